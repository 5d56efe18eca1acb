//! Finds the models of programs other than COLMAP, and reads them (`read.rs`).

mod read;

use std::{
    io::Read,
    path::{Path, PathBuf},
};

pub(super) use self::read::read;
use self::read::{bundler_list, sure_cloud};
use super::{
    ModelContents, ModelFormat, ModelLocation, ProjectError, complete::cloud_beside,
    files::REQUIRED,
};
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

/// Files of programs that hold no model for others: their names, in lower case, what they are, and
/// what to do.
const OTHER_FILES: [(&str, &str, &str); 36] = [
    ("*.psx", METASHAPE, EXPORT_CAMERAS),
    ("*.psz", METASHAPE, EXPORT_CAMERAS),
    ("*.rsproj", REALITY, EXPORT_REGISTRATION),
    ("*.rcproj", REALITY, EXPORT_REGISTRATION),
    ("*.p4d", PIX4D, EXPORT_OPF),
    (
        "*_calibrated_camera_parameters.txt",
        PIX4D_CAMERAS,
        EXPORT_OPF,
    ),
    (
        "*_calibrated_external_camera_parameters*.txt",
        PIX4D_CAMERAS,
        EXPORT_OPF,
    ),
    (
        "*_calibrated_internal_camera_parameters*.cam",
        PIX4D_CAMERAS,
        EXPORT_OPF,
    ),
    ("*_pmatrix.txt", PIX4D_CAMERAS, EXPORT_OPF),
    ("*.opf", "a project in Pix4D's OPF", CONVERT_OPF),
    (
        "*.db",
        "a database, such as COLMAP's of features and matches, but no model",
        "make a model from it: colmap mapper",
    ),
    (
        "poses_bounds.npy",
        "the poses of LLFF, without sparse points",
        FROM_COLMAP,
    ),
    ("cameras_sphere.npz", CAMERAS, FROM_COLMAP),
    ("cameras.npz", CAMERAS, FROM_COLMAP),
    ("*_pose*.txt", POSES, WITH_POINTS),
    ("*_pose*.csv", POSES, WITH_POINTS),
    ("*.pose.txt", POSES, WITH_POINTS),
    ("pose*.txt", POSES, WITH_POINTS),
    ("pose*.csv", POSES, WITH_POINTS),
    ("pose*.npy", POSES, WITH_POINTS),
    ("*groundtruth.txt", POSES, WITH_POINTS),
    ("*traj*.txt", POSES, WITH_POINTS),
    ("*_cam.txt", CAMERAS, FROM_COLMAP),
    ("cameras.json", CAMERAS, FROM_COLMAP),
    ("cameras.csv", CAMERAS, WITH_POINTS),
    ("cameras.txt", CAMERAS, WITH_POINTS),
    ("*.las", CLOUD, WITH_CAMERAS),
    ("*.laz", CLOUD, WITH_CAMERAS),
    ("*.e57", CLOUD, WITH_CAMERAS),
    ("*.pts", CLOUD, WITH_CAMERAS),
    (
        "*.ply",
        "a point cloud or a mesh, without the cameras",
        WITH_CAMERAS,
    ),
    ("*.zip", "a ZIP archive", UNPACK),
    ("*.7z", "a 7-Zip archive", UNPACK),
    ("*.tgz", "an archive of tar", UNPACK),
    ("*.tar", "an archive of tar", UNPACK),
    ("*.tar.*", "an archive of tar", UNPACK),
];
/// Pictures of a folder as Windows shows them.
const THUMBNAILS: &str = "thumbs.db";

const METASHAPE: &str = "a Metashape project, which only Metashape reads";
const EXPORT_CAMERAS: &str = "export the cameras as XML beside it (File > Export > Export Cameras), and the tie points as PLY, in the same coordinate system";
const REALITY: &str = "a RealityScan (RealityCapture) project, which only RealityScan reads";
const EXPORT_REGISTRATION: &str =
    "export the registration as COLMAP's text format, with the images undistorted";
const PIX4D: &str = "a Pix4D project, which only Pix4D reads";
const PIX4D_CAMERAS: &str = "a list of Pix4D's cameras, without sparse points";
const EXPORT_OPF: &str = "export the project as OPF (PIX4Dmatic), and convert that to a model of COLMAP: opf2colmap, of pip install \"pyopf[tools]\"";
const CONVERT_OPF: &str =
    "convert it to a model of COLMAP: opf2colmap, of pip install \"pyopf[tools]\"";
const POSES: &str = "a list of poses, by its name, without sparse points";
const CAMERAS: &str = "a list of cameras, by its name, without sparse points";
const FROM_COLMAP: &str = "name the folder of the COLMAP model that it was made from, or make one from the photographs (colmap automatic_reconstructor)";
const WITH_POINTS: &str = "a plan needs sparse points, too: triangulate them from the poses (colmap point_triangulator), or make a model from the photographs (colmap automatic_reconstructor)";
const UNPACK: &str = "unpack it, and name its folder";
const CLOUD: &str = "a point cloud, without the cameras";
const WITH_CAMERAS: &str =
    "a plan needs the cameras: name the folder with the model of structure from motion";

