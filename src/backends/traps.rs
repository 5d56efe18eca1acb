//! Faults of a project that break a backend, for `viewrank doctor`.

use std::{collections::BTreeMap, path::Path};

use walkdir::WalkDir;

use super::{BackendError, selection};
use crate::{
    io::project::Project,
    model::scene::{Scene, ViewIndex, ViewPoints},
};

/// The project under examination.
pub struct ExaminedProject<'a> {
    pub project: &'a Project,
    pub scene: &'a Scene,
    pub points: &'a ViewPoints,
}

/// A fault of a project that breaks a backend.
#[derive(Clone, Debug, PartialEq)]
pub struct Trap {
    /// Stable identifier.
    pub name: &'static str,
    /// The fault and its consequence.
    pub what: String,
    /// Remedy: an imperative or a command.
    pub cure: String,
    /// Affected views; empty: the whole project.
    pub views: Vec<ViewIndex>,
}

impl ExaminedProject<'_> {
    /// Finds views whose names `check` refuses.
    pub(super) fn bad_names<T>(
        &self,
        trap: &'static str,
        check: impl Fn(&str) -> Result<T, BackendError>,
    ) -> Option<Trap> {
        let fault = |view: ViewIndex| match check(self.scene.name(view)) {
            Err(BackendError::Name { why, .. }) => Some((view, why)),
            _ => None,
        };
        let faults: Vec<(ViewIndex, String)> =
            self.scene.view_indices().filter_map(fault).collect();
        let (first, why) = faults.first()?;
        Some(Trap {
            name: trap,
            what: format!(
                "image names that it cannot take, as \"{}\": {why}",
                self.scene.name(*first)
            ),
            cure: "rename the images, in the folder and in the model".into(),
            views: faults.iter().map(|(view, _)| *view).collect(),
        })
    }

    /// Finds finished depth maps below a folder, which the program keeps regardless of their
    /// origin. `is_map`: of a file name and its path.
    pub(super) fn finished_maps(
        &self,
        trap: &'static str,
        folder: &Path,
        depth: usize,
        is_map: impl Fn(&str, &Path) -> bool,
        cure: String,
    ) -> Option<Trap> {
        let files = WalkDir::new(folder)
            .max_depth(depth)
            .into_iter()
            .filter_map(Result::ok);
        let maps = files
            .filter(|entry| {
                let name = entry.file_name().to_str();
                name.is_some_and(|name| is_map(name, entry.path()))
            })
            .count();
        (maps > 0).then(|| Trap {
            name: trap,
            what: format!(
                "{maps} finished depth maps in {} are kept, whatever partners they were made with",
                folder.display()
            ),
            cure,
            views: Vec::new(),
        })
    }

    /// Finds views that the backend cannot distinguish.
    pub(super) fn same_names(
        &self,
        trap: &'static str,
        same: &str,
        known_by: impl Fn(&str) -> String,
    ) -> Option<Trap> {
        // Sorted, so that each run names the same pair.
        let mut by_key: BTreeMap<String, Vec<ViewIndex>> = BTreeMap::new();
        for view in self.scene.view_indices() {
            by_key
                .entry(known_by(self.scene.name(view)))
                .or_default()
                .push(view);
        }
        let groups: Vec<&Vec<ViewIndex>> =
            by_key.values().filter(|views| views.len() > 1).collect();
        let first = groups.first()?;
        Some(Trap {
            name: trap,
            what: format!(
                "{} and {} are {same}",
                self.scene.name(first[0]),
                self.scene.name(first[1])
            ),
            cure: "rename the images, in the folder and in the model, so that no two are alike"
                .into(),
            views: groups.into_iter().flatten().copied().collect(),
        })
    }

    /// Finds views that observe no sparse point in front of them, in a model with points.
    pub(super) fn without_points(&self, trap: &'static str, so: &str) -> Option<Trap> {
        let none = |v: &ViewIndex| selection::depths(self.scene, self.points, *v).is_empty();
        let views: Vec<ViewIndex> = self.scene.view_indices().filter(none).collect();
        let first = views.first().filter(|_| !self.scene.points.is_empty())?;
        Some(Trap {
            name: trap,
            what: format!("{} observes no sparse point in front of it: {so}", self.scene.name(*first)),
            cure: "take these views out of the model (colmap image_deleter), or triangulate more points".into(),
            views,
        })
    }
}
