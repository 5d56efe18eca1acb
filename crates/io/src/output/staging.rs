//! Stages a change: the new files of the sets, the files that they replace, and the stale files to
//! remove.

use std::{
    collections::{BTreeSet, VecDeque},
    fs::File,
    io::{self, Read},
    path::{Path, PathBuf},
};

use cap_std::fs::Metadata;

use super::{
    Contents, FileSet, OutputError, WriteReport,
    contents::{has_bytes, has_contents},
    folder::Folder,
    journal::{Change, Root, STAGING, Step, staged},
    record::{self, Record, Records, hash},
};
use crate::{input, packed::Packed, paths, platform, printable::to_json};

/// Stages the differences between the sets and the files on disk, as one change for all sets.
pub(super) fn stage(
    root: &Root,
    sets: &[&FileSet],
) -> Result<(Change, Vec<WriteReport>), OutputError> {
    let records = Records::read(&root.folder);
    let wanted: BTreeSet<&str> = sets
        .iter()
        .flat_map(|set| set.files.keys())
        .map(String::as_str)
        .collect();
    let mut staging = Staging {
        root,
        folder: &root.folder,
        records: &records,
        wanted: &wanted,
        record: Record::default(),
        change: Change::default(),
        written: WriteReport::default(),
    };
    let written = sets
        .iter()
        .map(|set| staging.set(set))
        .collect::<Result<_, _>>()?;
    Ok((staging.into_change(sets), written))
}

struct Staging<'a> {
    root: &'a Root<'a>,
    folder: &'a Folder,
    records: &'a Records<'a>,
    /// Paths of all sets in this change.
    wanted: &'a BTreeSet<&'a str>,
    /// New record of the current set.
    record: Record,
    change: Change,
    written: WriteReport,
}

