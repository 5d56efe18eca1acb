//! Detects input that is still, and input that was planned already.
//!
//! A [`Stamp`] is the file-system metadata of the input (length, times, inode): cheap, and any
//! difference means "not still yet". A [`Fingerprint`] is a hash of the content and decides whether
//! there is anything to plan, so that a `touch`, a copy over itself or a restart of the daemon
//! plans nothing.

use std::{
    collections::BTreeMap,
    ffi::OsStr,
    fs,
    io::{self, Read},
    path::{Path, PathBuf},
    sync::{Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant, SystemTime, UNIX_EPOCH},
};

use super::discover::{self, InputFolders};
use crate::{
    base::input,
    io::project::{TEST_LISTS, is_image},
};

/// Metadata of one file or folder.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Entry {
    length: u64,
    modified_ns: u128,
    /// Last change of content or name, in ns since 1970; no program can set it.
    changed_ns: u128,
    inode: u64,
}

impl Entry {
    const NONE: Self = Self {
        length: 0,
        modified_ns: 0,
        changed_ns: 0,
        inode: 0,
    };

    pub(super) fn from_metadata(metadata: &fs::Metadata) -> Self {
        // The times of files of `/proc` are new at each look.
        if metadata.is_file() && metadata.len() == 0 {
            return Self::NONE;
        }
        let modified = metadata.modified().unwrap_or(UNIX_EPOCH);
        let since = modified.duration_since(UNIX_EPOCH).unwrap_or_default();
        // The modification time of a folder covers its length.
        let length = if metadata.is_dir() { 0 } else { metadata.len() };
        let (changed_ns, inode) = input::identity(metadata);
        Self {
            length,
            modified_ns: since.as_nanos(),
            changed_ns,
            inode,
        }
    }

    /// The entry of two files that are read as one.
    pub(super) fn with(self, other: Self) -> Self {
        Self {
            length: self.length.saturating_add(other.length),
            modified_ns: self.modified_ns.max(other.modified_ns),
            changed_ns: self.changed_ns.max(other.changed_ns),
            // Rotated, so that two names of one file do not cancel out.
            inode: self.inode.rotate_left(1) ^ other.inode,
        }
    }

    #[cfg(test)]
    pub(super) fn of_length(length: u64) -> Self {
        Self {
            length,
            modified_ns: 0,
            changed_ns: 0,
            inode: 0,
        }
    }
}

/// The files of one image folder, as digests: there may be a hundred thousand, and plans compare
/// pictures.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Images {
    /// Names of all files, and the [`Entry`] of each image.
    metadata: blake3::Hash,
    /// The same without what a copy that preserves times changes: inodes and times of change.
    content: blake3::Hash,
    /// Latest change of an image, ns since 1970.
    changed_ns: u128,
}

impl Images {
    fn list(folder: &Path) -> io::Result<Self> {
        let (mut metadata, mut content) = (blake3::Hasher::new(), blake3::Hasher::new());
        let mut newest = 0;
        for name in sorted_names(folder)? {
            let path = folder.join(&name);
            let found = is_image(&path)
                .then(|| fs::metadata(&path).ok())
                .flatten()
                .filter(fs::Metadata::is_file);
            let Entry {
                length,
                modified_ns,
                changed_ns,
                inode,
            } = found.map_or(Entry::NONE, |found| Entry::from_metadata(&found));
            for hasher in [&mut metadata, &mut content] {
                // No name has a 0 byte, so that this ends it.
                hasher.update(name.as_encoded_bytes()).update(&[0]);
                hasher
                    .update(&length.to_le_bytes())
                    .update(&modified_ns.to_le_bytes());
            }
            metadata
                .update(&changed_ns.to_le_bytes())
                .update(&inode.to_le_bytes());
            newest = changed_ns.max(newest);
        }
        Ok(Self {
            metadata: metadata.finalize(),
            content: content.finalize(),
            changed_ns: newest,
        })
    }
}

/// Metadata of a project's input.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Stamp {
    /// Model files and `viewrank.toml`.
    files: BTreeMap<PathBuf, Entry>,
    /// Masks, and files named in the settings.
    beside: BTreeMap<PathBuf, Entry>,
    /// Image folders and the images in them.
    folders: BTreeMap<PathBuf, (Entry, Images)>,
    /// Unreadable folders with the error.
    unreadable: BTreeMap<PathBuf, String>,
}

impl Stamp {
    /// Reads the metadata of a project's input; missing files are left out.
    pub fn read(project: &Path, follow_links: bool) -> Self {
        Self::of_folders(&InputFolders::find(project, follow_links))
    }

