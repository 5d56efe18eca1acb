//! Undistorts the images for backends that need it: a COLMAP dense workspace like that of
//! `image_undistorter`.
//!
//! Images are written in batches, each completely or not at all, with a record of their inputs, so
//! that an interrupted run resumes. The model is written last and removed first: a workspace with a
//! `sparse/` is complete.

mod camera;
mod picture;

use std::{
    io,
    path::{Path, PathBuf},
};

use nalgebra::Point2;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

pub use picture::UndistortImageError;

use crate::{
    backends::CUT_PANORAMAS,
    base::{
        error::{Advice, Hint},
        input::{self, FileKind},
        paths,
        printable::to_json,
        progress::{Cancelled, Stage, Watcher},
    },
    io::{
        formats::{
            colmap::{ColmapModel, ImageUse, Point2d},
            colmap_bin,
        },
        output::{self, Contents, Disk, FileSet, OutputError},
        pictures::PictureFolders,
        project::{
            ImageFolder, Project, ProjectError, UNDISTORTED_SET, has_model_of_others,
            undistorted_set,
        },
    },
    model::{
        camera::Camera,
        scene::{Scene, ViewIndex},
    },
};

/// Options of the undistorted images, with COLMAP's names and defaults.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct UndistortOptions {
    /// 0: no blank pixels; 1: all pixels of the distorted image; values between interpolate.
    pub blank_pixels: f64,
    /// Smallest and largest size relative to the distorted image.
    pub min_scale: f64,
    pub max_scale: f64,
    /// Longest side, pixels.
    pub max_image_size: Option<u32>,
    /// Region of interest: left, top, right, bottom, as shares of the sides.
    pub roi: [f64; 4],
}

impl UndistortOptions {
    const WHOLE: [f64; 4] = [0.0, 0.0, 1.0, 1.0];
}

impl Default for UndistortOptions {
    fn default() -> Self {
        Self {
            blank_pixels: 0.0,
            min_scale: 0.2,
            max_scale: 2.0,
            max_image_size: None,
            roi: Self::WHOLE,
        }
    }
}

/// Result of a run.
#[derive(Clone, Debug, Default, Serialize)]
pub struct UndistortReport {
    /// The dense workspace.
    pub folder: PathBuf,
    /// Number of images in the workspace.
    pub images: usize,
    /// Number of them computed by this run; the others were there already or are links to images
    /// without distortion.
    pub computed: usize,
    /// New names of the user's files that were in the way.
    pub kept: Vec<String>,
    /// True if the model has no points: nothing can be planned without.
    #[serde(skip)]
    pub is_without_points: bool,
    /// Folder of the images' masks, which are not undistorted; null without masks.
    pub masks: Option<PathBuf>,
}

impl UndistortReport {
    /// Warns of masks that are left behind.
    pub fn warning(&self) -> Option<String> {
        let (masks, folder) = (self.masks.as_ref()?.display(), self.folder.display());
        Some(format!(
            "the masks in {masks} are not undistorted: {folder} is planned and matched without them"
        ))
    }
}

/// Pixels per batch; up to about twelve bytes of memory each.
const BATCH_PIXELS: u64 = 100_000_000;

/// Writes the undistorted images and the model of the project to a dense workspace.
pub fn undistort(
    project: &Project,
    options: &UndistortOptions,
    out: &Path,
    disk: &Disk,
    watcher: &dyn Watcher,
) -> Result<UndistortReport, UndistortError> {
    output::refuse_to_leave(&project.home, out)?;
    if has_model_of_others(out) {
        return Err(UndistortError::OthersModel(out.into()));
    }
    let scene = project.read_scene()?;
    let job = Undistortion::new(project, &scene, options, out)?;
    let batches = job.batches();
    let masks = PictureFolders::new(project);
    let masks = masks.masks_of(scene.views.iter().map(|view| &*view.name));
    let mut done = UndistortReport {
        folder: out.into(),
        images: scene.views.len(),
        is_without_points: scene.points.is_empty(),
        masks,
        ..UndistortReport::default()
    };
    let mut finished = 0;
    watcher.progress(Stage::Undistort, 0, done.images as u64);
    for (i, views) in batches.iter().enumerate() {
        let note = job.note(views, watcher)?;
        if !job.is_there(i, views, &note) {
            // Removes the model first: next to images of other sizes, it would be taken for valid.
            FileSet::new(out, UNDISTORTED_SET).write(disk)?;
            done.kept
                .extend(job.batch(i, views, note, watcher)?.write(disk)?.kept);
            done.computed += views.iter().filter(|v| !job.stays(**v)).count();
        }
        finished += views.len();
        watcher.progress(Stage::Undistort, finished as u64, done.images as u64);
    }
    job.remove_batches_from(batches.len(), disk)?;
    // Any batch that was made anew has removed the model.
    if done.computed > 0 || !job.has_model()? {
        done.kept.extend(job.workspace()?.write(disk)?.kept);
    }
    Ok(done)
}

