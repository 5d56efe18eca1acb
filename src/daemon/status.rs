//! The files that say how things stand: `ROOT/viewrank/status.json`, the metrics, and the lock that says who watches.

use std::{
    collections::BTreeMap,
    fs::{File, TryLockError},
    io::{self, Read, Seek, Write},
    path::{Path, PathBuf},
    thread,
    time::{Duration, Instant, SystemTime, UNIX_EPOCH},
};

use tracing::warn;

use super::{
    DaemonError, discover,
    platform::host,
    state::{Phase, ProjectStatus, Status, Tracked},
};
use crate::io::output::{self, Disk, OutputError};

/// The status is written at most so often.
const PAUSE: Duration = Duration::from_secs(1);
/// Where it could not be written, it is tried again after this.
const RETRY: Duration = Duration::from_secs(10);
/// How often a lock is tried that nobody holds for long.
const TRIES: u32 = 5;
/// Relative to the root.
const LOCK: &str = "viewrank/watch.lock";
const STATUS: &str = "viewrank/status.json";
/// The lock begins with it.
const HOLDER: &str = "process ";
/// Bytes of a lock with the longest name of a host.
const LONGEST_NAME: u64 = 1024;
/// Sentences that the status shows.
const NOTICES: usize = 20;

/// Holds a root for this process; let go when dropped or when the process ends, however it ends.
pub struct Holder {
    /// Without symbolic links.
    pub root: PathBuf,
    _lock: File,
}

impl Holder {
    /// Takes the root, or says who has it, a folder around it or one in it.
    pub fn take(root: &Path, disk: &Disk) -> Result<Self, DaemonError> {
        let held = |path: &Path| Some(DaemonError::Held { path: path.into(), holder: Self::of(path)? });
        let inside = discover::walk(root, &[root.to_path_buf()], false, &|| {});
        let inside = inside.folders.iter().chain(&inside.projects).map(PathBuf::as_path);
        if let Some(error) = root.ancestors().chain(inside).find_map(held) {
            return Err(error);
        }
        output::make_own_folder(root, disk)?;
        let failed = |source| DaemonError::Root { path: root.join(LOCK), source };
        let mut lock = output::open_lock(root, LOCK)?;
        // Whoever asks at this instant whether it is held is gone in the next.
        for _ in 0..TRIES {
            match lock.try_lock() {
                Err(TryLockError::WouldBlock) => thread::sleep(Duration::from_millis(10)),
                locked => {
                    if let Err(TryLockError::Error(error)) = locked {
                        warn!("{}: no locks here ({error}): see to it that no other daemon watches it", root.display());
                    }
                    if !is_name_of_holder(&mut lock).map_err(failed)? {
                        let what = "a file of somebody else's";
                        return Err(OutputError::Foreign { path: root.join(LOCK), what }.into());
                    }
                    let name = format!("{HOLDER}{} on {}\n", std::process::id(), host());
                    let emptied = lock.set_len(0).and_then(|()| lock.rewind());
                    emptied.and_then(|()| lock.write_all(name.as_bytes())).map_err(failed)?;
                    return Ok(Self { root: root.into(), _lock: lock });
                }
            }
        }
        Err(held(root).unwrap_or_else(|| failed(io::ErrorKind::WouldBlock.into())))
    }

    /// Did nobody remove the folder of outputs, and the lock with it?
    fn is_there(&self) -> bool {
        self.root.join(LOCK).symlink_metadata().is_ok_and(|found| found.is_file())
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
        let lock = output::open_own(root, LOCK).ok()?;
        let Err(TryLockError::WouldBlock) = lock.try_lock_shared() else { return None };
        let mut name = String::new();
        // An empty name is better than none at all.
        _ = lock.take(LONGEST_NAME).read_to_string(&mut name);
        Some(name.trim().into())
    }
}

