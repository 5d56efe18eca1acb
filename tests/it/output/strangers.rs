//! A project that comes from a stranger has nothing written, moved or removed that is not ours.

use std::{fs, path::Path};

use viewrank_io::output::{Disk, OutputError, recover, replace};

use super::{empty_folder, fail_at, prepare, prepare_again, set, texts, tree, undisturbed, write};

#[cfg(unix)]
#[test]
fn a_lock_that_is_no_file_is_refused_and_nothing_is_made_through_it() {
    for target in ["../../outside.txt", "../own.txt", "nowhere/at/all"] {
        let folder = empty_folder();
        let root = folder.path().join("root");
        fs::create_dir_all(root.join("viewrank")).unwrap();
        fs::write(root.join("own.txt"), "own").unwrap();
        std::os::unix::fs::symlink(target, root.join("viewrank/.lock")).unwrap();
        let refused = set(&root, &[("a", "a")]).write(&Disk::REAL);
        assert!(
            matches!(refused, Err(OutputError::Foreign { .. })),
            "{target}: {refused:?}"
        );
        assert_eq!(tree(&root), texts(&[("own.txt", "own")]));
        assert!(!folder.path().join("outside.txt").exists());
    }
    let folder = empty_folder();
    fs::create_dir(folder.path().join("viewrank")).unwrap();
    make_pipe(&folder.path().join("viewrank/.lock"));
    assert!(matches!(
        set(folder.path(), &[("a", "a")]).write(&Disk::REAL),
        Err(OutputError::Foreign { .. })
    ));
}

#[cfg(unix)]
fn make_pipe(path: &Path) {
    assert!(
        std::process::Command::new("mkfifo")
            .arg(path)
            .status()
            .unwrap()
            .success()
    );
}

#[cfg(unix)]
#[test]
fn the_folder_of_outputs_may_be_a_link_inside_the_root_and_no_other() {
    let folder = empty_folder();
    let (root, outside) = (folder.path().join("root"), folder.path().join("outside"));
    fs::create_dir_all(root.join("outputs")).unwrap();
    fs::create_dir(&outside).unwrap();
    let link = root.join("viewrank");
    std::os::unix::fs::symlink(&outside, &link).unwrap();
    for _ in 0..2 {
        assert!(
            matches!(set(&root, &[("a", "a")]).write(&Disk::REAL), Err(OutputError::Escapes { path, .. }) if path.ends_with("root/viewrank"))
        );
        assert!(fs::read_dir(&outside).unwrap().next().is_none());
    }
    fs::remove_file(&link).unwrap();
    std::os::unix::fs::symlink("outputs", &link).unwrap();
    let around = folder.path().join("around");
    std::os::unix::fs::symlink(&root, &around).unwrap();
    write(&around, &[("viewrank/a", "a")]);
    assert_eq!(fs::read_to_string(root.join("outputs/a")).unwrap(), "a");
    assert_eq!(write(&around, &[]).removed, ["viewrank/a"]);
}

#[cfg(unix)]
#[test]
fn an_absolute_link_counts_as_one_that_leads_out() {
    let folder = empty_folder();
    fs::create_dir(folder.path().join("outputs")).unwrap();
    std::os::unix::fs::symlink(
        folder.path().join("outputs"),
        folder.path().join("viewrank"),
    )
    .unwrap();
    let refused = set(folder.path(), &[("a", "a")]).write(&Disk::REAL);
    assert!(
        matches!(refused, Err(OutputError::Escapes { .. })),
        "{refused:?}"
    );
    assert!(
        fs::read_dir(folder.path().join("outputs"))
            .unwrap()
            .next()
            .is_none()
    );
}

/// Else the plan of one project could be written into another.
#[cfg(unix)]
#[test]
fn no_link_on_the_way_from_a_watched_root_to_a_project_is_followed_even_if_it_stays_inside() {
    let folder = empty_folder();
    let root = folder.path();
    fs::create_dir_all(root.join("b/p")).unwrap();
    std::os::unix::fs::symlink("b", root.join("a")).unwrap();
    let project = root.join("a/p");
    let within = [root.to_path_buf(), project.clone()];
    let disk = Disk::REAL.within(&within);
    let files = set(&project, &[("a", "a")]);
    assert!(matches!(
        files.write(&disk),
        Err(OutputError::Foreign { .. })
    ));
    assert!(matches!(
        replace(&project.join("b"), b"b", &disk),
        Err(OutputError::Foreign { .. })
    ));
    assert!(fs::read_dir(root.join("b/p")).unwrap().next().is_none());
    // The path that the user names may have links.
    files.write(&Disk::REAL.within(&[project])).unwrap();
    assert_eq!(fs::read_to_string(root.join("b/p/a")).unwrap(), "a");
}

