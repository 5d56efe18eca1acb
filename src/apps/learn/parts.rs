//! Cross-validation: the views that are left out together while training on the others.

use std::path::{Path, PathBuf};

use crate::model::scene::{Scene, ViewIndex};

/// Largest number of parts; each costs one training.
const MOST: usize = 4;

/// The views of a project.
pub(super) struct Views<'a> {
    pub scene: &'a Scene,
    pub images: Option<&'a Path>,
    /// Views with a depth map.
    pub finished: Vec<ViewIndex>,
}

/// Disjoint parts of the views: whole scenes, or for a single scene the views before and after the middle one, by name. Projects
/// that share a view or an image belong to one scene.
pub(super) struct Parts {
    pub count: usize,
    pub scenes: usize,
    /// By project.
    scene: Vec<usize>,
    /// For a single scene, the name at which its second part begins.
    middle: Option<String>,
}

impl Parts {
    pub fn new(projects: &[Views]) -> Self {
        let folders: Vec<Option<PathBuf>> = projects.iter().map(|p| dunce::canonicalize(p.images?).ok()).collect();
        let mut scene: Vec<usize> = (0..projects.len()).collect();
        for i in 0..projects.len() {
            for j in 0..i {
                let same_folder = folders[i].is_some() && folders[i] == folders[j];
                if share_a_view(projects[i].scene, projects[j].scene, same_folder) {
                    let (from, to) = (scene[i], scene[j]);
                    scene.iter_mut().filter(|s| **s == from).for_each(|s| *s = to);
                }
            }
        }
        let mut distinct = scene.clone();
        distinct.sort_unstable();
        distinct.dedup();
        scene.iter_mut().for_each(|s| *s = distinct.partition_point(|d| d < s));
        let scenes = distinct.len();
        let middle = (scenes == 1).then(|| middle(projects));
        Self { count: if scenes == 1 { 2 } else { scenes.min(MOST) }, scenes, scene, middle }
    }

    /// Returns the index of the project's scene.
    pub fn scene(&self, project: usize) -> usize {
        self.scene[project]
    }

    /// Returns the part of a project's view, below [`Parts::count`].
    pub fn part_of(&self, project: usize, scene: &Scene, view: ViewIndex) -> usize {
        match &self.middle {
            Some(middle) => usize::from(scene.name(view) >= middle.as_str()),
            None => self.scene[project] % self.count,
        }
    }
}

/// Returns whether the scenes share a view: one of the same name, and with the same pose unless the images are in the same folder.
fn share_a_view(a: &Scene, b: &Scene, same_folder: bool) -> bool {
    let same = |view: &ViewIndex| {
        let other = b.find(a.name(*view));
        other.is_some_and(|other| same_folder || a.view(*view).cam_from_world == b.view(other).cam_from_world)
    };
    a.view_indices().any(|view| same(&view))
}

/// Returns the middle one of the names of the views with a depth map; empty without any.
fn middle(projects: &[Views]) -> String {
    let of = |p: &Views| p.finished.iter().map(|&view| p.scene.name(view).to_owned()).collect::<Vec<_>>();
    let mut names: Vec<String> = projects.iter().flat_map(of).collect();
    names.sort_unstable();
    names.dedup();
    names.get(names.len() / 2).cloned().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        method::synthetic::Town,
        model::camera::{Camera, CameraModel},
    };

    fn town(side: f64) -> Scene {
        let camera = Camera::new(1, CameraModel::Pinhole, 1000, 750, vec![850.0, 850.0, 500.0, 375.0]).unwrap();
        Town { side, edge: 8.0, points: 20, grid: 4, tilt: None, ..Town::new(camera) }.scene()
    }

    fn views<'a>(scene: &'a Scene, images: Option<&'a Path>) -> Views<'a> {
        Views { scene, images, finished: scene.view_indices().collect() }
    }

    /// Returns the parts that contain a view of that name and pose.
    fn parts_of(parts: &Parts, projects: &[Views], wanted: (&Scene, ViewIndex)) -> Vec<usize> {
        let (name, pose) = (wanted.0.name(wanted.1), wanted.0.view(wanted.1).cam_from_world);
        let part = |(number, p): (usize, &Views)| {
            let view = p.scene.find(name).filter(|&v| p.scene.view(v).cam_from_world == pose)?;
            Some(parts.part_of(number, p.scene, view))
        };
        let mut found: Vec<usize> = projects.iter().enumerate().filter_map(part).collect();
        found.dedup();
        found
    }

    #[test]
    fn no_view_is_in_two_parts() {
        let (one, other) = (town(100.0), town(140.0));
        // The second half of a scene, as from another plan of it, which shares no view with the first half.
        let (mut first, mut second) = (one.clone(), one.clone());
        first.views.truncate(one.views.len() / 2);
        second.views.drain(..one.views.len() / 2);
        for scenes in [vec![&one], vec![&one, &one], vec![&first, &other, &second, &one], vec![&one, &other, &one]] {
            let projects: Vec<Views> = scenes.iter().map(|scene| views(scene, None)).collect();
            let parts = Parts::new(&projects);
            for p in &projects {
                assert!(p.scene.view_indices().all(|v| parts_of(&parts, &projects, (p.scene, v)).len() == 1));
            }
            let used = |part| {
                let mut of = projects.iter().enumerate().flat_map(|(n, p)| p.finished.iter().map(move |&v| (n, p, v)));
                of.any(|(n, p, v)| parts.part_of(n, p.scene, v) == part)
            };
            assert!(parts.count == 2 && used(0) && used(1));
        }
    }

    #[test]
    fn parts_are_whole_scenes_however_often_they_were_computed() {
        let scenes = [town(100.0), town(120.0), town(140.0)];
        let projects: Vec<Views> = [0, 0, 1, 2, 1].map(|s: usize| views(&scenes[s], None)).into();
        let parts = Parts::new(&projects);
        let of = |project: usize| parts.part_of(project, projects[project].scene, ViewIndex(0));
        assert_eq!((parts.scenes, parts.count), (3, 3));
        assert_eq!([of(0), of(1), of(2), of(3), of(4)], [0, 0, 1, 2, 1]);
        assert_eq!(of(0), parts.part_of(0, &scenes[0], ViewIndex(scenes[0].views.len() as u32 - 1)));
        // The same images with other poses.
        let folder = tempfile::tempdir().unwrap();
        let projects = [views(&scenes[0], Some(folder.path())), views(&scenes[1], Some(folder.path()))];
        assert_eq!(Parts::new(&projects).scenes, 1);
    }
}
