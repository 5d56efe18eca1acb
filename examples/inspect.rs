//! Prints the ranking of a plan (from `--example plan` or `viewrank plan`).
//!
//!     cargo run --example inspect -- valley

use std::{env, error::Error, path::PathBuf};

use viewrank::manifest::WrittenPlan;

fn main() -> Result<(), Box<dyn Error>> {
    let folder: PathBuf = env::args_os()
        .nth(1)
        .ok_or("usage: inspect PROJECT")?
        .into();

    // Fails if the model or the images have changed since planning.
    let plan = WrittenPlan::read(&folder)?;
    println!(
        "planned for {}: {} of {} view clusters chosen",
        plan.backend,
        plan.cut,
        plan.clusters.len()
    );

    // The manifest has the whole ranking, so another cut needs no new plan.
    for (i, cluster) in plan.clusters.iter().enumerate() {
        let mark = if i < plan.cut { ' ' } else { '-' };
        let name = plan.scene.name(cluster.key);
        println!(
            "{mark}{:4}  {:5.1} %  {name} with {} partners",
            i + 1,
            100.0 * cluster.share,
            cluster.partners.len()
        );
    }
    Ok(())
}
