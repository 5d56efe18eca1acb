//! Visibility (method 2): the triangles that each view sees.
//!
//! A triangle is visible in a view if its corners and centroid are in front of the camera, its
//! centroid projects into the image, it faces the camera, and at least half of its samples have
//! nothing in front of them by more than a tolerance. Samples are pixels of a rendered buffer of
//! inverse depth and triangle ([`buffer`]). A triangle that covers fewer than four pixels is
//! sampled at its centroid and corners by rays instead, against the triangles in the surrounding
//! pixels.

mod buffer;
mod patches;
mod settings;
mod shown;

use std::{
    iter,
    ops::Range,
    sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering},
};

use bytemuck::Pod;
use nalgebra::{Point3, Vector3};

pub use self::shown::{gsd_at, projected_area};
use self::{
    buffer::{Buffer, Face, FacePoint, Tolerance},
    patches::{Patch, Patches},
};
pub use self::{settings::VisibilitySettings, shown::Shown};
use crate::{
    base::{
        bits,
        column::{self, Column, ColumnBuilder, DiskError, Storage, TableError},
        error::{Advice, Hint},
        progress::{Cancelled, Stage, Watcher},
        rows::Offsets,
    },
    method::surface::Surface,
    model::{
        camera::{Camera, CameraModel},
        scene::{PointIndex, Pose, Scene, ViewIndex, ViewPoints},
    },
};

