//! Reads a project's pictures and masks.

use std::{
    collections::HashSet,
    io::ErrorKind,
    path::{Path, PathBuf},
    time::UNIX_EPOCH,
};

use rayon::prelude::*;
use serde::Serialize;
use viewrank_core::{
    method::confidence::{self, Grey, Mask, PictureError, SPACING},
    model::{
        camera::Camera,
        scene::{Scene, ViewIndex},
    },
};

use crate::{
    image::{self, Image, ImageError},
    input::{self, FileKind},
    project::{self, ImageFolder, Project, Unread, is_raw},
};

/// Image and mask folders of a project.
#[derive(Clone, Debug)]
pub struct PictureFolders {
    images: Option<ImageFolder>,
    /// As COLMAP's `mask_path`: `NAME.png` for the image NAME, or that with `.png` in place of its
    /// extension; black where the image may not be used.
    masks: Vec<PathBuf>,
    project: PathBuf,
    /// Views whose image is not read, ascending.
    without_image: Vec<ViewIndex>,
}

/// Size and times of a file, which show a change without reading it.
#[derive(Serialize)]
pub struct Stamp {
    size: u64,
    /// Modification time, nanoseconds since 1970.
    modified: u64,
    /// Time of the last change to content or name, which no program can set; on systems without it,
    /// the modification time.
    changed: u64,
}

/// Half the size at which an image is matched, whose camera may be of another size.
fn grey_size([width, height]: [u32; 2], camera: &Camera, image_scale: f64) -> [u32; 2] {
    let scale = image_scale / SPACING * f64::from(camera.width) / f64::from(width);
    // A reduced copy of the image is not enlarged again.
    [width, height].map(|side| ((f64::from(side) * scale.min(1.0)).round() as u32).max(2))
}

impl PictureFolders {
    pub fn new(project: &Project) -> Self {
        Self {
            images: project.images.clone(),
            masks: project.mask_folders(),
            project: project.home.clone(),
            without_image: Vec::new(),
        }
    }

    /// Returns the same pictures without the images of these views, ascending, which are known to
    /// be missing or unreadable.
    pub fn without(self, views: &[ViewIndex]) -> Self {
        Self {
            without_image: views.to_vec(),
            ..self
        }
    }

    /// Pictures in a folder that need not be a project.
    pub fn of(project: &Path, images: Option<ImageFolder>) -> Self {
        Self {
            images,
            masks: Vec::new(),
            project: project.into(),
            without_image: Vec::new(),
        }
    }

    pub fn have_images(&self) -> bool {
        self.images.is_some()
    }

    pub fn have_masks(&self) -> bool {
        let by_model = self.images.as_ref().is_some_and(ImageFolder::has_masks);
        by_model || !self.masks.is_empty()
    }

    /// Views whose image is not read, ascending.
    pub fn without_image(&self) -> &[ViewIndex] {
        &self.without_image
    }

    /// Folder of the project.
    pub fn project(&self) -> &Path {
        &self.project
    }

    /// Returns size and times of a view's image and mask, where they exist; `None` if the time of
    /// change of a file is unknown.
    pub fn stamps(&self, name: &str) -> Option<[Option<Stamp>; 2]> {
        let stamps = self.files(name).map(|path| {
            path.and_then(|path| path.metadata().ok())
                .map(|m| Stamp::new(&m))
        });
        stamps
            .iter()
            .flatten()
            .all(|stamp| stamp.modified != 0)
            .then_some(stamps)
    }

    /// Returns the view's picture in grey at half the size at which it is matched, and its mask;
    /// `None` without an image folder.
    pub fn grey(
        &self,
        scene: &Scene,
        view: ViewIndex,
        image_scale: f64,
    ) -> Result<Option<(Grey, Option<Mask>)>, ImageError> {
        let Some(folder) = &self.images else {
            return Ok(None);
        };
        if self.without_image.binary_search(&view).is_ok() {
            return Err(Unread::Missing.into());
        }
        let (file, camera) = (folder.file(scene.name(view)), scene.camera_of(view));
        // Most raw files can be decoded, but only to the small picture that they begin with.
        if is_raw(&file) {
            return Err(
                Unread::Broken("a raw picture of a camera, which viewrank does not read").into(),
            );
        }
        let wanted = |full| grey_size(full, camera, image_scale);
        let bytes = input::read(&file, FileKind::Picture)?;
        let (image, full) = Image::decode_grey(&bytes, camera.most_picture_pixels(), wanted)?;
        check_shape(full, camera)?;
        let grey = Grey::new(image.width as usize, image.height as usize, image.pixels);
        Ok(Some((grey, self.mask(scene, view)?)))
    }

