//! Hints that something changed: native events where the file system has them, looks at fixed times where it hasn't.
//!
//! Each folder is watched by itself, so that the folders that viewrank writes to never wake it and the images of a project cost one
//! watch a folder. Events are hints only: what decides is the comparison in `settle`.

use std::{
    collections::{BTreeMap, VecDeque},
    ffi::CString,
    os::unix::{ffi::OsStrExt, fs::MetadataExt},
    path::{Path, PathBuf},
    sync::mpsc::Sender,
};

use notify::{ErrorKind, RecursiveMode, Watcher as _};

/// What a hint says.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Hint {
    /// Something happened at or below this path.
    Changed(PathBuf),
    /// Events were lost: everything must be looked at.
    Lost,
}

/// Watches folders.
pub struct Watches {
    native: Option<notify::RecommendedWatcher>,
    /// Folders by owner, with their inode.
    watched: BTreeMap<PathBuf, BTreeMap<PathBuf, u64>>,
    /// Why some or all folders are looked at in turn instead of being watched; said once.
    notices: VecDeque<String>,
    exhausted: bool,
}

impl Watches {
    /// Sends hints to `hints`. With `poll` no native events are asked for.
    pub fn new<T: From<Hint> + Send + 'static>(hints: Sender<T>, poll: bool) -> Self {
        let mut watches = Self { native: None, watched: BTreeMap::new(), notices: VecDeque::new(), exhausted: poll };
        if !poll {
            match notify::recommended_watcher(move |event| send(&hints, event)) {
                Ok(native) => watches.native = Some(native),
                Err(error) => {
                    watches.give_up(format!("no native file events ({error}); looking at the folders in turn"))
                }
            }
        }
        watches
    }

    /// Watches exactly these folders for `owner` (a project, or a folder outside projects); true when new ones came. A folder
    /// that was deleted and made again is watched again.
    pub fn update(&mut self, owner: &Path, folders: Vec<PathBuf>) -> bool {
        let Some(native) = &mut self.native else { return false };
        let before = self.watched.remove(owner).unwrap_or_default();
        let (mut after, mut failure, mut new, mut network) = (BTreeMap::new(), None, false, None);
        for folder in folders {
            let Ok(inode) = std::fs::metadata(&folder).map(|m| m.ino()) else { continue };
            if before.get(&folder) == Some(&inode) {
                after.insert(folder, inode);
                continue;
            }
            network = network.or_else(|| is_network(&folder).then(|| folder.clone()));
            match native.watch(&folder, RecursiveMode::NonRecursive) {
                Ok(()) => {
                    new = true;
                    after.insert(folder, inode);
                }
                Err(error) if matches!(error.kind, ErrorKind::PathNotFound) => {}
                Err(error) => failure = Some(error),
            }
        }
        for gone in before.keys().filter(|folder| !after.contains_key(*folder)) {
            // A folder that was deleted took its watch along.
            let _ = native.unwatch(gone);
        }
        if !after.is_empty() {
            self.watched.insert(owner.into(), after);
        }
        if let Some(error) = failure {
            self.report(&error);
        }
        if let Some(folder) = network.filter(|_| !self.exhausted) {
            let folder = folder.display();
            self.give_up(format!("{folder} lies on a network file system; looking at the folders in turn (--poll)"));
        }
        new
    }

    /// Lets go of folders that are gone.
    pub fn forget_missing(&mut self) {
        let missing: Vec<_> = self.watched.keys().filter(|owner| !owner.is_dir()).cloned().collect();
        missing.iter().for_each(|owner| _ = self.update(owner, Vec::new()));
    }

    /// Must some folders be looked at in turn?
    pub fn exhausted(&self) -> bool {
        self.exhausted
    }

    /// What should be said once.
    pub fn take_notice(&mut self) -> Option<String> {
        self.notices.pop_front()
    }

    /// Watches held, for measuring.
    pub fn count(&self) -> usize {
        self.watched.values().map(BTreeMap::len).sum()
    }

    fn report(&mut self, error: &notify::Error) {
        if self.exhausted {
            return;
        }
        let text = match error.kind {
            ErrorKind::MaxFilesWatch => {
                "out of inotify watches; looking at the folders in turn (raise fs.inotify.max_user_watches)".into()
            }
            _ => format!("cannot watch some folders ({error}); looking at them in turn"),
        };
        self.give_up(text);
    }

    fn give_up(&mut self, text: String) {
        self.exhausted = true;
        self.notices.push_back(text);
    }
}

