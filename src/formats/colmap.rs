//! A COLMAP model as its files hold it, whether binary or text, and the [`Scene`] made from it.
//!
//! Cross-references are checked here: COLMAP's own rules (`reconstruction.cc`), with two differences. Quaternions are
//! normalised. And where a track names another 2D point than the image's own list does, the list decides: OpenMVG and
//! AliceVision write the number of the *feature* into the tracks.

use std::{
    borrow::Cow,
    collections::{HashMap, HashSet},
    sync::{
        OnceLock,
        atomic::{AtomicUsize, Ordering},
    },
};

use nalgebra::{Point3, Quaternion, UnitQuaternion, Vector3};
use rayon::prelude::*;

use super::{Fault, Place, Problem, check_name};
use crate::{
    camera::Camera,
    scene::{CameraIndex, PointIndex, Pose, Scene, View, ViewIndex, mean},
};

/// All files of a model, in file order, nothing dropped. Lists of 2D points and tracks may point into the files' bytes.
#[derive(Clone, Debug, Default)]
pub struct ColmapModel<'a> {
    pub cameras: Vec<Camera>,
    pub images: Vec<ColmapImage<'a>>,
    pub points: Vec<ColmapPoint<'a>>,
    /// `None` where there is no such file (before COLMAP 4.0).
    pub rigs: Option<Vec<Rig>>,
    pub frames: Option<Vec<Frame>>,
    /// What was odd, but readable.
    pub warnings: Vec<String>,
}

#[derive(Clone, Debug)]
pub struct ColmapImage<'a> {
    pub id: u32,
    pub cam_from_world: StoredPose,
    pub camera_id: u32,
    pub name: Cow<'a, str>,
    pub points2d: Cow<'a, [Point2d]>,
    /// Where its record is.
    pub at: Place,
}

#[derive(Clone, Debug)]
pub struct ColmapPoint<'a> {
    pub id: u64,
    pub xyz: [f64; 3],
    /// R G B
    pub colour: [u8; 3],
    /// Mean reprojection error in pixels as stored; -1 where unknown.
    pub error: f64,
    pub track: Cow<'a, [TrackElement]>,
    /// Where its record is.
    pub at: Place,
}

/// A rigid motion as the files hold it: w x y z, not necessarily of length one, and a translation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StoredPose {
    pub quaternion: [f64; 4],
    pub translation: [f64; 3],
}

impl StoredPose {
    pub const IDENTITY: Self = Self { quaternion: [1.0, 0.0, 0.0, 0.0], translation: [0.0; 3] };

    /// With the quaternion normalised.
    pub fn pose(&self) -> Result<Pose, Problem> {
        if !self.translation.iter().chain(&self.quaternion).all(|v| v.is_finite()) {
            return Err(Problem::NotFinite("the pose"));
        }
        // The largest component first: the squares of tiny or huge ones leave the range of numbers.
        let scale = self.quaternion.iter().fold(0.0f64, |max, q| max.max(q.abs()));
        if scale == 0.0 {
            return Err(Problem::ZeroQuaternion);
        }
        let [w, x, y, z] = self.quaternion.map(|q| q / scale);
        let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)).to_rotation_matrix();
        Ok(Pose { rotation, translation: Vector3::from(self.translation) })
    }
}

impl From<&Pose> for StoredPose {
    fn from(pose: &Pose) -> Self {
        let q = UnitQuaternion::from_rotation_matrix(&pose.rotation);
        Self { quaternion: [q.w, q.i, q.j, q.k], translation: pose.translation.into() }
    }
}

/// An entry of an image's list of 2D points, as the 24 bytes of the binary file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub struct Point2d {
    x: [u8; 8],
    y: [u8; 8],
    point: [u8; 8],
}

impl Point2d {
    /// COLMAP's number for "no point".
    const NO_POINT: u64 = u64::MAX;

    pub fn new(pixel: [f64; 2], point: Option<u64>) -> Self {
        let point = point.unwrap_or(Self::NO_POINT).to_le_bytes();
        Self { x: pixel[0].to_le_bytes(), y: pixel[1].to_le_bytes(), point }
    }

    pub fn pixel(&self) -> [f64; 2] {
        [f64::from_le_bytes(self.x), f64::from_le_bytes(self.y)]
    }

    /// Id of the sparse point that it observes.
    pub fn point(&self) -> Option<u64> {
        Some(u64::from_le_bytes(self.point)).filter(|&id| id != Self::NO_POINT)
    }
}

