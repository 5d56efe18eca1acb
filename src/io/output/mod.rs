//! Whole-or-nothing sets of files: everything that viewrank writes goes through here.
//!
//! A set may have many files in many folders. It is staged in `viewrank/.staging` (`staging.rs`), synced, announced by a journal, moved into
//! place by renames, and the journal removed (`transaction.rs`). Killed before the journal stands, nothing has happened; killed
//! after, the next [`FileSet::write`] or [`recover`] finishes the work; a change that fails is undone. A record of each set
//! (`record.rs`) says which files are ours, by path and content hash: what a later set of the same name no longer has is
//! removed, a file of somebody else's that stands in the way is kept beside as `NAME.before-viewrank`, and nothing else is
//! touched. Journals and records are believed where they were written and nowhere else (`identity.rs`): those of a copy, or that a
//! stranger put there, remove nothing and replace nothing outside of `viewrank/`. Files of ours are opened by `open.rs`. No name and no symbolic link leads out of the set's root.

mod disk;
mod found;
mod identity;
mod open;
mod record;
mod staging;
mod transaction;

use std::{
    collections::BTreeMap,
    io,
    path::{Component, Path, PathBuf},
};

pub use disk::{Disk, Operation};
pub(crate) use open::{open_own, own_path, read_own};

use crate::base::error::Hint;

/// What a file is made of.
#[derive(Clone, Debug)]
pub enum Contents {
    Bytes(Vec<u8>),
    /// As `Bytes`, with the executable bit (runner scripts).
    Script(Vec<u8>),
    /// A copy of that file.
    Copy(PathBuf),
    /// A symbolic link to that file (relative where both lie under the root); a copy where links are not to be had.
    Link(PathBuf),
    /// An empty folder.
    Folder,
}

/// Files that appear together or not at all. Paths are relative to `root`, `/` between folders, never absolute, never with `..`.
#[derive(Clone, Debug)]
pub struct FileSet {
    pub root: PathBuf,
    /// Name of the set; an earlier set of the same name under the same root is replaced and its stale files removed.
    pub name: String,
    pub files: BTreeMap<String, Contents>,
}

/// What writing a set did; paths relative to the root.
#[derive(Clone, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct Written {
    /// New or with other contents than before.
    pub changed: Vec<String>,
    /// Files of an earlier set that are gone.
    pub removed: Vec<String>,
    /// Files of somebody else's that were in the way, under the names that they have now.
    pub kept: Vec<String>,
}

impl FileSet {
    pub fn new(root: impl Into<PathBuf>, name: &str) -> Self {
        Self { root: root.into(), name: name.into(), files: BTreeMap::new() }
    }

    pub fn add(&mut self, path: impl Into<String>, contents: Contents) {
        self.files.insert(path.into(), contents);
    }

    pub fn add_text(&mut self, path: impl Into<String>, text: impl Into<String>) {
        self.add(path, Contents::Bytes(text.into().into_bytes()));
    }

    /// Makes the set appear, whole or not at all. Files that are there with the same contents are left as they are.
    pub fn write(&self, disk: &Disk) -> Result<Written, OutputError> {
        let mut written = write_all(std::slice::from_ref(self), disk)?;
        Ok(written.pop().unwrap_or_default())
    }
}

/// Makes all sets appear; those of one root whole or not at all, roots in the reverse of the order in which they come first.
pub fn write_all(sets: &[FileSet], disk: &Disk) -> Result<Vec<Written>, OutputError> {
    sets.iter().flat_map(|set| set.files.keys()).try_for_each(|path| check_name(path))?;
    let mut roots: Vec<&Path> = Vec::new();
    for set in sets {
        if !roots.contains(&set.root.as_path()) {
            roots.push(&set.root);
        }
    }
    let mut written = vec![Written::default(); sets.len()];
    for root in roots.into_iter().rev() {
        let (places, own): (Vec<usize>, Vec<&FileSet>) =
            sets.iter().enumerate().filter(|(_, set)| set.root == root).unzip();
        for (place, done) in places.into_iter().zip(transaction::write(root, &own, disk)?) {
            written[place] = done;
        }
    }
    Ok(written)
}

/// Paths, relative to the root, of the files of all sets below it whose names begin with `prefix`, sorted.
pub fn recorded(root: &Path, prefix: &str) -> Vec<String> {
    record::Records::read(root).paths(prefix)
}

/// Finishes or undoes the set that a killed run left half in place under `root`, and clears what it staged; for those who read what was
/// written.
pub fn recover(root: &Path, disk: &Disk) -> Result<(), OutputError> {
    transaction::recover(root, disk)
}

/// Is `path` a new file in a folder that is there? What a user names on the command line may be a file of theirs.
///
/// # Errors
/// [`OutputError::InTheWay`], and where there is no such folder.
pub fn refuse_to_replace(path: &Path) -> Result<(), OutputError> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    match (path.symlink_metadata(), folder.metadata()) {
        (Ok(found), _) => Err(OutputError::InTheWay { path: path.into(), folder: found.is_dir() }),
        (_, Err(source)) => Err(OutputError::new(folder, source)),
        _ => Ok(()),
    }
}

