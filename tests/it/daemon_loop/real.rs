//! Real plans of a small town: what the daemon does with depth maps, outputs and settings.

use std::{fs, path::PathBuf};

use viewrank::daemon::{
    PlanJob, PlanOptions, WatchOptions, phase::Phase, read_status, watch_roots,
};
use viewrank_core::{
    method::synthetic::Town,
    model::{
        camera::{Camera, CameraModel},
        scene::Scene,
    },
};
use viewrank_io::{
    formats::{colmap::ColmapModel, colmap_bin},
    output::Disk,
};

use super::{eventually, make_pipe, options, root, with_daemon};
use crate::one_door::viewrank;

fn town() -> Scene {
    let camera = Camera::new(
        1,
        CameraModel::Pinhole,
        400,
        300,
        vec![320.0, 320.0, 200.0, 150.0],
    )
    .expect("a camera");
    Town {
        grid: 3,
        points: 400,
        tilt: None,
        side: 40.0,
        boxes: 1,
        ..Town::new(camera)
    }
    .scene()
}

/// A real model as the only project of a root.
struct Real {
    _guard: tempfile::TempDir,
    root: PathBuf,
    project: PathBuf,
}

impl Real {
    fn new(scene: &Scene) -> Self {
        let (guard, root) = root();
        let project = root.join("p");
        let real = Self {
            _guard: guard,
            root,
            project,
        };
        real.write_model(scene);
        real
    }

    fn write_model(&self, scene: &Scene) {
        let folder = self.project.join("sparse/0");
        fs::create_dir_all(&folder).expect("a folder");
        for (name, bytes) in colmap_bin::write(&ColmapModel::from_scene(scene)) {
            fs::write(folder.join(name), bytes).expect("a file");
        }
    }

    /// Runs a daemon once and returns the phase of the project.
    fn once(&self, replan: bool) -> Phase {
        let planner = PlanJob::new(PlanOptions {
            on_target: Some("true".into()),
            replan,
            cache: 0,
            follow_links: false,
            roots: Vec::new(),
            typed: Default::default(),
            is_run: false,
        });
        let options = WatchOptions {
            once: true,
            ..options(&self.root)
        };
        watch_roots(&options, &planner, &Disk::REAL, |_| {}).expect("the root can be watched");
        read_status(&self.root)
            .expect("a status")
            .status
            .projects
            .remove(0)
            .phase
    }

    fn manifest(&self) -> serde_json::Value {
        serde_json::from_slice(
            &fs::read(self.project.join("viewrank/manifest.json")).expect("a plan"),
        )
        .expect("JSON")
    }

    fn finished(&self) -> usize {
        let manifest = self.manifest();
        manifest["clusters"]
            .as_array()
            .expect("a list")
            .iter()
            .filter(|c| c["finished"] == true)
            .count()
    }

    /// Writes a depth map of the first key view.
    fn put_map(&self, folder: &str) {
        let key = self.manifest()["clusters"][0]["key"]
            .as_str()
            .expect("a name")
            .to_owned();
        let header = b"\x93NUMPY\x01\x00\x76\x00{'descr': '<f4', 'fortran_order': False, 'shape': (150, 200), }";
        let mut bytes = header.to_vec();
        bytes.resize(127, b' ');
        bytes.push(b'\n');
        bytes.extend((0..150 * 200).flat_map(|_| 40.0f32.to_le_bytes()));
        fs::create_dir_all(self.project.join(folder)).expect("a folder");
        fs::write(self.project.join(folder).join(format!("{key}.npy")), bytes).expect("a file");
    }
}

#[test]
fn two_maps_of_one_view_fail_the_plan_and_the_earlier_plan_stays() {
    let mut scene = town();
    let real = Real::new(&scene);
    assert!(matches!(real.once(false), Phase::Planned { .. }));
    real.put_map("sgm/a");
    real.put_map("sgm/b");
    let views = fs::read(real.project.join("viewrank/planned_views.json")).expect("a file");
    for (i, view) in scene.views.iter_mut().enumerate() {
        view.cam_from_world.translation.x += (i % 2) as f64;
    }
    real.write_model(&scene);
    match real.once(false) {
        Phase::Failed { reason, .. } => {
            assert!(reason.contains("two depth maps of view"), "{reason}")
        }
        phase => panic!("{phase}"),
    }
    assert_eq!(
        fs::read(real.project.join("viewrank/planned_views.json")).expect("a file"),
        views
    );
    fs::remove_dir_all(real.project.join("sgm/b")).expect("a folder");
    real.once(false);
    assert_eq!(
        real.manifest()["outdated"].as_array().map(Vec::len),
        Some(1)
    );
}

