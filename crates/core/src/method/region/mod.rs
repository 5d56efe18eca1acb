//! Region of interest (5.7 of [method 5]): the part of the scene that is planned for.
//!
//! A region is a set of polygons on the map, a box, a closed mesh, or `auto`. The other stages see
//! it only as a factor on the weight of each triangle and, for polygons, a wanted g_d.
//!
//! ```text
//! weight of t   factor(t) · w_t / Σ factor · w
//! factor(t)     mean of the areas' weight at 16 samples of t, 0 outside, 1 inside a box or mesh
//! core of auto  ends where m ln(m / a) + (1 − m) ln((1 − m) / (1 − a)) is largest
//! ```
//!
//! m and a, 0 to 1, are the shares of all pixels and of the area that the triangles with most
//! pixels per area have together. Boxes and meshes are in world coordinates and scene units.
//!
//! ```
//! use viewrank_core::{
//!     base::progress::NoWatcher,
//!     method::{ranking::Objective, region::RegionShape, synthetic::Town},
//! };
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! // Triangles of 2 m, of which the side of the box at x = 1 cuts some.
//! let surface = Town::default().surface();
//! let region = RegionShape::of_box([1.0, -40.0, -40.0, 40.0, 40.0, 40.0]);
//! let region = region.lay_over(&surface, &[], &NoWatcher)?;
//! assert!(region.factors.iter().all(|factor| (16.0 * factor).fract() == 0.0));
//! assert!(region.factors.iter().any(|&factor| factor > 0.0 && factor < 1.0));
//!
//! let objective = Objective::by_area(&surface, Some(&region), 1);
//! assert!((objective.weights.iter().sum::<f64>() - 1.0).abs() < 1e-9);
//! for (t, &weight) in (0..).zip(&objective.weights) {
//!     assert_eq!(weight > 0.0, region.is_inside(t));
//! }
//! # Ok(())
//! # }
//! ```
//!
//! [method 5]: https://github.com/viewrank/viewrank/blob/main/docs/method.md#5-ranking

mod areas;
mod columns;
mod densest;
mod error;
mod ground;
mod polygon;
mod solid;

use std::sync::atomic::{AtomicU64, Ordering};

use nalgebra::Point3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

pub use areas::{Area, Areas, Coordinates, Polygon};
pub use error::{RegionError, ShapeError};
pub use ground::{COARSEST, Footprint, Ground, GroundCell, GroundPlane, Photographed, Photographs};
pub use solid::OpenMesh;

use self::{areas::MapAreas, solid::Solid};
use crate::{
    base::progress::Watcher,
    model::{
        georeference::{Georeference, MapFrame},
        mesh::Mesh,
        surface::Surface,
    },
};

/// Triangles between two checks for cancellation.
const AT_ONCE: usize = 16_384;
/// Edges (of a mesh, triangles) of the region that may be looked at in all, and for each triangle
/// of the surface: a hundred times as many as outlines of towns or coasts need. A comb of some
/// hundred thousand teeth would take minutes.
const LOOKED_AT: [u64; 2] = [100_000_000, 16_000];

/// Kind of a region.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "lowercase")]
pub enum RegionKind {
    /// Polygons from a GeoJSON file.
    Polygons,
    Box,
    /// A closed mesh.
    Mesh,
    /// The box around the densest part of the surface.
    Auto,
}

/// Factors and wanted resolutions of the triangles of a surface.
#[derive(Clone, Debug, PartialEq)]
pub struct Region {
    pub kind: RegionKind,
    /// Factor on the weight of each triangle: its share inside, times the weight of the areas
    /// there.
    pub factors: Vec<f32>,
    /// Share of each triangle inside areas of positive weight, 0 to 1.
    pub covered: Vec<f32>,
    /// g_d that the areas ask for, per triangle, infinite where they ask for none; empty if no area
    /// asks for any.
    pub gsd: Vec<f32>,
    /// The box; for polygons and meshes the bounds of the triangles inside. Low corner, high
    /// corner, world coordinates.
    pub bounds: [f64; 6],
    pub outline: Outline,
}

/// Outline of the region on a map.
#[derive(Clone, Debug, PartialEq)]
pub enum Outline {
    /// Polygons in longitude and latitude, degrees.
    Geodetic(Vec<Polygon>),
    /// Rings of polygons in world coordinates.
    Polygons(Vec<Vec<Vec<Point3<f64>>>>),
    /// The convex hull, seen from above, of these points in world coordinates.
    Hull(Vec<Point3<f64>>),
}

impl Region {
    pub fn is_inside(&self, triangle: u32) -> bool {
        self.factors[triangle as usize] > 0.0
    }
}

/// A region before it is projected onto a surface.
#[derive(Clone, Debug)]
pub enum RegionShape {
    Areas(Box<MapAreas>),
    /// A closed mesh and its hull seen from above, world coordinates.
    Solid(Box<Solid>, Vec<Point3<f64>>),
    Box([f64; 6]),
    Auto,
}

/// Properties of the region at a position inside.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RegionProperties {
    weight: f64,
    gsd: Option<f64>,
}

