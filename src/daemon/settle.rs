//! Is a project's input complete and still? And is it what was planned already?
//!
//! Two looks at the input. A [`Stamp`] is what the file system says of it (length, time, inode): cheap, and any difference means
//! "not still yet". A [`Fingerprint`] is a hash of the content: it decides whether there is anything to plan, so that a
//! `touch`, a copy over itself or a restart of the daemon plans nothing.

use std::{
    collections::BTreeMap,
    fs,
    io::{self, Read},
    path::{Path, PathBuf},
    time::{Duration, Instant, SystemTime, UNIX_EPOCH},
};

use super::discover;

/// What the file system says of one file or folder.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Entry {
    length: u64,
    modified_ns: u128,
    inode: u64,
}

impl Entry {
    pub(super) fn of(metadata: &fs::Metadata) -> Self {
        use std::os::unix::fs::MetadataExt;
        let modified = metadata.modified().unwrap_or(UNIX_EPOCH);
        let since = modified.duration_since(UNIX_EPOCH).unwrap_or_default();
        // The length of a folder says nothing that its time doesn't.
        let length = if metadata.is_dir() { 0 } else { metadata.len() };
        Self { length, modified_ns: since.as_nanos(), inode: metadata.ino() }
    }

    #[cfg(test)]
    pub(super) fn of_length(length: u64) -> Self {
        Self { length, modified_ns: 0, inode: 0 }
    }
}

/// What a project's input looks like from outside.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Stamp {
    /// Model files and `viewrank.toml`.
    files: BTreeMap<PathBuf, Entry>,
    /// Image folders: their entries count, not the bytes of the images.
    folders: BTreeMap<PathBuf, Entry>,
}

impl Stamp {
    /// Looks at the project; what isn't there is left out.
    pub fn of(project: &Path, follow_links: bool) -> Self {
        let mut stamp = Self::default();
        let images = discover::image_folders(project);
        for folder in discover::input_folders(project, follow_links) {
            if images.contains(&folder) {
                if let Ok(metadata) = fs::metadata(&folder) {
                    stamp.folders.insert(folder, Entry::of(&metadata));
                }
                continue;
            }
            for entry in fs::read_dir(&folder).into_iter().flatten().filter_map(Result::ok) {
                let is_input = entry.file_name().to_str().is_some_and(is_input_file);
                if let Some(metadata) = fs::metadata(entry.path()).ok().filter(|m| is_input && m.is_file()) {
                    stamp.files.insert(entry.path(), Entry::of(&metadata));
                }
            }
        }
        stamp
    }

    pub fn is_empty(&self) -> bool {
        self.files.is_empty()
    }

    /// Bytes of the model files.
    pub fn bytes(&self) -> u64 {
        self.files.values().map(|entry| entry.length).sum()
    }

    /// The time of the youngest file, for people.
    pub fn newest(&self) -> SystemTime {
        let newest = self.files.values().map(|entry| entry.modified_ns).max().unwrap_or(0);
        UNIX_EPOCH + Duration::from_nanos(u64::try_from(newest).unwrap_or(0))
    }
}

fn is_input_file(name: &str) -> bool {
    let suffixes = [".mvs", ".ori", ".nvm", ".out", ".ply"];
    discover::is_model_file(name) || name == "viewrank.toml" || suffixes.iter().any(|suffix| name.ends_with(suffix))
}

/// A stamp (of input or of depth maps) and since when it has been the same.
#[derive(Clone, Debug)]
pub struct Stillness<S> {
    stamp: S,
    since: Instant,
}

impl<S: PartialEq> Stillness<S> {
    pub fn new(stamp: S, now: Instant) -> Self {
        Self { stamp, since: now }
    }

    /// Takes a new look; true when something changed.
    pub fn observe(&mut self, stamp: S, now: Instant) -> bool {
        let changed = stamp != self.stamp;
        if changed {
            *self = Self::new(stamp, now);
        }
        changed
    }

    /// The same stamp, but not still until now.
    pub fn restart(&mut self, now: Instant) {
        self.since = now;
    }

    pub fn stamp(&self) -> &S {
        &self.stamp
    }

    /// When it will have been still for `settle`.
    pub fn settled_at(&self, settle: Duration) -> Instant {
        self.since + settle
    }
}

/// Hash of a project's input: the content of the model files, the names in the image folders, and the settings in force.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(transparent)]
pub struct Fingerprint(String);

/// Hashes of files by their path and stamp, so that an unchanged file is read once.
#[derive(Debug, Default)]
pub struct HashCache(BTreeMap<PathBuf, (Entry, blake3::Hash)>);

