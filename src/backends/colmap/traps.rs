//! Faults of a project that break COLMAP.

use super::{cfg, marks, widths};
use crate::{
    backends::{ExaminedProject, Trap, selection},
    base::shell::command_path,
    io::project::ModelFormat,
    model::scene::Scene,
};

pub fn all(examined: &ExaminedProject) -> Vec<Trap> {
    let names = examined.bad_names("colmap-name", |name| cfg::check_name("colmap", name));
    let points = examined.without_points(
        "colmap-key-view-without-points",
        "COLMAP ends the whole run there",
    );
    let of_model = [
        names,
        points,
        blanks_in_text(examined),
        text_beside_binary(examined),
        widths::trap(examined),
    ];
    of_model
        .into_iter()
        .chain([far_away(examined), finished_maps(examined)])
        .flatten()
        .collect()
}

/// Finds maps that do not count for the exported plan.
fn finished_maps(examined: &ExaminedProject) -> Option<Trap> {
    let workspace = examined.project.dense_workspace.as_ref()?;
    let cure = "they do not count: viewrank run makes those anew that its plan needs; where they are of the last plan, viewrank plan --finished says so";
    let folder = workspace.join("stereo/depth_maps");
    let known = marks::known(&folder);
    examined.finished_maps(
        "colmap-stale-maps-skipped",
        &folder,
        8,
        |name, map| name.ends_with(".bin") && !known(map),
        cure.into(),
    )
}

/// Finds names with blanks, which text models cut at the first blank.
fn blanks_in_text(examined: &ExaminedProject) -> Option<Trap> {
    let text = examined.project.model.format == ModelFormat::ColmapText;
    let views: Vec<_> = examined
        .scene
        .view_indices()
        .filter(|&v| text && examined.scene.name(v).contains(' '))
        .collect();
    let first = examined.scene.name(*views.first()?);
    let model = examined.project.model.path.display();
    Some(Trap {
        name: "colmap-text-model-blank-name",
        what: format!("COLMAP cuts \"{first}\" at its first blank when it reads this text model"),
        cure: format!(
            "rename the images, or write the model as binary from the program that made it into {model}"
        ),
        views,
    })
}

/// Finds coordinates too large for f32, in existing workspaces only: there the model is COLMAP's
/// own.
fn far_away(examined: &ExaminedProject) -> Option<Trap> {
    let what = examined
        .project
        .dense_workspace
        .as_ref()
        .and_then(|_| rounded(examined.scene))?;
    let cure = "move the model near its origin (colmap model_transformer) before image_undistorter, or export with --out, which does".into();
    Some(Trap {
        name: "colmap-far-from-origin",
        what,
        cure,
        views: Vec::new(),
    })
}

/// Cameras in patch match and fusion are f32, and so are the points of `fused.ply`.
pub fn rounded(scene: &Scene) -> Option<String> {
    selection::rounding(scene).map(|rounding| {
        format!(
            "{rounding}: COLMAP's depth maps and cloud would be ruined; --out DIR writes a workspace near its origin"
        )
    })
}

/// COLMAP prefers the binary of two models in a folder.
fn text_beside_binary(examined: &ExaminedProject) -> Option<Trap> {
    let model = &examined.project.model;
    examined.project.has_other_text_model(examined.scene).then(|| Trap {
        name: "colmap-bin-beats-txt",
        what: format!(
            "{} holds another model as text: COLMAP and viewrank take the binary one, however old it is, OpenMVS the text",
            model.path.display()
        ),
        cure: format!(
            "keep one of the two: (cd {} && rm -f cameras.txt images.txt points3D.txt rigs.txt frames.txt)",
            command_path(&model.path)
        ),
        views: Vec::new(),
    })
}
