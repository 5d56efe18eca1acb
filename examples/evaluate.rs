//! Compares a plan with finished depth maps, here those of the CPU matcher in integrations/sgm.
//!
//!     cargo run --example plan -- valley
//!     python3 -m venv venv && venv/bin/pip install -r integrations/sgm/requirements.txt
//!     venv/bin/python integrations/sgm/sgm.py match valley --out valley/sgm
//!     cargo run --example evaluate -- valley valley/sgm

use std::{env, error::Error, path::PathBuf};

use viewrank::{
    Unwatched,
    evaluate::{Evaluation, EvaluationInput, EvaluationOptions, MeasuredClusters, MeasuredSurface, SoFar},
    replan,
};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<PathBuf> = env::args_os().skip(1).map(PathBuf::from).collect();
    let [project, depth_maps] = &arguments[..] else { return Err("usage: evaluate PROJECT DEPTH_MAPS".into()) };

    // The manifest has no tables, so they are computed again with its settings.
    let (_, plan) = replan::as_written(project, &Unwatched)?;
    let (model, settings) = (plan.stages.model(), &plan.stages.settings);
    let clusters: Vec<_> = plan.chosen().cloned().collect();

    // Without reference depth maps, every depth counts as correct; `accuracy` is used where a pixel shows no triangle.
    let accuracy = model.target.accuracy_over_gsd * settings.target.gsd.ok_or("the plan has no GSD")?;
    let input = EvaluationInput { model, clusters: &clusters, depth_maps, reference: None, accuracy };
    let measured = MeasuredClusters::new(&input, &Unwatched)?;

    let so_far = SoFar::new(&plan.stages, &measured);
    let options = EvaluationOptions { objective: &plan.stages.objective, so_far, baselines: false, clouds: None };
    let model = plan.stages.model();
    let surface = MeasuredSurface::new(&model, &measured);
    let evaluation = Evaluation::new(&model, &measured, &surface, &options, &Unwatched)?;
    let kept = evaluation.kept;
    println!("fulfilment kept by fusion: {:.1} %, forecast {:.1} %", 100.0 * kept.real, 100.0 * kept.predicted);
    println!(
        "completeness {:.3}, {} clusters without a depth map",
        evaluation.quality.completeness,
        evaluation.without_map.len()
    );
    Ok(())
}
