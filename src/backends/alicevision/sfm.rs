//! Scene files of AliceVision (`.sfm` 1.2.6), in which numbers are strings.

use std::path::Path;

use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::PIXEL_SHIFT;
use crate::{
    backends::selection,
    model::{
        cluster::RankedCluster,
        scene::{PointIndex, Scene, ViewIndex, ViewPoints},
    },
};

/// Least number of common landmarks of neighbours: AliceVision requires more than 20.
const LEAST_LANDMARKS: usize = 21;
/// Arbitrary sensor width, since focal lengths are in its units.
const SENSOR_MM: f64 = 36.0;

/// Path of the link to a view's image in the export.
pub fn image_path(scene: &Scene, view: ViewIndex) -> String {
    let extension = Path::new(scene.name(view))
        .extension()
        .map_or("jpg".into(), |e| e.to_string_lossy().to_ascii_lowercase());
    // Named as AliceVision's prepareDenseScene names them.
    format!("images/{}.{extension}", scene.view(view).image_id)
}

/// A point and its observers.
type Track = (PointIndex, Vec<ViewIndex>);

/// Key view and partners, with a landmark per point that the key view shares with a partner,
/// repeated if too few.
pub fn cluster_file(scene: &Scene, points: &ViewPoints, cluster: &RankedCluster) -> String {
    let members: Vec<_> = cluster.views().collect();
    let mut landmarks: Vec<Track> = points
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
        // A partner that shares no point gets no landmark either; the record warns of it.
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

/// Key views, with the landmarks that several of them share.
pub fn file_of_keys(scene: &Scene, keys: &[ViewIndex], is_key: &[bool]) -> String {
    let points = (0..scene.points.len() as u32).map(PointIndex);
    let tracks: Vec<Track> = points
        .map(|p| (p, selection::observers(scene, p, |v| is_key[v.index()])))
        .filter(|(_, v)| v.len() > 1)
        .collect();
    scene_file(scene, keys, &tracks)
}

/// A `.sfm`, of which whoever leaves out views needs the ids.
#[derive(Serialize, Deserialize)]
struct SceneFile {
    version: Value,
    views: Vec<Value>,
    intrinsics: Value,
    poses: Vec<Value>,
    structure: Vec<Landmark>,
}

#[derive(Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
struct Landmark {
    landmark_id: String,
    desc_type: String,
    color: [String; 3],
    #[serde(rename = "X")]
    place: [String; 3],
    observations: Vec<Observation>,
}

#[derive(Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
struct Observation {
    observation_id: String,
    feature_id: String,
    x: [String; 2],
}

/// Returns a scene with some of its views alone: filtering and meshing open the maps of all.
pub fn with_views(scene: &[u8], is_there: impl Fn(&str) -> bool) -> serde_json::Result<String> {
    let mut scene: SceneFile = serde_json::from_slice(scene)?;
    let is_of_one = |entry: &Value, key: &str| entry[key].as_str().is_some_and(&is_there);
    scene.views.retain(|view| is_of_one(view, "viewId"));
    scene.poses.retain(|pose| is_of_one(pose, "poseId"));
    for landmark in &mut scene.structure {
        let observations = &mut landmark.observations;
        observations.retain(|seen| is_there(&seen.observation_id));
    }
    let structure = &mut scene.structure;
    structure.retain(|landmark| landmark.observations.len() > 1);
    serde_json::to_string(&scene)
}

/// A `.sfm` of version 1.2.6. Only listed views may occur in observations.
fn scene_file(scene: &Scene, views: &[ViewIndex], landmarks: &[Track]) -> String {
    let mut views = views.to_vec();
    // AliceVision orders the views by ascending id, and `--rangeStart` counts in that order.
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
        text += &serde_json::to_string(&landmark_entry(scene, i, landmark)).unwrap_or_default();
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

fn landmark_entry(scene: &Scene, id: usize, (point, views): &Track) -> Landmark {
    let track = scene.track(*point);
    let pixel = |view: ViewIndex| {
        track
            .clone()
            .find(|&i| scene.track_views[i] == view)
            .map_or([0.0; 2], |i| scene.track_pixels[i].map(|c| c + PIXEL_SHIFT))
    };
    let observation = |&v: &ViewIndex| Observation {
        observation_id: scene.view(v).image_id.to_string(),
        feature_id: id.to_string(),
        x: pixel(v).map(|c| c.to_string()),
    };
    Landmark {
        landmark_id: id.to_string(),
        desc_type: "unknown".into(),
        color: scene.colours[point.index()].map(|c| c.to_string()),
        place: scene.points[point.index()].coords.data.0[0].map(|c| c.to_string()),
        observations: views.iter().map(observation).collect(),
    }
}
