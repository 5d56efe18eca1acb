//! Partners of several widths: COLMAP 4.0.0 to 4.1.1 copies the rows of the narrower ones to the
//! GPU as if they were as long as those of the widest (since commit 8e014c5b; repaired in 4.2.0,
//! colmap#4634).

use std::collections::BTreeSet;

use crate::{
    backends::{ExaminedProject, Selection, Trap, machine, machine::Version},
    io::project::ModelFormat,
    model::{cluster::RankedCluster, scene::ViewIndex},
};

/// First version with the fault, and first without it again.
const FAULTY: [Version; 2] = [Version([4, 0, 0]), Version([4, 2, 0])];

/// The COLMAP on this machine, as far as its version tells.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Colmap {
    Sound,
    Faulty(Version),
    /// Not installed, or of unknown version.
    Unknown,
}

impl Colmap {
    fn of(version: Option<Version>) -> Self {
        match version {
            None => Self::Unknown,
            Some(version) if (FAULTY[0]..FAULTY[1]).contains(&version) => Self::Faulty(version),
            Some(_) => Self::Sound,
        }
    }

    /// Says what it does with the narrower images; `None` if it does nothing wrong.
    fn fault(self) -> Option<String> {
        match self {
            Self::Sound => None,
            Self::Faulty(version) => Some(format!(
                "COLMAP {version}, which is installed, copies the narrower of a key view's partners wrongly to the GPU"
            )),
            Self::Unknown => Some(
                "COLMAP 4.0.0 to 4.1.1 copies the narrower of a key view's partners wrongly to the GPU (repaired in 4.2.0)".into(),
            ),
        }
    }
}

/// Warns of key views with partners of several widths, as the images of different cameras have.
pub fn warning(selection: &Selection) -> Option<String> {
    let mixed = mixed(selection);
    let fault = (!mixed.is_empty()).then(|| Colmap::of(machine::colmap_version()).fault());
    fault.flatten().map(|fault| {
        format!(
            "{}, the first is {}: {fault}",
            match mixed.len() {
                1 => "the partners of 1 key view differ in width".into(),
                n => format!("the partners of {n} key views differ in width"),
            },
            selection.scene.name(mixed[0])
        )
    })
}

/// Key views whose partners differ in width, best first.
fn mixed(selection: &Selection) -> Vec<ViewIndex> {
    let widths = |cluster: &RankedCluster| -> BTreeSet<u32> {
        let width = |view: &ViewIndex| selection.scene.camera_of(*view).width;
        cluster.partners.iter().map(width).collect()
    };
    let clusters = selection.clusters.iter();
    clusters
        .filter(|cluster| widths(cluster).len() > 1)
        .map(|cluster| cluster.key)
        .collect()
}

/// Finds images of several widths.
pub fn trap(examined: &ExaminedProject) -> Option<Trap> {
    let (widest, narrower) = narrower(examined)?;
    let colmap = Colmap::of(machine::colmap_version());
    colmap.fault().map(|fault| Trap {
        name: "colmap-4x-mixed-width-sources",
        what: format!(
            "{} images are narrower than the others ({widest} px): {fault}",
            narrower.len()
        ),
        cure:
            "match with COLMAP 3.8 to 3.13, or 4.2.0 and later, or undistort all images to one size"
                .into(),
        // Without a COLMAP that has the fault, nothing is wrong with them.
        views: match colmap {
            Colmap::Faulty(_) => narrower,
            _ => Vec::new(),
        },
    })
}

/// Returns the largest width and the views of smaller ones; `None` if there are no such views.
fn narrower(examined: &ExaminedProject) -> Option<(u32, Vec<ViewIndex>)> {
    let (scene, project) = (examined.scene, examined.project);
    // These formats do not store image sizes, which are guessed without the images.
    if matches!(
        project.model.format,
        ModelFormat::Bundler | ModelFormat::Nvm
    ) && project.images.is_none()
    {
        return None;
    }
    let width = |v| scene.camera_of(v).width;
    let widest = scene.view_indices().map(width).max()?;
    let narrower: Vec<_> = scene
        .view_indices()
        .filter(|&v| width(v) < widest)
        .collect();
    (!narrower.is_empty()).then_some((widest, narrower))
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::{
        io::project::Project,
        model::{
            camera::{Camera, CameraModel},
            scene::{CameraIndex, Scene},
        },
    };

    #[test]
    fn only_the_versions_with_the_fault_are_warned_of() {
        for version in [[3, 8, 0], [3, 13, 0], [4, 2, 0], [4, 2, 1], [5, 0, 0]] {
            assert_eq!(Colmap::of(Some(Version(version))).fault(), None);
        }
        for version in [[4, 0, 0], [4, 0, 4], [4, 1, 1]] {
            let fault = Colmap::of(Some(Version(version))).fault().unwrap();
            assert!(fault.contains(&Version(version).to_string()), "{fault}");
        }
        let unknown = Colmap::of(None).fault().unwrap();
        assert!(unknown.contains("4.0.0 to 4.1.1") && unknown.contains("4.2.0"));
    }

    #[test]
    fn views_narrower_than_the_widest_are_found_where_the_model_has_sizes() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/valley");
        let mut project = Project::open(&folder, None).unwrap();
        let mut scene = project.read_scene().unwrap();
        let found = |project: &Project, scene: &Scene| {
            let points = &scene.view_points();
            narrower(&ExaminedProject {
                project,
                scene,
                points,
            })
        };
        assert_eq!(found(&project, &scene), None);
        let wide = Camera::new(
            9,
            CameraModel::Pinhole,
            700,
            525,
            vec![500.0, 500.0, 350.0, 262.5],
        );
        scene.cameras.push(wide.unwrap());
        let last = CameraIndex(scene.cameras.len() as u32 - 1);
        scene.views[1..]
            .iter_mut()
            .for_each(|view| view.camera = last);
        assert_eq!(found(&project, &scene), Some((700, vec![ViewIndex(0)])));
        project.images = None;
        assert!(found(&project, &scene).is_some());
        project.model.format = ModelFormat::Bundler;
        assert_eq!(found(&project, &scene), None, "sizes are guessed");
    }
}