/// An entry of a track, as the 8 bytes of the binary file: an image id and a position in that image's list of 2D points.
#[derive(Clone, Copy, Debug, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub struct TrackElement {
    image: [u8; 4],
    index: [u8; 4],
}

impl TrackElement {
    pub fn new(image: u32, index: u32) -> Self {
        Self { image: image.to_le_bytes(), index: index.to_le_bytes() }
    }

    pub fn image(&self) -> u32 {
        u32::from_le_bytes(self.image)
    }

    pub fn index(&self) -> u32 {
        u32::from_le_bytes(self.index)
    }
}

/// A camera or another instrument of a rig.
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
    /// The reference sensor first; `sensor_from_rig` of the others where it is known.
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

/// Rotation (radians) and position (relative to the size of the translation) by which a rig's pose may differ from the image's.
const RIG_TOLERANCE: f64 = 1e-6;
/// Points per piece of work.
const CHUNK: usize = 4096;
/// Points whose 2D points are brought into the processor's cache at a time: a few hundred kilobytes.
const WARMED: usize = 256;

impl ColmapModel<'_> {
    /// The scene, with all references checked.
    pub fn scene(&self) -> Result<Scene, Fault> {
        let mut warnings = self.warnings.clone();
        let cameras = self.cameras_by_id()?;
        let (views, view_of_image) = self.views(&cameras)?;
        self.check_rigs(&views, &view_of_image, &cameras, &mut warnings)?;
        self.check_point_ids()?;
        let lists = ImageLists::new(&self.images, &view_of_image);
        let tracks = self.tracks(&lists)?;
        warnings.extend(lists.warning(tracks.views.len()));
        Ok(Scene {
            cameras: self.cameras.clone(),
            views,
            points: self.points.par_iter().map(|p| Point3::from(p.xyz)).collect(),
            point_ids: self.points.par_iter().map(|p| p.id).collect(),
            colours: self.points.par_iter().map(|p| p.colour).collect(),
            track_offsets: tracks.offsets,
            track_views: tracks.views,
            track_pixels: tracks.pixels,
            unregistered: Vec::new(),
            warnings,
        })
    }

    fn cameras_by_id(&self) -> Result<HashMap<u32, CameraIndex>, Fault> {
        let mut by_id = HashMap::with_capacity(self.cameras.len());
        for (index, camera) in self.cameras.iter().enumerate() {
            if by_id.insert(camera.id, CameraIndex(index as u32)).is_some() {
                let problem = Problem::Duplicate { what: "camera", id: camera.id.to_string() };
                return Err(Fault::new("cameras", Place::File, problem));
            }
        }
        Ok(by_id)
    }

    /// The views sorted by name, and for each image id the position of the image in the file and its view.
    fn views(&self, cameras: &HashMap<u32, CameraIndex>) -> Result<(Vec<View>, ImageIds), Fault> {
        let mut views = Vec::with_capacity(self.images.len());
        for (position, image) in self.images.iter().enumerate() {
            let view = image.view(position as u32, cameras);
            views.push(view.map_err(|problem| image.fault(problem))?);
        }
        views.sort_by(|a, b| a.name.cmp(&b.name));
        if let Some(same) = views.windows(2).find(|pair| pair[0].name == pair[1].name) {
            let problem = Problem::Duplicate { what: "image name", id: same[1].name.clone() };
            return Err(self.images[same[1].file_position as usize].fault(problem));
        }
        let ids = ImageIds::new(&views).map_err(|index| {
            let view = &views[index as usize];
            let problem = Problem::Duplicate { what: "image", id: view.image_id.to_string() };
            self.images[view.file_position as usize].fault(problem)
        })?;
        Ok((views, ids))
    }

    /// Compares rigs and frames, where there are both, with the poses of the images, which decide.
    fn check_rigs(
        &self,
        views: &[View],
        view_of_image: &ImageIds,
        cameras: &HashMap<u32, CameraIndex>,
        warnings: &mut Vec<String>,
    ) -> Result<(), Fault> {
        let (rigs, frames) = match (&self.rigs, &self.frames) {
            (Some(rigs), Some(frames)) => (rigs, frames),
            (None, None) => return Ok(()),
            _ => {
                warnings.push("only one of the rigs and the frames file is there; it is ignored".into());
                return Ok(());
            }
        };
        if rigs.is_empty() && frames.is_empty() {
            return Ok(());
        }
        let mut by_id = HashMap::with_capacity(rigs.len());
        for rig in rigs {
            let fault = |problem| Fault::new("rigs", rig.at, problem).in_record(|| format!("rig {}", rig.id));
            let cameras_of_rig = rig.sensors.iter().filter(|(s, _)| s.kind == Sensor::CAMERA);
            if let Some((absent, _)) = cameras_of_rig.into_iter().find(|(s, _)| !cameras.contains_key(&s.id)) {
                return Err(fault(Problem::Absent { what: "camera", id: absent.id.into() }));
            }
            if by_id.insert(rig.id, rig).is_some() {
                return Err(fault(Problem::Duplicate { what: "rig", id: rig.id.to_string() }));
            }
        }
        let mut seen = vec![false; views.len()];
        for frame in frames {
            let check = frame.check(&by_id, views, view_of_image, &self.cameras, &mut seen);
            check.map_err(|p| Fault::new("frames", frame.at, p).in_record(|| format!("frame {}", frame.id)))?;
        }
        match seen.iter().position(|&seen| !seen) {
            None => Ok(()),
            Some(view) => {
                let image = &self.images[views[view].file_position as usize];
                Err(image.fault(Problem::Contradiction("no frame of the frames file holds this image".into())))
            }
        }
    }

    fn check_point_ids(&self) -> Result<(), Fault> {
        if self.points.is_sorted_by(|a, b| a.id < b.id) {
            return Ok(());
        }
        let mut order: Vec<usize> = (0..self.points.len()).collect();
        order.par_sort_unstable_by_key(|&p| (self.points[p].id, p));
        let twice = order.windows(2).filter(|w| self.points[w[0]].id == self.points[w[1]].id).map(|w| w[1]).min();
        twice.map_or(Ok(()), |p| {
            let point = &self.points[p];
            Err(point.fault(Problem::Duplicate { what: "point", id: point.id.to_string() }))
        })
    }

    /// Views and pixels of all observations; pieces of the arrays are filled in parallel.
    fn tracks(&self, lists: &ImageLists) -> Result<Tracks, Fault> {
        let mut offsets = Vec::with_capacity(self.points.len() + 1);
        offsets.push(0);
        for point in &self.points {
            offsets.push(offsets[offsets.len() - 1] + point.track.len());
        }
        let total = offsets[self.points.len()];
        let (mut views, mut pixels) = (vec![ViewIndex(0); total], vec![[0.0; 2]; total]);
        let mut pieces = Vec::with_capacity(self.points.len() / CHUNK + 1);
        let (mut views_left, mut pixels_left) = (&mut views[..], &mut pixels[..]);
        for points in self.points.chunks(CHUNK) {
            let n = points.iter().map(|p| p.track.len()).sum();
            let (piece_views, piece_pixels);
            (piece_views, views_left) = views_left.split_at_mut(n);
            (piece_pixels, pixels_left) = pixels_left.split_at_mut(n);
            pieces.push((points, piece_views, piece_pixels));
        }
        let fill = |(points, views, pixels)| fill_piece(points, lists, views, pixels);
        let results: Vec<Result<(), Fault>> = pieces.into_par_iter().map(fill).collect();
        // The first fault of the file, whichever thread was first.
        results.into_iter().collect::<Result<(), Fault>>()?;
        Ok(Tracks { offsets, views, pixels })
    }

    /// The model reduced to some of its images. Ids stay, and so do the kept images' lists of 2D points, in which dropped
    /// points become "no point"; points keep the kept part of their tracks and go when fewer than `min_views` kept images
    /// observe them; cameras that no image uses go. Rigs and frames are left out: those of the whole model would contradict.
    pub fn reduced(&self, keep: impl Fn(&ColmapImage) -> bool, min_views: usize) -> Result<ColmapModel<'_>, Fault> {
        let (_, view_of_image) = self.views(&self.cameras_by_id()?)?;
        let lists = ImageLists::new(&self.images, &view_of_image);
        let kept: Vec<bool> = self.images.iter().map(keep).collect();
        let points = self.points.iter().map(|point| point.reduced(&lists, &kept, min_views));
        let points: Vec<ColmapPoint> = points.filter_map(Result::transpose).collect::<Result<_, _>>()?;
        let ids: HashSet<u64> = points.iter().map(|point| point.id).collect();
        let images = self.images.iter().zip(&kept).filter(|(_, kept)| **kept).map(|(image, _)| image.reduced(&ids));
        let images: Vec<ColmapImage> = images.collect();
        let used: HashSet<u32> = images.iter().map(|image| image.camera_id).collect();
        let cameras = self.cameras.iter().filter(|camera| used.contains(&camera.id)).cloned().collect();
        Ok(ColmapModel { cameras, images, points, rigs: None, frames: None, warnings: self.warnings.clone() })
    }

    /// The model of a scene from elsewhere: image ids are those of the scene where they are above 0 and unique, else 1, 2, ...
    /// in the order of names; the images' lists hold what the tracks observe.
    pub fn from_scene(scene: &Scene) -> ColmapModel<'static> {
        let given: HashSet<u32> = scene.views.iter().map(|view| view.image_id).collect();
        let keep_ids = given.len() == scene.views.len() && !given.contains(&0);
        let image_id = |v: usize| if keep_ids { scene.views[v].image_id } else { v as u32 + 1 };
        let mut lists = vec![Vec::new(); scene.views.len()];
        let mut points = Vec::with_capacity(scene.points.len());
        for (p, position) in scene.points.iter().enumerate() {
            let point = PointIndex(p as u32);
            let id = scene.point_ids[p];
            let track = scene.track(point).map(|o| {
                let view = scene.track_views[o].at();
                lists[view].push(Point2d::new(scene.track_pixels[o], Some(id)));
                TrackElement::new(image_id(view), lists[view].len() as u32 - 1)
            });
            let track = Cow::Owned(track.collect());
            let errors = scene.track(point).filter_map(|o| scene.reprojection_error(point, o));
            let error = mean(errors).unwrap_or(-1.0);
            points.push(ColmapPoint {
                id,
                xyz: (*position).into(),
                colour: scene.colours[p],
                error,
                track,
                at: Place::File,
            });
        }
        let images = scene.views.iter().zip(lists).enumerate().map(|(v, (view, list))| ColmapImage {
            id: image_id(v),
            cam_from_world: (&view.cam_from_world).into(),
            camera_id: scene.cameras[view.camera.at()].id,
            name: Cow::Owned(view.name.clone()),
            points2d: Cow::Owned(list),
            at: Place::File,
        });
        let images = images.collect();
        ColmapModel { cameras: scene.cameras.clone(), images, points, rigs: None, frames: None, warnings: Vec::new() }
    }
}

