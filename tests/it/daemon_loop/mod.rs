//! The daemon's loop on real folders: each project is planned once its input has settled, and only
//! then. The tests here count plans instead of making them; those in `real` make them.

mod real;

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

use viewrank::daemon::{
    DaemonError, Job, Planner, Signal, WatchOptions,
    phase::Phase,
    read_status,
    run::WatchSummary,
    settle::HashCache,
    state::{OnBusy, Outcome},
    watch_roots,
};
use viewrank_io::output::{Disk, OutputError};

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
        self.plans
            .lock()
            .expect("no panic")
            .get(project)
            .map_or(0, Vec::len)
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
        let model = ["cameras.bin", "images.bin", "points3D.bin"]
            .map(|name| job.project.join("sparse/0").join(name));
        let fingerprint =
            match HashCache::fingerprint(&self.hashes, job.project, &model, job.stamp, b"") {
                Ok(fingerprint) => fingerprint,
                Err(_) => return Outcome::Abandoned,
            };
        let text = serde_json::to_string(&fingerprint).expect("a string");
        let done = Outcome::Planned {
            fingerprint,
            backend: "colmap".into(),
            clusters: 1,
            share: 1.0,
            has_region: false,
            lacks_export: false,
            note: None,
            anew: true,
            known: None,
        };
        if self
            .plans
            .lock()
            .expect("no panic")
            .get(job.project)
            .and_then(|p| p.last())
            == Some(&text)
        {
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
        if fs::read(job.project.join("sparse/0/images.bin"))
            .is_ok_and(|bytes| bytes.starts_with(b"broken"))
        {
            return Outcome::Failed {
                reason: "broken".into(),
                hint: None,
            };
        }
        self.plans
            .lock()
            .expect("no panic")
            .entry(job.project.into())
            .or_default()
            .push(text);
        done
    }
}

