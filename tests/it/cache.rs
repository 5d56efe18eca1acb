//! Results of stages that a project keeps for its next plan (`viewrank/cache`): the same plan with
//! and without them, whatever has changed.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs, io,
    path::Path,
    sync::atomic::{AtomicUsize, Ordering},
};

use tempfile::TempDir;
use viewrank::{
    Plan, Settings,
    config::{self},
    files::files,
};
use viewrank_core::{
    base::progress::NoWatcher,
    method::synthetic::Town,
    model::{
        camera::{Camera, CameraModel},
        scene::Scene,
    },
};
use viewrank_io::{
    output::{self, Contents, Disk, Operation},
    ply,
    project::Project,
};

/// All stages, in the order of the plan.
const ALL: [&str; 7] = [
    "twins",
    "surface",
    "shown",
    "candidates",
    "confidence",
    "clusters",
    "ranking",
];
/// Settings that no plan reads, or that name a folder which the tests lack (pilot.rs has small
/// maps).
const NO_PART_OF_A_PLAN: [&str; 3] = ["on_target", "images", "pilot.maps"];

fn town() -> Scene {
    let camera = Camera::new(
        1,
        CameraModel::Pinhole,
        400,
        300,
        vec![320.0, 320.0, 200.0, 150.0],
    )
    .unwrap();
    Town {
        grid: 4,
        points: 800,
        side: 40.0,
        boxes: 1,
        ..Town::new(camera)
    }
    .scene()
}

fn settings(text: &str) -> Settings {
    let settings: Settings = toml::from_str(text).unwrap_or_else(|error| panic!("{text}: {error}"));
    if settings.backends.is_empty() {
        Settings {
            backends: vec!["sgm".into()],
            ..settings
        }
    } else {
        settings
    }
}

fn open(folder: &Path) -> Project {
    Project::open(folder, None).unwrap()
}

fn plan(folder: &Path, text: &str) -> Plan {
    viewrank::plan(&open(folder), &settings(text), &NoWatcher)
        .unwrap_or_else(|error| panic!("{text}: {error}"))
}

fn write(plan: &Plan, folder: &Path) {
    output::write_all(&files(plan, &open(folder)).unwrap().sets, &Disk::REAL).unwrap();
}

/// A project of the scene with its plan and all that it keeps.
fn planned(scene: &Scene) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    Project::create(folder.path(), scene, None).unwrap();
    write(&plan(folder.path(), ""), folder.path());
    folder
}

/// Files of a plan as they would be written, without the cache and what differs from run to run.
fn written(plan: &Plan, folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let own = files(plan, &open(folder)).unwrap().sets.swap_remove(0);
    let bytes = |contents| match contents {
        Contents::Bytes(bytes) => bytes,
        other => panic!("{other:?}"),
    };
    let mut all: BTreeMap<_, _> = own
        .files
        .into_iter()
        .map(|(path, contents)| (path, bytes(contents)))
        .collect();
    all.remove("viewrank/timings.json").unwrap();
    all
}

/// Stages that the plan did not find kept, or of which it has more to keep.
fn computed(plan: &Plan) -> Vec<String> {
    plan.unwritten().into_iter().map(|set| set.name).collect()
}

fn assert_same(kept: &Plan, anew: &Plan, folder: &Path, what: &str) {
    let (a, b) = (&kept.stages, &anew.stages);
    assert!(
        a.surface.vertices == b.surface.vertices && a.surface.triangles == b.surface.triangles,
        "{what}: surface"
    );
    assert!(
        a.visibility == b.visibility && a.surface_stats == b.surface_stats,
        "{what}: visibility"
    );
    assert!(a.candidates == b.candidates, "{what}: candidates");
    assert!(a.unary == b.unary, "{what}: confidence");
    assert!(
        a.clusters == b.clusters && a.fulfilment == b.fulfilment && a.half == b.half,
        "{what}: clusters"
    );
    assert!(
        kept.decision.ranking == anew.decision.ranking,
        "{what}: ranking"
    );
    let (kept, anew) = (written(kept, folder), written(anew, folder));
    for (path, bytes) in &anew {
        assert!(kept[path] == *bytes, "{what}: {path}");
    }
}

#[test]
fn the_same_plan_again_computes_no_stage() {
    let folder = planned(&town());
    let again = plan(folder.path(), "");
    assert_eq!(computed(&again), Vec::<String>::new());
    let before = written(&again, folder.path());
    fs::remove_dir_all(folder.path().join("viewrank/cache")).unwrap();
    let anew = plan(folder.path(), "");
    assert_eq!(computed(&anew), ALL);
    assert!(written(&anew, folder.path()) == before);
}

