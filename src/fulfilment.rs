//! Method 3: how well a triangle meets the wanted completeness, resolution and accuracy.

/// f(t, cluster) of every cluster, CSR by cluster, triangles ascending, only f > 0.
#[derive(Clone, Debug, Default)]
pub struct FulfilmentTable {
    /// Clusters + 1 entries.
    pub offsets: Vec<usize>,
    pub triangles: Vec<u32>,
    /// In (0, 1].
    pub values: Vec<f32>,
}

impl FulfilmentTable {
    pub fn clusters(&self) -> usize {
        self.offsets.len().saturating_sub(1)
    }

    /// Triangles of a cluster and their fulfilment.
    pub fn of(&self, cluster: usize) -> (&[u32], &[f32]) {
        let rows = self.offsets[cluster]..self.offsets[cluster + 1];
        (&self.triangles[rows.clone()], &self.values[rows])
    }
}
