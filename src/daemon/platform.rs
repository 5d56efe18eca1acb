//! Calls that differ between operating systems. All other files of the daemon are portable.

use std::{
    io,
    path::{Path, PathBuf},
    process::Command,
};

use crate::base::platform;

/// Physical memory to assume, in bytes, where the system doesn't report it.
const ASSUMED_MEMORY: u64 = 8 << 30;

/// Nice value of the daemon. Linux derives the I/O priority from it, too.
#[cfg(unix)]
const NICE: i32 = 10;

/// Lowers the priority of this process and of the threads that it starts from now on. Where the
/// system refuses, work continues at the current priority.
pub fn lower_priority() {
    #[cfg(unix)]
    let _ = rustix::process::setpriority_process(None, NICE);
}

/// Returns the physical memory of this machine in bytes, or the limit of the control group of this
/// process where that is lower.
pub fn machine_memory() -> u64 {
    let machine = physical_memory().unwrap_or(ASSUMED_MEMORY);
    group_memory(Path::new("/proc/self/cgroup"), Path::new("/sys/fs/cgroup"))
        .map_or(machine, |group| group.min(machine))
}

#[cfg(unix)]
fn physical_memory() -> Option<u64> {
    // SAFETY: `sysconf` takes and returns numbers, and may be called from any thread.
    let (pages, size) = unsafe {
        (
            libc::sysconf(libc::_SC_PHYS_PAGES),
            libc::sysconf(libc::_SC_PAGE_SIZE),
        )
    };
    u64::try_from(pages)
        .ok()?
        .checked_mul(u64::try_from(size).ok()?)
}

#[cfg(not(unix))]
fn physical_memory() -> Option<u64> {
    None
}

/// Returns the lowest `memory.max` among the control group (version 2) named in the file `own` and
/// its ancestors below the folder `groups`.
fn group_memory(own: &Path, groups: &Path) -> Option<u64> {
    let text = std::fs::read_to_string(own).ok()?;
    let name = text.lines().find_map(|line| line.strip_prefix("0::/"))?;
    let limits = Path::new(name)
        .ancestors()
        .map(|group| groups.join(group).join("memory.max"));
    limits
        // A group without a limit says `max`, which is not a number.
        .filter_map(|file| std::fs::read_to_string(file).ok()?.trim().parse().ok())
        .min()
}

/// Magic numbers (`statfs(2)`) of file systems that raise no events here for changes by other
/// machines: NFS, SMB, CIFS, SMB2, FUSE (sshfs), 9P, AFS, Ceph, Lustre, GPFS, BeeGFS.
#[cfg(target_os = "linux")]
const NETWORK: [u32; 11] = [
    0x6969,
    0x517b,
    0xff53_4d42,
    0xfe53_4d42,
    0x6573_5546,
    0x0102_1997,
    0x5346_414f,
    0x00c3_6400,
    0x0bd0_0bd0,
    0x4750_4653,
    0x1983_0326,
];

/// True if the folder is on a file system on which changes by other machines raise no events here.
#[cfg(target_os = "linux")]
pub fn is_network(folder: &Path) -> bool {
    // The magic number is signed on some architectures, and negative for some file systems.
    rustix::fs::statfs(folder).is_ok_and(|about| NETWORK.contains(&(about.f_type as u32)))
}

/// Always false: users of network file systems need `--poll` here.
#[cfg(not(target_os = "linux"))]
pub fn is_network(_: &Path) -> bool {
    false
}

/// Returns the name of this machine.
pub fn host() -> String {
    #[cfg(unix)]
    let name = rustix::system::uname()
        .nodename()
        .to_string_lossy()
        .into_owned();
    #[cfg(not(unix))]
    let name = std::env::var("COMPUTERNAME").unwrap_or_default();
    if name.trim().is_empty() {
        "this host".into()
    } else {
        name.trim().into()
    }
}

