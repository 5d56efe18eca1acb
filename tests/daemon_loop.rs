//! The daemon's loop on real folders: each project is planned once its input has settled, and only then. Most tests count plans
//! instead of making them.

use std::{
    collections::BTreeMap,
    fs,
    panic::{AssertUnwindSafe, catch_unwind, resume_unwind},
    path::{Path, PathBuf},
    sync::{
        Mutex,
        mpsc::{Sender, channel},
    },
    thread,
    time::{Duration, Instant},
};

use viewrank::internals::{
    camera::{Camera, CameraModel},
    daemon::{
        DaemonError, Job, Options, PlanJob, PlanOptions, Planner, Signal,
        phase::Phase,
        read_status,
        run::Summary,
        settle::HashCache,
        state::{OnBusy, Outcome},
        watch_roots,
    },
    formats::{colmap::ColmapModel, colmap_bin},
    output::{Disk, OutputError},
    scene::Scene,
    synthetic::Town,
};

/// Planner that records the fingerprint of each plan by project; a plan takes `length`.
#[derive(Default)]
struct Counter {
    length: Duration,
    plans: Mutex<BTreeMap<PathBuf, Vec<String>>>,
    cancelled: Mutex<usize>,
    /// Number of scans of projects.
    scans: Mutex<usize>,
    hashes: Mutex<HashCache>,
}

impl Counter {
    fn plans_of(&self, project: &Path) -> usize {
        self.plans.lock().expect("no panic").get(project).map_or(0, Vec::len)
    }
}

impl Planner for Counter {
    fn named_files(&self, _: &Path) -> Vec<PathBuf> {
        *self.scans.lock().expect("no panic") += 1;
        Vec::new()
    }

    fn follow(&self, _: &Job) -> Outcome {
        Outcome::Abandoned
    }

    fn plan(&self, job: &Job) -> Outcome {
        let model = ["cameras.bin", "images.bin", "points3D.bin"].map(|name| job.project.join("sparse/0").join(name));
        let fingerprint = match HashCache::fingerprint(&self.hashes, job.project, &model, job.stamp, b"") {
            Ok(fingerprint) => fingerprint,
            Err(_) => return Outcome::Abandoned,
        };
        let text = serde_json::to_string(&fingerprint).expect("a string");
        let done = Outcome::Planned { fingerprint, clusters: 1, share: 1.0, note: None, anew: true, known: None };
        if self.plans.lock().expect("no panic").get(job.project).and_then(|p| p.last()) == Some(&text) {
            return done;
        }
        let until = Instant::now() + self.length;
        while Instant::now() < until {
            if job.is_cancelled() {
                *self.cancelled.lock().expect("no panic") += 1;
                return Outcome::Abandoned;
            }
            thread::sleep(Duration::from_millis(5));
        }
        if !job.is_wanted() {
            return Outcome::Abandoned;
        }
        if fs::read(job.project.join("sparse/0/images.bin")).is_ok_and(|bytes| bytes.starts_with(b"broken")) {
            return Outcome::Failed { reason: "broken".into(), hint: None };
        }
        self.plans.lock().expect("no panic").entry(job.project.into()).or_default().push(text);
        done
    }
}

fn options(root: &Path) -> Options {
    Options {
        roots: vec![root.into()],
        settle: Duration::from_millis(200),
        poll: None,
        rescan: Duration::from_secs(3600),
        on_busy: OnBusy::Restart,
        jobs: 2,
        max_memory: 1 << 30,
        follow_links: false,
        once: false,
        metrics: None,
    }
}

/// Runs the daemon while `script` acts, then stops it.
fn with_daemon(options: &Options, planner: &dyn Planner, script: impl FnOnce()) -> Summary {
    thread::scope(|threads| {
        let (sender, receiver) = channel::<Box<dyn Fn(Signal) + Send>>();
        let daemon =
            threads.spawn(move || watch_roots(options, planner, &Disk::REAL, |signal| pass_on(&sender, signal)));
        let signal = receiver.recv().expect("the daemon starts");
        let done = catch_unwind(AssertUnwindSafe(script));
        signal(Signal::Stop);
        if let Err(failure) = done {
            resume_unwind(failure);
        }
        daemon.join().expect("no panic").expect("the root can be watched")
    })
}

fn pass_on(sender: &Sender<Box<dyn Fn(Signal) + Send>>, signal: Box<dyn Fn(Signal) + Send>) {
    sender.send(signal).expect("the test waits");
}

fn eventually(what: &str, condition: impl Fn() -> bool) {
    let end = Instant::now() + Duration::from_secs(30);
    while !condition() {
        assert!(Instant::now() < end, "timed out waiting for: {what}");
        thread::sleep(Duration::from_millis(10));
    }
}

