//! Reads a written plan instead of planning again: the ranking from `manifest.json`, the scene from
//! the model.

use std::{
    io, mem,
    path::{Path, PathBuf},
};

use serde::{Deserialize, Deserializer};

use super::{FingerprintError, RegionSummary, VERSION, ViewEntry, check::check, fingerprint};
use crate::{
    backends::{ExportRecord, Selection, by_name},
    base::{
        bounded::{self, Names},
        error::{Advice, Hint, shortened},
        input::FileKind,
        paths::absolute,
        shell::command_path,
    },
    config::{Budget, Settings, Share, TypedSetting},
    io::{
        json::place_and_fault,
        output::{self, OutputError},
        project::{ImageFaults, Project, ProjectError},
    },
    model::{
        cluster::{MapScale, RankedCluster},
        scene::{Scene, ViewIndex},
    },
    plan::{Cut, GroundSummary, MOST_VIEWS, OutdatedMap, Plan},
};

/// A written ranking with its project and scene.
#[derive(Debug)]
pub struct WrittenPlan {
    pub project: Project,
    pub scene: Scene,
    /// Name of the backend that the plan was made for.
    pub backend: String,
    pub settings: Settings,
    /// True if `settings.image_scale` is the backend's default.
    pub own_size: bool,
    /// The whole ranking, best first.
    pub clusters: Vec<RankedCluster>,
    /// Work of the clusters up to each, over that of all clusters at full size.
    pub work: Vec<f64>,
    /// Clusters up to the plan's own cut.
    pub cut: usize,
    /// Depth maps, or images, that the project can have.
    pub all_maps: usize,
    /// Images that could be chosen; `None` for a program that makes depth maps.
    pub images: Option<usize>,
    /// Number of clusters at the start that had a finished depth map when the plan was made, even
    /// if their views have moved since.
    pub finished: usize,
    /// Target share of the plan's cut, or else the share at the cut.
    pub target: Share,
    /// Warnings of the plan.
    pub warnings: Vec<String>,
}

/// Most bytes of a manifest's settings, as of a file of settings.
const SETTINGS_BYTES: usize = 1 << 20;
const MOST_EXPORTS: usize = 100;
/// Most warnings, and most that an export does not honour.
const MOST_WARNINGS: usize = 10_000;

/// The part of a manifest that viewrank reads back; views are names.
#[derive(Debug, Deserialize)]
pub(crate) struct RecordedPlan {
    input: Input,
    pub backend: String,
    #[serde(deserialize_with = "bounded::text::<_, _, SETTINGS_BYTES>")]
    pub settings: Settings,
    #[serde(default, deserialize_with = "bounded::text::<_, _, SETTINGS_BYTES>")]
    typed: Vec<TypedSetting>,
    #[serde(default)]
    pub own_size: bool,
    /// The whole ranking, best first, but after the finished clusters.
    #[serde(deserialize_with = "bounded::list::<_, _, MOST_VIEWS>")]
    pub clusters: Vec<ClusterEntry>,
    #[serde(deserialize_with = "bounded::list::<_, _, MOST_VIEWS>")]
    pub views: Vec<ViewEntry>,
    #[serde(deserialize_with = "bounded::list::<_, _, MOST_VIEWS>")]
    pub outdated: Vec<OutdatedMap>,
    pub cut: Cut,
    #[serde(default)]
    forecast: Option<RecordedForecast>,
    /// Without commands and clusters.
    #[serde(deserialize_with = "exports")]
    pub exports: Vec<ExportRecord>,
    #[serde(deserialize_with = "bounded::list::<_, _, MOST_WARNINGS>")]
    pub warnings: Vec<String>,
    #[serde(default)]
    region: Option<RegionSummary>,
    /// Path of the manifest.
    #[serde(skip)]
    path: PathBuf,
}

/// The field that manifests of all versions share.
#[derive(Debug, Deserialize)]
struct Versioned {
    version: u32,
}

#[derive(Debug, Deserialize)]
struct RecordedForecast {
    all_maps: usize,
}

#[derive(Debug, Deserialize)]
struct Input {
    model: String,
    fingerprint: String,
}

#[derive(Debug, Deserialize)]
pub(crate) struct ClusterEntry {
    pub rank: i64,
    pub key: String,
    pub partners: Names,
    #[serde(default)]
    pub scale: MapScale,
    #[serde(default)]
    pub work: f64,
    pub gain: f64,
    pub fulfilment: f64,
    pub share: f64,
    pub finished: bool,
}

