//! Progress and cancellation of a running stage. Terminal bars are in `cli/`, state files in
//! `daemon/`.

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
