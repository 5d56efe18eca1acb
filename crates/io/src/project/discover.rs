//! Finds the models of a project folder, chooses one, and finds its images and dense workspace.

use std::{
    cmp::Reverse,
    collections::{BTreeMap, BTreeSet, HashSet},
    fs,
    io::Read,
    path::{Path, PathBuf},
};

use super::{
    ImageFolder, ModelContents, ModelFormat, ModelLocation, Project, ProjectError, ProjectKind,
    complete::cloud_beside,
    files::{self, REQUIRED, colmap_file, read},
    folder, foreign,
    image_files::slashes,
    images,
    names::plain_or_own,
    originals, stamps,
};
use crate::{
    formats::{
        colmap::{ColmapImage, StoredPose},
        colmap_text,
    },
    input,
    mistaken::{self, Mistaken},
    paths::sub_folders,
};

pub(super) fn open(path: &Path, wanted: Option<&str>) -> Result<Project, ProjectError> {
    // The parent of a bare file name is empty, and no folder has that path.
    let parent = path
        .parent()
        .filter(|parent| !parent.as_os_str().is_empty())
        .unwrap_or(Path::new("."));
    let root = if path.is_file() { parent } else { path };
    if !root.is_dir() {
        return Err(ProjectError::NotFound(path.into()));
    }
    let (model, other_models) = choose(path, root, models_of(path, root)?, wanted)?;
    let dense_workspace = dense_workspace(root, &model);
    let (images, originals) = match image_folder(root, &model) {
        Some(images) => originals::told_apart(root, &model, images),
        None => (None, None),
    };
    Ok(Project {
        root: root.into(),
        home: root.into(),
        named: root.into(),
        kind: kind_of(root, &model, dense_workspace.as_deref()),
        images,
        originals,
        model_is_named: wanted.is_some(),
        model_stamps: stamps(root, &model),
        model,
        other_models,
        dense_workspace,
    })
}

/// The models that a path stands for: that of a file, those beside a file, those of a folder.
fn models_of(path: &Path, root: &Path) -> Result<Vec<ModelLocation>, ProjectError> {
    if !path.is_file() {
        return models(root);
    }
    if let Some(model) = foreign::model_file(path) {
        return Ok(vec![foreign::examined(root, model)]);
    }
    // Only what is beside a file is meant by it.
    let here = [root.to_path_buf()];
    models_in(root, &here, &here).into_models()
}

fn kind_of(root: &Path, model: &ModelLocation, dense_workspace: Option<&Path>) -> ProjectKind {
    match model.format {
        ModelFormat::OpenMvs => ProjectKind::OpenMvs,
        ModelFormat::Sure => ProjectKind::Sure,
        _ if dense_workspace == Some(root) => ProjectKind::ColmapDense,
        ModelFormat::ColmapBinary | ModelFormat::ColmapText if model.path != root => {
            ProjectKind::Colmap
        }
        _ => ProjectKind::BareModel,
    }
}

fn image_folder(root: &Path, model: &ModelLocation) -> Option<ImageFolder> {
    if model.format.is_colmap() {
        return folder::find(root, &model.path, None, &files::sought_images(model));
    }
    // It cannot be read, which reading the scene says, or has no names.
    if model.registered == 0 {
        return None;
    }
    let (read, _) = foreign::read(root, model).ok()?;
    images::find_by_names(root, &model.path, &read)
}

/// The models found in some folders, and the first incomplete one, which is an error only if no
/// other is complete anywhere.
#[derive(Default)]
struct Found {
    models: Vec<ModelLocation>,
    incomplete: Option<ProjectError>,
}

impl Found {
    fn into_models(self) -> Result<Vec<ModelLocation>, ProjectError> {
        match self.incomplete {
            Some(error) if self.models.is_empty() => Err(error),
            _ => Ok(self.models),
        }
    }

    fn extend(&mut self, there: Self) {
        self.models.extend(there.models);
        self.incomplete = self.incomplete.take().or(there.incomplete);
    }

