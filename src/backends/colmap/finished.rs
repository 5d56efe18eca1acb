//! Finished depth maps in a workspace. COLMAP skips a problem when its files exist, even if they
//! were made with other partners. So `run.sh` puts a note with the recipe ([`MapRecipe::recipe`])
//! next to each map when it starts to compute it, and `maps.tsv` lists the wanted recipe of each
//! map and the recipe of existing maps without a note. File times are not used: a run may outlast
//! the plan that it was started for.

use std::{
    collections::BTreeMap,
    path::{Component, Path},
};

use super::{cfg, cfg::Problem};
use crate::base::input::{self, FileKind};

/// Path of the recipes in the workspace. Exports move files into place in the order of their names,
/// this one after the lists for COLMAP: a run that starts in between notes the older recipe, and at
/// worst its maps are computed again.
pub const MAPS: &str = "stereo/viewrank/maps.tsv";
/// Mark of an empty list, and of a map of unknown origin.
const NONE: &str = "-";
const UNKNOWN: &str = "?";

/// Parameters of a finished or planned depth map.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MapRecipe {
    /// Sorted: COLMAP keeps no order.
    sources: Vec<String>,
    /// True for a photometric map from which a geometric pass cannot start.
    filtered: bool,
    /// Long side to which the images were reduced (`max_image_size`), pixels; `None`: not reduced.
    long_side: Option<u32>,
}

impl MapRecipe {
    pub fn new(problem: &Problem, filtered: bool, long_side: Option<u32>) -> Self {
        let mut sources = problem.sources.clone();
        sources.sort_unstable();
        Self {
            sources,
            filtered,
            long_side,
        }
    }

    /// Returns the cache key: maps that are made differently have different keys.
    fn recipe(&self) -> String {
        let size = self.long_side.map_or(NONE.into(), |n| n.to_string());
        let text = format!("{}\n{size}\n{}", self.filtered, self.sources.join("\n"));
        blake3::hash(text.as_bytes()).to_hex()[..16].into()
    }
}

/// Content of `maps.tsv`: a line per map with [wanted recipe] TAB [recipe of an existing map
/// without a note] TAB [path under `stereo/depth_maps`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MapRecords(BTreeMap<String, Entry>);

#[derive(Clone, Debug, Default, PartialEq)]
struct Entry {
    wanted: Option<String>,
    made: Option<String>,
}

impl MapRecords {
    pub fn new(wanted: impl IntoIterator<Item = (String, MapRecipe)>) -> Self {
        let entry = |(map, made): (String, MapRecipe)| {
            (
                map,
                Entry {
                    wanted: Some(made.recipe()),
                    made: None,
                },
            )
        };
        Self(wanted.into_iter().map(entry).collect())
    }

    /// Returns the recipes of the maps of the workspace so far. Without `maps.tsv` these are the
    /// lists of `patch-match.cfg`, run with COLMAP's default options.
    fn before(workspace: &Path) -> Self {
        if let Ok(text) = input::read_text(&workspace.join(MAPS), FileKind::List) {
            return Self::read(&text);
        }
        let text = input::read_text(&workspace.join("stereo/patch-match.cfg"), FileKind::List)
            .unwrap_or_default();
        let kinds = |p: Problem| {
            ["photometric", "geometric"]
                .map(|k| (map_name(&p.reference, k), MapRecipe::new(&p, false, None)))
        };
        Self::new(cfg::read_patch_match(&text).into_iter().flat_map(kinds))
    }

    fn read(text: &str) -> Self {
        let word = |word: &str| is_recipe(word).then(|| word.to_owned());
        let line = |line: &str| {
            let mut parts = line.splitn(3, '\t');
            let (wanted, made, map) = (parts.next()?, parts.next()?, parts.next()?);
            if !is_below(map) {
                return None;
            }
            Some((
                map.to_owned(),
                Entry {
                    wanted: word(wanted),
                    made: word(made),
                },
            ))
        };
        Self(text.lines().filter_map(line).collect())
    }

    /// Takes over the known recipes of the finished maps of the workspace; returns the maps that
    /// would be kept although their recipes differ or are unknown.
    pub fn follow(&mut self, workspace: &Path) -> Vec<String> {
        let before = Self::before(workspace);
        for map in before.0.keys() {
            self.0.entry(map.clone()).or_default();
        }
        let folder = workspace.join("stereo/depth_maps");
        self.0.retain(|map, entry| {
            let earlier = before.0.get(map).cloned().unwrap_or_default();
            let noted = input::read_text(&folder.join(format!("{map}.made")), FileKind::List).ok();
            let noted = noted
                .map(|note| note.trim().to_owned())
                .filter(|note| is_recipe(note));
            let made = noted.or(earlier.made).or(earlier.wanted);
            entry.made = folder
                .join(map)
                .is_file()
                .then(|| made.unwrap_or(UNKNOWN.into()));
            // The next run brings back a map that a killed one has set aside, if it is listed.
            let is_aside = || folder.join(format!("{map}.before")).is_file();
            entry.wanted.is_some() || entry.made.is_some() || is_aside()
        });
        let stale = |entry: &Entry| {
            entry.wanted.is_some() && entry.made.is_some() && entry.wanted != entry.made
        };
        self.0
            .iter()
            .filter(|(_, entry)| stale(entry))
            .map(|(map, _)| map.clone())
            .collect()
    }

    pub fn to_tsv(&self) -> String {
        let word = |word: &Option<String>| word.clone().unwrap_or(NONE.into());
        self.0
            .iter()
            .map(|(map, entry)| format!("{}\t{}\t{map}\n", word(&entry.wanted), word(&entry.made)))
            .collect()
    }
}

