//! Journalled changes: staged, journalled, renamed into place; completed or undone after a crash, undone after a failure.
//!
//! Step `i` of the journal has its new file in `.staging/i.new` (none: the path is removed) and a link to the old file in `.staging/i.old`
//! (none: the path was free). Every step is idempotent, so a crash while finishing or undoing does no harm; the journal stores which of the two
//! is in progress.
//!
//! The journal of an earlier process is carried out only if it was written in this folder (`identity.rs`) and each file that it would replace or
//! remove has the hash from before or after the change. Otherwise the journal and its staged files are set aside, and no file is touched
//! (`found.rs`).

use std::{
    collections::BTreeSet,
    fs::File,
    path::{Path, PathBuf},
};

use serde::{Deserialize, Serialize};

use super::{Disk, FileSet, OutputError, WriteReport, found, identity::identity, open::check_links, staging};

pub(super) const FOLDER: &str = "viewrank";
pub(super) const STAGING: &str = "viewrank/.staging";
pub(super) const JOURNAL: &str = "viewrank/.journal.json";
const LOCK: &str = "viewrank/.lock";

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
    pub new_folders: Vec<String>,
    pub steps: Vec<Step>,
    /// Folders to remove if they are empty by then, inner before outer.
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
    /// Canonical path.
    pub path: PathBuf,
    pub disk: &'a Disk<'a>,
    /// Identity of the folder `viewrank`.
    pub identity: String,
    _lock: File,
}

/// Writes the sets of one root.
pub(super) fn write(path: &Path, sets: &[&FileSet], disk: &Disk) -> Result<Vec<WriteReport>, OutputError> {
    let root = Root::open(path, disk)?;
    root.settle()?;
    let staged = root.make_staging().and_then(|()| staging::stage(&root, sets));
    let (change, written) = staged.inspect_err(|_| root.clear_staging())?;
    if change.steps.is_empty() && change.new_folders.is_empty() && change.old_folders.is_empty() {
        root.clear_staging();
    } else {
        root.carry_out(change)?;
    }
    Ok(written)
}

pub(super) fn recover(root: &Path, disk: &Disk) -> Result<(), OutputError> {
    let has_journal = is_there(&root.join(JOURNAL));
    if !has_journal && !is_there(&root.join(STAGING)) {
        return Ok(());
    }
    let settled = Root::open(root, disk).and_then(|root| root.settle());
    // Staged files without a journal do no harm, so an error in removing them is ignored.
    if has_journal { settled } else { Ok(()) }
}

impl<'a> Root<'a> {
    /// Creates the folder if necessary and waits for its lock.
    fn open(path: &Path, disk: &'a Disk<'a>) -> Result<Self, OutputError> {
        let failed = |error| OutputError::new(path, error);
        make_folders(&std::path::absolute(path).map_err(failed)?, disk)?;
        let path = dunce::canonicalize(path).map_err(failed)?;
        check_links(&path, LOCK)?;
        disk.make_folder(&path.join(FOLDER))?;
        let lock = disk.lock(&path.join(LOCK))?;
        let identity = identity(&path.join(FOLDER)).map_err(|error| OutputError::new(&path.join(FOLDER), error))?;
        Ok(Self { path, disk, identity, _lock: lock })
    }

    /// Path of a file of the set, after checking the folders above it.
    pub fn locate(&self, path: &str) -> Result<PathBuf, OutputError> {
        check_links(&self.path, path)
    }

    pub fn staging(&self) -> PathBuf {
        self.path.join(STAGING)
    }

    pub fn staged(&self, step: usize, which: &str) -> PathBuf {
        self.staging().join(format!("{step}.{which}"))
    }

    fn make_staging(&self) -> Result<(), OutputError> {
        self.disk.make_new_folder(&self.staging())
    }

    /// Removes the staged files. Errors are ignored: the set is complete, and the next run removes the rest.
    fn clear_staging(&self) {
        let _ = self.disk.remove_folder(&self.staging());
    }

