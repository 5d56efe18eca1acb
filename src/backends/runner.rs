//! How a program is started for the clusters of an export.

use std::{
    collections::BTreeMap,
    env,
    ffi::{OsStr, OsString},
    fmt::Display,
    path::{Path, PathBuf},
    slice,
};

use serde::de::DeserializeOwned;

use super::{Export, Selection};
use crate::{
    base::{pixels::PixelBound, platform},
    io::{
        depthmaps::{self, DepthMapError, DepthMapFormat},
        json::place_and_fault,
        output::{self, Contents, Disk},
        paths,
    },
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
    pub project: &'a PathBuf,
    /// Contents of [`TaskRunner::lists`], by name.
    pub lists: &'a BTreeMap<String, Vec<u8>>,
    /// Where the programs may work: a name that no other process has, below the export. It is
    /// removed at the end, if it is there.
    pub work: &'a Path,
    /// Content of the mark of a depth map: what it is made from.
    pub id: &'a str,
    /// Ranks of the depth maps that a cloud is fused from, ascending.
    pub finished: &'a [usize],
    /// The product there was made by viewrank, or by the script of the export.
    pub is_marked: bool,
    pub program: &'a Path,
    pub python: &'a Path,
    pub threads: usize,
    pub image_scale: f64,
}

impl TaskRunner {
    /// The clouds that are there.
    pub fn clouds_there(&self) -> impl Iterator<Item = &Path> {
        self.clouds
            .iter()
            .map(PathBuf::as_path)
            .filter(|cloud| cloud.is_file())
    }
}

impl<'a> Call<'a> {
    /// Returns whether the depth map of this rank is among those that a cloud is fused from.
    pub fn is_finished(&self, rank: usize) -> bool {
        self.finished.binary_search(&rank).is_ok()
    }

    /// The disk, for changes in the project alone.
    pub fn disk(&self) -> Disk<'a> {
        Disk::REAL.within(slice::from_ref(self.project))
    }

    /// A list of the export, as viewrank writes it: somebody may change that in the project at any
    /// time.
    pub fn list(&self, name: &str) -> Result<&'a [u8], String> {
        let list = self.lists.get(name).map(Vec::as_slice);
        list.ok_or_else(|| format!("{name}: not in this export: export again"))
    }

    /// Reads a [list](Self::list) in JSON.
    pub fn read<T: DeserializeOwned>(&self, name: &str) -> Result<T, String> {
        let list = self.list(name)?;
        serde_json::from_slice(list)
            .map_err(|error| format!("{name}, {}", place_and_fault(&error, list)))
    }

    /// The row of a task in a list of the export. `task`: rank and mark of a row; another plan may
    /// have been exported meanwhile.
    pub fn row_of<'r, Row>(
        &self,
        rank: usize,
        rows: &'r [Row],
        task: fn(&Row) -> (usize, &str),
    ) -> Result<&'r Row, String> {
        let row = rows.iter().find(|row| task(row) == (rank, self.id));
        row.ok_or_else(|| format!("rank {rank} is of another plan than run.json: try again"))
    }

    /// Returns a link to a file of the export.
    pub fn link(&self, name: &str) -> Contents {
        Contents::Link {
            file: self.workplace.join(name),
            folder: self.project.clone(),
        }
    }

    /// Returns a link to a file that a task has made there. A link in its place may be a
    /// stranger's.
    pub fn made(&self, name: &str) -> Result<Contents, String> {
        if paths::is_outside(&self.workplace.join(name), self.workplace) {
            return Err(format!("{name}: a link out of the export: remove it"));
        }
        Ok(self.link(name))
    }

    /// Moves what was made in [`Self::work`] to its place in the export. What nobody has marked
    /// there may be the user's own work, and is kept beside it.
    pub fn place(&self, name: &str) -> Result<(), String> {
        let [from, to] = [self.work, self.workplace].map(|folder| folder.join(name));
        let kept = self.workplace.join(format!("{name}.before-viewrank"));
        if !self.is_marked && to.exists() && !kept.exists() {
            output::rename(&to, &kept, &self.disk()).map_err(text)?;
        }
        output::rename(&from, &to, &self.disk()).map_err(text)
    }
}

/// The program that computes depth maps one by one.
#[derive(Clone, Copy, Debug)]
pub struct TaskProgram {
    /// Name on the PATH.
    pub name: &'static str,
    /// Environment variable that has the path, or the folder, of another. It is set for the
    /// commands.
    pub variable: &'static str,
}

impl TaskProgram {
    /// The path of the program that somebody names, or of that in the folder that he names. A bare
    /// name is not of the current folder, which may be a stranger's.
    pub fn named(&self, named: PathBuf) -> PathBuf {
        if named.components().count() > 1 && named.is_dir() {
            named.join(self.name)
        } else {
            named
        }
    }

    /// Finds the program that the variable names, else the one on the PATH.
    pub fn installed(&self) -> Option<PathBuf> {
        let named = env::var_os(self.variable).map(|named| self.named(named.into()));
        let named = named.and_then(|named| platform::located(&named));
        named.or_else(|| platform::located(Path::new(self.name)))
    }
}

