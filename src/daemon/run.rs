//! The loop: changes and times in, looks at projects and jobs out.
//!
//! One thread owns all state; jobs run in threads of their own and tell it how they end. Every look at the file system compares
//! stamps, so that a lost, late or doubled event changes nothing but the time of the look.

use std::{
    cell::Cell,
    collections::{BTreeMap, BTreeSet},
    panic::{AssertUnwindSafe, catch_unwind},
    path::{Path, PathBuf},
    sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel},
    thread::{Scope, scope},
    time::{Duration, Instant, SystemTime},
};

use sd_notify::NotifyState;
use tracing::{info, warn};

use super::{
    DaemonError, Job, Options, Planner, Shown,
    discover::{self, InputFolders},
    maps,
    queue::{Full, Queue},
    settle::{Stamp, newest_entry},
    state::{Looked, Outcome, Phase, Tracked, Work},
    status::{Holder, StatusFiles},
    watch::{self, Change, Watches},
};
use crate::io::{depthmaps, output::Disk};

/// Changes that come within this time of each other are one look.
const GATHER: Duration = Duration::from_millis(50);
/// Network file systems are looked at so often when nothing else is said.
const NETWORK_POLL: Duration = Duration::from_secs(10);
/// After a look at what changed there is none for so many times as long; but no longer than the settle time, so that nothing is
/// planned later for it, and not longer than this.
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
    Change(Change),
    Progress { project: PathBuf, job: u64, stage: String, percent: u8 },
    Finished { project: PathBuf, job: u64, looked: Looked, outcome: Outcome },
    Signal(Signal),
}

impl From<Change> for Event {
    fn from(change: Change) -> Self {
        Self::Change(change)
    }
}

/// Whoever started the daemon and watches over it: systemd, where it asked to be told.
struct Supervisor {
    next: Cell<Instant>,
}

impl Supervisor {
    fn new() -> Self {
        Self { next: Cell::new(Instant::now()) }
    }

    fn tell(&self, state: NotifyState) {
        // Without a supervisor there is nobody to tell.
        let _ = sd_notify::notify(&[state]);
    }

    /// Says from time to time that the loop turns.
    fn alive(&self) {
        let now = Instant::now();
        if now >= self.next.get() {
            self.next.set(now + WATCHDOG_PAUSE);
            self.tell(NotifyState::Watchdog);
        }
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
        status: StatusFiles::new(holders, options.metrics.clone(), disk)?,
        watches: Watches::new(sender.clone(), poll.is_some()),
        supervisor: Supervisor::new(),
        network: network && options.poll.is_none(),
        lost: false,
        poll,
        sender,
        next_job: 0,
        projects: BTreeMap::new(),
        queue: Queue::new(options.jobs, options.max_memory),
        dirty: BTreeMap::new(),
        gather_until: None,
        rest_until: Instant::now(),
        look_at_all: true,
        next_full_look: Instant::now(),
        stopping: false,
    };
    for root in &daemon.roots {
        match daemon.poll {
            Some(poll) => info!(root = %Shown(root), "watching, with a look every {} s", poll.as_secs_f64()),
            None => info!(root = %Shown(root), "watching, by file events"),
        }
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
    supervisor: Supervisor,
    /// Is it a network file system that makes for the polling?
    network: bool,
    /// Were events lost since the last look at everything?
    lost: bool,
    poll: Option<Duration>,
    sender: Sender<Event>,
    next_job: u64,
    projects: BTreeMap<PathBuf, Tracked>,
    queue: Queue,
    /// Where something changed, and when that was last heard of.
    dirty: BTreeMap<PathBuf, Instant>,
    gather_until: Option<Instant>,
    /// No look at what changed before this.
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
        self.supervisor.tell(NotifyState::Ready);
        loop {
            self.supervisor.alive();
            let now = Instant::now();
            self.look(now);
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
            while let Ok(event) = events.try_recv() {
                self.handle(event);
            }
        }
    }

