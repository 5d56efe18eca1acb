//! The input of a backend: the scene and the chosen view clusters in rank order.

use std::{
    borrow::Cow,
    path::{Component, Path, PathBuf},
};

use nalgebra::Vector3;

use super::{Backend, BackendError, by_name, place};
use crate::{
    base::shell::command_path,
    io::{
        paths,
        project::{ImageFaults, ImageFolder, Project, is_raw, slashes},
    },
    model::{
        camera::CameraModel,
        cluster::{MapScale, RankedCluster},
        scene::{PointIndex, Scene, ViewIndex, ViewPoints},
    },
};

/// Advice for panoramas, which cannot be undistorted.
pub const CUT_PANORAMAS: &str =
    "cut the panoramas into perspective views first, for instance with COLMAP's panorama_sfm.py";

/// Returns whether any view of a scene is a panorama.
pub fn has_panoramas(scene: &Scene) -> bool {
    let mut cameras = scene.view_indices().map(|view| scene.camera_of(view));
    cameras.any(|camera| camera.model() == CameraModel::Equirectangular)
}

/// The chosen view clusters of a scene.
#[derive(Clone, Copy, Debug)]
pub struct Selection<'a> {
    pub project: &'a Project,
    pub scene: &'a Scene,
    /// In rank order, up to the cut; each view is the key view of at most one.
    pub clusters: &'a [RankedCluster],
    /// Size of the matched images over the model's images.
    pub image_scale: f64,
    /// True if the user has not set `image_scale`: each program takes its own.
    pub own_size: bool,
    /// Name of the backend that the plan was made for.
    pub planned_for: &'a str,
    /// Faults of the scene's image files.
    pub image_faults: &'a ImageFaults,
    /// Every n-th view by name is kept apart for tests; `None`: those that the model names.
    pub test_every: Option<u32>,
}

/// A selection whose scene is near its origin, for programs that compute in f32.
pub struct NearOrigin<'a> {
    selection: Selection<'a>,
    scene: Cow<'a, Scene>,
    /// World coordinates of the new origin.
    pub origin: Vector3<f64>,
}

impl NearOrigin<'_> {
    pub fn selection(&self) -> Selection<'_> {
        Selection {
            scene: &self.scene,
            ..self.selection
        }
    }
}

impl<'a> Selection<'a> {
    /// Moves the scene near its origin, unless f32 represents its coordinates well enough.
    pub fn near_origin(&self) -> NearOrigin<'a> {
        let origin = origin_among(&centres(self.scene), self.scene.median_gsd());
        let moved = origin != Vector3::zeros();
        let scene = if moved {
            Cow::Owned(self.scene.moved(origin))
        } else {
            Cow::Borrowed(self.scene)
        };
        NearOrigin {
            selection: *self,
            scene,
            origin,
        }
    }
}

