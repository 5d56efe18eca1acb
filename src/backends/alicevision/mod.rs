//! AliceVision and Meshroom (ca8300f, read, not run). AliceVision reads no lists of views or
//! partners: each cluster becomes a scene file in which the key view shares landmarks with its
//! partners only, and the key view is named by its position among the views with pose, by ascending
//! id.
//!
//! Rotations are in column order, the principal point is an offset from the image centre. Pixel
//! centres are taken to be integers, as in OpenMVG; if that is wrong, all is half a pixel off. The
//! filtering takes counts that it finds in its output folder for its own, so it gets an empty one.

mod run;
mod sfm;

use self::{
    run::{RUN, Row, Run},
    sfm::{cluster_file, file_of_keys, image_path},
};
use super::{
    Backend, BackendError, Capabilities, Export, ExportOptions, ExportRecord, Honours, LastRun,
    PATCH_MATCH, Selection, TaskProgram, TaskRunner, Tasks,
    clusters::{map_script, task_ids},
    runner::is_not_empty,
    selection,
    strangers::name_links_in_scripts,
};
use crate::{
    base::printable::to_json,
    io::output::Contents,
    model::{
        cluster::RankedCluster,
        scene::{Scene, ViewPoints},
    },
};

/// Added to COLMAP's pixel coordinates to get those of `formats::alicevision`.
const PIXEL_SHIFT: f64 = -0.5;

pub static BACKEND: Backend = Backend {
    name: "alicevision",
    aliases: &["meshroom"],
    program: "AliceVision",
    last_run: LastRun::Never("read at ca8300f"),
    capabilities: Capabilities {
        partners: Honours::Yes,
        key_subset: Honours::Yes,
        order: Honours::Yes,
        fusion: "depthMapFiltering and meshing",
        notes: "one call per key view, partners by the landmarks of a scene file of its own; their order is that of common landmarks",
    },
    planning: PATCH_MATCH,
    // `--downscale` is 2 by default.
    own_scale: |_| 0.5,
    tasks: Some(Tasks {
        program: TaskProgram {
            name: "aliceVision_depthMapEstimation",
            variable: "ALICEVISION",
        },
        runner: tasks,
    }),
    export,
    ..Backend::DEFAULT
};

fn tasks(selection: &Selection, export: &Export) -> TaskRunner {
    let root = &export.files.root;
    let image_id = |cluster: &RankedCluster| selection.scene.view(cluster.key).image_id;
    let map = |cluster| Some(root.join(run::map_of(image_id(cluster))));
    TaskRunner {
        python: None,
        commands: run::commands,
        // EXR files are renamed when they are complete.
        is_whole: is_not_empty,
        finish: run::finish,
        lists: &[RUN, run::KEYS],
        own: "",
        clouds: vec![root.join("dense.abc")],
        sizes_share_a_file: true,
        maps: selection.clusters.iter().map(map).collect(),
    }
}

fn export(selection: &Selection, options: &ExportOptions) -> Result<Export, BackendError> {
    let clusters = (1..).zip(selection.clusters);
    // Their ids are of the plan, not of a scene that was moved.
    let rows: Vec<Row> = clusters
        .map(|(rank, cluster)| row(selection, rank, cluster))
        .collect();
    let near = selection.near_origin();
    let selection = &near.selection();
    let images = selection.undistorted_images(BACKEND.name)?;
    let scene = selection.scene;
    let mut files = options.file_set(&BACKEND, selection);
    for view in selection.views() {
        files.add(image_path(scene, view), images.link(scene.name(view)));
    }
    files.add(run::MAPS, Contents::Folder);
    let points = scene.view_points();
    let mut record = record_of(selection);
    record.moved(near.origin);
    for (row, cluster) in rows.iter().zip(selection.clusters) {
        files.add_text(&*row.scene, cluster_file(scene, &points, cluster));
        record.commands.push(format!(
            "aliceVision_depthMapEstimation -i {} --imagesFolder images {} -o depthMaps",
            row.scene,
            row.options.join(" ")
        ));
        record
            .warnings
            .extend(dropped_partners(scene, &points, cluster));
    }
    let keys: Vec<_> = selection.clusters.iter().map(|c| c.key).collect();
    files.add_text(run::KEYS, file_of_keys(scene, &keys, &selection.is_key()));
    let filtering = run::FILTERING.join(" ");
    record.commands.extend([
        format!("aliceVision_depthMapFiltering -i keys.sfm --depthMapsFolder depthMaps -o filtered {filtering}"),
        // `-o` is short for two options here.
        "aliceVision_meshing -i keys.sfm --depthMapsFolder filtered --output dense.abc --outputMesh mesh.obj"
            .into(),
    ]);
    record.note_scale(selection, |_| 1.0 / downscale(selection));
    files.add_script("run.sh", script(selection, &rows));
    files.add_text(RUN, to_json(&Run { maps: rows }));
    name_links_in_scripts(&mut files);
    Ok(Export::new(files, record))
}

