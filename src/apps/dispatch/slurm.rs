//! SLURM as the queue: finds queued tasks and decides which to cancel and submit.
//!
//! One job array whose indices are ranks; indices start in ascending order whatever the queue's
//! priorities are. Beyond the largest index that the queue accepts, further arrays follow, each
//! after the previous one. Jobs are identified by their names, which hold the project, the plan and
//! the array's first rank: no state is kept between calls. Each task is `viewrank run --rank N`.
//!
//! Run with SLURM 22.05 (Debian 12), hence: a single job with `--nice` needs backfill, which
//! `sched/builtin` lacks. The fusion depends on `afterany`, since with `afterok` it never runs once
//! a task has failed or was cancelled. Results are judged by files: `sbatch --wait` returns 0 for
//! tasks that failed to launch, accounting is not always there, and a finished task is listed only
//! for `MinJobAge`. Missing ranks are submitted again, since a requeued task waits two minutes;
//! `--requeue` is for lost nodes, with `--open-mode=append`, since a restart truncates the log. A
//! script is copied to a spool folder, so paths are absolute.

use std::{collections::BTreeSet, thread, time::Duration};

use super::{Dispatch, DispatchError, Task, Tools, hash};
use crate::{base::platform, config::DispatchSettings};

/// SLURM's default `MaxArraySize`, used if the queue cannot be asked.
const MAX_ARRAY_SIZE: usize = 1001;
/// SLURM's default `MaxJobCount`, used if the queue cannot be asked.
const MAX_JOB_COUNT: usize = 10_000;
/// SLURM's programs.
pub const COMMANDS: [&str; 4] = ["squeue", "scontrol", "sbatch", "scancel"];
/// Wait for cancelled tasks to leave the queue: number of polls, and the time between them.
const LOOKS: usize = 100;
const BETWEEN_LOOKS: Duration = Duration::from_millis(100);

/// Tasks, and how the queue is to run them.
#[derive(Clone, Copy)]
pub struct Request<'a> {
    pub dispatch: &'a Dispatch,
    pub tools: &'a Tools,
    pub settings: &'a DispatchSettings,
    /// The existing depth maps reach the target.
    pub reached: bool,
}

/// A task that is in the queue.
#[derive(Clone, Debug, PartialEq, Eq)]
struct QueuedTask {
    /// Job id of the array.
    job: String,
    /// Name of the plan that it is of.
    plan: String,
    rank: usize,
    pending: bool,
}

/// The queue's jobs of a project.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct SlurmQueue {
    /// Prefix of the names of the project's jobs.
    prefix: String,
    tasks: Vec<QueuedTask>,
    /// Jobs that join the depth maps; true if not yet started.
    fusions: Vec<(String, bool)>,
    /// Array indices range from 1 to this.
    max_index: usize,
    /// Total number of tasks that the queue accepts.
    max_jobs: usize,
}

/// A job array: consecutive ranks from `offset` + 1 on, those in `indices` (from 1).
#[derive(Clone, Debug, PartialEq, Eq)]
struct Array {
    offset: usize,
    indices: Vec<usize>,
}

/// A command for the queue.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Step {
    /// Cancels these tasks and jobs, which have not started.
    Cancel(Vec<String>),
    /// Submits an array that starts after those submitted before it.
    Array(Array),
    /// Submits the fusion, after all arrays and after these jobs.
    Fusion(Vec<String>),
}

/// The commands of a submission, or of a dry run.
#[derive(Clone, Debug, Default, serde::Serialize)]
pub struct Submission {
    /// Commands as typed in a shell.
    pub commands: Vec<Vec<String>>,
    /// Ranks submitted now.
    pub ranks: Vec<usize>,
    /// Ranks that were queued before.
    pub queued: Vec<usize>,
    /// Number of missing ranks that the queue had no room for.
    pub left: usize,
    /// Job ids of the arrays and the fusion.
    pub jobs: Vec<String>,
}

impl SlurmQueue {
    /// Returns a queue without jobs.
    pub fn empty(dispatch: &Dispatch) -> Self {
        let project = hash([&*dispatch.project.to_string_lossy()]);
        let prefix = format!("viewrank-{}-{}-", dispatch.backend, &project[..8]);
        Self {
            prefix,
            max_index: MAX_ARRAY_SIZE - 1,
            max_jobs: MAX_JOB_COUNT,
            ..Self::default()
        }
    }

