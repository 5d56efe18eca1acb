//! Bailer, Finckh, Lensch, *Scale Robust Multi View Stereo* (ECCV 2012), view selection.
//!
//! Goesele's greedy choice with a milder angle weight, `min(angle / a_max, 1)^1.5` with a_max = 35
//! degrees towards the key view and 14 degrees among the partners, and a coverage weight, so that
//! points already covered by chosen views count less and the partners cover the whole image: a
//! point seen by n of the chosen views counts 1 / (1 + n). The paper was not at hand when this was
//! written: the form of the weights is from memory, and the coverage weight is the simplest that
//! has this effect.

use super::Neighbourhood;
use crate::model::scene::{PointIndex, ViewIndex};

/// Angles from which a pair counts in full, degrees: with the key view, and among partners.
const FULL_ANGLE_KEY: f64 = 35.0;
const FULL_ANGLE_PARTNERS: f64 = 14.0;
const ANGLE_POWER: f64 = 1.5;

pub(super) fn choose(hood: &Neighbourhood, k: usize) -> Vec<ViewIndex> {
    hood.greedy(k, |view, points, taken| {
        points.iter().map(|&p| weight(hood, view, p, taken)).sum()
    })
}

fn weight(hood: &Neighbourhood, view: ViewIndex, point: PointIndex, taken: &[ViewIndex]) -> f64 {
    let angle = |other, full: f64| {
        (hood.angle(point, other, view).to_degrees() / full)
            .min(1.0)
            .powf(ANGLE_POWER)
    };
    let seeing = taken
        .iter()
        .filter(|v| hood.points.observed_by(**v).binary_search(&point).is_ok());
    let among: f64 = seeing
        .clone()
        .map(|&v| angle(v, FULL_ANGLE_PARTNERS))
        .product();
    let coverage = 1.0 / (1.0 + seeing.count() as f64);
    let ratio = hood.footprint(point, hood.key) / hood.footprint(point, view);
    let scale = ratio.min(ratio.recip()).max(0.0);
    angle(hood.key, FULL_ANGLE_KEY) * among * coverage * scale
}
