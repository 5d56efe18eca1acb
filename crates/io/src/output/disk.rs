//! All changes to the file system, in one place where tests can make each of them fail.

use std::{
    fs::File,
    io::{self, Read, Write},
    path::{Path, PathBuf},
};

use cap_std::fs::OpenOptions;

use super::{
    OutputError,
    folder::{self, Folder},
};
use crate::platform;

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

/// The file system. `before` is called ahead of each change and may refuse it; [`Disk::REAL`]
/// refuses none.
#[derive(Clone, Copy)]
pub struct Disk<'a> {
    before: &'a (dyn Fn(Operation, &Path) -> io::Result<()> + Sync),
    within: &'a [PathBuf],
}

impl Disk<'static> {
    pub const REAL: Self = Self {
        before: &|_, _| Ok(()),
        within: &[],
    };
}

impl<'a> Disk<'a> {
    /// A disk on which `before` can refuse changes, to test failures.
    pub fn guarded(before: &'a (dyn Fn(Operation, &Path) -> io::Result<()> + Sync)) -> Self {
        Self {
            before,
            within: &[],
        }
    }

    /// The same disk for a folder in a folder in … : no link is followed on the way from the first
    /// to the last, nor out of the last. A single one is opened by its path, as the user named it,
    /// the first of several by its resolved one. Paths elsewhere are the user's.
    pub fn within(self, within: &'a [PathBuf]) -> Self {
        Self { within, ..self }
    }

    /// Opens a folder that exists.
    pub(super) fn existing(&self, path: &Path) -> Result<Folder, OutputError> {
        let (base, inner) = self.base(path)?;
        base.folder(inner)
    }

    /// Opens a folder, after creating it and its missing ancestors.
    pub(super) fn make(&self, path: &Path) -> Result<Folder, OutputError> {
        // A single folder is opened by its path, so it must exist before `base` is called.
        if let [home] = self.within {
            let (base, inner) = named_by_user(home)?;
            self.make_folders(&base, &inner)?;
        }
        let (base, inner) = self.base(path)?;
        self.make_folders(&base, &inner)?;
        base.folder(inner)
    }

    /// Opens the folder from which the path is resolved; returns the rest of the path, too.
    fn base(&self, path: &Path) -> Result<(Folder, PathBuf), OutputError> {
        let Some((outermost, others)) = self.within.split_first() else {
            return named_by_user(path);
        };
        if self
            .within
            .iter()
            .any(|outer| folder::below(outer, path).is_none())
        {
            return named_by_user(path);
        }
        if others.is_empty() {
            return Ok((
                Folder::open(outermost)?,
                folder::below(outermost, path).unwrap_or_default(),
            ));
        }
        let (mut base, mut at) = (Folder::open_resolved(outermost)?, outermost);
        for inner in others {
            base = base.folder_without_links(folder::below(at, inner).unwrap_or_default())?;
            at = inner;
        }
        Ok((base, folder::below(at, path).unwrap_or_default()))
    }

    fn change<T>(
        &self,
        operation: Operation,
        (folder, name): (&Folder, &Path),
        act: impl FnOnce() -> io::Result<T>,
    ) -> Result<T, OutputError> {
        self.before(operation, &folder.path(name))?;
        act().map_err(|error| folder.failed(name, error))
    }

    fn before(&self, operation: Operation, path: &Path) -> Result<(), OutputError> {
        (self.before)(operation, path).map_err(|error| OutputError::new(path, error))
    }

    fn make_folders(&self, base: &Folder, path: &Path) -> Result<(), OutputError> {
        let mut folders: Vec<&Path> = path
            .ancestors()
            .filter(|folder| !folder.as_os_str().is_empty())
            .collect();
        folders.reverse();
        folders
            .into_iter()
            .try_for_each(|folder| self.make_folder(base, folder))
    }

    /// Creates one folder; no error if it exists.
    pub(super) fn make_folder(
        &self,
        folder: &Folder,
        name: impl AsRef<Path>,
    ) -> Result<(), OutputError> {
        let name = name.as_ref();
        match folder.folder(name) {
            Err(error) if error.is_missing() => {}
            found => return found.map(drop),
        }
        self.change(Operation::MakeFolder, (folder, name), || {
            // Another process may have created it since the check above.
            folder.dir.create_dir(name).or_else(|e| {
                if folder.folder(name).is_ok() {
                    Ok(())
                } else {
                    Err(e)
                }
            })
        })
    }

    /// Creates one folder; an error if the name exists.
    pub(super) fn make_new_folder(&self, folder: &Folder, name: &str) -> Result<(), OutputError> {
        self.change(Operation::MakeFolder, (folder, name.as_ref()), || {
            folder.dir.create_dir(name)
        })
    }

    /// Opens a lock file and waits for its lock, which is released when the file is dropped or the
    /// process ends.
    pub(super) fn lock(&self, folder: &Folder, name: &str) -> Result<File, OutputError> {
        self.before(Operation::Create, &folder.path(name))?;
        let file = folder.lock_file(name)?;
        file.lock()
            .map(|()| file)
            .map_err(|error| folder.failed(name.as_ref(), error))
    }

