//! Method 5: in which order the view clusters are computed.
//!
//! `f_o(V) = sum over triangles of weight x (1/m) x (the sum of the m largest f(t, v), v in V)` is monotone and submodular, so the
//! greedy order is within 1 - 1/e of the best set of each length. m is the `support`; m = 1 is the paper's maximum.

mod belief;

use std::{cmp::Ordering, collections::BinaryHeap};

pub use self::belief::{Attempt, Beliefs};

use crate::{
    base::{
        column,
        progress::{Cancelled, Stage, Watcher},
    },
    config::TriangleWeight,
    method::{fulfilment::FulfilmentTable, surface::Surface},
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
}

impl Ranking {
    /// f_o of all clusters together.
    pub fn total(&self) -> f64 {
        self.fulfilment.last().copied().unwrap_or(0.0)
    }

    fn push(&mut self, cluster: u32, gain: f64) {
        let sum = self.total() + gain;
        self.order.push(cluster);
        self.gains.push(gain);
        self.fulfilment.push(sum);
    }

    /// f_o of the first `length` clusters over f_o of all; 0 where nothing can be reached.
    pub fn share(&self, length: usize) -> f64 {
        match length.min(self.fulfilment.len()) {
            n if n > 0 && self.total() > 0.0 => self.fulfilment[n - 1] / self.total(),
            _ => 0.0,
        }
    }

    /// The fewest clusters that reach that share of what all clusters together reach.
    pub fn length_for_share(&self, share: f64) -> usize {
        let wanted = share * self.total();
        (self.fulfilment.partition_point(|&f| f < wanted) + 1).min(self.fulfilment.len())
    }
}

/// What each triangle counts; the sum is 1.
pub fn weights(surface: &Surface, weight: TriangleWeight) -> Vec<f64> {
    let one = |t: u32| match weight {
        TriangleWeight::Count => 1.0,
        TriangleWeight::Area => surface.area(t),
    };
    let raw: Vec<f64> = (0..surface.triangles.len() as u32).map(one).collect();
    let sum: f64 = raw.iter().sum();
    raw.into_iter().map(|w| if sum > 0.0 { w / sum } else { 0.0 }).collect()
}

/// The greedy order, lazily (Minoux 1978). `support`: m of method 5.2; 0 counts as 1.
///
/// Equal to plain greedy to the bit: a gain is a sum of terms that only shrink, always added in the order of triangles, and rounding
/// is monotone, so a stale gain never lies below the fresh one. Ties by cluster index, which is the order of view names.
pub fn rank(
    table: &FulfilmentTable,
    weights: &[f64],
    support: u32,
    watcher: &dyn Watcher,
) -> Result<Ranking, Cancelled> {
    rank_after(&[], table, weights, support, watcher)
}

/// The same behind clusters that are finished: they come first, in their order, whatever they gain (method 5.4).
pub fn rank_after(
    finished: &[u32],
    table: &FulfilmentTable,
    weights: &[f64],
    support: u32,
    watcher: &dyn Watcher,
) -> Result<Ranking, Cancelled> {
    let mut reached = Reached::new(weights, support);
    let mut ranking = Ranking::default();
    let mut left = vec![true; table.clusters()];
    for &cluster in finished {
        let row = table.of(cluster as usize);
        ranking.push(cluster, reached.gain(row));
        reached.take(row);
        left[cluster as usize] = false;
    }
    let gain = |&c: &usize| if left[c] { reached.gain(table.of(c)) } else { 0.0 };
    let clusters: Vec<usize> = (0..table.clusters()).collect();
    let first = column::read_by_parts(&clusters, gain, || table.release());
    let taken_then = finished.len();
    let stale = first.into_iter().enumerate().map(|(c, gain)| Entry { gain, cluster: c as u32, taken_then });
    let mut heap: BinaryHeap<Entry> = stale.filter(|e| e.gain > 0.0).collect();
    let (mut looks, total) = (0usize, heap.len() as u64);
    watcher.progress(Stage::Ranking, 0, total);
    while let Some(top) = heap.pop() {
        watcher.check()?;
        looks += 1;
        if looks.is_multiple_of(column::READ_AT_ONCE) {
            table.release();
        }
        let cluster = table.of(top.cluster as usize);
        if top.taken_then < ranking.order.len() {
            let gain = reached.gain(cluster);
            if gain > 0.0 {
                heap.push(Entry { gain, taken_then: ranking.order.len(), ..top });
            }
            continue;
        }
        reached.take(cluster);
        ranking.push(top.cluster, top.gain);
        watcher.progress(Stage::Ranking, total - heap.len() as u64, total);
    }
    watcher.progress(Stage::Ranking, total, total);
    Ok(ranking)
}

