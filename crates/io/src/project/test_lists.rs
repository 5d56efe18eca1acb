//! Lists of the images that are kept apart for tests, as trainers of Gaussian splats read them.

use std::{
    collections::{BTreeSet, HashMap},
    path::{Path, PathBuf},
};

use viewrank_core::model::scene::{ModelWarning, Scene, ViewIndex, WarningKind};

use super::{
    ModelLocation,
    names::{folded, last},
};
use crate::{
    formats::{name_parts, transforms},
    input::{self, FileKind},
    paths::stem,
};

/// That of the scripts of 3D Gaussian Splatting, beside the model.
const BESIDE_MODEL: &str = "test.txt";
/// Those of nerfstudio's reader of COLMAP's models, in the project.
const IN_PROJECT: &str = "test_list.txt";
const OF_TRAINING: &str = "train_list.txt";
/// nerfstudio's own model, whose splits hold for that of COLMAP beside it.
const TRANSFORMS: &str = "transforms.json";

/// Names of the files that list images for tests.
pub const TEST_LISTS: [&str; 2] = [BESIDE_MODEL, IN_PROJECT];

/// Where the lists of a model are, whether they exist or not.
pub(super) fn test_lists(root: &Path, model: &ModelLocation) -> [PathBuf; 2] {
    [model.path.join(BESIDE_MODEL), root.join(IN_PROJECT)]
}

/// Returns the views that the lists name, one to a line, ascending; none where they leave too few
/// to train on. Says which names mean none.
pub(super) fn listed_tests(
    root: &Path,
    model: &ModelLocation,
    scene: &Scene,
) -> (Vec<ViewIndex>, Option<ModelWarning>) {
    let read = |path: &PathBuf| input::read_text(path, FileKind::Settings).unwrap_or_default();
    let lines = |list: &str| -> Vec<String> {
        let names = list.lines().map(str::trim);
        let names = names.filter(|name| !name.is_empty() && !name.starts_with('#'));
        names.map(str::to_owned).collect()
    };
    let lists = test_lists(root, model);
    let mut named: Vec<String> = lists.iter().flat_map(|list| lines(&read(list))).collect();
    let of_nerfstudio = root.join(TRANSFORMS);
    // Where it is the model itself, its reader has taken the splits.
    if model.path != of_nerfstudio {
        let splits = input::read(&of_nerfstudio, FileKind::Sparse).unwrap_or_default();
        named.extend(transforms::tests(&splits));
    }
    if named.is_empty() {
        return (Vec::new(), None);
    }
    let meant = Meant::new(scene);
    let mut tests: BTreeSet<ViewIndex> = named.iter().filter_map(|name| meant.view(name)).collect();
    let stray = named.iter().find(|name| meant.view(name).is_none());
    // Writers without a split of their own repeat training images.
    for trained in lines(&read(&root.join(OF_TRAINING))) {
        meant.view(&trained).map(|view| tests.remove(&view));
    }
    let warn = |text: String| Some(ModelWarning::new(WarningKind::Format, text));
    if tests.len() + LEAST_TRAINED > scene.views.len() {
        let text = "the list of images for tests names all images: none are kept apart";
        return (Vec::new(), warn(text.into()));
    }
    let stray = stray.and_then(|name| {
        warn(format!(
            "the list of images for tests names {name}, which is no image of the model"
        ))
    });
    (tests.into_iter().collect(), stray)
}

/// Views without which there is nothing to choose from.
const LEAST_TRAINED: usize = 2;

/// The views by what their names may be cut to: without folders, without extension, in any
/// spelling.
struct Meant(HashMap<String, Option<ViewIndex>>);

impl Meant {
    fn new(scene: &Scene) -> Self {
        let mut meant = HashMap::new();
        for view in scene.view_indices() {
            for key in keys(scene.name(view)) {
                let of_key = meant.entry(key).or_insert(Some(view));
                // Of several none is meant.
                *of_key = of_key.filter(|first| *first == view);
            }
        }
        Self(meant)
    }

    /// The view that a name means, by as much of it as possible.
    fn view(&self, name: &str) -> Option<ViewIndex> {
        keys(name)
            .into_iter()
            .find_map(|key| self.0.get(&key).copied())?
    }
}

/// A name, and what it may be cut to, the most telling first.
fn keys(name: &str) -> [String; 4] {
    let name = name_parts(name).map_or_else(|| name.to_owned(), |parts| parts.join("/"));
    [&*name, stem(&name), last(&name), stem(last(&name))].map(folded)
}