    /// Queries the queue.
    pub fn read(dispatch: &Dispatch) -> Result<Self, DispatchError> {
        let mut queue = Self::empty(dispatch);
        let user = platform::user();
        // Without `-r`, the waiting tasks of an array are one line.
        queue.add_jobs(&run(&[
            "squeue", "-h", "-r", "-u", &user, "-o", "%i|%j|%T",
        ]
        .map(String::from))?);
        let configuration = run(&["scontrol", "show", "config"].map(String::from))?;
        let number = |name: &str| -> Option<usize> {
            let value = configuration
                .lines()
                .find_map(|line| line.strip_prefix(name)?.split('=').nth(1));
            value?.trim().parse().ok()
        };
        // MaxArraySize counts index 0, too. At least 1 stays: ranks are divided by it.
        queue.max_index = number("MaxArraySize").unwrap_or(MAX_ARRAY_SIZE).max(2) - 1;
        queue.max_jobs = number("MaxJobCount").unwrap_or(MAX_JOB_COUNT);
        Ok(queue)
    }

    /// Parses lines `JOB_INDEX|NAME|STATE`.
    fn add_jobs(&mut self, answer: &str) {
        for line in answer.lines() {
            let mut fields = line.trim().split('|');
            let (Some(id), Some(name), Some(state)) = (fields.next(), fields.next(), fields.next())
            else {
                continue;
            };
            match name
                .strip_prefix(&self.prefix)
                .map(|rest| rest.split_once('-'))
            {
                // Only the name of a fusion has neither plan nor rank.
                Some(None) => self.fusions.push((id.into(), state == "PENDING")),
                Some(Some((plan, offset))) => {
                    let index = id
                        .split_once('_')
                        .and_then(|(job, index)| Some((job, index.parse::<usize>().ok()?)));
                    let (Some((job, index)), Ok(offset)) = (index, offset.parse::<usize>()) else {
                        continue;
                    };
                    let (job, plan, pending) = (job.into(), plan.into(), state == "PENDING");
                    self.tasks.push(QueuedTask {
                        job,
                        plan,
                        rank: offset + index,
                        pending,
                    });
                }
                None => {}
            }
        }
    }

    /// Returns jobs with tasks that have not started, without duplicates.
    fn pending_jobs(&self) -> Vec<String> {
        let tasks = self
            .tasks
            .iter()
            .filter(|task| task.pending)
            .map(|task| &task.job);
        // The fusion, too: the tasks that it waits for are about to change.
        let fusions = self
            .fusions
            .iter()
            .filter(|fusion| fusion.1)
            .map(|fusion| &fusion.0);
        tasks
            .chain(fusions)
            .cloned()
            .collect::<BTreeSet<_>>()
            .into_iter()
            .collect()
    }

    fn jobs(&self) -> Vec<String> {
        self.tasks
            .iter()
            .map(|task| task.job.clone())
            .collect::<BTreeSet<_>>()
            .into_iter()
            .collect()
    }

    /// Returns the queued ranks of this plan.
    fn queued(&self, dispatch: &Dispatch) -> BTreeSet<usize> {
        let plan = dispatch.plan_name();
        self.tasks
            .iter()
            .filter(|task| task.plan == plan)
            .map(|task| task.rank)
            .collect()
    }

    /// Returns how many more tasks the queue accepts; one is reserved for the fusion.
    fn room(&self) -> usize {
        self.max_jobs
            .saturating_sub(self.tasks.len() + self.fusions.len() + 1)
    }

