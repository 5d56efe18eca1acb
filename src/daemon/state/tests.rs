use super::*;
use crate::daemon::settle::Entry;

const SETTLE: Duration = Duration::from_secs(2);

fn stamped(bytes: usize) -> (tempfile::TempDir, Stamp) {
    let root = tempfile::tempdir().expect("a temporary folder");
    std::fs::create_dir_all(root.path().join("sparse/0")).expect("a folder");
    std::fs::write(root.path().join("sparse/0/images.bin"), vec![0; bytes]).expect("a file");
    let stamp = Stamp::read(root.path(), false);
    (root, stamp)
}

fn planned(text: &str) -> Outcome {
    let fingerprint = serde_json::from_value(text.into()).expect("a string");
    Outcome::Planned {
        fingerprint,
        backend: "colmap".into(),
        clusters: 3,
        share: 0.9,
        has_region: false,
        lacks_export: false,
        note: None,
        anew: true,
        known: None,
    }
}

fn failed() -> Outcome {
    Outcome::Failed {
        reason: "disk full".into(),
        hint: None,
    }
}

fn map(length: u64) -> MapFiles {
    MapFiles::from([("map.npy".into(), Entry::of_length(length))])
}

/// A project that has been scanned.
fn tracked(stamp: &Stamp, now: Instant) -> TrackedProject {
    let mut project = TrackedProject::new("p".into(), now);
    project.observe(stamp.clone(), now, OnBusy::Restart);
    project
}

/// Runs a job from start to end.
fn run(project: &mut TrackedProject, work: Work, outcome: Outcome, now: Instant) {
    let input = project.start(7, work, SETTLE, now).0;
    assert!(project.finish(7, input, outcome, now));
}

fn of_plan(has_region: bool) -> Phase {
    Phase::Planned {
        backend: "colmap".into(),
        clusters: 3,
        share: 0.9,
        has_region,
        lacks_export: false,
        note: None,
    }
}

#[test]
fn a_project_that_stops_changing_is_planned_once() {
    let (_root, stamp) = stamped(5);
    let start = Instant::now();
    let mut project = tracked(&stamp, start);
    assert_eq!(project.due(SETTLE), Some((start + SETTLE, Work::Plan)));
    let input = project.start(1, Work::Plan, SETTLE, start).0;
    assert_eq!(project.due(SETTLE), None);
    project.progress(1, "surface".into(), 40);
    assert_eq!(
        project.phase(),
        Phase::Planning {
            stage: "surface".into(),
            percent: 40
        }
    );
    project.finish(1, input, planned("a"), start + SETTLE);
    assert_eq!(project.due(SETTLE), None);
    project.observe(stamp, start + SETTLE * 9, OnBusy::Restart);
    assert_eq!(project.due(SETTLE), None);
    assert_eq!(project.phase(), of_plan(false));
}

#[test]
fn a_change_while_planning_cancels_and_plans_again() {
    let ((_root, stamp), (_other, changed)) = (stamped(5), stamped(6));
    let start = Instant::now();
    let mut project = tracked(&stamp, start);
    let (input, cancel) = project.start(1, Work::Plan, SETTLE, start);
    project.observe(changed, start + SETTLE, OnBusy::Restart);
    assert!(cancel.load(Ordering::Relaxed));
    project.finish(1, input, Outcome::Abandoned, start + SETTLE);
    assert_eq!(project.due(SETTLE), Some((start + SETTLE * 2, Work::Plan)));
}

#[test]
fn a_job_that_finds_its_input_changed_starts_again_only_after_the_settle_time() {
    let (_root, stamp) = stamped(5);
    let start = Instant::now();
    let mut project = tracked(&stamp, start);
    run(&mut project, Work::Plan, Outcome::Abandoned, start + SETTLE);
    assert_eq!(project.due(SETTLE), Some((start + SETTLE * 2, Work::Plan)));
}