    /// Reads the metadata of the input in these folders.
    pub fn of_folders(folders: &InputFolders) -> Self {
        let mut stamp = Self::default();
        for folder in &folders.images {
            let found = fs::metadata(folder).map(|found| Entry::from_metadata(&found));
            match found.and_then(|entry| Ok((entry, Images::list(folder)?))) {
                Ok(found) => drop(stamp.folders.insert(folder.clone(), found)),
                Err(error) => stamp.note_unreadable(folder, &error),
            }
        }
        for folder in &folders.models {
            // Next to orientations a cloud is input; elsewhere a backend made it.
            let is_input = |name: &OsStr| {
                name.to_str()
                    .is_some_and(|name| is_input_file(name, folders.has_orientations))
            };
            let files = stamp.entries(folder, is_input);
            stamp.files.extend(files);
        }
        for model in &folders.of_others {
            if let Ok(found) = fs::metadata(model) {
                let entry = Entry::from_metadata(&found);
                stamp.files.insert(model.clone(), entry);
            }
        }
        for folder in &folders.masks {
            let files = stamp.entries(folder, |_| true);
            stamp.beside.extend(files);
        }
        stamp
    }

    /// Returns the files of a folder whose names are `wanted`.
    fn entries(&mut self, folder: &Path, wanted: impl Fn(&OsStr) -> bool) -> Vec<(PathBuf, Entry)> {
        let entries =
            fs::read_dir(folder).and_then(|entries| entries.collect::<io::Result<Vec<_>>>());
        let entries = entries.unwrap_or_else(|error| {
            self.note_unreadable(folder, &error);
            Vec::new()
        });
        let paths = entries
            .iter()
            .filter(|entry| wanted(&entry.file_name()))
            .map(fs::DirEntry::path);
        let file = |path: PathBuf| {
            fs::metadata(&path)
                .ok()
                .filter(fs::Metadata::is_file)
                .map(|m| (path, Entry::from_metadata(&m)))
        };
        paths.filter_map(file).collect()
    }

    fn note_unreadable(&mut self, folder: &Path, error: &io::Error) {
        if error.kind() != io::ErrorKind::NotFound {
            self.unreadable.insert(folder.into(), error.to_string());
        }
    }

    /// Adds those of these files that exist.
    pub fn with(mut self, named: &[PathBuf]) -> Self {
        let entry = |path: &PathBuf| {
            Some((
                path.clone(),
                Entry::from_metadata(&fs::metadata(path).ok()?),
            ))
        };
        self.beside.extend(named.iter().filter_map(entry));
        self
    }

    pub fn is_empty(&self) -> bool {
        self.files.is_empty()
    }

    /// Returns the first error that keeps the input from being read.
    pub fn read_error(&self) -> Option<String> {
        let (folder, reason) = self.unreadable.first_key_value()?;
        Some(format!("cannot read folder {}: {reason}", folder.display()))
    }

    /// Size in bytes of the largest model that may be planned: the project's COLMAP models have
    /// priority over scenes of other programs and over the model of its dense workspace.
    pub fn bytes(&self) -> u64 {
        let mut models: BTreeMap<(bool, PathBuf), u64> = BTreeMap::new();
        for (path, entry) in &self.files {
            let name = path.file_name().and_then(OsStr::to_str).unwrap_or("");
            let is_colmap = discover::is_model_file(name);
            let is_dense = path
                .components()
                .any(|part| discover::is_workspace(part.as_os_str()));
            // A COLMAP model is all files of one format in a folder, an OpenMVS scene one file, a
            // SURE model all other files.
            let model = match path.extension().and_then(OsStr::to_str) {
                Some("mvs") => path.clone(),
                Some(extension) if is_colmap => path.with_file_name(extension),
                _ => PathBuf::new(),
            };
            *models.entry((is_colmap && !is_dense, model)).or_default() += entry.length;
        }
        let first = models.keys().any(|(first, _)| *first);
        models
            .iter()
            .filter(|((of_first, _), _)| *of_first == first)
            .map(|(_, bytes)| *bytes)
            .max()
            .unwrap_or(0)
    }

    /// Returns since when the input has been as it was at `scanned`, given its last event at
    /// `heard`. Changes that raised no event are dated by the file system.
    pub fn same_since(&self, heard: Instant, (scanned, time): (Instant, SystemTime)) -> Instant {
        let files = self
            .files
            .values()
            .chain(self.beside.values())
            .map(|entry| entry.changed_ns);
        let folders = self
            .folders
            .values()
            .map(|(entry, images)| entry.changed_ns.max(images.changed_ns));
        let newest = files.chain(folders).max().unwrap_or(0);
        let newest = UNIX_EPOCH + Duration::from_nanos(u64::try_from(newest).unwrap_or(u64::MAX));
        // A time in the future, such as of another machine's clock, counts as now.
        let ago = time.duration_since(newest).unwrap_or_default();
        heard
            .max(scanned.checked_sub(ago).unwrap_or(heard))
            .min(scanned)
    }
}

