//! Jobs in processes of their own: a plan that runs out of memory or stack, or that the system
//! kills, ends its process and not the daemon.
//!
//! A worker is this program again with the daemon's arguments, and so with its options. It reads a
//! request per line of JSON from standard input, writes progress and outcomes to standard output,
//! logs to standard error like the daemon, and ends when its input does: with the daemon, however
//! that ends. It serves one job at a time and keeps its caches between them.

use std::{
    ffi::OsString,
    io::{self, BufRead, BufReader, Write},
    path::{Path, PathBuf},
    process::{Child, Command, ExitStatus, Stdio},
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, Ordering},
        mpsc::{Receiver, RecvTimeoutError, Sender, channel},
    },
    thread,
    time::{Duration, Instant},
};

use serde::{Deserialize, Serialize};

use super::{
    Job, PlanJob, Planner,
    follow::failed,
    maps::MapFiles,
    planner::outcome_of,
    platform,
    settle::{Entry, Stamp, lock},
    state::{OnBusy, Outcome, Work},
};
use crate::base::{
    error::{Advice, Hint},
    shell::command_path,
};

/// Interval at which a waiting daemon notices that a job was cancelled.
const PAUSE: Duration = Duration::from_millis(50);
/// Longest time of a job: settings that ask for far too much would keep all other projects waiting.
/// A plan of 10,000 views takes less than a tenth of it on two cores.
const LONGEST: Duration = Duration::from_secs(3 * 60 * 60);

/// A line to a worker. Paths are as the system has them, for not all are text.
#[derive(Debug, Serialize, Deserialize)]
enum Request {
    Job(JobRequest),
    /// Cancels the job.
    Cancel,
    /// Drops the caches of a project.
    Forget(OsString),
}

/// The fields of a [`Job`] that the worker cannot read itself.
#[derive(Debug, Serialize, Deserialize)]
struct JobRequest {
    work: Work,
    project: OsString,
    on_busy: OnBusy,
    maps: Vec<(OsString, Entry)>,
    most_memory: Option<u64>,
}

impl JobRequest {
    fn new(work: Work, job: &Job) -> Self {
        Self {
            work,
            project: job.project.into(),
            on_busy: job.on_busy,
            maps: job
                .maps
                .iter()
                .map(|(path, entry)| (path.into(), *entry))
                .collect(),
            most_memory: job.most_memory,
        }
    }

    /// Does the job. Its stamp is read here and so no older than the daemon's: input that has
    /// changed since then is planned once more.
    fn perform(self, planner: &PlanJob, follow_links: bool, cancel: &AtomicBool) -> Outcome {
        let project = PathBuf::from(self.project);
        let named = planner.named_files(&project);
        let job = Job {
            project: &project,
            stamp: &Stamp::read(&project, follow_links).with(&named),
            named: &named,
            on_busy: self.on_busy,
            follow_links,
            maps: &self
                .maps
                .into_iter()
                .map(|(path, entry)| (path.into(), entry))
                .collect::<MapFiles>(),
            most_memory: self.most_memory,
            cancel,
            progress: &|stage, percent| report(&Report::Progress(stage.into(), percent)),
        };
        outcome_of(planner, self.work, &job)
    }
}

/// A line from a worker.
#[derive(Debug, Serialize, Deserialize)]
enum Report {
    /// Stage and percent.
    Progress(String, u8),
    Ended(Outcome),
}

/// Fails only without the daemon, and then the worker ends, too.
#[expect(
    clippy::disallowed_methods,
    reason = "JSON for the daemon, not text for a terminal"
)]
fn report(report: &Report) {
    _ = write_line(&mut io::stdout().lock(), report);
}

fn write_line(to: &mut impl Write, line: &impl Serialize) -> io::Result<()> {
    let mut text = serde_json::to_vec(line)?;
    text.push(b'\n');
    to.write_all(&text)?;
    to.flush()
}

/// Works for the daemon that started this process. `end` is called when it is gone, perhaps during
/// a job, and ends the process.
pub fn serve(planner: &PlanJob, follow_links: bool, end: impl FnOnce() + Send + 'static) {
    platform::prefer_to_be_killed();
    let (sender, requests) = channel();
    // In a thread of its own, so that a cancellation arrives during a job.
    thread::spawn(move || {
        receive(&sender);
        end();
    });
    for (request, cancel) in requests {
        match request {
            Request::Job(job) => {
                report(&Report::Ended(job.perform(planner, follow_links, &cancel)))
            }
            Request::Forget(project) => planner.forget(Path::new(&project)),
            Request::Cancel => {}
        }
    }
}

