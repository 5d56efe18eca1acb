//! File-system events, which only say when to scan: the comparison in `settle` decides what
//! changed.
//!
//! On Linux each folder that a scan visits is watched by itself: a recursive watch would fail at
//! the first unreadable folder, and spend inotify watches on folders that are neither input nor
//! depth maps. Elsewhere one recursive watch per root is native and cheap.

use std::{
    collections::BTreeSet,
    io,
    ops::Bound,
    path::{Path, PathBuf},
    sync::mpsc::Sender,
};

use notify::{
    ErrorKind, EventKind, RecursiveMode, Watcher as _,
    event::{ModifyKind, RenameMode},
};

use super::platform;

const MODE: RecursiveMode = if cfg!(target_os = "linux") {
    RecursiveMode::NonRecursive
} else {
    RecursiveMode::Recursive
};

/// A file-system event.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Change {
    /// Something changed at this path.
    At(PathBuf),
    /// The file or folder at this path was removed, replaced or moved away.
    Gone(PathBuf),
    /// Events were lost.
    Lost,
}

/// Watched folders.
pub struct Watches<T> {
    changes: Sender<T>,
    /// `None` where nothing is watched.
    native: Option<notify::RecommendedWatcher>,
    folders: BTreeSet<PathBuf>,
    /// Reason for polling some or all folders.
    notice: Option<String>,
}

impl<T: From<Change> + Send + 'static> Watches<T> {
    /// Sends events to `changes`.
    pub fn new(changes: Sender<T>) -> Self {
        Self {
            changes,
            native: None,
            folders: BTreeSet::new(),
            notice: None,
        }
    }

    /// Drops all watches, so that the next scan restores them: events may have been lost, and
    /// watches with them. Does nothing once folders are polled.
    pub fn renew(&mut self) {
        if self.needs_polling() {
            return;
        }
        self.folders.clear();
        let changes = self.changes.clone();
        match notify::recommended_watcher(move |event| send(&changes, event)) {
            Ok(native) => self.native = Some(native),
            Err(error) => self.give_up(format!(
                "no native file events ({error}); polling the folders"
            )),
        }
    }

    /// Watches these folders, too; returns whether a watch was added.
    pub fn add<'a>(&mut self, folders: impl IntoIterator<Item = &'a PathBuf>) -> bool {
        let before = self.folders.len();
        folders.into_iter().for_each(|folder| self.add_one(folder));
        self.folders.len() > before
    }

    fn add_one(&mut self, folder: &Path) {
        let Some(native) = &mut self.native else {
            return;
        };
        let is_covered = |above: &Path| self.folders.contains(above);
        if is_covered(folder)
            || MODE == RecursiveMode::Recursive && folder.ancestors().any(is_covered)
        {
            return;
        }
        match native.watch(folder, MODE) {
            Ok(()) => _ = self.folders.insert(folder.into()),
            Err(error) if is_reported_above(&error) => return,
            Err(error) => match error.kind {
                ErrorKind::MaxFilesWatch => self
                    .give_up("out of inotify watches; polling the folders (raise fs.inotify.max_user_watches)".into()),
                _ => self.give_up(format!("cannot watch some folders ({error}); polling them")),
            },
        }
        if platform::is_network(folder) {
            self.give_up(format!(
                "{} is on a network file system; polling the folders (--poll)",
                folder.display()
            ));
        }
    }

    /// Forgets the watches at and below a path that was removed, replaced or moved away, so that
    /// the next scan restores them.
    pub fn remove(&mut self, path: &Path) {
        // Paths are ordered by their components.
        let from = self
            .folders
            .range::<Path, _>((Bound::Included(path), Bound::Unbounded));
        let inside: Vec<PathBuf> = from
            .take_while(|folder| folder.starts_with(path))
            .cloned()
            .collect();
        for folder in inside {
            self.folders.remove(&folder);
            // Fails where the watch ended with its folder.
            _ = self.native.as_mut().map(|native| native.unwatch(&folder));
        }
    }

    /// True once some folders can't be watched.
    pub fn needs_polling(&self) -> bool {
        self.notice.is_some()
    }

    /// The reason for polling.
    pub fn notice(&self) -> Option<&String> {
        self.notice.as_ref()
    }

    /// Keeps the first reason.
    fn give_up(&mut self, reason: String) {
        self.notice.get_or_insert(reason);
    }
}

