//! Plans around finished depth maps (method 5.4), on a town whose depths are known.

use std::{
    fs,
    path::{Path, PathBuf},
};

use nalgebra::{Point2, Vector3};
use serde_json::{Value, json};
use viewrank::{
    Plan, Settings,
    daemon::follow::{self, Progress},
    evaluate::{EvaluationInput, MeasuredClusters, MeasuredProgress},
    files::files,
    manifest::{WrittenPlan, WrittenPlanError},
    replan::{self, EarlierPlan, MapFolder, as_written, replan},
    report::{Contents, DepthMapFolders},
};
use viewrank_core::{
    base::progress::NoWatcher,
    method::{
        fulfilment::FulfilmentTable,
        ranking::{Maps, Ranker},
        synthetic::Town,
        visibility,
    },
    model::{
        camera::{Camera, CameraModel},
        cluster::MapScale,
        scene::{Scene, ViewIndex},
    },
};
use viewrank_io::{
    formats::{colmap::ColmapModel, colmap_bin},
    npy,
    output::Disk,
    project::Project,
};

use super::valley::printed;

const FOCAL: f64 = 320.0;
const ALTITUDE: f64 = 40.0;

fn town() -> Scene {
    let camera = Camera::new(
        1,
        CameraModel::Pinhole,
        400,
        300,
        vec![FOCAL, FOCAL, 200.0, 150.0],
    )
    .unwrap();
    let town = Town {
        grid: 4,
        points: 800,
        tilt: None,
        side: 40.0,
        altitude: ALTITUDE,
        boxes: 1,
        ..Town::new(camera)
    };
    town.scene()
}

/// A project of the model, planned.
struct Planned {
    folder: tempfile::TempDir,
    plan: Plan,
}

impl Planned {
    fn new(scene: &Scene) -> Self {
        let folder = tempfile::tempdir().unwrap();
        write_model(folder.path(), scene);
        let plan = plan_of(folder.path());
        write(&plan, folder.path());
        Self { folder, plan }
    }

    fn maps(&self) -> PathBuf {
        self.folder.path().join("sgm")
    }

    /// Depth maps of those clusters of the ranking; `keep` says which pixels have a depth.
    fn write_maps(&self, ranks: std::ops::Range<usize>, keep: impl Fn(u32, u32) -> bool) {
        fs::create_dir_all(self.maps()).unwrap();
        for &cluster in &self.plan.decision.ranking.order[ranks] {
            let key = self.plan.stages.clusters[cluster as usize].key;
            let depths = depths(&self.plan, key, &keep);
            write_map(
                &self
                    .maps()
                    .join(format!("{}.npy", self.plan.stages.scene.name(key))),
                [400, 300],
                depths,
            );
        }
    }

    /// The plan of the model that is there now, around the maps.
    fn again(&self) -> Plan {
        let project = Project::open(self.folder.path(), None).unwrap();
        let maps = MapFolder {
            folder: &self.maps(),
            ready: &|_| true,
            known: &|_| true,
        };
        let plan = plan_of(self.folder.path());
        replan(
            plan,
            &EarlierPlan::read(&project).unwrap(),
            &maps,
            &NoWatcher,
        )
        .unwrap()
        .0
    }

    fn keys(&self, ranks: std::ops::Range<usize>) -> Vec<&str> {
        let key = |&c: &u32| {
            self.plan
                .stages
                .scene
                .name(self.plan.stages.clusters[c as usize].key)
        };
        self.plan.decision.ranking.order[ranks]
            .iter()
            .map(key)
            .collect()
    }
}

fn write_model(project: &Path, scene: &Scene) {
    let folder = project.join("sparse/0");
    fs::create_dir_all(&folder).unwrap();
    for (name, bytes) in colmap_bin::write(&ColmapModel::from_scene(scene)) {
        fs::write(folder.join(name), bytes).unwrap();
    }
}

fn plan_of(folder: &Path) -> Plan {
    let settings = Settings {
        backends: vec!["sgm".into()],
        ..Settings::default()
    };
    viewrank::plan(&Project::open(folder, None).unwrap(), &settings, &NoWatcher).unwrap()
}

