//! Checks of `viewrank run` before it plans.

use std::path::Path;

use super::{Exit, Failure};
use crate::{
    apps::{
        dispatch::{Dispatch, Tools},
        undistort,
    },
    backends::{Backend, NotReady, Selection, not_ready},
    io::project::Project,
    model::{
        cluster::{MapScale, RankedCluster},
        scene::Scene,
    },
};

/// Fails before planning where matching would fail after it: without images, for a backend that
/// cannot match single clusters, without its program, or with a COLMAP that has no CUDA or a Python
/// that lacks packages. The export of one cluster says which program that is.
pub fn check(
    backend: &'static Backend,
    project: &Project,
    scene: Scene,
    program: Option<&Path>,
) -> Result<(), Failure> {
    let image_faults = project.image_faults(&scene);
    let has_images = project.images.is_some() && image_faults.is_any_usable(scene.views.len());
    // The run undistorts the images only after this check.
    let scene = undistort::with_undistorted_cameras(scene);
    let mut views = scene.view_indices();
    let (Some(key), Some(partner)) = (views.next(), views.next()) else {
        return Ok(());
    };
    let cluster = RankedCluster {
        key,
        partners: vec![partner],
        scale: MapScale::Full,
        share: 1.0,
    };
    let selection = Selection {
        project,
        scene: &scene,
        clusters: &[cluster],
        image_scale: 1.0,
        own_size: true,
        planned_for: backend.name,
        image_faults: &image_faults,
        test_every: None,
    };
    let export = match backend.export(&selection, &Default::default()) {
        Ok(export) => export,
        Err(error) if !has_images => return Err(error.into()),
        // Of this cluster alone, perhaps.
        Err(_) => return Ok(()),
    };
    let tools = Tools::find(&Dispatch::new(backend, &selection, &export, 0)?, program)?;
    match not_ready(backend, &tools.program, &tools.python) {
        Some(NotReady { what, cure }) => Err(Failure::new(Exit::Failed, what, cure.to_owned())),
        None => Ok(()),
    }
}
