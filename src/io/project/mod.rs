//! What kind of project a folder is, and where its model, images and depth maps are.

mod discover;
mod files;
mod foreign;
mod images;

use std::{
    io,
    path::{Path, PathBuf},
};

pub use files::ColmapFiles;
pub use images::{ImageFaults, slashes};

use crate::{
    base::{
        error::Hint,
        shell::{quoted, quoted_path},
    },
    io::formats::{Fault, colmap::ColmapModel},
    model::scene::{ModelWarning, Scene, WarningKind},
};

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

impl ModelFormat {
    /// Does COLMAP itself read it?
    pub fn is_colmap(self) -> bool {
        matches!(self, Self::ColmapBinary | Self::ColmapText)
    }

    /// Does it say where in the images the points are observed? Else they are put where they project.
    pub fn has_pixels(self) -> bool {
        !matches!(self, Self::OpenMvs | Self::Sure)
    }

    /// As people write it.
    pub fn name(self) -> &'static str {
        match self {
            Self::ColmapBinary => "COLMAP binary",
            Self::ColmapText => "COLMAP text",
            Self::Bundler => "Bundler",
            Self::Nvm => "NVM",
            Self::OpenMvg => "OpenMVG",
            Self::OpenSfm => "OpenSfM",
            Self::AliceVision => "AliceVision",
            Self::OpenMvs => "OpenMVS",
            Self::Sure => "SURE",
        }
    }
}

/// Where a sparse model lies.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ModelLocation {
    pub format: ModelFormat,
    /// Folder of a COLMAP model; the file of other formats.
    pub path: PathBuf,
    /// Registered images by a first look, without reading the model.
    pub registered: u64,
}

impl ModelLocation {
    /// What `--model` takes: the name of the folder or file.
    pub fn name(&self) -> String {
        self.path.file_name().unwrap_or(self.path.as_os_str()).to_string_lossy().into_owned()
    }
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
    /// Was it asked for by name?
    pub model_is_named: bool,
    /// Other sub-models of the same project, not used.
    pub other_models: Vec<ModelLocation>,
    /// The image folder that names are relative to.
    pub images: Option<PathBuf>,
    /// The COLMAP dense workspace: `root` itself, `root/dense` or `root/dense/N`.
    pub dense_workspace: Option<PathBuf>,
}

impl Project {
    /// Finds out what lies at a path: a project folder, a model folder, or a model file. Of several sub-models the one with
    /// most registered images is taken, ties by name, unless `model` names one.
    pub fn open(path: &Path, model: Option<&str>) -> Result<Self, ProjectError> {
        discover::open(path, model)
    }

    /// The project as commands take it: its folder, and `--model` where another sub-model would be taken without.
    pub fn as_argument(&self) -> String {
        let root = quoted_path(&self.root);
        match discover::is_first(&self.model, &self.other_models) {
            true => root,
            false => format!("{root} --model {}", quoted(&self.model.name())),
        }
    }

    /// Where viewrank writes: `root/viewrank`.
    pub fn output_folder(&self) -> PathBuf {
        self.root.join("viewrank")
    }

    /// Reads the model, and which images of the image folder it lacks.
    pub fn read_scene(&self) -> Result<Scene, ProjectError> {
        let mut scene = match self.model.format {
            ModelFormat::ColmapBinary | ModelFormat::ColmapText => self.colmap_files()?.scene()?,
            _ => {
                let fault = |fault| ProjectError::Fault { path: self.model.path.clone(), fault };
                foreign::read(&self.root, &self.model)?.scene().map_err(fault)?
            }
        };
        let others = self.sub_model_warning(scene.views.len());
        scene.warnings.extend(others.map(|text| ModelWarning::new(WarningKind::OtherModels, text)));
        let workspace = self.other_workspace_warning();
        scene.warnings.extend(workspace.map(|text| ModelWarning::new(WarningKind::OtherWorkspace, text)));
        // Where images lie beside everything else, not every picture belongs to the survey.
        if let Some(images) = self.images.as_ref().filter(|images| **images != self.root) {
            scene.unregistered.extend(images::unregistered(images, &scene));
            scene.unregistered.sort_unstable();
            scene.unregistered.dedup();
        }
        Ok(scene)
    }

    /// What is wrong with the image files of the scene; nothing where there is no image folder.
    pub fn image_faults(&self, scene: &Scene) -> ImageFaults {
        self.images.as_deref().map_or_else(ImageFaults::default, |folder| ImageFaults::find(folder, scene))
    }

    /// The files of a COLMAP model as they are, for writing a part of them.
    pub fn colmap_files(&self) -> Result<ColmapFiles, ProjectError> {
        ColmapFiles::open(&self.model)
    }