fn write(plan: &Plan, folder: &Path) {
    let files = files(plan, &Project::open(folder, None).unwrap()).unwrap();
    files
        .sets
        .iter()
        .for_each(|set| drop(set.write(&Disk::REAL).unwrap()));
}

/// Depth of the plan's surface in each pixel of the view.
fn depths(plan: &Plan, view: ViewIndex, keep: impl Fn(u32, u32) -> bool) -> Vec<f32> {
    let camera = plan.stages.scene.camera_of(view);
    let pose = &plan.stages.scene.view(view).cam_from_world;
    let front = visibility::front(
        &plan.stages.scene,
        &plan.stages.surface,
        view,
        [camera.width, camera.height],
        0..camera.height,
    );
    let depth = |(at, &t): (usize, &u32)| {
        let (column, row) = (at as u32 % camera.width, at as u32 / camera.width);
        if t == visibility::NOTHING || !keep(column, row) {
            return 0.0;
        }
        let ray = camera
            .ray(&Point2::new(f64::from(column) + 0.5, f64::from(row) + 0.5))
            .unwrap();
        let [a, b, c] = plan
            .stages
            .surface
            .corners(t)
            .map(|p| pose.camera_from_world(&p));
        let normal = (b - a).cross(&(c - a));
        (normal.dot(&a.coords) / normal.dot(&ray) * ray.z) as f32
    };
    front.iter().enumerate().map(depth).collect()
}

fn write_map(path: &Path, [width, height]: [usize; 2], depths: Vec<f32>) {
    fs::write(path, npy::write(&[height, width], depths)).unwrap();
}

/// The plan matches all at one size; the maps of another plan had half of it.
#[test]
fn finished_maps_at_half_the_size_stay_such_and_are_no_measure_of_what_can_be_reached() {
    let planned = Planned::new(&town());
    planned.write_maps(0..3, |_, _| true);
    let full = planned.again();
    for key in planned.keys(0..3) {
        let path = planned.maps().join(format!("{key}.npy"));
        let bytes = fs::read(&path).unwrap();
        let map = npy::read(&bytes).unwrap().values::<f32>().unwrap();
        let half = (0..150 * 200)
            .map(|at| map[2 * (at / 200) * 400 + 2 * (at % 200)])
            .collect();
        write_map(&path, [200, 150], half);
    }
    let half = planned.again();
    assert_eq!(half.decision.finished, 3);
    let scales = |plan: &Plan| {
        plan.decision
            .ranking
            .scales
            .iter()
            .filter(|&&scale| scale == MapScale::Half)
            .count()
    };
    assert_eq!((scales(&full), scales(&half)), (0, 3));
    assert!(
        half.decision.ranking.scales[..3]
            .iter()
            .all(|&scale| scale == MapScale::Half)
    );
    let [of_full, of_half] = [&full, &half].map(|plan| &plan.decision.ranking);
    assert!(
        of_half.kept[2] < of_full.kept[2],
        "{} {}",
        of_half.kept[2],
        of_full.kept[2]
    );
    // What the other views would give is corrected by what was measured, but these three count at
    // full size.
    assert!(
        of_half.reachable > 0.98 * planned.plan.decision.ranking.reachable,
        "{}",
        of_half.reachable
    );
    assert!(of_half.share(of_half.order.len()) < 1.0);
}

/// The predicted values of a cluster with those of the finished ones replaced, ranked plainly.
#[test]
fn without_failures_the_rest_is_ranked_as_by_prediction_behind_the_real_values() {
    let planned = Planned::new(&town());
    planned.write_maps(0..3, |_, _| true);
    let again = planned.again();
    assert_eq!(again.decision.finished, 3);
    let before = &planned.plan;
    assert_eq!(again.stages.clusters, before.stages.clusters);
    let finished = &before.decision.ranking.order[..3];
    let expected = |c: usize| -> Vec<(u32, f32)> {
        let from = if finished.contains(&(c as u32)) {
            &again.stages.fulfilment
        } else {
            &before.stages.fulfilment
        };
        let (triangles, values) = from.row(c);
        triangles
            .iter()
            .copied()
            .zip(values.iter().copied())
            .collect()
    };
    let table = FulfilmentTable::new((0..before.stages.clusters.len()).map(expected));
    assert_eq!(again.stages.fulfilment, table);
    let finished: Vec<_> = finished.iter().map(|&c| (c, MapScale::Full)).collect();
    let expected = Ranker::new(&Maps::full_size(&table), &before.stages.objective)
        .unwrap()
        .rank(&finished, 0.0, &NoWatcher)
        .unwrap();
    assert_eq!(again.decision.ranking, expected);
}