impl Selection<'_> {
    /// Returns all key views and partners, ascending by name.
    pub fn views(&self) -> Vec<ViewIndex> {
        let mut views: Vec<_> = self
            .clusters
            .iter()
            .flat_map(RankedCluster::views)
            .collect();
        views.sort_unstable();
        views.dedup();
        views
    }

    /// Returns the views that are kept apart for tests and have an image, ascending by name; none
    /// of depth maps, which use all.
    pub fn kept_for_tests(&self) -> Vec<ViewIndex> {
        let planned_for = by_name(self.planned_for);
        if planned_for.is_ok_and(Backend::makes_maps) {
            return Vec::new();
        }
        let without_image = self.image_faults.without_image(self.scene.views.len());
        self.scene.kept_for_tests(self.test_every, &without_image)
    }

    /// Returns the folder of the images.
    pub fn images(&self, backend: &'static str) -> Result<&ImageFolder, BackendError> {
        let needs = |what: String| BackendError::Needs {
            backend,
            what,
            hint: cure_of_images(self.project, self.scene, backend, self.image_faults),
        };
        let Some(folder) = self.project.images.as_ref() else {
            let why = match &self.project.originals {
                Some(originals) => originals.what(),
                None => "there is no image folder".into(),
            };
            return Err(needs(format!("the images, and {why}")));
        };
        let views = self.views();
        if let Some((name, cure)) = of_unread_kind(self.project, self.scene, backend) {
            return Err(BackendError::Needs {
                backend,
                what: format!("images in a format that it reads, which {name} is not"),
                hint: cure.into(),
            });
        }
        let faults = self.image_faults.among(&views);
        // One usable image suffices: the record warns of the others.
        if views.is_empty() || faults.is_any_usable(views.len()) {
            return Ok(folder);
        }
        let at = folder.display();
        let unusable = |what| BackendError::Needs {
            backend,
            what,
            hint: faults.cure().unwrap_or_default().into(),
        };
        Err(
            match (faults.unreadable.first(), faults.other_aspect_ratio.first()) {
                (Some((view, why)), _) => unusable(format!(
                    "the images, and none of those in {at} can be read: {} is {why}",
                    self.scene.name(*view)
                )),
                (None, Some((view, [width, height]))) => {
                    let (name, camera) = (self.scene.name(*view), self.scene.camera_of(*view));
                    let why = faults
                        .turned
                        .map_or(String::new(), |turned| format!(": {}", turned.why()));
                    unusable(format!(
                        "the model's images, and those in {at} are others: {name} has {width} x {height} pixels, its camera {} x {}{why}",
                        camera.width, camera.height
                    ))
                }
                (None, None) => {
                    let missing = faults.missing.first().map(|view| self.scene.name(*view));
                    let others = missing.map_or(String::new(), |name| others_than(name, folder));
                    needs(format!("the images, and none of them is in {at}{others}"))
                }
            },
        )
    }

    /// Fails if none of the images in their folder can be used. Where there is no such folder, the
    /// user may have them.
    pub fn refuse_unusable_images(&self, backend: &'static str) -> Result<(), BackendError> {
        match self.project.images {
            Some(_) => self.images(backend).map(drop),
            None => Ok(()),
        }
    }

    /// Returns the folder of the images for a command that runs in the folder `from`; if unknown, a
    /// shell variable that the command requires.
    pub fn images_in_commands(&self, from: &Path) -> String {
        let home = paths::real(&self.project.home);
        let seen_from = |images: &ImageFolder| match paths::real(images).strip_prefix(&home) {
            // Relative, so that the project can be moved with the export in it.
            Ok(inside) => place::path_from(from, &home).join(inside),
            Err(_) => paths::absolute(images),
        };
        match &self.project.images {
            Some(images) => command_path(&seen_from(images)),
            None => "\"${IMAGES:?folder of the images}\"".into(),
        }
    }

    /// Returns the paths of the files of some views, and for a command that runs in the folder
    /// `from` the folder in which they are: that of the images, unless a file is outside of it.
    pub fn files_in_commands(&self, views: &[ViewIndex], from: &Path) -> (Vec<String>, String) {
        let names = || views.iter().map(|view| self.scene.name(*view));
        let Some(images) = &self.project.images else {
            let names = names().map(str::to_owned).collect();
            return (names, self.images_in_commands(from));
        };
        let inside: Vec<&str> = names().map(|name| images.path_of(name)).collect();
        if inside.iter().all(|path| is_below(path)) {
            let inside = inside.into_iter().map(str::to_owned).collect();
            return (inside, self.images_in_commands(from));
        }
        let files: Vec<PathBuf> = names()
            .map(|name| paths::place_of_file(&images.file(name)))
            .collect();
        let mut above = paths::real(images);
        // `rsync --files-from` sees all paths from a single folder.
        while !files.iter().all(|file| file.starts_with(&above)) && above.pop() {}
        let below = |file: &PathBuf| slashes(file.strip_prefix(&above).unwrap_or(file));
        (files.iter().map(below).collect(), command_path(&above))
    }

    /// Returns the folder of the images if these are undistorted.
    ///
    /// # Errors
    /// Fails on distorted cameras, with the command that undistorts as the hint, and on a folder
    /// without images.
    pub fn undistorted_images(&self, backend: &'static str) -> Result<&ImageFolder, BackendError> {
        let distorted = self
            .views()
            .into_iter()
            .find(|v| !self.scene.camera_of(*v).is_pinhole());
        let Some(view) = distorted else {
            return self.images(backend);
        };
        // To undistort no images, or others than the model's, would fail next.
        self.images(backend)?;
        let camera = self.scene.camera_of(view).model().name();
        let hint = match self.project.undistorted_workspace() {
            Some(dense) => {
                format!(
                    "plan and export the undistorted images instead: viewrank plan {}",
                    command_path(&dense)
                )
            }
            None if has_panoramas(self.scene) => CUT_PANORAMAS.into(),
            None => {
                let (root, model) = (self.project.as_argument(), &self.project.model);
                let dense = command_path(&self.project.place_of_undistorted());
                let images = self.project.images.as_ref();
                let images = images.map_or_else(
                    || self.project.root.join("images"),
                    |images| images.to_path_buf(),
                );
                let colmap = format!(
                    " (or `colmap image_undistorter --image_path {} --input_path {} --output_path {dense}`)",
                    command_path(&images),
                    command_path(&model.path)
                );
                let colmap = if model.format.is_colmap() {
                    colmap
                } else {
                    String::new()
                };
                format!(
                    "make them with `viewrank undistort {root}`{colmap}, then `viewrank plan {dense}`"
                )
            }
        };
        Err(BackendError::Needs {
            backend,
            what: format!(
                "undistorted images, but the camera of {} is {camera}",
                self.scene.name(view)
            ),
            hint,
        })
    }

    /// Returns the level of an image pyramid, each of half the side of the one before, at which
    /// maps of this size are matched.
    pub fn pyramid_level(&self, scale: MapScale) -> u32 {
        let full = (1.0 / self.image_scale).log2().round().max(0.0) as u32;
        full + u32::from(scale == MapScale::Half)
    }

    /// Matched size of programs that can only halve images, as a part of their size.
    pub fn halved(&self) -> f64 {
        (-f64::from(self.pyramid_level(MapScale::Full))).exp2()
    }

    /// Returns all key views in rank order, then the other partners by name.
    pub fn keys_first(&self) -> Vec<ViewIndex> {
        let is_key = self.is_key();
        let partners = self.views().into_iter().filter(|v| !is_key[v.index()]);
        self.clusters
            .iter()
            .map(|c| c.key)
            .chain(partners)
            .collect()
    }

    /// Returns, for each view of the scene, whether it is a key view.
    pub fn is_key(&self) -> Vec<bool> {
        let mut is_key = vec![false; self.scene.views.len()];
        self.clusters
            .iter()
            .for_each(|c| is_key[c.key.index()] = true);
        is_key
    }

    /// Returns the long side of the largest image of the clusters, pixels.
    pub fn long_side(&self) -> u32 {
        self.views()
            .into_iter()
            .map(|v| self.scene.camera_of(v))
            .map(|c| c.width.max(c.height))
            .max()
            .unwrap_or(0)
    }

    /// Returns the largest number of partners of a cluster.
    pub fn most_partners(&self) -> usize {
        self.clusters
            .iter()
            .map(|c| c.partners.len())
            .max()
            .unwrap_or(0)
    }
}

