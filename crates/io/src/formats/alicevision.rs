//! AliceVision's SfMData (`.sfm`, `.json`; Meshroom), versions 1.0 to 1.2: JSON in which every
//! number is a string.
//!
//! Poses are a world-to-camera rotation in *column-major* order and a centre; axes as in COLMAP;
//! the centre of the first pixel is (0, 0). Since 1.2.2 focal lengths are in millimetres on the
//! sensor, since 1.2.1 principal points are relative to the image centre. Views of a rig have the
//! rig's pose and a pose within the rig.

use std::{
    collections::{HashMap, HashSet},
    fmt,
    marker::PhantomData,
    str::FromStr,
};

use nalgebra::{Matrix3, Vector3};
use serde::{
    Deserialize, Deserializer,
    de::{Error, IntoDeserializer, SeqAccess, Visitor, value::SeqAccessDeserializer},
};
use viewrank_core::model::{
    camera::{Camera, CameraModel},
    scene::WarningKind,
};

use super::{
    Fault, MOST_IMAGES, Place, Problem,
    foreign::{ForeignModel, camera, json, pose_with_centre, shift},
};
use crate::bounded;

#[derive(Deserialize)]
struct SfmData {
    version: List<Number<u32>>,
    views: List<View, MOST_IMAGES>,
    intrinsics: List<Intrinsic, MOST_IMAGES>,
    #[serde(default)]
    poses: List<PoseEntry, MOST_IMAGES>,
    #[serde(default)]
    rigs: List<Rig, MOST_IMAGES>,
    #[serde(default)]
    structure: List<Landmark>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct View {
    view_id: Number<u32>,
    pose_id: Option<Number<u32>>,
    intrinsic_id: Option<Number<u32>>,
    rig_id: Option<Number<u32>>,
    sub_pose_id: Option<Number<usize>>,
    is_pose_independant: Option<Number<bool>>,
    #[serde(default)]
    path: String,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Intrinsic {
    intrinsic_id: Number<u32>,
    width: Number<u64>,
    height: Number<u64>,
    sensor_width: Option<Number<f64>>,
    sensor_height: Option<Number<f64>>,
    #[serde(rename = "type")]
    kind: String,
    distortion_type: Option<String>,
    undistortion_type: Option<String>,
    focal_length: Option<Number<f64>>,
    px_focal_length: Option<OneOrTwo>,
    pixel_ratio: Option<Number<f64>>,
    #[serde(default)]
    principal_point: List<Number<f64>>,
    #[serde(default)]
    distortion_params: List<Number<f64>>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct PoseEntry {
    pose_id: Number<u32>,
    pose: Transform,
}

#[derive(Deserialize)]
struct Transform {
    transform: Motion,
}

#[derive(Deserialize)]
struct Motion {
    rotation: List<Number<f64>>,
    center: List<Number<f64>>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Rig {
    rig_id: Number<u32>,
    #[serde(default)]
    sub_poses: List<SubPose>,
}

#[derive(Deserialize)]
struct SubPose {
    pose: Motion,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Landmark {
    landmark_id: Number<u32>,
    #[serde(default)]
    color: List<Number<f64>>,
    #[serde(rename = "X")]
    position: List<Number<f64>>,
    #[serde(default)]
    observations: List<Observation>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Observation {
    observation_id: Number<u32>,
    #[serde(default)]
    x: List<Number<f64>>,
}

/// A number, possibly in quotes.
#[derive(Clone, Copy, Debug)]
struct Number<T>(T);

impl<'de, T: FromStr> Deserialize<'de> for Number<T> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Quoted<T>(PhantomData<T>);
        impl<T: FromStr> Visitor<'_> for Quoted<T> {
            type Value = Number<T>;
            fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
                f.write_str("a number, possibly in quotes")
            }
            fn visit_str<E: Error>(self, text: &str) -> Result<Self::Value, E> {
                // Booleans are also written as 0 and 1.
                let text = match text {
                    "0" | "1" if size_of::<T>() == 1 => {
                        if text == "1" {
                            "true"
                        } else {
                            "false"
                        }
                    }
                    _ => text,
                };
                text.parse()
                    .map(Number)
                    .map_err(|_| E::custom(format!("{text:?} is not a valid number")))
            }
            fn visit_bool<E: Error>(self, value: bool) -> Result<Self::Value, E> {
                self.visit_str(&value.to_string())
            }
            fn visit_u64<E: Error>(self, value: u64) -> Result<Self::Value, E> {
                self.visit_str(&value.to_string())
            }
            fn visit_i64<E: Error>(self, value: i64) -> Result<Self::Value, E> {
                self.visit_str(&value.to_string())
            }
            fn visit_f64<E: Error>(self, value: f64) -> Result<Self::Value, E> {
                self.visit_str(&value.to_string())
            }
        }
        deserializer.deserialize_any(Quoted(PhantomData))
    }
}

/// A list of at most `MOST` elements; an empty one is written as an empty string.
#[derive(Clone, Debug)]
struct List<T, const MOST: usize = { usize::MAX }>(Vec<T>);

impl<T, const MOST: usize> Default for List<T, MOST> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

impl<'de, T: Deserialize<'de>, const MOST: usize> Deserialize<'de> for List<T, MOST> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Elements<T, const MOST: usize>(PhantomData<T>);
        impl<'de, T: Deserialize<'de>, const MOST: usize> Visitor<'de> for Elements<T, MOST> {
            type Value = List<T, MOST>;
            fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
                f.write_str("a list, or an empty string")
            }
            fn visit_str<E: Error>(self, text: &str) -> Result<Self::Value, E> {
                if text.is_empty() {
                    Ok(List::default())
                } else {
                    Err(E::custom("expected a list"))
                }
            }
            fn visit_seq<A: SeqAccess<'de>>(self, list: A) -> Result<Self::Value, A::Error> {
                bounded::elements::<A, T, MOST>(list).map(List)
            }
        }
        deserializer.deserialize_any(Elements(PhantomData))
    }
}

