//! `viewrank watch`: plans each project when its sparse model is complete, and follows the backend.
//!
//! [`run`] is the main loop. [`watch`] reports file-system events, [`discover`] finds projects,
//! [`settle`] detects input that is still and new, `maps` lists depth maps, [`state`] is the state
//! machine of a project with its [`phase`], [`queue`] limits the work, `job` plans one project with
//! the same functions as `viewrank plan`, `worker` does that in a process of its own,
//! `planned_from` records its input, [`follow`] measures depth maps, `status` writes the status
//! files, [`platform`] contains the differences between operating systems.

pub mod discover;
pub mod follow;
pub mod foreground;
mod job;
mod kept;
mod maps;
pub mod phase;
mod planned_from;
mod planner;
pub mod platform;
pub mod queue;
pub mod run;
pub mod settle;
pub mod state;
mod status;
pub mod watch;
mod worker;

use std::{path::PathBuf, time::Duration};

pub use job::{PlanJob, PlanOptions, PlanWhen};
pub use planner::{Job, Planner};
pub use run::{Signal, watch_roots};
pub use status::{Line, read_status, status_file};
pub use worker::{Workers, serve};

use crate::{
    base::error::{Advice, Hint},
    io::output::OutputError,
};

/// Options of `viewrank watch`.
#[derive(Clone, Debug)]
pub struct WatchOptions {
    pub roots: Vec<PathBuf>,
    /// A model is complete when its files have not changed for this time.
    pub settle: Duration,
    /// Interval of scanning all folders instead of waiting for events; `None`: scan only network
    /// file systems that way.
    pub poll: Option<Duration>,
    /// Interval of full scans that make up for lost events.
    pub rescan: Duration,
    pub on_busy: state::OnBusy,
    pub jobs: usize,
    /// Memory limit in bytes of all running plans together.
    pub max_memory: u64,
    pub follow_links: bool,
    /// Exit when every project is planned or has failed.
    pub once: bool,
    /// Prometheus text file to write.
    pub metrics: Option<PathBuf>,
}

/// Errors that stop the daemon. All others concern one project and appear in the status.
#[derive(Debug, thiserror::Error)]
pub enum DaemonError {
    #[error("cannot watch {}: {source}", path.display())]
    Root {
        path: PathBuf,
        source: std::io::Error,
    },
    #[error("{} is already watched by {holder}", path.display())]
    Held { path: PathBuf, holder: String },
    #[error("cannot write metrics: {0}")]
    Metrics(OutputError),
    #[error(transparent)]
    Output(#[from] OutputError),
}

impl Hint for DaemonError {
    fn hint(&self) -> Option<Advice> {
        match self {
            Self::Root { source, .. } if source.kind() == std::io::ErrorKind::NotFound => Some(
                "name a folder that exists: the one that holds the projects, or a project itself"
                    .into(),
            ),
            Self::Root { .. } => Some("choose a folder that you may read and write".into()),
            Self::Held { .. } => {
                Some("use that daemon (see `viewrank status`), or stop it first".into())
            }
            Self::Metrics(_) => Some("choose a file in a folder that you may write to".into()),
            Self::Output(error) => error.hint(),
        }
    }

    fn is_usage(&self) -> bool {
        matches!(self, Self::Metrics(_))
    }
}