/// The name of an image with the extension of its file, which programs choose a decoder by.
pub fn name_of_kind(project: &Project, name: &str) -> String {
    let images = project.images.as_ref();
    images.map_or_else(|| name.into(), |images| images.name_of_kind(name))
}

/// Returns whether a path leads to a place below the folder that it is relative to.
pub fn is_below(path: &str) -> bool {
    let is_name = |part| matches!(part, Component::Normal(_) | Component::CurDir);
    Path::new(path).components().all(is_name)
}

/// Returns the name of an image that the folder has instead, as a part of the sentence; empty if
/// it has none.
fn others_than(name: &str, folder: &ImageFolder) -> String {
    match folder.first_image() {
        Some(_) if folder.candidates_for(name).is_some() => " by its name".into(),
        Some(other) => format!(", which has others ({other})"),
        None => String::new(),
    }
}

/// Says what to do where the folder has images, but none that the model names.
fn other_names(project: &Project, scene: &Scene, faults: &ImageFaults) -> Option<String> {
    let there = project.images.as_ref()?.first_image()?;
    let name = scene.name(*faults.missing.first()?);
    Some(format!(
        "name the folder of the model's images with --images, or rename these as the model has them ({name}, not {there})"
    ))
}

/// Says what to do about the images of a project, of which a backend can use none.
pub fn cure_of_images(
    project: &Project,
    scene: &Scene,
    backend: &str,
    faults: &ImageFaults,
) -> String {
    let of_kind = of_unread_kind(project, scene, backend).map(|(_, cure)| cure);
    if let Some(cure) = of_kind.or(faults.cure()) {
        return cure.into();
    }
    let images = project.images.as_ref();
    let fits_two = |view: &ViewIndex| {
        let name = scene.name(*view);
        Some((name, images?.candidates_for(name)?))
    };
    match faults.missing.first().and_then(fits_two) {
        Some((name, two)) => format!(
            "two files fit {name} ({}): move those that are not the model's out of the folder",
            two.join(" and ")
        ),
        None => {
            other_names(project, scene, faults).unwrap_or_else(|| project.where_images_belong())
        }
    }
}

