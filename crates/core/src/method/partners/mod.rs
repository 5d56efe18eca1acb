//! Selection of the matching partners of each key view (method 4).
//!
//! [`CandidateSearch`] finds the views with the most shared sparse points that the backend can
//! match; [`choose`] selects k of them for each key view, as in the paper ([`sampled`]) or by a
//! search that continues from there ([`search`]).

mod candidates;
mod gate;
mod pair;
mod sampled;
mod search;
mod settings;

use std::sync::atomic::{AtomicU64, Ordering};

use self::search::PartnerChoice;
pub use self::{
    candidates::{CandidateSearch, Candidates, Limits, Refusal, Refuses, candidates, neighbours},
    gate::PairLimit,
    pair::PairGeometry,
    settings::{GateSettings, PartnerMethod, PartnerSettings},
};
use crate::{
    base::{
        column::{self, TableError},
        progress::{Stage, Watcher},
    },
    method::fulfilment::{
        BATCH, FulfilmentTable, FulfilmentTableBuilder, Model,
        block::{Block, BlockSlots},
    },
    model::{cluster::ViewCluster, scene::ViewIndex},
};

/// Selects a view cluster for each view that has candidates, in the order of views, and computes
/// its fulfilment.
///
/// A view with at most k candidates gets all of them. Views with a rejected picture are neither key
/// views nor partners.
pub fn choose(
    model: &Model,
    candidates: &Candidates,
    settings: &PartnerSettings,
    seed: u64,
    watcher: &dyn Watcher,
) -> Result<(Vec<ViewCluster>, FulfilmentTable), TableError> {
    let judges = sampled::judging_triangles(
        model.surface.triangles.len(),
        settings.triangle_fraction,
        seed,
    );
    let is_sound = |view: &ViewIndex| model.agreement.rejected.binary_search(view).is_err();
    let candidates_of = |key: ViewIndex| -> Vec<ViewIndex> {
        candidates
            .candidates_of(key)
            .iter()
            .copied()
            .filter(is_sound)
            .collect()
    };
    let has_candidates =
        |key: &ViewIndex| is_sound(key) && candidates.candidates_of(*key).iter().any(is_sound);
    let keys: Vec<ViewIndex> = model.scene.view_indices().filter(has_candidates).collect();
    let (done, total) = (AtomicU64::new(0), keys.len() as u64);
    watcher.progress(Stage::Partners, 0, total);
    let choose_one = |slots: &mut BlockSlots, &key: &ViewIndex| {
        watcher.check()?;
        let is_judge = |t: u32| judges[t as usize];
        let candidates = candidates_of(key);
        let mut block = Block::new(model, key, &candidates, is_judge, slots);
        let choice = choose_for(&mut block, model, key, &candidates, settings, seed);
        watcher.progress(
            Stage::Partners,
            1 + done.fetch_add(1, Ordering::Relaxed),
            total,
        );
        Ok(choice)
    };
    let (mut clusters, mut table) = (
        Vec::with_capacity(keys.len()),
        FulfilmentTableBuilder::like(model.visibility)?,
    );
    column::in_order(
        &keys,
        BATCH,
        || BlockSlots::new(model),
        choose_one,
        |batch, chosen| {
            model.release();
            for (&key, (partners, values)) in batch.iter().zip(chosen) {
                table.push(model.visibility.triangles_seen_by(key), &values)?;
                clusters.push(ViewCluster { key, partners });
            }
            Ok(())
        },
    )?;
    Ok((clusters, table.finish()?))
}

/// Partners of one key view, best first, and f of its triangles.
fn choose_for(
    block: &mut Block,
    model: &Model,
    key: ViewIndex,
    candidates: &[ViewIndex],
    settings: &PartnerSettings,
    seed: u64,
) -> (Vec<ViewIndex>, Vec<f32>) {
    let n = candidates.len();
    let k = n.min(settings.k as usize);
    let drawn = sampled::combinations(model.scene, key, n, k, settings.draws as usize, seed);
    let start = sampled::best(block, &drawn);
    let choice = match settings.method {
        PartnerMethod::Sampled => PartnerChoice::new(block, start),
        PartnerMethod::Search => search::search(block, start, n),
    };
    let ordered = search::best_first(block, choice.partners);
    (
        ordered.into_iter().map(|p| candidates[p]).collect(),
        choice.values,
    )
}

#[cfg(test)]
mod tests;
