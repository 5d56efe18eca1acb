//! The ideal pinhole camera of a thumbnail.

use nalgebra::{Matrix3, Point3, Vector3};

use crate::model::scene::Pose;

/// Camera and pose of a thumbnail and of its map.
#[derive(Clone, Debug, PartialEq)]
pub struct Pinhole {
    /// Pixels.
    pub width: usize,
    pub height: usize,
    /// Focal lengths and principal point, pixels; the centre of the first pixel is (0, 0).
    pub focal: [f64; 2],
    pub centre: [f64; 2],
    pub pose: Pose,
}

impl Pinhole {
    /// Returns the direction of a pixel in camera coordinates, with z = 1.
    pub fn ray(&self, x: usize, y: usize) -> Vector3<f64> {
        let at = [x, y].map(|at| at as f64);
        Vector3::new(
            (at[0] - self.centre[0]) / self.focal[0],
            (at[1] - self.centre[1]) / self.focal[1],
            1.0,
        )
    }

    /// Returns the place of the world that a pixel shows at an inverse depth above 0.
    pub fn place(&self, pixel: usize, inverse: f64) -> Point3<f64> {
        let x = self.ray(pixel % self.width, pixel / self.width) / inverse;
        (self.pose.rotation.inverse() * (x - self.pose.translation)).into()
    }

    /// Returns the pixel that shows a place of the world, and the depth of the place; `None`
    /// outside the picture.
    pub fn pixel(&self, place: &Point3<f64>) -> Option<(usize, f64)> {
        let x = self.pose.camera_from_world(place);
        if x.z <= 0.0 {
            return None;
        }
        let column = self.focal[0] * x.x / x.z + self.centre[0] + 0.5;
        let row = self.focal[1] * x.y / x.z + self.centre[1] + 0.5;
        let inside =
            column >= 0.0 && row >= 0.0 && column < self.width as f64 && row < self.height as f64;
        inside.then(|| (row as usize * self.width + column as usize, x.z))
    }

    pub fn matrix(&self) -> Matrix3<f64> {
        let ([fx, fy], [cx, cy]) = (self.focal, self.centre);
        Matrix3::new(fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0)
    }
}
