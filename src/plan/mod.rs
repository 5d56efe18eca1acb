//! The one function that runs the stages of the method, and what comes out of it.
//!
//! [`plan`] reads the model, builds the surface, sees which view sees what, and chooses and ranks view clusters; then it cuts the
//! ranking (`cut.rs`), forecasts its cost (`forecast.rs`), says why the rest is not taken (`reasons.rs`) and what the user should
//! know (`warnings.rs`). It writes nothing: [`files`] turns a plan into what is to be written.

mod again;
mod cut;
mod files;
mod finished;
mod forecast;
mod memory;
mod nothing;
mod outdated;
mod reasons;
mod timings;
mod warnings;

pub use again::{AgainError, again, as_written};
pub use cut::Cut;
pub use files::{FilesError, PlanFiles, files};
pub use finished::{Finished, Outdated, PlannedView, PlannedViews};
pub use forecast::Forecast;
pub use memory::Memory;
pub use nothing::Nothing;
pub use reasons::{Likest, ViewStatus};
pub use timings::Timings;
pub use warnings::unlikely_gsd;

use crate::{
    backends::{self, Backend, BackendError, RankedCluster},
    column::{DiskError, TableError},
    confidence::{self, Confidence, Pictures, Predictor, Proxy, Source, Trained, TrainedError, Unary},
    config::{Settings, Share},
    error::Hint,
    fulfilment::{FulfilmentTable, GSD_MARGIN, Model, Rule, Target},
    partners::{self, Candidates, Reason, ViewCluster},
    progress::{Cancelled, Stage, Watcher},
    project::{Project, ProjectError},
    ranking::{self, Ranking},
    scene::{Scene, Units, ViewPoints},
    surface::{self, MeshFile, Surface, SurfaceError, SurfaceStats},
    visibility::{self, Visibility},
};

/// Everything that a plan consists of: the value of each stage.
#[derive(Clone, Debug)]
pub struct Plan {
    /// All settings in force; what was chosen from the data or by the backend is filled in.
    pub settings: Settings,
    /// Name of the backend that the plan is made for.
    pub backend: &'static str,
    pub scene: Scene,
    pub surface: Surface,
    pub surface_stats: SurfaceStats,
    pub visibility: Visibility,
    /// Unary confidence of each row of `visibility`.
    pub unary: Unary,
    /// What was seen in the pictures.
    pub pictures: confidence::Seen,
    /// What predicts success.
    pub confidence: Confidence,
    pub trained: Option<Trained>,
    /// g_d and a_d of each triangle (method 3.6).
    pub target: Target,
    pub candidates: Candidates,
    /// One per view that can be a key view, in the order of views.
    pub clusters: Vec<ViewCluster>,
    pub fulfilment: FulfilmentTable,
    pub ranking: Ranking,
    /// What is done already, by [`replan`](crate::replan); nothing in a fresh plan.
    pub finished: Finished,
    pub cut: Cut,
    pub forecast: Forecast,
    /// Status and reason of each view.
    pub views: Vec<(ViewStatus, Option<Reason>)>,
    /// Reason of each triangle that no cluster fulfils to a tenth.
    pub triangle_reasons: Vec<Option<Reason>>,
    pub warnings: Vec<String>,
    /// What was forecast before each stage.
    pub memory: Memory,
    /// Not part of what was planned: differs from run to run.
    pub timings: Timings,
}

impl Plan {
    /// The clusters to compute, best first.
    pub fn chosen(&self) -> impl ExactSizeIterator<Item = &ViewCluster> {
        self.ranking.order[..self.cut.clusters].iter().map(|&c| &self.clusters[c as usize])
    }

    /// Memory that its tables take, about.
    pub fn bytes(&self) -> u64 {
        let unary = self.unary.values.bytes() + self.unary.partner_odds.bytes();
        let fulfilment = self.fulfilment.triangles.bytes() + self.fulfilment.values.bytes();
        let tables = self.visibility.triangles.bytes() + unary + fulfilment;
        let surface = 24 * self.surface.vertices.len() + 24 * self.surface.triangles.len();
        let scene = 64 * self.scene.points.len() + 24 * self.scene.observations();
        (tables + surface + scene) as u64
    }

