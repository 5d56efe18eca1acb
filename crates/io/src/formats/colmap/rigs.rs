//! Checks rigs and frames against the poses of the images.

use std::collections::HashMap;

use viewrank_core::model::{
    camera::Camera,
    scene::{CameraIndex, ModelWarning, Pose, View, WarningKind},
};

use super::{ColmapModel, Frame, FrameData, Rig, Sensor, StoredPose, tracks::ImageIds};
use crate::formats::{Fault, Problem};

/// Largest differences between the pose by the rig and that of the image: rotation in radians,
/// translation relative to its length.
const RIG_TOLERANCE: f64 = 1e-6;

impl ColmapModel<'_> {
    /// Checks rigs and frames, if the model has both, against the poses of the images, which are
    /// the ones used.
    pub(super) fn check_rigs(
        &self,
        views: &[View],
        view_of_image: &ImageIds,
        cameras: &HashMap<u32, CameraIndex>,
        warnings: &mut Vec<ModelWarning>,
    ) -> Result<(), Fault> {
        let Some((rigs, frames)) = self.rigs_and_frames(warnings) else {
            return Ok(());
        };
        let mut check = FrameCheck {
            rigs: rigs_by_id(rigs, cameras)?,
            views,
            view_of_image,
            cameras: &self.cameras,
            seen: vec![false; views.len()],
        };
        for frame in frames {
            check.frame(frame).map_err(|problem| {
                Fault::new("frames", frame.at, problem).in_record(|| format!("frame {}", frame.id))
            })?;
        }
        let Some(unseen) = check.seen.iter().position(|&seen| !seen) else {
            return Ok(());
        };
        let image = &self.images[views[unseen].file_position as usize];
        Err(image.fault(Problem::Contradiction(
            "the image is in no frame of the frames file".into(),
        )))
    }

    /// Rigs and frames that are to be checked; warns of one without the other.
    fn rigs_and_frames(&self, warnings: &mut Vec<ModelWarning>) -> Option<(&[Rig], &[Frame])> {
        match (&self.rigs, &self.frames) {
            (Some(rigs), Some(frames)) => {
                // Two empty files say nothing of the images.
                let is_any = !rigs.is_empty() || !frames.is_empty();
                is_any.then_some((rigs, frames))
            }
            (None, None) => None,
            _ => {
                let text = "the model has only one of the rigs and frames files, which is ignored";
                warnings.push(ModelWarning::new(WarningKind::Damaged, text));
                None
            }
        }
    }
}

/// Checks that the rigs have ids of their own, and cameras of the model.
fn rigs_by_id<'a>(
    rigs: &'a [Rig],
    cameras: &HashMap<u32, CameraIndex>,
) -> Result<HashMap<u32, &'a Rig>, Fault> {
    let mut by_id = HashMap::with_capacity(rigs.len());
    for rig in rigs {
        let fault =
            |problem| Fault::new("rigs", rig.at, problem).in_record(|| format!("rig {}", rig.id));
        let mut of_rig = rig.sensors.iter().map(|(sensor, _)| sensor);
        let is_absent =
            |sensor: &&Sensor| sensor.kind == Sensor::CAMERA && !cameras.contains_key(&sensor.id);
        if let Some(absent) = of_rig.find(is_absent) {
            return Err(fault(Problem::absent("camera", absent.id)));
        }
        if by_id.insert(rig.id, rig).is_some() {
            return Err(fault(Problem::duplicate("rig", rig.id)));
        }
    }
    Ok(by_id)
}

/// Checks the poses of frames against those of their images.
struct FrameCheck<'a> {
    rigs: HashMap<u32, &'a Rig>,
    views: &'a [View],
    view_of_image: &'a ImageIds,
    cameras: &'a [Camera],
    /// Views that a frame has.
    seen: Vec<bool>,
}

impl<'a> FrameCheck<'a> {
    fn frame(&mut self, frame: &Frame) -> Result<(), Problem> {
        let rig = *self
            .rigs
            .get(&frame.rig_id)
            .ok_or(Problem::absent("rig", frame.rig_id))?;
        let rig_from_world = frame.rig_from_world.pose()?;
        let of_cameras = |datum: &&FrameData| datum.sensor.kind == Sensor::CAMERA;
        for datum in frame.data.iter().filter(of_cameras) {
            let view = self.view_of(datum)?;
            if let Some(sensor_from_rig) = self.sensor_from_rig(rig, datum, view)? {
                let composed = compose(&sensor_from_rig.pose()?, &rig_from_world);
                check_pose(&composed, view)?;
            }
        }
        Ok(())
    }

    /// The view of an image of a frame, which is marked as seen.
    fn view_of(&mut self, datum: &FrameData) -> Result<&'a View, Problem> {
        let absent = Problem::absent("image", datum.id);
        let image_id = u32::try_from(datum.id).map_err(|_| absent.clone())?;
        let view = self.view_of_image.get(image_id).ok_or(absent)?.view;
        if std::mem::replace(&mut self.seen[view.index()], true) {
            return Err(Problem::duplicate("image", datum.id));
        }
        Ok(&self.views[view.index()])
    }

    /// The pose of the camera in its rig, if it is known; the camera must be that of the view.
    fn sensor_from_rig<'r>(
        &self,
        rig: &'r Rig,
        datum: &FrameData,
        view: &View,
    ) -> Result<Option<&'r StoredPose>, Problem> {
        let sensor = rig.sensors.iter().find(|(s, _)| *s == datum.sensor);
        let (_, sensor_from_rig) =
            sensor.ok_or(Problem::absent("camera of the rig", datum.sensor.id))?;
        if self.cameras[view.camera.index()].id != datum.sensor.id {
            return Err(Problem::Contradiction(format!(
                "image {} has camera {} in the frames file, but another one in the images file",
                datum.id, datum.sensor.id
            )));
        }
        Ok(sensor_from_rig.as_ref())
    }
}

fn check_pose(by_rig: &Pose, view: &View) -> Result<(), Problem> {
    if nearly_equal(by_rig, &view.cam_from_world) {
        return Ok(());
    }
    Err(Problem::Contradiction(format!(
        "the pose of image {} from rig and frame differs from that in the images file",
        view.image_id
    )))
}

/// a ∘ b
fn compose(a: &Pose, b: &Pose) -> Pose {
    Pose {
        rotation: a.rotation * b.rotation,
        translation: a.rotation * b.translation + a.translation,
    }
}

fn nearly_equal(a: &Pose, b: &Pose) -> bool {
    let size = 1.0 + a.translation.norm().max(b.translation.norm());
    let apart = (a.rotation.matrix() - b.rotation.matrix()).norm();
    apart < RIG_TOLERANCE && (a.translation - b.translation).norm() < RIG_TOLERANCE * size
}
