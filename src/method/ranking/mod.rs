//! Method 5: in which order the view clusters are computed.
//!
//! Greedy: each time the cluster that adds most to the [`Objective`]. That is monotone, but submodular only where a single map is enough: a map
//! may be worth more when another has come that it can agree with. Gains are therefore kept up to date, not looked up lazily.

mod belief;
mod bound;
mod objective;
mod reached;

use self::reached::Amount;
pub(crate) use self::reached::Reached;
pub use self::{
    belief::{Attempt, Beliefs},
    bound::most_of_any,
    objective::{KEPT, Objective, SINGLE_MAP_CREDIT, SeenPixels},
};
use crate::{
    base::{
        column::{self, DiskError, TableError},
        progress::{Stage, Watcher},
    },
    method::fulfilment::{ByTriangle, FulfilmentTable},
};

/// Greedy order of the clusters.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Ranking {
    /// Cluster indices (into the plan's clusters), best first; only those with a gain above 0, or finished already.
    pub order: Vec<u32>,
    /// Gain of f_o of each, at its time.
    pub gains: Vec<f64>,
    /// f_o of the first i + 1 clusters.
    pub fulfilment: Vec<f64>,
    /// Weight of the triangles that fusion keeps of the first i + 1 clusters, 0 to 1.
    pub kept: Vec<f64>,
}

impl Ranking {
    /// f_o of all clusters together.
    pub fn total(&self) -> f64 {
        self.fulfilment.last().copied().unwrap_or(0.0)
    }

    /// Weight of the triangles that fusion keeps of all clusters together, 0 to 1.
    pub fn total_kept(&self) -> f64 {
        self.kept.last().copied().unwrap_or(0.0)
    }

    /// What fusion keeps of the first `length` clusters over what it keeps of all, 0 to 1; 0 where it keeps nothing even of all.
    pub fn share(&self, length: usize) -> f64 {
        match length.min(self.kept.len()) {
            n if n > 0 && self.total_kept() > 0.0 => self.kept[n - 1] / self.total_kept(),
            _ => 0.0,
        }
    }

    /// The fewest clusters with that [`Self::share`]; all of them where fusion keeps nothing.
    pub fn length_for_share(&self, share: f64) -> usize {
        if self.total_kept() == 0.0 {
            return self.kept.len();
        }
        let wanted = share * self.total_kept();
        (self.kept.partition_point(|&kept| kept < wanted) + 1).min(self.kept.len())
    }

    fn push(&mut self, cluster: u32, gain: i64, reached: &Reached) {
        self.order.push(cluster);
        self.gains.push(Amount(gain).value());
        self.fulfilment.push(reached.fulfilment());
        self.kept.push(reached.kept_weight());
    }
}

/// The greedy order; ties go to the cluster that does more by itself, then to the first, which is that of the first view name.
pub fn rank(table: &FulfilmentTable, objective: &Objective, watcher: &dyn Watcher) -> Result<Ranking, TableError> {
    rank_after(&[], table, objective, watcher)
}

/// The same behind clusters that are finished: they come first, in their order, whatever they gain (method 5.4).
pub fn rank_after(
    finished: &[u32],
    table: &FulfilmentTable,
    objective: &Objective,
    watcher: &dyn Watcher,
) -> Result<Ranking, TableError> {
    let mut greedy = Greedy::new(table, objective)?;
    let mut ranking = Ranking::default();
    for &cluster in finished {
        watcher.check()?;
        greedy.take(cluster, &mut ranking);
    }
    let total = greedy.left.iter().filter(|&&c| greedy.gains[c as usize] > 0).count() as u64;
    watcher.progress(Stage::Ranking, 0, total);
    while let Some(cluster) = greedy.best() {
        watcher.check()?;
        greedy.take(cluster, &mut ranking);
        let done = (ranking.order.len() - finished.len()) as u64;
        watcher.progress(Stage::Ranking, done.min(total), total);
    }
    watcher.progress(Stage::Ranking, total, total);
    Ok(ranking)
}

/// The gain of each cluster that is left, kept up to date: when a triangle is better reached, the gains of all clusters that see it change by
/// whole numbers, so that they stay what a fresh sum would give.
struct Greedy<'a> {
    table: &'a FulfilmentTable,
    by_triangle: ByTriangle,
    reached: Reached<'a>,
    /// Not taken.
    left: Vec<u32>,
    /// By cluster.
    gains: Vec<i64>,
    /// Gain of each cluster where nothing is reached.
    alone: Vec<i64>,
}

impl<'a> Greedy<'a> {
    fn new(table: &'a FulfilmentTable, objective: &'a Objective) -> Result<Self, DiskError> {
        let left: Vec<u32> = (0..table.clusters() as u32).collect();
        let by_triangle = ByTriangle::new(table, &left, objective.weights.len())?;
        let reached = Reached::new(objective);
        let gain = |&c: &u32| reached.whole_gain(table.row(c as usize));
        let gains = column::read_by_parts(&left, gain, || table.release());
        Ok(Self { table, by_triangle, left, alone: gains.clone(), gains, reached })
    }

    /// The cluster that gains most, if any gains.
    fn best(&self) -> Option<u32> {
        let gain = |c: u32| (self.gains[c as usize], self.alone[c as usize], std::cmp::Reverse(c));
        self.left.iter().copied().max_by_key(|&c| gain(c)).filter(|&c| self.gains[c as usize] > 0)
    }

    fn take(&mut self, cluster: u32, ranking: &mut Ranking) {
        let gain = self.gains[cluster as usize];
        self.left.retain(|&c| c != cluster);
        let (triangles, values) = self.table.row(cluster as usize);
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
            self.table.release();
            self.by_triangle.release();
        }
        ranking.push(cluster, gain, &self.reached);
    }
}

#[cfg(test)]
mod tests;