/// Returns whether a word of a list or a note, which may be anybody's, is a recipe.
fn is_recipe(word: &str) -> bool {
    let is_digit = |byte: u8| matches!(byte, b'0'..=b'9' | b'a'..=b'f');
    word == UNKNOWN || word.len() == 16 && word.bytes().all(is_digit)
}

/// Returns whether a path of a list, which may be anybody's, stays below its folder.
fn is_below(map: &str) -> bool {
    Path::new(map)
        .components()
        .all(|part| matches!(part, Component::Normal(_)))
}

/// Returns the path of a map under `stereo/depth_maps` and `stereo/normal_maps`.
pub fn map_name(image: &str, kind: &str) -> String {
    format!("{image}.{kind}.bin")
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    const MAP: &str = "stereo/depth_maps/a.jpg.photometric.bin";

    fn lists(partners: &[&str], filtered: bool) -> MapRecords {
        of_size(partners, filtered, None)
    }

    fn of_size(partners: &[&str], filtered: bool, long_side: Option<u32>) -> MapRecords {
        let problem = Problem {
            reference: "a.jpg".into(),
            sources: partners.iter().map(|&s| s.into()).collect(),
        };
        MapRecords::new([(
            map_name("a.jpg", "photometric"),
            MapRecipe::new(&problem, filtered, long_side),
        )])
    }

    fn put(workspace: &Path, path: &str, text: &str) {
        let path = workspace.join(path);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(&path, text).unwrap();
    }

    /// Writes the lists as an export does; returns the number of finished maps that it reports.
    fn export(workspace: &Path, mut lists: MapRecords) -> usize {
        let stale = lists.follow(workspace);
        put(workspace, MAPS, &lists.to_tsv());
        assert_eq!(MapRecords::read(&lists.to_tsv()), lists);
        stale.len()
    }

    /// Decision of `run.sh` before it computes the map.
    fn begin(workspace: &Path) {
        let lists = MapRecords::before(workspace);
        let wanted = lists
            .0
            .values()
            .find_map(|entry| entry.wanted.clone())
            .unwrap();
        put(workspace, &format!("{MAP}.made"), &format!("{wanted}\n"));
    }

    #[test]
    fn maps_of_another_size_are_stale() {
        let workspace = tempfile::tempdir().unwrap();
        let at = workspace.path();
        assert_eq!(export(at, lists(&["b.jpg"], true)), 0);
        put(at, MAP, "");
        assert_eq!(export(at, of_size(&["b.jpg"], true, Some(800))), 1);
        assert_eq!(
            export(at, of_size(&["b.jpg"], true, Some(800))),
            1,
            "until it is made anew"
        );
        begin(at);
        assert_eq!(export(at, of_size(&["b.jpg"], true, Some(800))), 0);
    }

    #[test]
    fn colmap_stale_maps_skipped() {
        let workspace = tempfile::tempdir().unwrap();
        let at = workspace.path();
        assert!(
            lists(&["b.jpg"], true).follow(at).is_empty(),
            "no map, nothing to report"
        );

        put(at, MAP, "");
        assert_eq!(
            lists(&["b.jpg"], true).follow(at),
            ["a.jpg.photometric.bin"],
            "nobody knows how it was made"
        );
        put(at, "stereo/patch-match.cfg", "a.jpg\nc.jpg, b.jpg\n");
        assert!(
            lists(&["b.jpg", "c.jpg"], false).follow(at).is_empty(),
            "made by COLMAP from the same partners"
        );
        assert_eq!(
            lists(&["b.jpg"], false).follow(at).len(),
            1,
            "made from more partners"
        );

        fs::remove_file(at.join(MAP)).unwrap();
        assert_eq!(export(at, lists(&["b.jpg"], false)), 0);
        put(at, MAP, "");
        assert_eq!(
            export(at, lists(&["b.jpg"], false)),
            0,
            "made by hand, by the list in place"
        );
        assert_eq!(export(at, lists(&["c.jpg"], false)), 1);
        assert_eq!(
            export(at, lists(&["c.jpg"], false)),
            1,
            "still the map of the first lists"
        );
        assert_eq!(export(at, lists(&["b.jpg"], false)), 0);
    }

    /// A run that was started before a plan and ends after it.
    #[test]
    fn maps_of_a_run_that_outlasts_its_plan_are_stale() {
        let workspace = tempfile::tempdir().unwrap();
        let at = workspace.path();
        export(at, lists(&["b.jpg"], true));
        begin(at);
        assert_eq!(
            export(at, lists(&["c.jpg"], true)),
            0,
            "no map is there yet"
        );
        put(at, MAP, "");
        assert_eq!(export(at, lists(&["c.jpg"], true)), 1);
        assert_eq!(export(at, lists(&["b.jpg"], true)), 0);
    }

    #[test]
    fn colmap_filtered_photometric_reused() {
        let workspace = tempfile::tempdir().unwrap();
        let at = workspace.path();
        export(at, lists(&["b.jpg"], true));
        put(at, MAP, "");
        assert_eq!(export(at, lists(&["b.jpg"], true)), 0);
        assert_eq!(export(at, lists(&["b.jpg"], false)), 1);
    }

    #[test]
    fn maps_of_views_that_a_plan_leaves_out_stay_known() {
        let workspace = tempfile::tempdir().unwrap();
        let at = workspace.path();
        export(at, lists(&["b.jpg"], true));
        put(at, MAP, "");
        export(at, MapRecords::default());
        assert_eq!(export(at, lists(&["c.jpg"], true)), 1);
        assert_eq!(export(at, lists(&["b.jpg"], true)), 0);
    }
}
