//! Hints that something changed: native events where the file system has them, looks at fixed times where it hasn't.
//!
//! Each folder is watched by itself, so that the folders that viewrank writes to never wake it and the images of a project cost one
//! watch a folder. Events are hints only: what decides is the comparison in `settle`.

use std::{
    collections::{BTreeMap, BTreeSet},
    ffi::CString,
    io,
    ops::Bound,
    os::unix::{ffi::OsStrExt, fs::MetadataExt},
    path::{Path, PathBuf},
    sync::mpsc::Sender,
};

use notify::{ErrorKind, EventKind, RecursiveMode, Watcher as _, event::ModifyKind};

/// What is heard of.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Change {
    /// Something happened at or below this path.
    At(PathBuf),
    /// It went, or another came in its place.
    Gone(PathBuf),
    /// Events were lost: everything must be looked at.
    Lost,
}

/// Watches folders.
pub struct Watches {
    native: Option<notify::RecommendedWatcher>,
    watched: BTreeMap<PathBuf, Watch>,
    /// Why some or all folders are looked at in turn instead of being watched.
    notices: Vec<String>,
    exhausted: bool,
}

/// Of one folder.
struct Watch {
    /// The project, or the folder itself outside projects.
    owner: PathBuf,
    inode: u64,
    /// A watch ends with its folder; one that is made again may get the same inode.
    stands: bool,
}

impl Watches {
    /// Tells `changes`. With `poll` no native events are asked for.
    pub fn new<T: From<Change> + Send + 'static>(changes: Sender<T>, poll: bool) -> Self {
        let mut watches = Self { native: None, watched: BTreeMap::new(), notices: Vec::new(), exhausted: poll };
        if !poll {
            match notify::recommended_watcher(move |event| send(&changes, event)) {
                Ok(native) => watches.native = Some(native),
                Err(error) => {
                    watches.give_up(format!("no native file events ({error}); looking at the folders in turn"))
                }
            }
        }
        watches
    }

    /// Watches exactly these folders for `owner` (a project, or a folder outside projects; they lie in it); true when new ones came. A
    /// folder that was deleted and made again is watched again.
    pub fn update(&mut self, owner: &Path, folders: &[PathBuf]) -> bool {
        let Some(native) = &mut self.native else { return false };
        let (mut failure, mut new, mut network) = (None, false, None);
        for folder in folders {
            let Ok(inode) = std::fs::metadata(folder).map(|m| m.ino()) else { continue };
            let known = self.watched.get_mut(folder).filter(|watch| watch.inode == inode);
            let is_new = known.is_none();
            if let Some(watch) = known.filter(|watch| watch.stands) {
                watch.owner = owner.into();
                continue;
            }
            network = network.or_else(|| is_network(folder).then(|| folder.clone()));
            match native.watch(folder, RecursiveMode::NonRecursive) {
                Ok(()) => {
                    new |= is_new;
                    self.watched.insert(folder.clone(), Watch { owner: owner.into(), inode, stands: true });
                }
                Err(error) if will_be_told(&error) => _ = self.watched.remove(folder),
                Err(error) => failure = Some(error),
            }
        }
        let own = inside(&self.watched, owner).filter(|(_, watch)| watch.owner == owner);
        let gone: Vec<_> = own.map(|(folder, _)| folder).filter(|folder| !folders.contains(folder)).cloned().collect();
        for folder in gone {
            self.watched.remove(&folder);
            // A folder that was deleted took its watch along.
            let _ = native.unwatch(&folder);
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

    /// The folder went, and what was in it: their watches did, too, whatever is there now.
    pub fn doubt(&mut self, folder: &Path) {
        let inside: Vec<PathBuf> = inside(&self.watched, folder).map(|(folder, _)| folder.clone()).collect();
        for folder in inside {
            if let Some(watch) = self.watched.get_mut(&folder) {
                (watch.inode, watch.stands) = (0, false);
            }
        }
    }

    /// Has all folders watched anew as they are looked at: events may have been lost, and watches with them.
    pub fn renew(&mut self) {
        // Where they are looked at in turn anyway, that would cost more than it is worth.
        if !self.exhausted {
            self.watched.values_mut().for_each(|watch| watch.stands = false);
        }
    }

    /// Lets go of folders that are gone.
    pub fn forget_missing(&mut self) {
        let owners: BTreeSet<&PathBuf> = self.watched.values().map(|watch| &watch.owner).collect();
        let missing: Vec<_> = owners.into_iter().filter(|owner| !owner.is_dir()).cloned().collect();
        missing.iter().for_each(|owner| _ = self.update(owner, &[]));
    }

    /// Must some folders be looked at in turn?
    pub fn exhausted(&self) -> bool {
        self.exhausted
    }

    /// Why they must be.
    pub fn notices(&self) -> &[String] {
        &self.notices
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
        self.notices.push(text);
    }
}

/// The folders at and below a path.
fn inside<'a>(watched: &'a BTreeMap<PathBuf, Watch>, path: &Path) -> impl Iterator<Item = (&'a PathBuf, &'a Watch)> {
    // Paths are ordered by their components.
    let from = (Bound::Included(path), Bound::Unbounded);
    watched.range::<Path, _>(from).take_while(move |(folder, _)| folder.starts_with(path))
}

