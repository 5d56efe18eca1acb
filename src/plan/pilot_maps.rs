//! Small depth maps that a program made of all views, in place of the pilot's own (method 5.9).

use std::path::{Path, PathBuf};

use super::PlanError;
use crate::{
    base::{
        input::{self, FileKind},
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

impl PilotMaps {
    /// Finds the maps in the folder.
    ///
    /// # Errors
    /// If there is none, or one cannot be read.
    pub fn find(folder: &Path, scene: &Scene) -> Result<Self, PlanError> {
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
