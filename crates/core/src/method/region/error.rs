//! Errors of regions.

use super::{columns::Rectangle, solid::OpenMesh};
use crate::{
    base::{
        error::{Advice, Hint},
        progress::Cancelled,
    },
    model::georeference::SET_PLACE,
};

/// A region that cannot be used, whatever the surface.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ShapeError {
    #[error(transparent)]
    Open(#[from] OpenMesh),
    #[error("it is in WGS 84, but the model has no georeference")]
    NoGeoreference,
    #[error("{x} {y} is not a longitude and a latitude")]
    NotDegrees { x: f64, y: f64 },
    #[error("its axes are not unit vectors")]
    Axes,
}

impl Hint for ShapeError {
    fn hint(&self) -> Option<Advice> {
        let hint = match self {
            Self::Open(_) => "close its holes, or give a box x0,y0,z0,x1,y1,z1",
            Self::NoGeoreference => {
                return Some(
                    format!("{SET_PLACE}, or draw the polygon in model units with \"crs\": null")
                        .into(),
                );
            }
            Self::NotDegrees { .. } => {
                "export it in WGS 84 (EPSG:4326), longitude first; for model units add \"crs\": null to the file"
            }
            Self::Axes => "copy crs and axes from viewrank/views_local.json",
        };
        Some(hint.into())
    }
}

/// The region cannot be used on this surface.
#[derive(Debug, thiserror::Error)]
pub enum RegionError {
    #[error("no part of the surface is inside the region: it covers {}, the surface {}", on_map(region, *is_geodetic), on_map(model, *is_geodetic))]
    OutsideMap {
        region: Rectangle,
        model: Rectangle,
        is_geodetic: bool,
    },
    #[error(
        "no part of the surface is inside the region: it covers {}, the surface {}",
        in_space(region),
        in_space(model)
    )]
    OutsideBox { region: [f64; 6], model: [f64; 6] },
    #[error("the areas of the region that hold parts of the surface all have the weight 0")]
    Weightless,
    #[error(
        "the region has too many edges across the surface: finding what is inside would take minutes"
    )]
    TooIntricate,
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
}

/// Distance from the surface, over its size, up to which a region is probably where it was meant.
const NEAR: f64 = 10.0;

impl RegionError {
    /// Returns whether the region is where the surface is, but between the samples of its
    /// triangles.
    fn is_too_small(&self) -> bool {
        match self {
            Self::OutsideMap { region, model, .. } => (0..2).all(|axis| {
                model.low[axis] <= region.low[axis] && region.high[axis] <= model.high[axis]
            }),
            Self::OutsideBox { region, model } => (0..3)
                .all(|axis| model[axis] <= region[axis] && region[axis + 3] <= model[axis + 3]),
            _ => false,
        }
    }

    /// Returns whether the region is probably where it was meant, on ground without surface.
    pub fn is_of_bare_ground(&self) -> bool {
        self.is_near() && !self.is_in_degrees()
    }

    /// Returns whether the region is beside the surface, at most [`NEAR`] times its size away, or
    /// in a gap of it.
    fn is_near(&self) -> bool {
        match self {
            Self::OutsideMap { region, model, .. } => {
                are_near([region.low, region.high], [model.low, model.high])
            }
            Self::OutsideBox { region, model } => {
                let corners = |of: &[f64; 6]| [[of[0], of[1], of[2]], [of[3], of[4], of[5]]];
                are_near(corners(region), corners(model))
            }
            _ => false,
        }
    }

    /// Returns whether a polygon or box that was taken for one in units of the model is probably in
    /// degrees.
    pub(super) fn is_in_degrees(&self) -> bool {
        match self {
            Self::OutsideMap {
                region: Rectangle { low, high },
                is_geodetic: false,
                ..
            } => are_degrees(*low, *high),
            Self::OutsideBox { region, model } => {
                // A model without scale may be small itself.
                let is_tiny = (0..2).all(|axis| {
                    let size = |of: &[f64; 6]| of[axis + 3] - of[axis];
                    size(region) < TINY * size(model)
                });
                let [west, south, _, east, north, _] = *region;
                are_degrees([west, south], [east, north]) && (is_tiny || !self.is_near())
            }
            _ => false,
        }
    }

