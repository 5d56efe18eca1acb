//! Is a project's input complete and still? And is it what was planned already?
//!
//! Two looks at the input. A [`Stamp`] is what the file system says of it (length, times, inode): cheap, and any difference means
//! "not still yet". A [`Fingerprint`] is a hash of the content: it decides whether there is anything to plan, so that a
//! `touch`, a copy over itself or a restart of the daemon plans nothing.

use std::{
    collections::BTreeMap,
    ffi::OsStr,
    fs, io,
    path::{Path, PathBuf},
    sync::{Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant, UNIX_EPOCH},
};

use super::{
    discover::{self, InputFolders},
    platform,
};
use crate::base::input;

/// What the file system says of one file or folder.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Entry {
    length: u64,
    modified_ns: u128,
    /// When content or name changed, which no program can set.
    changed_ns: u128,
    inode: u64,
}

impl Entry {
    pub(super) fn of(metadata: &fs::Metadata) -> Self {
        let modified = metadata.modified().unwrap_or(UNIX_EPOCH);
        let since = modified.duration_since(UNIX_EPOCH).unwrap_or_default();
        // The length of a folder says nothing that its time doesn't.
        let length = if metadata.is_dir() { 0 } else { metadata.len() };
        let (changed_ns, inode) = platform::identity(metadata);
        Self { length, modified_ns: since.as_nanos(), changed_ns, inode }
    }

    #[cfg(test)]
    pub(super) fn of_length(length: u64) -> Self {
        Self { length, modified_ns: 0, changed_ns: 0, inode: 0 }
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
    /// Folders that can't be looked into, and why.
    unreadable: BTreeMap<PathBuf, String>,
}

impl Stamp {
    /// Looks at the project; what isn't there is left out.
    pub fn of(project: &Path, follow_links: bool) -> Self {
        Self::of_folders(&InputFolders::of(project, follow_links))
    }

    /// Looks into these folders.
    pub fn of_folders(folders: &InputFolders) -> Self {
        let mut stamp = Self::default();
        for folder in &folders.images {
            if let Ok(metadata) = fs::metadata(folder) {
                stamp.folders.insert(folder.clone(), Entry::of(&metadata));
            }
        }
        for folder in &folders.models {
            // What lies beside orientations is their cloud, elsewhere it is what a backend made.
            let is_input =
                |name: &OsStr| name.to_str().is_some_and(|name| is_input_file(name, folders.has_orientations));
            let files = stamp.entries(folder, is_input);
            stamp.files.extend(files);
        }
        for folder in &folders.masks {
            let files = stamp.entries(folder, |_| true);
            stamp.beside.extend(files);
        }
        stamp
    }

