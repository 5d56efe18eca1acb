//! Surface (method 1): from sparse points to an oriented triangle mesh.
//!
//! `delaunay` tetrahedralises the points, `carve` casts rays from cameras to points through the
//! cells, `cut` separates inside from outside, `clean` keeps the visible part as an oriented
//! manifold, `simplify` and `refine` adjust the edge lengths to the target; `terrain` is the 2.5D
//! variant for nadir flights, `ply` reads and writes meshes.

pub mod carve;
pub mod clean;
pub mod corners;
pub mod cut;
pub mod delaunay;
#[cfg(test)]
mod manifold;
pub mod points;
mod quadric;
pub mod refine;
mod settings;
pub mod shapes;
pub mod simplify;
pub mod terrain;
#[cfg(test)]
mod tests;
mod wanted;

use nalgebra::{Point3, Vector3};
use serde::{Deserialize, Serialize};

use crate::{
    base::{
        error::{Advice, Hint},
        progress::{Cancelled, Stage, Watcher},
        tiles,
    },
    model::{
        georeference::{self, UprightFrame},
        mesh::Mesh,
        scene::{PointIndex, Scene},
    },
};
use delaunay::{Delaunay, DelaunayError, Dimension};
pub use settings::{SurfaceChoice, SurfaceSettings};
pub use wanted::WantedGsd;

/// With fewer points, a terrain is built.
const MIN_CARVED_POINTS: usize = 100;
/// Ratio of the spreads of the points in two directions below which the smaller one counts as zero.
const NO_SPREAD: f64 = 1e-6;
/// Margin of a tile, as a multiple of the longest edge: points farther away hardly change the
/// surface inside.
const MARGIN_EDGES: f64 = 10.0;
/// Steps per tile of [`build`] for progress.
const STEPS: u64 = 6;

/// Method by which the surface was made.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "lowercase")]
pub enum SurfaceKind {
    #[serde(rename = "3d")]
    Carved,
    Terrain,
    Mesh,
}

/// An oriented triangle mesh with borders; each edge has at most two triangles, normals point
/// outwards.
#[derive(Clone, Debug)]
pub struct Surface {
    pub kind: SurfaceKind,
    /// Vertices in world coordinates, scene units.
    pub vertices: Vec<Point3<f64>>,
    /// Vertex indices, counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
}

impl Surface {
    #[inline]
    pub fn corners(&self, triangle: u32) -> [Point3<f64>; 3] {
        self.triangles[triangle as usize].map(|v| self.vertices[v as usize])
    }

    pub fn centroid(&self, triangle: u32) -> Point3<f64> {
        let [a, b, c] = self.corners(triangle);
        Point3::from((a.coords + b.coords + c.coords) / 3.0)
    }

    /// Returns the normal, whose length is twice the triangle's area.
    pub fn area_normal(&self, triangle: u32) -> Vector3<f64> {
        let [a, b, c] = self.corners(triangle);
        (b - a).cross(&(c - a))
    }

    pub fn area(&self, triangle: u32) -> f64 {
        0.5 * self.area_normal(triangle).norm()
    }

    /// Returns the surface of the triangles to keep, in their order. Unused vertices are removed,
    /// and a vertex whose fans were connected only by dropped triangles is split, so that the
    /// result is again a manifold.
    pub fn keep(&self, keep: &[bool]) -> Surface {
        let kept = self
            .triangles
            .iter()
            .zip(keep)
            .filter_map(|(&t, &k)| k.then_some(t));
        corners::split_fans(Surface {
            kind: self.kind,
            vertices: self.vertices.clone(),
            triangles: kept.collect(),
        })
    }
}

impl Surface {
    /// Appends another surface.
    fn append(&mut self, other: Surface) {
        let offset = self.vertices.len() as u32;
        self.vertices.extend(other.vertices);
        self.triangles.extend(
            other
                .triangles
                .iter()
                .map(|corners| corners.map(|v| v + offset)),
        );
    }
}

