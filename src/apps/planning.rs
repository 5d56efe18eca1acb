//! Plans a project for the backend that its settings name, and finds the images that it takes.

use crate::{
    backends::{Backend, planned_for},
    base::progress::Watcher,
    config::Settings,
    io::project::{Project, ProjectError},
    model::scene::{Scene, View},
    plan::{Plan, PlanError, Timings},
};

/// Plans which views of the project become key views, with which partners, in which order, for the
/// backend that the settings name, else the default one.
pub fn plan(
    project: &Project,
    settings: &Settings,
    watcher: &dyn Watcher,
) -> Result<Plan, PlanError> {
    Plan::new(project, settings, &planned_for(project, settings)?, watcher)
}

/// Returns the undistorted workspace of the project, if the backend needs that: the cameras of the
/// project's model are distorted, and those of the workspace are not and have the same poses.
pub fn undistorted_workspace(
    project: &Project,
    backend: &Backend,
) -> Result<Option<Project>, ProjectError> {
    // Looked for before the scene is read, which takes longer.
    let dense = project.undistorted_workspace();
    let Some(dense) = dense.filter(|_| !backend.takes_distorted) else {
        return Ok(None);
    };
    let is_pinhole = |scene: &Scene| {
        scene
            .view_indices()
            .all(|view| scene.camera_of(view).is_pinhole())
    };
    let scene = project.read_scene()?;
    if is_pinhole(&scene) {
        return Ok(None);
    }
    let Ok(workspace) = Project::open(&dense, None) else {
        return Ok(None);
    };
    let fits = |there: Scene| is_pinhole(&there) && is_of_same_images(&there, &scene);
    Ok(workspace.read_scene().is_ok_and(fits).then_some(workspace))
}

/// Returns whether a scene has the views of another in the same poses. OpenSfM adds the extension
/// of the undistorted images to the names (`a.jpg.tif`).
fn is_of_same_images(undistorted: &Scene, scene: &Scene) -> bool {
    let is_same = |(there, here): (&View, &View)| {
        let added = there.name.strip_prefix(&*here.name);
        added.is_some_and(|added| added.is_empty() || added.starts_with('.'))
            && there.cam_from_world.is_near(&here.cam_from_world)
    };
    undistorted.views.len() == scene.views.len()
        && undistorted.views.iter().zip(&scene.views).all(is_same)
}

/// Like [`plan`], for a scene of the project that is already read.
pub fn plan_scene(
    project: &Project,
    scene: Scene,
    settings: &Settings,
    watcher: &dyn Watcher,
) -> Result<Plan, PlanError> {
    let matcher = planned_for(project, settings)?;
    Plan::from_scene(
        project,
        scene,
        settings,
        &matcher,
        Timings::start(),
        watcher,
    )
}
