//! Checks rigs and frames against the poses of the images.

use std::collections::HashMap;

use viewrank_core::model::{
    camera::Camera,
    scene::{CameraIndex, ModelWarning, Pose, View, WarningKind},
};

use super::{ColmapModel, Frame, Rig, Sensor, tracks::ImageIds};
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
        let (rigs, frames) = match (&self.rigs, &self.frames) {
            (Some(rigs), Some(frames)) => (rigs, frames),
            (None, None) => return Ok(()),
            _ => {
                let text = "the model has only one of the rigs and frames files, which is ignored";
                warnings.push(ModelWarning::new(WarningKind::Damaged, text));
                return Ok(());
            }
        };
        if rigs.is_empty() && frames.is_empty() {
            return Ok(());
        }
        let mut by_id = HashMap::with_capacity(rigs.len());
        for rig in rigs {
            let fault = |problem| {
                Fault::new("rigs", rig.at, problem).in_record(|| format!("rig {}", rig.id))
            };
            let cameras_of_rig = rig.sensors.iter().filter(|(s, _)| s.kind == Sensor::CAMERA);
            if let Some((absent, _)) = cameras_of_rig
                .into_iter()
                .find(|(s, _)| !cameras.contains_key(&s.id))
            {
                return Err(fault(Problem::Absent {
                    what: "camera",
                    id: absent.id.into(),
                }));
            }
            if by_id.insert(rig.id, rig).is_some() {
                return Err(fault(Problem::Duplicate {
                    what: "rig",
                    id: rig.id.to_string(),
                }));
            }
        }
        let mut seen = vec![false; views.len()];
        for frame in frames {
            let check = frame.check(&by_id, views, view_of_image, &self.cameras, &mut seen);
            check.map_err(|p| {
                Fault::new("frames", frame.at, p).in_record(|| format!("frame {}", frame.id))
            })?;
        }
        match seen.iter().position(|&seen| !seen) {
            None => Ok(()),
            Some(view) => {
                let image = &self.images[views[view].file_position as usize];
                Err(image.fault(Problem::Contradiction(
                    "the image is in no frame of the frames file".into(),
                )))
            }
        }
    }
}

impl Frame {
    /// Checks the frame's pose against those of its images, and marks the images as seen.
    fn check(
        &self,
        rigs: &HashMap<u32, &Rig>,
        views: &[View],
        view_of_image: &ImageIds,
        cameras: &[Camera],
        seen: &mut [bool],
    ) -> Result<(), Problem> {
        let rig = rigs.get(&self.rig_id).ok_or(Problem::Absent {
            what: "rig",
            id: self.rig_id.into(),
        })?;
        let rig_from_world = self.rig_from_world.pose()?;
        for datum in self.data.iter().filter(|d| d.sensor.kind == Sensor::CAMERA) {
            let absent = Problem::Absent {
                what: "image",
                id: datum.id,
            };
            let image_id = u32::try_from(datum.id).map_err(|_| absent.clone())?;
            let view = view_of_image.get(image_id).ok_or(absent)?.view;
            if std::mem::replace(&mut seen[view.index()], true) {
                return Err(Problem::Duplicate {
                    what: "image",
                    id: datum.id.to_string(),
                });
            }
            let view = &views[view.index()];
            let sensor = rig.sensors.iter().find(|(s, _)| *s == datum.sensor);
            let (_, sensor_from_rig) = sensor.ok_or(Problem::Absent {
                what: "camera of the rig",
                id: datum.sensor.id.into(),
            })?;
            if cameras[view.camera.index()].id != datum.sensor.id {
                let message = format!(
                    "image {image_id} has camera {} in the frames file",
                    datum.sensor.id
                );
                return Err(Problem::Contradiction(format!(
                    "{message}, but another one in the images file"
                )));
            }
            let Some(sensor_from_rig) = sensor_from_rig else {
                continue;
            };
            let composed = compose(&sensor_from_rig.pose()?, &rig_from_world);
            if !nearly_equal(&composed, &view.cam_from_world) {
                let message = format!(
                    "the pose of image {image_id} from rig and frame differs from that in the images file"
                );
                return Err(Problem::Contradiction(message));
            }
        }
        Ok(())
    }
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
