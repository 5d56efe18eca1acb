//! Plans outside of their projects, for projects that must not be written to.

use std::path::{Path, PathBuf};

use serde::Deserialize;

use crate::{input::FileKind, output};

/// File of a plan outside its project, relative to the folder of the plan: `{"project": PATH}`.
const PROJECT_FILE: &str = "viewrank/project.json";

#[derive(Deserialize)]
struct RecordedPlan {
    project: PathBuf,
}

/// The project of the plan in this folder, if it is another folder.
pub(super) fn project_of(folder: &Path) -> Option<PathBuf> {
    let recorded: RecordedPlan =
        serde_json::from_slice(&output::read_own(folder, PROJECT_FILE, FileKind::Settings).ok()?)
            .ok()?;
    Some(recorded.project)
}
