//! Atomic writes of sets of files; all output of viewrank goes through this module.
//!
//! - A set may have many files in many folders. It is staged in `viewrank/.staging` (`staging.rs`)
//!   and synced; then a journal is written, the files are renamed into place, and the journal is
//!   removed (`transaction.rs`).
//! - A process killed before the journal exists has changed nothing; one killed later leaves a
//!   journal that the next [`FileSet::write`] or [`recover`] completes. A change that fails is
//!   undone.
//! - A record of each set (`record.rs`) lists viewrank's files by path and content hash. Files that
//!   a later set of the same name lacks are removed; a user's file at the path of a new one is kept
//!   as `NAME.before-viewrank`; no other file is touched.
//! - Journals and records are valid only in the folder in which they were written (`identity.rs`):
//!   a copied or planted one removes and replaces nothing outside `viewrank/`.
//! - All of it happens in open folders (`folder.rs`): neither a name nor a symbolic link can lead
//!   out of the set's root, nor can somebody who exchanges folders meanwhile.

mod contents;
mod disk;
mod folder;
mod found;
mod identity;
mod journal;
mod record;
mod staging;
mod transaction;

use std::{
    collections::BTreeMap,
    io,
    path::{Component, Path, PathBuf},
};

use viewrank_core::base::error::{Advice, Hint};

pub use disk::{Disk, Operation};
pub use folder::{Folder, below, is_own, open_own, read_own, refuse_to_leave};

use crate::{packed::Packed, paths};

/// Contents of an entry of a [`FileSet`].
#[derive(Clone, Debug)]
pub enum Contents {
    Bytes(Vec<u8>),
    /// `head`, then the rows of tables, which may be larger than memory.
    Table {
        head: Vec<u8>,
        rows: Packed,
    },
    /// As `Bytes`, with the executable bit set (runner scripts).
    Script(Vec<u8>),
    /// A copy of this file.
    Copy(PathBuf),
    /// A symbolic link to this file, relative if both are below the root; where the file system has
    /// no links, a copy of a file that is in the `folder`, also by its links: a stranger's link may
    /// lead to any file of the user's.
    Link {
        file: PathBuf,
        folder: PathBuf,
    },
    /// An empty folder.
    Folder,
}

/// Files that are written together or not at all. Paths are relative to `root`, with `/` between
/// folders and without `..`.
#[derive(Clone, Debug)]
pub struct FileSet {
    pub root: PathBuf,
    /// Name of the set; it replaces an earlier set of the same name below the same root, whose
    /// stale files are removed.
    pub name: String,
    // By path, so that the steps of a change have one order.
    pub files: BTreeMap<String, Contents>,
    /// True for results that can be made again: where the disk is full, or a fault is in their
    /// folders, [`write_all`] writes the other sets without them.
    pub is_spare: bool,
}

/// Changes made by writing a set; paths relative to the root.
#[derive(Clone, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct WriteReport {
    /// New files, and files with new contents.
    pub changed: Vec<String>,
    /// Files of an earlier set that were removed.
    pub removed: Vec<String>,
    /// New names of the user's files that were in the way.
    pub kept: Vec<String>,
    /// Why a spare set was not written.
    #[serde(skip)]
    pub failed: Option<String>,
}

impl FileSet {
    pub fn new(root: impl Into<PathBuf>, name: &str) -> Self {
        Self {
            root: root.into(),
            name: name.into(),
            files: BTreeMap::new(),
            is_spare: false,
        }
    }

    pub fn add(&mut self, path: impl Into<String>, contents: Contents) {
        self.files.insert(path.into(), contents);
    }

    pub fn add_text(&mut self, path: impl Into<String>, text: impl Into<String>) {
        self.add(path, Contents::Bytes(text.into().into_bytes()));
    }

    pub fn add_script(&mut self, path: impl Into<String>, text: impl Into<String>) {
        self.add(path, Contents::Script(text.into().into_bytes()));
    }

    /// Writes the set, completely or not at all. Files that already have their contents are not
    /// touched.
    pub fn write(&self, disk: &Disk) -> Result<WriteReport, OutputError> {
        let mut written = write_all(std::slice::from_ref(self), disk)?;
        Ok(written.pop().unwrap_or_default())
    }
}

