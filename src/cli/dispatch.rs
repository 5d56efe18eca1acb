//! `viewrank dispatch`: hands the view clusters of a plan to a queue, in rank order.

use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
};

use crate::{
    apps::dispatch::{
        Dispatch, DispatchError, Tools,
        slurm::{self, Request, SlurmQueue, Submission},
    },
    backends::{self, place},
    base::shell::sh_word,
    config::{Budget, CommandLineSettings, DispatchSettings, Share},
    daemon::{follow, phase::Phase, state::Outcome},
    io::{
        output::{Disk, FileSet},
        project::Project,
    },
    show::manifest::WrittenPlan,
};
use clap::{Args, ValueEnum};
use serde::Serialize;

use super::{Failure, Format, config, print, print_json, progress::ProgressDisplay, warn};

/// Submit the view clusters of a plan to a queue: a task per depth map, best first, and a task that
/// fuses them.
///
/// Can be run again at any time: finished, queued and running tasks are kept, missing ones
/// submitted again, waiting ones cancelled once the existing depth maps reach the target. Defaults
/// for the resources of a task come from viewrank.toml, section dispatch.
#[derive(Args)]
pub struct Arguments {
    /// Folder of the project, or its model
    #[arg(value_parser = super::arguments::project())]
    project: PathBuf,

    /// slurm: job arrays. shell: only the export, and the commands for GNU parallel or a plain loop
    #[arg(long, value_enum)]
    scheduler: Scheduler,
    /// Backend that computes the depth maps [default: the plan's]
    #[arg(long, value_name = "NAME")]
    backend: Option<String>,
    /// Take the first N view clusters, or P % of the number of registered views (of a plan of two
    /// sizes: of the work of all) [default: the plan's cut]
    #[arg(long, value_name = "N|P%")]
    budget: Option<Budget>,
    /// Take the fewest view clusters that reach P % of what all together reach [default: the plan's
    /// cut]
    #[arg(long, value_name = "P%")]
    target: Option<Share>,
    /// The backend's program: sgm.py, DensifyPointCloud, colmap, dmrecon, ... [default: $SGM,
    /// $DENSIFY, $COLMAP, $DMRECON or $ALICEVISION, else from the PATH]
    #[arg(long, value_name = "FILE")]
    program: Option<PathBuf>,

    /// Partition of the queue
    #[arg(long, help_heading = "Task")]
    partition: Option<String>,
    /// Account to charge
    #[arg(long, help_heading = "Task")]
    account: Option<String>,
    /// Quality of service
    #[arg(long, help_heading = "Task")]
    qos: Option<String>,
    /// Time limit per depth map, such as 2h or 1d6h
    #[arg(long, value_name = "T", help_heading = "Task")]
    time: Option<String>,
    /// Memory per task, such as 8G
    #[arg(long, value_name = "SIZE", help_heading = "Task")]
    memory: Option<String>,
    /// CPUs per task, and threads of the backend [default: 1]
    #[arg(long, value_name = "N", help_heading = "Task")]
    cpus: Option<i64>,
    /// GPUs per task
    #[arg(long, value_name = "N", help_heading = "Task")]
    gpus: Option<i64>,
    /// Largest number of tasks that run at once [default: the queue's limit]
    #[arg(long, value_name = "N", help_heading = "Task")]
    at_once: Option<i64>,
    /// Further option of sbatch; repeatable
    #[arg(
        long,
        value_name = "OPTION",
        allow_hyphen_values = true,
        help_heading = "Task"
    )]
    option: Vec<String>,
    /// Lines of sh to run at the start of each task, such as "module load colmap"
    #[arg(long, value_name = "LINES", help_heading = "Task")]
    setup: Option<String>,

    /// Print the commands; write and submit nothing
    #[arg(long, help_heading = "Output")]
    dry_run: bool,
    /// Format of the results on stdout
    #[arg(long, value_enum, default_value_t, help_heading = "Output")]
    format: Format,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Scheduler {
    Slurm,
    Shell,
}

