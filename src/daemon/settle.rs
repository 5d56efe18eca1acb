//! Detects input that is still, and input that was planned already.
//!
//! A [`Stamp`] is the file-system metadata of the input (length, times, inode): cheap, and any difference means "not still yet". A
//! [`Fingerprint`] is a hash of the content and decides whether there is anything to plan, so that a `touch`, a copy over itself or a
//! restart of the daemon plans nothing.

use std::{
    collections::BTreeMap,
    ffi::OsStr,
    fs, io,
    path::{Path, PathBuf},
    sync::{Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant, SystemTime, UNIX_EPOCH},
};

use super::discover::{self, InputFolders};
use crate::{base::input, io::project::is_image};

/// Metadata of one file or folder.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Entry {
    length: u64,
    modified_ns: u128,
    /// Last change of content or name, in ns since 1970; no program can set it.
    changed_ns: u128,
    inode: u64,
}

impl Entry {
    const NONE: Self = Self { length: 0, modified_ns: 0, changed_ns: 0, inode: 0 };

    pub(super) fn from_metadata(metadata: &fs::Metadata) -> Self {
        let modified = metadata.modified().unwrap_or(UNIX_EPOCH);
        let since = modified.duration_since(UNIX_EPOCH).unwrap_or_default();
        // The modification time of a folder covers its length.
        let length = if metadata.is_dir() { 0 } else { metadata.len() };
        let (changed_ns, inode) = input::identity(metadata);
        Self { length, modified_ns: since.as_nanos(), changed_ns, inode }
    }

    #[cfg(test)]
    pub(super) fn of_length(length: u64) -> Self {
        Self { length, modified_ns: 0, changed_ns: 0, inode: 0 }
    }
}

