//! The files that say how things stand: `ROOT/viewrank/status.json`, the metrics, and the lock that says who watches.

use std::{
    collections::BTreeMap,
    fs::File,
    io::{Read, Seek, SeekFrom, Write},
    path::{Path, PathBuf},
    time::{Duration, Instant, SystemTime, UNIX_EPOCH},
};

use tracing::warn;

use super::{
    DaemonError,
    discover::OUTPUT_FOLDER,
    state::{Phase, ProjectStatus, Status, Tracked},
};
use crate::output::{self, Disk};

/// The status is written at most so often.
const PAUSE: Duration = Duration::from_secs(1);
/// Sentences that are kept.
const NOTICES: usize = 20;

/// Holds a root for this process; let go when dropped or when the process ends, however it ends.
pub struct Holder {
    /// Without symbolic links.
    pub root: PathBuf,
    _lock: File,
}

impl Holder {
    /// Takes the root, or says who has it.
    pub fn take(root: &Path, disk: &Disk) -> Result<Self, DaemonError> {
        let error = |path: &Path| {
            let path = path.to_path_buf();
            move |source| DaemonError::Root { path, source }
        };
        let root = root.canonicalize().map_err(error(root))?;
        let folder = root.join(OUTPUT_FOLDER);
        output::make_folder(&folder, disk)?;
        let path = folder.join("watch.lock");
        let options = File::options().read(true).write(true).create(true).truncate(false).open(&path);
        let mut lock = options.map_err(error(&path))?;
        if lock.try_lock().is_err() {
            let mut holder = String::new();
            // An empty name is better than none at all.
            _ = lock.read_to_string(&mut holder);
            return Err(DaemonError::Held { path: root, holder: holder.trim().into() });
        }
        let name = format!("process {} on {}\n", std::process::id(), host());
        let written =
            lock.set_len(0).and_then(|()| lock.seek(SeekFrom::Start(0))).and_then(|_| lock.write_all(name.as_bytes()));
        written.map_err(error(&path))?;
        Ok(Self { root, _lock: lock })
    }

    /// Does a daemon hold the root at this moment?
    fn is_held(root: &Path) -> bool {
        let path = root.join(OUTPUT_FOLDER).join("watch.lock");
        File::open(path).is_ok_and(|file| file.try_lock_shared().is_err())
    }
}

fn host() -> String {
    let name = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    if name.trim().is_empty() { "this host".into() } else { name.trim().into() }
}

/// Writes the status files of all roots when something changed.
pub struct StatusFiles {
    roots: Vec<Holder>,
    metrics: Option<PathBuf>,
    notices: Vec<String>,
    written: Vec<Status>,
    next: Option<Instant>,
}

impl StatusFiles {
    pub fn new(roots: Vec<Holder>, metrics: Option<PathBuf>) -> Self {
        let written = roots.iter().map(|_| Status::default()).collect();
        Self { roots, metrics, notices: Vec::new(), written, next: None }
    }

    /// A sentence for people, said once.
    pub fn notice(&mut self, text: String) {
        if !self.notices.contains(&text) && self.notices.len() < NOTICES {
            warn!("{text}");
            self.notices.push(text);
        }
    }

    /// When a change waits to be written.
    pub fn due(&self) -> Option<Instant> {
        self.next
    }

    /// Writes what changed, at most once a second unless it is the last time. A disk that can't be written to is tried again.
    pub fn publish(&mut self, projects: &BTreeMap<PathBuf, Tracked>, disk: &Disk, now: Instant, last: bool) {
        let fresh: Vec<_> = (0..self.roots.len()).map(|i| self.status(i, projects)).collect();
        if fresh == self.written {
            self.next = None;
            return;
        }
        let at = *self.next.get_or_insert(now);
        if now < at && !last {
            return;
        }
        self.next = Some(now + PAUSE);
        for (holder, status) in self.roots.iter().zip(&fresh) {
            let path = holder.root.join(OUTPUT_FOLDER).join("status.json");
            let text = serde_json::to_vec_pretty(status).unwrap_or_default();
            if let Err(error) = output::replace(&path, &text, disk) {
                return warn!("cannot write the status: {error}");
            }
        }
        if let Some(path) = &self.metrics
            && let Err(error) = output::replace(path, metrics(projects).as_bytes(), disk)
        {
            warn!("cannot write the metrics: {error}");
        }
        self.written = fresh;
    }

    fn status(&self, root: usize, projects: &BTreeMap<PathBuf, Tracked>) -> Status {
        let folder = &self.roots[root].root;
        let mut before = self.written[root].projects.iter().peekable();
        let lines = projects.values().filter_map(|tracked| {
            let relative = tracked.root.strip_prefix(folder).ok()?;
            let project =
                if relative.as_os_str().is_empty() { ".".into() } else { relative.to_string_lossy().into_owned() };
            while before.peek().is_some_and(|b| Path::new(&b.project) < Path::new(&project)) {
                before.next();
            }
            let same = before.peek().filter(|b| {
                b.project == project && std::mem::discriminant(&b.phase) == std::mem::discriminant(&tracked.phase)
            });
            let since = same.map_or_else(seconds_now, |b| b.since);
            Some(ProjectStatus { project, phase: tracked.phase.clone(), since })
        });
        Status {
            version: 1,
            pid: std::process::id(),
            host: host(),
            notices: self.notices.clone(),
            projects: lines.collect(),
        }
    }
}

fn seconds_now() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs())
}

/// Projects by state, in Prometheus' text format.
fn metrics(projects: &BTreeMap<PathBuf, Tracked>) -> String {
    let mut counts: BTreeMap<&str, usize> =
        ["waiting", "queued", "planning", "planned", "computing", "reached", "failed"].map(|name| (name, 0)).into();
    for tracked in projects.values() {
        *counts.entry(name_of(&tracked.phase)).or_default() += 1;
    }
    let mut text = String::from("# HELP viewrank_projects Projects by state.\n# TYPE viewrank_projects gauge\n");
    for (state, count) in counts {
        text += &format!("viewrank_projects{{state=\"{state}\"}} {count}\n");
    }
    text
}

fn name_of(phase: &Phase) -> &'static str {
    match phase {
        Phase::Waiting { .. } => "waiting",
        Phase::Queued { .. } => "queued",
        Phase::Planning { .. } => "planning",
        Phase::Planned { .. } => "planned",
        Phase::Computing { .. } => "computing",
        Phase::Reached { .. } => "reached",
        Phase::Failed { .. } => "failed",
    }
}

/// The status of a root as it was last written, and whether a daemon runs there now.
#[derive(Debug, PartialEq)]
pub struct Line {
    pub running: bool,
    pub status: Status,
}

/// Reads the status of a root; `None` where no daemon ever watched it.
pub fn read_status(root: &Path) -> Option<Line> {
    let text = std::fs::read(root.join(OUTPUT_FOLDER).join("status.json")).ok()?;
    let status = serde_json::from_slice(&text).ok()?;
    Some(Line { running: Holder::is_held(root), status })
}
