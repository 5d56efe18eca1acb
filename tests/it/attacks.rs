//! What a stranger may plant in a project folder or a watched root, against the program itself:
//! nothing outside is changed, nothing of the user's is lost, nothing is waited for, and no plan is
//! stale. `tests/it/output/strangers.rs` and `tests/it/daemon_loop/` have the same for the library,
//! with every file of ours and every step of a change.
//!
//! Tests that need an ordinary user's rights are ignored; run them as one: `cargo test --test it
//! attacks:: -- --include-ignored`.
#![cfg(unix)]

use std::{
    fs,
    os::unix::fs::{PermissionsExt, symlink},
    path::{Path, PathBuf},
    process::{Command, Output},
};

use serde_json::Value;
use tempfile::TempDir;

use super::valley;

/// A root with the precious file of somebody else beside it, and a project in it.
struct Place {
    folder: TempDir,
}

impl Place {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        valley::copy_to(&folder.path().join("root/p"));
        fs::write(folder.path().join("precious.txt"), "precious").unwrap();
        Self { folder }
    }

    fn root(&self) -> PathBuf {
        self.folder.path().join("root")
    }

    fn project(&self) -> PathBuf {
        self.root().join("p")
    }

    fn own(&self, name: &str) -> PathBuf {
        self.project().join("viewrank").join(name)
    }

    fn precious(&self) -> PathBuf {
        self.folder.path().join("precious.txt")
    }

    fn is_untouched(&self) -> bool {
        fs::read_to_string(self.precious()).unwrap() == "precious"
    }

    fn images(&self) -> Vec<PathBuf> {
        let entries = fs::read_dir(self.project().join("images")).unwrap();
        let mut images: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
        images.sort();
        images
    }

    /// Plans with the confidence that is quickest.
    fn plan(&self) -> Output {
        viewrank(&[
            "plan",
            path(&self.project()),
            "--quiet",
            "--confidence",
            "geometric",
        ])
    }

    fn watch(&self) -> Output {
        viewrank(&["watch", path(&self.root()), "--once", "--settle", "10ms"])
    }

    fn manifest(&self) -> Value {
        serde_json::from_slice(&fs::read(self.own("manifest.json")).unwrap()).unwrap()
    }
}

