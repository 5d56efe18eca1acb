//! AliceVision and Meshroom (ca8300f, read, not run). AliceVision reads no lists of views or
//! partners: each cluster becomes a scene file in which the key view shares landmarks with its
//! partners only, and the key view is named by its position among the views with pose, by ascending
//! id.
//!
//! Rotations are in column order, the principal point is an offset from the image centre. Pixel
//! centres are taken to be integers, as in OpenMVG; if that is wrong, all is half a pixel off. The
//! filtering takes counts that it finds in its output folder for its own, so it gets an empty one.

use std::{fmt::Write, path::Path};

use serde_json::{Value, json};

use super::{
    Backend, BackendError, Capabilities, Export, ExportOptions, ExportRecord, Honours, LastRun,
    PATCH_MATCH, Selection,
    clusters::{ClusterScript, recipe},
    selection,
    strangers::list_links,
};
use crate::model::{
    cluster::RankedCluster,
    scene::{PointIndex, Scene, ViewIndex, ViewPoints},
};

/// Least number of common landmarks of neighbours: AliceVision requires more than 20.
const LEAST_LANDMARKS: usize = 21;
/// Added to COLMAP's pixel coordinates to get those of `formats::alicevision`.
const PIXEL_SHIFT: f64 = -0.5;
/// Arbitrary sensor width, since focal lengths are in its units.
const SENSOR_MM: f64 = 36.0;

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
    export,
    ..Backend::DEFAULT
};

