//! The daemon's loop on real folders, with a planner that only counts: each project is planned once its input is still, and only then.

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

use viewrank::{
    daemon::{
        DaemonError, Job, Options, Planner, Signal, Summary, read_status,
        settle::HashCache,
        state::{OnBusy, Outcome, Phase},
        watch_roots,
    },
    output::Disk,
};

/// Counts how often each content of each project was planned; a plan takes `length`.
#[derive(Default)]
struct Counter {
    length: Duration,
    plans: Mutex<BTreeMap<PathBuf, Vec<String>>>,
    cancelled: Mutex<usize>,
    hashes: Mutex<HashCache>,
}

impl Counter {
    fn plans_of(&self, project: &Path) -> usize {
        self.plans.lock().expect("no panic").get(project).map_or(0, Vec::len)
    }
}

impl Planner for Counter {
    fn follow(&self, _: &Job) -> Outcome {
        Outcome::Abandoned
    }

    fn plan(&self, job: &Job) -> Outcome {
        let model = ["cameras.bin", "images.bin", "points3D.bin"].map(|name| job.project.join("sparse/0").join(name));
        let fingerprint = match self.hashes.lock().expect("no panic").fingerprint(job.project, &model, job.stamp, b"") {
            Ok(fingerprint) => fingerprint,
            Err(_) => return Outcome::Abandoned,
        };
        let text = serde_json::to_string(&fingerprint).expect("a string");
        let done = Outcome::Planned { fingerprint, clusters: 1, share: 1.0, note: None };
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
fn with_daemon(options: &Options, planner: &Counter, script: impl FnOnce()) -> Summary {
    thread::scope(|threads| {
        let (sender, receiver) = channel::<Box<dyn Fn(Signal) + Send>>();
        let daemon = threads.spawn(move || watch_roots(options, planner, &Disk::REAL, |signal| hand(&sender, signal)));
        let signal = receiver.recv().expect("the daemon starts");
        let done = catch_unwind(AssertUnwindSafe(script));
        signal(Signal::Stop);
        if let Err(failure) = done {
            resume_unwind(failure);
        }
        daemon.join().expect("no panic").expect("the root can be watched")
    })
}

fn hand(sender: &Sender<Box<dyn Fn(Signal) + Send>>, signal: Box<dyn Fn(Signal) + Send>) {
    sender.send(signal).expect("the test waits");
}

fn eventually(what: &str, condition: impl Fn() -> bool) {
    let end = Instant::now() + Duration::from_secs(30);
    while !condition() {
        assert!(Instant::now() < end, "waited in vain for: {what}");
        thread::sleep(Duration::from_millis(10));
    }
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
fn projects_there_at_the_start_and_later_ones_are_planned_once_each() {
    let (_guard, root) = root();
    write_model(&root.join("early"), "a");
    let planner = Counter::default();
    let summary = with_daemon(&options(&root), &planner, || {
        eventually("the early project", || planner.plans_of(&root.join("early")) == 1);
        write_model(&root.join("deep/er/late one"), "b");
        eventually("the late project", || planner.plans_of(&root.join("deep/er/late one")) == 1);
        fs::rename(root.join("early"), root.join("moved")).expect("a move");
        eventually("the moved project", || planner.plans_of(&root.join("moved")) == 1);
        thread::sleep(Duration::from_millis(500));
    });
    assert_eq!(summary, Summary { projects: 2, planned: 2, failed: 0, waiting: 0 });
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
        eventually("the first look", || read_status(&root).is_some());
        thread::sleep(Duration::from_millis(300));
        write_model(&root.join("p"), "a");
        eventually("the plan", || planner.plans_of(&root.join("p")) == 1);
        write_model(&root.join("q/dense"), "b");
        eventually("the plan of the inner one", || planner.plans_of(&root.join("q/dense")) == 1);
        write_model(&root.join("q"), "c");
        eventually("the plan of the outer one", || planner.plans_of(&root.join("q")) == 1);
    });
    assert_eq!(summary, Summary { projects: 2, planned: 2, failed: 0, waiting: 0 }, "q/dense is a part of q");
}

#[test]
fn a_slow_writer_is_waited_for() {
    let (_guard, root) = root();
    let planner = Counter::default();
    // Long against the pauses of the writer, however busy the machine is.
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
        thread::sleep(Duration::from_millis(800));
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
    let planner = Counter::default();
    with_daemon(&options(&root), &planner, || {
        eventually("the plan", || planner.plans_of(&root.join("p")) == 1);
        fs::remove_dir_all(root.join("p")).expect("removed");
        write_model(&root.join("p"), "b");
        eventually("the second plan", || planner.plans_of(&root.join("p")) == 2);
        fs::remove_dir_all(root.join("p/sparse/0")).expect("removed");
        write_model(&root.join("p"), "c");
        eventually("the third plan", || planner.plans_of(&root.join("p")) == 3);
    });
}

#[test]
fn polling_finds_what_native_events_would() {
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
fn once_ends_when_nothing_is_left_and_one_failure_touches_no_other_project() {
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
    assert_eq!(phases[0], ("bad", "failed: broken (again in 10 s)".into()));
    assert_eq!(phases[1], ("good", "planned: 1 key views for 100 %".into()));
}

#[test]
fn a_second_daemon_says_who_holds_the_root() {
    let (_guard, root) = root();
    let planner = Counter::default();
    with_daemon(&options(&root), &planner, || {
        eventually("the first daemon", || {
            read_status(&root).is_some_and(|line| line.running) || root.join("viewrank/watch.lock").exists()
        });
        thread::sleep(Duration::from_millis(100));
        let second = watch_roots(&options(&root), &planner, &Disk::REAL, |_| {});
        match second {
            Err(DaemonError::Held { holder, .. }) => assert!(holder.contains(&std::process::id().to_string())),
            other => panic!("expected to be refused, got {other:?}"),
        }
    });
}