fn is_input_file(name: &str, with_cloud: bool) -> bool {
    let ends = |suffixes: &[&str]| suffixes.iter().any(|suffix| name.ends_with(suffix));
    let cloud = with_cloud && ends(&[".nvm", ".out", ".ply"]);
    let is_list = TEST_LISTS.contains(&name);
    discover::is_model_file(name)
        || is_list
        || name == "viewrank.toml"
        || ends(&[".mvs", ".ori"])
        || cloud
}

/// A stamp and the time since when it has been unchanged.
#[derive(Clone, Debug)]
pub struct Stillness<S> {
    stamp: S,
    since: Instant,
}

impl<S: PartialEq> Stillness<S> {
    pub fn new(stamp: S, now: Instant) -> Self {
        Self { stamp, since: now }
    }

    /// Takes a new stamp; true if it differs.
    pub fn observe(&mut self, stamp: S, now: Instant) -> bool {
        let changed = stamp != self.stamp;
        if changed {
            *self = Self::new(stamp, now);
        }
        changed
    }

    /// Keeps the stamp, but counts it as unchanged only from `then` on.
    pub fn restart(&mut self, then: Instant) {
        self.since = self.since.max(then);
    }

    pub fn stamp(&self) -> &S {
        &self.stamp
    }

    /// Returns when the stamp will have been unchanged for `settle`.
    pub fn settled_at(&self, settle: Duration) -> Instant {
        self.since + settle
    }
}

/// Hash of a project's input: the content of model files, masks and files named in the settings;
/// the names in the image folders, with length and modification time of each image; and the
/// settings in force. Images are too large to be hashed whole.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(transparent)]
pub struct Fingerprint(String);

/// Hashes of files by path and metadata, so that an unchanged file is read once.
#[derive(Debug, Default)]
pub struct HashCache(BTreeMap<PathBuf, (Entry, blake3::Hash)>);

impl HashCache {
    /// Computes the fingerprint of the current input; `model` are the files of the model to plan.
    /// The cache isn't locked while files are read.
    ///
    /// # Errors
    /// Files that vanish or can't be read.
    pub fn fingerprint(
        cache: &Mutex<Self>,
        project: &Path,
        model: &[PathBuf],
        stamp: &Stamp,
        settings: &[u8],
    ) -> io::Result<Fingerprint> {
        let mut hasher = blake3::Hasher::new();
        hasher
            // Another version may plan the same input otherwise.
            .update(env!("CARGO_PKG_VERSION").as_bytes())
            .update(blake3::hash(settings).as_bytes());
        // `settings` already holds the content of a valid `viewrank.toml`.
        let beside = stamp
            .beside
            .keys()
            .filter(|path| !path.ends_with("viewrank.toml"));
        for path in model.iter().chain(beside) {
            let relative = path.strip_prefix(project).unwrap_or(path);
            hasher
                .update(relative.as_os_str().as_encoded_bytes())
                .update(&[0]);
            hasher.update(Self::file(cache, path)?.as_bytes());
        }
        // From the stamp, which is older than anything a plan reads: an image that changes
        // meanwhile differs from it.
        stamp
            .folders
            .values()
            .for_each(|(_, images)| _ = hasher.update(images.content.as_bytes()));
        let is_input = |path: &PathBuf| model.contains(path) || stamp.beside.contains_key(path);
        // Files of former models would stay as long as the daemon runs.
        lock(cache)
            .0
            .retain(|path, _| !path.starts_with(project) || is_input(path));
        Ok(Fingerprint(hasher.finalize().to_hex().to_string()))
    }

    /// Removes the hashes of a project.
    pub fn forget(&mut self, project: &Path) {
        self.0.retain(|path, _| !path.starts_with(project));
    }

    fn file(cache: &Mutex<Self>, path: &Path) -> io::Result<blake3::Hash> {
        let named =
            |error: io::Error| io::Error::new(error.kind(), format!("{}: {error}", path.display()));
        let file = input::open(path).map_err(named)?;
        // Taken before reading, so that a file written meanwhile gets another entry.
        let entry = Entry::from_metadata(&file.metadata().map_err(named)?);
        if let Some((_, hash)) = lock(cache).0.get(path).filter(|(known, _)| *known == entry) {
            return Ok(*hash);
        }
        let hash = blake3::Hasher::new()
            // A file that grows while it is read gets another entry, so the rest of it is not
            // needed.
            .update_reader(file.take(entry.length))
            .map_err(named)?
            .finalize();
        lock(cache).0.insert(path.into(), (entry, hash));
        Ok(hash)
    }
}

/// Locks a mutex even if a thread that held it panicked: the daemon's caches are consistent between
/// any two statements.
pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn sorted_names(folder: &Path) -> io::Result<Vec<std::ffi::OsString>> {
    let mut names = fs::read_dir(folder)?
        .map(|entry| Ok(entry?.file_name()))
        .collect::<io::Result<Vec<_>>>()?;
    names.sort();
    Ok(names)
}

#[cfg(test)]
mod tests;