impl List<Number<f64>> {
    fn numbers<const N: usize>(&self, what: &'static str) -> Result<[f64; N], Problem> {
        let wrong = || {
            Problem::Json(format!(
                "{what} has {} numbers instead of {N}",
                self.0.len()
            ))
        };
        let numbers: Vec<f64> = self.0.iter().map(|n| n.0).collect();
        numbers.try_into().map_err(|_| wrong())
    }
}

/// Focal length: one number up to version 1.1, a list of two since.
enum OneOrTwo {
    One(Number<f64>),
    Two(List<Number<f64>>),
}

impl<'de> Deserialize<'de> for OneOrTwo {
    /// Not as an untagged enumeration, which keeps all of a list to try it twice.
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Either;
        impl<'de> Visitor<'de> for Either {
            type Value = OneOrTwo;
            fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
                f.write_str("a number or a list of two")
            }
            fn visit_str<E: Error>(self, text: &str) -> Result<Self::Value, E> {
                Number::deserialize(text.into_deserializer()).map(OneOrTwo::One)
            }
            fn visit_u64<E: Error>(self, value: u64) -> Result<Self::Value, E> {
                self.visit_f64(value as f64)
            }
            fn visit_i64<E: Error>(self, value: i64) -> Result<Self::Value, E> {
                self.visit_f64(value as f64)
            }
            fn visit_f64<E: Error>(self, value: f64) -> Result<Self::Value, E> {
                Ok(OneOrTwo::One(Number(value)))
            }
            fn visit_seq<A: SeqAccess<'de>>(self, list: A) -> Result<Self::Value, A::Error> {
                List::deserialize(SeqAccessDeserializer::new(list)).map(OneOrTwo::Two)
            }
        }
        deserializer.deserialize_any(Either)
    }
}

/// World to camera.
type RigidMotion = (Matrix3<f64>, Vector3<f64>);

impl Motion {
    fn rotation_and_centre(&self) -> Result<RigidMotion, Problem> {
        let rotation = Matrix3::from_column_slice(&self.rotation.numbers::<9>("rotation")?);
        Ok((rotation, Vector3::from(self.center.numbers::<3>("center")?)))
    }
}

