//! When input is still, and when it is another.

use super::*;

fn project() -> tempfile::TempDir {
    let root = tempfile::tempdir().expect("a temporary folder");
    fs::create_dir_all(root.path().join("sparse/0")).expect("a folder");
    fs::create_dir_all(root.path().join("images/left")).expect("a folder");
    fs::create_dir_all(root.path().join("viewrank")).expect("a folder");
    fs::write(root.path().join("sparse/0/cameras.bin"), "cameras").expect("a file");
    root
}

#[test]
fn changes_without_events_include_images_written_after_their_folder_changed() {
    let root = tempfile::tempdir().expect("a temporary folder");
    let images = [root.path().to_path_buf()];
    std::fs::write(root.path().join("a.jpg"), "begun").expect("a file");
    let folder = std::fs::metadata(root.path())
        .expect("a folder")
        .modified()
        .expect("a time");
    std::thread::sleep(Duration::from_millis(20));
    std::fs::write(root.path().join("a.jpg"), "more of it").expect("a file");
    assert_eq!(
        std::fs::metadata(root.path())
            .expect("a folder")
            .modified()
            .expect("a time"),
        folder
    );
    let stamp = Stamp::of_folders(&InputFolders {
        images: images.into(),
        ..InputFolders::default()
    });
    let (scanned, time) = (
        Instant::now() + Duration::from_secs(7),
        SystemTime::now() + Duration::from_secs(7),
    );
    let heard = scanned - Duration::from_secs(9);
    let since = stamp.same_since(heard, (scanned, time));
    let (written, _) =
        input::identity(&std::fs::metadata(root.path().join("a.jpg")).expect("a file"));
    let written = UNIX_EPOCH + Duration::from_nanos(u64::try_from(written).expect("this century"));
    assert_eq!(
        since,
        scanned - time.duration_since(written).expect("before"),
        "as of the image, not of its folder"
    );
}

#[test]
fn input_has_settled_once_nothing_changed_for_the_settle_time() {
    let root = project();
    let (start, settle) = (Instant::now(), Duration::from_secs(2));
    let mut still = Stillness::new(Stamp::read(root.path(), false), start);
    fs::write(root.path().join("sparse/0/cameras.bin"), "longer now").expect("a file");
    let later = start + Duration::from_secs(1);
    assert!(still.observe(Stamp::read(root.path(), false), later));
    assert!(!still.observe(Stamp::read(root.path(), false), later + settle));
    assert_eq!(still.settled_at(settle), later + settle);
    still.restart(start);
    assert_eq!(
        still.settled_at(settle),
        later + settle,
        "an earlier time does not shorten the wait"
    );
    still.restart(later + settle);
    assert_eq!(still.settled_at(settle), later + 2 * settle);
}

#[test]
fn changes_without_events_are_dated_by_the_file_system() {
    let entry = |seconds: u128| Entry {
        changed_ns: seconds * 1_000_000_000,
        ..Entry::of_length(1)
    };
    let files = BTreeMap::from([("a".into(), entry(100)), ("b".into(), entry(107))]);
    let stamp = Stamp {
        files,
        ..Stamp::default()
    };
    let (start, second) = (
        Instant::now() + Duration::from_secs(3600),
        Duration::from_secs(1),
    );
    let scanned = (start + 10 * second, UNIX_EPOCH + 110 * second);
    assert_eq!(
        stamp.same_since(start, scanned),
        start + 7 * second,
        "written after the last event"
    );
    assert_eq!(
        stamp.same_since(start + 9 * second, scanned),
        start + 9 * second,
        "older files that were moved here"
    );
    let earlier = (scanned.0, UNIX_EPOCH + 50 * second);
    assert_eq!(
        stamp.same_since(start, earlier),
        scanned.0,
        "dated by a clock that is ahead"
    );
    assert_eq!(
        stamp.same_since(scanned.0 + second, scanned),
        scanned.0,
        "what came after the scan is not in it"
    );
}

#[test]
fn a_file_rewritten_with_its_old_length_and_time_has_another_fingerprint() {
    let root = project();
    let path = root.path().join("sparse/0/cameras.bin");
    let time = fs::metadata(&path)
        .and_then(|m| m.modified())
        .expect("a time");
    let cache = Mutex::new(HashCache::default());
    let print = |stamp: &Stamp| {
        HashCache::fingerprint(&cache, root.path(), std::slice::from_ref(&path), stamp, b"")
            .expect("readable")
    };
    let before = Stamp::read(root.path(), false);
    let print_before = print(&before);
    // Until the clock of the file system has advanced.
    let end = Instant::now() + Duration::from_secs(10);
    while Stamp::read(root.path(), false) == before && Instant::now() < end {
        fs::write(&path, "CAMERAS").expect("a file");
        fs::File::options()
            .write(true)
            .open(&path)
            .and_then(|f| f.set_modified(time))
            .expect("a time");
    }
    assert_eq!(
        fs::metadata(&path)
            .and_then(|m| m.modified())
            .expect("a time"),
        time
    );
    assert_ne!(print(&Stamp::read(root.path(), false)), print_before);
}

