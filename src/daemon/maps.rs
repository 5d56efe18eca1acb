//! Depth map files of a project: which are completely written, and which have been measured.

use std::{
    collections::BTreeMap,
    fs, io,
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use walkdir::WalkDir;

use super::{discover, settle::Entry};
use crate::{
    base::{
        error::{Advice, Hint},
        paths::is_outside,
    },
    io::depthmaps,
};

/// Pause after measuring the maps of a project, as a multiple of the time taken.
const REST: u32 = 3;

/// Depth map files by path.
pub type MapFiles = BTreeMap<PathBuf, Entry>;

/// Error about an unreadable folder that may hold depth maps. Its maps must not be taken for gone.
#[derive(Debug, thiserror::Error)]
#[error("cannot read folder {}: {source}", path.display())]
pub struct UnreadableMaps {
    path: PathBuf,
    source: io::Error,
}

impl Hint for UnreadableMaps {
    fn hint(&self) -> Option<Advice> {
        Some(
            "make it readable for the user who runs viewrank: it may hold finished depth maps"
                .into(),
        )
    }
}

/// Lists the depth map files of the project.
pub fn map_files(project: &Path, follow_links: bool) -> Result<MapFiles, UnreadableMaps> {
    scan(project, follow_links).1
}

/// Lists the depth map files of the project, without those behind links that lead out of it.
pub fn map_files_inside(project: &Path) -> Result<MapFiles, UnreadableMaps> {
    scan_where(project, &|folder| !is_outside(folder, project)).1
}

/// Returns the folders to watch for depth maps (those that hold some, and those in which such a
/// folder may appear, except the output folder itself), and the depth map files.
pub fn scan(
    project: &Path,
    follow_links: bool,
) -> (Vec<PathBuf>, Result<MapFiles, UnreadableMaps>) {
    scan_where(project, &|folder| {
        discover::may_enter(project, folder, follow_links)
    })
}

fn scan_where(
    project: &Path,
    may_enter: &dyn Fn(&Path) -> bool,
) -> (Vec<PathBuf>, Result<MapFiles, UnreadableMaps>) {
    let mut found = Found::default();
    for place in depthmaps::default_folders(project) {
        if !place.starts_with(project.join(discover::OUTPUT_FOLDER)) {
            // A folder that does not exist yet is reported by the one above it.
            let above = place
                .ancestors()
                .skip(1)
                .take_while(|above| *above != project);
            let above = above.filter(|above| above.is_dir());
            found.folders.extend(above.map(Path::to_path_buf));
        }
        let is_folder = found
            .metadata(&place, fs::metadata(&place))
            .is_some_and(|metadata| metadata.is_dir());
        if is_folder && may_enter(&place) {
            found.add_maps_in(&place);
        }
    }
    let Found {
        mut folders,
        files,
        unreadable,
    } = found;
    folders.retain(|folder| may_enter(folder));
    folders.sort();
    folders.dedup();
    (folders, unreadable.map_or(Ok(files), Err))
}

/// Results of a scan.
#[derive(Default)]
struct Found {
    folders: Vec<PathBuf>,
    files: MapFiles,
    /// The first file or folder that could not be read.
    unreadable: Option<UnreadableMaps>,
}

impl Found {
    /// Returns the metadata of a path; `None` if nothing is there, or if it cannot be read.
    fn metadata(&mut self, path: &Path, found: io::Result<fs::Metadata>) -> Option<fs::Metadata> {
        let source = match found {
            Ok(metadata) => return Some(metadata),
            Err(source) => source,
        };
        let is_gone = matches!(
            source.kind(),
            io::ErrorKind::NotFound | io::ErrorKind::NotADirectory
        );
        if !is_gone {
            self.unreadable.get_or_insert(UnreadableMaps {
                path: path.into(),
                source,
            });
        }
        None
    }

    fn add_maps_in(&mut self, place: &Path) {
        for entry in WalkDir::new(place) {
            match entry {
                Ok(entry) if entry.file_type().is_dir() => self.folders.push(entry.into_path()),
                Ok(entry) => self.add_map(place, entry.into_path()),
                Err(error) => {
                    let path = error.path().unwrap_or(place).to_path_buf();
                    self.metadata(&path, Err(error.into()));
                }
            }
        }
    }

    /// Adds a file if it is a depth map, with all files that are read for it.
    fn add_map(&mut self, place: &Path, file: PathBuf) {
        let read = depthmaps::files_of(place, &file);
        let metadata = |path: &PathBuf| {
            self.metadata(path, fs::metadata(path))
                .filter(fs::Metadata::is_file)
        };
        let found: Vec<_> = read.iter().map_while(metadata).collect();
        let entries = found.iter().map(Entry::from_metadata).reduce(Entry::with);
        self.files.extend(entries.map(|entries| (file, entries)));
    }
}

/// History of the depth map files of a project.
#[derive(Debug, Default)]
pub struct MapTracker {
    /// Each map and since when it has been unchanged.
    seen: BTreeMap<PathBuf, (Entry, Instant)>,
    /// Time at which a map was last missing.
    vanished: Option<Instant>,
    /// Maps of the last measurement.
    measured: MapFiles,
    /// Earliest time of the next measurement.
    rest_until: Option<Instant>,
}

impl MapTracker {
    /// Takes a new list of files; true if it differs.
    pub fn observe(&mut self, files: MapFiles, now: Instant) -> bool {
        let same = |(path, entry): (&PathBuf, &Entry)| {
            self.seen.get(path).is_some_and(|(known, _)| known == entry)
        };
        let changed = files.len() != self.seen.len() || !files.iter().all(same);
        let vanished = self.seen.keys().any(|path| !files.contains_key(path));
        self.vanished = if vanished { Some(now) } else { self.vanished };
        let mut before = std::mem::take(&mut self.seen);
        self.seen = files
            .into_iter()
            .map(|(path, entry)| {
                let same = before.remove(&path).filter(|(known, _)| *known == entry);
                (path, same.unwrap_or((entry, now)))
            })
            .collect();
        changed
    }

    /// Returns when the next measurement is due.
    pub fn due(&self, settle: Duration) -> Option<Instant> {
        let new = |path: &PathBuf, entry: &Entry| self.measured.get(path) != Some(entry);
        let settles = self
            .seen
            .iter()
            .filter(|(path, (entry, _))| new(path, entry))
            .map(|(_, (_, since))| *since);
        // The one that has waited longest decides, since others may come without a pause.
        let first = settles.chain(self.vanished).min()?;
        Some((first + settle).max(self.rest_until.unwrap_or(first)))
    }

    /// Number of files that are new or changed since the last measurement.
    pub fn unmeasured(&self) -> usize {
        self.seen
            .iter()
            .filter(|(path, (entry, _))| self.measured.get(*path) != Some(entry))
            .count()
    }

    /// Files that have been unchanged for `settle`.
    pub fn settled(&self, settle: Duration, now: Instant) -> MapFiles {
        let settled = self
            .seen
            .iter()
            .filter(|(_, (_, since))| *since + settle <= now);
        settled
            .map(|(path, (entry, _))| (path.clone(), *entry))
            .collect()
    }

    /// Records that these files were measured, which took `took`.
    pub fn record_measured(&mut self, files: MapFiles, took: Duration, now: Instant) {
        self.measured = files;
        self.vanished = None;
        self.rest_until = Some(now + took * REST);
    }

    /// Lets all maps be measured again, because the plan changed.
    pub fn forget_measured(&mut self) {
        self.measured.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SETTLE: Duration = Duration::from_secs(2);
    const SECOND: Duration = Duration::from_secs(1);

    /// Files of these names and lengths.
    fn files(lengths: &[(&str, u64)]) -> MapFiles {
        lengths
            .iter()
            .map(|&(name, length)| (PathBuf::from(name), Entry::of_length(length)))
            .collect()
    }

    #[test]
    fn each_map_settles_while_others_are_written() {
        let start = Instant::now();
        let mut maps = MapTracker::default();
        assert_eq!(maps.due(SETTLE), None);
        maps.observe(files(&[("a", 1)]), start);
        assert_eq!(maps.due(SETTLE), Some(start + SETTLE));
        maps.observe(files(&[("a", 1), ("b", 1)]), start + SECOND);
        maps.observe(files(&[("a", 1), ("b", 2)]), start + SETTLE);
        let settled = maps.settled(SETTLE, start + SETTLE);
        assert_eq!(settled, files(&[("a", 1)]));
        maps.record_measured(settled, Duration::ZERO, start + SETTLE);
        assert_eq!(maps.due(SETTLE), Some(start + SETTLE * 2));
        maps.record_measured(
            files(&[("a", 1), ("b", 2)]),
            Duration::ZERO,
            start + SETTLE * 2,
        );
        assert_eq!(maps.due(SETTLE), None);
        maps.observe(files(&[("b", 2)]), start + SETTLE * 3);
        assert_eq!(
            maps.due(SETTLE),
            Some(start + SETTLE * 4),
            "a missing map changes the result"
        );
    }

    #[test]
    fn measuring_takes_at_most_a_quarter_of_the_time() {
        let start = Instant::now();
        let mut maps = MapTracker::default();
        maps.record_measured(MapFiles::new(), SECOND, start);
        maps.observe(files(&[("a", 1)]), start);
        assert_eq!(maps.due(SETTLE), Some(start + SECOND * 3));
    }

    #[test]
    fn folders_in_which_maps_may_appear_are_watched_except_the_output_folder() {
        let root = tempfile::tempdir().expect("a temporary folder");
        for folder in [
            "dense/0/stereo",
            "viewrank/openmvs/x",
            "sgm/depth_maps",
            "export",
        ] {
            fs::create_dir_all(root.path().join(folder)).expect("a folder");
        }
        let watched = scan(root.path(), false).0;
        let names: Vec<_> = watched
            .iter()
            .map(|f| f.strip_prefix(root.path()).expect("below"))
            .collect();
        let expected = [
            "dense",
            "dense/0",
            "dense/0/stereo",
            "export",
            "sgm",
            "sgm/depth_maps",
            "viewrank/openmvs",
            "viewrank/openmvs/x",
        ];
        assert_eq!(names, expected.map(Path::new));
    }

    #[test]
    fn maps_are_found_wherever_backends_write_them() {
        let root = tempfile::tempdir().expect("a temporary folder");
        let maps = [
            "dense/0/stereo/depth_maps/a.geometric.bin",
            "dense/stereo/depth_maps/a.geometric.bin",
            "openmvs/depth0001.dmap",
            "sgm/depth_maps/a.npy",
            "stereo/depth_maps/a.geometric.bin",
            "viewrank/colmap/stereo/depth_maps/a.geometric.bin",
        ];
        for path in maps.iter().chain(&[
            "openmvs/scene.mvs",
            "openmvs/unfinished/0001-x/depth0001.dmap",
            "elsewhere/depth0001.dmap",
        ]) {
            let path = root.path().join(path);
            fs::create_dir_all(path.parent().expect("below the root")).expect("a folder");
            fs::write(path, "").expect("a file");
        }
        let found = map_files(root.path(), false).expect("readable");
        let names: Vec<_> = found
            .keys()
            .map(|f| f.strip_prefix(root.path()).expect("below"))
            .collect();
        assert_eq!(names, maps.map(Path::new));
    }

    #[test]
    fn a_map_changes_with_what_is_read_beside_it() {
        // `older` above the project says nothing about its maps.
        let root = tempfile::tempdir().expect("a temporary folder");
        let project = root.path().join("older/p");
        let [map, confidence] = ["depth_est", "confidence"].map(|kind| {
            project
                .join("mvsnet/depths")
                .join(kind)
                .join("00000001.pfm")
        });
        for path in [&map, &confidence] {
            fs::create_dir_all(path.parent().expect("below the root")).expect("a folder");
        }
        fs::write(&map, "").expect("a file");
        let entry = || {
            map_files(&project, false)
                .expect("readable")
                .remove(&map)
                .expect("the map")
        };
        let alone = entry();
        fs::write(&confidence, "1").expect("a file");
        assert_ne!(entry(), alone);
    }
}