    /// These models, or those of the next places if there are none.
    fn or(self, next: impl FnOnce() -> Result<Self, ProjectError>) -> Result<Self, ProjectError> {
        if !self.models.is_empty() {
            return Ok(self);
        }
        let next = next()?;
        Ok(Self {
            models: next.models,
            incomplete: self.incomplete.or(next.incomplete),
        })
    }
}

/// Finds the models of a project: in the places where programs keep them; if there are none, in the
/// folders below; if there are none, in dense workspaces, whose model is made from another one.
fn models(root: &Path) -> Result<Vec<ModelLocation>, ProjectError> {
    let own = FOLDERS_OF_PROGRAMS.iter();
    let own = own.flat_map(|folder| with_sparse(&root.join(folder)));
    let of_instant_ngp = with_sub_folders(&root.join(COLMAP_SPARSE));
    let own: Vec<PathBuf> = own.chain(of_instant_ngp).collect();
    let found = models_in(root, &own, &folders_of_other_programs(root))
        .or(|| Ok(models_in(root, &sub_folders(root), &[])))?
        .or(|| models_below(root))?;
    // The model of a workspace must not hide that the one it was made from is incomplete.
    if found.incomplete.is_some() {
        return found.into_models();
    }
    let dense = || {
        let workspaces = with_sub_folders(&root.join(DENSE));
        let folders: Vec<PathBuf> = workspaces.iter().flat_map(|w| with_sparse(w)).collect();
        Ok(models_in(root, &folders, &[]))
    };
    found.or(dense)?.into_models()
}

/// Folders of a project that programs name: COLMAP's own is the project, nerfstudio has a `colmap`,
/// the scripts of 3D Gaussian Splatting have a `distorted`, that of instant-ngp a `colmap_text`.
pub const FOLDERS_OF_PROGRAMS: [&str; 4] = ["", "colmap", "distorted", "colmap_text"];
/// The script of instant-ngp has this for COLMAP's `sparse`.
const COLMAP_SPARSE: &str = "colmap_sparse";
/// Folders of Meshroom's nodes that have models, each in a folder named by a hash.
const NODES_OF_MESHROOM: [&str; 2] = ["StructureFromMotion", "ConvertSfMFormat"];
/// Folder of the dense workspaces of a project.
const DENSE: &str = "dense";
/// Usual names of dense workspaces, and of the folders of several.
pub const WORKSPACES: [&str; 2] = [DENSE, "undistorted"];
/// Most folders that are searched for models.
const MOST_FOLDERS: usize = 1000;

/// The project, and the folders of Meshroom's nodes in it.
fn folders_of_other_programs(root: &Path) -> Vec<PathBuf> {
    let caches = [root.join("MeshroomCache"), root.to_path_buf()];
    let nodes = caches
        .iter()
        .flat_map(|cache| NODES_OF_MESHROOM.map(|node| cache.join(node)));
    [root.to_path_buf()]
        .into_iter()
        .chain(nodes.flat_map(|node| sub_folders(&node)))
        .take(MOST_FOLDERS)
        .collect()
}

/// The models of programs other than COLMAP that [`Project::open`] finds in a folder itself, by
/// their names and first bytes. A `*.out` is one only if it says so: programs and queues give their
/// logs this ending.
pub fn models_of_other_programs(root: &Path) -> Vec<PathBuf> {
    let folders = folders_of_other_programs(root).into_iter();
    let models = folders.flat_map(|folder| foreign::listed(&folder));
    models
        .filter(|model| model.format != ModelFormat::Bundler || foreign::is_bundle(&model.path))
        .map(|model| model.path)
        .collect()
}