    /// Returns the next commands. A cancellation comes alone: the queue must be read again after
    /// it.
    fn steps(&self, dispatch: &Dispatch, missing: &[&Task], reached: bool) -> Vec<Step> {
        let queued = self.queued(dispatch);
        let ranks = missing.iter().map(|task| task.rank);
        let absent: Vec<usize> = ranks.filter(|rank| !queued.contains(rank)).collect();
        let plan = dispatch.plan_name();
        let is_outdated = |task: &QueuedTask| task.pending && task.plan != plan;
        let outdated = self.tasks.iter().any(is_outdated);
        let waiting = self.tasks.iter().any(|task| task.pending);
        // Missing ranks would start behind those that wait: all are queued again, in rank order.
        let cancels = if reached {
            waiting
        } else {
            outdated || !absent.is_empty() && !self.pending_jobs().is_empty()
        };
        if cancels {
            return vec![Step::Cancel(self.pending_jobs())];
        }
        let mut ranks = if reached { Vec::new() } else { absent };
        ranks.truncate(self.room());
        let mut steps: Vec<Step> = arrays(&ranks, self.max_index)
            .into_iter()
            .map(Step::Array)
            .collect();
        let more_comes = !steps.is_empty() || !self.tasks.is_empty();
        // A fusion that has started misses the maps that are still to come.
        let will_be_fused = self
            .fusions
            .iter()
            .any(|&(_, pending)| pending || !more_comes);
        if !will_be_fused && (more_comes || !dispatch.is_fused()) {
            steps.push(Step::Fusion(self.jobs()));
        }
        steps
    }

    /// Returns the commands that [`submit`] would run now.
    pub fn rehearse(mut self, request: Request) -> Submission {
        let Request {
            dispatch, reached, ..
        } = request;
        let missing = &request.missing();
        let mut submission = Submission::default();
        let mut steps = self.steps(dispatch, missing, reached);
        if let [cancel @ Step::Cancel(_)] = &steps[..] {
            submission
                .commands
                .push(self.command(&request, cancel, &[]));
            // As scancel will leave the queue: it removes only what has not started.
            self.tasks.retain(|task| !task.pending);
            self.fusions.retain(|&(_, pending)| !pending);
            steps = self.steps(dispatch, missing, reached);
        }
        submission.queued = self.queued(dispatch).into_iter().collect();
        for step in &steps {
            submission
                .commands
                .push(self.command(&request, step, &submission.jobs));
            submission.ranks.extend(step.ranks());
            submission
                .jobs
                .push(format!("JOB{}", submission.jobs.len() + 1));
        }
        submission.count_left(missing, reached);
        submission
    }

    fn command(&self, request: &Request, step: &Step, before: &[String]) -> Vec<String> {
        let Request {
            dispatch, settings, ..
        } = *request;
        let folder = dispatch.folder.display();
        // In the name of a log `%%` is a %.
        let logs = format!("{folder}/logs").replace('%', "%%");
        let mut command: Vec<String> = vec!["sbatch".into(), "--parsable".into()];
        let after = |jobs: &[String]| {
            (!jobs.is_empty()).then(|| format!("--dependency=afterany:{}", jobs.join(":")))
        };
        match step {
            Step::Cancel(jobs) => {
                return ["scancel".into(), "--state=PENDING".into()]
                    .into_iter()
                    .chain(jobs.iter().cloned())
                    .collect();
            }
            Step::Array(array) => {
                command.push(format!(
                    "--job-name={}{}-{}",
                    self.prefix,
                    dispatch.plan_name(),
                    array.offset
                ));
                command.push(format!("--array={}", array.specification(settings.at_once)));
                command.push(format!("--output={logs}/%A_%a.log"));
                // The tasks of a failed node go back to the queue.
                command.extend(["--open-mode=append".into(), "--requeue".into()]);
                command.extend(
                    settings
                        .time
                        // SLURM counts whole minutes, and takes 0 for no limit at all.
                        .map(|time| format!("--time={}", (time.0 / 60.0).ceil().max(1.0))),
                );
                command.extend(settings.gpus.map(|gpus| format!("--gres=gpu:{gpus}")));
                command.extend(after(before));
            }
            Step::Fusion(jobs) => {
                command.push(format!("--job-name={}fuse", self.prefix));
                command.push(format!("--output={logs}/fuse-%j.log"));
                command.extend(after(&[jobs, before].concat()));
            }
        }
        command.extend(resources(settings));
        command.push(format!("--chdir={}", dispatch.project.display()));
        command.extend(settings.options.iter().cloned());
        command.push(format!("--wrap={}", request.script(step)));
        command
    }
}

