//! `viewrank run`: plans, matches and fuses a project on this machine, best first, until the target
//! is reached.

use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::{Duration, Instant},
};

use clap::Args;
use serde::Serialize;

use super::{
    Exit, Failure, Format, arguments, config, next, note, print, print_json,
    progress::ProgressDisplay, ready, summary::duration, terminal::complain, warn, wrapped,
};
use crate::{
    apps::{
        dispatch::{Dispatch, Task, Tools, local::ScriptResult},
        planning, undistort,
    },
    backends::{self, Backend, place},
    base::{platform, shell::command_path},
    config::CommandLineSettings,
    daemon::{follow, foreground::Foreground, state::Outcome},
    io::project::Project,
    model::cluster::MapScale,
    show::{
        files::report_path,
        manifest::{WrittenPlan, planned_region, warnings_with},
    },
};

/// A measurement pauses the matching; the next one comes after this multiple of its duration.
const REST: u32 = 4;
/// The report takes as long as planning; it is rewritten after this multiple of its duration.
const REPORT_REST: u32 = 20;
/// Said at the end of a run that leaves nothing of the plan.
const ALL_DONE: &str = "the list is done, with all that the plan has";
/// Depth maps of which a cloud can be fused.
const LEAST_FUSED: usize = 2;
/// Number of consecutive failures that ends the run.
const FAILURES: usize = 3;

/// Plan a project, compute its depth maps best first until the target is reached, and fuse them.
///
/// Undistorts the images if the backend needs that, and matches with the backend that the project
/// is set up for, else with OpenMVS (DensifyPointCloud) or a COLMAP with CUDA if on the PATH, else
/// with integrations/sgm (Python with numpy and opencv). Each depth map is measured;
/// PROJECT/viewrank/report.html shows the progress. Ctrl-C stops and fuses what is there, a second
/// one ends at once; the same command resumes.
#[derive(Args)]
pub struct Arguments {
    /// Folder of the project, or its model
    #[arg(value_parser = super::arguments::project())]
    project: PathBuf,

    /// Backend to match with [default: as the project is set up, else what is installed]
    #[arg(long, value_name = "NAME")]
    backend: Option<String>,
    /// Stop at P % of what all view clusters together reach [default: 90%, or the settings']
    #[arg(long, value_name = "P%")]
    target: Option<String>,
    /// Compute at most N depth maps, or those of P % of the registered views (with --scales, of the
    /// work of all)
    #[arg(long, value_name = "N|P%")]
    budget: Option<String>,
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
    /// The backend's program [default: $DENSIFY, $COLMAP, $SGM, else from the PATH]
    #[arg(long, value_name = "FILE")]
    program: Option<PathBuf>,
    /// Threads of the backend [default: all]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    threads: Option<u16>,
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

/// JSON output: state at the end.
#[derive(Serialize)]
struct RunSummary {
    project: PathBuf,
    backend: &'static str,
    /// Numbers of finished and planned depth maps.
    done: usize,
    tasks: usize,
    failed: usize,
    /// Depth maps that the project could have.
    all: usize,
    /// All of them that can be made are there.
    is_whole: bool,
    /// Share of the cloud of all of them, 0 to 1, estimated from the finished maps; null before
    /// the first measurement.
    share: Option<f64>,
    /// The same as the plan predicted it for as many maps.
    predicted: Option<f64>,
    /// Seconds that this run matched for, and that all depth maps would take at that speed; null
    /// if it computed none.
    seconds: Option<[f64; 2]>,
    /// Target of the share; null if only other limits were set.
    target: Option<f64>,
    target_reached: bool,
    /// Stopped before its end.
    stopped: bool,
    /// Point cloud; null if none was made.
    cloud: Option<PathBuf>,
    /// Report page; null if none was written.
    report: Option<PathBuf>,
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let stop = platform::stop_flag()
        .map_err(|error| Failure::new(Exit::Failed, error.to_string(), None))?;
    let project = Project::open(&arguments.project, None)?;
    let settings = config::load(Some(&project), arguments.typed(None, true))?.settings;
    let project = project.with_images(settings.images.as_deref());
    let (backend, choice) = backends::chosen(&project, &settings)?;
    let say = |line: String| {
        if arguments.is_silent() {
            Ok(())
        } else {
            print([line])
        }
    };
    say(format!(
        "Backend: {} ({}).",
        backend.name,
        choice.describe()
    ))?;
    let own = project.root.clone();
    let scene = project.read_scene()?;
    let is_distorted = scene
        .view_indices()
        .any(|view| !scene.camera_of(view).is_pinhole());
    // Ctrl-C also ends the programs that are asked what they can do.
    let stopped = || Failure::new(Exit::Failed, "stopped before planning", arguments.go_on());
    ready::check(backend, &project, scene, arguments.program.as_deref()).map_err(|failure| {
        if stop.load(Ordering::Relaxed) {
            stopped()
        } else {
            failure
        }
    })?;
    Dispatch::refuse_if_at_work(&project)?;
    let root = if backend.takes_distorted || !is_distorted {
        project.root
    } else {
        undistorted(arguments, project, backend)?
    };
    let is_own = root == own;
    let mut typed = arguments.typed(Some(backend.name), is_own);
    // Somebody may have typed it for that plan.
    if let Some(region) = planned_region(&root).filter(|_| settings.region.is_none()) {
        note(&format!("the region is that of the last plan: {region}"));
        typed.set("--region", "region", Some(region));
    }
    let foreground = Foreground::new(&root, typed, &stop);
    let mut work = Work::new(arguments, backend, &foreground, &stop)?;
    say(work.plan_in_words())?;
    let ended = work.compute()?;
    work.end(ended)
}

/// Why no more depth maps are computed.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Ended {
    TargetReached,
    ListDone,
    /// By Ctrl-C.
    Stopped,
}

