//! OpenMVS's DensifyPointCloud, v2.0 to v2.4 and branch develop: `docs/backends.md` 2.
//!
//! It reads no list of key views, and a list of neighbours sets the search range to 0.1 to 100
//! units regardless of the scene. So each cluster becomes a scene of its own, in which only the key
//! view can be computed and the depth range comes from its sparse points. The scenes share a folder
//! and the ids of the images, which name the depth maps; a final run fuses these in a scene of the
//! key views. [`run`] does all that and checks each map, since DensifyPointCloud exits with 0 even
//! on failure; `run.py` is what remains of it where there is no viewrank.

use std::{collections::BTreeMap, fs, path::Path};

use self::{
    run::{Row, Run},
    scene::Builder,
};
use super::{
    Backend, BackendError, Capabilities, ExaminedProject, Export, ExportOptions, ExportRecord,
    Honours, LastRun, PlanningNumbers, Selection, TaskProgram, TaskRunner, Tasks, Trap,
    clusters::task_ids, record::capped_scale, selection, strangers::name_links_in_scripts,
};
use crate::{
    base::{printable::to_json, shell::command_path},
    io::{
        depthmaps::openmvs::WholeMap,
        formats::openmvs::Mvs,
        output::Contents,
        project::{ModelFormat, ProjectKind},
    },
    method::confidence::{PairConfidence, Photometric},
    model::{
        camera::Camera,
        cluster::{Gate, RankedCluster},
        scene::ViewIndex,
    },
    plan::WorkPerMap,
};

mod fusion;
mod neighbours;
mod run;
mod scene;

/// Depth maps that must agree on a point of the fused cloud.
const MAPS_PER_POINT: usize = 2;

/// Confidence of a PatchMatch pair (method 7.2), measured as [`PlanningNumbers::source`] says.
pub(super) const CONFIDENCE: PairConfidence = PairConfidence {
    min_matches: 1,
    p0: 0.6,
    cosine_power: 0.0,
    scale_octaves: None,
    full_angle_deg: Some(8.0),
};

/// By depth maps of seven scenes: it fills nearly everything, so that a depth says
/// little of a match.
const PHOTOMETRIC: Photometric = Photometric {
    agree: 0.55,
    differ: 0.1,
    full_agreement: 0.82,
};

/// Measured with v2.3.0 (CPU) on caliterra: 1.8 s and 1.0 s per partner at 500 x 374, proportional
/// to pixels; 0.15 s to load a scene.
pub(super) const WORK: WorkPerMap = WorkPerMap {
    fixed: 0.03,
    per_map: 1.8,
};

pub(super) const PLANNING: PlanningNumbers = PlanningNumbers {
    reach: None,
    gate: Gate {
        min_shared_points: 4,
        min_angle_deg: 5.0,
        max_angle_deg: 60.0,
        max_scale_octaves: 1.68,
        epipole_inside: true,
    },
    confidence: CONFIDENCE,
    photometric: PHOTOMETRIC,
    support: MAPS_PER_POINT as u32,
    work: WORK,
    measured: "valley, 1 more",
    caution: None,
    source: "success of v2.3.0 (CPU) on valley: below 5 degrees 0.09 to 0.36, from 8 to 60 degrees flat, no harm by scale up to \
             1.2 octaves (method 7.1, 7.2); no cosine of incidence: real maps of valley and boruszyn are then ranked better, and \
             foreseen better on valley (calibration error 0.02, with it 0.09); \
             scale 3.2 is OpenMVS's own limit; at least 3 shared points make a neighbour; its rule \
             that drops neighbours of a low score is switched off in dense.cfg; support 2: the runner fuses with \
             --number-views-fuse 2",
};

pub static BACKEND: Backend = Backend {
    name: "openmvs",
    aliases: &["densifypointcloud"],
    program: "OpenMVS",
    last_run: LastRun::At {
        date: "2026-11-29",
        version: "develop 36f303d of 2024, and v2.3.0 the day before (CPU)",
        what: "maps and fusion; v2.4.0 and develop of 2026 never",
    },
    capabilities: Capabilities {
        partners: Honours::Yes,
        key_subset: Honours::Yes,
        order: Honours::Yes,
        fusion: "of the key views' maps, where at least two agree",
        notes: "one small scene per cluster; the order of partners is OpenMVS's own, all of them are used",
    },
    planning: PLANNING,
    options: &["--scene", "--scale"],
    own_scale,
    mixes_sizes: true,
    serves: |project| project.kind == ProjectKind::OpenMvs,
    tasks: Some(Tasks {
        program: TaskProgram {
            name: "DensifyPointCloud",
            variable: "DENSIFY",
        },
        runner: tasks,
    }),
    traps,
    export,
    unread: &["webp", "jp2"],
    ..Backend::DEFAULT
};

