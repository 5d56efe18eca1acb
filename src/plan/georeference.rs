//! Georeferences a project's model from the settings, the files of the program that made it, or its
//! coordinates.

use std::path::Path;

use nalgebra::Vector3;
use rayon::prelude::*;
use serde::Deserialize;

use crate::{
    base::input::{self, FileKind},
    config::{FrameSettings, Settings},
    io::{
        formats::exif,
        project::{ModelFormat, Project, ProjectError},
    },
    model::{
        georeference::{Geodetic, Georeference, Zone},
        scene::{Scene, View},
    },
};

/// The georeference of the project's model; [`Georeference::Local`] if unknown.
pub fn georeference(project: &Project, scene: &Scene, settings: &FrameSettings) -> Georeference {
    let known = from_settings(settings).or_else(|| from_files(project));
    let known = known.or(scene.georeference);
    match known.unwrap_or_else(|| Georeference::from_coordinates(scene)) {
        // Last, because it opens up to 300 images.
        Georeference::Local if settings.gps => {
            from_images(project, scene).unwrap_or(Georeference::Local)
        }
        known => known,
    }
}

/// Metres in a unit of the project's model, by its place on earth; `None` if unknown.
pub fn metres_per_unit(
    project: &Project,
    settings: &Settings,
) -> Result<Option<f64>, ProjectError> {
    let project = project.clone().with_images(settings.images.as_deref());
    let scene = project.read_scene()?;
    Ok(georeference(&project, &scene, &settings.frame).metres_per_unit())
}

/// Most images whose positions are read.
const MOST_POSITIONS: usize = 300;

/// Fits the model to the GPS positions in its images.
fn from_images(project: &Project, scene: &Scene) -> Option<Georeference> {
    let (centres, positions) = positions_in_images(project, scene);
    Georeference::fitted(&centres, &positions)
}

/// Returns the cameras of the images that say where on earth they were taken, scene units, and
/// where that was; of a part of the images, if there are many.
pub fn positions_in_images(project: &Project, scene: &Scene) -> (Vec<Vector3<f64>>, Vec<Geodetic>) {
    let Some(folder) = project.images.as_ref() else {
        return Default::default();
    };
    // Spread over all images: the first 300 may be of one flight line, which fixes no rotation.
    let step = scene.views.len().div_ceil(MOST_POSITIONS).max(1);
    let views: Vec<&View> = scene.views.iter().step_by(step).collect();
    let position = |view: &&View| {
        Some((
            view.cam_from_world.centre().coords,
            exif::position(&folder.file(&view.name))?,
        ))
    };
    views.par_iter().filter_map(position).unzip()
}

/// Says that the positions in the images do not place the model on earth, if there are any and
/// nothing else does.
pub fn unused_positions(project: &Project, settings: &Settings) -> Option<String> {
    let project = project.clone().with_images(settings.images.as_deref());
    let scene = project.read_scene().ok()?;
    let is_unplaced = georeference(&project, &scene, &settings.frame) == Georeference::Local;
    (settings.frame.gps && is_unplaced).then(|| unused_positions_of(&project, &scene))?
}

/// Says that the positions in the images of a model without a place on earth are not used.
pub fn unused_positions_of(project: &Project, scene: &Scene) -> Option<String> {
    let positions = positions_in_images(project, scene).1.len();
    (positions > 1).then(|| {
        format!(
            "The GPS positions of {positions} images are not used: they do not fit the model's cameras, or are on one line."
        )
    })
}

fn from_settings(settings: &FrameSettings) -> Option<Georeference> {
    let utm = settings.utm.as_deref().and_then(Zone::parse);
    let utm = utm.map(|zone| Georeference::Utm {
        zone,
        offset: settings.offset.unwrap_or_default(),
    });
    utm.or_else(|| {
        settings.origin.map(|[latitude, longitude, height]| {
            Georeference::east_north_up(Geodetic {
                longitude,
                latitude,
                height,
            })
        })
    })
}

/// Reads the files that OpenSfM and OpenDroneMap write next to their models.
fn from_files(project: &Project) -> Option<Georeference> {
    if project.model.format != ModelFormat::OpenSfm {
        return None;
    }
    let folder = project.model.path.parent()?;
    // OpenDroneMap keeps the model under this name when it moves it to map coordinates.
    if folder.join("reconstruction.topocentric.json").is_file() {
        return map_coordinates(&folder.parent()?.join("odm_georeferencing/coords.txt"));
    }
    let reference = read_json::<Reference>(&folder.join("reference_lla.json"))?;
    Some(Georeference::east_north_up(Geodetic {
        longitude: reference.longitude,
        latitude: reference.latitude,
        height: reference.altitude,
    }))
}

#[derive(Deserialize)]
struct Reference {
    latitude: f64,
    longitude: f64,
    altitude: f64,
}

fn read_json<T: serde::de::DeserializeOwned>(path: &Path) -> Option<T> {
    serde_json::from_str(&input::read_text(path, FileKind::Sparse).ok()?).ok()
}

/// Parses `coords.txt`: a line like `WGS84 UTM 15N`, then the offset of the model's coordinates.
fn map_coordinates(path: &Path) -> Option<Georeference> {
    let text = input::read_text(path, FileKind::Settings).ok()?;
    let mut lines = text.lines();
    let zone = Zone::parse(lines.next()?.strip_prefix("WGS84 UTM ")?)?;
    let mut numbers = lines.next()?.split_whitespace().map(str::parse);
    let offset = [numbers.next()?.ok()?, numbers.next()?.ok()?];
    Some(Georeference::Utm { zone, offset })
}