/// Finds the models further below a project, two folders deep, in the only folder that has any.
fn models_below(root: &Path) -> Result<Found, ProjectError> {
    let (mut below, mut found) = (Vec::new(), Found::default());
    let mut left = MOST_FOLDERS;
    let children = sub_folders(root).into_iter();
    for child in children.filter(|folder| is_searched(folder)) {
        if left == 0 {
            break;
        }
        let mut folders = with_sub_folders(&child);
        folders.truncate(left);
        left -= folders.len();
        // Workspaces are made from another model, here as in the project itself.
        let (dense, own): (Vec<_>, Vec<_>) = folders
            .into_iter()
            .partition(|folder| folder.ends_with(DENSE));
        let find = |folders: &[PathBuf]| {
            let of_colmap: Vec<PathBuf> = folders.iter().flat_map(|f| with_sparse(f)).collect();
            models_in(root, &of_colmap, folders)
        };
        let there = find(&own).or(|| Ok(find(&dense)))?;
        if !there.models.is_empty() {
            below.push(child);
        }
        found.extend(there);
    }
    match below.len() {
        0 | 1 => Ok(found),
        _ => Err(ProjectError::SeveralProjects {
            path: root.into(),
            below,
        }),
    }
}

/// Returns whether a folder below a project may hold its model: no hidden one, no results.
fn is_searched(folder: &Path) -> bool {
    let name = folder.file_name().unwrap_or_default().to_string_lossy();
    !name.starts_with('.') && !["viewrank", DENSE].contains(&&*name)
}

/// Finds the models of COLMAP in some folders, and those of other programs in some. The latter are
/// read only if none of COLMAP's has tracks, for they come after it.
fn models_in(root: &Path, of_colmap: &[PathBuf], of_others: &[PathBuf]) -> Found {
    let mut found = Found::default();
    let mut known = HashSet::new();
    for folder in of_colmap.iter().filter(|folder| known.insert(*folder)) {
        match colmap_model(folder) {
            Ok(model) => found.models.extend(model),
            Err(error) => _ = found.incomplete.get_or_insert(error),
        }
    }
    let richest = found.models.iter().map(|model| model.contents).max();
    let are_read = richest < Some(ModelContents::Tracks);
    let others = of_others.iter().flat_map(|folder| foreign::listed(folder));
    found.models.extend(others.map(|model| {
        if are_read {
            foreign::examined(root, model)
        } else {
            model
        }
    }));
    found
}

/// The folder, its `sparse`, and the folders in that.
pub(super) fn with_sparse(folder: &Path) -> Vec<PathBuf> {
    [
        vec![folder.into()],
        with_sub_folders(&folder.join("sparse")),
    ]
    .concat()
}

fn with_sub_folders(folder: &Path) -> Vec<PathBuf> {
    [vec![folder.into()], sub_folders(folder)].concat()
}

/// The wanted folders in a folder, and those in them.
fn two_folders_below(root: &Path, is_wanted: impl Fn(&Path) -> bool) -> Vec<PathBuf> {
    let wanted = sub_folders(root).into_iter();
    let wanted = wanted.filter(|folder| is_wanted(folder));
    let below = wanted.flat_map(|folder| with_sub_folders(&folder));
    below.take(MOST_FOLDERS).collect()
}

/// Finds the model of a folder; prefers binary to text, like COLMAP. The points may be in a PLY
/// file instead.
fn colmap_model(folder: &Path) -> Result<Option<ModelLocation>, ProjectError> {
    let mut incomplete = None;
    for format in [ModelFormat::ColmapBinary, ModelFormat::ColmapText] {
        let model = ModelLocation::new(format, folder);
        let missing: Vec<&str> = REQUIRED
            .into_iter()
            .filter(|stem| !colmap_file(folder, stem, format).is_file())
            .collect();
        if missing.is_empty() || missing == ["points3D"] && cloud_beside(&model).is_some() {
            return Ok(Some(ModelLocation {
                registered: registered(&colmap_file(folder, "images", format), format),
                contents: files::contents(&model),
                ..model
            }));
        }
        if missing.len() < REQUIRED.len() {
            incomplete.get_or_insert((missing, format));
        } else if let Some(link) = link_to_nothing(folder, format) {
            return Err(link);
        }
    }
    // A missing file may be there in compressed form.
    if incomplete.is_some()
        && let Some(error) = foreign::packed(folder, foreign::is_of_colmap)
    {
        return Err(error);
    }
    // Other programs have lists of cameras of the same name, which alone are no model.
    let incomplete = incomplete.filter(|(missing, format)| {
        *format == ModelFormat::ColmapBinary
            || missing[..] != REQUIRED[1..]
            || files::are_cameras(&colmap_file(folder, REQUIRED[0], *format))
    });
    match incomplete {
        None => Ok(None),
        Some((missing, format)) => Err(ProjectError::IncompleteModel {
            folder: folder.into(),
            missing: file_names(&missing, format),
        }),
    }
}

