//! Ranking ([method 5]): the order in which the view clusters are computed.
//!
//! Greedy: the next cluster is the one that adds most to the [`Objective`]. The objective is
//! monotone, but submodular only if a single map is enough: a map gains worth when another one can
//! confirm it. Gains are therefore kept up to date instead of evaluated lazily.
//!
//! ```text
//! f_o(V) = Σ_t w_t g_t(V),   Σ_t w_t = 1
//! g_t    = f_1                                                    m = 1
//! g_t    = (f_m + e · mean(f_1 … f_{m−1})) / (1 + e)              m > 1,   e = 0.5
//! share  = Σ_t w_t f_m(V) / Σ_t w_t f_m(all clusters)
//! ```
//!
//! f_1 ≥ f_2 ≥ … are the f of the clusters V at triangle t, m the number of maps that must agree
//! there; f and w_t are 0 to 1. With a [pilot](super::pilot), t is a place. [`Redrawing`] ranks the
//! images of programs that match no pairs (5.10).
//!
//! ```
//! use viewrank_core::{
//!     base::progress::NoWatcher,
//!     method::{
//!         fulfilment::FulfilmentTable,
//!         ranking::{self, Objective},
//!     },
//! };
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! // f of three clusters on four triangles: (triangle, f), triangles ascending.
//! let fulfilment = FulfilmentTable::new([
//!     vec![(0, 0.9), (1, 0.8)],
//!     vec![(1, 0.7), (2, 0.9), (3, 0.9)],
//!     vec![(0, 0.5)],
//! ]);
//! let objective = Objective::weighing(vec![1.0; 4], 1);
//! let ranking = ranking::rank(&fulfilment, &objective, &NoWatcher)?;
//! assert_eq!(ranking.order, [1, 0]);
//! assert!((ranking.fulfilment[0] - 2.5 / 4.0).abs() < 1e-6);
//! # Ok(())
//! # }
//! ```
//!
//! [method 5]: https://github.com/viewrank/viewrank/blob/main/docs/method.md#5-ranking

mod belief;
mod bound;
mod maps;
mod objective;
mod reached;
mod redrawing;
mod settings;

use std::{
    cmp::Reverse,
    sync::atomic::{AtomicI64, Ordering},
};

use rayon::prelude::*;

use self::reached::FixedPoint;
pub use self::reached::Reached;
pub use self::{
    belief::{Attempt, Beliefs},
    bound::most_of_any,
    maps::Maps,
    objective::{Objective, SINGLE_MAP_CREDIT},
    redrawing::{Redrawing, RedrawnOrder, Site},
    settings::{RankingSettings, TriangleWeight},
};
use crate::{
    base::{
        column::{self, DiskError, TableError},
        progress::{Cancelled, Stage, Watcher},
    },
    method::fulfilment::{ByTriangle, FulfilmentTable, Rows},
    model::cluster::MapScale,
};

/// Prices of work at which maps of two sizes are ranked, besides 0: enough that plans of any length
/// have one that fits them (method 5.8).
pub const PRICES: u32 = 30;
const PRICES_PER_OCTAVE: f64 = 3.0;
/// Raised triangles that a thread takes at a time: about a tenth of a millisecond of work.
const TRIANGLES_AT_ONCE: usize = if cfg!(test) { 2 } else { 256 };

/// A ranking of view clusters.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Ranking {
    /// Cluster indices (into the plan's clusters), best first; only finished ones and those with a
    /// gain above 0.
    pub order: Vec<u32>,
    /// Size at which each cluster is matched.
    pub scales: Vec<MapScale>,
    /// Gain of f_o of each cluster over those before it.
    pub gains: Vec<f64>,
    /// f_o of the first i + 1 clusters.
    pub fulfilment: Vec<f64>,
    /// Weight that fusion keeps of the first i + 1 clusters, 0 to 1.
    pub kept: Vec<f64>,
    /// Weight that fusion keeps of all clusters at full size, ranked or not.
    pub reachable: f64,
}

impl Ranking {
    /// Returns the share: weight that fusion keeps of the first `length` clusters over that of all,
    /// 0 to 1; 0 if it keeps nothing of all.
    pub fn share(&self, length: usize) -> f64 {
        match length.min(self.kept.len()) {
            n if n > 0 && self.reachable > 0.0 => self.kept[n - 1] / self.reachable,
            _ => 0.0,
        }
    }

    /// Corrects the shares by that of the first clusters, which are finished, as it was measured:
    /// of what they leave, the others are expected to add the same parts as before.
    pub fn correct(&mut self, finished: usize, measured: f64) {
        let expected = self.share(finished);
        // No factor leads from 0 to what was measured, and at 1 there is no rest to share out.
        if !(expected > 0.0 && expected < 1.0) {
            return;
        }
        for (rank, kept) in self.kept.iter_mut().enumerate() {
            let share = *kept / self.reachable;
            let corrected = if rank < finished {
                share * measured / expected
            } else {
                as_part_of_rest(share, expected, measured)
            };
            *kept = corrected * self.reachable;
        }
    }