/// Returns the scene with the cameras that its undistorted images will have. A camera without a
/// pinhole camera stays.
pub fn with_undistorted_cameras(mut scene: Scene) -> Scene {
    for camera in scene
        .cameras
        .iter_mut()
        .filter(|camera| camera.model().focal_length_count() > 0)
    {
        if let Ok(pinhole) = camera::undistorted(camera, &UndistortOptions::default()) {
            *camera = pinhole;
        }
    }
    scene
}

/// Inputs of an undistorted image; the image is recomputed when they change.
#[derive(Serialize)]
struct ImageRecipe<'a> {
    name: &'a str,
    /// BLAKE3 of the distorted image.
    image: String,
    from: String,
    to: String,
}

struct Undistortion<'a> {
    project: &'a Project,
    scene: &'a Scene,
    images: &'a ImageFolder,
    out: &'a Path,
    /// The undistorted camera of each camera of the scene.
    cameras: Vec<Camera>,
}

impl<'a> Undistortion<'a> {
    fn new(
        project: &'a Project,
        scene: &'a Scene,
        options: &UndistortOptions,
        out: &'a Path,
    ) -> Result<Self, UndistortError> {
        let images = project.images.as_ref().ok_or_else(|| {
            UndistortError::NoImages(project.root.clone(), project.where_images_belong())
        })?;
        // The images would be replaced by what is made of them.
        if paths::is_same(images, &out.join("images")) {
            return Err(UndistortError::OwnImages(images.to_path_buf()));
        }
        let pinhole = |camera: &Camera| match camera.model().focal_length_count() {
            0 => Err(UndistortError::NoPinhole {
                model: camera.model().name(),
            }),
            _ => camera::undistorted(camera, options).map_err(|error| UndistortError::Image {
                path: images.to_path_buf(),
                source: error.into(),
            }),
        };
        let cameras = scene
            .cameras
            .iter()
            .map(pinhole)
            .collect::<Result<_, _>>()?;
        Ok(Self {
            project,
            scene,
            images,
            out,
            cameras,
        })
    }

    fn source(&self, view: ViewIndex) -> &Camera {
        self.scene.camera_of(view)
    }

    fn target(&self, view: ViewIndex) -> &Camera {
        &self.cameras[self.scene.view(view).camera.index()]
    }

    /// Returns whether the image needs no undistortion.
    fn stays(&self, view: ViewIndex) -> bool {
        let (source, target) = (self.source(view), self.target(view));
        source.is_pinhole() && (source.width, source.height) == (target.width, target.height)
    }

    /// Groups the views into batches of a bounded number of pixels.
    fn batches(&self) -> Vec<Vec<ViewIndex>> {
        let mut batches: Vec<Vec<ViewIndex>> = Vec::new();
        let mut pixels = u64::MAX;
        for view in self.scene.view_indices() {
            let own = u64::from(self.source(view).width) * u64::from(self.source(view).height);
            if pixels.saturating_add(own) > BATCH_PIXELS {
                batches.push(Vec::new());
                pixels = 0;
            }
            pixels += own;
            batches
                .last_mut()
                .expect("the first view opens a batch")
                .push(view);
        }
        batches
    }

