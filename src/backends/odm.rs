//! ODX, the engine of WebODM since 2026, and OpenDroneMap's ODM, from which it comes:
//! `docs/backends.md` 11. Read, not run. They keep an existing `openmvs/scene.mvs`; in ours each
//! key view shares points with its partners only, and every other image is too poorly connected to
//! be computed.

use std::path::{Path, PathBuf};

use super::{
    Backend, BackendError, Capabilities, ExaminedProject, Export, ExportOptions, ExportRecord,
    Honours, LastRun, Selection, Trap, openmvs, selection,
    strangers::{name_links_in_scripts, with_refusal},
};
use crate::{
    base::shell::{command_path, sh_word},
    io::{output::Contents, project::ModelFormat},
    model::camera::Camera,
};

/// Variable that the commands need; unset, they fail and name it. `run.sh` sets it to its argument.
const PROJECT: &str = "${PROJECT:?folder of the engine's project, whole path}";
/// Image of the engine: ODX unless the variable names another, such as `opendronemap/odm`.
const ENGINE: &str = "${ENGINE:-webodm/odx}";
const RUNNER_HEAD: &str = include_str!("../../integrations/odm/run_head.sh");

pub static BACKEND: Backend = Backend {
    name: "odm",
    aliases: &["odx", "webodm", "opendronemap"],
    program: "ODX, ODM",
    last_run: LastRun::Never("ODM read at 32cfaac, ODX in part at d947e6b"),
    capabilities: Capabilities {
        partners: Honours::Partly,
        key_subset: Honours::Yes,
        order: Honours::No,
        fusion: "OpenMVS, as ODX and ODM call it",
        notes: "two key views that are partners of each other share them; more than 5 partners (8 with CUDA) are cut; a partner of several key \
                views is loaded for each of them",
    },
    planning: openmvs::PLANNING,
    own_scale,
    traps,
    export,
    ..Backend::DEFAULT
};

/// `get_depthmap_resolution` and `stages/openmvs.py` with the default `--pc-quality medium`: an
/// eighth, more of small images and less of large ones, by OpenMVS's resolution levels.
fn own_scale(camera: &Camera) -> f64 {
    let side = camera.width.max(camera.height);
    let megapixels = f64::from(camera.width) * f64::from(camera.height) / 1e6;
    let more = if megapixels < 6.0 {
        2.0
    } else if megapixels > 42.0 {
        0.5
    } else {
        1.0
    };
    let wanted = (f64::from(side) * 0.125 * more).floor().max(320.0);
    let level = (f64::from(side) / wanted).log2().round().max(0.0) as u32;
    openmvs::scale_at(camera, level, [640, side])
}

fn traps(examined: &ExaminedProject) -> Vec<Trap> {
    let root = &examined.project.root;
    let [inside, below] =
        ["openmvs", "opensfm/undistorted/openmvs"].map(|folder| root.join(folder));
    let folder = if inside.is_dir() { inside } else { below };
    let [dense, scene] =
        ["scene_dense_dense_filtered.ply", "scene.mvs"].map(|file| folder.join(file));
    let there = |name, path: &Path, what: &str, cure: &str| {
        path.is_file().then(|| Trap {
            name,
            what: format!("{} is there, {what}", path.display()),
            cure: format!("{cure} {}", command_path(path)),
            views: Vec::new(),
        })
    };
    let skipped = there(
        "odm-existing-model-skips-stage",
        &dense,
        "so that ODX and ODM skip the dense stage",
        "rm",
    );
    let kept = there(
        "odm-existing-scene",
        &scene,
        "and ODX and ODM take it unless ours replaces it",
        "put our scene.mvs over",
    );
    // A stage that is skipped reads no scene.
    skipped.or(kept).into_iter().collect()
}

