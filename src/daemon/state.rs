//! What the daemon knows of one project, as a state machine without a file system or a clock of its own, and the status file
//! that `viewrank status` reads.

use std::{
    fmt,
    path::PathBuf,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{
    maps::{MapFiles, Maps},
    settle::{Fingerprint, Stamp, Stillness},
};

/// First pause after a failure; doubled with each further one.
const FIRST_RETRY: Duration = Duration::from_secs(10);
/// Longest pause after a failure.
const LONGEST_RETRY: Duration = Duration::from_secs(3600);

/// Where a project stands, as it is shown.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "state", rename_all = "lowercase")]
pub enum Phase {
    /// The input isn't complete or not still yet.
    Waiting {
        /// What is waited for.
        reason: String,
    },
    /// Complete; waits for a free job or for memory.
    Queued {
        /// What is waited for.
        reason: String,
    },
    /// A plan is being made.
    Planning {
        /// As in `timings.json`.
        stage: String,
        /// Of the stage.
        percent: u8,
    },
    /// The plan is there, and no depth map yet.
    Planned {
        /// Key views to the cut.
        clusters: usize,
        /// What they reach by prediction of what all view clusters reach, 0 to 1.
        share: f64,
        /// What should be known about it.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        note: Option<String>,
    },
    /// The backend writes depth maps.
    Computing {
        /// Key views that have a depth map.
        done: usize,
        /// Key views to the cut, and those beyond it that have a depth map.
        clusters: usize,
        /// What they really reach of what all view clusters are expected to reach, 0 to 1; null where they are counted, not measured.
        share: Option<f64>,
        /// Files of depth maps that came or changed since; left out where there are none.
        #[serde(default, skip_serializing_if = "is_zero")]
        unmeasured: usize,
        /// What should be known about it.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        note: Option<String>,
    },
    /// The target is reached in reality.
    Reached {
        /// Key views that have a depth map.
        done: usize,
        /// Key views to the cut, and those beyond it that have a depth map.
        clusters: usize,
        /// What they really reach of what all view clusters are expected to reach, 0 to 1.
        share: f64,
        /// What should be known about it.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        note: Option<String>,
    },
    /// It could not be planned or measured; it is tried again after a pause, or as soon as its input changes.
    Failed {
        /// What went wrong, and where.
        reason: String,
        /// What to do about it.
        hint: Option<String>,
        /// Seconds between the failure and the next try.
        retry_after_s: u64,
    },
}

fn is_false(flag: &bool) -> bool {
    !flag
}

fn is_zero(n: &usize) -> bool {
    *n == 0
}

impl fmt::Display for Phase {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Waiting { reason } => write!(f, "waiting: {reason}"),
            Self::Queued { reason } => write!(f, "queued: {reason}"),
            Self::Planning { stage, percent } => write!(f, "planning: {stage} {percent} %"),
            Self::Planned { clusters, share, note } => {
                write!(f, "planned: {clusters} key views for {:.0} %", share * 100.0)?;
                note.iter().try_for_each(|note| write!(f, "; {note}"))
            }
            Self::Computing { done, clusters, share, unmeasured, note } => {
                write!(f, "computing: {done} of {clusters} depth maps")?;
                // 89.9 % of a target of 90 % have not reached it.
                share.iter().try_for_each(|share| write!(f, ", {:.0} % reached", (share * 100.0).floor()))?;
                match *unmeasured {
                    0 => {}
                    1 => write!(f, ", 1 new file to be measured")?,
                    n => write!(f, ", {n} new files to be measured")?,
                }
                note.iter().try_for_each(|note| write!(f, "; {note}"))
            }
            Self::Reached { done, share, note, .. } => {
                write!(f, "reached: {:.0} % with {done} depth maps", share * 100.0)?;
                note.iter().try_for_each(|note| write!(f, "; {note}"))
            }
            Self::Failed { reason, retry_after_s, .. } => {
                write!(f, "failed: {reason} (next try {retry_after_s} s after it)")
            }
        }
    }
}

