//! Converts an OpenMVS scene to a model in COLMAP's conventions.

use std::collections::HashMap;

use nalgebra::{Matrix3, Point3, Vector3};
use viewrank_core::model::{
    camera::{Camera, CameraModel},
    scene::{Pose, WarningKind},
};

use super::{Image, Mvs, NO_POSE};
use crate::formats::{
    Fault, Place, Problem,
    colmap::ColmapImage,
    foreign::{ForeignModel, SizeLookup, camera, fault_in, pose_with_centre, shift},
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
            let fault = |problem| fault_in(problem, || format!("image {n}"));
            let name = image.utf8_name().map_err(fault)?;
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
        let what = || format!("image {name:?}");
        let mvs = &self.platforms[image.platform as usize].cameras[image.camera as usize];
        let k = mvs.k;
        let is_known = mvs.width > 0 && mvs.height > 0;
        let known = is_known.then_some((mvs.width, mvs.height));
        let size = known.or_else(|| size_of(name));
        let (width, height) = size.ok_or_else(|| fault_in(unknown_scale(), what))?;
        // Without a resolution, K is in units of the longer side of the image.
        let unit_px = if is_known { 1 } else { width.max(height) };
        let [fx, fy, cx, cy] = [k[0], k[4], k[2], k[5]].map(|term| term * f64::from(unit_px));
        // OpenMVS's pixel centres are integers.
        let [cx, cy] = shift([cx, cy]);
        let (model, params) = (CameraModel::Pinhole, vec![fx, fy, cx, cy]);
        let found = Camera::new(id, model, width.into(), height.into(), params);
        camera(found, what)
    }

    /// World-to-camera pose: that of the platform, followed by that of the camera on the platform.
    pub fn rotation_and_centre(&self, image: &Image) -> (Matrix3<f64>, Vector3<f64>) {
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
        let cameras = foreign.model.cameras.clone();
        let images = Projection::of_images(&foreign.model.images, &cameras)?;
        let mut behind = 0;
        for (n, vertex) in self.vertices.iter().enumerate() {
            let x = Point3::from(vertex.x.map(f64::from));
            let views = vertex.views.iter();
            // `read` has checked that the scene has these images.
            let views = views.filter_map(|view| calibrated[view.image as usize]);
            let mut track = Vec::with_capacity(vertex.views.len());
            for image in views {
                match images[image].pixel(&x) {
                    Some(pixel) => track.push((image, pixel)),
                    None => behind += 1,
                }
            }
            foreign.add_point(n as u64, x.into(), self.rgb(n), track, Place::File);
        }
        warn_of_behind(foreign, behind);
        Ok(())
    }

    /// Colour of a vertex; white if the scene has none.
    fn rgb(&self, vertex: usize) -> [u8; 3] {
        // The file has blue first.
        let [b, g, r] = self.colours.get(vertex).copied().unwrap_or([255; 3]);
        [r, g, b]
    }
}

fn unknown_scale() -> Problem {
    let text = "the scale of its normalised intrinsics is unknown because the image is missing";
    Problem::Contradiction(text.into())
}

fn warn_of_behind(foreign: &mut ForeignModel, behind: usize) {
    if behind > 0 {
        let text = format!("{behind} observations of points behind their views are left out");
        foreign.warn(WarningKind::Damaged, text);
    }
}

impl Image {
    fn utf8_name(&self) -> Result<String, Problem> {
        String::from_utf8(self.name.clone()).map_err(|error| Problem::Name {
            name: String::from_utf8_lossy(error.as_bytes()).into_owned(),
            why: "is not UTF-8",
        })
    }
}

/// Pose and camera of an image.
struct Projection<'a> {
    pose: Pose,
    camera: &'a Camera,
}

impl<'a> Projection<'a> {
    fn of_images(images: &[ColmapImage], cameras: &'a [Camera]) -> Result<Vec<Self>, Fault> {
        let by_id = cameras.iter().map(|camera| (camera.id, camera));
        let by_id: HashMap<u32, &Camera> = by_id.collect();
        let of_image = |image: &ColmapImage| {
            let pose = image.cam_from_world.pose();
            Ok(Self {
                pose: pose.map_err(|problem| problem.at(Place::File))?,
                camera: by_id[&image.camera_id],
            })
        };
        images.iter().map(of_image).collect()
    }

    /// The pixel of a point in front of the camera.
    fn pixel(&self, x: &Point3<f64>) -> Option<[f64; 2]> {
        let in_camera = self.pose.camera_from_world(x);
        let pixel = self.camera.project_beyond_field(&in_camera)?;
        Some([pixel.x, pixel.y])
    }
}
