//! Finds and reads the models of programs other than COLMAP.

use std::{
    io::Read,
    path::{Path, PathBuf},
};

use viewrank_core::model::scene::WarningKind;

use super::{ModelFormat, ModelLocation, ProjectError, files, folder, images::ImageSearch};
use crate::{
    formats::{
        Fault, Place, Problem, alicevision, blocks, bundler, cloud,
        foreign::ForeignModel,
        metashape::{self, Frame},
        micmac, mve, nvm, openmvg,
        openmvs::Mvs,
        opensfm, sure, transforms,
    },
    input::{self, FileKind},
    ply,
};

/// Model files in a project folder, in order of preference.
const MODEL_PATHS: [(&str, ModelFormat); 12] = [
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

/// Finds the models of other programs in a folder.
pub(super) fn models(root: &Path) -> Vec<ModelLocation> {
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
                models.push(location(root, format, path));
            }
        }
    }
    for path in files
        .iter()
        .filter(|name| name.ends_with(".xml"))
        .map(|name| root.join(name))
    {
        models.extend(xml_format(&path).map(|format| location(root, format, path)));
    }
    let of_micmac = files
        .iter()
        .filter(|name| name.starts_with("Ori-"))
        .map(|name| root.join(name));
    for folder in of_micmac
        .chain([root.into()])
        .filter(|folder| !oriented_by_micmac(folder).is_empty())
    {
        models.push(location(root, ModelFormat::MicMac, folder));
    }
    let ori = [root.join("ori"), root.into()]
        .into_iter()
        .find(|folder| !orientations(folder).is_empty());
    if let Some(folder) = ori {
        // NVM and Bundler files next to orientations are their sparse cloud.
        models.retain(|model| !matches!(model.format, ModelFormat::Nvm | ModelFormat::Bundler));
        models.push(location(root, ModelFormat::Sure, folder));
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
        "ori" => return Some(location(root, ModelFormat::Sure, root.into())),
        _ => return None,
    };
    Some(location(root, format, path.into()))
}

