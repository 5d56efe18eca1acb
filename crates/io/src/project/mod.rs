//! Projects: folders with a sparse model, and where their images and dense workspace are.

mod complete;
mod containing;
mod create;
mod discover;
mod elsewhere;
mod error;
mod files;
mod folder;
mod foreign;
mod image_files;
mod images;
mod names;
mod originals;
mod other_names;
mod probe;
mod test_lists;

use std::{
    collections::{BTreeMap, HashMap, HashSet},
    path::{Path, PathBuf},
    time::SystemTime,
};

use viewrank_core::{
    base::error::Advice,
    model::scene::{ModelWarning, Scene, ViewIndex, WarningKind},
};

pub use containing::containing;
pub use create::CreateError;
pub use discover::{FOLDERS_OF_PROGRAMS, WORKSPACES, models_of_other_programs};
pub use error::ProjectError;
pub use files::ColmapFiles;
pub use folder::{ImageFolder, MASKS};
pub use image_files::{images_below, is_image, slashes};
pub use images::{ImageFaults, Turned};
pub use originals::Originals;
pub use probe::{Unread, is_raw, probe};
pub use test_lists::TEST_LISTS;

use crate::{
    depthmaps,
    formats::{
        colmap::{ColmapImage, ColmapModel},
        foreign::ForeignModel,
        name_parts,
    },
    output::{self, Disk},
    paths,
    shell::{command_path, command_word, shown_path},
};

/// Sparse model formats.
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
    /// `transforms.json` (nerfstudio, instant-ngp).
    Transforms,
    /// Metashape's `cameras.xml`.
    Metashape,
    /// BlocksExchange XML (ContextCapture).
    Blocks,
    /// MVE's `synth_0.out`.
    Mve,
    /// An `Ori-` folder of MicMac.
    MicMac,
}

impl ModelFormat {
    /// Returns whether COLMAP reads the format.
    pub fn is_colmap(self) -> bool {
        matches!(self, Self::ColmapBinary | Self::ColmapText)
    }

    /// Returns whether the format stores measured pixels. Without them, observations are placed at
    /// the projections of their points.
    pub fn has_pixels(self) -> bool {
        !matches!(
            self,
            Self::OpenMvs
                | Self::Sure
                | Self::Transforms
                | Self::Metashape
                | Self::Mve
                | Self::MicMac
        )
    }

    /// Display name.
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
            Self::Transforms => "transforms.json",
            Self::Metashape => "Metashape",
            Self::Blocks => "BlocksExchange",
            Self::Mve => "MVE",
            Self::MicMac => "MicMac",
        }
    }
}

/// What a model has for a plan to start from, poorest first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum ModelContents {
    /// Views without sparse points, or unknown.
    Poses,
    /// Sparse points without tracks, in the model or in a PLY file beside it.
    Points,
    /// Sparse points that several views observe.
    Tracks,
}

/// Location of a sparse model.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ModelLocation {
    pub format: ModelFormat,
    /// Folder of a COLMAP model; the file of other formats.
    pub path: PathBuf,
    /// Number of registered images according to a quick check of the file; 0 if that fails or was
    /// not needed.
    pub registered: u64,
    pub contents: ModelContents,
    /// Name as passed to `--model`: that of the folder or file, with the folders above it if
    /// several models of the project have the same.
    pub name: String,
}

impl ModelLocation {
    /// A model that is not examined.
    pub fn new(format: ModelFormat, path: impl Into<PathBuf>) -> Self {
        let path = path.into();
        let name = path.file_name().unwrap_or(path.as_os_str());
        Self {
            format,
            registered: 0,
            contents: ModelContents::Poses,
            name: name.to_string_lossy().into_owned(),
            path,
        }
    }
}

/// Layout of the project folder.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ProjectKind {
    /// `sparse/0`, `sparse/1`, ..., `images/`.
    Colmap,
    /// `sparse/*.bin`, `images/`, `stereo/`.
    ColmapDense,
    /// A model without a project around it.
    BareModel,
    OpenMvs,
    Sure,
}

