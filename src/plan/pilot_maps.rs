//! Small depth maps that a program made of all views, in place of the pilot's own (method 5.9).

use std::path::{Path, PathBuf};

use walkdir::{DirEntry, WalkDir};

use super::PlanError;
use crate::{
    base::{
        input::{self, FileKind},
        paths::is_outside,
        progress::Watcher,
    },
    io::depthmaps::{self, DepthMapFile},
    method::pilot::PilotMap,
    model::{cluster::ViewCluster, scene::Scene},
};

/// Relative difference of the depths of neighbours on one surface, between which a depth is
/// interpolated.
const SAME_SURFACE: f64 = 0.02;

/// The maps in a folder, ascending by view.
pub(super) struct PilotMaps(Vec<DepthMapFile>);

/// Also of files that are no maps: some name or describe the maps beside them.
fn refuse_links_out_of(project: &Path, folder: &Path) -> Result<(), PlanError> {
    let entries = WalkDir::new(folder).into_iter().filter_map(Result::ok);
    let mut links = entries.filter(DirEntry::path_is_symlink);
    match links.find(|link| is_outside(link.path(), project)) {
        Some(link) => Err(PlanError::PilotLink(link.into_path())),
        None => Ok(()),
    }
}

impl PilotMaps {
    /// Finds the maps in the folder.
    ///
    /// # Errors
    /// Without any map, for one that cannot be read, and for a folder in the project in which a
    /// link leads out of the project, which may be a stranger's.
    pub fn find(folder: &Path, scene: &Scene, project: &Path) -> Result<Self, PlanError> {
        // Only the user can name one elsewhere.
        if !is_outside(folder, project) {
            refuse_links_out_of(project, folder)?;
        }
        let set = depthmaps::find(folder, scene)?.into_complete()?;
        Ok(Self(set.maps))
    }

    /// Hashes of the files, for the fingerprint of what follows from them; `None` if one cannot be
    /// read.
    pub fn hashes(&self) -> Option<Vec<String>> {
        let files = self.0.iter().flat_map(depthmaps::files_with_depths);
        let hash = |path: PathBuf| {
            let bytes = input::read(&path, FileKind::Picture).ok()?;
            Some(blake3::hash(&bytes).to_string())
        };
        files.map(hash).collect()
    }

    /// Reads the map of each cluster's key view; `None` where there is none.
    pub fn read(
        &self,
        scene: &Scene,
        clusters: &[ViewCluster],
        watcher: &dyn Watcher,
    ) -> Result<Vec<Option<PilotMap>>, PlanError> {
        let read = |cluster: &ViewCluster| {
            watcher.check()?;
            let place = self.0.binary_search_by_key(&cluster.key, |file| file.view);
            let Ok(place) = place else { return Ok(None) };
            let map = depthmaps::read_of_view(&self.0[place], scene)?;
            let camera = scene.camera_of(cluster.key);
            let depth = |at| map.interpolated(camera, &at, SAME_SURFACE);
            Ok(PilotMap::made_by_program(scene, cluster.key, depth))
        };
        depthmaps::in_parallel(clusters, |cluster| Some(cluster.key), scene, read)
    }
}

#[cfg(all(test, unix))]
mod tests {
    use std::{fs, os::unix::fs::symlink};

    use super::*;
    use crate::{method::synthetic::Town, model::scene::ViewIndex};

    #[test]
    fn links_in_a_folder_of_the_project_do_not_lead_out_of_it() {
        let (folder, scene) = (tempfile::tempdir().unwrap(), Town::default().scene());
        let (project, outside) = (folder.path().join("project"), folder.path().join("maps"));
        let inside = project.join("small");
        fs::create_dir_all(&inside).unwrap();
        fs::create_dir(&outside).unwrap();
        let name = format!("{}.npy", scene.name(ViewIndex(0)));
        for place in [&project, &outside] {
            let map = place.join(&name);
            fs::create_dir_all(map.parent().unwrap()).unwrap();
            fs::write(map, "").unwrap();
        }
        let link = inside.join("0").join(&name);
        fs::create_dir_all(link.parent().unwrap()).unwrap();
        let find = |folder: &Path| PilotMaps::find(folder, &scene, &project);
        symlink(project.join(&name), &link).unwrap();
        assert_eq!(find(&inside).unwrap().0.len(), 1);
        fs::remove_file(&link).unwrap();
        symlink(outside.join(&name), &link).unwrap();
        assert!(matches!(find(&inside), Err(PlanError::PilotLink(path)) if path == link));
        // Nobody but the user can name one elsewhere.
        assert_eq!(find(&outside).unwrap().0.len(), 1);
    }
}