/// Fills the views and pixels of some points, one after the other.
fn fill_piece(
    points: &[ColmapPoint],
    lists: &ImageLists,
    views: &mut [ViewIndex],
    pixels: &mut [[f64; 2]],
) -> Result<(), Fault> {
    let mut observations = Vec::new();
    let mut next = 0;
    for points in points.chunks(WARMED) {
        lists.warm(points);
        for point in points {
            point.observations(lists, &mut observations)?;
            for &(view, pixel) in &observations {
                (views[next], pixels[next]) = (view, pixel);
                next += 1;
            }
        }
    }
    Ok(())
}

/// Where an image id leads to.
#[derive(Clone, Copy, Debug)]
struct ImageView {
    /// In the file.
    position: u32,
    view: ViewIndex,
}

/// All image ids of a model.
struct ImageIds {
    /// By id, as far as the ids are dense: looked up for each track element.
    dense: Vec<Option<ImageView>>,
    sparse: HashMap<u32, ImageView>,
}

impl ImageIds {
    /// The error is the position of the first view whose image id was there before.
    fn new(views: &[View]) -> Result<Self, u32> {
        let mut ids = Self { dense: vec![None; 1024 + 4 * views.len()], sparse: HashMap::new() };
        for (index, view) in views.iter().enumerate() {
            let image_view = ImageView { position: view.file_position, view: ViewIndex(index as u32) };
            let before = match ids.dense.get_mut(view.image_id as usize) {
                Some(slot) => slot.replace(image_view),
                None => ids.sparse.insert(view.image_id, image_view),
            };
            if before.is_some() {
                return Err(index as u32);
            }
        }
        Ok(ids)
    }

