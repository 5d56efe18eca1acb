//! Marks of the depth maps that the script of an export makes.
//!
//! COLMAP skips a problem when its files exist, even if they were made with other partners. So the
//! script leaves a mark for each map that isn't there when it starts COLMAP: what the map will be
//! made from. viewrank leaves its own (`apps/dispatch`).

use std::path::Path;

use super::{OWN, cfg::Problem};
use crate::backends::clusters::{hash, made_from, task_marker};

/// A depth map of the lists, with its mark.
pub struct ListedMap {
    /// Path under `stereo/depth_maps`.
    pub map: String,
    pub mark: String,
    /// Content of its mark: the first where it is made from these lists; the second is as good.
    pub ids: [String; 2],
}

impl ListedMap {
    /// `size`: long side to which the images are reduced, if they are.
    pub fn new(problem: &Problem, kind: &str, size: Option<u32>) -> Self {
        let key = &*problem.reference;
        let mut sources: Vec<&str> = problem.sources.iter().map(String::as_str).collect();
        // COLMAP keeps no order.
        sources.sort_unstable();
        let size = size.map_or(String::new(), |size| size.to_string());
        let id = hash([kind, key, &size].into_iter().chain(sources));
        let mark = match kind {
            "geometric" => hash([key, kind]),
            _ => task_marker(key),
        };
        Self {
            map: map_name(key, kind),
            mark,
            ids: [id.clone(), id],
        }
    }
}

/// Returns `marks.tsv`, a line per map: mark TAB its content TAB path under `stereo/depth_maps`.
pub fn to_tsv(maps: &[ListedMap]) -> String {
    let line = |ListedMap { map, mark, ids }: &ListedMap| format!("{mark}\t{}\t{map}\n", ids[0]);
    maps.iter().map(line).collect()
}

/// Returns the maps that COLMAP would keep although they were made from something else, or nobody
/// knows from what.
pub fn stale<'a>(maps: &'a [ListedMap], workspace: &Path, project: &Path) -> Vec<&'a str> {
    let is_stale = |listed: &&ListedMap| {
        let path = workspace.join("stereo/depth_maps").join(&listed.map);
        let of_script = format!("{OWN}done/{}", listed.mark);
        let of_viewrank = (project, super::BACKEND.name);
        path.is_file()
            && made_from((workspace, &of_script), of_viewrank, &listed.mark)
                .is_none_or(|id| !listed.ids.contains(&id))
    };
    let stale = maps.iter().filter(is_stale);
    stale.map(|listed| &*listed.map).collect()
}

/// Returns the path of a map under `stereo/depth_maps` and `stereo/normal_maps`.
pub fn map_name(image: &str, kind: &str) -> String {
    format!("{image}.{kind}.bin")
}
