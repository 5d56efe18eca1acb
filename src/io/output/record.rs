//! Which files under a root are ours: one record per set, `viewrank/.sets/NAME.json`.
//!
//! A record that was not written here (`identity.rs`) is believed about files below `viewrank/` only. Elsewhere a file that it claims
//! becomes ours again as soon as a set wants it exactly as it is.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    io::{self, Read},
    path::Path,
};

use serde::{Deserialize, Serialize};

use super::{OutputError, check_name, identity::identity, open};

/// Folder of the records, relative to the root.
pub(super) const FOLDER: &str = "viewrank/.sets";
/// Paths that begin with it are ours by their names.
const OWN: &str = "viewrank/";

/// What a set wrote; paths relative to the root.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Record {
    /// BLAKE3 of each file, see [`hash`].
    pub files: BTreeMap<String, String>,
    /// Folders that were made for it.
    pub folders: BTreeSet<String>,
    /// Of the folder in which it was written, see [`identity`](super::identity::identity).
    #[serde(default)]
    pub identity: String,
}

/// The records of all sets under a root, by name of the set.
pub(super) struct Records {
    of_sets: BTreeMap<String, Record>,
    /// What the records that were written here have.
    identity: Option<String>,
}

/// A file as some set recorded it.
pub(super) struct Claim {
    pub hash: String,
    /// By a record that is believed.
    pub is_ours: bool,
}

impl Records {
    /// Broken records are passed over: their files then count as somebody else's, which loses nothing.
    pub fn read(root: &Path) -> Self {
        let entries = fs::read_dir(root.join(FOLDER)).into_iter().flatten().flatten();
        let records = entries.filter_map(|entry| {
            let name = entry.file_name().to_str()?.strip_suffix(".json")?.to_owned();
            let bytes = open::read_own(root, &format!("{FOLDER}/{name}.json")).ok()?;
            let record: Record = serde_json::from_slice(&bytes).ok()?;
            let sound = record.files.keys().chain(&record.folders).all(|path| check_name(path).is_ok());
            sound.then_some((name, record))
        });
        Self { of_sets: records.collect(), identity: identity(&root.join("viewrank")).ok() }
    }

    /// What is believed of the record of a set.
    pub fn of(&self, set: &str) -> Record {
        let mut record = self.of_sets.get(set).cloned().unwrap_or_default();
        if self.identity.as_ref() != Some(&record.identity) {
            record.files.retain(|path, _| path.starts_with(OWN));
            record.folders.retain(|path| path.starts_with(OWN));
        }
        record
    }

    /// Paths of the files of sets whose names begin so, sorted.
    pub fn paths(&self, prefix: &str) -> Vec<String> {
        let sets = self.of_sets.iter().filter(|(name, _)| name.starts_with(prefix));
        let paths: BTreeSet<&String> = sets.flat_map(|(_, record)| record.files.keys()).collect();
        paths.into_iter().cloned().collect()
    }

    /// The file, if it is as some record says.
    pub fn claim(&self, root: &Path, path: &str) -> Result<Option<Claim>, OutputError> {
        let Some(hash) = self.recorded_hash(root, path, |_| true)? else { return Ok(None) };
        let believed = |r: &&Record| path.starts_with(OWN) || self.identity.as_ref() == Some(&r.identity);
        let is_ours = self.of_sets.values().filter(believed).any(|r| r.files.get(path) == Some(&hash));
        Ok(Some(Claim { hash, is_ours }))
    }

    /// Does another set than this one count on the file as it is?
    pub fn belongs_to_other(&self, set: &str, root: &Path, path: &str) -> Result<bool, OutputError> {
        Ok(self.recorded_hash(root, path, |name| name != set)?.is_some())
    }

    /// Was the folder made for another set than this one?
    pub fn other_has_folder(&self, set: &str, folder: &str) -> bool {
        self.of_sets.iter().any(|(name, record)| name != set && record.folders.contains(folder))
    }

    /// The hash of the file, if one of those sets recorded it.
    fn recorded_hash(&self, root: &Path, path: &str, of: impl Fn(&str) -> bool) -> Result<Option<String>, OutputError> {
        let sets = self.of_sets.iter().filter(|(name, _)| of(name));
        let mut hashes = sets.filter_map(|(_, record)| record.files.get(path)).peekable();
        if hashes.peek().is_none() {
            return Ok(None);
        }
        let found = hash(&root.join(path)).map_err(|error| OutputError::new(&root.join(path), error))?;
        Ok(found.filter(|found| hashes.any(|recorded| recorded == found)))
    }
}

/// BLAKE3 of a file's contents, or of the target of a symbolic link; `None` where there is neither.
pub(super) fn hash(path: &Path) -> io::Result<Option<String>> {
    match fs::symlink_metadata(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error),
        Ok(found) if found.is_symlink() => {
            let target = fs::read_link(path)?;
            Ok(Some(format!("link:{}", blake3::hash(target.as_os_str().as_encoded_bytes()))))
        }
        Ok(found) if found.is_file() => {
            let mut hasher = blake3::Hasher::new();
            hasher.update_reader(open::existing(path)?)?;
            Ok(Some(hasher.finalize().to_string()))
        }
        Ok(_) => Ok(None),
    }
}

/// Have both the same contents?
pub(super) fn same_contents(mut one: impl Read, mut other: impl Read) -> io::Result<bool> {
    let (mut a, mut b) = (vec![0; 1 << 16], vec![0; 1 << 16]);
    loop {
        let length = read_full(&mut one, &mut a)?;
        if length != read_full(&mut other, &mut b)? || a[..length] != b[..length] {
            return Ok(false);
        }
        if length == 0 {
            return Ok(true);
        }
    }
}

/// Fills the block unless the end comes first.
fn read_full(from: &mut impl Read, block: &mut [u8]) -> io::Result<usize> {
    let mut length = 0;
    while length < block.len() {
        match from.read(&mut block[length..])? {
            0 => break,
            n => length += n,
        }
    }
    Ok(length)
}
