//! The sparse model: output of every reader, input of every stage.
//!
//! Flat arrays rather than objects: 1,200 views with 6.6 million observations take less than 200
//! MB. Views are sorted by name, so [`ViewIndex`] orders like the names, and "ties by view name" is
//! a comparison of indices. The ids of the source file are kept for writing the model back.

use std::ops::Range;

use bytemuck::{Pod, Zeroable};
use nalgebra::{Point3, Rotation3, Vector3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::{
    base::{
        error::{Advice, shortened},
        median::median,
        rows::Offsets,
    },
    model::{camera::Camera, georeference::Georeference},
};

/// Index of a view in [`Scene::views`]; ordered like the names.
#[derive(
    Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Pod, Zeroable, Serialize, Deserialize,
)]
#[repr(transparent)]
#[serde(transparent)]
pub struct ViewIndex(pub u32);

/// Index of a sparse point in [`Scene::points`].
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
#[serde(transparent)]
pub struct PointIndex(pub u32);

/// Index of a camera (a set of intrinsics) in [`Scene::cameras`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct CameraIndex(pub u32);

impl ViewIndex {
    /// The index as a `usize`, for slices.
    pub fn index(self) -> usize {
        self.0 as usize
    }
}

impl PointIndex {
    /// The index as a `usize`, for slices.
    pub fn index(self) -> usize {
        self.0 as usize
    }
}

impl CameraIndex {
    /// The index as a `usize`, for slices.
    pub fn index(self) -> usize {
        self.0 as usize
    }
}

/// Rigid transform from world to camera: `x_cam = rotation * x_world + translation` (COLMAP's
/// `cam_from_world`). Camera axes: x right, y down, z forward.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    pub rotation: Rotation3<f64>,
    pub translation: Vector3<f64>,
}

impl Pose {
    /// Returns whether two poses are the same, to the precision of text files.
    pub fn is_near(&self, other: &Self) -> bool {
        const DIGITS: f64 = 1e-5;
        let moved = (self.translation - other.translation).norm();
        (self.rotation.matrix() - other.rotation.matrix()).norm() < DIGITS
            && moved < DIGITS * (1.0 + self.translation.norm())
    }

    /// Transforms a point from world to camera coordinates, scene units.
    pub fn camera_from_world(&self, x: &Point3<f64>) -> Point3<f64> {
        self.rotation * x + self.translation
    }

    /// The camera centre in world coordinates, `-Rᵀ t`.
    pub fn centre(&self) -> Point3<f64> {
        Point3::from(-(self.rotation.inverse() * self.translation))
    }

    /// Unit viewing direction in world coordinates: the third row of R.
    pub fn viewing_direction(&self) -> Vector3<f64> {
        self.rotation.matrix().row(2).transpose()
    }
}

/// A registered image.
#[derive(Clone, Debug)]
pub struct View {
    /// Name as in the model, relative to the image folder, `/` between folders.
    pub name: String,
    /// Image id in the source file.
    pub image_id: u32,
    /// Index among the registered images of that file, from 0; `fused.ply.vis` and OpenMVS refer to
    /// images by it.
    pub file_position: u32,
    pub camera: CameraIndex,
    pub cam_from_world: Pose,
}

/// Units of the scene: metres (`metric`) or an arbitrary scale (`relative`).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "lowercase")]
pub enum Units {
    Metric,
    Relative,
}

/// Views, cameras, sparse points and their tracks. Readers build it; no stage changes it.
#[derive(Clone, Debug, Default)]
pub struct Scene {
    pub cameras: Vec<Camera>,
    /// Sorted by name (bytes), names unique.
    pub views: Vec<View>,
    /// World coordinates, scene units.
    pub points: Vec<Point3<f64>>,
    /// Point ids in the source file.
    pub point_ids: Vec<u64>,
    /// Colours of the points, R G B.
    pub colours: Vec<[u8; 3]>,
    /// Track of point p: entries `track_offsets[p]..track_offsets[p + 1]` of the two arrays below.
    pub track_offsets: Vec<usize>,
    /// View of each observation; sorted by view within a track.
    pub track_views: Vec<ViewIndex>,
    /// Measured image position of each observation, pixels, in COLMAP's convention (centre of the
    /// first pixel at 0.5, 0.5).
    pub track_pixels: Vec<[f64; 2]>,
    /// Images of the model or of the image folder without a pose, sorted by name.
    pub unregistered: Vec<String>,
    /// Images that the user took out of the model, sorted by name.
    pub left_out: Vec<String>,
    /// Views that the file of the model keeps apart for tests, ascending.
    pub tests: Vec<ViewIndex>,
    /// Place on earth, where the file of the model names it.
    pub georeference: Option<Georeference>,
    /// Problems that did not prevent reading.
    pub warnings: Vec<ModelWarning>,
}

/// A problem of a model, or of the files next to it, that does not prevent reading.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ModelWarning {
    pub kind: WarningKind,
    /// A sentence for users.
    pub text: String,
    /// The remedy, if the reader knows a better one than those of the kind.
    pub cure: Option<Advice>,
}

