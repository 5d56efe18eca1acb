//! Open folders, through which all output is written.
//!
//! Projects may be untrusted, and somebody with write access to one may exchange its folders for
//! links while viewrank writes. A folder is therefore held open, names are resolved from it and
//! beneath it, and each file is made, renamed and removed in the open folder that holds it:
//! `openat2` with RESOLVE_BENEATH on Linux, elsewhere and on old kernels one component at a time
//! without links (cap-std). On Windows, where renames and hard links go by path, the open folders
//! cannot be renamed meanwhile.
//!
//! The path that a user names is followed through links. Folders below it may be relative links
//! that stay there (`viewrank -> outputs`); an absolute one counts as leading out. Only regular
//! files are opened: not symbolic links, whose target would be truncated or read with the user's
//! permissions, and not pipes, which would block.

use std::{
    ffi::OsString,
    fs::{self, File},
    io,
    path::{Component, Path, PathBuf},
};

use cap_fs_ext::{
    DirExt, FollowSymlinks, OpenOptionsFollowExt, OpenOptionsMaybeDirExt, OpenOptionsSyncExt,
};
use cap_std::{
    ambient_authority,
    fs::{self as cap_fs, Dir, Metadata, OpenOptions},
};

use super::{OutputError, contents::has_bytes};
use crate::{
    input::{self, FileKind},
    paths::absolute,
};

/// An open folder, whatever becomes of its path. Names are relative to it.
#[derive(Debug)]
pub struct Folder {
    /// For messages.
    path: PathBuf,
    pub(super) dir: Dir,
}

impl Folder {
    /// Opens a folder by a path that the user named, through links.
    pub fn open(path: &Path) -> Result<Self, OutputError> {
        let opened = Dir::open_ambient_dir(path, ambient_authority());
        opened
            .map(|dir| Self {
                path: path.into(),
                dir,
            })
            .map_err(|error| match error.kind() {
                io::ErrorKind::NotADirectory => OutputError::InTheWay {
                    path: path.into(),
                    folder: false,
                },
                _ => OutputError::new(path, error),
            })
    }

    /// Opens a folder by the path that it had when its links were resolved, so that it is no link
    /// itself: who may write in the folder above may have put one in its place.
    ///
    /// # Errors
    /// [`OutputError::Foreign`] for a link.
    pub fn open_resolved(path: &Path) -> Result<Self, OutputError> {
        let mut options = OpenOptions::new();
        options
            .read(true)
            .follow(FollowSymlinks::No)
            .maybe_dir(true);
        // Opening a pipe in its place would block.
        if cfg!(unix) {
            options.nonblock(true);
        }
        let opened = cap_fs::File::open_ambient_with(path, &options, ambient_authority());
        match opened.and_then(|file| Ok((file.metadata()?, file))) {
            Ok((found, file)) if found.is_dir() => Ok(Self {
                path: path.into(),
                dir: Dir::from_std_file(file.into_std()),
            }),
            Ok(_) => Err(OutputError::InTheWay {
                path: path.into(),
                folder: false,
            }),
            Err(_) if path.is_symlink() => Err(OutputError::Foreign {
                path: path.into(),
                what: "a symbolic link",
            }),
            Err(error) => Err(OutputError::new(path, error)),
        }
    }

    /// Opens a folder below this one; the empty name is this folder.
    ///
    /// # Errors
    /// [`OutputError::Escapes`], [`OutputError::InTheWay`] for a file, [`OutputError::Io`] with
    /// `NotFound`.
    pub fn folder(&self, name: impl AsRef<Path>) -> Result<Self, OutputError> {
        let name = name.as_ref();
        let dir = self
            .dir
            .open_dir(self_if_empty(name))
            .map_err(|error| self.failed(name, error))?;
        Ok(Self {
            path: self.path(name),
            dir,
        })
    }

