//! Plans a project and writes the plan into it: `cargo run --example plan -- fixtures/valley` (adds fixtures/valley/viewrank).

use std::{env, error::Error, path::PathBuf};

use viewrank::{Project, Settings, Unwatched, files, output};

fn main() -> Result<(), Box<dyn Error>> {
    let folder: PathBuf = env::args_os().nth(1).ok_or("usage: plan PROJECT")?.into();

    // `None` chooses the sub-model with the most registered images.
    let project = Project::open(&folder, None)?;

    // The default settings suit most projects; `Unwatched` neither reports progress nor cancels.
    let plan = viewrank::plan(&project, &Settings::default(), &Unwatched)?;

    // Best first: whoever runs out of time has matched the most useful clusters.
    let scene = &plan.stages.scene;
    for cluster in plan.chosen() {
        let partners: Vec<&str> = cluster.partners.iter().map(|&view| scene.name(view)).collect();
        println!("{}: {}", scene.name(cluster.key), partners.join(" "));
    }

    // All files appear together or not at all.
    let files = files::files(&plan, &project)?;
    output::write_all(&files.sets, &output::Disk::REAL)?;
    if let Some(command) = files.command {
        println!("run the backend with: {command}");
    }
    Ok(())
}