#[test]
fn input_that_changes_and_returns_is_checked_again() {
    let ((_root, stamp), (_other, changed)) = (stamped(5), stamped(6));
    let start = Instant::now();
    let mut project = tracked(&stamp, start);
    run(&mut project, Work::Plan, planned("a"), start);
    project.observe(changed, start + SETTLE, OnBusy::Restart);
    project.observe(stamp, start + SETTLE * 2, OnBusy::Restart);
    assert_eq!(
        project.phase(),
        Phase::Waiting {
            reason: "files to stop changing".into()
        }
    );
    assert_eq!(project.due(SETTLE), Some((start + SETTLE * 3, Work::Plan)));
    run(&mut project, Work::Plan, planned("a"), start + SETTLE * 3);
    assert_eq!(project.phase(), of_plan(false));
}

#[test]
fn input_that_changes_and_returns_while_it_is_planned_is_planned_again() {
    let ((_root, stamp), (_other, changed)) = (stamped(5), stamped(6));
    let start = Instant::now();
    let mut project = tracked(&stamp, start);
    let input = project.start(1, Work::Plan, SETTLE, start).0;
    project.observe(changed, start, OnBusy::Queue);
    project.observe(stamp, start + SETTLE, OnBusy::Queue);
    project.finish(1, input, planned("a"), start + SETTLE);
    assert_eq!(project.due(SETTLE), Some((start + SETTLE * 2, Work::Plan)));
}

#[test]
fn maps_that_come_and_go_while_a_job_is_queued_leave_the_project_planned() {
    let (_root, stamp) = stamped(5);
    let start = Instant::now();
    let mut project = tracked(&stamp, start);
    project.wait_for(Some("a free job slot (--jobs)"));
    assert_eq!(
        project.phase(),
        Phase::Queued {
            reason: "a free job slot (--jobs)".into()
        }
    );
    project.wait_for(None);
    run(&mut project, Work::Plan, planned("a"), start);
    project.observe_maps(map(1), start);
    assert_eq!(project.due(SETTLE), Some((start + SETTLE, Work::Follow)));
    project.wait_for(Some("a free job slot (--jobs)"));
    assert!(project.is_queued());
    assert_eq!(project.phase(), of_plan(false));
    project.observe_maps(MapFiles::new(), start + SETTLE);
    project.wait_for(None);
    run(
        &mut project,
        Work::Follow,
        Outcome::Abandoned,
        start + SETTLE * 2,
    );
    assert_eq!(
        (project.phase(), project.due(SETTLE)),
        (of_plan(false), None)
    );
}

#[test]
fn the_job_of_an_earlier_project_at_the_same_path_is_ignored() {
    let (_root, stamp) = stamped(5);
    let now = Instant::now();
    let input = tracked(&stamp, now).start(1, Work::Plan, SETTLE, now).0;
    let mut project = tracked(&stamp, now);
    let own = project.start(2, Work::Plan, SETTLE, now).0;
    project.progress(1, "ranking".into(), 99);
    assert!(!project.finish(1, input, planned("of the other"), now));
    assert_eq!(
        project.phase(),
        Phase::Planning {
            stage: "read".into(),
            percent: 0
        }
    );
    assert!(project.finish(
        2,
        own,
        Outcome::Incomplete {
            reason: "images.bin ends at byte 5".into()
        },
        now
    ));
    assert_eq!(
        project.phase(),
        Phase::Waiting {
            reason: "images.bin ends at byte 5".into()
        }
    );
}

#[test]
fn an_image_being_written_delays_a_plan_but_starts_none() {
    let (_root, stamp) = stamped(5);
    let start = Instant::now();
    let mut project = tracked(&stamp, start);
    project.disturb(start + SETTLE);
    assert_eq!(project.due(SETTLE), Some((start + SETTLE * 2, Work::Plan)));
    run(&mut project, Work::Plan, planned("a"), start + SETTLE * 2);
    project.disturb(start + SETTLE * 3);
    assert_eq!(project.due(SETTLE), None);
}

