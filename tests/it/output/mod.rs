//! Sets of files appear whole or not at all, whatever fails and whenever the process dies.

#[cfg(unix)]
mod races;
mod strangers;

use std::{
    collections::BTreeMap,
    fs, io,
    path::Path,
    sync::atomic::{AtomicUsize, Ordering},
};

use viewrank_io::output::{Contents, Disk, FileSet, Operation, OutputError, recover, replace};

/// A folder of its own, in memory where the machine has such a place: these tests sync some
/// thousand times.
fn empty_folder() -> tempfile::TempDir {
    tempfile::tempdir_in("/dev/shm")
        .or_else(|_| tempfile::tempdir())
        .unwrap()
}

/// All that a user sees below a folder: path and contents (links as `-> target`), without the
/// program's own bookkeeping.
fn tree(root: &Path) -> BTreeMap<String, String> {
    let entries = walkdir::WalkDir::new(root)
        .min_depth(1)
        .into_iter()
        .map(|entry| entry.unwrap());
    let named = entries.map(|entry| {
        (
            entry
                .path()
                .strip_prefix(root)
                .unwrap()
                .to_str()
                .unwrap()
                .to_owned(),
            entry,
        )
    });
    let visible = named.filter(|(path, _)| path != "viewrank" && !path.starts_with("viewrank/."));
    visible
        .map(|(path, entry)| {
            let kind = entry.file_type();
            let contents = match () {
                () if kind.is_symlink() => {
                    format!("-> {}", fs::read_link(entry.path()).unwrap().display())
                }
                () if kind.is_dir() => "folder".into(),
                () => fs::read_to_string(entry.path()).unwrap(),
            };
            (path, contents)
        })
        .collect()
}

fn set(root: &Path, files: &[(&str, &str)]) -> FileSet {
    let mut set = FileSet::new(root, "test");
    files
        .iter()
        .for_each(|(path, text)| set.add_text(*path, *text));
    set
}

fn write(root: &Path, files: &[(&str, &str)]) -> viewrank_io::output::WriteReport {
    set(root, files).write(&Disk::REAL).unwrap()
}

fn texts(files: &[(&str, &str)]) -> BTreeMap<String, String> {
    files
        .iter()
        .map(|(path, text)| (path.to_string(), text.to_string()))
        .collect()
}

#[test]
fn a_later_set_replaces_the_earlier_and_touches_nothing_else() {
    let folder = empty_folder();
    let root = folder.path();
    fs::write(root.join("theirs.txt"), "theirs").unwrap();
    let first = write(
        root,
        &[("a.txt", "a"), ("deep/er/b.txt", "b"), ("same.txt", "same")],
    );
    assert_eq!(first.changed, ["a.txt", "deep/er/b.txt", "same.txt"]);
    let before = fs::metadata(root.join("same.txt"))
        .unwrap()
        .modified()
        .unwrap();

    let second = write(
        root,
        &[("a.txt", "a2"), ("c/c.txt", "c"), ("same.txt", "same")],
    );
    assert_eq!(
        (second.changed.as_slice(), second.removed.as_slice()),
        (
            &["a.txt".into(), "c/c.txt".into()][..],
            &["deep/er/b.txt".into()][..]
        )
    );
    assert_eq!(
        fs::metadata(root.join("same.txt"))
            .unwrap()
            .modified()
            .unwrap(),
        before,
        "unchanged files keep their time"
    );
    let expected = texts(&[
        ("a.txt", "a2"),
        ("c", "folder"),
        ("c/c.txt", "c"),
        ("same.txt", "same"),
        ("theirs.txt", "theirs"),
    ]);
    assert_eq!(tree(root), expected);
    assert_eq!(
        write(
            root,
            &[("a.txt", "a2"), ("c/c.txt", "c"), ("same.txt", "same")]
        ),
        Default::default()
    );
}

