//! Evaluates the clusters of a plan in memory.

use std::path::Path;

use super::{
    Evaluation, EvaluationOptions, MeasuredClusters, MeasuredProgress, MeasuredSurface, cells,
    orders,
    run::{EvaluateError, EvaluationInput},
};
use crate::{base::progress::Watcher, plan::Plan};

impl Evaluation {
    /// Measures the depth maps in `depth_maps` that were made for the plan, against those in
    /// `reference` or, without a reference, as if every depth were right. `baselines`: also
    /// compares the order with others.
    pub fn of_plan(
        plan: &Plan,
        depth_maps: &Path,
        reference: Option<&Path>,
        baselines: bool,
        watcher: &dyn Watcher,
    ) -> Result<Self, EvaluateError> {
        let stages = &plan.stages;
        let model = stages.model();
        let clusters: Vec<_> = orders::of_plan(plan).cloned().collect();
        let measured = MeasuredClusters::new(
            &EvaluationInput::new(stages, &clusters, depth_maps, reference),
            watcher,
        )?;
        let surface = MeasuredSurface::new(&model, &measured);
        let so_far = MeasuredProgress::new(stages, &measured);
        let cells = cells::incidence(stages, &measured, depth_maps, None, watcher)?;
        let options = EvaluationOptions {
            all_maps: plan.decision.forecast.all_maps,
            objective: &stages.objective,
            pilot: stages.pilot.as_ref(),
            cells,
            so_far,
            clouds: None,
            half: None,
            baselines,
        };
        Ok(Self::new(&model, &measured, &surface, &options, watcher)?)
    }
}