fn export(selection: &Selection, options: &ExportOptions) -> Result<Export, BackendError> {
    let near = selection.near_origin();
    let selection = &near.selection();
    let images = selection.undistorted_images(BACKEND.name)?;
    let scene = selection.scene;
    let mut files = options.file_set(&BACKEND, selection);
    for view in selection.views() {
        files.add(image_path(scene, view), images.link(scene.name(view)));
    }
    let points = scene.view_points();
    let mut record = record_of(selection);
    record.moved(near.origin);
    let names: Vec<String> = selection
        .clusters
        .iter()
        .map(|cluster| result_name(selection, cluster))
        .collect();
    let mut script = ClusterScript::new(&names, RUNNER_HEAD);
    for (i, (cluster, name)) in selection.clusters.iter().zip(&names).enumerate() {
        let path = format!("clusters/{:04}.sfm", i + 1);
        files.add_text(&*path, cluster_file(scene, &points, cluster));
        let options = estimation(selection, cluster, &path);
        script.cluster(
            name,
            &format!("[ -d kept/{name} ]"),
            &[format!("map {name} {options}")],
        );
        record.commands.push(format!(
            "aliceVision_depthMapEstimation {options} -o depthMaps"
        ));
        record
            .warnings
            .extend(dropped_partners(scene, &points, cluster));
    }
    let keys: Vec<_> = selection.clusters.iter().map(|c| c.key).collect();
    files.add_text(
        "keys.sfm",
        scene_file(scene, &keys, &all_landmarks(scene, &selection.is_key())),
    );
    files.add_script(
        "finished.py",
        include_str!("../../integrations/alicevision/finished.py"),
    );
    record.commands.extend([
        "python3 -I finished.py".into(),
        "rm -rf filtered && mkdir filtered".into(),
        format!("aliceVision_depthMapFiltering -i finished.sfm --depthMapsFolder depthMaps -o filtered {FILTERING}"),
        // `-o` is short for two options here.
        "aliceVision_meshing -i finished.sfm --depthMapsFolder filtered --output dense.abc --outputMesh mesh.obj"
            .into(),
    ]);
    record.note_scale(selection, |_| 1.0 / downscale(selection));
    files.add_script("run.sh", script.finish(&[format!("join {FILTERING}")]));
    list_links(&mut files);
    Ok(Export::new(files, record))
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

const RUNNER_HEAD: &str = include_str!("../../integrations/alicevision/run_head.sh");
/// Only key views have maps, and three of them rarely agree.
const FILTERING: &str = "--minNumOfConsistentCams 1 --minNumOfConsistentCamsWithLowSimilarity 2";

/// Name of the folder of a key view's maps: its id and the hash of what they are made from.
fn result_name(selection: &Selection, cluster: &RankedCluster) -> String {
    let recipe = recipe(selection, cluster, &downscale(selection).to_string());
    format!("{}-{recipe}", selection.scene.view(cluster.key).image_id)
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

/// Options for the key view, by its position among the views of the file, which are ordered by
/// ascending id. All angles are admitted and tiles do not select partners, so that every partner is
/// used.
fn estimation(selection: &Selection, cluster: &RankedCluster, path: &str) -> String {
    let id = |v: &ViewIndex| selection.scene.view(*v).image_id;
    let position = cluster
        .partners
        .iter()
        .filter(|p| id(p) < id(&cluster.key))
        .count();
    let k = cluster.partners.len();
    let downscale = downscale(selection);
    format!(
        "-i {path} --imagesFolder images --rangeStart {position} --rangeSize 1 \
         --minViewAngle 0 --maxViewAngle 180 --maxTCams {k} --chooseTCamsPerTile 0 --sgmMaxTCamsPerTile {k} --refineMaxTCamsPerTile {k} \
         --downscale {downscale}"
    )
}

/// AliceVision shrinks by whole numbers.
fn downscale(selection: &Selection) -> f64 {
    (1.0 / selection.image_scale).round().max(1.0)
}

fn image_path(scene: &Scene, view: ViewIndex) -> String {
    let extension = Path::new(scene.name(view))
        .extension()
        .map_or("jpg".into(), |e| e.to_string_lossy().to_ascii_lowercase());
    format!("images/{}.{extension}", scene.view(view).image_id)
}

/// A landmark and its observers.
type Landmark = (PointIndex, Vec<ViewIndex>);

/// Key view and partners, with a landmark per point that the key view shares with a partner,
/// repeated if too few.
fn cluster_file(scene: &Scene, points: &ViewPoints, cluster: &RankedCluster) -> String {
    let members: Vec<_> = cluster.views().collect();
    let mut landmarks: Vec<Landmark> = points
        .observed_by(cluster.key)
        .iter()
        .map(|&p| (p, selection::observers(scene, p, |v| members.contains(&v))))
        .filter(|(_, v)| v.len() > 1)
        .collect();
    for &partner in &cluster.partners {
        let shared: Vec<_> = landmarks
            .iter()
            .filter(|(_, v)| v.contains(&partner))
            .map(|l| l.0)
            .collect();
        let missing = LEAST_LANDMARKS.saturating_sub(shared.len());
        landmarks.extend(
            shared
                .iter()
                .cycle()
                .take(missing)
                .map(|&p| (p, vec![cluster.key, partner])),
        );
    }
    scene_file(scene, &members, &landmarks)
}

fn all_landmarks(scene: &Scene, is_key: &[bool]) -> Vec<Landmark> {
    let points = (0..scene.points.len() as u32).map(PointIndex);
    points
        .map(|p| (p, selection::observers(scene, p, |v| is_key[v.index()])))
        .filter(|(_, v)| v.len() > 1)
        .collect()
}

/// A `.sfm` of version 1.2.6. Only listed views may occur in observations.
fn scene_file(scene: &Scene, views: &[ViewIndex], landmarks: &[Landmark]) -> String {
    let mut views = views.to_vec();
    views.sort_by_key(|&v| scene.view(v).image_id);
    let mut cameras: Vec<u32> = views.iter().map(|&v| scene.view(v).camera.0).collect();
    cameras.sort_unstable();
    cameras.dedup();
    let head = json!({
        "version": ["1", "2", "6"],
        "views": views.iter().map(|&v| view_entry(scene, v)).collect::<Vec<_>>(),
        "intrinsics": cameras.iter().map(|&c| intrinsic_entry(scene, c)).collect::<Vec<_>>(),
        "poses": views.iter().map(|&v| pose_entry(scene, v)).collect::<Vec<_>>(),
    });
    // Written one by one: as JSON values in memory they take ten times the size of their text.
    let mut text = head.to_string();
    text.pop();
    text += ",\"structure\":[";
    for (i, landmark) in landmarks.iter().enumerate() {
        text += if i > 0 { "," } else { "" };
        let _ = write!(text, "{}", landmark_entry(scene, i, landmark));
    }
    text + "]}\n"
}

/// Numbers are strings, as in the files of AliceVision itself.
fn numbers(values: &[f64]) -> Vec<String> {
    values.iter().map(f64::to_string).collect()
}

fn view_entry(scene: &Scene, view: ViewIndex) -> Value {
    let (entry, camera) = (scene.view(view), scene.camera_of(view));
    json!({
        "viewId": entry.image_id.to_string(),
        "poseId": entry.image_id.to_string(),
        "intrinsicId": (entry.camera.0 + 1).to_string(),
        "path": image_path(scene, view),
        "width": camera.width.to_string(),
        "height": camera.height.to_string(),
    })
}

/// Focal length in mm of the sensor, and (since 1.2.5) the second one over it; the principal point
/// is an offset from the middle of the image, pixel centres are integers.
fn intrinsic_entry(scene: &Scene, camera: u32) -> Value {
    let entry = &scene.cameras[camera as usize];
    let (f, c) = entry.pinhole_part();
    let (width, height) = (f64::from(entry.width), f64::from(entry.height));
    json!({
        "intrinsicId": (camera + 1).to_string(),
        "width": entry.width.to_string(),
        "height": entry.height.to_string(),
        "sensorWidth": SENSOR_MM.to_string(),
        "sensorHeight": (SENSOR_MM * height / width).to_string(),
        "serialNumber": "",
        "type": "pinhole",
        "initializationMode": "calibrated",
        "initialFocalLength": "-1",
        "focalLength": (f.x / width * SENSOR_MM).to_string(),
        "pixelRatio": (f.y / f.x).to_string(),
        "pixelRatioLocked": "true",
        "principalPoint": numbers(&[c.x - 0.5 * width + PIXEL_SHIFT, c.y - 0.5 * height + PIXEL_SHIFT]),
        "distortionParams": "",
        "locked": "true",
    })
}

/// Rotation in column-major order.
fn pose_entry(scene: &Scene, view: ViewIndex) -> Value {
    let pose = &scene.view(view).cam_from_world;
    json!({
        "poseId": scene.view(view).image_id.to_string(),
        "pose": {
            "transform": {
                "rotation": numbers(pose.rotation.matrix().as_slice()),
                "center": numbers(pose.centre().coords.as_slice()),
            },
            "locked": "1",
        },
    })
}

fn landmark_entry(scene: &Scene, id: usize, (point, views): &Landmark) -> Value {
    let track = scene.track(*point);
    let pixel = |view: ViewIndex| {
        track
            .clone()
            .find(|&i| scene.track_views[i] == view)
            .map_or([0.0; 2], |i| scene.track_pixels[i].map(|c| c + PIXEL_SHIFT))
    };
    let observation = |&v: &ViewIndex| json!({ "observationId": scene.view(v).image_id.to_string(), "featureId": id.to_string(), "x": numbers(&pixel(v)) });
    json!({
        "landmarkId": id.to_string(),
        "descType": "unknown",
        "color": scene.colours[point.index()].map(|c| c.to_string()),
        "X": numbers(scene.points[point.index()].coords.as_slice()),
        "observations": views.iter().map(observation).collect::<Vec<_>>(),
    })
}