#[test]
fn an_image_with_its_old_length_and_time_is_not_still_and_with_another_time_is_another_input() {
    let root = project();
    let image = root.path().join("images/left/1.jpg");
    fs::write(&image, "picture").expect("a file");
    let time = fs::metadata(&image)
        .and_then(|m| m.modified())
        .expect("a time");
    let put_back = |time: SystemTime| {
        fs::File::options()
            .write(true)
            .open(&image)
            .and_then(|f| f.set_modified(time))
            .expect("a time");
    };
    let cache = Mutex::new(HashCache::default());
    let print = |stamp: &Stamp| {
        HashCache::fingerprint(&cache, root.path(), &[], stamp, b"").expect("readable")
    };
    let before = Stamp::read(root.path(), false);
    // Until the clock of the file system has advanced.
    let end = Instant::now() + Duration::from_secs(10);
    while Stamp::read(root.path(), false) == before && Instant::now() < end {
        fs::write(&image, "PICTURE").expect("a file");
        put_back(time);
    }
    let overwritten = Stamp::read(root.path(), false);
    assert!(overwritten != before && print(&overwritten) == print(&before));
    put_back(time - Duration::from_secs(60));
    assert_ne!(print(&Stamp::read(root.path(), false)), print(&before));
}

#[test]
fn a_fingerprint_has_the_names_of_files_and_neither_the_settings_file_nor_files_that_are_no_input_any_more()
 {
    let root = project();
    let [one, other, toml] =
        ["sparse/0/one.bin", "sparse/0/other.bin", "viewrank.toml"].map(|n| root.path().join(n));
    for path in [&one, &other] {
        fs::write(path, "the same").expect("a file");
    }
    let cache = Mutex::new(HashCache::default());
    let print = |model: &Path, settings: &[u8]| {
        let stamp = Stamp::default().with(std::slice::from_ref(&toml));
        HashCache::fingerprint(&cache, root.path(), &[model.into()], &stamp, settings)
            .expect("readable")
    };
    let first = print(&one, b"");
    assert!(print(&other, b"") != first && print(&one, b"k") != first);
    fs::write(&toml, "# a comment").expect("a file");
    assert_eq!(print(&one, b""), first);
    let known: Vec<PathBuf> = lock(&cache).0.keys().cloned().collect();
    assert_eq!(known, [one]);
}

#[test]
fn a_folder_has_no_length() {
    let root = project();
    assert_eq!(
        Entry::from_metadata(&fs::metadata(root.path()).expect("a folder")).length,
        0
    );
}

#[test]
fn unreadable_folders_are_reported() {
    let root = project();
    let no_folder = root.path().join("sparse/0/cameras.bin");
    let stamp = |models| {
        Stamp::of_folders(&InputFolders {
            models,
            ..InputFolders::default()
        })
    };
    let read_error = stamp(vec![no_folder.clone()])
        .read_error()
        .expect("read_error");
    assert!(
        read_error.starts_with(&format!("cannot read folder {}: ", no_folder.display())),
        "{read_error}"
    );
    assert_eq!(
        stamp(vec![root.path().join("sparse/0"), root.path().join("gone")]).read_error(),
        None
    );
}

#[test]
fn memory_is_estimated_from_the_largest_model_that_may_be_planned() {
    let bytes = |files: &[(&str, u64)]| {
        let entry =
            |&(path, length): &(&str, u64)| (Path::new("/p").join(path), Entry::of_length(length));
        Stamp {
            files: files.iter().map(entry).collect(),
            ..Stamp::default()
        }
        .bytes()
    };
    let colmap = [
        ("sparse/0/images.bin", 5),
        ("sparse/0/cameras.bin", 1),
        ("sparse/1/images.bin", 7),
    ];
    assert_eq!(bytes(&colmap), 7);
    let beside = [
        ("scene_dense.mvs", 1 << 40),
        ("dense/sparse/images.bin", 1 << 30),
        ("sparse/0/images.txt", 6),
    ];
    assert_eq!(bytes(&[&colmap[..], &beside[..]].concat()), 7);
    assert_eq!(bytes(&beside[..2]), 1 << 40);
    assert_eq!(
        bytes(&[
            ("1.ori", 2),
            ("2.ori", 2),
            ("cloud.ply", 9),
            ("scene.mvs", 3)
        ]),
        13
    );
}

