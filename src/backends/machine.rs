//! Default backend: the one that the project is set up for, else an installed one.

use std::{
    env, fmt,
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

use super::{BACKENDS, Backend, Tasks, colmap, openmvs, sgm};
use crate::{base::platform, config::Settings, config::UnknownBackend, io::project::Project};

/// How the backend came to be chosen.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Choice {
    /// The command line or the settings name it.
    Named,
    /// The project is planned for it.
    Planned,
    /// The project has its workspace or its model.
    Project,
    /// This program is installed.
    Installed(PathBuf),
    /// Neither OpenMVS nor a COLMAP with CUDA is installed: the matcher that comes with viewrank.
    NothingElse,
}

impl Choice {
    /// Describes the choice in a clause that follows the name of the backend.
    pub fn describe(&self) -> String {
        match self {
            Self::Named => "as named".into(),
            Self::Planned => "as planned before; --backend names another".into(),
            Self::Project => "as the project is set up".into(),
            Self::Installed(program) => format!("{} is installed", program.display()),
            Self::NothingElse => "no DensifyPointCloud and no colmap with CUDA on the PATH".into(),
        }
    }
}

/// Returns the backend of the project and how it was chosen: the first of the settings, else the
/// one that the project is set up for, else OpenMVS or a COLMAP with CUDA on the PATH, else `sgm`.
pub fn chosen(
    project: &Project,
    settings: &Settings,
) -> Result<(&'static Backend, Choice), UnknownBackend> {
    match settings.backends.first() {
        Some(name) => super::by_name(name).map(|backend| (backend, Choice::Named)),
        None => Ok(by_default(project)),
    }
}

/// Like [`chosen`], for settings that name no backend.
pub fn by_default(project: &Project) -> (&'static Backend, Choice) {
    // A workspace of `viewrank undistort` says that images were distorted, not which program will
    // match them.
    let is_set_up = |backend: &Backend| {
        (backend.serves)(project)
            && !(backend.name == colmap::BACKEND.name && project.has_undistorted_workspace())
    };
    if let Some(backend) = BACKENDS.iter().copied().find(|backend| is_set_up(backend)) {
        return (backend, Choice::Project);
    }
    if let Some(program) = densify() {
        return (&openmvs::BACKEND, Choice::Installed(program));
    }
    match colmap_with_gpu() {
        Some(program) => (&colmap::BACKEND, Choice::Installed(program)),
        None => (&sgm::BACKEND, Choice::NothingElse),
    }
}

fn densify() -> Option<PathBuf> {
    openmvs::BACKEND.tasks?.program.installed()
}

fn colmap() -> Option<PathBuf> {
    colmap::BACKEND.tasks?.program.installed()
}

/// Returns COLMAP if it can match: its dense stereo needs CUDA, or HIP since 4.2.
fn colmap_with_gpu() -> Option<PathBuf> {
    // Chosen unasked only if it says so; `not_ready` refuses only one that says the opposite.
    let can_match = |help: String| {
        ["with CUDA", "with HIP"]
            .iter()
            .any(|gpu| help.contains(gpu))
    };
    colmap().filter(|program| help(program).is_some_and(can_match))
}

/// Version of a program: major, minor, patch.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Version(pub [u32; 3]);

impl fmt::Display for Version {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [major, minor, patch] = self.0;
        write!(f, "{major}.{minor}.{patch}")
    }
}

/// Returns the version of the installed COLMAP; `None` without one, or if it isn't a release.
pub(super) fn colmap_version() -> Option<Version> {
    release(&help(&colmap()?)?)
}

/// Parses the first line of `colmap help`: `COLMAP 3.8 -- ...`, `COLMAP 4.2.0 (Commit ...)`.
fn release(help: &str) -> Option<Version> {
    let word = help
        .trim_start()
        .strip_prefix("COLMAP ")?
        .split_whitespace()
        .next()?;
    let mut parts = word.split('.').map(|part| part.parse().ok());
    let version = [
        parts.next()??,
        parts.next()??,
        parts.next().unwrap_or(Some(0))?,
    ];
    // `4.2.0.dev0` comes before the release, and may lack its repairs.
    parts.next().is_none().then_some(Version(version))
}

/// Returns the Python that runs scripts: `PYTHON`, else `python3`.
pub fn python() -> PathBuf {
    env::var_os("PYTHON").map_or_else(|| "python3".into(), PathBuf::from)
}