/// How a job on a project ended.
#[derive(Clone, Debug, PartialEq)]
pub enum Outcome {
    /// A new plan was written, or the one that is there is still right.
    Planned {
        fingerprint: Fingerprint,
        clusters: usize,
        share: f64,
        note: Option<String>,
        /// Was it made now, or is the one that was there still right?
        anew: bool,
        /// What was measured before, where the plan stayed the same.
        known: Option<Box<Outcome>>,
    },
    /// The finished depth maps were measured.
    Followed {
        done: usize,
        clusters: usize,
        share: Option<f64>,
        reached: bool,
        note: Option<String>,
    },
    /// The model doesn't parse or its files don't fit together: it isn't there whole yet.
    Incomplete {
        reason: String,
    },
    /// The input changed meanwhile, or the job was cancelled; nothing was written.
    Abandoned,
    Failed {
        reason: String,
        hint: Option<String>,
    },
}

/// What a job does.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Work {
    Plan,
    /// Measure the finished depth maps of the plan.
    Follow,
}

/// What a job looked at.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Looked {
    pub input: Stamp,
    /// Depth maps that were written to their end.
    pub maps: MapFiles,
}

/// What to do when the input changes while a plan is made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum OnBusy {
    /// Cancel it and start again when the input is still.
    #[default]
    Restart,
    /// Finish it, then plan once more.
    Queue,
}

/// One project.
#[derive(Debug)]
pub struct Tracked {
    pub root: PathBuf,
    /// What the last job came to; shown as long as it is about what is there.
    result: Phase,
    still: Stillness<Stamp>,
    maps: Maps,
    /// Is the result about the input as it is?
    concluded: bool,
    /// Is there a plan whose depth maps may come?
    planned: bool,
    job: Option<Running>,
    /// What a job that is due waits for.
    queued: Option<&'static str>,
    failures: u32,
    retry: Option<(Instant, Work)>,
}

/// A job that runs.
#[derive(Debug)]
struct Running {
    number: u64,
    work: Work,
    started: Instant,
    cancel: Arc<AtomicBool>,
    /// Has the input changed since it began?
    overtaken: bool,
    stage: String,
    percent: u8,
}

impl Tracked {
    /// A project of which nothing has been seen yet.
    pub fn new(root: PathBuf, now: Instant) -> Self {
        Self {
            root,
            result: waiting(&Stamp::default()),
            still: Stillness::new(Stamp::default(), now),
            maps: Maps::default(),
            concluded: false,
            planned: false,
            job: None,
            queued: None,
            failures: 0,
            retry: None,
        }
    }

    /// Where it stands.
    pub fn phase(&self) -> Phase {
        match (&self.job, self.queued) {
            (Some(Running { work: Work::Plan, stage, percent, .. }), _) => {
                Phase::Planning { stage: stage.clone(), percent: *percent }
            }
            // Depth maps that wait for being measured change nothing in what is known.
            _ if self.concluded => match self.result.clone() {
                Phase::Computing { done, clusters, share, note, .. } => {
                    Phase::Computing { done, clusters, share, unmeasured: self.maps.unmeasured(), note }
                }
                result => result,
            },
            (_, Some(reason)) => Phase::Queued { reason: reason.into() },
            _ => waiting(self.still.stamp()),
        }
    }

    /// Takes a look at the input, which has been as it is since `since` if it changed. A change makes the project wait, and cancels
    /// its job where `on_busy` says so.
    pub fn observe(&mut self, stamp: Stamp, since: Instant, on_busy: OnBusy) {
        if !self.still.observe(stamp, since) {
            return;
        }
        self.look_again();
        if let Some(job) = &mut self.job {
            job.overtaken = true;
            if on_busy == OnBusy::Restart {
                job.cancel.store(true, Ordering::Relaxed);
            }
        }
    }

    /// An image was being written then: the input was not still, though nothing that is looked at changed.
    pub fn disturb(&mut self, then: Instant) {
        self.still.restart(then);
    }

    /// Takes a look at the depth maps. What failed is tried again soon where they changed, for they may have been the cause.
    pub fn observe_maps(&mut self, maps: MapFiles, now: Instant) {
        if self.maps.observe(maps, now)
            && let Some((at, _)) = &mut self.retry
        {
            *at = (*at).min(now + FIRST_RETRY);
        }
    }

    /// When this project next wants a job, and which; `None` while one runs or there is nothing to do.
    pub fn due(&self, settle: Duration) -> Option<(Instant, Work)> {
        if self.job.is_some() || self.still.stamp().is_empty() {
            return None;
        }
        if !self.concluded {
            return Some((self.still.settled_at(settle), Work::Plan));
        }
        if self.retry.is_some() {
            return self.retry;
        }
        let maps = self.maps.due(settle).filter(|_| self.planned);
        maps.map(|at| (at, Work::Follow))
    }