fn script(selection: &Selection, rows: &[Row]) -> String {
    let maps = rows.iter().zip(selection.clusters).map(|(row, cluster)| {
        let key = selection.scene.name(cluster.key);
        let words = format!("{} {}", row.scene, row.options.join(" "));
        (key, &*row.id, row.map(), words)
    });
    let steps = include_str!("../../../integrations/alicevision/run_steps.sh");
    map_script(steps, maps, &format!("join {}\n", run::FILTERING.join(" ")))
}

fn record_of(selection: &Selection) -> ExportRecord {
    let name = |view| selection.scene.view(view).image_id.to_string();
    let mut record = ExportRecord::new(&BACKEND, selection, name);
    record.made_for = "AliceVision (ca8300f; read, not run)".into();
    record.way = "one scene file and one call per cluster".into();
    record.runner = Some("run.sh".into());
    record.not_honoured = vec!["the order of the partners of a key view".into()];
    record.pixel_shift = PIXEL_SHIFT;
    record.fusion =
        "minNumOfConsistentCams 1: only key views have maps, 3 of them rarely agree".into();
    record
}

/// Warns of partners that share no sparse point with the key view.
fn dropped_partners(scene: &Scene, points: &ViewPoints, cluster: &RankedCluster) -> Vec<String> {
    let shared = selection::shared_points(scene, points, cluster.key);
    let key = scene.name(cluster.key);
    let dropped = cluster.partners.iter().filter(|p| shared[p.index()] == 0).map(|&p| {
        let partner = scene.name(p);
        format!(
            "{key}: its partner {partner} shares no sparse point with it, without which AliceVision does not use it"
        )
    });
    dropped.collect()
}

/// The task of a cluster: the key view is named by its position among the views of its scene file,
/// which are ordered by ascending id. All angles are admitted and tiles do not select partners, so
/// that every partner is used.
fn row(selection: &Selection, rank: usize, cluster: &RankedCluster) -> Row {
    let id = |v| selection.scene.view(v).image_id;
    let key = id(cluster.key);
    let position = cluster.partners.iter().filter(|p| id(**p) < key).count();
    let (k, downscale) = (cluster.partners.len(), downscale(selection));
    let camera = selection.scene.camera_of(cluster.key);
    // All maps have one size, so the id at full size would be the same.
    let [mark, _] = task_ids(&BACKEND, selection, cluster);
    let options = format!(
        "--rangeStart {position} --rangeSize 1 \
         --minViewAngle 0 --maxViewAngle 180 --maxTCams {k} --chooseTCamsPerTile 0 --sgmMaxTCamsPerTile {k} --refineMaxTCamsPerTile {k} \
         --downscale {downscale}"
    );
    Row {
        rank,
        id: mark,
        view: key,
        scene: format!("clusters/{rank:04}.sfm"),
        options: options.split(' ').map(String::from).collect(),
        size: [camera.width, camera.height].map(|side| side.div_ceil(downscale as u32)),
    }
}

/// AliceVision shrinks by whole numbers.
fn downscale(selection: &Selection) -> f64 {
    (1.0 / selection.image_scale).round().max(1.0)
}