/// A folder with a sparse model.
#[derive(Clone, Debug)]
pub struct Project {
    pub root: PathBuf,
    /// Folder with viewrank's output folder: `root`, or another one for a project that must not be
    /// written to.
    pub home: PathBuf,
    /// The folder that the user named, the root or the home: errors quote no files outside of it.
    pub named: PathBuf,
    pub kind: ProjectKind,
    /// The model to plan for.
    pub model: ModelLocation,
    /// True if the user named the model.
    pub model_is_named: bool,
    /// Other sub-models of the project, which are not used.
    pub other_models: Vec<ModelLocation>,
    /// The folder to which image names are relative.
    pub images: Option<ImageFolder>,
    /// Images that were found, but are not those of the model: it is undistorted, they are not.
    pub originals: Option<Originals>,
    /// The COLMAP dense workspace: `root` itself, `root/dense` or `root/dense/N`, or of the same
    /// structure in `root/undistorted`.
    pub dense_workspace: Option<PathBuf>,
    /// The model's files as they were before the scene was read.
    pub model_stamps: Vec<FileStamp>,
}

/// Length and modification time of a file; `None` if it is missing. Not the inode, which some
/// network file systems make up anew each time.
pub type FileStamp = Option<(u64, Option<SystemTime>)>;

/// Name of the file set with the model of undistorted images; those of their batches begin with it.
pub const UNDISTORTED_SET: &str = "undistorted";

/// Name of the file set of a batch of undistorted images, from 1.
pub fn undistorted_set(batch: usize) -> String {
    format!("{UNDISTORTED_SET}-{batch:04}")
}

impl Project {
    /// Opens a project folder, a model folder or a model file. Of several models it takes the one
    /// named by `model`, or the richest: with tracks before points, COLMAP's before those of other
    /// programs, with most registered images, ties by depth of the folder, then by name.
    ///
    /// # Errors
    /// If there is no complete model, or no sub-model of that name.
    pub fn open(path: &Path, model: Option<&str>) -> Result<Self, ProjectError> {
        discover::open(path, model)
    }

    /// Opens what a user names: as [`Self::open`], or the folder of a plan that was written
    /// elsewhere (`plan --out`).
    pub fn open_or_planned(path: &Path, model: Option<&str>) -> Result<Self, ProjectError> {
        match Self::open(path, model) {
            Err(ProjectError::NoModel { .. } | ProjectError::Mistaken { .. })
                if elsewhere::project_of(path).is_some() =>
            {
                let project = elsewhere::project_of(path).unwrap_or_default();
                let project = Self::open(&paths::from_here(&project), model)?;
                Ok(Self {
                    // The folder may be a stranger's and lead to any project, of whose files errors
                    // must not tell.
                    named: path.into(),
                    ..project.with_home(path)
                })
            }
            opened => opened,
        }
    }

    /// The same project with the results in another folder; nothing is written to its own. The plan
    /// there names the project, so that the folder can be opened in its place.
    pub fn with_home(self, home: &Path) -> Self {
        let home = home.into();
        // A workspace gets the files of its backend, which would be written into the project.
        Self {
            home,
            dense_workspace: None,
            ..self
        }
    }

    /// The same project with its images in this folder; `None`: where they were found.
    pub fn with_images(self, images: Option<&Path>) -> Self {
        // Images that the user names are meant, whatever they were made from.
        let originals = self.originals.filter(|_| images.is_none());
        let images = images.map(ImageFolder::new).or(self.images);
        Self {
            images,
            originals,
            ..self
        }
    }

    /// Returns the name of the project's folder, also where that was typed as `.`.
    pub fn name(&self) -> String {
        let whole = dunce::canonicalize(&self.root).unwrap_or_else(|_| self.root.clone());
        let name = whole.file_name().unwrap_or(whole.as_os_str());
        name.to_string_lossy().into_owned()
    }

    /// Returns whether results go to a folder outside the project.
    pub fn is_elsewhere(&self) -> bool {
        self.home != self.root
    }

    /// Command line argument for the project: its folder, and `--model` unless the sub-model is the
    /// default.
    pub fn as_argument(&self) -> String {
        let root = command_path(&self.home);
        if discover::is_first(&self.model, &self.other_models) {
            root
        } else {
            format!("{root} --model {}", command_word(&self.model.name))
        }
    }

    /// Path of the model relative to the project, as `--model` takes it; "." is the project itself.
    pub fn model_path(&self) -> String {
        self.path_of(&self.model)
    }

