//! Default backend: the one that the project is set up for, else an installed one.

use std::{
    env,
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

use super::{BACKENDS, Backend, colmap, openmvs, sgm};
use crate::{base::platform, config::Settings, config::UnknownBackend, io::project::Project};

/// Reason for the choice of a backend.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Why {
    /// The command line or the settings name it.
    Named,
    /// The project has its workspace or its model.
    Project,
    /// This program is installed.
    Installed(PathBuf),
    /// Neither OpenMVS nor a COLMAP with CUDA is installed: the matcher that comes with viewrank.
    NothingElse,
}

impl Why {
    /// Returns the reason as a clause that follows the name of the backend.
    pub fn words(&self) -> String {
        match self {
            Self::Named => "as named".into(),
            Self::Project => "as the project is set up".into(),
            Self::Installed(program) => format!("{} is installed", program.display()),
            Self::NothingElse => "no DensifyPointCloud and no colmap with CUDA on the PATH".into(),
        }
    }
}

/// Returns the backend of the project and the reason: the first of the settings, else the one that the project is set up for, else OpenMVS or a COLMAP with CUDA
/// on the PATH, else `sgm`.
pub fn chosen(project: &Project, settings: &Settings) -> Result<(&'static Backend, Why), UnknownBackend> {
    match settings.backends.first() {
        Some(name) => super::by_name(name).map(|backend| (backend, Why::Named)),
        None => Ok(by_default(project)),
    }
}

/// Like [`chosen`], for settings that name no backend.
pub fn by_default(project: &Project) -> (&'static Backend, Why) {
    // A workspace of `viewrank undistort` says that images were distorted, not which program will match them.
    let is_set_up = |backend: &Backend| {
        (backend.serves)(project) && !(backend.name == colmap::BACKEND.name && project.has_undistorted_workspace())
    };
    if let Some(backend) = BACKENDS.iter().copied().find(|backend| is_set_up(backend)) {
        return (backend, Why::Project);
    }
    if let Some(program) = installed("DENSIFY", "DensifyPointCloud") {
        return (&openmvs::BACKEND, Why::Installed(program));
    }
    match installed("COLMAP", "colmap").filter(|program| has_cuda(program)) {
        Some(program) => (&colmap::BACKEND, Why::Installed(program)),
        None => (&sgm::BACKEND, Why::NothingElse),
    }
}

/// Returns the program that the environment variable names, else the one on the PATH.
fn installed(variable: &str, program: &str) -> Option<PathBuf> {
    let named = env::var_os(variable).and_then(|named| platform::located(Path::new(&named)));
    named.or_else(|| platform::located(Path::new(program)))
}

/// Returns whether this COLMAP can match: its dense stereo needs CUDA, and `colmap help` says whether it has it.
fn has_cuda(program: &Path) -> bool {
    let mut command = Command::new(program);
    let output = command.arg("help").stdin(Stdio::null()).output();
    output.is_ok_and(|output| String::from_utf8_lossy(&output.stdout).contains("with CUDA"))
}
