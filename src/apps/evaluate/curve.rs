//! What an order of view clusters reaches, cluster by cluster (method 8).

use crate::{
    method::{fulfilment::FulfilmentTable, ranking::Reached},
    model::cluster::ViewCluster,
};

/// f_o and matching pairs of the first i clusters of an order; both begin with 0 at i = 0.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Curve {
    pub fulfilment: Vec<f64>,
    pub pairs: Vec<usize>,
}

impl Curve {
    /// Along `order` (indices into `clusters` and into the table's rows). `support`: m of method 5.2.
    pub fn new(
        table: &FulfilmentTable,
        weights: &[f64],
        support: u32,
        clusters: &[ViewCluster],
        order: &[u32],
    ) -> Self {
        let mut reached = Reached::new(weights, support);
        let mut curve = Self { fulfilment: vec![0.0], pairs: vec![0] };
        let (mut fulfilment, mut pairs) = (0.0, 0);
        for &c in order {
            let cluster = table.of(c as usize);
            fulfilment += reached.gain(cluster);
            reached.take(cluster);
            pairs += clusters[c as usize].partners.len();
            curve.fulfilment.push(fulfilment);
            curve.pairs.push(pairs);
        }
        curve
    }

    /// f_o of the whole order.
    pub fn total(&self) -> f64 {
        self.fulfilment.last().copied().unwrap_or(0.0)
    }

    /// The fewest first clusters that reach a fulfilment; `None` where all together do not.
    pub fn clusters_for(&self, fulfilment: f64) -> Option<usize> {
        let clusters = self.fulfilment.partition_point(|&f| f < fulfilment - ROUNDING);
        (clusters < self.fulfilment.len()).then_some(clusters)
    }

    /// Matching pairs of those clusters.
    pub fn pairs_for(&self, fulfilment: f64) -> Option<usize> {
        self.clusters_for(fulfilment).map(|clusters| self.pairs[clusters])
    }

    /// Share of `total` that the first clusters reach; 0 where nothing can be reached.
    pub fn share(&self, clusters: usize, total: f64) -> f64 {
        let fulfilment = self.fulfilment[clusters.min(self.fulfilment.len() - 1)];
        if total > 0.0 { fulfilment / total } else { 0.0 }
    }
}

/// Sums of the same terms in another order differ by less.
const ROUNDING: f64 = 1e-9;

/// The shares at which curves are read: 10, 20, ... 90 %.
pub const SHARES: [f64; 9] = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9];

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::scene::ViewIndex;

    #[test]
    fn counts_clusters_and_pairs_up_to_a_fulfilment() {
        let table = FulfilmentTable::new([vec![(0, 1.0)], vec![(0, 0.5), (1, 0.5)], vec![(1, 1.0)]]);
        let cluster = |key: u32, partners: u32| ViewCluster {
            key: ViewIndex(key),
            partners: (0..partners).map(|p| ViewIndex(10 + p)).collect(),
        };
        let clusters = [cluster(0, 2), cluster(1, 3), cluster(2, 4)];
        let curve = Curve::new(&table, &[0.5, 0.5], 1, &clusters, &[1, 0, 2]);
        assert_eq!(curve.fulfilment, [0.0, 0.5, 0.75, 1.0]);
        assert_eq!(curve.pairs, [0, 3, 5, 9]);
        assert_eq!(curve.clusters_for(0.5), Some(1));
        assert_eq!(curve.clusters_for(0.51), Some(2));
        assert_eq!(curve.pairs_for(0.76), Some(9));
        assert_eq!(curve.clusters_for(1.01), None);
        assert_eq!(curve.share(1, 1.0), 0.5);
        assert_eq!(curve.share(9, 0.0), 0.0);
    }
}
