//! Finds the models of programs other than COLMAP, and reads them (`read.rs`).

mod read;

use std::{
    io::Read,
    path::{Path, PathBuf},
};

pub(super) use self::read::read;
use self::read::{bundler_list, sure_cloud};
use super::{ModelContents, ModelFormat, ModelLocation, ProjectError, complete::cloud_beside};
use crate::{
    formats::{Place, Problem, cloud},
    input,
    mistaken::{self, Mistaken},
};

/// Model files in a project folder, in order of preference.
const MODEL_PATHS: [(&str, ModelFormat); 13] = [
    ("scene.mvs", ModelFormat::OpenMvs),
    ("sfm_data.json", ModelFormat::OpenMvg),
    ("reconstruction.json", ModelFormat::OpenSfm),
    ("opensfm/reconstruction.json", ModelFormat::OpenSfm),
    ("*.mvs", ModelFormat::OpenMvs),
    ("*.sfm", ModelFormat::AliceVision),
    ("*.nvm", ModelFormat::Nvm),
    ("bundle/bundle.out", ModelFormat::Bundler),
    ("synth_0.out", ModelFormat::Mve),
    ("*bundle.out", ModelFormat::Bundler),
    ("*.out", ModelFormat::Bundler),
    ("transforms.json", ModelFormat::Transforms),
    ("transforms_train.json", ModelFormat::Transforms),
];

/// Description of these files for the error without any model.
pub(super) const SEARCHED_PATHS: &str = "*.mvs, sfm_data.json, reconstruction.json, *.sfm, *.nvm, *bundle.out, synth_0.out, transforms.json, *.xml (Metashape, BlocksExchange), \
     Ori-*/Orientation-*.xml (MicMac), and ori/*.ori";

/// Models in binary formats of their programs: ending, what it is, and how to convert it.
const BINARY: [(&str, &str, &str); 2] = [
    (
        "sfm_data.bin",
        "OpenMVG's binary sfm_data is not read",
        "convert it: openMVG_main_ConvertSfM_DataFormat -i sfm_data.bin -o sfm_data.json -V -I -E -S",
    ),
    (
        ".abc",
        "AliceVision's Alembic files are not read",
        "convert it: aliceVision_convertSfMFormat --input sfm.abc --output sfm.sfm",
    ),
];

/// The fault of a folder whose only model is in a binary format of its program.
pub(super) fn in_binary(root: &Path) -> Option<ProjectError> {
    let names = file_names(root);
    BINARY.iter().find_map(|&(ending, what, hint)| {
        let name = names.iter().find(|name| name.ends_with(ending))?;
        let fault = Problem::Unsupported {
            what: what.into(),
            hint,
        }
        .at(Place::File);
        Some(ProjectError::fault(&root.join(name))(fault))
    })
}

/// Files of programs that hold no model for others: extension, what it is, and what to do.
const OTHER_FILES: [(&str, &str, &str); 11] = [
    ("psx", METASHAPE, EXPORT_CAMERAS),
    ("psz", METASHAPE, EXPORT_CAMERAS),
    ("rsproj", REALITY, EXPORT_REGISTRATION),
    ("rcproj", REALITY, EXPORT_REGISTRATION),
    (
        "db",
        "a database, such as COLMAP's of features and matches, but no model",
        "make a model from it: colmap mapper",
    ),
    ("las", CLOUD, WITH_CAMERAS),
    ("laz", CLOUD, WITH_CAMERAS),
    ("e57", CLOUD, WITH_CAMERAS),
    ("pts", CLOUD, WITH_CAMERAS),
    (
        "ply",
        "a point cloud or a mesh, without the cameras",
        WITH_CAMERAS,
    ),
    ("zip", "a ZIP archive", "unpack it, and name its folder"),
];
/// Pictures of a folder as Windows shows them.
const THUMBNAILS: &str = "thumbs.db";

const METASHAPE: &str = "a Metashape project, which only Metashape reads";
const EXPORT_CAMERAS: &str = "export the cameras as XML beside it (File > Export > Export Cameras), and the tie points as PLY, in the same coordinate system";
const REALITY: &str = "a RealityScan (RealityCapture) project, which only RealityScan reads";
const EXPORT_REGISTRATION: &str =
    "export the registration as COLMAP's text format, with the images undistorted";
const CLOUD: &str = "a point cloud, without the cameras";
const WITH_CAMERAS: &str =
    "a plan needs the cameras: name the folder with the model of structure from motion";