pub fn read(bytes: &[u8]) -> Result<ForeignModel, Fault> {
    let data: SfmData = json(bytes)?;
    let version: Vec<u32> = data.version.0.iter().map(|n| n.0).collect();
    let mut foreign = ForeignModel::default();
    for intrinsic in &data.intrinsics.0 {
        let id = intrinsic.intrinsic_id.0;
        let found = intrinsic.camera(&version);
        foreign
            .model
            .cameras
            .push(found.map_err(|fault| fault.in_record(|| format!("intrinsic {id}")))?);
    }
    let poses: HashMap<u32, &Motion> = data
        .poses
        .0
        .iter()
        .map(|p| (p.pose_id.0, &p.pose.transform))
        .collect();
    let rigs: HashMap<u32, &Rig> = data.rigs.0.iter().map(|rig| (rig.rig_id.0, rig)).collect();
    let intrinsics: HashSet<u32> = data.intrinsics.0.iter().map(|i| i.intrinsic_id.0).collect();
    let mut images = HashMap::new();
    let mut nameless = 0;
    for view in &data.views.0 {
        let id = view.view_id.0;
        let fault =
            |problem| Fault::new("", Place::File, problem).in_record(|| format!("view {id}"));
        let name = if view.path.is_empty() {
            format!("view_{id}")
        } else {
            view.path.clone()
        };
        nameless += usize::from(view.path.is_empty());
        let motion = view.motion(&poses, &rigs).map_err(fault)?;
        let camera_id = view
            .intrinsic_id
            .map(|id| id.0)
            .filter(|id| intrinsics.contains(id));
        let Some(((rotation, centre), camera_id)) = motion.zip(camera_id) else {
            foreign.unregistered.push(name);
            continue;
        };
        images.insert(id, foreign.model.images.len());
        let pose = pose_with_centre(rotation, centre).map_err(fault)?;
        foreign.add_image(id, name, camera_id, pose, Place::File);
    }
    if nameless > 0 {
        foreign.warn(
            WarningKind::Format,
            format!("{nameless} views without a path are named by their ids"),
        );
    }
    for landmark in &data.structure.0 {
        let id = landmark.landmark_id.0;
        let added = landmark.add_to(&mut foreign, &images);
        added.map_err(|problem| {
            Fault::new("", Place::File, problem).in_record(|| format!("landmark {id}"))
        })?;
    }
    foreign.shorten_names();
    Ok(foreign)
}

impl View {
    /// Rotation and centre of a view; `None` without a pose.
    fn motion(
        &self,
        poses: &HashMap<u32, &Motion>,
        rigs: &HashMap<u32, &Rig>,
    ) -> Result<Option<RigidMotion>, Problem> {
        // Without a pose id, the view's own id is its pose's id.
        let pose_id = self.pose_id.unwrap_or(self.view_id).0;
        let Some(motion) = poses.get(&pose_id) else {
            return Ok(None);
        };
        let (rotation, centre) = motion.rotation_and_centre()?;
        let independent = self.is_pose_independant.is_none_or(|flag| flag.0);
        let Some((rig_id, sub_pose)) = self.rig_id.zip(self.sub_pose_id).filter(|_| !independent)
        else {
            return Ok(Some((rotation, centre)));
        };
        let rig = rigs.get(&rig_id.0).ok_or(Problem::Absent {
            what: "rig",
            id: rig_id.0.into(),
        })?;
        let sub_pose = rig.sub_poses.0.get(sub_pose.0);
        let sub_pose = sub_pose.ok_or(Problem::Absent {
            what: "rig",
            id: rig_id.0.into(),
        })?;
        let (sub_rotation, sub_centre) = sub_pose.pose.rotation_and_centre()?;
        Ok(Some((
            sub_rotation * rotation,
            centre + rotation.transpose() * sub_centre,
        )))
    }
}

impl Landmark {
    fn add_to(
        &self,
        foreign: &mut ForeignModel,
        images: &HashMap<u32, usize>,
    ) -> Result<(), Problem> {
        let mut observations = Vec::with_capacity(self.observations.0.len());
        for observation in &self.observations.0 {
            if let Some(&image) = images.get(&observation.observation_id.0) {
                observations.push((image, shift(observation.x.numbers("x")?)));
            }
        }
        let colour = self
            .color
            .numbers::<3>("color")
            .map_or([255; 3], |c| c.map(|c| c.clamp(0.0, 255.0) as u8));
        let id = self.landmark_id.0.into();
        foreign.add_point(
            id,
            self.position.numbers("X")?,
            colour,
            observations,
            Place::File,
        );
        Ok(())
    }
}

impl Intrinsic {
    fn camera(&self, version: &[u32]) -> Result<Camera, Fault> {
        let fault = |problem| Fault::new("", Place::File, problem);
        let id = self.intrinsic_id.0;
        let (width, height) = (self.width.0, self.height.0);
        let [fx, fy] = self.focal_lengths(version).map_err(fault)?;
        let mut offset = self
            .principal_point
            .numbers::<2>("principalPoint")
            .map_err(fault)?;
        if version >= &[1, 2, 1][..] {
            offset = [
                offset[0] + width as f64 / 2.0,
                offset[1] + height as f64 / 2.0,
            ];
        }
        let [cx, cy] = shift(offset);
        let (model, params) = self.model([fx, fy, cx, cy]).map_err(fault)?;
        camera(Camera::new(id, model, width, height, params), || {
            format!("intrinsic {id}")
        })
    }

