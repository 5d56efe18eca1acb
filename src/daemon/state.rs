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
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "state", rename_all = "lowercase")]
pub enum Phase {
    /// The input isn't complete or not still yet.
    Waiting {
        reason: String,
    },
    /// Complete; waits for a free job or for memory.
    Queued {
        reason: String,
    },
    Planning {
        stage: String,
        percent: u8,
    },
    Planned {
        clusters: usize,
        share: f64,
        /// What should be known about it.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        note: Option<String>,
    },
    /// The backend writes depth maps.
    Computing {
        done: usize,
        clusters: usize,
        /// `None`: the maps are counted, not measured.
        share: Option<f64>,
        #[serde(default, skip_serializing_if = "Option::is_none")]
        note: Option<String>,
    },
    /// The target is reached in reality.
    Reached {
        done: usize,
        clusters: usize,
        share: f64,
    },
    Failed {
        reason: String,
        hint: Option<String>,
        retry_in_s: u64,
    },
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
            Self::Computing { done, clusters, share, note } => {
                write!(f, "computing: {done} of {clusters} depth maps")?;
                share.iter().try_for_each(|share| write!(f, ", {:.0} % reached", share * 100.0))?;
                note.iter().try_for_each(|note| write!(f, "; {note}"))
            }
            Self::Reached { done, share, .. } => write!(f, "reached: {:.0} % with {done} depth maps", share * 100.0),
            Self::Failed { reason, retry_in_s, .. } => write!(f, "failed: {reason} (again in {retry_in_s} s)"),
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
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Work {
    Plan,
    /// Measure the finished depth maps of the plan.
    Follow,
}

/// What a job looked at.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Looked {
    pub work: Work,
    pub input: Stamp,
    /// Depth maps that were written to their end.
    pub maps: MapFiles,
    started: Instant,
}

/// What to do when the input changes while a plan is made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
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
    pub phase: Phase,
    still: Stillness<Stamp>,
    maps: Maps,
    /// The stamp that the last plan came to a conclusion about.
    concluded: Option<Stamp>,
    /// What the plan that is there was made from.
    pub planned: Option<Fingerprint>,
    job: Option<Arc<AtomicBool>>,
    failures: u32,
    retry: Option<(Instant, Work)>,
}

impl Tracked {
    pub fn new(root: PathBuf, stamp: Stamp, now: Instant) -> Self {
        let phase = waiting(&stamp);
        Self {
            root,
            phase,
            still: Stillness::new(stamp, now),
            maps: Maps::default(),
            concluded: None,
            planned: None,
            job: None,
            failures: 0,
            retry: None,
        }
    }

    /// Takes a look at the input. A change makes the project wait, and cancels its job where `on_busy` says so.
    pub fn observe(&mut self, stamp: Stamp, now: Instant, on_busy: OnBusy) {
        if !self.still.observe(stamp, now) {
            return;
        }
        self.retry = None;
        match &self.job {
            Some(cancel) if on_busy == OnBusy::Restart => cancel.store(true, Ordering::Relaxed),
            Some(_) => {}
            None => self.phase = waiting(self.still.stamp()),
        }
    }

    /// An image is being written: the input is not still, though nothing that is looked at changed.
    pub fn disturb(&mut self, now: Instant) {
        self.still.restart(now);
    }

    /// Takes a look at the depth maps.
    pub fn observe_maps(&mut self, maps: MapFiles, now: Instant) {
        self.maps.observe(maps, now);
    }

    /// When this project next wants a job, and which; `None` while one runs or there is nothing to do.
    pub fn due(&self, settle: Duration) -> Option<(Instant, Work)> {
        if self.job.is_some() || self.still.stamp().is_empty() {
            return None;
        }
        if self.concluded.as_ref() != Some(self.still.stamp()) {
            return Some((self.still.settled_at(settle), Work::Plan));
        }
        if self.retry.is_some() {
            return self.retry;
        }
        self.planned.as_ref()?;
        self.maps.due(settle).map(|at| (at, Work::Follow))
    }

    /// The input as last seen.
    pub fn stamp(&self) -> &Stamp {
        self.still.stamp()
    }

    pub fn is_busy(&self) -> bool {
        self.job.is_some()
    }

    /// A job on what was last seen begins; the flag cancels it.
    pub fn start(&mut self, work: Work, settle: Duration, now: Instant) -> (Looked, Arc<AtomicBool>) {
        let cancel = Arc::new(AtomicBool::new(false));
        self.job = Some(cancel.clone());
        if work == Work::Plan {
            self.phase = Phase::Planning { stage: "read".into(), percent: 0 };
        }
        let maps = self.maps.settled(settle, now);
        (Looked { work, input: self.still.stamp().clone(), maps, started: now }, cancel)
    }