/// The file of another program that a path names, else the first one in its folder, for the fault
/// of a folder without any model.
pub(super) fn of_other_program(path: &Path, root: &Path) -> Option<ProjectError> {
    let kind = |path: PathBuf| {
        let extension = path.extension()?.to_str()?.to_ascii_lowercase();
        let kinds = OTHER_FILES.iter().zip(0..);
        let (&(_, what, cure), rank) =
            kinds.into_iter().find(|((own, ..), _)| *own == extension)?;
        let mistaken = Mistaken { what, cure };
        Some((rank, ProjectError::Mistaken { path, mistaken }))
    };
    if path.is_file() {
        return kind(path.into()).map(|(_, error)| error);
    }
    let names = file_names(root).into_iter();
    let names = names.filter(|name| !name.eq_ignore_ascii_case(THUMBNAILS));
    let paths = names
        .map(|name| root.join(name))
        .filter(|path| path.is_file());
    let found = paths.filter_map(kind);
    let first = found.min_by_key(|(rank, _): &(u32, _)| *rank);
    first.map(|(_, error)| error)
}

/// Extensions of model files, of which some are recognised by what is in them.
const MODEL_EXTENSIONS: [&str; 7] = ["xml", "json", "sfm", "mvs", "nvm", "out", "ori"];

/// The fault of a folder without any model, if a file that could be one is of another kind.
pub(super) fn mistaken(root: &Path) -> Option<ProjectError> {
    let names = file_names(root);
    let could_be_one = |name: &&String| {
        let extension = name.rsplit_once('.').map(|(_, extension)| extension);
        extension.is_some_and(|extension| MODEL_EXTENSIONS.contains(&extension))
    };
    names.iter().filter(could_be_one).find_map(|name| {
        let path = root.join(name);
        let mistaken = mistaken::of_file(&path)?;
        Some(ProjectError::Mistaken { path, mistaken })
    })
}

/// Finds the models of other programs in a folder, without reading them.
pub(super) fn listed(root: &Path) -> Vec<ModelLocation> {
    let files = file_names(root);
    let mut models: Vec<ModelLocation> = Vec::new();
    for (pattern, format) in MODEL_PATHS {
        let found = matching(pattern, root, &files).into_iter();
        for path in found.filter(|path| path.is_file()) {
            if models.iter().all(|model| model.path != path) {
                models.push(ModelLocation::new(format, path));
            }
        }
    }
    for path in matching("*.xml", root, &files) {
        models.extend(xml_format(&path).map(|format| ModelLocation::new(format, path)));
    }
    for folder in folders_of_micmac(root, &files) {
        models.push(ModelLocation::new(ModelFormat::MicMac, folder));
    }
    let mut with_ori = [root.join("ori"), root.into()].into_iter();
    if let Some(folder) = with_ori.find(|folder| !orientations(folder).is_empty()) {
        // NVM and Bundler files next to orientations are their sparse cloud.
        models.retain(|model| !matches!(model.format, ModelFormat::Nvm | ModelFormat::Bundler));
        models.push(ModelLocation::new(ModelFormat::Sure, folder));
    }
    models
}

fn folders_of_micmac(root: &Path, files: &[String]) -> impl Iterator<Item = PathBuf> {
    let named = files.iter().filter(|name| name.starts_with("Ori-"));
    let folders = named.map(|name| root.join(name)).chain([root.into()]);
    folders.filter(|folder| !oriented_by_micmac(folder).is_empty())
}

/// The paths in a folder, which has these files, that a pattern of [`MODEL_PATHS`] stands for.
fn matching(pattern: &str, root: &Path, files: &[String]) -> Vec<PathBuf> {
    let Some(ending) = pattern.strip_prefix('*') else {
        return vec![root.join(pattern)];
    };
    let matching = files.iter().filter(|name| name.ends_with(ending));
    matching.map(|name| root.join(name)).collect()
}

/// Recognises a model file by its extension or its first bytes.
pub(super) fn model_file(path: &Path) -> Option<ModelLocation> {
    let root = path.parent()?;
    let format = match path.extension()?.to_str()? {
        "mvs" => ModelFormat::OpenMvs,
        "nvm" => ModelFormat::Nvm,
        "out" if path.ends_with("synth_0.out") => ModelFormat::Mve,
        "out" => ModelFormat::Bundler,
        "xml" => xml_format(path)?,
        "sfm" => ModelFormat::AliceVision,
        "json" => json_format(path)?,
        "ori" => return Some(ModelLocation::new(ModelFormat::Sure, root)),
        _ => return None,
    };
    Some(ModelLocation::new(format, path))
}