    /// Returns the view's mask; `None` if it has none.
    pub fn mask(&self, scene: &Scene, view: ViewIndex) -> Result<Option<Mask>, ImageError> {
        let path = self.mask_file(scene.name(view));
        let read = |path: PathBuf| {
            let camera = scene.camera_of(view);
            let mask = image::mask(
                &input::read(&path, FileKind::Picture)?,
                camera.most_picture_pixels(),
            )?;
            check_shape([mask.width, mask.height], camera).map(|()| mask)
        };
        path.map(read)
            .transpose()
            .map_err(|fault| ImageError::Mask(Box::new(fault)))
    }

    /// Returns the fault of a view's mask that its header and its end show; `None` if the view has
    /// no mask.
    pub fn check_mask(&self, scene: &Scene, view: ViewIndex) -> Option<Result<(), ImageError>> {
        let path = self.mask_file(scene.name(view))?;
        let check = || {
            // Says what is wrong with a pipe, say.
            input::open(&path)?;
            check_shape(
                project::probe(&path)?.ok_or(ImageError::Unknown)?,
                scene.camera_of(view),
            )
        };
        Some(check())
    }

    /// Bytes of memory for reading the largest mask; 0 without one that can be read.
    pub fn most_mask_bytes(&self, scene: &Scene) -> u64 {
        let views: Vec<ViewIndex> = scene.view_indices().collect();
        let bytes = |view: &ViewIndex| {
            let bound = scene.camera_of(*view).most_picture_pixels();
            self.mask_file(scene.name(*view))
                .and_then(|path| image::mask_reading_bytes(&path, bound))
        };
        views.par_iter().filter_map(bytes).max().unwrap_or_default()
    }

    /// Returns what is wrong and what to do if there is a folder of masks, but no view of the scene
    /// has one in it.
    pub fn unused_masks(&self, scene: &Scene) -> Option<[String; 2]> {
        let cure = self.naming_of_masks(scene)?;
        if self
            .masks_of(scene.views.iter().map(|view| &*view.name))
            .is_some()
        {
            return None;
        }
        let folders: Vec<String> = self
            .masks
            .iter()
            .map(|folder| folder.display().to_string())
            .collect();
        Some([
            format!("no image has a mask in {}", folders.join(" or ")),
            cure,
        ])
    }

    /// Says how masks are named, with an image of the scene as the example; `None` without views or
    /// folders of masks.
    pub fn naming_of_masks(&self, scene: &Scene) -> Option<String> {
        let (first, folder) = (scene.view_indices().next()?, self.masks.first()?);
        let example = folder.join(format!("{}.png", scene.name(first)));
        Some(format!(
            "name them after the images, as COLMAP does: {}",
            example.display()
        ))
    }

    /// Paths of the masks that belong to no image of the project, sorted by folder, then name.
    pub fn stray_masks(&self, scene: &Scene) -> Vec<PathBuf> {
        let names = scene
            .views
            .iter()
            .map(|view| &*view.name)
            .chain(scene.unregistered.iter().map(String::as_str));
        let named: HashSet<PathBuf> = names.flat_map(|name| self.mask_files(name)).collect();
        let stray = |folder: &PathBuf| -> Vec<PathBuf> {
            let names = project::images_below(folder, |name| !named.contains(&folder.join(name)));
            names.into_iter().map(|name| folder.join(name)).collect()
        };
        self.masks.iter().flat_map(stray).collect()
    }

    /// Returns whether the view has a mask that excludes all of its image.
    pub fn is_all_masked(&self, scene: &Scene, view: ViewIndex) -> bool {
        self.mask(scene, view)
            .is_ok_and(|mask| mask.is_some_and(|mask| mask.share([1, 1], 0, 0) == 0.0))
    }

