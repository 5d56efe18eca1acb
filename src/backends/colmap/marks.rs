//! Marks of finished depth maps as `run.sh` writes them: `stereo/viewrank/done/MARKER`, the same
//! files as `apps/dispatch` writes and reads.
//!
//! COLMAP skips a problem when its files exist, even if they were made with other partners. So the
//! script notes what each map that isn't there will be made from when it starts COLMAP, and names
//! one that was made from something else.

use super::cfg::Problem;
use crate::backends::clusters::{hash, task_marker};

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
    format!("{image}.{kind}.bin")
}
