//! Compares a plan with its depth maps: `cargo run --example evaluate -- fixtures/valley DEPTH_MAPS` (after `--example plan`).

use std::{env, error::Error, path::PathBuf};

use viewrank::{
    Unwatched,
    evaluate::{Evaluation, EvaluationInput, EvaluationOptions, MeasuredClusters, MeasuredSurface},
    replan,
};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<PathBuf> = env::args_os().skip(1).map(PathBuf::from).collect();
    let [project, depth_maps] = &arguments[..] else { return Err("usage: evaluate PROJECT DEPTH_MAPS".into()) };

    // The manifest holds no tables; they are computed again with its settings.
    let (_, plan) = replan::as_written(project, &Unwatched)?;
    let (model, settings) = (plan.stages.model(), &plan.stages.settings);
    let clusters: Vec<_> = plan.chosen().cloned().collect();

    // Without reference depths, every depth on the surface counts as right.
    let accuracy = model.target.accuracy_over_gsd * settings.target.gsd.ok_or("the plan has no GSD")?;
    let task = EvaluationInput { model, clusters: &clusters, depth_maps, reference: None, accuracy };
    let run = MeasuredClusters::new(&task, &Unwatched)?;

    let measure = EvaluationOptions { objective: &plan.stages.objective, baselines: false };
    let model = plan.stages.model();
    let reached = MeasuredSurface::new(&model, &run);
    let evaluation = Evaluation::new(&model, &run, &reached, &measure, &Unwatched)?;
    let kept = evaluation.kept;
    println!("of what is wanted, fusion keeps {:.1} %; forecast: {:.1} %", 100.0 * kept.real, 100.0 * kept.predicted);
    println!(
        "completeness {:.3}, {} clusters without a depth map",
        evaluation.quality.completeness,
        evaluation.without_map.len()
    );
    Ok(())
}
