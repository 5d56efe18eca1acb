//! `viewrank run`: plans, matches and fuses a project on this machine, best first, until the target
//! is reached.

mod result;
mod task;
mod work;

use std::{
    path::{Path, PathBuf},
    sync::atomic::{AtomicBool, Ordering},
    thread,
};

use clap::Args;

pub use self::result::target_in_percent;
use self::work::Work;
use super::{
    Exit, Failure, Format, arguments, config, next, note, plan::kept_backends, print, ready,
    undistort::undistorted,
};
use crate::{
    apps::{dispatch::Dispatch, planning, undistort::UndistortOptions},
    backends::{self, Backend, Choice, Product},
    base::{platform, shell::command_path},
    config::{Budget, CommandLineSettings, Settings, TypedSetting},
    daemon::{PlanWhen, foreground::Foreground},
    io::project::Project,
    show::manifest::{PlannedMaps, planned_maps, planned_options},
};

/// Options of a whole run, which plans.
const WHOLE_RUN: [&str; 8] = [
    "target",
    "k",
    "scales",
    "region",
    "gsd",
    "images",
    "no_report",
    "format",
];

/// Plan a project, compute its depth maps best first until the target is reached, and fuse them.
///
/// Undistorts the images if the backend needs that, and matches with the backend that the project
/// is planned or set up for, else with OpenMVS (DensifyPointCloud) or a COLMAP with CUDA if on the
/// PATH, else with integrations/sgm (Python with numpy and opencv). Each depth map is measured;
/// PROJECT/viewrank/report.html shows the progress. From 1 % of the maps on, the cloud so far is
/// fused from time to time. Ctrl-C stops and fuses what is there, a second one ends at once; the
/// same command resumes.
#[derive(Args)]
pub struct Arguments {
    /// Folder of the project, or its model
    #[arg(value_parser = super::arguments::project())]
    project: PathBuf,

    /// Backend to match with [default: as planned, else as the project is set up, else what is
    /// installed]
    #[arg(long, value_name = "NAME")]
    backend: Option<String>,
    /// Stop at P % of what all view clusters together reach [default: 90%, or the settings']
    #[arg(long, value_name = "P%")]
    target: Option<String>,
    /// Compute at most N depth maps, or those of P % of the registered views (with --scales, of the
    /// work of all)
    #[arg(long, value_name = "N|P%")]
    budget: Option<Budget>,
    /// Matching partners per key view [default: 5]
    #[arg(short, value_name = "N")]
    k: Option<String>,
    /// Sizes that a key view may be matched at, as in viewrank plan
    #[arg(long, value_name = "S,...", value_delimiter = ',', value_parser = super::arguments::scale)]
    scales: Option<Vec<f64>>,
    /// Part of the scene to plan for, as in viewrank plan
    #[arg(
        long,
        value_name = "FILE|X0,Y0,Z0,X1,Y1,Z1|auto",
        allow_hyphen_values = true
    )]
    region: Option<String>,
    /// Wanted ground sampling distance, as in viewrank plan
    #[arg(long, value_name = "L")]
    gsd: Option<String>,
    /// Folder to which the image names of the model are relative [default: where they are found]
    #[arg(long, value_name = "DIR")]
    images: Option<PathBuf>,
    /// The backend's program [default: $DENSIFY, $COLMAP, $DMRECON, $ALICEVISION or $SGM, else from
    /// the PATH]
    #[arg(long, value_name = "FILE")]
    program: Option<PathBuf>,
    /// Threads of the backend [default: all]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    threads: Option<u16>,
    /// Compute the depth map of the N-th view cluster of the plan alone, and end; for queues
    #[arg(long, value_name = "N", group = "task", conflicts_with_all = WHOLE_RUN, value_parser = clap::value_parser!(u32).range(1..))]
    rank: Option<u32>,
    /// Fuse the depth maps of the plan that are there, and end; for queues
    #[arg(long, group = "task", conflicts_with_all = WHOLE_RUN)]
    fuse: bool,
    /// No report page
    #[arg(long)]
    no_report: bool,
    /// No progress and no results; warnings and errors only
    #[arg(long, short)]
    quiet: bool,
    /// Format of the results on stdout
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let stop = platform::stop_flag()
        .map_err(|error| Failure::new(Exit::Failed, error.to_string(), None))?;
    if let Some(product) = arguments.product() {
        return task::run(arguments, product, &stop);
    }
    let project = open(arguments)?;
    let typed = arguments
        .typed(None, true)
        .following(options_of_maps(&project.home));
    let settings = config::load(Some(&project), typed)?.settings;
    let project = project.with_images(settings.images.as_deref());
    let (backend, choice) = planned_or_chosen(&project, &settings)?;
    let say = |line: String| {
        if arguments.is_silent() {
            Ok(())
        } else {
            print([line])
        }
    };
    refuse_images(arguments, &project, backend)?;
    say(format!(
        "Backend: {} ({}).",
        backend.name,
        choice.describe()
    ))?;
    let own = project.root.clone();
    let root = matched_root(arguments, project, backend, &stop)?;
    let typed = typed_for(arguments, &root, &own, backend)?;
    let foreground = Foreground::new(&root, typed, &stop);
    let mut work = Work::new(arguments, backend, &foreground, &stop, PlanWhen::Outdated)?;
    say(work.plan_in_words())?;
    let mut ended = work.compute()?;
    // Where the maps gave less than the plan had promised, a plan around them may have more.
    while work.fell_short(ended) {
        let planned = work.length();
        work = work.replanned()?;
        // Without more maps than before, the next round would fall short again.
        if work.length() <= planned {
            break;
        }
        say(work.plan_in_words())?;
        ended = work.compute()?;
    }
    work.end(ended)
}

