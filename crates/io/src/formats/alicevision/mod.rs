//! AliceVision's SfMData (`.sfm`, `.json`; Meshroom), versions 1.0 to 1.2: JSON in which every
//! number is a string.
//!
//! Poses are a world-to-camera rotation in *column-major* order and a centre; axes as in COLMAP;
//! the centre of the first pixel is (0, 0). Since 1.2.2 focal lengths are in millimetres on the
//! sensor, since 1.2.1 principal points are relative to the image centre. Views of a rig have the
//! rig's pose and a pose within the rig.

mod lens;
mod values;

use std::collections::{HashMap, HashSet};

use nalgebra::{Matrix3, Vector3};
use serde::Deserialize;
use viewrank_core::model::scene::WarningKind;

use self::{
    lens::Intrinsic,
    values::{List, Number},
};
use super::{
    Fault, MOST_IMAGES, Place, Problem,
    foreign::{ForeignModel, fault_in, json_object, pose_with_centre, shift},
};

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
    // Misspelt as in the file.
    is_pose_independant: Option<Number<bool>>,
    #[serde(default)]
    path: String,
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

/// World to camera.
type RigidMotion = (Matrix3<f64>, Vector3<f64>);

impl Motion {
    fn rotation_and_centre(&self) -> Result<RigidMotion, Problem> {
        let rotation = Matrix3::from_column_slice(&self.rotation.numbers::<9>("rotation")?);
        Ok((rotation, Vector3::from(self.center.numbers::<3>("center")?)))
    }
}

pub fn read(bytes: &[u8]) -> Result<ForeignModel, Fault> {
    let data: SfmData = json_object(bytes, "an object with \"views\" and \"poses\"")?;
    let version: Vec<u32> = data.version.0.iter().map(|n| n.0).collect();
    let mut foreign = ForeignModel::default();
    let cameras = data.intrinsics.0.iter().map(|one| one.camera(&version));
    foreign.model.cameras = cameras.collect::<Result<_, _>>()?;
    let images = data.add_images(&mut foreign)?;
    for landmark in &data.structure.0 {
        landmark.add_to(&mut foreign, &images).map_err(|problem| {
            fault_in(problem, || format!("landmark {}", landmark.landmark_id.0))
        })?;
    }
    foreign.shorten_names();
    Ok(foreign)
}

impl SfmData {
    /// Adds the views with a pose and a camera; returns the position in the model of each, by id.
    fn add_images(&self, foreign: &mut ForeignModel) -> Result<HashMap<u32, usize>, Fault> {
        let parts = PartsById::new(self);
        let mut images = HashMap::new();
        for view in &self.views.0 {
            let id = view.view_id.0;
            let fault = |problem| fault_in(problem, || format!("view {id}"));
            let motion = view.motion(&parts).map_err(fault)?;
            let camera_id = view.intrinsic_id.map(|id| id.0);
            let camera_id = camera_id.filter(|id| parts.intrinsics.contains(id));
            let Some(((rotation, centre), camera_id)) = motion.zip(camera_id) else {
                foreign.unregistered.push(view.name());
                continue;
            };
            images.insert(id, foreign.model.images.len());
            let pose = pose_with_centre(rotation, centre).map_err(fault)?;
            foreign.add_image(id, view.name(), camera_id, pose, Place::File);
        }
        self.warn_of_nameless(foreign);
        Ok(images)
    }

    fn warn_of_nameless(&self, foreign: &mut ForeignModel) {
        let views = self.views.0.iter();
        let nameless = views.filter(|view| view.path.is_empty()).count();
        if nameless > 0 {
            foreign.warn(
                WarningKind::Format,
                format!("{nameless} views without a path are named by their ids"),
            );
        }
    }
}

/// The parts to which views refer.
struct PartsById<'a> {
    poses: HashMap<u32, &'a Motion>,
    rigs: HashMap<u32, &'a Rig>,
    intrinsics: HashSet<u32>,
}

impl<'a> PartsById<'a> {
    fn new(data: &'a SfmData) -> Self {
        let (poses, rigs) = (data.poses.0.iter(), data.rigs.0.iter());
        let poses = poses.map(|entry| (entry.pose_id.0, &entry.pose.transform));
        let intrinsics = data.intrinsics.0.iter();
        Self {
            poses: poses.collect(),
            rigs: rigs.map(|rig| (rig.rig_id.0, rig)).collect(),
            intrinsics: intrinsics.map(|one| one.intrinsic_id.0).collect(),
        }
    }
}

impl View {
    fn name(&self) -> String {
        if self.path.is_empty() {
            format!("view_{}", self.view_id.0)
        } else {
            self.path.clone()
        }
    }

    /// Rotation and centre of a view; `None` without a pose.
    fn motion(&self, parts: &PartsById) -> Result<Option<RigidMotion>, Problem> {
        // Without a pose id, the view's own id is its pose's id.
        let pose_id = self.pose_id.unwrap_or(self.view_id).0;
        let Some(motion) = parts.poses.get(&pose_id) else {
            return Ok(None);
        };
        let (rotation, centre) = motion.rotation_and_centre()?;
        let Some(sub_pose) = self.sub_pose(&parts.rigs)? else {
            return Ok(Some((rotation, centre)));
        };
        // x_cam = R_sub (R (X - c) - c_sub)
        let (sub_rotation, sub_centre) = sub_pose.rotation_and_centre()?;
        Ok(Some((
            sub_rotation * rotation,
            centre + rotation.transpose() * sub_centre,
        )))
    }

    /// The pose within the rig, of a view whose pose is that of its rig.
    fn sub_pose<'a>(&self, rigs: &HashMap<u32, &'a Rig>) -> Result<Option<&'a Motion>, Problem> {
        let independent = self.is_pose_independant.is_none_or(|flag| flag.0);
        let in_rig = self.rig_id.zip(self.sub_pose_id);
        let Some((Number(rig_id), Number(index))) = in_rig.filter(|_| !independent) else {
            return Ok(None);
        };
        let rig = rigs.get(&rig_id);
        let sub_pose = rig.and_then(|rig| rig.sub_poses.0.get(index));
        let absent = Problem::absent("rig", rig_id);
        Ok(Some(&sub_pose.ok_or(absent)?.pose))
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