    /// Does the folder of a binary COLMAP model hold another one as text: other images, or other poses?
    pub fn has_other_text_model(&self, scene: &Scene) -> bool {
        let location = ModelLocation { format: ModelFormat::ColmapText, ..self.model.clone() };
        if self.model.format != ModelFormat::ColmapBinary || !self.model.path.join("images.txt").is_file() {
            return false;
        }
        ColmapFiles::open(&location).and_then(|files| files.scene()).map_or(true, |text| !text.has_same_views(scene))
    }

    /// Hands the model on as COLMAP's files hold it: the project's own files, else the model of the scene.
    pub fn with_colmap_model<T>(
        &self,
        scene: &Scene,
        use_model: impl FnOnce(&ColmapModel) -> T,
    ) -> Result<T, ProjectError> {
        Ok(match self.model.format {
            ModelFormat::ColmapBinary | ModelFormat::ColmapText => use_model(&self.colmap_files()?.model()?),
            _ => use_model(&ColmapModel::from_scene(scene)),
        })
    }

    /// All files that the model is read from, in a fixed order.
    pub fn model_files(&self) -> Vec<PathBuf> {
        match self.model.format {
            ModelFormat::ColmapBinary | ModelFormat::ColmapText => files::all(&self.model),
            _ => foreign::files(&self.root, &self.model),
        }
    }

    /// Other models whose images are mostly those of the scene: copies of the model, in other coordinates perhaps.
    pub fn copies(&self, scene: &Scene) -> Vec<&ModelLocation> {
        let is_copy = |model: &&ModelLocation| {
            let names = discover::image_names(&self.root, model).unwrap_or_default();
            let shared = names.iter().filter(|name| scene.find(name).is_some()).count();
            2 * shared >= names.len()
        };
        self.other_models.iter().filter(is_copy).collect()
    }

    /// A workspace of another model is none of this one's.
    fn other_workspace_warning(&self) -> Option<String> {
        let others = discover::dense_folders(&self.root, &self.model);
        let other = others.first().filter(|_| self.dense_workspace.is_none())?;
        Some(format!(
            "{} lacks images of this model, or its own model cannot be read: nothing is written into it",
            other.display()
        ))
    }

    /// Which of several models is read, and which are not.
    fn sub_model_warning(&self, registered: usize) -> Option<String> {
        let others = self.other_models.iter().map(|m| format!("{} ({} images)", m.name(), m.registered));
        let others: Vec<String> = others.collect();
        (!others.is_empty() && !self.model_is_named).then(|| {
            let used = self.model.name();
            let how = match self.model.path.is_dir() {
                true => format!("viewrank plan {} plans one by itself", quoted_path(&self.other_models[0].path)),
                false => "--model takes another".into(),
            };
            format!(
                "of several sub-models {used} ({registered} images) is used; not used: {}; {how}",
                others.join(", ")
            )
        })
    }
}

/// Why a project cannot be opened or its model not be read.
#[derive(Debug, thiserror::Error)]
pub enum ProjectError {
    #[error("{0}: no such file or folder")]
    NotFound(PathBuf),
    #[error("no sparse model under {path}; looked for {looked_for}")]
    NoModel { path: PathBuf, looked_for: String },
    #[error("{folder} holds part of a COLMAP model, but not {missing}")]
    IncompleteModel { folder: PathBuf, missing: String },
    #[error("there is no sub-model {wanted:?} in {path}; there {present}")]
    NoSuchModel { path: PathBuf, wanted: String, present: String },
    #[error("{path}: {source}")]
    Io { path: PathBuf, source: io::Error },
    #[error("{path}, {fault}")]
    Fault { path: PathBuf, fault: Fault },
    #[error("{0}: there is no list of images (list.txt) beside it or one folder up")]
    NoImageList(PathBuf),
}

impl Hint for ProjectError {
    fn hint(&self) -> Option<String> {
        Some(match self {
            Self::NotFound(_) => "Give the folder of the project, the one that holds `sparse` and `images`.".into(),
            Self::NoModel { .. } => "Give a folder that holds `sparse`, or the folder of the model itself.".into(),
            Self::IncompleteModel { .. } => {
                "Export the model again, with all of cameras, images and points3D in one format, binary or text.".into()
            }
            Self::NoSuchModel { .. } => "Give such a name to --model, or leave it out.".into(),
            Self::Io { .. } => "Check that the file is there and may be read.".into(),
            Self::Fault { fault, .. } => fault.problem.hint().into(),
            Self::NoImageList(_) => {
                "Put the list that Bundler was given there: a line per camera, the image's name.".into()
            }
        })
    }

    fn is_usage(&self) -> bool {
        matches!(self, Self::NoSuchModel { .. })
    }
}
