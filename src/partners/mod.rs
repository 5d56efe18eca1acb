//! Method 4: which matching partners each key view gets.
//!
//! [`candidates`] are the views with the most shared sparse points that the backend can match; [`choose`] picks k of them for each
//! key view: the best of drawn combinations (`sampled.rs`), improved by exchanges (`search.rs`), judged on a part of the key view's
//! triangles (`block.rs`).

mod block;
mod candidates;
mod sampled;
mod search;

use rayon::prelude::*;

pub use candidates::{Candidates, PairGeometry, Refusal, candidates};

use crate::{
    config::{PartnerCount, PartnerMethod, PartnerSettings},
    fulfilment::{self, FulfilmentRow, FulfilmentTable, Model},
    partners::block::Block,
    progress::{Cancelled, Stage, Watcher},
    scene::ViewIndex,
};

/// A key view with its matching partners, best first.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ViewCluster {
    pub key: ViewIndex,
    pub partners: Vec<ViewIndex>,
}

/// With fewer judging triangles than this chance decides; then all visible triangles judge.
const FEWEST_JUDGES: usize = 50;

/// A view cluster for each view that has candidates, in the order of views, and its fulfilment.
pub fn choose(
    model: &Model,
    candidates: &Candidates,
    settings: &PartnerSettings,
    seed: u64,
    watcher: &dyn Watcher,
) -> Result<(Vec<ViewCluster>, FulfilmentTable), Cancelled> {
    let keys: Vec<ViewIndex> = model.scene.view_indices().filter(|&v| !candidates.of(v).is_empty()).collect();
    let done = std::sync::atomic::AtomicU64::new(0);
    let total = keys.len() as u64;
    watcher.progress(Stage::Partners, 0, total);
    let choose_one = |&key: &ViewIndex| {
        watcher.check()?;
        let chosen = choose_for(model, key, candidates.of(key), settings, seed);
        let done = done.fetch_add(1, std::sync::atomic::Ordering::Relaxed) + 1;
        watcher.progress(Stage::Partners, done, total);
        Ok(chosen)
    };
    let chosen = keys.par_iter().map(choose_one).collect::<Result<Vec<_>, Cancelled>>()?;
    let (clusters, rows) = chosen.into_iter().unzip();
    Ok((clusters, FulfilmentTable::from_rows(rows)))
}

/// The partners of one key view, and its fulfilment with them.
fn choose_for(
    model: &Model,
    key: ViewIndex,
    candidates: &[ViewIndex],
    settings: &PartnerSettings,
    seed: u64,
) -> (ViewCluster, FulfilmentRow) {
    let k = match settings.k {
        PartnerCount::Fixed(k) => k,
        PartnerCount::Auto(_) => settings.k_max,
    };
    let k = (k as usize).min(candidates.len());
    let block = Block::gather(model, key, candidates, &judging(model, key, settings.triangle_fraction, seed));
    let drawn = sampled::combinations(candidates.len(), k, settings.draws as usize, seed, model.scene.name(key));
    let Some(sampled) = sampled::best(&block, &drawn) else {
        return (ViewCluster { key, partners: Vec::new() }, FulfilmentRow::default());
    };
    let cluster = |members| {
        let members = search::best_first(&block, members);
        let partners: Vec<_> = members.into_iter().map(|m| candidates[usize::from(m)]).collect();
        let row = fulfilment::row(model, key, &partners);
        (ViewCluster { key, partners }, row)
    };
    if settings.method == PartnerMethod::Sampled {
        return cluster(sampled.0);
    }
    let mut found = search::search(&block, k, sampled.clone());
    found.sort_unstable();
    let searched = cluster(found.clone());
    if found == sampled.0 {
        return searched;
    }
    // The judges are a part of the triangles; all of them have the last word.
    let sampled = cluster(sampled.0);
    if sampled.1.sum() > searched.1.sum() { sampled } else { searched }
}

/// Positions, among the key view's visible triangles, of those in T_z: a fixed pseudo-random 1/z of all triangles.
fn judging(model: &Model, key: ViewIndex, z: u32, seed: u64) -> Vec<u32> {
    let visible = model.visibility.of(key);
    let judges = |t: u32| mix(seed ^ u64::from(t)).is_multiple_of(u64::from(z.max(1)));
    let chosen: Vec<u32> = (0..visible.len() as u32).filter(|&i| judges(visible[i as usize])).collect();
    if chosen.len() >= FEWEST_JUDGES { chosen } else { (0..visible.len() as u32).collect() }
}

/// SplitMix64's finaliser: spreads consecutive numbers over all of u64.
fn mix(mut x: u64) -> u64 {
    x = x.wrapping_add(0x9e37_79b9_7f4a_7c15);
    x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ (x >> 31)
}