/// Finds the workspace of undistorted images of another program, else undistorts the images;
/// returns their project.
fn undistorted(
    arguments: &Arguments,
    project: Project,
    backend: &Backend,
) -> Result<PathBuf, Failure> {
    // Its own may be of earlier images.
    if !project.has_undistorted_workspace()
        && let Some(workspace) = planning::undistorted_workspace(&project, backend)?
    {
        note(&format!(
            "{} needs undistorted images: {}",
            backend.name,
            workspace.root.display()
        ));
        Dispatch::refuse_if_at_work(&workspace)?;
        return Ok(workspace.root);
    }
    let dense = project.root.join("dense");
    if let Ok(earlier) = Project::open(&dense, None) {
        Dispatch::refuse_if_at_work(&earlier)?;
    }
    note(&format!(
        "{} needs undistorted images: {}",
        backend.name,
        dense.display()
    ));
    let progress = ProgressDisplay::new(arguments.is_silent());
    let done = undistort::undistort(
        &project,
        &undistort::UndistortOptions::default(),
        &dense,
        &project.disk(),
        &progress,
    )?;
    progress.finish();
    done.warning().iter().for_each(|warning| warn(warning));
    Ok(dense)
}

/// Suggests a higher target after the whole list reached only `share` (measured): raised by the
/// shortfall, at least by five points. `None` if the list has all maps.
fn higher(target: f64, share: Option<f64>) -> Option<String> {
    let missing = share.map_or(0.0, |share| target - share);
    (target < 1.0).then(|| format!("{:.0}%", (100.0 * (target + missing.max(0.05))).min(100.0)))
}