/// Is a lock file new or one of ours? Nothing else is ever emptied, by whatever name it is reached.
fn is_name_of_holder(lock: &mut File) -> io::Result<bool> {
    let mut text = Vec::new();
    lock.take(LONGEST_NAME + 1).read_to_end(&mut text)?;
    Ok(text.is_empty() || text.len() as u64 <= LONGEST_NAME && text.starts_with(HOLDER.as_bytes()))
}

/// Writes the status files of all roots when something changed.
pub struct StatusFiles {
    roots: Vec<RootStatus>,
    metrics: Option<Metrics>,
    /// What holds since the last look at everything.
    notices: Vec<String>,
    /// What held before it.
    said: Vec<String>,
    due: Option<Instant>,
}

/// One root and what was said of it last.
struct RootStatus {
    holder: Holder,
    written: Status,
    pace: Pace,
}

/// The metrics and whether they say how things stand.
struct Metrics {
    path: PathBuf,
    fresh: bool,
    pace: Pace,
}

impl StatusFiles {
    /// # Errors
    /// Metrics that can't be written.
    pub fn new(roots: Vec<Holder>, metrics: Option<PathBuf>, disk: &Disk) -> Result<Self, DaemonError> {
        let root = |holder| RootStatus { holder, written: Status::default(), pace: Pace::default() };
        if let Some(path) = &metrics {
            let text = metrics_text(&BTreeMap::new());
            output::replace(path, text.as_bytes(), disk).map_err(DaemonError::Metrics)?;
        }
        Ok(Self {
            roots: roots.into_iter().map(root).collect(),
            metrics: metrics.map(|path| Metrics { path, fresh: false, pace: Pace::default() }),
            notices: Vec::new(),
            said: Vec::new(),
            due: None,
        })
    }

    /// A look at everything begins: what is not noticed again holds no longer.
    pub fn begin_scan(&mut self) {
        self.said = std::mem::take(&mut self.notices);
    }

    /// A sentence for people, logged where it did not hold before.
    pub fn notice(&mut self, text: String) {
        if self.notices.contains(&text) {
            return;
        }
        if !self.said.contains(&text) {
            warn!("{text}");
        }
        self.notices.push(text);
    }

    /// When a change waits to be written.
    pub fn due(&self) -> Option<Instant> {
        self.due
    }

    /// Writes what changed, but what changes all the time at most once a second unless it is the last time. A disk that can't be written to is tried again.
    pub fn publish(&mut self, projects: &BTreeMap<PathBuf, Tracked>, disk: &Disk, now: Instant, last: bool) {
        self.due = None;
        let mut wait = |until: Option<Instant>| self.due = [self.due, until].into_iter().flatten().min();
        for root in &mut self.roots {
            let fresh = root.status(projects, &self.notices);
            // Of a root that is gone there is nothing to say until it comes back.
            if fresh == root.written && root.holder.is_there() || !root.holder.root.is_dir() {
                root.pace.rest();
                continue;
            }
            if let Some(metrics) = &mut self.metrics {
                metrics.fresh = false;
            }
            match root.pace.write(now, last, || write_status(&mut root.holder, &fresh, disk)) {
                true => root.written = fresh,
                false => wait(root.pace.next),
            }
        }
        if let Some(metrics) = self.metrics.as_mut().filter(|metrics| !metrics.fresh) {
            let Metrics { path, pace, .. } = metrics;
            let text = || metrics_text(projects);
            metrics.fresh = pace.write(now, last, || Ok(output::replace(path, text().as_bytes(), disk)?));
            wait(metrics.pace.next.filter(|_| !metrics.fresh));
        }
    }
}

/// When a file was written, and may be again.
#[derive(Default)]
struct Pace {
    next: Option<Instant>,
    /// Why it could not be written; said once.
    trouble: Option<String>,
}

impl Pace {
    /// There was nothing to write: the next change is written at once.
    fn rest(&mut self) {
        self.next = None;
    }

