//! The seam to the file system: each call that changes something passes here, and a test can make each fail.

use std::{
    fs::{self, File},
    io::{self, Read, Write},
    path::Path,
};

use super::{OutputError, open};

/// A change of the file system.
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

/// The file system. `before` is asked ahead of each change and may refuse it; the program's own disk refuses nothing.
pub struct Disk<'a> {
    before: &'a (dyn Fn(Operation, &Path) -> io::Result<()> + Sync),
}

impl Disk<'static> {
    pub const REAL: Self = Self { before: &|_, _| Ok(()) };
}

impl<'a> Disk<'a> {
    /// A disk on which `before` decides whether a change takes place: for tests of what a failure leaves behind.
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

    /// Makes one folder; one that is there already is fine.
    pub(super) fn make_folder(&self, path: &Path) -> Result<(), OutputError> {
        if path.is_dir() {
            return Ok(());
        }
        self.change(Operation::MakeFolder, path, || {
            fs::create_dir(path).or_else(|e| if path.is_dir() { Ok(()) } else { Err(e) })
        })
    }

    /// Makes a folder where nothing is.
    pub(super) fn make_new_folder(&self, path: &Path) -> Result<(), OutputError> {
        self.change(Operation::MakeFolder, path, || fs::create_dir(path))
    }

    /// Opens a lock file and waits for its lock, which ends with the file or the process.
    pub(super) fn lock(&self, path: &Path) -> Result<File, OutputError> {
        self.before(Operation::Create, path)?;
        let file = open::lock_file(path)?;
        file.lock().map(|()| file).map_err(|error| OutputError::new(path, error))
    }

    /// Writes a new file and syncs it, 1 MiB at a time.
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

    /// A second name for the file `from` (a symbolic link is not followed).
    pub(super) fn hard_link(&self, from: &Path, to: &Path) -> Result<(), OutputError> {
        self.change(Operation::Link, to, || fs::hard_link(from, to))
    }

    pub(super) fn symbolic_link(&self, target: &Path, at: &Path) -> Result<(), OutputError> {
        self.change(Operation::Link, at, || make_symbolic_link(target, at))
    }

    /// Puts `from` in the place of `to`; `Ok(false)` where `from` is gone.
    pub(super) fn rename(&self, from: &Path, to: &Path) -> Result<bool, OutputError> {
        if fs::symlink_metadata(from).is_err() {
            return Ok(false);
        }
        self.change(Operation::Rename, to, || fs::rename(from, to)).map(|()| true)
    }

    /// Removes a file or a link; one that is gone already is fine.
    pub(super) fn remove(&self, path: &Path) -> Result<(), OutputError> {
        if fs::symlink_metadata(path).is_err() {
            return Ok(());
        }
        self.change(Operation::Remove, path, || fs::remove_file(path))
    }

    /// Removes a folder if it is there and empty.
    pub(super) fn remove_empty_folder(&self, path: &Path) -> Result<(), OutputError> {
        let empty = fs::read_dir(path).is_ok_and(|mut entries| entries.next().is_none());
        if empty { self.change(Operation::RemoveFolder, path, || fs::remove_dir(path)) } else { Ok(()) }
    }

    /// Removes a folder of files.
    pub(super) fn remove_folder(&self, path: &Path) -> Result<(), OutputError> {
        if fs::symlink_metadata(path).is_err() {
            return Ok(());
        }
        self.change(Operation::RemoveFolder, path, || fs::remove_dir_all(path))
    }

    /// Makes the names in a folder durable.
    pub(super) fn sync_folder(&self, path: &Path) -> Result<(), OutputError> {
        self.change(Operation::Sync, path, || match File::open(path)?.sync_all() {
            // Some network file systems cannot sync a folder; they order its changes themselves.
            Err(error) if error.kind() == io::ErrorKind::InvalidInput => Ok(()),
            done => done,
        })
    }
}

fn create_new(path: &Path, executable: bool) -> io::Result<File> {
    let mut options = File::options();
    options.write(true).create_new(true);
    #[cfg(unix)]
    if executable {
        use std::os::unix::fs::OpenOptionsExt;
        options.mode(0o777);
    }
    let _ = executable;
    options.open(path)
}

#[cfg(unix)]
fn make_symbolic_link(target: &Path, at: &Path) -> io::Result<()> {
    std::os::unix::fs::symlink(target, at)
}

#[cfg(windows)]
fn make_symbolic_link(target: &Path, at: &Path) -> io::Result<()> {
    std::os::windows::fs::symlink_file(target, at)
}
