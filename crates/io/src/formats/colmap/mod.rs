//! A COLMAP model as stored in its files, binary or text, and its conversion to a [`Scene`].
//!
//! The conversion checks cross-references by COLMAP's rules (`reconstruction.cc`), with two
//! differences: quaternions are normalised, and if a track and the image's list of 2D points
//! disagree, the list wins, because OpenMVG and AliceVision write *feature* numbers into the
//! tracks.

mod reduce;
mod rigs;
mod tracks;

use std::{borrow::Cow, collections::HashMap};

use nalgebra::{Point3, Quaternion, UnitQuaternion, Vector3};
use rayon::prelude::*;
use viewrank_core::model::{
    camera::Camera,
    scene::{CameraIndex, ModelWarning, Pose, Scene, View, WarningKind},
};

pub use self::reduce::ImageUse;
use self::tracks::{ImageIds, ImageLists};
use super::{Fault, Place, Problem, check_name};

/// The complete contents of the files of a model, in file order. Lists of 2D points and tracks may
/// borrow from the files' bytes.
#[derive(Clone, Debug, Default)]
pub struct ColmapModel<'a> {
    pub cameras: Vec<Camera>,
    pub images: Vec<ColmapImage<'a>>,
    pub points: Vec<ColmapPoint<'a>>,
    /// `None` without such a file (before COLMAP 4.0).
    pub rigs: Option<Vec<Rig>>,
    pub frames: Option<Vec<Frame>>,
    /// Problems that did not prevent reading.
    pub warnings: Vec<ModelWarning>,
}

#[derive(Clone, Debug)]
pub struct ColmapImage<'a> {
    pub id: u32,
    pub cam_from_world: StoredPose,
    pub camera_id: u32,
    pub name: Cow<'a, str>,
    pub points2d: Cow<'a, [Point2d]>,
    /// Position of its record.
    pub at: Place,
}

#[derive(Clone, Debug)]
pub struct ColmapPoint<'a> {
    pub id: u64,
    pub xyz: [f64; 3],
    /// R G B
    pub colour: [u8; 3],
    /// Mean reprojection error as stored, pixels; -1 if unknown.
    pub error: f64,
    pub track: Cow<'a, [TrackElement]>,
    /// Position of its record.
    pub at: Place,
}

/// A rigid transform as stored: a quaternion w x y z, not necessarily of unit length, and a
/// translation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StoredPose {
    pub quaternion: [f64; 4],
    pub translation: [f64; 3],
}

impl StoredPose {
    pub const IDENTITY: Self = Self {
        quaternion: [1.0, 0.0, 0.0, 0.0],
        translation: [0.0; 3],
    };

    /// Normalises the quaternion.
    pub fn pose(&self) -> Result<Pose, Problem> {
        if !self
            .translation
            .iter()
            .chain(&self.quaternion)
            .all(|v| v.is_finite())
        {
            return Err(Problem::NotFinite("the pose"));
        }
        // Divided by the largest component first: squares of tiny or huge components would
        // underflow or overflow.
        let scale = self
            .quaternion
            .iter()
            .fold(0.0f64, |max, q| max.max(q.abs()));
        if scale == 0.0 {
            return Err(Problem::ZeroQuaternion);
        }
        let [w, x, y, z] = self.quaternion.map(|q| q / scale);
        let rotation =
            UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)).to_rotation_matrix();
        Ok(Pose {
            rotation,
            translation: Vector3::from(self.translation),
        })
    }
}

impl From<&Pose> for StoredPose {
    fn from(pose: &Pose) -> Self {
        let q = UnitQuaternion::from_rotation_matrix(&pose.rotation);
        Self {
            quaternion: [q.w, q.i, q.j, q.k],
            translation: pose.translation.into(),
        }
    }
}

/// An entry of an image's list of 2D points; laid out as in the binary file (24 bytes).
#[derive(Clone, Copy, Debug, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub struct Point2d {
    // Bytes, since the records of a file begin anywhere.
    x: [u8; 8],
    y: [u8; 8],
    point: [u8; 8],
}

impl Point2d {
    /// COLMAP's value for "no point".
    const NO_POINT: u64 = u64::MAX;

    pub fn new(pixel: [f64; 2], point: Option<u64>) -> Self {
        let point = point.unwrap_or(Self::NO_POINT).to_le_bytes();
        Self {
            x: pixel[0].to_le_bytes(),
            y: pixel[1].to_le_bytes(),
            point,
        }
    }

    pub fn pixel(&self) -> [f64; 2] {
        [f64::from_le_bytes(self.x), f64::from_le_bytes(self.y)]
    }

    /// Id of the observed sparse point.
    pub fn point(&self) -> Option<u64> {
        Some(u64::from_le_bytes(self.point)).filter(|&id| id != Self::NO_POINT)
    }
}

/// An entry of a track: an image id and an index into that image's list of 2D points; laid out as
/// in the binary file (8 bytes).
#[derive(Clone, Copy, Debug, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub struct TrackElement {
    image: [u8; 4],
    index: [u8; 4],
}

impl TrackElement {
    pub fn new(image: u32, index: u32) -> Self {
        Self {
            image: image.to_le_bytes(),
            index: index.to_le_bytes(),
        }
    }

    pub fn image(&self) -> u32 {
        u32::from_le_bytes(self.image)
    }

    pub fn index(&self) -> u32 {
        u32::from_le_bytes(self.index)
    }
}