fn json_format(path: &Path) -> Option<ModelFormat> {
    if path.file_name()?.to_str()?.starts_with("transforms") {
        return Some(ModelFormat::Transforms);
    }
    let head = head(path)?;
    if head.contains("\"sfm_data_version\"") {
        Some(ModelFormat::OpenMvg)
    } else if head.trim_start().starts_with('[') {
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

fn location(root: &Path, format: ModelFormat, path: PathBuf) -> ModelLocation {
    let mut model = ModelLocation {
        format,
        path,
        registered: 0,
    };
    model.registered = read(root, &model).map_or(0, |foreign| foreign.model.images.len() as u64);
    model
}

fn file_names(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder)
        .into_iter()
        .flatten()
        .filter_map(Result::ok);
    let mut names: Vec<String> = entries
        .filter_map(|entry| entry.file_name().into_string().ok())
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

/// The existing files of the model.
pub(super) fn files(root: &Path, model: &ModelLocation) -> Vec<PathBuf> {
    let beside = match model.format {
        ModelFormat::Bundler => bundler_list(&model.path),
        ModelFormat::OpenSfm => Some(model.path.with_file_name("tracks.csv")),
        ModelFormat::Metashape | ModelFormat::Blocks | ModelFormat::Transforms => {
            cloud_beside(&model.path)
        }
        ModelFormat::MicMac => {
            let files = file_names(&model.path)
                .into_iter()
                .filter(|name| name.ends_with(".xml"));
            return files
                .map(|name| model.path.join(name))
                .chain(cloud_beside(&model.path))
                .collect();
        }
        ModelFormat::Sure => {
            let cloud = sure_cloud(root).map(|(path, _)| path);
            return orientations(&model.path).into_iter().chain(cloud).collect();
        }
        _ => None,
    };
    [Some(model.path.clone()), beside]
        .into_iter()
        .flatten()
        .filter(|path| path.is_file())
        .collect()
}

/// Reads the model; its image sizes come from the image files for formats that don't store them.
pub(super) fn read(root: &Path, model: &ModelLocation) -> Result<ForeignModel, ProjectError> {
    let search = ImageSearch::new(folder::candidates(root, &model.path));
    let size_of = |name: &str| search.size_of(name);
    let spelled = |name: &str| search.spelled(name);
    let at = |path: &Path, fault| ProjectError::Fault {
        path: path.into(),
        fault,
    };
    let path = &model.path;
    if model.format == ModelFormat::Sure {
        return read_sure(root, path);
    }
    if model.format == ModelFormat::MicMac {
        return read_micmac(path);
    }
    let bytes = files::read(path)?;
    let mut foreign = match model.format {
        ModelFormat::Transforms => {
            let (mut foreign, cloud) =
                transforms::read(&bytes, &size_of, &spelled).map_err(|fault| at(path, fault))?;
            let named = cloud
                .map(|cloud| path.with_file_name(cloud.replace('\\', "/")))
                .filter(|cloud| cloud.is_file());
            if let Some(cloud) = named {
                cloud::add_cloud(&mut foreign, &vertices(&cloud)?);
            }
            foreign
        }
        ModelFormat::Bundler => {
            let list = bundler_list(path).ok_or_else(|| ProjectError::NoImageList(path.clone()))?;
            let names = files::read(&list)?;
            bundler::read(&bytes, &names, &size_of)
                .map_err(|fault| at(if fault.file == "list" { &list } else { path }, fault))?
        }
        ModelFormat::OpenSfm => {
            let tracks = path.with_file_name("tracks.csv");
            let rows = tracks.is_file().then(|| files::read(&tracks)).transpose()?;
            opensfm::read(&bytes, rows.as_deref()).map_err(|fault| {
                at(
                    if fault.file == "tracks" {
                        &tracks
                    } else {
                        path
                    },
                    fault,
                )
            })?
        }
        ModelFormat::Metashape => {
            let read =
                |frame| metashape::read(&bytes, frame, &spelled).map_err(|fault| at(path, fault));
            let (world, chunk) = (read(Frame::World)?, read(Frame::Chunk)?);
            // Points may be exported in either; they are where the cameras look.
            let points = cloud_beside(path)
                .map(|cloud| vertices(&cloud))
                .transpose()?
                .unwrap_or_default();
            let seen = |model| cloud::views_per_point(model, &points);
            if seen(&chunk) > seen(&world) {
                chunk
            } else {
                world
            }
        }
        ModelFormat::Blocks => blocks::read(&bytes).map_err(|fault| at(path, fault))?,
        ModelFormat::Mve => {
            let views = ImageSearch::new(vec![path.with_file_name("views")]);
            let size_of = |name: &str| views.size_of(name);
            mve::read(&bytes, &mve_views(path), &size_of).map_err(|fault| at(path, fault))?
        }
        ModelFormat::Nvm => nvm::read(&bytes, &size_of).map_err(|fault| at(path, fault))?,
        ModelFormat::OpenMvg => openmvg::read(&bytes).map_err(|fault| at(path, fault))?,
        ModelFormat::AliceVision => alicevision::read(&bytes).map_err(|fault| at(path, fault))?,
        _ => Mvs::read(&bytes)
            .and_then(|mvs| mvs.model(&size_of))
            .map_err(|fault| at(path, fault))?,
    };
    foreign.shorten_names();
    if foreign.model.points.is_empty() {
        add_cloud_beside(&mut foreign, path)?;
    }
    Ok(foreign)
}

/// Reads an `Ori-` folder of MicMac, with the points of a PLY file in the folder of the images
/// (`AperiCloud`).
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
    add_cloud_beside(&mut foreign, folder)?;
    Ok(foreign)
}

/// Gives a model without points those of a PLY file beside it.
fn add_cloud_beside(foreign: &mut ForeignModel, model: &Path) -> Result<(), ProjectError> {
    let Some(path) = cloud_beside(model) else {
        let text = "no points: export the tie points or a cloud as PLY, in the coordinates of the cameras, into the folder of the model";
        foreign.warn(WarningKind::Damaged, text);
        return Ok(());
    };
    let points = vertices(&path)?;
    let has_both = !points.is_empty() && !foreign.model.images.is_empty();
    if has_both && cloud::views_per_point(foreign, &points) == 0.0 {
        let what =
            "no point lies before any camera: points and cameras are in different coordinates"
                .into();
        let hint =
            "export both in the same coordinate system, such as Metashape's Local Coordinates";
        let fault = Fault::new("", Place::File, Problem::Unsupported { what, hint });
        return Err(ProjectError::Fault { path, fault });
    }
    cloud::add_cloud(foreign, &points);
    Ok(())
}

/// The first PLY file in the folder of a model.
fn cloud_beside(model: &Path) -> Option<PathBuf> {
    let folder = model.parent()?;
    file_names(folder)
        .iter()
        .find(|name| name.ends_with(".ply"))
        .map(|name| folder.join(name))
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

/// The vertices of a PLY file.
fn vertices(path: &Path) -> Result<Vec<nalgebra::Point3<f64>>, ProjectError> {
    let cloud = ply::read(&files::read(path)?).map_err(|error| ProjectError::Fault {
        fault: Fault::new("", Place::File, Problem::Json(error.to_string())),
        path: path.into(),
    })?;
    Ok(cloud.vertices)
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

/// Finds the sparse cloud of a SURE project: NVM, Bundler or PLY.
fn sure_cloud(root: &Path) -> Option<(PathBuf, ModelFormat)> {
    let names = file_names(root);
    let endings = [
        (".nvm", ModelFormat::Nvm),
        (".out", ModelFormat::Bundler),
        (".ply", ModelFormat::Sure),
    ];
    let first = |ending: &str| {
        names
            .iter()
            .find(|name| name.ends_with(ending))
            .map(|name| root.join(name))
    };
    endings
        .into_iter()
        .find_map(|(ending, format)| Some((first(ending)?, format)))
}

/// Reads oriented images, and points from an NVM or Bundler file (with tracks) or a PLY file
/// (without).
fn read_sure(root: &Path, folder: &Path) -> Result<ForeignModel, ProjectError> {
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
    match sure_cloud(root) {
        None => {
            let text = "no points: copy a sparse cloud (*.nvm, *.out or *.ply) or a mesh (*.ply) into the project's folder; if only the \
                        height of the ground is known, make a ground.ply with integrations/sure/ground.py";
            foreign.warn(WarningKind::Damaged, text)
        }
        Some((path, ModelFormat::Sure)) => cloud::add_cloud(&mut foreign, &vertices(&path)?),
        Some((path, format)) => {
            let cloud = read(
                root,
                &ModelLocation {
                    format,
                    path: path.clone(),
                    registered: 0,
                },
            )?;
            foreign
                .model
                .warnings
                .extend(cloud.model.warnings.iter().cloned());
            sure::add_tracks(&mut foreign, &cloud).map_err(|problem| ProjectError::Fault {
                fault: Fault::new("", Place::File, problem),
                path,
            })?;
        }
    }
    Ok(foreign)
}

#[cfg(test)]
mod tests;
