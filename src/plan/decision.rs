//! Ranks the clusters, cuts the ranking, and derives forecast, reasons and warnings.

use super::{
    Band, Cut, FinishedMaps, Forecast, GivenUp, PlanError, Stages, Timings, ViewStatus, cut, forecast, reasons,
    warnings,
};
use crate::{
    base::progress::{Stage, Watcher},
    method::{
        fulfilment::Model,
        ranking::{self, Objective, Ranking},
    },
    model::{
        cluster::{MapScale, ViewCluster},
        reason::Reason,
    },
};

/// The ranking, its cut, the forecast cost, and the reasons for everything left out.
#[derive(Clone, Debug)]
pub struct Decision {
    pub ranking: Ranking,
    /// The finished part; empty in a fresh plan.
    pub finished: FinishedMaps,
    pub cut: Cut,
    /// Area that fusion is expected to keep of the clusters up to each rank, over that of all clusters, 0 to 1.
    pub area_shares: Vec<f64>,
    pub forecast: Forecast,
    /// Status and reason of each view.
    pub views: Vec<(ViewStatus, Option<Reason>)>,
    /// By triangle, the reason why no cluster fulfils it to 0.1; `None` if one does.
    pub triangle_reasons: Vec<Option<Reason>>,
    pub warnings: Vec<String>,
}

/// Ranks the clusters by their fulfilment and cuts the ranking as set. The finished clusters come first, as listed in `order`.
///
/// `finished.clusters` is replaced by the length of `order`.
pub fn decide(
    stages: &Stages,
    finished: FinishedMaps,
    order: &[(u32, MapScale)],
    timings: &mut Timings,
    watcher: &dyn Watcher,
) -> Result<Decision, PlanError> {
    timings.time(Stage::Ranking, || rank_and_cut(stages, finished, order, watcher))
}

fn rank_and_cut(
    stages: &Stages,
    finished: FinishedMaps,
    order: &[(u32, MapScale)],
    watcher: &dyn Watcher,
) -> Result<Decision, PlanError> {
    let finished = FinishedMaps { clusters: order.len(), ..finished };
    let ranking = match &stages.known_ranking {
        Some(known) if order.is_empty() => known.clone(),
        _ => rank(stages, &finished, order, watcher)?,
    };
    let cut = cut::cut(&stages.settings.cut, &cost(stages, &stages.model(), &ranking, &finished))?;
    // Band and what is given up take the clusters in their order, on one thread each.
    let (fulfilment_bound, (reachable_band, given_up)) = rayon::join(
        || ranking::most_of_any(cut.clusters, &stages.maps(), &stages.objective, &ranking),
        || rayon::join(|| Band::of_reachable(stages, &ranking), || GivenUp::new(stages, &ranking, cut.clusters)),
    );
    let cut = Cut {
        fulfilment_bound,
        share_band: Band::of_share(stages, cut.share, cut.reachable, &reachable_band),
        reachable_band,
        pairs_beyond_gate: pairs_beyond_gate(stages, &ranking.order[..cut.clusters]),
        given_up,
        ..cut
    };
    let decision = decide_as(stages, finished, ranking, cut)?;
    watcher.check()?;
    Ok(decision)
}

/// Ranks the clusters; if there is a choice of sizes, and the settings allow more work than a map of each view takes, some have full size instead.
fn rank(
    stages: &Stages,
    finished: &FinishedMaps,
    order: &[(u32, MapScale)],
    watcher: &dyn Watcher,
) -> Result<Ranking, PlanError> {
    let (maps, objective) = (stages.maps(), &stages.objective);
    let ranking = ranking::rank_after(order, &maps, objective, watcher)?;
    match cut::enlarge(&stages.settings.cut, &cost(stages, &stages.model(), &ranking, finished)) {
        Some(chosen) => Ok(ranking::rank_after(order, &maps.only(&chosen), objective, watcher)?),
        None => Ok(ranking),
    }
}

/// Derives forecast, reasons and warnings from a given ranking and cut.
pub fn decide_as(stages: &Stages, finished: FinishedMaps, ranking: Ranking, cut: Cut) -> Result<Decision, PlanError> {
    let model = stages.model();
    let all_reasons = reasons::Reasons {
        model: &model,
        viewers: &stages.shown.views,
        candidates: &stages.candidates,
        missing_images: &stages.missing_images,
        clusters: &stages.clusters,
        fulfilment: &stages.fulfilment,
        region: stages.region.as_ref(),
    };
    let by_area = Objective::by_area(&stages.surface, stages.region.as_ref(), stages.objective.support);
    // The one takes the clusters in their order, on one thread.
    let (area_shares, (forecast, views, triangle_reasons)) = rayon::join(
        || ranking::shares_by(&by_area, &ranking, &stages.maps()),
        || {
            let forecast = forecast::forecast(&cost(stages, &model, &ranking, &finished), cut.clusters);
            let views = all_reasons.views(&ranking.order[..cut.clusters], &stages.settings.partners);
            (forecast, views, all_reasons.triangles())
        },
    );
    let views = views?;
    let warnings = warnings::warnings(stages, &ranking, &cut, &finished);
    Ok(Decision { ranking, finished, cut, area_shares, forecast, views, triangle_reasons, warnings })
}

fn pairs_beyond_gate(stages: &Stages, chosen: &[u32]) -> usize {
    let beyond = |&cluster: &u32| {
        let ViewCluster { key, partners } = &stages.clusters[cluster as usize];
        let beyond = stages.candidates.beyond_gate(*key);
        partners.iter().filter(|partner| beyond.contains(partner)).count()
    };
    chosen.iter().map(beyond).sum()
}

pub(super) fn cost<'a>(
    stages: &'a Stages,
    model: &'a Model<'a>,
    ranking: &'a Ranking,
    finished: &FinishedMaps,
) -> forecast::Cost<'a> {
    let settings = &stages.settings.forecast;
    forecast::Cost { model, stages, ranking, finished: finished.clusters, settings }
}