    /// Are its depth maps being measured?
    pub fn is_measuring(&self) -> bool {
        self.job.as_ref().is_some_and(|job| job.work == Work::Follow)
    }

    /// The input as last seen.
    pub fn stamp(&self) -> &Stamp {
        self.still.stamp()
    }

    /// A job that is due waits for something, or for nothing any more.
    pub fn wait_for(&mut self, reason: Option<&'static str>) {
        self.queued = reason;
    }

    /// Does a job that is due wait until others have ended?
    pub fn is_queued(&self) -> bool {
        self.queued.is_some()
    }

    /// Is there a plan, and nothing to be done about it?
    pub fn is_at_rest(&self) -> bool {
        self.planned && self.job.is_none() && !self.has_failed()
    }

    /// The job of that number begins on what was last seen; the flag cancels it.
    pub fn start(&mut self, number: u64, work: Work, settle: Duration, now: Instant) -> (Looked, Arc<AtomicBool>) {
        let cancel = Arc::new(AtomicBool::new(false));
        let stage = "read".into();
        self.job =
            Some(Running { number, work, started: now, cancel: cancel.clone(), overtaken: false, stage, percent: 0 });
        (Looked { input: self.still.stamp().clone(), maps: self.maps.settled(settle, now) }, cancel)
    }

    /// How far the job of that number is.
    pub fn progress(&mut self, number: u64, stage: String, percent: u8) {
        if let Some(job) = self.job.as_mut().filter(|job| job.number == number) {
            (job.stage, job.percent) = (stage, percent);
        }
    }

    pub fn cancel(&self) {
        if let Some(job) = &self.job {
            job.cancel.store(true, Ordering::Relaxed);
        }
    }

    /// The job of that number, which looked at this, ended; false where it is none of this project's (but of one that was here before).
    pub fn finish(&mut self, number: u64, looked: Looked, outcome: Outcome, now: Instant) -> bool {
        let Some(job) = self.job.take_if(|job| job.number == number) else { return false };
        let cancelled = job.cancel.load(Ordering::Relaxed);
        match (job.work, &outcome) {
            (Work::Plan, Outcome::Abandoned) => {
                if !cancelled {
                    // It found the input changed, which is to be seen before it begins again.
                    self.still.restart(now);
                }
                return true;
            }
            (Work::Plan, _) => self.concluded = !job.overtaken,
            (Work::Follow, Outcome::Failed { .. }) => {}
            (Work::Follow, _) if cancelled => {}
            (Work::Follow, _) => self.maps.measured(looked.maps, now - job.started, now),
        }
        if outcome != Outcome::Abandoned {
            self.conclude(job.work, outcome, now);
        }
        true
    }

    fn conclude(&mut self, work: Work, outcome: Outcome, now: Instant) {
        let failures = self.failures + 1;
        (self.failures, self.retry) = (0, None);
        self.result = match outcome {
            Outcome::Planned { clusters, share, note, known, .. } => {
                // What they reach is to be said again, also where the plan stayed the same.
                self.maps.forget_measured();
                self.planned = true;
                match known {
                    Some(known) => return self.conclude(work, *known, now),
                    None => Phase::Planned { clusters, share, note },
                }
            }
            Outcome::Followed { done, clusters, share: Some(share), reached: true, note } => {
                Phase::Reached { done, clusters, share, note }
            }
            Outcome::Followed { done, clusters, share, note, .. } => {
                Phase::Computing { done, clusters, share, unmeasured: 0, note }
            }
            Outcome::Incomplete { reason } => {
                // Depth maps that come meanwhile belong to a plan whose model is gone.
                self.planned = false;
                Phase::Waiting { reason }
            }
            Outcome::Abandoned => return,
            Outcome::Failed { reason, hint } => {
                let pause = retry_after(failures);
                (self.failures, self.retry) = (failures, Some((now + pause, work)));
                Phase::Failed { reason, hint, retry_after_s: pause.as_secs() }
            }
        };
    }

    /// What the last job came to, whether the input has changed since or not.
    pub fn result(&self) -> &Phase {
        &self.result
    }