impl HashCache {
    /// The fingerprint of the input as it is now. Fails where a file vanishes or can't be read meanwhile.
    pub fn fingerprint(&mut self, project: &Path, stamp: &Stamp, settings: &[u8]) -> io::Result<Fingerprint> {
        let mut hasher = blake3::Hasher::new();
        hasher.update(env!("CARGO_PKG_VERSION").as_bytes()).update(blake3::hash(settings).as_bytes());
        // What `viewrank.toml` says is in the settings; a broken one says nothing.
        for (path, entry) in stamp.files.iter().filter(|(path, _)| !path.ends_with("viewrank.toml")) {
            let relative = path.strip_prefix(project).unwrap_or(path);
            hasher.update(relative.as_os_str().as_encoded_bytes()).update(&[0]);
            hasher.update(self.file(path, *entry)?.as_bytes());
        }
        for folder in stamp.folders.keys() {
            for name in sorted_names(folder)? {
                hasher.update(name.as_encoded_bytes()).update(&[0]);
            }
            hasher.update(&[1]);
        }
        self.0.retain(|path, _| !path.starts_with(project) || stamp.files.contains_key(path));
        Ok(Fingerprint(hasher.finalize().to_hex().to_string()))
    }

    /// Forgets what is kept of a project.
    pub fn forget(&mut self, project: &Path) {
        self.0.retain(|path, _| !path.starts_with(project));
    }

    fn file(&mut self, path: &Path, entry: Entry) -> io::Result<blake3::Hash> {
        if let Some((_, hash)) = self.0.get(path).filter(|(known, _)| *known == entry) {
            return Ok(*hash);
        }
        let mut hasher = blake3::Hasher::new();
        let mut file = fs::File::open(path)
            .map_err(|error| io::Error::new(error.kind(), format!("{}: {error}", path.display())))?;
        let mut buffer = vec![0; 1 << 18];
        loop {
            match file.read(&mut buffer)? {
                0 => break,
                n => hasher.update(&buffer[..n]),
            };
        }
        let hash = hasher.finalize();
        self.0.insert(path.into(), (entry, hash));
        Ok(hash)
    }
}

fn sorted_names(folder: &Path) -> io::Result<Vec<std::ffi::OsString>> {
    let mut names = fs::read_dir(folder)?.map(|entry| Ok(entry?.file_name())).collect::<io::Result<Vec<_>>>()?;
    names.sort();
    Ok(names)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn project() -> tempfile::TempDir {
        let root = tempfile::tempdir().expect("a temporary folder");
        fs::create_dir_all(root.path().join("sparse/0")).expect("a folder");
        fs::create_dir_all(root.path().join("images/left")).expect("a folder");
        fs::create_dir_all(root.path().join("viewrank")).expect("a folder");
        fs::write(root.path().join("sparse/0/cameras.bin"), "cameras").expect("a file");
        root
    }

    #[test]
    fn input_is_still_once_nothing_changed_for_the_settle_time() {
        let root = project();
        let (start, settle) = (Instant::now(), Duration::from_secs(2));
        let mut still = Stillness::new(Stamp::of(root.path(), false), start);
        fs::write(root.path().join("sparse/0/cameras.bin"), "longer now").expect("a file");
        let later = start + Duration::from_secs(1);
        assert!(still.observe(Stamp::of(root.path(), false), later));
        assert!(!still.observe(Stamp::of(root.path(), false), later + settle));
        assert_eq!(still.settled_at(settle), later + settle);
    }

    #[test]
    fn outputs_are_not_input_and_new_images_are() {
        let root = project();
        let before = Stamp::of(root.path(), false);
        fs::write(root.path().join("viewrank/manifest.json"), "{}").expect("a file");
        assert_eq!(Stamp::of(root.path(), false), before);
        fs::write(root.path().join("images/left/1.jpg"), "").expect("a file");
        assert_ne!(Stamp::of(root.path(), false), before);
    }

    #[test]
    fn a_file_copied_over_itself_keeps_the_fingerprint() {
        let root = project();
        let mut cache = HashCache::default();
        let mut print = |settings: &[u8]| {
            let stamp = Stamp::of(root.path(), false);
            cache.fingerprint(root.path(), &stamp, settings).expect("readable files")
        };
        let before = print(b"a");
        fs::remove_file(root.path().join("sparse/0/cameras.bin")).expect("the file");
        fs::write(root.path().join("sparse/0/cameras.bin"), "cameras").expect("a file");
        assert_eq!(print(b"a"), before);
        assert_ne!(print(b"b"), before, "other settings");
        fs::write(root.path().join("sparse/0/cameras.bin"), "Cameras").expect("a file");
        assert_ne!(print(b"a"), before);
    }
}