fn json_format(path: &Path) -> Option<ModelFormat> {
    if path.file_name()?.to_str()?.starts_with("transforms") {
        return Some(ModelFormat::Transforms);
    }
    let head = head(path)?;
    if head.contains("\"sfm_data_version\"") {
        Some(ModelFormat::OpenMvg)
    } else if head
        .trim_start_matches('\u{feff}')
        .trim_start()
        .starts_with('[')
    {
        Some(ModelFormat::OpenSfm)
    } else {
        head.contains("\"version\"")
            .then_some(ModelFormat::AliceVision)
    }
}

fn xml_format(path: &Path) -> Option<ModelFormat> {
    let head = head(path)?;
    if head.contains("<BlocksExchange") {
        Some(ModelFormat::Blocks)
    } else {
        (head.contains("<document") && head.contains("<chunk")).then_some(ModelFormat::Metashape)
    }
}

/// The first bytes of a file, as text.
fn head(path: &Path) -> Option<String> {
    let mut head = Vec::new();
    input::open(path)
        .and_then(|file| file.take(4096).read_to_end(&mut head))
        .ok()?;
    Some(String::from_utf8_lossy(&head).into_owned())
}

/// Reads what the model has; nothing if it cannot be read, which reading it again says.
pub(super) fn examined(root: &Path, model: ModelLocation) -> ModelLocation {
    let Ok((foreign, cloud)) = read(root, &model) else {
        return model;
    };
    let contents = match foreign.model.points.is_empty() {
        _ if cloud::has_tracks(&foreign.model) => ModelContents::Tracks,
        true if cloud.is_none() => ModelContents::Poses,
        _ => ModelContents::Points,
    };
    ModelLocation {
        registered: foreign.model.images.len() as u64,
        contents,
        ..model
    }
}

/// Names of the files and folders in a folder, sorted, without hidden ones: macOS writes `._a.nvm`
/// beside `a.nvm`.
pub(super) fn file_names(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder)
        .into_iter()
        .flatten()
        .filter_map(Result::ok);
    let mut names: Vec<String> = entries
        .filter_map(|entry| entry.file_name().into_string().ok())
        .filter(|name| !name.starts_with('.'))
        .collect();
    names.sort_unstable();
    names
}

fn orientations(folder: &Path) -> Vec<PathBuf> {
    file_names(folder)
        .iter()
        .filter(|name| name.ends_with(".ori"))
        .map(|name| folder.join(name))
        .collect()
}

/// Names of the images that a folder of MicMac orients, and the files.
fn oriented_by_micmac(folder: &Path) -> Vec<(String, PathBuf)> {
    let image = |name: &String| {
        let image = name.strip_prefix("Orientation-")?.strip_suffix(".xml")?;
        Some((image.to_owned(), folder.join(name)))
    };
    file_names(folder).iter().filter_map(image).collect()
}

/// The existing files of the model, and the PLY file of its points if it has no tracks of its own.
pub(super) fn files(root: &Path, model: &ModelLocation) -> Vec<PathBuf> {
    if model.format == ModelFormat::Sure {
        let cloud = sure_cloud(&model.path).map(|(path, _)| path);
        return orientations(&model.path).into_iter().chain(cloud).collect();
    }
    let cloud = match model.contents {
        ModelContents::Tracks => None,
        // It names the file.
        _ if model.format == ModelFormat::Transforms => {
            read(root, model).ok().and_then(|(_, cloud)| cloud)
        }
        _ => cloud_beside(model),
    };
    let own = own_files(model).into_iter().filter(|path| path.is_file());
    own.chain(cloud).collect()
}

/// The files of a model, but for SURE's, whether they exist or not.
fn own_files(model: &ModelLocation) -> Vec<PathBuf> {
    let path = &model.path;
    match model.format {
        ModelFormat::MicMac => file_names(path)
            .iter()
            .filter(|name| name.ends_with(".xml"))
            .map(|name| path.join(name))
            .collect(),
        ModelFormat::Bundler => {
            let list = bundler_list(path);
            [path.clone()].into_iter().chain(list).collect()
        }
        ModelFormat::OpenSfm => vec![path.clone(), path.with_file_name("tracks.csv")],
        _ => vec![path.clone()],
    }
}

#[cfg(test)]
mod tests;
