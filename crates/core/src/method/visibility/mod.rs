//! Visibility ([method 2]): the triangles that each view sees.
//!
//! A triangle is visible in a view if its corners and centroid are in front of the camera, its
//! centroid projects into the image, it faces the camera, and at least half of its samples have
//! nothing in front of them by more than a tolerance. Samples are pixels of a rendered buffer of
//! inverse depth and triangle (`buffer`). A triangle that covers fewer than four pixels is sampled
//! at its centroid and corners by rays instead, against the triangles in the surrounding pixels.
//!
//! ```text
//! angle(normal, direction to the camera) < max_incidence_deg                       85°
//! free samples / samples ≥ min_free_share                                          0.5
//! tolerance = max(tolerance_edges · r g_d, tolerance_depth · depth)                0.1, 0.005
//! ```
//!
//! Depths and r g_d, the edge length of the simplified surface, are in scene units, depths along
//! the camera's axis; the numbers are the defaults of [`VisibilitySettings`].
//!
//! ```
//! use viewrank_core::base::{column::Storage, progress::NoWatcher};
//! use viewrank_core::method::visibility::{self, VisibilitySettings};
//! use viewrank_core::model::arrays::{Intrinsics, SceneArrays};
//! use viewrank_core::model::scene::{Scene, ViewIndex};
//! use viewrank_core::model::surface::{Surface, SurfaceKind};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let params = vec![100.0, 100.0, 50.0, 50.0];
//! let scene = Scene::from_arrays(&SceneArrays {
//!     cameras: vec![Intrinsics { model: "PINHOLE".into(), width: 100, height: 100, params }],
//!     names: vec!["down.jpg".into()],
//!     camera: vec![0],
//!     // From a height of 10, looking down.
//!     cam_from_world: vec![[1., 0., 0., 0., 0., -1., 0., 0., 0., 0., -1., 10.]],
//!     ..SceneArrays::default()
//! })?;
//! // Two triangles make a square on the ground; a third is above the first, at a height of 5.
//! let ground = [[-2., -2., 0.], [2., -2., 0.], [-2., 2., 0.], [2., 2., 0.]];
//! let above = [[-2., -2., 5.], [2., -2., 5.], [-2., 2., 5.]];
//! let vertices = ground.into_iter().chain(above).map(Into::into).collect();
//! let triangles = vec![[0, 1, 2], [1, 3, 2], [4, 5, 6]];
//! let surface = Surface { kind: SurfaceKind::Mesh, vertices, triangles };
//! let (points, settings, keep) =
//!     (scene.view_points(), VisibilitySettings::default(), Storage::Memory);
//! let seen = visibility::estimate(&scene, &points, &surface, &settings, 1.0, keep, &NoWatcher)?;
//! assert_eq!(seen.triangles_seen_by(ViewIndex(0)), [1, 2]);
//! # Ok(())
//! # }
//! ```
//!
//! [method 2]: https://github.com/viewrank/viewrank/blob/main/docs/method.md#2-visibility

mod buffer;
mod estimator;
mod parts;
mod patches;
mod settings;
mod shown;

use std::{
    iter,
    ops::Range,
    sync::atomic::{AtomicU32, Ordering},
};

use bytemuck::Pod;
use nalgebra::Point3;

use self::{
    buffer::{Buffer, Face, FacePoint},
    estimator::{Estimator, Observations, RenderedView},
};
pub use self::{
    parts::keep_parts_in_field,
    settings::VisibilitySettings,
    shown::{Shown, gsd_at, projected_area},
};
use crate::{
    base::{
        column::{self, Column, ColumnBuilder, DiskError, Storage, TableError},
        error::{Advice, Hint},
        progress::{Cancelled, Stage, StepCounter, Watcher},
        rows::Offsets,
    },
    model::{
        scene::{Scene, ViewIndex, ViewPoints},
        surface::Surface,
    },
};

/// Layers of the surface, one behind the other, that are drawn in a view on average over its
/// pixels. Streets and rooms are seen through tens of walls; a heap of triangles has any number.
const MOST_LAYERS: u64 = 256;

/// Error of computing what the views see.
#[derive(Debug, thiserror::Error)]
pub enum VisibilityError {
    #[error(
        "cannot use the surface: view {view:?} looks at more than {MOST_LAYERS} layers of it, one behind the other"
    )]
    Layers { view: String },
    #[error(transparent)]
    Table(#[from] TableError),
}

