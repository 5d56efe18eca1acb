//! Is a project's input complete and still? And is it what was planned already?
//!
//! Two looks at the input. A [`Stamp`] is what the file system says of it (length, time, inode): cheap, and any difference means
//! "not still yet". A [`Fingerprint`] is a hash of the content: it decides whether there is anything to plan, so that a
//! `touch`, a copy over itself or a restart of the daemon plans nothing.

use std::{
    collections::BTreeMap,
    fs, io,
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
    /// Masks, and what the settings name.
    beside: BTreeMap<PathBuf, Entry>,
    /// Image folders: their entries count, not the bytes of the images.
    folders: BTreeMap<PathBuf, Entry>,
}

impl Stamp {
    /// Looks at the project; what isn't there is left out.
    pub fn of(project: &Path, follow_links: bool) -> Self {
        let mut stamp = Self::default();
        let images = discover::image_folders(project);
        let masks = discover::mask_folders(project);
        let folders = discover::input_folders(project, follow_links);
        // What lies beside orientations is their cloud, elsewhere it is what a backend made.
        let with_cloud = discover::holds_orientations(project);
        for folder in folders {
            if images.contains(&folder) {
                if let Ok(metadata) = fs::metadata(&folder) {
                    stamp.folders.insert(folder, Entry::of(&metadata));
                }
                continue;
            }
            for entry in fs::read_dir(&folder).into_iter().flatten().filter_map(Result::ok) {
                let is_mask = masks.contains(&folder);
                let is_input =
                    is_mask || entry.file_name().to_str().is_some_and(|name| is_input_file(name, with_cloud));
                if let Some(metadata) = fs::metadata(entry.path()).ok().filter(|m| is_input && m.is_file()) {
                    let files = if is_mask { &mut stamp.beside } else { &mut stamp.files };
                    files.insert(entry.path(), Entry::of(&metadata));
                }
            }
        }
        stamp
    }

    /// The same with these files, as far as they are there.
    pub fn with(mut self, named: &[PathBuf]) -> Self {
        let entry = |path: &PathBuf| Some((path.clone(), Entry::of(&fs::metadata(path).ok()?)));
        self.beside.extend(named.iter().filter_map(entry));
        self
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

fn is_input_file(name: &str, with_cloud: bool) -> bool {
    let ends = |suffixes: &[&str]| suffixes.iter().any(|suffix| name.ends_with(suffix));
    let cloud = with_cloud && ends(&[".nvm", ".out", ".ply"]);
    discover::is_model_file(name) || name == "viewrank.toml" || ends(&[".mvs", ".ori"]) || cloud
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

/// Hash of a project's input: the content of the model's files, of masks and of what the settings name, the names in the image
/// folders, and the settings in force.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(transparent)]
pub struct Fingerprint(String);

/// Hashes of files by their path and stamp, so that an unchanged file is read once.
#[derive(Debug, Default)]
pub struct HashCache(BTreeMap<PathBuf, (Entry, blake3::Hash)>);

impl HashCache {
    /// The fingerprint of the input as it is now; `model` are the files of the model that is planned. Fails where a file vanishes
    /// or can't be read meanwhile.
    pub fn fingerprint(
        &mut self,
        project: &Path,
        model: &[PathBuf],
        stamp: &Stamp,
        settings: &[u8],
    ) -> io::Result<Fingerprint> {
        let mut hasher = blake3::Hasher::new();
        hasher.update(env!("CARGO_PKG_VERSION").as_bytes()).update(blake3::hash(settings).as_bytes());
        // What `viewrank.toml` says is in the settings; a broken one says nothing.
        let beside = stamp.beside.keys().filter(|path| !path.ends_with("viewrank.toml"));
        for path in model.iter().chain(beside) {
            let relative = path.strip_prefix(project).unwrap_or(path);
            hasher.update(relative.as_os_str().as_encoded_bytes()).update(&[0]);
            hasher.update(self.file(path)?.as_bytes());
        }
        for folder in stamp.folders.keys() {
            for name in sorted_names(folder)? {
                hasher.update(name.as_encoded_bytes()).update(&[0]);
            }
            hasher.update(&[1]);
        }
        self.0.retain(|path, _| !path.starts_with(project) || model.contains(path) || stamp.beside.contains_key(path));
        Ok(Fingerprint(hasher.finalize().to_hex().to_string()))
    }

    /// Forgets what is kept of a project.
    pub fn forget(&mut self, project: &Path) {
        self.0.retain(|path, _| !path.starts_with(project));
    }

    fn file(&mut self, path: &Path) -> io::Result<blake3::Hash> {
        let named = |error: io::Error| io::Error::new(error.kind(), format!("{}: {error}", path.display()));
        let file = fs::File::open(path).map_err(named)?;
        // Of before the reading: what is written meanwhile has another stamp.
        let entry = Entry::of(&file.metadata().map_err(named)?);
        if let Some((_, hash)) = self.0.get(path).filter(|(known, _)| *known == entry) {
            return Ok(*hash);
        }
        let hash = blake3::Hasher::new().update_reader(file).map_err(named)?.finalize();
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
    fn clouds_are_input_beside_orientations_and_a_backend_s_elsewhere() {
        let root = project();
        let stamp = || Stamp::of(root.path(), false);
        let before = stamp();
        fs::write(root.path().join("scene_dense.ply"), "ply").expect("a file");
        assert_eq!(stamp(), before);
        fs::write(root.path().join("1.ori"), "").expect("a file");
        assert_eq!(stamp().files.len(), before.files.len() + 2);
    }

    #[test]
    fn masks_and_what_the_settings_name_are_input() {
        let root = project();
        let mesh = root.path().join("mesh.ply");
        let stamp = || Stamp::of(root.path(), false).with(std::slice::from_ref(&mesh));
        let mut cache = HashCache::default();
        let mut print = |stamp: Stamp| cache.fingerprint(root.path(), &[], &stamp, b"").expect("readable files");
        let mut seen = vec![print(stamp())];
        for (file, content) in
            [("mesh.ply", "a"), ("mesh.ply", "b"), ("masks/1.jpg.png", "a"), ("masks/1.jpg.png", "b")]
        {
            let path = root.path().join(file);
            fs::create_dir_all(path.parent().expect("below the root")).expect("a folder");
            // Another file, should the clock be coarse.
            _ = fs::remove_file(&path);
            fs::write(root.path().join("new"), content).expect("a file");
            fs::rename(root.path().join("new"), path).expect("a file");
            let now = print(stamp());
            assert!(!seen.contains(&now), "{file}");
            seen.push(now);
        }
    }

    #[test]
    fn a_file_copied_over_itself_keeps_the_fingerprint() {
        let root = project();
        let mut cache = HashCache::default();
        let mut print = |settings: &[u8]| {
            let stamp = Stamp::of(root.path(), false);
            let model = [root.path().join("sparse/0/cameras.bin")];
            cache.fingerprint(root.path(), &model, &stamp, settings).expect("readable files")
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
