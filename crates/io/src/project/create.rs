//! Makes a project of a scene in memory.

use std::{
    fs,
    path::{Path, PathBuf},
};

use viewrank_core::{
    base::error::{Advice, Hint},
    model::scene::Scene,
};

use super::{ImageFolder, Project, ProjectError};
use crate::{
    formats::{colmap::ColmapModel, colmap_bin},
    input::{self, FileKind},
    output::{Contents, Disk, FileSet, OutputError},
    paths,
};

/// Folder of the model in a new project.
const MODEL: &str = "sparse/0";

/// Errors of making a project.
#[derive(Debug, thiserror::Error)]
pub enum CreateError {
    #[error("cannot write the model: {} has another one", .0.display())]
    OtherModel(PathBuf),
    #[error(transparent)]
    Output(#[from] OutputError),
    #[error(transparent)]
    Project(#[from] ProjectError),
}

impl Hint for CreateError {
    fn hint(&self) -> Option<Advice> {
        match self {
            Self::OtherModel(_) => Some("give a new or empty folder".into()),
            Self::Output(error) => error.hint(),
            Self::Project(error) => error.hint(),
        }
    }

    fn path(&self) -> Option<&Path> {
        match self {
            Self::OtherModel(path) => Some(path),
            Self::Output(error) => error.path(),
            Self::Project(error) => error.path(),
        }
    }
}

impl Project {
    /// Writes the scene as COLMAP model to `folder/sparse/0` and opens it as a project. `images`,
    /// the folder to which view names are relative, is noted in the model's `project.ini`. A folder
    /// that has the same model already is left as it is.
    ///
    /// # Errors
    /// The folder cannot be written, or has another model; names that no file can have.
    pub fn create(
        folder: &Path,
        scene: &Scene,
        images: Option<&Path>,
    ) -> Result<Self, CreateError> {
        // `project.ini` knows no working directory from which a relative path could count.
        let images = images.map(paths::absolute);
        let files = model_files(folder, scene, images.as_deref());
        if !are_there(&files) {
            if folder.join("sparse").exists() {
                return Err(CreateError::OtherModel(folder.into()));
            }
            fs::create_dir_all(folder).map_err(ProjectError::io(folder))?;
            files.write(&Disk::REAL)?;
        }
        let project = Self::open(folder, None)?;
        Ok(Self {
            images: images.map(ImageFolder::new).or(project.images.clone()),
            ..project
        })
    }
}

fn model_files(folder: &Path, scene: &Scene, images: Option<&Path>) -> FileSet {
    let mut files = FileSet::new(folder, "model");
    for (name, bytes) in colmap_bin::write(&ColmapModel::from_scene(scene)) {
        files.add(format!("{MODEL}/{name}"), Contents::Bytes(bytes));
    }
    if let Some(images) = images {
        files.add_text(
            format!("{MODEL}/project.ini"),
            format!("image_path={}\n", images.display()),
        );
    }
    files
}

/// Returns whether all files of a model have their contents already.
fn are_there(model: &FileSet) -> bool {
    model.files.iter().all(|(name, contents)| match contents {
        Contents::Bytes(bytes) => {
            let path = model.root.join(name);
            let there = input::read_start(&path, FileKind::Sparse, bytes.len() as u64 + 1);
            there.is_ok_and(|there| there == *bytes)
        }
        _ => false,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use viewrank_core::method::synthetic::Town;

    #[test]
    fn a_project_of_a_scene_has_its_views_and_its_images() {
        let scene = Town::default().scene();
        let (folder, images) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        for _ in 0..2 {
            Project::create(folder.path(), &scene, Some(images.path())).unwrap();
        }
        let project = Project::open(folder.path(), None).unwrap();
        assert_eq!(project.images.as_deref(), Some(images.path()));
        let read = project.read_scene().unwrap();
        assert!(read.has_same_views(&scene) && read.observations() == scene.observations());
        let other = scene.moved(nalgebra::Vector3::new(1.0, 0.0, 0.0));
        assert!(matches!(
            Project::create(folder.path(), &other, None),
            Err(CreateError::OtherModel(_))
        ));
    }
}
