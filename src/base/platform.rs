//! Differences between operating systems below the daemon: programs, signals to stop, groups of
//! processes, the user. Each function has a plain equivalent for systems other than Unix.

use std::{
    ffi::OsStr,
    io,
    path::{Path, PathBuf},
    process::{Child, Command},
    sync::{Arc, atomic::AtomicBool},
};

use super::paths::absolute;

/// Finds a program by its path, or on the PATH by its name.
pub fn located(program: &Path) -> Option<PathBuf> {
    match program.components().count() {
        1 => on_path(program),
        _ => Some(program.to_path_buf()).filter(|path| path.is_file()),
    }
}

/// Finds a program on the PATH, and only there: a file of that name in the current folder may be a
/// stranger's. On Windows, `.exe` may be left out.
fn on_path(program: &Path) -> Option<PathBuf> {
    let mut names = vec![program.to_path_buf()];
    if cfg!(windows) && program.extension().is_none() {
        names.insert(0, program.with_extension("exe"));
    }
    // Where none is set, as the system looks.
    let path = std::env::var_os("PATH").unwrap_or_else(|| "/usr/bin:/bin".into());
    let folders = absolute_folders(&path);
    folders
        .flat_map(|folder| names.iter().map(move |name| folder.join(name)))
        .find(|path| path.is_file())
}

/// The entries of a PATH that do not depend on the current folder; an empty one is that folder,
/// too.
fn absolute_folders(path: &OsStr) -> impl Iterator<Item = PathBuf> {
    std::env::split_paths(path).filter(|folder| folder.is_absolute())
}

/// A call of a program, by its path or by its name on the PATH. Neither it nor what it calls in
/// turn is looked for in the current folder, whatever the PATH.
///
/// # Errors
/// If it is not on the PATH.
pub fn command(program: impl AsRef<Path>) -> io::Result<Command> {
    let found = located(program.as_ref()).ok_or(io::ErrorKind::NotFound)?;
    let mut command = Command::new(found);
    // On Windows, programs are looked for there before the PATH unless this is set.
    command.env("NoDefaultCurrentDirectoryInExePath", "1");
    if let Some(path) = std::env::var_os("PATH") {
        let folders = std::env::join_paths(absolute_folders(&path));
        command.env("PATH", folders.map_err(io::Error::other)?);
    }
    Ok(command)
}

/// Returns the words that start this program: its path, or that of an interpreter with the script
/// or the options before the subcommand by which it runs this program.
pub fn this_program_as_typed(subcommand: &str) -> Vec<PathBuf> {
    let program = std::env::current_exe().unwrap_or_else(|_| "viewrank".into());
    // By the name that it was started with, a Python finds its environment.
    let typed = std::env::args_os().next().map(PathBuf::from);
    let typed = typed.and_then(|typed| located(&typed));
    let is_same = |typed: &PathBuf| {
        let real = [typed, &program].map(std::fs::canonicalize);
        matches!(real, [Ok(typed), Ok(program)] if typed == program)
    };
    let program = typed
        .filter(is_same)
        .map_or(program, |typed| absolute(&typed));
    let before = std::env::args_os().skip(1).map(PathBuf::from);
    let before = before.take_while(|word| word != Path::new(subcommand));
    let resolved = before.map(|word| {
        if word.is_file() {
            absolute(&word)
        } else {
            word
        }
    });
    [program].into_iter().chain(resolved).collect()
}

/// Sets the flag at Ctrl-C and, where the system has them, at other requests to end. A second
/// Ctrl-C ends the program at once.
pub fn stop_flag() -> io::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        // Registered before the handler that sets the flag, so that only a second signal ends the
        // program.
        signal_hook::flag::register_conditional_shutdown(signal, 130, Arc::clone(&stop))?;
        signal_hook::flag::register(signal, Arc::clone(&stop))?;
    }
    Ok(stop)
}

/// Request of a signal to a daemon.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Request {
    Stop,
    /// SIGHUP, which only Unix has.
    #[cfg_attr(not(unix), allow(dead_code, reason = "only signals of Unix make it"))]
    Rescan,
}

/// Calls `act` from a thread of its own at each request to stop or to scan again.
pub fn on_signal(act: impl Fn(Request) + Send + 'static) {
    #[cfg(unix)]
    {
        use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
        let Ok(mut signals) = signal_hook::iterator::Signals::new([SIGTERM, SIGINT, SIGHUP]) else {
            return;
        };
        std::thread::spawn(move || {
            signals.forever().for_each(|signal| {
                act(if signal == SIGHUP {
                    Request::Rescan
                } else {
                    Request::Stop
                })
            });
        });
    }
    #[cfg(not(unix))]
    {
        /// Interval of polling the flag.
        const PAUSE: std::time::Duration = std::time::Duration::from_millis(100);
        let Ok(stop) = stop_flag() else { return };
        std::thread::spawn(move || {
            while !stop.load(std::sync::atomic::Ordering::Relaxed) {
                std::thread::sleep(PAUSE);
            }
            act(Request::Stop);
        });
    }
}

/// Starts a command in its own process group, which Ctrl-C in the terminal does not reach.
pub fn in_own_group(command: &mut Command) -> &mut Command {
    #[cfg(unix)]
    std::os::unix::process::CommandExt::process_group(command, 0);
    command
}

/// The processes that are asked to end with a child.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ending {
    /// The child alone.
    Child,
    /// All of the group that the child was started [in](in_own_group).
    Group,
}

/// Asks a child to end, and waits for it; elsewhere than on Unix the child alone is ended, at once.
pub fn end(child: &mut Child, processes: Ending) {
    #[cfg(unix)]
    if let Some(pid) = i32::try_from(child.id())
        .ok()
        .and_then(rustix::process::Pid::from_raw)
    {
        use rustix::process::{Signal, kill_process, kill_process_group};
        _ = match processes {
            Ending::Child => kill_process(pid, Signal::TERM),
            Ending::Group => kill_process_group(pid, Signal::TERM),
        };
    }
    #[cfg(not(unix))]
    {
        let _ = processes;
        _ = child.kill();
    }
    _ = child.wait();
}

/// Another handle of a file, which the children that are started while it is kept inherit: a lock
/// of the file holds as long as any of them runs. None elsewhere than on Unix.
#[cfg(unix)]
pub fn inheritable(file: &std::fs::File) -> io::Result<impl Sized + use<>> {
    // Without close-on-exec, which std sets on its own handles.
    Ok(rustix::io::dup(file)?)
}

#[cfg(not(unix))]
pub fn inheritable(_: &std::fs::File) -> io::Result<impl Sized + use<>> {
    Ok(())
}

/// Number or name of the user who runs this process, as queues take it.
pub fn user() -> String {
    #[cfg(unix)]
    return rustix::process::getuid().as_raw().to_string();
    #[cfg(not(unix))]
    std::env::var("USERNAME").unwrap_or_default()
}
