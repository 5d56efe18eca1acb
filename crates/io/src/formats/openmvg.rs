//! OpenMVG's `sfm_data.json`, versions 0.2 and 0.3 (cereal JSON).
//!
//! Poses are a world-to-camera rotation (row-major) and a centre; axes as in COLMAP; the centre of
//! the first pixel is (0, 0). Radial, Brown and fisheye distortion have COLMAP's formulas.

use std::collections::{HashMap, HashSet};

use nalgebra::{Matrix3, Vector3};
use serde::Deserialize;
use viewrank_core::model::camera::{Camera, CameraModel};

use super::{
    Fault, MOST_IMAGES, Place, Problem,
    foreign::{ForeignModel, camera, json, pose_with_centre, shift},
};
use crate::bounded;

/// cereal's flag for a type whose name occurred before.
const SEEN_BEFORE: u64 = 0x8000_0000;

#[derive(Deserialize)]
struct SfmData {
    #[serde(default)]
    root_path: String,
    #[serde(deserialize_with = "bounded::list::<_, _, MOST_IMAGES>")]
    views: Vec<Entry<Pointer<View>>>,
    #[serde(deserialize_with = "bounded::list::<_, _, MOST_IMAGES>")]
    intrinsics: Vec<Entry<Pointer<Intrinsic>>>,
    #[serde(deserialize_with = "bounded::list::<_, _, MOST_IMAGES>")]
    extrinsics: Vec<Entry<Extrinsic>>,
    #[serde(default)]
    structure: Vec<Entry<Landmark>>,
}

#[derive(Deserialize)]
struct Entry<T> {
    key: u32,
    value: T,
}

#[derive(Deserialize)]
struct Pointer<T> {
    #[serde(default)]
    polymorphic_id: u64,
    polymorphic_name: Option<String>,
    ptr_wrapper: Data<T>,
}

#[derive(Deserialize)]
struct Data<T> {
    data: T,
}

#[derive(Deserialize)]
struct View {
    #[serde(default)]
    local_path: String,
    filename: String,
    id_intrinsic: u32,
    id_pose: u32,
}

#[derive(Deserialize)]
struct Intrinsic {
    width: u64,
    height: u64,
    #[serde(default)]
    focal_length: f64,
    #[serde(default)]
    principal_point: [f64; 2],
    disto_k1: Option<Vec<f64>>,
    disto_k3: Option<Vec<f64>>,
    disto_t2: Option<Vec<f64>>,
    fisheye: Option<Vec<f64>>,
}

#[derive(Deserialize)]
struct Extrinsic {
    rotation: [[f64; 3]; 3],
    center: [f64; 3],
}

#[derive(Deserialize)]
struct Landmark {
    #[serde(rename = "X")]
    position: [f64; 3],
    observations: Vec<Entry<Observation>>,
}

#[derive(Deserialize)]
struct Observation {
    x: [f64; 2],
}

pub fn read(bytes: &[u8]) -> Result<ForeignModel, Fault> {
    let data: SfmData = json(bytes)?;
    let mut foreign = ForeignModel::default();
    foreign.model.cameras = cameras(&data.intrinsics)?;
    let images = add_images(&mut foreign, &data)?;
    for Entry { key, value } in &data.structure {
        let observations = value
            .observations
            .iter()
            .filter_map(|o| Some((*images.get(&o.key)?, shift(o.value.x))));
        let id = u64::from(*key);
        foreign.add_point(id, value.position, [255; 3], observations, Place::File);
    }
    foreign.image_folder = Some(data.root_path).filter(|path| !path.is_empty());
    foreign.shorten_names();
    Ok(foreign)
}