#[test]
fn somebody_elses_file_is_kept_once() {
    let folder = empty_folder();
    let root = folder.path();
    fs::write(root.join("fusion.cfg"), "original").unwrap();
    assert_eq!(
        write(root, &[("fusion.cfg", "ours")]).kept,
        ["fusion.cfg.before-viewrank"]
    );
    write(root, &[("fusion.cfg", "ours, newer")]);
    let expected = texts(&[
        ("fusion.cfg", "ours, newer"),
        ("fusion.cfg.before-viewrank", "original"),
    ]);
    assert_eq!(tree(root), expected);

    // The other program writes its file again, then the user edits it: the first is kept already,
    // the second is not.
    fs::write(root.join("fusion.cfg"), "original").unwrap();
    assert!(
        write(root, &[("fusion.cfg", "ours, newest")])
            .kept
            .is_empty()
    );
    fs::write(root.join("fusion.cfg"), "edited").unwrap();
    assert_eq!(
        write(root, &[("fusion.cfg", "ours, at last")]).kept,
        ["fusion.cfg.before-viewrank-2"]
    );
}

#[test]
fn what_was_edited_or_belongs_to_another_set_does_not_go_stale() {
    let folder = empty_folder();
    let root = folder.path();
    write(
        root,
        &[("edited", "ours"), ("shared", "both"), ("stale", "ours")],
    );
    let mut other = FileSet::new(root, "other");
    other.add_text("shared", "both");
    other.add_text("own", "other");
    other.write(&Disk::REAL).unwrap();
    fs::write(root.join("edited"), "by hand").unwrap();
    assert_eq!(write(root, &[]).removed, ["stale"]);
    assert_eq!(
        tree(root),
        texts(&[("edited", "by hand"), ("own", "other"), ("shared", "both")])
    );
}

#[cfg(unix)]
#[test]
fn links_scripts_copies_and_folders() {
    use std::os::unix::fs::PermissionsExt;
    let folder = empty_folder();
    let root = folder.path().join("project");
    fs::create_dir_all(root.join("images")).unwrap();
    fs::write(root.join("images/1.jpg"), "picture").unwrap();
    fs::write(folder.path().join("outside.jpg"), "outside").unwrap();
    let link = |name: &str, folder: &Path| Contents::Link {
        file: folder.join(name),
        folder: folder.into(),
    };
    let mut set = FileSet::new(&root, "test");
    set.add("out/deep/1.jpg", link("images/1.jpg", &root));
    set.add("out/outside.jpg", link("outside.jpg", folder.path()));
    set.add("out/copy.jpg", Contents::Copy(root.join("images/1.jpg")));
    set.add("run.sh", Contents::Script(b"#!/bin/sh\n".to_vec()));
    set.add("maps", Contents::Folder);
    set.add_text("plain.txt", "text");
    set.write(&Disk::REAL).unwrap();
    let mode = |name: &str| fs::metadata(root.join(name)).unwrap().permissions().mode() & 0o111;
    assert_eq!(mode("plain.txt"), 0);
    assert_eq!(
        fs::read_link(root.join("out/deep/1.jpg")).unwrap(),
        Path::new("../../images/1.jpg")
    );
    assert_eq!(
        fs::read_to_string(root.join("out/deep/1.jpg")).unwrap(),
        "picture"
    );
    assert!(
        fs::read_link(root.join("out/outside.jpg"))
            .unwrap()
            .is_absolute()
    );
    assert_ne!(mode("run.sh"), 0);
    assert!(root.join("maps").is_dir());
    assert_eq!(set.write(&Disk::REAL).unwrap(), Default::default());
    fs::set_permissions(root.join("run.sh"), fs::Permissions::from_mode(0o644)).unwrap();
    set.write(&Disk::REAL).unwrap();
    assert_ne!(mode("run.sh"), 0);

    FileSet::new(&root, "test").write(&Disk::REAL).unwrap();
    assert_eq!(
        tree(&root),
        texts(&[("images", "folder"), ("images/1.jpg", "picture")])
    );
}

#[cfg(unix)]
#[test]
fn links_below_a_linked_folder_lead_to_the_images() {
    let folder = empty_folder();
    let (root, images) = (folder.path(), folder.path().join("images"));
    fs::create_dir_all(root.join("data/deep/outputs")).unwrap();
    std::os::unix::fs::symlink("data/deep/outputs", root.join("viewrank")).unwrap();
    fs::create_dir(&images).unwrap();
    fs::write(images.join("1.jpg"), "picture").unwrap();
    let mut set = FileSet::new(root, "test");
    let file = images.join("1.jpg");
    let link = "viewrank/out/1.jpg";
    set.add(
        link,
        Contents::Link {
            file,
            folder: images,
        },
    );
    for _ in 0..2 {
        set.write(&Disk::REAL).unwrap();
        assert_eq!(fs::read_to_string(root.join(link)).unwrap(), "picture");
    }
}