/// Passes requests on, each with the flag that cancels it, until there are no more.
fn receive(jobs: &Sender<(Request, Arc<AtomicBool>)>) {
    let mut current = Arc::new(AtomicBool::new(false));
    for line in io::stdin().lines() {
        let Ok(request) = line.and_then(|line| Ok(serde_json::from_str(&line)?)) else {
            return;
        };
        match request {
            Request::Cancel => current.store(true, Ordering::Relaxed),
            request => {
                current = Arc::default();
                if jobs.send((request, current.clone())).is_err() {
                    return;
                }
            }
        }
    }
}

/// Planner that lets workers plan and measure, as many as there are jobs at once.
pub struct Workers {
    /// Looks up what the daemon asks itself.
    planner: PlanJob,
    /// Starts a worker.
    command: Mutex<Command>,
    idle: Mutex<Vec<Worker>>,
    /// Time after which a job is ended.
    longest: Duration,
}

impl Workers {
    /// `command` starts a process that calls [`serve`].
    pub fn new(planner: PlanJob, command: Command) -> Self {
        Self {
            planner,
            command: Mutex::new(command),
            idle: Mutex::default(),
            longest: LONGEST,
        }
    }

    /// Returns an idle worker, best the one that has served the project last, or starts one.
    fn take(&self, project: &Path) -> io::Result<Worker> {
        let mut idle = lock(&self.idle);
        // One that was killed while it was idle must not get a job.
        idle.retain_mut(|worker| matches!(worker.process.try_wait(), Ok(None)));
        match idle
            .iter()
            .position(|worker| worker.project == project)
            .or(idle.len().checked_sub(1))
        {
            Some(at) => Ok(idle.remove(at)),
            None => Worker::start(&mut lock(&self.command)),
        }
    }

    fn perform(&self, work: Work, job: &Job) -> Outcome {
        let mut worker = match self.take(job.project) {
            Ok(worker) => worker,
            Err(error) => return failed(NoWorker(error)),
        };
        let until = Instant::now() + self.longest;
        match worker.perform(work, job, until) {
            Some(outcome) => {
                worker.project = job.project.into();
                lock(&self.idle).push(worker);
                outcome
            }
            None if job.is_cancelled() => Outcome::Abandoned,
            None if Instant::now() >= until => too_long(self.longest, job.project),
            None => lost(worker.process.wait().ok(), job.project),
        }
    }
}

impl Planner for Workers {
    fn named_files(&self, project: &Path) -> Vec<PathBuf> {
        self.planner.named_files(project)
    }

    fn has_plan(&self, project: &Path) -> bool {
        self.planner.has_plan(project)
    }

    fn plan(&self, job: &Job) -> Outcome {
        self.perform(Work::Plan, job)
    }

    fn follow(&self, job: &Job) -> Outcome {
        self.perform(Work::Follow, job)
    }

    fn forget(&self, project: &Path) {
        self.planner.forget(project);
        lock(&self.idle)
            .iter_mut()
            .for_each(|worker| _ = worker.send(&Request::Forget(project.into())));
    }
}

/// A process that serves jobs.
#[derive(Debug)]
struct Worker {
    process: Child,
    reports: Receiver<Report>,
    /// The project of its last job.
    project: PathBuf,
}

impl Worker {
    fn start(command: &mut Command) -> io::Result<Self> {
        let mut process = command
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()?;
        let (sender, reports) = channel();
        let output = process.stdout.take().ok_or(io::ErrorKind::BrokenPipe)?;
        thread::spawn(move || {
            let reports = BufReader::new(output)
                .lines()
                .map_while(|line| serde_json::from_str(&line.ok()?).ok());
            // Fails once nobody waits for reports any more.
            reports
                .map_while(|report: Report| sender.send(report).ok())
                .for_each(drop);
        });
        Ok(Self {
            process,
            reports,
            project: PathBuf::new(),
        })
    }

    fn send(&mut self, request: &Request) -> io::Result<()> {
        self.process
            .stdin
            .as_mut()
            .map_or(Ok(()), |input| write_line(input, request))
    }

    /// Returns the outcome of the job; `None` if the process has ended, or was ended at this time.
    fn perform(&mut self, work: Work, job: &Job, until: Instant) -> Option<Outcome> {
        self.send(&Request::Job(JobRequest::new(work, job))).ok()?;
        let mut is_cancelled = false;
        loop {
            match self.reports.recv_timeout(PAUSE) {
                Ok(Report::Progress(stage, percent)) => (job.progress)(&stage, percent),
                Ok(Report::Ended(outcome)) => return Some(outcome),
                Err(RecvTimeoutError::Disconnected) => return None,
                Err(RecvTimeoutError::Timeout) => {}
            }
            if Instant::now() >= until {
                // Where it cannot be ended, it has ended.
                _ = self.process.kill();
                return None;
            }
            if !is_cancelled && job.is_cancelled() {
                is_cancelled = true;
                self.send(&Request::Cancel).ok()?;
            }
        }
    }
}

