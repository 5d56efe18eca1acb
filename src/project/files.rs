//! Opening the files of a model. They are mapped into memory, not copied.

use std::{
    collections::BTreeSet,
    fs::File,
    io,
    path::{Path, PathBuf},
};

use memmap2::Mmap;

use super::{ModelFormat, ModelLocation, ProjectError};
use crate::{
    formats::{Bytes, Fault, colmap::ColmapModel, colmap_bin, colmap_text},
    scene::Scene,
};

/// The three files without which there is no COLMAP model.
pub(super) const REQUIRED: [&str; 3] = ["cameras", "images", "points3D"];

/// Maps a file. Whoever cuts the file while it is mapped ends this process; the models' writers replace files, and the
/// daemon waits until they are at rest.
pub(super) fn map(path: &Path) -> Result<Mmap, ProjectError> {
    let fail = |source| ProjectError::Io { path: path.into(), source };
    let file = File::open(path).map_err(fail)?;
    if !file.metadata().map_err(fail)?.is_file() {
        return Err(fail(io::Error::new(io::ErrorKind::InvalidInput, "not a regular file")));
    }
    // SAFETY: the map is only read; see above for files that change.
    unsafe { Mmap::map(&file) }.map_err(fail)
}

/// The files of a COLMAP model, open.
pub struct ColmapFiles {
    folder: PathBuf,
    format: ModelFormat,
    cameras: Mmap,
    images: Mmap,
    points3d: Mmap,
    rigs: Option<Mmap>,
    frames: Option<Mmap>,
}

impl ColmapFiles {
    pub(super) fn open(model: &ModelLocation) -> Result<Self, ProjectError> {
        let path = |stem| colmap_file(&model.path, stem, model.format);
        let optional = |stem| {
            let path = path(stem);
            path.is_file().then(|| map(&path)).transpose()
        };
        let [cameras, images, points3d] = REQUIRED.map(|stem| map(&path(stem)));
        Ok(Self {
            folder: model.path.clone(),
            format: model.format,
            cameras: cameras?,
            images: images?,
            points3d: points3d?,
            rigs: optional("rigs")?,
            frames: optional("frames")?,
        })
    }

    /// All that the files hold.
    pub fn model(&self) -> Result<ColmapModel<'_>, ProjectError> {
        let bytes = Bytes {
            cameras: &self.cameras,
            images: &self.images,
            points3d: &self.points3d,
            rigs: self.rigs.as_deref(),
            frames: self.frames.as_deref(),
        };
        let model =
            if self.format == ModelFormat::ColmapText { colmap_text::read(&bytes) } else { colmap_bin::read(&bytes) };
        model.map_err(|fault| self.locate(fault))
    }

    /// Names of the images, without a look at the rest of the model.
    pub(super) fn image_names(&self) -> Result<BTreeSet<String>, ProjectError> {
        let names = match self.format {
            ModelFormat::ColmapText => colmap_text::image_names(&self.images),
            _ => colmap_bin::image_names(&self.images),
        };
        names.map_err(|fault| self.locate(fault))
    }

    pub(super) fn scene(&self) -> Result<Scene, ProjectError> {
        self.model()?.scene().map_err(|fault| self.locate(fault))
    }

    fn locate(&self, fault: Fault) -> ProjectError {
        ProjectError::Fault { path: colmap_file(&self.folder, fault.file, self.format), fault }
    }
}

/// The files of a COLMAP model that are there.
pub(super) fn all(model: &ModelLocation) -> Vec<PathBuf> {
    let files =
        ["cameras", "images", "points3D", "rigs", "frames"].map(|stem| colmap_file(&model.path, stem, model.format));
    files.into_iter().filter(|path| path.is_file()).collect()
}

/// Path of one file of a COLMAP model.
pub(super) fn colmap_file(folder: &Path, stem: &str, format: ModelFormat) -> PathBuf {
    let extension = if format == ModelFormat::ColmapText { "txt" } else { "bin" };
    folder.join(format!("{stem}.{extension}"))
}
