//! Interface between the daemon and its planner.

use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    path::{Path, PathBuf},
    sync::atomic::{AtomicBool, Ordering},
};

use super::{
    discover::is_project,
    maps::MapFiles,
    queue,
    settle::Stamp,
    state::{OnBusy, Outcome, Work},
};

/// A project to plan or measure.
pub struct Job<'a> {
    pub project: &'a Path,
    /// The input, which had settled.
    pub stamp: &'a Stamp,
    /// Files besides model and images that belong to the input.
    pub named: &'a [PathBuf],
    pub on_busy: OnBusy,
    pub follow_links: bool,
    /// Completely written depth maps.
    pub maps: &'a MapFiles,
    /// Bytes that planning may take.
    pub most_memory: Option<u64>,
    pub cancel: &'a AtomicBool,
    /// Receives stage and percent.
    pub progress: &'a (dyn Fn(&str, u8) + Sync),
}

impl Job<'_> {
    pub fn is_cancelled(&self) -> bool {
        self.cancel.load(Ordering::Relaxed)
    }

    /// True if the input is the same as when the job started.
    pub fn is_current(&self) -> bool {
        Stamp::read(self.project, self.follow_links).with(self.named) == *self.stamp
    }

    /// True if the plan may be written: the job isn't cancelled, and its input is unchanged or the
    /// next plan is queued behind it.
    pub fn is_wanted(&self) -> bool {
        let may_be_written = || match self.on_busy {
            OnBusy::Queue => is_project(self.project, self.follow_links),
            OnBusy::Restart => self.is_current(),
        };
        !self.is_cancelled() && may_be_written()
    }
}

/// Plans and measures projects.
pub trait Planner: Sync {
    /// Estimates the peak memory in bytes of planning the input.
    fn need(&self, stamp: &Stamp) -> u64 {
        queue::need(stamp.bytes())
    }

    /// Lists files besides model and images that a plan of the project depends on, existing or not.
    fn named_files(&self, project: &Path) -> Vec<PathBuf> {
        let _ = project;
        Vec::new()
    }

    /// True if all files of the project's plan still exist.
    fn has_plan(&self, project: &Path) -> bool {
        let _ = project;
        true
    }

    /// Plans the project and writes the plan, unless the existing one is current.
    fn plan(&self, job: &Job) -> Outcome;

    /// Measures the finished depth maps of the project's plan.
    fn follow(&self, job: &Job) -> Outcome;

    /// Drops all caches of a project that is gone.
    fn forget(&self, project: &Path) {
        let _ = project;
    }
}

/// Runs a job and returns its outcome. A panic fails only this project.
pub(super) fn outcome_of(planner: &dyn Planner, work: Work, job: &Job) -> Outcome {
    let act = || match work {
        Work::Plan => planner.plan(job),
        Work::Follow => planner.follow(job),
    };
    // Safe, since the caches are consistent between any two statements (see `lock`).
    catch_unwind(AssertUnwindSafe(act)).unwrap_or_else(|_| Outcome::Failed {
        reason: "internal error; see the log".into(),
        hint: Some("run `viewrank plan` on it and report its output".into()),
    })
}