/// Returns the first image, and what to do, if the program of a backend reads none by their kinds.
pub fn of_unread_kind(
    project: &Project,
    scene: &Scene,
    backend: &str,
) -> Option<(String, &'static str)> {
    let (folder, backend) = (project.images.as_ref()?, by_name(backend).ok()?);
    let file = |view: ViewIndex| folder.name_of_kind(scene.name(view));
    let mut files = scene.view_indices().map(file);
    let is_raw = |name: &str| !backend.reads_raw && is_raw(Path::new(name));
    let is_unread = |name: &String| extension(name, backend.unread).is_some() || is_raw(name);
    let first = files.next().filter(is_unread)?;
    let cure = if is_raw(&first) {
        "develop the raw pictures into another folder, neither turned nor cropped, and name it with --images"
    } else {
        "convert the images to JPEG or PNG, with the same names but for the extension"
    };
    files.all(|name| is_unread(&name)).then_some((first, cure))
}

/// Spacing of f32 from which it is too coarse, ground pixels.
const COARSE_PX: f64 = 0.1;

/// Describes how f32 rounds the coordinates; `None` if it is fine enough.
pub fn rounding(scene: &Scene) -> Option<String> {
    let gsd = scene.median_gsd();
    let (largest, step) = too_coarse(&centres(scene), gsd)?;
    let gsd = gsd?;
    Some(format!(
        "coordinates up to {largest:.0} are rounded to {step:.2} units in numbers of 32 bits, and a pixel is {gsd:.3} units"
    ))
}

/// Returns the origin for coordinates near these camera centres: their mean in whole units if f32
/// is too coarse for them, else zero. `gsd`: units per pixel.
pub fn origin_among(centres: &[Vector3<f64>], gsd: Option<f64>) -> Vector3<f64> {
    match too_coarse(centres, gsd) {
        // Whole units, since the user adds them to the coordinates of what comes out.
        Some(_) => (centres.iter().sum::<Vector3<f64>>() / centres.len() as f64).map(f64::round),
        None => Vector3::zeros(),
    }
}

/// Returns the largest coordinate and the spacing of f32 there; `None` if it is fine enough.
fn too_coarse(centres: &[Vector3<f64>], gsd: Option<f64>) -> Option<(f64, f64)> {
    let largest = centres
        .iter()
        .map(|centre| centre.amax())
        .fold(0.0, f64::max);
    let step = largest * f64::from(f32::EPSILON);
    gsd.filter(|gsd| step >= COARSE_PX * gsd)
        .map(|_| (largest, step))
}

fn centres(scene: &Scene) -> Vec<Vector3<f64>> {
    scene
        .views
        .iter()
        .map(|view| view.cam_from_world.centre().coords)
        .collect()
}

/// Returns the depths of the points that the view observes, in front of it, ascending, scene units.
pub fn depths(scene: &Scene, points: &ViewPoints, view: ViewIndex) -> Vec<f64> {
    let pose = &scene.view(view).cam_from_world;
    let depth = |&p: &PointIndex| pose.camera_from_world(&scene.points[p.index()]).z;
    let mut depths: Vec<f64> = points
        .observed_by(view)
        .iter()
        .map(depth)
        .filter(|z| *z > 0.0)
        .collect();
    depths.sort_unstable_by(f64::total_cmp);
    depths
}