    fn get(&self, id: u32) -> Option<ImageView> {
        match self.dense.get(id as usize) {
            Some(slot) => *slot,
            None => self.sparse.get(&id).copied(),
        }
    }
}

/// The tracks of a [`Scene`].
struct Tracks {
    offsets: Vec<usize>,
    views: Vec<ViewIndex>,
    pixels: Vec<[f64; 2]>,
}

/// The images' lists of 2D points, which the tracks refer to.
struct ImageLists<'m> {
    view_of_image: &'m ImageIds,
    /// In file order.
    links: Vec<Links<'m>>,
    /// How many track elements named another 2D point than the lists did.
    followed: AtomicUsize,
}

impl<'m> ImageLists<'m> {
    fn new(images: &'m [ColmapImage<'m>], view_of_image: &'m ImageIds) -> Self {
        let links = images.iter().map(|image| Links { image, by_point: OnceLock::new() }).collect();
        Self { view_of_image, links, followed: AtomicUsize::new(0) }
    }

    /// Touches the 2D points of some points, which lie all over the file: without anything else between, the processor waits
    /// for many of them at the same time. That saves more than half of the time of reading.
    fn warm(&self, points: &[ColmapPoint]) {
        let mut seen = 0;
        for element in points.iter().flat_map(|point| point.track.iter()) {
            let Some(image_view) = self.view_of_image.get(element.image()) else { continue };
            if let Some(point2d) = self.links[image_view.position as usize].image.points2d.get(element.index() as usize)
            {
                seen ^= point2d.x[0] ^ point2d.point[7];
            }
        }
        std::hint::black_box(seen);
    }

    fn warning(&self, elements: usize) -> Option<String> {
        let followed = self.followed.load(Ordering::Relaxed);
        (followed > 0).then(|| {
            format!(
                "{followed} of {elements} track elements name another 2D point than the images' own lists (OpenMVG and \
                 AliceVision write the number of the feature there); the lists were followed"
            )
        })
    }
}

