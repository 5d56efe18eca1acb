//! Differences of Windows: its paths and quotes, files held open by other programs, no symbolic
//! links. Also run by `.ci/windows`, under Wine.
#![cfg(windows)]

use std::{
    fs::{self, File},
    os::windows::{fs::OpenOptionsExt, process::CommandExt},
    path::{Path, PathBuf},
    process::Command,
};

use super::valley::{self, printed, viewrank};

/// A copy of fixtures/valley in a folder of a temporary one.
struct Valley {
    root: tempfile::TempDir,
    project: PathBuf,
}

impl Valley {
    fn new(folder: &str) -> Self {
        let root = tempfile::tempdir().unwrap();
        let project = root.path().join(folder);
        valley::copy_to(&project);
        Self { root, project }
    }

    fn path(&self) -> &str {
        self.project.to_str().unwrap()
    }

    fn file(&self, name: &str) -> PathBuf {
        self.project.join("viewrank").join(name)
    }
}

#[test]
fn blanks_other_scripts_and_more_than_260_characters() {
    for folder in [
        "my väl ley".into(),
        "Ψηφίδες 地図".into(),
        ["a long name of a folder"; 8].join("\\"),
    ] {
        let valley = Valley::new(&folder);
        printed(&["plan", valley.path(), "--backend", "colmap,openmvs"]);
        printed(&["doctor", valley.path(), "--backend", "sgm"]);
        printed(&["report", valley.path()]);
        for file in [
            "manifest.json",
            "report.html",
            "colmap/stereo/viewrank/export.json",
            "openmvs/run.py",
        ] {
            assert!(valley.file(file).is_file(), "{folder}: {file}");
            assert!(
                folder.len() < 180
                    || valley
                        .file("colmap/stereo/viewrank/export.json")
                        .as_os_str()
                        .len()
                        > 260
            );
        }
    }
}

#[test]
fn parts_of_a_project_lead_to_it() {
    let valley = Valley::new("a project");
    for part in [r"sparse\0", r"sparse\0\points3D.bin", "images", "sparse/0"] {
        printed(&["plan", &format!(r"{}\{part}", valley.path()), "-q"]);
        assert!(valley.file("manifest.json").is_file(), "{part}");
        fs::remove_dir_all(valley.project.join("viewrank")).unwrap();
    }
}

#[test]
fn without_symbolic_links_the_images_of_an_export_are_the_project_s() {
    let valley = Valley::new("valley");
    let backends = [
        "colmap",
        "openmvs",
        "mvsnet",
        "gipuma",
        "alicevision",
        "pmvs",
        "splat",
    ];
    printed(&[
        "plan",
        valley.path(),
        "--backend",
        &backends.join(","),
        "-q",
    ]);
    let same = |image: &Path| {
        let bytes = fs::read(image).unwrap();
        fs::read_dir(valley.project.join("images"))
            .unwrap()
            .any(|own| fs::read(own.unwrap().path()).unwrap() == bytes)
    };
    for backend in backends {
        let mut folders = vec![valley.file(backend)];
        let mut images = Vec::new();
        while let Some(folder) = folders.pop() {
            for entry in fs::read_dir(folder).unwrap() {
                let path = entry.unwrap().path();
                match path.extension() {
                    _ if path.is_dir() => folders.push(path),
                    Some(end) if end == "jpg" => images.push(path),
                    _ => {}
                }
            }
        }
        assert!(
            images.len() >= 7 && images.iter().all(|image| same(image)),
            "{backend}: {images:?}"
        );
    }
}

#[test]
fn the_commands_shown_are_those_of_cmd() {
    let valley = Valley::new("it's a väl ley & more");
    let summary = printed(&["plan", valley.path(), "--backend", "sgm"]);
    let shown = summary
        .lines()
        .find_map(|line| line.strip_prefix("On one page: viewrank "))
        .unwrap();
    let typed = format!(
        "/C \"\"{}\" {}\"",
        env!("CARGO_BIN_EXE_viewrank").replace('/', "\\"),
        shown.replace(" --open", "")
    );
    let ran = Command::new("cmd").raw_arg(&typed).output().unwrap();
    assert!(
        ran.status.success(),
        "{typed}: {}",
        String::from_utf8_lossy(&ran.stderr)
    );
    assert!(valley.file("report.html").is_file());
}

#[test]
fn a_file_held_open_by_another_program_is_named_and_the_earlier_plan_stays() {
    let valley = Valley::new("valley");
    printed(&["plan", valley.path(), "-q"]);
    let files =
        ["manifest.json", "clusters.txt", "curve.svg", "surface.ply"].map(|name| valley.file(name));
    let before = files.each_ref().map(|file| fs::read(file).unwrap());
    for held in &files {
        let open = File::options().read(true).share_mode(0).open(held).unwrap();
        let refused = viewrank(&["plan", valley.path(), "-q", "-k", "3"]);
        let said = String::from_utf8_lossy(&refused.stderr).into_owned();
        assert!(
            !refused.status.success() && said.contains(held.file_name().unwrap().to_str().unwrap()),
            "{said}"
        );
        drop(open);
        assert_eq!(
            files.each_ref().map(|file| fs::read(file).unwrap()),
            before,
            "{}",
            held.display()
        );
    }
    printed(&["plan", valley.path(), "-q", "-k", "3"]);
    assert_ne!(fs::read(&files[0]).unwrap(), before[0]);
    let left = fs::read_dir(valley.file(""))
        .unwrap()
        .map(|entry| entry.unwrap().file_name());
    assert!(
        !left
            .into_iter()
            .any(|name| name == ".staging" || name == ".journal.json")
    );
}

#[test]
fn a_watched_folder_is_planned_once() {
    let valley = Valley::new(r"site 1\väl ley");
    let root = valley.root.path().to_str().unwrap();
    printed(&[
        "watch", root, "--once", "--settle", "100ms", "--poll", "200ms",
    ]);
    let written = || {
        fs::metadata(valley.file("timings.json"))
            .unwrap()
            .modified()
            .unwrap()
    };
    let first = written();
    let status = printed(&["status", root]);
    assert!(
        status.contains(root) && status.contains("site 1/väl ley"),
        "{status}"
    );
    printed(&[
        "watch", root, "--once", "--settle", "100ms", "--poll", "200ms",
    ]);
    assert_eq!(written(), first, "the plan is current");
}
