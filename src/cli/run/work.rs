//! Computes the depth maps of a plan in rank order, measures and fuses them.

use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
    sync::atomic::{AtomicBool, Ordering},
    time::{Duration, Instant},
};

use super::{
    Arguments,
    result::{Ended, target_in_percent},
};
use crate::{
    apps::dispatch::{
        Dispatch, Task, Tools,
        runner::{Owner, Runner, TaskResult},
    },
    backends::{Backend, place},
    base::shell::shown_path,
    cli::{
        Exit, Failure, Format, note, print, print_json, progress::ProgressDisplay, report,
        summary::duration, terminal::complain, warn,
    },
    daemon::{PlanWhen, follow, foreground::Foreground, phase::Phase, state::Outcome},
    io::paths::from_here,
    model::cluster::MapScale,
    show::{
        manifest::{WrittenPlan, warnings_with},
        share::area_of_all,
    },
};

/// A measurement pauses the matching; the next one comes after this multiple of its duration.
const REST: u32 = 4;
/// The report takes as long as planning; it is rewritten after this multiple of its duration.
const REPORT_REST: u32 = 20;
/// The cloud so far is fused anew after this multiple of the time that the last fusion took.
const FUSION_REST: u32 = 20;
/// Depth maps of which a cloud can be fused.
const LEAST_FUSED: usize = 2;
/// Part of all depth maps after which a cloud is worth a look: no others give as much of it.
const FIRST_FUSED: f64 = 0.01;
/// Number of consecutive failures that ends the run.
const FAILURES: usize = 3;

/// A planned project with its tasks.
pub struct Work<'a> {
    pub(super) arguments: &'a Arguments,
    pub(super) foreground: &'a Foreground<'a>,
    stop: &'a AtomicBool,
    pub(super) plan: WrittenPlan,
    pub(super) backend: &'static Backend,
    pub(super) dispatch: Dispatch,
    _held: std::fs::File,
    tools: Tools,
    pub(super) failed: Vec<String>,
    measured: Throttle,
    /// Estimated share of the finished maps; `None` before the first measurement.
    share: Option<f64>,
    reported: Throttle,
    so_far: CloudSoFar,
    /// Depth maps that this run computed, and the time that they took.
    pub(super) computed: (u32, Duration),
}

/// The fusions of a run before its end.
#[derive(Default)]
struct CloudSoFar {
    fused: Throttle,
    /// Depth maps that the run had computed at the last one.
    computed: u32,
    is_announced: bool,
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
    let counted = match others {
        0 => return,
        1 => "1 depth map that is there does not count".to_owned(),
        _ => format!("{others} depth maps that are there do not count"),
    };
    note(&format!("{counted} for this plan: made again"));
}

impl<'a> Work<'a> {
    pub fn new(
        arguments: &'a Arguments,
        backend: &'static Backend,
        foreground: &'a Foreground<'a>,
        stop: &'a AtomicBool,
        when: PlanWhen,
    ) -> Result<Self, Failure> {
        let lines = Lines::new(arguments.is_silent());
        match foreground.plan(when, &|stage, percent| lines.stage(stage, percent)) {
            Outcome::Planned { note, .. } => note.iter().for_each(|text| warn(text)),
            other => return Err(failure(other, stop, arguments.go_on())),
        }
        let root = foreground.root();
        let plan = WrittenPlan::read(root)?;
        let (dispatch, export) = Dispatch::of_plan(&plan, backend, plan.cut)?;
        warnings_with(&plan.warnings, std::slice::from_ref(&export.record), &[])
            .iter()
            .for_each(|warning| warn(warning));
        // Before the export is written, which another run may be working on.
        let held = dispatch.hold()?;
        let tools = Tools::find(&dispatch, arguments.program.as_deref())?;
        let folder = export.files.root.clone();
        place::check(&folder, std::slice::from_ref(&export), &plan.project)?;
        place::set_of_folder(&folder, [export.files], &plan.project).write(&plan.project.disk())?;
        note_maps_of_other_plans(&dispatch);
        Ok(Self {
            arguments,
            foreground,
            stop,
            backend,
            dispatch,
            _held: held,
            tools,
            failed: Vec::new(),
            measured: Throttle::default(),
            share: None,
            reported: Throttle::default(),
            so_far: CloudSoFar::default(),
            computed: (0, Duration::ZERO),
            plan,
        })
    }