impl ModelWarning {
    pub fn new(kind: WarningKind, text: impl AsRef<str>) -> Self {
        Self {
            kind,
            text: shortened(text.as_ref()).into_owned(),
            cure: None,
        }
    }

    pub fn with_cure(self, cure: impl Into<Advice>) -> Self {
        Self {
            cure: Some(cure.into()),
            ..self
        }
    }

    /// The sentence with its remedy.
    pub fn describe(&self) -> Advice {
        let text = Advice::text(&self.text);
        match &self.cure {
            Some(cure) => text.and(": ").join(cure.clone()),
            None => text,
        }
    }
}

/// Subject of a [`ModelWarning`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WarningKind {
    /// Data is missing, superfluous or contradictory.
    Damaged,
    /// The model has views, but no sparse points.
    NoPoints,
    /// The sparse points have no tracks: those they have here are their projections.
    Projected,
    /// The format doesn't store something, or the reader ignores it.
    Format,
    /// The project has other models, which were not read.
    OtherModels,
    /// The model's own file has other parts, which were not read.
    OtherParts,
    /// A dense workspace was made from another model.
    OtherWorkspace,
    /// Images are missing, so a value was guessed.
    Guessed,
}

impl Scene {
    pub fn camera_of(&self, view: ViewIndex) -> &Camera {
        &self.cameras[self.views[view.index()].camera.index()]
    }

    pub fn view(&self, view: ViewIndex) -> &View {
        &self.views[view.index()]
    }

    pub fn name(&self, view: ViewIndex) -> &str {
        &self.views[view.index()].name
    }

    /// Returns, for each view, its place among these; `None` if it is none of them.
    pub fn places_of(&self, views: impl IntoIterator<Item = ViewIndex>) -> Vec<Option<usize>> {
        let mut places = vec![None; self.views.len()];
        (0..)
            .zip(views)
            .for_each(|(i, view)| places[view.index()] = Some(i));
        places
    }

    pub fn view_indices(&self) -> impl ExactSizeIterator<Item = ViewIndex> + Clone {
        (0..self.views.len() as u32).map(ViewIndex)
    }

    /// Finds a view by name, in O(log n).
    pub fn find(&self, name: &str) -> Option<ViewIndex> {
        let found = self.views.binary_search_by(|v| v.name.as_str().cmp(name));
        found.ok().map(|i| ViewIndex(i as u32))
    }

    /// Returns the views that are kept apart for tests, ascending: every n-th by name, from the
    /// first, as trainers count them (0: none), else those that the model names; without those
    /// whose image is missing (`without_image`, ascending).
    pub fn kept_for_tests(
        &self,
        every: Option<u32>,
        without_image: &[ViewIndex],
    ) -> Vec<ViewIndex> {
        let mut tests = match every {
            Some(0) => Vec::new(),
            Some(n) => self.view_indices().step_by(n as usize).collect(),
            None => self.tests.clone(),
        };
        tests.retain(|view| without_image.binary_search(view).is_err());
        tests
    }

    /// Returns whether both scenes have the same view names and poses, to the precision of text
    /// files.
    pub fn has_same_views(&self, other: &Self) -> bool {
        let same = |(a, b): (&View, &View)| {
            a.name == b.name && a.cam_from_world.is_near(&b.cam_from_world)
        };
        self.views.len() == other.views.len() && self.views.iter().zip(&other.views).all(same)
    }

    pub fn observations(&self) -> usize {
        self.track_views.len()
    }

    /// Range of the observations of a point in `track_views` and `track_pixels`.
    pub fn track(&self, point: PointIndex) -> Range<usize> {
        self.track_offsets[point.index()]..self.track_offsets[point.index() + 1]
    }

    /// Views that observe the point, ascending; a view may occur more than once.
    pub fn track_views(&self, point: PointIndex) -> &[ViewIndex] {
        &self.track_views[self.track(point)]
    }

    /// Reprojection error, pixels, of an observation (an index into `track_pixels`) of `point`;
    /// `None` if the camera doesn't project the point (e.g. from behind).
    pub fn reprojection_error(&self, point: PointIndex, observation: usize) -> Option<f64> {
        let view = self.track_views[observation];
        let x_cam = self
            .view(view)
            .cam_from_world
            .camera_from_world(&self.points[point.index()]);
        self.camera_of(view)
            .reprojection_error(&x_cam, &self.track_pixels[observation].into())
    }

    /// Mean reprojection error, pixels, computed like COLMAP's: mean over points of the mean over
    /// each point's observations. Observations without a projection are left out; `None` if no
    /// observation has one.
    pub fn mean_reprojection_error(&self) -> Option<f64> {
        let means = (0..self.points.len()).filter_map(|p| {
            let point = PointIndex(p as u32);
            mean(
                self.track(point)
                    .filter_map(|o| self.reprojection_error(point, o)),
            )
        });
        mean(means)
    }

    /// Median ground sampling distance, scene units per pixel: median over views of (median depth
    /// of the observed points) / (mean focal length in pixels). Points behind a view are left out;
    /// `None` if no view observes a point in front of it.
    pub fn median_gsd(&self) -> Option<f64> {
        self.median_gsd_of(&self.view_points())
    }

