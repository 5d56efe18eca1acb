//! Ranks the clusters, cuts the ranking, and says what follows from both.

use super::{Cut, Finished, Forecast, PlanError, Stages, Timings, ViewStatus, cut, forecast, reasons, warnings};
use crate::{
    base::progress::{Stage, Watcher},
    method::{
        fulfilment::Model,
        ranking::{self, Ranking},
    },
    model::reason::Reason,
};

/// Which clusters are computed, in which order, and what that will cost and leave undone.
#[derive(Clone, Debug)]
pub struct Decision {
    pub ranking: Ranking,
    /// What is done already; nothing in a fresh plan.
    pub finished: Finished,
    pub cut: Cut,
    pub forecast: Forecast,
    /// Status and reason of each view.
    pub views: Vec<(ViewStatus, Option<Reason>)>,
    /// Reason of each triangle that no cluster fulfils to a tenth.
    pub triangle_reasons: Vec<Option<Reason>>,
    pub warnings: Vec<String>,
}

/// Ranks the clusters by their fulfilment behind the finished ones, which come first in the given order, and cuts the ranking as the settings say.
///
/// `finished.clusters` is overwritten by the number of those in `order`.
pub fn decide(
    stages: &Stages,
    finished: Finished,
    order: &[u32],
    timings: &mut Timings,
    watcher: &dyn Watcher,
) -> Result<Decision, PlanError> {
    let finished = Finished { clusters: order.len(), ..finished };
    let ranking =
        timings.time(Stage::Ranking, || ranking::rank_after(order, &stages.fulfilment, &stages.objective, watcher))?;
    let bound = |length| ranking::most_of_any(length, &stages.fulfilment, &stages.objective, &ranking.order);
    let cut = cut::cut(&stages.settings.cut, &cost(stages, &stages.model(), &ranking, &finished), bound)?;
    let decision = decide_as(stages, finished, ranking, cut)?;
    watcher.check()?;
    Ok(decision)
}

/// What follows from a ranking and a cut that are decided.
pub fn decide_as(stages: &Stages, finished: Finished, ranking: Ranking, cut: Cut) -> Result<Decision, PlanError> {
    let model = stages.model();
    let forecast = forecast::forecast(&cost(stages, &model, &ranking, &finished), cut.clusters);
    let why = reasons::Why {
        model: &model,
        candidates: &stages.candidates,
        clusters: &stages.clusters,
        fulfilment: &stages.fulfilment,
    };
    let views = why.views(&ranking.order[..cut.clusters], &stages.settings.partners)?;
    let triangle_reasons = why.triangles();
    let warnings = warnings::warnings(stages, &ranking, &finished);
    Ok(Decision { ranking, finished, cut, forecast, views, triangle_reasons, warnings })
}

pub(super) fn cost<'a>(
    stages: &'a Stages,
    model: &'a Model<'a>,
    ranking: &'a Ranking,
    finished: &Finished,
) -> forecast::Cost<'a> {
    let settings = &stages.settings.forecast;
    forecast::Cost { model, clusters: &stages.clusters, ranking, finished: finished.clusters, settings }
}
