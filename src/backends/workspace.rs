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

/// Folders of a workspace, relative to the export.
#[derive(Clone, Copy)]
pub struct Folders<'a> {
    pub model: &'a str,
    /// Where the images are to be, and where they are; `None`: without images.
    pub images: Option<(&'a str, &'a ImageFolder)>,
}

/// Adds `{cameras,images,points3D}.bin` of the model and links to the images for the views and for
/// those kept for tests, in coordinates relative to `origin`, without points that fewer than
/// `least_views` of the former observe.
pub fn add_workspace(
    backend: &'static str,
    files: &mut FileSet,
    selection: &Selection,
    (views, tests, least_views): (&[ViewIndex], &[ViewIndex], usize),
    folders: Folders,
    origin: Vector3<f64>,
) -> Result<(), BackendError> {
    for (name, bytes) in reduced_model(selection, (views, tests, least_views), origin)? {
        files.add(format!("{}/{name}", folders.model), Contents::Bytes(bytes));
    }
    for &view in views.iter().chain(tests) {
        let name = selection.scene.name(view);
        if name.split('/').any(|part| matches!(part, "" | "." | "..")) {
            let why = "it leads out of the image folder".into();
            return Err(BackendError::Name {
                backend,
                name: name.into(),
                why,
            });
        }
        if let Some((folder, images)) = folders.images {
            files.add(format!("{folder}/{name}"), images.link(name));
        }
    }
    Ok(())
}

/// Returns the files of the model reduced to the views. Everything else in a COLMAP model except
/// coordinates is kept.
fn reduced_model(
    selection: &Selection,
    (views, tests, least_views): (&[ViewIndex], &[ViewIndex], usize),
    origin: Vector3<f64>,
) -> Result<Vec<(&'static str, Vec<u8>)>, BackendError> {
    let names = |views: &[ViewIndex]| -> HashSet<&str> {
        views.iter().map(|&v| selection.scene.name(v)).collect()
    };
    let (counting, others) = (names(views), names(tests));
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
        let reduced = model.reduced(use_of, least_views)?;
        Ok(colmap_bin::write(&reduced.moved(origin)?))
    };
    let fault = |fault| ProjectError::Fault {
        path: selection.project.model.path.clone(),
        fault,
    };
    Ok(selection
        .project
        .with_colmap_model(selection.scene, write)?
        .map_err(fault)?)
}
