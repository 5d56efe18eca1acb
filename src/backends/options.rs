//! The user's options of an export.

use std::path::PathBuf;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{Backend, Selection};
use crate::io::output::FileSet;

/// Views that get depth maps from COLMAP.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum References {
    /// The key views.
    #[serde(rename = "keys")]
    Keys,
    /// The key views and, photometric only, their partners; geometric consistency needs these.
    #[serde(rename = "keys+partners")]
    KeysAndPartners,
    /// Every view of the model, key views first.
    #[serde(rename = "all")]
    All,
}

/// The user's options of an export.
#[derive(Clone, Debug, Default)]
pub struct ExportOptions {
    /// Output folder; `None`: the backend's default in the project.
    pub out: Option<PathBuf>,
    /// COLMAP; unset: `keys+partners` with geometric consistency, else `keys`.
    pub refs: Option<References>,
    /// COLMAP: depth maps checked against those of their partners. Unset: off, unless `refs` asks
    /// for partners' maps.
    pub geometric: Option<bool>,
    /// OpenMVS: a list of neighbours for this scene instead of a scene per cluster.
    pub scene: Option<PathBuf>,
    /// OpenMVS with `scene`: a copy of the scene, scaled so that OpenMVS's depth range fits.
    pub scale: bool,
}

impl ExportOptions {
    /// Returns an empty set of files for a backend with its own folder.
    pub(super) fn file_set(&self, backend: &Backend, selection: &Selection) -> FileSet {
        let own = || selection.project.output_folder().join(backend.name);
        FileSet::new(self.out.clone().unwrap_or_else(own), backend.name)
    }
}
