//! Selection of the matching partners of each key view ([method 4]).
//!
//! [`CandidateSearch`] finds the n views with the most shared sparse points that the backend can
//! match; [`choose`] selects k of them for each key view, as in the paper (`sampled`) or by a
//! search that continues from there (`search`). Both look for the set of partners with the largest
//! sum
//!
//! ```text
//! Σ_t f(t, v)          v: the key view with k of its n candidates
//! ```
//!
//! over the triangles t that the key view sees; `sampled` judges by a sample of them, `search` by
//! all in the end. f, 0 to 1, is [fulfilment](super::fulfilment).
//!
//! ```
//! use viewrank_core::base::{column::Storage, progress::NoWatcher};
//! use viewrank_core::method::partners::{self, Limits, PartnerMethod, PartnerSettings};
//! use viewrank_core::method::{confidence::Unary, synthetic::Town, target::TargetSettings};
//! use viewrank_core::model::cluster::Gate;
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let town = Town { edge: 4.0, points: 300, ..Town::default() }
//!     .seen(&TargetSettings::default(), 0.05, Storage::Memory);
//! let unary = Unary::certain();
//! let model = town.model(&unary);
//! let (mut settings, points) = (PartnerSettings::default(), town.scene.view_points());
//! let limits = Limits::gate(&Gate::OPEN);
//! let candidates = partners::candidates(&town.scene, &points, &settings, &limits, &NoWatcher)?;
//!
//! let mut sums = Vec::new();
//! for method in [PartnerMethod::Sampled, PartnerMethod::Search] {
//!     settings.method = method;
//!     let (clusters, table) = partners::choose(&model, &candidates, &settings, 0, &NoWatcher)?;
//!     assert!(clusters.iter().all(|cluster| cluster.partners.len() <= settings.k as usize));
//!     sums.push(table.values.iter().sum::<f32>());
//! }
//! assert!(sums[0] < sums[1]);
//! # Ok(())
//! # }
//! ```
//!
//! [method 4]: https://github.com/viewrank/viewrank/blob/main/docs/method.md#4-partners

mod candidates;
mod gate;
mod pair;
mod sampled;
mod search;
mod settings;

use self::search::PartnerChoice;
pub use self::{
    candidates::{CandidateSearch, Candidates, Limits, Refusals, Refuses, candidates, neighbours},
    gate::PairLimit,
    pair::PairGeometry,
    settings::{GateSettings, PartnerMethod, PartnerSettings},
};
use crate::{
    base::{
        column::{self, TableError},
        progress::{Stage, StepCounter, Watcher},
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
    // Once for all: partners chosen again for the gain gave no reliable gain (benchmarks, "The
    // paper's experiments").
    let choosing = Choosing::new(model, candidates, settings, seed);
    let keys = choosing.keys();
    let steps = StepCounter::start(watcher, Stage::Partners, keys.len());
    let mut clusters = Vec::with_capacity(keys.len());
    // The search has f of the chosen set at hand, which would be costly to compute again.
    let mut table = FulfilmentTableBuilder::like(model.visibility)?;
    column::in_order(
        &keys,
        BATCH,
        || BlockSlots::new(model),
        |slots, &key| steps.run(|| choosing.choose(key, slots)),
        |_, chosen| {
            model.release();
            for (cluster, values) in chosen {
                table.push(model.visibility.triangles_seen_by(cluster.key), &values)?;
                clusters.push(cluster);
            }
            Ok(())
        },
    )?;
    Ok((clusters, table.finish()?))
}

/// What partners are chosen by.
struct Choosing<'a> {
    model: &'a Model<'a>,
    candidates: &'a Candidates,
    settings: &'a PartnerSettings,
    seed: u64,
    /// True for the triangles that choices are judged by.
    judges: Vec<bool>,
}

impl<'a> Choosing<'a> {
    fn new(
        model: &'a Model<'a>,
        candidates: &'a Candidates,
        settings: &'a PartnerSettings,
        seed: u64,
    ) -> Self {
        let triangles = model.surface.triangles.len();
        let judges = sampled::judging_triangles(triangles, settings.triangle_fraction, seed);
        Self {
            model,
            candidates,
            settings,
            seed,
            judges,
        }
    }

    /// Returns whether the view's picture is not rejected.
    fn is_sound(&self, view: &ViewIndex) -> bool {
        let rejected = &self.model.agreement.rejected;
        rejected.binary_search(view).is_err()
    }

    fn candidates_of(&self, key: ViewIndex) -> impl Iterator<Item = ViewIndex> {
        let all = self.candidates.candidates_of(key).iter().copied();
        all.filter(|view| self.is_sound(view))
    }

    /// Returns the views that can be key views.
    fn keys(&self) -> Vec<ViewIndex> {
        let is_key =
            |view: &ViewIndex| self.is_sound(view) && self.candidates_of(*view).next().is_some();
        self.model.scene.view_indices().filter(is_key).collect()
    }

    /// Returns the cluster of a key view, its partners best first, and f of its triangles.
    fn choose(&self, key: ViewIndex, slots: &mut BlockSlots) -> (ViewCluster, Vec<f32>) {
        let candidates: Vec<ViewIndex> = self.candidates_of(key).collect();
        let is_judge = |t: u32| self.judges[t as usize];
        let mut block = Block::new(self.model, key, &candidates, is_judge, slots);
        let choice = self.best_set(&mut block, key, candidates.len());
        let ordered = search::best_first(&mut block, choice.partners);
        let partners = ordered.into_iter().map(|p| candidates[p]).collect();
        (ViewCluster { key, partners }, choice.values)
    }

    /// Returns the set of partners among the `n` candidates of a key view.
    fn best_set(&self, block: &mut Block, key: ViewIndex, n: usize) -> PartnerChoice {
        let settings = self.settings;
        let (k, draws) = (n.min(settings.k as usize), settings.draws as usize);
        let drawn = sampled::combinations(self.model.scene, key, n, k, draws, self.seed);
        let start = sampled::best(block, &drawn);
        match settings.method {
            PartnerMethod::Sampled => PartnerChoice::new(block, start),
            PartnerMethod::Search => search::search(block, start, n),
        }
    }
}

#[cfg(test)]
mod tests;