#[test]
fn what_failed_lowers_what_is_expected_of_its_neighbours_and_of_nobody_else() {
    let planned = Planned::new(&town());
    planned.write_maps(0..1, |column, _| column >= 200);
    let again = planned.again();
    let first = planned.plan.decision.ranking.order[0] as usize;
    let mut lowered = 0;
    for c in (0..again.stages.clusters.len()).filter(|&c| c != first) {
        let (before, after) = (
            planned.plan.stages.fulfilment.row(c),
            again.stages.fulfilment.row(c),
        );
        assert_eq!(before.0, after.0);
        assert!(before.1.iter().zip(after.1).all(|(b, a)| a <= b));
        lowered += before.1.iter().zip(after.1).filter(|(b, a)| a < b).count();
    }
    assert!(lowered > 0);
    // Triangles that the failed half of the map does not show are expected as before.
    let failed: Vec<u32> = {
        let key = planned.plan.stages.clusters[first].key;
        let picture = visibility::front(
            &planned.plan.stages.scene,
            &planned.plan.stages.surface,
            key,
            [400, 300],
            0..300,
        );
        let left = |&(at, _): &(usize, &u32)| at % 400 < 200;
        picture
            .iter()
            .enumerate()
            .filter(left)
            .map(|(_, t)| *t)
            .collect()
    };
    for c in (0..again.stages.clusters.len()).filter(|&c| c != first) {
        let (triangles, before) = planned.plan.stages.fulfilment.row(c);
        for ((t, b), a) in triangles
            .iter()
            .zip(before)
            .zip(again.stages.fulfilment.row(c).1)
        {
            assert!(a == b || failed.contains(t));
        }
    }
}

#[test]
fn finished_clusters_stay_at_the_head_of_the_files_and_of_the_cut() {
    let planned = Planned::new(&town());
    // The last of the ranking, which no cut would take.
    let all = planned.plan.decision.ranking.order.len();
    planned.write_maps(all - 2..all, |_, _| true);
    let again = planned.again();
    write(&again, planned.folder.path());
    assert!(again.decision.cut.clusters >= 2);
    let text = fs::read_to_string(planned.folder.path().join("viewrank/clusters.txt")).unwrap();
    let keys: Vec<&str> = text
        .lines()
        .map(|line| line.split('\t').next().unwrap())
        .collect();
    assert_eq!(keys[..2], planned.keys(all - 2..all));
    let manifest = fs::read(planned.folder.path().join("viewrank/manifest.json")).unwrap();
    let manifest: serde_json::Value = serde_json::from_slice(&manifest).unwrap();
    let finished: Vec<bool> = manifest["clusters"]
        .as_array()
        .unwrap()
        .iter()
        .map(|c| c["finished"].as_bool().unwrap())
        .collect();
    assert!(finished[..2].iter().all(|&f| f) && finished[2..].iter().all(|&f| !f));
    // Nothing new has come: the same bytes.
    let once_more = planned.again();
    assert_eq!(once_more.decision.ranking, again.decision.ranking);
}

