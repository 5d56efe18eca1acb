//! Differences between operating systems below the daemon: files and links, signals to stop, groups
//! of processes, the user, memory. Each function has a plain equivalent for systems other than
//! Unix.

use std::{
    fs::{File, Metadata, OpenOptions},
    io,
    path::{Path, PathBuf},
    process::{Child, Command},
    sync::{Arc, atomic::AtomicBool},
};

use cap_std::fs::Dir;

/// Sets `O_NONBLOCK`, so that opening a pipe does not wait for its writer.
pub fn never_block(options: &mut OpenOptions) {
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::custom_flags(options, libc::O_NONBLOCK);
    let _ = options;
}

/// Makes a new file executable, subject to the umask.
pub fn make_executable(options: &mut cap_std::fs::OpenOptions) {
    #[cfg(unix)]
    cap_std::fs::OpenOptionsExt::mode(options, 0o777);
    let _ = options;
}

/// Returns whether the owner may execute the file; true where the system has no such permission.
pub fn is_executable(found: &Metadata) -> bool {
    #[cfg(unix)]
    return std::os::unix::fs::PermissionsExt::mode(&found.permissions()) & 0o100 != 0;
    #[cfg(not(unix))]
    {
        let _ = found;
        true
    }
}

/// Returns the device number of the file system; 0 if unknown.
pub fn file_system(found: &Metadata) -> u64 {
    #[cfg(unix)]
    return std::os::unix::fs::MetadataExt::dev(found);
    #[cfg(not(unix))]
    {
        let _ = found;
        0
    }
}

/// Fills the buffer from offset `at`; several threads may read the same file.
pub fn read_exact_at(file: &File, buffer: &mut [u8], at: u64) -> io::Result<()> {
    #[cfg(unix)]
    return std::os::unix::fs::FileExt::read_exact_at(file, buffer, at);
    #[cfg(windows)]
    {
        let mut read = 0;
        while read < buffer.len() {
            match std::os::windows::fs::FileExt::seek_read(
                file,
                &mut buffer[read..],
                at + read as u64,
            ) {
                Ok(0) => return Err(io::ErrorKind::UnexpectedEof.into()),
                Ok(more) => read += more,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }
    #[cfg(not(any(unix, windows)))]
    {
        let _ = (file, buffer, at);
        Err(io::ErrorKind::Unsupported.into())
    }
}

/// Returns the number of bytes in holes of a file, which read as zeros and are stored nowhere, and
/// goes back to its start; 0 where the system does not tell.
pub fn hole_bytes(file: &File, length: u64) -> u64 {
    #[cfg(any(target_os = "linux", target_os = "macos"))]
    {
        use rustix::fs::{SeekFrom, seek};
        // Each piece of data costs the sender a block; beyond these, the rest counts as stored.
        const PIECES: usize = 1 << 16;
        let (mut holes, mut at) = (0, 0);
        for _ in 0..PIECES {
            let Some(hole) = seek(file, SeekFrom::Hole(at))
                .ok()
                .filter(|&hole| hole < length)
            else {
                break;
            };
            // No data behind it: it reaches to the end.
            at = seek(file, SeekFrom::Data(hole))
                .unwrap_or(length)
                .min(length);
            holes += at - hole;
            if at == length {
                break;
            }
        }
        if seek(file, SeekFrom::Start(0)).is_ok() {
            holes
        } else {
            0
        }
    }
    #[cfg(not(any(target_os = "linux", target_os = "macos")))]
    {
        let _ = (file, length);
        0
    }
}

/// Returns memory that was freed to the system where the allocator keeps it: glibc holds on to
/// hundreds of megabytes after a stage that many threads worked on, which the next large table then
/// comes on top of.
pub fn return_freed_memory() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: it takes a number, may be called from any thread, and returns pages of free blocks
    // alone.
    unsafe {
        libc::malloc_trim(0);
    }
}

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
    let path = std::env::var_os("PATH")?;
    // An empty entry is the current folder, too.
    let folders = std::env::split_paths(&path).filter(|folder| folder.is_absolute());
    folders
        .flat_map(|folder| names.iter().map(move |name| folder.join(name)))
        .find(|path| path.is_file())
}

/// Returns the inode number of a folder or, on Windows, the serial number of its volume and its
/// index there.
pub fn inode(folder: &Dir) -> io::Result<String> {
    let folder = folder.try_clone()?.into_std_file();
    #[cfg(unix)]
    return folder
        .metadata()
        .map(|found| std::os::unix::fs::MetadataExt::ino(&found).to_string());
    #[cfg(windows)]
    {
        let found = winapi_util::file::information(&folder)?;
        Ok(format!(
            "{} {}",
            found.volume_serial_number(),
            found.file_index()
        ))
    }
    #[cfg(not(any(unix, windows)))]
    {
        let _ = folder;
        Err(io::ErrorKind::Unsupported.into())
    }
}

/// Time of the last change of content or name, ns since 1970, which no program can set, and inode
/// number; `None` where the system has neither.
pub fn change_and_inode(found: &Metadata) -> Option<(u128, u64)> {
    #[cfg(unix)]
    {
        use std::os::unix::fs::MetadataExt;
        let (seconds, ns) = (
            found.ctime().try_into().unwrap_or(0),
            found.ctime_nsec().try_into().unwrap_or(0),
        );
        Some((
            std::time::Duration::new(seconds, ns).as_nanos(),
            found.ino(),
        ))
    }
    #[cfg(not(unix))]
    {
        let _ = found;
        None
    }
}

/// Makes a symbolic link to a file. Windows lets only administrators and developers do so, and
/// cap-std only to a relative target there.
pub fn link_file(target: &Path, folder: &Dir, name: &str) -> io::Result<()> {
    #[cfg(unix)]
    return folder.symlink_contents(target, name);
    #[cfg(windows)]
    {
        folder.symlink_file(target, name)?;
        // Wine reports success without making one.
        folder.symlink_metadata(name).map(|_| ())
    }
    #[cfg(not(any(unix, windows)))]
    {
        let _ = (target, folder, name);
        Err(io::ErrorKind::Unsupported.into())
    }
}

/// Syncs the entries of a folder; Windows does so by itself, and opens no folders.
pub fn sync_folder(folder: &Dir, name: &Path) -> io::Result<()> {
    match cfg!(windows) {
        true => Ok(()),
        false => folder.open(name)?.sync_all(),
    }
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

/// Ends a child that was started [in its own group](in_own_group) with all its descendants;
/// elsewhere than on Unix the child alone.
pub fn end_group(child: &mut Child) {
    #[cfg(unix)]
    if let Some(group) = i32::try_from(child.id())
        .ok()
        .and_then(rustix::process::Pid::from_raw)
    {
        _ = rustix::process::kill_process_group(group, rustix::process::Signal::TERM);
    }
    #[cfg(not(unix))]
    {
        _ = child.kill();
    }
    _ = child.wait();
}

/// Number or name of the user who runs this process, as queues take it.
pub fn user() -> String {
    #[cfg(unix)]
    return rustix::process::getuid().as_raw().to_string();
    #[cfg(not(unix))]
    std::env::var("USERNAME").unwrap_or_default()
}
