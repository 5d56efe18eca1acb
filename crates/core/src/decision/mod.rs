//! What is decided with the results of the stages (5.3 to 5.6 of [method 5]): the ranking, its cut,
//! the forecast of its cost, and a reason for everything left out.
//!
//! [`Tables`] holds the results; [`decide`] ranks the clusters and cuts the ranking at the shortest
//! of the limits that are set in [`CutSettings`]. By default that is a share of what all clusters
//! reach:
//!
//! ```text
//! cut.target   fewest clusters with   Σ_t w_t f_m(V) / Σ_t w_t f_m(all clusters) ≥ 0.9
//! cut.budget   a number of clusters, or a share of the registered views
//! cut.time     forecast seconds, cut.points forecast points of the depth maps
//! points       Σ_t f_conf · projected area of t (px² of the matched image), of a map
//! ```
//!
//! ```
//! use viewrank_core::{
//!     base::progress::NoWatcher,
//!     decision::DEFAULT_TARGET,
//!     method::{
//!         fulfilment::FulfilmentTable,
//!         ranking::{self, Objective},
//!     },
//! };
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! // f of four clusters on ten triangles: six, three and one of their own; the last adds nothing.
//! let row = |triangles: std::ops::Range<u32>| triangles.map(|t| (t, 1.0)).collect::<Vec<_>>();
//! let fulfilment = FulfilmentTable::new([row(9..10), row(0..6), row(6..9), row(1..5)]);
//! let objective = Objective::weighing(vec![1.0; 10], 1);
//! let ranking = ranking::rank(&fulfilment, &objective, &NoWatcher)?;
//! assert_eq!(ranking.order, [1, 2, 0]);
//!
//! let cut = ranking.length_for_share(DEFAULT_TARGET);
//! assert_eq!(ranking.order[..cut], [1, 2]);
//! assert!((ranking.share(cut) - 0.9).abs() < 1e-6);
//! # Ok(())
//! # }
//! ```
//!
//! [method 5]: https://github.com/viewrank/viewrank/blob/main/docs/method.md#5-ranking

mod band;
mod border;
mod counted;
mod curve;
mod cut;
mod forecast;
mod given_up;
mod images;
mod numbers;
mod reasons;
mod settings;
mod tables;
mod uncut;

use rayon::prelude::*;

pub use self::{
    band::Band,
    counted::{Counted, CountedPlaces, FinishedPart, PlacesRule, Predicted},
    curve::CurvePoint,
    cut::{Cut, CutLimit, DEFAULT_TARGET},
    forecast::Forecast,
    given_up::GivenUp,
    numbers::{Matcher, PlanningNumbers, ReachOfPair, ReachRule, WorkPerMap},
    reasons::{Substitute, ViewStatus},
    settings::{CutSettings, ForecastSettings},
    tables::Tables,
    uncut::UncutRanking,
};

use self::{forecast::Cost, reasons::Reasons};
use crate::{
    base::{
        column::{DiskError, TableError},
        error::{Advice, Hint},
        progress::{Cancelled, Stage, StepCounter, Watcher},
    },
    method::ranking::{self, Ranker, Ranking},
    model::{
        cluster::{MapScale, ViewCluster},
        reason::Reason,
    },
};

/// The ranking, its cut, the forecast cost, and the reasons for everything left out.
#[derive(Clone, Debug)]
pub struct Decision {
    pub ranking: Ranking,
    /// Number of clusters at the start of the ranking that have their depth map; their fulfilment
    /// is measured, not predicted (method 5.4).
    pub finished: usize,
    pub cut: Cut,
    /// Area that fusion is expected to keep of the clusters up to each rank, over that of all
    /// clusters, 0 to 1; all 0 for a program that makes no depth maps.
    pub area_shares: Vec<f64>,
    pub forecast: Forecast,
    /// Status and reason of each view.
    pub views: Vec<(ViewStatus, Option<Reason>)>,
    /// By triangle, the reason why no cluster fulfils it to 0.1; `None` if one does.
    pub triangle_reasons: Vec<Option<Reason>>,
    /// By triangle, true at the border of the surveyed site (method 5.3).
    pub border: Vec<bool>,
    /// Pixels that the depth map of each of the first clusters is expected to measure at full size;
    /// those up to the cut are among them, unless `forecast.points_per_map` is set; empty for a
    /// program that makes none.
    pub pixels: Vec<f64>,
}

/// What the decision needs to know besides the tables.
#[derive(Clone, Copy, Debug)]
pub struct Options<'a> {
    pub cut: &'a CutSettings,
    pub forecast: &'a ForecastSettings,
    /// Partners per key view.
    pub k: u32,
    /// True if depth maps may be planned at half the size.
    pub has_half: bool,
    /// False for a program that uses the images themselves (method 5.10).
    pub makes_maps: bool,
}

/// The finished clusters.
#[derive(Clone, Copy, Debug, Default)]
pub struct FinishedClusters<'a> {
    /// In their order, with the sizes of their maps.
    pub order: &'a [(u32, MapScale)],
    /// Share of what all clusters reach that they do, as measured; `None`: by the tables.
    pub share: Option<f64>,
}

