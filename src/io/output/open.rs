//! The way to every file of ours: locks, journals, records, the manifest, the status and their like.
//!
//! A project may come from a stranger. So a path is followed only while it stays below its root, and only a regular file is
//! opened: no symbolic link, whose target would be emptied or read in our name, and no pipe, which would be waited for. Links
//! inside the root are fine on the way to a file (`viewrank -> outputs`), and so is a root that is itself reached through links.
//!
//! Who may write below the root at the same instant can still exchange a folder between the look and the opening; such a
//! person needs no help from us to do harm there.

use std::{
    fs::{self, File, Metadata, OpenOptions},
    io,
    path::{Path, PathBuf},
};

use super::OutputError;
use crate::base::input::{self, FileKind};

/// `root/name` without symbolic links in `root`, if no folder on the way is a link out of it or a file.
pub fn own_path(root: &Path, name: &str) -> Result<PathBuf, OutputError> {
    let real = root.canonicalize().map_err(|error| OutputError::new(root, error))?;
    check_links(&real, name)
}

/// Opens a file of ours for reading.
///
/// # Errors
/// [`OutputError::Io`] with `NotFound` where it isn't there, [`OutputError::Escapes`], [`OutputError::Foreign`].
pub fn open_own(root: &Path, name: &str) -> Result<File, OutputError> {
    let path = root.join(name);
    // Most of those that are asked for in a walk aren't there.
    fs::symlink_metadata(&path).map_err(|error| OutputError::new(&path, error))?;
    regular_file(&own_path(root, name)?, File::options().read(true))
}

/// The bytes of a file of ours; errors as of [`open_own`], and where it is larger than any that we write.
pub fn read_own(root: &Path, name: &str) -> Result<Vec<u8>, OutputError> {
    let file = open_own(root, name)?;
    input::read_all(file, FileKind::State).map_err(|error| OutputError::new(&root.join(name), error))
}

/// Opens the lock file at `path`, which may be new; what is in it stays.
pub(super) fn lock_file(path: &Path) -> Result<File, OutputError> {
    regular_file(path, File::options().read(true).write(true).create(true).truncate(false))
}

/// Opens `path` itself for reading, if it is a regular file.
pub(super) fn existing(path: &Path) -> io::Result<File> {
    regular_file(path, File::options().read(true)).map_err(|error| match error {
        OutputError::Io { source, .. } | OutputError::Denied { source, .. } => source,
        error => io::Error::new(io::ErrorKind::InvalidInput, error.to_string()),
    })
}

/// Opens `path` itself, never what it links to and never anything that could be waited for.
fn regular_file(path: &Path, options: &mut OpenOptions) -> Result<File, OutputError> {
    let foreign = |found: &Metadata| OutputError::Foreign { path: path.into(), what: kind(found) };
    let before = fs::symlink_metadata(path).ok();
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::custom_flags(options, libc::O_NOFOLLOW | libc::O_NONBLOCK);
    #[cfg(not(unix))]
    if let Some(found) = before.as_ref().filter(|found| !found.is_file()) {
        return Err(foreign(found));
    }
    let file = options.open(path).map_err(|error| match before.filter(|found| !found.is_file()) {
        Some(found) => foreign(&found),
        None => OutputError::new(path, error),
    })?;
    let found = file.metadata().map_err(|error| OutputError::new(path, error))?;
    if found.is_file() { Ok(file) } else { Err(foreign(&found)) }
}

pub(super) fn kind(found: &Metadata) -> &'static str {
    match () {
        () if found.is_symlink() => "a symbolic link",
        () if found.is_dir() => "a folder",
        () => "a pipe or a device",
    }
}

/// `root/path`, if no folder on the way is a symbolic link out of the root or a file.
pub(super) fn check_links(root: &Path, path: &str) -> Result<PathBuf, OutputError> {
    let mut at = root.to_path_buf();
    let mut parts = path.split('/').peekable();
    while let Some(part) = parts.next() {
        at.push(part);
        let (Some(_), Ok(found)) = (parts.peek(), fs::symlink_metadata(&at)) else { continue };
        if found.is_symlink() && !at.canonicalize().is_ok_and(|target| target.starts_with(root)) {
            return Err(OutputError::Escapes { path: at, root: root.to_path_buf() });
        }
        if !at.is_dir() {
            return Err(OutputError::InTheWay { path: at, folder: false });
        }
    }
    Ok(at)
}
