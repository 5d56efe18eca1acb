//! Plans a project and writes the plan to PROJECT/viewrank.
//!
//!     cp -r fixtures/valley valley
//!     cargo run --example plan -- valley

use std::{env, error::Error, path::PathBuf};

use viewrank::{NoWatcher, Project, Settings, files, output};

fn main() -> Result<(), Box<dyn Error>> {
    let folder: PathBuf = env::args_os().nth(1).ok_or("usage: plan PROJECT")?.into();

    // Of several sub-models, `None` selects the one with the most registered images.
    let project = Project::open(&folder, None)?;

    // `NoWatcher` neither reports progress nor cancels.
    let plan = viewrank::plan(&project, &Settings::default(), &NoWatcher)?;

    // Best first: if matching stops early, the most useful clusters are done.
    let scene = &plan.stages.scene;
    for cluster in plan.chosen() {
        let partners: Vec<&str> = cluster
            .partners
            .iter()
            .map(|&view| scene.name(view))
            .collect();
        println!("{}: {}", scene.name(cluster.key), partners.join(" "));
    }

    // Writes all files or none.
    let files = files::files(&plan, &project)?;
    output::write_all(&files.sets, &output::Disk::REAL)?;
    if let Some(next) = files.next {
        println!("next: {next}");
    }
    Ok(())
}
