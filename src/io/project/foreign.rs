//! Finds and reads the models of programs other than COLMAP.

use std::{
    io::Read,
    path::{Path, PathBuf},
};

use super::{ModelFormat, ModelLocation, ProjectError, files, images};
use crate::{
    base::input,
    io::{
        formats::{
            Fault, Place, Problem, alicevision, bundler,
            foreign::{ForeignModel, last_parts},
            nvm, openmvg,
            openmvs::Mvs,
            opensfm, sure, transforms,
        },
        ply,
    },
    model::scene::WarningKind,
};

/// Model files in a project folder, in order of preference.
const MODEL_PATHS: [(&str, ModelFormat); 11] = [
    ("scene.mvs", ModelFormat::OpenMvs),
    ("sfm_data.json", ModelFormat::OpenMvg),
    ("reconstruction.json", ModelFormat::OpenSfm),
    ("opensfm/reconstruction.json", ModelFormat::OpenSfm),
    ("*.mvs", ModelFormat::OpenMvs),
    ("*.sfm", ModelFormat::AliceVision),
    ("*.nvm", ModelFormat::Nvm),
    ("bundle/bundle.out", ModelFormat::Bundler),
    ("*bundle.out", ModelFormat::Bundler),
    ("*.out", ModelFormat::Bundler),
    ("transforms.json", ModelFormat::Transforms),
];

/// Description of these files for the error without any model.
pub(super) const SEARCHED_PATHS: &str =
    "*.mvs, sfm_data.json, reconstruction.json, *.sfm, *.nvm, *bundle.out, transforms.json, and ori/*.ori";

/// Finds the models of other programs in a folder.
pub(super) fn models(root: &Path) -> Vec<ModelLocation> {
    let files = file_names(root);
    let mut models: Vec<ModelLocation> = Vec::new();
    for (pattern, format) in MODEL_PATHS {
        let found: Vec<PathBuf> = match pattern.strip_prefix('*') {
            Some(ending) => files.iter().filter(|name| name.ends_with(ending)).map(|name| root.join(name)).collect(),
            None => vec![root.join(pattern)],
        };
        for path in found.into_iter().filter(|path| path.is_file()) {
            if models.iter().all(|model| model.path != path) {
                models.push(location(root, format, path));
            }
        }
    }
    let ori = [root.join("ori"), root.into()].into_iter().find(|folder| !orientations(folder).is_empty());
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
        "out" => ModelFormat::Bundler,
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
    let mut head = Vec::new();
    input::open(path).and_then(|file| file.take(4096).read_to_end(&mut head)).ok()?;
    let head = String::from_utf8_lossy(&head);
    if head.contains("\"sfm_data_version\"") {
        Some(ModelFormat::OpenMvg)
    } else if head.trim_start().starts_with('[') {
        Some(ModelFormat::OpenSfm)
    } else {
        head.contains("\"version\"").then_some(ModelFormat::AliceVision)
    }
}

fn location(root: &Path, format: ModelFormat, path: PathBuf) -> ModelLocation {
    let mut model = ModelLocation { format, path, registered: 0 };
    model.registered = read(root, &model).map_or(0, |foreign| foreign.model.images.len() as u64);
    model
}

fn file_names(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().filter_map(Result::ok);
    let mut names: Vec<String> = entries.filter_map(|entry| entry.file_name().into_string().ok()).collect();
    names.sort_unstable();
    names
}

fn orientations(folder: &Path) -> Vec<PathBuf> {
    file_names(folder).iter().filter(|name| name.ends_with(".ori")).map(|name| folder.join(name)).collect()
}