    fn handle(&mut self, event: Event) {
        let now = Instant::now();
        match event {
            Event::Change(Change::At(path)) => self.hear(path, false, now),
            Event::Change(Change::Gone(path)) => {
                self.watches.doubt(&path);
                self.hear(path, true, now);
            }
            Event::Change(Change::Lost) => {
                self.lost = true;
                self.look_at_all = true;
            }
            Event::Progress { project, job, stage, percent } => {
                if let Some(tracked) = self.projects.get_mut(&project) {
                    tracked.progress(job, stage, percent);
                }
            }
            Event::Finished { project, job, looked, outcome } => self.finish(&project, job, looked, outcome, now),
            Event::Signal(Signal::Stop) => {
                self.stopping = true;
                self.projects.values().for_each(Tracked::cancel);
                self.supervisor.tell(NotifyState::Stopping);
            }
            Event::Signal(Signal::Rescan) => {
                self.look_at_all = true;
                self.projects.values_mut().for_each(Tracked::look_again);
            }
        }
    }

    /// What viewrank itself writes into a project's output folder, where depth maps may be, too, is nothing to look at; what is taken away
    /// there is.
    fn hear(&mut self, path: PathBuf, is_gone: bool, now: Instant) {
        let inside = |project: &Path| path.starts_with(project.join(discover::OUTPUT_FOLDER));
        let is_file = path.extension().is_some() && !depthmaps::looks_like_one(&path);
        if is_gone || !(is_file && self.project_around(&path).is_some_and(inside)) {
            self.mark(path, now);
        }
    }