#[test]
fn what_touches_only_cut_budget_or_region_computes_at_most_the_ranking() {
    let folder = planned(&town());
    let of = |text: &str| computed(&plan(folder.path(), text));
    let cut = "cut.target = '50%'\ncut.budget = '3'\nforecast.seconds_per_pair = 2.0\nbackends = ['sgm', 'images']";
    assert_eq!(of(cut), Vec::<String>::new());
    assert_eq!(of("region = '-10,-10,-20,10,10,20'"), ["ranking"]);
    assert_eq!(of("ranking.weight = 'area'"), ["ranking"]);
    assert_eq!(of("fulfilment.alpha = 0.3"), ["clusters", "ranking"]);
    assert_eq!(of("partners.k = 3"), ["candidates", "clusters", "ranking"]);
    assert_eq!(
        of("target.gsd = 0.2"),
        ["surface", "shown", "confidence", "clusters", "ranking"]
    );
}

/// With a limit, what else the tables hold decides whether a kept surface and its visibility may be
/// in memory.
#[test]
fn with_a_limit_a_surface_is_kept_for_tables_of_the_same_size() {
    let folder = planned(&town());
    assert_eq!(
        computed(&plan(folder.path(), "ranking.scales = [1.0, 0.5]")),
        ["clusters", "ranking"]
    );
    let limited = |text: &str| plan(folder.path(), &format!("max_memory = '8G'\n{text}"));
    write(&limited(""), folder.path());
    assert_eq!(
        computed(&limited("cut.target = '50%'")),
        Vec::<String>::new()
    );
    assert!(computed(&limited("ranking.scales = [1.0, 0.5]")).contains(&"surface".into()));
}

/// A longer cut computes what it needs of its further clusters alone, and keeps that as well.
#[test]
fn a_longer_cut_adds_to_what_is_kept() {
    let folder = planned(&town());
    let [short, long] = ["", "cut.target = '99%'"].map(|text| (text, plan(folder.path(), text)));
    assert!(short.1.decision.cut.clusters < long.1.decision.cut.clusters);
    assert_eq!(
        (computed(&short.1), computed(&long.1)),
        (vec![], vec!["ranking".to_owned()])
    );
    write(&long.1, folder.path());
    let kept = [short, long].map(|(text, _)| (text, plan(folder.path(), text)));
    fs::remove_dir_all(folder.path().join("viewrank/cache")).unwrap();
    for (text, kept) in kept {
        assert_eq!(computed(&kept), Vec::<String>::new(), "{text}");
        let anew = plan(folder.path(), text);
        assert!(
            written(&kept, folder.path()) == written(&anew, folder.path()),
            "{text}"
        );
        assert_eq!(kept.points_by_rank(), anew.points_by_rank(), "{text}");
    }
}