/// A cluster in the heap with its gain when so many clusters were taken.
struct Entry {
    gain: f64,
    cluster: u32,
    taken_then: usize,
}

impl Ord for Entry {
    fn cmp(&self, other: &Self) -> Ordering {
        self.gain.total_cmp(&other.gain).then(other.cluster.cmp(&self.cluster))
    }
}

impl PartialOrd for Entry {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Entry {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Entry {}

/// What the clusters taken so far reach: the m largest f of each triangle.
pub(crate) struct Reached<'a> {
    weights: &'a [f64],
    support: usize,
    /// m per triangle, ascending.
    best: Vec<f32>,
}

impl<'a> Reached<'a> {
    pub(crate) fn new(weights: &'a [f64], support: u32) -> Self {
        let support = support.max(1) as usize;
        Self { weights, support, best: vec![0.0; support * weights.len()] }
    }

    /// The value that a triangle's f must exceed to add anything.
    pub(crate) fn floor(&self, triangle: u32) -> f32 {
        self.best[triangle as usize * self.support]
    }

    /// How much f_o grows by a cluster.
    pub(crate) fn gain(&self, (triangles, values): (&[u32], &[f32])) -> f64 {
        let term = |(&t, &f): (&u32, &f32)| {
            let more = f - self.floor(t);
            if more > 0.0 { self.weights[t as usize] * f64::from(more) } else { 0.0 }
        };
        triangles.iter().zip(values).map(term).sum::<f64>() / self.support as f64
    }

