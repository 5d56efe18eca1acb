//! Surface ([method 1]): from sparse points to an oriented triangle mesh.
//!
//! The points are tetrahedralised ([`delaunay`]), and the rays from cameras to points vote on what
//! is outside ([`carve`]). A minimum cut parts outside from inside ([`cut`]); [`clean`] keeps what
//! rays reach as an oriented manifold, and [`simplify`] and [`refine`] adjust the edges to the
//! wanted GSD g_d. [`terrain`] is the 2.5D variant for nadir flights.
//!
//! ```text
//! facet that a ray crosses, d before its point   α_vis (1 − exp(−d² / 2σ²))
//! every facet                                    λ (1 − min(cos φ, cos ψ))
//! edges                                          95 % above r g_d, all below e g_d
//! ```
//!
//! The cut pays the first line where a ray would enter the inside, the second for every facet
//! between outside and inside. d, σ, the depth uncertainty of the points, and g_d, per pixel, are
//! lengths in scene units, φ and ψ the angles of the facet with the circumspheres of its two cells;
//! α_vis, λ, r and e are [settings], which have no unit. Vertices are in world coordinates.
//!
//! ```
//! use viewrank_core::{
//!     base::progress::NoWatcher,
//!     method::{
//!         surface::{self, SurfaceSettings, WantedGsd},
//!         synthetic::Town,
//!     },
//!     model::surface::SurfaceKind,
//! };
//!
//! # fn main() -> Result<(), surface::SurfaceError> {
//! // Boxes on hills, 80 m wide.
//! let scene = Town { points: 1500, ..Town::default() }.scene();
//! let (gsd, settings) = (0.1, SurfaceSettings::default());
//! let wanted = WantedGsd::uniform(gsd);
//! let (surface, stats) = surface::build(&scene, &wanted, &settings, None, 100_000, &NoWatcher)?;
//!
//! assert_eq!(surface.kind, SurfaceKind::Carved);
//! assert!(stats.simplified_triangles < stats.cleaned_triangles);
//! let sides = (0..stats.triangles as u32).flat_map(|t| surface.sides(t));
//! assert!(sides.fold(0.0, f64::max) < settings.max_edge_factor * gsd);
//! # Ok(())
//! # }
//! ```
//!
//! [method 1]: https://github.com/viewrank/viewrank/blob/main/docs/method.md#1-surface
//! [settings]: SurfaceSettings

pub mod carve;
pub mod clean;
pub mod cut;
pub mod delaunay;
mod from_points;
pub mod points;
mod quadric;
pub mod refine;
mod settings;
pub mod simplify;
pub mod terrain;
#[cfg(test)]
mod tests;
mod wanted;

use serde::{Deserialize, Serialize};

use crate::{
    base::{
        error::{Advice, Hint},
        progress::{Cancelled, Stage, Watcher},
    },
    model::{
        mesh::Mesh,
        scene::Scene,
        surface::{Surface, SurfaceKind},
    },
};
use delaunay::DelaunayError;
use from_points::from_points;
pub use settings::{SurfaceChoice, SurfaceSettings};
pub use wanted::WantedGsd;

/// Steps per tile of [`build`] for progress.
const STEPS: u64 = 6;

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

/// Builds the surface of the scene, or takes the mesh instead, and adjusts its edges to `wanted`
/// and the settings; at most about `most` triangles. It still has triangles that no view sees: see
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
        Some(mesh) => of_mesh(mesh, wanted, settings, &mut stats, &whole)?,
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

/// Takes a mesh for the surface, as it is or with adjusted edges.
fn of_mesh(
    mesh: Mesh,
    wanted: &WantedGsd,
    settings: &SurfaceSettings,
    stats: &mut SurfaceStats,
    whole: &Steps,
) -> Result<Surface, SurfaceError> {
    let surface = clean::make_manifold(Surface {
        kind: SurfaceKind::Mesh,
        vertices: mesh.vertices,
        triangles: mesh.triangles,
    });
    whole.watcher.check()?;
    stats.cleaned_triangles = surface.triangles.len();
    if settings.mesh_as_is {
        Ok(surface)
    } else {
        with_edges(surface, wanted, settings, stats, whole)
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
    /// Returns the progress of a tile, where those before it have this number of triangles.
    fn of_tile(&self, tile: usize, tiles: usize, triangles: usize) -> Self {
        Self {
            before: tile as u64 * STEPS,
            all: tiles as u64 * STEPS,
            most: self.most.saturating_sub(triangles as u64),
            watcher: self.watcher,
        }
    }

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
