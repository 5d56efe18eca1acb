//! Somebody exchanges folders of a project for links to a folder elsewhere while it is written:
//! nothing changes there.

use std::{
    collections::BTreeMap,
    fs, io,
    os::unix::fs::symlink,
    path::{Path, PathBuf},
    sync::{
        Mutex,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    thread,
    time::{Duration, SystemTime},
};

use viewrank_io::output::{
    Contents, Disk, FileSet, Operation, make_folder, recover, remove, replace, write_all,
};

use super::empty_folder;

/// Folders that are exchanged, relative to the watched root.
const FOLDERS: [&str; 10] = [
    "",
    "a",
    "a/p",
    "a/p/images",
    "a/p/viewrank",
    "a/p/viewrank/.sets",
    "a/p/viewrank/.staging",
    "a/p/viewrank/sgm",
    "a/p/viewrank/sgm/maps",
    "viewrank",
];

/// A watched root with a project, and a folder elsewhere that looks like each of its folders.
struct Place {
    folder: tempfile::TempDir,
    before: BTreeMap<PathBuf, (SystemTime, Vec<u8>)>,
}

impl Place {
    fn new() -> Self {
        let folder = empty_folder();
        let (root, outside) = (folder.path().join("root"), folder.path().join("outside"));
        for above in ["", "a/p", "p", "p/viewrank"] {
            let above = outside.join(above);
            let own = [
                "images",
                "maps",
                "sgm/maps",
                "p/viewrank/sgm/maps",
                "viewrank/sgm/maps",
                ".sets",
                "viewrank/.sets",
            ];
            own.iter()
                .for_each(|inner| fs::create_dir_all(above.join(inner)).unwrap());
            for name in [
                "status.json",
                "manifest.json",
                "sgm/list",
                "sgm/maps/1",
                "1",
                "list",
                "viewrank/manifest.json",
            ] {
                fs::write(above.join(name), "precious").unwrap();
            }
        }
        fs::create_dir_all(root.join("a/p/images")).unwrap();
        fs::create_dir_all(root.join("viewrank")).unwrap();
        fs::write(root.join("a/p/images/1.jpg"), "image").unwrap();
        let before = found(&outside);
        Self { folder, before }
    }

    fn root(&self) -> PathBuf {
        self.folder.path().join("root")
    }

    /// The root itself, for the empty name, or a folder below it.
    fn at(&self, folder: &str) -> PathBuf {
        self.root().join(folder).components().collect()
    }

    fn outside(&self) -> PathBuf {
        self.folder.path().join("outside")
    }

    /// Writes what a daemon writes; `version` makes each of the files another. Returns whether the
    /// plan was written.
    fn write(
        &self,
        version: usize,
        before: &(dyn Fn(Operation, &Path) -> io::Result<()> + Sync),
    ) -> bool {
        let (root, project) = (self.root(), self.root().join("a/p"));
        let within = [root.clone(), project.clone()];
        let disk = Disk::guarded(before).within(&within);
        let mut plan = FileSet::new(&project, "plan");
        let mut export = FileSet::new(project.join("viewrank/sgm"), "export");
        plan.add_text("viewrank/manifest.json", version.to_string());
        plan.add_text(
            format!("viewrank/sgm/maps/{}", version % 3),
            version.to_string(),
        );
        plan.add(
            "viewrank/sgm/images/1.jpg",
            Contents::Link {
                file: project.join("images/1.jpg"),
                folder: project.join("images"),
            },
        );
        plan.add(
            "viewrank/sgm/copies/1.jpg",
            Contents::Copy(project.join("images/1.jpg")),
        );
        export.add_text("list", version.to_string());
        // Each of them may fail, and fails without harm.
        _ = recover(&project, &disk);
        let written = write_all(&[plan, export], &disk);
        _ = make_folder(&project.join("viewrank/dispatch/sgm"), &disk);
        _ = replace(&project.join("viewrank/progress.json"), b"progress", &disk);
        _ = remove(&project.join("viewrank/sgm/maps/1"), &disk);
        let own = [root.clone(), root.join("viewrank")];
        _ = replace(
            &root.join("viewrank/status.json"),
            b"status",
            &Disk::guarded(before).within(&own),
        );
        written.is_ok()
    }

    #[track_caller]
    fn check(&self, when: &str) {
        let after = found(&self.outside());
        let differs = |path: &&PathBuf| after.get(*path) != self.before.get(*path);
        let changed: Vec<&PathBuf> = self
            .before
            .keys()
            .chain(after.keys())
            .filter(differs)
            .collect();
        assert!(changed.is_empty(), "{when}: {changed:?}");
    }

    /// Puts a link in place of the folder, for the duration of `act`; false if it isn't there.
    fn exchange(&self, folder: &str, act: impl FnOnce()) -> bool {
        let (at, aside) = (self.at(folder), self.folder.path().join("aside"));
        if fs::rename(&at, &aside).is_err() {
            return false;
        }
        let linked = symlink(self.outside(), &at).is_ok();
        act();
        if linked {
            _ = fs::remove_file(&at);
        }
        // What was made in its place meanwhile is in the way.
        while fs::rename(&aside, &at).is_err() {
            _ = fs::remove_dir_all(&at);
        }
        true
    }
}

/// All below a folder, with the time of the last change and the contents of files.
fn found(folder: &Path) -> BTreeMap<PathBuf, (SystemTime, Vec<u8>)> {
    let entries = walkdir::WalkDir::new(folder)
        .into_iter()
        .map(|entry| entry.unwrap());
    entries
        .map(|entry| {
            let contents = fs::read(entry.path()).unwrap_or_default();
            (
                entry.path().to_path_buf(),
                (entry.metadata().unwrap().modified().unwrap(), contents),
            )
        })
        .collect()
}

#[test]
fn a_folder_exchanged_just_before_any_change_leads_nothing_out() {
    let mut exchanged = 0;
    for folder in FOLDERS {
        let mut at = 0;
        loop {
            let place = Place::new();
            place.write(0, &|_, _| Ok(()));
            let (operations, is_done) = (AtomicUsize::new(0), AtomicBool::new(false));
            let aside = Mutex::new(false);
            // The link is there from the instant before operation number `at` until the one after
            // it.
            let before = |_: Operation, _: &Path| {
                let n = operations.fetch_add(1, Ordering::Relaxed);
                let (here, kept) = (place.at(folder), place.folder.path().join("aside"));
                let mut linked = aside.lock().unwrap();
                if n == at && fs::rename(&here, &kept).is_ok() {
                    symlink(place.outside(), &here).unwrap();
                    *linked = true;
                } else if *linked {
                    _ = fs::remove_file(&here);
                    _ = fs::rename(&kept, &here);
                    *linked = false;
                    is_done.store(true, Ordering::Relaxed);
                }
                Ok(())
            };
            place.write(1, &before);
            place.check(&format!("{folder} before operation {at}"));
            exchanged += usize::from(is_done.into_inner());
            at += 1;
            if at > operations.into_inner() {
                break;
            }
        }
    }
    assert!(exchanged > 100, "{exchanged}");
}

/// As long as VIEWRANK_RACES says: 300 changes by default.
#[test]
fn folders_exchanged_at_any_instant_lead_nothing_out() {
    let changes: usize = std::env::var("VIEWRANK_RACES")
        .ok()
        .and_then(|n| n.parse().ok())
        .unwrap_or(300);
    let place = Place::new();
    place.write(0, &|_, _| Ok(()));
    let (is_over, exchanges) = (AtomicBool::new(false), AtomicUsize::new(0));
    let (mut version, mut written) = (0, 0);
    thread::scope(|threads| {
        threads.spawn(|| {
            for folder in FOLDERS
                .iter()
                .cycle()
                .take_while(|_| !is_over.load(Ordering::Relaxed))
            {
                exchanges.fetch_add(
                    usize::from(place.exchange(folder, thread::yield_now)),
                    Ordering::Relaxed,
                );
                // Long enough for a part of a change.
                thread::sleep(Duration::from_micros(200));
            }
        });
        // On a busy machine the other thread may need longer for its share.
        let is_disturbed = |written: usize, version: usize| {
            exchanges.load(Ordering::Relaxed) > changes / 10 && (1..version).contains(&written)
        };
        while version < changes || !is_disturbed(written, version) && version < 20 * changes {
            version += 1;
            written += usize::from(place.write(version, &|_, _| Ok(())));
        }
        is_over.store(true, Ordering::Relaxed);
    });
    place.check(&format!("{version} changes"));
    let exchanges = exchanges.into_inner();
    assert!(
        exchanges > changes / 10 && (1..version).contains(&written),
        "{exchanges} exchanges, {written} of {version} written"
    );
    // Nobody disturbs it any more.
    place.write(changes + 1, &|_, _| Ok(()));
    place.write(changes + 2, &|_, _| Ok(()));
    assert_eq!(
        fs::read_to_string(place.root().join("a/p/viewrank/manifest.json")).unwrap(),
        (changes + 2).to_string()
    );
}