impl RegionProperties {
    const INSIDE: Self = Self {
        weight: 1.0,
        gsd: None,
    };
}

/// Mean over the 16 samples of a triangle.
#[derive(Clone, Copy, Debug, Default)]
pub struct TriangleSamples {
    is_touched: bool,
    covered: f32,
    factor: f32,
    gsd: f32,
}

impl RegionShape {
    /// Returns the region of polygons. `frame`: the map on which those without a georeference are
    /// drawn.
    pub fn of_areas(
        areas: Areas,
        place: &Georeference,
        frame: &MapFrame,
    ) -> Result<Self, ShapeError> {
        Ok(Self::Areas(Box::new(MapAreas::new(areas, place, frame)?)))
    }

    /// Returns the region inside a closed mesh.
    pub fn of_mesh(mesh: &Mesh, frame: &MapFrame) -> Result<Self, ShapeError> {
        let solid = Solid::new(mesh)?;
        let hull = frame.hull(&solid.vertices().collect::<Vec<_>>());
        Ok(Self::Solid(Box::new(solid), hull))
    }

    /// Returns the box of two opposite corners along the axes of the model.
    pub fn of_box(corners: [f64; 6]) -> Self {
        Self::Box(ordered(corners))
    }

    /// Returns the part of the map that the region covers; `None` for `auto`, which is a part of
    /// the surface.
    pub fn footprint(&self, frame: &MapFrame) -> Option<Footprint<'_>> {
        match self {
            Self::Areas(areas) => Some(Footprint::Areas(areas)),
            Self::Solid(_, hull) => Some(Footprint::Hull(hull.clone())),
            Self::Box(corners) => Some(Footprint::Hull(frame.hull(&box_corners(corners)))),
            Self::Auto => None,
        }
    }

    /// Projects the region onto a surface. `pixels`: number per triangle, over all views; for
    /// `auto` only.
    ///
    /// # Errors
    /// No part of the surface counts; cancellation.
    pub fn lay_over(
        self,
        surface: &Surface,
        pixels: &[f64],
        watcher: &dyn Watcher,
    ) -> Result<Region, RegionError> {
        match self {
            Self::Areas(areas) => {
                let sampled = areas.sampled(surface, watcher)?;
                let outside = || areas.outside(surface);
                let found = region(RegionKind::Polygons, surface, sampled, outside)?;
                Ok(Region {
                    outline: areas.outline(),
                    ..found
                })
            }
            Self::Solid(solid, hull) => {
                let found = inside_solid(&solid, surface, watcher)?;
                Ok(Region {
                    outline: Outline::Hull(hull),
                    ..found
                })
            }
            Self::Box(corners) => boxed(RegionKind::Box, corners, surface, watcher),
            Self::Auto => {
                let densest = densest::densest(surface, pixels);
                let corners = densest.unwrap_or_else(|| bounds(surface, |_| true));
                boxed(RegionKind::Auto, corners, surface, watcher)
            }
        }
    }
}

fn inside_solid(
    solid: &Solid,
    surface: &Surface,
    watcher: &dyn Watcher,
) -> Result<Region, RegionError> {
    let sampled = in_parts(surface, watcher, |t, looked_at| {
        solid_sample(surface, t, |p| solid.contains(p, looked_at))
    })?;
    let corners = [solid.low, solid.high].map(|p| [p.x, p.y, p.z]).concat();
    let outside = || RegionError::outside_box(&corners, &bounds(surface, |_| true));
    region(RegionKind::Mesh, surface, sampled, outside)
}

fn boxed(
    kind: RegionKind,
    corners: [f64; 6],
    surface: &Surface,
    watcher: &dyn Watcher,
) -> Result<Region, RegionError> {
    let inside = |p: &Point3<f64>| {
        (0..3).all(|axis| corners[axis] <= p[axis] && p[axis] <= corners[axis + 3])
    };
    let sampled = in_parts(surface, watcher, |t, _| solid_sample(surface, t, inside))?;
    let outside = || RegionError::outside_box(&corners, &bounds(surface, |_| true));
    let found = region(kind, surface, sampled, outside)?;
    Ok(Region {
        bounds: corners,
        outline: Outline::Hull(box_corners(&corners)),
        ..found
    })
}

/// The eight corners of a box.
fn box_corners(corners: &[f64; 6]) -> Vec<Point3<f64>> {
    let corner = |i: usize| Point3::from([0, 1, 2].map(|axis| corners[axis + 3 * (i >> axis & 1)]));
    (0..8).map(corner).collect()
}