impl<'a> Request<'a> {
    /// Returns the tasks without a depth map, in rank order.
    fn missing(&self) -> Vec<&'a Task> {
        let tasks = self.dispatch.tasks.iter();
        tasks.filter(|task| !self.dispatch.is_done(task)).collect()
    }

    /// Returns the lines of sh that a job runs.
    fn script(&self, step: &Step) -> String {
        let Self {
            dispatch,
            tools,
            settings,
            ..
        } = *self;
        let setup = match settings.setup.trim_end() {
            "" => String::new(),
            lines => format!("{lines}\n"),
        };
        let environment = dispatch.environment(tools);
        let command = dispatch.command(&dispatch.project, tools, settings.cpus);
        let task = match step {
            Step::Array(array) => format!("--rank $(({} + SLURM_ARRAY_TASK_ID))", array.offset),
            _ => "--fuse".into(),
        };
        format!("{setup}{environment}exec {command} {task}")
    }
}

impl Submission {
    fn count_left(&mut self, missing: &[&Task], reached: bool) {
        let is_left =
            |task: &&&Task| !self.ranks.contains(&task.rank) && !self.queued.contains(&task.rank);
        self.left = if reached {
            0
        } else {
            missing.iter().filter(is_left).count()
        };
    }
}

impl Step {
    fn ranks(&self) -> Vec<usize> {
        match self {
            Self::Array(array) => array
                .indices
                .iter()
                .map(|index| array.offset + index)
                .collect(),
            _ => Vec::new(),
        }
    }
}

/// Submits the missing tasks that are not queued, in rank order, and the fusion after them. If the
/// target is reached, waiting tasks are cancelled.
///
/// `before_submission` is called once obsolete tasks are cancelled: it writes the export.
pub fn submit<E: From<DispatchError>>(
    request: Request,
    before_submission: impl FnOnce() -> Result<(), E>,
) -> Result<Submission, E> {
    let Request {
        dispatch, reached, ..
    } = request;
    let mut submission = Submission::default();
    for _ in 0..LOOKS {
        let queue = SlurmQueue::read(dispatch)?;
        // Checked after the queue: a task that ends in between then counts as done, not as missing.
        let missing = request.missing();
        let steps = queue.steps(dispatch, &missing, reached);
        if let [cancel @ Step::Cancel(_)] = &steps[..] {
            let command = queue.command(&request, cancel, &[]);
            run(&command)?;
            submission.commands.push(command);
            thread::sleep(BETWEEN_LOOKS);
            continue;
        }
        before_submission()?;
        submission.queued = queue.queued(dispatch).into_iter().collect();
        for step in &steps {
            let command = queue.command(&request, step, &submission.jobs);
            let answer = run(&command)?;
            // Where several clusters are managed together, sbatch prints `JOB;CLUSTER`.
            let job = answer
                .trim()
                .split(';')
                .next()
                .unwrap_or_default()
                .to_owned();
            if job.is_empty() || !job.bytes().all(|b| b.is_ascii_digit()) {
                return Err(DispatchError::Answer {
                    command: command.join(" "),
                    answer,
                }
                .into());
            }
            submission.commands.push(command);
            submission.ranks.extend(step.ranks());
            submission.jobs.push(job);
        }
        submission.count_left(&missing, reached);
        return Ok(submission);
    }
    Err(DispatchError::Stuck.into())
}

/// Returns the options for the resources that the user set.
fn resources(settings: &DispatchSettings) -> impl Iterator<Item = String> {
    let DispatchSettings {
        partition,
        account,
        qos,
        memory,
        cpus,
        ..
    } = settings;
    let named = [("partition", partition), ("account", account), ("qos", qos)];
    let named =
        named.map(|(option, value)| value.as_ref().map(|value| format!("--{option}={value}")));
    let memory = memory.map(|memory| format!("--mem={}M", memory.0.div_ceil(1 << 20)));
    named
        .into_iter()
        .flatten()
        .chain(memory)
        .chain([format!("--cpus-per-task={cpus}")])
}

