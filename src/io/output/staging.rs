//! Stages a change: the new files of the sets, the files that they replace, and the stale files to remove.

use std::{
    collections::{BTreeSet, VecDeque},
    fs::{self, Metadata},
    io::{self, Read},
    path::{Path, PathBuf},
};

use super::{
    Contents, FileSet, OutputError, WriteReport, open,
    record::{self, Record, Records},
    transaction::{Change, Root, Step},
};
use crate::base::{input, packed::Packed, platform};

/// Stages the differences between the sets and the files on disk, as one change for all sets.
pub(super) fn stage(root: &Root, sets: &[&FileSet]) -> Result<(Change, Vec<WriteReport>), OutputError> {
    let records = Records::read(&root.path);
    let wanted: BTreeSet<&str> = sets.iter().flat_map(|set| set.files.keys()).map(String::as_str).collect();
    let mut staging = Staging {
        root,
        records: &records,
        wanted: &wanted,
        record: Record::default(),
        change: Change::default(),
        written: WriteReport::default(),
    };
    let written = sets.iter().map(|set| staging.set(set)).collect::<Result<_, _>>()?;
    let mut change = staging.change;
    let needed: BTreeSet<String> = sets.iter().flat_map(|set| needed_folders(set)).collect();
    change.old_folders.retain(|folder| !needed.contains(folder));
    change.old_folders.sort_unstable_by(|a, b| b.cmp(a));
    change.old_folders.dedup();
    Ok((change, written))
}

struct Staging<'a> {
    root: &'a Root<'a>,
    records: &'a Records,
    /// Paths of all sets in this change.
    wanted: &'a BTreeSet<&'a str>,
    /// New record of the current set.
    record: Record,
    change: Change,
    written: WriteReport,
}

