//! Projects of SURE: orientations, and clouds with and without tracks.

use std::collections::BTreeSet;

use nalgebra::Point3;
use viewrank_core::model::{
    camera::{Camera, CameraModel},
    scene::{PointIndex, ViewIndex},
};
use viewrank_io::{
    formats::{cloud, sure},
    project::{Project, ProjectKind},
};

use super::{counts, formats, read};

#[test]
fn sure_orientations_round_trip() {
    let formats = formats();
    let base = read(formats.join("base_colmap38_bin"));
    let camera = Camera::new(
        1,
        CameraModel::Pinhole,
        1000,
        750,
        vec![751.0, 752.0, 500.25, 374.0],
    )
    .unwrap();
    for view in &base.views {
        let text = sure::write(&view.name, &camera, &view.cam_from_world).unwrap();
        assert!(
            text.lines()
                .filter(|line| line.starts_with('$'))
                .all(|line| line.len() == 72),
            "{text}"
        );
        let read = sure::read(text.as_bytes(), 1).unwrap();
        assert_eq!(read.image, view.name);
        assert!(
            (nalgebra::DVector::from_row_slice(read.camera.params())
                - nalgebra::DVector::from_row_slice(camera.params()))
            .norm()
                < 1e-9
        );
        let pose = read.cam_from_world.pose().unwrap();
        assert!((pose.rotation.matrix() - view.cam_from_world.rotation.matrix()).norm() < 1e-12);
        assert!((pose.centre() - view.cam_from_world.centre()).norm() < 1e-9);
    }
    assert!(sure::write("a", &base.cameras[0], &base.views[0].cam_from_world).is_none());
}

/// A cloud of any size takes a bounded part of the memory, the same part each time.
#[test]
fn a_huge_cloud_of_a_sure_project_is_thinned() {
    let camera = Camera::new(
        1,
        CameraModel::Pinhole,
        1000,
        750,
        vec![751.0, 751.0, 500.0, 375.0],
    )
    .unwrap();
    let pose = viewrank_core::model::scene::Pose {
        rotation: nalgebra::Rotation3::identity(),
        translation: nalgebra::Vector3::zeros(),
    };
    let oriented = || {
        let text = sure::write("a.jpg", &camera, &pose).unwrap();
        sure::model(vec![sure::read(text.as_bytes(), 1).unwrap()], str::to_owned)
    };
    // A grid whose rows are as long as a regular thinning would skip.
    let grid: Vec<Point3<f64>> = (0..3_000_000)
        .map(|n| Point3::new(f64::from(n % 3) - 1.0, f64::from(n / 3) * 1e-6 - 0.5, 5.0))
        .collect();
    let read = || {
        let mut foreign = oriented();
        cloud::add_cloud(&mut foreign.model, &grid);
        foreign.scene().unwrap()
    };
    let scene = read();
    assert!(
        (1_000_000..1_100_000).contains(&scene.points.len()),
        "{}",
        scene.points.len()
    );
    assert!(
        scene
            .warnings
            .iter()
            .any(|w| w.text.contains("3000000 points")),
        "{:?}",
        scene.warnings
    );
    assert_eq!(scene.points, read().points);
    let column = |x: f64| {
        scene.points.iter().filter(|p| p.x == x).count() as f64 / scene.points.len() as f64
    };
    assert!(
        [-1.0, 0.0, 1.0]
            .into_iter()
            .all(|x| (column(x) - 1.0 / 3.0).abs() < 0.01)
    );
    let mut few = oriented();
    cloud::add_cloud(&mut few.model, &grid[..9]);
    assert_eq!(few.scene().unwrap().points, grid[..9]);
}

#[test]
fn sure_projects_have_orientations_and_a_cloud() {
    let formats = formats();
    let base = read(formats.join("base_colmap38_bin"));
    let camera = Camera::new(
        1,
        CameraModel::Pinhole,
        1000,
        750,
        vec![751.0, 751.0, 500.0, 375.0],
    )
    .unwrap();
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    std::fs::create_dir(root.join("ori")).unwrap();
    for view in &base.views {
        let text = sure::write(&view.name, &camera, &view.cam_from_world).unwrap();
        std::fs::write(
            root.join("ori").join(&view.name).with_extension("ori"),
            text,
        )
        .unwrap();
    }
    let project = Project::open(root, None).unwrap();
    assert_eq!(
        (project.kind, project.model.registered),
        (ProjectKind::Sure, 12)
    );
    assert_eq!(project.read_scene().unwrap().warnings.len(), 1);

    std::fs::copy(
        formats.join("base_colmap38_exports/model.ply"),
        root.join("cloud.ply"),
    )
    .unwrap();
    let scene = read(root);
    assert_eq!(scene.points.len(), base.points.len());
    for p in 0..scene.points.len() {
        let x = &scene.points[p];
        let sees = |v: &ViewIndex| {
            let pixel = scene
                .camera_of(*v)
                .project(&scene.view(*v).cam_from_world.camera_from_world(x));
            pixel.is_some_and(|pixel| scene.camera_of(*v).contains(&pixel))
        };
        let expected: Vec<ViewIndex> = scene.view_indices().filter(sees).collect();
        assert_eq!(scene.track_views(PointIndex(p as u32)), expected);
    }

    let nvm = std::fs::read_to_string(formats.join("base_colmap38_exports/model.nvm")).unwrap();
    // Names of the cloud with other folders, case and extensions; one that is not oriented, one
    // that is missing.
    let name = |n: usize| base.views[n].name.as_str();
    let mut other = nvm.clone();
    for n in 0..12 {
        let stem = name(n)
            .rsplit_once('.')
            .map_or(name(n), |(stem, _)| stem)
            .to_uppercase();
        other = other.replace(
            name(n),
            &if n == 3 {
                "stranger.png".into()
            } else {
                format!("D:\\flug\\{stem}.TIF")
            },
        );
    }
    std::fs::write(root.join("cloud.nvm"), other).unwrap();
    let scene = read(root);
    let warned = |what: &str| scene.warnings.iter().any(|w| w.text.contains(what));
    assert!(
        warned(&format!(
            "1 oriented images are not in the sparse cloud, so their observations are missing: {}",
            name(3)
        )),
        "{:?}",
        scene.warnings
    );
    assert!(warned(
        "1 images of the sparse cloud are not oriented, so their observations are missing: stranger.png"
    ));
    assert_eq!(
        scene
            .view_indices()
            .filter(|v| scene.view_points().observed_by(*v).is_empty())
            .count(),
        1
    );
    std::fs::write(
        root.join("cloud.nvm"),
        nvm.replace("image", "picture")
            .replace("img", "pic")
            .replace("IMG", "PIC"),
    )
    .unwrap();
    let error = Project::open(root, None)
        .and_then(|project| project.read_scene())
        .unwrap_err()
        .to_string();
    assert!(error.contains("no image of the sparse cloud"), "{error}");

    std::fs::copy(
        formats.join("base_colmap38_exports/model.nvm"),
        root.join("cloud.nvm"),
    )
    .unwrap();
    let scene = Project::open(&root.join("ori"), None).is_ok_and(|p| p.kind == ProjectKind::Sure);
    assert!(scene);
    let scene = read(root);
    // NVM holds one observation per point and image.
    let distinct = |p: usize| {
        base.track_views(PointIndex(p as u32))
            .iter()
            .collect::<BTreeSet<_>>()
            .len()
    };
    let points = base.points.len();
    assert_eq!(
        counts(&scene),
        [12, points, (0..points).map(distinct).sum()]
    );
}