/// Statistics of building the surface.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct SurfaceStats {
    /// Number of tiles. The counts below are sums over them, so overlaps count twice.
    pub tiles: usize,
    /// Sparse points used.
    pub points: usize,
    /// Sparse points rejected: fewer than two views, behind a camera, or a large reprojection
    /// error.
    pub points_dropped: usize,
    /// Distinct vertices of the tetrahedralisation.
    pub vertices: usize,
    /// Tetrahedra, including those with the vertex at infinity.
    pub cells: usize,
    /// Rays that voted.
    pub rays: usize,
    /// Median depth uncertainty of the points, scene units.
    pub sigma: f64,
    /// Triangles of the cut, the terrain or the mesh file.
    pub raw_triangles: usize,
    /// Triangles after cleaning (method 1.4).
    pub cleaned_triangles: usize,
    /// Triangles after the collapse of short edges (method 1.5).
    pub simplified_triangles: usize,
    /// Triangles of the surface.
    pub triangles: usize,
}

/// An error of building a surface.
#[derive(Debug, thiserror::Error)]
pub enum SurfaceError {
    #[error(
        "only {distinct} different sparse points can be used ({dropped} have fewer than two views, lie behind a camera or have a large \
         reprojection error); a surface needs 4"
    )]
    TooFewPoints { distinct: usize, dropped: usize },
    #[error("the sparse points lie on one line, which makes no surface")]
    Linear,
    #[error("the wanted ground sampling distance is {0}, but must be a positive number")]
    Gsd(f64),
    #[error("cannot use the surface: no view sees any part of it")]
    Empty,
    #[error(transparent)]
    Delaunay(DelaunayError),
    #[error(transparent)]
    Refine(refine::RefineError),
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
}

impl Hint for SurfaceError {
    fn hint(&self) -> Option<Advice> {
        Some(match self {
            Self::TooFewPoints { .. } | Self::Linear => {
                Advice::text("check the model, or give a surface with ").set("surface.mesh")
            }
            Self::Empty => Advice::text("check the model (")
                .run("doctor")
                .and(") and the wanted ")
                .set("target.gsd")
                .and(", or give a surface with ")
                .set("surface.mesh"),
            Self::Gsd(_) => Advice::text("set target.gsd, or type ").set("target.gsd"),
            Self::Delaunay(_) => {
                "check the model: its points cannot be triangulated as they are".into()
            }
            Self::Refine(_) => Advice::text("ask for a coarser ")
                .set("target.gsd")
                .and(", or a larger surface.max_edge_factor"),
            Self::Cancelled(_) => return None,
        })
    }
}

impl From<DelaunayError> for SurfaceError {
    fn from(error: DelaunayError) -> Self {
        match error {
            DelaunayError::Cancelled(cancelled) => Self::Cancelled(cancelled),
            other => Self::Delaunay(other),
        }
    }
}

impl From<refine::RefineError> for SurfaceError {
    fn from(error: refine::RefineError) -> Self {
        match error {
            refine::RefineError::Cancelled(cancelled) => Self::Cancelled(cancelled),
            other => Self::Refine(other),
        }
    }
}

/// Builds the surface of the scene, or takes the mesh instead, and adjusts its edges to `wanted` and
/// the settings; at most about `most` triangles. It still has triangles that no view sees: see
/// [`Surface::keep`].
///
/// # Errors
/// Too few points, a target far too fine, cancellation.
pub fn build(
    scene: &Scene,
    wanted: &WantedGsd,
    settings: &SurfaceSettings,
    mesh: Option<Mesh>,
    most: u64,
    watcher: &dyn Watcher,
) -> Result<(Surface, SurfaceStats), SurfaceError> {
    let gsd = wanted.everywhere();
    if !(gsd.is_finite() && gsd > 0.0) {
        return Err(SurfaceError::Gsd(gsd));
    }
    let mut stats = SurfaceStats {
        tiles: 1,
        ..SurfaceStats::default()
    };
    let whole = Steps {
        before: 0,
        all: STEPS,
        most,
        watcher,
    };
    whole.reached(0);
    let surface = match mesh {
        Some(Mesh {
            vertices,
            triangles,
        }) => {
            let surface = clean::make_manifold(Surface {
                kind: SurfaceKind::Mesh,
                vertices,
                triangles,
            });
            watcher.check()?;
            stats.cleaned_triangles = surface.triangles.len();
            if settings.mesh_as_is {
                surface
            } else {
                with_edges(surface, wanted, settings, &mut stats, &whole)?
            }
        }
        None => from_points(scene, wanted, settings, &mut stats, &whole)?,
    };
    stats.triangles = surface.triangles.len();
    watcher.progress(Stage::Surface, 1, 1);
    if surface.triangles.is_empty() {
        Err(SurfaceError::Empty)
    } else {
        Ok((surface, stats))
    }
}

