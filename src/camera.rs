//! Camera models: projection, its Jacobian, undistortion. The models and their parameter order are COLMAP's.

use nalgebra::{Matrix2x3, Point2, Point3, Vector2};

/// COLMAP's camera models, by their number.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(u32)]
pub enum CameraModel {
    SimplePinhole = 0,
    Pinhole = 1,
    SimpleRadial = 2,
    Radial = 3,
    OpenCv = 4,
    OpenCvFisheye = 5,
    FullOpenCv = 6,
    Fov = 7,
    SimpleRadialFisheye = 8,
    RadialFisheye = 9,
    ThinPrismFisheye = 10,
    RadTanThinPrismFisheye = 11,
    SimpleDivision = 12,
    Division = 13,
    SimpleFisheye = 14,
    Fisheye = 15,
    Eucm = 16,
    Equirectangular = 17,
}

/// A set of intrinsics: pixels of an image of `width` x `height`; the centre of the first pixel is at (0.5, 0.5).
#[derive(Clone, Debug, PartialEq)]
pub struct Camera {
    /// Id in the file.
    pub id: u32,
    pub model: CameraModel,
    pub width: u32,
    pub height: u32,
    /// In COLMAP's order for the model; finite, as many as the model has.
    pub params: Vec<f64>,
}

impl Camera {
    /// Pixel of a point in camera coordinates; `None` where the model does not project it (behind the camera, or outside
    /// the field in which the projection is one to one).
    pub fn project(&self, x_cam: &Point3<f64>) -> Option<Point2<f64>> {
        let _ = x_cam;
        None
    }

    /// Pixel and the derivative of the pixel by the point in camera coordinates (px per scene unit).
    pub fn project_with_jacobian(&self, x_cam: &Point3<f64>) -> Option<(Point2<f64>, Matrix2x3<f64>)> {
        let _ = x_cam;
        None
    }

    /// Direction in camera coordinates (unit length) of the ray through a pixel; `None` where there is none.
    pub fn ray(&self, pixel: &Point2<f64>) -> Option<nalgebra::Unit<nalgebra::Vector3<f64>>> {
        let _ = pixel;
        None
    }

    /// Does the pixel lie in the image?
    pub fn contains(&self, pixel: &Point2<f64>) -> bool {
        pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x < f64::from(self.width) && pixel.y < f64::from(self.height)
    }

    /// The mean focal length in pixels (equirectangular: pixels per radian).
    pub fn mean_focal_length(&self) -> f64 {
        0.0
    }

    /// Focal lengths and principal point of the pinhole part, without distortion.
    pub fn pinhole_part(&self) -> (Vector2<f64>, Point2<f64>) {
        (Vector2::zeros(), Point2::origin())
    }

    /// PINHOLE or SIMPLE_PINHOLE: no distortion at all.
    pub fn is_pinhole(&self) -> bool {
        matches!(self.model, CameraModel::SimplePinhole | CameraModel::Pinhole)
    }
}