/// Triangles that cover fewer pixels are sampled by rays (method 2).
const FEW_PIXELS: u32 = 4;
/// Near plane, edge lengths: nothing closer to the camera is drawn.
const NEAR_EDGES: f64 = 0.05;

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
    pub fn keep(&self, keep: &[bool]) -> Result<Self, DiskError> {
        let numbers = numbers(keep);
        let mut offsets = Offsets::default();
        let mut triangles = ColumnBuilder::new(self.triangles.storage())?;
        for view in 0..self.offsets.rows() {
            if view.is_multiple_of(column::READ_AT_ONCE) {
                self.triangles.release();
            }
            let view = self.triangles[self.offsets.row(view)].iter();
            let view: Vec<u32> = view.filter_map(|&t| numbers[t as usize]).collect();
            triangles.extend(&view)?;
            offsets.push(view.len());
        }
        Ok(Self {
            offsets,
            triangles: triangles.finish()?,
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
    let (done, first_crowded) = (AtomicU64::new(0), AtomicU32::new(u32::MAX));
    watcher.progress(Stage::Visibility, 0, views.len() as u64);
    let look = |picture: &mut RenderedView, &view: &ViewIndex| {
        watcher.check()?;
        if !stage.draw(view, picture) {
            first_crowded.fetch_min(view.0, Ordering::Relaxed);
            return Ok(Vec::new());
        }
        let seen = stage.visible(view, picture);
        stage.observe(view, points.observed_by(view), picture, &observations);
        watcher.progress(
            Stage::Visibility,
            1 + done.fetch_add(1, Ordering::Relaxed),
            views.len() as u64,
        );
        Ok(seen)
    };
    let triangles = ColumnBuilder::new(keep).map_err(TableError::Disk)?;
    let (mut offsets, mut triangles) = (Offsets::default(), triangles);
    column::in_order(
        &views,
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
    if let Some(&view) = views.get(first_crowded.into_inner() as usize) {
        let view = scene.name(view).to_owned();
        return Err(VisibilityError::Layers { view });
    }
    let triangles = triangles.finish().map_err(TableError::Disk)?;
    Ok(Visibility {
        offsets,
        triangles,
        contradictions: observations.contradictions(),
    })
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
/// `size` (width, height), row by row; [`NOTHING`] for empty pixels. Sampled at pixel centres. Takes
/// 12 bytes per pixel of these rows.
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

/// The inputs that all views share.
struct Estimator<'a> {
    scene: &'a Scene,
    surface: &'a Surface,
    patches: Patches,
    /// Faces of each camera.
    faces: Vec<Vec<Face>>,
    tolerance: Tolerance,
    near: f64,
    /// Squared cosine of the largest allowed angle of incidence.
    cos2: f64,
    min_free_share: f64,
}

/// Buffers of one view; one per thread, reused.
#[derive(Default)]
struct RenderedView {
    buffers: Vec<Buffer>,
    /// Indices of the patches in the field.
    drawn: Vec<usize>,
    candidates: Vec<Candidate>,
    /// Vertices of the current patch in camera coordinates, and on a face.
    vertices: Vec<Point3<f64>>,
    projected: Vec<FacePoint>,
    /// Pixels that each triangle of the current patch covers.
    covered: Vec<u32>,
    /// Pixels in which each triangle is frontmost, all 0 between uses.
    in_front: Vec<u32>,
    /// A bit for each triangle, all zero between uses.
    seen: Vec<u64>,
}

impl RenderedView {
    /// Counts, for each candidate, the pixels in which it is frontmost.
    fn count_in_front(&mut self, patches: &Patches) {
        let Self {
            buffers,
            drawn,
            candidates,
            in_front,
            ..
        } = self;
        in_front.resize(patches.triangle_count(), 0);
        let shown = buffers
            .iter()
            .flat_map(|buffer| buffer.triangles(NOTHING))
            .filter(|&t| t != NOTHING);
        shown.for_each(|t| in_front[t as usize] += 1);
        candidates
            .iter_mut()
            .for_each(|candidate| candidate.in_front = in_front[candidate.triangle as usize]);
        // Usually far fewer than pixels.
        let drawn = drawn
            .iter()
            .flat_map(|&patch| patches.triangle_indices(&patches.patches[patch]));
        drawn.for_each(|&t| in_front[t as usize] = 0);
    }
}

fn is_share(min_share: f64, free: u32, samples: u32) -> bool {
    f64::from(free) >= min_share * f64::from(samples)
}

/// Returns whether at least this share (0 to 1) of the points that are sampled is free. `points`:
/// whether each is free, `None` for one that is not sampled. Stops at the first after which the
/// others cannot change it.
fn is_share_free(min_share: f64, points: impl ExactSizeIterator<Item = Option<bool>>) -> bool {
    let (mut samples, mut free) = (0, 0);
    for (left, point) in (0..points.len() as u32).rev().zip(points) {
        samples += u32::from(point.is_some());
        free += u32::from(point == Some(true));
        if samples > 0 && is_share(min_share, free, samples + left) {
            return true;
        }
        if !is_share(min_share, free + left, samples + left) {
            return false;
        }
    }
    false
}

/// A triangle that faces the camera and whose centroid is in the image.
struct Candidate {
    triangle: u32,
    /// Corners in camera coordinates.
    corners: [Point3<f64>; 3],
    /// Pixels that the triangle covers.
    covered: u32,
    /// Pixels in which the triangle is frontmost.
    in_front: u32,
}

impl<'a> Estimator<'a> {
    fn new(
        scene: &'a Scene,
        surface: &'a Surface,
        settings: &VisibilitySettings,
        edge_length: f64,
    ) -> Self {
        let length = settings.tolerance_edges * edge_length;
        Self {
            scene,
            surface,
            patches: Patches::new(surface),
            faces: scene
                .cameras
                .iter()
                .map(|c| Face::covering(c, settings.buffer_px))
                .collect(),
            tolerance: Tolerance {
                length,
                depth_share: settings.tolerance_depth,
            },
            near: NEAR_EDGES * edge_length,
            cos2: settings.max_incidence_deg.to_radians().cos().powi(2),
            min_free_share: settings.min_free_share,
        }
    }

    /// Renders everything in the view's field and collects the triangles that may be visible;
    /// returns whether all is drawn, which it is up to [`MOST_LAYERS`].
    fn draw(&self, view: ViewIndex, picture: &mut RenderedView) -> bool {
        let (camera, faces) = self.camera(view);
        let pose = &self.scene.view(view).cam_from_world;
        picture.candidates.clear();
        picture.drawn.clear();
        picture.buffers.resize_with(faces.len(), Buffer::default);
        picture
            .buffers
            .iter_mut()
            .zip(faces)
            .for_each(|(buffer, face)| buffer.clear(face));
        let pixels: u64 = faces.iter().map(Face::pixels).sum();
        let mut left = MOST_LAYERS * pixels;
        for (index, patch) in self.patches.patches.iter().enumerate() {
            let centre = pose.camera_from_world(&patch.centre);
            if !faces.iter().any(|face| face.meets(&centre, patch.radius)) {
                continue;
            }
            picture.drawn.push(index);
            picture.vertices.clear();
            picture.vertices.extend(
                self.patches
                    .vertices(patch)
                    .iter()
                    .map(|v| pose.camera_from_world(v)),
            );
            self.draw_patch(patch, faces, picture);
            let drawn: u64 = picture.covered.iter().map(|&n| u64::from(n)).sum();
            let Some(rest) = left.checked_sub(drawn) else {
                return false;
            };
            left = rest;
            for ((triangle, corners), &covered) in
                self.patches.triangles(patch).zip(&picture.covered)
            {
                let corners = corners.map(|c| picture.vertices[c]);
                if self.may_be_visible(camera, &corners) {
                    picture.candidates.push(Candidate {
                        triangle,
                        corners,
                        covered,
                        in_front: 0,
                    });
                }
            }
        }
        picture.count_in_front(&self.patches);
        true
    }

    /// Renders the triangles of a patch, whose vertices are already in `picture`, and counts the
    /// pixels of each.
    fn draw_patch(&self, patch: &Patch, faces: &[Face], picture: &mut RenderedView) {
        let RenderedView {
            buffers,
            vertices,
            projected,
            covered,
            ..
        } = picture;
        covered.clear();
        covered.resize(patch.len(), 0);
        for (face, buffer) in faces.iter().zip(buffers) {
            projected.clear();
            projected.extend(vertices.iter().map(|v| face.project(v)));
            let triangles = self
                .patches
                .triangles(patch)
                .map(|(t, corners)| (t, corners.map(|c| &projected[c])));
            buffer.draw(face, self.near, triangles, covered);
        }
    }

    /// Checks conditions 1 and 2 of method 2; corners in camera coordinates.
    fn may_be_visible(&self, camera: &Camera, [a, b, c]: &[Point3<f64>; 3]) -> bool {
        let everywhere = camera.model() == CameraModel::Equirectangular;
        let centroid = (a.coords + b.coords + c.coords) / 3.0;
        let normal = (b - a).cross(&(c - a));
        let towards = -normal.dot(&centroid);
        let faces_camera = towards > 0.0
            && towards * towards > self.cos2 * normal.norm_squared() * centroid.norm_squared();
        faces_camera
            && (everywhere || a.z.min(b.z).min(c.z) > 0.0)
            && camera
                .project(&centroid.into())
                .is_some_and(|pixel| camera.contains(&pixel))
    }

    /// Returns the candidates that are not occluded (condition 3), ascending.
    fn visible(&self, view: ViewIndex, picture: &mut RenderedView) -> Vec<u32> {
        let mut seen = std::mem::take(&mut picture.seen);
        seen.resize(self.surface.triangles.len().div_ceil(64), 0);
        let mut count = 0;
        for candidate in &picture.candidates {
            let is_free = match candidate.covered {
                ..FEW_PIXELS => self.is_free_at_points(view, picture, candidate),
                covered => self.are_enough(self.free_pixels(view, picture, candidate), covered),
            };
            if is_free {
                seen[candidate.triangle as usize / 64] |= 1 << (candidate.triangle % 64);
                count += 1;
            }
        }
        let triangles = bits::take(&mut seen, count);
        picture.seen = seen;
        triangles
    }

    fn are_enough(&self, free: u32, samples: u32) -> bool {
        is_share(self.min_free_share, free, samples)
    }

    /// Returns the number of the candidate's pixels that are free. Counts exactly only if needed:
    /// most triangles are frontmost in enough of their pixels and need no second pass.
    fn free_pixels(&self, view: ViewIndex, picture: &RenderedView, candidate: &Candidate) -> u32 {
        if self.are_enough(candidate.in_front, candidate.covered) {
            return candidate.in_front;
        }
        let faces = self.camera(view).1.iter().zip(&picture.buffers);
        faces
            .map(|(face, buffer)| buffer.free(face, &candidate.corners, self.near, self.tolerance))
            .sum()
    }

    /// Returns whether enough of the centroid and the corners are free, among those in the field.
    fn is_free_at_points(
        &self,
        view: ViewIndex,
        picture: &RenderedView,
        candidate: &Candidate,
    ) -> bool {
        let [a, b, c] = candidate.corners;
        let centroid = Point3::from((a.coords + b.coords + c.coords) / 3.0);
        let is_free = |point: Point3<f64>| {
            let mut faces = self.camera(view).1.iter().zip(&picture.buffers);
            let (pixels, own) =
                faces.find_map(|(face, buffer)| buffer.around(face, &point, self.near))?;
            Some(!self.ray_is_blocked(view, &point, candidate.triangle, &pixels, own))
        };
        is_share_free(
            self.min_free_share,
            [centroid, a, b, c].into_iter().map(is_free),
        )
    }

    /// Returns whether a triangle in the pixels around a point is in front of it by more than the
    /// tolerance.
    fn ray_is_blocked(
        &self,
        view: ViewIndex,
        point: &Point3<f64>,
        triangle: u32,
        pixels: &[(u32, f64); 4],
        own: f64,
    ) -> bool {
        let pose = &self.scene.view(view).cam_from_world;
        let blocks = |&(other, front): &(u32, f64)| {
            front > 0.0
                && other != triangle
                && self.tolerance.hides(front, own)
                && hit(&self.corners(pose, other), &point.coords)
                    .is_some_and(|share| self.tolerance.hides(own / share, own))
        };
        pixels.iter().any(blocks)
    }

    fn corners(&self, pose: &Pose, triangle: u32) -> [Point3<f64>; 3] {
        self.surface
            .corners(triangle)
            .map(|v| pose.camera_from_world(&v))
    }

    fn camera(&self, view: ViewIndex) -> (&Camera, &[Face]) {
        let camera = self.scene.view(view).camera.index();
        (&self.scene.cameras[camera], &self.faces[camera])
    }

    /// Records which observed points of the view are on the surface and which are behind it.
    fn observe(
        &self,
        view: ViewIndex,
        points: &[PointIndex],
        picture: &RenderedView,
        observations: &Observations,
    ) {
        let pose = &self.scene.view(view).cam_from_world;
        for &p in points {
            let point = pose.camera_from_world(&self.scene.points[p.index()]);
            let mut faces = self.camera(view).1.iter().zip(&picture.buffers);
            let Some((_, front, own)) =
                faces.find_map(|(face, buffer)| buffer.sample(face, &point, self.near))
            else {
                continue;
            };
            if self.tolerance.hides(front, own) {
                observations.hidden[p.index()].fetch_add(1, Ordering::Relaxed);
            } else if !self.tolerance.hides(own, front) {
                observations.on_surface[p.index()].store(true, Ordering::Relaxed);
            }
        }
    }
}

/// Intersects a ray from the origin with a triangle. Returns the position along `ray` as a share of
/// its length, `None` if they don't meet.
fn hit([a, b, c]: &[Point3<f64>; 3], ray: &Vector3<f64>) -> Option<f64> {
    let normal = (b - a).cross(&(c - a));
    let share = normal.dot(&a.coords) / normal.dot(ray);
    let sides = [(a, b), (b, c), (c, a)].map(|(p, q)| p.coords.cross(&q.coords).dot(ray));
    let inside = sides.iter().all(|&s| s >= 0.0) || sides.iter().all(|&s| s <= 0.0);
    (inside && share > 0.0).then_some(share)
}

/// By sparse point: whether it is on the surface in any view, and the number of its views in which
/// it is hidden.
struct Observations {
    on_surface: Vec<AtomicBool>,
    hidden: Vec<AtomicU32>,
}

impl Observations {
    fn new(points: usize) -> Self {
        Self {
            on_surface: (0..points).map(|_| AtomicBool::new(false)).collect(),
            hidden: (0..points).map(|_| AtomicU32::new(0)).collect(),
        }
    }

    fn contradictions(self) -> u64 {
        let both = self.on_surface.into_iter().zip(self.hidden);
        both.filter_map(|(on, hidden)| on.into_inner().then_some(u64::from(hidden.into_inner())))
            .sum()
    }
}

#[cfg(test)]
mod tests;