/// The folder above tells of one that comes back or may be looked into again.
fn will_be_told(error: &notify::Error) -> bool {
    match &error.kind {
        ErrorKind::PathNotFound => true,
        ErrorKind::Io(error) => matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::PermissionDenied),
        _ => false,
    }
}

fn send<T: From<Change>>(changes: &Sender<T>, event: notify::Result<notify::Event>) {
    // The daemon may be gone already; then nobody wants to hear of it.
    let _ = match event {
        Ok(event) if event.need_rescan() => changes.send(Change::Lost.into()),
        Ok(event) if event.kind.is_access() => Ok(()),
        Ok(event) => {
            let moved = matches!(event.kind, EventKind::Modify(ModifyKind::Name(_)));
            let change = if moved || event.kind.is_remove() { Change::Gone } else { Change::At };
            event.paths.into_iter().try_for_each(|path| changes.send(change(path).into()))
        }
        Err(_) => changes.send(Change::Lost.into()),
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
        let (sender, hints) = channel::<Change>();
        let mut watches = Watches::new(sender, false);
        assert!(watches.update(root.path(), std::slice::from_ref(&seen)));
        assert!(!watches.update(root.path(), std::slice::from_ref(&seen)));
        std::fs::write(unseen.join("manifest.json"), "{}").expect("a file");
        std::fs::write(seen.join("cameras.bin"), "x").expect("a file");
        let first = hints.recv_timeout(Duration::from_secs(10)).expect("a hint");
        assert_eq!(first, Change::At(seen.join("cameras.bin")));
        assert!(hints.try_iter().all(|h| h == Change::At(seen.join("cameras.bin"))));
    }

    /// A watch that ended with its folder, where the folder that was made since has its inode.
    #[test]
    fn a_watch_that_may_have_ended_is_made_again() {
        let root = tempfile::tempdir().expect("a temporary folder");
        let (above, inner) = (root.path().join("a"), root.path().join("a/b"));
        std::fs::create_dir_all(&inner).expect("a folder");
        type Doubt = fn(&mut Watches, &Path);
        let doubts: [(Doubt, bool); 2] = [(|w, above| w.doubt(above), true), (|w, _| w.renew(), false)];
        for (doubt, is_new) in doubts {
            let (sender, changes) = channel::<Change>();
            let mut watches = Watches::new(sender, false);
            watches.update(&above, &[above.clone(), inner.clone()]);
            watches.native.as_mut().expect("events").unwatch(&inner).expect("a watch");
            assert!(!watches.update(&above, &[above.clone(), inner.clone()]), "it is taken for standing");
            doubt(&mut watches, &above);
            assert_eq!(watches.update(&above, &[above.clone(), inner.clone()]), is_new);
            std::fs::write(inner.join("file"), "x").expect("a file");
            assert_eq!(changes.recv_timeout(Duration::from_secs(10)), Ok(Change::At(inner.join("file"))));
        }
    }

    #[test]
    fn it_is_told_when_a_folder_goes_or_is_replaced() {
        let root = tempfile::tempdir().expect("a temporary folder");
        let gone = |act: &dyn Fn(&Path)| {
            let folder = root.path().join("folder");
            std::fs::create_dir(&folder).expect("a folder");
            let (sender, changes) = channel::<Change>();
            let mut watches = Watches::new(sender, false);
            watches.update(root.path(), &[root.path().to_path_buf(), folder.clone()]);
            act(&folder);
            while changes.recv_timeout(Duration::from_secs(10)).expect("a change") != Change::Gone(folder.clone()) {}
        };
        gone(&|folder| std::fs::remove_dir(folder).expect("removed"));
        gone(&|folder| std::fs::rename(folder, root.path().join("elsewhere")).expect("moved"));
    }

    #[test]
    fn a_folder_is_its_last_owner_s_alone() {
        let root = tempfile::tempdir().expect("a temporary folder");
        let (project, inner) = (root.path().join("p"), root.path().join("p/sparse"));
        std::fs::create_dir_all(&inner).expect("a folder");
        let mut watches = Watches::new(channel::<Change>().0, false);
        watches.update(&inner, std::slice::from_ref(&inner));
        watches.update(&project, &[project.clone(), inner.clone()]);
        watches.update(&inner, &[]);
        assert_eq!(watches.watched.keys().collect::<Vec<_>>(), [&project, &inner]);
        watches.update(&project, std::slice::from_ref(&project));
        assert_eq!(watches.watched.keys().collect::<Vec<_>>(), [&project]);
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
        let (sender, hints) = channel::<Change>();
        send(&sender, Ok(notify::Event::new(notify::EventKind::Other).set_flag(notify::event::Flag::Rescan)));
        assert_eq!(hints.recv(), Ok(Change::Lost));
    }
}