/// The existing files of the model.
pub(super) fn files(root: &Path, model: &ModelLocation) -> Vec<PathBuf> {
    let beside = match model.format {
        ModelFormat::Bundler => bundler_list(&model.path),
        ModelFormat::OpenSfm => Some(model.path.with_file_name("tracks.csv")),
        ModelFormat::Sure => {
            let cloud = sure_cloud(root).map(|(path, _)| path);
            return orientations(&model.path).into_iter().chain(cloud).collect();
        }
        _ => None,
    };
    [Some(model.path.clone()), beside].into_iter().flatten().filter(|path| path.is_file()).collect()
}

/// Reads the model; its image sizes come from the image files for formats that don't store them.
pub(super) fn read(root: &Path, model: &ModelLocation) -> Result<ForeignModel, ProjectError> {
    let candidates = images::candidates(root, &model.path);
    let size_of = |name: &str| {
        let names = last_parts(name);
        names.iter().find_map(|name| candidates.iter().find_map(|folder| images::size_by_header(&folder.join(name))))
    };
    let at = |path: &Path, fault| ProjectError::Fault { path: path.into(), fault };
    let path = &model.path;
    if model.format == ModelFormat::Sure {
        return read_sure(root, path);
    }
    let bytes = files::read(path)?;
    let mut foreign = match model.format {
        ModelFormat::Transforms => {
            let spelled = |name: &str| images::with_extension(&candidates, name);
            let (mut foreign, cloud) = transforms::read(&bytes, &size_of, &spelled).map_err(|fault| at(path, fault))?;
            match cloud.map(|cloud| path.with_file_name(cloud.replace('\\', "/"))).filter(|cloud| cloud.is_file()) {
                Some(cloud) => sure::add_cloud(&mut foreign, &vertices(&cloud)?),
                None => foreign.warn(
                    WarningKind::Damaged,
                    "no points: transforms.json names no PLY file that is there (ply_file_path)",
                ),
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
            opensfm::read(&bytes, rows.as_deref())
                .map_err(|fault| at(if fault.file == "tracks" { &tracks } else { path }, fault))?
        }
        ModelFormat::Nvm => nvm::read(&bytes, &size_of).map_err(|fault| at(path, fault))?,
        ModelFormat::OpenMvg => openmvg::read(&bytes).map_err(|fault| at(path, fault))?,
        ModelFormat::AliceVision => alicevision::read(&bytes).map_err(|fault| at(path, fault))?,
        _ => Mvs::read(&bytes).and_then(|mvs| mvs.model(&size_of)).map_err(|fault| at(path, fault))?,
    };
    foreign.shorten_names();
    Ok(foreign)
}

/// The vertices of a PLY file.
fn vertices(path: &Path) -> Result<Vec<nalgebra::Point3<f64>>, ProjectError> {
    let cloud = ply::read(&files::read(path)?).map_err(|error| ProjectError::Fault {
        fault: Fault::new("", Place::File, Problem::Json(error.to_string())),
        path: path.into(),
    })?;
    Ok(cloud.vertices)
}

/// Finds the image list of a bundle file: `list.rd.txt` for `*.rd.out`, `X.list.txt` for `X.bundle.out`, otherwise `list.txt` in its folder or
/// the one above; `imagelist.lst` is RealityCapture's.
fn bundler_list(bundle: &Path) -> Option<PathBuf> {
    let name = bundle.file_name()?.to_string_lossy();
    let own = name.strip_suffix("bundle.out").map(|stem| bundle.with_file_name(format!("{stem}list.txt")));
    let undistorted = name.ends_with(".rd.out").then(|| bundle.with_file_name("list.rd.txt"));
    let up = bundle.parent().and_then(Path::parent).map(|folder| folder.join("list.txt"));
    let beside = |name: &str| Some(bundle.with_file_name(name));
    let lists = [undistorted, own, beside("list.txt"), beside("imagelist.lst"), up];
    lists.into_iter().flatten().find(|path| path.is_file())
}

/// Finds the sparse cloud of a SURE project: NVM, Bundler or PLY.
fn sure_cloud(root: &Path) -> Option<(PathBuf, ModelFormat)> {
    let names = file_names(root);
    let endings = [(".nvm", ModelFormat::Nvm), (".out", ModelFormat::Bundler), (".ply", ModelFormat::Sure)];
    let first = |ending: &str| names.iter().find(|name| name.ends_with(ending)).map(|name| root.join(name));
    endings.into_iter().find_map(|(ending, format)| Some((first(ending)?, format)))
}

/// Reads oriented images, and points from an NVM or Bundler file (with tracks) or a PLY file (without).
fn read_sure(root: &Path, folder: &Path) -> Result<ForeignModel, ProjectError> {
    let mut oriented = Vec::new();
    for (n, path) in orientations(folder).iter().enumerate() {
        let found = sure::read(&files::read(path)?, n as u32 + 1);
        oriented.push(found.map_err(|fault| ProjectError::Fault { path: path.clone(), fault })?);
    }
    let candidates = images::candidates(root, folder);
    let mut foreign = sure::model(oriented, |name| images::with_extension(&candidates, name));
    match sure_cloud(root) {
        None => {
            let text = "no points: copy a sparse cloud (*.nvm, *.out or *.ply) or a mesh (*.ply) into the project's folder; if only the \
                        height of the ground is known, make a ground.ply with integrations/sure/ground.py";
            foreign.warn(WarningKind::Damaged, text)
        }
        Some((path, ModelFormat::Sure)) => sure::add_cloud(&mut foreign, &vertices(&path)?),
        Some((path, format)) => {
            let cloud = read(root, &ModelLocation { format, path: path.clone(), registered: 0 })?;
            foreign.model.warnings.extend(cloud.model.warnings.iter().cloned());
            sure::add_tracks(&mut foreign, &cloud)
                .map_err(|problem| ProjectError::Fault { fault: Fault::new("", Place::File, problem), path })?;
        }
    }
    Ok(foreign)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use crate::{io::project::Project, model::camera::CameraModel};

    fn folder(files: &[(&str, &str)]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for (name, text) in files {
            let path = folder.path().join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        }
        image::GrayImage::new(200, 100).save(folder.path().join("a.png")).unwrap();
        folder
    }

    #[test]
    fn a_bundle_of_realitycapture_has_paths_of_windows_in_its_list() {
        let bundle = "# Bundle file v0.3\n1 1\n100 0 0\n1 0 0\n0 1 0\n0 0 1\n0 0 -5\n1 2 3\n10 20 30\n1 0 0 -20 10\n";
        let folder = folder(&[("bundle.out", bundle), ("imagelist.lst", "C:\\photos\\a.png\r\n")]);
        let scene = Project::open(folder.path(), None).unwrap().read_scene().unwrap();
        assert_eq!((scene.views[0].name.as_str(), scene.track_pixels[0]), ("a.png", [80.0, 40.0]));
    }

    #[test]
    fn nerfstudio_has_its_points_beside() {
        let frame = |name: &str, x: f64| {
            format!(r#"{{"file_path":"{name}","transform_matrix":[[1,0,0,{x}],[0,1,0,0],[0,0,1,9],[0,0,0,1]]}}"#)
        };
        let frames = format!(r#""frames":[{},{}]"#, frame("a.png", 0.0), frame("b.png", 1.0));
        let json = format!(r#"{{"w":200,"h":100,"fl_x":90,"ply_file_path":"sparse_pc.ply",{frames}}}"#);
        let ply = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n0 0 0\n1 1 0\n";
        let folder = folder(&[("transforms.json", &json), ("sparse_pc.ply", ply)]);
        let scene = Project::open(folder.path(), None).unwrap().read_scene().unwrap();
        assert_eq!((scene.views.len(), scene.points.len(), scene.track_views.len()), (2, 2, 4));
        assert_eq!(scene.cameras[0].model(), CameraModel::Pinhole);
        // The first point lies before the first camera.
        assert_eq!(scene.track_pixels[0], [100.0, 50.0]);
    }
}
