//! `viewrank watch`: plans each project when its sparse model is complete, and follows the backend.
//!
//! [`discover`] finds projects, [`watch`] hints at changes, [`settle`] says whether the input is still and new, [`state`] is what is
//! known of a project, [`queue`] bounds the work, [`run`] is the loop, `job` plans one project with the same
//! functions as `viewrank plan`, `maps` says which depth maps are there, [`follow`] measures them.

pub mod discover;
pub mod follow;
mod job;
mod kept;
mod maps;
pub mod platform;
pub mod queue;
pub mod run;
pub mod settle;
pub mod state;
mod status;
pub mod watch;

use std::{
    fmt,
    path::{Path, PathBuf},
    time::Duration,
};

pub use job::{Job, PlanJob, PlanOptions, Planner};
pub use run::{Signal, watch_roots};
pub use status::{Line, read_status, status_file};

use crate::{base::error::Hint, io::output::OutputError};

/// How `viewrank watch` works.
#[derive(Clone, Debug)]
pub struct Options {
    pub roots: Vec<PathBuf>,
    /// A model is complete when its files have been still for so long.
    pub settle: Duration,
    /// Look at all folders so often instead of waiting for events; `None`: only on network file systems.
    pub poll: Option<Duration>,
    /// A full look at everything, for what events lost.
    pub rescan: Duration,
    pub on_busy: state::OnBusy,
    pub jobs: usize,
    /// Bytes of memory that all plans together may need.
    pub max_memory: u64,
    pub follow_links: bool,
    /// End when every project is planned or can't be.
    pub once: bool,
    /// Prometheus text file.
    pub metrics: Option<PathBuf>,
}

/// What stops the daemon; everything else concerns one project and is told in the status.
#[derive(Debug, thiserror::Error)]
pub enum DaemonError {
    #[error("{}: {source}", path.display())]
    Root { path: PathBuf, source: std::io::Error },
    #[error("{} is already watched by {holder}", path.display())]
    Held { path: PathBuf, holder: String },
    #[error("the metrics cannot be written: {0}")]
    Metrics(OutputError),
    #[error(transparent)]
    Output(#[from] OutputError),
}

impl Hint for DaemonError {
    fn hint(&self) -> Option<String> {
        match self {
            Self::Root { .. } => Some("give a folder that may be read and written".into()),
            Self::Held { .. } => Some("use that daemon (`viewrank status` shows it), or stop it first".into()),
            Self::Metrics(_) => Some("give a file in a folder that may be written to".into()),
            Self::Output(error) => error.hint(),
        }
    }

    fn is_usage(&self) -> bool {
        matches!(self, Self::Metrics(_))
    }
}

/// A path for people: on one line, whatever its name is.
pub struct Shown<'a>(pub &'a Path);

impl fmt::Display for Shown<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.to_string_lossy().chars().try_for_each(|c| match c {
            c if c.is_control() => write!(f, "{}", c.escape_default()),
            c => write!(f, "{c}"),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_with_a_line_break_stays_on_its_line() {
        assert_eq!(Shown(Path::new("/a b/c\nd\x1b[2Jé")).to_string(), "/a b/c\\nd\\u{1b}[2Jé");
    }
}
