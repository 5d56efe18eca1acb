//! One job: plan one project, with the same functions as `viewrank plan`.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    process::{Command, Stdio},
    sync::{
        Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, AtomicU8, Ordering},
    },
    thread,
};

use serde::{Deserialize, Serialize};
use tracing::warn;

use super::{
    discover::OUTPUT_FOLDER,
    follow, queue,
    settle::{Fingerprint, HashCache, Stamp},
    state::Outcome,
};
use crate::{
    config::{Configuration, Files, Settings, Typed, user_file},
    error::Hint,
    output::{self, Disk},
    plan::{self, PlanError},
    progress::{Stage, Watcher},
    project::Project,
};

/// A project to plan.
pub struct Job<'a> {
    pub project: &'a Path,
    /// The input that was still; a plan of anything else is not to be written.
    pub stamp: &'a Stamp,
    pub cancel: &'a AtomicBool,
    /// Stage and percent.
    pub progress: &'a (dyn Fn(&str, u8) + Sync),
}

impl Job<'_> {
    pub fn is_cancelled(&self) -> bool {
        self.cancel.load(Ordering::Relaxed)
    }

    /// Is the input still what it was when the job began?
    pub fn is_current(&self) -> bool {
        !self.is_cancelled() && Stamp::of(self.project) == *self.stamp
    }
}

/// Plans projects.
pub trait Planner: Sync {
    /// Bytes of memory that planning the input takes at its peak.
    fn need(&self, stamp: &Stamp) -> u64 {
        queue::need(stamp.bytes())
    }

    /// Plans the project and writes the plan, unless the one that is there is right already.
    fn plan(&self, job: &Job) -> Outcome;

    /// Measures the finished depth maps of the project's plan.
    fn follow(&self, job: &Job) -> Outcome;

    /// The project's target is reached in reality.
    fn target_reached(&self, project: &Path) {
        let _ = project;
    }

    /// The project is gone.
    fn forget(&self, project: &Path) {
        let _ = project;
    }
}

/// Written with each plan: what it was made from, so that a new start of the daemon knows.
const RECORD: &str = "planned_from.json";

/// The record beside a plan.
#[derive(Debug, Serialize, Deserialize)]
struct PlannedFrom {
    fingerprint: Fingerprint,
    clusters: usize,
    share: f64,
}

/// The planner of `viewrank watch`: [`plan::plan`] and [`plan::files`].
#[derive(Default)]
pub struct PlanJob {
    /// It comes from the user who started the daemon, never from a project.
    on_target: Option<String>,
    hashes: Mutex<HashCache>,
    /// The last settings of each project that could be read.
    good_settings: Mutex<BTreeMap<PathBuf, Settings>>,
}

/// Why a job ends early, or how it ended.
type Ended<T> = Result<T, Outcome>;

impl Planner for PlanJob {
    fn plan(&self, job: &Job) -> Outcome {
        self.try_plan(job).unwrap_or_else(|ended| if job.is_cancelled() { Outcome::Abandoned } else { ended })
    }

    fn follow(&self, job: &Job) -> Outcome {
        follow::follow(job.project, &JobWatcher::new(job))
    }

    fn target_reached(&self, project: &Path) {
        let Some(command) = &self.on_target else { return };
        match Command::new("sh").arg("-c").arg(command).env("VIEWRANK_PROJECT", project).stdin(Stdio::null()).spawn() {
            Ok(mut child) => _ = thread::spawn(move || child.wait()),
            Err(error) => warn!(%error, "cannot run the command for a reached target"),
        }
    }

    fn forget(&self, project: &Path) {
        lock(&self.hashes).forget(project);
        lock(&self.good_settings).remove(project);
    }
}

impl PlanJob {
    /// `on_target`: run by the shell when a project's target is reached, with the project's folder in VIEWRANK_PROJECT.
    pub fn new(on_target: Option<String>) -> Self {
        Self { on_target, ..Self::default() }
    }