impl Staging<'_> {
    /// The change, which removes the folders that no set needs, the deepest first.
    fn into_change(self, sets: &[&FileSet]) -> Change {
        let mut change = self.change;
        let needed: BTreeSet<String> = sets.iter().flat_map(|set| needed_folders(set)).collect();
        // A folder that one set drops may be needed by another of this change.
        change.old_folders.retain(|folder| !needed.contains(folder));
        change.old_folders.sort_unstable_by(|a, b| b.cmp(a));
        change.old_folders.dedup();
        change
    }

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
        let found = self.folder.find(path)?;
        if let Contents::Folder = contents {
            return self.missing_folders(&format!("{path}/"));
        }
        self.missing_folders(path)?;
        let Some(found) = found else {
            return self.replace(path, contents, false);
        };
        self.check_replaceable(path, &found)?;
        let claim = self.records.claim(path)?;
        // A user's file that happens to have these contents is not recorded: with a later set it
        // would be removed as stale.
        if self.is_same(path, &found, contents)? {
            self.record
                .files
                .extend(claim.map(|claim| (path.to_owned(), claim.hash)));
            return Ok(());
        }
        if !claim.is_some_and(|claim| claim.is_ours) {
            self.keep_original(path)?;
        }
        self.replace(path, contents, true)
    }

    /// Checks that only a file or a link is replaced.
    fn check_replaceable(&self, path: &str, found: &Metadata) -> Result<(), OutputError> {
        if found.is_dir() {
            return Err(OutputError::InTheWay {
                path: self.folder.path(path),
                folder: true,
            });
        }
        if !found.is_file() && !found.is_symlink() {
            return Err(self.folder.foreign(path, found));
        }
        Ok(())
    }

    /// Stages the new file, and a link to the current one.
    fn replace(
        &mut self,
        path: &str,
        contents: &Contents,
        has_old: bool,
    ) -> Result<(), OutputError> {
        let new = staged(self.change.steps.len(), "new");
        self.make(&new, path, contents)?;
        let old = if has_old { self.keep_old(path)? } else { None };
        // Of the staged file: its source may change while it is copied.
        let new = hash(self.folder, &new)?;
        self.record
            .files
            .extend(new.clone().map(|hash| (path.to_owned(), hash)));
        self.written.changed.push(path.into());
        self.change.steps.push(Step {
            path: path.into(),
            new,
            old,
        });
        Ok(())
    }

    /// Stages a link to the file that the next step replaces or removes, for undo; returns its
    /// hash.
    fn keep_old(&self, path: &str) -> Result<Option<String>, OutputError> {
        // A link and not a rename: until the journal is carried out, the old file stays in its
        // place.
        let old = staged(self.change.steps.len(), "old");
        self.link_or_copy(path, &old)?;
        hash(self.folder, &old)
    }

    /// Makes the staged file `at` for `path`.
    fn make(&self, at: &str, path: &str, contents: &Contents) -> Result<(), OutputError> {
        let (disk, folder) = (self.root.disk, self.folder);
        match contents {
            Contents::Bytes(bytes) => disk.write_new(folder, at, bytes.as_slice(), false),
            Contents::Table { head, rows } => {
                disk.write_new(folder, at, Parts::new(head, rows), false)
            }
            Contents::Script(bytes) => disk.write_new(folder, at, bytes.as_slice(), true),
            Contents::Copy(from) => self.copy(open_source(from)?, at),
            Contents::Link {
                file,
                folder: within,
            } => disk
                .symbolic_link(&self.link_target(file, path), folder, at)
                .or_else(|_| self.without_symbolic_link(file, within, at)),
            Contents::Folder => Ok(()),
        }
    }

    /// Makes the staged file `at` of a file in the folder `within`, where there are no symbolic
    /// links.
    fn without_symbolic_link(
        &self,
        file: &Path,
        within: &Path,
        at: &str,
    ) -> Result<(), OutputError> {
        let real = inside(file, within)?;
        // Without developer mode Windows forbids symbolic links, but not hard links on the same
        // drive.
        let is_made = cfg!(windows) && self.hard_link(&real, at).is_ok();
        if is_made {
            return Ok(());
        }
        self.copy(open_source(&real)?, at)
    }

    fn copy(&self, from: File, to: &str) -> Result<(), OutputError> {
        let executable = from
            .metadata()
            .is_ok_and(|found| platform::is_executable(&found));
        self.root.disk.write_new(self.folder, to, from, executable)
    }

    /// Makes a hard link to a file anywhere.
    fn hard_link(&self, from: &Path, to: &str) -> Result<(), OutputError> {
        let source = Folder::open(from.parent().unwrap_or(from))?;
        self.root.disk.hard_link(
            (&source, from.file_name().unwrap_or_default().as_ref()),
            (self.folder, to),
        )
    }

    /// Makes a hard link, or a copy if the file system has none or forbids it.
    fn link_or_copy(&self, from: &str, to: &str) -> Result<(), OutputError> {
        let (disk, folder) = (self.root.disk, self.folder);
        disk.hard_link((folder, from.as_ref()), (folder, to))
            .or_else(|_| match folder.link(from) {
                Ok(target) => disk.symbolic_link(&target, folder, to),
                Err(_) => self.copy(folder.file(from)?, to),
            })
    }

    /// Keeps a user's file under a new name, unless an earlier run has done so.
    fn keep_original(&mut self, path: &str) -> Result<(), OutputError> {
        let original = hash(self.folder, path)?;
        let names = std::iter::once(format!("{path}.before-viewrank"))
            .chain((2..).map(|n| format!("{path}.before-viewrank-{n}")));
        for name in names {
            if self.folder.find(&name)?.is_none() {
                self.link_or_copy(path, &staged(self.change.steps.len(), "new"))?;
                self.change.steps.push(Step {
                    path: name.clone(),
                    new: original,
                    old: None,
                });
                self.written.kept.push(name);
                break;
            }
            if hash(self.folder, &name)? == original {
                break;
            }
        }
        Ok(())
    }

    /// Adds the missing folders above `path` to the change. All must be on the file system of the
    /// staging folder: renames cannot cross file systems.
    fn missing_folders(&mut self, path: &str) -> Result<(), OutputError> {
        for folder in folders_above(path) {
            match (self.folder.folder(folder), self.folder.find(folder)?) {
                (Ok(_), _) => self.check_file_system(folder)?,
                (Err(error), Some(_)) => return Err(error),
                (Err(_), None) if self.change.new_folders.iter().any(|known| known == folder) => {}
                (Err(_), None) => self.change.new_folders.push(folder.into()),
            }
        }
        Ok(())
    }

    fn check_file_system(&self, folder: &str) -> Result<(), OutputError> {
        let number = |folder: &str| {
            let found = self.folder.folder(folder)?.metadata();
            found
                .map(|found| platform::file_system(&found))
                .map_err(|error| self.folder.failed(folder.as_ref(), error))
        };
        if number(folder)? == number(STAGING)? {
            return Ok(());
        }
        Err(OutputError::OtherFileSystem {
            path: self.folder.path(folder),
            staging: self.folder.path(STAGING),
        })
    }

    /// Removes the files of the earlier set that no set in this change has, if they are unmodified
    /// and belong to no other set.
    fn stale_files(&mut self, set: &str, earlier: &Record) -> Result<(), OutputError> {
        let stale: Vec<String> = earlier
            .files
            .keys()
            .filter(|path| !self.wanted.contains(path.as_str()))
            .cloned()
            .collect();
        for path in stale {
            // An edited file has no claim any more: it is the user's.
            if !self
                .records
                .claim(&path)?
                .is_some_and(|claim| claim.is_ours)
                || self.records.belongs_to_other(set, &path)?
            {
                continue;
            }
            let old = self.keep_old(&path)?;
            self.change.steps.push(Step {
                path: path.clone(),
                new: None,
                old,
            });
            self.written.removed.push(path);
        }
        Ok(())
    }

    /// Records the set's folders, and removes those that it no longer needs.
    fn folders(&mut self, set: &FileSet, earlier: &Record) {
        let needed = needed_folders(set);
        let new = self
            .change
            .new_folders
            .iter()
            .filter(|folder| needed.contains(*folder));
        // A folder that was there before is the user's and stays, even when it becomes empty.
        self.record.folders = earlier
            .folders
            .intersection(&needed)
            .chain(new)
            .cloned()
            .collect();
        let unneeded = earlier.folders.difference(&needed).filter(|folder| {
            !self.records.other_has_folder(&set.name, folder) && self.folder.folder(folder).is_ok()
        });
        self.change.old_folders.extend(unneeded.cloned());
    }

    /// Stages the record in the same change as the files that it lists.
    fn record_itself(&mut self, set: &str, earlier: &Record) -> Result<(), OutputError> {
        self.record.identity.clone_from(&self.root.identity);
        // Not written again, so that a second run changes nothing.
        if self.record == *earlier {
            return Ok(());
        }
        let path = format!("{}/{set}.json", record::FOLDER);
        self.check_folder_of_records()?;
        self.missing_folders(&path)?;
        let text = to_json(&self.record);
        let new = staged(self.change.steps.len(), "new");
        self.root
            .disk
            .write_new(self.folder, &new, text.as_bytes(), false)?;
        let old = if self.folder.find(&path)?.is_some() {
            self.keep_old(&path)?
        } else {
            None
        };
        self.change.steps.push(Step {
            path,
            new: hash(self.folder, &new)?,
            old,
        });
        Ok(())
    }

    /// An earlier record is replaced without being kept: what is in a folder elsewhere is none.
    fn check_folder_of_records(&self) -> Result<(), OutputError> {
        let found = self.folder.find(record::FOLDER)?;
        match found.filter(Metadata::is_symlink) {
            Some(link) => Err(self.folder.foreign(record::FOLDER, &link)),
            None => Ok(()),
        }
    }

    /// Returns whether the existing file has the wanted contents.
    fn is_same(
        &self,
        path: &str,
        found: &Metadata,
        contents: &Contents,
    ) -> Result<bool, OutputError> {
        if let (Contents::Link { file, .. }, true) = (contents, found.is_symlink()) {
            return Ok(self.folder.link(path)? == self.link_target(file, path));
        }
        // A link to a file with the same contents is replaced, too: its target is somebody else's.
        if !found.is_file() {
            return Ok(false);
        }
        self.has_contents(path, contents)
    }

    fn has_contents(&self, path: &str, contents: &Contents) -> Result<bool, OutputError> {
        let there = self.folder.file(path)?;
        match contents {
            // Where links cannot be made, an earlier run has made a copy.
            Contents::Link { file: from, .. } | Contents::Copy(from) => {
                is_copy(&there, &open_source(from)?)
            }
            Contents::Bytes(bytes) => has_bytes(&there, bytes),
            Contents::Table { head, rows } => {
                let length =
                    head.len() + rows.iter().map(|part| part.as_bytes().len()).sum::<usize>();
                has_contents(&there, length as u64, Parts::new(head, rows))
            }
            Contents::Script(bytes) => {
                has_bytes(&there, bytes).and_then(|same| Ok(same && is_executable(&there)?))
            }
            Contents::Folder => Ok(false),
        }
        .map_err(|error| self.folder.failed(path.as_ref(), error))
    }

    /// Target of a link: relative if both ends are below the root, so the project can be moved;
    /// otherwise absolute, also where a folder on the way to the link is itself a link, since `..`
    /// would then lead elsewhere.
    fn link_target(&self, to: &Path, path: &str) -> PathBuf {
        let absolute = paths::absolute(to);
        let real = match (
            absolute
                .parent()
                .and_then(|folder| dunce::canonicalize(folder).ok()),
            absolute.file_name(),
        ) {
            (Some(folder), Some(name)) => folder.join(name),
            _ => absolute,
        };
        let root = dunce::canonicalize(self.folder.path("")).unwrap_or_default();
        match real.strip_prefix(&root) {
            Ok(to) if !self.folder.has_links(path) => {
                let up = path.matches('/').count();
                (0..up).map(|_| Path::new("..")).chain([to]).collect()
            }
            _ => real,
        }
    }
}