#[test]
fn a_plan_keeps_the_maps_of_the_plan_before_with_the_partners_they_were_made_with() {
    let planned = Planned::new(&town());
    planned.write_maps(0..2, |_, _| true);
    let root = planned.folder.path().to_str().unwrap();
    let clusters = || {
        let manifest = fs::read(planned.folder.path().join("viewrank/manifest.json")).unwrap();
        let manifest: Value = serde_json::from_slice(&manifest).unwrap();
        let part = |c: &Value| [&c["key"], &c["partners"], &c["finished"]].map(Value::clone);
        let clusters = manifest["clusters"].as_array().unwrap();
        clusters.iter().map(part).collect::<Vec<_>>()
    };
    let before = clusters();
    assert!(before[0][1].as_array().unwrap().len() > 1, "{before:?}");
    printed(&["plan", root, "-k", "1", "--quiet"]);
    let after = clusters();
    for (before, after) in before[..2].iter().zip(&after) {
        assert_eq!((&before[..2], &after[2]), (&after[..2], &json!(true)));
    }
    let mut rest = after[2..].iter();
    assert!(rest.all(|c| c[1].as_array().unwrap().len() <= 1));
    // A new plan for another program knows nothing of these maps.
    let settings = planned.folder.path().join("viewrank.toml");
    fs::write(settings, "backends = [\"gipuma\"]\n").unwrap();
    printed(&["plan", root, "--quiet"]);
    assert!(clusters().iter().all(|c| c[2] == json!(false)));
}

#[test]
fn maps_without_a_record_keep_no_plan_from_being_made() {
    let planned = Planned::new(&town());
    planned.write_maps(0..2, |_, _| true);
    let at = |name: &str| planned.folder.path().join("viewrank").join(name);
    fs::remove_file(at("planned_views.json")).unwrap();
    let root = planned.folder.path().to_str().unwrap();
    printed(&["plan", root, "--quiet"]);
    let manifest: Value = serde_json::from_slice(&fs::read(at("manifest.json")).unwrap()).unwrap();
    assert_eq!(manifest["clusters"][0]["finished"], false);
    assert!(at("planned_views.json").is_file());
}

#[test]
fn a_plan_around_finished_maps_is_read_as_it_was_written() {
    let planned = Planned::new(&town());
    let all = planned.plan.decision.ranking.order.len();
    planned.write_maps(all - 2..all, |column, _| column >= 100);
    let again = planned.again();
    write(&again, planned.folder.path());
    let keys = |plan: &Plan| {
        plan.ranked()
            .map(|c| (c.key, c.partners))
            .collect::<Vec<_>>()
    };
    assert_ne!(keys(&again), keys(&planned.plan));
    let (_, read, _) = as_written(planned.folder.path(), &NoWatcher).unwrap();
    assert_eq!(keys(&read), keys(&again));
    assert_eq!(
        (read.decision.cut.clusters, read.decision.finished),
        (again.decision.cut.clusters, 2)
    );
    assert_eq!(read.decision.views, again.decision.views);
    assert!(read.unwritten().is_empty(), "what is kept is predicted");
    assert!(
        read.warnings.starts_with(&again.warnings),
        "and what writing the plan found"
    );
    let near = |a: &[f64], b: &[f64]| {
        a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-12)
    };
    assert!(near(
        &read.decision.ranking.gains,
        &again.decision.ranking.gains
    ));
    assert!(near(
        &read.decision.ranking.fulfilment,
        &again.decision.ranking.fulfilment
    ));
    assert_eq!(
        keys(&replan::repeat(planned.folder.path(), &NoWatcher).unwrap().1),
        keys(&planned.plan),
        "the prediction"
    );

    // A cluster that is not finished and not this program's.
    let path = planned.folder.path().join("viewrank/manifest.json");
    let mut manifest: serde_json::Value =
        serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    manifest["clusters"][2]["partners"]
        .as_array_mut()
        .unwrap()
        .pop();
    manifest["cut"]["pairs"] = (manifest["cut"]["pairs"].as_u64().unwrap() - 1).into();
    fs::write(&path, manifest.to_string()).unwrap();
    let error = as_written(planned.folder.path(), &NoWatcher).unwrap_err();
    assert!(error.to_string().contains("ranks differently"), "{error}");
}

