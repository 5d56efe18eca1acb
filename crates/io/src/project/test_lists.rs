//! Lists of the images that are kept apart for tests, as trainers of Gaussian splats read them.

use std::path::PathBuf;

use viewrank_core::model::scene::{Scene, ViewIndex};

use super::Project;
use crate::input::{self, FileKind};

/// That of the scripts of 3D Gaussian Splatting, beside the model.
const BESIDE_MODEL: &str = "test.txt";
/// That of nerfstudio's reader of COLMAP's models, in the project.
const IN_PROJECT: &str = "test_list.txt";

impl Project {
    /// Views that a list beside the model or in the project names, one to a line, ascending; none
    /// without a list.
    pub(super) fn listed_tests(&self, scene: &Scene) -> Vec<ViewIndex> {
        let lists = [
            self.model.path.join(BESIDE_MODEL),
            self.root.join(IN_PROJECT),
        ];
        let list = |path: &PathBuf| input::read_text(path, FileKind::Settings).ok();
        let Some(list) = lists.iter().find_map(list) else {
            return Vec::new();
        };
        let named = list.lines().filter_map(|line| scene.find(line.trim()));
        let mut tests: Vec<ViewIndex> = named.collect();
        tests.sort_unstable();
        tests.dedup();
        if tests.len() == scene.views.len() {
            // There would be nothing to train on.
            tests.clear();
        }
        tests
    }
}