    /// Writes if it is time; true when that is done.
    fn write(&mut self, now: Instant, last: bool, write: impl FnOnce() -> Result<(), DaemonError>) -> bool {
        if self.next.is_some_and(|at| now < at) && !last {
            return false;
        }
        let trouble = write().err().map(|error| error.to_string());
        if let Some(text) = trouble.as_ref().filter(|_| trouble != self.trouble) {
            warn!("cannot say how things stand: {text}");
        }
        self.next = Some(now + if trouble.is_none() { PAUSE } else { RETRY });
        self.trouble = trouble;
        self.trouble.is_none()
    }
}

fn write_status(holder: &mut Holder, status: &Status, disk: &Disk) -> Result<(), DaemonError> {
    holder.hold_on(disk)?;
    let text = serde_json::to_vec_pretty(status).unwrap_or_default();
    Ok(output::replace(&output::own_path(&holder.root, STATUS)?, &text, disk)?)
}

impl RootStatus {
    fn status(&self, projects: &BTreeMap<PathBuf, Tracked>, notices: &[String]) -> Status {
        let mut before = self.written.projects.iter().peekable();
        let lines = projects.values().filter_map(|tracked| {
            let relative = tracked.root.strip_prefix(&self.holder.root).ok()?;
            let project =
                if relative.as_os_str().is_empty() { ".".into() } else { relative.to_string_lossy().into_owned() };
            while before.peek().is_some_and(|b| Path::new(&b.project) < Path::new(&project)) {
                before.next();
            }
            let phase = tracked.phase();
            let same = before
                .peek()
                .filter(|b| b.project == project && std::mem::discriminant(&b.phase) == std::mem::discriminant(&phase));
            let since = same.map_or_else(seconds_now, |b| b.since);
            Some(ProjectStatus { project, phase, since, measuring: tracked.is_measuring() })
        });
        let more = notices.len().checked_sub(NOTICES + 1).map(|n| format!("and {} more: see the log", n + 1));
        Status {
            version: 1,
            pid: std::process::id(),
            host: host(),
            notices: notices.iter().take(NOTICES).cloned().chain(more).collect(),
            projects: lines.collect(),
        }
    }
}

fn seconds_now() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs())
}