/// The model with a view moved along its image by so many pixels at the ground.
#[test]
fn kept_stages_change_nothing_and_hold_predictions() {
    let planned = Planned::new(&town());
    planned.write_maps(0..3, |column, _| column > 100);
    let cache = planned.folder.path().join("viewrank/cache");
    let kept_files = || {
        let mut files: Vec<_> = fs::read_dir(&cache)
            .unwrap()
            .map(|entry| entry.unwrap().path())
            .collect();
        files.sort();
        files
            .into_iter()
            .map(|path| (path.clone(), fs::read(path).unwrap()))
            .collect::<Vec<_>>()
    };
    let before = kept_files();
    let fast = planned.again();
    assert!(
        fast.unwritten().is_empty(),
        "nothing was computed but the ranking"
    );
    fs::remove_dir_all(&cache).unwrap();
    let slow = planned.again();
    let manifest = |plan: &Plan| {
        let project = Project::open(planned.folder.path(), None).unwrap();
        files(plan, &project).unwrap().manifest.to_json()
    };
    assert_eq!(manifest(&fast), manifest(&slow));
    assert!(
        fast.stages.fulfilment == slow.stages.fulfilment
            && fast.stages.fulfilment != planned.plan.stages.fulfilment
    );
    write(&slow, planned.folder.path());
    assert!(kept_files() == before);
}

fn shifted(scene: &Scene, name: &str, pixels: f64) -> Scene {
    let mut scene = scene.clone();
    let view = scene.find(name).unwrap();
    scene.views[view.index()].cam_from_world.translation +=
        Vector3::new(pixels * ALTITUDE / FOCAL, 0.0, 0.0);
    scene
}

#[test]
fn maps_whose_views_moved_too_far_are_named_and_the_others_stay() {
    let scene = town();
    let planned = Planned::new(&scene);
    planned.write_maps(0..4, |_, _| true);
    let cluster = &planned.plan.stages.clusters[planned.plan.decision.ranking.order[0] as usize];
    let moved = planned.plan.stages.scene.name(cluster.partners[0]);
    write_model(planned.folder.path(), &shifted(&scene, moved, 0.4));
    let again = planned.again();
    assert_eq!(
        (again.decision.finished, again.finished.outdated.len()),
        (4, 0),
        "within a pixel"
    );
    assert!(!again.finished.made_with.is_empty());
    write(&again, planned.folder.path());

    // 0.8 px more is 1.2 px from where the view was when the maps were made.
    write_model(planned.folder.path(), &shifted(&scene, moved, 1.2));
    let later = planned.again();
    let mut with_moved: Vec<&str> = {
        let uses = |&&c: &&u32| {
            let cluster = &planned.plan.stages.clusters[c as usize];
            cluster.key == planned.plan.stages.scene.find(moved).unwrap()
                || cluster
                    .partners
                    .contains(&planned.plan.stages.scene.find(moved).unwrap())
        };
        let order = &planned.plan.decision.ranking.order[..4];
        order
            .iter()
            .filter(uses)
            .map(|&c| {
                planned
                    .plan
                    .stages
                    .scene
                    .name(planned.plan.stages.clusters[c as usize].key)
            })
            .collect()
    };
    with_moved.sort_unstable();
    let named: Vec<&str> = later
        .finished
        .outdated
        .iter()
        .map(|o| o.key.as_str())
        .collect();
    assert_eq!(
        named, with_moved,
        "{moved} moved: {:?}",
        later.finished.outdated
    );
    assert_eq!(later.decision.finished, 4 - with_moved.len());
    for outdated in &later.finished.outdated {
        let pixels = outdated.moved_px.unwrap();
        // The ground lies up to 3 m nearer or farther than the mean, a box 8 m nearer.
        assert!((1.0..1.6).contains(&pixels), "{pixels}");
    }
    write(&later, planned.folder.path());

    // The outdated maps are still the same files and stay outdated; one made anew is not.
    let anew = with_moved[0];
    let view = planned.plan.stages.scene.find(anew).unwrap();
    write_map(
        &planned.maps().join(format!("{anew}.npy")),
        [400, 300],
        depths(&planned.plan, view, |column, _| column % 2 == 0),
    );
    let last = planned.again();
    let named: Vec<&str> = last
        .finished
        .outdated
        .iter()
        .map(|o| o.key.as_str())
        .collect();
    assert_eq!(named, with_moved[1..]);
}

