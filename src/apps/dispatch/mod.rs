//! The view clusters of a plan as tasks of a queue, one task per rank, for `viewrank dispatch`.
//!
//! `PROJECT/viewrank/dispatch/NAME` holds `list-HASH.tsv` (one line per task: rank, marker, id,
//! depth map, key view), `task.sh` and `fuse.sh` (the scripts of `integrations/slurm`, with their
//! variables filled in), `logs/`, and the records of the scripts: `done/MARKER` with the id of the
//! cluster that the depth map was made for, and `fused`, the ids joined last. An id covers a key
//! view with its partners, their cameras and poses, so a changed plan recomputes only changed
//! clusters. Missing work is derived from these files alone; [`slurm`] knows which of it is queued.

pub mod local;
pub mod slurm;

use std::{
    collections::BTreeSet,
    env,
    fs::{self, File, TryLockError},
    io,
    path::{Path, PathBuf},
};

use crate::{
    backends::{self, BACKENDS, Backend, Export, Selection, TaskRunner, recipe},
    base::{
        error::{Advice, Hint},
        input::FileKind,
        paths::absolute,
        platform,
        printable::printable,
        shell::quoted_path,
    },
    config::{DispatchSettings, Share},
    io::{
        output::{self, Contents, Disk, FileSet, Folder, OutputError},
        project::Project,
    },
    model::cluster::RankedCluster,
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
    pub map: PathBuf,
    /// Name of the key view.
    pub key: String,
}

/// The tasks of a plan for one backend.
#[derive(Clone, Debug)]
pub struct Dispatch {
    pub project: PathBuf,
    pub backend: &'static str,
    /// Folder of the task files.
    pub folder: PathBuf,
    /// In rank order; clusters that cannot have a depth map are left out.
    pub tasks: Vec<Task>,
    /// Depth maps of ranks up to this one are kept, whoever made them: the plan was ranked around
    /// them.
    finished: usize,
    /// Folder in which the backend runs.
    workplace: PathBuf,
    /// The backend's program, if the export includes it.
    exported_program: Option<PathBuf>,
    runner: TaskRunner,
}

/// Programs that the scripts need besides the backend's own runner.
#[derive(Clone, Debug)]
pub struct Tools {
    pub program: PathBuf,
    pub python: PathBuf,
}

impl Tools {
    /// Resolves the program: the one given, else the one in the runner's variable, else the one
    /// that comes with the export, else the one on the PATH. Python: `PYTHON`, else `python3`.
    pub fn find(dispatch: &Dispatch, named: Option<&Path>) -> Result<Self, DispatchError> {
        let runner = &dispatch.runner;
        let variable = env::var_os(runner.variable).map(PathBuf::from);
        let wanted = named.map(Path::to_path_buf).or(variable);
        if let (None, Some(own)) = (&wanted, &dispatch.exported_program) {
            return Ok(Self {
                program: own.clone(),
                ..Self::unseen(runner)
            });
        }
        let wanted = wanted.unwrap_or_else(|| runner.program.into());
        let typed = named.filter(|path| path.is_file()).map(absolute);
        let program = typed.or_else(|| platform::located(&wanted).map(|found| absolute(&found)));
        let program = program.ok_or(DispatchError::Program {
            program: wanted,
            variable: runner.variable,
        })?;
        Ok(Self {
            program,
            ..Self::unseen(runner)
        })
    }

    /// Programs that exist only on the nodes.
    pub fn unseen(runner: &TaskRunner) -> Self {
        let python = backends::python();
        // Scripts run it from another folder.
        let python = if python.components().count() > 1 {
            absolute(&python)
        } else {
            python
        };
        Self {
            program: runner.program.into(),
            python,
        }
    }
}