    /// Returns the record of a batch's inputs.
    fn note(&self, views: &[ViewIndex], watcher: &dyn Watcher) -> Result<String, UndistortError> {
        let made = |&view: &ViewIndex| {
            watcher.check()?;
            let camera = |c: &Camera| {
                format!(
                    "{} {}x{} {:?}",
                    c.model().name(),
                    c.width,
                    c.height,
                    c.params()
                )
            };
            // Read only to be hashed: a batch that is there is not decoded.
            let image = blake3::hash(&self.read(view)?).to_string();
            let (from, to) = (camera(self.source(view)), camera(self.target(view)));
            Ok(ImageRecipe {
                name: self.scene.name(view),
                image,
                from,
                to,
            })
        };
        let made: Vec<ImageRecipe> = views
            .par_iter()
            .map(made)
            .collect::<Result<_, UndistortError>>()?;
        Ok(to_json(&made))
    }

    fn read(&self, view: ViewIndex) -> Result<Vec<u8>, UndistortError> {
        let path = self.images.file(self.scene.name(view));
        input::read(&path, FileKind::Picture).map_err(|source| UndistortError::Image {
            path,
            source: image::ImageError::IoError(source).into(),
        })
    }

    fn is_there(&self, batch: usize, views: &[ViewIndex], note: &str) -> bool {
        input::read_text(&self.out.join(note_path(batch)), FileKind::Record)
            .is_ok_and(|there| there == note)
            && views
                .iter()
                .all(|v| self.out.join("images").join(self.scene.name(*v)).exists())
    }

    fn batch(
        &self,
        batch: usize,
        views: &[ViewIndex],
        note: String,
        watcher: &dyn Watcher,
    ) -> Result<FileSet, UndistortError> {
        let image = |&view: &ViewIndex| {
            watcher.check()?;
            let name = self.scene.name(view);
            let path = self.images.file(name);
            // The file itself, where nothing changes: encoded again, it would lose quality.
            let contents = if self.stays(view) {
                self.images.link(name)
            } else {
                picture::undistort(
                    &self.read(view)?,
                    name,
                    self.source(view),
                    self.target(view),
                )
                .map(Contents::Bytes)
                .map_err(|source| UndistortError::Image { path, source })?
            };
            Ok((format!("images/{name}"), contents))
        };
        let images: Vec<_> = views
            .par_iter()
            .map(image)
            .collect::<Result<_, UndistortError>>()?;
        let mut files = FileSet::new(self.out, &undistorted_set(1 + batch));
        files.files.extend(images);
        files.add_text(note_path(batch), note);
        Ok(files)
    }

    /// Removes batches that an earlier run with more images wrote.
    fn remove_batches_from(&self, first: usize, disk: &Disk) -> Result<(), OutputError> {
        let mut later = (first..).take_while(|&i| self.out.join(note_path(i)).exists());
        later.try_for_each(|i| {
            FileSet::new(self.out, &undistorted_set(1 + i))
                .write(disk)
                .map(|_| ())
        })
    }

    /// Returns whether the model of the workspace follows from the project's current model.
    fn has_model(&self) -> Result<bool, UndistortError> {
        let files = self.model()?;
        Ok(files.iter().all(|(name, bytes)| {
            input::read(&self.out.join("sparse").join(name), FileKind::Sparse)
                .is_ok_and(|there| there == *bytes)
        }))
    }

    fn model(&self) -> Result<Vec<(&'static str, Vec<u8>)>, UndistortError> {
        let write = |model: &ColmapModel| {
            Ok(colmap_bin::write(
                &self.undistorted(model.reduced(|_| ImageUse::Counting, 1)?),
            ))
        };
        Ok(self
            .project
            .with_colmap_model(self.scene, write)?
            .map_err(ProjectError::fault(&self.project.model.path))?)
    }