    fn path_of(&self, model: &ModelLocation) -> String {
        let path = &model.path;
        match path.strip_prefix(&self.root).unwrap_or(path) {
            own if own.as_os_str().is_empty() => ".".into(),
            path => path.to_string_lossy().replace('\\', "/"),
        }
    }

    /// Returns the folder in which a program writes its depth maps; `None` where links lead out of
    /// the project.
    pub fn folder_of_maps(&self, program: &str) -> Option<PathBuf> {
        depthmaps::folder_of(&self.home, self.dense_workspace.as_deref(), program)
    }

    /// Returns the dense workspace below the project, or the folder that OpenSfM has undistorted
    /// its model into, unless it lacks its images.
    pub fn undistorted_workspace(&self) -> Option<PathBuf> {
        let dense = self.dense_workspace.clone();
        let dense = dense.filter(|dense| *dense != self.root);
        let by_opensfm = || {
            let name = self.model.path.file_name()?;
            let folder = self.model.path.parent()?.join("undistorted");
            (self.model.format == ModelFormat::OpenSfm && folder.join(name).is_file())
                .then_some(folder)
        };
        let places = dense.into_iter().chain(by_opensfm());
        places
            .into_iter()
            .find(|place| discover::has_pictures(place))
    }

    /// Returns whether the model has a camera with lens distortion; false where it cannot be read.
    pub fn has_distorted_cameras(&self) -> bool {
        if self.model.format.is_colmap() {
            return files::is_distorted(&self.model) == Some(true);
        }
        let cameras = foreign::read(&self.root, &self.model).map(|(read, _)| read.model.cameras);
        cameras.is_ok_and(|cameras| cameras.iter().any(|camera| !camera.is_pinhole()))
    }

    /// Says where the images are to be put.
    pub fn where_images_belong(&self) -> String {
        let which = match &self.originals {
            Some(_) => "undistorted images",
            None => "images",
        };
        let folder = self.images.as_ref().map(|images| images.to_path_buf());
        let folder = folder.unwrap_or_else(|| self.root.join("images"));
        let shown = command_path(&folder);
        match folder.read_link() {
            Ok(target) if !folder.exists() => {
                let target = shown_path(&target);
                format!("bring back {target}, to which the link {shown} leads")
            }
            _ => format!("put the {which} into {shown}"),
        }
    }

    /// Returns whether `viewrank undistort` made the dense workspace.
    pub fn has_undistorted_workspace(&self) -> bool {
        self.dense_workspace.as_ref().is_some_and(|dense| {
            dense
                .join(format!("viewrank/{}.json", undistorted_set(1)))
                .is_file()
        })
    }

    /// The folder for the undistorted images where none is named: `dense`, or another if somebody
    /// else's model is in that.
    pub fn place_of_undistorted(&self) -> PathBuf {
        let [dense, other] = WORKSPACES.map(|name| self.home.join(name));
        if has_model_of_others(&dense) {
            other
        } else {
            dense
        }
    }

    /// viewrank's output folder: `home/viewrank`.
    pub fn output_folder(&self) -> PathBuf {
        self.home.join("viewrank")
    }