fn tasks(selection: &Selection, export: &Export) -> TaskRunner {
    let map = |c: &RankedCluster| {
        Some(export.files.root.join(format!(
            "depth{:04}.dmap",
            selection.scene.view(c.key).image_id
        )))
    };
    TaskRunner {
        python: None,
        commands: run::commands,
        is_whole: WholeMap::is_there,
        finish: run::finish,
        lists: &[run::RUN],
        own: "",
        clouds: vec![export.files.root.join("fused.ply")],
        sizes_share_a_file: true,
        maps: selection.clusters.iter().map(map).collect(),
    }
}

/// Finds coordinates too large for the f32 points and cameras of a scene.mvs.
fn traps(examined: &ExaminedProject) -> Vec<Trap> {
    let largest = examined
        .scene
        .points
        .iter()
        .flat_map(|p| p.iter().map(|x| x.abs()))
        .fold(0.0, f64::max);
    let step = largest * f64::from(f32::EPSILON);
    let of_openmvs = examined.project.model.format == ModelFormat::OpenMvs;
    let named = examined.bad_names("openmvs-backslash-name", |name| {
        check_name(BACKEND.name, name)
    });
    let rounded = examined
        .scene
        .median_gsd()
        // Points of other models are not rounded yet: the export moves them near the origin.
        .filter(|gsd| of_openmvs && step > *gsd);
    let trap = rounded.map(|gsd| Trap {
    name: "openmvs-far-from-origin",
    what: format!(
        "coordinates up to {largest:.0} in a scene.mvs are rounded to {step:.2} units, and a pixel is {gsd:.3} units: the points \
         are ruined"
    ),
    cure: "move the origin of the model among the points before it is written as scene.mvs".into(),
    views: Vec::new(),
});
    let folder = &examined.project.root;
    let cure = format!("remove them: rm {}/depth*.dmap", command_path(folder));
    let is_map = |name: &str, _: &Path| name.starts_with("depth") && name.ends_with(".dmap");
    let maps = examined.finished_maps("openmvs-existing-dmap-kept", folder, 1, is_map, cure);
    trap.into_iter().chain(named).chain(maps).collect()
}

fn export(selection: &Selection, options: &ExportOptions) -> Result<Export, BackendError> {
    if let Some(scene) = &options.scene {
        return neighbours::export(selection, options, scene);
    }
    check_names(BACKEND.name, selection)?;
    let images = selection.undistorted_images(BACKEND.name)?;
    // Of the plan, not of scenes that were moved.
    let ids = selection.clusters.iter();
    let ids: Vec<[String; 2]> = ids.map(|c| task_ids(&BACKEND, selection, c)).collect();
    let near = selection.near_origin();
    let selection = &near.selection();
    let builder = Builder::new(selection);
    let mut files = options.file_set(&BACKEND, selection);
    let mut rows = Vec::new();
    for ((rank, cluster), ids) in (1..).zip(selection.clusters).zip(ids) {
        let (mvs, range) = builder.cluster(cluster);
        let row = Row::new(selection, &builder, (rank, cluster, ids), &range);
        files.add(row.scene(), Contents::Bytes(mvs.write()));
        rows.push(row);
    }
    let mut pictures = BTreeMap::new();
    for view in selection.views() {
        let (link, path) = (images.link(selection.scene.name(view)), builder.image(view));
        if let Contents::Link { file, .. } = &link
            && let Ok(picture) = fs::metadata(file)
        {
            pictures.insert(path.clone(), picture.len());
        }
        files.add(path, link);
    }
    let (common, overlaps) = common_project(selection);
    files.add("fuse.mvs", Contents::Bytes(builder.images(&common).write()));
    files.add_text("fuse.txt", fusion::neighbours(&overlaps));
    let run = Run::new(selection, rows, overlaps, pictures);
    files.add_text("run.json", to_json(&run));
    files.add_text("dense.cfg", dense_config(selection));
    files.add_text("options.cfg", run::NO_OPTIONS);
    files.add_script(
        "run.py",
        include_str!("../../../integrations/openmvs/run.py"),
    );
    name_links_in_scripts(&mut files);
    let mut record = record_of(selection);
    record.moved(near.origin);
    Ok(Export::new(files, record))
}