/// Projects by state, and how far each is that has depth maps, in Prometheus' text format.
fn metrics_text(projects: &BTreeMap<PathBuf, Tracked>) -> String {
    let mut counts: BTreeMap<&str, usize> =
        ["waiting", "queued", "planning", "planned", "computing", "reached", "failed"].map(|name| (name, 0)).into();
    let phases: Vec<(&PathBuf, Phase)> = projects.iter().map(|(root, tracked)| (root, tracked.phase())).collect();
    for (_, phase) in &phases {
        *counts.entry(name_of(phase)).or_default() += 1;
    }
    let mut text = String::from("# HELP viewrank_projects Projects by state.\n# TYPE viewrank_projects gauge\n");
    for (state, count) in counts {
        text += &format!("viewrank_projects{{state=\"{state}\"}} {count}\n");
    }
    let mut gauge = |name: &str, help: &str, value: fn(&Phase) -> Option<f64>| {
        text += &format!("# HELP {name} {help}\n# TYPE {name} gauge\n");
        for (root, value) in phases.iter().filter_map(|(root, phase)| Some((root, value(phase)?))) {
            text += &format!("{name}{{project=\"{}\"}} {value}\n", label(root));
        }
    };
    gauge("viewrank_depth_maps_done", "Key views with a depth map.", |phase| match phase {
        Phase::Computing { done, .. } | Phase::Reached { done, .. } => Some(*done as f64),
        _ => None,
    });
    gauge("viewrank_depth_maps_wanted", "Key views to the cut, and those beyond it that have a depth map.", |phase| {
        match phase {
            Phase::Computing { clusters, .. } | Phase::Reached { clusters, .. } => Some(*clusters as f64),
            _ => None,
        }
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

/// Where the status of a root is.
pub fn status_file(root: &Path) -> PathBuf {
    root.join(STATUS)
}

/// Reads the status of a root; `None` where no daemon ever watched it, or where it can't be read.
pub fn read_status(root: &Path) -> Option<Line> {
    let text = output::read_own(root, STATUS).ok()?;
    let status = serde_json::from_slice(&text).ok()?;
    Some(Line { running: Holder::of(root).is_some(), status })
}

#[cfg(test)]
mod tests {
    use super::*;

    const NONE: &BTreeMap<PathBuf, Tracked> = &BTreeMap::new();

    fn files(roots: &[&tempfile::TempDir], metrics: Option<PathBuf>) -> StatusFiles {
        let take = |root: &&tempfile::TempDir| Holder::take(root.path(), &Disk::REAL).expect("nobody else");
        StatusFiles::new(roots.iter().map(take).collect(), metrics, &Disk::REAL).expect("a disk")
    }

    fn notices(root: &tempfile::TempDir) -> Vec<String> {
        read_status(root.path()).expect("a status").status.notices
    }

    #[test]
    fn a_root_that_is_gone_or_cannot_be_written_keeps_no_other_from_being_told() {
        let [gone, broken, well] = std::array::from_fn(|_| tempfile::tempdir().expect("a temporary folder"));
        let mut files = files(&[&gone, &broken, &well], None);
        std::fs::remove_dir_all(gone.path()).expect("removed");
        let status = broken.path().join("viewrank/status.json");
        std::fs::create_dir_all(status.join("in the way")).expect("a folder");
        let mut now = Instant::now();
        for text in ["a", "b"] {
            files.notice(text.into());
            files.publish(NONE, &Disk::REAL, now, false);
            assert_eq!(notices(&well).last().map(String::as_str), Some(text));
            now += PAUSE;
        }
        assert_eq!(files.due(), Some(now - PAUSE * 2 + RETRY), "the broken one");
        std::fs::remove_dir_all(&status).expect("removed");
        files.publish(NONE, &Disk::REAL, now + RETRY, false);
        assert_eq!((notices(&broken).len(), files.due()), (2, None));
    }

    #[test]
    fn notices_last_as_long_as_they_hold() {
        let root = tempfile::tempdir().expect("a temporary folder");
        let mut files = files(&[&root], None);
        let publish = |texts: &[&str], files: &mut StatusFiles| {
            files.begin_scan();
            texts.iter().for_each(|text| files.notice((*text).into()));
            files.publish(NONE, &Disk::REAL, Instant::now(), true);
        };
        publish(&["a", "b", "a"], &mut files);
        assert_eq!(notices(&root), ["a", "b"]);
        publish(&["b", "c"], &mut files);
        assert_eq!(notices(&root), ["b", "c"]);
        let many: Vec<String> = (0..NOTICES + 5).map(|i| i.to_string()).collect();
        publish(&many.iter().map(String::as_str).collect::<Vec<_>>(), &mut files);
        assert_eq!((notices(&root).len(), notices(&root)[NOTICES].as_str()), (NOTICES + 1, "and 5 more: see the log"));
    }

    #[test]
    fn metrics_that_cannot_be_written_are_refused_at_the_start() {
        let root = tempfile::tempdir().expect("a temporary folder");
        let holder = Holder::take(root.path(), &Disk::REAL).expect("nobody else");
        let metrics = root.path().join("no folder/viewrank.prom");
        assert!(StatusFiles::new(vec![holder], Some(metrics), &Disk::REAL).is_err());
    }

    #[test]
    fn a_root_is_refused_where_one_around_it_or_in_it_is_held() {
        let root = tempfile::tempdir().expect("a temporary folder");
        let (inner, above) = (root.path().join("a/b"), root.path().join("a"));
        std::fs::create_dir_all(inner.join("c")).expect("a folder");
        let _holder = Holder::take(&inner, &Disk::REAL).expect("nobody else");
        for path in [root.path(), &above, &inner, &inner.join("c")] {
            let held = Holder::take(path, &Disk::REAL).err();
            assert!(matches!(held, Some(DaemonError::Held { path, .. }) if path == inner), "{}", path.display());
        }
    }
}
