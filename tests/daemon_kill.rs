//! The daemon killed at random instants, over projects that change: it ends where an undisturbed one ends, byte for byte.
//!
//! 300 kills by default; VIEWRANK_KILLS sets another number.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    thread,
    time::Duration,
};

use rand_core::{Rng, SeedableRng};
use rand_pcg::Pcg64;
use viewrank::{
    camera::{Camera, CameraModel},
    formats::{colmap::ColmapModel, colmap_bin},
    synthetic::Town,
};

const PROJECTS: [&str; 3] = ["a", "deep/b", "with blank/c"];
/// Models that a project may have.
const VARIANTS: u64 = 2;
/// Written by every run anew.
const NOT_COMPARED: [&str; 2] = ["timings.json", ".lock"];

fn model(variant: u64) -> Vec<(&'static str, Vec<u8>)> {
    let camera = Camera::new(1, CameraModel::Pinhole, 400, 300, vec![320.0, 320.0, 200.0, 150.0]).expect("a camera");
    let town = Town { grid: 3, points: 400, tilt: None, side: 40.0, boxes: 1, seed: variant, ..Town::new(camera) };
    colmap_bin::write(&ColmapModel::from_scene(&town.scene()))
}

/// Replaces the model file by file, as a copying program does.
fn put_model(project: &Path, variant: u64) {
    let folder = project.join("sparse/0");
    fs::create_dir_all(&folder).expect("a folder");
    for (name, bytes) in model(variant) {
        fs::write(folder.join(name), bytes).expect("a file");
    }
}

fn daemon(root: &Path, options: &[&str]) -> Child {
    let nowhere = Path::new(env!("CARGO_TARGET_TMPDIR"));
    let mut command = Command::new(env!("CARGO_BIN_EXE_viewrank"));
    command.arg("watch").arg(root).args(["--settle", "30ms", "--jobs", "2"]).args(options);
    command.env("XDG_CONFIG_HOME", nowhere).stderr(Stdio::null()).spawn().expect("the program starts")
}

/// Plans what is there, undisturbed.
fn finish(root: &Path) {
    let status = daemon(root, &["--once"]).wait().expect("the program ends");
    assert!(status.success(), "{status}");
}

/// All files of the project's output folder, but what differs from run to run.
fn outputs(project: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let folder = project.join("viewrank");
    let files = walkdir::WalkDir::new(&folder).into_iter().map(|entry| entry.expect("a readable folder"));
    let files = files.filter(|e| e.file_type().is_file() && !NOT_COMPARED.iter().any(|name| e.file_name() == *name));
    let read = |e: walkdir::DirEntry| {
        let name = e.path().strip_prefix(&folder).expect("below the folder").to_path_buf();
        (name, fs::read(e.path()).expect("a readable file"))
    };
    files.map(read).collect()
}

/// The record of a set says what was written, hash of `timings.json` included; only its file names are compared.
fn without_hashes(mut outputs: BTreeMap<PathBuf, Vec<u8>>) -> BTreeMap<PathBuf, Vec<u8>> {
    outputs.iter_mut().filter(|(path, _)| path.starts_with(".sets")).for_each(|(_, bytes)| bytes.clear());
    outputs
}

#[test]
fn a_daemon_killed_at_any_instant_ends_where_an_undisturbed_one_ends() {
    let kills: u64 = std::env::var("VIEWRANK_KILLS").ok().and_then(|n| n.parse().ok()).unwrap_or(300);
    let undisturbed: Vec<_> = (0..VARIANTS).map(undisturbed).collect();
    let root = tempfile::tempdir().expect("a temporary folder");
    let mut random = Pcg64::seed_from_u64(kills);
    let mut variants = [0; PROJECTS.len()];
    PROJECTS.iter().for_each(|project| put_model(&root.path().join(project), 0));
    for _ in 0..kills {
        let mut running = daemon(root.path(), &[]);
        if random.next_u32().is_multiple_of(3) {
            let project = random.next_u32() as usize % PROJECTS.len();
            variants[project] = (variants[project] + 1) % VARIANTS;
            put_model(&root.path().join(PROJECTS[project]), variants[project]);
        }
        thread::sleep(Duration::from_millis(u64::from(random.next_u32() % 400)));
        running.kill().expect("SIGKILL");
        running.wait().expect("the end");
    }
    finish(root.path());
    for (project, variant) in PROJECTS.iter().zip(variants) {
        let found = without_hashes(outputs(&root.path().join(project)));
        let expected = &undisturbed[variant as usize];
        assert_eq!(found.keys().collect::<Vec<_>>(), expected.keys().collect::<Vec<_>>(), "{project}");
        for (path, bytes) in &found {
            assert!(bytes == &expected[path], "{project}: {} differs", path.display());
        }
    }
}

/// The outputs of a project with this model, planned by a daemon that nothing disturbs. The folder is called as one of the
/// projects, for a manifest may name it.
fn undisturbed(variant: u64) -> BTreeMap<PathBuf, Vec<u8>> {
    let root = tempfile::tempdir().expect("a temporary folder");
    let project = root.path().join(PROJECTS[0]);
    put_model(&project, variant);
    finish(root.path());
    let outputs = without_hashes(outputs(&project));
    assert!(outputs.contains_key(Path::new("manifest.json")), "{:?}", outputs.keys());
    outputs
}
