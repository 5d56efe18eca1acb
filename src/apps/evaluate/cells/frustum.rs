//! What a camera cannot see, found without looking at each place.

use nalgebra::{Point2, Point3, Vector3};

use crate::model::{camera::Camera, scene::Pose};

/// Pixels around the image in which places still count as seen: rounding decides nothing.
const MARGIN: f64 = 1.0;

/// The half spaces of the world that hold all that a pinhole camera sees. The frames of other cameras
/// are bent: they have none, and may see everything.
pub struct Frustum {
    /// Unit normals towards the inside, with the distance of the world's origin.
    sides: Vec<(Vector3<f64>, f64)>,
}

/// A ball around places.
pub struct Ball {
    centre: Point3<f64>,
    radius: f64,
}

impl Ball {
    /// Returns a ball that holds these places; `None` if there are none.
    pub fn around(mut places: impl Iterator<Item = Point3<f64>>) -> Option<Self> {
        let first = places.next()?;
        let (low, high) = places.fold((first, first), |(low, high), place| {
            (low.inf(&place), high.sup(&place))
        });
        let centre = nalgebra::center(&low, &high);
        Some(Self {
            centre,
            radius: (high - centre).norm(),
        })
    }
}

impl Frustum {
    pub fn new(camera: &Camera, pose: &Pose) -> Self {
        let (width, height) = (f64::from(camera.width), f64::from(camera.height));
        let (left, top) = (-MARGIN, -MARGIN);
        let (right, bottom) = (width + MARGIN, height + MARGIN);
        let corners = [(left, top), (right, top), (right, bottom), (left, bottom)];
        let ray = |(x, y): (f64, f64)| Some(camera.ray(&Point2::new(x, y))?.into_inner());
        let rays = corners.map(ray);
        let centre = pose.centre();
        let side = |i: usize| {
            let normal = rays[i]?.cross(&rays[(i + 1) % 4]?);
            let normal = pose.rotation.inverse() * normal.try_normalize(0.0)?;
            Some((normal, -normal.dot(&centre.coords)))
        };
        let sides: Option<Vec<_>> = (0..4).map(side).collect();
        Self {
            sides: sides.filter(|_| camera.is_pinhole()).unwrap_or_default(),
        }
    }

    /// Returns whether a part of the ball may be seen; false only if none is.
    pub fn may_see(&self, ball: &Ball) -> bool {
        self.sides
            .iter()
            .all(|(normal, offset)| normal.dot(&ball.centre.coords) + offset >= -ball.radius)
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Rotation3;
    use proptest::prelude::*;

    use super::*;
    use crate::model::camera::CameraModel;

    fn camera() -> Camera {
        let params = vec![90.0, 110.0, 40.0, 35.0];
        Camera::new(1, CameraModel::Pinhole, 100, 60, params).unwrap()
    }

    fn vector(range: f64) -> impl Strategy<Value = Vector3<f64>> {
        prop::array::uniform3(-range..range).prop_map(Vector3::from)
    }

    proptest! {
        #[test]
        fn what_is_seen_is_in_no_ball_that_is_not(
            turn in vector(4.0),
            translation in vector(10.0),
            place in vector(20.0),
            other in vector(20.0),
        ) {
            let (camera, rotation) = (camera(), Rotation3::new(turn));
            let pose = Pose { rotation, translation };
            let frustum = Frustum::new(&camera, &pose);
            let places = [place, other].map(Point3::from);
            let is_seen = places.iter().any(|place| {
                let x = pose.camera_from_world(place);
                x.z > 0.0 && camera.project(&x).is_some_and(|pixel| camera.contains(&pixel))
            });
            let alone = places.map(|place| Ball::around([place].into_iter()).unwrap());
            prop_assert_eq!(alone.iter().any(|ball| frustum.may_see(ball)) || !is_seen, true);
            let both = Ball::around(places.into_iter()).unwrap();
            prop_assert!(frustum.may_see(&both) || !is_seen);
        }
    }

    #[test]
    fn most_of_the_world_is_not_seen() {
        let pose = Pose {
            rotation: Rotation3::identity(),
            translation: Vector3::zeros(),
        };
        let frustum = Frustum::new(&camera(), &pose);
        let sees =
            |x, y, z| frustum.may_see(&Ball::around([Point3::new(x, y, z)].into_iter()).unwrap());
        assert!(sees(0.0, 0.0, 1.0));
        assert!(!sees(2.0, 0.0, 1.0) && !sees(0.0, -2.0, 1.0) && !sees(0.0, 0.0, -1.0));
    }
}
