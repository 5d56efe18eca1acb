//! The reference matcher of this repository, `integrations/sgm`: semi-global matching along
//! epipolar lines.

mod search;

use std::ffi::{OsStr, OsString};

use nalgebra::Vector3;

use super::{
    Backend, BackendError, Call, Capabilities, ExaminedProject, Export, ExportOptions,
    ExportRecord, Honours, LastRun, PlanningNumbers, Product, Selection, TaskProgram, TaskRunner,
    Tasks, Trap,
    clusters::{task_ids, task_marker},
    error::check_length,
    runner::{finishes_itself, is_not_empty, words},
    semi_global::{self, CONFIDENCE, PHOTOMETRIC},
    workspace::{Workspace, add_workspace},
};
use crate::{
    io::{
        output::{Contents, FileSet},
        pictures::PictureFolders,
        project::ImageFolder,
    },
    model::{
        cluster::{Gate, RankedCluster},
        scene::ViewIndex,
    },
    plan::WorkPerMap,
};

/// It works on a polar grid around the epipole, so an epipole in the image or a large scale ratio
/// matters less than for a matcher that rectifies.
const NUMBERS: PlanningNumbers = PlanningNumbers {
    gate: Gate {
        min_shared_points: 8,
        min_angle_deg: 1.0,
        max_angle_deg: 60.0,
        max_scale_octaves: 1.6,
        epipole_inside: true,
    },
    reach: Some(search::reach),
    confidence: CONFIDENCE,
    photometric: PHOTOMETRIC,
    support: 1,
    work: WorkPerMap {
        fixed: 0.13,
        per_map: 0.5,
    },
    measured: "valley, 2 more",
    caution: None,
    source: "measured with integrations/sgm/measure.py on valley against exact depth, on boruszyn and lewis against the \
             maps of 22 partners; support 1: a depth map is checked against its own pairs; work: seconds of maps of full and half size of six \
             sets (benches/sizes.py --matcher sgm)",
};

/// Scripts of the matcher, exported next to its lists.
const MATCHER: [(&str, &str); 7] = [
    ("sgm.py", include_str!("../../../integrations/sgm/sgm.py")),
    ("fuse.py", include_str!("../../../integrations/sgm/fuse.py")),
    (
        "matching.py",
        include_str!("../../../integrations/sgm/matching.py"),
    ),
    (
        "merge.py",
        include_str!("../../../integrations/sgm/merge.py"),
    ),
    (
        "pairs.py",
        include_str!("../../../integrations/sgm/pairs.py"),
    ),
    (
        "rectify.py",
        include_str!("../../../integrations/sgm/rectify.py"),
    ),
    (
        "workspace.py",
        include_str!("../../../integrations/sgm/workspace.py"),
    ),
];

pub static BACKEND: Backend = Backend {
    name: "sgm",
    program: "sgm",
    last_run: LastRun::At {
        date: "2026-11-28",
        version: "this repository's",
        what: "maps and fusion",
    },
    capabilities: Capabilities {
        partners: Honours::Yes,
        key_subset: Honours::Yes,
        order: Honours::Yes,
        fusion: "sgm.py fuse joins the key views' maps; each is checked against its own pairs alone",
        notes: "pairs that it refuses are named in its report.json, with the reason",
    },
    planning: NUMBERS,
    unread: &["webp", "bmp", "ppm", "pgm", "jp2"],
    takes_masks: true,
    mixes_sizes: true,
    tasks: Some(Tasks {
        program: TaskProgram {
            name: "sgm.py",
            variable: "SGM",
        },
        runner: tasks,
    }),
    traps,
    export,
    ..Backend::DEFAULT
};

fn traps(examined: &ExaminedProject) -> Vec<Trap> {
    let bad = examined.bad_names("sgm-name", check_name);
    bad.into_iter().collect()
}

/// Longest end that is put behind the name of an image: `rows/NAME.json`.
const LONGEST_END: &str = ".json";

fn check_name(name: &str) -> Result<(), BackendError> {
    check_length(BACKEND.name, name, LONGEST_END)?;
    semi_global::checked_name(BACKEND.name, name).map(|_| ())
}

fn tasks(selection: &Selection, _: &Export) -> TaskRunner {
    let out = selection.project.home.join(RESULTS);
    let map = |c: &RankedCluster| {
        Some(out.join(format!("depth_maps/{}.npy", selection.scene.name(c.key))))
    };
    TaskRunner {
        python: Some(
            "name a Python with numpy and opencv in PYTHON: python3 -m venv V && V/bin/pip install numpy \
             opencv-python-headless",
        ),
        commands,
        is_whole: is_not_empty,
        finish: finishes_itself,
        lists: &[],
        own: "",
        clouds: vec![out.join("fused.ply")],
        sizes_share_a_file: true,
        maps: selection.clusters.iter().map(map).collect(),
    }
}