    /// Completes or undoes the change of an earlier process.
    fn settle(&self) -> Result<(), OutputError> {
        if let Some(journal) = found::journal(self)? {
            match journal.direction {
                Direction::Finish => self.finish(&journal.change)?,
                Direction::Undo => self.undo(&journal.change)?,
            }
        }
        self.disk.remove_folder(&self.staging())
    }

    fn carry_out(&self, change: Change) -> Result<(), OutputError> {
        let mut journal = Journal { direction: Direction::Finish, identity: self.identity.clone(), change };
        if let Err(failure) = self.write_journal(&journal)
            && !is_there(&self.path.join(JOURNAL))
        {
            self.clear_staging();
            return Err(failure);
        }
        let done = self.finish(&journal.change).map_err(|failure| {
            journal.direction = Direction::Undo;
            match self.write_journal(&journal).and_then(|()| self.undo(&journal.change)) {
                Ok(()) => failure,
                Err(undoing) => OutputError::Interrupted { failure: failure.into(), undoing: undoing.into() },
            }
        });
        if !matches!(done, Err(OutputError::Interrupted { .. })) {
            self.clear_staging();
        }
        done
    }

    /// Writes the journal: from now on the change will be completed or undone, even if this process is killed.
    fn write_journal(&self, journal: &Journal) -> Result<(), OutputError> {
        let draft = self.staging().join(match journal.direction {
            Direction::Finish => "finish",
            Direction::Undo => "undo",
        });
        let text = serde_json::to_vec(journal).expect("strings and booleans are JSON");
        self.disk.write_new(&draft, text.as_slice(), false)?;
        self.disk.sync_folder(&self.staging())?;
        self.disk.rename(&draft, &self.path.join(JOURNAL))?;
        self.disk.sync_folder(&self.path.join(FOLDER))
    }

    fn finish(&self, change: &Change) -> Result<(), OutputError> {
        for folder in &change.new_folders {
            self.disk.make_folder(&self.locate(folder)?)?;
        }
        for (i, step) in change.steps.iter().enumerate() {
            let target = self.locate(&step.path)?;
            if step.new.is_some() {
                self.disk.rename(&self.staged(i, "new"), &target)?;
            } else {
                self.disk.remove(&target)?;
            }
        }
        for folder in &change.old_folders {
            self.disk.remove_empty_folder(&self.locate(folder)?)?;
        }
        self.close(change)
    }

    fn undo(&self, change: &Change) -> Result<(), OutputError> {
        for folder in change.old_folders.iter().rev() {
            self.disk.make_folder(&self.locate(folder)?)?;
        }
        for (i, step) in change.steps.iter().enumerate().rev() {
            let target = self.locate(&step.path)?;
            if step.old.is_some() {
                self.disk.rename(&self.staged(i, "old"), &target)?;
            } else if step.new.is_some() && !is_there(&self.staged(i, "new")) {
                self.disk.remove(&target)?;
            }
        }
        for folder in change.new_folders.iter().rev() {
            self.disk.remove_empty_folder(&self.locate(folder)?)?;
        }
        self.close(change)
    }

    /// Syncs the changed folders, then removes the journal.
    fn close(&self, change: &Change) -> Result<(), OutputError> {
        let paths = change.steps.iter().map(|s| &s.path).chain(&change.new_folders).chain(&change.old_folders);
        let parents: BTreeSet<PathBuf> =
            paths.filter_map(|p| Some(self.path.join(p).parent()?.to_path_buf())).collect();
        for folder in parents.iter().filter(|folder| folder.is_dir()) {
            self.disk.sync_folder(folder)?;
        }
        self.disk.remove(&self.path.join(JOURNAL))?;
        self.disk.sync_folder(&self.path.join(FOLDER))
    }
}

pub(super) fn make_folders(path: &Path, disk: &Disk) -> Result<(), OutputError> {
    if path.is_file() {
        return Err(OutputError::InTheWay { path: path.to_path_buf(), folder: false });
    }
    if let Some(parent) = path.parent().filter(|_| !path.is_dir()) {
        make_folders(parent, disk)?;
    }
    disk.make_folder(path)
}

/// Returns whether the path exists, even as a broken link.
pub(super) fn is_there(path: &Path) -> bool {
    path.symlink_metadata().is_ok()
}
