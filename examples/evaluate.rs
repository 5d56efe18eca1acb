//! Compares a plan with finished depth maps, here those of the CPU matcher in integrations/sgm.
//!
//!     cargo run --example plan -- valley
//!     python3 -m venv venv && venv/bin/pip install -r integrations/sgm/requirements.txt
//!     venv/bin/python integrations/sgm/sgm.py match valley --out valley/sgm
//!     cargo run --example evaluate -- valley valley/sgm

use std::{env, error::Error, path::PathBuf};

use viewrank::{
    NoWatcher,
    evaluate::{
        Evaluation, EvaluationInput, EvaluationOptions, MeasuredClusters, MeasuredProgress,
        MeasuredSurface,
    },
    replan,
};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<PathBuf> = env::args_os().skip(1).map(PathBuf::from).collect();
    let [project, depth_maps] = &arguments[..] else {
        return Err("usage: evaluate PROJECT DEPTH_MAPS".into());
    };

    // The manifest has no tables, so they are computed again with its settings.
    let (_, plan, _) = replan::as_written(project, &NoWatcher)?;
    let clusters: Vec<_> = plan.chosen().cloned().collect();

    // Without reference depth maps, every depth counts as correct.
    let input = EvaluationInput::new(&plan.stages, &clusters, depth_maps, None);
    let measured = MeasuredClusters::new(&input, &NoWatcher)?;

    let so_far = MeasuredProgress::new(&plan.stages, &measured);
    let options = EvaluationOptions {
        objective: &plan.stages.objective,
        so_far,
        clouds: None,
        half: None,
        baselines: false,
    };
    let model = plan.stages.model();
    let surface = MeasuredSurface::new(&model, &measured);
    let evaluation = Evaluation::new(&model, &measured, &surface, &options, &NoWatcher)?;
    let kept = evaluation.kept;
    println!(
        "fulfilment kept by fusion: {:.1} %, forecast {:.1} %",
        100.0 * kept.real,
        100.0 * kept.predicted
    );
    println!(
        "completeness {:.3}, {} clusters without a depth map",
        evaluation.quality.completeness,
        evaluation.without_map.len()
    );
    Ok(())
}
