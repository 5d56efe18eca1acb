//! The status file `ROOT/viewrank/status.json`, the metrics, and the lock of a watched root.

use std::{
    collections::BTreeMap,
    fs::{File, TryLockError},
    path::{Path, PathBuf},
    thread,
    time::{Duration, Instant, SystemTime, UNIX_EPOCH},
};

use tracing::warn;

use super::{
    DaemonError,
    discover::{self, OUTPUT_FOLDER},
    phase::{Phase, ProjectStatus, STATUS_VERSION, Status},
    platform::host,
    state::TrackedProject,
};
use crate::{
    base::{error::shortened, input::FileKind},
    io::{
        output::{self, Disk},
        project::slashes,
    },
};

/// Shortest time between two writes of the status.
const PAUSE: Duration = Duration::from_secs(1);
/// Pause before a failed write is retried.
const RETRY: Duration = Duration::from_secs(10);
/// Tries to take a lock, which others may hold for an instant.
const TRIES: u32 = 20;
/// Time between two of them.
const INSTANT: Duration = Duration::from_millis(10);
/// The lock in a root's folder `viewrank`.
const LOCK: &str = "watch.lock";
const STATUS_FILE: &str = "status.json";
/// Limit of notices in the status.
const NOTICES: usize = 20;

/// Lock on a root, released on drop or when the process ends, however it ends. The file is locked
/// and never written: it may be a second name of any file.
pub struct Holder {
    /// Canonical path.
    pub root: PathBuf,
    _lock: File,
}

impl Holder {
    /// Locks the root.
    ///
    /// # Errors
    /// [`DaemonError::Held`] where a daemon holds the root, a folder above it or one in it.
    pub fn take(root: &Path, disk: &Disk) -> Result<Self, DaemonError> {
        let error = |path: &Path| DaemonError::Held {
            path: path.into(),
            holder: holder(path),
        };
        // If one root is inside the other, both daemons would plan the same projects.
        let held = |path: &Path| Self::is_held(path).then(|| error(path));
        let inside = discover::walk(root, &[root.to_path_buf()], false, &|| {});
        let inside = inside
            .folders
            .iter()
            .chain(&inside.projects)
            .map(PathBuf::as_path);
        if let Some(error) = root.ancestors().chain(inside).find_map(held) {
            return Err(error);
        }
        let lock = output::make_own_folder(root, disk)?.lock_file(LOCK)?;
        // A process that only queries the holder of the root locks it for an instant.
        for _ in 0..TRIES {
            match lock.try_lock() {
                Err(TryLockError::WouldBlock) => thread::sleep(INSTANT),
                locked => {
                    // A file system without locks must not keep the daemon from its work.
                    if let Err(TryLockError::Error(error)) = locked {
                        warn!(
                            "cannot lock {}: {error}; make sure that no other daemon watches it",
                            root.display()
                        );
                    }
                    return Ok(Self {
                        root: root.into(),
                        _lock: lock,
                    });
                }
            }
        }
        Err(error(root))
    }

    /// True unless the lock was removed, such as with the output folder.
    fn is_there(&self) -> bool {
        self.root
            .join(OUTPUT_FOLDER)
            .join(LOCK)
            .symlink_metadata()
            .is_ok_and(|found| found.is_file())
    }

    /// Locks the root again if the lock is gone.
    fn renew(&mut self, disk: &Disk) -> Result<(), DaemonError> {
        if self.root.is_dir() && !self.is_there() {
            *self = Self::take(&self.root, disk)?;
        }
        Ok(())
    }

    /// Returns whether a daemon holds the root now, and not only for an instant: a process that it
    /// was just starting when it ended has a copy of its lock until then.
    fn is_held(root: &Path) -> bool {
        let name = format!("{OUTPUT_FOLDER}/{LOCK}");
        let Ok(lock) = output::open_own(root, &name) else {
            return false;
        };
        (0..TRIES).all(|_| {
            // Shared, since several processes may ask at once.
            let is_held = matches!(lock.try_lock_shared(), Err(TryLockError::WouldBlock));
            if is_held {
                thread::sleep(INSTANT);
            }
            is_held
        })
    }
}