/// Returns the folder of the project that is matched: its own, or a workspace of undistorted
/// images.
fn matched_root(
    arguments: &Arguments,
    project: Project,
    backend: &'static Backend,
    stop: &AtomicBool,
) -> Result<PathBuf, Failure> {
    let scene = project.read_scene()?;
    let is_distorted = scene
        .view_indices()
        .any(|view| !scene.camera_of(view).is_pinhole());
    let is_to_undistort = is_distorted && !backend.takes_distorted;
    let workspace = if is_to_undistort {
        foreign_workspace(&project, backend)?
    } else {
        None
    };
    // The images that are matched must be there, those that they were made from need not.
    let (matched, scene) = match &workspace {
        Some(workspace) => (workspace, workspace.read_scene()?),
        None => (&project, scene),
    };
    ready::check(backend, matched, scene, arguments.program.as_deref()).map_err(|failure| {
        // Ctrl-C also ends the programs that are asked what they can do.
        if stop.load(Ordering::Relaxed) {
            Failure::stopped("before planning", arguments.go_on())
        } else {
            failure
        }
    })?;
    Dispatch::refuse_if_at_work(&project)?;
    match workspace {
        Some(workspace) => Ok(workspace.root),
        None if is_to_undistort => undistorted_project(arguments, project, backend),
        None => Ok(project.root),
    }
}

/// Returns what was typed now, and of the last plan what still holds in this folder; `own` is the
/// project's.
fn typed_for(
    arguments: &Arguments,
    root: &Path,
    own: &Path,
    backend: &Backend,
) -> Result<CommandLineSettings, Failure> {
    let is_own = root == own;
    let mut planned = options_of_maps(root);
    // The first run in a new workspace goes on as the project itself was planned.
    if planned.is_empty() {
        planned = options_of_maps(own);
    }
    planned.retain(|option| is_own || option.key != "images");
    let typed = arguments.typed(Some(backend.name), is_own);
    let typed = typed.following(planned);
    let configuration = config::load(Some(&Project::open(root, None)?), typed.clone())?;
    let followed: Vec<&TypedSetting> = configuration.followed().collect();
    config::refuse_outside(&followed, own)?;
    if !arguments.is_silent() {
        note_followed(root, &followed);
    }
    Ok(typed)
}

/// Opens the project, which must not be the folder of a plan made with `--out`: it is planned and
/// computed in its own folder.
fn open(arguments: &Arguments) -> Result<Project, Failure> {
    let project = Project::open_or_planned(&arguments.project, None)?;
    if !project.is_elsewhere() {
        return Ok(project);
    }
    let (plan, root) = (
        command_path(&arguments.project),
        command_path(&project.root),
    );
    Err(Failure::new(
        Exit::Usage,
        format!("{plan} is a plan of {root}, and run plans and computes in the project itself"),
        format!(
            "viewrank run {root}; for the depth maps of this plan alone: viewrank dispatch {plan}"
        ),
    ))
}

/// Returns the options that were typed for the project's plan of depth maps; none without such a
/// plan.
fn options_of_maps(root: &Path) -> Vec<TypedSetting> {
    let makes_maps = |plan: PlannedMaps| {
        backends::by_name(&plan.backend).is_ok_and(|backend| backend.makes_maps())
    };
    if planned_maps(root).is_some_and(makes_maps) {
        planned_options(root)
    } else {
        Vec::new()
    }
}

/// Says with which options of the last plan this one goes on.
fn note_followed(root: &Path, followed: &[&TypedSetting]) {
    let followed: Vec<String> = followed.iter().map(ToString::to_string).collect();
    if !followed.is_empty() {
        note(&format!(
            "as typed for the last plan: {} (viewrank plan {} starts afresh)",
            followed.join(" "),
            command_path(root)
        ));
    }
}

/// Returns the backend of the project's plan, if none is named: another could not use its maps.
/// Without a plan for depth maps, the one that is chosen for a plan.
fn planned_or_chosen(
    project: &Project,
    settings: &Settings,
) -> Result<(&'static Backend, Choice), Failure> {
    let kept = kept_backends(project, settings)?;
    match kept.as_deref() {
        Some([planned, ..]) if planned.makes_maps() => Ok((planned, Choice::Planned)),
        _ => Ok(backends::chosen(project, settings)?),
    }
}

