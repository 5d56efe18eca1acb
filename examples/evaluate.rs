//! Compares a plan with finished depth maps, here those of the CPU matcher in integrations/sgm.
//!
//!     cargo run --example plan -- valley
//!     python3 -m venv venv && venv/bin/pip install -r integrations/sgm/requirements.txt
//!     venv/bin/python integrations/sgm/sgm.py match valley --out valley/sgm
//!     cargo run --example evaluate -- valley valley/sgm

use std::{env, error::Error, path::PathBuf};

use viewrank::{NoWatcher, evaluate::Evaluation, replan};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<PathBuf> = env::args_os().skip(1).map(PathBuf::from).collect();
    let [project, depth_maps] = &arguments[..] else {
        return Err("usage: evaluate PROJECT DEPTH_MAPS".into());
    };

    // The manifest has no tables, so they are computed again with its settings.
    let (_, plan, _) = replan::as_written(project, &NoWatcher)?;
    // Without reference depth maps, every depth counts as correct.
    let evaluation = Evaluation::of_plan(&plan, depth_maps, None, false, &NoWatcher)?;
    let ours = &evaluation.cells.all.orders[0];
    for (maps, share) in ours.curve.iter().enumerate() {
        println!(
            "{maps} depth maps: {:.1} % of the cells of their cloud",
            100.0 * share
        );
    }
    println!(
        "completeness {:.3}, {} clusters without a depth map",
        evaluation.quality.completeness,
        evaluation.without_map.len()
    );
    Ok(())
}