#[test]
fn with_queue_the_plan_is_finished_and_then_made_again() {
    let ((_root, stamp), (_other, changed)) = (stamped(5), stamped(6));
    let start = Instant::now();
    let mut project = tracked(&stamp, start);
    let (input, cancel) = project.start(1, Work::Plan, SETTLE, start);
    project.observe(changed, start + SETTLE, OnBusy::Queue);
    assert!(!cancel.load(Ordering::Relaxed));
    project.finish(1, input, planned("a"), start + SETTLE);
    assert_eq!(project.due(SETTLE), Some((start + SETTLE * 2, Work::Plan)));
}

#[test]
fn failed_measurements_are_retried_and_wait_for_a_complete_model() {
    let ((_root, stamp), (_other, changed)) = (stamped(5), stamped(6));
    let start = Instant::now();
    let mut project = tracked(&stamp, start);
    run(&mut project, Work::Plan, planned("a"), start);
    project.observe_maps(map(1), start);
    let mut now = start + SETTLE;
    for pause in [FIRST_RETRY, FIRST_RETRY * 2] {
        run(&mut project, Work::Follow, failed(), now);
        assert_eq!(project.due(SETTLE), Some((now + pause, Work::Follow)));
        now += pause;
    }
    let input = project.start(1, Work::Follow, SETTLE, now).0;
    project.cancel();
    project.finish(1, input, Outcome::Abandoned, now);
    project.observe(changed, now, OnBusy::Restart);
    run(
        &mut project,
        Work::Plan,
        Outcome::Incomplete {
            reason: "images.bin ends at byte 5".into(),
        },
        now,
    );
    assert_eq!(project.due(SETTLE), None);
    project.observe(stamp, now, OnBusy::Restart);
    run(&mut project, Work::Plan, planned("a"), now);
    assert_eq!(project.due(SETTLE), Some((start + SETTLE, Work::Follow)));
}

#[test]
fn maps_newer_than_the_last_measurement_are_counted() {
    let (_root, stamp) = stamped(5);
    let now = Instant::now();
    let mut project = tracked(&stamp, now);
    run(&mut project, Work::Plan, planned("a"), now);
    project.observe_maps(map(1), now);
    let followed = Outcome::Followed(Phase::Partial {
        backend: "colmap".into(),
        done: 1,
        clusters: 3,
        share: Some(0.5),
        unmeasured: 0,
        has_region: false,
        note: None,
    });
    let unmeasured = |project: &TrackedProject| match project.phase() {
        Phase::Partial { unmeasured, .. } => unmeasured,
        phase => panic!("{phase}"),
    };
    run(&mut project, Work::Follow, followed, now + SETTLE);
    assert_eq!(unmeasured(&project), 0);
    project.observe_maps(
        map(1)
            .into_iter()
            .chain([("b".into(), Entry::of_length(1))])
            .collect(),
        now + SETTLE,
    );
    assert_eq!(unmeasured(&project), 1);
    assert!(
        project
            .phase()
            .to_string()
            .ends_with("about 50 % of the area that all cover, 1 new file to measure")
    );
    project.start(1, Work::Follow, SETTLE, now + SETTLE * 2);
    assert!(project.is_measuring() && unmeasured(&project) == 1);
}

#[test]
fn a_failed_job_is_retried_soon_after_maps_change() {
    let (_root, stamp) = stamped(5);
    for work in [Work::Plan, Work::Follow] {
        let now = Instant::now();
        let mut project = tracked(&stamp, now);
        run(&mut project, Work::Plan, planned("a"), now);
        project.observe_maps(map(1), now);
        (0..9).for_each(|_| run(&mut project, work, failed(), now));
        let late = project.due(SETTLE).expect("a retry").0;
        assert!(late > now + FIRST_RETRY * 10);
        project.observe_maps(map(1), now);
        assert_eq!(project.due(SETTLE), Some((late, work)), "nothing changed");
        project.observe_maps(map(2), now + SETTLE);
        assert_eq!(
            project.due(SETTLE),
            Some((now + SETTLE + FIRST_RETRY, work))
        );
    }
}