#[derive(Deserialize)]
struct RecordedExport {
    backend: String,
    #[serde(deserialize_with = "bounded::list::<_, _, MOST_WARNINGS>")]
    not_honoured: Vec<String>,
    #[serde(deserialize_with = "bounded::list::<_, _, MOST_WARNINGS>")]
    warnings: Vec<String>,
}

fn exports<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<ExportRecord>, D::Error> {
    let record = |export: RecordedExport| ExportRecord {
        backend: export.backend,
        not_honoured: export.not_honoured,
        warnings: export.warnings,
        ..ExportRecord::default()
    };
    let exports = bounded::list::<_, _, MOST_EXPORTS>(deserializer)?;
    Ok(exports.into_iter().map(record).collect())
}

/// Path of the manifest, relative to the project.
pub(crate) const FILE: &str = "viewrank/manifest.json";

/// Reads a file of the plan that viewrank wrote.
pub(crate) fn read_own(project: &Project, name: &str) -> Result<Vec<u8>, WrittenPlanError> {
    output::read_own(&project.home, name, FileKind::Plan).map_err(|error| match error {
        OutputError::Io { path, source } | OutputError::Denied { path, source } => {
            WrittenPlanError::Io { path, source }
        }
        error => WrittenPlanError::Own(error),
    })
}

/// Checks the contents of the manifest at `path`, as every reader does first: ranks, names,
/// partners, shares, settings and cut must not contradict each other. Does not check that the model
/// is still the planned one.
///
/// # Errors
/// [`WrittenPlanError::Manifest`] with the first field that does, [`WrittenPlanError::Version`].
pub fn validate(bytes: &[u8], path: &Path) -> Result<(), WrittenPlanError> {
    RecordedPlan::parse(bytes, path.into()).map(drop)
}

/// Returns the name of the backend that the project's plan is for; `None` without a plan.
pub fn planned_backend(project: &Project) -> Option<String> {
    RecordedPlan::read(project)
        .ok()
        .map(|recorded| recorded.backend)
}

/// Returns the names of the backends that the project's plan was written for, the one that it is
/// for first; none without a plan.
pub fn planned_backends(project: &Project) -> Vec<String> {
    let workspace = open_planned_workspace(project);
    let Ok(recorded) = RecordedPlan::read(workspace.as_ref().unwrap_or(project)) else {
        return Vec::new();
    };
    match recorded.settings.backends {
        named if named.is_empty() => vec![recorded.backend],
        named => named,
    }
}

/// Returns the path, relative to the project, of the model that its plan is for; `None` without a
/// plan.
pub fn planned_model(project: &Project) -> Option<String> {
    Some(RecordedPlan::read(project).ok()?.input.model)
}

/// The depth maps (or images) that a plan chooses.
pub struct PlannedMaps {
    pub clusters: usize,
    /// Number of depth maps that the project can have.
    pub all: usize,
    /// Predicted share of the chosen ones in what all give, 0 to 1.
    pub share: f64,
    /// Number of depth maps that were finished when the plan was made, and their measured share.
    pub finished: Option<(usize, f64)>,
    /// Share that the user wants; `None` if only other limits were set.
    pub target: Option<f64>,
    pub has_region: bool,
    pub backend: String,
}

/// Returns what the project's plan chooses; `None` without a plan.
pub fn planned_maps(root: &Path) -> Option<PlannedMaps> {
    let (_, recorded) = RecordedPlan::open(root).ok()?;
    let last = recorded.cut.clusters.checked_sub(1);
    let share = last.and_then(|last| Some(recorded.clusters.get(last)?.share));
    Some(PlannedMaps {
        clusters: recorded.cut.clusters,
        all: recorded.all_maps(),
        share: share.unwrap_or_default(),
        finished: recorded.measured(),
        target: recorded.settings.cut.target.map(|target| target.0),
        has_region: recorded.settings.region.is_some(),
        backend: recorded.backend,
    })
}

/// Returns the options that were typed for the project's plan; none without a plan.
pub fn planned_options(root: &Path) -> Vec<TypedSetting> {
    let recorded = RecordedPlan::open(root);
    recorded.map_or_else(|_| Vec::new(), |(_, recorded)| recorded.settings.typed)
}

/// Returns which image in how many the project's plan keeps apart for tests.
pub fn planned_test_every(root: &Path) -> Option<u32> {
    let (_, recorded) = RecordedPlan::open(root).ok()?;
    recorded.settings.test_every.filter(|every| *every > 0)
}