    pub fn cancel(&self) {
        if let Some(cancel) = &self.job {
            cancel.store(true, Ordering::Relaxed);
        }
    }

    /// The job that looked at this ended.
    pub fn finish(&mut self, looked: Looked, outcome: Outcome, now: Instant) {
        let work = looked.work;
        let cancelled = self.job.take().is_some_and(|cancel| cancel.load(Ordering::Relaxed));
        match (work, &outcome) {
            (Work::Plan, Outcome::Abandoned) | (Work::Follow, Outcome::Failed { .. }) => {}
            (Work::Plan, _) => self.concluded = Some(looked.input),
            (Work::Follow, _) if cancelled => {}
            (Work::Follow, _) => self.maps.measured(looked.maps, now - looked.started, now),
        }
        if work == Work::Follow && outcome == Outcome::Abandoned {
            return;
        }
        let failures = self.failures + 1;
        (self.failures, self.retry) = (0, None);
        self.phase = match outcome {
            Outcome::Planned { fingerprint, clusters, share, note } => {
                // What they reach is to be said again, also where the plan stayed the same.
                self.maps.forget_measured();
                self.planned = Some(fingerprint);
                Phase::Planned { clusters, share, note }
            }
            Outcome::Followed { done, clusters, share: Some(share), reached: true, .. } => {
                Phase::Reached { done, clusters, share }
            }
            Outcome::Followed { done, clusters, share, note, .. } => Phase::Computing { done, clusters, share, note },
            Outcome::Incomplete { reason } => {
                // Depth maps that come meanwhile belong to a plan whose model is gone.
                self.planned = None;
                Phase::Waiting { reason }
            }
            Outcome::Abandoned => waiting(self.still.stamp()),
            Outcome::Failed { reason, hint } => {
                let pause = retry_after(failures);
                (self.failures, self.retry) = (failures, Some((now + pause, work)));
                Phase::Failed { reason, hint, retry_in_s: pause.as_secs() }
            }
        };
    }

    pub fn has_failed(&self) -> bool {
        self.failures > 0
    }

    /// Forgets what was concluded, so that the input is looked at again.
    pub fn look_again(&mut self) {
        self.concluded = None;
        self.retry = None;
    }
}

fn waiting(stamp: &Stamp) -> Phase {
    let reason = if stamp.is_empty() {
        "the files of a model (--follow-links: also behind links)"
    } else {
        "its files to be still"
    };
    Phase::Waiting { reason: reason.into() }
}

fn retry_after(failures: u32) -> Duration {
    FIRST_RETRY.saturating_mul(1 << (failures - 1).min(16)).min(LONGEST_RETRY)
}

/// `ROOT/viewrank/status.json`: all projects of a root, for `viewrank status`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Status {
    pub version: u32,
    /// Process and host of the daemon that wrote it.
    pub pid: u32,
    pub host: String,
    /// Sentences that concern the whole root: lost events, folders that can't be read.
    pub notices: Vec<String>,
    pub projects: Vec<ProjectStatus>,
}

