//! Main loop: takes events and deadlines, scans projects and starts jobs.
//!
//! One thread owns all state; each job runs in a thread of its own and sends its outcome. Every
//! scan compares stamps, so that a lost, late or duplicate event only changes when the scan
//! happens.

use std::{
    cell::Cell,
    collections::BTreeMap,
    path::{Path, PathBuf},
    sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel},
    thread::{Scope, scope},
    time::{Duration, Instant},
};

use tracing::{info, warn};

use super::{
    DaemonError, Job, Planner, WatchOptions,
    phase::Phase,
    planner::outcome_of,
    platform::{self, Life, notify_supervisor},
    queue::{Full, JobQueue},
    state::{JobInput, Outcome, TrackedProject, Work},
    status::{Holder, StatusFiles},
    watch::{Change, Watches},
};
use crate::io::output::Disk;

mod scan;

use scan::Scans;

/// Default scan interval on network file systems.
const NETWORK_POLL: Duration = Duration::from_secs(10);
/// Longest wait of the loop, for the watchdog's sake.
const LONGEST_SLEEP: Duration = Duration::from_secs(20);
/// Shortest time between two messages to the watchdog, whose queue is short.
const WATCHDOG_PAUSE: Duration = Duration::from_secs(10);

/// Request to the daemon.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Signal {
    Stop,
    Rescan,
}

/// Number of projects by state when the daemon ended.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct WatchSummary {
    pub projects: usize,
    pub planned: usize,
    pub failed: usize,
    pub waiting: usize,
}

enum Event {
    Change(Change),
    Progress {
        project: PathBuf,
        job: u64,
        stage: String,
        percent: u8,
    },
    Finished {
        project: PathBuf,
        job: u64,
        input: JobInput,
        outcome: Outcome,
    },
    Signal(Signal),
}

impl From<Change> for Event {
    fn from(change: Change) -> Self {
        Self::Change(change)
    }
}

/// The supervisor of this process, such as systemd.
struct Supervisor {
    next: Cell<Instant>,
}

impl Supervisor {
    fn new() -> Self {
        Self {
            next: Cell::new(Instant::now()),
        }
    }

    /// Notifies the supervisor, at most every [`WATCHDOG_PAUSE`], that the loop is alive.
    fn alive(&self) {
        let now = Instant::now();
        if now >= self.next.get() {
            self.next.set(now + WATCHDOG_PAUSE);
            notify_supervisor(Life::Alive);
        }
    }
}

/// Watches the roots until stopped or, with [`WatchOptions::once`], until nothing is left to plan.
/// `signals` receives a function that sends signals to the daemon from any thread.
///
/// # Errors
/// Roots that can't be read, written or locked, and metrics that can't be written.
pub fn watch_roots(
    options: &WatchOptions,
    planner: &dyn Planner,
    disk: &Disk,
    signals: impl FnOnce(Box<dyn Fn(Signal) + Send>),
) -> Result<WatchSummary, DaemonError> {
    // First of all, so that signals wait in the channel from the start.
    let (sender, events) = channel();
    let to_loop = sender.clone();
    // Fails once the loop has ended.
    signals(Box::new(move |signal| {
        _ = to_loop.send(Event::Signal(signal))
    }));
    let found = options.roots.iter().map(|root| {
        dunce::canonicalize(root).map_err(|source| DaemonError::Root {
            path: root.clone(),
            source,
        })
    });
    let mut roots = found.collect::<Result<Vec<_>, _>>()?;
    // Sorted, a folder comes before those in it, which it already covers.
    roots.sort();
    roots.dedup_by(|inner, outer| inner.starts_with(outer));
    let holders = roots
        .iter()
        .map(|root| Holder::take(root, disk))
        .collect::<Result<Vec<_>, _>>()?;
    let network = roots.iter().any(|root| platform::is_network(root));
    let poll = options.poll.or(network.then_some(NETWORK_POLL));
    let mut daemon = Daemon {
        options,
        roots,
        planner,
        status: StatusFiles::new(holders, options.metrics.clone(), disk)?,
        watches: Watches::new(sender.clone()),
        supervisor: Supervisor::new(),
        is_on_network: network && options.poll.is_none(),
        poll,
        sender,
        next_job: 0,
        projects: BTreeMap::new(),
        queue: JobQueue::new(options.jobs, options.max_memory),
        scans: Scans::new(Instant::now()),
        stopping: false,
    };
    for root in &daemon.roots {
        match daemon.poll {
            Some(poll) => {
                info!(root = %root.display(), "watching, with a scan every {} s", poll.as_secs_f64())
            }
            None => info!(root = %root.display(), "watching for file events"),
        }
    }
    // Scoped, so that no job outlives the locks of the roots.
    scope(|threads| daemon.run(threads, &events, disk))
}