/// Covers each state that a daemon may leave when killed while it forgets missing depth maps.
#[test]
fn missing_maps_are_forgotten_even_if_a_run_was_killed_meanwhile() {
    let steps: [&[&str]; 3] = [&[], &["planned_from.json"], &["progress.json"]];
    for removed in steps {
        let real = Real::new(&town());
        real.once(true);
        real.put_map("sgm");
        assert!(matches!(
            real.once(true),
            Phase::Partial { .. } | Phase::Reached { .. }
        ));
        assert_eq!(real.finished(), 1);
        fs::remove_dir_all(real.project.join("sgm")).expect("a folder");
        removed.iter().for_each(|name| {
            fs::remove_file(real.project.join("viewrank").join(name)).expect("a file")
        });
        assert!(
            matches!(real.once(true), Phase::Planned { .. }),
            "{removed:?}"
        );
        assert_eq!(
            (
                real.finished(),
                real.project.join("viewrank/progress.json").exists()
            ),
            (0, false),
            "{removed:?}"
        );
    }
}

#[test]
fn maps_beyond_the_cut_are_counted_in_addition() {
    let real = Real::new(&town());
    fs::write(real.project.join("viewrank.toml"), "[cut]\nbudget = 1\n").expect("a file");
    real.once(false);
    let planned = real.manifest();
    assert_eq!(planned["cut"]["clusters"], 1);
    real.put_map("sgm");
    let text = fs::read_dir(real.project.join("sgm"))
        .expect("maps")
        .next()
        .expect("a map")
        .expect("a map")
        .path();
    let second = planned["clusters"][1]["key"].as_str().expect("a name");
    fs::rename(text, real.project.join("sgm").join(format!("{second}.npy"))).expect("moved");
    real.once(false);
    let progress = fs::read(real.project.join("viewrank/progress.json")).expect("a file");
    let progress: serde_json::Value = serde_json::from_slice(&progress).expect("JSON");
    assert_eq!(
        (&progress["done"], &progress["clusters"]),
        (&1.into(), &2.into())
    );
    assert_eq!(progress["finished"], serde_json::json!([second]));
}

#[test]
fn maps_of_another_program_than_the_plans_do_not_count() {
    let real = Real::new(&town());
    real.once(false);
    real.put_map("sgm");
    fs::write(
        real.project.join("viewrank.toml"),
        "backends = ['openmvs']\n",
    )
    .expect("a file");
    // Also in the plan that takes the place of the other program's.
    for _ in 0..2 {
        let phase = real.once(true);
        assert!(matches!(phase, Phase::Planned { .. }), "{phase}");
        assert_eq!(real.finished(), 0);
    }
}

/// Uses a link to itself, which even root can't read.
#[test]
fn unreadable_maps_are_not_taken_for_gone() {
    let mut scene = town();
    let real = Real::new(&scene);
    real.once(false);
    real.put_map("sgm");
    for (i, view) in scene.views.iter_mut().enumerate() {
        view.cam_from_world.translation.x += (i % 2) as f64;
    }
    real.write_model(&scene);
    real.once(false);
    let outdated = || real.manifest()["outdated"].as_array().map(Vec::len);
    assert_eq!(outdated(), Some(1));
    let (maps, aside) = (real.project.join("sgm"), real.root.join("aside"));
    fs::rename(&maps, &aside).expect("moved");
    std::os::unix::fs::symlink(&maps, &maps).expect("a link");
    match real.once(false) {
        Phase::Failed { reason, .. } => assert!(reason.contains("cannot read folder"), "{reason}"),
        phase => panic!("{phase}"),
    }
    assert_eq!(outdated(), Some(1), "the outdated map is remembered");
    fs::remove_file(&maps).expect("a link");
    fs::rename(&aside, &maps).expect("moved");
    real.once(false);
    assert_eq!(outdated(), Some(1));
}

