//! All changes to the file system, in one place where tests can make each of them fail.

use std::{
    fs::{self, File},
    io::{self, Read, Write},
    path::Path,
};

use super::{OutputError, open};
use crate::base::platform;

/// A kind of change to the file system.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Operation {
    MakeFolder,
    Create,
    Write,
    Sync,
    Link,
    Rename,
    Remove,
    RemoveFolder,
}

/// The file system. `before` is called ahead of each change and may refuse it; [`Disk::REAL`] refuses none.
pub struct Disk<'a> {
    before: &'a (dyn Fn(Operation, &Path) -> io::Result<()> + Sync),
}

impl Disk<'static> {
    pub const REAL: Self = Self { before: &|_, _| Ok(()) };
}

impl<'a> Disk<'a> {
    /// A disk on which `before` can refuse changes, to test failures.
    pub fn guarded(before: &'a (dyn Fn(Operation, &Path) -> io::Result<()> + Sync)) -> Self {
        Self { before }
    }

    fn change<T>(
        &self,
        operation: Operation,
        path: &Path,
        act: impl FnOnce() -> io::Result<T>,
    ) -> Result<T, OutputError> {
        self.before(operation, path)?;
        act().map_err(|error| OutputError::new(path, error))
    }

    fn before(&self, operation: Operation, path: &Path) -> Result<(), OutputError> {
        (self.before)(operation, path).map_err(|error| OutputError::new(path, error))
    }

    /// Creates one folder; no error if it exists.
    pub(super) fn make_folder(&self, path: &Path) -> Result<(), OutputError> {
        if path.is_dir() {
            return Ok(());
        }
        self.change(Operation::MakeFolder, path, || {
            fs::create_dir(path).or_else(|e| if path.is_dir() { Ok(()) } else { Err(e) })
        })
    }

    /// Creates one folder; an error if the path exists.
    pub(super) fn make_new_folder(&self, path: &Path) -> Result<(), OutputError> {
        self.change(Operation::MakeFolder, path, || fs::create_dir(path))
    }

    /// Opens a lock file and waits for its lock, which is released when the file is dropped or the process ends.
    pub(super) fn lock(&self, path: &Path) -> Result<File, OutputError> {
        self.before(Operation::Create, path)?;
        let file = open::lock_file(path)?;
        file.lock().map(|()| file).map_err(|error| OutputError::new(path, error))
    }

    /// Writes a new file in blocks of 1 MiB and syncs it.
    pub(super) fn write_new(&self, path: &Path, mut contents: impl Read, executable: bool) -> Result<(), OutputError> {
        let mut file = self.change(Operation::Create, path, || create_new(path, executable))?;
        let mut block = vec![0; 1 << 20];
        loop {
            let length = contents.read(&mut block).map_err(|error| OutputError::new(path, error))?;
            if length == 0 {
                break;
            }
            self.change(Operation::Write, path, || file.write_all(&block[..length]))?;
        }
        self.change(Operation::Sync, path, || file.sync_all())
    }

    /// Creates a hard link `to` for the file `from`; doesn't follow a symbolic link.
    pub(super) fn hard_link(&self, from: &Path, to: &Path) -> Result<(), OutputError> {
        self.change(Operation::Link, to, || fs::hard_link(from, to))
    }

    pub(super) fn symbolic_link(&self, target: &Path, at: &Path) -> Result<(), OutputError> {
        self.change(Operation::Link, at, || platform::link_file(target, at))
    }

    /// Renames `from` to `to`, replacing it; `Ok(false)` if `from` doesn't exist.
    pub(super) fn rename(&self, from: &Path, to: &Path) -> Result<bool, OutputError> {
        if fs::symlink_metadata(from).is_err() {
            return Ok(false);
        }
        self.change(Operation::Rename, to, || fs::rename(from, to)).map(|()| true)
    }

    /// Removes a file or a link; no error if it doesn't exist.
    pub(super) fn remove(&self, path: &Path) -> Result<(), OutputError> {
        if fs::symlink_metadata(path).is_err() {
            return Ok(());
        }
        self.change(Operation::Remove, path, || fs::remove_file(path))
    }

    /// Removes a folder if it exists and is empty.
    pub(super) fn remove_empty_folder(&self, path: &Path) -> Result<(), OutputError> {
        let empty = fs::read_dir(path).is_ok_and(|mut entries| entries.next().is_none());
        if empty { self.change(Operation::RemoveFolder, path, || fs::remove_dir(path)) } else { Ok(()) }
    }

    /// Removes a folder with its contents; no error if it doesn't exist.
    pub(super) fn remove_folder(&self, path: &Path) -> Result<(), OutputError> {
        if fs::symlink_metadata(path).is_err() {
            return Ok(());
        }
        self.change(Operation::RemoveFolder, path, || fs::remove_dir_all(path))
    }

    /// Syncs the directory entries of a folder.
    pub(super) fn sync_folder(&self, path: &Path) -> Result<(), OutputError> {
        self.change(Operation::Sync, path, || match platform::sync_folder(path) {
            // Some network file systems cannot sync a folder, but keep its changes in order.
            Err(error) if error.kind() == io::ErrorKind::InvalidInput => Ok(()),
            done => done,
        })
    }
}

fn create_new(path: &Path, executable: bool) -> io::Result<File> {
    let mut options = File::options();
    options.write(true).create_new(true);
    if executable {
        platform::make_executable(&mut options);
    }
    options.open(path)
}
