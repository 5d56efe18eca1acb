//! MVSNet's `colmap2mvsnet.py` (Yao et al. 2018): the sum over shared points of a Gaussian of the
//! triangulation angle around 5 degrees, of standard deviation 1 degree below and 10 above. A point
//! that the first of the two views observes twice counts twice.

use super::Neighbourhood;
use viewrank_core::model::scene::ViewIndex;

pub(super) fn choose(hood: &Neighbourhood, k: usize) -> Vec<ViewIndex> {
    let weight = |degrees: f64| {
        let sigma = if degrees <= 5.0 { 1.0 } else { 10.0 };
        (-(degrees - 5.0f64).powi(2) / (2.0 * sigma * sigma)).exp()
    };
    hood.best(k, |view, points| {
        let first = view.min(hood.key);
        let score = |&p| {
            hood.observations(p, first) as f64 * weight(hood.angle(p, hood.key, view).to_degrees())
        };
        Some(points.iter().map(score).sum())
    })
}