/// An image's 2D points by the sparse point that they observe, sorted when first asked for.
struct Links<'m> {
    image: &'m ColmapImage<'m>,
    by_point: OnceLock<Vec<(u64, u32)>>,
}

impl<'m> Links<'m> {
    /// The n-th 2D point of the image that observes the point, and its position in the list.
    fn nth(&self, point: u64, n: usize) -> Option<(u32, &'m Point2d)> {
        let by_point = self.by_point.get_or_init(|| {
            let linked = self.image.points2d.iter().enumerate();
            let mut linked: Vec<_> = linked.filter_map(|(i, p)| p.point().map(|id| (id, i as u32))).collect();
            linked.sort_unstable();
            linked
        });
        let first = by_point.partition_point(|&(id, _)| id < point);
        let &(id, index) = by_point.get(first + n)?;
        (id == point).then(|| (index, &self.image.points2d[index as usize]))
    }
}

impl ColmapImage<'_> {
    /// With only these points linked.
    fn reduced(&self, points: &HashSet<u64>) -> ColmapImage<'_> {
        let relink = |p: &Point2d| Point2d::new(p.pixel(), p.point().filter(|id| points.contains(id)));
        let points2d = Cow::Owned(self.points2d.iter().map(relink).collect());
        ColmapImage { name: Cow::Borrowed(&self.name), points2d, ..*self }
    }

    fn fault(&self, problem: Problem) -> Fault {
        Fault::new("images", self.at, problem).in_record(|| format!("image {}, {:?}", self.id, self.name))
    }

    fn view(&self, position: u32, cameras: &HashMap<u32, CameraIndex>) -> Result<View, Problem> {
        check_name(&self.name)?;
        let absent = Problem::Absent { what: "camera", id: self.camera_id.into() };
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
    /// The part of the point that the kept images (in file order) observe.
    fn reduced(
        &self,
        lists: &ImageLists,
        kept: &[bool],
        min_views: usize,
    ) -> Result<Option<ColmapPoint<'static>>, Fault> {
        let mut track = Vec::new();
        self.resolve(lists, |image_view, index, _| {
            if kept[image_view.position as usize] {
                let image = lists.links[image_view.position as usize].image.id;
                track.push(TrackElement::new(image, index));
            }
            Ok(())
        })?;
        let views: HashSet<u32> = track.iter().map(TrackElement::image).collect();
        let Self { id, xyz, colour, error, at, .. } = *self;
        let reduced = ColmapPoint { id, xyz, colour, error, track: Cow::Owned(track), at };
        Ok((views.len() >= min_views).then_some(reduced))
    }

    fn fault(&self, problem: Problem) -> Fault {
        Fault::new("points3D", self.at, problem).in_record(|| format!("point {}", self.id))
    }

    /// Finds the 2D point of each element of the track.
    fn resolve<'m>(
        &self,
        lists: &ImageLists<'m>,
        mut each: impl FnMut(ImageView, u32, &'m Point2d) -> Result<(), Fault>,
    ) -> Result<(), Fault> {
        for (n, element) in self.track.iter().enumerate() {
            let absent = || self.fault(Problem::Absent { what: "image", id: element.image().into() });
            let image_view = lists.view_of_image.get(element.image()).ok_or_else(absent)?;
            let links = &lists.links[image_view.position as usize];
            let named = links.image.points2d.get(element.index() as usize);
            match named {
                Some(point2d) if point2d.point().is_none_or(|id| id == self.id) => {
                    each(image_view, element.index(), point2d)?;
                }
                _ => {
                    let before = self.track[..n].iter().filter(|e| e.image() == element.image()).count();
                    let (index, point2d) =
                        links.nth(self.id, before).ok_or_else(|| self.wrong_index(element, named))?;
                    lists.followed.fetch_add(1, Ordering::Relaxed);
                    each(image_view, index, point2d)?;
                }
            }
        }
        Ok(())
    }

    /// View and pixel of each element of the track, sorted by view.
    fn observations(&self, lists: &ImageLists, observations: &mut Vec<(ViewIndex, [f64; 2])>) -> Result<(), Fault> {
        observations.clear();
        if !self.xyz.iter().all(|v| v.is_finite()) {
            return Err(self.fault(Problem::NotFinite("the position")));
        }
        self.resolve(lists, |image_view, _, point2d| {
            let pixel = point2d.pixel();
            if !pixel.iter().all(|v| v.is_finite()) {
                let image = lists.links[image_view.position as usize].image;
                return Err(image.fault(Problem::NotFinite("a 2D point")));
            }
            observations.push((image_view.view, pixel));
            Ok(())
        })?;
        observations.sort_by_key(|o| o.0);
        Ok(())
    }

    fn wrong_index(&self, element: &TrackElement, named: Option<&Point2d>) -> Fault {
        let why = match named.and_then(Point2d::point) {
            Some(other) => format!("which observes point {other}"),
            None => "which has no such 2D point".into(),
        };
        self.fault(Problem::TrackIndex { image: element.image(), index: element.index(), why })
    }
}

