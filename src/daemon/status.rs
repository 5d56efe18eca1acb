//! The files that say how things stand: `ROOT/viewrank/status.json`, the metrics, and the lock that says who watches.

use std::{
    collections::BTreeMap,
    fs::File,
    io::{self, Read, Write},
    path::{Path, PathBuf},
    thread,
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
/// Where it could not be written, it is tried again after this.
const RETRY: Duration = Duration::from_secs(10);
/// How often a lock is tried that nobody holds for long.
const TRIES: u32 = 5;
/// Sentences that are kept.
const NOTICES: usize = 20;

/// Holds a root for this process; let go when dropped or when the process ends, however it ends.
pub struct Holder {
    /// Without symbolic links.
    pub root: PathBuf,
    _lock: File,
}

impl Holder {
    /// Takes the root, or says who has it or a folder around it.
    pub fn take(root: &Path, disk: &Disk) -> Result<Self, DaemonError> {
        let held = |path: &Path| Some(DaemonError::Held { path: path.into(), holder: Self::of(path)? });
        if let Some(error) = root.ancestors().find_map(held) {
            return Err(error);
        }
        output::make_folder(&root.join(OUTPUT_FOLDER), disk)?;
        let path = lock_file(root);
        let failed = |source| DaemonError::Root { path: path.clone(), source };
        let open = File::options().read(true).write(true).create(true).truncate(false).open(&path);
        let mut lock = open.map_err(failed)?;
        // Whoever asks at this instant whether it is held is gone in the next.
        for _ in 0..TRIES {
            if lock.try_lock().is_ok() {
                let name = format!("process {} on {}\n", std::process::id(), host());
                lock.set_len(0).and_then(|()| lock.write_all(name.as_bytes())).map_err(failed)?;
                return Ok(Self { root: root.into(), _lock: lock });
            }
            thread::sleep(Duration::from_millis(10));
        }
        Err(held(root).unwrap_or_else(|| failed(io::ErrorKind::WouldBlock.into())))
    }

    /// Did nobody remove the folder of outputs, and the lock with it?
    fn is_there(&self) -> bool {
        lock_file(&self.root).is_file()
    }

    /// Takes the root again where the lock is gone.
    fn hold_on(&mut self, disk: &Disk) -> Result<(), DaemonError> {
        if self.root.is_dir() && !self.is_there() {
            *self = Self::take(&self.root, disk)?;
        }
        Ok(())
    }

    /// The daemon that holds the root at this moment.
    fn of(root: &Path) -> Option<String> {
        let mut lock = File::open(lock_file(root)).ok()?;
        lock.try_lock_shared().err()?;
        let mut name = String::new();
        // An empty name is better than none at all.
        _ = lock.read_to_string(&mut name);
        Some(name.trim().into())
    }
}

fn lock_file(root: &Path) -> PathBuf {
    root.join(OUTPUT_FOLDER).join("watch.lock")
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
    /// Why the files could not be written; said once.
    trouble: Option<String>,
}

impl StatusFiles {
    pub fn new(roots: Vec<Holder>, metrics: Option<PathBuf>) -> Self {
        let written = roots.iter().map(|_| Status::default()).collect();
        Self { roots, metrics, notices: Vec::new(), written, next: None, trouble: None }
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
        if fresh == self.written && self.roots.iter().all(Holder::is_there) {
            self.next = None;
            return;
        }
        let at = *self.next.get_or_insert(now);
        if now < at && !last {
            return;
        }
        let trouble = self.write(&fresh, projects, disk).err().map(|error| error.to_string());
        if let Some(text) = trouble.as_ref().filter(|_| trouble != self.trouble) {
            warn!("cannot say how things stand: {text}");
        }
        if trouble.is_none() {
            self.written = fresh;
        }
        self.next = Some(now + if trouble.is_none() { PAUSE } else { RETRY });
        self.trouble = trouble;
    }

    fn write(
        &mut self,
        fresh: &[Status],
        projects: &BTreeMap<PathBuf, Tracked>,
        disk: &Disk,
    ) -> Result<(), DaemonError> {
        for (holder, status) in self.roots.iter_mut().zip(fresh) {
            holder.hold_on(disk)?;
            let text = serde_json::to_vec_pretty(status).unwrap_or_default();
            output::replace(&holder.root.join(OUTPUT_FOLDER).join("status.json"), &text, disk)?;
        }
        match &self.metrics {
            Some(path) => Ok(output::replace(path, metrics(projects).as_bytes(), disk)?),
            None => Ok(()),
        }
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

/// Projects by state, and how far each is that has depth maps, in Prometheus' text format.
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
    let mut gauge = |name: &str, help: &str, value: fn(&Phase) -> Option<f64>| {
        text += &format!("# HELP {name} {help}\n# TYPE {name} gauge\n");
        for (root, value) in projects.iter().filter_map(|(root, tracked)| Some((root, value(&tracked.phase)?))) {
            text += &format!("{name}{{project=\"{}\"}} {value}\n", label(root));
        }
    };
    gauge("viewrank_depth_maps_done", "Key views with a depth map, of those to the cut.", |phase| match phase {
        Phase::Computing { done, .. } | Phase::Reached { done, .. } => Some(*done as f64),
        _ => None,
    });
    gauge("viewrank_depth_maps_wanted", "Key views to the cut.", |phase| match phase {
        Phase::Computing { clusters, .. } | Phase::Reached { clusters, .. } => Some(*clusters as f64),
        _ => None,
    });
    gauge(
        "viewrank_share_reached",
        "Real fulfilment over what all clusters together can reach.",
        |phase| match phase {
            Phase::Computing { share, .. } => *share,
            Phase::Reached { share, .. } => Some(*share),
            _ => None,
        },
    );
    text
}

/// A path as the value of a label.
fn label(path: &Path) -> String {
    path.to_string_lossy().replace('\\', "\\\\").replace('"', "\\\"").replace('\n', "\\n")
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
    Some(Line { running: Holder::of(root).is_some(), status })
}