/// Returns the error of a file of a model that is a link to none, as git-annex leaves it.
fn link_to_nothing(folder: &Path, format: ModelFormat) -> Option<ProjectError> {
    let mut files = REQUIRED
        .map(|stem| colmap_file(folder, stem, format))
        .into_iter();
    let path = files.find(|file| file.is_symlink() && !file.exists())?;
    let mistaken = Mistaken {
        what: "a link to a file that is not there",
        cure: "fetch the file (git annex get), or copy it here",
    };
    Some(ProjectError::Mistaken { path, mistaken })
}

/// The names of files of COLMAP models, for an error.
fn file_names(stems: &[&str], format: ModelFormat) -> String {
    let names = stems.iter().filter_map(|stem| {
        let path = colmap_file(Path::new(""), stem, format);
        Some(path.file_name()?.to_string_lossy().into_owned())
    });
    names.collect::<Vec<_>>().join(", ")
}

/// Number of registered images, without reading the model; 0 if that fails (reading the model
/// reports why).
fn registered(images: &Path, format: ModelFormat) -> u64 {
    if format == ModelFormat::ColmapText {
        return read(images).map_or(0, |bytes| colmap_text::count_images(&bytes));
    }
    let mut head = [0; 8];
    let file =
        input::open(images).and_then(|mut file| file.read_exact(&mut head).and(file.metadata()));
    // A count too large for the file is damaged, and must not win the choice. A record has at least
    // 73 bytes.
    let possible = |metadata: fs::Metadata| {
        Some(u64::from_le_bytes(head)).filter(|n| *n <= metadata.len() / 73)
    };
    file.ok().and_then(possible).unwrap_or(0)
}

/// Chooses a model; returns it and the others.
fn choose(
    path: &Path,
    root: &Path,
    mut models: Vec<ModelLocation>,
    wanted: Option<&str>,
) -> Result<(ModelLocation, Vec<ModelLocation>), ProjectError> {
    // Folders may be looked at for more than one program.
    let mut seen = BTreeSet::new();
    models.retain(|model| seen.insert(model.path.clone()));
    // Before the sort, whose ties go by name.
    name_apart(&mut models, root);
    models.sort_by_cached_key(order);
    check_any(path, root, &models)?;
    let position = match wanted {
        None => 0,
        Some(wanted) => {
            position_of(wanted, root, &models).ok_or_else(|| ProjectError::NoSuchModel {
                path: path.into(),
                wanted: wanted.into(),
                present: names(&models).join(", "),
            })?
        }
    };
    // A model that the user named is taken whatever the others are.
    if wanted.is_none() {
        refuse_pointers(&models)?;
    }
    let model = models.remove(position);
    // Beside COLMAP's models with tracks, others have not been read yet.
    let is_unread = !model.format.is_colmap() && models.iter().any(|m| m.format.is_colmap());
    let model = match model.registered {
        0 if is_unread => foreign::examined(root, model),
        _ => model,
    };
    Ok((model, models))
}

/// Checks that there is a model; where none has images, files that are other models or other things
/// are named.
fn check_any(path: &Path, root: &Path, models: &[ModelLocation]) -> Result<(), ProjectError> {
    // A list of images without poses is none (OpenMVG's `matches/sfm_data.json`).
    if models.iter().all(|model| model.registered == 0) {
        let binary = || {
            let below = two_folders_below(root, |_| true);
            let folders = [folders_of_other_programs(root), below].concat();
            folders.iter().find_map(|folder| {
                let packed = || foreign::packed(folder, foreign::is_of_model);
                foreign::in_binary(folder).or_else(packed)
            })
        };
        if let Some(error) = foreign::mistaken(root).or_else(binary) {
            return Err(error);
        }
    }
    if !models.is_empty() {
        return Ok(());
    }
    let below = two_folders_below(root, is_searched);
    if let Some(error) = foreign::of_other_program(path, root, &below) {
        return Err(error);
    }
    let colmap = "cameras, images and points3D (.bin or .txt) here, in sparse, colmap and distorted, and two folders below";
    let looked_for = format!("{colmap}; {}", foreign::SEARCHED_PATHS);
    Err(ProjectError::NoModel {
        path: path.into(),
        looked_for,
    })
}

