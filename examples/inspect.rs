//! Inspects the manifest of a planned project: `cargo run --example inspect -- fixtures/valley` (after `--example plan`).

use std::{env, error::Error, path::PathBuf};

use viewrank::manifest::WrittenPlan;

fn main() -> Result<(), Box<dyn Error>> {
    let folder: PathBuf = env::args_os().nth(1).ok_or("usage: inspect PROJECT")?.into();

    // An error if the model or the images have changed since the plan was written.
    let plan = WrittenPlan::read(&folder)?;
    println!("planned for {}: {} of {} view clusters chosen", plan.backend, plan.cut, plan.clusters.len());

    // The manifest holds the whole ranking, so that it can be cut elsewhere without planning again.
    for (i, cluster) in plan.clusters.iter().enumerate() {
        let mark = if i < plan.cut { ' ' } else { '-' };
        let name = plan.scene.name(cluster.key);
        println!("{mark}{:4}  {:5.1} %  {name} with {} partners", i + 1, 100.0 * cluster.share, cluster.partners.len());
    }
    Ok(())
}