    /// Returns the minimum number of clusters with that [`Self::share`]; all of them if fusion
    /// keeps nothing.
    pub fn length_for_share(&self, share: f64) -> usize {
        if self.reachable == 0.0 {
            return self.kept.len();
        }
        let wanted = share * self.reachable;
        // Kept weight never falls along the order, so it can be bisected.
        (self.kept.partition_point(|&kept| kept < wanted) + 1).min(self.kept.len())
    }

    /// Returns the clusters with the size at which they are matched, best first.
    pub fn maps(&self) -> impl Iterator<Item = (u32, MapScale)> {
        self.order.iter().copied().zip(self.scales.iter().copied())
    }
}

/// Returns the share that is the same part of what is left of all beyond the share `to` as `share`
/// is beyond `from`.
pub fn as_part_of_rest(share: f64, from: f64, to: f64) -> f64 {
    if from < 1.0 {
        to + (share - from) * (1.0 - to) / (1.0 - from)
    } else {
        to
    }
}

/// Ranks clusters at full size. Ties go to the cluster with the larger f_o by itself, then to the
/// first by view name.
pub fn rank(
    table: &FulfilmentTable,
    objective: &Objective,
    watcher: &dyn Watcher,
) -> Result<Ranking, TableError> {
    Ok(Ranker::new(&Maps::full_size(table), objective)?.rank(&[], 0.0, watcher)?)
}

/// Returns the share (0 to 1) of each prefix of a ranking under other weights.
pub fn shares_by(objective: &Objective, ranking: &Ranking, maps: &Maps) -> Vec<f64> {
    let mut reached = Reached::new(objective);
    let mut take = |(i, (cluster, scale)): (usize, (u32, MapScale))| {
        reached.take(maps.row_at(cluster, scale));
        if i.is_multiple_of(column::READ_AT_ONCE) {
            maps.release();
        }
        reached.kept_weight()
    };
    let kept: Vec<f64> = ranking.maps().enumerate().map(&mut take).collect();
    let all = if maps.has_half() {
        Reached::by_all(maps, objective).kept_weight()
    } else {
        kept.last().copied().unwrap_or(0.0)
    };
    kept.into_iter()
        .map(|kept| if all > 0.0 { kept / all } else { 0.0 })
        .collect()
}

/// Ranks depth maps, one per cluster, by gain less a price for their work.
pub struct Ranker<'a> {
    maps: &'a Maps<'a>,
    by_triangle: ByTriangle,
    nothing: Reached<'a>,
    /// Gain of each map by itself.
    alone: Vec<i64>,
    /// Weight that fusion keeps of all clusters at full size, if that is not what it keeps of all
    /// ranked ones.
    reachable: Option<f64>,
}

impl<'a> Ranker<'a> {
    pub fn new(maps: &'a Maps, objective: &'a Objective) -> Result<Self, DiskError> {
        let all: Vec<u32> = (0..maps.len()).collect();
        let rows = Rows {
            row: &|map| maps.row(map),
            release: &|| maps.release(),
            clusters: &all,
        };
        let by_triangle = ByTriangle::of_rows(&rows, maps.storage(), objective.weights.len())?;
        let nothing = Reached::new(objective);
        let gain = |&map: &u32| nothing.whole_gain(maps.row(map));
        // Once for all prices, whose rankings begin with these gains.
        let alone = column::read_by_parts(&all, gain, || maps.release());
        let reachable = maps
            .has_half()
            .then(|| Reached::by_all(maps, objective).kept_weight());
        Ok(Self {
            maps,
            by_triangle,
            nothing,
            alone,
            reachable,
        })
    }

    /// Returns prices of a unit of work, f_o: 0, at which all maps have full size, and falling ones
    /// from that at which no map by itself is worth its work.
    pub fn prices(&self) -> Vec<f64> {
        let worth = |map: u32| FixedPoint(self.alone[map as usize]).value() / self.maps.work(map);
        let most = (0..self.maps.len()).map(worth).fold(0.0, f64::max);
        let octaves = |step: u32| f64::from(step) / PRICES_PER_OCTAVE;
        std::iter::once(0.0)
            .chain((1..=PRICES).map(|step| most * (-octaves(step)).exp2()))
            .collect()
    }

    /// Ranks the maps at a price per unit of work. Finished maps come first, in the given order,
    /// whatever their gain (method 5.4). Ties go to the map with the larger gain by itself, then to
    /// the first.
    pub fn rank(
        &self,
        finished: &[(u32, MapScale)],
        price: f64,
        watcher: &dyn Watcher,
    ) -> Result<Ranking, Cancelled> {
        let mut greedy = Greedy::new(self, price);
        let mut ranking = Ranking::default();
        for &(cluster, scale) in finished {
            watcher.check()?;
            greedy.take(self.maps.index(cluster, scale), &mut ranking);
        }
        let total = greedy.gaining().count() as u64;
        watcher.progress(Stage::Ranking, 0, total);
        // No exchanges afterwards: they raise f_o by at most 5.4 % and save a map in 4 of 36 plans,
        // but a longer plan would no longer begin with a shorter one.
        while let Some(map) = greedy.best() {
            watcher.check()?;
            greedy.take(map, &mut ranking);
            let done = (ranking.order.len() - finished.len()) as u64;
            watcher.progress(Stage::Ranking, done.min(total), total);
        }
        watcher.progress(Stage::Ranking, total, total);
        let kept = ranking.kept.last();
        ranking.reachable = self.reachable.or(kept.copied()).unwrap_or(0.0);
        Ok(ranking)
    }
}