/// Returns the 1 % and 99 % quantiles of the depths of the view's sparse points; if it observes
/// none, of all points in front of it.
///
/// # Errors
/// If no point is in front of it; `backend` needs a range.
pub fn depth_range(
    backend: &'static str,
    scene: &Scene,
    points: &ViewPoints,
    view: ViewIndex,
) -> Result<[f64; 2], BackendError> {
    let mut all = depths(scene, points, view);
    if all.is_empty() {
        let pose = &scene.view(view).cam_from_world;
        all = scene
            .points
            .iter()
            .map(|x| pose.camera_from_world(x).z)
            .filter(|z| *z > 0.0)
            .collect();
        all.sort_unstable_by(f64::total_cmp);
    }
    let Some(last) = all.len().checked_sub(1) else {
        let name = scene.name(view);
        return Err(BackendError::Needs {
            backend,
            what: format!("a depth range, and {name} observes no sparse point in front of it"),
            hint: "leave the view out of the model".into(),
        });
    };
    // Not the extremes: one wrong point would stretch the range.
    Ok([0.01, 0.99].map(|share| all[(last as f64 * share).round() as usize]))
}

/// Returns the number of sparse points that each view of the scene shares with `view`; 0 for
/// itself.
pub fn shared_points(scene: &Scene, points: &ViewPoints, view: ViewIndex) -> Vec<u32> {
    let mut shared = vec![0; scene.views.len()];
    for &p in points.observed_by(view) {
        let track = scene.track_views(p);
        for (i, v) in track.iter().enumerate() {
            // A view may observe a point twice; a track is sorted by view.
            shared[v.index()] += u32::from(i == 0 || track[i - 1] != *v);
        }
    }
    shared[view.index()] = 0;
    shared
}

/// Returns the one of these extensions that a name has, in lower case and as it is usually spelt.
pub fn extension(name: &str, known: &[&'static str]) -> Option<&'static str> {
    let given = Path::new(name).extension()?.to_str()?.to_ascii_lowercase();
    let usual = match &*given {
        "jpeg" => "jpg",
        "tif" => "tiff",
        given => given,
    };
    known.iter().find(|known| **known == usual).copied()
}

/// Returns those of the views that observe a point that are wanted, each once.
pub fn observers(
    scene: &Scene,
    point: PointIndex,
    wanted: impl Fn(ViewIndex) -> bool,
) -> Vec<ViewIndex> {
    let mut views = scene.track_views(point).to_vec();
    views.dedup();
    views.retain(|view| wanted(*view));
    views
}

/// Number of key views that a fusion compares with one: all that share points would take long.
pub const FUSED_WITH: usize = 24;

/// Returns those of `others`, best first, that are among the [`FUSED_WITH`] best for key view `i`
/// in the fusion of some number of first maps. A script takes the first of them that have a map.
/// The best of all would not do: few of them are among the first maps of a dense video, and a map
/// that is compared with few others gives few points.
pub fn fused_with(i: usize, others: &[usize]) -> Vec<usize> {
    let mut kept: Vec<usize> = Vec::new();
    for &other in others {
        // The first fusion with both maps: later ones have better ones besides. One that is not
        // kept has enough better ones that come no later, so that it need not be counted.
        let last = i.max(other);
        if kept.iter().filter(|&&better| better <= last).count() < FUSED_WITH {
            kept.push(other);
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_number_of_first_maps_is_compared_as_if_the_plan_ended_there() {
        let maps = 300;
        for i in [0, 7, 150, 299] {
            // 7 and 300 have no common factor: each number once.
            let others: Vec<usize> = (1..=maps)
                .map(|n| n * 7 % maps)
                .filter(|&o| o != i)
                .collect();
            let kept = fused_with(i, &others);
            for first in i + 1..=maps {
                let compared = |list: &[usize]| -> Vec<usize> {
                    let there = list.iter().copied().filter(|&o| o < first);
                    there.take(FUSED_WITH).collect()
                };
                assert_eq!(compared(&kept), compared(&others), "{first} maps, map {i}");
            }
            assert!(kept.len() < others.len() / 2);
        }
    }
}