    /// What f depends on; with it any view clusters can be looked at.
    pub fn model(&self) -> Model<'_> {
        Model {
            scene: &self.scene,
            surface: &self.surface,
            visibility: &self.visibility,
            target: &self.target,
            unary: &self.unary,
            rule: rule(&self.settings, self.confidence),
        }
    }

    /// Ranks the clusters by their fulfilment, behind those that are finished; and what follows from the ranking.
    pub(crate) fn rank(&mut self, finished: &[u32], watcher: &dyn Watcher) -> Result<(), PlanError> {
        let weights = ranking::weights(&self.surface, self.settings.ranking.weight);
        let support = self.settings.ranking.support.unwrap_or(1);
        self.finished.clusters = finished.len();
        self.ranking = self
            .timings
            .time(Stage::Ranking, || ranking::rank_after(finished, &self.fulfilment, &weights, support, watcher))?;
        let cut = cut::cut(&self.settings.cut, &self.cost(&self.model()))?;
        self.cut_at(cut)?;
        watcher.check()?;
        Ok(())
    }

    /// Cuts the ranking there; and what follows from both.
    fn cut_at(&mut self, cut: Cut) -> Result<(), PlanError> {
        let model = self.model();
        let forecast = forecast::forecast(&self.cost(&model), cut.clusters);
        let why = reasons::Why {
            model: &model,
            candidates: &self.candidates,
            clusters: &self.clusters,
            fulfilment: &self.fulfilment,
        };
        let views = why.views(&self.ranking.order[..cut.clusters], &self.settings.partners)?;
        let triangle_reasons = why.triangles();
        (self.cut, self.forecast, self.views, self.triangle_reasons) = (cut, forecast, views, triangle_reasons);
        self.warnings = warnings::warnings(self);
        Ok(())
    }

    fn cost<'a>(&'a self, model: &'a Model) -> forecast::Cost<'a> {
        let finished = self.finished.clusters;
        let settings = &self.settings.forecast;
        forecast::Cost { model, clusters: &self.clusters, ranking: &self.ranking, finished, settings }
    }

    /// Pixels that the depth map of each cluster of the ranking will measure, before fusion.
    pub fn points_by_rank(&self) -> Vec<f64> {
        forecast::points(&self.cost(&self.model()), self.ranking.order.len())
    }

    /// Of each cluster those ranked before it that do more of what it could by itself than any before them.
    pub fn likest(&self) -> Result<Vec<Vec<Likest>>, DiskError> {
        reasons::likest(&self.fulfilment, &self.ranking.order, self.surface.triangles.len())
    }

    /// The whole ranking, best first.
    pub fn ranked(&self) -> impl ExactSizeIterator<Item = RankedCluster> {
        self.ranking.order.iter().enumerate().map(|(i, &c)| {
            let ViewCluster { key, partners } = self.clusters[c as usize].clone();
            RankedCluster { key, partners, share: self.ranking.share(i + 1) }
        })
    }
}

/// Plans which views of the project become key views, with which partners, in which order.
pub fn plan(project: &Project, settings: &Settings, watcher: &dyn Watcher) -> Result<Plan, PlanError> {
    let mut timings = Timings::start();
    planned_for(project, settings)?;
    if settings.cut.time.is_some() && !settings.forecast.knows_times() {
        return Err(PlanError::NoTimes);
    }
    watcher.progress(Stage::Read, 0, 1);
    let scene = timings.time(Stage::Read, || project.read_scene())?;
    watcher.progress(Stage::Read, 1, 1);
    watcher.check()?;
    plan_scene(project, scene, settings, timings, watcher)
}