impl Dispatch {
    /// Returns the tasks of an export with the default options; the plan was ranked around the
    /// first `finished` depth maps.
    pub fn new(
        backend: &'static Backend,
        selection: &Selection,
        export: &Export,
        finished: usize,
    ) -> Result<Self, DispatchError> {
        let project = absolute(&selection.project.home);
        let runner =
            (backend.tasks)(selection, export).ok_or(DispatchError::NoTasks(backend.name))?;
        let task = |(i, cluster): (usize, &RankedCluster)| {
            let map = runner.maps[i].clone()?;
            let key = selection.scene.name(cluster.key);
            let options = format!("{} {}", backend.name, export.record.image_scale);
            let (marker, id) = (hash([key]), recipe(selection, cluster, &options));
            Some(Task {
                rank: i + 1,
                marker,
                id,
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
        if let Some(task) = tasks
            .iter()
            .find(|t| t.map.to_string_lossy().contains(['\t', '\n']))
        {
            return Err(DispatchError::Path(task.map.clone()));
        }
        let folder = project.join("viewrank/dispatch").join(backend.name);
        let workplace = absolute(&export.files.root);
        let brings_program = export.files.files.contains_key(runner.program);
        let exported_program = brings_program.then(|| workplace.join(runner.program));
        Ok(Self {
            project,
            backend: backend.name,
            folder,
            tasks,
            finished,
            workplace,
            exported_program,
            runner,
        })
    }

    pub fn runner(&self) -> &TaskRunner {
        &self.runner
    }

    /// Returns the lines of the list. The line of a rank changes only if its cluster does.
    fn list(&self) -> String {
        let line = |t: &Task| {
            let key = printable(&t.key);
            format!(
                "{}\t{}\t{}\t{}\t{key}\n",
                t.rank,
                t.marker,
                t.id,
                t.map.display()
            )
        };
        self.tasks.iter().map(line).collect()
    }

    /// Returns the name of the list, which depends on its contents.
    pub fn list_name(&self) -> String {
        hash([self.list().as_str()])[..8].into()
    }

    fn list_path(&self, name: &str) -> PathBuf {
        self.folder.join(format!("list-{name}.tsv"))
    }

    /// Returns the markers and ranks of an older list, if it still exists.
    fn old_markers(&self, name: &str) -> Vec<(usize, String)> {
        let text = self.own_text(&format!("list-{name}.tsv"));
        let entry = |line: &str| {
            let mut fields = line.split('\t');
            Some((fields.next()?.parse().ok()?, fields.next()?.to_owned()))
        };
        text.lines().filter_map(entry).collect()
    }

    /// Returns the list and the scripts; older lists that queued tasks still read are kept.
    pub fn files(
        &self,
        tools: &Tools,
        settings: &DispatchSettings,
        old_lists: &BTreeSet<String>,
    ) -> FileSet {
        let mut files = FileSet::new(&self.project, &format!("dispatch-{}", self.backend));
        let mut add = |name: &str, contents| {
            files.add(
                format!("viewrank/dispatch/{}/{name}", self.backend),
                contents,
            )
        };
        let head = self.head(tools, settings);
        let script = |template: &str| {
            let list = include_str!("../../../integrations/slurm/list.sh");
            let script = backends::with_refusal(&template.replacen("@LIST@\n", list, 1));
            // The last: a path in it may hold anything.
            Contents::Script(script.replacen("@HEAD@\n", &head, 1).into_bytes())
        };
        add(
            "task.sh",
            script(include_str!("../../../integrations/slurm/task.sh")),
        );
        add(
            "fuse.sh",
            script(include_str!("../../../integrations/slurm/fuse.sh")),
        );
        add("logs", Contents::Folder);
        for old in old_lists {
            let name = format!("list-{old}.tsv");
            if let Ok(bytes) = self.own(&name) {
                add(&name, Contents::Bytes(bytes));
            }
        }
        add(
            &format!("list-{}.tsv", self.list_name()),
            Contents::Bytes(self.list().into_bytes()),
        );
        files
    }

    /// Returns the variables of the scripts. SLURM copies a script when it is submitted, so all
    /// paths are absolute.
    fn head(&self, tools: &Tools, settings: &DispatchSettings) -> String {
        let TaskRunner { compute, fuse, .. } = &self.runner;
        let body = |name: &str, command: &str| {
            format!("{name}() {{\n    cd \"$workplace\" && {command}\n}}\n")
        };
        let setup = settings.setup.trim_end();
        format!(
            "project={}\nworkplace={}\nfolder={}\nlist={}\nfinished={}\nprogram={}\npython={}\nthreads=${{SLURM_CPUS_PER_TASK:-{}}}\n{}{}{setup}{}",
            quoted_path(&self.project),
            quoted_path(&self.workplace),
            quoted_path(&self.folder),
            quoted_path(&self.list_path(&self.list_name())),
            self.finished,
            quoted_path(&tools.program),
            quoted_path(&tools.python),
            settings.cpus,
            body("compute", compute),
            body("fuse", fuse),
            if setup.is_empty() { "" } else { "\n" },
        )
    }

    /// Returns whether the task's depth map exists and either was made from this key view and these
    /// partners with their current poses, or is one that the plan was ranked around.
    pub fn is_done(&self, task: &Task) -> bool {
        let noted = || self.own_text(&format!("done/{}", task.marker));
        (task.rank <= self.finished || noted().trim() == task.id)
            && fs::metadata(&task.map).is_ok_and(|map| map.len() > 0)
    }

    /// Returns the depth maps of the finished tasks.
    pub fn finished_maps(&self) -> impl Iterator<Item = &Path> {
        self.tasks
            .iter()
            .filter(|task| self.is_done(task))
            .map(|task| &*task.map)
    }

    /// Refuses a project in which the scripts would read something other than files, for which they
    /// would wait, or write through links.
    fn refuse_strangers(&self) -> Result<(), OutputError> {
        let own = |name: &str| format!("viewrank/dispatch/{}/{name}", self.backend);
        let read = ["viewrank/progress.json".into(), own("fused")].into_iter();
        for name in read.chain(
            self.tasks
                .iter()
                .map(|task| own(&format!("done/{}", task.marker))),
        ) {
            match output::open_own(&self.project, &name) {
                Err(error) if error.is_missing() => {}
                found => drop(found?),
            }
        }
        let of_maps: BTreeSet<&Path> = self
            .tasks
            .iter()
            .filter_map(|task| task.map.parent())
            .collect();
        let written = [self.folder.join("done"), self.folder.join("logs")];
        written
            .iter()
            .map(PathBuf::as_path)
            .chain(of_maps)
            .try_for_each(|folder| output::refuse_to_leave(&self.project, folder))
    }

    /// Locks the project against other submissions until the file is dropped.
    pub fn hold(&self) -> Result<File, DispatchError> {
        self.refuse_strangers()?;
        output::make_folder(
            &self.folder,
            &Disk::REAL.within(std::slice::from_ref(&self.project)),
        )?;
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
            Ok(lock) if matches!(lock.try_lock_shared(), Err(TryLockError::WouldBlock)) => {
                Err(DispatchError::Busy(project.home.join(name)))
            }
            _ => Ok(()),
        }
    }

    /// Returns whether exactly the finished depth maps have been joined already.
    pub fn is_fused(&self) -> bool {
        let done: String = self
            .tasks
            .iter()
            .filter(|t| self.is_done(t))
            .map(|t| format!("{}\n", t.id))
            .collect();
        done.is_empty() || self.own_text("fused") == done
    }

    /// Reads a file in [`Self::folder`], written by viewrank or its scripts; links are not
    /// followed.
    fn own(&self, name: &str) -> Result<Vec<u8>, OutputError> {
        output::read_own(
            &self.project,
            &format!("viewrank/dispatch/{}/{name}", self.backend),
            FileKind::Record,
        )
    }

    /// Returns the text of such a file; empty if it does not exist.
    fn own_text(&self, name: &str) -> String {
        self.own(name)
            .ok()
            .and_then(|bytes| String::from_utf8(bytes).ok())
            .unwrap_or_default()
    }
}

/// Returns 16 hexadecimal digits of BLAKE3 over the texts.
fn hash<'a>(texts: impl IntoIterator<Item = &'a str>) -> String {
    let mut hasher = blake3::Hasher::new();
    for text in texts {
        hasher
            .update(&(text.len() as u64).to_le_bytes())
            .update(text.as_bytes());
    }
    hasher.finalize().to_hex()[..16].into()
}

/// An error in handing clusters to a queue.
#[derive(Debug, thiserror::Error)]
pub enum DispatchError {
    #[error("viewrank cannot run {0} view by view")]
    NoTasks(&'static str),
    #[error("cannot find the program {}", program.display())]
    Program {
        program: PathBuf,
        variable: &'static str,
    },
    #[error("{}: tabs and line breaks separate the entries of the list", .0.display())]
    Path(PathBuf),
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
    Lock(#[from] OutputError),
    #[error("--target {wanted} is more than the plan's {planned}, at which tasks stop")]
    Target { wanted: Share, planned: Share },
}

/// Offers the matcher that comes with viewrank, where it would run. Its own program is never missing
/// unless somebody named another.
fn or_sgm() -> &'static str {
    let runs_here = backends::by_name("sgm").is_ok_and(backends::can_match_here);
    if runs_here {
        ", or match with --backend sgm, whose program is here"
    } else {
        ""
    }
}

impl Hint for DispatchError {
    fn hint(&self) -> Option<Advice> {
        Some(match self {
            Self::NoTasks(name) => format!(
                "run what `viewrank plan PROJECT --backend {name}` prints, or take --backend sgm, openmvs or colmap"
            )
            .into(),
            Self::Program { program, .. } if program.is_dir() => {
                "it is a folder: name the program in it".into()
            }
            Self::Program { variable, .. } => {
                let or_sgm = or_sgm();
                format!(
                    "name it with --program or {variable}{or_sgm}; where only the nodes of a queue have it, see viewrank dispatch --setup"
                )
                .into()
            }
            Self::Path(_) => "rename the folder or the image".into(),
            Self::Start { program, .. } if program == "sh" => {
                "the scripts need sh; on Windows, put that of Git for Windows on the PATH, or use WSL".into()
            }
            Self::Start { .. } => "run this where SLURM's commands are, or take --scheduler shell".into(),
            Self::Refused { .. } => "see the queue's message; --dry-run shows all commands".into(),
            Self::Answer { .. } => "look whether that command works by itself".into(),
            Self::Stuck => "look with squeue, then try again".into(),
            Self::Busy(_) => "wait for it to end, or stop it with Ctrl-C; the same command, typed again, goes on from there".into(),
            Self::Lock(error) => return error.hint(),
            Self::Target { wanted, .. } => Advice::text("plan again with ").set_to("cut.target", wanted.to_string()),
        })
    }

    fn is_usage(&self) -> bool {
        matches!(self, Self::Target { .. })
    }
}
