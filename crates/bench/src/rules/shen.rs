//! Shen, *Accurate Multiple View 3D Reconstruction Using Patch-Based Stereo for Large-Scale Scenes*
//! (IEEE TIP 2013), stereo pair selection.
//!
//! theta: mean angle at the shared points; d: distance of the centres. Views must satisfy 5 < theta
//! < 60 degrees and 0.05 d_m < d < 2 d_m, where d_m is the median of d over the views within the
//! limits of theta; of these, the k with the smallest theta d are chosen.

use super::{Neighbourhood, smallest};
use viewrank_core::model::scene::{PointIndex, ViewIndex};

pub(super) fn choose(hood: &Neighbourhood, k: usize) -> Vec<ViewIndex> {
    let angled = hood
        .others
        .iter()
        .map(|(view, points)| (*view, mean_angle(hood, *view, points)));
    let angled: Vec<(ViewIndex, f64)> = angled
        .filter(|(_, theta)| *theta > 5.0 && *theta < 60.0)
        .collect();
    let distance = |view| (hood.centre(view) - hood.centre(hood.key)).norm();
    let mut distances: Vec<f64> = angled.iter().map(|(view, _)| distance(*view)).collect();
    distances.sort_by(f64::total_cmp);
    let Some(&median) = distances.get(distances.len() / 2) else {
        return Vec::new();
    };
    let eligible = angled
        .into_iter()
        .map(|(view, theta)| (view, theta, distance(view)));
    let eligible = eligible.filter(|(_, _, d)| *d > 0.05 * median && *d < 2.0 * median);
    smallest(k, eligible.map(|(view, theta, d)| (theta * d, view)))
}

/// Returns the mean angle at the shared points, degrees.
fn mean_angle(hood: &Neighbourhood, view: ViewIndex, points: &[PointIndex]) -> f64 {
    let sum: f64 = points
        .iter()
        .map(|&p| hood.angle(p, hood.key, view).to_degrees())
        .sum();
    sum / points.len() as f64
}