/// A ranking cannot be cut as asked, or not be made.
#[derive(Debug, thiserror::Error)]
pub enum DecisionError {
    #[error("the time limit needs forecast.seconds_per_map or forecast.seconds_per_pair")]
    NoTimes,
    #[error(transparent)]
    Table(#[from] TableError),
}

impl From<DiskError> for DecisionError {
    fn from(error: DiskError) -> Self {
        Self::Table(error.into())
    }
}

impl From<Cancelled> for DecisionError {
    fn from(error: Cancelled) -> Self {
        Self::Table(error.into())
    }
}

impl Hint for DecisionError {
    fn hint(&self) -> Option<Advice> {
        match self {
            Self::NoTimes => Some(
                "time one depth map, and write its seconds into viewrank.toml: forecast.seconds_per_map = 30"
                    .into(),
            ),
            Self::Table(error) => error.hint(),
        }
    }

    fn is_usage(&self) -> bool {
        matches!(self, Self::NoTimes)
    }
}

/// Ranks the clusters by their fulfilment and cuts the ranking as set. The finished clusters come
/// first. `known`: the ranking without finished clusters, if it is known.
pub fn decide(
    tables: &Tables,
    options: &Options,
    known: Option<&UncutRanking>,
    finished: &FinishedClusters,
    watcher: &dyn Watcher,
) -> Result<Decision, DecisionError> {
    let FinishedClusters { order, share } = *finished;
    // Where there are no maps, none are finished.
    let order = if options.makes_maps { order } else { &[] };
    let finished = order.len();
    let ranked = match known {
        Some(known) if order.is_empty() => known.clone(),
        _ => {
            let mut ranking = rank(tables, options, order, watcher)?;
            if let Some(share) = share {
                ranking.correct(finished, share);
            }
            UncutRanking::new(tables, ranking, options.makes_maps)
        }
    };
    let cost = Cost::new(tables, options, &ranked.ranking, &ranked.pixels, finished);
    let cut = cut::cut(options.cut, &cost)?;
    let cut = assessed(tables, options, &ranked, cut);
    let decision = decide_as(tables, options, finished, ranked, cut)?;
    watcher.check()?;
    Ok(decision)
}

/// Adds to a cut the bound on other choices, its bands, and what it gives up.
fn assessed(tables: &Tables, options: &Options, ranked: &UncutRanking, cut: Cut) -> Cut {
    let ranking = &ranked.ranking;
    let (fulfilment_bound, (reachable_band, share_band, given_up)) = rayon::join(
        || most_of_any(tables, options, ranking, &cut),
        || bands(tables, options, ranked, &cut),
    );
    Cut {
        fulfilment_bound,
        share_band,
        reachable_band,
        pairs_beyond_gate: pairs_beyond_gate(tables, &ranking.order[..cut.clusters]),
        given_up,
        ..cut
    }
}

/// Returns an upper bound on the fulfilment of any choice of as many clusters as the cut.
fn most_of_any(tables: &Tables, options: &Options, ranking: &Ranking, cut: &Cut) -> f64 {
    if !options.makes_maps {
        // No choice of images draws more than all of them.
        return cut.reachable;
    }
    let counted = tables.counted();
    ranking::most_of_any(cut.clusters, &counted.maps, counted.objective, ranking)
}

/// Returns the bands of what all clusters give and of the share at the cut, and what the cut gives
/// up.
fn bands(
    tables: &Tables,
    options: &Options,
    ranked: &UncutRanking,
    cut: &Cut,
) -> (Band, Band, GivenUp) {
    if !options.makes_maps {
        // Nothing of it depends on matching.
        let [reachable, share] = [cut.reachable, cut.share].map(Band::exactly);
        return (reachable, share, GivenUp::default());
    }
    // Both take the clusters in their order, on one thread each.
    let (reachable, given_up) = rayon::join(
        || Band::of_reachable(tables, &ranked.ranking),
        || GivenUp::new(tables, ranked, cut.clusters),
    );
    let share = Band::of_share(tables, cut.share, cut.reachable, &reachable);
    (reachable, share, given_up)
}

/// Ranks the clusters, or the images of a program that makes no maps.
fn rank(
    tables: &Tables,
    options: &Options,
    order: &[(u32, MapScale)],
    watcher: &dyn Watcher,
) -> Result<Ranking, DecisionError> {
    if !options.makes_maps {
        return Ok(images::rank(tables, watcher)?);
    }
    if options.has_half {
        return rank_at_prices(tables, options, order, watcher);
    }
    let counted = tables.counted();
    let ranker = Ranker::new(&counted.maps, counted.objective)?;
    Ok(counted.rank(&ranker, order, 0.0, watcher)?)
}

/// Ranks maps of two sizes at several prices of work, and returns the ranking that is best at its
/// cut.
fn rank_at_prices(
    tables: &Tables,
    options: &Options,
    order: &[(u32, MapScale)],
    watcher: &dyn Watcher,
) -> Result<Ranking, DecisionError> {
    let counted = tables.counted();
    let ranker = Ranker::new(&counted.maps, counted.objective)?;
    let prices = ranker.prices();
    let steps = StepCounter::start(watcher, Stage::Ranking, prices.len());
    let at_price = |price: f64| {
        let ranking = counted.rank(&ranker, order, price, &Silent(watcher))?;
        Merited::new(tables, options, ranking, order.len())
    };
    let rankings = prices
        .par_iter()
        .map(|&price| steps.run(|| at_price(price))?);
    // Rayon keeps the order of the prices, which decides between equals.
    let best = rankings.try_reduce_with(|a, b| Ok(a.or_better(b)));
    let best = best.transpose()?;
    steps.end();
    Ok(best.map(|best| best.ranking).unwrap_or_default())
}

/// A ranking, with what makes its plan better than others.
struct Merited {
    /// In this order: what fusion keeps, up to the target; f_o, unless the target is reached;
    /// little work.
    merit: [f64; 3],
    ranking: Ranking,
}

impl Merited {
    fn new(
        tables: &Tables,
        options: &Options,
        ranking: Ranking,
        finished: usize,
    ) -> Result<Self, DecisionError> {
        let settings = options.cut;
        let cost = Cost::new(tables, options, &ranking, &[], finished);
        let cut = cut::cut(settings, &cost)?;
        let work: f64 = cost.works().take(cut.clusters).sum();
        let most = settings
            .target
            .map_or(0.0, |target| target.0 * ranking.reachable);
        // Where the target is reached, more is of no use.
        let is_enough = settings.target.is_some_and(|target| target.0 < 1.0) && cut.kept >= most;
        let fulfilment = if is_enough { 0.0 } else { cut.fulfilment };
        Ok(Self {
            merit: [cut.kept.min(most), fulfilment, -work],
            ranking,
        })
    }