    pub(crate) fn take(&mut self, (triangles, values): (&[u32], &[f32])) {
        for (&t, &f) in triangles.iter().zip(values) {
            let best = &mut self.best[t as usize * self.support..][..self.support];
            let place = best.partition_point(|&b| b < f);
            if place > 0 {
                best.copy_within(1..place, 0);
                best[place - 1] = f;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::base::progress::Unwatched;

    /// f_o by its definition.
    fn fulfilment(rows: &[Vec<(u32, f32)>], chosen: &[usize], triangles: u32, support: usize) -> f64 {
        let of_triangle = |t: u32| {
            let mut f: Vec<f64> =
                chosen.iter().flat_map(|&c| &rows[c]).filter(|r| r.0 == t).map(|r| f64::from(r.1)).collect();
            f.sort_by(|a, b| b.total_cmp(a));
            f.iter().take(support).sum::<f64>() / support as f64
        };
        (0..triangles).map(of_triangle).sum::<f64>() / f64::from(triangles)
    }

    /// Plain greedy with fresh gains, same arithmetic, ties by index.
    fn plain_greedy(table: &FulfilmentTable, weights: &[f64], support: u32) -> Vec<(u32, f64)> {
        let mut reached = Reached::new(weights, support);
        let mut left: Vec<u32> = (0..table.clusters() as u32).collect();
        let mut order = Vec::new();
        loop {
            let gains = left.iter().map(|&c| (c, reached.gain(table.of(c as usize))));
            let best = gains.fold((0, 0.0), |a, b| if b.1 > a.1 { b } else { a });
            if best.1 <= 0.0 {
                return order;
            }
            reached.take(table.of(best.0 as usize));
            left.retain(|&c| c != best.0);
            order.push(best);
        }
    }

    fn rows() -> impl Strategy<Value = Vec<Vec<(u32, f32)>>> {
        // Few distinct values, so that ties are common.
        let row = proptest::collection::btree_map(0u32..12, (1u8..8).prop_map(|v| f32::from(v) / 8.0), 0..10);
        proptest::collection::vec(row.prop_map(|r| r.into_iter().collect()), 0..9)
    }

    proptest! {
        #[test]
        fn lazy_is_plain_greedy(rows in rows(), support in 1u32..4) {
            let table = FulfilmentTable::new(&rows);
            let weights = vec![1.0 / 12.0; 12];
            let ranking = rank(&table, &weights, support, &Unwatched).unwrap();
            let lazy: Vec<_> = ranking.order.iter().copied().zip(ranking.gains.iter().copied()).collect();
            prop_assert_eq!(lazy, plain_greedy(&table, &weights, support));
            let chosen: Vec<usize> = ranking.order.iter().map(|&c| c as usize).collect();
            for n in 1..=chosen.len() {
                let expected = fulfilment(&rows, &chosen[..n], 12, support as usize);
                prop_assert!((ranking.fulfilment[n - 1] - expected).abs() < 1e-6);
            }
            let all: Vec<usize> = (0..rows.len()).collect();
            prop_assert!((ranking.total() - fulfilment(&rows, &all, 12, support as usize)).abs() < 1e-6);
        }

        #[test]
        fn what_is_finished_comes_first_and_the_rest_is_greedy_behind_it(rows in rows(), support in 1u32..4) {
            let table = FulfilmentTable::new(&rows);
            let weights = vec![1.0 / 12.0; 12];
            let whole = rank(&table, &weights, support, &Unwatched).unwrap();
            for length in 0..=whole.order.len() {
                prop_assert_eq!(&rank_after(&whole.order[..length], &table, &weights, support, &Unwatched).unwrap(), &whole);
            }
            let last: Vec<u32> = (0..rows.len() as u32).rev().take(2).collect();
            let after = rank_after(&last, &table, &weights, support, &Unwatched).unwrap();
            prop_assert_eq!(&after.order[..last.len()], &last[..]);
            prop_assert!((after.total() - whole.total()).abs() < 1e-6);
            let behind = after.gains[last.len()..].iter();
            prop_assert!(behind.clone().zip(behind.skip(1)).all(|(a, b)| a >= b));
        }

        #[test]
        fn greedy_is_near_the_optimum(rows in rows(), support in 1u32..4) {
            let ranking = rank(&FulfilmentTable::new(&rows), &[1.0 / 12.0; 12], support, &Unwatched).unwrap();
            for length in 1..=ranking.order.len() {
                let sets = (0u32..1 << rows.len()).filter(|s| s.count_ones() as usize == length);
                let members = |s: u32| (0..rows.len()).filter(|c| s >> c & 1 == 1).collect::<Vec<_>>();
                let optimum = sets.map(|s| fulfilment(&rows, &members(s), 12, support as usize)).fold(0.0, f64::max);
                let bound = (1.0 - (-1f64).exp()) * optimum;
                prop_assert!(ranking.fulfilment[length - 1] >= bound - 1e-6);
            }
        }
    }

    #[test]
    fn the_prefix_for_a_share_is_the_shortest() {
        let rows = [vec![(0, 0.5f32)], vec![(1, 0.25)], vec![(2, 0.25)]];
        let ranking = rank(&FulfilmentTable::new(&rows), &[1.0 / 3.0; 3], 1, &Unwatched).unwrap();
        assert_eq!(ranking.order, [0, 1, 2]);
        assert_eq!([0.4, 0.5, 0.6, 0.75, 1.0].map(|s| ranking.length_for_share(s)), [1, 1, 2, 2, 3]);
        assert_eq!(Ranking::default().length_for_share(0.9), 0);
        assert_eq!(Ranking::default().share(3), 0.0);
    }

    #[test]
    fn a_gain_of_zero_ends_the_order() {
        let rows = [vec![(0, 0.5f32), (1, 0.5)], vec![(0, 0.5)], vec![(1, 0.25)], vec![]];
        let ranking = rank(&FulfilmentTable::new(&rows), &[0.5; 2], 1, &Unwatched).unwrap();
        assert_eq!(ranking.order, [0]);
    }
}
