//! Reads the models of programs other than COLMAP, with the files that belong to them.

use std::path::{Path, PathBuf};

use viewrank_core::model::scene::WarningKind;

use super::{file_names, orientations, oriented_by_micmac};
use crate::{
    formats::{
        Fault, Place, alicevision, blocks, bundler, cloud,
        foreign::{ForeignModel, SizeLookup},
        metashape::{self, Frame},
        micmac, mve, nvm, openmvg,
        openmvs::Mvs,
        opensfm,
        sure::{self, Orientation},
        transforms,
    },
    input::{self, FileKind},
    project::{
        ModelFormat, ModelLocation, ProjectError,
        complete::{cloud_beside, clouds_in, vertices},
        files, folder,
        images::ImageSearch,
    },
};

/// Reads the model, and finds the PLY file of its points if it has none of its own; image sizes
/// come from the image files for formats that don't store them.
pub(in crate::project) fn read(
    root: &Path,
    model: &ModelLocation,
) -> Result<(ForeignModel, Option<PathBuf>), ProjectError> {
    let path = &model.path;
    match model.format {
        ModelFormat::Sure => return read_sure(root, path),
        ModelFormat::MicMac => return Ok((read_micmac(path)?, cloud_beside(model))),
        _ => {}
    }
    let search = ImageSearch::new(folder::candidates(root, path));
    let bytes = files::read(path)?;
    if model.format == ModelFormat::Transforms {
        return read_transforms(model, &bytes, &search);
    }
    let mut foreign = parse(model, &bytes, &search)?;
    foreign.shorten_names();
    Ok((foreign, cloud_beside(model)))
}

/// Reads a model of one file, and the files that belong to it.
fn parse(
    model: &ModelLocation,
    bytes: &[u8],
    search: &ImageSearch,
) -> Result<ForeignModel, ProjectError> {
    let path = &model.path;
    let size_of = |name: &str| search.size_of(name);
    let read = match model.format {
        ModelFormat::Bundler => return read_bundler(path, bytes, &size_of),
        ModelFormat::OpenSfm => return read_opensfm(path, bytes),
        ModelFormat::Metashape => {
            return read_metashape(model, bytes, &|name| search.spelled(name));
        }
        ModelFormat::Mve => read_mve(path, bytes),
        ModelFormat::Blocks => blocks::read(bytes),
        ModelFormat::Nvm => nvm::read(bytes, &size_of),
        ModelFormat::OpenMvg => openmvg::read(bytes),
        ModelFormat::AliceVision => alicevision::read(bytes),
        _ => Mvs::read(bytes).and_then(|mvs| mvs.model(&size_of)),
    };
    read.map_err(ProjectError::fault(path))
}

/// Reads a `transforms.json`, which may name the PLY file of its points.
fn read_transforms(
    model: &ModelLocation,
    bytes: &[u8],
    search: &ImageSearch,
) -> Result<(ForeignModel, Option<PathBuf>), ProjectError> {
    let path = &model.path;
    let size_of = |name: &str| search.size_of(name);
    let spelled = |name: &str| search.spelled(name);
    let (mut foreign, named) =
        transforms::read(bytes, &size_of, &spelled).map_err(ProjectError::fault(path))?;
    let others = splits_beside(path);
    if !others.is_empty() {
        let text = format!("{} not read: images kept for tests", others.join(" and "));
        foreign.warn(WarningKind::Format, text);
    }
    let named = named.map(|cloud| path.with_file_name(cloud.replace('\\', "/")));
    // The file may have been copied without the points that it names.
    let named = named.filter(|cloud| cloud.is_file());
    Ok((foreign, named.or_else(|| cloud_beside(model))))
}

/// The files of test images beside a `transforms_train.json`.
fn splits_beside(path: &Path) -> Vec<String> {
    let is_part = path.ends_with("transforms_train.json");
    let names = path
        .parent()
        .map(file_names)
        .unwrap_or_default()
        .into_iter();
    let others = ["transforms_test.json", "transforms_val.json"];
    names
        .filter(|name| is_part && others.contains(&&**name))
        .collect()
}

fn read_mve(bundle: &Path, bytes: &[u8]) -> Result<ForeignModel, Fault> {
    let views = ImageSearch::new(vec![bundle.with_file_name("views")]);
    mve::read(bytes, &mve_views(bundle), &|name| views.size_of(name))
}

fn read_bundler(
    path: &Path,
    bytes: &[u8],
    size_of: SizeLookup,
) -> Result<ForeignModel, ProjectError> {
    let list = bundler_list(path).ok_or_else(|| ProjectError::NoImageList(path.into()))?;
    let names = files::read(&list)?;
    bundler::read(bytes, &names, size_of).map_err(|fault| match fault.file {
        "list" => ProjectError::fault(&list)(fault),
        _ => ProjectError::fault(path)(fault),
    })
}