    /// As [`Self::median_gsd`], for `view_points` of this scene that are at hand.
    pub fn median_gsd_of(&self, view_points: &ViewPoints) -> Option<f64> {
        let of_view = |view: ViewIndex| {
            let pose = &self.view(view).cam_from_world;
            let camera = self.camera_of(view);
            let points = view_points.observed_by(view).iter();
            let depths =
                points.map(|&p| camera.depth(&pose.camera_from_world(&self.points[p.index()])));
            let depth = median(depths.filter(|&depth| depth > 0.0))?;
            Some(depth / camera.mean_focal_length())
        };
        let views: Vec<ViewIndex> = self.view_indices().collect();
        let of_views: Vec<f64> = views.into_par_iter().filter_map(of_view).collect();
        median(of_views)
    }

    /// Returns a copy of the scene whose world origin is at `origin`.
    pub fn moved(&self, origin: Vector3<f64>) -> Scene {
        let mut scene = self.clone();
        scene.points.iter_mut().for_each(|x| *x -= origin);
        for pose in scene.views.iter_mut().map(|view| &mut view.cam_from_world) {
            // R x + t = R (x - origin) + (t + R origin).
            pose.translation += pose.rotation * origin;
        }
        scene
    }

    /// Transposes the tracks: for each view the points that it observes, ascending, without
    /// duplicates.
    pub fn view_points(&self) -> ViewPoints {
        ViewPoints::new(self)
    }
}

/// Arithmetic mean; `None` without values.
pub fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (n, sum) = values.fold((0u64, 0.0), |(n, sum), value| (n + 1, sum + value));
    (n > 0).then(|| sum / n as f64)
}

/// The points that each view observes, CSR by view.
#[derive(Clone, Debug)]
pub struct ViewPoints {
    offsets: Offsets,
    points: Vec<PointIndex>,
}

impl ViewPoints {
    fn new(scene: &Scene) -> Self {
        let distinct = |p: PointIndex| {
            let track = scene.track_views(p);
            (0..track.len())
                // Views ascend within a track, so that those that occur twice are side by side.
                .filter(move |&i| i == 0 || track[i] != track[i - 1])
                .map(move |i| (track[i].index(), p))
        };
        let all = || (0..scene.points.len() as u32).map(PointIndex);
        let (offsets, points) = Offsets::sorted(scene.views.len(), || all().flat_map(distinct));
        Self { offsets, points }
    }

    /// The points that the view observes, ascending.
    pub fn observed_by(&self, view: ViewIndex) -> &[PointIndex] {
        &self.points[self.offsets.row(view.index())]
    }

    /// Returns the points that both views observe, ascending, without duplicates.
    pub fn shared(&self, a: ViewIndex, b: ViewIndex) -> Vec<PointIndex> {
        let other = self.observed_by(b);
        let mut shared: Vec<PointIndex> = self.observed_by(a).to_vec();
        shared.retain(|point| other.binary_search(point).is_ok());
        shared
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::camera::CameraModel;

    #[test]
    fn median_gsd_is_depth_over_focal_length() {
        let camera = Camera::new(
            1,
            CameraModel::Pinhole,
            100,
            100,
            vec![90.0, 110.0, 50.0, 50.0],
        )
        .unwrap();
        let pose = Pose {
            rotation: Rotation3::identity(),
            translation: Vector3::zeros(),
        };
        let view = |name: &str| View {
            name: name.into(),
            image_id: 0,
            file_position: 0,
            camera: CameraIndex(0),
            cam_from_world: pose,
        };
        // Neither the point behind both cameras nor the view without observations counts.
        let scene = Scene {
            cameras: vec![camera],
            views: vec![view("a"), view("b"), view("c")],
            points: [-5.0, 1.0, 2.0, 4.0]
                .map(|z| Point3::new(0.0, 0.0, z))
                .to_vec(),
            point_ids: vec![1, 2, 3, 4],
            colours: vec![[0; 3]; 4],
            track_offsets: vec![0, 2, 3, 5, 6],
            track_views: [0, 1, 0, 0, 1, 1].map(ViewIndex).to_vec(),
            track_pixels: vec![[0.0; 2]; 6],
            ..Scene::default()
        };
        // View a: depths 1 and 2; view b: 2 and 4.
        assert_eq!(scene.median_gsd(), Some(0.5 * (1.5 + 3.0) / 100.0));
        assert_eq!(Scene::default().median_gsd(), None);
        // No point is behind an equirectangular camera: distances of view a 5, 1 and 2, of view b
        // 5, 2 and 4.
        let equirectangular = Camera::new(
            1,
            CameraModel::Equirectangular,
            1000,
            500,
            vec![1000.0, 500.0],
        )
        .unwrap();
        let focal = equirectangular.mean_focal_length();
        let scene = Scene {
            cameras: vec![equirectangular],
            ..scene
        };
        assert!((scene.median_gsd().unwrap() - 3.0 / focal).abs() < 1e-12);
    }
}
