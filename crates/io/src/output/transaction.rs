//! Journalled changes: staged, journalled, renamed into place; completed or undone after a crash,
//! undone after a failure.
//!
//! The journal of an earlier process is carried out only if it was written in this folder
//! (`identity.rs`) and each file that it would replace or remove has the hash from before or after
//! the change. Otherwise the journal and its staged files are set aside, and no file is touched
//! (`found.rs`).

use std::{collections::BTreeSet, path::Path};

use super::{
    Disk, FileSet, OutputError, WriteReport, found,
    identity::identity,
    journal::{Change, Direction, FOLDER, JOURNAL, Journal, Root, STAGING, staged},
    staging,
};

const LOCK: &str = "viewrank/.lock";

/// Writes the sets of one root.
pub(super) fn write(
    path: &Path,
    sets: &[&FileSet],
    disk: &Disk,
) -> Result<Vec<WriteReport>, OutputError> {
    let root = Root::open(path, disk)?;
    // First an earlier process's unfinished change, whose staging folder is in the way.
    root.settle()?;
    let staged = root
        .make_staging()
        .and_then(|()| staging::stage(&root, sets));
    let (change, written) = staged.inspect_err(|_| root.clear_staging())?;
    if change.steps.is_empty() && change.new_folders.is_empty() && change.old_folders.is_empty() {
        root.clear_staging();
    } else {
        root.carry_out(change)?;
    }
    Ok(written)
}

pub(super) fn recover(root: &Path, disk: &Disk) -> Result<(), OutputError> {
    // Opening the root would create `viewrank` and its lock in a project that is only read.
    let is_there = |name: &str| root.join(name).symlink_metadata().is_ok();
    let has_journal = is_there(JOURNAL);
    if !has_journal && !is_there(STAGING) {
        return Ok(());
    }
    let settled = Root::open(root, disk).and_then(|root| root.settle());
    // Staged files without a journal do no harm, so an error in removing them is ignored.
    if has_journal { settled } else { Ok(()) }
}

impl<'a> Root<'a> {
    /// Creates the folder if necessary and waits for its lock.
    fn open(path: &Path, disk: &'a Disk<'a>) -> Result<Self, OutputError> {
        let folder = disk.make(path)?;
        disk.make_folder(&folder, FOLDER)?;
        let lock = disk.lock(&folder, LOCK)?;
        let own = folder.folder(FOLDER)?;
        let identity = identity(&own).map_err(|error| folder.failed(FOLDER.as_ref(), error))?;
        Ok(Self {
            folder,
            disk,
            identity,
            _lock: lock,
        })
    }

    fn make_staging(&self) -> Result<(), OutputError> {
        self.disk.make_new_folder(&self.folder, STAGING)
    }

    /// Removes the staged files. Errors are ignored: the set is complete, and the next run removes
    /// the rest.
    fn clear_staging(&self) {
        let _ = self.disk.remove_folder(&self.folder, STAGING);
    }

    /// Completes or undoes the change of an earlier process.
    fn settle(&self) -> Result<(), OutputError> {
        // Without a journal, what is staged is of a process that ended before its change began.
        if let Some(journal) = found::journal(self)? {
            match journal.direction {
                Direction::Finish => self.finish(&journal.change)?,
                Direction::Undo => self.undo(&journal.change)?,
            }
        }
        self.disk.remove_folder(&self.folder, STAGING)
    }

    fn carry_out(&self, change: Change) -> Result<(), OutputError> {
        let mut journal = Journal {
            direction: Direction::Finish,
            identity: self.identity.clone(),
            change,
        };
        // If only the last sync failed, the journal is in place, and the next process would carry
        // it out: the change goes on.
        if let Err(failure) = self.write_journal(&journal)
            && matches!(self.folder.find(JOURNAL), Ok(None))
        {
            self.clear_staging();
            return Err(failure);
        }
        // This may fail on Windows, where a file that another program holds open cannot be
        // replaced.
        let done = self.finish(&journal.change).map_err(|failure| {
            // Written before the first file goes back: half an undone change cannot be completed.
            journal.direction = Direction::Undo;
            match self
                .write_journal(&journal)
                .and_then(|()| self.undo(&journal.change))
            {
                Ok(()) => failure,
                Err(undoing) => OutputError::Interrupted {
                    failure: failure.into(),
                    undoing: undoing.into(),
                },
            }
        });
        // After a failed undo, the staged files may be the only copies.
        if !matches!(done, Err(OutputError::Interrupted { .. })) {
            self.clear_staging();
        }
        done
    }

    /// Writes the journal: from now on the change will be completed or undone, even if this process
    /// is killed.
    fn write_journal(&self, journal: &Journal) -> Result<(), OutputError> {
        let draft = match journal.direction {
            Direction::Finish => format!("{STAGING}/finish"),
            Direction::Undo => format!("{STAGING}/undo"),
        };
        let text = serde_json::to_vec(journal).expect("strings and booleans are JSON");
        self.disk
            .write_new(&self.folder, &draft, text.as_slice(), false)?;
        // The names of the staged files must be on the disk before the journal that relies on them.
        self.disk.sync_folder(&self.folder, STAGING)?;
        self.disk.rename(&self.folder, &draft, JOURNAL)?;
        self.disk.sync_folder(&self.folder, FOLDER)
    }

    fn finish(&self, change: &Change) -> Result<(), OutputError> {
        for folder in &change.new_folders {
            self.disk.make_folder(&self.folder, folder)?;
        }
        for (i, step) in change.steps.iter().enumerate() {
            if step.new.is_some() {
                self.disk
                    .rename(&self.folder, &staged(i, "new"), &step.path)?;
            } else {
                self.disk.remove(&self.folder, &step.path)?;
            }
        }
        for folder in &change.old_folders {
            self.disk.remove_empty_folder(&self.folder, folder)?;
        }
        self.close(change)
    }

    fn undo(&self, change: &Change) -> Result<(), OutputError> {
        // In reverse, outer folders come before inner ones.
        for folder in change.old_folders.iter().rev() {
            self.disk.make_folder(&self.folder, folder)?;
        }
        // Several steps may have changed one file: the last of them is undone first.
        for (i, step) in change.steps.iter().enumerate().rev() {
            if step.old.is_some() {
                self.disk
                    .rename(&self.folder, &staged(i, "old"), &step.path)?;
            } else if step.new.is_some() && self.folder.find(staged(i, "new"))?.is_none() {
                // The new file has left the staging folder, so it is what has the path.
                self.disk.remove(&self.folder, &step.path)?;
            }
        }
        for folder in change.new_folders.iter().rev() {
            self.disk.remove_empty_folder(&self.folder, folder)?;
        }
        self.close(change)
    }

    /// Syncs the changed folders, then removes the journal.
    fn close(&self, change: &Change) -> Result<(), OutputError> {
        let paths = change
            .steps
            .iter()
            .map(|s| &s.path)
            .chain(&change.new_folders)
            .chain(&change.old_folders);
        let parents: BTreeSet<&Path> = paths.filter_map(|path| Path::new(path).parent()).collect();
        for folder in parents
            .into_iter()
            .filter(|folder| self.folder.folder(folder).is_ok())
        {
            self.disk.sync_folder(&self.folder, folder)?;
        }
        // Last: after a power failure, the journal completes renames that were not on the disk yet.
        self.disk.remove(&self.folder, JOURNAL)?;
        self.disk.sync_folder(&self.folder, FOLDER)
    }
}