/// Gains of the remaining maps, kept up to date: when f of a triangle rises, the gains of all maps
/// that see it change by integers, and so stay equal to a fresh sum.
struct Greedy<'a> {
    ranker: &'a Ranker<'a>,
    reached: Reached<'a>,
    /// Maps of clusters that are not chosen yet.
    left: Vec<u32>,
    /// Gain, by map; several threads change them.
    gains: Vec<AtomicI64>,
    /// Price of each map's work, in the unit of the gains.
    costs: Vec<i64>,
}

/// Triangles whose f a map raises.
#[derive(Default)]
struct Raised {
    triangles: Vec<u32>,
    /// Their m largest f before.
    before: Vec<f32>,
}

impl<'a> Greedy<'a> {
    fn new(ranker: &'a Ranker, price: f64) -> Self {
        let all = 0..ranker.maps.len();
        let cost = |map| FixedPoint::new(price, ranker.maps.work(map)).0;
        Self {
            ranker,
            reached: ranker.nothing.clone(),
            left: all.clone().collect(),
            gains: ranker.alone.iter().copied().map(AtomicI64::new).collect(),
            costs: all.map(cost).collect(),
        }
    }

    /// Returns the map with the largest gain less its price, among those that gain.
    fn best(&self) -> Option<u32> {
        // Not gain over work, which takes all cheap maps first: from half of the work on, its f_o
        // is up to 7 % below that of full size alone.
        let surplus = |gain: i64, map: u32| gain - self.costs[map as usize];
        let alone = |map: u32| self.ranker.alone[map as usize];
        let key = |&map: &u32| {
            (
                surplus(self.gain(map), map),
                surplus(alone(map), map),
                Reverse(map),
            )
        };
        // A scan, not a heap: a step changes the gains of many maps, and raises some.
        self.gaining().max_by_key(key)
    }

    fn gaining(&self) -> impl Iterator<Item = u32> {
        let left = self.left.iter().copied();
        left.filter(|&map| self.gain(map) > 0)
    }

    fn gain(&self, map: u32) -> i64 {
        self.gains[map as usize].load(Ordering::Relaxed)
    }

    fn take(&mut self, map: u32, ranking: &mut Ranking) {
        let Ranker {
            maps, by_triangle, ..
        } = self.ranker;
        let (gain, cluster) = (self.gain(map), maps.cluster(map));
        // A key view is matched at one size only: the cluster's other map is out as well.
        self.left.retain(|&other| maps.cluster(other) != cluster);
        let raised = self.raise(maps.row(map));
        self.update_gains(&raised);
        if ranking.order.len().is_multiple_of(column::READ_AT_ONCE) {
            maps.release();
            by_triangle.release();
        }
        ranking.order.push(cluster);
        ranking.scales.push(maps.scale(map));
        ranking.gains.push(FixedPoint(gain).value());
        ranking.fulfilment.push(self.reached.fulfilment());
        ranking.kept.push(self.reached.kept_weight());
    }

    fn raise(&mut self, (triangles, values): (&[u32], &[f32])) -> Raised {
        let mut raised = Raised::default();
        for (&t, &f) in triangles.iter().zip(values) {
            if f <= self.reached.agreed(t) {
                continue;
            }
            raised.triangles.push(t);
            // The gains of other maps change by the difference.
            raised.before.extend_from_slice(self.reached.largest(t));
            self.reached.take_at(t, f);
        }
        raised
    }

    /// Changes the gains of all maps that see raised triangles.
    fn update_gains(&self, raised: &Raised) {
        let Self { reached, gains, .. } = self;
        let update = |(&t, before): (&u32, &[f32])| {
            let [then, now] =
                [before, reached.largest(t)].map(|largest| reached.gains_at(t, largest));
            let entries = self.ranker.by_triangle.row(t).iter();
            // At or below the m-th largest f, a map gains nothing here, before or after.
            for entry in entries.filter(|entry| entry.f > before[0]) {
                let change = now(entry.f) - then(entry.f);
                // Sums of integers do not depend on the order in which threads add.
                gains[entry.place as usize].fetch_add(change, Ordering::Relaxed);
            }
        };
        // Rankings at several prices run at once, and one that waited for parts of its own would
        // begin another.
        let at_once = if self.ranker.maps.has_half() {
            usize::MAX
        } else {
            TRIANGLES_AT_ONCE
        };
        let before = raised
            .before
            .par_chunks_exact(reached.objective.support as usize);
        raised
            .triangles
            .par_iter()
            .zip(before)
            .with_min_len(at_once)
            .for_each(update);
    }
}

#[cfg(test)]
mod tests;
