//! Record of the input of a plan, written with it, so that a restarted daemon recognises a current
//! plan.

use std::path::Path;

use serde::{Deserialize, Serialize};

use super::{discover::OUTPUT_FOLDER, settle::Fingerprint};
use crate::{
    base::input::{self, FileKind},
    config::Settings,
    io::output::{self, FileSet},
    plan::Plan,
    show::manifest,
};

/// Path of the record, relative to the project.
pub const RECORD: &str = "viewrank/planned_from.json";

/// Most files of a plan that are looked for each time the record is read.
const MOST_FILES: usize = 1 << 17;

/// Content of [`RECORD`].
#[derive(Debug, Serialize, Deserialize)]
pub struct PlannedFrom {
    pub fingerprint: Fingerprint,
    /// Version of the manifest; a plan of another version is made again.
    #[serde(default)]
    pub version: u32,
    /// Name of the backend that the plan is for.
    #[serde(default)]
    pub backend: String,
    pub clusters: usize,
    pub share: f64,
    /// True if the plan keeps finished depth maps.
    #[serde(default)]
    pub finished: bool,
    /// True if there is no export for a backend that the settings name: the input is planned again.
    #[serde(default)]
    pub lacks_export: bool,
    /// Settings as given, without the values chosen from the data.
    pub settings: Settings,
    /// Files of the plan, relative to the project; if one is missing the project is planned again.
    #[serde(default)]
    pub files: Vec<String>,
}

impl PlannedFrom {
    /// Makes the record of a plan, with an empty list of files.
    pub fn new(plan: &Plan, fingerprint: Fingerprint, settings: Settings) -> Self {
        let finished = plan.decision.finished > 0 || !plan.finished.outdated.is_empty();
        Self {
            fingerprint,
            version: manifest::VERSION,
            backend: plan.stages.backend.into(),
            clusters: plan.decision.cut.clusters,
            share: plan.decision.cut.share,
            finished,
            lacks_export: false,
            settings,
            files: Vec::new(),
        }
    }

    /// Reads the record of a project's plan; `None` if the record or a file of the plan is missing,
    /// unreadable or of another version.
    pub fn read(project: &Path) -> Option<Self> {
        let bytes =
            input::read_all(output::open_own(project, RECORD).ok()?, FileKind::Record).ok()?;
        let record: Self = serde_json::from_slice(&bytes).ok()?;
        // More than this program writes: somebody else made it.
        if record.files.len() > MOST_FILES {
            return None;
        }
        let exists = |file: &String| project.join(file).exists();
        let has_manifest = project.join(OUTPUT_FOLDER).join("manifest.json").is_file();
        (has_manifest && record.version == manifest::VERSION && record.files.iter().all(exists))
            .then_some(record)
    }

    /// Lists the files of the sets that are inside the project, except caches.
    pub fn list_files(&mut self, sets: &[FileSet], project: &Path) {
        self.files = sets
            .iter()
            .flat_map(|set| files_in(set, project))
            .take(MOST_FILES)
            .collect();
    }
}

fn files_in(set: &FileSet, project: &Path) -> Vec<String> {
    let Ok(folder) = set.root.strip_prefix(project) else {
        return Vec::new();
    };
    let inside = set
        .files
        .keys()
        .map(|name| folder.join(name))
        // Emptying the cache must not cause a new plan.
        .filter(|name| !name.starts_with("viewrank/cache"));
    inside
        .map(|name| name.to_string_lossy().into_owned())
        .collect()
}
