//! Plans further images that fill the holes: poses, chosen greedily by the objective of the plan
//! from candidates around each hole.
//!
//! There are no pictures of planned images yet: success is predicted from geometry alone.

mod bare;
mod candidates;
mod choice;
mod files;
mod missed;
mod outlines;

use nalgebra::{Point3, Vector3};

use super::holes::Hole;
use crate::{
    base::progress::Watcher,
    method::{target::GSD_MARGIN, visibility::VisibilityError},
    model::georeference::MapFrame,
    plan::Plan,
};

pub use bare::{BareGround, MOST, bare_ground};
pub use files::files;
pub use missed::{missed, missed_areas, unbuilt_ground};

/// An image to take.
#[derive(Clone, Debug, PartialEq)]
pub struct Waypoint {
    /// Order in which it was chosen, from 1: if only some can be flown, the first ones fill most.
    pub rank: usize,
    /// World coordinates.
    pub centre: Point3<f64>,
    /// Viewing direction, a unit vector in world coordinates.
    pub direction: Vector3<f64>,
    /// Hole that it was planned for, an index into the listed holes.
    pub hole: usize,
    /// Height above the place that it looks at, scene units.
    pub height: f64,
    /// Distance from the place that it looks at, scene units.
    pub distance: f64,
    /// Largest share of what it sees, by area, that one other image sees too, planned or taken; 0
    /// to 1.
    pub overlap: f64,
}

/// The images to take, in the order to fly them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Flight {
    pub waypoints: Vec<Waypoint>,
    /// Part of the weight of each listed hole that fusion is expected to keep with them, 0 to 1.
    pub of_holes: Vec<f64>,
    /// About how many more would be needed beyond the most that are planned.
    pub more: usize,
}

/// Plans the images for the holes.
pub fn flight(
    plan: &Plan,
    holes: &[Hole],
    watcher: &dyn Watcher,
) -> Result<Flight, VisibilityError> {
    let frame = MapFrame::new(&plan.stages.scene, plan.stages.settings.surface.up);
    let poses = candidates::around(plan, holes, &frame);
    if poses.is_empty() {
        return Ok(Flight::default());
    }
    let mut flight = choice::choose(plan, holes, &poses, &frame, watcher)?;
    flight.waypoints = in_flying_order(flight.waypoints);
    Ok(flight)
}

impl Flight {
    /// Adds the images of bare ground, which becomes the first of the listed holes.
    pub fn with_ground_first(mut self, bare: &BareGround) -> Self {
        let before = self.waypoints.len();
        self.waypoints.iter_mut().for_each(|own| own.hole += 1);
        self.waypoints
            .extend(bare.waypoints.iter().map(|waypoint| Waypoint {
                rank: before + waypoint.rank,
                ..waypoint.clone()
            }));
        self.of_holes.insert(0, bare.covered);
        self.more = bare.more;
        self
    }

    /// Returns a warning if more images are needed than are planned.
    pub fn unplanned(&self) -> Option<String> {
        (self.more > 0).then(|| {
            format!(
                "only the {MOST} images nearest to the photographs are planned for bare ground; all of it would take about {} more: use a coarser --gsd, or plan the region in parts",
                two_digits(self.more)
            )
        })
    }

    /// Returns notes on the planned images: their margin, and how many more are needed.
    pub fn remarks(&self) -> String {
        let margin = format!(
            "Each image is planned at {} of the distance that gives the wanted resolution: what is lower or slanted comes out coarser.",
            1.0 / GSD_MARGIN
        );
        match self.unplanned() {
            Some(unplanned) => format!("{margin} Also, {unplanned}."),
            None => margin,
        }
    }
}

/// Rounds up to two significant digits.
fn two_digits(number: usize) -> usize {
    let unit = 10_usize.pow(number.max(1).ilog10().saturating_sub(1));
    number.div_ceil(unit) * unit
}

/// Returns the waypoints ordered so that each is followed by the nearest one left.
fn in_flying_order(mut left: Vec<Waypoint>) -> Vec<Waypoint> {
    let mut ordered: Vec<Waypoint> = Vec::with_capacity(left.len());
    while !left.is_empty() {
        let from = ordered.last().map(|last| last.centre);
        let distance =
            |waypoint: &Waypoint| from.map_or(0.0, |from| (waypoint.centre - from).norm());
        let next = (0..left.len())
            .min_by(|&a, &b| distance(&left[a]).total_cmp(&distance(&left[b])))
            .unwrap_or(0);
        ordered.push(left.remove(next));
    }
    ordered
}
