//! Finished depth maps in a workspace. COLMAP skips a problem when its files exist, whatever partners they were made with, so each export
//! notes which lists were in force, and the next one tells which maps these lists made.

use std::{collections::BTreeMap, path::Path, time::SystemTime};

use serde::{Deserialize, Serialize};

use super::{cfg, cfg::Problem};

/// Path of the note in the workspace.
pub const NOTE: &str = "stereo/viewrank/lists.json";

/// How a depth map was or will be made.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Made {
    /// Sorted: COLMAP keeps no order.
    sources: Vec<String>,
    /// A photometric map that a geometric pass cannot start from.
    filtered: bool,
    /// Long side that the images were reduced to (`max_image_size`), pixels; `None`: as they are.
    #[serde(default)]
    long_side: Option<u32>,
}

impl Made {
    pub fn new(problem: &Problem, filtered: bool, long_side: Option<u32>) -> Self {
        let mut sources = problem.sources.clone();
        sources.sort_unstable();
        Self { sources, filtered, long_side }
    }
}

/// The lists in force, by the path of the depth map under `stereo/depth_maps`, and what is known of older maps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Lists {
    in_force: BTreeMap<String, Made>,
    finished: BTreeMap<String, Made>,
}

impl Lists {
    pub fn new(in_force: BTreeMap<String, Made>) -> Self {
        Self { in_force, finished: BTreeMap::new() }
    }

    /// The lists that the maps of the workspace were made by up to now, and since when they are in force. Without a note of ours these are
    /// the lists of `patch-match.cfg`, run with COLMAP's default options.
    fn before(workspace: &Path) -> (Self, SystemTime) {
        let note = workspace.join(NOTE);
        if let Some(lists) = std::fs::read(&note).ok().and_then(|bytes| serde_json::from_slice(&bytes).ok()) {
            let since = note.metadata().and_then(|m| m.modified());
            return (lists, since.unwrap_or(SystemTime::UNIX_EPOCH));
        }
        let text = std::fs::read_to_string(workspace.join("stereo/patch-match.cfg")).unwrap_or_default();
        let kinds =
            |p: Problem| ["photometric", "geometric"].map(|k| (map_name(&p.reference, k), Made::new(&p, false, None)));
        let in_force = cfg::read_patch_match(&text).into_iter().flat_map(kinds).collect();
        (Self::new(in_force), SystemTime::UNIX_EPOCH)
    }

    /// Takes over what is known of the finished maps of the workspace; returns those that the lists would keep although they were made
    /// otherwise, or nobody knows how.
    pub fn follow(&mut self, workspace: &Path) -> Vec<String> {
        let (before, since) = Self::before(workspace);
        let modified =
            |map: &String| workspace.join("stereo/depth_maps").join(map).metadata().and_then(|m| m.modified()).ok();
        let known = |map: &String, modified: SystemTime| {
            let by_lists = modified >= since && before.in_force.contains_key(map);
            if by_lists { before.in_force.get(map) } else { before.finished.get(map) }
        };
        for map in before.in_force.keys().chain(before.finished.keys()) {
            if let Some(made) = modified(map).and_then(|at| known(map, at)) {
                self.finished.insert(map.clone(), made.clone());
            }
        }
        let stale = |(map, wanted): (&String, &Made)| modified(map).is_some() && self.finished.get(map) != Some(wanted);
        self.in_force.iter().filter(|entry| stale(*entry)).map(|(map, _)| map.clone()).collect()
    }

    pub fn to_json(&self) -> String {
        serde_json::to_string_pretty(self).expect("string keys") + "\n"
    }
}

/// Path of a map under `stereo/depth_maps` and `stereo/normal_maps`.
pub fn map_name(image: &str, kind: &str) -> String {
    format!("{image}.{kind}.bin")
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    fn lists(partners: &[&str], filtered: bool) -> Lists {
        let problem = Problem { reference: "a.jpg".into(), sources: partners.iter().map(|&s| s.into()).collect() };
        Lists::new([(map_name("a.jpg", "photometric"), Made::new(&problem, filtered, None))].into())
    }

    #[test]
    fn maps_of_another_size_are_stale() {
        let workspace = tempfile::tempdir().unwrap();
        put(workspace.path(), NOTE, &lists(&["b.jpg"], true).to_json(), 200);
        put(workspace.path(), MAP, "", 100);
        let mut smaller = lists(&["b.jpg"], true);
        smaller.in_force.values_mut().for_each(|made| made.long_side = Some(800));
        assert_eq!(smaller.follow(workspace.path()), ["a.jpg.photometric.bin"]);
        put(workspace.path(), NOTE, &smaller.to_json(), 200);
        assert!(smaller.follow(workspace.path()).is_empty());
    }

    fn put(workspace: &Path, path: &str, text: &str, age_s: u64) {
        let path = workspace.join(path);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(&path, text).unwrap();
        let time = SystemTime::now() - Duration::from_secs(age_s);
        std::fs::File::options().append(true).open(path).unwrap().set_modified(time).unwrap();
    }

    const MAP: &str = "stereo/depth_maps/a.jpg.photometric.bin";

    #[test]
    fn colmap_stale_maps_skipped() {
        let workspace = tempfile::tempdir().unwrap();
        let at = workspace.path();
        assert!(lists(&["b.jpg"], true).follow(at).is_empty(), "no map, nothing to report");

        put(at, MAP, "", 500);
        assert_eq!(lists(&["b.jpg"], true).follow(at), ["a.jpg.photometric.bin"], "nobody knows how it was made");
        put(at, "stereo/patch-match.cfg", "a.jpg\nc.jpg, b.jpg\n", 600);
        assert!(lists(&["b.jpg", "c.jpg"], false).follow(at).is_empty(), "made by COLMAP from the same partners");
        assert_eq!(lists(&["b.jpg"], false).follow(at).len(), 1, "made from more partners");

        let mut first = lists(&["b.jpg"], false);
        put(at, NOTE, &first.to_json(), 400);
        put(at, MAP, "", 300);
        assert!(first.follow(at).is_empty());
        let mut second = lists(&["c.jpg"], false);
        assert_eq!(second.follow(at).len(), 1);
        put(at, NOTE, &second.to_json(), 200);
        assert_eq!(lists(&["c.jpg"], false).follow(at).len(), 1, "older than the lists in force: still the first ones");
        assert!(lists(&["b.jpg"], false).follow(at).is_empty());
    }

    #[test]
    fn colmap_filtered_photometric_reused() {
        let workspace = tempfile::tempdir().unwrap();
        put(workspace.path(), NOTE, &lists(&["b.jpg"], true).to_json(), 200);
        put(workspace.path(), MAP, "", 100);
        assert!(lists(&["b.jpg"], true).follow(workspace.path()).is_empty());
        assert_eq!(lists(&["b.jpg"], false).follow(workspace.path()).len(), 1);
    }
}
