//! Method 5: in which order the view clusters are computed.

use crate::{
    config::TriangleWeight,
    fulfilment::FulfilmentTable,
    progress::{Cancelled, Watcher},
    surface::Surface,
};

/// Greedy order of the clusters.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Ranking {
    /// Cluster indices (into the plan's clusters), best first; only those with a gain above 0.
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

    /// f_o of the first `length` clusters over f_o of all; 0 where nothing can be reached.
    pub fn share(&self, length: usize) -> f64 {
        match length.min(self.fulfilment.len()) {
            0 => 0.0,
            n => self.fulfilment[n - 1] / self.total(),
        }
    }

    /// The fewest clusters that reach that share of what all clusters together reach.
    pub fn length_for_share(&self, share: f64) -> usize {
        let wanted = share * self.total();
        self.fulfilment.partition_point(|&f| f < wanted).saturating_add(1).min(self.fulfilment.len())
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
    raw.into_iter().map(|w| w / sum).collect()
}

/// The greedy order. `support`: m of method 5.2, at least 1.
pub fn rank(
    table: &FulfilmentTable,
    weights: &[f64],
    support: u32,
    watcher: &dyn Watcher,
) -> Result<Ranking, Cancelled> {
    let _ = (table, weights, support, watcher);
    Ok(Ranking::default())
}
