//! Progress and cancellation of a running stage. Terminal bars are in `cli/`, state files in
//! `daemon/`.

use std::sync::atomic::{AtomicU64, Ordering};

use super::error::{Advice, Hint};

/// The stages of a plan, in the order in which they run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Stage {
    Read,
    Surface,
    Visibility,
    Confidence,
    Partners,
    Pilot,
    Ranking,
    Evaluate,
    Undistort,
    Train,
    Write,
}

/// Receives progress and can cancel the run. Called from several threads at once.
pub trait Watcher: Sync {
    /// `done` of `total` steps of the stage are finished; a stage starts with 0 and ends with `done
    /// == total`.
    fn progress(&self, stage: Stage, done: u64, total: u64);

    /// Returns whether to stop. Stages ask at least every 50 ms and then return [`Cancelled`].
    fn cancelled(&self) -> bool {
        false
    }

    /// Bytes of memory beyond which the run fails; `None`: no limit. Unlike the limit of the
    /// settings, it never changes how the run computes.
    fn most_memory(&self) -> Option<u64> {
        None
    }

    /// `Err` when cancelled, for use with `?`.
    fn check(&self) -> Result<(), Cancelled> {
        if self.cancelled() {
            Err(Cancelled)
        } else {
            Ok(())
        }
    }
}

/// Counts the steps of a stage, which several threads finish, and reports each.
pub struct StepCounter<'a> {
    watcher: &'a dyn Watcher,
    stage: Stage,
    done: AtomicU64,
    total: u64,
}

impl<'a> StepCounter<'a> {
    /// Reports the start of the stage.
    pub fn start(watcher: &'a dyn Watcher, stage: Stage, total: usize) -> Self {
        let total = total as u64;
        watcher.progress(stage, 0, total);
        Self {
            watcher,
            stage,
            done: AtomicU64::new(0),
            total,
        }
    }

    /// Takes a step unless the run is cancelled.
    pub fn run<T>(&self, step: impl FnOnce() -> T) -> Result<T, Cancelled> {
        self.watcher.check()?;
        let result = step();
        let done = 1 + self.done.fetch_add(1, Ordering::Relaxed);
        self.watcher.progress(self.stage, done, self.total);
        Ok(result)
    }

    /// Reports the end: the report of another step may have come after that of the last.
    pub fn end(self) {
        self.watcher.progress(self.stage, self.total, self.total);
    }
}

/// The run was stopped by its [`Watcher`]; nothing was written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("cancelled")]
pub struct Cancelled;

impl Hint for Cancelled {
    fn hint(&self) -> Option<Advice> {
        None
    }
}

/// Watches nothing and never cancels.
pub struct NoWatcher;

impl Watcher for NoWatcher {
    fn progress(&self, _: Stage, _: u64, _: u64) {}
}