struct Daemon<'a> {
    options: &'a WatchOptions,
    /// Canonical paths.
    roots: Vec<PathBuf>,
    planner: &'a dyn Planner,
    status: StatusFiles,
    watches: Watches<Event>,
    supervisor: Supervisor,
    /// Polling was chosen because a root is on a network file system.
    is_on_network: bool,
    poll: Option<Duration>,
    sender: Sender<Event>,
    next_job: u64,
    projects: BTreeMap<PathBuf, TrackedProject>,
    queue: JobQueue,
    scans: Scans,
    stopping: bool,
}

impl<'a> Daemon<'a> {
    fn run<'s>(
        &mut self,
        threads: &'s Scope<'s, '_>,
        events: &Receiver<Event>,
        disk: &Disk,
    ) -> Result<WatchSummary, DaemonError>
    where
        'a: 's,
    {
        // Before the first scan, which may take longer than a supervisor waits.
        notify_supervisor(Life::Ready);
        loop {
            self.supervisor.alive();
            let now = Instant::now();
            self.scan(now);
            self.start_jobs(threads, now);
            self.status.publish(&self.projects, disk, now, false);
            if self.is_done() {
                self.status.publish(&self.projects, disk, now, true);
                return Ok(self.summary());
            }
            match events.recv_timeout(self.sleep(now)) {
                Ok(event) => self.handle(event),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => self.stopping = true,
            }
            // All events that are here by now share the next scan.
            while let Ok(event) = events.try_recv() {
                self.handle(event);
            }
        }
    }

    fn handle(&mut self, event: Event) {
        let now = Instant::now();
        match event {
            Event::Change(change) => self.note_change(change, now),
            Event::Progress {
                project,
                job,
                stage,
                percent,
            } => {
                if let Some(tracked) = self.projects.get_mut(&project) {
                    tracked.progress(job, stage, percent);
                }
            }
            Event::Finished {
                project,
                job,
                input,
                outcome,
            } => self.finish(&project, job, input, outcome, now),
            Event::Signal(Signal::Stop) => {
                // The loop goes on until the cancelled jobs have ended.
                self.stopping = true;
                self.projects.values().for_each(TrackedProject::cancel);
                notify_supervisor(Life::Stopping);
            }
            Event::Signal(Signal::Rescan) => {
                self.scans.add_everything();
                self.projects.values_mut().for_each(TrackedProject::recheck);
            }
        }
    }

    fn finish(
        &mut self,
        project: &Path,
        job: u64,
        input: JobInput,
        outcome: Outcome,
        now: Instant,
    ) {
        self.queue.release(job);
        let Some(tracked) = self.projects.get_mut(project) else {
            // The project is gone: drop what its job cached.
            return self.planner.forget(project);
        };
        let abandoned = outcome == Outcome::Abandoned;
        let (is_unchanged, before) = (
            matches!(outcome, Outcome::Planned { anew: false, .. }),
            tracked.result().clone(),
        );
        if !tracked.finish(job, input, outcome, now) {
            return;
        }
        match tracked.result() {
            _ if abandoned => {}
            // A restart would log each of the plans that it finds current.
            same if is_unchanged && *same == before => {}
            Phase::Failed { reason, .. } => warn!(project = %project.display(), %reason, "failed"),
            phase => info!(project = %project.display(), "{phase}"),
        }
        // Changes after the job's last scan may have raised no event yet.
        self.scans.add_project(project.into(), now);
    }

    fn start_jobs<'s>(&mut self, threads: &'s Scope<'s, '_>, now: Instant)
    where
        'a: 's,
    {
        if self.stopping {
            return;
        }
        self.projects
            .values_mut()
            .for_each(|tracked| tracked.wait_for(None));
        let due = |t: &TrackedProject| t.due(self.options.settle).filter(|(at, _)| *at <= now);
        let waiting = self
            .projects
            .values()
            .filter_map(|t| due(t).map(|(at, work)| (at, t.root.clone(), work)));
        let mut waiting: Vec<_> = waiting.collect();
        // Plans before measurements, because backends wait for plans.
        waiting.sort_by(|a, b| (a.2, a.0, &a.1).cmp(&(b.2, b.0, &b.1)));
        self.queue.begin_round();
        for (_, project, work) in waiting {
            self.start_job(threads, &project, work, now);
        }
    }

    fn start_job<'s>(
        &mut self,
        threads: &'s Scope<'s, '_>,
        project: &Path,
        work: Work,
        now: Instant,
    ) where
        'a: 's,
    {
        let WatchOptions {
            on_busy,
            follow_links,
            settle,
            max_memory,
            ..
        } = *self.options;
        let Some(number) = self.admit(project) else {
            return;
        };
        let Some(tracked) = self.projects.get_mut(project) else {
            return;
        };
        let (input, cancel) = tracked.start(number, work, settle, now);
        let (planner, sender, project) = (self.planner, self.sender.clone(), project.to_path_buf());
        let named = planner.named_files(&project);
        threads.spawn(move || {
            let progress = |stage: &str, percent| {
                let event = Event::Progress {
                    project: project.clone(),
                    job: number,
                    stage: stage.into(),
                    percent,
                };
                // Fails once the loop has ended.
                _ = sender.send(event);
            };
            let job = Job {
                project: &project,
                stamp: &input.stamp,
                named: &named,
                on_busy,
                follow_links,
                maps: &input.maps,
                most_memory: Some(max_memory),
                cancel: &cancel,
                progress: &progress,
            };
            let outcome = outcome_of(planner, work, &job);
            _ = sender.send(Event::Finished {
                project: project.clone(),
                job: number,
                input,
                outcome,
            });
        });
    }

    /// Returns the number of a new job; `None` if it has to wait.
    fn admit(&mut self, project: &Path) -> Option<u64> {
        let tracked = self.projects.get_mut(project)?;
        self.next_job += 1;
        let number = self.next_job;
        match self.queue.admit(number, self.planner.need(tracked.stamp())) {
            Ok(()) => return Some(number),
            Err(Full::Jobs) => tracked.wait_for(Some("a free job slot (--jobs)")),
            Err(Full::Memory) => tracked.wait_for(Some("memory (--max-memory)")),
        }
        None
    }

    /// Time until there is something to do.
    fn sleep(&self, now: Instant) -> Duration {
        let due = self
            .projects
            .values()
            // What waits for a slot or for memory has been due for a while, and would keep the loop
            // from sleeping; the end of another job wakes it.
            .filter(|tracked| !tracked.is_queued());
        let due = due
            .filter_map(|t| t.due(self.options.settle))
            .map(|(at, _)| at)
            .min();
        let times = [Some(self.scans.due()), due, self.status.due()];
        let next = times.into_iter().flatten().min();
        next.map_or(LONGEST_SLEEP, |at| {
            at.saturating_duration_since(now).min(LONGEST_SLEEP)
        })
    }

    fn is_done(&self) -> bool {
        let nothing_due = || {
            self.projects
                .values()
                .all(|t| t.due(self.options.settle).is_none() || t.has_failed())
        };
        self.queue.is_idle()
            && (self.stopping || self.options.once && self.scans.is_empty() && nothing_due())
    }

    fn summary(&self) -> WatchSummary {
        let count = |wanted: fn(&Phase) -> bool| {
            self.projects
                .values()
                .filter(|t| wanted(&t.phase()))
                .count()
        };
        let has_failed = |p: &Phase| match p {
            Phase::Planned { lacks_export, .. } => *lacks_export,
            Phase::Failed { .. } => true,
            _ => false,
        };
        let planned = |p: &Phase| {
            matches!(
                p,
                Phase::Planned { .. } | Phase::Partial { .. } | Phase::Reached { .. }
            )
        };
        WatchSummary {
            projects: self.projects.len(),
            planned: count(planned),
            failed: count(has_failed),
            waiting: count(|p| matches!(p, Phase::Waiting { .. })),
        }
    }
}
