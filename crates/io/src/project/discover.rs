//! Finds the models of a project folder, chooses one, and finds its images and dense workspace.

use std::{
    cmp::Reverse,
    collections::{BTreeSet, HashSet},
    fs,
    io::Read,
    path::{Path, PathBuf},
};

use super::{
    ModelFormat, ModelLocation, Project, ProjectError, ProjectKind,
    files::{self, REQUIRED, colmap_file, read},
    folder, foreign, images, stamps,
};
use crate::{formats::colmap_text, input};

pub(super) fn open(path: &Path, wanted: Option<&str>) -> Result<Project, ProjectError> {
    let parent = path
        .parent()
        .filter(|parent| !parent.as_os_str().is_empty())
        .unwrap_or(Path::new("."));
    let root = if path.is_file() { parent } else { path };
    if !root.is_dir() {
        return Err(ProjectError::NotFound(path.into()));
    }
    let named = path.is_file().then(|| foreign::model_file(path)).flatten();
    let colmap = match named {
        Some(_) => Ok(Vec::new()),
        // Only what is beside a file is meant by it.
        None if path.is_file() => colmap_models_here(root),
        None => colmap_models(root),
    };
    let found = match colmap {
        Ok(models) if models.is_empty() => match named {
            Some(model) => vec![model],
            None => foreign_or_dense(root)?,
        },
        // An incomplete COLMAP model doesn't prevent using another program's model.
        Err(error) => foreign_or_dense(root)
            .ok()
            .filter(|models| !models.is_empty())
            .ok_or(error)?,
        Ok(models) => models,
    };
    let (model, other_models) = choose(path, found, wanted)?;
    let model_stamps = stamps(root, &model);
    let dense_workspace = dense_workspace(root, &model);
    let kind = match model.format {
        ModelFormat::OpenMvs => ProjectKind::OpenMvs,
        ModelFormat::Sure => ProjectKind::Sure,
        _ if dense_workspace.as_deref() == Some(root) => ProjectKind::ColmapDense,
        ModelFormat::ColmapBinary | ModelFormat::ColmapText if model.path != root => {
            ProjectKind::Colmap
        }
        _ => ProjectKind::BareModel,
    };
    let images = match model.format {
        ModelFormat::ColmapBinary | ModelFormat::ColmapText => {
            folder::find(root, &model.path, None, &files::first_names(&model))
        }
        _ => foreign::read(root, &model)
            .ok()
            .and_then(|read| images::find_by_names(root, &model.path, &read)),
    };
    let model_is_named = wanted.is_some();
    Ok(Project {
        root: root.into(),
        home: root.into(),
        kind,
        model,
        model_is_named,
        other_models,
        images,
        dense_workspace,
        model_stamps,
    })
}

/// Finds the COLMAP models in a folder, in `sparse` and in the sub-folders of `sparse`; if there
/// are none, in the folder's own sub-folders.
fn colmap_models(root: &Path) -> Result<Vec<ModelLocation>, ProjectError> {
    match (
        colmap_models_here(root),
        colmap_models_among(&sub_folders(root)),
    ) {
        (Ok(models), second) if models.is_empty() => second,
        (Err(error), Ok(models)) if models.is_empty() => Err(error),
        (Err(_), Ok(models)) => Ok(models),
        (first, _) => first,
    }
}

fn colmap_models_here(root: &Path) -> Result<Vec<ModelLocation>, ProjectError> {
    colmap_models_among(&[vec![root.into()], with_sub_folders(&root.join("sparse"))].concat())
}

/// Finds the models of other programs; if there are none, those of the dense workspace (which is
/// made from another model).
fn foreign_or_dense(root: &Path) -> Result<Vec<ModelLocation>, ProjectError> {
    let models = foreign::models(root);
    if models.is_empty() {
        colmap_models_among(&with_sub_folders(&root.join("dense/sparse")))
    } else {
        Ok(models)
    }
}

/// Finds the COLMAP models among `folders`. An incomplete model is an error only if no other is
/// complete.
fn colmap_models_among(folders: &[PathBuf]) -> Result<Vec<ModelLocation>, ProjectError> {
    let (mut models, mut incomplete) = (Vec::new(), None);
    for folder in folders {
        match colmap_model(folder) {
            Ok(model) => models.extend(model),
            Err(error) => _ = incomplete.get_or_insert(error),
        }
    }
    incomplete
        .filter(|_| models.is_empty())
        .map_or(Ok(models), Err)
}

fn with_sub_folders(folder: &Path) -> Vec<PathBuf> {
    [vec![folder.into()], sub_folders(folder)].concat()
}

fn sub_folders(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder)
        .into_iter()
        .flatten()
        .filter_map(Result::ok);
    let mut folders: Vec<_> = entries
        .map(|entry| entry.path())
        .filter(|path| path.is_dir())
        .collect();
    folders.sort();
    folders
}