    /// As [`Self::folder`], but follows no link at all.
    ///
    /// # Errors
    /// [`OutputError::Foreign`] for a link.
    pub fn folder_without_links(&self, name: impl AsRef<Path>) -> Result<Self, OutputError> {
        let mut at = self.folder("")?;
        // Part by part: only the last part of a path can be opened without following links.
        for part in name.as_ref() {
            let dir = at
                .dir
                .open_dir_nofollow(part)
                .map_err(|error| match at.find(part) {
                    Ok(Some(found)) if found.is_symlink() => at.foreign(part, &found),
                    _ => at.failed(part.as_ref(), error),
                })?;
            at = Self {
                path: at.path(part),
                dir,
            };
        }
        Ok(at)
    }

    pub fn path(&self, name: impl AsRef<Path>) -> PathBuf {
        if name.as_ref().as_os_str().is_empty() {
            self.path.clone()
        } else {
            self.path.join(name)
        }
    }

    /// Metadata of this folder itself.
    pub(super) fn metadata(&self) -> io::Result<fs::Metadata> {
        self.dir.try_clone()?.into_std_file().metadata()
    }

    /// Metadata of a file, a folder or a link, which is not followed; `None` if there is nothing.
    pub(super) fn find(&self, name: impl AsRef<Path>) -> Result<Option<Metadata>, OutputError> {
        match self.dir.symlink_metadata(&name) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            found => found
                .map(Some)
                .map_err(|error| self.failed(name.as_ref(), error)),
        }
    }

    /// Returns whether there is something of that name, even a broken link.
    pub(super) fn has(&self, name: impl AsRef<Path>) -> bool {
        matches!(self.find(name), Ok(Some(_)))
    }

    /// Returns whether a folder on the way to the name is a symbolic link.
    pub(super) fn has_links(&self, name: &str) -> bool {
        let is_link =
            |folder: &str| matches!(self.find(folder), Ok(Some(found)) if found.is_symlink());
        name.match_indices('/')
            .any(|(end, _)| is_link(&name[..end]))
    }

    /// Names in a folder below this one.
    pub(super) fn names(&self, folder: &str) -> io::Result<impl Iterator<Item = OsString>> {
        Ok(self
            .dir
            .read_dir(folder)?
            .flatten()
            .map(|entry| entry.file_name()))
    }

    /// Target of a symbolic link.
    pub(super) fn link(&self, name: &str) -> Result<PathBuf, OutputError> {
        self.dir
            .read_link_contents(name)
            .map_err(|error| self.failed(name.as_ref(), error))
    }

    /// Opens a regular file for reading.
    pub(super) fn file(&self, name: &str) -> Result<File, OutputError> {
        self.regular_file(name, OpenOptions::new().read(true))
    }

    /// Opens a lock file, creating it if necessary; doesn't lock or change it.
    pub fn lock_file(&self, name: &str) -> Result<File, OutputError> {
        self.regular_file(name, OpenOptions::new().read(true).write(true).create(true))
    }

    /// Opens a regular file; never follows a link in its place and never blocks on a pipe.
    fn regular_file(&self, name: &str, options: &mut OpenOptions) -> Result<File, OutputError> {
        let before = self
            .find(name)
            .ok()
            .flatten()
            .filter(|found| !found.is_file());
        options.follow(FollowSymlinks::No);
        // Where an open cannot be kept from blocking (Windows), look at what is there first.
        if cfg!(unix) {
            options.nonblock(true);
        } else if let Some(found) = before {
            return Err(self.foreign(name, &found));
        }
        let file = self
            .dir
            .open_with(name, options)
            .map_err(|error| match &before {
                Some(found) => self.foreign(name, found),
                None => self.failed(name.as_ref(), error),
            })?;
        // Of the open file: the name may have been given to another since `before`.
        let found = file
            .metadata()
            .map_err(|error| self.failed(name.as_ref(), error))?;
        if found.is_file() {
            Ok(file.into_std())
        } else {
            Err(self.foreign(name, &found))
        }
    }

    pub(super) fn foreign(&self, name: impl AsRef<Path>, found: &Metadata) -> OutputError {
        let what = match () {
            () if found.is_symlink() => "a symbolic link",
            () if found.is_dir() => "a folder",
            () => "a pipe or a device",
        };
        OutputError::Foreign {
            path: self.path(name),
            what,
        }
    }

    /// The error of an access to a name: where a link on the way leads out, or a file is in the
    /// place of a folder, the first one.
    pub(super) fn failed(&self, name: &Path, error: io::Error) -> OutputError {
        // Links are followed here, since it is through one of them that the way leads out.
        let first = |is: &dyn Fn(io::Result<Metadata>) -> bool| {
            let parts: Vec<&Path> = name.ancestors().collect();
            let mut parts = parts
                .into_iter()
                .rev()
                .filter(|part| part != &Path::new(""));
            self.path(
                parts
                    .find(|part| is(self.dir.metadata(part)))
                    .unwrap_or(name),
            )
        };
        match error.kind() {
            _ if leads_out(&error) => OutputError::Escapes {
                path: first(&|found| found.is_err_and(|error| leads_out(&error))),
                root: self.path.clone(),
            },
            io::ErrorKind::NotADirectory => OutputError::InTheWay {
                path: first(&|found| found.is_ok_and(|found| !found.is_dir())),
                folder: false,
            },
            _ => OutputError::new(&self.path(name), error),
        }
    }
}