/// Progress of one tile among all.
struct Steps<'a> {
    before: u64,
    all: u64,
    /// Maximum number of triangles of the tile.
    most: u64,
    watcher: &'a dyn Watcher,
}

impl Steps<'_> {
    fn reached(&self, step: u64) {
        self.watcher
            .progress(Stage::Surface, self.before + step, self.all);
    }
}

/// Simplifies and refines a cleaned surface (method 1.5 and 1.6).
fn with_edges(
    surface: Surface,
    wanted: &WantedGsd,
    settings: &SurfaceSettings,
    stats: &mut SurfaceStats,
    steps: &Steps,
) -> Result<Surface, SurfaceError> {
    steps.reached(4);
    let shortest = wanted.lengths(&surface.vertices, settings.edge_factor, steps.watcher)?;
    let surface = simplify::simplify(surface, shortest, steps.watcher)?;
    stats.simplified_triangles += surface.triangles.len();
    steps.reached(5);
    let longest = wanted.lengths(&surface.vertices, settings.max_edge_factor, steps.watcher)?;
    Ok(refine::refine(surface, longest, steps.most, steps.watcher)?)
}

/// Builds the surface of the sparse points: whole, or tile by tile, each from the points in and
/// around it, cropped to the tile.
fn from_points(
    scene: &Scene,
    wanted: &WantedGsd,
    settings: &SurfaceSettings,
    stats: &mut SurfaceStats,
    whole: &Steps,
) -> Result<Surface, SurfaceError> {
    let points = points::usable_points(scene);
    stats.points = points.len();
    stats.points_dropped = scene.points.len() - points.len();
    let positions: Vec<Point3<f64>> = points.iter().map(|p| scene.points[p.index()]).collect();
    let all = Part {
        scene,
        wanted,
        settings,
        everywhere: &positions,
    };
    let tiles = match settings.tile_points {
        Some(most) if points.len() > most as usize => tiles::split(&positions, most as usize),
        _ => return all.surface(&points, &positions, stats, whole),
    };
    stats.tiles = tiles.len();
    let margin = MARGIN_EDGES * settings.max_edge_factor * wanted.everywhere();
    let mut merged: Option<Surface> = None;
    for (i, tile) in tiles.iter().enumerate() {
        whole.watcher.check()?;
        let before = merged
            .as_ref()
            .map_or(0, |merged: &Surface| merged.triangles.len() as u64);
        let most = whole.most.saturating_sub(before);
        let steps = Steps {
            before: i as u64 * STEPS,
            all: tiles.len() as u64 * STEPS,
            most,
            ..*whole
        };
        let near = |(_, position): &(&PointIndex, &Point3<f64>)| tile.is_near(position, margin);
        let (points, near): (Vec<PointIndex>, Vec<Point3<f64>>) =
            points.iter().zip(&positions).filter(near).unzip();
        let surface = match all.surface(&points, &near, stats, &steps) {
            // The points of a tile may coincide or be collinear.
            Err(SurfaceError::TooFewPoints { .. } | SurfaceError::Linear) => continue,
            surface => surface?,
        };
        let triangles = 0..surface.triangles.len() as u32;
        let own: Vec<bool> = triangles
            .map(|t| tile.contains(&surface.centroid(t)))
            .collect();
        let own = surface.keep(&own);
        match &mut merged {
            None => merged = Some(own),
            Some(merged) => merged.append(own),
        }
    }
    merged.ok_or(SurfaceError::Linear)
}