    /// The disk for results: nothing that is written below [`Self::home`] gets out of it.
    pub fn disk(&self) -> Disk<'_> {
        Disk::REAL.within(std::slice::from_ref(&self.home))
    }

    /// Reads the model, and adds the images of the image folder that it lacks to `unregistered`.
    pub fn read_scene(&self) -> Result<Scene, ProjectError> {
        let scene = self.scene_of_files();
        let mut scene = scene.map_err(|error| error.explained(&self.named))?;
        if scene.tests.is_empty() {
            let (tests, warning) = test_lists::listed_tests(&self.root, &self.model, &scene);
            scene.tests = tests;
            scene.warnings.extend(warning);
        }
        let others = self.sub_model_warning(scene.views.len());
        scene.warnings.extend(others);
        scene.warnings.extend(self.other_workspace_warning());
        scene.warnings.extend(self.rivals_warning());
        scene
            .warnings
            .extend(self.originals.iter().map(|originals| {
                ModelWarning::new(WarningKind::OtherWorkspace, originals.what())
                    .with_cure(originals.cure())
            }));
        if let Some(images) = &self.images {
            let mut others = images::unregistered(images, &scene);
            // A project folder also holds files that are no photographs of the survey.
            if **images == *self.root {
                others.retain(images::is_beside_views(&scene));
            }
            scene.unregistered.extend(others);
            // Some models list images without a pose themselves.
            scene.unregistered.sort_unstable();
            scene.unregistered.dedup();
        }
        Ok(scene)
    }

    fn scene_of_files(&self) -> Result<Scene, ProjectError> {
        if self.model.format.is_colmap() {
            let files = self.colmap_files()?;
            let model = self.completed_colmap(&files)?;
            return model.scene().map_err(|fault| files.locate(fault));
        }
        let (mut foreign, cloud) = foreign::read(&self.root, &self.model)?;
        self.name_images(&mut foreign.model)?;
        if let Some(images) = &self.images {
            // Masks are found by the names that `name_images` has given.
            images.add_masks(self.masks_of(&foreign));
        }
        foreign.model = complete::completed(foreign.model, &self.model, cloud)?;
        let scene = foreign.scene();
        scene.map_err(ProjectError::fault(&self.model.path))
    }

    /// The masks that a model names, by the names of their images: those below its folder, since a
    /// stranger may have named others.
    fn masks_of(&self, foreign: &ForeignModel) -> HashMap<String, PathBuf> {
        let folder = self.model.path.parent().unwrap_or(&self.root);
        let mask = |image: &ColmapImage| {
            let parts = name_parts(foreign.masks.get(&image.id)?)?;
            let is_below = parts.first().is_some_and(|first| *first != "..");
            is_below.then(|| (image.name.to_string(), folder.join(parts.join("/"))))
        };
        foreign.model.images.iter().filter_map(mask).collect()
    }

    fn completed_colmap<'a>(
        &self,
        files: &'a ColmapFiles,
    ) -> Result<ColmapModel<'a>, ProjectError> {
        let mut model = files.model()?;
        self.name_images(&mut model)?;
        complete::completed(model, &self.model, complete::cloud_beside(&self.model))
    }

    fn name_images(&self, model: &mut ColmapModel) -> Result<(), ProjectError> {
        if let Some(names) = names::with_one_file(model, self.images.as_deref()) {
            return Err(ProjectError::OneFile {
                path: self.model.path.clone(),
                names,
            });
        }
        match &self.images {
            Some(images) => images.name_images(model),
            None => drop(names::take_names_of_files(model, None)),
        }
        Ok(())
    }

    /// Returns the names in the model of the dense workspace, which lists for COLMAP name, of those
    /// images that have others here, by these.
    pub fn names_in_workspace(&self) -> HashMap<String, String> {
        let Some(workspace) = &self.dense_workspace else {
            return HashMap::new();
        };
        let there = discover::names_in_workspace(workspace);
        let mut here = there.clone();
        let own = self.images.as_deref().filter(|_| *workspace == self.root);
        let images = own.map_or_else(|| workspace.join("images"), Path::to_path_buf);
        names::to_names_of_files(&mut here, Some(&images));
        let others = here.into_iter().zip(there);
        others.filter(|(here, there)| here != there).collect()
    }

    /// Checks the image files of the scene; finds no faults without an image folder.
    pub fn image_faults(&self, scene: &Scene) -> ImageFaults {
        let views: Vec<ViewIndex> = scene.view_indices().collect();
        self.image_faults_of(&views, scene)
    }

    /// Checks the image files of these views alone, each of which is opened.
    pub fn image_faults_of(&self, views: &[ViewIndex], scene: &Scene) -> ImageFaults {
        let find = |folder| ImageFaults::find(folder, scene, views);
        self.images.as_ref().map(find).unwrap_or_default()
    }

    /// Returns whether the image folder, if there is one, has no image of the scene.
    pub fn has_only_other_images(&self, scene: &Scene) -> bool {
        let has_image = |folder: &ImageFolder| {
            scene
                .view_indices()
                .any(|view| folder.file(scene.name(view)).is_file())
        };
        self.images
            .as_ref()
            .is_some_and(|folder| !has_image(folder))
    }

    /// Returns the folders of masks, the first of which counts if several have one for an image.
    pub fn mask_folders(&self) -> Vec<PathBuf> {
        let place = |folder: &Path| folder.canonicalize().unwrap_or_else(|_| folder.into());
        // The folder above the project may belong to others.
        let images = self
            .images
            .as_deref()
            .filter(|images| place(images) != place(&self.root));
        let above = [Some(&*self.root), images.and_then(Path::parent), images]
            .into_iter()
            .flatten();
        // By links, two of them may be one folder.
        let mut places = HashSet::new();
        above
            .map(|folder| folder.join(MASKS))
            .filter(|folder| folder.is_dir() && places.insert(place(folder)))
            .collect()
    }

    /// Reads the files of a COLMAP model unchanged, to write a part of the model.
    pub fn colmap_files(&self) -> Result<ColmapFiles, ProjectError> {
        ColmapFiles::open(&self.model)
    }

    /// Returns whether the folder of a binary COLMAP model also has a text model with other images
    /// or poses, or one that cannot be read.
    pub fn has_other_text_model(&self, scene: &Scene) -> bool {
        // COLMAP reads the binary model of such a folder, OpenMVS's importer the text.
        let text = Self {
            model: ModelLocation {
                format: ModelFormat::ColmapText,
                ..self.model.clone()
            },
            ..self.clone()
        };
        if self.model.format != ModelFormat::ColmapBinary
            || !self.model.path.join("images.txt").is_file()
        {
            return false;
        }
        text.scene_of_files()
            .map_or(true, |text| !text.has_same_views(scene))
    }

    /// Calls `use_model` with the COLMAP model in the project's files, or with one made from the
    /// scene for other formats.
    pub fn with_colmap_model<T>(
        &self,
        scene: &Scene,
        use_model: impl FnOnce(&ColmapModel) -> T,
    ) -> Result<T, ProjectError> {
        Ok(match self.model.format {
            ModelFormat::ColmapBinary | ModelFormat::ColmapText => {
                use_model(&self.completed_colmap(&self.colmap_files()?)?)
            }
            _ => use_model(&ColmapModel::from_scene(scene)),
        })
    }

    /// All files of the model, in a fixed order.
    pub fn model_files(&self) -> Vec<PathBuf> {
        model_files(&self.root, &self.model)
    }

    /// Returns an error if the model's files have changed since the project was opened: what is
    /// known of them is out of date.
    pub fn refuse_changed_model(&self) -> Result<(), ProjectError> {
        if stamps(&self.root, &self.model) == self.model_stamps {
            Ok(())
        } else {
            Err(ProjectError::ModelChanged(self.model.path.clone()))
        }
    }

    /// Other models at least half of whose images are in the scene: copies of the model, possibly
    /// in other coordinates.
    pub fn copies(&self, scene: &Scene) -> Vec<&ModelLocation> {
        // Programs differ in the folders that they put before all names.
        let mut views_by_end: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
        for view in &scene.views {
            for end in ends_of(&view.name).skip(1) {
                views_by_end.entry(end).or_default().push(&view.name);
            }
        }
        let is_copy = |model: &&ModelLocation| {
            let poses = discover::poses(&self.root, model).unwrap_or_default();
            let names: Vec<&String> = poses.keys().collect();
            // Only images that differ by the same folders count together: names such as
            // DJI_0001.JPG are in every flight.
            let mut shared: BTreeMap<(bool, &str), usize> = BTreeMap::new();
            for name in &names {
                let ends = ends_of(name).filter(|end| scene.find(end).is_some());
                let before = ends.map(|end| (true, &name[..name.len() - end.len()]));
                let longer = views_by_end.get(&***name).into_iter().flatten();
                let beyond = longer.map(|view| (false, &view[..view.len() - name.len()]));
                before
                    .chain(beyond)
                    .for_each(|folders| *shared.entry(folders).or_default() += 1);
            }
            let shared = shared.into_values().max().unwrap_or(0);
            shared > 0 && 2 * shared >= names.len()
        };
        self.other_models.iter().filter(is_copy).collect()
    }

    /// Names a dense workspace that is not used: one that was made from another model, or the
    /// others beside the one that is. Not where nothing is written into the project anyway.
    fn other_workspace_warning(&self) -> Option<ModelWarning> {
        if self.is_elsewhere() || self.dense_workspace.as_ref() == Some(&self.root) {
            return None;
        }
        let there = discover::dense_folders(&self.root, &self.model);
        let Some(used) = &self.dense_workspace else {
            let other = there.first()?;
            let why = discover::why_other(&self.root, &self.model, other);
            let text = format!("{} {why}; viewrank writes nothing into it", other.display());
            return Some(ModelWarning::new(WarningKind::OtherWorkspace, text));
        };
        let cure = "no action needed; to use another one, name its folder as the project";
        let text = passed_over(used, &there)?;
        Some(ModelWarning::new(WarningKind::Format, text).with_cure(cure))
    }

    /// Names the other folders that the images of the model may be in.
    fn rivals_warning(&self) -> Option<ModelWarning> {
        let images = self
            .images
            .as_ref()
            .filter(|images| !images.rivals.is_empty())?;
        let rivals = images.rivals.iter().take(NAMED);
        let rivals: Vec<String> = rivals.map(|rival| shown_path(rival)).collect();
        let text = format!(
            "of several folders whose images have the names of the model {} is taken, not {}",
            shown_path(images),
            rivals.join(" or ")
        );
        let cure = Advice::text("no action needed; ")
            .set("images")
            .and(" names another");
        Some(ModelWarning::new(WarningKind::Format, text).with_cure(cure))
    }

    /// Names the other dense workspaces beside the one that is used.
    pub fn other_workspaces(&self) -> Option<String> {
        let used = self.dense_workspace.as_ref()?;
        passed_over(used, &discover::dense_folders(&self.root, &self.model))
    }

    /// Names the model that is used, and the others.
    fn sub_model_warning(&self, registered: usize) -> Option<ModelWarning> {
        let words = |model: &ModelLocation| {
            let path = self.path_of(model);
            match model.registered {
                0 => path,
                registered => format!("{path} ({registered} images)"),
            }
        };
        let first = self.other_models.iter().take(NAMED);
        let mut others: Vec<String> = first.map(words).collect();
        let more = self.other_models.len().saturating_sub(NAMED);
        others.extend((more > 0).then(|| format!("{more} more")));
        (!others.is_empty() && !self.model_is_named).then(|| {
            let (used, others) = (self.model_path(), others.join(" or "));
            // A folder holds one plan. That of a model in `sparse` has the images of the project.
            let sparse = self.root.join("sparse");
            let mut others_there = self.other_models.iter();
            let next = others_there.find(|model| model.path.parent() == Some(&sparse));
            // What poses another program has is not known yet.
            let is_read = |model: &ModelLocation| model.registered > 0;
            let cure = match next {
                Some(next) => Some(
                    Advice::text("plan another by itself: ")
                        .run(format!("plan {}", command_path(&next.path))),
                ),
                None if self.other_models.iter().any(is_read) => {
                    Some(Advice::default().set("model").and(" names another"))
                }
                None => None,
            };
            let text = format!("the model is {used} ({registered} images), not {others}");
            let warning = ModelWarning::new(WarningKind::OtherModels, text);
            ModelWarning { cure, ..warning }
        })
    }
}