pub(super) fn self_if_empty(name: &Path) -> &Path {
    if name.as_os_str().is_empty() {
        Path::new(".")
    } else {
        name
    }
}

/// Returns whether cap-std refused to resolve a path; a refusal of the system has a number.
fn leads_out(error: &io::Error) -> bool {
    error.kind() == io::ErrorKind::PermissionDenied && error.raw_os_error().is_none()
}

/// Opens one of viewrank's files for reading.
///
/// # Errors
/// [`OutputError::Io`] with `NotFound` if it doesn't exist, [`OutputError::Escapes`],
/// [`OutputError::Foreign`].
pub fn open_own(root: &Path, name: &str) -> Result<File, OutputError> {
    Folder::open(root)?.file(name)
}

/// Reads one of viewrank's files.
///
/// # Errors
/// As [`open_own`], and if the file is larger than any of its kind.
pub fn read_own(root: &Path, name: &str, kind: FileKind) -> Result<Vec<u8>, OutputError> {
    let file = open_own(root, name)?;
    input::read_all(file, kind).map_err(|error| OutputError::new(&root.join(name), error))
}

/// Returns whether one of viewrank's files has these contents, whatever their length.
///
/// # Errors
/// As [`open_own`], and if the file cannot be read.
pub fn is_own(root: &Path, name: &str, bytes: &[u8]) -> Result<bool, OutputError> {
    let file = open_own(root, name)?;
    has_bytes(&file, bytes).map_err(|error| OutputError::new(&root.join(name), error))
}

/// Checks that a folder whose path is below `root` is there through all links, before work whose
/// results go there.
///
/// # Errors
/// [`OutputError::Escapes`] if a link on the way leads out of `root`.
pub fn refuse_to_leave(root: &Path, folder: &Path) -> Result<(), OutputError> {
    let Some(inner) = below(root, folder) else {
        return Ok(());
    };
    match Folder::open(root).and_then(|root| root.folder(inner)) {
        Err(error @ OutputError::Escapes { .. }) => Err(error),
        _ => Ok(()),
    }
}

/// The path relative to `root`, whatever links there are; `None` if it isn't below it, or has a
/// `..`.
pub fn below(root: &Path, path: &Path) -> Option<PathBuf> {
    let inner = absolute(path)
        .strip_prefix(absolute(root))
        .ok()?
        .to_path_buf();
    inner
        .components()
        .all(|part| matches!(part, Component::Normal(_)))
        .then_some(inner)
}