    /// Plans anew around the finished maps, and goes on with that plan.
    pub fn replanned(self) -> Result<Self, Failure> {
        let Self {
            arguments,
            backend,
            foreground,
            stop,
            _held: held,
            ..
        } = self;
        // Or `new` could not take the lock.
        drop(held);
        let next = Self::new(arguments, backend, foreground, stop, PlanWhen::AroundMaps)?;
        Ok(Self {
            computed: self.computed,
            failed: self.failed,
            measured: self.measured,
            reported: self.reported,
            so_far: self.so_far,
            ..next
        })
    }

    pub fn plan_in_words(&self) -> String {
        let (all, tasks) = (self.plan.all_maps, self.dispatch.tasks.len());
        let area = area_of_all(None, self.plan.settings.region.is_some());
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
                let target = target_in_percent(target);
                format!(
                    "Computing up to {tasks} of {all} depth maps{done}, until they cover about {target} of {area}."
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
    pub(super) fn target(&self) -> Option<f64> {
        self.plan.settings.cut.target.map(|target| target.0)
    }

    /// Number of depth maps of the plan.
    pub fn length(&self) -> usize {
        self.dispatch.tasks.len()
    }

    /// Returns whether all maps of the plan are there, and cover less than the target.
    pub fn fell_short(&self, ended: Ended) -> bool {
        let below = |target| self.share.is_some_and(|share| share < target);
        ended == Ended::ListDone && self.failed.is_empty() && self.target().is_some_and(below)
    }

    fn runner(&self) -> Runner<'_> {
        Runner {
            tools: &self.tools,
            threads: self.arguments.threads(),
            stop: self.stop,
            owner: Owner::Viewrank,
            on_wait: &|| note("waiting for another process that computes the same"),
        }
    }

    /// Computes the depth maps in rank order.
    pub fn compute(&mut self) -> Result<Ended, Failure> {
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
            let ended = self.dispatch.compute(task, &self.runner())?;
            // Ctrl-C may also come when the task has just ended.
            if ended == TaskResult::Stopped || self.stop.load(Ordering::Relaxed) {
                return Ok(Ended::Stopped);
            }
            in_a_row = match ended {
                TaskResult::Failed(output) => {
                    // A single map that fails leaves nothing to go on with.
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
            // After the last map, the final fusion follows anyway.
            if i + 1 < missing.len() && !reached {
                self.fuse_so_far();
            }
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
        // An earlier share would be printed beside a map that it does not count.
        self.share = None;
        if !(is_last || self.measured.is_due(REST)) {
            return false;
        }
        let done: BTreeSet<PathBuf> = self
            .dispatch
            .finished_maps()
            .map(Path::to_path_buf)
            .collect();
        if done.is_empty() {
            return false;
        }
        let began = Instant::now();
        let outcome = self.foreground.measure(&|path| done.contains(path));
        self.measured.note(began);
        match outcome {
            Outcome::Followed(phase) => {
                self.share = follow::Progress::read(self.foreground.root())
                    .and_then(|progress| progress.share);
                matches!(phase, Phase::Reached { .. }) && self.target().is_some()
            }
            Outcome::Failed { reason, .. } => {
                warn(&format!("cannot measure the depth maps: {reason}"));
                false
            }
            _ => false,
        }
    }

    /// Fuses the cloud so far, so that a user who has seen enough can stop early: first when this
    /// run has computed 1 % of all maps, then for a part of the time. A failure is a warning, since
    /// the maps are kept and fused at the end.
    fn fuse_so_far(&mut self) {
        let first = (FIRST_FUSED * self.plan.scene.views.len() as f64).ceil() as usize;
        let (computed, before) = (self.computed.0, &self.so_far);
        if computed == before.computed
            || (computed as usize) < first.max(LEAST_FUSED)
            || !before.fused.is_due(FUSION_REST)
        {
            return;
        }
        let began = Instant::now();
        let ended = self.dispatch.fuse(&self.runner());
        self.so_far.fused.note(began);
        self.so_far.computed = computed;
        let failure = match ended {
            Ok(TaskResult::Failed(output)) => last_line(&output).to_owned(),
            Err(error) => error.to_string(),
            Ok(TaskResult::Done | TaskResult::Idle) => return self.announce_cloud(),
            Ok(TaskResult::Stopped) => return,
        };
        warn(&format!("cannot fuse the cloud so far: {failure}"));
    }

    /// Says once where the cloud so far is.
    fn announce_cloud(&mut self) {
        if !self.so_far.is_announced && !self.arguments.is_silent() {
            for cloud in self.dispatch.runner().clouds_there() {
                let cloud = shown_path(&from_here(cloud));
                note(&format!(
                    "the cloud so far, updated from time to time: {cloud}"
                ));
            }
        }
        self.so_far.is_announced = true;
    }

    /// Writes the report page, unless the last one is recent.
    fn report(&mut self, is_last: bool) {
        if self.arguments.no_report || !(is_last || self.reported.is_due(REPORT_REST)) {
            return;
        }
        let began = Instant::now();
        if let Err(failure) = report::write(self.foreground.root(), &ProgressDisplay::new(true)) {
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
        let target = self.target().map_or_else(String::new, |target| {
            format!(" (target {:.0} %)", 100.0 * target)
        });
        let share = self.share.map_or_else(String::new, |share| {
            format!("{:5.1} %{target}", 100.0 * share)
        });
        let (all, took) = (self.dispatch.tasks.len(), took.as_secs_f64());
        complain(&format!(
            "{done:4} of {all}  {share:<22}  {:<28} {took:6.1} s, at most {} left",
            task.key,
            duration(left)
        ));
    }

    /// Fuses, writes the report and prints the result.
    pub fn end(mut self, ended: Ended) -> Result<(), Failure> {
        if ended == Ended::Stopped {
            if self.dispatch.finished_maps().count() < LEAST_FUSED {
                return Err(self.stopped());
            }
            note("fusing the depth maps that are there; Ctrl-C again leaves that");
            // The fusion ends as soon as it is set again.
            self.stop.store(false, Ordering::Relaxed);
            self.measure(true);
        }
        match self.dispatch.fuse(&self.runner())? {
            TaskResult::Done | TaskResult::Idle => {}
            TaskResult::Stopped => return Err(self.stopped()),
            TaskResult::Failed(output) => {
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
            return Err(if self.arguments.is_silent() {
                self.stopped().behind_result()
            } else {
                Failure::already_printed(Exit::Failed)
            });
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

    /// Returns the command that continues.
    pub(super) fn again(&self) -> String {
        self.arguments.again(self.arguments.target.as_deref())
    }

    fn stopped(&self) -> Failure {
        let (done, all) = (
            self.dispatch.finished_maps().count(),
            self.dispatch.tasks.len(),
        );
        let at = format!("with {done} of {all} depth maps");
        Failure::stopped(&at, self.arguments.go_on())
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
        let hint = match self.dispatch.runner().python {
            _ if output.contains("No space left on device") => {
                format!(
                    "free some space there; finished depth maps are kept, and this goes on: {}",
                    self.again()
                )
            }
            Some(python) if output.contains("ModuleNotFoundError") => python.into(),
            _ => format!(
                "check the images (viewrank doctor {}) and the program (with one of its own commands), or take another --backend",
                self.plan.project.as_argument()
            ),
        };
        Failure::new(Exit::Failed, message, hint).with_output(output)
    }
}

/// Returns the failure of a missing plan.
fn failure(outcome: Outcome, stop: &AtomicBool, go_on: String) -> Failure {
    match outcome {
        Outcome::Failed { reason, hint } => Failure::new(Exit::Failed, reason, hint),
        Outcome::Incomplete { reason } => Failure::new(Exit::Failed, reason, None),
        _ if stop.load(Ordering::Relaxed) => Failure::stopped("while planning", go_on),
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
