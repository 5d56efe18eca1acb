//! Goesele, Snavely, Curless, Hoppe, Seitz, *Multi-View Stereo for Community Photo Collections*
//! (ICCV 2007), section 4.1; the footprint is that of MVE's `GlobalViewSelection`, which multiplies
//! the angle weights of all views taken, also of those that do not see the point; the paper's
//! product, and this one, is over those that see it.
//!
//! Greedy. A view gains, for every shared point, `w_scale x product of w_angle with the key view
//! and with every view taken before that sees the point`; `w_angle = (angle / 10 deg)^2` below 10
//! degrees, else 1; `w_scale` by r, the key view's footprint over the other's: 2/r above 2, 1 from
//! 1 to 2, r below 1.

use super::Neighbourhood;
use viewrank_core::model::scene::{PointIndex, ViewIndex};

/// Parallax from which a pair counts in full, degrees.
const FULL_ANGLE: f64 = 10.0;

pub(super) fn choose(hood: &Neighbourhood, k: usize) -> Vec<ViewIndex> {
    hood.greedy(k, |view, points, taken| {
        points.iter().map(|&p| weight(hood, view, p, taken)).sum()
    })
}

fn weight(hood: &Neighbourhood, view: ViewIndex, point: PointIndex, taken: &[ViewIndex]) -> f64 {
    let seen_by = |v: &&ViewIndex| hood.points.observed_by(**v).binary_search(&point).is_ok();
    let angle = |&other: &ViewIndex| {
        (hood.angle(point, other, view).to_degrees() / FULL_ANGLE)
            .min(1.0)
            .powi(2)
    };
    let angles: f64 = taken
        .iter()
        .filter(seen_by)
        .chain([&hood.key])
        .map(angle)
        .product();
    angles * scale(hood.footprint(point, hood.key) / hood.footprint(point, view))
}

/// `ratio`: the key view's pixel over the other's; above 1 the other one is finer.
pub(super) fn scale(ratio: f64) -> f64 {
    if ratio > 2.0 {
        2.0 / ratio
    } else {
        ratio.clamp(0.0, 1.0)
    }
}