fn send<T: From<Hint>>(hints: &Sender<T>, event: notify::Result<notify::Event>) {
    // The daemon may be gone already; then nobody wants the hint.
    let _ = match event {
        Ok(event) if event.need_rescan() => hints.send(Hint::Lost.into()),
        Ok(event) if event.kind.is_access() => Ok(()),
        Ok(event) => event.paths.into_iter().try_for_each(|path| hints.send(Hint::Changed(path).into())),
        Err(_) => hints.send(Hint::Lost.into()),
    };
}

/// Magic numbers of file systems that tell nobody when another machine writes: NFS, SMB, CIFS, SMB2, FUSE (sshfs), 9P, AFS, Ceph,
/// Lustre, GPFS, BeeGFS (`statfs(2)`).
const NETWORK: [i64; 11] = [
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

/// Does the folder lie on a file system whose changes by other machines raise no events here?
pub fn is_network(folder: &Path) -> bool {
    let Ok(path) = CString::new(folder.as_os_str().as_bytes()) else { return false };
    // SAFETY: `statfs` is plain numbers, for which all zeros is a value; `path` ends in NUL and lives through the call.
    let magic = unsafe {
        let mut about: libc::statfs = std::mem::zeroed();
        (libc::statfs(path.as_ptr(), &mut about) == 0).then_some(about.f_type)
    };
    magic.is_some_and(is_network_magic)
}

fn is_network_magic(magic: libc::__fsword_t) -> bool {
    // Some of them are negative where the type has 32 bits.
    NETWORK.contains(&i64::from(magic as u32))
}

#[cfg(test)]
mod tests {
    use std::{sync::mpsc::channel, time::Duration};

    use super::*;

    #[test]
    fn writes_into_a_watched_folder_are_hinted_and_others_are_not() {
        let root = tempfile::tempdir().expect("a temporary folder");
        let (seen, unseen) = (root.path().join("sparse"), root.path().join("viewrank"));
        std::fs::create_dir_all(&seen).expect("a folder");
        std::fs::create_dir_all(&unseen).expect("a folder");
        let (sender, hints) = channel::<Hint>();
        let mut watches = Watches::new(sender, false);
        assert!(watches.update(root.path(), vec![seen.clone()]));
        assert!(!watches.update(root.path(), vec![seen.clone()]));
        std::fs::write(unseen.join("manifest.json"), "{}").expect("a file");
        std::fs::write(seen.join("cameras.bin"), "x").expect("a file");
        let first = hints.recv_timeout(Duration::from_secs(10)).expect("a hint");
        assert_eq!(first, Hint::Changed(seen.join("cameras.bin")));
        assert!(hints.try_iter().all(|h| h == Hint::Changed(seen.join("cameras.bin"))));
    }

    #[test]
    fn this_machine_s_own_disk_is_no_network_and_nfs_and_smb_are() {
        assert!(!is_network(&std::env::temp_dir()));
        assert!(is_network_magic(libc::NFS_SUPER_MAGIC) && is_network_magic(libc::SMB_SUPER_MAGIC));
        assert!(is_network_magic(0xff53_4d42_u32 as i32 as libc::__fsword_t), "CIFS, negative in 32 bits");
        assert!(!is_network_magic(libc::TMPFS_MAGIC) && !is_network_magic(libc::EXT4_SUPER_MAGIC));
    }

    #[test]
    fn an_overflow_of_the_kernel_s_queue_means_that_events_were_lost() {
        let (sender, hints) = channel::<Hint>();
        send(&sender, Ok(notify::Event::new(notify::EventKind::Other).set_flag(notify::event::Flag::Rescan)));
        assert_eq!(hints.recv(), Ok(Hint::Lost));
    }
}