/// Returns what the photographs show of the region of the project's plan; `None` without a plan or
/// where the settings name another region or resolution.
pub fn planned_ground(project: &Project, settings: &Settings) -> Option<GroundSummary> {
    let recorded = RecordedPlan::read(project).ok()?;
    let (asked, planned) = (settings, &recorded.settings);
    let is_same = (asked.region.is_none() || asked.region == planned.region)
        && (asked.target.gsd.is_none() || asked.target.gsd == planned.target.gsd);
    // An older program counted less.
    let ground = recorded.region.filter(|_| is_same)?.ground;
    ground.filter(|ground| ground.needed > 0)
}

/// Returns the workspace of undistorted images whose plan counts for the project: where the project
/// has no plan of its own, or one for a program that needs undistorted images and therefore works
/// in the workspace.
pub fn planned_workspace(project: &Project) -> Option<PathBuf> {
    let dense = project.dense_workspace.clone();
    let dense = dense.or_else(|| project.undistorted_workspace());
    // A workspace would name itself: without the first condition, `RecordedPlan::open` would
    // recurse for ever.
    let dense = dense.filter(|dense| *dense != project.root && dense.join(FILE).is_file());
    dense.filter(|_| !project.home.join(FILE).exists() || needs_undistorted_images(project))
}

/// Returns whether the plan of the project itself is for a program that cannot take its images.
fn needs_undistorted_images(project: &Project) -> bool {
    let takes_distorted = |backend: String| by_name(&backend).is_ok_and(|b| b.takes_distorted);
    let own = planned_backend(project).filter(|_| !project.is_elsewhere());
    own.is_some_and(|backend| !takes_distorted(backend)) && project.has_distorted_cameras()
}

/// Opens the [`planned_workspace`] of the project, if any.
pub fn open_planned_workspace(project: &Project) -> Option<Project> {
    Project::open(&planned_workspace(project)?, None).ok()
}

impl WrittenPlan {
    /// Reads `viewrank/manifest.json` of the project.
    ///
    /// # Errors
    /// The manifest cannot be read, contradicts itself, or belongs to other model files or images.
    pub fn read(root: &Path) -> Result<Self, WrittenPlanError> {
        let (project, recorded) = RecordedPlan::open(root)?;
        let scene = project.read_scene()?;
        recorded.check_input(&project, &scene)?;
        let clusters = recorded.ranked(&scene)?;
        let cut = recorded.cut.clusters.min(clusters.len());
        let work = recorded
            .clusters
            .iter()
            .map(|cluster| cluster.work)
            .collect();
        let all_maps = recorded.all_maps();
        let (finished, settings, own_size) =
            (recorded.finished(), recorded.settings, recorded.own_size);
        let target = settings.cut.target.unwrap_or(Share(recorded.cut.share));
        let uses_images = by_name(&recorded.backend).is_ok_and(|backend| !backend.makes_maps());
        Ok(Self {
            project,
            backend: recorded.backend,
            settings,
            own_size,
            clusters,
            work,
            cut,
            all_maps,
            images: uses_images.then_some(all_maps),
            finished,
            target,
            scene,
            warnings: recorded.warnings,
        })
    }

    /// Returns these clusters of the plan, to be exported.
    pub fn selection<'a>(
        &'a self,
        clusters: &'a [RankedCluster],
        image_faults: &'a ImageFaults,
    ) -> Selection<'a> {
        Selection {
            project: &self.project,
            scene: &self.scene,
            clusters,
            image_scale: self.settings.image_scale(),
            own_size: self.own_size,
            planned_for: &self.backend,
            image_faults,
            test_every: self.settings.test_every,
        }
    }

    /// Returns the number of clusters up to another cut: the shorter of the budget and the shortest
    /// prefix that reaches the share; without either, the plan's own cut.
    pub fn cut_at(&self, budget: Option<Budget>, target: Option<Share>) -> usize {
        let all = self.clusters.len();
        let by_budget = match budget {
            // With maps of two sizes, a percentage is one of the work.
            Some(Budget::Views(share)) if self.settings.ranking.has_half() => {
                self.work.partition_point(|&work| work <= share.0)
            }
            Some(budget) => budget.clusters(self.images.unwrap_or(self.scene.views.len())),
            None => all,
        };
        let by_target = target.map_or(all, |target| {
            // Those below the target, and the one that reaches it.
            self.clusters.partition_point(|c| c.share < target.0) + 1
        });
        if budget.is_none() && target.is_none() {
            self.cut
        } else {
            all.min(by_budget).min(by_target)
        }
    }
}

