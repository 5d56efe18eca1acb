//! Camera models: projection, its Jacobian, undistortion. The models and their parameter order are COLMAP's
//! (`sensor/models.h`); this file knows the list, [`lens`] the mathematics.

mod lens;

use nalgebra::{Matrix2x3, Point2, Point3, Unit, Vector2, Vector3};

use lens::Lens;

/// COLMAP's camera models, by their number.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
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

/// Model, COLMAP's name, number of focal lengths, number of parameters after the principal point.
const MODELS: [(CameraModel, &str, usize, usize); 18] = [
    (CameraModel::SimplePinhole, "SIMPLE_PINHOLE", 1, 0),
    (CameraModel::Pinhole, "PINHOLE", 2, 0),
    (CameraModel::SimpleRadial, "SIMPLE_RADIAL", 1, 1),
    (CameraModel::Radial, "RADIAL", 1, 2),
    (CameraModel::OpenCv, "OPENCV", 2, 4),
    (CameraModel::OpenCvFisheye, "OPENCV_FISHEYE", 2, 4),
    (CameraModel::FullOpenCv, "FULL_OPENCV", 2, 8),
    (CameraModel::Fov, "FOV", 2, 1),
    (CameraModel::SimpleRadialFisheye, "SIMPLE_RADIAL_FISHEYE", 1, 1),
    (CameraModel::RadialFisheye, "RADIAL_FISHEYE", 1, 2),
    (CameraModel::ThinPrismFisheye, "THIN_PRISM_FISHEYE", 2, 8),
    (CameraModel::RadTanThinPrismFisheye, "RAD_TAN_THIN_PRISM_FISHEYE", 2, 12),
    (CameraModel::SimpleDivision, "SIMPLE_DIVISION", 1, 1),
    (CameraModel::Division, "DIVISION", 2, 1),
    (CameraModel::SimpleFisheye, "SIMPLE_FISHEYE", 1, 0),
    (CameraModel::Fisheye, "FISHEYE", 2, 0),
    (CameraModel::Eucm, "EUCM", 2, 2),
    // Its two parameters are the image size.
    (CameraModel::Equirectangular, "EQUIRECTANGULAR", 0, 0),
];

impl CameraModel {
    /// All models, in the order of their numbers.
    pub fn all() -> impl ExactSizeIterator<Item = Self> {
        MODELS.iter().map(|m| m.0)
    }

    /// The model of that number in COLMAP's binary files.
    pub fn from_id(id: u32) -> Option<Self> {
        MODELS.get(id as usize).map(|m| m.0)
    }

    /// The model of that name in COLMAP's text files.
    pub fn from_name(name: &str) -> Option<Self> {
        MODELS.iter().find(|m| m.1 == name).map(|m| m.0)
    }

    pub fn id(self) -> u32 {
        self as u32
    }

    /// COLMAP's name, such as `SIMPLE_RADIAL`.
    pub fn name(self) -> &'static str {
        MODELS[self as usize].1
    }

    pub fn parameter_count(self) -> usize {
        let (_, _, focal_lengths, extra) = MODELS[self as usize];
        focal_lengths + 2 + extra
    }

    /// 1 (one focal length for both axes), 2, or 0 (equirectangular).
    pub fn focal_length_count(self) -> usize {
        MODELS[self as usize].2
    }
}

/// What is wrong with a set of intrinsics.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CameraError {
    #[error("{model} takes {expected} parameters, here are {found}")]
    ParameterCount { model: &'static str, expected: usize, found: usize },
    #[error("parameter {index} is {value}, not a finite number")]
    NotFinite { index: usize, value: f64 },
    #[error("focal length {0} is not above zero")]
    FocalLength(f64),
    #[error("the image is {width} x {height} pixels, which must be 1 to 4294967295 each")]
    ImageSize { width: u64, height: u64 },
}

/// A set of intrinsics: pixels of an image of `width` x `height`; the centre of the first pixel is at (0.5, 0.5).
#[derive(Clone, Debug, PartialEq)]
pub struct Camera {
    /// Id in the file.
    pub id: u32,
    pub width: u32,
    pub height: u32,
    model: CameraModel,
    params: Vec<f64>,
    /// The parameters made ready for projection.
    lens: Lens,
}

