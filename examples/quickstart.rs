//! Prints the key views of a project, best first: `cargo run --example quickstart`.

use viewrank::{NoWatcher, Project, Settings};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let project = Project::open("fixtures/valley".as_ref(), None)?;
    let plan = viewrank::plan(&project, &Settings::default(), &NoWatcher)?;
    plan.chosen()
        .for_each(|cluster| println!("{}", plan.stages.scene.name(cluster.key)));
    Ok(())
}