/// Cancels the waiting tasks of the array that this process is a task of, if it is one.
pub fn cancel_rest_of_array() -> Result<(), DispatchError> {
    match std::env::var("SLURM_ARRAY_JOB_ID") {
        Ok(job) => run(&["scancel".into(), "--state=PENDING".into(), job]).map(drop),
        Err(_) => Ok(()),
    }
}

/// Splits ascending ranks into arrays with indices that the queue accepts.
fn arrays(ranks: &[usize], max_index: usize) -> Vec<Array> {
    let mut arrays: Vec<Array> = Vec::new();
    for rank in ranks {
        let offset = (rank - 1) / max_index * max_index;
        match arrays.last_mut().filter(|array| array.offset == offset) {
            Some(array) => array.indices.push(rank - offset),
            None => arrays.push(Array {
                offset,
                indices: vec![rank - offset],
            }),
        }
    }
    arrays
}

impl Array {
    /// Formats the indices as `1-40,45%8`.
    fn specification(&self, at_once: Option<u32>) -> String {
        let runs = self.indices.chunk_by(|a, b| a + 1 == *b);
        let run = |run: &[usize]| match run {
            [one] => one.to_string(),
            [first, .., last] => format!("{first}-{last}"),
            [] => String::new(),
        };
        let limit = at_once.map_or(String::new(), |limit| format!("%{limit}"));
        runs.map(run).collect::<Vec<_>>().join(",") + &limit
    }
}

/// Runs a command of the queue and returns what it printed.
fn run(command: &[String]) -> Result<String, DispatchError> {
    let done =
        platform::command(&command[0]).and_then(|mut program| program.args(&command[1..]).output());
    let done = done.map_err(|source| DispatchError::Start {
        program: command[0].clone(),
        source,
    })?;
    if done.status.success() {
        return Ok(String::from_utf8_lossy(&done.stdout).into_owned());
    }
    let message = String::from_utf8_lossy(&done.stderr)
        .trim()
        .replace('\n', "; ");
    Err(DispatchError::Refused {
        command: command.join(" "),
        message,
    })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn arrays_hold_each_rank_once_in_order(
            ranks in proptest::collection::btree_set(1usize..3000, 0..300),
            max_index in 1usize..1500,
        ) {
            let ranks: Vec<usize> = ranks.into_iter().collect();
            let arrays = arrays(&ranks, max_index);
            prop_assert!(arrays.iter().flat_map(|a| &a.indices).all(|i| (1..=max_index).contains(i)));
            let again: Vec<usize> = arrays.into_iter().map(Step::Array).flat_map(|step| step.ranks()).collect();
            prop_assert_eq!(again, ranks);
        }

        #[test]
        fn a_specification_names_its_indices(indices in proptest::collection::btree_set(1usize..60, 1..40)) {
            let array = Array { offset: 0, indices: indices.into_iter().collect() };
            let text = array.specification(None);
            let part = |part: &str| {
                let (first, last) = part.split_once('-').unwrap_or((part, part));
                first.parse::<usize>().unwrap()..=last.parse().unwrap()
            };
            prop_assert_eq!(text.split(',').flat_map(part).collect::<Vec<_>>(), array.indices);
        }
    }

    #[test]
    fn the_limit_stands_behind() {
        let array = Array {
            offset: 0,
            indices: vec![1, 2, 3, 7],
        };
        assert_eq!(array.specification(Some(4)), "1-3,7%4");
    }

    #[test]
    fn only_own_jobs_are_found() {
        let mut queue = SlurmQueue {
            prefix: "viewrank-sgm-12345678-".into(),
            ..SlurmQueue::default()
        };
        queue.add_jobs(
            "17_3|viewrank-sgm-12345678-abcd-1000|RUNNING\n18|viewrank-sgm-12345678-fuse|PENDING\n\
             19_1|viewrank-sgm-87654321-abcd-0|PENDING\nnonsense\n20_[2-5]|viewrank-sgm-12345678-abcd-0|PENDING\n",
        );
        let found = QueuedTask {
            job: "17".into(),
            plan: "abcd".into(),
            rank: 1003,
            pending: false,
        };
        assert_eq!(
            (queue.tasks.as_slice(), &queue.pending_jobs()[..]),
            (&[found][..], &["18".to_string()][..])
        );
    }
}