/// The file of another program that a path names, else the first one in its folder, else in the
/// `folders` below, for the fault of a folder without any model.
pub(super) fn of_other_program(
    path: &Path,
    root: &Path,
    below: &[PathBuf],
) -> Option<ProjectError> {
    if path.is_file() {
        return kind(path).map(|(_, error)| error);
    }
    let folders = [root].into_iter().chain(below.iter().map(PathBuf::as_path));
    let mut in_folders = folders.filter_map(|folder| {
        let names = file_names(folder).into_iter();
        // By its ending it would be COLMAP's database.
        let names = names.filter(|name| !name.eq_ignore_ascii_case(THUMBNAILS));
        let found = names.filter_map(|name| kind(&folder.join(name)));
        found.min_by_key(|(rank, _): &(u32, _)| *rank)
    });
    in_folders.next().map(|(_, error)| error)
}

/// Says which program's file it is; with its place in [`OTHER_FILES`].
fn kind(path: &Path) -> Option<(u32, ProjectError)> {
    let name = path.file_name()?.to_str()?.to_lowercase();
    let mut kinds = OTHER_FILES.iter().zip(0..);
    let (&(_, what, cure), rank) = kinds.find(|((pattern, ..), _)| fits(&name, pattern))?;
    let (path, mistaken) = (path.to_path_buf(), Mistaken { what, cure });
    path.is_file()
        .then_some((rank, ProjectError::Mistaken { path, mistaken }))
}

/// Returns whether a name fits a pattern, in which `*` stands for anything.
fn fits(name: &str, pattern: &str) -> bool {
    let Some((start, rest)) = pattern.split_once('*') else {
        return name == pattern;
    };
    let Some(mut left) = name.strip_prefix(start) else {
        return false;
    };
    let (between, end) = rest.rsplit_once('*').unwrap_or(("", rest));
    for part in between.split('*') {
        match left.find(part) {
            Some(at) => left = &left[at + part.len()..],
            None => return false,
        }
    }
    left.ends_with(end)
}

/// The first compressed file in a folder whose name without that ending `is_wanted`.
pub(super) fn packed(folder: &Path, is_wanted: impl Fn(&str) -> bool) -> Option<ProjectError> {
    let names = file_names(folder);
    let packed = |name: &String| {
        let (_, mistaken) = unpacked(name).filter(|(stem, _)| is_wanted(stem))?;
        let path = folder.join(name);
        path.is_file()
            .then_some(ProjectError::Mistaken { path, mistaken })
    };
    names.iter().find_map(packed)
}

/// Endings of compressed files, what they are, and what unpacks them.
const PACKED: [(&str, &str, &str); 4] = [
    (
        ".gz",
        "compressed with gzip",
        "unpack it and those beside it: gunzip *.gz, or 7-Zip on Windows",
    ),
    (
        ".bz2",
        "compressed with bzip2",
        "unpack it and those beside it: bunzip2 *.bz2, or 7-Zip on Windows",
    ),
    (
        ".xz",
        "compressed with xz",
        "unpack it and those beside it: unxz *.xz, or 7-Zip on Windows",
    ),
    (
        ".zst",
        "compressed with Zstandard",
        "unpack it and those beside it: unzstd *.zst",
    ),
];

/// The name of a compressed file without that ending, and what to do.
fn unpacked(name: &str) -> Option<(&str, Mistaken)> {
    PACKED.iter().find_map(|&(ending, what, cure)| {
        let stem = name.strip_suffix(ending)?;
        Some((stem, Mistaken { what, cure }))
    })
}

/// Returns whether a file of this name is a model, or a part of one of COLMAP's.
pub(super) fn is_of_model(name: &str) -> bool {
    let is_model = |(_, extension)| MODEL_EXTENSIONS.contains(&extension);
    is_of_colmap(name) || name == "sfm_data.bin" || name.rsplit_once('.').is_some_and(is_model)
}

/// Returns whether a model of COLMAP has a file of this name.
pub(super) fn is_of_colmap(name: &str) -> bool {
    name.rsplit_once('.').is_some_and(|(stem, extension)| {
        ["bin", "txt"].contains(&extension) && REQUIRED.contains(&stem)
    })
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

/// Most models in a folder that are looked at, the first by name of each kind: each looks through
/// the folder for its images and points.
const MOST_MODELS: usize = 64;

/// Finds the models of other programs in a folder, without reading them.
pub(super) fn listed(root: &Path) -> Vec<ModelLocation> {
    let files = file_names(root);
    let mut models: Vec<ModelLocation> = Vec::new();
    for (pattern, format) in MODEL_PATHS {
        let found = matching(pattern, root, &files).into_iter();
        for path in found.filter(|path| path.is_file()).take(MOST_MODELS) {
            // Several patterns match one file, as `*bundle.out` and `*.out`.
            if models.iter().all(|model| model.path != path) {
                models.push(ModelLocation::new(format, path));
            }
        }
    }
    let of_xml = matching("*.xml", root, &files).into_iter();
    let of_xml = of_xml.filter_map(|path| Some(ModelLocation::new(xml_format(&path)?, path)));
    models.extend(of_xml.take(MOST_MODELS));
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
    // The user may have named an `Ori-` folder itself.
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

/// Returns whether a file begins as those of Bundler do.
pub(super) fn is_bundle(path: &Path) -> bool {
    head(path).is_some_and(|head| head.trim_start().starts_with("# Bundle"))
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
