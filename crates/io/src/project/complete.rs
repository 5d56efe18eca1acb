//! Completes models of which programs wrote a part: points of a PLY file beside the cameras,
//! observations by projection.

use std::{
    cmp::Reverse,
    path::{Path, PathBuf},
};

use nalgebra::Point3;
use viewrank_core::model::scene::{ModelWarning, WarningKind};

use super::{ModelFormat, ModelLocation, ProjectError, error, files, foreign::file_names};
use crate::{
    formats::{Place, Problem, cloud, colmap::ColmapModel},
    mistaken, ply,
};

/// Completes a model; `cloud`: the PLY file of its points, if it has none of its own.
pub(super) fn completed<'a>(
    mut model: ColmapModel<'a>,
    location: &ModelLocation,
    cloud: Option<PathBuf>,
) -> Result<ColmapModel<'a>, ProjectError> {
    if model.images.is_empty() {
        return Ok(model);
    }
    if !model.points.is_empty() {
        cloud::complete(&mut model);
        return Ok(model);
    }
    let (path, points) = match cloud {
        Some(path) => (Some(path.clone()), vertices(&path)?),
        None => (None, Vec::new()),
    };
    match path.filter(|_| !points.is_empty()) {
        None => model.warnings.push(no_points(location)),
        Some(path) if cloud::views_per_point(&model, &points) == 0.0 => {
            return Err(other_coordinates(&path, "no point projects into any image"));
        }
        Some(path) if cloud::is_far_away(&model, &points) => {
            return Err(other_coordinates(
                &path,
                "the points are far from the cameras",
            ));
        }
        Some(path) => {
            model.warnings.extend(other_clouds(location, &path));
            cloud::add_cloud(&mut model, &points);
        }
    }
    Ok(model)
}

/// The PLY file of the points beside a model, else in its project.
pub(super) fn cloud_beside(location: &ModelLocation) -> Option<PathBuf> {
    let mut clouds = folders_of_clouds(location).flat_map(clouds_in);
    clouds.next().map(|cloud| cloud.path)
}

/// The folder of a model, and that of the project whose `sparse` it is in.
fn folders_of_clouds(location: &ModelLocation) -> impl Iterator<Item = &Path> {
    let is_colmap = location.format.is_colmap();
    // Of COLMAP's models the path is a folder, of others a file in one.
    let own = Some(&*location.path).filter(|_| is_colmap);
    let mut above = own.into_iter().flat_map(|path| path.ancestors().take(2));
    let sparse = above.find(|folder| folder.ends_with("sparse"));
    let beside = own.or_else(|| location.path.parent());
    beside.into_iter().chain(sparse.and_then(Path::parent))
}

/// A PLY file.
pub(super) struct Cloud {
    pub path: PathBuf,
    /// Numbers of vertices and faces; `None` if its header cannot be read.
    counts: Option<[u64; 2]>,
}

/// The PLY files in a folder, best first: clouds before meshes, of most vertices.
pub(super) fn clouds_in(folder: &Path) -> Vec<Cloud> {
    let names = file_names(folder).into_iter();
    let clouds = names.filter(|name| name.to_ascii_lowercase().ends_with(".ply"));
    let mut clouds: Vec<Cloud> = clouds
        .map(|name| Cloud::examined(folder.join(name)))
        .collect();
    // A file whose header cannot be read still counts: alone, it is the one that the error names.
    clouds.sort_by_key(|cloud| {
        let is_mesh = cloud.counts.is_some_and(|[_, faces]| faces > 0);
        let vertices = cloud.counts.map_or(0, |[vertices, _]| vertices);
        (cloud.counts.is_none(), is_mesh, Reverse(vertices))
    });
    clouds
}

impl Cloud {
    fn examined(path: PathBuf) -> Self {
        let counts = ply::counts(&path);
        Self { path, counts }
    }

    fn in_words(&self) -> String {
        let name = self.path.file_name().unwrap_or_default().display();
        match self.counts {
            None => {
                let what = mistaken::of_file(&self.path).map_or("no PLY file", |file| file.what);
                format!("{name} ({what})")
            }
            Some([vertices, 0]) => format!("{name} ({vertices} points)"),
            Some([vertices, faces]) => {
                format!("{name} (a mesh of {vertices} vertices and {faces} faces)")
            }
        }
    }
}

/// Names the PLY file that the points are from, if others are beside it.
fn other_clouds(location: &ModelLocation, path: &Path) -> Option<ModelWarning> {
    let clouds = folders_of_clouds(location).flat_map(clouds_in);
    let others = clouds.filter(|cloud| cloud.path != path).take(NAMED);
    let others: Vec<String> = others.map(|cloud| cloud.in_words()).collect();
    let used = Cloud::examined(path.into()).in_words();
    let text = format!(
        "the points are those of {used}, not of {}",
        others.join(", ")
    );
    let cure =
        "no action needed; if another file has the points, take the others out of the folder";
    (!others.is_empty()).then(|| ModelWarning::new(WarningKind::Format, text).with_cure(cure))
}

/// PLY files that a warning names.
const NAMED: usize = 3;

/// The vertices of a PLY file.
pub(super) fn vertices(path: &Path) -> Result<Vec<Point3<f64>>, ProjectError> {
    let cloud = ply::read(&files::read(path)?)
        .map_err(|error| Problem::Content(error.to_string()).at(Place::File))
        .map_err(ProjectError::fault(path))?;
    Ok(cloud.vertices)
}

/// `how`: what shows it.
fn other_coordinates(path: &Path, how: &str) -> ProjectError {
    let what = format!("{how}: points and cameras are in different coordinates");
    let hint = "export both in the same coordinate system: of Metashape, the points in Local Coordinates, or of a georeferenced chunk in EPSG:4978";
    let problem = Problem::Unsupported { what, hint };
    ProjectError::fault(path)(problem.at(Place::File))
}

/// Says how the program that wrote a model without points gives them.
fn no_points(location: &ModelLocation) -> ModelWarning {
    let cure = match location.format {
        ModelFormat::ColmapBinary | ModelFormat::ColmapText => error::TO_GIVE_POINTS,
        ModelFormat::AliceVision => {
            "cameras.sfm of Meshroom's StructureFromMotion has poses only: convert the sfm.abc beside it (aliceVision_convertSfMFormat --input sfm.abc \
             --output sfm.sfm, or a node ConvertSfMFormat)"
        }
        ModelFormat::OpenMvg => {
            "convert the model with its structure: openMVG_main_ConvertSfM_DataFormat -V -I -E -S"
        }
        ModelFormat::Sure => {
            "copy a sparse cloud (*.nvm, *.out or *.ply) or a mesh (*.ply) into the project's folder; if only the height of the ground is known, \
             make a ground.ply with integrations/sure/ground.py"
        }
        ModelFormat::Transforms => {
            "copy the points as PLY, in the coordinates of the cameras, beside transforms.json (ply_file_path names it), or plan the COLMAP model that they come from"
        }
        _ => {
            "export the tie points or a cloud as PLY into the folder of the model, in the coordinates of the cameras (of a georeferenced chunk of Metashape: EPSG:4978)"
        }
    };
    ModelWarning::new(WarningKind::NoPoints, "the model has no points").with_cure(cure)
}