fn read_opensfm(path: &Path, bytes: &[u8]) -> Result<ForeignModel, ProjectError> {
    let tracks = path.with_file_name("tracks.csv");
    let rows = tracks.is_file().then(|| files::read(&tracks)).transpose()?;
    opensfm::read(bytes, rows.as_deref()).map_err(|fault| match fault.file {
        "tracks" => ProjectError::fault(&tracks)(fault),
        _ => ProjectError::fault(path)(fault),
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
        metashape::read(bytes, frames, spelled).map_err(ProjectError::fault(&model.path))?;
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
        let oriented = micmac::read_orientation(&files::read(&path)?);
        let oriented = oriented.map_err(ProjectError::fault(&path))?;
        let known = calibrations
            .iter()
            .position(|known| *known == oriented.calibration);
        let camera_id = known.unwrap_or(calibrations.len()) as u32 + 1;
        if known.is_none() {
            let path = folder.join(&oriented.calibration);
            add_calibration(&mut foreign, &path, camera_id)?;
            calibrations.push(oriented.calibration);
        }
        foreign.add_image(n, image, camera_id, oriented.cam_from_world, Place::File);
    }
    Ok(foreign)
}

/// Adds the camera of one of MicMac's calibrations.
fn add_calibration(foreign: &mut ForeignModel, path: &Path, id: u32) -> Result<(), ProjectError> {
    let read = micmac::read_calibration(&files::read(path)?, id);
    let (camera, off) = read.map_err(ProjectError::fault(path))?;
    if off > 0.5 {
        let name = path.file_name().unwrap_or_default().display();
        let text = format!("{name}: COLMAP's nearest camera is off by up to {off:.1} pixels");
        foreign.warn(WarningKind::Format, text);
    }
    foreign.model.cameras.push(camera);
    Ok(())
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
pub(super) fn bundler_list(bundle: &Path) -> Option<PathBuf> {
    let name = bundle.file_name()?.to_string_lossy();
    let own = name
        .strip_suffix("bundle.out")
        .map(|stem| bundle.with_file_name(format!("{stem}list.txt")));
    let undistorted = name
        .ends_with(".rd.out")
        .then(|| bundle.with_file_name("list.rd.txt"));
    // Bundler writes `bundle/bundle.out`, and its list above.
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
pub(super) fn sure_cloud(folder: &Path) -> Option<(PathBuf, ModelFormat)> {
    let above = folder.parent().filter(|_| folder.ends_with("ori"));
    let project = above.unwrap_or(folder);
    let names = file_names(project);
    let first = |ending: &str| {
        names
            .iter()
            .find(|name| name.ends_with(ending))
            .map(|name| project.join(name))
    };
    let endings = [(".nvm", ModelFormat::Nvm), (".out", ModelFormat::Bundler)];
    let with_tracks = |(ending, format)| Some((first(ending)?, format));
    let cloud = || {
        Some((
            clouds_in(project).into_iter().next()?.path,
            ModelFormat::Sure,
        ))
    };
    endings.into_iter().find_map(with_tracks).or_else(cloud)
}

/// Reads the oriented images of a folder of SURE.
fn oriented(root: &Path, folder: &Path) -> Result<ForeignModel, ProjectError> {
    let mut oriented: Vec<Orientation> = Vec::new();
    for (id, path) in (1..).zip(orientations(folder)) {
        let read = sure::read(&files::read(&path)?, id);
        oriented.push(read.map_err(ProjectError::fault(&path))?);
    }
    let search = ImageSearch::new(folder::candidates(root, folder));
    Ok(sure::model(oriented, |name| search.spelled(name)))
}

/// Reads oriented images, with the tracks of an NVM or Bundler file, or finds a PLY file of points.
fn read_sure(root: &Path, folder: &Path) -> Result<(ForeignModel, Option<PathBuf>), ProjectError> {
    let mut foreign = oriented(root, folder)?;
    let (path, format) = match sure_cloud(folder) {
        None => return Ok((foreign, None)),
        Some((path, ModelFormat::Sure)) => return Ok((foreign, Some(path))),
        Some(with_tracks) => with_tracks,
    };
    let (tracks, _) = read(root, &ModelLocation::new(format, &path))?;
    let warnings = tracks.model.warnings.iter().cloned();
    foreign.model.warnings.extend(warnings);
    sure::add_tracks(&mut foreign, &tracks)
        .map_err(|problem| ProjectError::fault(&path)(problem.at(Place::File)))?;
    Ok((foreign, None))
}