#[test]
fn an_incomplete_model_waits_for_a_change_without_an_error() {
    let (_root, stamp) = stamped(5);
    let start = Instant::now();
    let mut project = tracked(&stamp, start);
    run(
        &mut project,
        Work::Plan,
        Outcome::Incomplete {
            reason: "images.bin ends at byte 5".into(),
        },
        start,
    );
    assert_eq!(project.due(SETTLE), None);
    assert_eq!(
        project.phase(),
        Phase::Waiting {
            reason: "images.bin ends at byte 5".into()
        }
    );
    project.observe(stamped(7).1, start + SETTLE, OnBusy::Restart);
    assert_eq!(project.due(SETTLE), Some((start + SETTLE * 2, Work::Plan)));
}

#[test]
fn retries_back_off_until_a_success() {
    let (_root, stamp) = stamped(5);
    let now = Instant::now();
    let mut project = tracked(&stamp, now);
    let mut pauses = Vec::new();
    for _ in 0..12 {
        run(&mut project, Work::Plan, failed(), now);
        pauses.push(project.due(SETTLE).expect("a retry").0 - now);
    }
    assert!(project.has_failed());
    assert!(
        pauses
            .windows(2)
            .all(|w| w[1] == (w[0] * 2).min(LONGEST_RETRY))
    );
    run(&mut project, Work::Plan, planned("a"), now);
    assert!(!project.has_failed());
    project.recheck();
    run(&mut project, Work::Plan, failed(), now);
    assert_eq!(project.due(SETTLE), Some((now + FIRST_RETRY, Work::Plan)));
}

#[test]
fn a_plan_that_is_too_large_is_rarely_tried_again_unless_its_input_changes() {
    let (_root, stamp) = stamped(5);
    let now = Instant::now();
    let mut project = tracked(&stamp, now);
    run(
        &mut project,
        Work::Plan,
        Outcome::Aside {
            reason: "5G".into(),
            hint: None,
        },
        now,
    );
    assert!(project.has_failed());
    assert_eq!(project.due(SETTLE), Some((now + LONGEST_RETRY, Work::Plan)));
    project.observe(stamped(7).1, now + SETTLE, OnBusy::Restart);
    assert_eq!(project.due(SETTLE), Some((now + SETTLE * 2, Work::Plan)));
}

#[test]
fn what_a_job_says_at_length_is_shortened() {
    let (_root, stamp) = stamped(5);
    let long = || "A".repeat(1 << 20);
    let outcomes = [
        Outcome::Incomplete { reason: long() },
        Outcome::Aside {
            reason: long(),
            hint: Some(long()),
        },
        Outcome::Followed(Phase::Partial {
            backend: "colmap".into(),
            done: 1,
            clusters: 2,
            share: None,
            unmeasured: 0,
            has_region: false,
            note: Some(long()),
        }),
    ];
    for outcome in outcomes {
        let start = Instant::now();
        let mut project = tracked(&stamp, start);
        run(&mut project, Work::Plan, outcome, start);
        let status = serde_json::to_string(&project.phase()).expect("JSON");
        assert!(status.len() < 3000, "{}", status.len());
    }
}

#[test]
fn shares_inside_a_region_are_said_to_be() {
    let planned = of_plan(true);
    let partial = Phase::Partial {
        backend: "colmap".into(),
        done: 1,
        clusters: 3,
        share: Some(0.5),
        unmeasured: 0,
        has_region: true,
        note: None,
    };
    let reached = Phase::Reached {
        backend: "colmap".into(),
        done: 3,
        clusters: 3,
        share: 0.9,
        has_region: true,
        note: None,
    };
    for phase in [planned, partial, reached] {
        let words = phase.to_string();
        assert!(words.contains(" inside the region"), "{phase}");
        assert!(words.contains(" for colmap: "), "{phase}");
    }
    assert!(!of_plan(false).to_string().contains("region"));
}