/// Adds a project and waits until it is planned. Events come in order and all projects have the same settling time, so everything that happened
/// before has had its effect then.
fn wait_until_idle(root: &Path, planner: &Counter) {
    write_model(&root.join("last"), "last");
    eventually("the last project", || planner.plans_of(&root.join("last")) == 1);
}

fn write_model(project: &Path, content: &str) {
    let folder = project.join("sparse/0");
    fs::create_dir_all(&folder).expect("a folder");
    for name in ["cameras.bin", "images.bin", "points3D.bin"] {
        fs::write(folder.join(name), content).expect("a file");
    }
}

fn root() -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().canonicalize().expect("a path");
    (folder, path)
}

#[test]
fn existing_and_later_projects_are_planned_once_each() {
    let (_guard, root) = root();
    write_model(&root.join("early"), "a");
    let planner = Counter::default();
    let summary = with_daemon(&options(&root), &planner, || {
        eventually("the early project", || planner.plans_of(&root.join("early")) == 1);
        write_model(&root.join("deep/er/late one"), "b");
        eventually("the late project", || planner.plans_of(&root.join("deep/er/late one")) == 1);
        fs::rename(root.join("early"), root.join("moved")).expect("a move");
        eventually("the moved project", || planner.plans_of(&root.join("moved")) == 1);
        wait_until_idle(&root, &planner);
    });
    assert_eq!(summary, Summary { projects: 3, planned: 3, failed: 0, waiting: 0 }, "with the last one");
    assert!(planner.plans.lock().expect("no panic").values().all(|plans| plans.len() == 1));
}

#[test]
fn a_folder_becomes_a_project_when_its_model_comes_last() {
    let (_guard, above) = root();
    // A folder of this name below a root holds outputs; above, it is a name like any other.
    let root = above.join("viewrank/roots");
    fs::create_dir_all(root.join("p/images")).expect("a folder");
    fs::create_dir_all(root.join("q/dense/images")).expect("a folder");
    let planner = Counter::default();
    let summary = with_daemon(&options(&root), &planner, || {
        eventually("the first scan", || read_status(&root).is_some());
        write_model(&root.join("p"), "a");
        eventually("the plan", || planner.plans_of(&root.join("p")) == 1);
        write_model(&root.join("q/dense"), "b");
        eventually("the plan of the inner one", || planner.plans_of(&root.join("q/dense")) == 1);
        write_model(&root.join("q"), "c");
        eventually("the plan of the outer one", || planner.plans_of(&root.join("q")) == 1);
    });
    assert_eq!(summary, Summary { projects: 2, planned: 2, failed: 0, waiting: 0 }, "q/dense belongs to q");
}

#[test]
fn a_slow_writer_delays_the_plan() {
    let (_guard, root) = root();
    let planner = Counter::default();
    // Longer than the pauses of the writer even on a busy machine.
    let options = Options { settle: Duration::from_secs(3), ..options(&root) };
    with_daemon(&options, &planner, || {
        for length in 1..12 {
            write_model(&root.join("slow"), &"x".repeat(length));
            assert_eq!(planner.plans_of(&root.join("slow")), 0);
            thread::sleep(Duration::from_millis(100));
        }
        eventually("the plan", || planner.plans_of(&root.join("slow")) == 1);
    });
}

#[test]
fn touching_a_project_or_writing_outputs_plans_nothing() {
    let (_guard, root) = root();
    write_model(&root.join("p"), "a");
    let planner = Counter::default();
    with_daemon(&options(&root), &planner, || {
        eventually("the plan", || planner.plans_of(&root.join("p")) == 1);
        write_model(&root.join("p"), "a");
        fs::create_dir_all(root.join("p/viewrank")).expect("a folder");
        fs::write(root.join("p/viewrank/manifest.json"), "{}").expect("a file");
        wait_until_idle(&root, &planner);
    });
    assert_eq!(planner.plans_of(&root.join("p")), 1);
}

#[test]
fn a_change_while_planning_restarts_the_plan() {
    let (_guard, root) = root();
    write_model(&root.join("p"), "a");
    let planner = Counter { length: Duration::from_millis(600), ..Counter::default() };
    with_daemon(&options(&root), &planner, || {
        let planning = || {
            let status = read_status(&root)?.status;
            status.projects.first().map(|p| matches!(p.phase, Phase::Planning { .. }))
        };
        eventually("the start", || planning() == Some(true));
        write_model(&root.join("p"), "b");
        eventually("the plan", || planner.plans_of(&root.join("p")) == 1);
    });
    assert_eq!(*planner.cancelled.lock().expect("no panic"), 1);
    assert_eq!(planner.plans_of(&root.join("p")), 1);
}

