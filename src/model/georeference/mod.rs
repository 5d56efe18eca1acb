//! Places a model on the WGS 84 ellipsoid, and says which way is up in it.

mod ellipsoid;
mod frame;

use nalgebra::{Matrix3, Point3, Vector3};

pub use ellipsoid::{Geodetic, Zone};
pub use frame::{MapFrame, UprightFrame, spread};

use super::scene::Scene;

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
    /// Earth-centred where the coordinates say so, else not known.
    pub fn from_coordinates(scene: &Scene) -> Self {
        if is_ecef(scene) { Self::Ecef } else { Self::Local }
    }

    /// East, north and up at a place.
    pub fn at(origin: Geodetic) -> Self {
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
        method::synthetic::Town,
        model::camera::{Camera, CameraModel},
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
        let frame = Georeference::at(Geodetic { latitude: 30.171208, longitude: -98.089669, height: 394.0 });
        let origin = frame.geodetic(&Point3::origin()).unwrap();
        assert!((origin.latitude - 30.171208).abs() < 1e-12 && (origin.height - 394.0).abs() < 1e-6);
        let east = frame.geodetic(&Point3::new(100.0, 0.0, 0.0)).unwrap();
        assert!(east.longitude > origin.longitude + 0.001 && (east.latitude - origin.latitude).abs() < 1e-6);
    }
}