    fn project_around<'p>(&self, path: &'p Path) -> Option<&'p Path> {
        path.ancestors().find(|above| self.projects.contains_key(*above))
    }

    fn mark(&mut self, path: PathBuf, now: Instant) {
        self.dirty.insert(path, now);
        self.gather_until.get_or_insert((now + GATHER).max(self.rest_until));
    }

    fn finish(&mut self, project: &Path, job: u64, looked: Looked, outcome: Outcome, now: Instant) {
        self.queue.release(job);
        let Some(tracked) = self.projects.get_mut(project) else {
            // What the job learned of a project that is gone.
            return self.planner.forget(project);
        };
        let abandoned = outcome == Outcome::Abandoned;
        let (looked_only, before) = (matches!(outcome, Outcome::Planned { anew: false, .. }), tracked.result().clone());
        if !tracked.finish(job, looked, outcome, now) {
            return;
        }
        match tracked.result() {
            _ if abandoned => {}
            same if looked_only && *same == before => {}
            Phase::Failed { reason, .. } => warn!(project = %Shown(project), %reason, "failed"),
            phase => info!(project = %Shown(project), "{phase}"),
        }
        // What changed while the job ran was seen; what changed after its last look may have raised no event yet.
        self.mark(project.into(), now);
    }

    /// Looks at what changed, or at everything when it is time.
    fn look(&mut self, now: Instant) {
        if self.look_at_all || now >= self.next_full_look {
            self.look_at_everything(now);
        } else if self.gather_until.is_some_and(|until| now >= until || self.is_something_due(now)) {
            self.look_at_changed(now);
            let ended = Instant::now();
            self.rest_until = ended + ((ended - now) * REST).min(LONGEST_REST).min(self.options.settle);
        }
        for notice in self.watches.notices() {
            self.status.notice(notice.clone());
        }
        self.next_full_look = self.next_full_look.min(now + self.pause());
    }

    /// May a job begin? Not before what is known to have changed was looked at.
    fn is_something_due(&self, now: Instant) -> bool {
        let due = |tracked: &Tracked| tracked.due(self.options.settle).is_some_and(|(at, _)| at <= now);
        self.projects.values().any(|tracked| !tracked.is_queued() && due(tracked))
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
        self.status.begin_look();
        if std::mem::take(&mut self.lost) {
            self.status.notice("file events were lost; looked at everything".into());
        }
        if self.network {
            self.status.notice("network file system: looking at the folders every 10 s (--poll)".into());
        }
        self.watches.renew();
        self.watches.forget_missing();
        let mut found = BTreeSet::new();
        for root in self.roots.clone() {
            found.extend(self.search(&root, now));
        }
        let gone: Vec<_> = self.projects.keys().filter(|project| !found.contains(*project)).cloned().collect();
        gone.iter().for_each(|project| self.forget(project, now));
        found.iter().for_each(|project| self.look_at_project(project, None, now));
        self.next_full_look = now + self.pause();
    }

    fn look_at_changed(&mut self, now: Instant) {
        self.gather_until = None;
        let mut projects: BTreeMap<PathBuf, Instant> = BTreeMap::new();
        let mut outside: BTreeMap<PathBuf, Instant> = BTreeMap::new();
        for (path, heard) in std::mem::take(&mut self.dirty) {
            // What lies in a folder that was moved is gone without a word of its own.
            let inside = self.projects.range(path.clone()..).take_while(|(project, _)| project.starts_with(&path));
            projects.extend(inside.map(|(project, _)| (project.clone(), heard)));
            let Some(project) = self.project_around(&path).map(Path::to_path_buf) else {
                // Thousands of files of one folder are one question.
                if let Some(folder) = changed_folder(path) {
                    hear_last(&mut outside, folder, heard);
                }
                continue;
            };
            if path.starts_with(project.join("images"))
                && let Some(tracked) = self.projects.get_mut(&project)
            {
                tracked.disturb(heard);
            }
            hear_last(&mut projects, project, heard);
        }
        for (project, heard) in projects {
            match discover::is_project(&project, self.options.follow_links) {
                true => self.look_at_project(&project, Some(heard), now),
                false => self.forget(&project, now),
            }
        }
        let mut folders: BTreeMap<PathBuf, Instant> = BTreeMap::new();
        for (path, heard) in outside {
            if let Some(folder) = self.folder_to_search(&path) {
                hear_last(&mut folders, folder, heard);
            }
        }
        for (folder, heard) in outermost(folders) {
            for project in self.search(&folder, now) {
                self.look_at_project(&project, Some(heard), now);
            }
        }
    }

    /// Where a change at a path outside projects may have made one: a folder above that looks like a project now (what came
    /// is its `sparse`), else the nearest folder that is there.
    fn folder_to_search(&self, path: &Path) -> Option<PathBuf> {
        let root = self.roots.iter().find(|root| path.starts_with(root))?;
        let inside = path.strip_prefix(root).ok()?;
        if !inside.components().all(|part| discover::is_searched(part.as_os_str())) {
            return None;
        }
        let follow_links = self.options.follow_links;
        let is_searched = |above: &&Path| above.is_dir() && discover::may_enter(root, above, follow_links);
        let folders = || path.ancestors().take_while(|above| above.starts_with(root)).filter(is_searched);
        let project = folders().find(|folder| discover::is_project(folder, self.options.follow_links));
        project.or_else(|| folders().next()).map(Path::to_path_buf)
    }

    /// Searches a folder outside projects for projects, which are to be looked at, and watches the folders in which one may appear.
    fn search(&mut self, folder: &Path, now: Instant) -> Vec<PathBuf> {
        let found = discover::walk(folder, &self.roots, self.options.follow_links, &|| self.supervisor.alive());
        let mut new_watches = false;
        for inner in found.folders {
            new_watches |= self.watches.update(&inner, std::slice::from_ref(&inner));
        }
        if new_watches {
            // Something may have come between the look and the watch.
            self.mark(folder.into(), now);
        }
        for (folder, reason) in found.unreadable {
            self.status.notice(format!("cannot look into {}: {reason}", folder.display()));
        }
        for project in &found.projects {
            if !self.projects.contains_key(project) {
                info!(project = %Shown(project), "found");
                self.forget_inside(project, now);
                self.projects.insert(project.clone(), Tracked::new(project.clone(), now));
            }
        }
        found.projects
    }

    /// What was taken for projects before the project around them was there is a part of it.
    fn forget_inside(&mut self, project: &Path, now: Instant) {
        let inside = self.projects.keys().filter(|inner| inner.starts_with(project));
        inside.cloned().collect::<Vec<_>>().iter().for_each(|inner| self.forget(inner, now));
    }

    /// Looks at a project of which something was heard last at `heard`; `None`: nothing is known of when it changed.
    fn look_at_project(&mut self, project: &Path, heard: Option<Instant>, now: Instant) {
        self.supervisor.alive();
        let Options { on_busy, follow_links, .. } = *self.options;
        let named = self.planner.named_files(project);
        let input = InputFolders::of(project, follow_links);
        let (map_folders, maps) = maps::look(project, follow_links);
        let folders = folders_to_watch(project, &input, map_folders, &named);
        let new_watches = self.watches.update(project, &folders);
        let stamp = Stamp::of_folders(&input).with(&named);
        let looked = (Instant::now(), SystemTime::now());
        if let Some(tracked) = self.projects.get_mut(project) {
            // Nobody listened before the first watch.
            let unheard = if new_watches { newest_entry(&input.images) } else { None };
            let since = heard.map_or(now, |heard| stamp.same_since(heard, unheard, looked));
            tracked.observe(stamp, since, on_busy);
            match maps {
                Ok(maps) => tracked.observe_maps(maps, now),
                // What was there before may still be.
                Err(unseen) => self.status.notice(unseen.to_string()),
            }
            if tracked.is_at_rest() && !self.planner.has_plan(project) {
                tracked.look_again();
            }
        }
        if new_watches {
            // Something may have come between the look and the watch.
            self.mark(project.into(), now);
        }
    }

    /// The project is gone, or no project any more: its job ends, and its place is searched again.
    fn forget(&mut self, project: &Path, now: Instant) {
        info!(project = %Shown(project), "gone");
        if let Some(tracked) = self.projects.remove(project) {
            tracked.cancel();
        }
        self.watches.update(project, &[]);
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
        self.projects.values_mut().for_each(|tracked| tracked.wait_for(None));
        let due = |t: &Tracked| t.due(self.options.settle).filter(|(at, _)| *at <= now);
        let waiting = self.projects.values().filter_map(|t| due(t).map(|(at, work)| (at, t.root.clone(), work)));
        let mut waiting: Vec<_> = waiting.collect();
        // Plans before measurements: a backend waits for them.
        waiting.sort_by(|a, b| (a.2, a.0, &a.1).cmp(&(b.2, b.0, &b.1)));
        self.queue.call_up();
        for (_, project, work) in waiting {
            self.start_job(threads, &project, work, now);
        }
    }

    fn start_job<'s>(&mut self, threads: &'s Scope<'s, '_>, project: &Path, work: Work, now: Instant)
    where
        'a: 's,
    {
        let Options { on_busy, follow_links, settle, .. } = *self.options;
        let Some(number) = self.admit(project, work, now) else { return };
        let Some(tracked) = self.projects.get_mut(project) else { return };
        let (looked, cancel) = tracked.start(number, work, settle, now);
        let (planner, sender, project) = (self.planner, self.sender.clone(), project.to_path_buf());
        let named = planner.named_files(&project);
        threads.spawn(move || {
            let progress = |stage: &str, percent| {
                let event = Event::Progress { project: project.clone(), job: number, stage: stage.into(), percent };
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
            let outcome = outcome_of(planner, work, &job);
            _ = sender.send(Event::Finished { project: project.clone(), job: number, looked, outcome });
        });
    }

    /// The number of a job that may start; `None` where it has to wait, or would never fit.
    fn admit(&mut self, project: &Path, work: Work, now: Instant) -> Option<u64> {
        let tracked = self.projects.get_mut(project)?;
        self.next_job += 1;
        let number = self.next_job;
        match self.queue.admit(number, self.planner.need(tracked.stamp())) {
            Ok(()) => return Some(number),
            Err(Full::Jobs) => tracked.wait_for(Some("for a free job (--jobs)")),
            Err(Full::Memory) => tracked.wait_for(Some("for memory (--max-memory)")),
            Err(Full::Never { need, max }) => {
                let mib = |bytes: u64| bytes.div_ceil(1 << 20);
                let reason = format!("needs about {} MiB, --max-memory allows {} MiB", mib(need), mib(max));
                let hint = Some("raise --max-memory, or plan it by itself with `viewrank plan`".into());
                let (looked, _) = tracked.start(number, work, self.options.settle, now);
                self.finish(project, number, looked, Outcome::Failed { reason, hint }, now);
            }
        }
        None
    }

    /// How long there is nothing to do.
    fn sleep(&self, now: Instant) -> Duration {
        let due = self.projects.values().filter(|tracked| !tracked.is_queued());
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
        let count = |wanted: fn(&Phase) -> bool| self.projects.values().filter(|t| wanted(&t.phase())).count();
        let planned = |p: &Phase| matches!(p, Phase::Planned { .. } | Phase::Computing { .. } | Phase::Reached { .. });
        Summary {
            projects: self.projects.len(),
            planned: count(planned),
            failed: count(|p| matches!(p, Phase::Failed { .. })),
            waiting: count(|p| matches!(p, Phase::Waiting { .. })),
        }
    }
}

