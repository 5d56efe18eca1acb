//! Ranks the clusters of a plan, with what only a plan knows: its settings, the ranking of an
//! earlier one, and its timings.

use super::{PlanError, Stages, Timings};
use crate::{
    base::progress::{Stage, Watcher},
    decision::{self, Cut, Decision, FinishedClusters, Options, UncutRanking},
};

/// Returns what the decision reads of the settings.
pub(super) fn options(stages: &Stages) -> Options<'_> {
    let settings = &stages.settings;
    Options {
        cut: &settings.cut,
        forecast: &settings.forecast,
        k: settings.partners.k,
        has_half: settings.ranking.has_half(),
        makes_maps: stages.makes_maps,
    }
}

/// Ranks the clusters by their fulfilment and cuts the ranking as set. The finished clusters come
/// first.
pub fn decide(
    stages: &Stages,
    finished: &FinishedClusters,
    timings: &mut Timings,
    watcher: &dyn Watcher,
) -> Result<Decision, PlanError> {
    let known = stages.known_ranking.as_ref();
    let decision = timings.time(Stage::Ranking, || {
        let options = options(stages);
        decision::decide(&stages.tables, &options, known, finished, watcher)
    })?;
    watcher.check()?;
    Ok(decision)
}

/// Derives forecast and reasons of views from a given ranking and cut. `finished`: number of
/// clusters at its start that are finished.
pub fn decide_as(
    stages: &Stages,
    finished: usize,
    ranked: UncutRanking,
    cut: Cut,
) -> Result<Decision, PlanError> {
    let options = options(stages);
    let decision = decision::decide_as(&stages.tables, &options, finished, ranked, cut)?;
    Ok(decision)
}
