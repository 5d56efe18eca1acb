//! Was a file written here, or did it come with a copy? Journals and records carry the identity of the folder `viewrank` in which they
//! were written, and are believed in that folder only.
//!
//! The identity is the instant at which the folder was made, which neither an archive nor a copy can bring along on Linux; where
//! the file system does not know that instant, or on other systems, the number of the folder (inode) decides as well. It holds
//! for all users, hosts and containers that see the folder, and needs no secret and no file elsewhere.
//!
//! Limits. It is no defence against somebody who can write below the root while viewrank is used here: they see the identity,
//! and can remove files themselves. An inode alone could be guessed on a small file system. A project that was copied, restored
//! or handed on is unknown at first: its journal is refused, and its files outside of `viewrank/` count as somebody else's, so
//! they are kept beside when they change and stay when they go stale. The same holds after each mount of a file system whose
//! inodes and times are made up at the mount (some of FUSE). All of that keeps files; none of it loses any.

use std::{
    fs::{self, Metadata},
    io,
    path::Path,
    time::UNIX_EPOCH,
};

/// The identity of a folder.
pub(super) fn identity(folder: &Path) -> io::Result<String> {
    let found = fs::metadata(folder)?;
    let made = found.created().ok().and_then(|time| time.duration_since(UNIX_EPOCH).ok());
    let made = made.map(|time| format!("made {}.{:09}", time.as_secs(), time.subsec_nanos()));
    Ok(match made {
        Some(made) if cfg!(target_os = "linux") => made,
        made => format!("{} {}", made.unwrap_or_default(), inode(&found)),
    })
}

#[cfg(unix)]
fn inode(found: &Metadata) -> String {
    format!("inode {}", std::os::unix::fs::MetadataExt::ino(found))
}

#[cfg(not(unix))]
fn inode(_: &Metadata) -> String {
    String::new()
}
