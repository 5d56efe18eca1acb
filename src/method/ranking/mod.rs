//! Ranking (method 5): the order in which the view clusters are computed.
//!
//! Greedy: the next cluster is the one that adds most to the [`Objective`]. The objective is monotone, but submodular only if a single map is enough:
//! a map gains worth when another one can confirm it. Gains are therefore kept up to date instead of evaluated lazily.

mod belief;
mod bound;
mod enlarge;
mod maps;
mod objective;
mod reached;

use self::reached::FixedPoint;
pub(crate) use self::reached::Reached;
pub use self::{
    belief::{Attempt, Beliefs},
    bound::most_of_any,
    enlarge::enlarge,
    maps::Maps,
    objective::{Objective, SINGLE_MAP_CREDIT},
};
use crate::{
    base::{
        column::{self, DiskError, TableError},
        progress::{Stage, Watcher},
    },
    method::fulfilment::{ByTriangle, FulfilmentTable},
    model::cluster::MapScale,
};

/// A ranking of view clusters.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Ranking {
    /// Cluster indices (into the plan's clusters), best first; only finished ones and those with a gain above 0.
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
    /// Returns the share: weight that fusion keeps of the first `length` clusters over that of all, 0 to 1; 0 if it keeps nothing of all.
    pub fn share(&self, length: usize) -> f64 {
        match length.min(self.kept.len()) {
            n if n > 0 && self.reachable > 0.0 => self.kept[n - 1] / self.reachable,
            _ => 0.0,
        }
    }

    /// Returns the minimum number of clusters with that [`Self::share`]; all of them if fusion keeps nothing.
    pub fn length_for_share(&self, share: f64) -> usize {
        if self.reachable == 0.0 {
            return self.kept.len();
        }
        let wanted = share * self.reachable;
        (self.kept.partition_point(|&kept| kept < wanted) + 1).min(self.kept.len())
    }

    /// Returns the clusters with the size at which they are matched, best first.
    pub fn maps(&self) -> impl Iterator<Item = (u32, MapScale)> {
        self.order.iter().copied().zip(self.scales.iter().copied())
    }
}

/// Ranks clusters at full size. Ties go to the cluster with the larger f_o by itself, then to the first by view name.
pub fn rank(table: &FulfilmentTable, objective: &Objective, watcher: &dyn Watcher) -> Result<Ranking, TableError> {
    rank_after(&[], &Maps::full_size(table), objective, watcher)
}

/// Ranks depth maps, one per cluster: by gain, or by gain over work if there is a choice of sizes. Finished maps come first, in the given order,
/// whatever their gain (method 5.4).
pub fn rank_after(
    finished: &[(u32, MapScale)],
    maps: &Maps,
    objective: &Objective,
    watcher: &dyn Watcher,
) -> Result<Ranking, TableError> {
    let mut greedy = Greedy::new(maps, objective)?;
    let mut ranking = Ranking::default();
    for &(cluster, scale) in finished {
        watcher.check()?;
        greedy.take(maps.index(cluster, scale), scale, &mut ranking);
    }
    let total = greedy.left.iter().filter(|&&map| greedy.gains[map as usize] > 0).count() as u64;
    watcher.progress(Stage::Ranking, 0, total);
    while let Some(map) = greedy.best() {
        watcher.check()?;
        greedy.take(map, maps.scale(map), &mut ranking);
        let done = (ranking.order.len() - finished.len()) as u64;
        watcher.progress(Stage::Ranking, done.min(total), total);
    }
    watcher.progress(Stage::Ranking, total, total);
    ranking.reachable = match maps.has_half() {
        true => kept_of_all(maps, objective),
        false => ranking.kept.last().copied().unwrap_or(0.0),
    };
    Ok(ranking)
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
    let all = if maps.has_half() { kept_of_all(maps, objective) } else { kept.last().copied().unwrap_or(0.0) };
    kept.into_iter().map(|kept| if all > 0.0 { kept / all } else { 0.0 }).collect()
}

/// Returns the weight that fusion is expected to keep of all clusters at full size.
fn kept_of_all(maps: &Maps, objective: &Objective) -> f64 {
    let mut reached = Reached::new(objective);
    for cluster in 0..maps.clusters() {
        reached.take(maps.row(cluster));
        if (cluster as usize).is_multiple_of(column::READ_AT_ONCE) {
            maps.release();
        }
    }
    reached.kept_weight()
}

/// Gains of the remaining maps, kept up to date: when f of a triangle rises, the gains of all maps that see it change by integers, and so stay equal
/// to a fresh sum.
struct Greedy<'a> {
    maps: &'a Maps<'a>,
    by_triangle: ByTriangle,
    reached: Reached<'a>,
    /// Maps to choose from, of clusters that are not chosen yet.
    left: Vec<u32>,
    /// Gain, by map.
    gains: Vec<i64>,
    /// Gain of each map by itself.
    alone: Vec<i64>,
}

impl<'a> Greedy<'a> {
    fn new(maps: &'a Maps, objective: &'a Objective) -> Result<Self, DiskError> {
        let all: Vec<u32> = (0..maps.len()).collect();
        let by_triangle = ByTriangle::of_rows(
            &|map| maps.row(map),
            &|| maps.release(),
            maps.storage(),
            &all,
            objective.weights.len(),
        )?;
        let reached = Reached::new(objective);
        let gain = |&map: &u32| reached.whole_gain(maps.row(map));
        let gains = column::read_by_parts(&all, gain, || maps.release());
        Ok(Self { maps, by_triangle, left: maps.candidates(), alone: gains.clone(), gains, reached })
    }

    /// Returns the map with the largest gain per work, if any gains.
    fn best(&self) -> Option<u32> {
        let better = |&a: &u32, &b: &u32| {
            let [of_a, of_b] = [a, b].map(|map| i128::from(self.maps.whole_work(map)));
            // Compares gain per work by cross multiplication: exact, so that equal work leaves the order by gain.
            let by =
                |gains: &[i64]| (i128::from(gains[a as usize]) * of_b).cmp(&(i128::from(gains[b as usize]) * of_a));
            by(&self.gains).then_with(|| by(&self.alone)).then(b.cmp(&a))
        };
        self.left.iter().copied().max_by(better).filter(|&map| self.gains[map as usize] > 0)
    }

    fn take(&mut self, map: u32, scale: MapScale, ranking: &mut Ranking) {
        let (gain, cluster) = (self.gains[map as usize], self.maps.cluster(map));
        self.left.retain(|&other| self.maps.cluster(other) != cluster);
        let (triangles, values) = self.maps.row(map);
        let mut before = Vec::with_capacity(self.reached.objective.support as usize);
        for (&t, &f) in triangles.iter().zip(values) {
            before.clear();
            before.extend_from_slice(self.reached.largest(t));
            if f <= before[0] {
                continue;
            }
            self.reached.take_at(t, f);
            let now = self.reached.largest(t);
            for entry in self.by_triangle.row(t).iter().filter(|entry| entry.f > before[0]) {
                let change = self.reached.gain_at(t, now, entry.f) - self.reached.gain_at(t, &before, entry.f);
                self.gains[entry.place as usize] += change;
            }
        }
        if ranking.order.len().is_multiple_of(column::READ_AT_ONCE) {
            self.maps.release();
            self.by_triangle.release();
        }
        ranking.order.push(cluster);
        ranking.scales.push(scale);
        ranking.gains.push(FixedPoint(gain).value());
        ranking.fulfilment.push(self.reached.fulfilment());
        ranking.kept.push(self.reached.kept_weight());
    }
}

#[cfg(test)]
mod tests;
