//! Runs one task of a plan: the only way in which depth maps are computed, for `viewrank run` and
//! for each process of a queue.

use std::{
    ffi::OsString,
    fs::{File, TryLockError},
    hash::{BuildHasher, Hasher, RandomState},
    io::{self, Read, Seek, SeekFrom},
    path::Path,
    process::{Command, Stdio},
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::Duration,
};

use super::{Dispatch, DispatchError, Task, Tools};
use crate::{
    backends::{Call, Product},
    base::platform::{self, Ending},
    io::output::{self, Folder, OutputError},
};

/// Time between two polls of a process, of a lock and of the stop flag.
const PAUSE: Duration = Duration::from_millis(50);
/// Bytes of a failed command's output that are kept.
const TAIL: u64 = 2000;

/// How a task ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum TaskResult {
    Done,
    /// Its result was there already.
    Idle,
    /// A command failed, or left no depth map; holds the end of its output, if that is kept.
    Failed(String),
    Stopped,
}

/// How the commands of a task are run.
pub struct Runner<'a> {
    pub tools: &'a Tools,
    /// Number of threads that the backend may use.
    pub threads: usize,
    pub stop: &'a AtomicBool,
    /// Whose process the commands are part of.
    pub owner: Owner,
    /// Called before another process is waited for that does the same.
    pub on_wait: &'a dyn Fn(),
}

/// Who starts the commands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Owner {
    /// viewrank, for many tasks: it keeps the end of their output, and ends them with all that they
    /// have started.
    Viewrank,
    /// A queue or a shell, for this task: it gets the output, and its signals reach all processes.
    Queue,
}