    /// The files of a folder that are wanted by their names.
    fn entries(&mut self, folder: &Path, wanted: impl Fn(&OsStr) -> bool) -> Vec<(PathBuf, Entry)> {
        let entries = fs::read_dir(folder).and_then(|entries| entries.collect::<io::Result<Vec<_>>>());
        let entries = entries.unwrap_or_else(|error| {
            if error.kind() != io::ErrorKind::NotFound {
                self.unreadable.insert(folder.into(), error.to_string());
            }
            Vec::new()
        });
        let paths = entries.iter().filter(|entry| wanted(&entry.file_name())).map(fs::DirEntry::path);
        let file =
            |path: PathBuf| fs::metadata(&path).ok().filter(fs::Metadata::is_file).map(|m| (path, Entry::of(&m)));
        paths.filter_map(file).collect()
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

    /// What keeps the model from being seen, for people.
    pub fn trouble(&self) -> Option<String> {
        let (folder, reason) = self.unreadable.first_key_value()?;
        Some(format!("cannot look into {}: {reason}", folder.display()))
    }

    /// Bytes of the largest model that may be planned: the project's COLMAP models go before scenes of other programs and before
    /// the model of its dense workspace.
    pub fn bytes(&self) -> u64 {
        let mut models: BTreeMap<(bool, PathBuf), u64> = BTreeMap::new();
        for (path, entry) in &self.files {
            let name = path.file_name().and_then(OsStr::to_str).unwrap_or("");
            let is_colmap = discover::is_model_file(name);
            let is_dense = path.components().any(|part| part.as_os_str() == discover::DENSE);
            // A COLMAP model is the files of a folder in one format, a scene one file, a SURE model all that there is.
            let model = match path.extension().and_then(OsStr::to_str) {
                Some("mvs") => path.clone(),
                Some(extension) if is_colmap => path.with_file_name(extension),
                _ => PathBuf::new(),
            };
            *models.entry((is_colmap && !is_dense, model)).or_default() += entry.length;
        }
        let first = models.keys().any(|(first, _)| *first);
        models.iter().filter(|((of_first, _), _)| *of_first == first).map(|(_, bytes)| *bytes).max().unwrap_or(0)
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

    /// The same stamp, but not still until then.
    pub fn restart(&mut self, then: Instant) {
        self.since = self.since.max(then);
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
    /// or can't be read meanwhile. Others may use the cache while files are read.
    pub fn fingerprint(
        cache: &Mutex<Self>,
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
            hasher.update(Self::file(cache, path)?.as_bytes());
        }
        for folder in stamp.folders.keys() {
            for name in sorted_names(folder)? {
                hasher.update(name.as_encoded_bytes()).update(&[0]);
            }
            hasher.update(&[1]);
        }
        let is_input = |path: &PathBuf| model.contains(path) || stamp.beside.contains_key(path);
        lock(cache).0.retain(|path, _| !path.starts_with(project) || is_input(path));
        Ok(Fingerprint(hasher.finalize().to_hex().to_string()))
    }

    /// Forgets what is kept of a project.
    pub fn forget(&mut self, project: &Path) {
        self.0.retain(|path, _| !path.starts_with(project));
    }

    fn file(cache: &Mutex<Self>, path: &Path) -> io::Result<blake3::Hash> {
        let named = |error: io::Error| io::Error::new(error.kind(), format!("{}: {error}", path.display()));
        let file = input::open(path).map_err(named)?;
        // Of before the reading: what is written meanwhile has another stamp.
        let entry = Entry::of(&file.metadata().map_err(named)?);
        if let Some((_, hash)) = lock(cache).0.get(path).filter(|(known, _)| *known == entry) {
            return Ok(*hash);
        }
        let hash = blake3::Hasher::new().update_reader(file).map_err(named)?.finalize();
        lock(cache).0.insert(path.into(), (entry, hash));
        Ok(hash)
    }
}

/// What is kept is whole between any two statements, whoever panicked.
pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
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
    fn a_file_rewritten_in_place_with_its_length_and_time_is_another() {
        let root = project();
        let path = root.path().join("sparse/0/cameras.bin");
        let time = fs::metadata(&path).and_then(|m| m.modified()).expect("a time");
        let cache = Mutex::new(HashCache::default());
        let print = |stamp: &Stamp| {
            HashCache::fingerprint(&cache, root.path(), std::slice::from_ref(&path), stamp, b"").expect("readable")
        };
        let before = Stamp::of(root.path(), false);
        let print_before = print(&before);
        // Until the clock of the file system has gone on.
        let end = Instant::now() + Duration::from_secs(10);
        while Stamp::of(root.path(), false) == before && Instant::now() < end {
            fs::write(&path, "CAMERAS").expect("a file");
            fs::File::options().write(true).open(&path).and_then(|f| f.set_modified(time)).expect("a time");
        }
        assert_eq!(fs::metadata(&path).and_then(|m| m.modified()).expect("a time"), time);
        assert_ne!(print(&Stamp::of(root.path(), false)), print_before);
    }

    #[test]
    fn what_cannot_be_looked_into_is_said() {
        let root = project();
        let no_folder = root.path().join("sparse/0/cameras.bin");
        let stamp = |models| Stamp::of_folders(&InputFolders { models, ..InputFolders::default() });
        let trouble = stamp(vec![no_folder.clone()]).trouble().expect("trouble");
        assert!(trouble.starts_with(&format!("cannot look into {}: ", no_folder.display())), "{trouble}");
        assert_eq!(stamp(vec![root.path().join("sparse/0"), root.path().join("gone")]).trouble(), None);
    }

    #[test]
    fn memory_is_estimated_by_the_largest_model_that_may_be_planned() {
        let bytes = |files: &[(&str, u64)]| {
            let entry = |&(path, length): &(&str, u64)| (Path::new("/p").join(path), Entry::of_length(length));
            Stamp { files: files.iter().map(entry).collect(), ..Stamp::default() }.bytes()
        };
        let colmap = [("sparse/0/images.bin", 5), ("sparse/0/cameras.bin", 1), ("sparse/1/images.bin", 7)];
        assert_eq!(bytes(&colmap), 7);
        let beside = [("scene_dense.mvs", 1 << 40), ("dense/sparse/images.bin", 1 << 30), ("sparse/0/images.txt", 6)];
        assert_eq!(bytes(&[&colmap[..], &beside[..]].concat()), 7);
        assert_eq!(bytes(&beside[..2]), 1 << 40);
        assert_eq!(bytes(&[("1.ori", 2), ("2.ori", 2), ("cloud.ply", 9), ("scene.mvs", 3)]), 13);
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
        let cache = Mutex::new(HashCache::default());
        let print =
            |stamp: Stamp| HashCache::fingerprint(&cache, root.path(), &[], &stamp, b"").expect("readable files");
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
        let cache = Mutex::new(HashCache::default());
        let print = |settings: &[u8]| {
            let stamp = Stamp::of(root.path(), false);
            let model = [root.path().join("sparse/0/cameras.bin")];
            HashCache::fingerprint(&cache, root.path(), &model, &stamp, settings).expect("readable files")
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
