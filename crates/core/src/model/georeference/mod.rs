//! Georeference of a model on the WGS 84 ellipsoid, and its upright frames.

mod ellipsoid;
mod fit;
mod frame;

use nalgebra::{Matrix3, Point3, Vector3};

pub use ellipsoid::{Geodetic, Zone};
pub use fit::{Fit, fit};
pub use frame::{MapFrame, UprightFrame, spread};

use super::scene::Scene;

/// Coordinate system of a model relative to the WGS 84 ellipsoid; lengths in metres except in
/// `Local`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Georeference {
    /// Unknown: the model has local coordinates.
    Local,
    /// Earth-centred, earth-fixed.
    Ecef,
    /// East, north, up of an origin; `origin` and the columns of `axes` are in ECEF coordinates.
    EastNorthUp {
        origin: Vector3<f64>,
        axes: Matrix3<f64>,
    },
    /// A point x of the model is `origin` + `axes` x in ECEF coordinates; `axes` has the scale.
    Fitted {
        origin: Vector3<f64>,
        axes: Matrix3<f64>,
        /// The GPS positions of images that it was fitted to; `None`: the program that made the
        /// model says so.
        support: Option<Support>,
    },
    /// UTM: x + `offset[0]` is the easting, y + `offset[1]` the northing.
    Utm { zone: Zone, offset: [f64; 2] },
}

/// Images that place a model.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Support {
    /// Images whose positions fit.
    pub fitting: usize,
    /// Images with a position.
    pub positions: usize,
    /// Median distance of the fitting positions from the cameras, metres.
    pub median: f64,
}

/// How to say where on earth a model is.
pub const SET_PLACE: &str =
    "set frame.utm (\"33N\") or frame.origin ([latitude, longitude, height]) in viewrank.toml";

/// Plausible heights of cameras above the ellipsoid, metres.
const HEIGHTS: std::ops::RangeInclusive<f64> = -1000.0..=15_000.0;
/// Least cosine of the angle between up in the model and up on the ellipsoid.
pub const UPRIGHT: f64 = 0.7;

impl Georeference {
    /// Returns `Ecef` if the camera positions are plausible ECEF coordinates, otherwise `Local`.
    pub fn from_coordinates(scene: &Scene) -> Self {
        if is_ecef(scene) {
            Self::Ecef
        } else {
            Self::Local
        }
    }

    /// Local east, north, up coordinates with their origin at `origin`.
    pub fn east_north_up(origin: Geodetic) -> Self {
        Self::EastNorthUp {
            origin: origin.to_ecef(),
            axes: origin.east_north_up(),
        }
    }

    /// Places a model by positions of its cameras, given in the same order as `centres`; `None` if
    /// they do not agree.
    pub fn fitted(centres: &[Vector3<f64>], positions: &[Geodetic]) -> Option<Self> {
        let middle = positions.get(positions.len() / 2)?;
        // Relative to one of them: earth-centred coordinates have seven digits before the point.
        let (centre, axes) = (middle.to_ecef(), middle.east_north_up());
        let local: Vec<Vector3<f64>> = positions
            .iter()
            .map(|p| axes.transpose() * (p.to_ecef() - centre))
            .collect();
        let Fit {
            similarity,
            inliers,
            median,
        } = fit(centres, &local)?;
        let support = Support {
            fitting: inliers,
            positions: positions.len(),
            median,
        };
        Some(Self::Fitted {
            origin: centre + axes * similarity.translation,
            axes: axes * similarity.linear,
            support: Some(support),
        })
    }

    /// Converts a point of the model to geodetic coordinates; `None` for `Local`.
    pub fn geodetic(&self, point: &Point3<f64>) -> Option<Geodetic> {
        match *self {
            Self::Local => None,
            Self::Ecef => Some(Geodetic::from_ecef(&point.coords)),
            Self::EastNorthUp { origin, axes } | Self::Fitted { origin, axes, .. } => {
                Some(Geodetic::from_ecef(&(origin + axes * point.coords)))
            }
            Self::Utm { zone, offset } => Some(Geodetic::from_utm(
                zone,
                point.x + offset[0],
                point.y + offset[1],
                point.z,
            )),
        }
    }