/// Writes all sets; those of one root together or not at all, but for spare ones. Roots are written
/// in reverse order of first occurrence.
pub fn write_all(sets: &[FileSet], disk: &Disk) -> Result<Vec<WriteReport>, OutputError> {
    sets.iter()
        .flat_map(|set| set.files.keys())
        .try_for_each(|path| check_name(path))?;
    let mut written = vec![WriteReport::default(); sets.len()];
    // The first set has the daemon's record of the plan, which must not be there before the other
    // files.
    for root in roots(sets).into_iter().rev() {
        write_root(root, sets, disk, &mut written)?;
    }
    Ok(written)
}

/// The roots of sets, by first occurrence.
fn roots(sets: &[FileSet]) -> Vec<&Path> {
    let mut roots: Vec<&Path> = Vec::new();
    for set in sets {
        if !roots.contains(&set.root.as_path()) {
            roots.push(&set.root);
        }
    }
    roots
}

/// Writes the sets of a root together, or, if the change may succeed then, without spare ones.
fn write_root(
    root: &Path,
    sets: &[FileSet],
    disk: &Disk,
    written: &mut [WriteReport],
) -> Result<(), OutputError> {
    let write = |places: &[usize]| {
        let own: Vec<&FileSet> = places.iter().map(|&place| &sets[place]).collect();
        transaction::write(root, &own, disk)
    };
    let all = (0..sets.len()).filter(|&place| sets[place].root == root);
    let all: Vec<usize> = all.collect();
    let (spare, needed): (Vec<usize>, Vec<usize>) =
        all.iter().partition(|&&place| sets[place].is_spare);
    let (places, done) = match write(&all) {
        Err(error) if spare.iter().any(|&place| error.spares(&sets[place])) => {
            for place in spare {
                written[place].failed = Some(error.to_string());
            }
            // From the start: the change that failed was undone.
            let done = write(&needed)?;
            (needed, done)
        }
        done => (all, done?),
    };
    for (place, done) in places.into_iter().zip(done) {
        written[place] = done;
    }
    Ok(())
}

/// Lists the files, below `root`, of all sets whose names begin with `prefix`: paths relative to
/// the root, sorted. The records may be anybody's.
pub fn recorded(root: &Path, prefix: &str) -> Vec<String> {
    Folder::open(root).map_or_else(
        |_| Vec::new(),
        |root| record::Records::read(&root).paths(prefix),
    )
}

/// Completes or undoes the change that a killed process left unfinished below `root`, and removes
/// its staged files; called before reading what was written.
pub fn recover(root: &Path, disk: &Disk) -> Result<(), OutputError> {
    transaction::recover(root, disk)
}

/// Checks that `path` doesn't exist and its folder does, so an output path from the command line
/// can't replace a user's file.
///
/// # Errors
/// [`OutputError::InTheWay`] if `path` exists, [`OutputError::Io`] or [`OutputError::Denied`] if
/// its folder isn't accessible.
pub fn refuse_to_replace(path: &Path) -> Result<(), OutputError> {
    let folder = folder_of(path);
    // A broken link is in the way, too: writing through it would create its target.
    match (path.symlink_metadata(), folder.metadata()) {
        (Ok(found), _) => Err(OutputError::InTheWay {
            path: path.into(),
            folder: found.is_dir(),
        }),
        (_, Err(source)) => Err(OutputError::new(folder, source)),
        _ => Ok(()),
    }
}

/// Checks that files can be created in `folder` or, if it doesn't exist, in its nearest existing
/// ancestor. For early failure before long work; leaves no file behind.
pub fn refuse_unwritable(folder: &Path) -> Result<(), OutputError> {
    let absolute = paths::absolute(folder);
    let there = absolute
        .ancestors()
        .find(|above| above.exists())
        .unwrap_or(&absolute);
    // A real file: permissions say nothing of a file system that is mounted read-only.
    tempfile::tempfile_in(there)
        .map(drop)
        .map_err(|source| OutputError::new(there, source))
}

/// Replaces a file atomically, without a record: for viewrank's own files that change often
/// (status, progress). Its folder must exist.
pub fn replace(path: &Path, bytes: &[u8], disk: &Disk) -> Result<(), OutputError> {
    let (folder, name) = place(path, disk)?;
    replace_in(&folder, &name, bytes, disk)
}