/// JSON output: actions taken.
#[derive(Serialize)]
struct Report<'a> {
    backend: &'a str,
    folder: &'a Path,
    tasks: usize,
    done: usize,
    target_reached: bool,
    #[serde(flatten)]
    submission: Submission,
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    // Jobs are identified by the project's canonical path.
    let root =
        dunce::canonicalize(&arguments.project).unwrap_or_else(|_| arguments.project.clone());
    let plan = WrittenPlan::read(&root)?;
    if let Some(wanted) = arguments.target.filter(|wanted| wanted.0 > plan.target.0) {
        return Err(DispatchError::Target {
            wanted,
            planned: plan.target,
        }
        .into());
    }
    let backend = backends::by_name(arguments.backend.as_ref().unwrap_or(&plan.backend))?;
    let settings = config::load(Some(&plan.project), arguments.typed())?
        .settings
        .dispatch;
    let cut = plan.cut_at(arguments.budget, arguments.target);
    let (dispatch, exported) = Dispatch::of_plan(&plan, backend, cut)?;
    // Until the end, since another dispatch or run would start the same tasks.
    let _held = if arguments.dry_run {
        None
    } else {
        Some(dispatch.hold()?)
    };
    let job = Job {
        arguments,
        project: &plan.project,
        tools: arguments.tools(&dispatch, &settings)?,
        reached: arguments.target_reached(&plan.project.root, &dispatch)?,
        settings,
        dispatch,
    };
    let submission = job.submit(exported.files)?;
    let report = job.report(submission);
    match arguments.format {
        Format::Json => print_json(&report),
        Format::Text => print(report.text(&job)),
    }
}

/// The tasks of a plan, and how they are to be run.
struct Job<'a> {
    arguments: &'a Arguments,
    project: &'a Project,
    dispatch: Dispatch,
    settings: DispatchSettings,
    tools: Tools,
    /// The existing depth maps reach the target.
    reached: bool,
}

impl Job<'_> {
    /// Writes the export, and submits the tasks to the queue, if there is one; neither in a dry
    /// run.
    fn submit(&self, exported: FileSet) -> Result<Submission, Failure> {
        let request = Request {
            dispatch: &self.dispatch,
            tools: &self.tools,
            settings: &self.settings,
            reached: self.reached,
        };
        let write = || self.write(exported);
        Ok(match (self.arguments.scheduler, self.arguments.dry_run) {
            (Scheduler::Slurm, true) => queue_or_empty(&self.dispatch).rehearse(request),
            (Scheduler::Slurm, false) => slurm::submit(request, write)?,
            (Scheduler::Shell, true) => Submission::default(),
            (Scheduler::Shell, false) => {
                write()?;
                Submission::default()
            }
        })
    }

    /// Writes the export.
    fn write(&self, exported: FileSet) -> Result<(), Failure> {
        let disk = self.project.disk();
        let folder = exported.root.clone();
        place::set_of_folder(&folder, [exported], self.project).write(&disk)?;
        self.dispatch.files().write(&disk)?;
        Ok(())
    }

    fn report(&self, submission: Submission) -> Report<'_> {
        let Dispatch {
            backend,
            folder,
            tasks,
            ..
        } = &self.dispatch;
        let done = tasks.iter().filter(|task| self.dispatch.is_done(task));
        Report {
            backend,
            folder,
            tasks: tasks.len(),
            done: done.count(),
            target_reached: self.reached,
            submission,
        }
    }
}

/// Reads the state of the queue; empty, with a warning, if the query fails.
fn queue_or_empty(dispatch: &Dispatch) -> SlurmQueue {
    SlurmQueue::read(dispatch).unwrap_or_else(|error| {
        warn(&format!(
            "cannot query the queue, assuming it is empty: {error}"
        ));
        SlurmQueue::empty(dispatch)
    })
}

impl Arguments {
    /// Command-line options as settings.
    fn typed(&self) -> CommandLineSettings {
        let mut typed = CommandLineSettings::default();
        typed.set("--partition", "dispatch.partition", self.partition.clone());
        typed.set("--account", "dispatch.account", self.account.clone());
        typed.set("--qos", "dispatch.qos", self.qos.clone());
        typed.set("--time", "dispatch.time", self.time.clone());
        typed.set("--memory", "dispatch.memory", self.memory.clone());
        typed.set("--cpus", "dispatch.cpus", self.cpus);
        typed.set("--gpus", "dispatch.gpus", self.gpus);
        typed.set("--at-once", "dispatch.at_once", self.at_once);
        typed.set(
            "--option",
            "dispatch.options",
            (!self.option.is_empty()).then(|| self.option.clone()),
        );
        typed.set("--setup", "dispatch.setup", self.setup.clone());
        typed
    }

