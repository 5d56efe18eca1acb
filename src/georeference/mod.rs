//! Where on the earth a model lies, where that is known: by the settings, by what the program that made it wrote beside it, or by its
//! coordinates themselves.

mod ellipsoid;

use std::path::Path;

use nalgebra::{Matrix3, Point3, Vector3};
use serde::Deserialize;

pub use ellipsoid::{Geodetic, Zone};

use crate::{
    config::FrameSettings,
    input::{self, Kind},
    pictures::MapFrame,
    project::{ModelFormat, Project},
    scene::Scene,
};

/// How the coordinates of a model lie on the WGS 84 ellipsoid.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Georeference {
    /// Not known: coordinates are the model's own.
    Local,
    /// Earth-centred, earth-fixed.
    Ecef,
    /// East, north, up at an origin.
    EastNorthUp { origin: Vector3<f64>, axes: Matrix3<f64> },
    /// UTM; the offset is added to x and y.
    Utm { zone: Zone, offset: [f64; 2] },
}

/// Heights of survey cameras above the ellipsoid, metres.
const HEIGHTS: std::ops::RangeInclusive<f64> = -1000.0..=15_000.0;
/// Least cosine between what is up by the cameras and by the ellipsoid.
pub const UPRIGHT: f64 = 0.7;

impl Georeference {
    pub fn find(project: &Project, scene: &Scene, settings: &FrameSettings) -> Self {
        let said = Self::said(settings).or_else(|| Self::written(project));
        said.unwrap_or_else(|| if is_ecef(scene) { Self::Ecef } else { Self::Local })
    }

    /// By the settings.
    fn said(settings: &FrameSettings) -> Option<Self> {
        let utm = settings.utm.as_deref().and_then(Zone::parse);
        let utm = utm.map(|zone| Self::Utm { zone, offset: settings.offset.unwrap_or_default() });
        utm.or_else(|| {
            settings.origin.map(|[latitude, longitude, height]| Self::at(Geodetic { longitude, latitude, height }))
        })
    }

    /// By the files that OpenSfM and OpenDroneMap leave beside their models.
    fn written(project: &Project) -> Option<Self> {
        if project.model.format != ModelFormat::OpenSfm {
            return None;
        }
        let folder = project.model.path.parent()?;
        // OpenDroneMap keeps the model of before it moved to map coordinates under this name.
        if folder.join("reconstruction.topocentric.json").is_file() {
            return map_coordinates(&folder.parent()?.join("odm_georeferencing/coords.txt"));
        }
        let beside = read_json::<Reference>(&folder.join("reference_lla.json"));
        let inside = || read_json::<Vec<Reconstruction>>(&project.model.path)?.into_iter().next()?.reference_lla;
        let reference = beside.or_else(inside)?;
        Some(Self::at(Geodetic {
            longitude: reference.longitude,
            latitude: reference.latitude,
            height: reference.altitude,
        }))
    }

    fn at(origin: Geodetic) -> Self {
        Self::EastNorthUp { origin: origin.to_ecef(), axes: origin.east_north_up() }
    }

    /// Where a point of the model is; `None` where the model's place is not known.
    pub fn geodetic(&self, point: &Point3<f64>) -> Option<Geodetic> {
        match *self {
            Self::Local => None,
            Self::Ecef => Some(Geodetic::from_ecef(&point.coords)),
            Self::EastNorthUp { origin, axes } => Some(Geodetic::from_ecef(&(origin + axes * point.coords))),
            Self::Utm { zone, offset } => {
                Some(Geodetic::from_utm(zone, point.x + offset[0], point.y + offset[1], point.z))
            }
        }
    }

    /// What the coordinates of the model are, for people.
    pub fn words(&self) -> &'static str {
        match self {
            Self::Local => {
                "a local frame, x to the right and y up the map, scene units: where the model lies on the earth is not known \
                 (frame.origin or frame.utm says it)"
            }
            Self::Ecef => "earth-centred coordinates",
            Self::EastNorthUp { .. } => "metres east, north and up of an origin",
            Self::Utm { .. } => "UTM coordinates",
        }
    }
}

