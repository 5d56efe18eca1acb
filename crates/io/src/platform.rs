//! Differences between operating systems in files and links. Each function has a plain equivalent
//! for systems other than Unix.

use std::{
    fs::{File, Metadata, OpenOptions},
    io,
    path::Path,
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

/// Returns whether the file belongs to the user of this process; true where files have no owners.
pub fn is_own(found: &Metadata) -> bool {
    #[cfg(unix)]
    return std::os::unix::fs::MetadataExt::uid(found) == rustix::process::geteuid().as_raw();
    #[cfg(not(unix))]
    {
        let _ = found;
        true
    }
}

/// Takes the permissions of other users away, where the system has such.
pub fn make_private(path: &Path) -> std::io::Result<()> {
    #[cfg(unix)]
    return std::fs::set_permissions(path, std::os::unix::fs::PermissionsExt::from_mode(0o600));
    #[cfg(not(unix))]
    {
        let _ = path;
        Ok(())
    }
}

/// Returns whether no other user may read or write the file; true where the system has no such
/// permissions.
pub fn is_private(found: &Metadata) -> bool {
    #[cfg(unix)]
    return std::os::unix::fs::PermissionsExt::mode(&found.permissions()) & 0o077 == 0;
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

/// Returns whether anything but the end is at the start of a file; false where every file knows its
/// length.
pub fn has_content(file: &File) -> bool {
    #[cfg(unix)]
    return !matches!(
        std::os::unix::fs::FileExt::read_at(file, &mut [0; 8], 0),
        Ok(0)
    );
    #[cfg(not(unix))]
    {
        let _ = file;
        false
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
    if cfg!(windows) {
        Ok(())
    } else {
        folder.open(name)?.sync_all()
    }
}