impl Camera {
    /// Checks the parameters, which are in COLMAP's order for the model.
    pub fn new(id: u32, model: CameraModel, width: u64, height: u64, params: Vec<f64>) -> Result<Self, CameraError> {
        let expected = model.parameter_count();
        if params.len() != expected {
            return Err(CameraError::ParameterCount { model: model.name(), expected, found: params.len() });
        }
        if let Some(index) = params.iter().position(|p| !p.is_finite()) {
            return Err(CameraError::NotFinite { index, value: params[index] });
        }
        // For an equirectangular image the two "focal lengths" are its width and height.
        let positive = model.focal_length_count() + if model == CameraModel::Equirectangular { 2 } else { 0 };
        if let Some(&bad) = params[..positive].iter().find(|&&f| f <= 0.0) {
            return Err(CameraError::FocalLength(bad));
        }
        let size = |n: u64| u32::try_from(n).ok().filter(|&n| n > 0);
        let (Some(w), Some(h)) = (size(width), size(height)) else {
            return Err(CameraError::ImageSize { width, height });
        };
        let lens = Lens::new(model, &params);
        Ok(Self { id, width: w, height: h, model, params, lens })
    }

    pub fn model(&self) -> CameraModel {
        self.model
    }

    /// In COLMAP's order for the model; finite, as many as the model has.
    pub fn params(&self) -> &[f64] {
        &self.params
    }

    /// Pixel of a point in camera coordinates; `None` where the model does not project it (behind the camera, or outside
    /// the field in which the projection is one to one).
    pub fn project(&self, x_cam: &Point3<f64>) -> Option<Point2<f64>> {
        self.lens.project(x_cam).map(Point2::from)
    }

    /// Pixel and the derivative of the pixel by the point in camera coordinates (px per scene unit).
    pub fn project_with_jacobian(&self, x_cam: &Point3<f64>) -> Option<(Point2<f64>, Matrix2x3<f64>)> {
        self.lens.project_with_jacobian(x_cam).map(|(p, j)| (Point2::from(p), j))
    }

    /// The formula of the model taken beyond the field in which it is one to one, as COLMAP's `img_from_cam` does it:
    /// for the reprojection error of an observation that is there; not for asking whether a point is seen.
    pub fn project_beyond_field(&self, x_cam: &Point3<f64>) -> Option<Point2<f64>> {
        self.lens.project_beyond_field(x_cam).map(Point2::from)
    }

    /// Distance in pixels between a measured pixel and the projection of a point, beyond the field too; `None` where there is
    /// no projection. Equirectangular images, whose pixels have no common scale, take the angle times the pixels per
    /// radian at the equator, as COLMAP does.
    pub fn reprojection_error(&self, x_cam: &Point3<f64>, measured: &Point2<f64>) -> Option<f64> {
        if self.model == CameraModel::Equirectangular {
            let angle = self.ray(measured)?.angle(&x_cam.coords);
            return Some(angle * f64::from(self.width) / std::f64::consts::TAU);
        }
        Some((self.project_beyond_field(x_cam)? - measured).norm())
    }

    /// Direction in camera coordinates (unit length) of the ray through a pixel; `None` where there is none.
    /// The inverse of [`Camera::project`] within its field.
    pub fn ray(&self, pixel: &Point2<f64>) -> Option<Unit<Vector3<f64>>> {
        self.lens.ray(pixel.coords)
    }

    /// What is divided by the focal length for the size of a pixel at a point: its z, or its distance in pictures of all directions (where
    /// nothing is behind the camera).
    pub fn depth(&self, x_cam: &Point3<f64>) -> f64 {
        if self.model == CameraModel::Equirectangular { x_cam.coords.norm() } else { x_cam.z }
    }

    /// Does the pixel lie in the image?
    pub fn contains(&self, pixel: &Point2<f64>) -> bool {
        pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x < f64::from(self.width) && pixel.y < f64::from(self.height)
    }

    /// The mean focal length in pixels (equirectangular: pixels per radian).
    pub fn mean_focal_length(&self) -> f64 {
        let (focal, _) = self.pinhole_part();
        0.5 * (focal.x + focal.y)
    }

    /// Focal lengths and principal point of the pinhole part, without distortion (equirectangular: pixels per radian and
    /// the centre of the image).
    pub fn pinhole_part(&self) -> (Vector2<f64>, Point2<f64>) {
        (self.lens.focal, Point2::from(self.lens.centre))
    }

    /// PINHOLE or SIMPLE_PINHOLE: no distortion at all.
    pub fn is_pinhole(&self) -> bool {
        matches!(self.model, CameraModel::SimplePinhole | CameraModel::Pinhole)
    }
}

#[cfg(test)]
mod tests;
