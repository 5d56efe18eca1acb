//! Converts an OpenMVS scene to a model in COLMAP's conventions.

use std::collections::HashMap;

use nalgebra::{Matrix3, Point3, Vector3};
use viewrank_core::model::{
    camera::{Camera, CameraModel},
    scene::WarningKind,
};

use super::{Image, Mvs, NO_POSE};
use crate::formats::{
    Fault, Place, Problem,
    foreign::{ForeignModel, SizeLookup, camera, pose_with_centre, shift},
};

impl Mvs {
    /// Converts the scene. Image ids are the scene's. Pixels of observations are projections, since
    /// the scene has no measured ones. `size_of` is called for intrinsics without a resolution.
    pub fn model(&self, size_of: SizeLookup) -> Result<ForeignModel, Fault> {
        let mut foreign = ForeignModel::default();
        let mut cameras = HashMap::new();
        // Index in the scene's list of images to index in the model.
        let mut calibrated = vec![None; self.images.len()];
        for (n, image) in self.images.iter().enumerate() {
            let fault =
                |problem| Fault::new("", Place::File, problem).in_record(|| format!("image {n}"));
            let name = String::from_utf8(image.name.clone());
            let name = name.map_err(|error| {
                let name = String::from_utf8_lossy(error.as_bytes()).into_owned();
                fault(Problem::Name {
                    name,
                    why: "is not UTF-8",
                })
            })?;
            if image.pose == NO_POSE {
                foreign.unregistered.push(name);
                continue;
            }
            let next = foreign.model.cameras.len() as u32 + 1;
            let camera_id = *cameras
                .entry((image.platform, image.camera))
                .or_insert(next);
            if camera_id == next {
                foreign
                    .model
                    .cameras
                    .push(self.camera_of(image, camera_id, &name, size_of)?);
            }
            let (rotation, centre) = self.rotation_and_centre(image);
            let pose = pose_with_centre(rotation, centre).map_err(fault)?;
            calibrated[n] = Some(foreign.model.images.len());
            foreign.add_image(image.id, name, camera_id, pose, Place::File);
        }
        self.add_points(&mut foreign, &calibrated)?;
        foreign.shorten_names();
        Ok(foreign)
    }

    fn camera_of(
        &self,
        image: &Image,
        id: u32,
        name: &str,
        size_of: SizeLookup,
    ) -> Result<Camera, Fault> {
        let mvs = &self.platforms[image.platform as usize].cameras[image.camera as usize];
        let k = mvs.k;
        let known = (mvs.width > 0 && mvs.height > 0).then_some((mvs.width, mvs.height));
        // Without a resolution, K is in units of the longer side of the image.
        let size = known.or_else(|| size_of(name)).ok_or_else(|| {
            let message =
                "the scale of its normalised intrinsics is unknown because the image is missing";
            Fault::new("", Place::File, Problem::Contradiction(message.into()))
                .in_record(|| format!("image {name:?}"))
        })?;
        let scale = if known.is_some() {
            1.0
        } else {
            f64::from(size.0.max(size.1))
        };
        let [cx, cy] = shift([k[2] * scale, k[5] * scale]);
        let params = vec![k[0] * scale, k[4] * scale, cx, cy];
        camera(
            Camera::new(
                id,
                CameraModel::Pinhole,
                size.0.into(),
                size.1.into(),
                params,
            ),
            || format!("image {name:?}"),
        )
    }

    /// World-to-camera pose: that of the platform, followed by that of the camera on the platform.
    fn rotation_and_centre(&self, image: &Image) -> (Matrix3<f64>, Vector3<f64>) {
        let platform = &self.platforms[image.platform as usize];
        let (camera, pose) = (
            &platform.cameras[image.camera as usize],
            &platform.poses[image.pose as usize],
        );
        let platform_rotation = Matrix3::from_row_slice(&pose.r);
        let rotation = Matrix3::from_row_slice(&camera.r) * platform_rotation;
        let centre =
            platform_rotation.transpose() * Vector3::from(camera.c) + Vector3::from(pose.c);
        (rotation, centre)
    }

    fn add_points(
        &self,
        foreign: &mut ForeignModel,
        calibrated: &[Option<usize>],
    ) -> Result<(), Fault> {
        let cameras: HashMap<u32, Camera> = foreign
            .model
            .cameras
            .iter()
            .map(|c| (c.id, c.clone()))
            .collect();
        let mut views = Vec::with_capacity(foreign.model.images.len());
        for image in &foreign.model.images {
            let pose = image
                .cam_from_world
                .pose()
                .map_err(|problem| Fault::new("", Place::File, problem))?;
            views.push((pose, &cameras[&image.camera_id]));
        }
        let mut behind = 0;
        for (n, vertex) in self.vertices.iter().enumerate() {
            let x = Point3::from(vertex.x.map(f64::from));
            let mut track = Vec::with_capacity(vertex.views.len());
            for image in vertex
                .views
                .iter()
                .filter_map(|view| calibrated[view.image as usize])
            {
                let (pose, camera) = &views[image];
                match camera.project_beyond_field(&pose.camera_from_world(&x)) {
                    Some(pixel) => track.push((image, [pixel.x, pixel.y])),
                    None => behind += 1,
                }
            }
            let [b, g, r] = self.colours.get(n).copied().unwrap_or([255; 3]);
            foreign.add_point(n as u64, x.into(), [r, g, b], track, Place::File);
        }
        if behind > 0 {
            let text = format!("{behind} observations of points behind their views are left out");
            foreign.warn(WarningKind::Damaged, text);
        }
        Ok(())
    }
}
