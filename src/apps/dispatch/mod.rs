//! The view clusters of a plan as tasks, one per rank, for `viewrank run` and for queues.
//!
//! `done/MARKER` in the export holds the id of the cluster that a depth map was made for, also of
//! one that the export's script made. `PROJECT/viewrank/dispatch/NAME` has the other records:
//! `fused` with the ids joined last, `locks/`, and the `logs/` of a queue. An id covers a key view
//! with its partners, their cameras and poses, so a changed plan recomputes only changed clusters.
//! Missing work is derived from these files alone; [`runner`] does it, here or on a node, and
//! [`slurm`] knows which of it is queued.

pub mod runner;
pub mod slurm;

use std::{
    collections::{BTreeMap, BTreeSet},
    env,
    fs::{self, File, TryLockError},
    io,
    path::{Path, PathBuf},
    sync::Arc,
};

use tempfile::TempDir;

use crate::{
    backends::{
        self, BACKENDS, Backend, BackendError, Export, Selection, TaskProgram, TaskRunner, Tasks,
        hash, task_ids, task_marker,
    },
    base::{
        error::{Advice, Hint},
        input::FileKind,
        paths::{self, absolute},
        platform,
        shell::{command_path, sh_word},
    },
    config::Share,
    io::{
        output::{self, Contents, Disk, FileSet, Folder, OutputError},
        project::{ImageFaults, Project},
    },
    model::cluster::RankedCluster,
    show::manifest::WrittenPlan,
};

/// The depth map of one view cluster.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Task {
    /// Rank, from 1.
    pub rank: usize,
    /// Name of the key view as a file name; two running tasks never share it.
    pub marker: String,
    /// Hash of the key view and its partners, their poses, and how they are matched.
    pub id: String,
    /// The same for a map of full size, which is as good as one of half the size.
    id_at_full_size: String,
    pub map: PathBuf,
    /// Name of the key view.
    pub key: String,
}

/// The tasks of a plan for one backend.
#[derive(Clone, Debug)]
pub struct Dispatch {
    pub project: PathBuf,
    pub backend: &'static str,
    /// Folder of the records.
    pub folder: PathBuf,
    /// In rank order; clusters that cannot have a depth map are left out.
    pub tasks: Vec<Task>,
    /// Options of `viewrank run` that the tasks need.
    choice: String,
    /// Depth maps of ranks up to this one are kept, whoever made them: the plan was ranked around
    /// them.
    finished: usize,
    /// Folder of the export.
    workplace: PathBuf,
    image_scale: f64,
    /// Scripts of the export, by name.
    scripts: BTreeMap<String, Vec<u8>>,
    /// Lists of the export that its tasks follow, by name.
    lists: BTreeMap<String, Vec<u8>>,
    program: TaskProgram,
    runner: TaskRunner,
}

/// Programs that the backend's commands need.
#[derive(Clone, Debug)]
pub struct Tools {
    pub program: PathBuf,
    pub python: PathBuf,
    /// Folder of the program if it came with the export, removed at the end.
    copied: Option<Arc<TempDir>>,
}

impl Tools {
    /// Resolves the program: the one given, else the one in its variable, else the one
    /// that comes with the export, else the one on the PATH. Python: `PYTHON`, else `python3`.
    pub fn find(dispatch: &Dispatch, named: Option<&Path>) -> Result<Self, DispatchError> {
        let TaskProgram { name, variable } = dispatch.program;
        let set = env::var_os(variable).map(PathBuf::from);
        let wanted = named.map(Path::to_path_buf).or(set);
        if wanted.is_none() && dispatch.scripts.contains_key(name) {
            return Self::of_export(dispatch).map_err(|source| DispatchError::Start {
                program: name.into(),
                source,
            });
        }
        let wanted = wanted.map_or_else(|| name.into(), |named| dispatch.program.named(named));
        // A bare name is otherwise looked for on the PATH alone, but whoever types the name of a
        // file here means that file.
        let typed = named.filter(|path| path.is_file()).map(absolute);
        let program = typed.or_else(|| platform::located(&wanted).map(|found| absolute(&found)));
        let program = program.ok_or(DispatchError::Program {
            program: wanted,
            variable,
        })?;
        Ok(Self {
            program,
            ..Self::unseen(dispatch)
        })
    }