/// For each setting another value than its default, with what it needs to be in force.
fn changes(folder: &Path) -> BTreeMap<&'static str, String> {
    let surface = plan(folder, "").stages.tables.surface;
    let mesh = folder.join("mesh.ply");
    fs::write(
        &mesh,
        ply::write(&surface.vertices, &surface.triangles[1..], &[], &[]),
    )
    .unwrap();
    let mesh = format!("surface.mesh = '{}'", mesh.display());
    let text = "units = 'metric' | image_scale = 0.5 | seed = 7 | max_memory = '4G' | backends = ['openmvs'] \
        | region = '-10,-10,-20,10,10,20' | target.gsd = 0.2 | target.accuracy = 0.3 | target.mode = 'absolute' \
        | coverage.min_cameras = 2 | fulfilment.alpha = 0.3 | fulfilment.sigma_px = 1.0 | surface.kind = 'terrain' \
        | surface.edge_factor = 30.0 | surface.max_edge_factor = 60.0 | surface.ray_weight = 3.0 \
        | surface.sigma_factor = 3.0 | surface.behind_sigma = 1.0 | surface.quality_weight = 2.0 \
        | surface.rays_per_point = 2 | surface.up = [0.0, 0.3, 1.0]; surface.kind = 'terrain' | surface.tile_points = 300 \
        | visibility.max_incidence_deg = 50.0 | visibility.min_free_share = 0.9 | visibility.tolerance_edges = 0.0 \
        | visibility.tolerance_depth = 0.1 | visibility.buffer_px = 200 | partners.k = 3 | partners.candidates = 8 \
        | partners.draws = 3; partners.method = 'sampled' | partners.triangle_fraction = 3; partners.method = 'sampled' \
        | partners.method = 'sampled' | partners.gate.min_shared_points = 60 | partners.gate.min_angle = 15.0 \
        | partners.gate.max_angle = 20.0 | partners.gate.max_scale_octaves = 0.1 | partners.gate.epipole_inside = false \
        | confidence.source = 'none' | confidence.p0 = 0.6 | confidence.cosine_power = 3.0 | confidence.scale_octaves = 0.5 \
        | confidence.full_angle = 30.0 | confidence.agree = 0.7 | confidence.differ = 0.3 | confidence.full_agreement = 0.5 \
        | confidence.min_matches = 2 | ranking.support = 3 | ranking.weight = 'count' | ranking.keep_px = 3.0 \
        | ranking.scales = [1.0, 0.5] | ranking.half_worth = 0.1; ranking.scales = [1.0, 0.5] | cut.budget = '3' \
        | cut.target = '50%'; ranking.scales = [1.0, 0.5] | cut.time = '1h'; forecast.seconds_per_pair = 2.0 | cut.points = '1M' \
        | forecast.seconds_per_pair = 2.0 | forecast.seconds_per_map = 2.0 | forecast.points_per_map = 2.0 \
        | frame.origin = [50.0, 20.0, 100.0] | frame.utm = '33N' | frame.offset = [1.0, 2.0]; frame.utm = '33N' \
        | frame.gps = false | test_every = 4; backends = ['images']";
    let change = |part: &'static str| {
        (
            part.split(" =").next().unwrap().trim(),
            part.replace("; ", "\n"),
        )
    };
    let mut all: BTreeMap<_, _> = text.split(" | ").map(change).collect();
    all.insert(
        "surface.mesh_as_is",
        format!("{mesh}\nsurface.mesh_as_is = true"),
    );
    all.insert("surface.mesh", mesh);
    all
}

#[test]
fn no_setting_changes_a_stage_without_its_fingerprint() {
    let (folder, other) = (planned(&town()), tempfile::tempdir().unwrap());
    Project::create(other.path(), &town(), None).unwrap();
    let changes = changes(other.path());
    let is_tested = |key: &&str| !key.starts_with("dispatch.") && !NO_PART_OF_A_PLAN.contains(key);
    let keys: BTreeSet<&str> = config::keys()
        .iter()
        .map(|key| key.name.as_str())
        .filter(is_tested)
        .collect();
    assert_eq!(changes.keys().copied().collect::<BTreeSet<_>>(), keys);
    for (key, text) in changes {
        let (kept, anew) = (plan(folder.path(), &text), plan(other.path(), &text));
        assert_same(&kept, &anew, folder.path(), key);
    }
}

#[test]
fn another_model_is_another_plan() {
    let folder = planned(&town());
    let mut moved = town();
    moved.points[5].z += 0.5;
    let mut fewer = town();
    fewer.track_views.swap_remove(0);
    fewer.track_pixels.swap_remove(0);
    fewer
        .track_offsets
        .iter_mut()
        .skip(1)
        .for_each(|offset| *offset -= 1);
    let mut turned = town();
    turned.views[3].cam_from_world.translation.x += 0.1;
    let mut renamed = town();
    renamed.views.last_mut().unwrap().name = "zzz.jpg".into();
    for scene in [moved, fewer, turned, renamed] {
        fs::remove_dir_all(folder.path().join("sparse")).unwrap();
        Project::create(folder.path(), &scene, None).unwrap();
        assert_eq!(computed(&plan(folder.path(), "")), ALL);
    }
}

#[test]
fn another_mesh_is_another_surface() {
    let folder = planned(&town());
    let mesh = "surface.mesh = 'mesh.ply'"
        .replace("mesh.ply", folder.path().join("mesh.ply").to_str().unwrap());
    let surface = plan(folder.path(), "").stages.tables.surface;
    let triangles =
        |from: usize| ply::write(&surface.vertices, &surface.triangles[from..], &[], &[]);
    for from in [0, 5] {
        fs::write(folder.path().join("mesh.ply"), triangles(from)).unwrap();
        let plan = plan(folder.path(), &mesh);
        assert_eq!(
            computed(&plan),
            ["surface", "shown", "confidence", "clusters", "ranking"],
            "from {from}"
        );
        write(&plan, folder.path());
    }
}