    /// Returns the paths of a view's image and mask; the image may not exist.
    pub fn files(&self, name: &str) -> [Option<PathBuf>; 2] {
        [
            self.images.as_ref().map(|folder| folder.file(name)),
            self.mask_file(name),
        ]
    }

    /// Folders of masks, in the order in which they count.
    pub fn mask_folders(&self) -> &[PathBuf] {
        &self.masks
    }

    /// Returns the folder of the first mask that one of these views has.
    pub fn masks_of<'a>(&self, mut names: impl Iterator<Item = &'a str>) -> Option<PathBuf> {
        let mask = names.find_map(|name| self.mask_file(name))?;
        let mut folders = self.masks.iter().map(PathBuf::as_path);
        let folder = folders.find(|folder| mask.starts_with(folder));
        Some(folder.or(mask.parent())?.to_path_buf())
    }

    /// Returns the file of a view's mask. A pipe or a device is found, too, so that reading it says
    /// what is wrong.
    pub fn mask_file(&self, name: &str) -> Option<PathBuf> {
        self.mask_files(name)
            .find(|path| path.exists() && !path.is_dir())
    }

    /// The masks that an image may have: the one that the model names, and in each folder
    /// `a.jpg.png` or `a.png` for `a.jpg`, and the same for the name of its file if that is
    /// another.
    fn mask_files(&self, name: &str) -> impl Iterator<Item = PathBuf> {
        let file = self
            .images
            .as_ref()
            .and_then(|images| images.other_name(name));
        let names: Vec<String> = [Some(name), file]
            .into_iter()
            .flatten()
            .flat_map(masks_of)
            .collect();
        let by_model = self.images.as_ref().and_then(|images| images.mask(name));
        let by_name = self
            .masks
            .iter()
            .flat_map(move |folder| names.clone().into_iter().map(|name| folder.join(name)));
        by_model.map(Path::to_path_buf).into_iter().chain(by_name)
    }
}

/// Names of the masks of an image, as COLMAP looks for them; an image that is PNG may have one of
/// its own name.
fn masks_of(name: &str) -> impl Iterator<Item = String> {
    let stem = match name.rsplit_once('.') {
        Some((stem, extension)) if !extension.contains('/') => stem,
        _ => name,
    };
    let is_png = name.to_ascii_lowercase().ends_with(".png");
    let own = if is_png {
        name.to_owned()
    } else {
        format!("{stem}.png")
    };
    [format!("{name}.png"), own].into_iter()
}

impl confidence::Pictures for PictureFolders {
    fn have_images(&self) -> bool {
        self.have_images()
    }

    fn grey(
        &self,
        scene: &Scene,
        view: ViewIndex,
        image_scale: f64,
    ) -> Result<Option<(Grey, Option<Mask>)>, PictureError> {
        Ok(self.grey(scene, view, image_scale)?)
    }

    fn mask(&self, scene: &Scene, view: ViewIndex) -> Result<Option<Mask>, PictureError> {
        Ok(self.mask(scene, view)?)
    }
}

impl From<ImageError> for PictureError {
    fn from(error: ImageError) -> Self {
        Self {
            is_unusable: error.is_unusable(),
            is_known: match &error {
                ImageError::Io(error) => error.kind() == ErrorKind::NotFound,
                ImageError::Unread(_) | ImageError::Shape { .. } => true,
                _ => false,
            },
            cause: error.into(),
        }
    }
}

impl Stamp {
    fn new(metadata: &std::fs::Metadata) -> Self {
        let since = metadata
            .modified()
            .unwrap_or(UNIX_EPOCH)
            .duration_since(UNIX_EPOCH);
        let modified = since.map_or(0, |since| since.as_nanos() as u64);
        Self {
            size: metadata.len(),
            modified,
            changed: input::identity(metadata).0 as u64,
        }
    }
}

/// Scaled copies of the image are accepted; another aspect ratio means another picture.
fn check_shape(size: [u32; 2], camera: &Camera) -> Result<(), ImageError> {
    let ([width, height], of_camera) = (size, [camera.width, camera.height]);
    let fits = camera.has_aspect_ratio_of(size);
    if fits {
        Ok(())
    } else {
        Err(ImageError::Shape {
            width,
            height,
            camera: of_camera,
        })
    }
}