#[test]
fn an_outdated_map_stays_named_while_its_view_has_no_partners() {
    let scene = town();
    let planned = Planned::new(&scene);
    planned.write_maps(0..2, |_, _| true);
    let moved = planned.keys(0..1)[0];
    let later = shifted(&scene, moved, 3.0);
    for model in [
        later.clone(),
        unobserved(&later, later.find(moved).unwrap()),
        later,
    ] {
        write_model(planned.folder.path(), &model);
        let again = planned.again();
        assert!(
            again
                .finished
                .outdated
                .iter()
                .any(|outdated| outdated.key == moved)
        );
        write(&again, planned.folder.path());
    }
}

#[test]
fn new_views_and_another_frame_leave_finished_maps_valid_and_another_scale_does_not() {
    let scene = town();
    let mut fewer = scene.clone();
    // The last view is not in the first model.
    let gone = ViewIndex(fewer.views.len() as u32 - 1);
    fewer = without(&fewer, gone);
    let planned = Planned::new(&fewer);
    planned.write_maps(0..3, |_, _| true);
    write_model(planned.folder.path(), &transformed(&scene, 1.0));
    let again = planned.again();
    assert_eq!(
        (again.decision.finished, again.finished.outdated.len()),
        (3, 0)
    );
    assert!(again.stages.scene.views.len() > planned.plan.stages.scene.views.len());
    write_model(planned.folder.path(), &transformed(&scene, 1.1));
    let again = planned.again();
    assert_eq!(
        (again.decision.finished, again.finished.outdated.len()),
        (0, 3)
    );
}

/// The scene without its last view.
fn without(scene: &Scene, view: ViewIndex) -> Scene {
    let mut fewer = unobserved(scene, view);
    assert_eq!(view.index(), fewer.views.len() - 1, "indices stay");
    fewer.views.pop();
    fewer
}

/// The scene without the observations of a view.
fn unobserved(scene: &Scene, view: ViewIndex) -> Scene {
    let mut fewer = scene.clone();
    let (mut views, mut pixels, mut offsets) = (Vec::new(), Vec::new(), vec![0]);
    for track in scene.track_offsets.windows(2) {
        for at in (track[0]..track[1]).filter(|&at| scene.track_views[at] != view) {
            views.push(scene.track_views[at]);
            pixels.push(scene.track_pixels[at]);
        }
        offsets.push(views.len() as _);
    }
    (fewer.track_views, fewer.track_pixels, fewer.track_offsets) = (views, pixels, offsets);
    fewer
}

/// The same scene in another frame: turned, moved and scaled.
fn transformed(scene: &Scene, scale: f64) -> Scene {
    let turn = nalgebra::Rotation3::from_euler_angles(0.3, -0.2, 1.0);
    let shift = Vector3::new(100.0, -20.0, 7.0);
    let mut other = scene.clone();
    for point in &mut other.points {
        *point = (turn * point.coords * scale + shift).into();
    }
    for view in &mut other.views {
        let pose = &mut view.cam_from_world;
        let rotation = pose.rotation * turn.inverse();
        pose.translation = pose.translation * scale - rotation * shift;
        pose.rotation = rotation;
    }
    other
}

#[test]
fn a_map_that_is_cut_off_says_nothing_about_the_others() {
    let mut moved = town();
    let planned = Planned::new(&moved);
    planned.write_maps(0..2, |_, _| true);
    fs::write(planned.maps().join("depth0009.dmap"), "DR").unwrap();
    fs::write(planned.maps().join("depth0010.dmap"), "").unwrap();
    for view in &mut moved.views {
        view.cam_from_world.translation.x += f64::from(view.image_id % 2);
    }
    write_model(planned.folder.path(), &moved);
    let plan = planned.again();
    let outdated: Vec<&str> = plan
        .finished
        .outdated
        .iter()
        .map(|outdated| outdated.key.as_str())
        .collect();
    let mut keys = planned.keys(0..2);
    keys.sort_unstable();
    assert_eq!((plan.decision.finished, outdated), (0, keys));
    assert_eq!(
        plan.finished.unreadable.len(),
        2,
        "{:?}",
        plan.finished.unreadable
    );
    assert!(plan.finished.unreadable[0].contains("depth0009.dmap"));
}

