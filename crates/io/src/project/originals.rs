//! Tells the images of an undistorted model from those that it was undistorted from: with the
//! latter every depth map would be wrong, and nothing would show it.

use std::path::{Path, PathBuf};

use viewrank_core::base::error::Advice;

use super::{
    ImageFolder, ModelFormat, ModelLocation,
    discover::{FOLDERS_OF_PROGRAMS, are_among, poses, with_sparse},
    files::{self, colmap_file},
    folder,
};
use crate::{paths, shell::command_path};

/// Images that are not those of the model, but those that they were made from.
#[derive(Clone, Debug)]
pub struct Originals {
    /// Their folder.
    pub folder: PathBuf,
    /// The folder of their project, and their model.
    project: PathBuf,
    model: PathBuf,
}

/// Folders above the images that may be the project of their model.
const ABOVE: usize = 2;

impl Originals {
    /// What they are.
    pub fn what(&self) -> String {
        let (folder, model) = (self.folder.display(), self.model.display());
        format!(
            "the images in {folder} are those of the distorted model {model}, not of this undistorted one, and are not used"
        )
    }

    /// What to do besides giving the undistorted images.
    pub fn cure(&self) -> Advice {
        let Self { project, model, .. } = self;
        let inside = model.strip_prefix(project).unwrap_or(model);
        let (project, model) = (command_path(project), command_path(inside));
        Advice::text("give the undistorted images, or make them: ")
            .run(format!("undistort {project} --model {model}"))
            .and("; if these are the undistorted ones, name them with ")
            .set("images")
    }
}

/// The folder of a model's images, unless it has the originals of its images.
pub(super) fn told_apart(
    root: &Path,
    model: &ModelLocation,
    images: ImageFolder,
) -> (Option<ImageFolder>, Option<Originals>) {
    match originals(root, model, &images) {
        Some(originals) => (None, Some(originals)),
        None => (Some(images), None),
    }
}

fn originals(root: &Path, model: &ModelLocation, images: &Path) -> Option<Originals> {
    if !model.format.is_colmap() || files::is_distorted(model)? {
        return None;
    }
    let above = images.ancestors().skip(1).take(ABOVE);
    above.chain([root]).find_map(|project| {
        // The ancestors of a relative path end with an empty one, which no command line can name.
        let is_here = project.as_os_str().is_empty();
        let project = if is_here { Path::new(".") } else { project };
        Some(Originals {
            folder: images.into(),
            project: project.into(),
            model: distorted_model(project, model, images)?,
        })
    })
}

/// The distorted model in a project that has these images, and the other model's in the same poses.
fn distorted_model(project: &Path, model: &ModelLocation, images: &Path) -> Option<PathBuf> {
    let folders = FOLDERS_OF_PROGRAMS.map(|folder| with_sparse(&project.join(folder)));
    let folders = folders.into_iter().flatten();
    let others = folders
        .filter(|folder| !paths::is_same(folder, &model.path))
        .filter_map(|folder| colmap_cameras(&folder))
        .filter(|other| files::is_distorted(other) == Some(true))
        .filter(|other| is_folder_of(project, other, images));
    let others: Vec<ModelLocation> = others.collect();
    if others.is_empty() {
        return None;
    }
    // Only where a candidate is left: the poses of a large model take long to read.
    let own = poses(project, model).filter(|own| !own.is_empty())?;
    let is_same =
        |other: &ModelLocation| poses(project, other).is_some_and(|other| are_among(&own, &other));
    others
        .into_iter()
        .find(is_same)
        .map(|distorted| distorted.path)
}

/// The model of a folder, by its cameras alone: to look at its images takes long.
fn colmap_cameras(folder: &Path) -> Option<ModelLocation> {
    let mut formats = [ModelFormat::ColmapBinary, ModelFormat::ColmapText].into_iter();
    let format = formats.find(|format| colmap_file(folder, "cameras", *format).is_file())?;
    Some(ModelLocation::new(format, folder))
}

/// Returns whether a folder is that of a distorted model's images.
fn is_folder_of(project: &Path, distorted: &ModelLocation, images: &Path) -> bool {
    let sought = files::sought_images(distorted);
    folder::find(project, &distorted.path, None, &sought)
        .is_some_and(|own| paths::is_same(&own, images))
}