/// How a backend computes depth maps one by one.
#[derive(Clone, Copy)]
pub struct Tasks {
    pub program: TaskProgram,
    /// Returns the runner for an export with the default options.
    pub runner: fn(&Selection, &Export) -> TaskRunner,
}

/// How the clusters of an export are computed one by one, and their depth maps fused.
#[derive(Clone, Debug)]
pub struct TaskRunner {
    /// Hint for a Python that lacks the packages of its commands; the variable `PYTHON` may name
    /// another Python. `None`: no Python is needed.
    pub python: Option<&'static str>,
    /// Makes ready what a task needs, and returns its commands, each run if the one before
    /// succeeds; they depend on no current folder, and may run side by side with those of other
    /// depth maps. An error is a reason in words.
    pub commands: fn(&Call) -> Result<Vec<Vec<OsString>>, String>,
    /// Returns whether a depth map is all there, as far as its size tells.
    pub is_whole: fn(&Path) -> bool,
    /// Checks what the commands have made, and puts it in its place. An error is a reason in words;
    /// what was in that place is still there then.
    pub finish: fn(&Call) -> Result<(), String>,
    /// Files of the export that the commands and the check follow.
    pub lists: &'static [&'static str],
    /// Folder of viewrank's own files in the export, with a `/` behind it unless it is the export
    /// itself: tasks work below it, and the marks of their maps are there.
    pub own: &'static str,
    /// Clouds that the fusion writes; each may be missing if it has no depth map.
    pub clouds: Vec<PathBuf>,
    /// A depth map of full size takes the place of one of half the size.
    pub sizes_share_a_file: bool,
    /// Depth map of each cluster, in rank order; `None` if it cannot be computed.
    pub maps: Vec<Option<PathBuf>>,
}

/// Share of pixels with a depth below which a map counts as empty.
const LEAST_FILLED: f64 = 0.01;

/// Fails if next to no pixel of a depth map that a program has made has a depth.
pub fn refuse_empty(filled: f64) -> Result<(), String> {
    if filled < LEAST_FILLED {
        let percent = 100.0 * filled;
        return Err(format!("only {percent:.1} % of the pixels have a depth"));
    }
    Ok(())
}

/// Fails unless a depth map that a program has made is all there, of the shape of this size, and
/// not empty, as maps are whose partners do not suffice.
pub fn refuse_unfit(path: &Path, format: DepthMapFormat, size: [u32; 2]) -> Result<(), String> {
    if !path.exists() {
        return Err("the program made no depth map".into());
    }
    // One more on each side, as `is_of_shape` allows.
    let pixels = size.map(|side| u64::from(side) + 1).iter().product();
    let map = depthmaps::read(path, format, PixelBound::new(pixels));
    let map = map.map_err(|error| match error {
        DepthMapError::Unfinished { .. } => "the program did not write all of the depth map".into(),
        error => error.to_string(),
    })?;
    refuse_other_shape("depth map", [map.width, map.height], size)?;
    refuse_empty(map.filled())
}

/// Fails unless a map is of the shape of the planned size, pixels.
pub fn refuse_other_shape(what: &str, made: [u32; 2], planned: [u32; 2]) -> Result<(), String> {
    if is_of_shape(made, planned) {
        return Ok(());
    }
    let [[w, h], [width, height]] = [made, planned];
    Err(format!(
        "the {what} has {w} x {h} pixels instead of {width} x {height}"
    ))
}

/// Returns whether a map is of the shape of the planned size, pixels. It may be smaller: the images
/// that are there may be smaller than those of the model that was planned.
fn is_of_shape(made: [u32; 2], planned: [u32; 2]) -> bool {
    let [[w, h], [width, height]] = [made, planned];
    let [across, along] = [[w, height], [h, width]].map(|[a, b]| u64::from(a) * u64::from(b));
    // Programs round either side otherwise.
    across.abs_diff(along) <= u64::from(width.max(height))
        && w <= width.saturating_add(1)
        && h <= height.saturating_add(1)
}

/// Finds another program of the same software: beside it, in the folders in which some build each,
/// or on the PATH.
pub fn program_beside(program: &Path, name: &str) -> Result<PathBuf, String> {
    let folder = program.parent().unwrap_or(Path::new(""));
    let near = [folder.join(name), folder.join("..").join(name).join(name)];
    near.iter()
        .find_map(|path| platform::located(path))
        .or_else(|| platform::located(Path::new(name)))
        .ok_or_else(|| format!("no program {name} in {} or on the PATH", folder.display()))
}

/// An error as a reason.
pub fn text(error: impl Display) -> String {
    error.to_string()
}

/// The words of a command.
pub fn words<const N: usize>(words: [&dyn AsRef<OsStr>; N]) -> Vec<OsString> {
    words.map(|word| word.as_ref().to_owned()).into()
}

/// [`TaskRunner::is_whole`] of a program that never leaves a part of a map.
pub fn is_not_empty(map: &Path) -> bool {
    map.metadata()
        .is_ok_and(|map| map.is_file() && map.len() > 0)
}

/// [`TaskRunner::finish`] of a program that fails unless its results are complete, and puts them in
/// their places itself.
pub fn finishes_itself(_: &Call) -> Result<(), String> {
    Ok(())
}
