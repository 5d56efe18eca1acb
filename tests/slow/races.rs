//! Somebody who may write in a watched root exchanges a folder of it for a link to that of another
//! root, again and again, while the program watches, plans or exports: nothing changes in the other
//! one. `tests/it/output/races.rs` has the same for the library, before each single change of a
//! file.
//!
//! 9 runs by default, one for each folder; VIEWRANK_RACES sets another number.
#![cfg(unix)]

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    os::unix::fs::symlink,
    path::{Path, PathBuf},
    process::{Command, Output},
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::{Duration, SystemTime},
};

use rand_core::{Rng, SeedableRng};
use rand_pcg::Pcg64;

/// Folders that are exchanged, relative to the root.
const FOLDERS: [&str; 9] = [
    "a",
    "a/p",
    "a/p/images",
    "a/p/dense",
    "a/p/viewrank",
    "a/p/viewrank/.staging",
    "a/p/viewrank/cache",
    "a/p/viewrank/openmvs",
    "viewrank",
];

/// Time limit of what ends by itself, seconds.
const ENOUGH: &str = "300";

fn copy(from: &Path, to: &Path) {
    for entry in walkdir::WalkDir::new(from) {
        let entry = entry.unwrap();
        let at = to.join(entry.path().strip_prefix(from).unwrap());
        match entry.file_type() {
            kind if kind.is_dir() => fs::create_dir_all(at).unwrap(),
            kind if kind.is_symlink() => symlink(fs::read_link(entry.path()).unwrap(), at).unwrap(),
            _ => fs::copy(entry.path(), at).map(drop).unwrap(),
        }
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

/// Runs the program with nobody's own settings for some seconds at most.
fn viewrank(seconds: &str, arguments: &[&str]) -> Output {
    let mut command = Command::new("timeout");
    command
        .args([
            "--signal=TERM",
            "--kill-after=60",
            seconds,
            env!("CARGO_BIN_EXE_viewrank"),
        ])
        .args(arguments);
    command
        .env("XDG_CONFIG_HOME", env!("CARGO_TARGET_TMPDIR"))
        .output()
        .unwrap()
}

/// Puts a link to a folder elsewhere in place of a folder, again and again; returns how often.
fn exchange(at: &Path, elsewhere: &Path, aside: &Path, seed: u64, is_over: &AtomicBool) -> usize {
    let mut random = Pcg64::seed_from_u64(seed);
    let mut pause =
        |most: u32| thread::sleep(Duration::from_micros(u64::from(random.next_u32() % most)));
    let mut exchanges = 0;
    while !is_over.load(Ordering::Relaxed) {
        pause(20_000);
        if fs::rename(at, aside).is_err() {
            continue;
        }
        exchanges += 1;
        let linked = symlink(elsewhere, at).is_ok();
        pause(2_000);
        if linked {
            _ = fs::remove_file(at);
        }
        // What the program made in its place meanwhile is in the way.
        while fs::rename(aside, at).is_err() {
            _ = fs::remove_dir_all(at);
        }
    }
    exchanges
}

#[test]
fn folders_exchanged_for_links_lead_nothing_out_of_the_root() {
    let runs: usize = std::env::var("VIEWRANK_RACES")
        .ok()
        .and_then(|n| n.parse().ok())
        .unwrap_or(FOLDERS.len());
    let folder = tempfile::tempdir().unwrap();
    let [root, elsewhere, aside] =
        ["root", "elsewhere", "aside"].map(|name| folder.path().join(name));
    let project = root.join("a/p");
    let fixture = Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/valley");
    ["sparse", "images"]
        .into_iter()
        .for_each(|part| copy(&fixture.join(part), &project.join(part)));
    fs::write(
        project.join("viewrank.toml"),
        "backends = [\"openmvs\"]\nconfidence.source = \"geometric\"\n",
    )
    .unwrap();
    let [root_name, project_name] = [&root, &project].map(|path| path.to_str().unwrap());
    // Another number of partners makes another plan.
    let watch = |seconds, k: usize| {
        viewrank(
            seconds,
            &[
                "watch",
                root_name,
                "--once",
                "--settle",
                "10ms",
                "-k",
                &k.to_string(),
            ],
        )
    };
    let undistort = |seconds| viewrank(seconds, &["undistort", project_name, "--quiet"]);
    let export = |seconds| viewrank(seconds, &["export", project_name, "--backend", "colmap"]);
    for done in [watch(ENOUGH, 2), undistort(ENOUGH), export(ENOUGH)] {
        assert!(
            done.status.success(),
            "{}",
            String::from_utf8_lossy(&done.stderr)
        );
    }
    copy(&root, &elsewhere);
    let before = found(&elsewhere);
    let mut exchanges = 0;
    for run in 0..runs {
        let folder = FOLDERS[run % FOLDERS.len()];
        let is_over = AtomicBool::new(false);
        let (at, there) = (root.join(folder), elsewhere.join(folder));
        exchanges += thread::scope(|threads| {
            let stranger = threads.spawn(|| exchange(&at, &there, &aside, run as u64, &is_over));
            let ended = match run / FOLDERS.len() % 3 {
                // It would go on for as long as its input changes.
                0 => watch("4", 2 + run % 4),
                1 => viewrank(
                    ENOUGH,
                    &[
                        "plan",
                        project_name,
                        "--quiet",
                        "-k",
                        &(2 + run % 4).to_string(),
                    ],
                ),
                _ => export(ENOUGH),
            };
            is_over.store(true, Ordering::Relaxed);
            assert!(
                ended.status.code().is_some_and(|code| code != 137),
                "{:?}",
                ended.status
            );
            stranger.join().unwrap()
        });
        let after = found(&elsewhere);
        let differs = |path: &&PathBuf| after.get(*path) != before.get(*path);
        let changed: BTreeSet<&PathBuf> =
            before.keys().chain(after.keys()).filter(differs).collect();
        assert!(
            changed.is_empty(),
            "run {run} of {runs}, {folder}: {changed:?}"
        );
    }
    assert!(exchanges > runs, "{exchanges}");
    // Nobody disturbs it any more.
    for done in [watch(ENOUGH, 6), export(ENOUGH)] {
        assert!(
            done.status.success(),
            "{}",
            String::from_utf8_lossy(&done.stderr)
        );
    }
}