    /// Pixels.
    fn focal_lengths(&self, version: &[u32]) -> Result<[f64; 2], Problem> {
        match &self.px_focal_length {
            Some(OneOrTwo::One(f)) => return Ok([f.0; 2]),
            Some(OneOrTwo::Two(list)) => return list.numbers("pxFocalLength"),
            None => {}
        }
        let missing = || Problem::Json("focalLength is missing".into());
        let pixels_per_mm = self.width.0 as f64 / self.sensor_width.map_or(36.0, |w| w.0);
        let f = self.focal_length.ok_or_else(missing)?.0 * pixels_per_mm;
        let ratio = self.pixel_ratio.map_or(1.0, |r| r.0);
        // The meaning of the ratio changed twice.
        Ok(match version {
            v if v < &[1, 2, 5][..] => [f, f / ratio],
            v if v < &[1, 2, 11][..] => [f, f * ratio],
            _ => [f / ratio, f],
        })
    }

    fn model(&self, [fx, fy, cx, cy]: [f64; 4]) -> Result<(CameraModel, Vec<f64>), Problem> {
        let kind = self.kind.to_ascii_lowercase();
        let distortion = self
            .distortion_type
            .as_ref()
            .map_or(String::new(), |d| d.to_ascii_lowercase());
        let undistortion = self
            .undistortion_type
            .as_ref()
            .map_or(String::new(), |d| d.to_ascii_lowercase());
        let unknown = || {
            Err(Problem::CameraModel(format!(
                "{kind} {distortion} {undistortion} (AliceVision)"
            )))
        };
        if !matches!(undistortion.as_str(), "" | "none") {
            return unknown();
        }
        let list = &self.distortion_params;
        let full = |k: [f64; 3], p: [f64; 2]| {
            (
                CameraModel::FullOpenCv,
                vec![fx, fy, cx, cy, k[0], k[1], p[0], p[1], k[2], 0.0, 0.0, 0.0],
            )
        };
        Ok(match (kind.as_str(), distortion.as_str()) {
            ("pinhole", "" | "none") => (CameraModel::Pinhole, vec![fx, fy, cx, cy]),
            ("radial1", _) | ("pinhole", "radialk1") => full(
                [list.numbers::<1>("distortionParams")?[0], 0.0, 0.0],
                [0.0; 2],
            ),
            ("radial3", _) | ("pinhole", "radialk3") => {
                full(list.numbers("distortionParams")?, [0.0; 2])
            }
            ("brown", _) | ("pinhole", "brown") => {
                let [k1, k2, k3, t1, t2] = list.numbers("distortionParams")?;
                full([k1, k2, k3], [t1, t2])
            }
            ("fisheye4", _) | ("pinhole", "fisheye") => {
                let k: [f64; 4] = list.numbers("distortionParams")?;
                (CameraModel::OpenCvFisheye, [[fx, fy, cx, cy], k].concat())
            }
            ("fisheye1", _) | ("pinhole", "fisheye1") => (
                CameraModel::Fov,
                vec![fx, fy, cx, cy, list.numbers::<1>("distortionParams")?[0]],
            ),
            ("equidistant", "" | "none") => {
                // The scale maps half of the field of view to a radius of 1.
                let (sensor_width, sensor_height) = (
                    self.sensor_width.map_or(36.0, |w| w.0),
                    self.sensor_height.map_or(24.0, |h| h.0),
                );
                let longest = self.width.0.max(self.height.0) as f64;
                let per_radian =
                    2.0 * fx * sensor_width / (longest * sensor_width.min(sensor_height));
                (
                    CameraModel::Fisheye,
                    vec![fx * per_radian, fy * per_radian, cx, cy],
                )
            }
            _ => return unknown(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_focal_length_is_one_number_or_two_and_read_once() {
        let read = |text: &str| match json::<OneOrTwo>(text.as_bytes()) {
            Ok(OneOrTwo::One(f)) => Ok(vec![f.0]),
            Ok(OneOrTwo::Two(list)) => Ok(list.0.iter().map(|f| f.0).collect()),
            Err(fault) => Err(fault.to_string()),
        };
        for (text, expected) in [
            ("5", vec![5.0]),
            ("\"5.5\"", vec![5.5]),
            ("[\"4\", 5]", vec![4.0, 5.0]),
        ] {
            assert_eq!(read(text), Ok(expected), "{text}");
        }
        // The error is that of an element, not that nothing fits the whole.
        let error = read("[0, \"x\", 0").unwrap_err();
        assert!(error.contains("\"x\" is not a valid number"), "{error}");
    }
}