impl Arguments {
    /// Returns the command that continues with the same choices, up to that target.
    fn again(&self, target: Option<&str>) -> String {
        let path = |path: &PathBuf| path.display().to_string();
        let options = [
            ("--backend", self.backend.clone()),
            ("--target", target.map(str::to_owned)),
            ("--budget", self.budget.clone()),
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
        typed.set("--budget", "cut.budget", self.budget.clone());
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

/// A planned project with its tasks.
struct Work<'a> {
    arguments: &'a Arguments,
    foreground: &'a Foreground<'a>,
    stop: &'a AtomicBool,
    plan: WrittenPlan,
    backend: &'static Backend,
    dispatch: Dispatch,
    _held: std::fs::File,
    threads: usize,
    failed: Vec<String>,
    measured: Throttle,
    /// Estimated share of the finished maps; `None` before the first measurement.
    share: Option<f64>,
    reported: Throttle,
    /// Depth maps that this run computed, and the time that they took.
    computed: (u32, Duration),
}

/// End and duration of the last run of a slow step.
#[derive(Clone, Copy, Default)]
struct Throttle(Option<(Instant, Duration)>);

impl Throttle {
    fn is_due(self, rest: u32) -> bool {
        self.0
            .is_none_or(|(ended, took)| ended.elapsed() >= took * rest)
    }

    fn note(&mut self, began: Instant) {
        self.0 = Some((Instant::now(), began.elapsed()));
    }
}

fn note_maps_of_other_plans(dispatch: &Dispatch) {
    let others = dispatch
        .tasks
        .iter()
        .filter(|task| !dispatch.is_done(task) && task.map.is_file())
        .count();
    if others > 0 {
        note(&format!(
            "{others} depth maps that are there do not count for this plan: made again"
        ));
    }
}

impl<'a> Work<'a> {
    fn new(
        arguments: &'a Arguments,
        backend: &'static Backend,
        foreground: &'a Foreground<'a>,
        stop: &'a AtomicBool,
    ) -> Result<Self, Failure> {
        let lines = Lines::new(arguments.is_silent());
        match foreground.plan(&|stage, percent| lines.stage(stage, percent)) {
            Outcome::Planned { note, .. } => note.iter().for_each(|text| warn(text)),
            other => return Err(failure(other, stop, arguments.go_on())),
        }
        let root = foreground.root();
        let plan = WrittenPlan::read(root)?;
        let settings = config::load(
            Some(&plan.project),
            arguments.typed(Some(backend.name), false),
        )?
        .settings
        .dispatch;
        let image_faults = plan.project.image_faults(&plan.scene);
        let selection = plan.selection(&plan.clusters[..plan.cut], &image_faults);
        let export = backend.export(&selection, &Default::default())?;
        warnings_with(&plan.warnings, std::slice::from_ref(&export.record), &[])
            .iter()
            .for_each(|warning| warn(warning));
        let dispatch = Dispatch::new(backend, &selection, &export, plan.finished)?;
        let held = dispatch.hold()?;
        let tools = Tools::find(&dispatch, arguments.program.as_deref())?;
        let folder = export.files.root.clone();
        place::check(&folder, std::slice::from_ref(&export), &plan.project)?;
        place::set_of_folder(&folder, [export.files], &plan.project).write(&plan.project.disk())?;
        dispatch
            .files(&tools, &settings, &BTreeSet::new())
            .write(&plan.project.disk())?;
        note_maps_of_other_plans(&dispatch);
        let cores = || thread::available_parallelism().map_or(1, usize::from);
        let threads = arguments.threads.map_or_else(cores, usize::from);
        Ok(Self {
            arguments,
            foreground,
            stop,
            backend,
            dispatch,
            _held: held,
            threads,
            failed: Vec::new(),
            measured: Throttle::default(),
            share: None,
            reported: Throttle::default(),
            computed: (0, Duration::ZERO),
            plan,
        })
    }

    fn plan_in_words(&self) -> String {
        let (all, tasks) = (self.plan.scene.views.len(), self.dispatch.tasks.len());
        let done = self.dispatch.finished_maps().count();
        let half = self
            .plan
            .clusters
            .iter()
            .take(tasks)
            .filter(|cluster| cluster.scale == MapScale::Half)
            .count();
        let half = if half > 0 {
            format!(", {half} at half size")
        } else {
            String::new()
        };
        let done = if done > 0 {
            format!("{half}, {done} of them there already")
        } else {
            half
        };
        match (self.target(), &self.arguments.budget) {
            (Some(target), _) => {
                let target = (1000.0 * target).round() / 10.0;
                format!(
                    "Computing up to {tasks} of {all} depth maps{done}, until {target} % of what all would give."
                )
            }
            (None, Some(budget)) => {
                format!("Computing {tasks} of {all} depth maps{done} (--budget {budget}).")
            }
            (None, None) => format!(
                "Computing {tasks} of {all} depth maps{done}, to the limit of the settings."
            ),
        }
    }

    /// Share at which to stop; `None` if only other limits were set, whose maps are all computed.
    fn target(&self) -> Option<f64> {
        self.plan.settings.cut.target.map(|target| target.0)
    }

    /// Computes the depth maps in rank order.
    fn compute(&mut self) -> Result<Ended, Failure> {
        let tasks = self.dispatch.tasks.clone();
        let missing: Vec<&Task> = tasks
            .iter()
            .filter(|task| !self.dispatch.is_done(task))
            .collect();
        let mut reached = self.measure(missing.is_empty());
        let (began, mut in_a_row) = (Instant::now(), 0);
        for (i, task) in missing.iter().enumerate() {
            if reached {
                return Ok(Ended::TargetReached);
            }
            let since = Instant::now();
            let ended = self.dispatch.compute_here(task, self.threads, self.stop)?;
            if ended == ScriptResult::Stopped || self.stop.load(Ordering::Relaxed) {
                return Ok(Ended::Stopped);
            }
            in_a_row = match ended {
                ScriptResult::Failed(output) => {
                    if in_a_row + 1 == FAILURES || missing.len() == 1 {
                        return Err(self.broken(task, in_a_row, &output));
                    }
                    warn(&format!(
                        "no depth map of {}: {}",
                        task.key,
                        last_line(&output)
                    ));
                    self.failed.push(task.key.clone());
                    in_a_row + 1
                }
                _ => {
                    self.computed.0 += 1;
                    self.computed.1 += since.elapsed();
                    0
                }
            };
            reached = self.measure(i + 1 == missing.len());
            self.report(false);
            let left =
                began.elapsed().as_secs_f64() / (i + 1) as f64 * (missing.len() - i - 1) as f64;
            self.line(task, since.elapsed(), left);
        }
        Ok(if reached {
            Ended::TargetReached
        } else {
            Ended::ListDone
        })
    }

    /// Measures the finished depth maps, unless the last measurement was recent; true if the target
    /// is reached.
    fn measure(&mut self, is_last: bool) -> bool {
        self.share = None;
        let done: BTreeSet<PathBuf> = self
            .dispatch
            .finished_maps()
            .map(Path::to_path_buf)
            .collect();
        if done.is_empty() || !(is_last || self.measured.is_due(REST)) {
            return false;
        }
        let began = Instant::now();
        let outcome = self.foreground.measure(&|path| done.contains(path));
        self.measured.note(began);
        match outcome {
            Outcome::Followed { reached, .. } => {
                self.share = follow::Progress::read(self.foreground.root())
                    .and_then(|progress| progress.share);
                reached && self.target().is_some()
            }
            Outcome::Failed { reason, .. } => {
                warn(&format!("cannot measure the depth maps: {reason}"));
                false
            }
            _ => false,
        }
    }

    /// Writes the report page, unless the last one is recent.
    fn report(&mut self, is_last: bool) {
        if self.arguments.no_report || !(is_last || self.reported.is_due(REPORT_REST)) {
            return;
        }
        let began = Instant::now();
        if let Err(failure) =
            super::report::write(self.foreground.root(), &ProgressDisplay::new(true))
        {
            warn(&format!("cannot write the report: {}", failure.message));
        }
        self.reported.note(began);
    }

    /// Prints the progress.
    fn line(&self, task: &Task, took: Duration, left: f64) {
        if self.arguments.is_silent() {
            return;
        }
        let done = self.dispatch.finished_maps().count();
        let target = self
            .target()
            .map_or_else(String::new, |target| format!(" of {:.1} %", 100.0 * target));
        let share = self.share.map_or_else(String::new, |share| {
            format!("{:5.1} %{target}", 100.0 * share)
        });
        let (all, took) = (self.dispatch.tasks.len(), took.as_secs_f64());
        complain(&format!(
            "{done:4} of {all}  {share:<14}  {:<28} {took:6.1} s, at most {} left",
            task.key,
            duration(left)
        ));
    }

    /// Fuses, writes the report and prints the result.
    fn end(mut self, ended: Ended) -> Result<(), Failure> {
        if ended == Ended::Stopped {
            if self.dispatch.finished_maps().count() < LEAST_FUSED {
                return Err(self.stopped());
            }
            note("fusing the depth maps that are there; Ctrl-C again leaves that");
            self.stop.store(false, Ordering::Relaxed);
            self.measure(true);
        }
        match self.dispatch.fuse_here(self.threads, self.stop)? {
            ScriptResult::Done => {}
            ScriptResult::Stopped => return Err(self.stopped()),
            ScriptResult::Failed(output) => {
                let message = "cannot fuse the depth maps, which are complete:";
                let hint = format!("to try again: {}", self.again());
                return Err(Failure::new(Exit::Failed, message, hint).with_output(&output));
            }
        }
        self.report(true);
        let result = self.result(ended);
        match self.arguments.format {
            Format::Json => print_json(&result)?,
            Format::Text if self.arguments.quiet => {}
            Format::Text => print(self.describe(&result))?,
        }
        if ended == Ended::Stopped {
            return Err(self.stopped().behind_result());
        }
        match self.failed.len() {
            0 => Ok(()),
            failed => {
                let message = format!(
                    "{failed} depth maps could not be computed, the first of {}",
                    self.failed[0]
                );
                Err(Failure::new(
                    Exit::Failed,
                    message,
                    format!("to try them again: {}", self.again()),
                )
                .behind_result())
            }
        }
    }

    fn result(&self, ended: Ended) -> RunSummary {
        let report = report_path(self.foreground.root());
        let (done, all) = (
            self.dispatch.finished_maps().count(),
            self.plan.scene.views.len(),
        );
        let progress = follow::Progress::read(self.foreground.root());
        RunSummary {
            project: self.foreground.root().into(),
            backend: self.backend.name,
            done,
            all,
            is_whole: done == self.plan.clusters.len(),
            tasks: self.dispatch.tasks.len(),
            failed: self.failed.len(),
            share: progress.as_ref().and_then(|progress| progress.share),
            predicted: done
                .checked_sub(1)
                .and_then(|last| Some(self.plan.clusters.get(last)?.share)),
            seconds: self.seconds(
                done,
                progress.and_then(|progress| progress.seconds_per_pair),
            ),
            target: self.target(),
            target_reached: ended == Ended::TargetReached,
            stopped: ended == Ended::Stopped,
            cloud: Some(self.dispatch.runner().cloud.clone()).filter(|cloud| cloud.is_file()),
            report: report.is_file().then_some(report),
        }
    }

    /// Time of matching the first maps of the list, and all maps: by the times of all finished maps
    /// where these are known, for earlier runs made some of them, else by this run's.
    fn seconds(&self, done: usize, per_pair: Option<f64>) -> Option<[f64; 2]> {
        let pairs = |maps: usize| {
            let clusters = self.plan.clusters.iter().take(maps);
            clusters
                .map(|cluster| cluster.partners.len())
                .sum::<usize>() as f64
        };
        let (computed, took) = self.computed;
        let of_run = || (computed > 0).then(|| took.as_secs_f64() / f64::from(computed));
        let in_all = self.plan.clusters.len();
        match per_pair {
            Some(each) => Some([done, in_all].map(|maps| each * pairs(maps))),
            None => of_run().map(|each| [done, in_all].map(|maps| each * maps as f64)),
        }
    }

    fn describe(&self, result: &RunSummary) -> Vec<String> {
        let target = self.target();
        let higher = target.and_then(|target| higher(target, result.share));
        let verdict = if result.target_reached {
            "the target is reached".to_owned()
        } else if result.stopped {
            "stopped".to_owned()
        } else if result.failed > 0 {
            let again = self.arguments.again(self.arguments.target.as_deref());
            format!("{} failed; to try again: {again}", result.failed)
        } else if result.tasks == self.plan.clusters.len() {
            ALL_DONE.to_owned()
        } else if self.arguments.budget.is_some() || target.is_none() {
            "the budget is spent; raise --budget for more".to_owned()
        } else if let Some(higher) = higher {
            let again = self.arguments.again(Some(&higher));
            format!("the list is done below the target; for more: {again}")
        } else {
            ALL_DONE.to_owned()
        };
        let result_line = format!("{}; {verdict}.", result.in_words());
        let mut lines = vec![String::new()];
        lines.extend(wrapped("", &result_line));
        if let Some(cloud) = &result.cloud {
            lines.push(format!("Point cloud: {}", cloud.display()));
        }
        if let Some(report) = &result.report {
            lines.push(format!("Report: {}", report.display()));
        }
        lines
    }

    /// Returns the command that continues.
    fn again(&self) -> String {
        self.arguments.again(self.arguments.target.as_deref())
    }

    fn stopped(&self) -> Failure {
        let (done, all) = (
            self.dispatch.finished_maps().count(),
            self.dispatch.tasks.len(),
        );
        Failure::new(
            Exit::Failed,
            format!("stopped with {done} of {all} depth maps"),
            self.arguments.go_on(),
        )
    }

    /// `before`: number of tasks that failed just before this one.
    fn broken(&self, task: &Task, before: usize, output: &str) -> Failure {
        let in_a_row = if before > 0 {
            format!("{} key views in a row, the last ", before + 1)
        } else {
            String::new()
        };
        let (name, key, why) = (self.backend.name, &task.key, last_line(output));
        let message = format!("{name} made no depth map of {in_a_row}{key}: {why}");
        let hint = match self.backend.name {
            _ if output.contains("No space left on device") => {
                format!("free some space there; finished depth maps are kept, and this goes on: {}", self.again())
            }
            "sgm" if output.contains("ModuleNotFoundError") => {
                "name a Python with numpy and opencv in PYTHON: python3 -m venv V && V/bin/pip install numpy \
                 opencv-python-headless"
                    .into()
            }
            _ => format!(
                "check the images (viewrank doctor {}) and the program (with one of its own commands), or take another --backend",
                self.plan.project.as_argument()
            ),
        };
        Failure::new(Exit::Failed, message, hint).with_output(output)
    }
}

impl RunSummary {
    /// Says what was computed, what that gives of what, how that is known, and what it saved.
    fn in_words(&self) -> String {
        let Self { done, all, .. } = *self;
        let percent = |share: f64| format!("{:.0} %", 100.0 * share);
        let share = match (self.share, self.predicted) {
            _ if self.is_whole => "the whole cloud".to_owned(),
            (Some(share), Some(predicted)) => format!(
                "about {} of the cloud that all {all} would give (estimated from these maps; the plan said {})",
                percent(share),
                percent(predicted)
            ),
            _ => format!("their share of the cloud that all {all} would give is not known"),
        };
        let seconds =
            self.seconds
                .filter(|_| !self.is_whole)
                .map_or_else(String::new, |[here, whole]| {
                    let [here, whole] = [here, whole].map(duration);
                    format!(", in {here} of matching, where all would take about {whole}")
                });
        format!("{done} of {all} depth maps: {share}{seconds}")
    }
}

/// Returns the failure of a missing plan.
fn failure(outcome: Outcome, stop: &AtomicBool, go_on: String) -> Failure {
    match outcome {
        Outcome::Failed { reason, hint } => Failure::new(Exit::Failed, reason, hint),
        Outcome::Incomplete { reason } => Failure::new(Exit::Failed, reason, None),
        _ if stop.load(Ordering::Relaxed) => {
            Failure::new(Exit::Failed, "stopped while planning", go_on)
        }
        _ => Failure::new(
            Exit::Failed,
            "the project changed while it was planned",
            go_on,
        ),
    }
}

/// Returns the last line of a task's output that the task's script did not print itself.
fn last_line(text: &str) -> &str {
    let mut lines = text.lines();
    let error = lines.clone().rfind(|line| line.starts_with("error: "));
    let line = error.or_else(|| lines.rfind(|line| !line.starts_with("rank ")));
    let line = line.map_or("it failed without a word", str::trim);
    line.strip_prefix("error: ").unwrap_or(line)
}

/// Prints stages of planning as lines on stderr.
struct Lines {
    is_silent: bool,
    stage: std::sync::Mutex<String>,
}

impl Lines {
    fn new(is_silent: bool) -> Self {
        Self {
            is_silent,
            stage: std::sync::Mutex::default(),
        }
    }

    fn stage(&self, stage: &str, _percent: u8) {
        let mut last = self
            .stage
            .lock()
            .unwrap_or_else(std::sync::PoisonError::into_inner);
        if !self.is_silent && *last != stage {
            complain(&format!("planning: {stage}"));
            *last = stage.into();
        }
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn a_list_that_fell_short_asks_for_a_higher_target() {
        let cases = [
            ((0.7, Some(0.695)), Some("75%")),
            ((0.8, None), Some("85%")),
            ((0.7, Some(0.6)), Some("80%")),
            ((0.98, Some(0.97)), Some("100%")),
            ((1.0, Some(0.9)), None),
        ];
        for ((target, share), expected) in cases {
            assert_eq!(
                super::higher(target, share).as_deref(),
                expected,
                "{target} {share:?}"
            );
        }
    }
}
