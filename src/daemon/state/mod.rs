//! State machine of one project, without access to files or a clock.

use std::{
    path::PathBuf,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use serde::{Deserialize, Serialize};

use super::{
    maps::{MapFiles, MapTracker},
    phase::Phase,
    settle::{Fingerprint, Stamp, Stillness},
};

/// Pause after the first failure; each further failure doubles it.
const FIRST_RETRY: Duration = Duration::from_secs(10);
/// Longest pause after a failure.
const LONGEST_RETRY: Duration = Duration::from_secs(3600);

/// Result of a job.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Outcome {
    /// A new plan was written, or the existing one is current.
    Planned {
        fingerprint: Fingerprint,
        backend: String,
        clusters: usize,
        share: f64,
        has_region: bool,
        /// There is no export for a backend that the settings name.
        lacks_export: bool,
        note: Option<String>,
        /// The plan is new.
        anew: bool,
        /// The last measurement, where the plan is unchanged.
        known: Option<Box<Outcome>>,
    },
    /// The finished depth maps were measured or counted, with this result.
    Followed(Phase),
    /// The model doesn't parse, or its files contradict each other: it isn't complete yet.
    Incomplete { reason: String },
    /// Nothing was written, because the input changed or the job was cancelled.
    Abandoned,
    Failed {
        reason: String,
        hint: Option<String>,
    },
    /// Planning the input takes more memory than is allowed, or has ended its process: it does so
    /// again as long as the input is the same, after the other jobs had to wait for it.
    Aside {
        reason: String,
        hint: Option<String>,
    },
}

/// Kind of a job.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum Work {
    Plan,
    /// Measure the finished depth maps of the plan.
    Follow,
}

/// Input and depth maps that a job works on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct JobInput {
    pub stamp: Stamp,
    /// Completely written depth maps.
    pub maps: MapFiles,
}

/// Reaction to input that changes during planning.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum OnBusy {
    /// Cancel the plan and start again when the input is still.
    #[default]
    Restart,
    /// Finish the plan, then plan once more.
    Queue,
}

/// A project that the daemon tracks.
#[derive(Debug)]
pub struct TrackedProject {
    pub root: PathBuf,
    /// Result of the last job; shown while `concluded`.
    result: Phase,
    still: Stillness<Stamp>,
    maps: MapTracker,
    /// The result applies to the current input.
    concluded: bool,
    /// There is a plan for which depth maps may appear.
    planned: bool,
    /// Backend of the last plan.
    backend: String,
    job: Option<RunningJob>,
    /// The reason why a job that is due can't start.
    queued: Option<&'static str>,
    failures: u32,
    retry: Option<(Instant, Work)>,
}

/// A running job.
#[derive(Debug)]
struct RunningJob {
    number: u64,
    work: Work,
    started: Instant,
    cancel: Arc<AtomicBool>,
    /// The input changed since the job started.
    overtaken: bool,
    stage: String,
    percent: u8,
}

impl TrackedProject {
    /// A project that hasn't been scanned yet.
    pub fn new(root: PathBuf, now: Instant) -> Self {
        Self {
            root,
            result: waiting(&Stamp::default()),
            still: Stillness::new(Stamp::default(), now),
            maps: MapTracker::default(),
            concluded: false,
            planned: false,
            backend: String::new(),
            job: None,
            queued: None,
            failures: 0,
            retry: None,
        }
    }

    /// Current phase to show.
    pub fn phase(&self) -> Phase {
        match (&self.job, self.queued) {
            (
                Some(RunningJob {
                    work: Work::Plan,
                    stage,
                    percent,
                    ..
                }),
                _,
            ) => Phase::Planning {
                stage: stage.clone(),
                percent: *percent,
            },
            // Depth maps still to be measured leave the last result valid.
            _ if self.concluded => match self.result.clone() {
                Phase::Partial {
                    backend,
                    done,
                    clusters,
                    share,
                    has_region,
                    note,
                    ..
                } => Phase::Partial {
                    backend,
                    done,
                    clusters,
                    share,
                    unmeasured: self.maps.unmeasured(),
                    has_region,
                    note,
                },
                result => result,
            },
            (_, Some(reason)) => Phase::Queued {
                reason: reason.into(),
            },
            _ => waiting(self.still.stamp()),
        }
    }

    /// Takes a new stamp of the input; if it differs, the input has been still since `since`. A
    /// change makes the project wait, and cancels its job with [`OnBusy::Restart`].
    pub fn observe(&mut self, stamp: Stamp, since: Instant, on_busy: OnBusy) {
        if !self.still.observe(stamp, since) {
            return;
        }
        self.recheck();
        if let Some(job) = &mut self.job {
            job.overtaken = true;
            if on_busy == OnBusy::Restart {
                job.cancel.store(true, Ordering::Relaxed);
            }
        }
    }

    /// Marks the input as not still at `then`: an image was being written, which the stamp doesn't
    /// show.
    pub fn disturb(&mut self, then: Instant) {
        self.still.restart(then);
    }

    /// Takes a new list of depth maps. If they changed, a failed job is retried soon, because they
    /// may have been the cause.
    pub fn observe_maps(&mut self, maps: MapFiles, now: Instant) {
        if self.maps.observe(maps, now)
            && let Some((at, _)) = &mut self.retry
        {
            *at = (*at).min(now + FIRST_RETRY);
        }
    }

    /// Returns the next job and when it is due; `None` while one runs or there is no job.
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

