//! Copies of `fixtures/valley`, and the program with the settings of no user.

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Output},
    sync::LazyLock,
};

use tempfile::TempDir;

pub fn fixture() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/valley")
}

/// A project folder of its own with the fixture's model and images.
pub fn project() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    copy_to(folder.path());
    folder
}

/// Copies the fixture's model and images.
pub fn copy_to(project: &Path) {
    for part in ["sparse", "images"] {
        copy(&fixture().join(part), &project.join(part));
    }
}

/// Copies a folder.
pub fn copy(from: &Path, to: &Path) {
    for entry in walkdir::WalkDir::new(from) {
        let entry = entry.unwrap();
        let target = to.join(entry.path().strip_prefix(from).unwrap());
        if entry.file_type().is_dir() {
            fs::create_dir_all(target).unwrap();
        } else {
            fs::copy(entry.path(), target).unwrap();
        }
    }
}

pub fn viewrank(arguments: &[&str]) -> Output {
    with_settings(Path::new(env!("CARGO_TARGET_TMPDIR")), arguments)
}

/// The program with the settings of a user who compares no pictures, which takes most of the time.
fn by_geometry(arguments: &[&str]) -> Output {
    static SETTINGS: LazyLock<PathBuf> = LazyLock::new(|| {
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("geometric");
        fs::create_dir_all(folder.join("viewrank")).unwrap();
        let file = folder.join("viewrank/viewrank.toml");
        fs::write(file, "confidence.source = \"geometric\"\n").unwrap();
        folder
    });
    with_settings(&SETTINGS, arguments)
}

fn with_settings(of_user: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_viewrank"))
        .args(arguments)
        .env("XDG_CONFIG_HOME", of_user)
        .env("APPDATA", of_user)
        .output()
        .unwrap()
}

/// Output of a call that must succeed.
#[track_caller]
pub fn printed(arguments: &[&str]) -> String {
    succeeded(viewrank(arguments), arguments)
}

/// As [`printed`], without comparing pictures.
#[track_caller]
pub fn printed_by_geometry(arguments: &[&str]) -> String {
    succeeded(by_geometry(arguments), arguments)
}

#[track_caller]
fn succeeded(output: Output, arguments: &[&str]) -> String {
    assert!(
        output.status.success(),
        "{arguments:?}: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    String::from_utf8(output.stdout).unwrap()
}