impl Hint for VisibilityError {
    fn hint(&self) -> Option<Advice> {
        match self {
            Self::Layers { .. } => {
                Some(Advice::text("give a mesh of what the images show with ").set("surface.mesh"))
            }
            Self::Table(error) => error.hint(),
        }
    }
}

/// Sparse table of (view, triangle) pairs; CSR by view, triangles ascending within a view.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Visibility {
    pub offsets: Offsets,
    /// Triangles, ascending within a view.
    pub triangles: Column<u32>,
    /// Number of observations that contradict the table: the surface hides the sparse point in this
    /// view, although the point is on the surface in another view of its track.
    pub contradictions: u64,
}

impl Visibility {
    /// Returns all views; each is a row of [`Self::triangles_seen_by`].
    pub fn views(&self) -> Vec<ViewIndex> {
        (0..self.offsets.rows())
            .map(|row| ViewIndex(row as u32))
            .collect()
    }

    /// Returns the triangles that the view sees, ascending.
    pub fn triangles_seen_by(&self, view: ViewIndex) -> &[u32] {
        &self.triangles[self.rows(view)]
    }

    /// Returns by triangle the number of views that see it, without some of them, ascending.
    pub fn views_of_triangles(&self, triangles: usize, left_out: &[ViewIndex]) -> Vec<u32> {
        let mut views = vec![0; triangles];
        for view in self.views() {
            if left_out.binary_search(&view).is_err() {
                for &triangle in self.triangles_seen_by(view) {
                    views[triangle as usize] += 1;
                }
            }
        }
        views
    }

    /// Returns the range of the view's rows. Tables parallel to this one (such as unary confidence)
    /// are indexed by row.
    pub fn rows(&self, view: ViewIndex) -> Range<usize> {
        self.offsets.row(view.index())
    }

    /// Returns the row of a triangle in a view; `None` if the view does not see it.
    pub fn row(&self, view: ViewIndex, triangle: u32) -> Option<usize> {
        let found = self.triangles_seen_by(view).binary_search(&triangle).ok()?;
        Some(self.rows(view).start + found)
    }

    /// Returns for each triangle whether any view sees it.
    pub fn seen_triangles(&self, triangles: usize) -> Vec<bool> {
        let mut seen = vec![false; triangles];
        self.triangles
            .by_parts()
            .for_each(|&t| seen[t as usize] = true);
        seen
    }

    /// Returns the table for the surface without the triangles where `keep` is false, renumbered as
    /// by [`Surface::keep`].
    pub fn keep(self, keep: &[bool]) -> Result<Self, DiskError> {
        let numbers = numbers(keep);
        let rows = self.offsets;
        let mut offsets = Offsets::default();
        let triangles = match self.triangles.into_rows() {
            // In place: the table is the largest of a plan.
            Ok(mut triangles) => {
                let mut end = 0;
                for view in 0..rows.rows() {
                    let start = end;
                    for row in rows.row(view) {
                        if let Some(number) = numbers[triangles[row] as usize] {
                            triangles[end] = number;
                            end += 1;
                        }
                    }
                    offsets.push(end - start);
                }
                triangles.truncate(end);
                triangles.into()
            }
            Err(shared) => {
                let mut triangles = ColumnBuilder::new(shared.storage())?;
                for view in 0..rows.rows() {
                    if view.is_multiple_of(column::READ_AT_ONCE) {
                        shared.release();
                    }
                    let view = shared[rows.row(view)].iter();
                    let view: Vec<u32> = view.filter_map(|&t| numbers[t as usize]).collect();
                    triangles.extend(&view)?;
                    offsets.push(view.len());
                }
                triangles.finish()?
            }
        };
        Ok(Self {
            offsets,
            triangles,
            contradictions: self.contradictions,
        })
    }

    /// Builds a column parallel to the table, with its storage, from batches of views. `of_view`
    /// returns a value for each row of a view; `start` makes the state of a thread.
    pub fn column<T: Pod + Send, S: Send>(
        &self,
        views_at_once: usize,
        start: impl Fn() -> S + Sync + Send,
        of_view: impl Fn(&mut S, ViewIndex) -> Result<Vec<T>, Cancelled> + Sync + Send,
    ) -> Result<Column<T>, TableError> {
        let mut column = ColumnBuilder::new(self.triangles.storage())?;
        column::in_order(
            &self.views(),
            views_at_once,
            start,
            |s, &view| of_view(s, view),
            |_, rows| {
                self.triangles.release();
                rows.iter().try_for_each(|rows| column.extend(rows))
            },
        )?;
        Ok(column.finish()?)
    }
}

