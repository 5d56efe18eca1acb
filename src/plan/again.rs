//! An existing plan once more, with all its tables: same input and settings, same plan.

use std::path::Path;

use super::{Plan, PlanError, plan};
use crate::{
    error::Hint,
    manifest::{Recorded, WrittenPlanError},
    progress::Watcher,
    project::Project,
};

/// Plans again what `viewrank/manifest.json` of the project says, by the prediction alone (finished depth maps are not looked at).
pub fn again(root: &Path, watcher: &dyn Watcher) -> Result<(Project, Plan), AgainError> {
    let (project, recorded) = Recorded::open(root)?;
    let mut settings = recorded.settings.clone();
    if settings.backends.is_empty() {
        settings.backends.push(recorded.backend.clone());
    }
    // Before the long work, though the model is read twice for it.
    recorded.check_input(&project, &project.read_scene().map_err(WrittenPlanError::from)?)?;
    let plan = plan(&project, &settings, watcher)?;
    recorded.check_ranking(&plan)?;
    Ok((project, plan))
}

/// Why there is no plan to go on with.
#[derive(Debug, thiserror::Error)]
pub enum AgainError {
    #[error(transparent)]
    Written(#[from] WrittenPlanError),
    #[error(transparent)]
    Plan(#[from] PlanError),
}

impl Hint for AgainError {
    fn hint(&self) -> Option<String> {
        match self {
            Self::Written(error) => error.hint(),
            Self::Plan(error) => error.hint(),
        }
    }
}
