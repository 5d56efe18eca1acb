//! The baseline of matching every key view at half the size.

use std::path::Path;

use serde::Serialize;

use super::{
    curve::ReachCurve,
    run::{EvaluateError, EvaluationInput, MeasuredClusters},
};
use crate::{
    base::progress::Watcher,
    method::ranking::Objective,
    model::cluster::{MapScale, ViewCluster},
    plan::Stages,
};

/// Depth maps of the same clusters at half the size, against those at full size.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct HalfSize {
    /// Number of depth maps at half the size.
    pub maps: usize,
    /// Weight that fusion keeps of them, over that of all depth maps at full size.
    pub share: f64,
    /// Smallest number of first depth maps at full size that gives as much; null if all give less.
    pub same_as: Option<usize>,
    /// Pixels to match, over those of all depth maps at full size.
    pub work: f64,
}

/// Pixels of a depth map at half the size, over those at full size.
const OF_FULL: f64 = 0.25;

impl HalfSize {
    /// `full`: the measured curve of the depth maps at full size.
    pub fn new(half: &MeasuredClusters, full: &ReachCurve, objective: &Objective) -> Self {
        let curve = half.real_curve(objective, &half.order);
        let pairs = |curve: &ReachCurve| curve.pairs.last().copied().unwrap_or(0) as f64;
        Self {
            maps: half.clusters.len(),
            share: curve.share(half.clusters.len(), full.total_kept()),
            same_as: full.clusters_for(curve.total_kept()),
            work: OF_FULL * pairs(&curve) / pairs(full).max(1.0),
        }
    }

    /// A sentence.
    pub fn in_words(&self) -> String {
        let Self {
            maps, share, work, ..
        } = *self;
        let as_much = match self.same_as {
            Some(1) => "the first depth map at full size gives as much".into(),
            Some(same) => format!("the first {same} at full size give as much"),
            None => "more than those at full size".into(),
        };
        format!(
            "At half the size, {maps} depth maps give {:.0} % of that for about {:.0} % of the work: {as_much}.",
            100.0 * share,
            100.0 * work
        )
    }
}

impl MeasuredClusters {
    /// Measures depth maps that were matched at half the size of the plan's.
    ///
    /// # Errors
    /// As [`Self::new`], and if any of the maps is nearer to full size.
    pub fn at_half_size(
        stages: &Stages,
        clusters: &[ViewCluster],
        depth_maps: &Path,
        reference: Option<&Path>,
        watcher: &dyn Watcher,
    ) -> Result<Self, EvaluateError> {
        let half_worth = Some(stages.settings.ranking.half_worth);
        let input = EvaluationInput {
            half_worth,
            ..EvaluationInput::new(stages, clusters, depth_maps, reference)
        };
        let measured = Self::new(&input, watcher)?;
        match measured
            .scales
            .iter()
            .filter(|&&scale| scale != MapScale::Half)
            .count()
        {
            0 => Ok(measured),
            of => Err(EvaluateError::NotHalf {
                path: depth_maps.into(),
                of,
                maps: measured.clusters.len(),
            }),
        }
    }
}
