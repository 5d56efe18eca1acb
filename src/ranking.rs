//! Method 5: in which order the view clusters are computed.

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
}
