//! Finds and reads the models of programs other than COLMAP.

use std::{
    io::Read,
    path::{Path, PathBuf},
};

use viewrank_core::model::scene::WarningKind;

use super::{
    ModelContents, ModelFormat, ModelLocation, ProjectError,
    complete::{cloud_beside, vertices},
    files, folder,
    images::ImageSearch,
};
use crate::{
    formats::{
        Fault, Place, Problem, alicevision, blocks, bundler, cloud,
        foreign::{ForeignModel, SizeLookup},
        metashape::{self, Frame},
        micmac, mve, nvm, openmvg,
        openmvs::Mvs,
        opensfm, sure, transforms,
    },
    input::{self, FileKind},
    mistaken,
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
        let fault = Fault::new(
            "",
            Place::File,
            Problem::Unsupported {
                what: what.into(),
                hint,
            },
        );
        Some(ProjectError::Fault {
            path: root.join(name),
            fault,
        })
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

/// Finds the models of other programs in a folder, without reading them.
pub(super) fn listed(root: &Path) -> Vec<ModelLocation> {
    let files = file_names(root);
    let mut models: Vec<ModelLocation> = Vec::new();
    for (pattern, format) in MODEL_PATHS {
        let found: Vec<PathBuf> = match pattern.strip_prefix('*') {
            Some(ending) => files
                .iter()
                .filter(|name| name.ends_with(ending))
                .map(|name| root.join(name))
                .collect(),
            None => vec![root.join(pattern)],
        };
        for path in found.into_iter().filter(|path| path.is_file()) {
            if models.iter().all(|model| model.path != path) {
                models.push(ModelLocation::new(format, path));
            }
        }
    }
    for path in files
        .iter()
        .filter(|name| name.ends_with(".xml"))
        .map(|name| root.join(name))
    {
        models.extend(xml_format(&path).map(|format| ModelLocation::new(format, path)));
    }
    let of_micmac = files
        .iter()
        .filter(|name| name.starts_with("Ori-"))
        .map(|name| root.join(name));
    for folder in of_micmac
        .chain([root.into()])
        .filter(|folder| !oriented_by_micmac(folder).is_empty())
    {
        models.push(ModelLocation::new(ModelFormat::MicMac, folder));
    }
    let ori = [root.join("ori"), root.into()]
        .into_iter()
        .find(|folder| !orientations(folder).is_empty());
    if let Some(folder) = ori {
        // NVM and Bundler files next to orientations are their sparse cloud.
        models.retain(|model| !matches!(model.format, ModelFormat::Nvm | ModelFormat::Bundler));
        models.push(ModelLocation::new(ModelFormat::Sure, folder));
    }
    models
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
    let own = match model.format {
        ModelFormat::MicMac => file_names(&model.path)
            .iter()
            .filter(|name| name.ends_with(".xml"))
            .map(|name| model.path.join(name))
            .collect(),
        ModelFormat::Sure => {
            let cloud = sure_cloud(&model.path).map(|(path, _)| path);
            return orientations(&model.path).into_iter().chain(cloud).collect();
        }
        ModelFormat::Bundler => [model.path.clone()]
            .into_iter()
            .chain(bundler_list(&model.path))
            .collect(),
        ModelFormat::OpenSfm => vec![model.path.clone(), model.path.with_file_name("tracks.csv")],
        _ => vec![model.path.clone()],
    };
    let cloud = match model.contents {
        ModelContents::Tracks => None,
        // It names the file.
        _ if model.format == ModelFormat::Transforms => {
            read(root, model).ok().and_then(|(_, cloud)| cloud)
        }
        _ => cloud_beside(model),
    };
    let own = own.into_iter().filter(|path: &PathBuf| path.is_file());
    own.chain(cloud).collect()
}

/// Reads the model, and finds the PLY file of its points if it has none of its own; image sizes come
/// from the image files for formats that don't store them.
pub(super) fn read(
    root: &Path,
    model: &ModelLocation,
) -> Result<(ForeignModel, Option<PathBuf>), ProjectError> {
    let search = ImageSearch::new(folder::candidates(root, &model.path));
    let size_of = |name: &str| search.size_of(name);
    let spelled = |name: &str| search.spelled(name);
    let path = &model.path;
    if model.format == ModelFormat::Sure {
        return read_sure(root, path);
    }
    let cloud = || cloud_beside(model);
    if model.format == ModelFormat::MicMac {
        return Ok((read_micmac(path)?, cloud()));
    }
    let bytes = files::read(path)?;
    let fault = |fault| at(path, fault);
    let mut foreign = match model.format {
        ModelFormat::Transforms => {
            let (foreign, named) = transforms::read(&bytes, &size_of, &spelled).map_err(fault)?;
            let named = named.map(|cloud| path.with_file_name(cloud.replace('\\', "/")));
            let named = named.filter(|cloud| cloud.is_file());
            return Ok((foreign, named.or_else(cloud)));
        }
        ModelFormat::Bundler => read_bundler(path, &bytes, &size_of)?,
        ModelFormat::OpenSfm => read_opensfm(path, &bytes)?,
        ModelFormat::Metashape => read_metashape(model, &bytes, &spelled)?,
        ModelFormat::Mve => {
            let views = ImageSearch::new(vec![path.with_file_name("views")]);
            let size_of = |name: &str| views.size_of(name);
            mve::read(&bytes, &mve_views(path), &size_of).map_err(fault)?
        }
        ModelFormat::Blocks => blocks::read(&bytes).map_err(fault)?,
        ModelFormat::Nvm => nvm::read(&bytes, &size_of).map_err(fault)?,
        ModelFormat::OpenMvg => openmvg::read(&bytes).map_err(fault)?,
        ModelFormat::AliceVision => alicevision::read(&bytes).map_err(fault)?,
        _ => Mvs::read(&bytes)
            .and_then(|mvs| mvs.model(&size_of))
            .map_err(fault)?,
    };
    foreign.shorten_names();
    Ok((foreign, cloud()))
}

fn at(path: &Path, fault: Fault) -> ProjectError {
    ProjectError::Fault {
        path: path.into(),
        fault,
    }
}

fn read_bundler(
    path: &Path,
    bytes: &[u8],
    size_of: SizeLookup,
) -> Result<ForeignModel, ProjectError> {
    let list = bundler_list(path).ok_or_else(|| ProjectError::NoImageList(path.into()))?;
    let names = files::read(&list)?;
    bundler::read(bytes, &names, size_of).map_err(|fault| match fault.file {
        "list" => at(&list, fault),
        _ => at(path, fault),
    })
}

fn read_opensfm(path: &Path, bytes: &[u8]) -> Result<ForeignModel, ProjectError> {
    let tracks = path.with_file_name("tracks.csv");
    let rows = tracks.is_file().then(|| files::read(&tracks)).transpose()?;
    opensfm::read(bytes, rows.as_deref()).map_err(|fault| match fault.file {
        "tracks" => at(&tracks, fault),
        _ => at(path, fault),
    })
}

/// Points may be exported with the cameras' transform or without; they are where the cameras look.
fn read_metashape(
    model: &ModelLocation,
    bytes: &[u8],
    spelled: &dyn Fn(&str) -> String,
) -> Result<ForeignModel, ProjectError> {
    let frames = [Frame::World, Frame::Chunk];
    let [world, chunk] =
        metashape::read(bytes, frames, spelled).map_err(|fault| at(&model.path, fault))?;
    let points = cloud_beside(model)
        .map(|cloud| vertices(&cloud))
        .transpose()?
        .unwrap_or_default();
    let seen = |foreign: &ForeignModel| cloud::views_per_point(&foreign.model, &points);
    if seen(&chunk) > seen(&world) {
        Ok(chunk)
    } else {
        Ok(world)
    }
}

/// Reads an `Ori-` folder of MicMac; the points are in a PLY file beside it (`AperiCloud`).
fn read_micmac(folder: &Path) -> Result<ForeignModel, ProjectError> {
    let mut foreign = ForeignModel::default();
    let mut calibrations: Vec<String> = Vec::new();
    for (n, (image, path)) in (1..).zip(oriented_by_micmac(folder)) {
        let at = |path: &Path, fault| ProjectError::Fault {
            path: path.into(),
            fault,
        };
        let oriented =
            micmac::read_orientation(&files::read(&path)?).map_err(|fault| at(&path, fault))?;
        let known = calibrations
            .iter()
            .position(|known| *known == oriented.calibration);
        let camera_id = known.unwrap_or(calibrations.len()) as u32 + 1;
        if known.is_none() {
            let path = folder.join(&oriented.calibration);
            let read = micmac::read_calibration(&files::read(&path)?, camera_id);
            let (camera, off) = read.map_err(|fault| at(&path, fault))?;
            if off > 0.5 {
                let text = format!(
                    "{}: COLMAP's nearest camera is off by up to {off:.1} pixels",
                    oriented.calibration
                );
                foreign.warn(WarningKind::Format, text);
            }
            foreign.model.cameras.push(camera);
            calibrations.push(oriented.calibration);
        }
        foreign.add_image(n, image, camera_id, oriented.cam_from_world, Place::File);
    }
    Ok(foreign)
}

/// The views beside a bundle of MVE, by their `meta.ini` and undistorted image.
fn mve_views(bundle: &Path) -> Vec<mve::View> {
    let folder = bundle.with_file_name("views");
    let search = ImageSearch::new(vec![folder.clone()]);
    let view = |name: &String| {
        let meta =
            input::read_text(&folder.join(name).join("meta.ini"), FileKind::Settings).ok()?;
        let image = search.spelled(&format!("{name}/undistorted.jpg"));
        mve::View::read(&meta, image)
    };
    file_names(&folder)
        .iter()
        .filter(|name| name.ends_with(".mve"))
        .filter_map(view)
        .collect()
}

/// Finds the image list of a bundle file: `list.rd.txt` for `*.rd.out`, `X.list.txt` for
/// `X.bundle.out`, otherwise `list.txt` in its folder or the one above; `imagelist.lst` is
/// RealityCapture's.
fn bundler_list(bundle: &Path) -> Option<PathBuf> {
    let name = bundle.file_name()?.to_string_lossy();
    let own = name
        .strip_suffix("bundle.out")
        .map(|stem| bundle.with_file_name(format!("{stem}list.txt")));
    let undistorted = name
        .ends_with(".rd.out")
        .then(|| bundle.with_file_name("list.rd.txt"));
    let up = bundle
        .parent()
        .and_then(Path::parent)
        .map(|folder| folder.join("list.txt"));
    let beside = |name: &str| Some(bundle.with_file_name(name));
    let lists = [
        undistorted,
        own,
        beside("list.txt"),
        beside("imagelist.lst"),
        up,
    ];
    lists.into_iter().flatten().find(|path| path.is_file())
}

/// Finds the sparse cloud of orientations in a folder of SURE, in it or in that above its `ori`:
/// NVM, Bundler or PLY.
fn sure_cloud(folder: &Path) -> Option<(PathBuf, ModelFormat)> {
    let above = folder.parent().filter(|_| folder.ends_with("ori"));
    let project = above.unwrap_or(folder);
    let names = file_names(project);
    let endings = [
        (".nvm", ModelFormat::Nvm),
        (".out", ModelFormat::Bundler),
        (".ply", ModelFormat::Sure),
    ];
    let first = |ending: &str| {
        names
            .iter()
            .find(|name| name.ends_with(ending))
            .map(|name| project.join(name))
    };
    endings
        .into_iter()
        .find_map(|(ending, format)| Some((first(ending)?, format)))
}

/// Reads oriented images, with the tracks of an NVM or Bundler file, or finds a PLY file of points.
fn read_sure(root: &Path, folder: &Path) -> Result<(ForeignModel, Option<PathBuf>), ProjectError> {
    let mut oriented = Vec::new();
    for (n, path) in orientations(folder).iter().enumerate() {
        let found = sure::read(&files::read(path)?, n as u32 + 1);
        oriented.push(found.map_err(|fault| ProjectError::Fault {
            path: path.clone(),
            fault,
        })?);
    }
    let search = ImageSearch::new(folder::candidates(root, folder));
    let mut foreign = sure::model(oriented, |name| search.spelled(name));
    let (path, format) = match sure_cloud(folder) {
        None => return Ok((foreign, None)),
        Some((path, ModelFormat::Sure)) => return Ok((foreign, Some(path))),
        Some(with_tracks) => with_tracks,
    };
    let (tracks, _) = read(root, &ModelLocation::new(format, &path))?;
    let warnings = tracks.model.warnings.iter().cloned();
    foreign.model.warnings.extend(warnings);
    sure::add_tracks(&mut foreign, &tracks).map_err(|problem| ProjectError::Fault {
        fault: Fault::new("", Place::File, problem),
        path,
    })?;
    Ok((foreign, None))
}

#[cfg(test)]
mod tests;