impl Staging<'_> {
    fn set(&mut self, set: &FileSet) -> Result<WriteReport, OutputError> {
        let earlier = self.records.trusted(&set.name);
        for (path, contents) in &set.files {
            self.file(path, contents)?;
        }
        self.stale_files(&set.name, &earlier)?;
        self.folders(set, &earlier);
        self.record_itself(&set.name, &earlier)?;
        self.record = Record::default();
        Ok(std::mem::take(&mut self.written))
    }

    fn file(&mut self, path: &str, contents: &Contents) -> Result<(), OutputError> {
        let target = self.root.locate(path)?;
        let found = fs::symlink_metadata(&target).ok();
        if let Contents::Folder = contents {
            return self.empty_folder(path, &target, found);
        }
        self.missing_folders(path)?;
        let Some(found) = found else { return self.replace(path, contents, false) };
        if found.is_dir() {
            return Err(OutputError::InTheWay { path: target, folder: true });
        }
        if !found.is_file() && !found.is_symlink() {
            return Err(OutputError::Foreign { path: target, what: open::kind(&found) });
        }
        let claim = self.records.claim(&self.root.path, path)?;
        if is_same(&target, &found, contents, &self.root.path).map_err(|error| OutputError::new(&target, error))? {
            self.record.files.extend(claim.map(|claim| (path.to_owned(), claim.hash)));
            return Ok(());
        }
        if !claim.is_some_and(|claim| claim.is_ours) {
            self.keep_original(path, &target)?;
        }
        self.replace(path, contents, true)
    }

    fn empty_folder(&mut self, path: &str, target: &Path, found: Option<Metadata>) -> Result<(), OutputError> {
        if found.is_some() && !target.is_dir() {
            return Err(OutputError::InTheWay { path: target.to_path_buf(), folder: false });
        }
        self.missing_folders(&format!("{path}/"))
    }

    /// Stages the new file, and a link to the current one.
    fn replace(&mut self, path: &str, contents: &Contents, has_old: bool) -> Result<(), OutputError> {
        let target = self.root.locate(path)?;
        let step = self.change.steps.len();
        let new = self.root.staged(step, "new");
        self.make(&new, &target, contents)?;
        let old = if has_old { self.keep_old(&target)? } else { None };
        let new = hash_of(&new)?;
        self.record.files.extend(new.clone().map(|hash| (path.to_owned(), hash)));
        self.written.changed.push(path.into());
        self.change.steps.push(Step { path: path.into(), new, old });
        Ok(())
    }

    /// Stages a link to the file that the next step replaces or removes, for undo; returns its hash.
    fn keep_old(&self, target: &Path) -> Result<Option<String>, OutputError> {
        let old = self.root.staged(self.change.steps.len(), "old");
        self.link_or_copy(target, &old)?;
        hash_of(&old)
    }

    fn make(&self, at: &Path, target: &Path, contents: &Contents) -> Result<(), OutputError> {
        let disk = self.root.disk;
        match contents {
            Contents::Bytes(bytes) => disk.write_new(at, bytes.as_slice(), false),
            Contents::Table { head, rows } => disk.write_new(at, Parts::new(head, rows), false),
            Contents::Script(bytes) => disk.write_new(at, bytes.as_slice(), true),
            Contents::Copy(from) => self.copy(from, at),
            Contents::Link { file, folder } => {
                let link = link_target(file, target, &self.root.path);
                disk.symbolic_link(&link, at).or_else(|_| {
                    let real = inside(file, folder)?;
                    let made = if cfg!(windows) { disk.hard_link(&real, at).is_ok() } else { false };
                    if made { Ok(()) } else { self.copy(&real, at) }
                })
            }
            Contents::Folder => Ok(()),
        }
    }

    fn copy(&self, from: &Path, to: &Path) -> Result<(), OutputError> {
        let source = input::open(from).map_err(|error| OutputError::new(from, error))?;
        let executable = source.metadata().is_ok_and(|found| platform::is_executable(&found));
        self.root.disk.write_new(to, source, executable)
    }

    /// Makes a hard link, or a copy if the file system has none or forbids it.
    fn link_or_copy(&self, from: &Path, to: &Path) -> Result<(), OutputError> {
        self.root.disk.hard_link(from, to).or_else(|_| match fs::read_link(from) {
            Ok(target) => self.root.disk.symbolic_link(&target, to),
            Err(_) => self.copy(from, to),
        })
    }

    /// Keeps a user's file under a new name, unless an earlier run has done so.
    fn keep_original(&mut self, path: &str, target: &Path) -> Result<(), OutputError> {
        let original = hash_of(target)?;
        let names = std::iter::once(format!("{path}.before-viewrank"))
            .chain((2..).map(|n| format!("{path}.before-viewrank-{n}")));
        for name in names {
            let backup = self.root.locate(&name)?;
            if fs::symlink_metadata(&backup).is_err() {
                self.link_or_copy(target, &self.root.staged(self.change.steps.len(), "new"))?;
                self.change.steps.push(Step { path: name.clone(), new: original, old: None });
                self.written.kept.push(name);
                break;
            }
            if hash_of(&backup)? == original {
                break;
            }
        }
        Ok(())
    }

    /// Adds the missing folders above `path` to the change. All must be on the file system of the staging folder: renames cannot cross file
    /// systems.
    fn missing_folders(&mut self, path: &str) -> Result<(), OutputError> {
        for folder in folders_above(path) {
            let at = self.root.locate(folder)?;
            match fs::metadata(&at) {
                Ok(found) => self.check_file_system(&at, &found)?,
                Err(_) if self.change.new_folders.iter().any(|known| known == folder) => {}
                Err(_) => self.change.new_folders.push(folder.into()),
            }
        }
        Ok(())
    }

    fn check_file_system(&self, folder: &Path, found: &Metadata) -> Result<(), OutputError> {
        let staging = self.root.staging();
        let home = fs::metadata(&staging).map_err(|error| OutputError::new(&staging, error))?;
        if platform::file_system(found) == platform::file_system(&home) {
            return Ok(());
        }
        Err(OutputError::OtherFileSystem { path: folder.to_path_buf(), staging })
    }

    /// Removes the files of the earlier set that no set in this change has, if they are unmodified and belong to no other set.
    fn stale_files(&mut self, set: &str, earlier: &Record) -> Result<(), OutputError> {
        let stale: Vec<String> =
            earlier.files.keys().filter(|path| !self.wanted.contains(path.as_str())).cloned().collect();
        for path in stale {
            let target = self.root.locate(&path)?;
            if !self.records.claim(&self.root.path, &path)?.is_some_and(|claim| claim.is_ours)
                || self.records.belongs_to_other(set, &self.root.path, &path)?
            {
                continue;
            }
            let old = self.keep_old(&target)?;
            self.change.steps.push(Step { path: path.clone(), new: None, old });
            self.written.removed.push(path);
        }
        Ok(())
    }

    /// Records the set's folders, and removes those that it no longer needs.
    fn folders(&mut self, set: &FileSet, earlier: &Record) {
        let needed = needed_folders(set);
        let new = self.change.new_folders.iter().filter(|folder| needed.contains(*folder));
        self.record.folders = earlier.folders.intersection(&needed).chain(new).cloned().collect();
        let unneeded = earlier
            .folders
            .difference(&needed)
            .filter(|folder| !self.records.other_has_folder(&set.name, folder) && self.root.path.join(folder).is_dir());
        self.change.old_folders.extend(unneeded.cloned());
    }

    /// Stages the record in the same change as the files that it lists.
    fn record_itself(&mut self, set: &str, earlier: &Record) -> Result<(), OutputError> {
        self.record.identity.clone_from(&self.root.identity);
        if self.record == *earlier {
            return Ok(());
        }
        let path = format!("{}/{set}.json", record::FOLDER);
        let target = self.root.locate(&path)?;
        // An earlier record is replaced without being kept: what is in a folder elsewhere is none.
        let folder = self.root.path.join(record::FOLDER);
        if let Some(link) = fs::symlink_metadata(&folder).ok().filter(Metadata::is_symlink) {
            return Err(OutputError::Foreign { path: folder, what: open::kind(&link) });
        }
        self.missing_folders(&path)?;
        let step = self.change.steps.len();
        let mut text = serde_json::to_vec_pretty(&self.record).expect("strings are JSON");
        text.push(b'\n');
        let new = self.root.staged(step, "new");
        self.root.disk.write_new(&new, text.as_slice(), false)?;
        let old = if fs::symlink_metadata(&target).is_ok() { self.keep_old(&target)? } else { None };
        self.change.steps.push(Step { path, new: hash_of(&new)?, old });
        Ok(())
    }
}

