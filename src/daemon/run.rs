//! The loop: hints and times in, looks at projects and jobs out.
//!
//! One thread owns all state; jobs run in threads of their own and tell it how they end. Every look at the file system compares
//! stamps, so that a lost, late or doubled hint changes nothing but the time of the look.

use std::{
    collections::{BTreeMap, BTreeSet},
    panic::{AssertUnwindSafe, catch_unwind},
    path::{Path, PathBuf},
    sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel},
    thread::{Scope, scope},
    time::{Duration, Instant},
};

use tracing::{info, warn};

use super::{
    DaemonError, Job, Options, Planner, discover, maps,
    queue::{Full, Queue},
    settle::Stamp,
    state::{Looked, Outcome, Phase, Tracked, Work},
    status::{Holder, StatusFiles},
    watch::{self, Hint, Watches},
};
use crate::output::Disk;

/// Hints that come within this time of each other are one look.
const GATHER: Duration = Duration::from_millis(50);
/// Network file systems are looked at so often when nothing else is said.
const NETWORK_POLL: Duration = Duration::from_secs(10);
/// Of one unit of time, at most this share goes into looking at what was hinted at.
const REST: u32 = 19;
const LONGEST_REST: Duration = Duration::from_secs(2);
/// The loop turns at least so often, for a watchdog's sake.
const LONGEST_SLEEP: Duration = Duration::from_secs(20);
/// A watchdog is told at most so often: its messages wait in a queue that is short.
const WATCHDOG_PAUSE: Duration = Duration::from_secs(10);

/// What the system asks of the daemon.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Signal {
    Stop,
    Rescan,
}

/// How the projects stood at the end.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Summary {
    pub projects: usize,
    pub planned: usize,
    pub failed: usize,
    pub waiting: usize,
}

enum Event {
    Hint(Hint),
    Progress { project: PathBuf, stage: String, percent: u8 },
    Finished { project: PathBuf, looked: Looked, outcome: Outcome },
    Signal(Signal),
}

impl From<Hint> for Event {
    fn from(hint: Hint) -> Self {
        Self::Hint(hint)
    }
}

/// Watches the roots until stopped (or, with [`Options::once`], until nothing is left to plan). `signals` is handed a function
/// that tells the daemon of signals, to be called from any thread.
pub fn watch_roots(
    options: &Options,
    planner: &dyn Planner,
    disk: &Disk,
    signals: impl FnOnce(Box<dyn Fn(Signal) + Send>),
) -> Result<Summary, DaemonError> {
    let (sender, events) = channel();
    let to_loop = sender.clone();
    // The loop may have ended; then nobody waits for signals.
    signals(Box::new(move |signal| _ = to_loop.send(Event::Signal(signal))));
    let found = options
        .roots
        .iter()
        .map(|root| root.canonicalize().map_err(|source| DaemonError::Root { path: root.clone(), source }));
    let mut roots = found.collect::<Result<Vec<_>, _>>()?;
    roots.sort();
    roots.dedup_by(|inner, outer| inner.starts_with(outer));
    let holders = roots.iter().map(|root| Holder::take(root, disk)).collect::<Result<Vec<_>, _>>()?;
    let network = roots.iter().any(|root| watch::is_network(root));
    let poll = options.poll.or(network.then_some(NETWORK_POLL));
    let mut daemon = Daemon {
        options,
        roots,
        planner,
        status: StatusFiles::new(holders, options.metrics.clone()),
        watches: Watches::new(sender.clone(), poll.is_some()),
        poll,
        sender,
        projects: BTreeMap::new(),
        queue: Queue::new(options.jobs, options.max_memory),
        dirty: BTreeSet::new(),
        gather_until: None,
        rest_until: Instant::now(),
        look_at_all: true,
        next_full_look: Instant::now(),
        stopping: false,
    };
    if network && options.poll.is_none() {
        daemon.status.notice("network file system: looking at the folders every 10 s (--poll)".into());
    }
    scope(|threads| daemon.run(threads, &events, disk))
}

struct Daemon<'a> {
    options: &'a Options,
    /// Without symbolic links.
    roots: Vec<PathBuf>,
    planner: &'a dyn Planner,
    status: StatusFiles,
    watches: Watches,
    poll: Option<Duration>,
    sender: Sender<Event>,
    projects: BTreeMap<PathBuf, Tracked>,
    queue: Queue,
    /// Paths that something was hinted about.
    dirty: BTreeSet<PathBuf>,
    gather_until: Option<Instant>,
    /// No look at what was hinted at before this.
    rest_until: Instant,
    look_at_all: bool,
    next_full_look: Instant,
    stopping: bool,
}

