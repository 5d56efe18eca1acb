//! Opens viewrank's own files: locks, journals, records, the manifest, the status and so on.
//!
//! Projects may be untrusted. A path is therefore followed only while it stays below its root, and only regular files are opened: not symbolic
//! links, whose target would be truncated or read with the user's permissions, and not pipes, which would block. Folders on the path may be links
//! inside the root (`viewrank -> outputs`), and the root itself may be reached through links.
//!
//! A process with write access below the root can still exchange a folder between the check and the opening; it could do the same harm without
//! viewrank.

use std::{
    fs::{self, File, Metadata, OpenOptions},
    io,
    path::{Path, PathBuf},
};

use super::OutputError;
use crate::base::{
    input::{self, FileKind},
    platform,
};

/// Returns `root/name` with the symbolic links of `root` resolved.
///
/// # Errors
/// If a folder on the path is a link out of the root, or a file.
pub fn own_path(root: &Path, name: &str) -> Result<PathBuf, OutputError> {
    let real = dunce::canonicalize(root).map_err(|error| OutputError::new(root, error))?;
    check_links(&real, name)
}

/// Opens one of viewrank's files for reading.
///
/// # Errors
/// [`OutputError::Io`] with `NotFound` if it doesn't exist, [`OutputError::Escapes`], [`OutputError::Foreign`].
pub fn open_own(root: &Path, name: &str) -> Result<File, OutputError> {
    let path = root.join(name);
    // Fast path: most files that a scan of a folder tree asks for don't exist.
    fs::symlink_metadata(&path).map_err(|error| OutputError::new(&path, error))?;
    regular_file(&own_path(root, name)?, File::options().read(true))
}

/// Reads one of viewrank's files.
///
/// # Errors
/// As [`open_own`], and if the file is larger than any that viewrank writes.
pub fn read_own(root: &Path, name: &str) -> Result<Vec<u8>, OutputError> {
    let file = open_own(root, name)?;
    input::read_all(file, FileKind::State).map_err(|error| OutputError::new(&root.join(name), error))
}

/// Opens the lock file at `path`, creating it if necessary, without truncating it.
pub(super) fn lock_file(path: &Path) -> Result<File, OutputError> {
    regular_file(path, File::options().read(true).write(true).create(true).truncate(false))
}

/// Opens `path` for reading if it is a regular file.
pub(super) fn existing(path: &Path) -> io::Result<File> {
    regular_file(path, File::options().read(true)).map_err(|error| match error {
        OutputError::Io { source, .. } | OutputError::Denied { source, .. } => source,
        error => io::Error::new(io::ErrorKind::InvalidInput, error.to_string()),
    })
}

/// Opens a regular file; never follows a link at `path` and never blocks on a pipe.
fn regular_file(path: &Path, options: &mut OpenOptions) -> Result<File, OutputError> {
    let foreign = |found: &Metadata| OutputError::Foreign { path: path.into(), what: kind(found) };
    let before = fs::symlink_metadata(path).ok();
    platform::refuse_links(options);
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

/// Returns `root/path` after checking that no folder on the path is a file or a symbolic link out of the root.
pub(super) fn check_links(root: &Path, path: &str) -> Result<PathBuf, OutputError> {
    let mut at = root.to_path_buf();
    let mut parts = path.split('/').peekable();
    while let Some(part) = parts.next() {
        at.push(part);
        let (Some(_), Ok(found)) = (parts.peek(), fs::symlink_metadata(&at)) else { continue };
        refuse_link_out(root, &at, &found)?;
        if !at.is_dir() {
            return Err(OutputError::InTheWay { path: at, folder: false });
        }
    }
    Ok(at)
}

fn refuse_link_out(root: &Path, at: &Path, found: &Metadata) -> Result<(), OutputError> {
    // Of long paths, Windows has one form only.
    let stays = || Ok::<_, io::Error>(at.canonicalize()?.starts_with(root.canonicalize()?));
    if found.is_symlink() && !stays().unwrap_or(false) {
        return Err(OutputError::Escapes { path: at.into(), root: root.into() });
    }
    Ok(())
}

/// Checks that a folder whose path lies below `root` lies there through all links. Files written to it as a root of their own are checked
/// from there on only.
///
/// # Errors
/// [`OutputError::Escapes`] if a link on the way leads out of `root`.
pub fn refuse_to_leave(root: &Path, folder: &Path) -> Result<(), OutputError> {
    let absolute = |path: &Path| std::path::absolute(path).unwrap_or_else(|_| path.to_path_buf());
    let (mut at, folder) = (absolute(root), absolute(folder));
    let Ok(inner) = folder.strip_prefix(&at) else { return Ok(()) };
    let root = at.clone();
    for part in inner.components() {
        at.push(part);
        if let Ok(found) = fs::symlink_metadata(&at) {
            refuse_link_out(&root, &at, &found)?;
        }
    }
    Ok(())
}

/// Returns whether a folder on the path is a symbolic link.
pub(super) fn has_links(root: &Path, path: &str) -> bool {
    let is_link = |folder: &str| fs::symlink_metadata(root.join(folder)).is_ok_and(|found| found.is_symlink());
    path.match_indices('/').any(|(end, _)| is_link(&path[..end]))
}