/// The engine's project of a folder that viewrank plans: the folder itself, or that of which it is
/// `opensfm/undistorted`.
fn project_of(root: &Path) -> Option<PathBuf> {
    let root = std::path::absolute(root).ok()?;
    if root.ends_with("opensfm/undistorted") {
        return root.ancestors().nth(2).map(Path::to_path_buf);
    }
    root.join("opensfm").is_dir().then_some(root)
}

/// Commands of `run.sh` in the engine's project.
fn steps() -> [String; 3] {
    [
        format!("tried rm -rf \"{PROJECT}/opensfm/undistorted/openmvs\""),
        // The files and not the links, which may lead to where the container sees nothing.
        format!("tried cp -rL openmvs \"{PROJECT}/opensfm/undistorted/\""),
        format!(
            "docker run --rm -v \"$(dirname \"{PROJECT}\")\":/datasets \"{ENGINE}\" --project-path /datasets \"$(basename \"{PROJECT}\")\""
        ),
    ]
}

fn export(selection: &Selection, options: &ExportOptions) -> Result<Export, BackendError> {
    openmvs::check_names(BACKEND.name, selection)?;
    let images = selection.undistorted_images(BACKEND.name)?;
    let mut files = options.file_set(&BACKEND, selection);
    // ODM calls OpenMVS in the working folder openmvs/depthmaps, whose absolute path depends on the
    // container.
    let of_kind = |name: &str| selection::name_of_kind(selection.project, name);
    let mvs = openmvs::joint_scene(selection, |name| format!("../images/{}", of_kind(name)));
    files.add("openmvs/scene.mvs", Contents::Bytes(mvs.write()));
    for view in selection.views() {
        let name = selection.scene.name(view);
        files.add(
            format!("openmvs/images/{}", of_kind(name)),
            images.link(name),
        );
    }
    let mut record = ExportRecord::new(&BACKEND, selection, |v| {
        format!("depth{:04}.dmap", selection.scene.view(v).image_id)
    });
    record.made_for = "ODX (WebODM/ODX d947e6b of 2026) and ODM (32cfaac); read, not run".into();
    record.way =
        "openmvs/scene.mvs in place of the engine's own; ENGINE=opendronemap/odm runs ODM, not ODX"
            .into();
    let script = format!("{RUNNER_HEAD}{}\n", steps().join("\n"));
    let project = project_of(&selection.project.root).map_or_else(
        || format!("\"{PROJECT}\""),
        |path| sh_word(&path.display().to_string()),
    );
    record.commands = vec![format!("./run.sh {project}")];
    files.add_script("run.sh", with_refusal(&script));
    name_links_in_scripts(&mut files);
    record.not_honoured.extend([
        "the rank order".into(),
        "partners beyond the fifth (CUDA: eighth)".into(),
    ]);
    record.note_own_scale(selection);
    record.warnings.extend([
        "ODX and ODM must be run the second time without any --rerun, which would delete the scene".into(),
        "opensfm/undistorted/openmvs must hold nothing older: with a scene_dense_dense_filtered.ply the stage is skipped, and old depth \
         maps are kept"
            .into(),
    ]);
    record.warnings.extend(of_other_coordinates(selection));
    record.pixel_shift = -0.5;
    record.fusion = "options of ODX and ODM: number-views-fuse 2".into();
    Ok(Export::new(files, record))
}

/// Warns of coordinates that are not the engine's, or that its files would round.
fn of_other_coordinates(selection: &Selection) -> Vec<String> {
    let mut warnings = Vec::new();
    if selection.project.model.format != ModelFormat::OpenSfm {
        warnings.push(
            "ODX and ODM take the points as they are: the model must be in the coordinates of their own reconstruction, as that in \
             opensfm/undistorted of their project is"
                .into(),
        );
    }
    let ruined = |rounding| {
        format!(
            "{rounding}: the cloud would be ruined, and the engine's own coordinates are smaller"
        )
    };
    warnings.extend(selection::rounding(selection.scene).map(ruined));
    warnings
}
