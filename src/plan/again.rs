//! An existing plan once more, with all its tables: same input and settings, same plan.

use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::{Plan, PlanError, plan};
use crate::{
    backends::RankedCluster,
    config::Settings,
    error::Hint,
    manifest::{FingerprintError, fingerprint},
    progress::Watcher,
    project::Project,
    scene::Scene,
};

/// The part of a manifest that a plan follows from.
#[derive(Deserialize)]
struct Recorded {
    version: u32,
    input: Input,
    backend: String,
    settings: Settings,
    clusters: Vec<Cluster>,
}

#[derive(Deserialize)]
struct Input {
    model: String,
    fingerprint: String,
}

#[derive(Deserialize)]
struct Cluster {
    key: String,
    partners: Vec<String>,
}

impl Cluster {
    fn is(&self, other: &RankedCluster, scene: &Scene) -> bool {
        let partners = other.partners.iter().map(|&p| scene.name(p));
        self.key == scene.name(other.key) && partners.eq(self.partners.iter().map(String::as_str))
    }
}

/// Plans again what `viewrank/manifest.json` of the project says.
pub fn again(root: &Path, watcher: &dyn Watcher) -> Result<(Project, Plan), AgainError> {
    let path = root.join("viewrank/manifest.json");
    let bytes = std::fs::read(&path).map_err(|source| AgainError::Io { path: path.clone(), source })?;
    let recorded: Recorded = serde_json::from_slice(&bytes)
        .map_err(|error| AgainError::Manifest { path: path.clone(), what: error.to_string() })?;
    if recorded.version != crate::manifest::VERSION {
        return Err(AgainError::Version { path, version: recorded.version });
    }
    let model = Path::new(&recorded.input.model).file_name().map(|name| name.to_string_lossy().into_owned());
    let only_model = Project::open(root, None).map_err(PlanError::from)?;
    let project = match model {
        Some(name) if only_model.model.name() != name => Project::open(root, Some(&name)).map_err(PlanError::from)?,
        _ => only_model,
    };
    let mut settings = recorded.settings;
    if settings.backends.is_empty() {
        settings.backends.push(recorded.backend);
    }
    let plan = plan(&project, &settings, watcher)?;
    if fingerprint(&project, &plan.scene)? != recorded.input.fingerprint {
        return Err(AgainError::OtherInput(path));
    }
    let same = plan.ranked().len() == recorded.clusters.len()
        && plan.ranked().zip(&recorded.clusters).all(|(ranked, recorded)| recorded.is(&ranked, &plan.scene));
    if !same {
        return Err(AgainError::OtherPlan(path));
    }
    Ok((project, plan))
}

/// Why there is no plan to go on with.
#[derive(Debug, thiserror::Error)]
pub enum AgainError {
    #[error("{}: {source}", path.display())]
    Io { path: PathBuf, source: std::io::Error },
    #[error("{}: {what}", path.display())]
    Manifest { path: PathBuf, what: String },
    #[error("{}: a manifest of version {version}, this program reads {}", path.display(), crate::manifest::VERSION)]
    Version { path: PathBuf, version: u32 },
    #[error("{}: the model or the images have changed since this plan was made", .0.display())]
    OtherInput(PathBuf),
    #[error("{}: another version of viewrank made this plan, and this one ranks otherwise", .0.display())]
    OtherPlan(PathBuf),
    #[error(transparent)]
    Input(#[from] FingerprintError),
    #[error(transparent)]
    Plan(#[from] PlanError),
}

impl Hint for AgainError {
    fn hint(&self) -> Option<String> {
        match self {
            Self::Io { path, .. }
            | Self::Manifest { path, .. }
            | Self::Version { path, .. }
            | Self::OtherInput(path)
            | Self::OtherPlan(path) => {
                let root = path.parent().and_then(Path::parent).unwrap_or(Path::new("."));
                Some(format!("make the plan first: viewrank plan {}", root.display()))
            }
            Self::Input(error) => error.hint(),
            Self::Plan(error) => error.hint(),
        }
    }
}