#[test]
fn a_manifest_that_contradicts_itself_is_refused_with_its_field() {
    let planned = Planned::new(&town());
    let root = planned.folder.path();
    let path = root.join("viewrank/manifest.json");
    let written: serde_json::Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    WrittenPlan::read(root).unwrap();
    let clusters = written["clusters"].as_array().unwrap();
    let [first, second] = [0, 1].map(|i| clusters[i]["key"].clone());
    let edits: [(&str, serde_json::Value, &str); 23] = [
        (
            "/clusters/1/partners/0",
            second.clone(),
            "clusters[1].partners: ",
        ),
        (
            "/clusters/1/partners",
            vec![first.clone(); 5].into(),
            "clusters[1].partners: ",
        ),
        (
            "/clusters/1/partners/0",
            "nobody.jpg".into(),
            "clusters[1].partners: ",
        ),
        ("/clusters/1/key", first.clone(), "clusters[1].key: "),
        ("/clusters/1/key", "nobody.jpg".into(), "clusters[1].key: "),
        ("/clusters/1/rank", (-1).into(), "clusters[1].rank: "),
        ("/clusters/1/rank", 3.into(), "clusters[1].rank: "),
        ("/clusters/1/share", 17.into(), "clusters[1].share: "),
        ("/clusters/1/share", 0.0.into(), "clusters[1].share: "),
        ("/clusters/1/share", f64::NAN.into(), "null"),
        ("/clusters/1/gain", (-0.5).into(), "clusters[1].gain: "),
        (
            "/clusters/1/fulfilment",
            0.0.into(),
            "clusters[1].fulfilment: ",
        ),
        (
            "/clusters/1/finished",
            true.into(),
            "clusters[1].finished: ",
        ),
        ("/cut/clusters", 1_000_000_000.into(), "cut.clusters: "),
        ("/cut/clusters", (-1).into(), "-1"),
        ("/cut/pairs", 1.into(), "cut.pairs: "),
        ("/cut/share", 17.into(), "cut.share: "),
        ("/cut/reachable", (-1).into(), "cut.reachable: "),
        ("/backend", "nobody".into(), "backend: "),
        (
            "/views/1/name",
            written["views"][0]["name"].clone(),
            "views[1].name: ",
        ),
        (
            "/settings/fulfilment/alpha",
            17.into(),
            "settings.fulfilment.alpha",
        ),
        ("/settings/image_scale", 0.into(), "settings.image_scale"),
        (
            "/settings/surface/up",
            vec![0; 3].into(),
            "settings.surface.up",
        ),
    ];
    for (place, value, words) in edits {
        let mut edited = written.clone();
        *edited.pointer_mut(place).unwrap() = value;
        fs::write(&path, edited.to_string()).unwrap();
        match WrittenPlan::read(root) {
            Err(WrittenPlanError::Manifest { what, path: named }) => {
                assert!(what.contains(words) && named == path, "{place}: {what}");
            }
            other => panic!("{place}: {:?}", other.map(|plan| plan.clusters)),
        }
        let project = Project::open(root, None).unwrap();
        assert!(
            matches!(
                EarlierPlan::read(&project),
                Err(WrittenPlanError::Manifest { .. })
            ),
            "{place}"
        );
    }
}