/// The daemon that holds a root, as its status names it: in the first moment of a new daemon, the
/// one before.
fn holder(root: &Path) -> String {
    match status(root) {
        Some(Status { pid, host, .. }) => format!("process {pid} on {host}"),
        None => "another process".into(),
    }
}

/// Writer of the status files of all roots and of the metrics.
pub struct StatusFiles {
    roots: Vec<RootStatus>,
    metrics: Option<Metrics>,
    /// Notices since the last full scan.
    notices: Vec<String>,
    /// Notices of the scan before that.
    earlier: Vec<String>,
    due: Option<Instant>,
}

/// A root and its last written status.
struct RootStatus {
    holder: Holder,
    written: Status,
    pace: Pace,
}

/// The metrics file.
struct Metrics {
    path: PathBuf,
    /// The file is up to date.
    fresh: bool,
    pace: Pace,
}

impl StatusFiles {
    /// # Errors
    /// Metrics that can't be written.
    pub fn new(
        roots: Vec<Holder>,
        metrics: Option<PathBuf>,
        disk: &Disk,
    ) -> Result<Self, DaemonError> {
        let root = |holder| RootStatus {
            holder,
            written: Status::default(),
            pace: Pace::default(),
        };
        // Written at once: a path that cannot be written ends the start and does not fill the log.
        if let Some(path) = &metrics {
            let text = metrics_text(&BTreeMap::new());
            output::replace(path, text.as_bytes(), disk).map_err(DaemonError::Metrics)?;
        }
        Ok(Self {
            roots: roots.into_iter().map(root).collect(),
            metrics: metrics.map(|path| Metrics {
                path,
                fresh: false,
                pace: Pace::default(),
            }),
            notices: Vec::new(),
            earlier: Vec::new(),
            due: None,
        })
    }

    /// Begins a full scan: notices that aren't repeated expire.
    pub fn begin_scan(&mut self) {
        self.earlier = std::mem::take(&mut self.notices);
    }

    /// Adds a notice, and logs it if it is new since the last full scan.
    pub fn notice(&mut self, text: String) {
        let text = shortened(&text).into_owned();
        if self.notices.contains(&text) {
            return;
        }
        if !self.earlier.contains(&text) {
            warn!("{text}");
        }
        self.notices.push(text);
    }

    /// Returns when a delayed change must be written.
    pub fn due(&self) -> Option<Instant> {
        self.due
    }

    /// Writes the files that changed, each at most once a second unless this is the `last` call.
    /// Failed writes are retried.
    pub fn publish(
        &mut self,
        projects: &BTreeMap<PathBuf, TrackedProject>,
        disk: &Disk,
        now: Instant,
        last: bool,
    ) {
        self.due = None;
        let mut wait =
            |until: Option<Instant>| self.due = [self.due, until].into_iter().flatten().min();
        for root in &mut self.roots {
            let fresh = root.status(projects, &self.notices);
            // A root that is gone has no status until it comes back.
            if fresh == root.written && root.holder.is_there() || !root.holder.root.is_dir() {
                root.pace.rest();
                continue;
            }
            if let Some(metrics) = &mut self.metrics {
                metrics.fresh = false;
            }
            let write = || write_status(&mut root.holder, &fresh, disk);
            if root.pace.write(now, last, write) {
                root.written = fresh;
            } else {
                wait(root.pace.next);
            }
        }
        if let Some(metrics) = self.metrics.as_mut().filter(|metrics| !metrics.fresh) {
            let Metrics { path, pace, .. } = metrics;
            let text = || metrics_text(projects);
            metrics.fresh = pace.write(now, last, || {
                Ok(output::replace(path, text().as_bytes(), disk)?)
            });
            wait(metrics.pace.next.filter(|_| !metrics.fresh));
        }
    }
}

/// Limits how often a file is written.
#[derive(Default)]
struct Pace {
    next: Option<Instant>,
    /// The last error, logged once.
    failure: Option<String>,
}

impl Pace {
    /// Lets the next change be written at once, because there was nothing to write.
    fn rest(&mut self) {
        self.next = None;
    }

