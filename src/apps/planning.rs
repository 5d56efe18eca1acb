//! Plans a project for the backend that its settings name.

use crate::{
    backends::planned_for,
    base::progress::Watcher,
    config::Settings,
    io::project::Project,
    model::scene::Scene,
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