/// Fails where a model that would be passed over is only a pointer to it: it may be the larger one.
fn refuse_pointers(models: &[ModelLocation]) -> Result<(), ProjectError> {
    let Some((used, others)) = models.split_first() else {
        return Ok(());
    };
    // Beside COLMAP's with tracks, those of other programs are never taken.
    let colmap_alone = used.format.is_colmap() && used.contents == ModelContents::Tracks;
    let others = others
        .iter()
        .filter(|model| model.format.is_colmap() || !colmap_alone);
    let files = others.flat_map(|model| {
        if model.format.is_colmap() {
            REQUIRED
                .map(|stem| colmap_file(&model.path, stem, model.format))
                .to_vec()
        } else {
            vec![model.path.clone()]
        }
    });
    let pointer = |path: PathBuf| Some((mistaken::pointer(&path)?, path));
    match files.into_iter().find_map(pointer) {
        None => Ok(()),
        Some((mistaken, path)) => Err(ProjectError::NotFetched {
            path,
            mistaken,
            used: used.name.clone(),
        }),
    }
}

/// Position of the model that is meant by its path, else by its name, else by the end of its path.
fn position_of(wanted: &str, root: &Path, models: &[ModelLocation]) -> Option<usize> {
    let position = |is_meant: &dyn Fn(&ModelLocation) -> bool| models.iter().position(is_meant);
    position(&|model| model.path == root.join(wanted))
        .or_else(|| position(&|model| model.name == wanted))
        .or_else(|| position(&|model| !wanted.is_empty() && model.path.ends_with(wanted)))
}

fn names(models: &[ModelLocation]) -> Vec<String> {
    models.iter().map(|model| model.name.clone()).collect()
}

/// Adds to the names that several models have the folders above them.
fn name_apart(models: &mut [ModelLocation], root: &Path) {
    let names = names(models);
    for model in models {
        if names.iter().filter(|name| **name == model.name).count() > 1
            && let Ok(path) = model.path.strip_prefix(root)
            && !path.as_os_str().is_empty()
        {
            model.name = slashes(path);
        }
    }
}

/// Sort key: the richest first; COLMAP's before those of other programs; most registered images
/// first; in the folder itself before those below; by name.
type Order = (
    Reverse<ModelContents>,
    bool,
    Reverse<u64>,
    usize,
    (u64, String),
);

fn order(model: &ModelLocation) -> Order {
    (
        Reverse(model.contents),
        !model.format.is_colmap(),
        Reverse(model.registered),
        model.path.components().count(),
        by_number(&model.name),
    )
}

/// Returns whether this is the model that is used by default.
pub(super) fn is_first(model: &ModelLocation, others: &[ModelLocation]) -> bool {
    others.iter().all(|other| order(model) <= order(other))
}

/// Sort key: 2 before 10, numbers before words.
fn by_number(name: &str) -> (u64, String) {
    (name.parse().unwrap_or(u64::MAX), name.into())
}

/// Finds the dense workspace of the model: the project folder itself, or the first one below it
/// that has all its images, in the same poses, preferably one that still has their files.
fn dense_workspace(root: &Path, model: &ModelLocation) -> Option<PathBuf> {
    if root.join("stereo").is_dir() {
        return Some(root.into());
    }
    let workspaces = dense_folders(root, model);
    // The poses of a large model take long to read, for nothing without a workspace.
    let own = if workspaces.is_empty() {
        None
    } else {
        poses(root, model)
    }?;
    let has_the_images = |folder: &PathBuf| {
        let there = poses_of_workspace(root, folder);
        there.is_some_and(|there| are_among(&own, &there))
    };
    let fitting: Vec<PathBuf> = workspaces.into_iter().filter(has_the_images).collect();
    match &fitting[..] {
        // Listing the files of a large workspace takes long.
        [only] => Some(only.clone()),
        several => {
            let with_files = several.iter().find(|folder| has_pictures(folder));
            with_files.or(several.first()).cloned()
        }
    }
}