    /// Writes if enough time has passed; true on success.
    fn write(
        &mut self,
        now: Instant,
        last: bool,
        write: impl FnOnce() -> Result<(), DaemonError>,
    ) -> bool {
        if self.next.is_some_and(|at| now < at) && !last {
            return false;
        }
        let failure = write().err().map(|error| error.to_string());
        if let Some(text) = failure.as_ref().filter(|_| failure != self.failure) {
            warn!("cannot write status: {text}");
        }
        self.next = Some(now + if failure.is_none() { PAUSE } else { RETRY });
        self.failure = failure;
        self.failure.is_none()
    }
}

fn write_status(holder: &mut Holder, status: &Status, disk: &Disk) -> Result<(), DaemonError> {
    holder.renew(disk)?;
    let text = serde_json::to_vec_pretty(status).unwrap_or_default();
    Ok(output::replace_in(
        &output::make_own_folder(&holder.root, disk)?,
        STATUS_FILE,
        &text,
        disk,
    )?)
}

impl RootStatus {
    fn status(&self, projects: &BTreeMap<PathBuf, TrackedProject>, notices: &[String]) -> Status {
        let mut before = self.written.projects.iter().peekable();
        let lines = projects.values().filter_map(|tracked| {
            let relative = tracked.root.strip_prefix(&self.holder.root).ok()?;
            let project = if relative.as_os_str().is_empty() {
                ".".into()
            } else {
                slashes(relative)
            };
            // Compared as paths, as the projects are sorted: as text, `a-b` comes before `a/b`.
            while before
                .peek()
                .is_some_and(|b| Path::new(&b.project) < Path::new(&project))
            {
                before.next();
            }
            let phase = tracked.phase();
            let same = before.peek().filter(|b| {
                b.project == project
                    // A phase that only counts on keeps its start.
                    && std::mem::discriminant(&b.phase) == std::mem::discriminant(&phase)
            });
            let since = same.map_or_else(seconds_now, |b| b.since);
            Some(ProjectStatus {
                project,
                phase,
                since,
                measuring: tracked.is_measuring(),
            })
        });
        let more = notices
            .len()
            .checked_sub(NOTICES + 1)
            .map(|n| format!("and {} more: see the log", n + 1));
        Status {
            version: STATUS_VERSION,
            pid: std::process::id(),
            host: host(),
            notices: notices.iter().take(NOTICES).cloned().chain(more).collect(),
            projects: lines.collect(),
        }
    }
}

fn seconds_now() -> u64 {
    SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .map_or(0, |d| d.as_secs())
}

/// Formats the number of projects by state and the progress of those with depth maps as Prometheus
/// text.
fn metrics_text(projects: &BTreeMap<PathBuf, TrackedProject>) -> String {
    // With states of no project, too: to Prometheus, a missing series is not a zero.
    let mut counts: BTreeMap<&str, usize> = [
        "waiting", "queued", "planning", "planned", "partial", "reached", "failed",
    ]
    .map(|name| (name, 0))
    .into();
    let phases: Vec<(&PathBuf, Phase)> = projects
        .iter()
        .map(|(root, tracked)| (root, tracked.phase()))
        .collect();
    for (_, phase) in &phases {
        *counts.entry(name_of(phase)).or_default() += 1;
    }
    let mut text = String::from(
        "# HELP viewrank_projects Projects by state.\n# TYPE viewrank_projects gauge\n",
    );
    for (state, count) in counts {
        text += &format!("viewrank_projects{{state=\"{state}\"}} {count}\n");
    }
    for Gauge { name, help, value } in GAUGES {
        text += &format!("# HELP {name} {help}\n# TYPE {name} gauge\n");
        let values = phases
            .iter()
            .filter_map(|(root, phase)| Some((root, value(phase)?)));
        for (root, value) in values {
            text += &format!("{name}{{project=\"{}\"}} {value}\n", label(root));
        }
    }
    text
}

/// A number that each project with depth maps has.
struct Gauge {
    name: &'static str,
    help: &'static str,
    value: fn(&Phase) -> Option<f64>,
}