#[derive(Deserialize)]
struct Reference {
    latitude: f64,
    longitude: f64,
    altitude: f64,
}

#[derive(Deserialize)]
struct Reconstruction {
    reference_lla: Option<Reference>,
}

fn read_json<T: serde::de::DeserializeOwned>(path: &Path) -> Option<T> {
    serde_json::from_slice(&input::read(path, Kind::Sparse).ok()?).ok()
}

/// `WGS84 UTM 15N`, then the offset of the model's coordinates.
fn map_coordinates(path: &Path) -> Option<Georeference> {
    let text = input::read_text(path, Kind::Settings).ok()?;
    let mut lines = text.lines();
    let zone = Zone::parse(lines.next()?.strip_prefix("WGS84 UTM ")?)?;
    let mut numbers = lines.next()?.split_whitespace().map(str::parse);
    let offset = [numbers.next()?.ok()?, numbers.next()?.ok()?];
    Some(Georeference::Utm { zone, offset })
}

/// Earth-centred coordinates betray themselves: every camera lies near the ellipsoid, and up is away from the earth's centre. The latter
/// tells them from UTM coordinates whose northing happens to be an earth radius.
fn is_ecef(scene: &Scene) -> bool {
    let near = scene.views.iter().all(|view| {
        let centre = view.cam_from_world.centre().coords;
        centre.norm() > 6.0e6 && HEIGHTS.contains(&Geodetic::from_ecef(&centre).height)
    });
    if !near || scene.views.is_empty() {
        return false;
    }
    let up = MapFrame::new(scene, None).axes[2];
    let place = Geodetic::from_ecef(&scene.views[0].cam_from_world.centre().coords);
    place.east_north_up().column(2).dot(&up) > UPRIGHT
}

#[cfg(test)]
mod tests {
    use nalgebra::Rotation3;

    use super::*;
    use crate::{
        camera::{Camera, CameraModel},
        synthetic::Town,
    };

    fn town() -> Scene {
        let camera = Camera::new(1, CameraModel::Pinhole, 1000, 750, vec![850.0, 850.0, 500.0, 375.0]).unwrap();
        Town { points: 300, ..Town::new(camera) }.scene()
    }

    /// The scene turned and moved.
    fn moved(mut scene: Scene, rotation: Matrix3<f64>, translation: Vector3<f64>) -> Scene {
        let rotation = Rotation3::from_matrix_unchecked(rotation);
        scene.points.iter_mut().for_each(|p| *p = rotation * *p + translation);
        for view in &mut scene.views {
            let pose = &mut view.cam_from_world;
            pose.rotation *= rotation.inverse();
            pose.translation -= pose.rotation * translation;
        }
        scene
    }

    #[test]
    fn earth_centred_models_are_known_by_their_coordinates() {
        let place = Geodetic { longitude: -81.89, latitude: 41.4, height: 300.0 };
        assert!(!is_ecef(&town()));
        assert!(is_ecef(&moved(town(), place.east_north_up(), place.to_ecef())));
        let utm = moved(town(), Matrix3::identity(), Vector3::new(500_000.0, 6_355_000.0, 100.0));
        assert!(!is_ecef(&utm), "a northing of an earth radius");
    }

    #[test]
    fn a_point_east_of_the_origin_lies_east_of_it() {
        let settings = FrameSettings { origin: Some([30.171208, -98.089669, 394.0]), ..Default::default() };
        let frame = Georeference::said(&settings).unwrap();
        let origin = frame.geodetic(&Point3::origin()).unwrap();
        assert!((origin.latitude - 30.171208).abs() < 1e-12 && (origin.height - 394.0).abs() < 1e-6);
        let east = frame.geodetic(&Point3::new(100.0, 0.0, 0.0)).unwrap();
        assert!(east.longitude > origin.longitude + 0.001 && (east.latitude - origin.latitude).abs() < 1e-6);
    }
}