#[test]
fn where_links_cannot_be_made_only_files_of_the_folder_are_copied() {
    use std::os::unix::fs::symlink;
    let folder = empty_folder();
    let (root, store) = (folder.path().join("project"), folder.path().join("store"));
    let images = root.join("images");
    fs::create_dir_all(&root).unwrap();
    fs::create_dir_all(store.join("day 1")).unwrap();
    fs::write(store.join("1.jpg"), "picture").unwrap();
    fs::write(store.join("day 1/2.jpg"), "second picture").unwrap();
    fs::write(folder.path().join("id_rsa"), "secret").unwrap();
    // The folder may be a link itself, and have links within it.
    symlink(&store, &images).unwrap();
    symlink("day 1/2.jpg", store.join("2.jpg")).unwrap();
    symlink("../id_rsa", store.join("3.jpg")).unwrap();
    symlink("..", store.join("up")).unwrap();
    let without_links = |operation: Operation, _: &Path| match operation {
        Operation::Link => Err(std::io::ErrorKind::PermissionDenied.into()),
        _ => Ok(()),
    };
    let export = |name: &str| {
        let mut set = FileSet::new(&root, "test");
        set.add(
            "out/image.jpg",
            Contents::Link {
                file: images.join(name),
                folder: images.clone(),
            },
        );
        set.write(&Disk::guarded(&without_links))
            .map(|_| fs::read_to_string(root.join("out/image.jpg")).unwrap())
    };
    for name in ["3.jpg", "up/id_rsa", "../id_rsa", "../store/../id_rsa"] {
        let refused = export(name);
        assert!(
            matches!(&refused, Err(OutputError::CopyOut { path, .. }) if *path == images.join(name)),
            "{refused:?}"
        );
        assert!(!root.join("out").exists());
    }
    assert_eq!(export("1.jpg").unwrap(), "picture");
    assert_eq!(export("2.jpg").unwrap(), "second picture");
}

#[test]
fn names_never_leave_the_root() {
    let folder = empty_folder();
    for name in [
        "../evil",
        "/etc/evil",
        "a/../../evil",
        "./a",
        "a//b",
        "",
        "a/",
        "..",
        "nul\0",
    ] {
        let refused = set(&folder.path().join("root"), &[(name, "")]).write(&Disk::REAL);
        assert!(matches!(refused, Err(OutputError::Name { .. })), "{name:?}");
    }
    assert_eq!(tree(folder.path()), texts(&[]));
}

#[cfg(unix)]
#[test]
fn links_out_of_the_root_are_not_followed() {
    let folder = empty_folder();
    let (root, outside) = (folder.path().join("root"), folder.path().join("outside"));
    fs::create_dir_all(root.join("real")).unwrap();
    fs::create_dir(&outside).unwrap();
    std::os::unix::fs::symlink(&outside, root.join("stereo")).unwrap();
    std::os::unix::fs::symlink(folder.path().join("gone"), root.join("dangling")).unwrap();
    std::os::unix::fs::symlink("real", root.join("inner")).unwrap();
    for file in ["stereo/fusion.cfg", "dangling/fusion.cfg"] {
        let refused = set(&root, &[("a", "a"), (file, "")]).write(&Disk::REAL);
        assert!(
            matches!(refused, Err(OutputError::Escapes { .. })),
            "{file}: {refused:?}"
        );
    }
    assert!(!root.join("a").exists() && fs::read_dir(&outside).unwrap().next().is_none());
    write(&root, &[("inner/a", "a")]);
    assert_eq!(fs::read_to_string(root.join("real/a")).unwrap(), "a");

    // A link in the place of a file is somebody else's file; what it points to stays as it is.
    fs::write(outside.join("precious"), "precious").unwrap();
    std::os::unix::fs::symlink(outside.join("precious"), root.join("b")).unwrap();
    fs::write(outside.join("same"), "ours").unwrap();
    std::os::unix::fs::symlink(outside.join("same"), root.join("c")).unwrap();
    write(&root, &[("b", "ours"), ("c", "ours")]);
    assert!(
        fs::symlink_metadata(root.join("c")).unwrap().is_file(),
        "the same contents, but elsewhere"
    );
    assert_eq!(
        fs::read_to_string(outside.join("precious")).unwrap(),
        "precious"
    );
    assert_eq!(
        fs::read_link(root.join("b.before-viewrank")).unwrap(),
        outside.join("precious")
    );
}