    /// Returns the better of two, the first of equals.
    fn or_better(self, next: Self) -> Self {
        if next.merit > self.merit { next } else { self }
    }
}

/// Passes on cancellation, but not the progress of one of several rankings.
struct Silent<'a>(&'a dyn Watcher);

impl Watcher for Silent<'_> {
    fn progress(&self, _: Stage, _: u64, _: u64) {}

    fn cancelled(&self) -> bool {
        self.0.cancelled()
    }

    fn most_memory(&self) -> Option<u64> {
        self.0.most_memory()
    }
}

/// Derives forecast and reasons of views from a given ranking and cut.
pub fn decide_as(
    tables: &Tables,
    options: &Options,
    finished: usize,
    ranked: UncutRanking,
    cut: Cut,
) -> Result<Decision, DecisionError> {
    let model = tables.model();
    let UncutRanking {
        ranking,
        area_shares,
        triangle_reasons,
        border,
        mut pixels,
    } = ranked;
    if options.makes_maps && options.forecast.points_per_map.is_none() {
        let cost = Cost::new(tables, options, &ranking, &pixels, finished);
        let more = forecast::full_size_pixels(&cost, pixels.len()..cut.clusters);
        pixels.extend(more);
    }
    let cost = Cost::new(tables, options, &ranking, &pixels, finished);
    let forecast = forecast::forecast(&cost, cut.clusters);
    let reasons = Reasons::of(tables, &model);
    // A program that matches no pairs lacks none.
    let wanted_partners = if options.makes_maps { options.k } else { 0 };
    let views = reasons.views(&ranking.order[..cut.clusters], wanted_partners)?;
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
    })
}

fn pairs_beyond_gate(tables: &Tables, chosen: &[u32]) -> usize {
    let beyond = |&cluster: &u32| {
        let ViewCluster { key, partners } = &tables.clusters[cluster as usize];
        let beyond = tables.candidates.beyond_gate(*key);
        partners
            .iter()
            .filter(|partner| beyond.contains(partner))
            .count()
    };
    chosen.iter().map(beyond).sum()
}

impl Decision {
    /// Pixels that the depth map of each cluster will measure, before fusion, in the order of the
    /// ranking.
    pub fn points_by_rank(&self, tables: &Tables, options: &Options) -> Vec<f64> {
        let cost = self.cost(tables, options);
        forecast::points(&cost, self.ranking.order.len())
    }

    fn cost<'a>(&'a self, tables: &'a Tables, options: &'a Options<'a>) -> Cost<'a> {
        Cost::new(tables, options, &self.ranking, &self.pixels, self.finished)
    }

    /// For each cluster, the clusters ranked before it that give more of its own fulfilment than
    /// all before them, by rank: the last one within a cut is the best substitute there.
    pub fn best_substitutes(&self, tables: &Tables) -> Result<Vec<Vec<Substitute>>, DiskError> {
        let triangles = tables.surface.triangles.len();
        reasons::best_substitutes(&tables.fulfilment, &self.ranking.order, triangles)
    }
}