#[test]
fn no_damaged_file_is_believed() {
    let folder = planned(&town());
    let expected = written(&plan(folder.path(), ""), folder.path());
    for stage in ALL {
        let path = folder.path().join(format!("viewrank/cache/{stage}.table"));
        let good = fs::read(&path).unwrap();
        let changed = |place: usize| {
            let mut bad = good.clone();
            bad[place] ^= 1;
            bad
        };
        let cut = good[..good.len() - 1].to_vec();
        for bad in [
            changed(3),
            changed(40),
            changed(good.len() / 2),
            changed(good.len() - 1),
            cut,
            Vec::new(),
        ] {
            fs::write(&path, bad).unwrap();
            let plan = plan(folder.path(), "");
            assert_eq!(computed(&plan), [stage]);
            assert!(written(&plan, folder.path()) == expected, "{stage}");
            write(&plan, folder.path());
            assert!(fs::read(&path).unwrap() == good, "{stage} is made again");
        }
    }
}

#[test]
fn a_cache_that_cannot_be_written_is_no_reason_to_fail() {
    let folder = planned(&town());
    let (cache, text) = (folder.path().join("viewrank/cache"), "cut.target = '50%'");
    let in_the_way: [&dyn Fn(); 2] = [
        &|| fs::create_dir(cache.join("ranking.table")).unwrap(),
        &|| fs::write(&cache, "mine").unwrap(),
    ];
    for (target, block) in ["50%", "60%"].into_iter().zip(in_the_way) {
        fs::remove_dir_all(&cache).unwrap();
        if target == "50%" {
            fs::create_dir(&cache).unwrap();
        }
        block();
        only_the_plan_is_written(folder.path(), &text.replace("50%", target), &Disk::REAL);
    }
    assert_eq!(fs::read_to_string(&cache).unwrap(), "mine");
}

#[test]
fn a_disk_that_is_full_has_room_for_a_plan_without_its_cache() {
    for (at, target) in [(3, "50%"), (40, "60%")] {
        let folder = planned(&town());
        fs::remove_dir_all(folder.path().join("viewrank/cache")).unwrap();
        let changes = AtomicUsize::new(0);
        let full_once = |_: Operation, _: &Path| {
            if changes.fetch_add(1, Ordering::Relaxed) == at {
                return Err(io::ErrorKind::StorageFull.into());
            }
            Ok(())
        };
        only_the_plan_is_written(
            folder.path(),
            &format!("cut.target = '{target}'"),
            &Disk::guarded(&full_once),
        );
        assert!(!folder.path().join("viewrank/cache").exists());
    }
}

fn only_the_plan_is_written(folder: &Path, text: &str, disk: &Disk) {
    let plan = plan(folder, text);
    let sets = files(&plan, &open(folder)).unwrap().sets;
    let reports = output::write_all(&sets, disk).unwrap();
    let failed = sets
        .iter()
        .zip(&reports)
        .filter(|(_, report)| report.failed.is_some());
    assert_eq!(
        failed.map(|(set, _)| &*set.name).collect::<Vec<_>>(),
        ALL,
        "{text}"
    );
    let manifest = fs::read(folder.join("viewrank/manifest.json")).unwrap();
    assert!(
        manifest == written(&plan, folder)["viewrank/manifest.json"],
        "{text}"
    );
}

/// Somebody else's project may hold files for the right inputs whose hashes are right.
#[test]
fn a_made_up_file_with_the_right_hash_is_computed_anew() {
    let folder = planned(&town());
    let expected = written(&plan(folder.path(), ""), folder.path());
    for stage in ALL {
        let path = folder.path().join(format!("viewrank/cache/{stage}.table"));
        let good = fs::read(&path).unwrap();
        let is_end = |&(_, byte): &(usize, &u8)| *byte == b'\n';
        let (end, _) = good.iter().enumerate().filter(is_end).nth(1).unwrap();
        let (head, contents) = good.split_at(end + 1);
        let start = head.iter().position(|byte| *byte == b'{').unwrap();
        let mut bad = contents.to_vec();
        bad.iter_mut().for_each(|byte| *byte = 0);
        let (magic, head) = head.split_at(start);
        let mut head: serde_json::Value = serde_json::from_slice(head).unwrap();
        let facts = head["facts"].to_string();
        head["hash"] = blake3::hash(&[facts.as_bytes(), &bad].concat())
            .to_string()
            .into();
        fs::write(
            &path,
            [magic, format!("{head}\n").as_bytes(), &bad].concat(),
        )
        .unwrap();
        let plan = plan(folder.path(), "");
        assert_eq!(computed(&plan), [stage]);
        assert!(written(&plan, folder.path()) == expected, "{stage}");
        fs::write(&path, good).unwrap();
    }
}