/// Fails for a program that uses the images themselves, and where the project's plan is for one,
/// unless a backend is named: another plan would take its place.
fn refuse_images(
    arguments: &Arguments,
    project: &Project,
    backend: &Backend,
) -> Result<(), Failure> {
    if !backend.makes_maps() {
        let (name, project) = (backend.name, command_path(&arguments.project));
        return Err(Failure::new(
            Exit::Usage,
            format!("run computes depth maps, and {name} takes the images themselves"),
            Some(format!(
                "viewrank plan {project} --backend {name} chooses them"
            )),
        ));
    }
    let planned = planned_maps(&project.home).filter(|_| arguments.backend.is_none());
    let is_for_images = |plan: &PlannedMaps| {
        backends::by_name(&plan.backend).is_ok_and(|backend| !backend.makes_maps())
    };
    match planned.filter(is_for_images) {
        Some(plan) => Err(Failure::new(
            Exit::Usage,
            format!(
                "the plan of this project chooses images for {}, which run does not start",
                plan.backend
            ),
            Some("name a backend for depth maps (--backend), whose plan takes its place".into()),
        )),
        None => Ok(()),
    }
}

/// Finds the workspace of undistorted images that another program has made. Viewrank's own may be
/// of earlier images.
fn foreign_workspace(project: &Project, backend: &Backend) -> Result<Option<Project>, Failure> {
    if project.has_undistorted_workspace() {
        return Ok(None);
    }
    let workspace = planning::undistorted_workspace(project, backend)?;
    if let Some(workspace) = &workspace {
        note_workspace(backend, &workspace.root);
        let others = project.other_workspaces();
        others.iter().for_each(|said| note(said));
        Dispatch::refuse_if_at_work(workspace)?;
    }
    Ok(workspace)
}

fn note_workspace(backend: &Backend, workspace: &Path) {
    note(&format!(
        "{} needs undistorted images: {}",
        backend.name,
        workspace.display()
    ));
}

/// Undistorts the images, which writes a COLMAP model; returns the folder of their project.
fn undistorted_project(
    arguments: &Arguments,
    project: Project,
    backend: &Backend,
) -> Result<PathBuf, Failure> {
    let dense = project.place_of_undistorted();
    // A run in that workspace may be matching the images that would be replaced.
    if let Ok(earlier) = Project::open(&dense, None) {
        Dispatch::refuse_if_at_work(&earlier)?;
    }
    note_workspace(backend, &dense);
    let options = UndistortOptions::default();
    undistorted(&project, &options, &dense, arguments.is_silent())?;
    Ok(dense)
}

impl Arguments {
    /// Returns the result of the single task to run; `None` for a whole run.
    fn product(&self) -> Option<Product> {
        let map = self.rank.map(|rank| Product::Map(rank as usize));
        map.or(self.fuse.then_some(Product::Cloud))
    }

    /// Returns the number of threads for the backend.
    fn threads(&self) -> usize {
        let cores = || thread::available_parallelism().map_or(1, usize::from);
        self.threads.map_or_else(cores, usize::from)
    }

    /// Returns the command that continues with the same choices, up to that target.
    fn again(&self, target: Option<&str>) -> String {
        let path = |path: &PathBuf| path.display().to_string();
        let options = [
            ("--backend", self.backend.clone()),
            ("--target", target.map(str::to_owned)),
            ("--budget", self.budget.map(|budget| budget.to_string())),
            ("-k", self.k.clone()),
            ("--scales", next::scales(self.scales.as_deref())),
            ("--region", self.region.clone()),
            ("--gsd", self.gsd.clone()),
            ("--images", self.images.as_ref().map(path)),
            ("--program", self.program.as_ref().map(path)),
            ("--threads", self.threads.map(|threads| threads.to_string())),
        ];
        next::with_options(
            format!("viewrank run {}", command_path(&self.project)),
            options,
        )
    }

    /// Says how to continue.
    fn go_on(&self) -> String {
        format!("to go on: {}", self.again(self.target.as_deref()))
    }

    fn is_silent(&self) -> bool {
        self.quiet || self.format == Format::Json
    }

    /// Command-line options as settings; `backend`: the chosen one. An undistorted workspace has
    /// its images beside its model, so that `--images` is not for it.
    fn typed(&self, backend: Option<&str>, with_images: bool) -> CommandLineSettings {
        let mut typed = CommandLineSettings::default();
        let backend = backend.map(str::to_owned).or(self.backend.clone());
        typed.set("--backend", "backends", backend.map(|name| vec![name]));
        typed.set("--target", "cut.target", self.target.clone());
        let budget = self.budget.map(|budget| budget.to_string());
        typed.set("--budget", "cut.budget", budget);
        let k = self.k.as_deref();
        typed.set("-k", "partners.k", k.map(arguments::number));
        typed.set("--scales", "ranking.scales", self.scales.clone());
        let region = self.region.as_deref();
        typed.set("--region", "region", region.map(arguments::region));
        typed.set("--gsd", "target.gsd", self.gsd.clone());
        let images = self.images.as_deref().filter(|_| with_images);
        typed.set("--images", "images", images.map(arguments::absolute));
        typed
    }
}