    pub(super) fn outside_box(region: &[f64], model: &[f64; 6]) -> Self {
        Self::OutsideBox {
            region: std::array::from_fn(|i| region[i]),
            model: *model,
        }
    }
}

/// Side of a box over that of the model, below which it may be one in degrees beside a model in
/// metres.
const TINY: f64 = 0.01;

/// Returns whether the corners of a rectangle may be longitudes and latitudes: a site is far
/// smaller than a degree, and far from the origin.
fn are_degrees(low: [f64; 2], high: [f64; 2]) -> bool {
    let most = [180.0, 90.0];
    let on_earth = |axis: usize| {
        high[axis] - low[axis] < 0.5 && low[axis] >= -most[axis] && high[axis] <= most[axis]
    };
    (0..2).all(on_earth) && (0..2).any(|axis| low[axis].abs() > 1.0)
}

/// Returns whether a region is at most [`NEAR`] times the size of the surface away from it along
/// each axis. Both: low and high corner.
fn are_near<const N: usize>(region: [[f64; N]; 2], model: [[f64; N]; 2]) -> bool {
    let sizes = (0..N).map(|axis| model[1][axis] - model[0][axis]);
    let most = NEAR * sizes.fold(0.0, f64::max);
    let gap =
        |axis: usize| (region[0][axis] - model[1][axis]).max(model[0][axis] - region[1][axis]);
    (0..N).all(|axis| gap(axis) <= most)
}

fn on_map(Rectangle { low, high }: &Rectangle, is_geodetic: bool) -> String {
    let [first, second] = if is_geodetic {
        ["longitude", "latitude"]
    } else {
        ["x", "y"]
    };
    format!(
        "{first} {:.6} to {:.6}, {second} {:.6} to {:.6}",
        low[0], high[0], low[1], high[1]
    )
}

fn in_space(corners: &[f64; 6]) -> String {
    let axis =
        |(i, name): (usize, &str)| format!("{name} {:.6} to {:.6}", corners[i], corners[i + 3]);
    ["x", "y", "z"]
        .into_iter()
        .enumerate()
        .map(axis)
        .collect::<Vec<_>>()
        .join(", ")
}

impl Hint for RegionError {
    fn hint(&self) -> Option<Advice> {
        let hint = match self {
            Self::OutsideBox { .. } if self.is_in_degrees() => {
                "its numbers look like longitude and latitude, but a box is in the frame and the units of the model: give the corners as a polygon in GeoJSON"
            }
            _ if self.is_in_degrees() => {
                return Some(
                    format!("its numbers look like longitude and latitude, but the place of the model on earth is not known: {SET_PLACE}").into(),
                );
            }
            _ if self.is_too_small() => {
                return Some(
                    Advice::text("draw it where the surface is and larger than its triangles (viewrank/surface.ply), or ask for a finer ")
                        .set("target.gsd"),
                );
            }
            Self::OutsideMap { .. } if self.is_near() => {
                return Some(
                    Advice::text("no surface means no depth maps: take images of it, which ")
                        .run("plan")
                        .and(" plans, too, or draw it on over a part of the surface"),
                );
            }
            Self::OutsideMap {
                is_geodetic: true, ..
            } => {
                "check that the polygon has longitude before latitude, and frame.origin or frame.utm"
            }
            Self::OutsideMap { .. } => {
                "draw the polygon over viewrank/views_local.json; for one in WGS 84 the model needs a place on earth (frame.utm or frame.origin in viewrank.toml)"
            }
            Self::OutsideBox { .. } => "give it in the frame and the units of the model",
            Self::Weightless => "give the areas that count a weight above 0",
            Self::TooIntricate => {
                "simplify its outline to the detail of the surface: ogr2ogr -simplify"
            }
            Self::Cancelled(error) => return error.hint(),
        };
        Some(hint.into())
    }
}