    /// True while its depth maps are measured.
    pub fn is_measuring(&self) -> bool {
        self.job
            .as_ref()
            .is_some_and(|job| job.work == Work::Follow)
    }

    /// The input as last scanned.
    pub fn stamp(&self) -> &Stamp {
        self.still.stamp()
    }

    /// Sets the reason why a job that is due can't start; `None` clears it.
    pub fn wait_for(&mut self, reason: Option<&'static str>) {
        self.queued = reason;
    }

    /// True if a job that is due waits until others have ended.
    pub fn is_queued(&self) -> bool {
        self.queued.is_some()
    }

    /// True if there is a plan, no job runs and none has failed.
    pub fn is_at_rest(&self) -> bool {
        self.planned && self.job.is_none() && !self.has_failed()
    }

    /// Starts a job on the last scanned input; setting the returned flag cancels it.
    pub fn start(
        &mut self,
        number: u64,
        work: Work,
        settle: Duration,
        now: Instant,
    ) -> (JobInput, Arc<AtomicBool>) {
        let cancel = Arc::new(AtomicBool::new(false));
        let stage = "read".into();
        self.job = Some(RunningJob {
            number,
            work,
            started: now,
            cancel: cancel.clone(),
            overtaken: false,
            stage,
            percent: 0,
        });
        (
            JobInput {
                stamp: self.still.stamp().clone(),
                maps: self.maps.settled(settle, now),
            },
            cancel,
        )
    }

    /// Records the progress of the job with this number.
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

    /// Ends the job with this number. False if the job is not this project's, but of an earlier
    /// project at this path.
    pub fn finish(&mut self, number: u64, input: JobInput, outcome: Outcome, now: Instant) -> bool {
        let Some(job) = self.job.take_if(|job| job.number == number) else {
            return false;
        };
        let cancelled = job.cancel.load(Ordering::Relaxed);
        match (job.work, &outcome) {
            (Work::Plan, Outcome::Abandoned) => {
                if !cancelled {
                    // The job saw a change that the next scan must see before the job starts again.
                    self.still.restart(now);
                }
                return true;
            }
            (Work::Plan, _) => self.concluded = !job.overtaken,
            // Nothing is recorded, so that the maps stay due.
            (Work::Follow, Outcome::Failed { .. } | Outcome::Aside { .. }) => {}
            (Work::Follow, _) if cancelled => {}
            (Work::Follow, _) => self
                .maps
                .record_measured(input.maps, now - job.started, now),
        }
        if outcome != Outcome::Abandoned {
            self.conclude(job.work, outcome, [job.started, now]);
        }
        true
    }

    /// `times`: start of the job, and now.
    fn conclude(&mut self, work: Work, outcome: Outcome, times: [Instant; 2]) {
        let [started, now] = times;
        // Counted for a failure alone: any other outcome starts again from 0.
        let failures = self.failures + 1;
        (self.failures, self.retry) = (0, None);
        let result = match outcome {
            Outcome::Planned {
                backend,
                clusters,
                share,
                has_region,
                lacks_export,
                note,
                known,
                ..
            } => {
                // Measure again even where the plan is unchanged.
                self.maps.forget_measured();
                self.planned = true;
                self.backend.clone_from(&backend);
                match known {
                    Some(known) => return self.conclude(work, *known, times),
                    None => Phase::Planned {
                        backend,
                        clusters,
                        share,
                        has_region,
                        lacks_export,
                        note,
                    },
                }
            }
            Outcome::Followed(phase) => phase.of_plan_for(&self.backend),
            Outcome::Incomplete { reason } => {
                // New depth maps would belong to a plan whose model is gone.
                self.planned = false;
                Phase::Waiting { reason }
            }
            Outcome::Abandoned => return,
            Outcome::Failed { reason, hint } => {
                self.failures = failures;
                self.fail(reason, hint, retry_after(failures), (now, work))
            }
            Outcome::Aside { reason, hint } => {
                // A job that takes hours must not keep the others waiting most of the time.
                let pause = LONGEST_RETRY.max(8 * (now - started));
                self.fail(reason, hint, pause, (now, work))
            }
        };
        self.result = result.shortened();
    }

    /// Plans a retry after a pause.
    fn fail(
        &mut self,
        reason: String,
        hint: Option<String>,
        pause: Duration,
        (now, work): (Instant, Work),
    ) -> Phase {
        self.retry = Some((now + pause, work));
        Phase::Failed {
            reason,
            hint,
            retry_after_s: pause.as_secs(),
        }
    }

    /// Result of the last job, even if the input has changed since.
    pub fn result(&self) -> &Phase {
        &self.result
    }

    /// True if the only thing left to do is to retry a failed job.
    pub fn has_failed(&self) -> bool {
        self.concluded && self.retry.is_some()
    }

    /// Drops the result, so that the input is checked again.
    pub fn recheck(&mut self) {
        self.concluded = false;
        self.retry = None;
    }
}

fn waiting(stamp: &Stamp) -> Phase {
    let reason = match stamp.read_error() {
        Some(error) => error,
        None if stamp.is_empty() => {
            "model files (add --follow-links for those behind links)".into()
        }
        None => "files to stop changing".into(),
    };
    Phase::Waiting { reason }
}

fn retry_after(failures: u32) -> Duration {
    FIRST_RETRY
        // The shift must stay below 32; the longest pause is reached long before.
        .saturating_mul(1 << (failures - 1).min(16))
        .min(LONGEST_RETRY)
}

#[cfg(test)]
mod tests;
