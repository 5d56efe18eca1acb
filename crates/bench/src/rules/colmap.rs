//! COLMAP's `__auto__, k` (`PatchMatchController::ReadProblems`, 3.8 to 4.x): the views with the
//! most shared points whose 75th percentile of triangulation angles is at least 1 degree.

use super::Neighbourhood;
use viewrank_core::model::scene::{PointIndex, ViewIndex};

/// `PatchMatchStereo.min_triangulation_angle`, degrees.
const MIN_ANGLE: f64 = 1.0;
const PERCENTILE: f64 = 75.0;

pub(super) fn choose(hood: &Neighbourhood, k: usize) -> Vec<ViewIndex> {
    hood.best(k, |view, points| {
        let angles = angles(hood, view, points);
        (percentile(&angles) >= MIN_ANGLE).then_some(angles.len() as f64)
    })
}

/// Returns the triangulation angles, degrees, ascending, one for each pair of observations of a
/// shared point; COLMAP counts as many shared points. Angles above 90 degrees are folded
/// (`CalculateTriangulationAngle`).
fn angles(hood: &Neighbourhood, view: ViewIndex, points: &[PointIndex]) -> Vec<f64> {
    let of_point = |&p: &PointIndex| {
        let angle = hood.angle(p, hood.key, view).to_degrees();
        std::iter::repeat_n(
            angle.min(180.0 - angle),
            hood.observations(p, hood.key) * hood.observations(p, view),
        )
    };
    let mut angles: Vec<f64> = points.iter().flat_map(of_point).collect();
    angles.sort_by(f64::total_cmp);
    angles
}

/// Returns the percentile, interpolated between its two neighbours (COLMAP 3.8 takes the nearer
/// one).
fn percentile(angles: &[f64]) -> f64 {
    // Never empty: only views that share points are asked.
    let rank = PERCENTILE / 100.0 * (angles.len() - 1) as f64;
    let (low, high) = (angles[rank.floor() as usize], angles[rank.ceil() as usize]);
    low + (high - low) * rank.fract()
}