/// What a job came to; a fault of ours is a failure of that project alone.
fn outcome_of(planner: &dyn Planner, work: Work, job: &Job) -> Outcome {
    let act = || match work {
        Work::Plan => planner.plan(job),
        Work::Follow => planner.follow(job),
    };
    catch_unwind(AssertUnwindSafe(act)).unwrap_or_else(|_| Outcome::Failed {
        reason: "an internal error; see the log".into(),
        hint: Some("run `viewrank plan` on it and report what it prints".into()),
    })
}

/// Where a change outside projects took place, if projects are searched there.
fn changed_folder(path: PathBuf) -> Option<PathBuf> {
    match path.is_dir() {
        true => Some(path),
        false if path.file_name().is_some_and(discover::is_searched) => path.parent().map(Path::to_path_buf),
        false => None,
    }
}

/// Of several changes the last counts.
fn hear_last(of: &mut BTreeMap<PathBuf, Instant>, path: PathBuf, heard: Instant) {
    let last = of.entry(path).or_insert(heard);
    *last = heard.max(*last);
}

/// Folders without those inside others, which are searched with them.
fn outermost(folders: BTreeMap<PathBuf, Instant>) -> BTreeMap<PathBuf, Instant> {
    let mut outer: BTreeMap<PathBuf, Instant> = BTreeMap::new();
    for (folder, heard) in folders {
        // What lies in a folder follows it.
        let around = outer.last_key_value().map(|(around, _)| around).filter(|around| folder.starts_with(around));
        let around = around.cloned().unwrap_or(folder);
        hear_last(&mut outer, around, heard);
    }
    outer
}

/// Folders whose changes concern the project; `named` are the files that it depends on beside model and images.
fn folders_to_watch(project: &Path, input: &InputFolders, maps: Vec<PathBuf>, named: &[PathBuf]) -> Vec<PathBuf> {
    let own = project.join(discover::OUTPUT_FOLDER);
    let named = named.iter().filter_map(|file| file.parent().map(Path::to_path_buf));
    let named = named.filter(|folder| folder.starts_with(project) && !folder.starts_with(&own));
    let mut folders: BTreeSet<PathBuf> = input.all().cloned().chain(maps).chain(named).collect();
    folders.extend(Some(own).filter(|own| own.is_dir()));
    folders.into_iter().collect()
}