fn hash_of(path: &Path) -> Result<Option<String>, OutputError> {
    record::hash(path).map_err(|error| OutputError::new(path, error))
}

/// All folders above the files of a set.
fn needed_folders(set: &FileSet) -> BTreeSet<String> {
    let ends = set.files.iter().map(|(path, contents)| match contents {
        Contents::Folder => format!("{path}/"),
        _ => path.clone(),
    });
    ends.flat_map(|p| folders_above(&p).map(String::from).collect::<Vec<_>>()).collect()
}

/// Parts that are read one after the other.
struct Parts<'a>(VecDeque<&'a [u8]>);

impl<'a> Parts<'a> {
    fn new(head: &'a [u8], rows: &'a Packed) -> Self {
        Self(std::iter::once(head).chain(rows.iter().map(|part| part.as_bytes())).collect())
    }
}

impl Read for Parts<'_> {
    fn read(&mut self, to: &mut [u8]) -> io::Result<usize> {
        while self.0.front().is_some_and(|part| part.is_empty()) {
            self.0.pop_front();
        }
        self.0.front_mut().map_or(Ok(0), |part| part.read(to))
    }
}

/// `a` and `a/b` for `a/b/c`; also `a/b/c` for `a/b/c/`.
fn folders_above(path: &str) -> impl Iterator<Item = &str> {
    path.match_indices('/').map(|(end, _)| &path[..end])
}

/// Returns whether the existing file has the wanted contents.
fn is_same(target: &Path, found: &Metadata, contents: &Contents, root: &Path) -> io::Result<bool> {
    match contents {
        Contents::Link { file, .. } if found.is_symlink() => {
            Ok(fs::read_link(target)? == link_target(file, target, root))
        }
        _ if found.is_symlink() => Ok(false),
        Contents::Link { file: from, .. } | Contents::Copy(from) => {
            let source = input::open(from)?;
            Ok(source.metadata()?.len() == found.len() && record::same_contents(source, open::existing(target)?)?)
        }
        Contents::Bytes(bytes) => is_bytes(target, found, bytes),
        Contents::Table { head, rows } => {
            let length = head.len() + rows.iter().map(|part| part.as_bytes().len()).sum::<usize>();
            Ok(found.len() == length as u64 && record::same_contents(Parts::new(head, rows), open::existing(target)?)?)
        }
        Contents::Script(bytes) => Ok(platform::is_executable(found) && is_bytes(target, found, bytes)?),
        Contents::Folder => Ok(found.is_dir()),
    }
}

fn is_bytes(target: &Path, found: &Metadata, bytes: &[u8]) -> io::Result<bool> {
    Ok(found.len() == bytes.len() as u64 && record::same_contents(bytes, open::existing(target)?)?)
}

/// The path of a file without links.
///
/// # Errors
/// [`OutputError::CopyOut`] if it leads out of the folder.
fn inside(file: &Path, folder: &Path) -> Result<PathBuf, OutputError> {
    let real = |path: &Path| dunce::canonicalize(path).map_err(|error| OutputError::new(path, error));
    let (path, within) = (real(file)?, real(folder)?);
    match path.starts_with(within) {
        true => Ok(path),
        false => Err(OutputError::CopyOut { path: file.into(), folder: folder.into() }),
    }
}

/// Target of a link: relative if both ends are below the root, so the project can be moved; otherwise absolute.
fn link_target(to: &Path, from: &Path, root: &Path) -> PathBuf {
    let absolute = std::path::absolute(to).unwrap_or_else(|_| to.to_path_buf());
    let real = match (absolute.parent().and_then(|folder| dunce::canonicalize(folder).ok()), absolute.file_name()) {
        (Some(folder), Some(name)) => folder.join(name),
        _ => absolute,
    };
    let (Ok(to), Ok(from)) = (real.strip_prefix(root), from.strip_prefix(root)) else { return real };
    let up = from.components().count() - 1;
    (0..up).map(|_| Path::new("..")).chain([to]).collect()
}