    /// Writes a new file in blocks of 1 MiB and syncs it.
    pub(super) fn write_new(
        &self,
        folder: &Folder,
        name: &str,
        mut contents: impl Read,
        executable: bool,
    ) -> Result<(), OutputError> {
        let at = (folder, name.as_ref());
        let mut file = self.change(Operation::Create, at, || {
            create_new(folder, name, executable)
        })?;
        let mut block = vec![0; 1 << 20];
        loop {
            let length = contents
                .read(&mut block)
                .map_err(|error| folder.failed(at.1, error))?;
            if length == 0 {
                break;
            }
            self.change(Operation::Write, at, || file.write_all(&block[..length]))?;
        }
        // A journal must name only files whose contents are on the disk, and some file systems find
        // out only here that they are full.
        self.change(Operation::Sync, at, || file.sync_all())
    }

    /// Creates a hard link for the file `from`; doesn't follow a symbolic link.
    pub(super) fn hard_link(
        &self,
        from: (&Folder, &Path),
        to: (&Folder, &str),
    ) -> Result<(), OutputError> {
        let (folder, name) = to;
        self.change(Operation::Link, (folder, name.as_ref()), || {
            from.0.dir.hard_link(from.1, &folder.dir, name)
        })
    }

    pub(super) fn symbolic_link(
        &self,
        target: &Path,
        folder: &Folder,
        name: &str,
    ) -> Result<(), OutputError> {
        self.change(Operation::Link, (folder, name.as_ref()), || {
            platform::link_file(target, &folder.dir, name)
        })
    }

    /// Renames `from` to `to`, replacing it; `Ok(false)` if `from` doesn't exist.
    pub(super) fn rename(
        &self,
        folder: &Folder,
        from: &str,
        to: &str,
    ) -> Result<bool, OutputError> {
        // After a crash, the step may be done already.
        if folder.find(from)?.is_none() {
            return Ok(false);
        }
        let rename = || folder.dir.rename(from, &folder.dir, to);
        self.change(Operation::Rename, (folder, to.as_ref()), rename)
            .map(|()| true)
    }

    /// Waits until the contents of a file are on the disk.
    pub(super) fn sync(&self, folder: &Folder, name: &str) -> Result<(), OutputError> {
        let file = folder.file(name)?;
        self.change(Operation::Sync, (folder, name.as_ref()), || file.sync_all())
    }

    /// Renames a file to a name in another folder, replacing what is there.
    pub(super) fn rename_to(
        &self,
        from: (&Folder, &str),
        (folder, name): (&Folder, &str),
    ) -> Result<(), OutputError> {
        self.change(Operation::Rename, (folder, name.as_ref()), || {
            from.0.dir.rename(from.1, &folder.dir, name)
        })
    }

    /// Removes a file or a link; no error if it doesn't exist.
    pub(super) fn remove(&self, folder: &Folder, name: &str) -> Result<(), OutputError> {
        let remove = || folder.dir.remove_file(name);
        self.remove_found(Operation::Remove, (folder, name), remove)
    }

    fn remove_found(
        &self,
        operation: Operation,
        (folder, name): (&Folder, &str),
        remove: impl FnOnce() -> io::Result<()>,
    ) -> Result<(), OutputError> {
        match folder.find(name)? {
            Some(_) => self.change(operation, (folder, name.as_ref()), remove),
            None => Ok(()),
        }
    }

    /// Removes a folder if it exists and is empty.
    pub(super) fn remove_empty_folder(
        &self,
        folder: &Folder,
        name: &str,
    ) -> Result<(), OutputError> {
        let is_empty = folder
            .names(name)
            .is_ok_and(|mut names| names.next().is_none());
        let remove = || folder.dir.remove_dir(name);
        if is_empty {
            self.change(Operation::RemoveFolder, (folder, name.as_ref()), remove)
        } else {
            Ok(())
        }
    }

    /// Removes a folder with its contents; no error if it doesn't exist.
    pub(super) fn remove_folder(&self, folder: &Folder, name: &str) -> Result<(), OutputError> {
        let remove = || folder.dir.remove_dir_all(name);
        self.remove_found(Operation::RemoveFolder, (folder, name), remove)
    }

    /// Syncs the directory entries of a folder.
    pub(super) fn sync_folder(
        &self,
        folder: &Folder,
        name: impl AsRef<Path>,
    ) -> Result<(), OutputError> {
        let name = name.as_ref();
        self.change(Operation::Sync, (folder, name), || {
            match platform::sync_folder(&folder.dir, folder::self_if_empty(name)) {
                // Some network file systems cannot sync a folder, but keep its changes in order.
                Err(error) if error.kind() == io::ErrorKind::InvalidInput => Ok(()),
                done => done,
            }
        })
    }
}

/// Opens the nearest existing folder of a path, through links; returns the rest of the path, too.
fn named_by_user(path: &Path) -> Result<(Folder, PathBuf), OutputError> {
    let path = std::path::absolute(path).map_err(|error| OutputError::new(path, error))?;
    let there = path
        .ancestors()
        .find(|above| above.exists())
        .unwrap_or(&path);
    let inner = path
        .strip_prefix(there)
        .map(Path::to_path_buf)
        .unwrap_or_default();
    Ok((Folder::open(there)?, inner))
}

fn create_new(folder: &Folder, name: &str, executable: bool) -> io::Result<File> {
    let mut options = OpenOptions::new();
    // Never into an existing file: it may be a link, or have another name among the user's files.
    options.write(true).create_new(true);
    if executable {
        platform::make_executable(&mut options);
    }
    folder
        .dir
        .open_with(name, &options)
        .map(cap_std::fs::File::into_std)
}
