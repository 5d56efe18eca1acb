//! OpenMVG's `sfm_data.json`, versions 0.2 and 0.3 (cereal JSON).
//!
//! Poses are a world-to-camera rotation (row-major) and a centre; axes as in COLMAP; the centre of
//! the first pixel is (0, 0). Radial, Brown and fisheye distortion have COLMAP's formulas.

use std::collections::HashMap;

use nalgebra::{Matrix3, Vector3};
use serde::Deserialize;
use viewrank_core::model::camera::{Camera, CameraModel};

use super::{
    Fault, MOST_IMAGES, Place, Problem,
    colmap::StoredPose,
    foreign::{ForeignModel, brown, camera, fault_in, json_object, pose_with_centre, shift},
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

impl View {
    fn name(&self) -> String {
        match &*self.local_path {
            "" => self.filename.clone(),
            folder => format!("{folder}/{}", self.filename),
        }
    }
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

impl Extrinsic {
    fn pose(&self) -> Result<StoredPose, Problem> {
        let rotation = Matrix3::from_fn(|row, column| self.rotation[row][column]);
        pose_with_centre(rotation, Vector3::from(self.center))
    }
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
    let data: SfmData = json_object(bytes, "an object with \"views\" and \"extrinsics\"")?;
    let mut foreign = ForeignModel::default();
    foreign.model.cameras = cameras(&data.intrinsics)?;
    let images = add_images(&mut foreign, &data)?;
    for Entry { key, value } in &data.structure {
        let observations = value
            .observations
            .iter()
            .filter_map(|o| Some((*images.get(&o.key)?, shift(o.value.x))));
        let id = u64::from(*key);
        // The file has no colours.
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

fn by_key<T>(entries: &[Entry<T>]) -> HashMap<u32, &T> {
    let entries = entries.iter();
    entries.map(|entry| (entry.key, &entry.value)).collect()
}

/// Adds the views with a pose and a camera; returns the position in the model of each, by key.
fn add_images(foreign: &mut ForeignModel, data: &SfmData) -> Result<HashMap<u32, usize>, Fault> {
    let (poses, cameras) = (by_key(&data.extrinsics), by_key(&data.intrinsics));
    let mut images = HashMap::new();
    for Entry { key, value } in &data.views {
        let view = &value.ptr_wrapper.data;
        let pose = poses.get(&view.id_pose);
        let Some(pose) = pose.filter(|_| cameras.contains_key(&view.id_intrinsic)) else {
            foreign.unregistered.push(view.name());
            continue;
        };
        images.insert(*key, foreign.model.images.len());
        let name = view.name();
        let pose = pose
            .pose()
            .map_err(|problem| fault_in(problem, || format!("view {key}, {name:?}")))?;
        foreign.add_image(*key, name, view.id_intrinsic, pose, Place::File);
    }
    Ok(images)
}

fn intrinsic(id: u32, kind: &str, data: &Intrinsic) -> Result<Camera, Fault> {
    let what = || format!("intrinsic {id}");
    let (model, params) = data
        .model(kind)
        .map_err(|problem| fault_in(problem, what))?;
    camera(
        Camera::new(id, model, data.width, data.height, params),
        what,
    )
}

impl Intrinsic {
    /// COLMAP's model, and its parameters.
    fn model(&self, kind: &str) -> Result<(CameraModel, Vec<f64>), Problem> {
        let f = self.focal_length;
        let [cx, cy] = shift(self.principal_point);
        let pinhole = [f, f, cx, cy];
        Ok(match kind {
            "pinhole" => (CameraModel::SimplePinhole, vec![f, cx, cy]),
            "pinhole_radial_k1" => {
                let [k1] = distortion(kind, &self.disto_k1)?;
                (CameraModel::SimpleRadial, vec![f, cx, cy, k1])
            }
            "pinhole_radial_k3" => brown(pinhole, distortion(kind, &self.disto_k3)?, [0.0; 2]),
            "pinhole_brown_t2" => {
                let [k1, k2, k3, t1, t2] = distortion(kind, &self.disto_t2)?;
                brown(pinhole, [k1, k2, k3], [t1, t2])
            }
            "fisheye" => {
                let k: [f64; 4] = distortion(kind, &self.fisheye)?;
                (CameraModel::OpenCvFisheye, [pinhole, k].concat())
            }
            "spherical" => (
                CameraModel::Equirectangular,
                vec![self.width as f64, self.height as f64],
            ),
            _ => return Err(Problem::CameraModel(format!("{kind} (OpenMVG)"))),
        })
    }
}

/// The distortion parameters of a kind.
fn distortion<const N: usize>(kind: &str, list: &Option<Vec<f64>>) -> Result<[f64; N], Problem> {
    let list = list.as_deref().and_then(|list| list.try_into().ok());
    list.ok_or_else(|| Problem::Content(format!("{kind} without its {N} distortion parameters")))
}