/// Returns whether a workspace has its undistorted images.
pub(super) fn has_pictures(workspace: &Path) -> bool {
    let images = ImageFolder::new(workspace.join("images"));
    images.first_image().is_some()
}

fn poses_of_workspace(root: &Path, workspace: &Path) -> Option<Poses> {
    let model = colmap_model(&workspace.join("sparse")).ok().flatten();
    model.and_then(|model| poses(root, &model))
}

/// Says why a dense workspace is not that of the model.
pub(super) fn why_other(root: &Path, model: &ModelLocation, workspace: &Path) -> &'static str {
    let own = poses(root, model).unwrap_or_default();
    match poses_of_workspace(root, workspace) {
        None => "has a model that cannot be read",
        Some(there) if own.keys().any(|name| !there.contains_key(name)) => {
            "lacks images of this model"
        }
        Some(_) => "has the images of this model in other poses",
    }
}

/// Returns whether the images have the same poses in another model.
pub(super) fn are_among(own: &Poses, others: &Poses) -> bool {
    let is_near = |(name, own): (&String, &StoredPose)| {
        let other = others.get(name).and_then(|other| other.pose().ok());
        other
            .zip(own.pose().ok())
            .is_some_and(|(other, own)| own.is_near(&other))
    };
    own.iter().all(is_near)
}

/// Dense workspaces (folders with `stereo`) of their usual names, those with the model's name
/// first.
pub(super) fn dense_folders(root: &Path, model: &ModelLocation) -> Vec<PathBuf> {
    let name = model.path.file_name().unwrap_or_default();
    let of = |folder: PathBuf| {
        let dense = [
            vec![folder.join(name), folder.clone()],
            sub_folders(&folder),
        ];
        dense.concat()
    };
    let homes = [Some(root), home_of(root, model)].into_iter().flatten();
    let usual = homes.flat_map(|home| WORKSPACES.map(|folder| home.join(folder)));
    let mut folders: Vec<PathBuf> = usual.flat_map(of).collect();
    // The project may itself be the folder that holds the model.
    let mut known = HashSet::new();
    folders.retain(|folder| folder.join("stereo").is_dir() && known.insert(folder.clone()));
    folders
}

/// The folder in a project that holds its model: that of its `sparse`, else of its file.
fn home_of<'a>(root: &Path, model: &'a ModelLocation) -> Option<&'a Path> {
    let mut above = model.path.ancestors();
    let sparse = above.find(|folder| folder.ends_with("sparse"));
    let home = sparse.unwrap_or(&model.path).parent()?;
    home.starts_with(root).then_some(home)
}

/// Poses of the registered images, by their plain names: programs differ in how they spell one
/// path.
pub(super) type Poses = BTreeMap<String, StoredPose>;

/// Poses of the registered images; `None` if the model cannot be read.
pub(super) fn poses(root: &Path, model: &ModelLocation) -> Option<Poses> {
    let plain = |(name, pose)| (plain_or_own(name), pose);
    if model.format.is_colmap() {
        return Some(files::poses(model)?.into_iter().map(plain).collect());
    }
    let images = foreign::read(root, model).ok()?.0.model.images;
    let pose = |image: ColmapImage| plain((image.name.into_owned(), image.cam_from_world));
    Some(images.into_iter().map(pose).collect())
}

/// Names of the images in the model of a workspace, as they are there.
pub(super) fn names_in_workspace(workspace: &Path) -> Vec<String> {
    let model = colmap_model(&workspace.join("sparse")).ok().flatten();
    let poses = model.and_then(|model| files::poses(&model));
    poses.unwrap_or_default().into_keys().collect()
}