fn cameras(intrinsics: &[Entry<Pointer<Intrinsic>>]) -> Result<Vec<Camera>, Fault> {
    // cereal writes a type name only at its first occurrence.
    let mut type_names = HashMap::new();
    let of_entry = |Entry { key, value }: &'_ Entry<Pointer<Intrinsic>>| {
        let number = value.polymorphic_id & !SEEN_BEFORE;
        if let Some(name) = &value.polymorphic_name {
            type_names.insert(number, name.clone());
        }
        let name = type_names.get(&number).map_or("pinhole", String::as_str);
        intrinsic(*key, name, &value.ptr_wrapper.data)
    };
    intrinsics.iter().map(of_entry).collect()
}

/// Adds the views with a pose and a camera; returns the position in the model of each, by key.
fn add_images(foreign: &mut ForeignModel, data: &SfmData) -> Result<HashMap<u32, usize>, Fault> {
    let poses: HashMap<u32, &Extrinsic> = data
        .extrinsics
        .iter()
        .map(|pose| (pose.key, &pose.value))
        .collect();
    let cameras: HashSet<u32> = data.intrinsics.iter().map(|camera| camera.key).collect();
    let mut images = HashMap::new();
    for Entry { key, value } in &data.views {
        let view = &value.ptr_wrapper.data;
        let name = match &*view.local_path {
            "" => view.filename.clone(),
            folder => format!("{folder}/{}", view.filename),
        };
        let pose = poses.get(&view.id_pose);
        let Some(pose) = pose.filter(|_| cameras.contains(&view.id_intrinsic)) else {
            foreign.unregistered.push(name);
            continue;
        };
        images.insert(*key, foreign.model.images.len());
        let rotation = Matrix3::from_fn(|row, column| pose.rotation[row][column]);
        let pose = pose_with_centre(rotation, Vector3::from(pose.center));
        let pose = pose.map_err(|problem| {
            Fault::new("", Place::File, problem).in_record(|| format!("view {key}, {name:?}"))
        })?;
        foreign.add_image(*key, name, view.id_intrinsic, pose, Place::File);
    }
    Ok(images)
}

fn intrinsic(id: u32, kind: &str, data: &Intrinsic) -> Result<Camera, Fault> {
    let f = data.focal_length;
    let [cx, cy] = shift(data.principal_point);
    let parameters = |list: &Option<Vec<f64>>, n: usize| {
        let list = list.clone().filter(|list| list.len() == n);
        list.ok_or_else(|| {
            let message = format!("{kind} without its {n} distortion parameters");
            Fault::new("", Place::File, Problem::Json(message))
                .in_record(|| format!("intrinsic {id}"))
        })
    };
    let (model, params) = match kind {
        "pinhole" => (CameraModel::SimplePinhole, vec![f, cx, cy]),
        "pinhole_radial_k1" => (
            CameraModel::SimpleRadial,
            vec![f, cx, cy, parameters(&data.disto_k1, 1)?[0]],
        ),
        "pinhole_radial_k3" => {
            let k = parameters(&data.disto_k3, 3)?;
            (
                CameraModel::FullOpenCv,
                vec![f, f, cx, cy, k[0], k[1], 0.0, 0.0, k[2], 0.0, 0.0, 0.0],
            )
        }
        "pinhole_brown_t2" => {
            let k = parameters(&data.disto_t2, 5)?;
            (
                CameraModel::FullOpenCv,
                vec![f, f, cx, cy, k[0], k[1], k[3], k[4], k[2], 0.0, 0.0, 0.0],
            )
        }
        "fisheye" => (
            CameraModel::OpenCvFisheye,
            [&[f, f, cx, cy], &parameters(&data.fisheye, 4)?[..]].concat(),
        ),
        "spherical" => (
            CameraModel::Equirectangular,
            vec![data.width as f64, data.height as f64],
        ),
        _ => {
            let problem = Problem::CameraModel(format!("{kind} (OpenMVG)"));
            return Err(
                Fault::new("", Place::File, problem).in_record(|| format!("intrinsic {id}"))
            );
        }
    };
    camera(
        Camera::new(id, model, data.width, data.height, params),
        || format!("intrinsic {id}"),
    )
}
