//! A plan that was written before, without planning again: the ranking from `manifest.json`, the scene from the model.

use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::{FingerprintError, VERSION, fingerprint};
use crate::{
    backends::RankedCluster,
    config::{Budget, Settings, Share},
    error::Hint,
    project::{Project, ProjectError},
    scene::{Scene, ViewIndex},
};

/// A ranking with the project and the scene that it belongs to.
#[derive(Debug)]
pub struct WrittenPlan {
    pub project: Project,
    pub scene: Scene,
    /// Name of the backend that the plan was made for.
    pub backend: String,
    pub settings: Settings,
    /// The whole ranking, best first.
    pub clusters: Vec<RankedCluster>,
    /// Clusters that the plan's own cut takes.
    pub cut: usize,
}

/// The part of a manifest that is needed.
#[derive(Deserialize)]
struct Recorded {
    version: u32,
    input: Input,
    backend: String,
    settings: Settings,
    clusters: Vec<Cluster>,
    cut: Cut,
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
    share: f64,
}

#[derive(Deserialize)]
struct Cut {
    clusters: usize,
}

impl WrittenPlan {
    /// Reads `viewrank/manifest.json` of the project; an error where model or images have changed since.
    pub fn read(root: &Path) -> Result<Self, WrittenPlanError> {
        let any_model = Project::open(root, None)?;
        let path = any_model.output_folder().join("manifest.json");
        let recorded = Recorded::read(&path)?;
        let model = Path::new(&recorded.input.model).file_name().map(|name| name.to_string_lossy().into_owned());
        let project = match model {
            Some(name) if any_model.model.name() != name => Project::open(root, Some(&name))?,
            _ => any_model,
        };
        let scene = project.read_scene()?;
        if fingerprint(&project, &scene)? != recorded.input.fingerprint {
            return Err(WrittenPlanError::OtherInput(path));
        }
        let view = |name: &String| scene.find(name).ok_or_else(|| WrittenPlanError::OtherInput(path.clone()));
        let cluster = |c: &Cluster| {
            let partners: Result<Vec<ViewIndex>, _> = c.partners.iter().map(view).collect();
            Ok(RankedCluster { key: view(&c.key)?, partners: partners?, share: c.share })
        };
        let clusters: Vec<_> = recorded.clusters.iter().map(cluster).collect::<Result<_, WrittenPlanError>>()?;
        let cut = recorded.cut.clusters.min(clusters.len());
        Ok(Self { project, backend: recorded.backend, settings: recorded.settings, clusters, cut, scene })
    }

    /// How many clusters another cut takes: so many, or the fewest that reach the share.
    pub fn cut_at(&self, budget: Option<Budget>, target: Option<Share>) -> usize {
        let all = self.clusters.len();
        let by_budget = match budget {
            Some(Budget::Clusters(n)) => usize::try_from(n).unwrap_or(all),
            Some(Budget::Views(share)) => (share.0 * self.scene.views.len() as f64).ceil() as usize,
            None => all,
        };
        let by_target = target.map_or(all, |target| self.clusters.partition_point(|c| c.share < target.0) + 1);
        if budget.is_none() && target.is_none() { self.cut } else { all.min(by_budget).min(by_target) }
    }
}

impl Recorded {
    fn read(path: &Path) -> Result<Self, WrittenPlanError> {
        let bytes = std::fs::read(path).map_err(|source| WrittenPlanError::Io { path: path.into(), source })?;
        let recorded: Self = serde_json::from_slice(&bytes)
            .map_err(|error| WrittenPlanError::Manifest { path: path.into(), what: error.to_string() })?;
        match recorded.version {
            VERSION => Ok(recorded),
            version => Err(WrittenPlanError::Version { path: path.into(), version }),
        }
    }
}

/// Why there is no plan to go on with.
#[derive(Debug, thiserror::Error)]
pub enum WrittenPlanError {
    #[error("there is no plan: {}: {source}", path.display())]
    Io { path: PathBuf, source: std::io::Error },
    #[error("{}: {what}", path.display())]
    Manifest { path: PathBuf, what: String },
    #[error("{}: a manifest of version {version}, this program reads {VERSION}", path.display())]
    Version { path: PathBuf, version: u32 },
    #[error("{}: the model or the images have changed since this plan was made", .0.display())]
    OtherInput(PathBuf),
    #[error(transparent)]
    Input(#[from] FingerprintError),
    #[error(transparent)]
    Project(#[from] ProjectError),
}

impl Hint for WrittenPlanError {
    fn hint(&self) -> Option<String> {
        match self {
            Self::Io { path, .. }
            | Self::Manifest { path, .. }
            | Self::Version { path, .. }
            | Self::OtherInput(path) => {
                let root = path.parent().and_then(Path::parent).unwrap_or(Path::new("."));
                Some(format!("make the plan first: viewrank plan {}", root.display()))
            }
            Self::Input(error) => error.hint(),
            Self::Project(error) => error.hint(),
        }
    }
}