impl<'a> Daemon<'a> {
    fn run<'s>(
        &mut self,
        threads: &'s Scope<'s, '_>,
        events: &Receiver<Event>,
        disk: &Disk,
    ) -> Result<Summary, DaemonError>
    where
        'a: 's,
    {
        let mut next_told = None;
        loop {
            let now = Instant::now();
            self.look(now);
            self.start_jobs(threads, now);
            self.status.publish(&self.projects, disk, now, false);
            if next_told.is_none() {
                tell_supervisor(sd_notify::NotifyState::Ready);
            }
            if next_told.is_none_or(|at| now >= at) {
                next_told = Some(now + WATCHDOG_PAUSE);
                tell_supervisor(sd_notify::NotifyState::Watchdog);
            }
            if self.is_done() {
                self.status.publish(&self.projects, disk, now, true);
                return Ok(self.summary());
            }
            match events.recv_timeout(self.sleep(now)) {
                Ok(event) => self.handle(event),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => self.stopping = true,
            }
            while let Ok(event) = events.try_recv() {
                self.handle(event);
            }
        }
    }

    fn handle(&mut self, event: Event) {
        let now = Instant::now();
        match event {
            Event::Hint(Hint::Changed(path)) => self.mark(path, now),
            Event::Hint(Hint::Lost) => {
                self.status.notice("file events were lost; looked at everything".into());
                self.look_at_all = true;
            }
            Event::Progress { project, stage, percent } => {
                let planning = |t: &&mut Tracked| t.is_busy() && matches!(t.phase, Phase::Planning { .. });
                if let Some(tracked) = self.projects.get_mut(&project).filter(planning) {
                    tracked.phase = Phase::Planning { stage, percent };
                }
            }
            Event::Finished { project, looked, outcome } => self.finish(&project, looked, outcome, now),
            Event::Signal(Signal::Stop) => {
                self.stopping = true;
                self.projects.values().for_each(Tracked::cancel);
                tell_supervisor(sd_notify::NotifyState::Stopping);
            }
            Event::Signal(Signal::Rescan) => {
                self.look_at_all = true;
                self.projects.values_mut().for_each(Tracked::look_again);
            }
        }
    }

    fn mark(&mut self, path: PathBuf, now: Instant) {
        self.dirty.insert(path);
        self.gather_until.get_or_insert((now + GATHER).max(self.rest_until));
    }

    fn finish(&mut self, project: &Path, looked: Looked, outcome: Outcome, now: Instant) {
        self.queue.release(project);
        let Some(tracked) = self.projects.get_mut(project) else { return };
        tracked.finish(looked, outcome, now);
        match &tracked.phase {
            Phase::Failed { reason, .. } => warn!(project = %project.display(), %reason, "failed"),
            phase => info!(project = %project.display(), "{phase}"),
        }
        // What changed while the job ran was seen; what changed after its last look may have raised no event yet.
        self.mark(project.into(), now);
    }

    /// Looks at what was hinted at, or at everything when it is time.
    fn look(&mut self, now: Instant) {
        if self.look_at_all || now >= self.next_full_look {
            self.look_at_everything(now);
        } else if self.gather_until.is_some_and(|until| now >= until) {
            self.look_at_hinted(now);
            let ended = Instant::now();
            self.rest_until = ended + ((ended - now) * REST).min(LONGEST_REST);
        }
        while let Some(notice) = self.watches.take_notice() {
            self.status.notice(notice);
        }
        self.next_full_look = self.next_full_look.min(now + self.pause());
    }

    /// Between two looks at everything.
    fn pause(&self) -> Duration {
        match self.poll {
            Some(poll) => poll,
            // No event tells of a root that comes back.
            None if self.watches.exhausted() || self.roots.iter().any(|root| !root.is_dir()) => {
                NETWORK_POLL.min(self.options.rescan)
            }
            None => self.options.rescan,
        }
    }

    fn look_at_everything(&mut self, now: Instant) {
        self.look_at_all = false;
        self.dirty.clear();
        self.gather_until = None;
        self.watches.forget_missing();
        for root in self.roots.clone() {
            self.search(&root, now);
        }
        let known: Vec<_> = self.projects.keys().cloned().collect();
        known.iter().for_each(|project| self.look_at_project(project, now));
        self.next_full_look = now + self.pause();
    }

    fn look_at_hinted(&mut self, now: Instant) {
        self.gather_until = None;
        let (mut projects, mut folders) = (BTreeSet::new(), BTreeSet::new());
        for path in std::mem::take(&mut self.dirty) {
            let Some(project) = path.ancestors().find(|above| self.projects.contains_key(*above)) else {
                folders.extend(self.folder_to_search(&path));
                continue;
            };
            if path.starts_with(project.join("images"))
                && let Some(tracked) = self.projects.get_mut(project)
            {
                tracked.disturb(now);
            }
            projects.insert(project.to_path_buf());
        }
        projects.iter().for_each(|project| self.look_at_project(project, now));
        folders.iter().for_each(|folder| self.search(folder, now));
    }

    /// Where a change at a path outside projects may have made one: a folder above that looks like a project now (what came
    /// is its `sparse`), else the nearest folder that is there.
    fn folder_to_search(&self, path: &Path) -> Option<PathBuf> {
        let root = self.roots.iter().find(|root| path.starts_with(root))?;
        let inside = path.strip_prefix(root).ok()?;
        if inside.components().any(|part| part.as_os_str() == discover::OUTPUT_FOLDER) {
            return None;
        }
        let folders = || path.ancestors().take_while(|above| above.starts_with(root)).filter(|above| above.is_dir());
        let project = folders().find(|folder| discover::is_project(folder, self.options.follow_links));
        project.or_else(|| folders().next()).map(Path::to_path_buf)
    }

    /// Searches a folder outside projects for projects, and watches the folders in which one may appear.
    fn search(&mut self, folder: &Path, now: Instant) {
        let found = discover::walk(folder, self.options.follow_links);
        let mut new_watches = false;
        for inner in found.folders {
            new_watches |= self.watches.update(&inner.clone(), vec![inner]);
        }
        if new_watches {
            // Something may have come between the look and the watch.
            self.mark(folder.into(), now);
        }
        for (folder, reason) in found.unreadable {
            self.status.notice(format!("cannot look into {}: {reason}", folder.display()));
        }
        for project in found.projects {
            if !self.projects.contains_key(&project) {
                info!(project = %project.display(), "found");
                self.forget_inside(&project, now);
                let named = self.planner.named_files(&project);
                self.watches.update(&project, self.folders_of(&project, &named));
                let stamp = Stamp::of(&project, self.options.follow_links).with(&named);
                let tracked = Tracked::new(project.clone(), stamp, now);
                self.projects.insert(project.clone(), tracked);
                // It may have been written to between the look and the watch.
                self.mark(project, now);
            }
        }
    }

    /// What was taken for projects before the project around them was there is a part of it.
    fn forget_inside(&mut self, project: &Path, now: Instant) {
        let inside = self.projects.keys().filter(|inner| inner.starts_with(project));
        inside.cloned().collect::<Vec<_>>().iter().for_each(|inner| self.forget(inner, now));
    }

    /// Folders whose changes concern the project; `named` are the files that it depends on beside model and images.
    fn folders_of(&self, project: &Path, named: &[PathBuf]) -> Vec<PathBuf> {
        let mut folders = discover::input_folders(project, self.options.follow_links);
        folders.extend(maps::watched_folders(project, self.options.follow_links));
        let named = named.iter().filter_map(|file| file.parent().map(Path::to_path_buf));
        let own = project.join(discover::OUTPUT_FOLDER);
        folders.extend(named.filter(|folder| folder.starts_with(project) && !folder.starts_with(&own)));
        folders.sort();
        folders.dedup();
        folders
    }

    fn look_at_project(&mut self, project: &Path, now: Instant) {
        if !discover::is_project(project, self.options.follow_links) {
            self.forget(project, now);
            return;
        }
        let named = self.planner.named_files(project);
        let new_watches = self.watches.update(project, self.folders_of(project, &named));
        let Options { on_busy, follow_links, .. } = *self.options;
        let stamp = Stamp::of(project, follow_links).with(&named);
        if let Some(tracked) = self.projects.get_mut(project) {
            tracked.observe(stamp, now, on_busy);
            tracked.observe_maps(maps::map_files(project, follow_links), now);
            let at_rest = !tracked.is_busy() && !tracked.has_failed();
            if at_rest && tracked.planned.is_some() && !self.planner.has_plan(project) {
                tracked.look_again();
            }
        }
        if new_watches {
            self.mark(project.into(), now);
        }
    }

    /// The project is gone, or no project any more: its job ends, and its place is searched again.
    fn forget(&mut self, project: &Path, now: Instant) {
        info!(project = %project.display(), "gone");
        if let Some(tracked) = self.projects.remove(project) {
            tracked.cancel();
        }
        self.watches.update(project, Vec::new());
        self.planner.forget(project);
        if let Some(above) = project.parent().filter(|_| !self.roots.iter().any(|root| root == project)) {
            self.mark(above.into(), now);
        }
    }

    fn start_jobs<'s>(&mut self, threads: &'s Scope<'s, '_>, now: Instant)
    where
        'a: 's,
    {
        if self.stopping {
            return;
        }
        let due = |t: &Tracked| t.due(self.options.settle).filter(|(at, _)| *at <= now);
        let waiting = self.projects.values().filter_map(|t| due(t).map(|(at, work)| (at, t.root.clone(), work)));
        let mut waiting: Vec<_> = waiting.collect();
        waiting.sort_by(|a, b| (a.0, &a.1).cmp(&(b.0, &b.1)));
        self.queue.call_up();
        for (_, project, work) in waiting {
            self.start_job(threads, &project, work, now);
        }
    }

    fn start_job<'s>(&mut self, threads: &'s Scope<'s, '_>, project: &Path, work: Work, now: Instant)
    where
        'a: 's,
    {
        let Some(tracked) = self.projects.get_mut(project) else { return };
        let Options { on_busy, follow_links, .. } = *self.options;
        match self.queue.admit(project, self.planner.need(tracked.stamp())) {
            Ok(()) => {}
            Err(Full::Jobs) => return tracked.phase = Phase::Queued { reason: "for a free job (--jobs)".into() },
            Err(Full::Memory) => return tracked.phase = Phase::Queued { reason: "for memory (--max-memory)".into() },
            Err(Full::Never { need, max }) => {
                let mib = |bytes: u64| bytes.div_ceil(1 << 20);
                let reason = format!("needs about {} MiB, --max-memory allows {}", mib(need), mib(max));
                let hint = Some("raise --max-memory, or plan it by itself with `viewrank plan`".into());
                let (looked, _) = tracked.start(work, self.options.settle, now);
                return self.finish(project, looked, Outcome::Failed { reason, hint }, now);
            }
        }
        if work == Work::Plan {
            info!(project = %project.display(), "planning");
        }
        let (looked, cancel) = tracked.start(work, self.options.settle, now);
        let (planner, sender, project) = (self.planner, self.sender.clone(), project.to_path_buf());
        let named = planner.named_files(&project);
        threads.spawn(move || {
            let progress = |stage: &str, percent| {
                let event = Event::Progress { project: project.clone(), stage: stage.into(), percent };
                // Progress that nobody reads any more is no loss.
                _ = sender.send(event);
            };
            let job = Job {
                project: &project,
                stamp: &looked.input,
                named: &named,
                on_busy,
                follow_links,
                maps: &looked.maps,
                cancel: &cancel,
                progress: &progress,
            };
            let act = || match work {
                Work::Plan => planner.plan(&job),
                Work::Follow => planner.follow(&job),
            };
            let outcome = catch_unwind(AssertUnwindSafe(act)).unwrap_or_else(|_| Outcome::Failed {
                reason: "an internal error; see the log".into(),
                hint: Some("run `viewrank plan` on it and report what it prints".into()),
            });
            _ = sender.send(Event::Finished { project: project.clone(), looked, outcome });
        });
    }

    /// How long there is nothing to do.
    fn sleep(&self, now: Instant) -> Duration {
        let due = self.projects.values().filter(|t| !matches!(t.phase, Phase::Queued { .. }));
        let due = due.filter_map(|t| t.due(self.options.settle)).map(|(at, _)| at).min();
        let times = [Some(self.next_full_look), self.gather_until, due, self.status.due()];
        let next = times.into_iter().flatten().min();
        next.map_or(LONGEST_SLEEP, |at| at.saturating_duration_since(now).min(LONGEST_SLEEP))
    }

    fn is_done(&self) -> bool {
        let nothing_due = || self.projects.values().all(|t| t.due(self.options.settle).is_none() || t.has_failed());
        let quiet = self.dirty.is_empty() && !self.look_at_all;
        self.queue.is_idle() && (self.stopping || self.options.once && quiet && nothing_due())
    }

    fn summary(&self) -> Summary {
        let count = |wanted: fn(&Phase) -> bool| self.projects.values().filter(|t| wanted(&t.phase)).count();
        let planned = |p: &Phase| matches!(p, Phase::Planned { .. } | Phase::Computing { .. } | Phase::Reached { .. });
        Summary {
            projects: self.projects.len(),
            planned: count(planned),
            failed: count(|p| matches!(p, Phase::Failed { .. })),
            waiting: count(|p| matches!(p, Phase::Waiting { .. })),
        }
    }
}

/// Tells systemd, where it asked to be told.
fn tell_supervisor(state: sd_notify::NotifyState) {
    // Without a supervisor there is nobody to tell.
    let _ = sd_notify::notify(&[state]);
}