/// As [`plan`], for the project's scene that was read before, in the time that `timings` have.
pub fn plan_scene(
    project: &Project,
    scene: Scene,
    settings: &Settings,
    mut timings: Timings,
    watcher: &dyn Watcher,
) -> Result<Plan, PlanError> {
    let backend = planned_for(project, settings)?;
    let source = Source::new(&settings.confidence.source, project, backend.name());
    let trained = source.trained(&project.root)?;
    let mut settings = in_force(project, settings, &scene, backend, &source)?;
    let mut memory = Memory::before_surface(&scene, &mut settings)?;
    let points = scene.view_points();
    // Parts of the surface are made by one thread: the others find candidates meanwhile.
    let (seen, candidates) = rayon::join(
        || look(&scene, &points, &settings, watcher, &mut timings, &mut memory),
        || partners::candidates(&scene, &points, &settings.partners, &backend.planning().gate, watcher),
    );
    let (seen, candidates) = (seen?, candidates?);
    memory.before_partners(&scene, &seen.surface, &seen.visibility)?;
    let target = target(&scene, &seen, &settings);
    seen.visibility.triangles.release();
    let confidence = Confidence::new(&source, trained.as_ref(), &settings.confidence, &backend.planning().confidence);
    confidence.fill_in(&mut settings.confidence);
    let rule = rule(&settings, confidence);
    let model = Model {
        scene: &scene,
        surface: &seen.surface,
        visibility: &seen.visibility,
        target: &target,
        unary: &Unary::certain(),
        rule,
    };
    let (pictures, unary) = timings.time(Stage::Confidence, || {
        let pictures = pictures(project, &scene, &source, trained.as_ref(), watcher)?;
        let unary = match (&trained, confidence) {
            (Some(trained), Confidence::Trained(_)) => trained.unary(&model, &points, &pictures.maps, watcher)?,
            (_, Confidence::Pair(_)) => confidence::nearby(&scene, &points, &seen.surface, &seen.visibility, watcher)?
                .times(
                    Unary::new(&scene, &seen.surface, &seen.visibility, &pictures.maps, watcher)?,
                    &seen.visibility,
                )?,
            _ => Unary::new(&scene, &seen.surface, &seen.visibility, &pictures.maps, watcher)?,
        };
        Ok::<_, PlanError>((pictures, unary))
    })?;
    let model = Model { unary: &unary, ..model };
    let (clusters, fulfilment) = timings
        .time(Stage::Partners, || partners::choose(&model, &candidates, &settings.partners, settings.seed, watcher))?;
    watcher.check()?;
    let mut plan = Plan {
        backend: backend.name(),
        surface: seen.surface,
        surface_stats: seen.stats,
        visibility: seen.visibility,
        memory,
        settings,
        scene,
        unary,
        pictures,
        confidence,
        trained,
        target,
        candidates,
        clusters,
        fulfilment,
        ranking: Ranking::default(),
        finished: Finished::default(),
        cut: Cut::default(),
        forecast: Forecast::default(),
        views: Vec::new(),
        triangle_reasons: Vec::new(),
        warnings: Vec::new(),
        timings,
    };
    plan.rank(&[], watcher)?;
    plan.timings.end();
    Ok(plan)
}

/// The first of the backends that files are wanted for, else the one that the project is set up for.
fn planned_for(project: &Project, settings: &Settings) -> Result<&'static dyn Backend, BackendError> {
    match settings.backends.first() {
        Some(name) => backends::by_name(name),
        None => Ok(backends::for_project(project)),
    }
}

/// The settings with what is left to the data and the backend filled in.
fn in_force(
    project: &Project,
    settings: &Settings,
    scene: &Scene,
    backend: &dyn Backend,
    source: &Source,
) -> Result<Settings, PlanError> {
    if scene.views.is_empty() {
        return Err(PlanError::NoViews(project.model.path.clone()));
    }
    let mut all = settings.clone();
    all.units.get_or_insert(Units::Relative);
    let gsd = match all.target.gsd {
        Some(gsd) => gsd,
        None => GSD_MARGIN * scene.median_gsd().ok_or(PlanError::NoScale)? / all.image_scale,
    };
    all.target.accuracy.get_or_insert(gsd);
    all.target.mode = all.target.mode.in_force(settings.target.gsd.or(settings.target.accuracy).is_some());
    all.target.gsd = Some(gsd);
    all.partners.candidates = all.partners.candidates.max(all.partners.k);
    let numbers = backend.planning();
    all.ranking.support.get_or_insert(numbers.support);
    all.confidence.source = source.to_string();
    if all.partners.k == 1 {
        all.coverage.min_cameras = 2;
    }
    let cut = &mut all.cut;
    if cut.budget.is_none() && cut.time.is_none() && cut.points.is_none() {
        cut.target.get_or_insert(Share(cut::DEFAULT_TARGET));
    }
    Ok(all)
}

/// What the pictures say; masks count wherever confidence does.
fn pictures(
    project: &Project,
    scene: &Scene,
    source: &Source,
    trained: Option<&Trained>,
    watcher: &dyn Watcher,
) -> Result<confidence::Seen, PlanError> {
    let pictures = Pictures::new(project);
    let predictor: Option<&dyn Predictor> = match (source, trained) {
        (Source::Proxy, _) => Some(&Proxy),
        (_, Some(trained)) => trained.picture.as_ref().map(|picture| picture as &dyn Predictor),
        _ => None,
    };
    let unasked = *source == Source::None || predictor.is_none() && !pictures.have_masks();
    if unasked {
        return Ok(confidence::Seen { maps: vec![None; scene.views.len()], ..Default::default() });
    }
    Ok(pictures.look(scene, predictor, watcher)?)
}