#[test]
fn a_file_in_the_place_of_a_folder_is_an_error_that_changes_nothing() {
    let folder = empty_folder();
    fs::write(folder.path().join("a"), "file").unwrap();
    fs::create_dir(folder.path().join("b")).unwrap();
    for path in ["a/b", "b"] {
        let refused = set(folder.path(), &[("0", ""), (path, "")]).write(&Disk::REAL);
        assert!(
            matches!(refused, Err(OutputError::InTheWay { .. })),
            "{path}"
        );
    }
    assert_eq!(
        tree(folder.path()),
        texts(&[("a", "file"), ("b", "folder")])
    );
    assert!(!folder.path().join("viewrank/.staging").exists());
}

/// A project with a file of somebody else's and an earlier set of ours, and the set that is to
/// replace it.
fn prepare(root: &Path) -> FileSet {
    fs::write(root.join("theirs.cfg"), "theirs").unwrap();
    write(
        root,
        &[
            ("a", "old a"),
            ("old/b", "old b"),
            ("old/deep/c", "old c"),
            ("same", "same"),
        ],
    );
    let new = [
        ("a", "new a"),
        ("new/d", "new d"),
        ("new/deep/e", "new e"),
        ("same", "same"),
        ("theirs.cfg", "ours"),
    ];
    set(root, &new)
}

/// The trees before and after the change of [`prepare`], and how many operations it takes.
fn undisturbed() -> (BTreeMap<String, String>, BTreeMap<String, String>, usize) {
    let folder = empty_folder();
    let new = prepare(folder.path());
    let old_tree = tree(folder.path());
    let operations = AtomicUsize::new(0);
    let count = |_: Operation, _: &Path| {
        operations.fetch_add(1, Ordering::Relaxed);
        Ok(())
    };
    new.write(&Disk::guarded(&count)).unwrap();
    (old_tree, tree(folder.path()), operations.into_inner())
}

/// Fails operation number `at`, or all from there on as if the process had died.
fn fail_at(at: usize, from_there_on: bool) -> impl Fn(Operation, &Path) -> io::Result<()> + Sync {
    let operations = AtomicUsize::new(0);
    move |_, _| {
        let n = operations.fetch_add(1, Ordering::Relaxed);
        let fails = n == at || (from_there_on && n > at);
        if fails {
            Err(io::ErrorKind::StorageFull.into())
        } else {
            Ok(())
        }
    }
}

#[test]
fn any_single_failure_leaves_the_old_set_or_the_new() {
    let (old, new, operations) = undisturbed();
    for at in 0..operations {
        let folder = empty_folder();
        let result = prepare(folder.path()).write(&Disk::guarded(&fail_at(at, false)));
        let expected = if result.is_ok() { &new } else { &old };
        assert_eq!(&tree(folder.path()), expected, "operation {at}: {result:?}");
        assert!(
            !folder.path().join("viewrank/.journal.json").exists(),
            "operation {at}"
        );
        // The next run is as if nothing had been.
        prepare_again(folder.path()).write(&Disk::REAL).unwrap();
        assert_eq!(tree(folder.path()), new, "operation {at}");
        assert!(
            !folder.path().join("viewrank/.staging").exists(),
            "operation {at}"
        );
    }
}

/// The new set of [`prepare`] alone.
fn prepare_again(root: &Path) -> FileSet {
    let new = [
        ("a", "new a"),
        ("new/d", "new d"),
        ("new/deep/e", "new e"),
        ("same", "same"),
        ("theirs.cfg", "ours"),
    ];
    set(root, &new)
}

