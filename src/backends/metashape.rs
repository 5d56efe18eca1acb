//! Metashape, from the vendor's Python reference of 2.x; not run. A script that finds cameras by
//! label and makes depth maps of the key views, with key views and partners enabled: that disabled
//! cameras are never partners is an assumption.

use serde_json::json;

use super::{
    Backend, BackendError, Capabilities, ExaminedProject, Export, ExportOptions, ExportRecord,
    Honours, LastRun, PlanningNumbers, Selection, Trap, images::ANY_PROGRAM,
};
use crate::base::printable::to_json;

pub static BACKEND: Backend = Backend {
    name: "metashape",
    aliases: &["photoscan", "agisoft"],
    program: "Metashape",
    last_run: LastRun::Never("documentation"),
    capabilities: Capabilities {
        partners: Honours::No,
        key_subset: Honours::Yes,
        order: Honours::No,
        fusion: "buildPointCloud",
        notes: "partners are Metashape's own choice among the enabled cameras: key views and chosen partners",
    },
    planning: PlanningNumbers {
        support: 2,
        ..ANY_PROGRAM
    },
    takes_distorted: true,
    traps,
    export,
    reads_raw: true,
    ..Backend::DEFAULT
};

/// Finds equal file names: they are the labels by which the script finds cameras.
fn traps(examined: &ExaminedProject) -> Vec<Trap> {
    let label = |name: &str| name.rsplit('/').next().unwrap_or(name).to_owned();
    examined
        .same_names(
            "metashape-duplicate-labels",
            "the same camera label in Metashape",
            label,
        )
        .into_iter()
        .collect()
}

fn export(selection: &Selection, options: &ExportOptions) -> Result<Export, BackendError> {
    let downscale = 1.0 / selection.halved();
    let names = |views: &mut dyn Iterator<Item = crate::model::scene::ViewIndex>| {
        views
            .map(|v| selection.scene.name(v).to_owned())
            .collect::<Vec<_>>()
    };
    let list = json!({
        "keys": names(&mut selection.clusters.iter().map(|c| c.key)),
        "enabled": names(&mut selection.views().into_iter()),
        "max_neighbors": selection.most_partners(),
        "downscale": downscale,
    });
    let mut files = options.file_set(&BACKEND, selection);
    files.add_text("clusters.json", to_json(&list));
    files.add_script(
        "depth_maps.py",
        include_str!("../../integrations/metashape/depth_maps.py"),
    );
    let mut record = ExportRecord::new(&BACKEND, selection, |v| selection.scene.name(v).into());
    record.made_for = "Metashape 1.6 to 2.x (from its reference; not run)".into();
    record.way = "script, cameras by label".into();
    record.commands =
        vec!["metashape.sh -r depth_maps.py \"${PSX:?the Metashape project, a .psx file}\"".into()];
    record.not_honoured.extend([
        "matching partners (only how many)".into(),
        "the rank order".into(),
    ]);
    record.note_scale(selection, |_| 1.0 / downscale);
    record.fusion = "buildPointCloud (buildDenseCloud before 2.0)".into();
    Ok(Export::new(files, record))
}