/// Can files be made in `folder` or, while it isn't there, in the nearest folder above it? Asked before long work; leaves nothing behind.
pub fn refuse_unwritable(folder: &Path) -> Result<(), OutputError> {
    let absolute = std::path::absolute(folder).unwrap_or_else(|_| folder.to_path_buf());
    let there = absolute.ancestors().find(|above| above.exists()).unwrap_or(&absolute);
    tempfile::tempfile_in(there).map(drop).map_err(|source| OutputError::new(there, source))
}

/// Puts one file in place of another in one step: for files that are ours alone and change often (a status, a log of progress).
pub fn replace(path: &Path, bytes: &[u8], disk: &Disk) -> Result<(), OutputError> {
    let name = path.file_name().ok_or_else(|| OutputError::Name { name: path.display().to_string() })?;
    let draft = path.with_file_name(format!(".{}.new", name.to_string_lossy()));
    // A killed run may have left its draft.
    disk.remove(&draft)?;
    let written = disk.write_new(&draft, bytes, false).and_then(|()| disk.rename(&draft, path));
    written.map(|_| ()).inspect_err(|_| _ = disk.remove(&draft))
}

/// Takes one such file away; it may be gone already.
pub fn remove(path: &Path, disk: &Disk) -> Result<(), OutputError> {
    disk.remove(path)
}

/// Makes a folder and those above it.
pub fn make_folder(path: &Path, disk: &Disk) -> Result<(), OutputError> {
    transaction::make_folders(path, disk)
}

/// Makes the folder `viewrank` below a root.
///
/// # Errors
/// [`OutputError::Escapes`] where it is a link out of the root.
pub(crate) fn make_own_folder(root: &Path, disk: &Disk) -> Result<(), OutputError> {
    let inside = own_path(root, "viewrank/any")?;
    disk.make_folder(inside.parent().unwrap_or(root))
}

/// Opens a file that we lock, makes it if need be; neither locked nor changed yet. The folder must be there.
pub(crate) fn open_lock(root: &Path, name: &str) -> Result<std::fs::File, OutputError> {
    open::lock_file(&own_path(root, name)?)
}

/// A name is a path of plain components below the root, written the one way that there is.
fn check_name(name: &str) -> Result<(), OutputError> {
    let plain = Path::new(name).components().all(|part| matches!(part, Component::Normal(_)));
    let canonical = name.split('/').all(|part| !part.is_empty() && part != "." && !part.contains('\0'));
    if plain && canonical { Ok(()) } else { Err(OutputError::Name { name: name.into() }) }
}

/// Why a set could not be written; the files of before are in place unless it is [`OutputError::Interrupted`].
#[derive(Debug, thiserror::Error)]
pub enum OutputError {
    #[error("\"{name}\" is no name for a file below the output folder")]
    Name { name: String },
    #[error("{}: a symbolic link leads out of {}", path.display(), root.display())]
    Escapes { path: PathBuf, root: PathBuf },
    #[error("{}: {what} in the place of a file of viewrank's own", path.display())]
    Foreign { path: PathBuf, what: &'static str },
    #[error("{}: {} is in the way", path.display(), if *folder { "a folder" } else { "a file" })]
    InTheWay { path: PathBuf, folder: bool },
    #[error("{}: not on the same file system as {}", path.display(), staging.display())]
    OtherFileSystem { path: PathBuf, staging: PathBuf },
    #[error("{}: no space left", path.display())]
    Full { path: PathBuf },
    #[error("{}: not permitted ({source})", path.display())]
    Denied { path: PathBuf, source: io::Error },
    #[error("{}: {source}", path.display())]
    Io { path: PathBuf, source: io::Error },
    #[error("{}: {why}", path.display())]
    Journal { path: PathBuf, why: String },
    #[error("{failure}; putting the earlier files back failed as well: {undoing}")]
    Interrupted { failure: Box<OutputError>, undoing: Box<OutputError> },
}

impl OutputError {
    fn new(path: &Path, source: io::Error) -> Self {
        let path = path.to_path_buf();
        match source.kind() {
            io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => Self::Full { path },
            io::ErrorKind::PermissionDenied | io::ErrorKind::ReadOnlyFilesystem => Self::Denied { path, source },
            _ => Self::Io { path, source },
        }
    }
}

impl Hint for OutputError {
    fn hint(&self) -> Option<String> {
        Some(match self {
            Self::Name { .. } => {
                "rename the image in the model: names are relative, without \"..\" and empty parts".into()
            }
            Self::Escapes { .. } => "replace the link by a folder".into(),
            Self::Foreign { .. } => "move it away: viewrank makes its own".into(),
            Self::InTheWay { .. } => "move it away, or name another".into(),
            Self::OtherFileSystem { .. } => "write to a folder of one file system with --out".into(),
            Self::Full { .. } => "make room on that disk; nothing was changed".into(),
            Self::Denied { .. } => "get write permission there, or work on a copy; nothing was changed".into(),
            Self::Io { .. } => "see that the disk is there and in order; nothing was changed".into(),
            Self::Journal { .. } => {
                "run again, which goes on without it; what was staged is kept beside it in .staging.refused-N".into()
            }
            Self::Interrupted { .. } => "mend the cause and run again: that puts a whole set in place".into(),
        })
    }
}