/// Builds a region from the samples of its triangles, with the bounds of those inside and an empty
/// outline.
fn region(
    kind: RegionKind,
    surface: &Surface,
    sampled: Vec<TriangleSamples>,
    outside: impl FnOnce() -> RegionError,
) -> Result<Region, RegionError> {
    if sampled.iter().all(|sample| sample.factor == 0.0) {
        let is_weightless = sampled.iter().any(|sample| sample.is_touched);
        return Err(if is_weightless {
            RegionError::Weightless
        } else {
            outside()
        });
    }
    let has_gsd = sampled.iter().any(|sample| sample.gsd.is_finite());
    Ok(Region {
        kind,
        bounds: bounds(surface, |t| sampled[t].factor > 0.0),
        gsd: if has_gsd {
            sampled.iter().map(|sample| sample.gsd).collect()
        } else {
            Vec::new()
        },
        covered: sampled.iter().map(|sample| sample.covered).collect(),
        factors: sampled.into_iter().map(|sample| sample.factor).collect(),
        outline: Outline::Hull(Vec::new()),
    })
}

/// Samples all triangles, in their order; `sample` adds what it looks at of the region to its
/// second argument.
fn in_parts(
    surface: &Surface,
    watcher: &dyn Watcher,
    sample: impl Fn(u32, &mut u64) -> TriangleSamples + Sync,
) -> Result<Vec<TriangleSamples>, RegionError> {
    let triangles = surface.triangles.len();
    let most = LOOKED_AT[0] + LOOKED_AT[1] * triangles as u64;
    let in_all = AtomicU64::new(0);
    let one = |t: u32| {
        // The sum doesn't depend on the order, so neither does whether it becomes too large.
        if in_all.load(Ordering::Relaxed) > most {
            return TriangleSamples::default();
        }
        let mut looked_at = 0;
        let sampled = sample(t, &mut looked_at);
        in_all.fetch_add(looked_at, Ordering::Relaxed);
        sampled
    };
    let mut all = Vec::with_capacity(triangles);
    for start in (0..triangles).step_by(AT_ONCE) {
        watcher.check()?;
        let end = triangles.min(start + AT_ONCE);
        all.par_extend((start as u32..end as u32).into_par_iter().map(one));
        if in_all.load(Ordering::Relaxed) > most {
            return Err(RegionError::TooIntricate);
        }
    }
    Ok(all)
}

fn solid_sample(
    surface: &Surface,
    triangle: u32,
    mut inside: impl FnMut(&Point3<f64>) -> bool,
) -> TriangleSamples {
    let [a, b, c] = surface.corners(triangle);
    let at = |[u, v]: [f64; 2]| a + (b - a) * u + (c - a) * v;
    sampled(|place| inside(&at(place)).then_some(RegionProperties::INSIDE))
}

/// Samples a triangle at the centroids of the 16 triangles of a regular subdivision; `at` gets the
/// barycentric coordinates of the second and third corner.
fn sampled(at: impl FnMut([f64; 2]) -> Option<RegionProperties>) -> TriangleSamples {
    let (mut sum, mut gsd, mut is_touched, mut covered) = (0.0, f64::INFINITY, false, 0u8);
    for wish in sample_places().filter_map(at) {
        // Also by areas of weight 0, which tells a region without weight from one beside the
        // surface.
        is_touched = true;
        covered += u8::from(wish.weight > 0.0);
        sum += wish.weight;
        gsd = wish.gsd.map_or(gsd, |wanted| gsd.min(wanted));
    }
    let samples = f64::from(CUTS * CUTS);
    TriangleSamples {
        is_touched,
        covered: (f64::from(covered) / samples) as f32,
        factor: (sum / samples) as f32,
        gsd: gsd as f32,
    }
}

/// Parts of each side in the subdivision.
const CUTS: u32 = 4;

/// Returns the centroids of the upright triangles of the subdivision, then of those upside down.
fn sample_places() -> impl Iterator<Item = [f64; 2]> {
    let place = |i: u32, thirds: f64| (f64::from(i) + thirds / 3.0) / f64::from(CUTS);
    let upright =
        (0..CUTS).flat_map(move |i| (0..CUTS - i).map(move |j| [place(i, 1.0), place(j, 1.0)]));
    let inverted = (0..CUTS - 1)
        .flat_map(move |i| (0..CUTS - 1 - i).map(move |j| [place(i, 2.0), place(j, 2.0)]));
    upright.chain(inverted)
}

/// Returns the low and high corner of the triangles that count.
fn bounds(surface: &Surface, counts: impl Fn(usize) -> bool) -> [f64; 6] {
    let mut bounds = [
        f64::INFINITY,
        f64::INFINITY,
        f64::INFINITY,
        f64::NEG_INFINITY,
        f64::NEG_INFINITY,
        f64::NEG_INFINITY,
    ];
    let inside = surface
        .triangles
        .iter()
        .enumerate()
        .filter(|(t, _)| counts(*t));
    for vertex in inside
        .flat_map(|(_, corners)| corners)
        .map(|&v| surface.vertices[v as usize])
    {
        for axis in 0..3 {
            bounds[axis] = bounds[axis].min(vertex[axis]);
            bounds[axis + 3] = bounds[axis + 3].max(vertex[axis]);
        }
    }
    bounds
}

/// Sorts two opposite corners into the low and the high one.
fn ordered(corners: [f64; 6]) -> [f64; 6] {
    std::array::from_fn(|i| {
        if i < 3 {
            corners[i].min(corners[i + 3])
        } else {
            corners[i].max(corners[i - 3])
        }
    })
}