/// Inputs shared by all tiles of a surface.
struct Part<'a> {
    scene: &'a Scene,
    wanted: &'a WantedGsd,
    settings: &'a SurfaceSettings,
    /// Positions of the points of all tiles.
    everywhere: &'a [Point3<f64>],
}

impl Part<'_> {
    /// Builds the surface of some points, in space or as terrain (method 1.7 and 1.8).
    fn surface(
        &self,
        points: &[PointIndex],
        positions: &[Point3<f64>],
        stats: &mut SurfaceStats,
        steps: &Steps,
    ) -> Result<Surface, SurfaceError> {
        let Self {
            scene,
            wanted,
            settings,
            everywhere,
        } = *self;
        let gsd = wanted.everywhere();
        let distinct = distinct_up_to_four(positions);
        if distinct < 4 {
            return Err(SurfaceError::TooFewPoints {
                distinct,
                dropped: stats.points_dropped,
            });
        }
        let [thickness, width, length] = georeference::spread(positions);
        if width <= NO_SPREAD * length {
            return Err(SurfaceError::Linear);
        }
        steps.reached(1);
        let is_flat = thickness <= NO_SPREAD * length;
        let is_terrain = match settings.kind {
            SurfaceChoice::Terrain => true,
            SurfaceChoice::Carved => is_flat,
            SurfaceChoice::Auto => is_flat || thickness < gsd || points.len() < MIN_CARVED_POINTS,
        };
        let cleaned = if is_terrain {
            let frame = UprightFrame::new(everywhere, scene, settings.up);
            let raw = terrain::triangulate(positions, &frame, settings.edge_factor * gsd);
            stats.raw_triangles += raw.triangles.len();
            if raw.triangles.is_empty() {
                return Err(SurfaceError::Linear);
            }
            clean::clean(&raw, &vec![true; raw.triangles.len()])
        } else {
            carved(scene, points, positions, settings, stats, steps)?
        };
        stats.cleaned_triangles += cleaned.triangles.len();
        with_edges(cleaned, wanted, settings, stats, steps)
    }
}

fn carved(
    scene: &Scene,
    points: &[PointIndex],
    positions: &[Point3<f64>],
    settings: &SurfaceSettings,
    stats: &mut SurfaceStats,
    steps: &Steps,
) -> Result<Surface, SurfaceError> {
    let delaunay = Delaunay::triangulate(positions, steps.watcher)?;
    if delaunay.dimension != Dimension::Three {
        return Err(SurfaceError::Linear);
    }
    steps.reached(2);
    let rays = carve::Rays::choose(scene, &delaunay, points, settings.rays_per_point as usize);
    // Mean over the tiles, weighted by vertices.
    let (before, here) = (stats.vertices as f64, delaunay.vertex_count() as f64);
    stats.sigma = if before == 0.0 {
        rays.sigma
    } else {
        (before * stats.sigma + here * rays.sigma) / (before + here)
    };
    stats.vertices += delaunay.vertex_count();
    stats.cells += delaunay.cells.len();
    stats.rays += rays.count();
    let raw = carve::carve(&delaunay, &rays, settings, steps.watcher)?;
    stats.raw_triangles += raw.surface.triangles.len();
    drop((delaunay, rays));
    steps.reached(3);
    Ok(clean::clean(&raw.surface, &raw.seen))
}

/// Returns the number of distinct points, at most 4.
fn distinct_up_to_four(points: &[Point3<f64>]) -> usize {
    let mut distinct: Vec<&Point3<f64>> = Vec::new();
    for point in points {
        if !distinct.contains(&point) {
            distinct.push(point);
        }
        if distinct.len() == 4 {
            break;
        }
    }
    distinct.len()
}