/// True for a folder that was removed or is unreadable: the folder above reports when that changes.
fn is_reported_above(error: &notify::Error) -> bool {
    match &error.kind {
        ErrorKind::PathNotFound => true,
        ErrorKind::Io(error) => matches!(
            error.kind(),
            io::ErrorKind::NotFound | io::ErrorKind::PermissionDenied
        ),
        _ => false,
    }
}

fn send<T: From<Change>>(changes: &Sender<T>, event: notify::Result<notify::Event>) {
    // Fails where the daemon has ended.
    let _ = match event {
        Ok(event) if event.need_rescan() => changes.send(Change::Lost.into()),
        // Scans raise them, too.
        Ok(event) if event.kind.is_access() => Ok(()),
        Ok(event) => {
            let change = match event.kind {
                EventKind::Modify(ModifyKind::Name(RenameMode::To | RenameMode::Both)) => {
                    Change::At
                }
                EventKind::Modify(ModifyKind::Name(_)) | EventKind::Remove(_) => Change::Gone,
                _ => Change::At,
            };
            event
                .paths
                .into_iter()
                .try_for_each(|path| changes.send(change(path).into()))
        }
        Err(_) => changes.send(Change::Lost.into()),
    };
}

#[cfg(test)]
mod tests {
    use std::{
        sync::mpsc::{Receiver, channel},
        time::Duration,
    };

    use super::*;

    fn watches() -> (Watches<Change>, Receiver<Change>) {
        let (sender, changes) = channel();
        let mut watches = Watches::new(sender);
        watches.renew();
        (watches, changes)
    }

    fn next(changes: &Receiver<Change>) -> Change {
        changes
            .recv_timeout(Duration::from_secs(10))
            .expect("a change")
    }

    #[test]
    fn only_writes_into_watched_folders_are_reported() {
        let root = tempfile::tempdir().expect("a temporary folder");
        let (watched, other) = (root.path().join("sparse"), root.path().join("viewrank"));
        std::fs::create_dir_all(&watched).expect("a folder");
        std::fs::create_dir_all(&other).expect("a folder");
        let (mut watches, changes) = watches();
        assert!(watches.add([&watched]));
        assert!(!watches.add([&watched]));
        std::fs::write(other.join("manifest.json"), "{}").expect("a file");
        std::fs::write(watched.join("cameras.bin"), "x").expect("a file");
        assert_eq!(next(&changes), Change::At(watched.join("cameras.bin")));
        assert!(
            changes
                .try_iter()
                .all(|change| change == Change::At(watched.join("cameras.bin")))
        );
    }

    #[test]
    fn a_watch_that_may_have_ended_is_set_anew() {
        let root = tempfile::tempdir().expect("a temporary folder");
        let (above, inner) = (root.path().join("a"), root.path().join("a/b"));
        std::fs::create_dir_all(&inner).expect("a folder");
        for forget in [
            |watches: &mut Watches<Change>, above: &Path| watches.remove(above),
            |watches: &mut Watches<Change>, _: &Path| watches.renew(),
        ] {
            let (mut watches, changes) = watches();
            watches.add([&above, &inner]);
            watches
                .native
                .as_mut()
                .expect("events")
                .unwatch(&inner)
                .expect("a watch");
            assert!(
                !watches.add([&above, &inner]),
                "the end of the watch went unnoticed"
            );
            forget(&mut watches, &above);
            assert!(watches.add([&above, &inner]));
            std::fs::write(inner.join("file"), "x").expect("a file");
            assert_eq!(next(&changes), Change::At(inner.join("file")));
        }
    }

    #[test]
    fn folders_that_are_removed_or_moved_away_are_reported_as_gone() {
        let root = tempfile::tempdir().expect("a temporary folder");
        let gone = |act: &dyn Fn(&Path)| {
            let folder = root.path().join("folder");
            std::fs::create_dir(&folder).expect("a folder");
            let (mut watches, changes) = watches();
            watches.add([&root.path().to_path_buf(), &folder]);
            act(&folder);
            while next(&changes) != Change::Gone(folder.clone()) {}
        };
        gone(&|folder| std::fs::remove_dir(folder).expect("removed"));
        gone(&|folder| std::fs::rename(folder, root.path().join("elsewhere")).expect("moved"));
    }

    #[test]
    fn an_overflow_of_the_kernel_s_queue_means_that_events_were_lost() {
        let (sender, changes) = channel::<Change>();
        send(
            &sender,
            Ok(notify::Event::new(EventKind::Other).set_flag(notify::event::Flag::Rescan)),
        );
        assert_eq!(changes.recv(), Ok(Change::Lost));
    }
}
