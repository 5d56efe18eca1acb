//! Copies of `fixtures/valley`, and the program with the settings of no user.

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Output},
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
    let nowhere = env!("CARGO_TARGET_TMPDIR");
    Command::new(env!("CARGO_BIN_EXE_viewrank"))
        .args(arguments)
        .env("XDG_CONFIG_HOME", nowhere)
        .env("APPDATA", nowhere)
        .output()
        .unwrap()
}

/// Output of a call that must succeed.
#[track_caller]
pub fn printed(arguments: &[&str]) -> String {
    let output = viewrank(arguments);
    assert!(
        output.status.success(),
        "{arguments:?}: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    String::from_utf8(output.stdout).unwrap()
}
