//! The single definition of the share reached, with its denominator (method 8).

use serde::Serialize;

use super::run::MeasuredClusters;
use crate::{
    method::ranking::{Beliefs, Reached},
    plan::Stages,
};

/// Measured weight that fusion keeps of the finished depth maps, over the weight that it is expected to keep of all.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct MeasuredProgress {
    /// Weight that fusion keeps of the finished maps, 0 to 1.
    pub kept: f64,
    /// Weight that fusion keeps of all clusters of the plan, 0 to 1: measured if finished, else predicted in the light of failures (method 5.4).
    pub reachable: f64,
    /// `kept` over `reachable`; null where nothing can be kept.
    pub share: Option<f64>,
}

impl MeasuredProgress {
    /// Computes the progress. `stages`: those of the plan that the run's clusters belong to.
    pub fn new(stages: &Stages, run: &MeasuredClusters) -> Self {
        let mut beliefs = Beliefs::new(&stages.scene, &stages.surface, &stages.clusters, &stages.fulfilment);
        let finished = run.clusters.iter().zip(&run.attempts);
        finished.for_each(|(cluster, attempts)| beliefs.learn(cluster.key, attempts));
        let mut reached = Reached::new(&stages.objective);
        (0..run.clusters.len()).for_each(|c| reached.take(run.real.row(c)));
        let kept = reached.kept_weight();
        for (c, cluster) in stages.clusters.iter().enumerate() {
            if run.clusters.binary_search_by_key(&cluster.key, |finished| finished.key).is_err() {
                let (triangles, believed) = beliefs.row(c);
                reached.take((triangles, &believed));
            }
        }
        let reachable = reached.kept_weight();
        Self { kept, reachable, share: (reachable > 0.0).then(|| kept / reachable) }
    }
}