/// Holds a lock until it is dropped and the programs that were started meanwhile have ended: they
/// may outlive a process that is killed.
struct Lock<T>(#[allow(dead_code, reason = "held")] Option<(File, T)>);

impl Dispatch {
    /// Computes the depth map of a task, unless it is there. Where another process computes one of
    /// the same key view, it is waited for first.
    pub fn compute(&self, task: &Task, runner: &Runner) -> Result<TaskResult, DispatchError> {
        if self.is_done(task) {
            return Ok(TaskResult::Idle);
        }
        let Some(_lock) = self.lock(&format!("locks/{}", task.marker), runner)? else {
            return Ok(TaskResult::Stopped);
        };
        let Some(_no_script) = self.without_script(runner)? else {
            return Ok(TaskResult::Stopped);
        };
        // Whoever held the lock may have made it meanwhile.
        if self.is_done(task) {
            return Ok(TaskResult::Idle);
        }
        // A link in the place of the map itself is replaced.
        if let Some(folder) = task.map.parent().filter(|folder| !self.is_ours(folder)) {
            let message = format!(
                "{} is a link out of the project, which is not followed: remove it",
                folder.display()
            );
            return Ok(TaskResult::Failed(message));
        }
        let (mark, disk) = (self.workplace.join(self.mark(task)), self.disk());
        let is_marked = mark.exists();
        if is_marked {
            // Of what is made from now on nobody knows yet; it is still viewrank's own.
            output::replace(&mark, b"unfinished\n", &disk)?;
        }
        let ended = self.run(Product::Map(task.rank), &task.id, is_marked, runner)?;
        if ended != TaskResult::Done {
            return Ok(ended);
        }
        if !self.has_map(task) {
            let message = format!("{} was not written", task.map.display());
            return Ok(TaskResult::Failed(message));
        }
        // Last: a map without a mark is made again, one with a mark counts.
        output::make_folder(&self.marks(), &disk)?;
        output::replace(&mark, format!("{}\n", task.id).as_bytes(), &disk)?;
        Ok(TaskResult::Done)
    }

    /// Waits for the lock on a file; `None` if stopped before. The file is never removed: some
    /// processes would lock the old file and some the new one.
    fn lock(
        &self,
        name: &str,
        runner: &Runner,
    ) -> Result<Option<Lock<impl Sized + use<>>>, DispatchError> {
        output::make_folder(&self.folder.join("locks"), &self.disk())?;
        let path = format!("viewrank/dispatch/{}/{name}", self.backend);
        match Folder::open(&self.project)?.lock_file(&path) {
            Ok(lock) => self.held(lock, File::try_lock, runner),
            // Another user's, in a project that several use.
            Err(OutputError::Denied { .. }) => Ok(Some(Lock(None))),
            Err(error) => Err(error.into()),
        }
    }

    /// Waits until the script of the export computes nothing, and keeps it from starting: it locks
    /// the folder of its marks. `None` if stopped before.
    fn without_script(
        &self,
        runner: &Runner,
    ) -> Result<Option<Lock<impl Sized + use<>>>, DispatchError> {
        // Windows opens no folders, and has no sh.
        match File::open(self.workplace.join(self.runner.own)) {
            Ok(folder) => self.held(folder, File::try_lock_shared, runner),
            Err(_) => Ok(Some(Lock(None))),
        }
    }

    fn held(
        &self,
        lock: File,
        attempt: fn(&File) -> Result<(), TryLockError>,
        runner: &Runner,
    ) -> Result<Option<Lock<impl Sized + use<>>>, DispatchError> {
        let mut has_waited = false;
        // On a file system without locks, the work goes ahead unlocked.
        while matches!(attempt(&lock), Err(TryLockError::WouldBlock)) {
            if runner.stop.load(Ordering::Relaxed) {
                return Ok(None);
            }
            if !std::mem::replace(&mut has_waited, true) {
                (runner.on_wait)();
            }
            thread::sleep(PAUSE);
        }
        let inherited = platform::inheritable(&lock).map_err(|source| DispatchError::Start {
            program: self.backend.into(),
            source,
        })?;
        Ok(Some(Lock(Some((lock, inherited)))))
    }

    /// Fuses the depth maps that are there, unless the same ones were fused before.
    pub fn fuse(&self, runner: &Runner) -> Result<TaskResult, DispatchError> {
        if self.is_fused() {
            return Ok(TaskResult::Idle);
        }
        let Some(_lock) = self.lock("fused.lock", runner)? else {
            return Ok(TaskResult::Stopped);
        };
        let Some(_no_script) = self.without_script(runner)? else {
            return Ok(TaskResult::Stopped);
        };
        if self.is_fused() {
            return Ok(TaskResult::Idle);
        }
        // Before the run: maps that are finished during it may be missing in the cloud.
        let fused = self.done_ids();
        let ended = self.run(Product::Cloud, "", true, runner)?;
        if ended == TaskResult::Done {
            output::replace(&self.folder.join("fused"), fused.as_bytes(), &self.disk())?;
        }
        Ok(ended)
    }

    /// Runs the commands of a task, each if the one before succeeds.
    fn run(
        &self,
        product: Product,
        id: &str,
        is_marked: bool,
        runner: &Runner,
    ) -> Result<TaskResult, DispatchError> {
        let own = self.runner.own;
        let work = self.workplace.join(format!("{own}unfinished/{}", unique()));
        let finished: Vec<usize> = match product {
            Product::Map(_) => Vec::new(),
            Product::Cloud => self.finished_tasks().map(|task| task.rank).collect(),
        };
        let call = Call {
            product,
            id,
            work: &work,
            finished: &finished,
            is_marked,
            workplace: &self.workplace,
            project: &self.project,
            lists: &self.lists,
            program: &runner.tools.program,
            python: &runner.tools.python,
            threads: runner.threads,
            image_scale: self.image_scale,
        };
        let ended = self.run_there(&call, runner);
        // What cannot be removed is in nobody's way.
        _ = output::remove_folder(&work, &self.disk());
        ended
    }

    fn run_there(&self, call: &Call, runner: &Runner) -> Result<TaskResult, DispatchError> {
        let commands = match (self.runner.commands)(call) {
            Ok(commands) => commands,
            Err(reason) => return Ok(TaskResult::Failed(reason)),
        };
        let mut said = String::new();
        for words in commands {
            let mut command = self.command_of(&words, runner)?;
            match runner.ended(&mut command).map_err(not_started(&words))? {
                (TaskResult::Done, output) => said = output,
                (other, _) => return Ok(other),
            }
        }
        Ok(match (self.runner.finish)(call) {
            Ok(()) => TaskResult::Done,
            // The last line counts where there is room for one alone.
            Err(reason) => TaskResult::Failed(format!("{said}\n{reason}").trim().into()),
        })
    }

    fn command_of(&self, words: &[OsString], runner: &Runner) -> Result<Command, DispatchError> {
        let mut command = platform::command(Path::new(&words[0])).map_err(not_started(words))?;
        command
            .args(&words[1..])
            .env(self.program.variable, &runner.tools.program)
            // A program that asks something would wait for an answer that nobody gives.
            .stdin(Stdio::null())
            // The current folder may be a stranger's.
            .current_dir("/");
        Ok(command)
    }
}

fn not_started(words: &[OsString]) -> impl Fn(io::Error) -> DispatchError {
    let program = words[0].to_string_lossy().into_owned();
    move |source| DispatchError::Start {
        program: program.clone(),
        source,
    }
}

/// A name that no other process makes at the same time, on whatever machine.
fn unique() -> String {
    format!("{:016x}", RandomState::new().build_hasher().finish())
}

impl Runner<'_> {
    /// Starts a command and waits for it; returns the end of its output, too.
    fn ended(&self, command: &mut Command) -> io::Result<(TaskResult, String)> {
        let mut output = None;
        if self.owner == Owner::Viewrank {
            // A file, because a pipe that nobody reads stops the program when it is full.
            let file = tempfile::tempfile()?;
            command.stdout(file.try_clone()?).stderr(file.try_clone()?);
            platform::in_own_group(command);
            output = Some(file);
        }
        let mut child = command.spawn()?;
        loop {
            if let Some(status) = child.try_wait()? {
                let said = output.and_then(|mut file| tail(&mut file).ok());
                let said = said.unwrap_or_default();
                return Ok(if status.success() {
                    (TaskResult::Done, said)
                } else {
                    (TaskResult::Failed(said.clone()), said)
                });
            }
            if self.stop.load(Ordering::Relaxed) {
                let processes = match self.owner {
                    Owner::Viewrank => Ending::Group,
                    Owner::Queue => Ending::Child,
                };
                platform::end(&mut child, processes);
                return Ok((TaskResult::Stopped, String::new()));
            }
            thread::sleep(PAUSE);
        }
    }
}

/// Returns the last lines.
fn tail(output: &mut File) -> io::Result<String> {
    let start = output.seek(SeekFrom::End(0))?.saturating_sub(TAIL);
    output.seek(SeekFrom::Start(start))?;
    let mut bytes = Vec::new();
    output.read_to_end(&mut bytes)?;
    let text = String::from_utf8_lossy(&bytes);
    // The first line was cut, maybe within a character.
    let whole = if start > 0 {
        text.split_once('\n').map_or(&*text, |(_, whole)| whole)
    } else {
        &text
    };
    Ok(whole.trim().into())
}