#[test]
fn a_folder_deleted_and_made_again_is_watched_again() {
    let (_guard, root) = root();
    write_model(&root.join("p"), "a");
    fs::create_dir(root.join("group")).expect("a folder");
    let planner = Counter::default();
    with_daemon(&options(&root), &planner, || {
        eventually("the plan", || planner.plans_of(&root.join("p")) == 1);
        // Two changes each: the first may be found by the scan for the new folder itself.
        for (gone, content) in [("p", "b"), ("p/sparse", "d"), ("p/sparse/0", "f")] {
            let plans = planner.plans_of(&root.join("p"));
            fs::remove_dir_all(root.join(gone)).expect("removed");
            fs::create_dir_all(root.join("p/sparse/0")).expect("a folder");
            write_model(&root.join("p"), content);
            eventually("the plan", || planner.plans_of(&root.join("p")) == plans + 1);
            write_model(&root.join("p"), &format!("{content} again"));
            eventually("the next plan", || planner.plans_of(&root.join("p")) == plans + 2);
        }
        fs::remove_dir(root.join("group")).expect("removed");
        fs::create_dir(root.join("group")).expect("a folder");
        for name in ["one", "two"] {
            write_model(&root.join("group").join(name), "a");
            eventually("the plan in the group", || planner.plans_of(&root.join("group").join(name)) == 1);
        }
    });
}

#[test]
fn the_job_of_a_replaced_folder_is_ignored() {
    let (_guard, root) = root();
    write_model(&root.join("p"), "a");
    let planner = Counter { length: Duration::from_millis(500), ..Counter::default() };
    let summary = with_daemon(&options(&root), &planner, || {
        let state = |wanted: fn(&Phase) -> bool| {
            let status = read_status(&root).map(|line| line.status);
            status.is_some_and(|status| status.projects.iter().any(|p| wanted(&p.phase)))
        };
        eventually("the start", || state(|phase| matches!(phase, Phase::Planning { .. })));
        fs::rename(root.join("p"), root.join(".away")).expect("moved");
        eventually("the project to go", || !state(|_| true));
        write_model(&root.join("p"), "b");
        eventually("the plan", || planner.plans_of(&root.join("p")) == 1);
        eventually("its status", || state(|phase| matches!(phase, Phase::Planned { .. })));
    });
    assert_eq!(summary, Summary { projects: 1, planned: 1, failed: 0, waiting: 0 });
}

#[test]
fn files_that_viewrank_writes_where_depth_maps_may_be_trigger_no_scan() {
    let (_guard, root) = root();
    write_model(&root.join("p"), "a");
    let exported = root.join("p/viewrank/openmvs");
    fs::create_dir_all(&exported).expect("a folder");
    let planner = Counter::default();
    let scans = || *planner.scans.lock().expect("no panic");
    with_daemon(&options(&root), &planner, || {
        eventually("the plan", || planner.plans_of(&root.join("p")) == 1);
        thread::sleep(Duration::from_millis(500));
        let before = scans();
        fs::write(exported.join("scene.mvs"), "").expect("a file");
        thread::sleep(Duration::from_millis(500));
        assert_eq!(scans(), before);
        fs::write(exported.join("depth0001.dmap"), "").expect("a file");
        eventually("the scan of the map", || scans() > before);
    });
}

#[test]
fn polling_finds_the_same_changes_as_events() {
    let (_guard, root) = root();
    let planner = Counter::default();
    let options = Options { poll: Some(Duration::from_millis(100)), ..options(&root) };
    with_daemon(&options, &planner, || {
        write_model(&root.join("p"), "a");
        eventually("the plan", || planner.plans_of(&root.join("p")) == 1);
        write_model(&root.join("p"), "b");
        eventually("the second plan", || planner.plans_of(&root.join("p")) == 2);
    });
}

#[test]
fn once_ends_when_nothing_is_left_and_a_failure_affects_no_other_project() {
    let (_guard, root) = root();
    write_model(&root.join("good"), "a");
    write_model(&root.join("bad"), "broken");
    let planner = Counter::default();
    let options = Options { once: true, ..options(&root) };
    let summary = watch_roots(&options, &planner, &Disk::REAL, |_| {}).expect("the root can be watched");
    assert_eq!(summary, Summary { projects: 2, planned: 1, failed: 1, waiting: 0 });
    let line = read_status(&root).expect("a status");
    assert!(!line.running);
    let phases: Vec<_> = line.status.projects.iter().map(|p| (p.project.as_str(), p.phase.to_string())).collect();
    assert_eq!(phases[0], ("bad", "failed: broken (retry 10 s after the failure)".into()));
    assert_eq!(phases[1], ("good", "planned: 1 key views for 100 %".into()));
}