#[test]
fn a_process_that_dies_at_any_instant_leaves_what_recovery_makes_whole() {
    let (old, new, operations) = undisturbed();
    let mut finished = 0;
    for at in 0..operations {
        let folder = empty_folder();
        let result = prepare(folder.path()).write(&Disk::guarded(&fail_at(at, true)));
        recover(folder.path(), &Disk::REAL).unwrap();
        let found = tree(folder.path());
        assert!(
            found == old || found == new,
            "operation {at}: {result:?}: {found:?}"
        );
        finished += usize::from(found == new);
        prepare_again(folder.path()).write(&Disk::REAL).unwrap();
        assert_eq!(tree(folder.path()), new, "operation {at}");
    }
    assert!(finished > 0 && finished < operations, "both ends occur");
}

#[test]
fn a_file_that_is_replaced_is_the_old_or_the_new_whatever_fails() {
    let operations = AtomicUsize::new(0);
    let count = |_: Operation, _: &Path| {
        operations.fetch_add(1, Ordering::Relaxed);
        Ok(())
    };
    replace(
        &empty_folder().path().join("status.json"),
        b"new",
        &Disk::guarded(&count),
    )
    .unwrap();
    for (at, dies) in (0..operations.into_inner()).flat_map(|at| [(at, false), (at, true)]) {
        let folder = empty_folder();
        let path = folder.path().join("status.json");
        replace(&path, b"old", &Disk::REAL).unwrap();
        let result = replace(&path, b"new", &Disk::guarded(&fail_at(at, dies)));
        assert!(
            matches!(result, Err(OutputError::Full { .. })),
            "operation {at}"
        );
        assert_eq!(fs::read(&path).unwrap(), b"old", "operation {at}");
        assert!(
            dies || fs::read_dir(folder.path()).unwrap().count() == 1,
            "operation {at} leaves its draft"
        );
        replace(&path, b"new", &Disk::REAL).unwrap();
        assert_eq!(
            tree(folder.path()),
            texts(&[("status.json", "new")]),
            "operation {at}"
        );
    }
}

#[test]
fn what_was_staged_and_never_announced_goes() {
    let folder = empty_folder();
    write(folder.path(), &[("viewrank/a", "1")]);
    let staging = folder.path().join("viewrank/.staging");
    fs::create_dir(&staging).unwrap();
    fs::write(staging.join("0.new"), "2").unwrap();
    recover(folder.path(), &Disk::REAL).unwrap();
    assert!(!staging.exists());
    assert_eq!(
        fs::read_to_string(folder.path().join("viewrank/a")).unwrap(),
        "1"
    );
}

#[test]
fn recovery_may_itself_be_killed() {
    let (old, new, operations) = undisturbed();
    for at in (0..operations).step_by(3) {
        for again in 0..8 {
            let folder = empty_folder();
            let _ = prepare(folder.path()).write(&Disk::guarded(&fail_at(at, true)));
            let _ = recover(folder.path(), &Disk::guarded(&fail_at(again, true)));
            recover(folder.path(), &Disk::REAL).unwrap();
            let found = tree(folder.path());
            assert!(
                found == old || found == new,
                "operations {at}, {again}: {found:?}"
            );
        }
    }
}

#[test]
fn an_undo_that_is_killed_is_taken_up_again() {
    let (old, new, operations) = undisturbed();
    let mut undone = 0;
    for at in 0..operations {
        for dies_after in 1..12 {
            let folder = empty_folder();
            let set = prepare(folder.path());
            let (first, second) = (fail_at(at, false), fail_at(at + dies_after, true));
            let result = set.write(&Disk::guarded(&|o, p: &Path| first(o, p).and(second(o, p))));
            let journal = fs::read_to_string(folder.path().join("viewrank/.journal.json"))
                .unwrap_or_default();
            recover(folder.path(), &Disk::REAL).unwrap();
            let found = tree(folder.path());
            assert!(
                found == old || found == new,
                "operations {at}, {dies_after}: {found:?}"
            );
            let was_undone = journal.contains(r#""direction":"undo""#);
            if was_undone || matches!(result, Err(OutputError::Full { .. })) {
                assert_eq!(found, old, "operations {at}, {dies_after}");
            }
            undone += usize::from(was_undone);
        }
    }
    assert!(undone > 0, "some died while undoing");
}