fn options(root: &Path) -> WatchOptions {
    WatchOptions {
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
fn with_daemon(
    options: &WatchOptions,
    planner: &dyn Planner,
    script: impl FnOnce(),
) -> WatchSummary {
    thread::scope(|threads| {
        let (sender, receiver) = channel::<Box<dyn Fn(Signal) + Send>>();
        let daemon = threads.spawn(move || {
            watch_roots(options, planner, &Disk::REAL, |signal| {
                pass_on(&sender, signal)
            })
        });
        let signal = receiver.recv().expect("the daemon starts");
        let done = catch_unwind(AssertUnwindSafe(script));
        signal(Signal::Stop);
        if let Err(failure) = done {
            resume_unwind(failure);
        }
        daemon
            .join()
            .expect("no panic")
            .expect("the root can be watched")
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

/// Adds a project and waits until it is planned. Events come in order and all projects have the
/// same settling time, so everything that happened before has had its effect then.
fn wait_until_idle(root: &Path, planner: &Counter) {
    write_model(&root.join("last"), "last");
    eventually("the last project", || {
        planner.plans_of(&root.join("last")) == 1
    });
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
        eventually("the early project", || {
            planner.plans_of(&root.join("early")) == 1
        });
        write_model(&root.join("deep/er/late one"), "b");
        eventually("the late project", || {
            planner.plans_of(&root.join("deep/er/late one")) == 1
        });
        fs::rename(root.join("early"), root.join("moved")).expect("a move");
        eventually("the moved project", || {
            planner.plans_of(&root.join("moved")) == 1
        });
        wait_until_idle(&root, &planner);
    });
    assert_eq!(
        summary,
        WatchSummary {
            projects: 3,
            planned: 3,
            failed: 0,
            waiting: 0
        },
        "with the last one"
    );
    assert!(
        planner
            .plans
            .lock()
            .expect("no panic")
            .values()
            .all(|plans| plans.len() == 1)
    );
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
        eventually("the plan of the inner one", || {
            planner.plans_of(&root.join("q/dense")) == 1
        });
        write_model(&root.join("q"), "c");
        eventually("the plan of the outer one", || {
            planner.plans_of(&root.join("q")) == 1
        });
    });
    assert_eq!(
        summary,
        WatchSummary {
            projects: 2,
            planned: 2,
            failed: 0,
            waiting: 0
        },
        "q/dense belongs to q"
    );
}

#[test]
fn a_slow_writer_delays_the_plan() {
    let (_guard, root) = root();
    let planner = Counter::default();
    // Longer than the pauses of the writer even on a busy machine.
    let options = WatchOptions {
        settle: Duration::from_secs(3),
        ..options(&root)
    };
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
    let planner = Counter {
        length: Duration::from_millis(600),
        ..Counter::default()
    };
    with_daemon(&options(&root), &planner, || {
        let planning = || {
            let status = read_status(&root)?.status;
            status
                .projects
                .first()
                .map(|p| matches!(p.phase, Phase::Planning { .. }))
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
            eventually("the plan", || {
                planner.plans_of(&root.join("p")) == plans + 1
            });
            write_model(&root.join("p"), &format!("{content} again"));
            eventually("the next plan", || {
                planner.plans_of(&root.join("p")) == plans + 2
            });
        }
        fs::remove_dir(root.join("group")).expect("removed");
        fs::create_dir(root.join("group")).expect("a folder");
        for name in ["one", "two"] {
            write_model(&root.join("group").join(name), "a");
            eventually("the plan in the group", || {
                planner.plans_of(&root.join("group").join(name)) == 1
            });
        }
    });
}

#[test]
fn the_job_of_a_replaced_folder_is_ignored() {
    let (_guard, root) = root();
    write_model(&root.join("p"), "a");
    let planner = Counter {
        length: Duration::from_millis(500),
        ..Counter::default()
    };
    let summary = with_daemon(&options(&root), &planner, || {
        let state = |wanted: fn(&Phase) -> bool| {
            let status = read_status(&root).map(|line| line.status);
            status.is_some_and(|status| status.projects.iter().any(|p| wanted(&p.phase)))
        };
        eventually("the start", || {
            state(|phase| matches!(phase, Phase::Planning { .. }))
        });
        fs::rename(root.join("p"), root.join(".away")).expect("moved");
        eventually("the project to go", || !state(|_| true));
        write_model(&root.join("p"), "b");
        eventually("the plan", || planner.plans_of(&root.join("p")) == 1);
        eventually("its status", || {
            state(|phase| matches!(phase, Phase::Planned { .. }))
        });
    });
    assert_eq!(
        summary,
        WatchSummary {
            projects: 1,
            planned: 1,
            failed: 0,
            waiting: 0
        }
    );
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
    let options = WatchOptions {
        poll: Some(Duration::from_millis(100)),
        ..options(&root)
    };
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
    let options = WatchOptions {
        once: true,
        ..options(&root)
    };
    let summary =
        watch_roots(&options, &planner, &Disk::REAL, |_| {}).expect("the root can be watched");
    assert_eq!(
        summary,
        WatchSummary {
            projects: 2,
            planned: 1,
            failed: 1,
            waiting: 0
        }
    );
    let line = read_status(&root).expect("a status");
    assert!(!line.running);
    let phases: Vec<_> = line
        .status
        .projects
        .iter()
        .map(|p| (p.project.as_str(), p.phase.to_string()))
        .collect();
    assert_eq!(
        phases[0],
        (
            "bad",
            "failed: broken (retry 10 s after the failure)".into()
        )
    );
    let planned = "planned for colmap: 1 depth map for 100 % of the area that all cover";
    assert_eq!(phases[1], ("good", planned.into()));
}

#[test]
fn projects_move_with_the_folder_that_contains_them() {
    let (_guard, root) = root();
    write_model(&root.join("group/p"), "a");
    let planner = Counter::default();
    with_daemon(&options(&root), &planner, || {
        eventually("the plan", || planner.plans_of(&root.join("group/p")) == 1);
        fs::rename(root.join("group"), root.join("moved")).expect("moved");
        eventually("the plan at its new place", || {
            planner.plans_of(&root.join("moved/p")) == 1
        });
        let names = || {
            read_status(&root)
                .expect("a status")
                .status
                .projects
                .into_iter()
                .map(|p| p.project)
        };
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
        eventually("the first plan", || {
            planner.plans_of(&root.join("first")) == 1
        });
        std::os::unix::fs::symlink(elsewhere.join("q"), root.join("link")).expect("a link");
        write_model(&root.join("second"), "a");
        eventually("the second plan", || {
            planner.plans_of(&root.join("second")) == 1
        });
    });
    assert_eq!(
        (
            planner.plans_of(&root.join("link")),
            planner.plans_of(&elsewhere.join("q"))
        ),
        (0, 0)
    );
}

#[test]
fn a_second_daemon_names_the_holder_of_the_root() {
    let (_guard, root) = root();
    let planner = Counter::default();
    with_daemon(&options(&root), &planner, || {
        eventually("the first daemon", || {
            read_status(&root).is_some_and(|line| line.running)
        });
        let second = watch_roots(&options(&root), &planner, &Disk::REAL, |_| {});
        match second {
            Err(DaemonError::Held { holder, .. }) => {
                assert!(holder.contains(&std::process::id().to_string()))
            }
            other => panic!("expected to be refused, got {other:?}"),
        }
    });
}

fn make_pipe(path: &Path) {
    assert!(
        std::process::Command::new("mkfifo")
            .arg(path)
            .status()
            .expect("mkfifo")
            .success()
    );
}

fn watch_once(root: &Path) -> Result<WatchSummary, DaemonError> {
    let options = WatchOptions {
        once: true,
        ..options(root)
    };
    watch_roots(&options, &Counter::default(), &Disk::REAL, |_| {})
}

#[test]
fn a_file_in_place_of_the_lock_is_left_unchanged() {
    let (_elsewhere, outside) = root();
    let precious = outside.join("precious.txt");
    let text = "process of a precious kind";
    fs::write(&precious, text).expect("a file");
    type Plant<'a> = &'a dyn Fn(&Path);
    let plant: [(&str, Plant); 4] = [
        ("link", &|lock| {
            std::os::unix::fs::symlink(&precious, lock).expect("a link")
        }),
        ("second name", &|lock| {
            fs::hard_link(&precious, lock).expect("a second name")
        }),
        ("file", &|lock| fs::write(lock, text).expect("a file")),
        ("pipe", &make_pipe),
    ];
    for (kind, plant) in plant {
        let root = outside.join(kind);
        fs::create_dir_all(root.join("viewrank")).expect("a folder");
        plant(&root.join("viewrank/watch.lock"));
        let watched = watch_once(&root);
        match kind {
            // A file is locked, and nothing is written into it.
            "second name" | "file" => {
                assert!(watched.is_ok(), "{kind}: {watched:?}");
                assert_eq!(
                    fs::read_to_string(root.join("viewrank/watch.lock")).expect("a file"),
                    text
                );
            }
            _ => {
                assert!(
                    matches!(
                        watched,
                        Err(DaemonError::Output(OutputError::Foreign { .. }))
                    ),
                    "{kind}: {watched:?}"
                )
            }
        }
        assert_eq!(
            fs::read_to_string(&precious).expect("a file"),
            text,
            "{kind}"
        );
    }
}

#[test]
fn neither_status_nor_lock_is_written_through_a_link() {
    let (_elsewhere, outside) = root();
    let (_guard, root) = root();
    std::os::unix::fs::symlink(&outside, root.join("viewrank")).expect("a link");
    assert!(matches!(
        watch_once(&root),
        Err(DaemonError::Output(OutputError::Escapes { .. }))
    ));
    assert!(fs::read_dir(&outside).expect("a folder").next().is_none());

    fs::remove_file(root.join("viewrank")).expect("a link");
    // The folder of somebody else who may write below the same root.
    fs::create_dir(root.join("theirs")).expect("a folder");
    fs::write(root.join("theirs/status.json"), "precious").expect("a file");
    std::os::unix::fs::symlink("theirs", root.join("viewrank")).expect("a link");
    assert!(matches!(
        watch_once(&root),
        Err(DaemonError::Output(OutputError::Foreign { .. }))
    ));
    assert_eq!(
        fs::read_to_string(root.join("theirs/status.json")).expect("their file"),
        "precious"
    );
    assert_eq!(
        fs::read_dir(root.join("theirs")).expect("a folder").count(),
        1
    );

    fs::remove_file(root.join("viewrank")).expect("a link");
    watch_once(&root).expect("the root can be watched");
    watch_once(&root).expect("a lock of an earlier run may be taken");
}
