//! The subject: the part of the surface that the shares are about, without far shards.

use nalgebra::Point3;

use crate::{
    base::progress::NoWatcher,
    method::region::{Region, RegionShape},
    model::georeference::MapFrame,
    plan::Plan,
};

/// Weight left out at each end of each axis.
const TAIL: f64 = 0.01;
/// Margin on each side, as a share of the box's side.
const ROOM: f64 = 0.03;

/// A box in the map frame that holds all but the outermost of the weight (method 5.1) inside the
/// region; without one, inside the region that `auto` would be (method 5.7).
#[derive(Clone, Debug)]
pub struct Subject<'a> {
    frame: &'a MapFrame,
    pub low: [f64; 3],
    pub high: [f64; 3],
}

impl<'a> Subject<'a> {
    /// Returns the box; `None` if nothing has weight.
    pub fn new(plan: &Plan, frame: &'a MapFrame) -> Option<Self> {
        let dense = densest(plan);
        let counts = |t: u32| dense.as_ref().is_none_or(|region| region.is_inside(t));
        let weights = plan.stages.objective.weights.iter();
        let places: Vec<([f64; 3], f64)> = (0u32..)
            .zip(weights)
            .filter(|(t, weight)| **weight > 0.0 && counts(*t))
            .map(|(t, &weight)| (frame.local(&plan.stages.surface.centroid(t)), weight))
            .collect();
        if places.is_empty() {
            return None;
        }
        let ranges = [0, 1, 2].map(|axis| {
            range(
                places
                    .iter()
                    .map(|(place, weight)| (place[axis], *weight))
                    .collect(),
            )
        });
        Some(Self {
            frame,
            low: ranges.map(|r| r[0]),
            high: ranges.map(|r| r[1]),
        })
    }

    /// Returns whether a world point is in the box.
    pub fn contains(&self, point: &Point3<f64>) -> bool {
        let local = self.frame.local(point);
        (0..3).all(|axis| (self.low[axis]..=self.high[axis]).contains(&local[axis]))
    }
}

/// The region of `auto`; `None` with a region of the plan's own, whose weights are 0 outside, or if
/// there is none.
fn densest(plan: &Plan) -> Option<Region> {
    let stages = &plan.stages;
    if stages.region.is_some() {
        return None;
    }
    RegionShape::Auto
        .lay_over(&stages.surface, &stages.shown.pixels, &NoWatcher)
        .ok()
}

/// Returns the range of values that holds all weight except the tails, with a margin.
fn range(mut values: Vec<(f64, f64)>) -> [f64; 2] {
    values.sort_by(|a, b| a.0.total_cmp(&b.0));
    let all: f64 = values.iter().map(|(_, weight)| weight).sum();
    let at = |part: f64| {
        let mut sum = 0.0;
        let found = values.iter().find(|(_, weight)| {
            sum += weight;
            sum >= part * all
        });
        found.or(values.last()).map_or(0.0, |(value, _)| *value)
    };
    let [low, high] = [at(TAIL), at(1.0 - TAIL)];
    let room = ROOM * (high - low);
    [low - room, high + room]
}

#[cfg(test)]
mod tests {
    use super::range;

    #[test]
    fn a_far_shard_does_not_widen_the_range() {
        let mut values: Vec<(f64, f64)> = (0..=1000).map(|i| (f64::from(i) / 10.0, 1.0)).collect();
        values.push((1e6, 5.0));
        let [low, high] = range(values);
        assert!(
            (-3.0..2.0).contains(&low) && (98.0..104.0).contains(&high),
            "{low} {high}"
        );
    }
}