/// Refuses names that OpenMVS would resolve to another path; `backend` is the one that runs it.
pub fn check_names(backend: &'static str, selection: &Selection) -> Result<(), BackendError> {
    selection
        .views()
        .into_iter()
        .try_for_each(|view| check_name(backend, selection.scene.name(view)))
}

fn check_name(backend: &'static str, name: &str) -> Result<(), BackendError> {
    if name.contains('\\') {
        let why = "OpenMVS takes a backslash for the end of a folder's name";
        return Err(BackendError::name(backend, name, why));
    }
    Ok(())
}

fn record_of(selection: &Selection) -> ExportRecord {
    let mut record = ExportRecord::new(&BACKEND, selection, |v| {
        format!("depth{:04}.dmap", selection.scene.view(v).image_id)
    });
    record.made_for =
        "OpenMVS v2.0 to v2.4 and develop (run with v2.3.0 and develop 36f303d)".into();
    record.way = "one scene per cluster".into();
    // `-I`: the folder may be a stranger's, and no module in it is imported.
    record.commands = vec!["python3 -I run.py".into()];
    record
        .not_honoured
        .extend(["the order of the partners of a key view (all of them are used)".into()]);
    record.note_scale(selection, capped_scale(resolution(selection)));
    record.pixel_shift = -0.5;
    record.fusion =
        format!("number-views-fuse {MAPS_PER_POINT}: that many key views must agree on a point");
    record
}

/// Returns one scene of all clusters in model coordinates, with the given image paths, for programs
/// that run OpenMVS themselves.
pub(super) fn joint_scene(selection: &Selection, path: impl Fn(&str) -> String) -> Mvs {
    Builder::new(selection).joint(selection, path)
}

/// Returns the images of the fusion (key views in rank order, and a partner if there is only one
/// key view) and their overlaps.
fn common_project(selection: &Selection) -> (Vec<ViewIndex>, Vec<Vec<usize>>) {
    let mut views: Vec<_> = selection.clusters.iter().map(|c| c.key).collect();
    let keys = views.len();
    if let [only] = selection.clusters {
        views.extend(only.partners.first());
    }
    let points = selection.scene.view_points();
    let overlaps = |i: usize| {
        let shared = selection::shared_points(selection.scene, &points, views[i]);
        let mut others: Vec<_> = (0..views.len()).filter(|&o| o != i).collect();
        others.sort_by_key(|&o| std::cmp::Reverse(shared[views[o].index()]));
        // OpenMVS requires a neighbour: a view without overlap is compared with an arbitrary one.
        let overlapping = others
            .iter()
            .filter(|&&o| shared[views[o].index()] > 0)
            .count()
            .max(1);
        others.truncate(overlapping);
        selection::fused_with(i, &others)
    };
    let overlaps = (0..views.len())
        .map(|i| if i < keys { overlaps(i) } else { Vec::new() })
        .collect();
    (views, overlaps)
}

/// Options with which every partner is used regardless of OpenMVS's score, no limit cuts a list,
/// and a fusion by the filter 2 of v2.4 and develop keeps what two maps agree on, as the plan
/// counts: it asks for five pixels otherwise.
fn dense_config(selection: &Selection) -> String {
    // OpenMVS filters neighbours beyond three quarters of the limit by angle and scale.
    let views = (selection.most_partners() * 4)
        .div_ceil(3)
        .max(selection::FUSED_WITH * 4 / 3);
    format!(
        "View Min Score = 0\nView Min Score Ratio = 0\nMax Views = {views}\nMin Pixels Fuse = {MAPS_PER_POINT}\n"
    )
}

/// Resolution level 1, but neither below 640 nor above 2560 pixels: the defaults of
/// DensifyPointCloud.
fn own_scale(camera: &Camera) -> f64 {
    scale_at(camera, 1, OWN_SIZES)
}

/// Least and greatest long side of OpenMVS's images by default, pixels.
const OWN_SIZES: [u32; 2] = [640, 2560];

/// Returns the size of the images at a resolution level, over their own size. Levels stop before an
/// image becomes smaller than the least size.
pub(super) fn scale_at(camera: &Camera, level: u32, [least, greatest]: [u32; 2]) -> f64 {
    let side = camera.width.max(camera.height);
    let halved = (0..=level)
        .rev()
        .map(|level| side >> level)
        .find(|size| *size >= least)
        .unwrap_or(side);
    f64::from(halved.min(greatest)) / f64::from(side)
}

/// Returns the long side of the matched images, pixels.
fn resolution(selection: &Selection) -> u32 {
    (f64::from(selection.long_side()) * selection.image_scale).round() as u32
}