/// A line of the status.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ProjectStatus {
    /// Relative to the root, `/` between folders; "." for the root itself.
    pub project: String,
    #[serde(flatten)]
    pub phase: Phase,
    /// Seconds since 1970 at which the phase began.
    pub since: u64,
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
        Outcome::Planned { fingerprint, clusters: 3, share: 0.9, note: None }
    }

    #[test]
    fn a_still_project_is_planned_once() {
        let (root, stamp) = stamped(5);
        let start = Instant::now();
        let mut project = Tracked::new(root.path().into(), stamp.clone(), start);
        assert_eq!(project.due(SETTLE), Some((start + SETTLE, Work::Plan)));
        let looked = project.start(Work::Plan, SETTLE, start).0;
        assert_eq!(project.due(SETTLE), None);
        project.finish(looked, planned("a"), start + SETTLE);
        assert_eq!(project.due(SETTLE), None);
        project.observe(stamp, start + SETTLE * 9, OnBusy::Restart);
        assert_eq!(project.due(SETTLE), None);
        assert_eq!(project.phase, Phase::Planned { clusters: 3, share: 0.9, note: None });
    }

    #[test]
    fn a_change_while_planning_cancels_and_plans_again() {
        let ((root, stamp), (_other, changed)) = (stamped(5), stamped(6));
        let start = Instant::now();
        let mut project = Tracked::new(root.path().into(), stamp.clone(), start);
        let (looked, cancel) = project.start(Work::Plan, SETTLE, start);
        project.observe(changed, start + SETTLE, OnBusy::Restart);
        assert!(cancel.load(Ordering::Relaxed));
        project.finish(looked, Outcome::Abandoned, start + SETTLE);
        assert_eq!(project.due(SETTLE), Some((start + SETTLE * 2, Work::Plan)));
    }

    #[test]
    fn an_image_that_is_being_written_is_waited_for_and_plans_nothing_by_itself() {
        let (root, stamp) = stamped(5);
        let start = Instant::now();
        let mut project = Tracked::new(root.path().into(), stamp, start);
        project.disturb(start + SETTLE);
        assert_eq!(project.due(SETTLE), Some((start + SETTLE * 2, Work::Plan)));
        let looked = project.start(Work::Plan, SETTLE, start).0;
        project.finish(looked, planned("a"), start + SETTLE * 2);
        project.disturb(start + SETTLE * 3);
        assert_eq!(project.due(SETTLE), None);
    }

    #[test]
    fn with_queue_the_plan_is_finished_and_made_once_more() {
        let ((root, stamp), (_other, changed)) = (stamped(5), stamped(6));
        let start = Instant::now();
        let mut project = Tracked::new(root.path().into(), stamp.clone(), start);
        let (looked, cancel) = project.start(Work::Plan, SETTLE, start);
        project.observe(changed, start + SETTLE, OnBusy::Queue);
        assert!(!cancel.load(Ordering::Relaxed));
        project.finish(looked, planned("a"), start + SETTLE);
        assert_eq!(project.due(SETTLE), Some((start + SETTLE * 2, Work::Plan)));
    }

    #[test]
    fn maps_that_could_not_be_measured_are_tried_again_and_wait_for_a_model_that_is_whole() {
        let ((root, stamp), (_other, changed)) = (stamped(5), stamped(6));
        let start = Instant::now();
        let mut project = Tracked::new(root.path().into(), stamp.clone(), start);
        let looked = project.start(Work::Plan, SETTLE, start).0;
        project.finish(looked, planned("a"), start);
        let map = root.path().join("map.npy");
        std::fs::write(&map, "").expect("a file");
        let entry = Entry::of(&std::fs::metadata(&map).expect("the file"));
        project.observe_maps(MapFiles::from([(map, entry)]), start);
        let mut now = start + SETTLE;
        for pause in [FIRST_RETRY, FIRST_RETRY * 2] {
            let looked = project.start(Work::Follow, SETTLE, now).0;
            project.finish(looked, Outcome::Failed { reason: "disk full".into(), hint: None }, now);
            assert_eq!(project.due(SETTLE), Some((now + pause, Work::Follow)));
            now += pause;
        }
        let looked = project.start(Work::Follow, SETTLE, now).0;
        project.cancel();
        project.finish(looked, Outcome::Abandoned, now);
        project.observe(changed, now, OnBusy::Restart);
        let looked = project.start(Work::Plan, SETTLE, now).0;
        project.finish(looked, Outcome::Incomplete { reason: "images.bin ends at byte 5".into() }, now);
        assert_eq!(project.due(SETTLE), None);
        project.observe(stamp, now, OnBusy::Restart);
        let looked = project.start(Work::Plan, SETTLE, now).0;
        project.finish(looked, planned("a"), now);
        assert_eq!(project.due(SETTLE), Some((start + SETTLE, Work::Follow)));
    }

    #[test]
    fn an_incomplete_model_waits_for_a_change_without_an_error() {
        let (root, stamp) = stamped(5);
        let start = Instant::now();
        let mut project = Tracked::new(root.path().into(), stamp.clone(), start);
        let looked = project.start(Work::Plan, SETTLE, start).0;
        project.finish(looked, Outcome::Incomplete { reason: "images.bin ends at byte 5".into() }, start);
        assert_eq!(project.due(SETTLE), None);
        assert_eq!(project.phase, Phase::Waiting { reason: "images.bin ends at byte 5".into() });
        project.observe(stamped(7).1, start + SETTLE, OnBusy::Restart);
        assert_eq!(project.due(SETTLE), Some((start + SETTLE * 2, Work::Plan)));
    }

    #[test]
    fn failures_back_off_and_a_success_forgets_them() {
        let (root, stamp) = stamped(5);
        let now = Instant::now();
        let mut project = Tracked::new(root.path().into(), stamp.clone(), now);
        let mut pauses = Vec::new();
        for _ in 0..12 {
            let looked = project.start(Work::Plan, SETTLE, now).0;
            project.finish(looked, Outcome::Failed { reason: "disk full".into(), hint: None }, now);
            pauses.push(project.due(SETTLE).expect("a retry").0 - now);
        }
        assert!(pauses.windows(2).all(|w| w[1] == (w[0] * 2).min(LONGEST_RETRY)));
        let looked = project.start(Work::Plan, SETTLE, now).0;
        project.finish(looked, planned("a"), now);
        project.look_again();
        let looked = project.start(Work::Plan, SETTLE, now).0;
        project.finish(looked, Outcome::Failed { reason: "disk full".into(), hint: None }, now);
        assert_eq!(project.due(SETTLE), Some((now + FIRST_RETRY, Work::Plan)));
    }
}
