//! Reads the mesh that replaces the surface from the points.

use std::path::{Path, PathBuf};

use crate::{
    base::{
        error::{Advice, Hint},
        input::{self, FileKind},
    },
    io::ply::{self, PlyError},
    model::mesh::Mesh,
};

/// The mesh of the settings cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum MeshError {
    #[error("{}: {source}", path.display())]
    File {
        path: PathBuf,
        source: std::io::Error,
    },
    #[error("{}: {source}", path.display())]
    Ply { path: PathBuf, source: PlyError },
}

impl MeshError {
    /// The error without anything from a file that it may not quote.
    pub(super) fn quoting(self, may_quote: impl Fn(&Path) -> bool) -> Self {
        match self {
            Self::Ply { path, source } if !may_quote(&path) => Self::Ply {
                path,
                source: source.hidden(),
            },
            error => error,
        }
    }
}

impl Hint for MeshError {
    fn hint(&self) -> Option<Advice> {
        Some(match self {
            Self::File { .. } => "check that the file exists and is readable".into(),
            Self::Ply { .. } => "give a PLY file of triangles in the frame of the model".into(),
        })
    }
}

pub(super) fn read(path: &Path) -> Result<Mesh, MeshError> {
    let bytes = input::read(path, FileKind::Mesh).map_err(|source| MeshError::File {
        path: path.into(),
        source,
    })?;
    ply::read(&bytes).map_err(|source| MeshError::Ply {
        path: path.into(),
        source,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mesh_that_is_none_is_refused_with_its_place() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("sphere.ply");
        std::fs::write(&path, "solid sphere").unwrap();
        let error = read(&path).unwrap_err().to_string();
        assert!(error.contains("sphere.ply: line 1"), "{error}");
    }
}
