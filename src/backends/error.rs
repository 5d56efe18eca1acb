//! Errors of exports.

use std::path::{Path, PathBuf};

use super::BACKENDS;
use crate::{
    base::error::{Advice, Hint},
    config::UnknownBackend,
    io::{output::OutputError, project::ProjectError},
};

/// Error of an export.
#[derive(Debug, thiserror::Error)]
pub enum BackendError {
    #[error(transparent)]
    Unknown(#[from] UnknownBackend),
    #[error("{backend} cannot take the image name \"{name}\": {why}")]
    Name {
        backend: &'static str,
        name: String,
        why: String,
    },
    #[error("{backends}: unknown option {option}")]
    Option {
        option: &'static str,
        backends: String,
    },
    #[error("{backend} needs {what}")]
    Needs {
        backend: &'static str,
        what: String,
        hint: String,
    },
    #[error("cannot export to {}: it belongs to the project", _0.display())]
    OwnFile(PathBuf),
    #[error("cannot export next to {}: it belongs to another model", _0.display())]
    OtherModel(PathBuf),
    #[error("{} contains the export for {backend}", folder.display())]
    OtherExport { folder: PathBuf, backend: String },
    #[error(transparent)]
    Place(#[from] OutputError),
    #[error(transparent)]
    Model(Box<ProjectError>),
}

impl From<ProjectError> for BackendError {
    fn from(error: ProjectError) -> Self {
        Self::Model(Box::new(error))
    }
}

impl BackendError {
    /// The backend cannot take the name of an image.
    pub(super) fn name(backend: &'static str, name: &str, why: impl Into<String>) -> Self {
        Self::Name {
            backend,
            name: name.into(),
            why: why.into(),
        }
    }
}

impl Hint for BackendError {
    fn hint(&self) -> Option<Advice> {
        Some(match self {
            Self::Unknown(error) => return error.hint(),
            Self::Name { .. } => {
                "rename the image file and its entry in the model, then plan again".into()
            }
            Self::Option { option, .. } => {
                let takers = BACKENDS
                    .iter()
                    .filter(|b| b.options.contains(option))
                    .map(|b| b.name);
                format!(
                    "leave it out; it is for {}",
                    takers.collect::<Vec<_>>().join(", ")
                )
                .into()
            }
            Self::Needs { hint, .. } => hint.clone().into(),
            Self::OwnFile(_) => Advice::text("write to another folder with ").set("out"),
            Self::OtherModel(_) => Advice::text("write to another folder with ")
                .set("out")
                .and(", or move that model away"),
            Self::OtherExport { .. } => Advice::text("write to another folder with ")
                .set("out")
                .and(", or remove that one first"),
            Self::Place(error) => return error.hint(),
            Self::Model(error) => return error.hint(),
        })
    }

    fn is_usage(&self) -> bool {
        matches!(self, Self::Unknown(_) | Self::Option { .. })
    }

    fn path(&self) -> Option<&Path> {
        match self {
            Self::OwnFile(path)
            | Self::OtherModel(path)
            | Self::OtherExport { folder: path, .. } => Some(path),
            Self::Place(error) => error.path(),
            Self::Model(error) => error.path(),
            _ => None,
        }
    }
}

/// Most bytes of the name of a file or folder.
const LONGEST: usize = 255;

/// Refuses an image whose results, named like it with `end` behind, no folder takes.
pub(super) fn check_length(
    backend: &'static str,
    name: &str,
    end: &str,
) -> Result<(), BackendError> {
    let longest = LONGEST - end.len();
    let file = name.rsplit('/').next().unwrap_or(name);
    if file.len() <= longest {
        return Ok(());
    }
    let why = format!(
        "its results would be named like it with {end} behind, and that is longer than a file name may be: {longest} bytes are the most"
    );
    Err(BackendError::name(backend, name, why))
}