/// Returns whether a workspace has a model that viewrank did not write, whose images and depth maps
/// would be mixed with ours.
pub fn has_model_of_others(workspace: &Path) -> bool {
    workspace.join("sparse").is_dir() && output::recorded(workspace, UNDISTORTED_SET).is_empty()
}

fn passed_over(used: &Path, there: &[PathBuf]) -> Option<String> {
    let others = there.iter().filter(|other| *other != used).take(NAMED);
    let others: Vec<String> = others.map(|other| other.display().to_string()).collect();
    (!others.is_empty()).then(|| {
        format!(
            "of the workspaces of undistorted images {} is used, not {}",
            used.display(),
            others.join(" or ")
        )
    })
}

/// A name, and what follows each of its folders.
fn ends_of(name: &str) -> impl Iterator<Item = &str> {
    let inner = name.match_indices('/').map(|(at, _)| &name[at + 1..]);
    std::iter::once(name).chain(inner)
}

/// Models that a warning names.
const NAMED: usize = 5;

fn model_files(root: &Path, model: &ModelLocation) -> Vec<PathBuf> {
    let mut files = if model.format.is_colmap() {
        files::all(model)
    } else {
        foreign::files(root, model)
    };
    let lists = test_lists::test_lists(root, model).into_iter();
    files.extend(lists.filter(|list| list.is_file()));
    files
}

fn stamps(root: &Path, model: &ModelLocation) -> Vec<FileStamp> {
    let stamp = |path: PathBuf| {
        let found = path.metadata().ok()?;
        Some((found.len(), found.modified().ok()))
    };
    model_files(root, model).into_iter().map(stamp).collect()
}