/// A command line for the user's shell.
pub fn shell(command: &str) -> io::Result<Command> {
    let (shell, option) = if cfg!(windows) {
        ("cmd", "/C")
    } else {
        ("sh", "-c")
    };
    let mut shell = platform::command(shell)?;
    shell.arg(option).arg(command);
    Ok(shell)
}

/// This program again, with the arguments of this process and `--WORD` behind the subcommand; the
/// same one even if its file was replaced since, where the system can tell.
///
/// # Errors
/// If the system does not say which program this is.
pub fn this_program(word: &str) -> io::Result<Command> {
    let running = if cfg!(target_os = "linux") {
        PathBuf::from("/proc/self/exe")
    } else {
        PathBuf::new()
    };
    let program = if running.exists() {
        running
    } else {
        std::env::current_exe()?
    };
    let mut command = Command::new(program);
    let mut arguments = std::env::args_os();
    let name = arguments.next();
    // An interpreter, such as that of the Python package, finds its files by the name that it was
    // started with.
    #[cfg(unix)]
    name.map(|name| std::os::unix::process::CommandExt::arg0(&mut command, name));
    #[cfg(not(unix))]
    let _ = name;
    // Behind the others it would be one of the folders where they end with `-- FOLDER`.
    let arguments: Vec<_> = arguments.collect();
    let (before, behind) = arguments.split_at(
        arguments
            .iter()
            .position(|argument| argument == "watch")
            .map_or(0, |at| at + 1),
    );
    command.args(before).arg(word).args(behind);
    Ok(command)
}

/// Where memory runs out, lets the system end this process rather than others.
pub fn prefer_to_be_killed() {
    /// Between -1000 and 1000, of which the daemon's own unit (integrations/systemd) has 500.
    #[cfg(target_os = "linux")]
    const BADNESS: &str = "900";
    #[cfg(target_os = "linux")]
    let _ = std::fs::write("/proc/self/oom_score_adj", BADNESS);
}

/// State of the daemon that a supervisor may want to know.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Life {
    Ready,
    /// The main loop is alive.
    Alive,
    Stopping,
}

/// Notifies the supervisor of this process (systemd), if there is one.
pub fn notify_supervisor(life: Life) {
    #[cfg(target_os = "linux")]
    {
        use sd_notify::NotifyState::{Ready, Stopping, Watchdog};
        let state = match life {
            Life::Ready => Ready,
            Life::Alive => Watchdog,
            Life::Stopping => Stopping,
        };
        // Fails only without a supervisor.
        let _ = sd_notify::notify(&[state]);
    }
    #[cfg(not(target_os = "linux"))]
    let _ = life;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_lowest_limit_of_the_enclosing_control_groups_applies() {
        let root = tempfile::tempdir().expect("a temporary folder");
        let own = root.path().join("own");
        std::fs::write(&own, "0::/system.slice/viewrank.service\n").expect("a file");
        assert_eq!(group_memory(&own, root.path()), None);
        for (group, max) in [
            ("system.slice/viewrank.service", "max"),
            ("system.slice", "300"),
            (".", "500"),
        ] {
            std::fs::create_dir_all(root.path().join(group)).expect("a folder");
            std::fs::write(
                root.path().join(group).join("memory.max"),
                format!("{max}\n"),
            )
            .expect("a file");
        }
        assert_eq!(group_memory(&own, root.path()), Some(300));
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn nfs_and_smb_are_network_file_systems_and_local_disks_are_not() {
        assert!(!is_network(&std::env::temp_dir()));
        let is_listed = |magic: libc::c_long| NETWORK.contains(&(magic as u32));
        assert!(is_listed(libc::NFS_SUPER_MAGIC) && is_listed(libc::SMB_SUPER_MAGIC));
        assert!(!is_listed(libc::TMPFS_MAGIC) && !is_listed(libc::EXT4_SUPER_MAGIC));
    }
}