#[test]
fn projects_move_with_the_folder_that_contains_them() {
    let (_guard, root) = root();
    write_model(&root.join("group/p"), "a");
    let planner = Counter::default();
    with_daemon(&options(&root), &planner, || {
        eventually("the plan", || planner.plans_of(&root.join("group/p")) == 1);
        fs::rename(root.join("group"), root.join("moved")).expect("moved");
        eventually("the plan at its new place", || planner.plans_of(&root.join("moved/p")) == 1);
        let names = || read_status(&root).expect("a status").status.projects.into_iter().map(|p| p.project);
        eventually("the old place to be forgotten", || names().eq(["moved/p"]));
    });
}

#[test]
fn a_new_link_is_not_followed() {
    let (_outside, elsewhere) = root();
    write_model(&elsewhere.join("q"), "a");
    let (_guard, root) = root();
    let planner = Counter::default();
    with_daemon(&options(&root), &planner, || {
        write_model(&root.join("first"), "a");
        eventually("the first plan", || planner.plans_of(&root.join("first")) == 1);
        std::os::unix::fs::symlink(elsewhere.join("q"), root.join("link")).expect("a link");
        write_model(&root.join("second"), "a");
        eventually("the second plan", || planner.plans_of(&root.join("second")) == 1);
    });
    assert_eq!((planner.plans_of(&root.join("link")), planner.plans_of(&elsewhere.join("q"))), (0, 0));
}

#[test]
fn a_second_daemon_names_the_holder_of_the_root() {
    let (_guard, root) = root();
    let planner = Counter::default();
    with_daemon(&options(&root), &planner, || {
        eventually("the first daemon", || read_status(&root).is_some_and(|line| line.running));
        let second = watch_roots(&options(&root), &planner, &Disk::REAL, |_| {});
        match second {
            Err(DaemonError::Held { holder, .. }) => assert!(holder.contains(&std::process::id().to_string())),
            other => panic!("expected to be refused, got {other:?}"),
        }
    });
}

fn make_pipe(path: &Path) {
    assert!(std::process::Command::new("mkfifo").arg(path).status().expect("mkfifo").success());
}

fn watch_once(root: &Path) -> Result<Summary, DaemonError> {
    let options = Options { once: true, ..options(root) };
    watch_roots(&options, &Counter::default(), &Disk::REAL, |_| {})
}

#[test]
fn a_file_in_place_of_the_lock_is_refused_and_left_unchanged() {
    let (_elsewhere, outside) = root();
    let precious = outside.join("precious.txt");
    fs::write(&precious, "precious").expect("a file");
    type Plant<'a> = &'a dyn Fn(&Path);
    let plant: [(&str, Plant); 4] = [
        ("link", &|lock| std::os::unix::fs::symlink(&precious, lock).expect("a link")),
        ("second name", &|lock| fs::hard_link(&precious, lock).expect("a second name")),
        ("file", &|lock| fs::write(lock, "precious").expect("a file")),
        ("pipe", &make_pipe),
    ];
    for (kind, plant) in plant {
        let root = outside.join(kind);
        fs::create_dir_all(root.join("viewrank")).expect("a folder");
        plant(&root.join("viewrank/watch.lock"));
        let refused = watch_once(&root);
        assert!(matches!(refused, Err(DaemonError::Output(OutputError::Foreign { .. }))), "{kind}: {refused:?}");
        assert_eq!(fs::read(&precious).expect("a file"), b"precious", "{kind}");
        assert!(kind != "file" || fs::read(root.join("viewrank/watch.lock")).expect("a file") == b"precious");
    }
}

#[test]
fn neither_status_nor_lock_is_written_outside_the_root() {
    let (_elsewhere, outside) = root();
    let (_guard, root) = root();
    std::os::unix::fs::symlink(&outside, root.join("viewrank")).expect("a link");
    assert!(matches!(watch_once(&root), Err(DaemonError::Output(OutputError::Escapes { .. }))));
    assert!(fs::read_dir(&outside).expect("a folder").next().is_none());

    fs::remove_file(root.join("viewrank")).expect("a link");
    fs::create_dir(root.join("outputs")).expect("a folder");
    std::os::unix::fs::symlink("outputs", root.join("viewrank")).expect("a link");
    watch_once(&root).expect("the root can be watched");
    assert!(read_status(&root).is_some() && root.join("outputs/status.json").is_file());
    watch_once(&root).expect("a lock of an earlier run may be taken");
}