/// As [`replace`], in an open folder.
pub fn replace_in(
    folder: &Folder,
    name: &str,
    bytes: &[u8],
    disk: &Disk,
) -> Result<(), OutputError> {
    let draft = format!(".{name}.new");
    // A killed process may have left its draft.
    disk.remove(folder, &draft)?;
    let written = disk
        .write_new(folder, &draft, bytes, false)
        .and_then(|()| disk.rename(folder, &draft, name));
    written
        .map(|_| ())
        .inspect_err(|_| _ = disk.remove(folder, &draft))
}

/// Removes a file written by [`replace`]; no error if it doesn't exist.
pub fn remove(path: &Path, disk: &Disk) -> Result<(), OutputError> {
    match place(path, disk) {
        Err(error) if error.is_missing() => Ok(()),
        found => found.and_then(|(folder, name)| disk.remove(&folder, &name)),
    }
}

/// Moves a file that a program has finished to its place, where it replaces another.
pub fn rename(from: &Path, to: &Path, disk: &Disk) -> Result<(), OutputError> {
    let (folder, name) = place(from, disk)?;
    let (to_folder, to_name) = place(to, disk)?;
    // A rename may reach the disk before the contents, which a power failure would then lose.
    disk.sync(&folder, &name)?;
    disk.rename_to((&folder, &name), (&to_folder, &to_name))
}

/// Creates a folder in which a program is to work, below a folder that is created if necessary.
///
/// # Errors
/// If there is something of that name.
pub fn make_new_folder(path: &Path, disk: &Disk) -> Result<(), OutputError> {
    make_folder(path.parent().unwrap_or(path), disk)?;
    let (folder, name) = place(path, disk)?;
    disk.make_new_folder(&folder, &name)
}

/// Removes a folder with its contents, through no link; no error if it doesn't exist.
pub fn remove_folder(path: &Path, disk: &Disk) -> Result<(), OutputError> {
    match place(path, disk) {
        Err(error) if error.is_missing() => Ok(()),
        found => found.and_then(|(folder, name)| disk.remove_folder(&folder, &name)),
    }
}

/// Opens the folder of a file.
fn place(path: &Path, disk: &Disk) -> Result<(Folder, String), OutputError> {
    let name = path.file_name().and_then(|name| name.to_str());
    let name = name.ok_or_else(|| OutputError::Name {
        name: path.display().to_string(),
    })?;
    Ok((disk.existing(folder_of(path))?, name.into()))
}

/// Returns the folder that a file is in: the current one for a bare name.
fn folder_of(path: &Path) -> &Path {
    match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    }
}

/// Creates a folder and its missing ancestors.
pub fn make_folder(path: &Path, disk: &Disk) -> Result<(), OutputError> {
    disk.make(path).map(drop)
}

/// Opens the folder `viewrank` of a root that others may write to, after creating it if necessary.
/// `root`: its resolved path.
///
/// # Errors
/// [`OutputError::Foreign`] if either is a link: files that [`replace_in`] replaces would be
/// somebody's.
pub fn make_own_folder(root: &Path, disk: &Disk) -> Result<Folder, OutputError> {
    let root = Folder::open_resolved(root)?;
    disk.make_folder(&root, "viewrank")?;
    root.folder_without_links("viewrank")
}

/// Checks that a name is a relative path of plain components in canonical form.
fn check_name(name: &str) -> Result<(), OutputError> {
    let plain = Path::new(name)
        .components()
        .all(|part| matches!(part, Component::Normal(_)));
    // `components` drops `.` and doubled slashes, so that one file would have two names in records.
    let canonical = name
        .split('/')
        .all(|part| !part.is_empty() && part != "." && !part.contains('\0'));
    // A drive, a stream of a file, another separator: no plain parts there.
    let plain = plain && !(cfg!(windows) && name.contains([':', '\\']));
    if plain && canonical {
        Ok(())
    } else {
        Err(OutputError::Name { name: name.into() })
    }
}

