//! View frustums, which rule out that a camera sees any of many places.

use nalgebra::{Point2, Point3, Vector3};

use crate::model::{camera::Camera, scene::Pose};

/// Pixels by which the frustum is wider than the image, so that rounding errors don't matter.
const MARGIN: f64 = 1.0;

/// The planes through a pinhole camera's centre and the sides of its image, in world coordinates.
/// With lens distortion the sides are curved: such a frustum has no planes, and rules nothing out.
pub struct Frustum {
    /// Unit normals that point inwards, and the signed distance of the origin.
    planes: Vec<(Vector3<f64>, f64)>,
}

/// A bounding sphere.
pub struct Sphere {
    centre: Point3<f64>,
    radius: f64,
}

impl Sphere {
    /// Returns a bounding sphere of these points; `None` without any.
    pub fn around(mut places: impl Iterator<Item = Point3<f64>>) -> Option<Self> {
        let first = places.next()?;
        let (low, high) = places.fold((first, first), |(low, high), place| {
            (low.inf(&place), high.sup(&place))
        });
        // Around their box: larger than need be, but found in one pass.
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
        let plane = |i: usize| {
            let normal = rays[i]?.cross(&rays[(i + 1) % 4]?);
            let normal = pose.rotation.inverse() * normal.try_normalize(0.0)?;
            Some((normal, -normal.dot(&centre.coords)))
        };
        let planes: Option<Vec<_>> = (0..4).map(plane).collect();
        Self {
            planes: planes.filter(|_| camera.is_pinhole()).unwrap_or_default(),
        }
    }

    /// Returns whether the sphere may intersect the frustum; false only if it doesn't.
    pub fn may_see(&self, sphere: &Sphere) -> bool {
        self.planes
            .iter()
            .all(|(normal, offset)| normal.dot(&sphere.centre.coords) + offset >= -sphere.radius)
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
        fn spheres_around_visible_points_intersect(
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
            let alone = places.map(|place| Sphere::around([place].into_iter()).unwrap());
            prop_assert!(alone.iter().any(|sphere| frustum.may_see(sphere)) || !is_seen);
            let both = Sphere::around(places.into_iter()).unwrap();
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
            |x, y, z| frustum.may_see(&Sphere::around([Point3::new(x, y, z)].into_iter()).unwrap());
        assert!(sees(0.0, 0.0, 1.0));
        assert!(!sees(2.0, 0.0, 1.0) && !sees(0.0, -2.0, 1.0) && !sees(0.0, 0.0, -1.0));
    }
}
