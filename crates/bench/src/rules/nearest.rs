//! The simplest rules: the closest camera centres, the most shared points, chance.

use super::{Neighbourhood, smallest};
use viewrank::evaluate::orders::shuffle;
use viewrank_core::model::scene::ViewIndex;

/// Views from which `random` draws: the n of the paper.
const RANDOM_AMONG: usize = 22;

/// `mindist`: the k closest camera centres of the whole model, ties by name.
pub(super) fn closest(hood: &Neighbourhood, k: usize) -> Vec<ViewIndex> {
    let own = hood.centre(hood.key);
    let others = hood.scene.view_indices().filter(|&v| v != hood.key);
    smallest(
        k,
        others.map(|v| ((hood.centre(v) - own).norm_squared(), v)),
    )
}

/// `maxcon`: the k views with the most shared sparse points, ties by name.
pub(super) fn most_connected(hood: &Neighbourhood, k: usize) -> Vec<ViewIndex> {
    hood.best(k, |_, points| Some(points.len() as f64))
}

/// Returns k of the most connected views, drawn at random; the seed is the key view's index.
pub(super) fn random(hood: &Neighbourhood, k: usize) -> Vec<ViewIndex> {
    let mut views = most_connected(hood, RANDOM_AMONG);
    shuffle(&mut views, u64::from(hood.key.0));
    views.truncate(k);
    views
}