/// The files of one image folder, as digests: there may be a hundred thousand, and plans compare pictures.
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
            let found = is_image(&path).then(|| fs::metadata(&path).ok()).flatten().filter(fs::Metadata::is_file);
            let Entry { length, modified_ns, changed_ns, inode } =
                found.map_or(Entry::NONE, |found| Entry::from_metadata(&found));
            for hasher in [&mut metadata, &mut content] {
                hasher.update(name.as_encoded_bytes()).update(&[0]);
                hasher.update(&length.to_le_bytes()).update(&modified_ns.to_le_bytes());
            }
            metadata.update(&changed_ns.to_le_bytes()).update(&inode.to_le_bytes());
            newest = changed_ns.max(newest);
        }
        Ok(Self { metadata: metadata.finalize(), content: content.finalize(), changed_ns: newest })
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

    /// Returns the files of a folder whose names are `wanted`.
    fn entries(&mut self, folder: &Path, wanted: impl Fn(&OsStr) -> bool) -> Vec<(PathBuf, Entry)> {
        let entries = fs::read_dir(folder).and_then(|entries| entries.collect::<io::Result<Vec<_>>>());
        let entries = entries.unwrap_or_else(|error| {
            self.note_unreadable(folder, &error);
            Vec::new()
        });
        let paths = entries.iter().filter(|entry| wanted(&entry.file_name())).map(fs::DirEntry::path);
        let file = |path: PathBuf| {
            fs::metadata(&path).ok().filter(fs::Metadata::is_file).map(|m| (path, Entry::from_metadata(&m)))
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
        let entry = |path: &PathBuf| Some((path.clone(), Entry::from_metadata(&fs::metadata(path).ok()?)));
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

    /// Size in bytes of the largest model that may be planned: the project's COLMAP models have priority over scenes of other programs
    /// and over the model of its dense workspace.
    pub fn bytes(&self) -> u64 {
        let mut models: BTreeMap<(bool, PathBuf), u64> = BTreeMap::new();
        for (path, entry) in &self.files {
            let name = path.file_name().and_then(OsStr::to_str).unwrap_or("");
            let is_colmap = discover::is_model_file(name);
            let is_dense = path.components().any(|part| part.as_os_str() == discover::DENSE);
            // A COLMAP model is all files of one format in a folder, an OpenMVS scene one file, a SURE model all other files.
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

    /// Returns since when the input has been as it was at `scanned`, given its last event at `heard`. Changes that raised no event
    /// are dated by the file system.
    pub fn same_since(&self, heard: Instant, (scanned, time): (Instant, SystemTime)) -> Instant {
        let files = self.files.values().chain(self.beside.values()).map(|entry| entry.changed_ns);
        let folders = self.folders.values().map(|(entry, images)| entry.changed_ns.max(images.changed_ns));
        let newest = files.chain(folders).max().unwrap_or(0);
        let newest = UNIX_EPOCH + Duration::from_nanos(u64::try_from(newest).unwrap_or(u64::MAX));
        let ago = time.duration_since(newest).unwrap_or_default();
        heard.max(scanned.checked_sub(ago).unwrap_or(heard)).min(scanned)
    }
}

fn is_input_file(name: &str, with_cloud: bool) -> bool {
    let ends = |suffixes: &[&str]| suffixes.iter().any(|suffix| name.ends_with(suffix));
    let cloud = with_cloud && ends(&[".nvm", ".out", ".ply"]);
    discover::is_model_file(name) || name == "viewrank.toml" || ends(&[".mvs", ".ori"]) || cloud
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

/// Hash of a project's input: the content of model files, masks and files named in the settings; the names in the image folders, with
/// length and modification time of each image; and the settings in force. Images are too large to be hashed whole.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(transparent)]
pub struct Fingerprint(String);

/// Hashes of files by path and metadata, so that an unchanged file is read once.
#[derive(Debug, Default)]
pub struct HashCache(BTreeMap<PathBuf, (Entry, blake3::Hash)>);

impl HashCache {
    /// Computes the fingerprint of the current input; `model` are the files of the model to plan. The cache isn't locked while files
    /// are read.
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
        hasher.update(env!("CARGO_PKG_VERSION").as_bytes()).update(blake3::hash(settings).as_bytes());
        // `settings` already holds the content of a valid `viewrank.toml`.
        let beside = stamp.beside.keys().filter(|path| !path.ends_with("viewrank.toml"));
        for path in model.iter().chain(beside) {
            let relative = path.strip_prefix(project).unwrap_or(path);
            hasher.update(relative.as_os_str().as_encoded_bytes()).update(&[0]);
            hasher.update(Self::file(cache, path)?.as_bytes());
        }
        // From the stamp, which is older than anything a plan reads: an image that changes meanwhile differs from it.
        stamp.folders.values().for_each(|(_, images)| _ = hasher.update(images.content.as_bytes()));
        let is_input = |path: &PathBuf| model.contains(path) || stamp.beside.contains_key(path);
        lock(cache).0.retain(|path, _| !path.starts_with(project) || is_input(path));
        Ok(Fingerprint(hasher.finalize().to_hex().to_string()))
    }

    /// Removes the hashes of a project.
    pub fn forget(&mut self, project: &Path) {
        self.0.retain(|path, _| !path.starts_with(project));
    }

    fn file(cache: &Mutex<Self>, path: &Path) -> io::Result<blake3::Hash> {
        let named = |error: io::Error| io::Error::new(error.kind(), format!("{}: {error}", path.display()));
        let file = input::open(path).map_err(named)?;
        // Taken before reading, so that a file written meanwhile gets another entry.
        let entry = Entry::from_metadata(&file.metadata().map_err(named)?);
        if let Some((_, hash)) = lock(cache).0.get(path).filter(|(known, _)| *known == entry) {
            return Ok(*hash);
        }
        let hash = blake3::Hasher::new().update_reader(file).map_err(named)?.finalize();
        lock(cache).0.insert(path.into(), (entry, hash));
        Ok(hash)
    }
}

/// Locks a mutex even if a thread that held it panicked: the daemon's caches are consistent between any two statements.
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
    fn changes_without_events_include_images_written_after_their_folder_changed() {
        let root = tempfile::tempdir().expect("a temporary folder");
        let images = [root.path().to_path_buf()];
        std::fs::write(root.path().join("a.jpg"), "begun").expect("a file");
        let folder = std::fs::metadata(root.path()).expect("a folder").modified().expect("a time");
        std::thread::sleep(Duration::from_millis(20));
        std::fs::write(root.path().join("a.jpg"), "more of it").expect("a file");
        assert_eq!(std::fs::metadata(root.path()).expect("a folder").modified().expect("a time"), folder);
        let stamp = Stamp::of_folders(&InputFolders { images: images.into(), ..InputFolders::default() });
        let (scanned, time) = (Instant::now() + Duration::from_secs(7), SystemTime::now() + Duration::from_secs(7));
        let heard = scanned - Duration::from_secs(9);
        let since = stamp.same_since(heard, (scanned, time));
        assert!(since > scanned - Duration::from_secs(8) && since <= scanned, "not as of the folder's change");
    }

    #[test]
    fn input_has_settled_once_nothing_changed_for_the_settle_time() {
        let root = project();
        let (start, settle) = (Instant::now(), Duration::from_secs(2));
        let mut still = Stillness::new(Stamp::read(root.path(), false), start);
        fs::write(root.path().join("sparse/0/cameras.bin"), "longer now").expect("a file");
        let later = start + Duration::from_secs(1);
        assert!(still.observe(Stamp::read(root.path(), false), later));
        assert!(!still.observe(Stamp::read(root.path(), false), later + settle));
        assert_eq!(still.settled_at(settle), later + settle);
    }

    #[test]
    fn changes_without_events_are_dated_by_the_file_system() {
        let entry = |seconds: u128| Entry { changed_ns: seconds * 1_000_000_000, ..Entry::of_length(1) };
        let files = BTreeMap::from([("a".into(), entry(100)), ("b".into(), entry(107))]);
        let stamp = Stamp { files, ..Stamp::default() };
        let (start, second) = (Instant::now() + Duration::from_secs(3600), Duration::from_secs(1));
        let scanned = (start + 10 * second, UNIX_EPOCH + 110 * second);
        assert_eq!(stamp.same_since(start, scanned), start + 7 * second, "written after the last event");
        assert_eq!(
            stamp.same_since(start + 9 * second, scanned),
            start + 9 * second,
            "older files that were moved here"
        );
        let earlier = (scanned.0, UNIX_EPOCH + 50 * second);
        assert_eq!(stamp.same_since(start, earlier), scanned.0, "dated by a clock that is ahead");
    }

    #[test]
    fn a_file_rewritten_with_its_old_length_and_time_has_another_fingerprint() {
        let root = project();
        let path = root.path().join("sparse/0/cameras.bin");
        let time = fs::metadata(&path).and_then(|m| m.modified()).expect("a time");
        let cache = Mutex::new(HashCache::default());
        let print = |stamp: &Stamp| {
            HashCache::fingerprint(&cache, root.path(), std::slice::from_ref(&path), stamp, b"").expect("readable")
        };
        let before = Stamp::read(root.path(), false);
        let print_before = print(&before);
        // Until the clock of the file system has advanced.
        let end = Instant::now() + Duration::from_secs(10);
        while Stamp::read(root.path(), false) == before && Instant::now() < end {
            fs::write(&path, "CAMERAS").expect("a file");
            fs::File::options().write(true).open(&path).and_then(|f| f.set_modified(time)).expect("a time");
        }
        assert_eq!(fs::metadata(&path).and_then(|m| m.modified()).expect("a time"), time);
        assert_ne!(print(&Stamp::read(root.path(), false)), print_before);
    }

    #[test]
    fn unreadable_folders_are_reported() {
        let root = project();
        let no_folder = root.path().join("sparse/0/cameras.bin");
        let stamp = |models| Stamp::of_folders(&InputFolders { models, ..InputFolders::default() });
        let read_error = stamp(vec![no_folder.clone()]).read_error().expect("read_error");
        assert!(read_error.starts_with(&format!("cannot read folder {}: ", no_folder.display())), "{read_error}");
        assert_eq!(stamp(vec![root.path().join("sparse/0"), root.path().join("gone")]).read_error(), None);
    }

    #[test]
    fn memory_is_estimated_from_the_largest_model_that_may_be_planned() {
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
    fn new_images_are_input_and_outputs_are_not() {
        let root = project();
        let before = Stamp::read(root.path(), false);
        fs::write(root.path().join("viewrank/manifest.json"), "{}").expect("a file");
        assert_eq!(Stamp::read(root.path(), false), before);
        fs::write(root.path().join("images/left/1.jpg"), "").expect("a file");
        assert_ne!(Stamp::read(root.path(), false), before);
    }

    #[test]
    fn an_image_overwritten_in_place_is_another_input_and_a_note_beside_it_is_not() {
        let root = project();
        let image = root.path().join("images/left/1.jpg");
        fs::write(&image, "a picture").expect("a file");
        fs::write(root.path().join("images/left/notes.txt"), "a note").expect("a file");
        let cache = Mutex::new(HashCache::default());
        let input = || {
            let stamp = Stamp::read(root.path(), false);
            let print = HashCache::fingerprint(&cache, root.path(), &[], &stamp, b"").expect("readable files");
            (stamp, print)
        };
        let before = input();
        fs::write(root.path().join("images/left/notes.txt"), "another, longer note").expect("a file");
        assert_eq!(input(), before);
        let longer = "another picture";
        fs::write(&image, longer).expect("a file");
        let after = input();
        assert!(after.0 != before.0 && after.1 != before.1);
        // A copy that preserves times.
        let time = fs::metadata(&image).and_then(|m| m.modified()).expect("a time");
        fs::write(root.path().join("new"), longer).expect("a file");
        fs::File::options()
            .write(true)
            .open(root.path().join("new"))
            .and_then(|f| f.set_modified(time))
            .expect("a time");
        fs::rename(root.path().join("new"), &image).expect("a file");
        let copied = input();
        assert!(copied.0 != after.0 && copied.1 == after.1);
    }

    #[test]
    fn clouds_are_input_only_next_to_orientations() {
        let root = project();
        let stamp = || Stamp::read(root.path(), false);
        let before = stamp();
        fs::write(root.path().join("scene_dense.ply"), "ply").expect("a file");
        assert_eq!(stamp(), before);
        fs::write(root.path().join("1.ori"), "").expect("a file");
        assert_eq!(stamp().files.len(), before.files.len() + 2);
    }

    #[test]
    fn masks_and_files_named_in_the_settings_are_input() {
        let root = project();
        let mesh = root.path().join("mesh.ply");
        let stamp = || Stamp::read(root.path(), false).with(std::slice::from_ref(&mesh));
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
            let stamp = Stamp::read(root.path(), false);
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