fn commands(call: &Call) -> Result<Vec<Vec<OsString>>, String> {
    let out = call.project.join(RESULTS);
    let command = |what: &str, options: &[&dyn AsRef<OsStr>]| {
        let mut command = words([
            &call.python,
            &call.program,
            &what,
            &call.workplace,
            &"--clusters",
            &call.workplace.join("clusters.txt"),
            &"--out",
            &out,
            &"--image-scale",
            &call.image_scale.to_string(),
        ]);
        command.extend(options.iter().map(|option| option.as_ref().to_owned()));
        command
    };
    Ok(match call.product {
        Product::Map(rank) => {
            let (cache, rank) = (out.join("pairs"), rank.to_string());
            vec![command("match", &[&"--cache", &cache, &"--rank", &rank])]
        }
        Product::Cloud => vec![
            // A run of no clusters joins the rows of single ranks into one `report.json`.
            command("match", &[&"--stop-at", &"0"]),
            command("fuse", &[]),
        ],
    })
}

fn export(selection: &Selection, options: &ExportOptions) -> Result<Export, BackendError> {
    let images = selection.undistorted_images(BACKEND.name)?;
    for view in selection.views() {
        check_name(selection.scene.name(view))?;
    }
    let mut record = ExportRecord::new(&BACKEND, selection, |v| selection.scene.name(v).into());
    record.made_for = "integrations/sgm".into();
    record.way = "COLMAP workspace, pair files".into();
    let scale = selection.image_scale;
    let mut files = options.file_set(&BACKEND, selection);
    let results = results(selection, &files);
    let out = results.as_deref().unwrap_or("depth_maps");
    let command = |what| {
        format!("python3 sgm.py {what} . --clusters clusters.txt --out {out} --image-scale {scale}")
    };
    record.commands = vec![command("match"), command("fuse")];
    record.fusion =
        "a point per cell of one ground sampling distance, the mean of the depths in it".into();
    for (name, text) in MATCHER {
        files.add_script(name, text);
    }
    for (name, text) in semi_global::pair_files(BACKEND.name, selection)? {
        files.add_text(name, text);
    }
    if let Some(results) = results {
        files.add_text(MARKS, marks(selection, &results));
    }
    add_model(selection, &mut files)?;
    add_pictures(selection, images, &mut files);
    Ok(Export::new(files, record))
}

/// List of the marks that `sgm.py` writes, for `viewrank run` to go on from its maps.
const MARKS: &str = "marks.tsv";
/// Folder of the results in the project.
const RESULTS: &str = "sgm";

/// Returns the path from the export to the results of `viewrank run`; `None` for an export
/// elsewhere, which that does not look at.
fn results(selection: &Selection, files: &FileSet) -> Option<String> {
    let export = files.root.strip_prefix(&selection.project.home).ok()?;
    Some("../".repeat(export.components().count()) + RESULTS)
}

/// Returns a line per map: mark TAB its content TAB size of the images over the model's TAB path.
fn marks(selection: &Selection, results: &str) -> String {
    let scale = selection.image_scale;
    let line = |cluster: &RankedCluster| {
        let key = selection.scene.name(cluster.key);
        let ([id, _], mark) = (task_ids(&BACKEND, selection, cluster), task_marker(key));
        format!("{mark}\t{id}\t{scale}\t{results}/depth_maps/{key}.npy\n")
    };
    selection.clusters.iter().map(line).collect()
}

/// Adds the model as it was planned: completed, without distortion, and with plain names.
fn add_model(selection: &Selection, files: &mut FileSet) -> Result<(), BackendError> {
    let all: Vec<ViewIndex> = selection.scene.view_indices().collect();
    let workspace = Workspace {
        // All, since the spacing of the cloud is the median of their ground sampling distances.
        views: &all,
        tests: &[],
        least_views: 1,
        model: "sparse",
        images: None,
    };
    add_workspace(BACKEND.name, files, selection, workspace, Vector3::zeros())
}

/// Adds links to the images of the clusters and to their masks.
fn add_pictures(selection: &Selection, images: &ImageFolder, files: &mut FileSet) {
    let pictures = PictureFolders::new(selection.project);
    for view in selection.views() {
        let name = selection.scene.name(view);
        files.add(format!("images/{name}"), images.link(name));
        if let Some(mask) = pictures.mask_file(name) {
            // Masks may be in a folder of their own outside of the project.
            let folder = mask.parent().unwrap_or(&mask).to_path_buf();
            let link = Contents::Link { file: mask, folder };
            files.add(format!("masks/{name}.png"), link);
        }
    }
}
