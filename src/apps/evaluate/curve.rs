//! Measured curve of an order of view clusters (method 8).

use crate::{
    method::{
        fulfilment::FulfilmentTable,
        ranking::{Objective, Reached},
    },
    model::cluster::ViewCluster,
};

/// Results of the first i clusters of an order, for i = 0, 1, ...; all begin with 0.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct ReachCurve {
    /// f_o (method 5.1).
    pub fulfilment: Vec<f64>,
    /// Weight that fusion keeps (method 5.2), 0 to 1; shares refer to it.
    pub kept: Vec<f64>,
    /// Number of (key view, partner) pairs.
    pub pairs: Vec<usize>,
}

impl ReachCurve {
    /// Computes the curve along `order` (indices into `clusters` and into the table's rows).
    pub fn new(
        table: &FulfilmentTable,
        objective: &Objective,
        clusters: &[ViewCluster],
        order: &[u32],
    ) -> Self {
        Self::of_rows(
            objective,
            order
                .iter()
                .map(|&c| (table.row(c as usize), clusters[c as usize].partners.len())),
        )
    }

    /// Computes the curve along depth maps, each given by its row of fulfilment and its number of
    /// partners.
    pub fn of_rows<'r>(
        objective: &Objective,
        maps: impl Iterator<Item = ((&'r [u32], &'r [f32]), usize)>,
    ) -> Self {
        let (mut reached, mut pairs) = (Reached::new(objective), 0);
        let mut curve = Self::start();
        for (row, partners) in maps {
            reached.take(row);
            pairs += partners;
            curve.fulfilment.push(reached.fulfilment());
            curve.kept.push(reached.kept_weight());
            curve.pairs.push(pairs);
        }
        curve
    }

    /// Returns the curve before the first cluster.
    pub(super) fn start() -> Self {
        Self {
            fulfilment: vec![0.0],
            kept: vec![0.0],
            pairs: vec![0],
        }
    }

    /// Returns f_o of the whole order.
    pub fn total(&self) -> f64 {
        self.fulfilment.last().copied().unwrap_or(0.0)
    }

    /// Returns the weight that fusion keeps of the whole order, 0 to 1.
    pub fn total_kept(&self) -> f64 {
        self.kept.last().copied().unwrap_or(0.0)
    }

    /// Returns the smallest number of first clusters of which fusion keeps at least this weight;
    /// `None` if it keeps less of all of them.
    pub fn clusters_for(&self, kept: f64) -> Option<usize> {
        first_at(&self.kept, kept)
    }

    /// Returns the weight that fusion keeps of the first clusters as a share of `total`; 0 if that
    /// is 0.
    pub fn share(&self, clusters: usize, total: f64) -> f64 {
        let kept = self.kept[clusters.min(self.kept.len() - 1)];
        if total > 0.0 { kept / total } else { 0.0 }
    }
}

/// Tolerance: sums of the same terms in a different order differ by less.
const ROUNDING: f64 = 1e-9;

/// Returns the first place of a curve that is at this height; `None` if all of it is below.
pub fn first_at(curve: &[f64], height: f64) -> Option<usize> {
    curve.iter().position(|&value| value >= height - ROUNDING)
}

/// The shares at which curves are read: 10, 20, ... 90 %.
pub const SHARES: [f64; 9] = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9];

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::scene::ViewIndex;

    #[test]
    fn counts_clusters_up_to_a_fulfilment() {
        let table =
            FulfilmentTable::new([vec![(0, 1.0)], vec![(0, 0.5), (1, 0.2)], vec![(1, 1.0)]]);
        let cluster = |key: u32, partners: u32| ViewCluster {
            key: ViewIndex(key),
            partners: (0..partners).map(|p| ViewIndex(10 + p)).collect(),
        };
        let clusters = [cluster(0, 2), cluster(1, 3), cluster(2, 4)];
        let curve = ReachCurve::new(
            &table,
            &Objective::weighing(vec![1.0; 2], 1),
            &clusters,
            &[1, 0, 2],
        );
        assert!(
            curve
                .fulfilment
                .iter()
                .zip([0.0, 0.35, 0.6, 1.0])
                .all(|(f, expected)| (f - expected).abs() < 1e-6)
        );
        assert!(
            curve
                .kept
                .iter()
                .zip([0.0, 0.35, 0.6, 1.0])
                .all(|(kept, expected)| (kept - expected).abs() < 1e-6)
        );
        assert_eq!(curve.pairs, [0, 3, 5, 9]);
        assert_eq!(curve.clusters_for(0.34), Some(1));
        assert_eq!(curve.clusters_for(0.36), Some(2));
        assert_eq!(curve.clusters_for(0.76), Some(3));
        assert_eq!(curve.clusters_for(1.01), None);
        assert_eq!(curve.share(1, 1.0), curve.kept[1]);
        assert_eq!(curve.share(9, 0.0), 0.0);
    }
}
