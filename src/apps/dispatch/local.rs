//! Runs the scripts of a dispatch on this machine, one after the other, for `viewrank run`.

use std::{
    fs::File,
    io::{self, Read, Seek, SeekFrom},
    process::Stdio,
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::Duration,
};

use super::{Dispatch, DispatchError, Task};
use crate::base::platform;

/// Time between two polls of a process and of the stop flag.
const PAUSE: Duration = Duration::from_millis(50);
/// Bytes of a failed script's output that are kept.
const TAIL: u64 = 2000;

/// Result of a script.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ScriptResult {
    Done,
    /// The script failed; holds the end of its output.
    Failed(String),
    Stopped,
}

impl Dispatch {
    /// Computes the depth map of a task; returns at once if it already exists. `threads`: number of
    /// threads that the backend may use.
    pub fn compute_here(
        &self,
        task: &Task,
        threads: usize,
        stop: &AtomicBool,
    ) -> Result<ScriptResult, DispatchError> {
        self.run_here("task.sh", Some(task.rank), threads, stop)
    }

    /// Fuses the depth maps that exist so far.
    pub fn fuse_here(
        &self,
        threads: usize,
        stop: &AtomicBool,
    ) -> Result<ScriptResult, DispatchError> {
        self.run_here("fuse.sh", None, threads, stop)
    }

    fn run_here(
        &self,
        script: &str,
        rank: Option<usize>,
        threads: usize,
        stop: &AtomicBool,
    ) -> Result<ScriptResult, DispatchError> {
        let failed = |source| DispatchError::Start {
            program: "sh".into(),
            source,
        };
        let mut output = tempfile::tempfile().map_err(failed)?;
        let copy = |file: &File| file.try_clone().map(Stdio::from).map_err(failed);
        let mut command = platform::command("sh").map_err(failed)?;
        command
            .arg(self.folder.join(script))
            .args(rank.map(|rank| rank.to_string()));
        // The scripts read from it the number of CPUs that a queue would grant.
        command
            .env("SLURM_CPUS_PER_TASK", threads.to_string())
            .env_remove("SLURM_ARRAY_JOB_ID");
        command
            .stdin(Stdio::null())
            .stdout(copy(&output)?)
            .stderr(copy(&output)?);
        let mut child = platform::in_own_group(&mut command)
            .spawn()
            .map_err(failed)?;
        loop {
            if let Some(status) = child.try_wait().map_err(failed)? {
                let failed = |_| ScriptResult::Failed(tail(&mut output).unwrap_or_default());
                return Ok(Some(status)
                    .filter(|status| !status.success())
                    .map_or(ScriptResult::Done, failed));
            }
            if stop.load(Ordering::Relaxed) {
                platform::end_group(&mut child);
                return Ok(ScriptResult::Stopped);
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
    let whole = if start > 0 {
        text.split_once('\n').map_or(&*text, |(_, whole)| whole)
    } else {
        &text
    };
    Ok(whole.trim().into())
}