fn open_source(path: &Path) -> Result<File, OutputError> {
    input::open(path).map_err(|error| OutputError::new(path, error))
}

/// All folders above the files of a set.
fn needed_folders(set: &FileSet) -> BTreeSet<String> {
    let ends = set.files.iter().map(|(path, contents)| match contents {
        Contents::Folder => format!("{path}/"),
        _ => path.clone(),
    });
    ends.flat_map(|p| folders_above(&p).map(String::from).collect::<Vec<_>>())
        .collect()
}

/// Parts that are read one after the other.
struct Parts<'a>(VecDeque<&'a [u8]>);

impl<'a> Parts<'a> {
    fn new(head: &'a [u8], rows: &'a Packed) -> Self {
        Self(
            std::iter::once(head)
                .chain(rows.iter().map(|part| part.as_bytes()))
                .collect(),
        )
    }
}

impl Read for Parts<'_> {
    fn read(&mut self, to: &mut [u8]) -> io::Result<usize> {
        // A read of nothing counts as the end, so an empty part would cut off the others.
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

fn is_copy(file: &File, source: &File) -> io::Result<bool> {
    has_contents(file, source.metadata()?.len(), source)
}

/// The path of a file without links.
///
/// # Errors
/// [`OutputError::CopyOut`] if it leads out of the folder.
fn inside(file: &Path, folder: &Path) -> Result<PathBuf, OutputError> {
    let real =
        |path: &Path| dunce::canonicalize(path).map_err(|error| OutputError::new(path, error));
    let (path, within) = (real(file)?, real(folder)?);
    if path.starts_with(within) {
        Ok(path)
    } else {
        Err(OutputError::CopyOut {
            path: file.into(),
            folder: folder.into(),
        })
    }
}

fn is_executable(file: &File) -> io::Result<bool> {
    Ok(platform::is_executable(&file.metadata()?))
}