fn town() -> Scene {
    let camera = Camera::new(1, CameraModel::Pinhole, 400, 300, vec![320.0, 320.0, 200.0, 150.0]).expect("a camera");
    Town { grid: 3, points: 400, tilt: None, side: 40.0, boxes: 1, ..Town::new(camera) }.scene()
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
        let real = Self { _guard: guard, root, project };
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
        });
        let options = Options { once: true, ..options(&self.root) };
        watch_roots(&options, &planner, &Disk::REAL, |_| {}).expect("the root can be watched");
        read_status(&self.root).expect("a status").status.projects.remove(0).phase
    }

    fn manifest(&self) -> serde_json::Value {
        serde_json::from_slice(&fs::read(self.project.join("viewrank/manifest.json")).expect("a plan")).expect("JSON")
    }

    fn finished(&self) -> usize {
        let manifest = self.manifest();
        manifest["clusters"].as_array().expect("a list").iter().filter(|c| c["finished"] == true).count()
    }

    /// Writes a depth map of the first key view.
    fn put_map(&self, folder: &str) {
        let key = self.manifest()["clusters"][0]["key"].as_str().expect("a name").to_owned();
        let header = b"\x93NUMPY\x01\x00\x76\x00{'descr': '<f4', 'fortran_order': False, 'shape': (30, 40), }";
        let mut bytes = header.to_vec();
        bytes.resize(127, b' ');
        bytes.push(b'\n');
        bytes.extend((0..30 * 40).flat_map(|_| 40.0f32.to_le_bytes()));
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
        Phase::Failed { reason, .. } => assert!(reason.contains("two depth maps of view"), "{reason}"),
        phase => panic!("{phase}"),
    }
    assert_eq!(fs::read(real.project.join("viewrank/planned_views.json")).expect("a file"), views);
    fs::remove_dir_all(real.project.join("sgm/b")).expect("a folder");
    real.once(false);
    assert_eq!(real.manifest()["outdated"].as_array().map(Vec::len), Some(1));
}

/// Covers each state that a daemon may leave when killed while it forgets missing depth maps.
#[test]
fn missing_maps_are_forgotten_even_if_a_run_was_killed_meanwhile() {
    let steps: [&[&str]; 3] = [&[], &["planned_from.json"], &["progress.json"]];
    for removed in steps {
        let real = Real::new(&town());
        real.once(true);
        real.put_map("sgm");
        assert!(matches!(real.once(true), Phase::Computing { .. } | Phase::Reached { .. }));
        assert_eq!(real.finished(), 1);
        fs::remove_dir_all(real.project.join("sgm")).expect("a folder");
        removed.iter().for_each(|name| fs::remove_file(real.project.join("viewrank").join(name)).expect("a file"));
        assert!(matches!(real.once(true), Phase::Planned { .. }), "{removed:?}");
        assert_eq!((real.finished(), real.project.join("viewrank/progress.json").exists()), (0, false), "{removed:?}");
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
    let text = fs::read_dir(real.project.join("sgm")).expect("maps").next().expect("a map").expect("a map").path();
    let second = planned["clusters"][1]["key"].as_str().expect("a name");
    fs::rename(text, real.project.join("sgm").join(format!("{second}.npy"))).expect("moved");
    real.once(false);
    let progress = fs::read(real.project.join("viewrank/progress.json")).expect("a file");
    let progress: serde_json::Value = serde_json::from_slice(&progress).expect("JSON");
    assert_eq!((&progress["done"], &progress["clusters"]), (&1.into(), &2.into()));
    assert_eq!(progress["finished"], serde_json::json!([second]));
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
    for name in ["cameras.bin", "images.bin", "points3D.bin"] {
        fs::copy(real.project.join("sparse/0").join(name), dense.join("sparse").join(name)).expect("a file");
    }
    let files = [dense.join("stereo/patch-match.cfg"), real.project.join("viewrank/clusters.txt")];
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
    for (kind, words) in [("pipe", "not a regular file"), ("link", "is a symbolic link")] {
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
    std::os::unix::fs::symlink(elsewhere.project.join("sparse/0/images.bin"), &file).expect("a link");
    match real.once(false) {
        Phase::Waiting { reason } => assert!(reason.contains("images.bin is behind a symbolic link"), "{reason}"),
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
    });
    let options = Options { once: true, follow_links: true, ..options(&real.root) };
    let summary = watch_roots(&options, &planner, &Disk::REAL, |_| {}).expect("the root can be watched");
    assert_eq!(summary.planned, 1);
}
