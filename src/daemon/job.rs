//! One job: plan one project, with the same functions as `viewrank plan`.

use std::{
    path::Path,
    sync::atomic::{AtomicBool, Ordering},
};

use super::{queue, settle::Stamp, state::Outcome};

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

    /// The project is gone.
    fn forget(&self, project: &Path) {
        let _ = project;
    }
}
