//! Prints the key views of a project, best first: `cargo run --example quickstart`.

use viewrank::{Project, Settings, Unwatched};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let project = Project::open("fixtures/valley".as_ref(), None)?;
    let plan = viewrank::plan(&project, &Settings::default(), &Unwatched)?;
    plan.chosen().for_each(|cluster| println!("{}", plan.stages.scene.name(cluster.key)));
    Ok(())
}
