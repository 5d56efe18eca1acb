//! Ranks images for a program that uses them themselves (method 5.10).

use super::Tables;
use crate::{
    base::progress::{Cancelled, Watcher},
    method::{
        confidence::Sharpness,
        ranking::{Ranking, Redrawing, RedrawnOrder},
    },
    model::{cluster::MapScale, scene::ViewIndex},
};

/// Ranks the key views by how well the photographs of all of them can be drawn again: that is what
/// the ranking gains, fulfils and keeps.
pub fn rank(tables: &Tables, watcher: &dyn Watcher) -> Result<Ranking, Cancelled> {
    let shown = (&tables.scene, &tables.surface, &tables.visibility);
    let factors = tables.region.as_ref().map(|region| &region.factors[..]);
    let sharpness = Sharpness::new(&tables.scene, &tables.agreement.detail);
    let keys: Vec<ViewIndex> = tables.clusters.iter().map(|cluster| cluster.key).collect();
    let redrawing = Redrawing::new(shown, &keys, factors, &sharpness, watcher)?;
    let RedrawnOrder { views, drawn } = redrawing.rank(watcher)?;
    // Only key views are photographs there.
    let cluster = |view: &ViewIndex| keys.partition_point(|key| key < view) as u32;
    let before = std::iter::once(0.0).chain(drawn.iter().copied());
    let gains = drawn
        .iter()
        .zip(before)
        .map(|(after, before)| after - before);
    Ok(Ranking {
        gains: gains.collect(),
        scales: vec![MapScale::Full; views.len()],
        reachable: drawn.last().copied().unwrap_or_default(),
        fulfilment: drawn.clone(),
        kept: drawn,
        order: views.iter().map(cluster).collect(),
    })
}