    /// Metres in a unit of the model; `None` for `Local`.
    pub fn metres_per_unit(&self) -> Option<f64> {
        match self {
            Self::Local => None,
            // A rotation times the scale.
            Self::Fitted { axes, .. } => Some(axes.determinant().abs().cbrt()),
            Self::Ecef | Self::EastNorthUp { .. } | Self::Utm { .. } => Some(1.0),
        }
    }

    /// Describes the coordinates for users.
    pub fn describe(&self) -> &'static str {
        match self {
            Self::Local => {
                "a local frame, x to the right and y up the map, scene units: the model has no georeference \
                 (frame.utm or frame.origin in viewrank.toml gives it one)"
            }
            Self::Ecef => "earth-centred coordinates",
            Self::Fitted {
                support: Some(_), ..
            } => "a local frame, placed on earth by the GPS positions of the images",
            Self::Fitted { support: None, .. } => {
                "a local frame, placed on earth by the program that made the model"
            }
            Self::EastNorthUp { .. } => "metres east, north and up of an origin",
            Self::Utm { .. } => "UTM coordinates",
        }
    }
}

/// Returns whether every camera is near the ellipsoid and up points away from the earth's centre.
/// The second condition excludes UTM coordinates whose northing happens to be near the earth's
/// radius.
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
    use crate::method::synthetic::Town;

    fn town() -> Scene {
        Town {
            points: 300,
            ..Town::default()
        }
        .scene()
    }

    /// Rotates and translates a scene.
    fn transformed(mut scene: Scene, rotation: Matrix3<f64>, translation: Vector3<f64>) -> Scene {
        let rotation = Rotation3::from_matrix_unchecked(rotation);
        scene
            .points
            .iter_mut()
            .for_each(|p| *p = rotation * *p + translation);
        for view in &mut scene.views {
            let pose = &mut view.cam_from_world;
            pose.rotation *= rotation.inverse();
            pose.translation -= pose.rotation * translation;
        }
        scene
    }

    #[test]
    fn ecef_models_are_recognised_by_their_coordinates() {
        let place = Geodetic {
            longitude: -81.89,
            latitude: 41.4,
            height: 300.0,
        };
        assert!(!is_ecef(&town()));
        assert!(is_ecef(&transformed(
            town(),
            place.east_north_up(),
            place.to_ecef()
        )));
        let utm = transformed(
            town(),
            Matrix3::identity(),
            Vector3::new(500_000.0, 6_355_000.0, 100.0),
        );
        assert!(!is_ecef(&utm), "a northing near the earth's radius");
    }

    #[test]
    fn the_scale_of_a_fitted_model_is_metres_in_a_unit() {
        let origin = Geodetic {
            latitude: 52.0,
            longitude: 21.0,
            height: 100.0,
        };
        let place = Georeference::east_north_up(origin);
        // A model in units of 5 m.
        let centres: Vec<Vector3<f64>> = (0..12)
            .map(|i| Vector3::new(f64::from(i % 4), f64::from(i / 4), 0.1 * f64::from(i % 3)))
            .collect();
        let positions: Vec<Geodetic> = centres
            .iter()
            .map(|centre| place.geodetic(&Point3::from(centre * 5.0)).unwrap())
            .collect();
        let fitted = Georeference::fitted(&centres, &positions).unwrap();
        assert!((fitted.metres_per_unit().unwrap() - 5.0).abs() < 1e-6);
        assert_eq!(place.metres_per_unit(), Some(1.0));
        assert_eq!(Georeference::Local.metres_per_unit(), None);
    }

    #[test]
    fn a_point_100_m_east_has_a_greater_longitude() {
        let frame = Georeference::east_north_up(Geodetic {
            latitude: 30.171208,
            longitude: -98.089669,
            height: 394.0,
        });
        let origin = frame.geodetic(&Point3::origin()).unwrap();
        assert!(
            (origin.latitude - 30.171208).abs() < 1e-12 && (origin.height - 394.0).abs() < 1e-6
        );
        let east = frame.geodetic(&Point3::new(100.0, 0.0, 0.0)).unwrap();
        assert!(
            east.longitude > origin.longitude + 0.001
                && (east.latitude - origin.latitude).abs() < 1e-6
        );
    }
}