/// Error of writing a set. The earlier files are in place unless it is
/// [`OutputError::Interrupted`].
#[derive(Debug, thiserror::Error)]
pub enum OutputError {
    #[error("\"{name}\" is not a valid file name below the output folder")]
    Name { name: String },
    #[error("{}: a symbolic link leads out of {}", path.display(), root.display())]
    Escapes { path: PathBuf, root: PathBuf },
    #[error("cannot copy {}: it leads out of {}", path.display(), folder.display())]
    CopyOut { path: PathBuf, folder: PathBuf },
    #[error("{}: {what} in place of a file of viewrank's", path.display())]
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
    #[error("{failure}; cannot restore the earlier files, either: {undoing}")]
    Interrupted {
        failure: Box<OutputError>,
        undoing: Box<OutputError>,
    },
}

impl OutputError {
    fn new(path: &Path, source: io::Error) -> Self {
        let path = path.to_path_buf();
        match source.kind() {
            io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => Self::Full { path },
            io::ErrorKind::PermissionDenied | io::ErrorKind::ReadOnlyFilesystem => {
                Self::Denied { path, source }
            }
            _ => Self::Io { path, source },
        }
    }

    /// Returns whether there is nothing at the path.
    pub fn is_missing(&self) -> bool {
        matches!(self, Self::Io { source, .. } if source.kind() == io::ErrorKind::NotFound)
    }

    /// Returns whether the change may succeed without the set: nothing has changed, and the disk is
    /// full, or something is wrong in a folder with files of the set.
    fn spares(&self, set: &FileSet) -> bool {
        // Errors name whole paths, a set may have a relative one.
        let root = paths::absolute(&set.root);
        let folders = set.files.keys().filter_map(|path| Path::new(path).parent());
        let mut folders = folders.map(|folder| root.join(folder));
        match self {
            Self::Interrupted { .. } => false,
            Self::Full { .. } => true,
            _ => self
                .path()
                .is_some_and(|path| folders.any(|folder| path.starts_with(folder))),
        }
    }
}

impl Hint for OutputError {
    fn hint(&self) -> Option<Advice> {
        Some(match self {
            Self::Name { .. } => {
                "rename the image in the model: names are relative, without \"..\" or empty parts".into()
            }
            Self::Escapes { .. } => {
                Advice::text("replace the link with a folder, or with a relative link; where there is ").set("out").and(", it can name the link's target")
            }
            Self::CopyOut { .. } => {
                Advice::text("put the file itself there, or write where symbolic links can be made (to another disk, with ").set("out").and(")")
            }
            Self::Foreign { .. } => "move it away: viewrank creates its own".into(),
            Self::InTheWay { .. } => "move it away, or choose another name".into(),
            Self::OtherFileSystem { .. } => Advice::text("choose a folder on a single file system with ").set("out"),
            Self::Full { .. } => "free some space on that disk (a plan's viewrank/cache can be deleted: it only saves time); nothing was changed".into(),
            Self::Denied { .. } => "get write permission there, or work on a copy; nothing was changed".into(),
            Self::Io { source, .. } if source.kind() == io::ErrorKind::NotADirectory => {
                "name a folder, not a file or something below one".into()
            }
            Self::Io { .. } => "check that the disk is mounted and works; nothing was changed".into(),
            Self::Journal { .. } => {
                "run again to continue without it; its staged files are kept next to it in .staging.refused-N".into()
            }
            Self::Interrupted { .. } => "fix the cause and run again: that completes the set".into(),
        })
    }

    fn path(&self) -> Option<&Path> {
        match self {
            Self::Name { .. } => None,
            Self::Escapes { path, .. }
            | Self::CopyOut { path, .. }
            | Self::Foreign { path, .. }
            | Self::InTheWay { path, .. }
            | Self::OtherFileSystem { path, .. }
            | Self::Full { path }
            | Self::Denied { path, .. }
            | Self::Io { path, .. }
            | Self::Journal { path, .. } => Some(path),
            Self::Interrupted { failure, .. } => failure.path(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bare_name_is_in_the_current_folder() {
        assert_eq!(folder_of(Path::new("learnt.toml")), Path::new("."));
        assert_eq!(folder_of(Path::new("a/learnt.toml")), Path::new("a"));
        // Nothing is created: the folder is there, and the file was never asked for.
        let (_, name) = place(Path::new("learnt.toml"), &Disk::REAL).unwrap();
        assert_eq!(name, "learnt.toml");
    }
}