/// A surface of triangles that at least one view sees.
struct Seen {
    surface: Surface,
    stats: SurfaceStats,
    visibility: Visibility,
    gsd: f64,
}

fn look(
    scene: &Scene,
    points: &ViewPoints,
    settings: &Settings,
    watcher: &dyn Watcher,
    timings: &mut Timings,
    memory: &mut Memory,
) -> Result<Seen, PlanError> {
    let gsd = settings.target.gsd.ok_or(PlanError::NoScale)?;
    let mesh = settings.surface.mesh.clone().map(|path| MeshFile { path, as_is: settings.surface.mesh_as_is });
    let most = memory.most_triangles();
    let (surface, stats) =
        timings.time(Stage::Surface, || surface::build(scene, gsd, &settings.surface, mesh.as_ref(), most, watcher))?;
    let keep = memory.before_visibility(scene, &surface, &settings.visibility)?;
    let edge_length = settings.surface.edge_factor * gsd;
    let visibility = timings.time(Stage::Visibility, || {
        visibility::estimate(scene, points, &surface, &settings.visibility, edge_length, keep, watcher)
    })?;
    let seen = visibility.seen(surface.triangles.len());
    if !seen.contains(&true) {
        return Err(SurfaceError::Empty.into());
    }
    Ok(Seen { surface: surface.keep(&seen), stats, visibility: visibility.keep(&seen)?, gsd })
}

fn target(scene: &Scene, seen: &Seen, settings: &Settings) -> Target {
    Target::new(scene, &seen.surface, &seen.visibility, &settings.target, seen.gsd, settings.image_scale)
}

fn rule(settings: &Settings, confidence: Confidence) -> Rule {
    Rule {
        alpha: settings.fulfilment.alpha,
        sigma_px: settings.fulfilment.sigma_px,
        min_cameras: settings.coverage.min_cameras,
        image_scale: settings.image_scale,
        confidence,
    }
}

/// Why there is no plan.
#[derive(Debug, thiserror::Error)]
pub enum PlanError {
    #[error(transparent)]
    Project(#[from] ProjectError),
    #[error("{}: the model has no registered image", _0.display())]
    NoViews(std::path::PathBuf),
    #[error("no view observes a sparse point in front of it, so that no ground sampling distance is known")]
    NoScale,
    #[error(transparent)]
    Surface(#[from] SurfaceError),
    #[error(transparent)]
    Backend(#[from] BackendError),
    #[error(transparent)]
    Trained(#[from] TrainedError),
    #[error("how long matching takes is not known, so that the time limit cannot be kept to")]
    NoTimes,
    #[error(
        "the {stage} would need about {} of memory, but max_memory is {}",
        memory::readable(*need),
        memory::readable(*limit)
    )]
    Memory { stage: &'static str, need: u64, limit: u64 },
    #[error(transparent)]
    Disk(#[from] DiskError),
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
}

impl From<TableError> for PlanError {
    fn from(error: TableError) -> Self {
        match error {
            TableError::Cancelled(error) => Self::Cancelled(error),
            TableError::Disk(error) => Self::Disk(error),
        }
    }
}

impl Hint for PlanError {
    fn hint(&self) -> Option<String> {
        Some(match self {
            Self::Project(error) => return error.hint(),
            Self::NoViews(_) => "run structure from motion first, or take another model with --model".into(),
            Self::NoScale => "say what is wanted with --gsd, or give a model with points".into(),
            Self::Surface(error) => return error.hint(),
            Self::Backend(error) => return error.hint(),
            Self::Trained(error) => return error.hint(),
            Self::NoTimes => "time one depth map and set forecast.seconds_per_map or .seconds_per_pair".into(),
            Self::Memory { stage: memory::SURFACE, need, .. } => format!(
                "give --max-memory {} or more: what the tables need besides is known once the surface is built",
                memory::readable(need + need / 20)
            ),
            Self::Memory { need, .. } => format!(
                "give --max-memory {}, or have fewer triangles with a coarser --gsd or a larger surface.edge_factor",
                memory::readable(need + need / 20)
            ),
            Self::Disk(error) => return error.hint(),
            Self::Cancelled(_) => return None,
        })
    }

    fn is_usage(&self) -> bool {
        match self {
            Self::NoTimes => true,
            Self::Project(error) => error.is_usage(),
            Self::Backend(error) => error.is_usage(),
            Self::Trained(error) => error.is_usage(),
            _ => false,
        }
    }
}