    /// A copy of the program that the export has, where nobody else can write: somebody may change
    /// that in the project at any time.
    fn of_export(dispatch: &Dispatch) -> io::Result<Self> {
        let folder = tempfile::tempdir()?;
        for (name, script) in &dispatch.scripts {
            fs::write(folder.path().join(name), script)?;
        }
        Ok(Self {
            program: folder.path().join(dispatch.program.name),
            copied: Some(Arc::new(folder)),
            ..Self::unseen(dispatch)
        })
    }

    /// Programs that exist only on the nodes.
    pub fn unseen(dispatch: &Dispatch) -> Self {
        let python = backends::python();
        // It is run from another folder.
        let python = if python.components().count() > 1 {
            absolute(&python)
        } else {
            python
        };
        Self {
            program: dispatch.program.name.into(),
            python,
            copied: None,
        }
    }
}

impl Dispatch {
    /// Returns the tasks of a plan's first `cut` clusters, and the export that they need.
    pub fn of_plan(
        plan: &WrittenPlan,
        backend: &'static Backend,
        cut: usize,
    ) -> Result<(Self, Export), DispatchError> {
        let clusters = &plan.clusters[..cut];
        // Each task of a queue would open the images of the whole model.
        let views = plan.selection(clusters, &ImageFaults::default()).views();
        let image_faults = plan.project.image_faults_of(&views, &plan.scene);
        let selection = plan.selection(clusters, &image_faults);
        let export = backend.export(&selection, &Default::default())?;
        output::refuse_to_leave(&plan.project.home, &export.files.root)?;
        let mut dispatch = Self::new(backend, &selection, &export, plan.finished)?;
        if cut != plan.cut {
            // Each task reads the plan by itself, and must find as many ranks in it.
            dispatch.choice += &format!(" --budget {cut}");
        }
        Ok((dispatch, export))
    }

    /// Returns the tasks of an export with the default options; the plan was ranked around the
    /// first `finished` depth maps.
    pub fn new(
        backend: &'static Backend,
        selection: &Selection,
        export: &Export,
        finished: usize,
    ) -> Result<Self, DispatchError> {
        // A plan for another program may have that one's image size.
        let selection = &backend.at_its_size(selection);
        let project = absolute(&selection.project.home);
        let Some(Tasks { program, runner }) = backend.tasks else {
            return Err(DispatchError::NoTasks {
                project,
                backend: backend.name,
            });
        };
        let runner = runner(selection, export);
        let task = |(i, cluster): (usize, &RankedCluster)| {
            let map = runner.maps[i].clone()?;
            let key = selection.scene.name(cluster.key);
            let [id, of_full_size] = task_ids(backend, selection, cluster);
            let id_at_full_size = if runner.sizes_share_a_file {
                of_full_size
            } else {
                id.clone()
            };
            Some(Task {
                rank: i + 1,
                marker: task_marker(key),
                id,
                id_at_full_size,
                map: absolute(&map),
                key: key.into(),
            })
        };
        let tasks: Vec<Task> = selection
            .clusters
            .iter()
            .enumerate()
            .filter_map(task)
            .collect();
        let folder = project.join("viewrank/dispatch").join(backend.name);
        let workplace = absolute(&export.files.root);
        // From memory: somebody may change the lists in the project at any time.
        let lists = lists(&export.files, runner.lists);
        Ok(Self {
            project,
            backend: backend.name,
            folder,
            tasks,
            // Another plan may be for another program.
            choice: format!(" --backend {}", backend.name),
            finished,
            workplace,
            image_scale: export.record.image_scale,
            scripts: scripts(&export.files),
            lists,
            program,
            runner,
        })
    }

