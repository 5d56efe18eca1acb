//! Whole-or-nothing sets of files: everything that viewrank writes goes through here.

use std::{collections::BTreeMap, path::PathBuf};

/// What a file is made of.
#[derive(Clone, Debug)]
pub enum Contents {
    Bytes(Vec<u8>),
    /// As `Bytes`, with the executable bit (runner scripts).
    Script(Vec<u8>),
    /// A copy of that file.
    Copy(PathBuf),
    /// A symbolic link to that file (relative where both lie in the project); a copy where links are not to be had.
    Link(PathBuf),
    /// An empty folder.
    Folder,
}

/// Files that appear together or not at all. Paths are relative to `root`, `/` between folders, never absolute, never with `..`.
#[derive(Clone, Debug)]
pub struct FileSet {
    pub root: PathBuf,
    /// Name of the set; an earlier set of the same name under the same root is replaced and its stale files removed.
    pub name: String,
    pub files: BTreeMap<String, Contents>,
}

impl FileSet {
    pub fn new(root: impl Into<PathBuf>, name: &str) -> Self {
        Self { root: root.into(), name: name.into(), files: BTreeMap::new() }
    }

    pub fn add(&mut self, path: impl Into<String>, contents: Contents) {
        self.files.insert(path.into(), contents);
    }

    pub fn add_text(&mut self, path: impl Into<String>, text: impl Into<String>) {
        self.add(path, Contents::Bytes(text.into().into_bytes()));
    }
}