impl RecordedPlan {
    /// Opens the project with the model of its plan, and reads the plan.
    /// Where the program needed undistorted images, the plan is in their workspace.
    pub fn open(root: &Path) -> Result<(Project, Self), WrittenPlanError> {
        let any_model = Project::open_or_planned(root, None)?;
        match planned_workspace(&any_model) {
            Some(workspace) => Self::open(&workspace),
            None => Self::open_own(root, any_model),
        }
    }

    /// Reads the plan in the folder itself.
    pub fn open_here(root: &Path) -> Result<(Project, Self), WrittenPlanError> {
        Self::open_own(root, Project::open_or_planned(root, None)?)
    }

    fn open_own(root: &Path, any_model: Project) -> Result<(Project, Self), WrittenPlanError> {
        let recorded = Self::read(&any_model)?;
        let planned = &recorded.input.model;
        let project = if any_model.model_path() == *planned {
            any_model
        } else {
            Project::open_or_planned(root, Some(planned))?
        };
        let project = project.with_images(recorded.settings.images.as_deref());
        Ok((project, recorded))
    }

    /// Reads `viewrank/manifest.json` of the project without checking its input.
    pub fn read(project: &Project) -> Result<Self, WrittenPlanError> {
        // Folders outside are read as the plan was made from them, and not quoted.
        Self::parse(&read_own(project, FILE)?, project.home.join(FILE))
    }

    fn parse(bytes: &[u8], path: PathBuf) -> Result<Self, WrittenPlanError> {
        let refused = |what: String| WrittenPlanError::Manifest {
            path: path.clone(),
            what: shortened(&what).into_owned(),
        };
        // First, since fields of another version need not be those of this one.
        let Versioned { version } = serde_json::from_slice(bytes)
            .map_err(|error| refused(place_and_fault(&error, bytes)))?;
        if version != VERSION {
            return Err(WrittenPlanError::Version { path, version });
        }
        let mut recorded: Self = serde_json::from_slice(bytes)
            .map_err(|error| refused(place_and_fault(&error, bytes)))?;
        check(&recorded).map_err(refused)?;
        // The file may be a stranger's, and its options are shown in commands to copy.
        recorded.typed.retain(TypedSetting::is_of_plan);
        // The manifest is in PROJECT/viewrank.
        let home = path.ancestors().nth(2).map_or_else(PathBuf::new, absolute);
        let typed = mem::take(&mut recorded.typed).into_iter();
        recorded.settings.typed = typed.map(|typed| typed.read_in(&home)).collect();
        Ok(Self { path, ..recorded })
    }

    /// Returns an error if the model or the images have changed since the plan was made.
    pub fn check_input(&self, project: &Project, scene: &Scene) -> Result<(), WrittenPlanError> {
        let same = fingerprint(project, scene, &self.settings)? == self.input.fingerprint;
        if same {
            Ok(())
        } else {
            Err(WrittenPlanError::OtherInput(self.path.clone()))
        }
    }
}

impl RecordedPlan {
    /// Returns the whole ranking, best first, with indices of views.
    pub fn ranked(&self, scene: &Scene) -> Result<Vec<RankedCluster>, WrittenPlanError> {
        let view = |name: &str| {
            scene
                .find(name)
                .ok_or_else(|| WrittenPlanError::OtherInput(self.path.clone()))
        };
        let cluster = |c: &ClusterEntry| {
            let partners: Result<Vec<ViewIndex>, _> = c.partners.iter().map(view).collect();
            Ok(RankedCluster {
                key: view(&c.key)?,
                partners: partners?,
                scale: c.scale,
                share: c.share,
            })
        };
        self.clusters.iter().map(cluster).collect()
    }

    /// Returns the number of depth maps, or images, that the project can have.
    fn all_maps(&self) -> usize {
        let forecast = self.forecast.as_ref();
        forecast.map_or(self.clusters.len(), |forecast| forecast.all_maps)
    }

    /// Returns the number of finished clusters; they are first in the ranking.
    pub fn finished(&self) -> usize {
        self.clusters
            .iter()
            .take_while(|cluster| cluster.finished)
            .count()
    }

    /// Number and share of the finished clusters, as measured for the plan.
    fn measured(&self) -> Option<(usize, f64)> {
        let last = self.finished().checked_sub(1)?;
        Some((last + 1, self.clusters[last].share))
    }