    /// The disk, for changes in the project alone.
    fn disk(&self) -> Disk<'_> {
        Disk::REAL.within(std::slice::from_ref(&self.project))
    }

    pub fn runner(&self) -> &TaskRunner {
        &self.runner
    }

    /// Returns a name of the tasks, which changes with each of them.
    pub fn plan_name(&self) -> String {
        let line = |task: &Task| format!("{} {}\n", task.rank, task.id);
        let lines: String = self.tasks.iter().map(line).collect();
        hash([&*lines])[..8].into()
    }

    /// Returns the start of the line of sh that does one of the tasks, which `--rank N` or `--fuse`
    /// completes: the same viewrank, on the project at this path, with these programs.
    pub fn command(&self, project: &Path, tools: &Tools, threads: u32) -> String {
        let path = |path: &Path| sh_word(&path.display().to_string());
        let viewrank: Vec<String> = platform::this_program_as_typed("dispatch")
            .iter()
            .map(|word| path(word))
            .collect();
        let mut words = vec![
            viewrank.join(" "),
            format!("run {}{}", path(project), self.choice),
            format!("--threads {threads}"),
        ];
        // One that only the nodes have is looked for there.
        if tools.program.is_absolute() && tools.copied.is_none() {
            words.push(format!("--program {}", path(&tools.program)));
        }
        words.join(" ")
    }

    /// Returns what stands before a [`command`](Self::command) in sh, for the variables that the
    /// programs need; empty without any.
    pub fn environment(&self, tools: &Tools) -> String {
        // A bare name is found on the PATH of each node.
        if self.runner.python.is_none() || !tools.python.is_absolute() {
            return String::new();
        }
        let python = sh_word(&tools.python.display().to_string());
        format!("export PYTHON={python} && ")
    }

    /// Returns the folder of a queue's logs.
    pub fn files(&self) -> FileSet {
        let mut files = FileSet::new(&self.project, &format!("dispatch-{}", self.backend));
        let logs = format!("viewrank/dispatch/{}/logs", self.backend);
        files.add(logs, Contents::Folder);
        files
    }

    fn refuse_other_file(&self, name: &str, bytes: &[u8]) -> Result<(), DispatchError> {
        match output::is_own(&self.workplace, name, bytes) {
            Ok(true) => Ok(()),
            _ => Err(DispatchError::Export(self.workplace.join(name))),
        }
    }

    /// Fails unless the export is there as it is written: its scripts are about to be run on its
    /// lists, and the folder may be a stranger's, or of another plan.
    pub fn refuse_other_export(&self, export: &Export) -> Result<(), DispatchError> {
        for (name, contents) in &export.files.files {
            let (Contents::Script(bytes) | Contents::Bytes(bytes)) = contents else {
                continue;
            };
            self.refuse_other_file(name, bytes)?;
        }
        Ok(())
    }

    /// Returns whether the task's depth map exists and either was made from this key view and these
    /// partners with their current poses, or is one that the plan was ranked around.
    pub fn is_done(&self, task: &Task) -> bool {
        (task.rank <= self.finished || self.is_marked(task)) && self.has_map(task)
    }

    /// Returns whether the task's depth map exists, in the project or the workplace: a link out of
    /// both may be a stranger's.
    fn has_map(&self, task: &Task) -> bool {
        self.is_ours(&task.map) && (self.runner.is_whole)(&task.map)
    }

    /// Returns whether a path leads through no link out of both the project and the workplace.
    fn is_ours(&self, path: &Path) -> bool {
        let ours = [&self.project, &self.workplace];
        ours.iter().any(|of| !paths::is_outside(path, of))
    }

    /// Returns whether a task's depth map has its mark, from viewrank or from the script of the
    /// export, which may have run where there is no viewrank.
    fn is_marked(&self, task: &Task) -> bool {
        let mark = output::read_own(&self.workplace, &self.mark(task), FileKind::Record);
        [&*task.id, &*task.id_at_full_size].contains(&text_of(mark).trim())
    }

    /// Name of the mark of a task's depth map, in the export.
    fn mark(&self, task: &Task) -> String {
        format!("{}done/{}", self.runner.own, task.marker)
    }

    fn marks(&self) -> PathBuf {
        self.workplace.join(format!("{}done", self.runner.own))
    }

    /// Returns the finished tasks, in rank order.
    pub fn finished_tasks(&self) -> impl Iterator<Item = &Task> {
        self.tasks.iter().filter(|task| self.is_done(task))
    }

    /// Returns the depth maps of the finished tasks.
    pub fn finished_maps(&self) -> impl Iterator<Item = &Path> {
        self.finished_tasks().map(|task| &*task.map)
    }

    /// Returns whether the depth maps of these key views are there, at least one: who says so may
    /// be a stranger. Those beyond the tasks are not looked for.
    pub fn has_maps_of(&self, keys: &[String]) -> bool {
        let keys: BTreeSet<&str> = keys.iter().map(String::as_str).collect();
        let counted = self.tasks.iter().filter(|task| keys.contains(&*task.key));
        let mut are_there = counted.map(|task| self.has_map(task)).peekable();
        are_there.peek().is_some() && are_there.all(|is_there| is_there)
    }

    /// Refuses a project in which something other than files would be read, or written through
    /// links.
    pub fn refuse_strangers(&self) -> Result<(), OutputError> {
        let fused = format!("viewrank/dispatch/{}/fused", self.backend);
        let read = ["viewrank/progress.json".into(), fused].map(|name| (&self.project, name));
        let marks = self.tasks.iter().map(|t| (&self.workplace, self.mark(t)));
        for (root, name) in read.into_iter().chain(marks) {
            match output::open_own(root, &name) {
                Err(error) if error.is_missing() => {}
                found => drop(found?),
            }
        }
        let of_maps: BTreeSet<&Path> = self
            .tasks
            .iter()
            .filter_map(|task| task.map.parent())
            .collect();
        let written = [
            self.marks(),
            self.folder.join("locks"),
            self.folder.join("logs"),
        ];
        written
            .iter()
            .map(PathBuf::as_path)
            .chain(of_maps)
            .try_for_each(|folder| output::refuse_to_leave(&self.project, folder))
    }

    /// Locks the project against other submissions until the file is dropped.
    pub fn hold(&self) -> Result<File, DispatchError> {
        self.refuse_strangers()?;
        output::make_folder(&self.folder, &self.disk())?;
        let name = format!("viewrank/dispatch/{}/lock", self.backend);
        let lock = Folder::open(&self.project)?.lock_file(&name)?;
        match lock.try_lock() {
            Err(TryLockError::WouldBlock) => Err(DispatchError::Busy(self.folder.clone())),
            // On a file system without locks, the submission goes ahead unlocked.
            _ => Ok(lock),
        }
    }

    /// Fails if a `viewrank run` is at work on the project, whose tasks another plan would change
    /// under it, or a submission.
    ///
    /// # Errors
    /// [`DispatchError::Busy`].
    pub fn refuse_if_at_work(project: &Project) -> Result<(), DispatchError> {
        BACKENDS
            .iter()
            .try_for_each(|backend| Self::refuse_if_at_work_with(backend, project))
    }

    /// As [`Self::refuse_if_at_work`], for runs with this backend, which another export of it would
    /// change.
    ///
    /// # Errors
    /// [`DispatchError::Busy`].
    pub fn refuse_if_at_work_with(
        backend: &Backend,
        project: &Project,
    ) -> Result<(), DispatchError> {
        let name = format!("viewrank/dispatch/{}", backend.name);
        match output::open_own(&project.home, &format!("{name}/lock")) {
            // Shared, so that two that only look do not take each other for a run.
            Ok(lock) if matches!(lock.try_lock_shared(), Err(TryLockError::WouldBlock)) => {
                Err(DispatchError::Busy(project.home.join(name)))
            }
            _ => Ok(()),
        }
    }

    /// Returns whether exactly the finished depth maps have been joined already.
    pub fn is_fused(&self) -> bool {
        let done = self.done_ids();
        done.is_empty()
            // The record stays where somebody has removed the cloud.
            || self.own_text("fused") == done && self.runner.clouds_there().next().is_some()
    }

    /// Returns a line with the id of each finished task.
    fn done_ids(&self) -> String {
        self.finished_tasks()
            .map(|task| format!("{}\n", task.id))
            .collect()
    }

    /// Reads a file in [`Self::folder`]; links are not followed.
    fn own(&self, name: &str) -> Result<Vec<u8>, OutputError> {
        output::read_own(
            &self.project,
            &format!("viewrank/dispatch/{}/{name}", self.backend),
            FileKind::Record,
        )
    }

    /// Returns the text of such a file; empty if it does not exist.
    fn own_text(&self, name: &str) -> String {
        text_of(self.own(name))
    }
}