#[test]
fn a_later_dense_workspace_gets_its_files_and_removed_files_are_written_again() {
    let real = Real::new(&town());
    real.once(false);
    let dense = real.project.join("dense");
    fs::create_dir_all(dense.join("stereo")).expect("a folder");
    fs::create_dir_all(dense.join("sparse")).expect("a folder");
    fs::create_dir_all(dense.join("images")).expect("a folder");
    fs::write(dense.join("images/a.jpg"), "").expect("a file");
    for name in ["cameras.bin", "images.bin", "points3D.bin"] {
        fs::copy(
            real.project.join("sparse/0").join(name),
            dense.join("sparse").join(name),
        )
        .expect("a file");
    }
    let files = [
        dense.join("stereo/patch-match.cfg"),
        real.project.join("viewrank/clusters.txt"),
    ];
    for file in files {
        real.once(false);
        let written = fs::read(&file).expect("a file of the plan");
        fs::remove_file(&file).expect("a file");
        real.once(false);
        assert_eq!(fs::read(&file).expect("the file again"), written);
    }
}

#[test]
fn a_removed_output_is_noticed_at_once() {
    let real = Real::new(&town());
    let planner = PlanJob::new(PlanOptions {
        on_target: None,
        replan: false,
        cache: 0,
        follow_links: false,
        roots: Vec::new(),
        typed: Default::default(),
        is_run: false,
    });
    let file = real.project.join("viewrank/clusters.txt");
    with_daemon(&options(&real.root), &planner, || {
        let is_planned = || {
            let status = read_status(&real.root);
            status.is_some_and(
                |line| matches!(line.status.projects.first(), Some(p) if matches!(p.phase, Phase::Planned { .. })),
            )
        };
        eventually("the plan", is_planned);
        fs::remove_file(&file).expect("a file of the plan");
        eventually("the file again", || file.exists());
    });
}

/// Reading a pipe would block, and reading a device would never end.
#[test]
fn settings_that_are_not_a_regular_file_fail_only_their_project() {
    for (kind, words) in [
        ("pipe", "not a regular file"),
        ("link", "is a symbolic link"),
    ] {
        let real = Real::new(&town());
        let settings = real.project.join("viewrank.toml");
        match kind {
            "pipe" => make_pipe(&settings),
            _ => std::os::unix::fs::symlink("/dev/zero", &settings).expect("a link"),
        }
        match real.once(false) {
            Phase::Failed { reason, .. } => assert!(reason.contains(words), "{reason}"),
            phase => panic!("{kind}: {phase}"),
        }
    }
}

#[test]
fn a_model_behind_a_link_is_planned_only_with_follow_links() {
    let elsewhere = Real::new(&town());
    let real = Real::new(&town());
    let file = real.project.join("sparse/0/images.bin");
    fs::remove_file(&file).expect("a file");
    std::os::unix::fs::symlink(elsewhere.project.join("sparse/0/images.bin"), &file)
        .expect("a link");
    match real.once(false) {
        Phase::Waiting { reason } => assert!(
            reason.contains("images.bin is behind a symbolic link"),
            "{reason}"
        ),
        phase => panic!("{phase}"),
    }
    assert!(!real.project.join("viewrank/manifest.json").exists());
    let planner = PlanJob::new(PlanOptions {
        on_target: None,
        replan: false,
        cache: 0,
        follow_links: false,
        roots: Vec::new(),
        typed: Default::default(),
        is_run: false,
    });
    let options = WatchOptions {
        once: true,
        follow_links: true,
        ..options(&real.root)
    };
    let summary =
        watch_roots(&options, &planner, &Disk::REAL, |_| {}).expect("the root can be watched");
    assert_eq!(summary.planned, 1);
}

#[test]
fn a_plan_by_hand_that_is_replaced_is_named_with_its_region() {
    let real = Real::new(&town());
    let project = real.project.to_str().expect("a path");
    let options = ["--region", "auto", "--budget", "1", "--quiet"];
    let by_hand = viewrank(&[&["plan", project][..], &options].concat());
    assert!(by_hand.status.success(), "{by_hand:?}");
    let phase = real.once(false).to_string();
    assert!(
        phase.contains("a plan made by hand") && phase.contains("--region auto"),
        "{phase}"
    );
}

#[test]
fn shares_of_a_project_with_a_region_are_inside_it() {
    let real = Real::new(&town());
    fs::write(real.project.join("viewrank.toml"), "region = 'auto'\n").expect("a file");
    for has_map in [false, true] {
        if has_map {
            real.put_map("sgm");
        }
        let phase = real.once(false).to_string();
        assert!(phase.contains("inside the region"), "{phase}");
    }
    // As `viewrank status` has it once nothing is planned or measured anew.
    let phase = real.once(false).to_string();
    assert!(phase.contains("inside the region"), "{phase}");
}