    fn try_plan(&self, job: &Job) -> Ended<Outcome> {
        output::recover(job.project, &Disk::REAL).map_err(failed)?;
        let (settings, note) = self.settings(job.project)?;
        let as_text = serde_json::to_vec(&settings).map_err(|_| Outcome::Abandoned)?;
        // A file that vanishes while it is hashed is a change, which raises its own event.
        let fingerprint = lock(&self.hashes).fingerprint(job.project, job.stamp, &as_text);
        let fingerprint = fingerprint.map_err(|_| Outcome::Abandoned)?;
        if let Some(record) = record_of(job.project).filter(|record| record.fingerprint == fingerprint) {
            return Ok(Outcome::Planned { fingerprint, clusters: record.clusters, share: record.share, note });
        }
        let project = Project::open(job.project, None).map_err(incomplete)?;
        let plan = plan::plan(&project, &settings, &JobWatcher::new(job)).map_err(sort_out)?;
        let files = plan::files(&plan, &project).map_err(failed)?;
        let (clusters, share) = (plan.cut.clusters, plan.cut.share);
        let record = PlannedFrom { fingerprint: fingerprint.clone(), clusters, share };
        let record = serde_json::to_string(&record).map_err(|_| Outcome::Abandoned)?;
        let mut sets = files.sets;
        if let Some(own) = sets.first_mut() {
            own.add_text(format!("{OUTPUT_FOLDER}/{RECORD}"), record + "\n");
        }
        if !job.is_current() {
            return Err(Outcome::Abandoned);
        }
        // The record comes last: without it the plan is made again.
        for set in sets.iter().rev() {
            set.write(&Disk::REAL).map_err(failed)?;
        }
        Ok(Outcome::Planned { fingerprint, clusters, share, note })
    }

    /// The project's settings; the last good ones, and a word about it, where they can't be read now.
    fn settings(&self, project: &Path) -> Ended<(Settings, Option<String>)> {
        let files = Files { user: user_file(), project: Some(project.join("viewrank.toml")) };
        match Configuration::load(&files, Typed::default()) {
            Ok(configuration) => {
                let settings = configuration.settings;
                lock(&self.good_settings).insert(project.into(), settings.clone());
                Ok((settings, None))
            }
            Err(error) => match lock(&self.good_settings).get(project) {
                Some(good) => Ok((good.clone(), Some(format!("{error}; the last good settings hold")))),
                None => Err(failed(error)),
            },
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // What is kept is whole between any two statements, whoever panicked.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn record_of(project: &Path) -> Option<PlannedFrom> {
    let folder = project.join(OUTPUT_FOLDER);
    let text = fs::read(folder.join(RECORD)).ok()?;
    serde_json::from_slice(&text).ok().filter(|_| folder.join("manifest.json").is_file())
}

fn failed(error: impl Hint) -> Outcome {
    Outcome::Failed { reason: error.to_string(), hint: error.hint() }
}

/// A model that doesn't parse or fit together is taken for one that isn't there whole yet.
fn incomplete(error: impl Hint) -> Outcome {
    Outcome::Incomplete { reason: error.to_string() }
}

fn sort_out(error: PlanError) -> Outcome {
    match error {
        PlanError::Cancelled(_) => Outcome::Abandoned,
        PlanError::Project(_) | PlanError::NoViews(_) => incomplete(error),
        error => failed(error),
    }
}

/// Passes on progress, a percent at a time, and the wish to cancel.
struct JobWatcher<'a> {
    job: &'a Job<'a>,
    /// Stage and percent that were told last.
    told: [AtomicU8; 2],
}

impl<'a> JobWatcher<'a> {
    fn new(job: &'a Job<'a>) -> Self {
        Self { job, told: [AtomicU8::new(u8::MAX), AtomicU8::new(u8::MAX)] }
    }
}

impl Watcher for JobWatcher<'_> {
    fn progress(&self, stage: Stage, done: u64, total: u64) {
        let percent = (100 * done.min(total) / total.max(1)) as u8;
        let same_stage = self.told[0].swap(stage as u8, Ordering::Relaxed) == stage as u8;
        let same_percent = self.told[1].swap(percent, Ordering::Relaxed) == percent;
        if !(same_stage && same_percent) {
            let name = serde_json::to_value(stage).ok();
            (self.job.progress)(name.as_ref().and_then(|n| n.as_str()).unwrap_or("planning"), percent);
        }
    }

    fn cancelled(&self) -> bool {
        self.job.is_cancelled()
    }
}