/// Returns the text of a file; empty if it cannot be read.
fn text_of(read: Result<Vec<u8>, OutputError>) -> String {
    read.ok()
        .and_then(|bytes| String::from_utf8(bytes).ok())
        .unwrap_or_default()
}

/// Returns the contents of these files of an export.
fn lists(files: &FileSet, names: &[&str]) -> BTreeMap<String, Vec<u8>> {
    let list = |name: &&str| match files.files.get(*name) {
        Some(Contents::Bytes(bytes)) => Some(((*name).into(), bytes.clone())),
        _ => None,
    };
    names.iter().filter_map(list).collect()
}

fn scripts(files: &FileSet) -> BTreeMap<String, Vec<u8>> {
    let script = |(name, contents): (&String, &Contents)| match contents {
        Contents::Script(bytes) => Some((name.clone(), bytes.clone())),
        _ => None,
    };
    files.files.iter().filter_map(script).collect()
}

/// An error in handing clusters to a queue.
#[derive(Debug, thiserror::Error)]
pub enum DispatchError {
    #[error("viewrank cannot run {backend} view by view")]
    NoTasks {
        project: PathBuf,
        backend: &'static str,
    },
    #[error("cannot find the program {}", program.display())]
    Program {
        program: PathBuf,
        variable: &'static str,
    },
    #[error("{}: missing, or not what this viewrank writes, and so not run", .0.display())]
    Export(PathBuf),
    #[error("{program}: {source}")]
    Start { program: String, source: io::Error },
    #[error("{command} failed: {message}")]
    Refused { command: String, message: String },
    #[error("cannot parse the answer of {command}: \"{answer}\"")]
    Answer { command: String, answer: String },
    #[error("cancelled tasks remain in the queue")]
    Stuck,
    #[error("a viewrank run or dispatch is at work in {}", .0.display())]
    Busy(PathBuf),
    #[error(transparent)]
    Output(#[from] OutputError),
    #[error(transparent)]
    Backend(#[from] BackendError),
    #[error("a target of {wanted} is more than the plan's {planned}, at which tasks stop")]
    Target { wanted: Share, planned: Share },
}

/// Offers the matcher that comes with viewrank, where it would run. Its own program is never
/// missing unless somebody named another.
fn or_sgm() -> Advice {
    let runs_here = backends::by_name("sgm").is_ok_and(backends::can_match_here);
    if !runs_here {
        return Advice::default();
    }
    Advice::text(", or match with ")
        .set_to("backends", "sgm")
        .and(", whose program is here")
}

impl Hint for DispatchError {
    fn hint(&self) -> Option<Advice> {
        Some(match self {
            Self::NoTasks { project, backend } => {
                let with_tasks = BACKENDS.iter().filter(|backend| backend.tasks.is_some());
                let names: Vec<&str> = with_tasks.map(|backend| backend.name).collect();
                let project = command_path(project);
                Advice::text("run what `")
                    .run(format!("plan {project} --backend {backend}"))
                    .and("` prints, or take one of ")
                    .set_to("backends", names.join(", "))
            }
            Self::Program { program, .. } if program.is_dir() => {
                "it is a folder: name the program in it".into()
            }
            Self::Program { variable, .. } => {
                Advice::text("name it with ")
                    .set("program")
                    .and(format!(" or {variable}"))
                    .join(or_sgm())
                    .and("; where only the nodes of a queue have it, see ")
                    .run("dispatch --setup")
            }
            Self::Start { program, .. } if slurm::COMMANDS.contains(&&**program) => {
                Advice::text("run this where SLURM's commands are, or take ")
                    .set_to("scheduler", "shell")
            }
            Self::Start { .. } => "put it on the PATH; PYTHON names another Python".into(),
            Self::Export(_) => "write the export again: viewrank plan, or viewrank dispatch".into(),
            Self::Refused { .. } => Advice::text("see the queue's message; ")
                .set("dry-run")
                .and(" shows all commands"),
            Self::Answer { .. } => "look whether that command works by itself".into(),
            Self::Stuck => "look with squeue, then try again".into(),
            Self::Busy(_) => "wait for it to end, or stop it with Ctrl-C; the same command, typed again, goes on from there".into(),
            Self::Output(error) => return error.hint(),
            Self::Backend(error) => return error.hint(),
            Self::Target { wanted, .. } => Advice::text("plan again with ").set_to("cut.target", wanted.to_string()),
        })
    }

    fn is_usage(&self) -> bool {
        match self {
            Self::Target { .. } => true,
            Self::Output(error) => error.is_usage(),
            Self::Backend(error) => error.is_usage(),
            _ => false,
        }
    }
}
