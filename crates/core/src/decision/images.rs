//! Ranks images for a program that uses them themselves (method 5.10).

use super::Tables;
use crate::{
    base::progress::{Cancelled, Watcher},
    method::{
        confidence::Sharpness,
        ranking::{Ranking, Reached, Redrawing, RedrawnOrder},
    },
    model::{cluster::MapScale, scene::ViewIndex},
};

/// Ranks the key views by how well the photographs of all of them can be drawn again: that is what
/// the ranking keeps. f_o is that of the depth maps, which nobody computes.
pub fn rank(tables: &Tables, watcher: &dyn Watcher) -> Result<Ranking, Cancelled> {
    let shown = (&tables.scene, &tables.surface, &tables.visibility);
    let factors = tables.region.as_ref().map(|region| &region.factors[..]);
    let sharpness = Sharpness::new(&tables.scene, &tables.agreement.detail);
    let keys: Vec<ViewIndex> = tables.clusters.iter().map(|cluster| cluster.key).collect();
    let redrawing = Redrawing::new(shown, &keys, factors, &sharpness, watcher)?;
    let RedrawnOrder { views, drawn } = redrawing.rank(watcher)?;
    // Only key views are photographs there.
    let cluster = |view: &ViewIndex| keys.partition_point(|key| key < view) as u32;
    let order: Vec<u32> = views.iter().map(cluster).collect();

    let maps = tables.maps();
    let mut reached = Reached::new(&tables.objective);
    let mut fulfilment = Vec::with_capacity(order.len());
    for &cluster in &order {
        watcher.check()?;
        reached.take(maps.row_at(cluster, MapScale::Full));
        fulfilment.push(reached.fulfilment());
    }
    maps.release();
    let before = std::iter::once(0.0).chain(fulfilment.iter().copied());
    let gains = fulfilment
        .iter()
        .zip(before)
        .map(|(after, before)| after - before);
    Ok(Ranking {
        gains: gains.collect(),
        scales: vec![MapScale::Full; order.len()],
        reachable: drawn.last().copied().unwrap_or_default(),
        kept: drawn,
        fulfilment,
        order,
    })
}
