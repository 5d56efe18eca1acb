//! Marks of finished depth maps as `run.sh` writes them: `stereo/viewrank/done/MARKER`, the same
//! files as `apps/dispatch` writes and reads.
//!
//! COLMAP skips a problem when its files exist, even if they were made with other partners. So the
//! script notes what each map that isn't there will be made from when it starts COLMAP, and names
//! one that was made from something else. A map without its mark does not count for the plan: the
//! workspace is the user's, who may have run COLMAP there himself.

use std::{
    collections::HashMap,
    path::{Path, PathBuf},
};

use super::{
    MARKS, OWN, as_path,
    cfg::Problem,
    run::{RUN, Row, Run},
};
use crate::{
    backends::{
        KnownMaps,
        clusters::{hash, task_marker},
    },
    base::input::FileKind,
    io::output,
};

/// A depth map of the lists, with its mark.
pub struct ListedMap {
    /// Path under `stereo/depth_maps`.
    map: String,
    mark: String,
    /// Content of its mark.
    pub id: String,
}

impl ListedMap {
    /// `options`: those of COLMAP by which maps of a kind differ.
    pub fn new(problem: &Problem, kind: &str, options: &str) -> Self {
        let key = &*problem.reference;
        let mut sources: Vec<&str> = problem.sources.iter().map(String::as_str).collect();
        // COLMAP keeps no order.
        sources.sort_unstable();
        let mark = match kind {
            // A photometric map has the mark of the task in `viewrank run`, so a geometric one
            // needs another.
            "geometric" => hash([key, kind]),
            _ => task_marker(key),
        };
        Self {
            map: map_name(key, kind),
            mark,
            id: hash([kind, key, options].into_iter().chain(sources)),
        }
    }
}

/// Returns `marks.tsv`, a line per map: mark TAB its content TAB path under `stereo/depth_maps`.
pub fn to_tsv(maps: &[ListedMap]) -> String {
    let line = |ListedMap { map, mark, id }: &ListedMap| format!("{mark}\t{id}\t{map}\n");
    maps.iter().map(line).collect()
}

/// Returns the path of a map under `stereo/depth_maps` and `stereo/normal_maps`.
pub fn map_name(image: &str, kind: &str) -> String {
    format!("{}.{kind}.bin", as_path(image))
}

/// Returns whether a map below `stereo/depth_maps` has the mark of what the list there says that it
/// is made from.
pub fn known(depth_maps: &Path) -> KnownMaps {
    let Some(workspace) = depth_maps.ancestors().nth(2).map(Path::to_path_buf) else {
        return Box::new(|_| false);
    };
    let list = output::read_own(&workspace, MARKS, FileKind::Plan).unwrap_or_default();
    let listed = from_tsv(&String::from_utf8_lossy(&list), depth_maps);
    let at_full_size = ids_at_full_size(&workspace, depth_maps);
    Box::new(move |map| {
        // The folder may hold any number of maps: marks are read only for those of the plan.
        let Some([mark, id]) = listed.get(map) else {
            return false;
        };
        let made_from =
            output::read_own(&workspace, &format!("{OWN}done/{mark}"), FileKind::Record);
        let of_full_size = at_full_size.get(map);
        let ids = [Some(id), of_full_size].into_iter().flatten();
        made_from.is_ok_and(|made_from| {
            // `run.sh` writes marks with `echo`, which adds a line break.
            ids.map(String::as_bytes)
                .any(|id| made_from.trim_ascii() == id)
        })
    })
}

/// Returns the content of the mark that a map has if it was made at full size, where it would do
/// for the plan, too.
fn ids_at_full_size(workspace: &Path, depth_maps: &Path) -> HashMap<PathBuf, String> {
    let run = output::read_own(workspace, RUN, FileKind::Plan).unwrap_or_default();
    let maps = serde_json::from_slice::<Run>(&run).map(|run| run.maps);
    let map = |row: Row| {
        let map = map_name(&row.problem.reference, "photometric");
        (depth_maps.join(map), row.id_at_full_size)
    };
    let rows = maps.unwrap_or_default().into_iter();
    // A `run.json` without this field would make an empty mark count.
    rows.filter(|row| !row.id_at_full_size.is_empty())
        .map(map)
        .collect()
}

/// Returns mark and content by the path of the map. A mark is a hash: no path in the list leads
/// elsewhere.
fn from_tsv(list: &str, depth_maps: &Path) -> HashMap<PathBuf, [String; 2]> {
    let is_hash = |mark: &&str| mark.bytes().all(|byte| byte.is_ascii_hexdigit());
    let entry = |line: &str| {
        let mut cells = line.splitn(3, '\t');
        let mark = cells.next().filter(is_hash)?;
        let (id, map) = (cells.next()?, cells.next()?);
        Some((depth_maps.join(map), [mark, id].map(str::to_owned)))
    };
    list.lines().filter_map(entry).collect()
}