fn path(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// Runs the program with nobody's own settings. One that waits for ever would be killed, which is a
/// failure without an exit code.
fn viewrank(arguments: &[&str]) -> Output {
    let nowhere = Path::new(env!("CARGO_TARGET_TMPDIR"));
    let mut command = Command::new("timeout");
    command
        .args(["--signal=KILL", "300", env!("CARGO_BIN_EXE_viewrank")])
        .args(arguments);
    command.env("XDG_CONFIG_HOME", nowhere).output().unwrap()
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[track_caller]
fn succeeds(output: Output) {
    assert!(output.status.success(), "{}", said(&output));
}

/// The error of a call that must end by itself, with an error.
#[track_caller]
fn fails(output: Output) -> String {
    assert!(
        matches!(output.status.code(), Some(1 | 2)),
        "{:?}: {}",
        output.status,
        said(&output)
    );
    said(&output)
}

fn make_pipe(path: &Path) {
    assert!(Command::new("mkfifo").arg(path).status().unwrap().success());
}

#[test]
fn attack_1_the_locks_and_the_output_folder_are_links_out_of_the_root() {
    let place = Place::new();
    let own = place.root().join("viewrank");
    fs::create_dir(&own).unwrap();
    symlink(place.precious(), own.join("watch.lock")).unwrap();
    assert!(fails(place.watch()).contains("watch.lock"));
    fs::remove_dir_all(&own).unwrap();
    let outside = place.folder.path().join("outside");
    fs::create_dir(&outside).unwrap();
    symlink(&outside, &own).unwrap();
    fails(place.watch());
    fs::create_dir(place.project().join("viewrank")).unwrap();
    symlink(outside.join("new"), place.own(".lock")).unwrap();
    fails(place.plan());
    assert!(place.is_untouched() && fs::read_dir(outside).unwrap().next().is_none());
}

#[test]
fn attack_2_a_planted_journal_removes_nothing_and_is_set_aside() {
    let place = Place::new();
    let (notes, image) = (
        place.project().join("my_notes.txt"),
        place.images()[0].clone(),
    );
    fs::write(&notes, "notes").unwrap();
    fs::create_dir(place.project().join("viewrank")).unwrap();
    let image_name = image.file_name().unwrap().to_str().unwrap();
    let hash = blake3::hash(b"notes");
    let journal = format!(
        r#"{{"direction":"finish","identity":"","change":{{"new_folders":[],"old_folders":[],"steps":[{{"path":"my_notes.txt","new":null,"old":"{hash}"}},{{"path":"images/{image_name}","new":null,"old":null}}]}}}}"#
    );
    fs::write(place.own(".journal.json"), &journal).unwrap();
    assert!(fails(place.plan()).contains("my_notes.txt"));
    assert_eq!(
        fs::read_to_string(place.own(".journal.refused-1.json")).unwrap(),
        journal
    );
    succeeds(place.plan());
    assert!(image.is_file() && fs::read_to_string(notes).unwrap() == "notes");
}

#[test]
fn a_planted_record_makes_no_file_of_the_user_part_of_a_report() {
    let place = Place::new();
    let notes = place.project().join("my_notes.txt");
    fs::write(&notes, "notes").unwrap();
    fs::create_dir_all(place.own(".sets")).unwrap();
    fs::write(place.own("report.html"), "<html lang=\"en\">").unwrap();
    let record = format!(
        r#"{{"files":{{"my_notes.txt":"{}"}},"folders":[]}}"#,
        blake3::hash(b"notes")
    );
    fs::write(place.own(".sets/report.json"), record).unwrap();
    succeeds(place.plan());
    succeeds(viewrank(&["report", path(&place.project()), "--quiet"]));
    assert_eq!(fs::read_to_string(notes).unwrap(), "notes");
}

#[test]
fn attack_3_settings_name_a_device() {
    let place = Place::new();
    for key in ["confidence.source", "surface.mesh"] {
        fs::write(
            place.project().join("viewrank.toml"),
            format!("{key} = \"/dev/zero\"\n"),
        )
        .unwrap();
        assert!(
            fails(viewrank(&["plan", path(&place.project()), "--quiet"])).contains("/dev/zero"),
            "{key}"
        );
    }
}

#[cfg(target_os = "linux")]
#[test]
fn files_of_the_system_without_a_length_hold_up_no_project() {
    let place = Place::new();
    let [region, masked] = ["region", "masked"].map(|name| place.root().join(name));
    valley::copy_to(&region);
    let settings = "region = \"/proc/self/pagemap\"\n";
    fs::write(region.join("viewrank.toml"), settings).unwrap();
    valley::copy_to(&masked);
    fs::create_dir(masked.join("masks")).unwrap();
    // The times of this one are new at each look.
    symlink("/proc/uptime", masked.join("masks/any.png")).unwrap();
    let done = viewrank(&[
        "watch",
        path(&place.root()),
        "--once",
        "--follow-links",
        "--settle",
        "10ms",
    ]);
    let said = fails(done);
    assert!(
        ["pagemap", "any.png"].map(|name| said.contains(name)) == [true; 2],
        "{said}"
    );
    assert!(place.own("manifest.json").is_file());
}

#[test]
fn attack_4_pipes_in_place_of_an_image_and_a_mask_hold_nobody_up() {
    let place = Place::new();
    let images = place.images();
    fs::remove_file(&images[0]).unwrap();
    make_pipe(&images[0]);
    let masks = place.project().join("masks");
    fs::create_dir(&masks).unwrap();
    make_pipe(&masks.join(format!(
        "{}.png",
        images[1].file_name().unwrap().to_str().unwrap()
    )));
    succeeds(place.watch());
    let warnings = place.manifest()["warnings"].to_string();
    for image in &images[..2] {
        assert!(
            warnings.contains(image.file_name().unwrap().to_str().unwrap()),
            "{warnings}"
        );
    }
}

#[test]
fn attack_5_images_overwritten_in_place_are_planned_again_and_once() {
    let place = Place::new();
    let fingerprint = || {
        succeeds(place.watch());
        place.manifest()["input"]["fingerprint"].clone()
    };
    let first = fingerprint();
    let record = || {
        fs::metadata(place.own("planned_from.json"))
            .unwrap()
            .modified()
            .unwrap()
    };
    let written = record();
    assert_eq!(
        (fingerprint(), record()),
        (first.clone(), written),
        "after a restart"
    );
    let other = fs::read(&place.images()[0]).unwrap();
    place
        .images()
        .iter()
        .for_each(|image| fs::write(image, &other).unwrap());
    let second = fingerprint();
    assert_ne!(second, first);
    assert_eq!(fingerprint(), second);
}

#[test]
fn attack_6_an_edited_manifest_is_used_by_no_command() {
    let place = Place::new();
    succeeds(place.plan());
    let mut edited = place.manifest();
    let key = edited["clusters"][1]["key"].clone();
    edited["clusters"][1]["partners"][0] = key;
    fs::write(place.own("manifest.json"), edited.to_string()).unwrap();
    let project = place.project();
    let commands: [&[&str]; 3] = [
        &["export"],
        &["dispatch", "--scheduler", "shell"],
        &["report"],
    ];
    for command in commands {
        let error = fails(viewrank(&[command, &[path(&project)]].concat()));
        assert!(
            error.contains("manifest.json: clusters[1].partners"),
            "{command:?}: {error}"
        );
    }
}

#[test]
fn a_region_elsewhere_that_a_plan_names_is_not_read_again() {
    let place = Place::new();
    let region = place.folder.path().join("area.txt");
    fs::write(&region, "-9e9,-9e9,-9e9,9e9,9e9,9e9").unwrap();
    let project = place.project();
    let plan = [
        "plan",
        path(&project),
        "--quiet",
        "--confidence",
        "geometric",
    ];
    succeeds(viewrank(
        &[&plan[..], &["--region", path(&region)]].concat(),
    ));
    let doctor = |options: &[&str]| {
        let done = viewrank(&[&["doctor", path(&project), "--gsd", "0.5"], options].concat());
        (done.status.code(), said(&done))
    };
    let (code, said) = doctor(&[]);
    assert_eq!(code, Some(2), "{said}");
    assert!(said.contains("leads out of the project"), "{said}");
    let (code, said) = doctor(&["--region", path(&region)]);
    assert_ne!(code, Some(2), "{said}");
    // Within the project it is one of its files.
    let inside = project.join("area.txt");
    fs::rename(&region, &inside).unwrap();
    succeeds(viewrank(
        &[&plan[..], &["--region", path(&inside)]].concat(),
    ));
    let (code, said) = doctor(&[]);
    assert_ne!(code, Some(2), "{said}");
}

#[test]
fn a_plan_of_another_version_says_so_and_is_made_again() {
    let place = Place::new();
    succeeds(place.plan());
    let project = place.project();
    let good = place.manifest();
    for version in [1, 3] {
        // Fields of another version are none of this one.
        let other = serde_json::json!({"version": version, "input": 1, "order": ["a.jpg"]});
        fs::write(place.own("manifest.json"), other.to_string()).unwrap();
        let commands: [&[&str]; 4] = [
            &["export"],
            &["dispatch", "--scheduler", "shell"],
            &["report"],
            &["predict", "--out", "nowhere"],
        ];
        for command in commands {
            let error = fails(viewrank(&[command, &[path(&project)]].concat()));
            let says = error.contains("written by another version")
                && error.contains("plan again: viewrank plan");
            assert!(says, "{command:?}: {error}");
        }
        succeeds(place.plan());
        assert_eq!(place.manifest(), good);
    }
    succeeds(viewrank(&["export", path(&project)]));
}

#[test]
fn attack_7_a_quoted_key_is_an_unknown_setting() {
    let place = Place::new();
    fs::write(
        place.project().join("viewrank.toml"),
        "\"partners.k\" = 2\n",
    )
    .unwrap();
    assert!(fails(place.plan()).contains("unknown setting"));
}

/// Files that the daemon reads back, of the project and of the root.
fn state(place: &Place) -> Vec<PathBuf> {
    let own = [
        "planned_from.json",
        "progress.json",
        "planned_views.json",
        "timings.json",
        "cache/confidence.maps",
    ];
    let own = own.map(|name| place.own(name)).to_vec();
    [own, vec![place.root().join("viewrank/status.json")]].concat()
}

#[test]
fn tampered_state_of_the_daemon_is_made_again() {
    let place = Place::new();
    fs::write(
        place.project().join("viewrank.toml"),
        "confidence.source = \"geometric\"\n",
    )
    .unwrap();
    succeeds(place.watch());
    let good = place.manifest();
    for text in [
        "{",
        r#"{"fingerprint":"f","clusters":-1,"share":1e999,"files":["/etc/passwd","../../x"]}"#,
    ] {
        for file in state(&place) {
            fs::create_dir_all(file.parent().unwrap()).unwrap();
            fs::write(&file, text).unwrap();
        }
        fs::write(place.own("manifest.json"), text).unwrap();
        succeeds(place.watch());
        assert_eq!(place.manifest(), good, "{text}");
    }
}

#[test]
fn links_and_pipes_in_place_of_state_are_never_followed_nor_waited_for() {
    let place = Place::new();
    fs::write(
        place.project().join("viewrank.toml"),
        "confidence.source = \"geometric\"\n",
    )
    .unwrap();
    succeeds(place.watch());
    for plant in [
        &(|file: &Path| symlink(place.precious(), file).unwrap()) as &dyn Fn(&Path),
        &make_pipe,
    ] {
        for file in state(&place) {
            fs::create_dir_all(file.parent().unwrap()).unwrap();
            _ = fs::remove_file(&file);
            plant(&file);
        }
        let ended = place.watch();
        assert!(ended.status.code().is_some(), "{:?}", ended.status);
        assert!(place.is_untouched());
        state(&place)
            .iter()
            .for_each(|file| _ = fs::remove_file(file));
        succeeds(place.watch());
    }
}

#[test]
fn links_and_pipes_in_place_of_a_dispatchs_state_are_refused() {
    let place = Place::new();
    succeeds(viewrank(&[
        "plan",
        path(&place.project()),
        "--quiet",
        "--confidence",
        "geometric",
        "--backend",
        "sgm",
    ]));
    let dispatch = || {
        viewrank(&[
            "dispatch",
            path(&place.project()),
            "--scheduler",
            "shell",
            "--program",
            "/bin/true",
        ])
    };
    succeeds(dispatch());
    let task = || {
        let project = place.project();
        viewrank(&[
            "run",
            path(&project),
            "--rank",
            "1",
            "--program",
            "/bin/false",
        ])
    };
    fails(task());
    let folder = place.own("dispatch/sgm");
    let lock = fs::read_dir(folder.join("locks"))
        .unwrap()
        .next()
        .unwrap()
        .unwrap()
        .path();
    let marker = lock.file_name().unwrap().to_str().unwrap();
    fs::create_dir(place.own("sgm/done")).unwrap();
    for plant in [
        &(|file: &Path| symlink(place.precious(), file).unwrap()) as &dyn Fn(&Path),
        &make_pipe,
    ] {
        for name in [
            &format!("../../sgm/done/{marker}"),
            &format!("locks/{marker}"),
            "fused",
            "lock",
        ] {
            let file = folder.join(name);
            _ = fs::remove_file(&file);
            plant(&file);
            let error = fails(if name.starts_with("locks/") {
                task()
            } else {
                dispatch()
            });
            assert!(
                error.contains("in place of a file of viewrank's") && place.is_untouched(),
                "{name}: {error}"
            );
            fs::remove_file(&file).unwrap();
        }
    }
    succeeds(dispatch());
}

/// Each folder of results is checked, not only `viewrank` itself.
#[test]
fn no_folder_of_results_is_followed_out_of_the_project() {
    let place = Place::new();
    let (outside, project) = (place.folder.path().join("outside"), place.project());
    fs::create_dir(&outside).unwrap();
    let maps = place.folder.path().join("maps");
    fs::create_dir(&maps).unwrap();
    let is_empty = || fs::read_dir(&outside).unwrap().next().is_none();
    succeeds(place.plan());
    let dispatch = [
        "dispatch",
        "--scheduler",
        "shell",
        "--program",
        "/bin/true",
        "--backend",
        "sgm",
    ];
    let commands: [(&[&str], &str); 7] = [
        (
            &["plan", "--backend", "sgm", "--confidence", "geometric"],
            "viewrank/sgm",
        ),
        (
            &["plan", "--backend", "sgm", "--confidence", "geometric"],
            "viewrank",
        ),
        (&["export", "--backend", "openmvs"], "viewrank/openmvs"),
        (
            &["export", "--backend", "colmap", "--tiles", "2"],
            "viewrank/colmap-tiles",
        ),
        (&dispatch, "viewrank/sgm"),
        (
            &["evaluate", "--depth-maps", path(&maps)],
            "viewrank/evaluation",
        ),
        (&["undistort"], "dense"),
    ];
    for (command, folder) in commands {
        let at = project.join(folder);
        let aside = place.folder.path().join("aside");
        let had = at.exists();
        if had {
            fs::rename(&at, &aside).unwrap();
        }
        symlink(&outside, &at).unwrap();
        let error = fails(viewrank(&[command, &[path(&project)]].concat()));
        assert!(is_empty(), "{command:?} wrote through {folder}");
        assert!(error.contains(folder), "{command:?}: {error}");
        fs::remove_file(&at).unwrap();
        if had {
            fs::rename(&aside, &at).unwrap();
        }
    }
}

#[test]
fn no_word_of_a_file_outside_of_the_project_is_said_unless_the_user_names_it() {
    let place = Place::new();
    let secret = place.folder.path().join("secret");
    let settings = place.project().join("viewrank.toml");
    let said_of = |contents: &str| {
        fs::write(&secret, contents).unwrap();
        let project = place.project();
        let mut all = String::new();
        for command in ["plan", "doctor", "inspect", "config"] {
            let Output { stdout, stderr, .. } = viewrank(&[command, path(&project)]);
            all += &String::from_utf8_lossy(&[stdout, stderr].concat());
        }
        let Output { stdout, stderr, .. } = place.watch();
        all += &String::from_utf8_lossy(&[stdout, stderr].concat());
        all + &fs::read_to_string(place.root().join("viewrank/status.json")).unwrap()
    };
    let regions = [
        r#"{"type":"hunter2"}"#,
        r#"{"type":"Polygon","coordinates":[["hunter2"]]}"#,
        r#"{"type":"Feature","properties":{"weight":"hunter2"}}"#,
        "ply\nhunter2 1.0\n",
    ];
    symlink(&secret, place.project().join("area")).unwrap();
    for (key, name) in [
        ("region", "../../secret"),
        ("region", "area"),
        ("surface.mesh", path(&secret)),
    ] {
        fs::write(&settings, format!("{key} = \"{name}\"\n")).unwrap();
        for contents in regions {
            let said = said_of(contents);
            assert!(!said.contains("hunter2"), "{key} {name}: {said}");
        }
        let said = said_of(regions[3]);
        assert!(said.contains("leads out of the folder"), "{key}: {said}");
    }
    fs::remove_file(&settings).unwrap();
    fs::write(&secret, regions[0]).unwrap();
    let error = fails(viewrank(&[
        "plan",
        path(&place.project()),
        "--region",
        path(&secret),
    ]));
    assert!(error.contains("hunter2"), "{error}");
    let (project, link) = (place.project(), place.project().join("area"));
    let error = fails(viewrank(&["plan", path(&project), "--region", path(&link)]));
    assert!(!error.contains("hunter2"), "{error}");
    symlink(&secret, &settings).unwrap();
    for contents in ["hunter2 = 1\n", "target.gsd = \"hunter2\"\n", "\nhunter2"] {
        let said = said_of(contents);
        assert!(!said.contains("hunter2"), "{said}");
        assert!(
            said.contains("the file is outside of the project"),
            "{said}"
        );
    }
    fs::remove_file(&settings).unwrap();
    // A folder that says that it is the plan of another one.
    let (other, plan) = (place.folder.path().join("other"), place.root().join("plan"));
    fs::create_dir_all(plan.join("viewrank")).unwrap();
    fs::create_dir(&other).unwrap();
    symlink(place.project().join("sparse"), other.join("sparse")).unwrap();
    fs::write(other.join("viewrank.toml"), "hunter2 = 1\n").unwrap();
    let pointer = serde_json::json!({ "project": path(&other) }).to_string();
    fs::write(plan.join("viewrank/project.json"), pointer).unwrap();
    for command in ["plan", "doctor"] {
        let Output { stdout, stderr, .. } = viewrank(&[command, path(&plan)]);
        let said = String::from_utf8_lossy(&[stdout, stderr].concat()).into_owned();
        assert!(!said.contains("hunter2"), "{command}: {said}");
        assert!(
            said.contains("the file is outside of the project"),
            "{command}: {said}"
        );
    }
    fs::remove_dir_all(&plan).unwrap();
    let model = place.project().join("sparse/0");
    fs::remove_dir_all(&model).unwrap();
    fs::create_dir(&model).unwrap();
    for name in ["cameras.txt", "images.txt", "points3D.txt"] {
        symlink(&secret, model.join(name)).unwrap();
    }
    let said = said_of("hunter2 hunter2\n");
    assert!(!said.contains("hunter2"), "{said}");
    assert!(said.contains("outside of the project"), "{said}");
}

#[test]
fn no_folder_outside_of_the_project_is_walked_for_maps_of_the_pilot() {
    let place = Place::new();
    let (project, maps) = (place.project(), place.folder.path().join("hunter2"));
    fs::create_dir(&maps).unwrap();
    fs::write(maps.join("hunter2.pfm"), "hunter2").unwrap();
    let pilot = format!("pilot.maps = '{}'", path(&maps));
    fs::write(project.join("viewrank.toml"), pilot).unwrap();
    let error = fails(viewrank(&["plan", path(&project)]));
    assert!(error.contains("leads out of the folder"), "{error}");
}

#[test]
fn links_in_circles_end() {
    let place = Place::new();
    symlink(place.root(), place.project().join("images/again")).unwrap();
    symlink("self", place.project().join("images/self")).unwrap();
    symlink("../sparse", place.project().join("sparse/more")).unwrap();
    symlink(place.root(), place.root().join("more")).unwrap();
    succeeds(place.plan());
    succeeds(place.watch());
    succeeds(viewrank(&[
        "watch",
        path(&place.root()),
        "--once",
        "--settle",
        "10ms",
        "--follow-links",
    ]));
}

/// Takes the rights away while `act` runs; temporary folders could not be removed otherwise.
fn without_rights(folder: &Path, mode: u32, act: impl FnOnce()) {
    fs::set_permissions(folder, fs::Permissions::from_mode(mode)).unwrap();
    let done = std::panic::catch_unwind(std::panic::AssertUnwindSafe(act));
    fs::set_permissions(folder, fs::Permissions::from_mode(0o755)).unwrap();
    done.unwrap();
}

#[test]
#[ignore = "needs a user who is not root"]
fn a_read_only_project_is_refused_before_it_is_planned_and_stays_as_it_is() {
    let place = Place::new();
    without_rights(&place.project(), 0o555, || {
        fails(place.plan());
        assert!(!place.project().join("viewrank").exists());
        succeeds(viewrank(&[
            "plan",
            path(&place.project()),
            "--quiet",
            "--dry-run",
        ]));
    });
    succeeds(place.plan());
}

#[test]
#[ignore = "needs a user who is not root"]
fn rights_taken_away_lose_no_plan() {
    let place = Place::new();
    succeeds(place.plan());
    let before = fs::read(place.own("manifest.json")).unwrap();
    fs::write(place.project().join("viewrank.toml"), "partners.k = 3\n").unwrap();
    without_rights(&place.project().join("viewrank"), 0o555, || {
        _ = fails(place.plan())
    });
    without_rights(&place.project().join("sparse"), 0o000, || {
        _ = fails(place.plan())
    });
    assert_eq!(fs::read(place.own("manifest.json")).unwrap(), before);
    succeeds(place.plan());
    assert_ne!(fs::read(place.own("manifest.json")).unwrap(), before);
}

/// A file that costs its sender nothing and takes minutes to read.
#[cfg(target_os = "linux")]
#[test]
fn files_that_are_mostly_holes_are_read_by_no_command() {
    let place = Place::new();
    succeeds(place.plan());
    let points = place.project().join("sparse/0/points3D.bin");
    let whole = fs::read(&points).unwrap();
    fs::File::options()
        .write(true)
        .open(&points)
        .and_then(|file| file.set_len(40 << 30))
        .unwrap();
    let commands: [&[&str]; 3] = [&["plan"], &["inspect"], &["export"]];
    for command in commands {
        let error = fails(viewrank(&[command, &[path(&place.project())]].concat()));
        assert!(
            error.contains("points3D.bin") && error.contains("were never written"),
            "{command:?}: {error}"
        );
    }
    fs::write(&points, whole).unwrap();
    let name = place.images()[0]
        .file_name()
        .unwrap()
        .to_string_lossy()
        .into_owned();
    let mask = place.project().join(format!("masks/{name}.png"));
    fs::create_dir_all(mask.parent().unwrap()).unwrap();
    fs::File::create(&mask)
        .and_then(|file| file.set_len(1 << 30))
        .unwrap();
    succeeds(place.plan());
    assert!(
        place.manifest()["warnings"]
            .to_string()
            .contains("were never written"),
        "{}",
        place.manifest()["warnings"]
    );
}

#[test]
fn tasks_of_a_queue_wait_for_no_pipe_and_write_through_no_link() {
    let place = Place::new();
    let (project, outside) = (place.project(), place.folder.path().join("outside"));
    fs::create_dir(&outside).unwrap();
    succeeds(viewrank(&[
        "plan",
        path(&project),
        "--quiet",
        "--confidence",
        "geometric",
        "--backend",
        "sgm",
    ]));
    let dispatch = || {
        viewrank(&[
            "dispatch",
            path(&project),
            "--scheduler",
            "shell",
            "--program",
            "/bin/true",
        ])
    };
    for name in ["viewrank/progress.json", "viewrank/dispatch/sgm/fused"] {
        let at = project.join(name);
        fs::create_dir_all(at.parent().unwrap()).unwrap();
        make_pipe(&at);
        assert!(
            fails(dispatch()).contains("a pipe or a device in place of a file of viewrank's"),
            "{name}"
        );
        fs::remove_file(at).unwrap();
    }
    for name in [
        "viewrank/sgm/done",
        "viewrank/dispatch/sgm/locks",
        "viewrank/dispatch/sgm/logs",
        "sgm/depth_maps",
        "sgm",
    ] {
        let at = project.join(name);
        fs::create_dir_all(at.parent().unwrap()).unwrap();
        _ = fs::remove_dir(&at);
        symlink(&outside, &at).unwrap();
        assert!(
            fails(dispatch()).contains("a symbolic link leads out of"),
            "{name}"
        );
        fs::remove_file(&at).unwrap();
    }
    assert!(fs::read_dir(outside).unwrap().next().is_none());
    succeeds(dispatch());
    symlink(place.precious(), place.own("progress.json")).unwrap();
    let task = viewrank(&[
        "run",
        path(&project),
        "--rank",
        "1",
        "--program",
        "/bin/true",
    ]);
    assert!(fails(task).contains("a symbolic link in place of a file of viewrank's"));
}

#[test]
fn no_program_of_the_current_folder_is_started() {
    let place = Place::new();
    succeeds(place.plan());
    for name in ["sh", "squeue", "scontrol", "sbatch", "xdg-open", "open"] {
        let program = place.project().join(name);
        fs::write(&program, "#!/bin/sh\n: >../../started\n").unwrap();
        fs::set_permissions(&program, fs::Permissions::from_mode(0o755)).unwrap();
    }
    let slurm = [
        "dispatch",
        ".",
        "--scheduler",
        "slurm",
        "--backend",
        "sgm",
        "--program",
        "/bin/true",
    ];
    let watch = [
        "watch",
        ".",
        "--once",
        "--settle",
        "10ms",
        "--on-target",
        "sh",
    ];
    for entry in ["", "."] {
        for call in [&["report", ".", "--open"][..], &slurm, &watch] {
            Command::new(env!("CARGO_BIN_EXE_viewrank"))
                .args(call)
                .current_dir(place.project())
                .env("PATH", format!("{entry}:/nowhere"))
                .output()
                .unwrap();
            assert!(!place.folder.path().join("started").exists(), "{call:?}");
        }
    }
}
