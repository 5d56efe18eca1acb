//! The MVS programs that viewrank writes for: one file per backend, everything that is known about it in that file.

use crate::{
    confidence::PairConfidence,
    output::FileSet,
    partners::PairGeometry,
    plan::{Plan, Reason},
    project::Project,
};

/// How far a backend does what the plan says.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Honours {
    Yes,
    /// Only in part; the backend's `notes` say how.
    Partly,
    No,
}

/// What a backend honours of a plan.
#[derive(Clone, Copy, Debug, serde::Serialize)]
pub struct Capabilities {
    /// Exactly the given matching partners.
    pub partners: Honours,
    /// Depth maps for exactly the key views.
    pub key_subset: Honours,
    /// Key views in rank order.
    pub order: Honours,
    /// The step that joins the depth maps, in words.
    pub fusion: &'static str,
    /// What is not honoured, for people.
    pub notes: &'static str,
}

/// What a backend contributes to planning, each with where it was measured.
#[derive(Clone, Copy, Debug, serde::Serialize)]
pub struct PlanningNumbers {
    /// Method 7.2.
    pub confidence: PairConfidence,
    /// Depth maps that must see a triangle (m, method 5.2).
    pub support: u32,
    /// Where the numbers and the gate come from.
    pub source: &'static str,
}

/// An MVS program.
pub trait Backend: Sync {
    /// As typed behind `--backend`.
    fn name(&self) -> &'static str;

    fn capabilities(&self) -> Capabilities;

    fn planning(&self) -> PlanningNumbers;

    /// Why the backend cannot match the pair; `None`: it can (method 7.1).
    fn refusal(&self, pair: &PairGeometry) -> Option<Reason>;

    /// The same for all pairs of one key view that share points, most shared points first, where one pair decides about another.
    fn refusals(&self, pairs: &[PairGeometry]) -> Vec<Option<Reason>> {
        pairs.iter().map(|pair| self.refusal(pair)).collect()
    }

    /// Is the project set up for this backend, so that `plan` writes its files unasked?
    fn serves(&self, project: &Project) -> bool {
        let _ = project;
        false
    }

    /// What is to be written; writes nothing.
    fn files(&self, plan: &Plan, project: &Project, options: &ExportOptions) -> Result<FileSet, BackendError>;
}

/// What a user can choose about an export.
#[derive(Clone, Debug, Default)]
pub struct ExportOptions {
    /// Where the files go; `None`: the backend's own place in the project.
    pub out: Option<std::path::PathBuf>,
}

/// Why a backend's files cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum BackendError {
    #[error("{backend} cannot take the image name \"{name}\": {why}")]
    Name { backend: &'static str, name: String, why: String, hint: String },
    #[error("{backend} needs {what}")]
    Needs { backend: &'static str, what: String, hint: String },
    #[error("{path}: {source}")]
    Io { path: std::path::PathBuf, source: std::io::Error },
}