#[test]
fn the_same_maps_reach_the_same_share_wherever_it_is_shown() {
    let planned = Planned::new(&town());
    // Every third column failed.
    planned.write_maps(0..3, |column, _| column % 3 > 0);
    let root = planned.folder.path();
    let of_plan = planned.again().decision.ranking.share(3);
    assert!(of_plan > 0.0 && of_plan < 1.0);

    let _ = follow::follow(root, &|_| true, &NoWatcher);
    let of_status = Progress::read(root).unwrap().share.unwrap();

    let (project, plan, exports) = as_written(root, &NoWatcher).unwrap();
    let folders = DepthMapFolders {
        depth_maps: Some(planned.maps()),
        reference: None,
    };
    let contents = Contents::new(&plan, &project, &exports, &folders, &NoWatcher).unwrap();
    let contents = serde_json::to_value(&contents).unwrap();
    let of_report = contents["real"]["share"].as_array().unwrap()[2]
        .as_f64()
        .unwrap();

    let clusters: Vec<_> = plan
        .decision
        .ranking
        .order
        .iter()
        .map(|&c| plan.stages.clusters[c as usize].clone())
        .collect();
    let maps = planned.maps();
    let run = MeasuredClusters::new(
        &EvaluationInput::new(&plan.stages, &clusters, &maps, None),
        &NoWatcher,
    )
    .unwrap();
    let of_evaluate = MeasuredProgress::new(&plan.stages, &run).share.unwrap();

    for (shown, share) in [
        ("status", of_status),
        ("report", of_report),
        ("evaluate", of_evaluate),
    ] {
        assert!(
            (share - of_plan).abs() < 1e-9,
            "{shown}: {share}, plan: {of_plan}"
        );
    }
}

#[test]
fn status_shows_what_evaluate_measured_and_counts_the_maps_that_came_after() {
    let planned = Planned::new(&town());
    planned.write_maps(0..1, |column, _| column % 3 > 0);
    let root = planned.folder.path().to_str().unwrap();
    let of = |command: &str| -> Value {
        serde_json::from_str(&printed(&[command, root, "--format", "json"])).unwrap()
    };
    let evaluated = of("evaluate");
    let status = &of("status")["projects"][0];
    assert_eq!(status["share"], evaluated["reached"]["share"]);
    assert_eq!(
        (&status["done"], &status["unmeasured"]),
        (&json!(1), &Value::Null)
    );
    // In the same words, too.
    let all = planned.plan.decision.forecast.all_maps;
    let area = format!("% of the area that all {all} cover");
    for command in ["status", "evaluate"] {
        let text = printed(&[command, root]);
        assert!(text.contains(&area), "{area}: {text}");
    }
    planned.write_maps(1..2, |_, _| true);
    let status = &of("status")["projects"][0];
    assert_eq!(
        (&status["done"], &status["unmeasured"]),
        (&json!(1), &json!(1))
    );
    let first = planned.keys(0..1)[0];
    fs::remove_file(planned.maps().join(format!("{first}.npy"))).unwrap();
    let text = printed(&["status", root]);
    let is_said = |text: &str| text.contains("1 measured depth map is gone");
    let status = &of("status")["projects"][0];
    assert!(is_said(&text), "{text}");
    assert!(is_said(status["note"].as_str().unwrap()), "{status}");
    assert_eq!(status["state"], "partial");
    // Of a later plan the measurement says nothing.
    let manifest = planned.folder.path().join("viewrank/manifest.json");
    fs::write(&manifest, fs::read(&manifest).unwrap()).unwrap();
    assert_eq!(of("status")["projects"][0]["share"], Value::Null);
}

#[test]
fn evaluate_records_the_maps_of_the_plan_also_where_their_folder_is_named() {
    let planned = Planned::new(&town());
    planned.write_maps(0..1, |column, _| column % 3 > 0);
    let root = planned.folder.path().to_str().unwrap();
    let (maps, other) = (planned.maps(), planned.folder.path().join("copies"));
    fs::create_dir(&other).unwrap();
    for map in fs::read_dir(&maps).unwrap().map(Result::unwrap) {
        fs::copy(map.path(), other.join(map.file_name())).unwrap();
    }
    let recorded = |folder: &Path| {
        let named = folder.join("../").join(folder.file_name().unwrap());
        printed(&["evaluate", root, "--depth-maps", named.to_str().unwrap()]);
        Progress::read(planned.folder.path()).map(|progress| progress.done)
    };
    assert_eq!(recorded(&other), None, "maps of anybody");
    assert_eq!(recorded(&maps), Some(1));
}
