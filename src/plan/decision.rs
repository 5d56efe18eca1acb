//! Ranks the clusters, cuts the ranking, and derives forecast, reasons and warnings.

use std::sync::atomic::{AtomicU64, Ordering};

use rayon::prelude::*;

use super::{
    Band, Cut, FinishedMaps, Forecast, GivenUp, PlanError, Stages, Timings, UncutRanking,
    ViewStatus, cut, forecast, reasons::Reasons, warnings,
};
use crate::{
    base::progress::{Stage, Watcher},
    method::{
        fulfilment::Model,
        ranking::{self, Ranker, Ranking},
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
    /// Area that fusion is expected to keep of the clusters up to each rank, over that of all
    /// clusters, 0 to 1.
    pub area_shares: Vec<f64>,
    pub forecast: Forecast,
    /// Status and reason of each view.
    pub views: Vec<(ViewStatus, Option<Reason>)>,
    /// By triangle, the reason why no cluster fulfils it to 0.1; `None` if one does.
    pub triangle_reasons: Vec<Option<Reason>>,
    /// By triangle, true at the border of the surveyed site (method 5.3).
    pub border: Vec<bool>,
    /// Pixels that the depth map of each of the first clusters is expected to measure at full size;
    /// those up to the cut are among them, unless `forecast.points_per_map` is set.
    pub pixels: Vec<f64>,
    pub warnings: Vec<String>,
}

/// Ranks the clusters by their fulfilment and cuts the ranking as set. The finished clusters come
/// first, as listed in `order`.
///
/// `finished.clusters` is replaced by the length of `order`.
pub fn decide(
    stages: &Stages,
    finished: FinishedMaps,
    order: &[(u32, MapScale)],
    timings: &mut Timings,
    watcher: &dyn Watcher,
) -> Result<Decision, PlanError> {
    timings.time(Stage::Ranking, || {
        rank_and_cut(stages, finished, order, watcher)
    })
}

fn rank_and_cut(
    stages: &Stages,
    finished: FinishedMaps,
    order: &[(u32, MapScale)],
    watcher: &dyn Watcher,
) -> Result<Decision, PlanError> {
    let finished = FinishedMaps {
        clusters: order.len(),
        ..finished
    };
    let ranked = match &stages.known_ranking {
        Some(known) if order.is_empty() => known.clone(),
        _ => UncutRanking::new(stages, rank(stages, &finished, order, watcher)?),
    };
    let ranking = &ranked.ranking;
    let cut = cut::cut(
        &stages.settings.cut,
        &cost(stages, &stages.model(), ranking, &ranked.pixels, &finished),
    )?;
    // Band and what is given up take the clusters in their order, on one thread each.
    let (fulfilment_bound, (reachable_band, given_up)) = rayon::join(
        || ranking::most_of_any(cut.clusters, &stages.maps(), &stages.objective, ranking),
        || {
            rayon::join(
                || Band::of_reachable(stages, ranking),
                || GivenUp::new(stages, &ranked, cut.clusters),
            )
        },
    );
    let cut = Cut {
        fulfilment_bound,
        share_band: Band::of_share(stages, cut.share, cut.reachable, &reachable_band),
        reachable_band,
        pairs_beyond_gate: pairs_beyond_gate(stages, &ranking.order[..cut.clusters]),
        given_up,
        ..cut
    };
    let decision = decide_as(stages, finished, ranked, cut)?;
    watcher.check()?;
    Ok(decision)
}

/// Ranks the clusters; if there is a choice of sizes, at several prices of work, and returns the
/// ranking that is best at its cut.
fn rank(
    stages: &Stages,
    finished: &FinishedMaps,
    order: &[(u32, MapScale)],
    watcher: &dyn Watcher,
) -> Result<Ranking, PlanError> {
    let maps = stages.maps();
    let ranker = Ranker::new(&maps, &stages.objective)?;
    if !stages.settings.ranking.has_half() {
        return Ok(ranker.rank(order, 0.0, watcher)?);
    }
    let prices = ranker.prices();
    let ranked = AtomicU64::new(0);
    watcher.progress(Stage::Ranking, 0, prices.len() as u64);
    let one = |&price: &f64| {
        let ranking = ranker.rank(order, price, &Unseen(watcher))?;
        let merit = merit(stages, &ranking, finished)?;
        watcher.progress(
            Stage::Ranking,
            ranked.fetch_add(1, Ordering::Relaxed) + 1,
            prices.len() as u64,
        );
        Ok((merit, ranking))
    };
    let rankings: Vec<([f64; 3], Ranking)> = prices
        .par_iter()
        .map(one)
        .collect::<Result<_, PlanError>>()?;
    watcher.progress(Stage::Ranking, prices.len() as u64, prices.len() as u64);
    // The first of equals has the lower price.
    let better = |best: ([f64; 3], Ranking), next: ([f64; 3], Ranking)| {
        if next.0 > best.0 { next } else { best }
    };
    Ok(rankings
        .into_iter()
        .reduce(better)
        .map(|(_, ranking)| ranking)
        .unwrap_or_default())
}

/// Returns what makes a plan better than others, in this order: what fusion keeps, up to the
/// target; f_o, unless the target is reached; little work.
fn merit(
    stages: &Stages,
    ranking: &Ranking,
    finished: &FinishedMaps,
) -> Result<[f64; 3], PlanError> {
    let (model, settings) = (stages.model(), &stages.settings.cut);
    let cost = cost(stages, &model, ranking, &[], finished);
    let cut = cut::cut(settings, &cost)?;
    let work: f64 = (0..cut.clusters).map(|rank| cost.work(rank)).sum();
    let most = settings
        .target
        .map_or(0.0, |target| target.0 * ranking.reachable);
    // Where the target is reached, more is of no use.
    let is_enough = settings.target.is_some_and(|target| target.0 < 1.0) && cut.kept >= most;
    let fulfilment = if is_enough { 0.0 } else { cut.fulfilment };
    Ok([cut.kept.min(most), fulfilment, -work])
}

/// Passes on cancellation, but not the progress of one of several rankings.
struct Unseen<'a>(&'a dyn Watcher);

