//! The journal of a change, and the root that it is made in.
//!
//! Step `i` of the journal has its new file in `.staging/i.new` (none: the path is removed) and a
//! link to the old file in `.staging/i.old` (none: the path was free). Every step is idempotent, so
//! a crash while finishing or undoing does no harm; the journal stores which of the two is in
//! progress.

use std::fs::File;

use serde::{Deserialize, Serialize};

use super::{Disk, folder::Folder};
use crate::bounded;

/// Most files or folders of a change.
const MOST: usize = 1 << 20;

pub(super) const FOLDER: &str = "viewrank";
// In the project and not among temporary files: a rename does not cross file systems.
pub(super) const STAGING: &str = "viewrank/.staging";
pub(super) const JOURNAL: &str = "viewrank/.journal.json";

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Direction {
    Finish,
    Undo,
}

/// A change of a set of files; paths relative to the root.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(super) struct Change {
    /// Folders to create, outer before inner.
    #[serde(deserialize_with = "bounded::list::<_, _, MOST>")]
    pub new_folders: Vec<String>,
    #[serde(deserialize_with = "bounded::list::<_, _, MOST>")]
    pub steps: Vec<Step>,
    /// Folders to remove if they are empty by then, inner before outer.
    #[serde(deserialize_with = "bounded::list::<_, _, MOST>")]
    pub old_folders: Vec<String>,
}

/// The change at one path.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Step {
    pub path: String,
    /// Hash of the new file; `None`: the path is removed.
    pub new: Option<String>,
    /// Hash of the old file; `None`: the path was free.
    pub old: Option<String>,
}

#[derive(Serialize, Deserialize)]
pub(super) struct Journal {
    pub direction: Direction,
    /// Identity of the folder in which it was written.
    pub identity: String,
    pub change: Change,
}

/// A locked root folder.
pub(super) struct Root<'a> {
    pub folder: Folder,
    pub disk: &'a Disk<'a>,
    /// Identity of the folder `viewrank`.
    pub identity: String,
    /// Held until the root is dropped.
    pub _lock: File,
}

/// Name of the new or old file of a step.
pub(super) fn staged(step: usize, which: &str) -> String {
    format!("{STAGING}/{step}.{which}")
}
