//! How a program is started for the clusters of an export.

use std::{
    ffi::{OsStr, OsString},
    path::{Path, PathBuf},
};

/// The result of a task.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Product {
    /// The depth map of the view cluster of this rank, from 1.
    Map(usize),
    /// The cloud of the depth maps that are there.
    Cloud,
}

/// A task with what its processes need; all paths are absolute.
pub struct Call<'a> {
    pub product: Product,
    /// Folder of the export.
    pub workplace: &'a Path,
    pub project: &'a Path,
    pub program: &'a Path,
    pub python: &'a Path,
    pub threads: usize,
    pub image_scale: f64,
}

/// How the clusters of an export are computed one by one, and their depth maps fused.
#[derive(Clone, Debug)]
pub struct TaskRunner {
    /// Name of the program on the PATH.
    pub program: &'static str,
    /// Environment variable that overrides the path, and is set for the commands.
    pub variable: &'static str,
    /// Commands of a task, each run if the one before succeeds; they depend on no current folder.
    /// Those of a depth map fail unless it is complete, and may run side by side with others.
    pub commands: fn(&Call) -> Vec<Vec<OsString>>,
    /// Files of the export that change with the maps that are there.
    pub state: &'static [&'static str],
    /// Cloud that the fusion writes.
    pub cloud: PathBuf,
    /// Depth map of each cluster, in rank order; `None` if it cannot be computed.
    pub maps: Vec<Option<PathBuf>>,
}

/// The words of a command.
pub fn words<const N: usize>(words: [&dyn AsRef<OsStr>; N]) -> Vec<OsString> {
    words.map(|word| word.as_ref().to_owned()).into()
}
