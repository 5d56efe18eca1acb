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

/// Ranks the key views by how well all photographs can be drawn again from them: that is what the
/// ranking keeps. f_o is that of the depth maps which nobody computes.
pub fn rank(tables: &Tables, watcher: &dyn Watcher) -> Result<Ranking, Cancelled> {
    let shown = (&tables.scene, &tables.surface, &tables.visibility);
    let factors = tables.region.as_ref().map(|region| &region.factors[..]);
    let sharpness = Sharpness::new(&tables.scene, &tables.agreement.detail);
    let keys: Vec<ViewIndex> = tables.clusters.iter().map(|cluster| cluster.key).collect();
    let redrawing = Redrawing::new(shown, factors, &sharpness, &tables.without_image);
    let RedrawnOrder { views, drawn } = redrawing.rank(&keys, watcher)?;
    let cluster = |view| keys.binary_search(view).ok();
    let order: Vec<u32> = views.iter().filter_map(cluster).map(|c| c as u32).collect();

    let maps = tables.maps();
    let mut reached = Reached::new(&tables.objective);
    let fulfilment = order.iter().map(|&cluster| {
        reached.take(maps.row_at(cluster, MapScale::Full));
        reached.fulfilment()
    });
    let fulfilment: Vec<f64> = fulfilment.collect();
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