    /// Returns an error if the ranking is not the plan's. With finished depth maps, their partners
    /// are those of an earlier plan and they change the order, so only the partners of the other
    /// clusters are compared.
    pub fn check_ranking(&self, plan: &Plan) -> Result<(), WrittenPlanError> {
        let ranked = self.ranked(&plan.stages.scene)?;
        let same = match self.finished() {
            0 => plan
                .ranked()
                .map(|c| (c.key, c.partners, c.scale))
                .eq(ranked.into_iter().map(|c| (c.key, c.partners, c.scale))),
            finished => {
                let place = |key| {
                    plan.stages
                        .clusters
                        .binary_search_by_key(&key, |cluster| cluster.key)
                        .ok()
                };
                let partners = |key| place(key).map(|c| &plan.stages.clusters[c].partners);
                ranked[finished..]
                    .iter()
                    .all(|c| partners(c.key) == Some(&c.partners))
            }
        };
        if same {
            Ok(())
        } else {
            Err(WrittenPlanError::OtherPlan(self.path.clone()))
        }
    }
}

/// Errors of reading a written plan.
#[derive(Debug, thiserror::Error)]
pub enum WrittenPlanError {
    #[error("cannot read the plan {}: {source}", path.display())]
    Io { path: PathBuf, source: io::Error },
    #[error("cannot use the plan {}: {what}", path.display())]
    Manifest { path: PathBuf, what: String },
    #[error("cannot use the plan {}: written by another version of viewrank (its format is {version}, this program reads {VERSION})", path.display())]
    Version { path: PathBuf, version: u32 },
    #[error("cannot use the plan {}: the model, the images or a file that its settings name has changed since it was made", .0.display())]
    OtherInput(PathBuf),
    #[error("cannot use the plan {}: another version of viewrank made it, and this version ranks differently", .0.display())]
    OtherPlan(PathBuf),
    #[error("cannot read the plan: {0}")]
    Own(OutputError),
    #[error(transparent)]
    Input(#[from] FingerprintError),
    #[error(transparent)]
    Project(#[from] ProjectError),
}

/// The folder of the plan, where `path` is looked for in the folder `viewrank` of that.
fn folder_of_plan(path: &Path) -> Option<&Path> {
    let inner = path.parent()?.parent()?;
    let above = match inner.parent()? {
        here if here.as_os_str().is_empty() => Path::new("."),
        above => above,
    };
    (above.join(FILE).is_file() && inner.join("manifest.json").is_file()).then_some(above)
}

/// The command that writes the manifest at `path`, for the same program.
fn plan_command(path: &Path) -> String {
    let root = path
        .parent()
        .and_then(Path::parent)
        .unwrap_or(Path::new("."));
    let recorded = RecordedPlan::open(root).ok();
    let known = recorded.and_then(|(_, recorded)| by_name(&recorded.backend).ok());
    let backend = known.map_or_else(String::new, |known| format!(" --backend {}", known.name));
    let options = planned_options(root);
    let options = options.iter().map(|option| format!(" {option}"));
    let options: String = options.collect();
    format!("viewrank plan {}{backend}{options}", command_path(root))
}

impl Hint for WrittenPlanError {
    fn hint(&self) -> Option<Advice> {
        match self {
            Self::Io { path, source } => Some(match source.kind() {
                io::ErrorKind::PermissionDenied => {
                    Advice::text("make it readable for yourself, or plan elsewhere: ")
                        .set_to("out", "DIR")
                }
                io::ErrorKind::FileTooLarge => {
                    format!("plan for fewer programs at a time: {}", plan_command(path)).into()
                }
                _ => match folder_of_plan(path) {
                    Some(above) => format!("name the folder of the plan: {}", command_path(above)),
                    None => format!("make the plan first: {}", plan_command(path)),
                }
                .into(),
            }),
            Self::Manifest { path, .. }
            | Self::Version { path, .. }
            | Self::OtherInput(path)
            | Self::OtherPlan(path) => Some(format!("plan again: {}", plan_command(path)).into()),
            Self::Own(error) => error.hint(),
            Self::Input(error) => error.hint(),
            Self::Project(error) => error.hint(),
        }
    }

    fn path(&self) -> Option<&Path> {
        match self {
            Self::Io { path, .. }
            | Self::Manifest { path, .. }
            | Self::Version { path, .. }
            | Self::OtherInput(path)
            | Self::OtherPlan(path) => Some(path),
            Self::Own(error) => error.path(),
            Self::Input(error) => error.path(),
            Self::Project(error) => error.path(),
        }
    }
}