/// A camera or other sensor of a rig.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Sensor {
    /// [`Sensor::CAMERA`], 1 for an IMU.
    pub kind: i32,
    /// The camera id.
    pub id: u32,
}

impl Sensor {
    pub const CAMERA: i32 = 0;
    pub const IMU: i32 = 1;
}

#[derive(Clone, Debug, PartialEq)]
pub struct Rig {
    pub id: u32,
    /// The reference sensor first; `sensor_from_rig` of the others, if known.
    pub sensors: Vec<(Sensor, Option<StoredPose>)>,
    pub at: Place,
}

#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    pub id: u32,
    pub rig_id: u32,
    pub rig_from_world: StoredPose,
    pub data: Vec<FrameData>,
    pub at: Place,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FrameData {
    pub sensor: Sensor,
    /// The image id, for a camera.
    pub id: u64,
}

impl ColmapModel<'_> {
    pub fn warn(&mut self, kind: WarningKind, text: impl AsRef<str>) {
        self.warnings.push(ModelWarning::new(kind, text));
    }

    /// Converts the model to a scene.
    ///
    /// # Errors
    /// The first invalid reference, pose or name.
    pub fn scene(&self) -> Result<Scene, Fault> {
        let mut warnings = self.warnings.clone();
        let cameras = self.cameras_by_id()?;
        let (views, view_of_image) = self.views(&cameras)?;
        self.check_rigs(&views, &view_of_image, &cameras, &mut warnings)?;
        self.check_point_ids()?;
        let lists = ImageLists::new(&self.images, &view_of_image);
        let tracks = self.tracks(&lists)?;
        warnings.extend(lists.warnings(tracks.views.len()));
        let points = self.points.par_iter();
        Ok(Scene {
            cameras: self.cameras.clone(),
            views,
            points: points.clone().map(|p| Point3::from(p.xyz)).collect(),
            point_ids: points.clone().map(|p| p.id).collect(),
            colours: points.map(|p| p.colour).collect(),
            track_offsets: tracks.offsets,
            track_views: tracks.views,
            track_pixels: tracks.pixels,
            warnings,
            ..Scene::default()
        })
    }

    fn cameras_by_id(&self) -> Result<HashMap<u32, CameraIndex>, Fault> {
        let mut by_id = HashMap::with_capacity(self.cameras.len());
        for (index, camera) in self.cameras.iter().enumerate() {
            if by_id.insert(camera.id, CameraIndex(index as u32)).is_some() {
                let problem = Problem::duplicate("camera", camera.id);
                return Err(Fault::new("cameras", Place::File, problem));
            }
        }
        Ok(by_id)
    }

    /// The views sorted by name, and for each image id the index of the image in the file and its
    /// view.
    fn views(&self, cameras: &HashMap<u32, CameraIndex>) -> Result<(Vec<View>, ImageIds), Fault> {
        let mut views = Vec::with_capacity(self.images.len());
        for (position, image) in self.images.iter().enumerate() {
            let view = image.view(position as u32, cameras);
            views.push(view.map_err(|problem| image.fault(problem))?);
        }
        // Indices of views must not depend on the order of the file: equal results are ordered by
        // them.
        views.sort_by(|a, b| a.name.cmp(&b.name));
        if let Some(same) = views.windows(2).find(|pair| pair[0].name == pair[1].name) {
            return Err(self.duplicate("image name", same[1].name.clone(), &same[1]));
        }
        let ids = ImageIds::new(&views).map_err(|index| {
            let view = &views[index as usize];
            self.duplicate("image", view.image_id.to_string(), view)
        })?;
        Ok((views, ids))
    }

    /// The fault of a view whose image has the name or the id of another one.
    fn duplicate(&self, what: &'static str, id: String, view: &View) -> Fault {
        self.images[view.file_position as usize].fault(Problem::Duplicate { what, id })
    }

    fn check_point_ids(&self) -> Result<(), Fault> {
        // Strictly ascending ids cannot repeat, which saves sorting millions of them.
        if self
            .points
            .par_windows(2)
            .all(|pair| pair[0].id < pair[1].id)
        {
            return Ok(());
        }
        let mut order: Vec<usize> = (0..self.points.len()).collect();
        order.par_sort_unstable_by_key(|&p| (self.points[p].id, p));
        // The first in the file, whatever its id, as in a reading from start to end.
        let twice = order
            .windows(2)
            .filter(|w| self.points[w[0]].id == self.points[w[1]].id)
            .map(|w| w[1])
            .min();
        twice.map_or(Ok(()), |p| {
            let point = &self.points[p];
            Err(point.fault(Problem::duplicate("point", point.id)))
        })
    }
}

impl ColmapImage<'_> {
    fn fault(&self, problem: Problem) -> Fault {
        Fault::new("images", self.at, problem)
            .in_record(|| format!("image {}, {:?}", self.id, self.name))
    }

    fn view(&self, position: u32, cameras: &HashMap<u32, CameraIndex>) -> Result<View, Problem> {
        check_name(&self.name)?;
        let absent = Problem::absent("camera", self.camera_id);
        Ok(View {
            name: self.name.clone().into_owned(),
            image_id: self.id,
            file_position: position,
            camera: *cameras.get(&self.camera_id).ok_or(absent)?,
            cam_from_world: self.cam_from_world.pose()?,
        })
    }
}

impl ColmapPoint<'_> {
    fn fault(&self, problem: Problem) -> Fault {
        Fault::new("points3D", self.at, problem).in_record(|| format!("point {}", self.id))
    }
}