impl Frame {
    /// Compares the frame's pose with those of its images, and marks them as seen.
    fn check(
        &self,
        rigs: &HashMap<u32, &Rig>,
        views: &[View],
        view_of_image: &ImageIds,
        cameras: &[Camera],
        seen: &mut [bool],
    ) -> Result<(), Problem> {
        let rig = rigs.get(&self.rig_id).ok_or(Problem::Absent { what: "rig", id: self.rig_id.into() })?;
        let rig_from_world = self.rig_from_world.pose()?;
        for datum in self.data.iter().filter(|d| d.sensor.kind == Sensor::CAMERA) {
            let absent = Problem::Absent { what: "image", id: datum.id };
            let image_id = u32::try_from(datum.id).map_err(|_| absent.clone())?;
            let view = view_of_image.get(image_id).ok_or(absent)?.view;
            if std::mem::replace(&mut seen[view.at()], true) {
                return Err(Problem::Duplicate { what: "image", id: datum.id.to_string() });
            }
            let view = &views[view.at()];
            let sensor = rig.sensors.iter().find(|(s, _)| *s == datum.sensor);
            let (_, sensor_from_rig) =
                sensor.ok_or(Problem::Absent { what: "camera of the rig", id: datum.sensor.id.into() })?;
            if cameras[view.camera.at()].id != datum.sensor.id {
                let message = format!("the frame takes image {image_id} with camera {}", datum.sensor.id);
                return Err(Problem::Contradiction(format!("{message}, the images file with another")));
            }
            let Some(sensor_from_rig) = sensor_from_rig else { continue };
            let composed = compose(&sensor_from_rig.pose()?, &rig_from_world);
            if !nearly_equal(&composed, &view.cam_from_world) {
                let message = format!("the pose of image {image_id} by rig and frame is not that of the images file");
                return Err(Problem::Contradiction(message));
            }
        }
        Ok(())
    }
}

/// a ∘ b
fn compose(a: &Pose, b: &Pose) -> Pose {
    Pose { rotation: a.rotation * b.rotation, translation: a.rotation * b.translation + a.translation }
}

fn nearly_equal(a: &Pose, b: &Pose) -> bool {
    let size = 1.0 + a.translation.norm().max(b.translation.norm());
    let apart = (a.rotation.matrix() - b.rotation.matrix()).norm();
    apart < RIG_TOLERANCE && (a.translation - b.translation).norm() < RIG_TOLERANCE * size
}