const GAUGES: [Gauge; 3] = [
    Gauge {
        name: "viewrank_depth_maps_done",
        help: "Key views with a depth map.",
        value: |phase| match phase {
            Phase::Partial { done, .. } | Phase::Reached { done, .. } => Some(*done as f64),
            _ => None,
        },
    },
    Gauge {
        name: "viewrank_depth_maps_wanted",
        help: "Key views to the cut, and those beyond it that have a depth map.",
        value: |phase| match phase {
            Phase::Partial { clusters, .. } | Phase::Reached { clusters, .. } => {
                Some(*clusters as f64)
            }
            _ => None,
        },
    },
    Gauge {
        name: "viewrank_share_reached",
        help: "What fusion keeps of the finished depth maps over what it would of all.",
        value: |phase| match phase {
            Phase::Partial { share, .. } => *share,
            Phase::Reached { share, .. } => Some(*share),
            _ => None,
        },
    },
];

/// Escapes a path for the value of a label.
fn label(path: &Path) -> String {
    path.to_string_lossy()
        .replace('\\', "\\\\")
        .replace('"', "\\\"")
        .replace('\n', "\\n")
}

fn name_of(phase: &Phase) -> &'static str {
    match phase {
        Phase::Waiting { .. } => "waiting",
        Phase::Queued { .. } => "queued",
        Phase::Planning { .. } => "planning",
        Phase::Planned { .. } => "planned",
        Phase::Partial { .. } => "partial",
        Phase::Reached { .. } => "reached",
        Phase::Failed { .. } => "failed",
    }
}

/// The last written status of a root, and whether a daemon runs there now.
#[derive(Debug, PartialEq)]
pub struct Line {
    pub running: bool,
    pub status: Status,
}

/// Path of the status file of a root.
pub fn status_file(root: &Path) -> PathBuf {
    root.join(OUTPUT_FOLDER).join(STATUS_FILE)
}

/// Reads the status of a root; `None` where no daemon has watched it yet or the file can't be read.
pub fn read_status(root: &Path) -> Option<Line> {
    status(root).map(|status| Line {
        running: Holder::is_held(root),
        status,
    })
}

fn status(root: &Path) -> Option<Status> {
    let name = format!("{OUTPUT_FOLDER}/{STATUS_FILE}");
    serde_json::from_slice(&output::read_own(root, &name, FileKind::Record).ok()?).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    const NONE: &BTreeMap<PathBuf, TrackedProject> = &BTreeMap::new();

    fn files(roots: &[&tempfile::TempDir], metrics: Option<PathBuf>) -> StatusFiles {
        let take = |root: &&tempfile::TempDir| {
            Holder::take(root.path(), &Disk::REAL).expect("nobody else")
        };
        StatusFiles::new(roots.iter().map(take).collect(), metrics, &Disk::REAL).expect("a disk")
    }

    fn notices(root: &tempfile::TempDir) -> Vec<String> {
        read_status(root.path()).expect("a status").status.notices
    }

    #[test]
    fn a_root_that_is_gone_or_not_writable_does_not_delay_the_status_of_others() {
        let [gone, broken, well] =
            std::array::from_fn(|_| tempfile::tempdir().expect("a temporary folder"));
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
    fn notices_expire_unless_a_full_scan_repeats_them() {
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
        publish(
            &many.iter().map(String::as_str).collect::<Vec<_>>(),
            &mut files,
        );
        assert_eq!(
            (notices(&root).len(), notices(&root)[NOTICES].as_str()),
            (NOTICES + 1, "and 5 more: see the log")
        );
    }

    #[test]
    fn metrics_that_cannot_be_written_are_an_error_at_the_start() {
        let root = tempfile::tempdir().expect("a temporary folder");
        let holder = Holder::take(root.path(), &Disk::REAL).expect("nobody else");
        let metrics = root.path().join("no folder/viewrank.prom");
        assert!(StatusFiles::new(vec![holder], Some(metrics), &Disk::REAL).is_err());
    }

    #[test]
    fn a_root_is_refused_if_one_above_or_inside_it_is_held() {
        let root = tempfile::tempdir().expect("a temporary folder");
        let (inner, above) = (root.path().join("a/b"), root.path().join("a"));
        std::fs::create_dir_all(inner.join("c")).expect("a folder");
        let _holder = Holder::take(&inner, &Disk::REAL).expect("nobody else");
        for path in [root.path(), &above, &inner, &inner.join("c")] {
            let held = Holder::take(path, &Disk::REAL).err();
            assert!(
                matches!(held, Some(DaemonError::Held { path, .. }) if path == inner),
                "{}",
                path.display()
            );
        }
    }
}