impl Watcher for Unseen<'_> {
    fn progress(&self, _: Stage, _: u64, _: u64) {}

    fn cancelled(&self) -> bool {
        self.0.cancelled()
    }

    fn most_memory(&self) -> Option<u64> {
        self.0.most_memory()
    }
}

/// Derives forecast, reasons of views, and warnings from a given ranking and cut.
pub fn decide_as(
    stages: &Stages,
    finished: FinishedMaps,
    ranked: UncutRanking,
    cut: Cut,
) -> Result<Decision, PlanError> {
    let model = stages.model();
    let UncutRanking {
        ranking,
        area_shares,
        triangle_reasons,
        border,
        mut pixels,
    } = ranked;
    if stages.settings.forecast.points_per_map.is_none() {
        let more = forecast::full_size_pixels(
            &cost(stages, &model, &ranking, &pixels, &finished),
            pixels.len()..cut.clusters,
        );
        pixels.extend(more);
    }
    let forecast = forecast::forecast(
        &cost(stages, &model, &ranking, &pixels, &finished),
        cut.clusters,
    );
    let reasons = Reasons::of(stages, &model);
    let views = reasons.views(&ranking.order[..cut.clusters], &stages.settings.partners)?;
    let warnings = warnings::warnings(stages, &ranking, &cut, &finished);
    Ok(Decision {
        ranking,
        finished,
        cut,
        area_shares,
        forecast,
        views,
        triangle_reasons,
        border,
        pixels,
        warnings,
    })
}

fn pairs_beyond_gate(stages: &Stages, chosen: &[u32]) -> usize {
    let beyond = |&cluster: &u32| {
        let ViewCluster { key, partners } = &stages.clusters[cluster as usize];
        let beyond = stages.candidates.beyond_gate(*key);
        partners
            .iter()
            .filter(|partner| beyond.contains(partner))
            .count()
    };
    chosen.iter().map(beyond).sum()
}

pub(super) fn cost<'a>(
    stages: &'a Stages,
    model: &'a Model<'a>,
    ranking: &'a Ranking,
    pixels: &'a [f64],
    finished: &FinishedMaps,
) -> forecast::Cost<'a> {
    let settings = &stages.settings.forecast;
    forecast::Cost {
        model,
        stages,
        ranking,
        pixels,
        finished: finished.clusters,
        settings,
    }
}