/// Finds the model of a folder; prefers binary to text, like COLMAP.
fn colmap_model(folder: &Path) -> Result<Option<ModelLocation>, ProjectError> {
    let mut incomplete = None;
    for format in [ModelFormat::ColmapBinary, ModelFormat::ColmapText] {
        let missing: Vec<PathBuf> = REQUIRED
            .map(|stem| colmap_file(folder, stem, format))
            .into_iter()
            .filter(|path| !path.is_file())
            .collect();
        if missing.is_empty() {
            let registered = registered(&colmap_file(folder, "images", format), format);
            return Ok(Some(ModelLocation {
                format,
                path: folder.into(),
                registered,
            }));
        }
        if missing.len() < REQUIRED.len() {
            incomplete.get_or_insert(missing);
        }
    }
    match incomplete {
        None => Ok(None),
        Some(missing) => {
            let names: Vec<_> = missing
                .iter()
                .filter_map(|path| path.file_name())
                .map(|n| n.to_string_lossy())
                .collect();
            Err(ProjectError::IncompleteModel {
                folder: folder.into(),
                missing: names.join(", "),
            })
        }
    }
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
    mut models: Vec<ModelLocation>,
    wanted: Option<&str>,
) -> Result<(ModelLocation, Vec<ModelLocation>), ProjectError> {
    models.sort_by_cached_key(order);
    let position = match wanted {
        None => 0,
        Some(wanted) => models
            .iter()
            .position(|model| model.name() == wanted)
            .unwrap_or(models.len()),
    };
    if models.is_empty() {
        let root = if path.is_file() {
            path.parent().unwrap_or(Path::new("."))
        } else {
            path
        };
        if let Some(error) = foreign::in_binary(root) {
            return Err(error);
        }
        let colmap = "cameras, images and points3D (.bin or .txt) here, in sparse, sparse/*, */ and dense/sparse";
        let looked_for = format!("{colmap}; {}", foreign::SEARCHED_PATHS);
        return Err(ProjectError::NoModel {
            path: path.into(),
            looked_for,
        });
    }
    if position == models.len() {
        let present = models
            .iter()
            .map(ModelLocation::name)
            .collect::<Vec<_>>()
            .join(", ");
        let wanted = wanted.unwrap_or_default().into();
        return Err(ProjectError::NoSuchModel {
            path: path.into(),
            wanted,
            present,
        });
    }
    let model = models.remove(position);
    Ok((model, models))
}

/// Sort key: most registered images first, then by name.
fn order(model: &ModelLocation) -> (Reverse<u64>, (u64, String)) {
    (Reverse(model.registered), by_number(&model.name()))
}

/// Returns whether this is the model that is used by default.
pub(super) fn is_first(model: &ModelLocation, others: &[ModelLocation]) -> bool {
    others.iter().all(|other| order(model) <= order(other))
}

/// Sort key: 2 before 10, numbers before words.
fn by_number(name: &str) -> (u64, String) {
    (name.parse().unwrap_or(u64::MAX), name.into())
}

/// Finds the dense workspace of the model: the project folder itself, or the first one below
/// `dense` that has all its images.
fn dense_workspace(root: &Path, model: &ModelLocation) -> Option<PathBuf> {
    if root.join("stereo").is_dir() {
        return Some(root.into());
    }
    let workspaces = dense_folders(root, model);
    let names = if workspaces.is_empty() {
        None
    } else {
        image_names(root, model)
    }?;
    let has_the_images = |folder: &PathBuf| {
        let there = colmap_model(&folder.join("sparse")).ok().flatten();
        there
            .and_then(|dense| image_names(root, &dense))
            .is_some_and(|there| names.is_subset(&there))
    };
    workspaces.into_iter().find(has_the_images)
}

/// Dense workspaces below `dense` (folders with `stereo`), the one with the model's name first.
pub(super) fn dense_folders(root: &Path, model: &ModelLocation) -> Vec<PathBuf> {
    let dense = root.join("dense");
    let mut folders = [
        vec![dense.join(model.name()), dense.clone()],
        sub_folders(&dense),
    ]
    .concat();
    let mut known = HashSet::new();
    folders.retain(|folder| folder.join("stereo").is_dir() && known.insert(folder.clone()));
    folders
}

/// Names of the registered images; `None` if the model cannot be read.
pub(super) fn image_names(root: &Path, model: &ModelLocation) -> Option<BTreeSet<String>> {
    match model.format.is_colmap() {
        true => files::image_names(model),
        false => {
            let images = foreign::read(root, model).ok()?.model.images;
            Some(
                images
                    .into_iter()
                    .map(|image| image.name.into_owned())
                    .collect(),
            )
        }
    }
}