    /// Returns the programs that tasks run; by name if not found here (dry runs, or only the nodes
    /// have them).
    fn tools(
        &self,
        dispatch: &Dispatch,
        settings: &DispatchSettings,
    ) -> Result<Tools, DispatchError> {
        match Tools::find(dispatch, self.program.as_deref()) {
            Err(_) if !settings.setup.is_empty() && self.program.is_none() => {
                Ok(Tools::unseen(dispatch))
            }
            Err(error) if self.dry_run => {
                warn(&error.to_string());
                Ok(Tools::unseen(dispatch))
            }
            found => found,
        }
    }

    /// Returns whether the existing depth maps reach the target. Measured, so that tasks which
    /// start now find it in `progress.json`.
    fn target_reached(&self, root: &Path, dispatch: &Dispatch) -> Result<bool, Failure> {
        if self.dry_run {
            return Ok(follow::reached(root)
                .is_some_and(|progress| dispatch.has_maps_of(&progress.finished)));
        }
        let progress = ProgressDisplay::new(self.format == Format::Json);
        // Maps of another model, plan or program don't belong to these tasks.
        let done: BTreeSet<&Path> = dispatch.finished_maps().collect();
        let outcome = follow::follow(root, &|path| done.contains(path), &progress);
        progress.finish();
        match outcome {
            Outcome::Followed(phase) => Ok(matches!(phase, Phase::Reached { .. })),
            other => {
                if let Outcome::Failed { reason, .. } = other {
                    warn(&format!("cannot measure the existing depth maps: {reason}"));
                }
                // It refers to removed depth maps or another plan: no task may stop because of it.
                follow::Progress::remove(root, &Disk::REAL.within(&[root.to_path_buf()]))?;
                Ok(false)
            }
        }
    }
}

impl Report<'_> {
    fn text(&self, job: &Job) -> Vec<String> {
        let arguments = job.arguments;
        let (folder, all) = (self.folder.display(), self.tasks);
        let mut lines = vec![format!(
            "{}: {all} view clusters, {} finished; {folder}",
            self.backend, self.done
        )];
        if self.target_reached {
            lines.push(
                "  the existing depth maps reach the target: no more tasks are started".into(),
            );
        }
        match arguments.scheduler {
            Scheduler::Shell if self.target_reached => {}
            Scheduler::Shell => lines.extend(by_hand(job)),
            Scheduler::Slurm => {
                let Submission {
                    commands,
                    ranks,
                    queued,
                    left,
                    jobs,
                } = &self.submission;
                if !queued.is_empty() {
                    lines.push(format!("  on their way  {} tasks", queued.len()));
                }
                if !ranks.is_empty() {
                    let (first, last) = (ranks[0], ranks[ranks.len() - 1]);
                    lines.push(format!(
                        "  submitted     {} tasks, ranks {first} to {last}",
                        ranks.len()
                    ));
                }
                if *left > 0 {
                    lines.push(format!(
                        "  left          {left} tasks, which the queue has no room for: call this again later"
                    ));
                }
                if !jobs.is_empty() {
                    lines.push(format!("  jobs          {}", jobs.join(", ")));
                }
                let commands = commands.iter().filter(|_| arguments.dry_run);
                for command in commands {
                    let words: Vec<String> = command.iter().map(|word| sh_word(word)).collect();
                    lines.push(format!("  would run     {}", words.join(" ")));
                }
            }
        }
        lines
    }
}

/// Returns the commands that do the tasks without a queue. The project is the current folder: GNU
/// parallel would take braces in its path for its own.
fn by_hand(job: &Job) -> [String; 2] {
    let dispatch = &job.dispatch;
    let folder = sh_word(&dispatch.project.display().to_string());
    let last = dispatch.tasks.last().map_or(0, |task| task.rank);
    let jobs = job.settings.at_once.unwrap_or(2);
    let viewrank = dispatch.command(Path::new("."), &job.tools, job.settings.cpus);
    let start = format!("cd {folder} && {}", job.dispatch.environment(&job.tools));
    [
        format!(
            "  one by one       {start}{{ for rank in $(seq {last}); do {viewrank} --rank $rank; done; {viewrank} --fuse; }}"
        ),
        format!(
            // Without `-q`, a shell would read the words once more.
            "  with parallel    {start}{{ seq {last} | parallel -q -j {jobs} {viewrank} --rank; {viewrank} --fuse; }}"
        ),
    ]
}
