//! Method 5: in which order the view clusters are computed.
//!
//! Greedy: each time the cluster that adds most to the [`Objective`]. That is monotone, but submodular only where a single map is enough: a map
//! may be worth more when another has come that it can agree with. Gains are therefore kept up to date, not looked up lazily.

mod belief;
mod bound;
mod maps;
mod objective;
mod reached;

use self::reached::Amount;
pub(crate) use self::reached::Reached;
pub use self::{
    belief::{Attempt, Beliefs},
    bound::most_of_any,
    maps::Maps,
    objective::{Objective, SINGLE_MAP_CREDIT, SeenPixels},
};
use crate::{
    base::{
        column::{self, DiskError, TableError},
        progress::{Stage, Watcher},
    },
    method::fulfilment::{ByTriangle, FulfilmentTable},
    model::cluster::MapScale,
};

/// Greedy order of the clusters.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Ranking {
    /// Cluster indices (into the plan's clusters), best first; only those with a gain above 0, or finished already.
    pub order: Vec<u32>,
    /// Size at which each is matched.
    pub scales: Vec<MapScale>,
    /// Gain of f_o of each, at its time.
    pub gains: Vec<f64>,
    /// f_o of the first i + 1 clusters.
    pub fulfilment: Vec<f64>,
    /// Weight that fusion keeps of the first i + 1 clusters, 0 to 1.
    pub kept: Vec<f64>,
    /// The same of all clusters at full size, ranked or not.
    pub reachable: f64,
}

impl Ranking {
    /// f_o of the whole order.
    pub fn total(&self) -> f64 {
        self.fulfilment.last().copied().unwrap_or(0.0)
    }

    /// What fusion keeps of the first `length` clusters over what it keeps of all, 0 to 1; 0 where it keeps nothing even of all.
    pub fn share(&self, length: usize) -> f64 {
        match length.min(self.kept.len()) {
            n if n > 0 && self.reachable > 0.0 => self.kept[n - 1] / self.reachable,
            _ => 0.0,
        }
    }

    /// The fewest clusters with that [`Self::share`]; all of them where fusion keeps nothing.
    pub fn length_for_share(&self, share: f64) -> usize {
        if self.reachable == 0.0 {
            return self.kept.len();
        }
        let wanted = share * self.reachable;
        (self.kept.partition_point(|&kept| kept < wanted) + 1).min(self.kept.len())
    }

    /// Clusters with the size at which they are matched, best first.
    pub fn maps(&self) -> impl Iterator<Item = (u32, MapScale)> {
        self.order.iter().copied().zip(self.scales.iter().copied())
    }
}

/// The greedy order of clusters at full size; ties go to the cluster that does more by itself, then to the first, which is that of the first
/// view name.
pub fn rank(table: &FulfilmentTable, objective: &Objective, watcher: &dyn Watcher) -> Result<Ranking, TableError> {
    rank_after(&[], &Maps::full_size(table), objective, watcher)
}

/// The greedy order of depth maps, one of each cluster: by gain, or by gain over work where there is a choice of sizes. Behind those that are
/// finished: they come first, in their order, whatever they gain (method 5.4).
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
        // What is finished is measured; its row is the same whatever its size.
        greedy.take(cluster, scale, &mut ranking);
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

/// What fusion is expected to keep of each prefix of a ranking over what it keeps of all clusters at full size, by other weights, 0 to 1.
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

/// Weight that fusion is expected to keep of all clusters at full size.
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

/// The gain of each map that is left, kept up to date: when a triangle is better reached, the gains of all maps that see it change by
/// whole numbers, so that they stay what a fresh sum would give.
struct Greedy<'a> {
    maps: &'a Maps<'a>,
    by_triangle: ByTriangle,
    reached: Reached<'a>,
    /// Of clusters that are not taken.
    left: Vec<u32>,
    /// By map.
    gains: Vec<i64>,
    /// Gain of each map where nothing is reached.
    alone: Vec<i64>,
}

impl<'a> Greedy<'a> {
    fn new(maps: &'a Maps, objective: &'a Objective) -> Result<Self, DiskError> {
        let left: Vec<u32> = (0..maps.len()).collect();
        let by_triangle = ByTriangle::of_rows(
            &|map| maps.row(map),
            &|| maps.release(),
            maps.storage(),
            &left,
            objective.weights.len(),
        )?;
        let reached = Reached::new(objective);
        let gain = |&map: &u32| reached.whole_gain(maps.row(map));
        let gains = column::read_by_parts(&left, gain, || maps.release());
        Ok(Self { maps, by_triangle, left, alone: gains.clone(), gains, reached })
    }

    /// The map that gains most for its work, if any gains.
    fn best(&self) -> Option<u32> {
        let better = |&a: &u32, &b: &u32| {
            let [of_a, of_b] = [a, b].map(|map| i128::from(self.maps.whole_work(map)));
            // a's gain over a's work, against b's: exact, so that equal works leave the order by gain.
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
        ranking.gains.push(Amount(gain).value());
        ranking.fulfilment.push(self.reached.fulfilment());
        ranking.kept.push(self.reached.kept_weight());
    }
}

#[cfg(test)]
mod tests;
