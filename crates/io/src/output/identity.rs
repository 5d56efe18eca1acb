//! Tells files written in this folder from copied ones. Journals and records store the identity of
//! the `viewrank` folder in which they were written, and are valid in that folder only.
//!
//! The identity is the creation time of the folder, which on Linux neither archives nor copies
//! preserve. On other systems, and on file systems without creation times, it includes the inode
//! number. On Windows it is the volume and the index of the folder there alone: programs may set
//! the creation time, and Wine derives it from times that change. The identity is the same for all
//! users, hosts and containers that see the folder, and needs neither a secret nor a file
//! elsewhere.
//!
//! Limits. This doesn't protect against someone with write access below the root: they can read the
//! identity, and remove files anyway. An inode number alone could be guessed on a small file
//! system. In a project that was copied or restored from a backup the identity is unknown at first:
//! the journal is refused, and viewrank's files outside `viewrank/` count as the user's, so they
//! are kept when they change or become stale. The same happens at each mount of a file system that
//! invents inodes and times (some FUSE file systems). In all these cases files are kept, never
//! lost.

use std::{io, time::UNIX_EPOCH};

use super::folder::Folder;
use crate::platform;

/// Returns the identity of a folder: creation time, inode number, or both; on Windows volume and
/// index.
pub(super) fn identity(folder: &Folder) -> io::Result<String> {
    let created = folder.metadata()?.created().ok().filter(|_| !cfg!(windows));
    let made = created.and_then(|time| time.duration_since(UNIX_EPOCH).ok());
    let made = made.map(|time| format!("made {}.{:09}", time.as_secs(), time.subsec_nanos()));
    Ok(match made {
        Some(made) if cfg!(target_os = "linux") => made,
        made => format!(
            "{} inode {}",
            made.unwrap_or_default(),
            platform::inode(&folder.dir)?
        ),
    })
}