#[test]
fn new_images_are_input_and_outputs_are_not() {
    let root = project();
    let before = Stamp::read(root.path(), false);
    fs::write(root.path().join("viewrank/manifest.json"), "{}").expect("a file");
    assert_eq!(Stamp::read(root.path(), false), before);
    fs::write(root.path().join("images/left/1.jpg"), "").expect("a file");
    assert_ne!(Stamp::read(root.path(), false), before);
}

#[test]
fn an_image_overwritten_in_place_is_another_input_and_a_note_beside_it_is_not() {
    let root = project();
    let image = root.path().join("images/left/1.jpg");
    fs::write(&image, "a picture").expect("a file");
    fs::write(root.path().join("images/left/notes.txt"), "a note").expect("a file");
    let cache = Mutex::new(HashCache::default());
    let input = || {
        let stamp = Stamp::read(root.path(), false);
        let print =
            HashCache::fingerprint(&cache, root.path(), &[], &stamp, b"").expect("readable files");
        (stamp, print)
    };
    let before = input();
    fs::write(
        root.path().join("images/left/notes.txt"),
        "another, longer note",
    )
    .expect("a file");
    assert_eq!(input(), before);
    let longer = "another picture";
    fs::write(&image, longer).expect("a file");
    let after = input();
    assert!(after.0 != before.0 && after.1 != before.1);
    // A copy that preserves times.
    let time = fs::metadata(&image)
        .and_then(|m| m.modified())
        .expect("a time");
    fs::write(root.path().join("new"), longer).expect("a file");
    fs::File::options()
        .write(true)
        .open(root.path().join("new"))
        .and_then(|f| f.set_modified(time))
        .expect("a time");
    fs::rename(root.path().join("new"), &image).expect("a file");
    let copied = input();
    assert!(copied.0 != after.0 && copied.1 == after.1);
}

#[test]
fn clouds_are_input_only_next_to_orientations() {
    let root = project();
    let stamp = || Stamp::read(root.path(), false);
    let before = stamp();
    fs::write(root.path().join("scene_dense.ply"), "ply").expect("a file");
    assert_eq!(stamp(), before);
    fs::write(root.path().join("1.ori"), "").expect("a file");
    assert_eq!(stamp().files.len(), before.files.len() + 2);
}

#[test]
fn masks_and_files_named_in_the_settings_are_input() {
    let root = project();
    let mesh = root.path().join("mesh.ply");
    let stamp = || Stamp::read(root.path(), false).with(std::slice::from_ref(&mesh));
    let cache = Mutex::new(HashCache::default());
    let print = |stamp: Stamp| {
        HashCache::fingerprint(&cache, root.path(), &[], &stamp, b"").expect("readable files")
    };
    let mut seen = vec![print(stamp())];
    for (file, content) in [
        ("mesh.ply", "a"),
        ("mesh.ply", "b"),
        ("masks/1.jpg.png", "a"),
        ("masks/1.jpg.png", "b"),
    ] {
        let path = root.path().join(file);
        fs::create_dir_all(path.parent().expect("below the root")).expect("a folder");
        // Another file, should the clock be coarse.
        _ = fs::remove_file(&path);
        fs::write(root.path().join("new"), content).expect("a file");
        fs::rename(root.path().join("new"), path).expect("a file");
        let now = print(stamp());
        assert!(!seen.contains(&now), "{file}");
        seen.push(now);
    }
}

#[test]
fn a_file_copied_over_itself_keeps_the_fingerprint() {
    let root = project();
    let cache = Mutex::new(HashCache::default());
    let print = |settings: &[u8]| {
        let stamp = Stamp::read(root.path(), false);
        let model = [root.path().join("sparse/0/cameras.bin")];
        HashCache::fingerprint(&cache, root.path(), &model, &stamp, settings)
            .expect("readable files")
    };
    let before = print(b"a");
    fs::remove_file(root.path().join("sparse/0/cameras.bin")).expect("the file");
    fs::write(root.path().join("sparse/0/cameras.bin"), "cameras").expect("a file");
    assert_eq!(print(b"a"), before);
    assert_ne!(print(b"b"), before, "other settings");
    fs::write(root.path().join("sparse/0/cameras.bin"), "Cameras").expect("a file");
    assert_ne!(print(b"a"), before);
}