/// Returns whether `viewrank run` would find what it needs to match with this backend.
pub fn can_match_here(backend: &Backend) -> bool {
    match backend.name {
        name if name == colmap::BACKEND.name => colmap_with_gpu().is_some(),
        name if name == sgm::BACKEND.name => import_error(&python()).is_none(),
        _ => {
            let installed = |tasks: Tasks| tasks.program.installed();
            backend.tasks.and_then(installed).is_some()
        }
    }
}

/// Why a program cannot match on this machine, and what to do.
pub struct NotReady {
    pub what: String,
    pub cure: &'static str,
}

/// Returns why the backend's program, or the Python that it needs, cannot match, as far as that can
/// be known before the first map.
pub fn not_ready(backend: &Backend, program: &Path, python: &Path) -> Option<NotReady> {
    if backend.name == colmap::BACKEND.name && is_without_gpu(&help(program)?) {
        return Some(NotReady {
            what: format!(
                "{} was built without CUDA and cannot compute depth maps",
                program.display()
            ),
            cure: "name a COLMAP with CUDA with --program, or match with --backend openmvs or --backend sgm",
        });
    }
    let missing = if backend.name == sgm::BACKEND.name {
        import_error(python)?
    } else {
        return None;
    };
    Some(NotReady {
        what: format!(
            "sgm computes no depth maps with {}: {missing}",
            python.display()
        ),
        cure: "pip install numpy opencv-python-headless, or name a Python that has them by the variable PYTHON",
    })
}

/// Returns why the backend's program that is installed here cannot match; `None` also where none is
/// installed, since the files may be for another machine.
pub fn not_ready_here(backend: &Backend) -> Option<NotReady> {
    let is_colmap = backend.name == colmap::BACKEND.name;
    let program = is_colmap.then(colmap)??;
    not_ready(backend, &program, &python())
}

/// Reads from `colmap help` whether it was built without CUDA: the words of 3.8 to 4.1, and since
/// 4.2.
fn is_without_gpu(help: &str) -> bool {
    ["without CUDA", "without GPU support"]
        .iter()
        .any(|words| help.contains(words))
}

/// Returns what `colmap help` prints, which says how it was built.
fn help(program: &Path) -> Option<String> {
    let output = Command::new(program)
        .arg("help")
        .stdin(Stdio::null())
        .output()
        .ok()?;
    Some(String::from_utf8_lossy(&output.stdout).into_owned())
}

/// Returns the last line of the error if this Python does not have the packages of
/// `integrations/sgm`.
fn import_error(python: &Path) -> Option<String> {
    let Some(program) = platform::located(python) else {
        return Some("no such program".into());
    };
    // In an empty folder: the current one may be a stranger's, with a numpy.py of his.
    let empty = match tempfile::tempdir() {
        Ok(empty) => empty,
        Err(error) => return Some(error.to_string()),
    };
    let mut command = Command::new(program);
    command
        .args(["-c", "import numpy, cv2"])
        .env("PYTHONSAFEPATH", "1")
        .current_dir(empty.path());
    match command.stdin(Stdio::null()).output() {
        Ok(output) if output.status.success() => None,
        Ok(output) => {
            let text = String::from_utf8_lossy(&output.stderr);
            Some(
                text.trim_end()
                    .lines()
                    .last()
                    .unwrap_or("it does not start")
                    .to_owned(),
            )
        }
        Err(error) => Some(error.to_string()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colmap_says_its_version_and_how_it_was_built() {
        for (help, version, can_match) in [
            (
                "COLMAP 3.8 -- Structure-from-Motion and Multi-View Stereo\n              (Commit Unknown on Unknown without CUDA)\n",
                Some([3, 8, 0]),
                false,
            ),
            (
                "COLMAP 4.1.1 (Commit 1e5b23f on 2026-07-17 with CUDA)",
                Some([4, 1, 1]),
                true,
            ),
            (
                "COLMAP 4.2.0 (Commit be5e291 on 2026-08-31 without GPU support)",
                Some([4, 2, 0]),
                false,
            ),
            (
                "COLMAP 4.2.1 (Commit 0000000 on 2026-10-01 with HIP)",
                Some([4, 2, 1]),
                true,
            ),
            (
                "COLMAP 4.2.0.dev0 (Commit 5d968cf on 2026-08-08 with CUDA)",
                None,
                true,
            ),
            ("usage: something else", None, true),
        ] {
            assert_eq!(release(help), version.map(Version), "{help}");
            assert_eq!(!is_without_gpu(help), can_match, "{help}");
        }
    }
}