/// Computes which view sees which triangle. `edge_length`: r g_d, the edge length of the simplified
/// surface, scene units; `keep`: storage of the table.
///
/// # Errors
/// Cancelled, the disk, or the first view that looks at too many layers of the surface.
pub fn estimate(
    scene: &Scene,
    points: &ViewPoints,
    surface: &Surface,
    settings: &VisibilitySettings,
    edge_length: f64,
    keep: Storage,
    watcher: &dyn Watcher,
) -> Result<Visibility, VisibilityError> {
    let stage = Estimator::new(scene, surface, settings, edge_length);
    let observations = Observations::new(scene.points.len());
    let views: Vec<ViewIndex> = scene.view_indices().collect();
    let first_crowded = AtomicU32::new(u32::MAX);
    let steps = StepCounter::start(watcher, Stage::Visibility, views.len());
    let look = |picture: &mut RenderedView, &view: &ViewIndex| {
        let seen = steps.run(|| stage.look(view, points.observed_by(view), picture, &observations));
        seen.map(|seen| {
            seen.unwrap_or_else(|| {
                // The least, so that the same view is named whichever thread comes first.
                first_crowded.fetch_min(view.0, Ordering::Relaxed);
                Vec::new()
            })
        })
    };
    let (offsets, triangles) = rows_of(&views, keep, look)?;
    if let Some(&view) = views.get(first_crowded.into_inner() as usize) {
        let view = scene.name(view).to_owned();
        return Err(VisibilityError::Layers { view });
    }
    Ok(Visibility {
        offsets,
        triangles,
        contradictions: observations.contradictions(),
    })
}

/// Builds the table of what `look` returns for each view.
fn rows_of(
    views: &[ViewIndex],
    keep: Storage,
    look: impl Fn(&mut RenderedView, &ViewIndex) -> Result<Vec<u32>, Cancelled> + Sync + Send,
) -> Result<(Offsets, Column<u32>), TableError> {
    let (mut offsets, mut triangles) = (Offsets::default(), ColumnBuilder::new(keep)?);
    column::in_order(
        views,
        column::READ_AT_ONCE,
        RenderedView::default,
        look,
        |_, rows| {
            for row in rows {
                triangles.extend(&row)?;
                offsets.push(row.len());
            }
            Ok(())
        },
    )?;
    Ok((offsets, triangles.finish()?))
}

/// Returns the largest number of pixels rendered for a view, over all faces of its camera.
pub fn picture_pixels(scene: &Scene, settings: &VisibilitySettings) -> u64 {
    let pixels = |camera| {
        Face::covering(camera, settings.buffer_px)
            .iter()
            .map(Face::pixels)
            .sum()
    };
    scene.cameras.iter().map(pixels).max().unwrap_or(0)
}

/// Returns the number of each triangle among those that are kept.
fn numbers(keep: &[bool]) -> Vec<Option<u32>> {
    let mut next = 0..;
    keep.iter()
        .map(|&is_kept| if is_kept { next.next() } else { None })
        .collect()
}

/// Marks a pixel without a triangle.
pub const NOTHING: u32 = u32::MAX;
/// Near plane of [`front`], as a share of the surface's distance from the camera.
const NEAR_SHARE: f64 = 1e-4;

/// Returns the frontmost triangle in each pixel of some rows of a pinhole view's image, resized to
/// `size` (width, height), row by row; [`NOTHING`] for empty pixels. Sampled at pixel centres.
/// Takes 12 bytes per pixel of these rows.
pub fn front(
    scene: &Scene,
    surface: &Surface,
    view: ViewIndex,
    size: [u32; 2],
    rows: Range<u32>,
) -> Vec<u32> {
    let face = Face::pinhole(scene.camera_of(view), size, rows);
    let pose = &scene.view(view).cam_from_world;
    let vertices = surface.vertices.iter();
    let vertices: Vec<Point3<f64>> = vertices.map(|v| pose.camera_from_world(v)).collect();
    let depths = vertices.iter().map(|v| v.z.abs());
    let near = NEAR_SHARE * depths.fold(f64::MIN_POSITIVE, f64::max);
    let vertices: Vec<FacePoint> = vertices.iter().map(|v| face.project(v)).collect();
    let mut buffer = Buffer::default();
    buffer.clear(&face);
    for (t, corners) in surface.triangles.iter().enumerate() {
        let corners = corners.map(|v| &vertices[v as usize]);
        buffer.draw(&face, near, iter::once((t as u32, corners)), &mut [0]);
    }
    buffer.triangles(NOTHING).collect()
}

#[cfg(test)]
mod tests;
