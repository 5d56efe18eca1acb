//! Ranks images for a program that uses them themselves (method 5.10).

use super::Tables;
use crate::{
    base::progress::{Cancelled, Watcher},
    method::{
        confidence::Sharpness,
        ranking::{Ranking, Redrawing, RedrawnOrder, Site},
    },
    model::{cluster::MapScale, scene::ViewIndex},
};

/// Ranks the key views by how well the photographs of all of them can be drawn again: that is what
/// the ranking gains, fulfils and keeps.
pub fn rank(tables: &Tables, watcher: &dyn Watcher) -> Result<Ranking, Cancelled> {
    let site = Site {
        scene: &tables.scene,
        surface: &tables.surface,
        visibility: &tables.visibility,
        factors: tables.region.as_ref().map(|region| &region.factors[..]),
        sharpness: &Sharpness::new(&tables.scene, &tables.agreement.detail),
    };
    let keys: Vec<ViewIndex> = tables.clusters.iter().map(|cluster| cluster.key).collect();
    let redrawing = Redrawing::new(&site, &keys, watcher)?;
    Ok(of_order(redrawing.rank(watcher)?, &keys))
}

/// Returns an order of views as a ranking of the clusters with these key views.
fn of_order(RedrawnOrder { views, drawn }: RedrawnOrder, keys: &[ViewIndex]) -> Ranking {
    // Only key views are photographs there.
    let cluster = |view: &ViewIndex| keys.partition_point(|key| key < view) as u32;
    let before = std::iter::once(0.0).chain(drawn.iter().copied());
    let gains = drawn
        .iter()
        .zip(before)
        .map(|(after, before)| after - before);
    Ranking {
        gains: gains.collect(),
        scales: vec![MapScale::Full; views.len()],
        reachable: drawn.last().copied().unwrap_or_default(),
        fulfilment: drawn.clone(),
        kept: drawn,
        order: views.iter().map(cluster).collect(),
    }
}
