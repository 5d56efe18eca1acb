//! Records of the files that viewrank wrote below a root: one per set, `viewrank/.sets/NAME.json`.
//!
//! A record that was not written in this folder (`identity.rs`) is trusted only for files below
//! `viewrank/`, and not through links there, which may lead to the user's folders. A file elsewhere
//! counts as viewrank's again once a set contains it with the same contents.

use std::{
    collections::{BTreeMap, BTreeSet},
    ffi::OsString,
    fs::File,
    io,
    time::UNIX_EPOCH,
};

use serde::{Deserialize, Serialize};

use super::{OutputError, check_name, folder::Folder, identity::identity};
use crate::input::{self, FileKind};

/// Folder of the records, relative to the root.
pub(super) const FOLDER: &str = "viewrank/.sets";
/// Bytes of all records together: those of exports of 100,000 images have 13 MB.
const MOST_BYTES: u64 = 1 << 27;
/// Files with this prefix are viewrank's, whoever recorded them.
const OWN: &str = "viewrank/";

/// Files and folders written for a set; paths relative to the root.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Record {
    /// BLAKE3 of each file, see [`hash`].
    pub files: BTreeMap<String, String>,
    /// Folders created for the set.
    pub folders: BTreeSet<String>,
    /// Identity of the folder in which the record was written, see
    /// [`identity`](super::identity::identity).
    #[serde(default)]
    pub identity: String,
}

impl Record {
    /// Reads the record of a set; `None` for a damaged one and for one that doesn't fit in the
    /// bytes `left`, from which its length is taken.
    fn read(root: &Folder, set: &str, left: &mut u64) -> Option<Self> {
        let file = root.file(&format!("{FOLDER}/{set}.json")).ok()?;
        let length = file.metadata().ok()?.len();
        if length > *left {
            return None;
        }
        let bytes = input::read_all(file, FileKind::Record).ok()?;
        let record: Self = serde_json::from_slice(&bytes).ok()?;
        *left -= length;
        // A planted record may list paths that lead out of the root.
        let mut paths = record.files.keys().chain(&record.folders);
        let is_sound = paths.all(|path| check_name(path).is_ok());
        is_sound.then_some(record)
    }
}

/// The records of all sets below a root.
pub(super) struct Records<'a> {
    /// By name of the set.
    by_set: BTreeMap<String, Record>,
    root: &'a Folder,
    /// Identity of this folder.
    identity: Option<String>,
}

/// A file that is as some set recorded it.
pub(super) struct Claim {
    pub hash: String,
    /// True if a trusted record lists it.
    pub is_ours: bool,
}

impl<'a> Records<'a> {
    /// Reads all records. Damaged ones, and those that no longer fit in [`MOST_BYTES`], are
    /// skipped: their files count as the user's and are kept.
    pub fn read(root: &'a Folder) -> Self {
        let mut names: Vec<OsString> = root.names(FOLDER).into_iter().flatten().collect();
        // Which records still fit in the budget must not depend on the order of the directory.
        names.sort_unstable();
        let mut left = MOST_BYTES;
        let records = names.into_iter().filter_map(|name| {
            let name = name.to_str()?.strip_suffix(".json")?.to_owned();
            let record = Record::read(root, &name, &mut left)?;
            Some((name, record))
        });
        let identity = root
            .folder("viewrank")
            .ok()
            .and_then(|folder| identity(&folder).ok());
        Self {
            by_set: records.collect(),
            root,
            identity,
        }
    }

    /// The trusted part of the record of a set.
    pub fn trusted(&self, set: &str) -> Record {
        let mut record = self.by_set.get(set).cloned().unwrap_or_default();
        if self.identity.as_ref() != Some(&record.identity) {
            record.files.retain(|path, _| self.is_own(path));
            record.folders.retain(|path| self.is_own(path));
        }
        record
    }

    fn is_own(&self, path: &str) -> bool {
        path.starts_with(OWN) && !self.root.has_links(path)
    }

    /// Paths of the files of sets whose names begin with `prefix`, sorted.
    pub fn paths(&self, prefix: &str) -> Vec<String> {
        let sets = self
            .by_set
            .iter()
            .filter(|(name, _)| name.starts_with(prefix));
        let paths: BTreeSet<&String> = sets.flat_map(|(_, record)| record.files.keys()).collect();
        paths.into_iter().cloned().collect()
    }

    /// Returns a claim if the file has the contents that some record lists.
    pub fn claim(&self, path: &str) -> Result<Option<Claim>, OutputError> {
        let Some(hash) = self.recorded_hash(path, |_| true)? else {
            return Ok(None);
        };
        let is_trusted =
            |r: &&Record| self.is_own(path) || self.identity.as_ref() == Some(&r.identity);
        let is_ours = self
            .by_set
            .values()
            .filter(is_trusted)
            .any(|r| r.files.get(path) == Some(&hash));
        Ok(Some(Claim { hash, is_ours }))
    }

    /// Returns whether a set other than `set` recorded the file with its current contents.
    pub fn belongs_to_other(&self, set: &str, path: &str) -> Result<bool, OutputError> {
        Ok(self.recorded_hash(path, |name| name != set)?.is_some())
    }

    /// Returns whether the folder was created for a set other than `set`.
    pub fn other_has_folder(&self, set: &str, folder: &str) -> bool {
        self.by_set
            .iter()
            .any(|(name, record)| name != set && record.folders.contains(folder))
    }

    /// Returns the hash of the file if a set whose name passes `filter` recorded it.
    fn recorded_hash(
        &self,
        path: &str,
        filter: impl Fn(&str) -> bool,
    ) -> Result<Option<String>, OutputError> {
        let sets = self.by_set.iter().filter(|(name, _)| filter(name));
        let mut hashes = sets
            .filter_map(|(_, record)| record.files.get(path))
            .peekable();
        // Hashing reads the whole file, for nothing where no record lists it.
        if hashes.peek().is_none() {
            return Ok(None);
        }
        Ok(hash(self.root, path)?.filter(|found| hashes.any(|recorded| recorded == found)))
    }
}

/// BLAKE3 of the contents of a file or of the target of a symbolic link; `None` if the path is
/// neither. Of a file with larger holes or longer than any of viewrank's, which would take minutes
/// to read, what the file system says about it.
pub(super) fn hash(root: &Folder, path: &str) -> Result<Option<String>, OutputError> {
    match root.find(path)? {
        // With a prefix: a file with the path as its text is not the link.
        Some(found) if found.is_symlink() => Ok(Some(format!(
            "link:{}",
            blake3::hash(root.link(path)?.as_os_str().as_encoded_bytes())
        ))),
        Some(found) if found.is_file() => hash_of_file(&root.file(path)?)
            .map(Some)
            .map_err(|error| root.failed(path.as_ref(), error)),
        _ => Ok(None),
    }
}

fn hash_of_file(file: &File) -> io::Result<String> {
    let found = file.metadata()?;
    if found.len() > FileKind::Sparse.limit() || input::large_holes(file, found.len()).is_some() {
        let modified = found
            .modified()?
            .duration_since(UNIX_EPOCH)
            .unwrap_or_default();
        let inode = input::identity(&found).1;
        return Ok(format!(
            "large:{} {} {inode}",
            found.len(),
            modified.as_nanos()
        ));
    }
    let mut hasher = blake3::Hasher::new();
    hasher.update_reader(file)?;
    Ok(hasher.finalize().to_string())
}