    /// Returns the model with pinhole cameras. 2D points that these cameras cannot see are dropped,
    /// as are their observations.
    fn undistorted<'m>(&self, mut model: ColmapModel<'m>) -> ColmapModel<'m> {
        let target = |id: u32| self.cameras.iter().find(|c| c.id == id);
        let source = |id: u32| self.scene.cameras.iter().find(|c| c.id == id);
        // Images and points name each other: both have to drop an observation.
        let mut unseen = std::collections::HashSet::new();
        for image in &mut model.images {
            let (Some(from), Some(to)) = (source(image.camera_id), target(image.camera_id)) else {
                continue;
            };
            let moved = |(i, point): (usize, &Point2d)| match seen(from, to, point.pixel()) {
                Some(pixel) => Point2d::new(pixel, point.point()),
                None => {
                    unseen.insert((image.id, i as u32));
                    Point2d::new(point.pixel(), None)
                }
            };
            image.points2d = image.points2d.iter().enumerate().map(moved).collect();
        }
        for point in &mut model.points {
            point.track = point
                .track
                .iter()
                .filter(|t| !unseen.contains(&(t.image(), t.index())))
                .copied()
                .collect();
        }
        model.points.retain(|point| !point.track.is_empty());
        model
            .cameras
            .iter_mut()
            .for_each(|c| *c = target(c.id).unwrap_or(c).clone());
        model
    }

    /// Returns all files but the images: the model, folders for depth maps, and COLMAP's own lists
    /// of all images, which a plan replaces.
    fn workspace(&self) -> Result<FileSet, UndistortError> {
        let mut files = FileSet::new(self.out, UNDISTORTED_SET);
        for (name, bytes) in self.model()? {
            files.add(format!("sparse/{name}"), Contents::Bytes(bytes));
        }
        let names = || self.scene.views.iter().map(|view| view.name.as_str());
        // Patch match creates no folders, also none for the sub-folders of names.
        for kind in ["depth_maps", "normal_maps", "consistency_graphs"] {
            for name in names() {
                let folder = name
                    .rsplit_once('/')
                    .map_or(String::new(), |(folder, _)| format!("/{folder}"));
                files.add(format!("stereo/{kind}{folder}"), Contents::Folder);
            }
        }
        files.add_text(
            "stereo/patch-match.cfg",
            names()
                .map(|n| format!("{n}\n__auto__, 20\n"))
                .collect::<String>(),
        );
        files.add_text(
            "stereo/fusion.cfg",
            names().map(|n| format!("{n}\n")).collect::<String>(),
        );
        Ok(files)
    }
}

fn note_path(batch: usize) -> String {
    format!("viewrank/{}.json", undistorted_set(1 + batch))
}

/// Maps a pixel of the distorted camera to the pinhole camera.
fn seen(from: &Camera, to: &Camera, pixel: [f64; 2]) -> Option<[f64; 2]> {
    let ray = from.ray(&Point2::from(pixel))?;
    to.project(&ray.into_inner().into()).map(Into::into)
}

/// An error of undistortion; images that are finished stay for the next run.
#[derive(Debug, thiserror::Error)]
pub enum UndistortError {
    #[error(transparent)]
    Project(#[from] ProjectError),
    #[error("cannot undistort {}: no image folder found", .0.display())]
    NoImages(PathBuf, String),
    #[error("cannot write to {}: it contains the images to undistort", .0.display())]
    OwnImages(PathBuf),
    #[error("cannot write to {}: its model is not viewrank's", .0.display())]
    OthersModel(PathBuf),
    #[error("cannot undistort {model} cameras to pinhole cameras")]
    NoPinhole { model: &'static str },
    #[error("{}: {source}", path.display())]
    Image {
        path: PathBuf,
        source: UndistortImageError,
    },
    #[error(transparent)]
    Output(#[from] OutputError),
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
}

impl Hint for UndistortError {
    fn hint(&self) -> Option<Advice> {
        Some(match self {
            Self::Project(error) => return error.hint(),
            Self::NoImages(_, hint) => hint.as_str().into(),
            Self::OwnImages(_) | Self::OthersModel(_) => {
                Advice::text("write to another folder with ").set("out")
            }
            Self::NoPinhole { .. } => CUT_PANORAMAS.into(),
            Self::Image {
                source: UndistortImageError::Size { .. },
                ..
            } => "give the images that the model was made from, at their full size".into(),
            Self::Image {
                source: UndistortImageError::Format,
                ..
            } => "convert the images and their names in the model, or undistort with COLMAP".into(),
            Self::Image {
                source: UndistortImageError::Broken(image::ImageError::IoError(error)),
                ..
            } if error.kind() == io::ErrorKind::NotFound => {
                "put the image there, or take it out of the model".into()
            }
            Self::Image { .. } => "replace the image, or take it out of the model".into(),
            Self::Output(error) => return error.hint(),
            Self::Cancelled(_) => return None,
        })
    }
}
