//! What kind of project a folder is, and where its model, images and depth maps are.

use std::path::PathBuf;

/// Formats of sparse models.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ModelFormat {
    ColmapBinary,
    ColmapText,
    Bundler,
    Nvm,
    OpenMvg,
    OpenSfm,
    AliceVision,
    OpenMvs,
    Sure,
}

/// Where a sparse model lies.
#[derive(Clone, Debug)]
pub struct ModelLocation {
    pub format: ModelFormat,
    /// Folder of a COLMAP model; the file of other formats.
    pub path: PathBuf,
}

/// What the folder is set up for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ProjectKind {
    /// `sparse/0`, `sparse/1`, ..., `images/`.
    Colmap,
    /// `sparse/*.bin`, `images/`, `stereo/`.
    ColmapDense,
    /// A folder or file that holds a model and nothing else.
    BareModel,
    OpenMvs,
    Sure,
}

/// A folder with a sparse model.
#[derive(Clone, Debug)]
pub struct Project {
    pub root: PathBuf,
    pub kind: ProjectKind,
    /// The model to plan for.
    pub model: ModelLocation,
    /// Other sub-models of the same project, not used.
    pub other_models: Vec<ModelLocation>,
    /// The image folder that names are relative to.
    pub images: Option<PathBuf>,
    /// The COLMAP dense workspace: `root` itself or `root/dense`.
    pub dense_workspace: Option<PathBuf>,
}

impl Project {
    /// Where viewrank writes: `root/viewrank`.
    pub fn output_folder(&self) -> PathBuf {
        self.root.join("viewrank")
    }
}