/// A project whose images and notes are the user's, and which came with these files in `viewrank`.
fn planted(files: &[(&str, &str)]) -> tempfile::TempDir {
    let folder = empty_folder();
    for (name, text) in [("my_notes.txt", "notes"), ("images/a.jpg", "image")]
        .iter()
        .chain(files)
    {
        let path = folder.path().join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    }
    folder
}

fn hash(text: &str) -> String {
    blake3::hash(text.as_bytes()).to_string()
}

/// A record by which notes and image are ours, with their right hashes.
fn planted_record(identity: &str) -> String {
    let (notes, image) = (hash("notes"), hash("image"));
    format!(
        r#"{{"files":{{"my_notes.txt":"{notes}","images/a.jpg":"{image}"}},"folders":["images","empty"],"identity":"{identity}"}}"#
    )
}

fn journal(identity: &str, steps: &str) -> String {
    format!(
        r#"{{"direction":"finish","identity":"{identity}","change":{{"new_folders":[],"steps":[{steps}],"old_folders":[]}}}}"#
    )
}

#[test]
fn a_hostile_journal_is_set_aside_and_removes_nothing() {
    let (notes, image) = (hash("notes"), hash("image"));
    let removals = format!(
        r#"{{"path":"my_notes.txt","new":null,"old":"{notes}"}},{{"path":"images/a.jpg","new":null,"old":"{image}"}}"#
    );
    let journals = [
        journal("made 0.000000000", &removals),
        journal("", &removals),
        journal(
            "",
            r#"{"path":"my_notes.txt","has_new":false,"has_old":false}"#,
        ),
        journal("", r#"{"path":"../precious","new":null,"old":null}"#),
        "{".into(),
    ];
    let record = planted_record("");
    for text in &journals {
        let folder = planted(&[
            ("viewrank/.journal.json", text),
            ("viewrank/.sets/test.json", &record),
        ]);
        let root = folder.path();
        let before = tree(root);
        match recover(root, &Disk::REAL) {
            Err(OutputError::Journal { path, .. }) => {
                assert_eq!(fs::read_to_string(path).unwrap(), *text)
            }
            other => panic!("{text}: {other:?}"),
        }
        assert_eq!(tree(root), before, "{text}");
        // The next run goes on without it.
        recover(root, &Disk::REAL).unwrap();
        assert_eq!(write(root, &[("a", "a")]).changed, ["a"]);
        assert_eq!(
            fs::read_to_string(root.join("my_notes.txt")).unwrap(),
            "notes"
        );
    }
}

#[test]
fn the_error_of_a_hostile_journal_names_a_file_that_it_is_after() {
    let step = r#"{"path":"my_notes.txt","new":null,"old":null}"#;
    let folder = planted(&[("viewrank/.journal.json", &journal("", step))]);
    let error = recover(folder.path(), &Disk::REAL).unwrap_err().to_string();
    assert!(
        error.contains(".journal.refused-1.json") && error.contains("my_notes.txt"),
        "{error}"
    );
}

#[cfg(unix)]
#[test]
fn a_linked_staging_folder_brings_no_file_in_from_outside() {
    let folder = empty_folder();
    let (root, outside) = (folder.path().join("root"), folder.path().join("outside"));
    fs::create_dir_all(root.join("viewrank")).unwrap();
    fs::create_dir(&outside).unwrap();
    fs::write(outside.join("0.new"), "secret").unwrap();
    let link = root.join("viewrank/.staging");
    let step = format!(
        r#"{{"path":"stolen","new":"{}","old":null}}"#,
        hash("secret")
    );
    for journal in [Some(journal("", &step)), None] {
        std::os::unix::fs::symlink(&outside, &link).unwrap();
        journal
            .iter()
            .for_each(|text| fs::write(root.join("viewrank/.journal.json"), text).unwrap());
        assert_eq!(recover(&root, &Disk::REAL).is_err(), journal.is_some());
        write(&root, &[("a", "a")]);
        assert_eq!(tree(&outside), texts(&[("0.new", "secret")]));
        assert!(!root.join("stolen").exists() && fs::symlink_metadata(&link).is_err());
    }
}

#[cfg(unix)]
#[test]
fn a_pipe_in_the_place_of_a_journal_or_a_record_is_not_waited_for() {
    let folder = empty_folder();
    fs::create_dir_all(folder.path().join("viewrank/.sets")).unwrap();
    make_pipe(&folder.path().join("viewrank/.sets/test.json"));
    make_pipe(&folder.path().join("viewrank/.journal.json"));
    assert!(matches!(
        recover(folder.path(), &Disk::REAL),
        Err(OutputError::Foreign { .. })
    ));
    fs::remove_file(folder.path().join("viewrank/.journal.json")).unwrap();
    assert_eq!(write(folder.path(), &[("a", "a")]).changed, ["a"]);
}

#[test]
fn a_file_of_any_size_in_place_of_ours_is_kept_and_not_read() {
    let folder = planted(&[]);
    let root = folder.path();
    write(root, &[("viewrank/list", "1"), ("viewrank/stale", "1")]);
    for name in ["viewrank/list", "viewrank/stale"] {
        fs::File::create(root.join(name))
            .unwrap()
            .set_len(1 << 42)
            .unwrap();
    }
    for _ in 0..2 {
        let written = write(root, &[("viewrank/list", "2")]);
        assert!(written.removed.is_empty(), "{written:?}");
    }
    let length = |name: &str| fs::metadata(root.join(name)).unwrap().len();
    assert_eq!(
        [
            "viewrank/list",
            "viewrank/list.before-viewrank",
            "viewrank/stale"
        ]
        .map(length),
        [1, 1 << 42, 1 << 42]
    );
}

#[test]
fn a_record_that_was_not_written_here_makes_no_file_ours() {
    for identity in ["", "made 0.000000000"] {
        let folder = planted(&[("viewrank/.sets/test.json", &planted_record(identity))]);
        let root = folder.path();
        fs::create_dir(root.join("empty")).unwrap();
        // The image would be stale, the notes would be replaced without a word.
        let written = write(root, &[("my_notes.txt", "ours")]);
        assert_eq!(
            (written.removed.len(), written.kept),
            (0, vec!["my_notes.txt.before-viewrank".into()])
        );
        let expected = [
            ("my_notes.txt", "ours"),
            ("my_notes.txt.before-viewrank", "notes"),
            ("images", "folder"),
            ("images/a.jpg", "image"),
            ("empty", "folder"),
        ];
        assert_eq!(tree(root), texts(&expected));
    }
}

/// A planted record cannot make the user's files ours by another way to them.
#[cfg(unix)]
#[test]
fn a_record_that_was_not_written_here_claims_nothing_through_links() {
    for (link, target, prefix) in [
        ("viewrank", ".", "viewrank"),
        ("viewrank/sgm", "..", "viewrank/sgm"),
    ] {
        let folder = planted(&[]);
        let root = folder.path();
        let at = root.join(link);
        fs::create_dir_all(at.parent().unwrap()).unwrap();
        std::os::unix::fs::symlink(target, at).unwrap();
        let (notes, image) = (hash("notes"), hash("image"));
        let record = format!(
            r#"{{"files":{{"{prefix}/my_notes.txt":"{notes}","{prefix}/images/a.jpg":"{image}"}},"folders":[],"identity":""}}"#
        );
        fs::create_dir_all(root.join("viewrank/.sets")).unwrap();
        fs::write(root.join("viewrank/.sets/test.json"), record).unwrap();
        let written = write(root, &[(&format!("{prefix}/my_notes.txt"), "ours")]);
        assert!(written.removed.is_empty(), "{written:?}");
        assert_eq!(
            fs::read_to_string(root.join("images/a.jpg")).unwrap(),
            "image"
        );
        assert_eq!(
            fs::read_to_string(root.join("my_notes.txt.before-viewrank")).unwrap(),
            "notes"
        );
    }
}

#[cfg(unix)]
#[test]
fn a_record_is_not_written_over_a_file_elsewhere() {
    let folder = planted(&[("settings/test.json", "theirs")]);
    let root = folder.path();
    fs::create_dir(root.join("viewrank")).unwrap();
    std::os::unix::fs::symlink("../settings", root.join("viewrank/.sets")).unwrap();
    let before = tree(root);
    assert!(matches!(
        set(root, &[("a", "a")]).write(&Disk::REAL),
        Err(OutputError::Foreign { .. })
    ));
    assert_eq!(tree(root), before);
}

/// Copies a folder with all that is in it.
fn copy_tree(from: &Path, to: &Path) {
    for entry in walkdir::WalkDir::new(from)
        .into_iter()
        .map(|entry| entry.unwrap())
    {
        let at = to.join(entry.path().strip_prefix(from).unwrap());
        if entry.file_type().is_dir() {
            fs::create_dir_all(at).unwrap();
        } else {
            fs::copy(entry.path(), at).unwrap();
        }
    }
}

#[test]
fn a_copy_of_a_project_takes_its_files_over_where_they_are_still_wanted() {
    let folder = empty_folder();
    let (first, copy) = (folder.path().join("first"), folder.path().join("copy"));
    let files = [
        ("viewrank/list", "1"),
        ("viewrank/old", "1"),
        ("same", "1"),
        ("other", "1"),
        ("stale", "1"),
    ];
    write(&first, &files);
    copy_tree(&first, &copy);
    let written = write(
        &copy,
        &[("viewrank/list", "2"), ("same", "1"), ("other", "2")],
    );
    assert_eq!(
        (written.kept, written.removed),
        (
            vec!["other.before-viewrank".into()],
            vec!["viewrank/old".into()]
        )
    );
    assert!(copy.join("stale").exists());
    assert!(
        write(
            &copy,
            &[("viewrank/list", "2"), ("same", "3"), ("other", "3")]
        )
        .kept
        .is_empty()
    );
}

#[test]
fn the_journal_of_a_copy_is_set_aside_and_no_file_is_lost() {
    let (_, new, operations) = undisturbed();
    let mut refused = 0;
    for at in 0..operations {
        let (folder, copy) = (empty_folder(), empty_folder());
        let _ = prepare(folder.path()).write(&Disk::guarded(&fail_at(at, true)));
        copy_tree(folder.path(), copy.path());
        let before = tree(copy.path());
        let result = recover(copy.path(), &Disk::REAL);
        assert!(
            matches!(result, Ok(()) | Err(OutputError::Journal { .. })),
            "operation {at}: {result:?}"
        );
        refused += usize::from(result.is_err());
        assert_eq!(tree(copy.path()), before, "operation {at}");
        prepare_again(copy.path()).write(&Disk::REAL).unwrap();
        let after = tree(copy.path());
        assert!(
            new.iter().all(|(path, text)| after.get(path) == Some(text)),
            "operation {at}: {after:?}"
        );
        assert!(
            after.values().any(|text| text == "theirs"),
            "operation {at}: {after:?}"
        );
    }
    assert!(refused > 0 && refused < operations, "both ends occur");
}

/// Whoever edits a file after the crash keeps what they wrote.
#[test]
fn what_was_edited_after_a_crash_is_left_alone() {
    let (_, _, operations) = undisturbed();
    for (at, name) in
        (0..operations).flat_map(|at| ["a", "old/b", "theirs.cfg"].map(|name| (at, name)))
    {
        let folder = empty_folder();
        let root = folder.path();
        let _ = prepare(root).write(&Disk::guarded(&fail_at(at, true)));
        fs::create_dir_all(root.join("old")).unwrap();
        // As an editor does that writes a new file and puts it in place.
        fs::write(root.join("draft"), "edited").unwrap();
        fs::rename(root.join("draft"), root.join(name)).unwrap();
        let _ = recover(root, &Disk::REAL);
        assert_eq!(
            fs::read_to_string(root.join(name)).unwrap(),
            "edited",
            "operation {at}"
        );
        prepare_again(root).write(&Disk::REAL).unwrap();
        assert!(
            tree(root).values().any(|text| text == "edited"),
            "operation {at}, {name}"
        );
    }
}
