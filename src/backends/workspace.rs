//! A COLMAP project with a subset of the views: a reduced binary model and links to the images.

use std::collections::HashSet;

use nalgebra::Vector3;

use super::{BackendError, Selection};
use crate::{
    io::{
        formats::{
            colmap::{ColmapImage, ColmapModel, ImageUse},
            colmap_bin,
        },
        output::{Contents, FileSet},
        project::{ImageFolder, ProjectError},
    },
    model::scene::ViewIndex,
};

/// A part of the model with its images, below the folder of an export.
#[derive(Clone, Copy)]
pub struct Workspace<'a> {
    /// Views whose points are taken.
    pub views: &'a [ViewIndex],
    /// Further views: those kept for tests.
    pub tests: &'a [ViewIndex],
    /// A point that fewer of `views` observe is left out.
    pub least_views: usize,
    /// Folder of the model.
    pub model: &'a str,
    /// Where the images are to be, and where they are; `None`: without images.
    pub images: Option<(&'a str, &'a ImageFolder)>,
}

/// Adds `{cameras,images,points3D}.bin` of the model and links to the images, in coordinates
/// relative to `origin`.
pub fn add_workspace(
    backend: &'static str,
    files: &mut FileSet,
    selection: &Selection,
    workspace: Workspace,
    origin: Vector3<f64>,
) -> Result<(), BackendError> {
    for (name, bytes) in reduced_model(selection, &workspace, origin)? {
        files.add(
            format!("{}/{name}", workspace.model),
            Contents::Bytes(bytes),
        );
    }
    for &view in workspace.views.iter().chain(workspace.tests) {
        let name = selection.scene.name(view);
        if name.split('/').any(|part| matches!(part, "" | "." | "..")) {
            let why = "it leads out of the image folder";
            return Err(BackendError::name(backend, name, why));
        }
        if let Some((folder, images)) = workspace.images {
            files.add(format!("{folder}/{name}"), images.link(name));
        }
    }
    Ok(())
}

/// Returns the files of the model reduced to the views. Everything else in a COLMAP model except
/// coordinates is kept.
fn reduced_model(
    selection: &Selection,
    workspace: &Workspace,
    origin: Vector3<f64>,
) -> Result<Vec<(&'static str, Vec<u8>)>, BackendError> {
    // By name: the images of the model on the disk are in an order of their own.
    let names = |views: &[ViewIndex]| -> HashSet<&str> {
        views.iter().map(|&v| selection.scene.name(v)).collect()
    };
    let (counting, others) = (names(workspace.views), names(workspace.tests));
    let write = |model: &ColmapModel| {
        let use_of = |image: &ColmapImage| {
            if counting.contains(&*image.name) {
                ImageUse::Counting
            } else if others.contains(&*image.name) {
                ImageUse::Kept
            } else {
                ImageUse::Removed
            }
        };
        let reduced = model.reduced(use_of, workspace.least_views)?;
        Ok(colmap_bin::write(&reduced.moved(origin)?))
    };
    Ok(selection
        .project
        .with_colmap_model(selection.scene, write)?
        .map_err(ProjectError::fault(&selection.project.model.path))?)
}