impl Drop for Worker {
    /// Ends the process, by the end of its input.
    fn drop(&mut self) {
        // `wait` closes its standard input first.
        _ = self.process.wait();
    }
}

/// Outcome of a job whose process has ended.
fn lost(status: Option<ExitStatus>, project: &Path) -> Outcome {
    // A process that ends by itself has said why in the log.
    let cause = if status.is_some_and(|status| status.code().is_some()) {
        ""
    } else {
        ": no memory, perhaps, or a damaged file"
    };
    let status = status.map_or("unknown".into(), |status| status.to_string());
    Outcome::Aside {
        reason: format!("the process that worked on it ended ({status}){cause}"),
        hint: Some(format!(
            "see the log, or run viewrank plan {}",
            command_path(project)
        )),
    }
}

/// Outcome of a job that was ended because others wait.
fn too_long(longest: Duration, project: &Path) -> Outcome {
    Outcome::Aside {
        reason: format!(
            "it took longer than {} hours and was ended",
            longest.as_secs() / 3600
        ),
        hint: Some(format!(
            "ask for less in its settings (target.gsd, visibility), or run viewrank plan {}, which may take any time",
            command_path(project)
        )),
    }
}

#[derive(Debug, thiserror::Error)]
#[error("cannot start a process to plan in: {0}")]
struct NoWorker(io::Error);

impl Hint for NoWorker {
    fn hint(&self) -> Option<Advice> {
        Some("start viewrank watch again if it was updated or moved".into())
    }
}

#[cfg(all(test, unix))]
mod tests {
    use std::{os::unix::ffi::OsStringExt, sync::atomic::AtomicBool};

    use super::*;
    use crate::daemon::PlanOptions;

    #[test]
    fn requests_keep_paths_that_are_not_text() {
        let project = PathBuf::from(OsString::from_vec(b"/r/\xff\n".to_vec()));
        let maps: MapFiles = [(project.join("a.npy"), Entry::of_length(7))].into();
        let job = Job {
            project: &project,
            stamp: &Stamp::default(),
            named: &[],
            on_busy: OnBusy::Queue,
            follow_links: false,
            maps: &maps,
            most_memory: Some(u64::MAX),
            cancel: &AtomicBool::new(false),
            progress: &|_, _| {},
        };
        let mut line = Vec::new();
        write_line(
            &mut line,
            &Request::Job(JobRequest::new(Work::Follow, &job)),
        )
        .unwrap();
        assert_eq!(line.iter().filter(|byte| **byte == b'\n').count(), 1);
        let Ok(Request::Job(read)) = serde_json::from_slice(&line) else {
            panic!("a job")
        };
        assert_eq!(
            (read.work, read.on_busy, read.most_memory),
            (Work::Follow, OnBusy::Queue, Some(u64::MAX))
        );
        assert_eq!(Path::new(&read.project), project);
        assert_eq!(
            read.maps
                .into_iter()
                .map(|(path, entry)| (path.into(), entry))
                .collect::<MapFiles>(),
            maps
        );
    }

    #[test]
    fn a_process_that_ends_without_an_answer_sets_the_project_aside() {
        let options = PlanOptions {
            on_target: None,
            replan: false,
            cache: 0,
            follow_links: false,
            roots: Vec::new(),
            typed: Default::default(),
            is_run: false,
        };
        let folder = tempfile::tempdir().unwrap();
        let outcome = |script: &str, longest: Duration| {
            let mut command = Command::new("sh");
            command.args(["-c", script]);
            let job = Job {
                project: folder.path(),
                stamp: &Stamp::default(),
                named: &[],
                on_busy: OnBusy::Restart,
                follow_links: false,
                maps: &MapFiles::new(),
                most_memory: None,
                cancel: &AtomicBool::new(false),
                progress: &|_, _| {},
            };
            let mut workers = Workers::new(PlanJob::new(options.clone()), command);
            workers.longest = longest;
            workers.plan(&job)
        };
        for (script, status) in [
            ("kill -ABRT $$", "signal: 6"),
            ("kill -KILL $$", "signal: 9"),
            ("read line; exit 7", "exit status: 7"),
            ("echo nonsense", ""),
        ] {
            let Outcome::Aside { reason, .. } = outcome(script, LONGEST) else {
                panic!("{script}")
            };
            assert!(reason.contains(status), "{reason}");
        }
        let answer =
            r#"read line; echo '{"Progress":["read",3]}'; echo '{"Ended":"Abandoned"}'; read line"#;
        assert_eq!(outcome(answer, LONGEST), Outcome::Abandoned);
        let Outcome::Aside { reason, .. } = outcome("read line; sleep 60", 2 * PAUSE) else {
            panic!("it never ends")
        };
        assert!(reason.contains("longer"), "{reason}");
    }
}
