//! The pilot made by a program: small depth maps of all views that a plan ranks by.

use std::{fs, path::Path};

use nalgebra::Point2;
use viewrank::{Plan, Settings, config::PilotSettings, manifest};
use viewrank_core::{
    base::progress::NoWatcher,
    method::{synthetic::Town, visibility},
    model::{
        camera::{Camera, CameraModel},
        scene::{Scene, ViewIndex},
    },
};
use viewrank_io::{
    formats::{colmap::ColmapModel, colmap_bin},
    output::Disk,
    project::Project,
};

const SIZE: [u32; 2] = [400, 300];

fn town() -> Scene {
    let params = vec![320.0, 320.0, 200.0, 150.0];
    let camera = Camera::new(1, CameraModel::Pinhole, 400, 300, params).unwrap();
    let town = Town {
        grid: 4,
        points: 800,
        tilt: None,
        side: 40.0,
        altitude: 40.0,
        boxes: 1,
        ..Town::new(camera)
    };
    town.scene()
}

fn project(scene: &Scene) -> tempfile::TempDir {
    let project = tempfile::tempdir().unwrap();
    let sparse = project.path().join("sparse/0");
    fs::create_dir_all(&sparse).unwrap();
    for (name, bytes) in colmap_bin::write(&ColmapModel::from_scene(scene)) {
        fs::write(sparse.join(name), bytes).unwrap();
    }
    project
}

fn plan(project: &Path, maps: Option<&Path>) -> Result<Plan, String> {
    let settings = Settings {
        backends: vec!["openmvs".into()],
        pilot: PilotSettings {
            maps: maps.map(Path::to_path_buf),
        },
        ..Settings::default()
    };
    let project = Project::open(project, None).unwrap();
    viewrank::plan(&project, &settings, &NoWatcher).map_err(|error| error.to_string())
}

/// Writes the depths of the plan's surface at a quarter of the size, as NumPy files, where the map
/// of a view `has` something at a place.
fn write_maps(plan: &Plan, folder: &Path, has: impl Fn(ViewIndex, Point2<f64>) -> bool) {
    fs::create_dir_all(folder).unwrap();
    let (scene, surface) = (&plan.stages.scene, &plan.stages.surface);
    let [width, height] = SIZE.map(|side| side / 4);
    for view in scene.view_indices() {
        let (camera, pose) = (scene.camera_of(view), &scene.view(view).cam_from_world);
        let front = visibility::front(scene, surface, view, [width, height], 0..height);
        let depth = |(at, &t): (usize, &u32)| {
            let (column, row) = (at as u32 % width, at as u32 / width);
            let at = Point2::new(4.0 * f64::from(column) + 2.0, 4.0 * f64::from(row) + 2.0);
            let ray = camera.ray(&at).unwrap();
            if t == visibility::NOTHING {
                return 0.0;
            }
            let [a, b, c] = surface.corners(t).map(|p| pose.camera_from_world(&p));
            let normal = (b - a).cross(&(c - a));
            let z = normal.dot(&a.coords) / normal.dot(&ray) * ray.z;
            let place = pose.centre() + pose.rotation.inverse() * (ray.into_inner() * (z / ray.z));
            if has(view, place.xy()) { z as f32 } else { 0.0 }
        };
        let depths: Vec<f32> = front.iter().enumerate().map(depth).collect();
        let head =
            format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({height}, {width}), }}");
        let head = format!("{head:117}\n");
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend((head.len() as u16).to_le_bytes());
        bytes.extend(head.as_bytes());
        bytes.extend(depths.iter().flat_map(|depth| depth.to_le_bytes()));
        fs::write(folder.join(format!("{}.npy", scene.name(view))), bytes).unwrap();
    }
}

#[test]
fn what_the_small_maps_do_not_show_is_not_counted() {
    let project = project(&town());
    let predicted = plan(project.path(), None).unwrap();
    assert!(predicted.stages.pilot.is_none(), "there are no photographs");
    let maps = project.path().join("small");
    write_maps(&predicted, &maps, |_, place| place.x < 0.0);
    let plan = plan(project.path(), Some(&maps)).unwrap();
    let places = &plan.stages.pilot.as_ref().unwrap().places;
    assert!(places.centres.len() > 100);
    assert!(places.centres.iter().all(|place| place.x < 0.5));
    // The first views chosen show that half, where the plan without them spreads.
    let first = |plan: &Plan| {
        let keys = plan.chosen().take(3).map(|cluster| cluster.key);
        let centre = |key: ViewIndex| plan.stages.scene.view(key).cam_from_world.centre().x;
        keys.map(centre).sum::<f64>() / 3.0
    };
    assert!(first(&plan) < -5.0, "{}", first(&plan));
    // Other maps in the same folder are another pilot.
    for set in plan.unwritten() {
        set.write(&Disk::REAL).unwrap();
    }
    write_maps(&predicted, &maps, |_, place| place.x > 0.0);
    let other = self::plan(project.path(), Some(&maps)).unwrap();
    let places = &other.stages.pilot.as_ref().unwrap().places;
    assert!(places.centres.iter().all(|place| place.x > -0.5));
}

#[test]
fn a_folder_without_maps_or_with_a_damaged_one_is_an_error() {
    let project = project(&town());
    let maps = project.path().join("small");
    fs::create_dir_all(&maps).unwrap();
    let error = plan(project.path(), Some(&maps)).unwrap_err();
    assert!(error.starts_with("the pilot: "), "{error}");
    let predicted = plan(project.path(), None).unwrap();
    write_maps(&predicted, &maps, |_, _| true);
    let name = predicted.stages.scene.name(ViewIndex(2));
    let path = maps.join(format!("{name}.npy"));
    let bytes = fs::read(&path).unwrap();
    fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    let error = plan(project.path(), Some(&maps)).unwrap_err();
    assert!(error.contains(name), "{error}");
}

/// Else a stranger's plan would have them read and ranked by.
#[test]
fn a_plan_is_one_of_the_maps_outside_that_it_was_made_from() {
    let (project, outside) = (project(&town()), tempfile::tempdir().unwrap());
    let predicted = plan(project.path(), None).unwrap();
    let fingerprint = |maps: &Path| {
        let project = Project::open(project.path(), None).unwrap();
        let settings = Settings {
            pilot: PilotSettings {
                maps: Some(maps.into()),
            },
            ..Settings::default()
        };
        manifest::fingerprint(&project, &predicted.stages.scene, &settings).unwrap()
    };
    let inside = project.path().join("small");
    let both = [outside.path(), &inside];
    let write = |has: fn(f64) -> bool| {
        for maps in both {
            write_maps(&predicted, maps, |_, place| has(place.x));
        }
    };
    write(|x| x < 0.0);
    let before = both.map(fingerprint);
    write(|_| true);
    let after = both.map(fingerprint);
    assert_ne!(before[0], after[0]);
    assert_eq!(before[1], after[1], "what is in the project is its own");
}