    /// Is there nothing to be done but to try again what failed?
    pub fn has_failed(&self) -> bool {
        self.concluded && self.retry.is_some()
    }

    /// Forgets what was concluded, so that the input is looked at again.
    pub fn look_again(&mut self) {
        self.concluded = false;
        self.retry = None;
    }
}

fn waiting(stamp: &Stamp) -> Phase {
    let reason = match stamp.trouble() {
        Some(trouble) => trouble,
        None if stamp.is_empty() => "the files of a model (--follow-links: also behind links)".into(),
        None => "its files to be still".into(),
    };
    Phase::Waiting { reason }
}

fn retry_after(failures: u32) -> Duration {
    FIRST_RETRY.saturating_mul(1 << (failures - 1).min(16)).min(LONGEST_RETRY)
}

/// `ROOT/viewrank/status.json`: all projects of a root, for `viewrank status`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Status {
    /// Version of this format.
    pub version: u32,
    /// Process of the daemon that wrote it.
    pub pid: u32,
    /// Host of that process.
    pub host: String,
    /// Sentences that concern the whole root: lost events, folders that can't be read.
    pub notices: Vec<String>,
    /// All projects, by path.
    pub projects: Vec<ProjectStatus>,
}

/// A line of the status.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ProjectStatus {
    /// Relative to the root, `/` between folders; "." for the root itself.
    pub project: String,
    #[serde(flatten)]
    pub phase: Phase,
    /// Seconds since 1970 at which the phase began.
    pub since: u64,
    /// Are its depth maps being measured now?
    #[serde(default, skip_serializing_if = "is_false")]
    pub measuring: bool,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::daemon::settle::Entry;

    const SETTLE: Duration = Duration::from_secs(2);

    fn stamped(bytes: usize) -> (tempfile::TempDir, Stamp) {
        let root = tempfile::tempdir().expect("a temporary folder");
        std::fs::create_dir_all(root.path().join("sparse/0")).expect("a folder");
        std::fs::write(root.path().join("sparse/0/images.bin"), vec![0; bytes]).expect("a file");
        let stamp = Stamp::of(root.path(), false);
        (root, stamp)
    }

    fn planned(text: &str) -> Outcome {
        let fingerprint = serde_json::from_value(text.into()).expect("a string");
        Outcome::Planned { fingerprint, clusters: 3, share: 0.9, note: None, anew: true, known: None }
    }

    fn failed() -> Outcome {
        Outcome::Failed { reason: "disk full".into(), hint: None }
    }

    fn map(length: u64) -> MapFiles {
        MapFiles::from([("map.npy".into(), Entry::of_length(length))])
    }

    /// A project that has been seen.
    fn tracked(stamp: &Stamp, now: Instant) -> Tracked {
        let mut project = Tracked::new("p".into(), now);
        project.observe(stamp.clone(), now, OnBusy::Restart);
        project
    }

    /// A job from beginning to end.
    fn run(project: &mut Tracked, work: Work, outcome: Outcome, now: Instant) {
        let looked = project.start(7, work, SETTLE, now).0;
        assert!(project.finish(7, looked, outcome, now));
    }

    const PLANNED: Phase = Phase::Planned { clusters: 3, share: 0.9, note: None };

    #[test]
    fn a_still_project_is_planned_once() {
        let (_root, stamp) = stamped(5);
        let start = Instant::now();
        let mut project = tracked(&stamp, start);
        assert_eq!(project.due(SETTLE), Some((start + SETTLE, Work::Plan)));
        let looked = project.start(1, Work::Plan, SETTLE, start).0;
        assert_eq!(project.due(SETTLE), None);
        project.progress(1, "surface".into(), 40);
        assert_eq!(project.phase(), Phase::Planning { stage: "surface".into(), percent: 40 });
        project.finish(1, looked, planned("a"), start + SETTLE);
        assert_eq!(project.due(SETTLE), None);
        project.observe(stamp, start + SETTLE * 9, OnBusy::Restart);
        assert_eq!(project.due(SETTLE), None);
        assert_eq!(project.phase(), PLANNED);
    }

    #[test]
    fn a_change_while_planning_cancels_and_plans_again() {
        let ((_root, stamp), (_other, changed)) = (stamped(5), stamped(6));
        let start = Instant::now();
        let mut project = tracked(&stamp, start);
        let (looked, cancel) = project.start(1, Work::Plan, SETTLE, start);
        project.observe(changed, start + SETTLE, OnBusy::Restart);
        assert!(cancel.load(Ordering::Relaxed));
        project.finish(1, looked, Outcome::Abandoned, start + SETTLE);
        assert_eq!(project.due(SETTLE), Some((start + SETTLE * 2, Work::Plan)));
    }

    #[test]
    fn a_job_that_finds_its_input_changed_is_not_begun_again_before_that_is_seen() {
        let (_root, stamp) = stamped(5);
        let start = Instant::now();
        let mut project = tracked(&stamp, start);
        run(&mut project, Work::Plan, Outcome::Abandoned, start + SETTLE);
        assert_eq!(project.due(SETTLE), Some((start + SETTLE * 2, Work::Plan)));
    }

    #[test]
    fn input_that_changes_and_returns_is_looked_at_again() {
        let ((_root, stamp), (_other, changed)) = (stamped(5), stamped(6));
        let start = Instant::now();
        let mut project = tracked(&stamp, start);
        run(&mut project, Work::Plan, planned("a"), start);
        project.observe(changed, start + SETTLE, OnBusy::Restart);
        project.observe(stamp, start + SETTLE * 2, OnBusy::Restart);
        assert_eq!(project.phase(), Phase::Waiting { reason: "its files to be still".into() });
        assert_eq!(project.due(SETTLE), Some((start + SETTLE * 3, Work::Plan)));
        run(&mut project, Work::Plan, planned("a"), start + SETTLE * 3);
        assert_eq!(project.phase(), PLANNED);
    }

    #[test]
    fn input_that_changes_and_returns_while_it_is_planned_is_planned_again() {
        let ((_root, stamp), (_other, changed)) = (stamped(5), stamped(6));
        let start = Instant::now();
        let mut project = tracked(&stamp, start);
        let looked = project.start(1, Work::Plan, SETTLE, start).0;
        project.observe(changed, start, OnBusy::Queue);
        project.observe(stamp, start + SETTLE, OnBusy::Queue);
        project.finish(1, looked, planned("a"), start + SETTLE);
        assert_eq!(project.due(SETTLE), Some((start + SETTLE * 2, Work::Plan)));
    }

    #[test]
    fn maps_that_come_and_go_while_others_are_planned_leave_the_project_planned() {
        let (_root, stamp) = stamped(5);
        let start = Instant::now();
        let mut project = tracked(&stamp, start);
        project.wait_for(Some("for a free job (--jobs)"));
        assert_eq!(project.phase(), Phase::Queued { reason: "for a free job (--jobs)".into() });
        project.wait_for(None);
        run(&mut project, Work::Plan, planned("a"), start);
        project.observe_maps(map(1), start);
        assert_eq!(project.due(SETTLE), Some((start + SETTLE, Work::Follow)));
        project.wait_for(Some("for a free job (--jobs)"));
        assert!(project.is_queued());
        assert_eq!(project.phase(), PLANNED);
        project.observe_maps(MapFiles::new(), start + SETTLE);
        project.wait_for(None);
        run(&mut project, Work::Follow, Outcome::Abandoned, start + SETTLE * 2);
        assert_eq!((project.phase(), project.due(SETTLE)), (PLANNED, None));
    }

    #[test]
    fn the_job_of_a_folder_that_was_here_before_says_nothing_about_this_one() {
        let (_root, stamp) = stamped(5);
        let now = Instant::now();
        let looked = tracked(&stamp, now).start(1, Work::Plan, SETTLE, now).0;
        let mut project = tracked(&stamp, now);
        let own = project.start(2, Work::Plan, SETTLE, now).0;
        project.progress(1, "ranking".into(), 99);
        assert!(!project.finish(1, looked, planned("of the other"), now));
        assert_eq!(project.phase(), Phase::Planning { stage: "read".into(), percent: 0 });
        assert!(project.finish(2, own, Outcome::Incomplete { reason: "images.bin ends at byte 5".into() }, now));
        assert_eq!(project.phase(), Phase::Waiting { reason: "images.bin ends at byte 5".into() });
    }

    #[test]
    fn an_image_that_is_being_written_is_waited_for_and_plans_nothing_by_itself() {
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
    fn with_queue_the_plan_is_finished_and_made_once_more() {
        let ((_root, stamp), (_other, changed)) = (stamped(5), stamped(6));
        let start = Instant::now();
        let mut project = tracked(&stamp, start);
        let (looked, cancel) = project.start(1, Work::Plan, SETTLE, start);
        project.observe(changed, start + SETTLE, OnBusy::Queue);
        assert!(!cancel.load(Ordering::Relaxed));
        project.finish(1, looked, planned("a"), start + SETTLE);
        assert_eq!(project.due(SETTLE), Some((start + SETTLE * 2, Work::Plan)));
    }

    #[test]
    fn maps_that_could_not_be_measured_are_tried_again_and_wait_for_a_model_that_is_whole() {
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
        let looked = project.start(1, Work::Follow, SETTLE, now).0;
        project.cancel();
        project.finish(1, looked, Outcome::Abandoned, now);
        project.observe(changed, now, OnBusy::Restart);
        run(&mut project, Work::Plan, Outcome::Incomplete { reason: "images.bin ends at byte 5".into() }, now);
        assert_eq!(project.due(SETTLE), None);
        project.observe(stamp, now, OnBusy::Restart);
        run(&mut project, Work::Plan, planned("a"), now);
        assert_eq!(project.due(SETTLE), Some((start + SETTLE, Work::Follow)));
    }

    #[test]
    fn maps_that_came_since_the_last_measurement_are_counted() {
        let (_root, stamp) = stamped(5);
        let now = Instant::now();
        let mut project = tracked(&stamp, now);
        run(&mut project, Work::Plan, planned("a"), now);
        project.observe_maps(map(1), now);
        let followed = Outcome::Followed { done: 1, clusters: 3, share: Some(0.5), reached: false, note: None };
        let unmeasured = |project: &Tracked| match project.phase() {
            Phase::Computing { unmeasured, .. } => unmeasured,
            phase => panic!("{phase}"),
        };
        run(&mut project, Work::Follow, followed, now + SETTLE);
        assert_eq!(unmeasured(&project), 0);
        project.observe_maps(map(1).into_iter().chain([("b".into(), Entry::of_length(1))]).collect(), now + SETTLE);
        assert_eq!(unmeasured(&project), 1);
        assert!(project.phase().to_string().ends_with("50 % reached, 1 new file to be measured"));
        project.start(1, Work::Follow, SETTLE, now + SETTLE * 2);
        assert!(project.is_measuring() && unmeasured(&project) == 1);
    }

    #[test]
    fn what_failed_is_tried_again_soon_where_the_maps_changed() {
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
            assert_eq!(project.due(SETTLE), Some((now + SETTLE + FIRST_RETRY, work)));
        }
    }

    #[test]
    fn an_incomplete_model_waits_for_a_change_without_an_error() {
        let (_root, stamp) = stamped(5);
        let start = Instant::now();
        let mut project = tracked(&stamp, start);
        run(&mut project, Work::Plan, Outcome::Incomplete { reason: "images.bin ends at byte 5".into() }, start);
        assert_eq!(project.due(SETTLE), None);
        assert_eq!(project.phase(), Phase::Waiting { reason: "images.bin ends at byte 5".into() });
        project.observe(stamped(7).1, start + SETTLE, OnBusy::Restart);
        assert_eq!(project.due(SETTLE), Some((start + SETTLE * 2, Work::Plan)));
    }

    #[test]
    fn failures_back_off_and_a_success_forgets_them() {
        let (_root, stamp) = stamped(5);
        let now = Instant::now();
        let mut project = tracked(&stamp, now);
        let mut pauses = Vec::new();
        for _ in 0..12 {
            run(&mut project, Work::Plan, failed(), now);
            pauses.push(project.due(SETTLE).expect("a retry").0 - now);
        }
        assert!(project.has_failed());
        assert!(pauses.windows(2).all(|w| w[1] == (w[0] * 2).min(LONGEST_RETRY)));
        run(&mut project, Work::Plan, planned("a"), now);
        assert!(!project.has_failed());
        project.look_again();
        run(&mut project, Work::Plan, failed(), now);
        assert_eq!(project.due(SETTLE), Some((now + FIRST_RETRY, Work::Plan)));
    }
}
