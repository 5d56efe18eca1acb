//! Camera models: projection, its Jacobian, undistortion. Models and parameter order are COLMAP's
//! (`sensor/models.h`); `lens` has the mathematics.

mod lens;

use nalgebra::{Matrix2x3, Point2, Point3, Unit, Vector2, Vector3};

use crate::base::pixels::PixelBound;
use lens::Lens;

/// COLMAP's camera models, numbered as in its binary files.
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
    (
        CameraModel::SimpleRadialFisheye,
        "SIMPLE_RADIAL_FISHEYE",
        1,
        1,
    ),
    (CameraModel::RadialFisheye, "RADIAL_FISHEYE", 1, 2),
    (CameraModel::ThinPrismFisheye, "THIN_PRISM_FISHEYE", 2, 8),
    (
        CameraModel::RadTanThinPrismFisheye,
        "RAD_TAN_THIN_PRISM_FISHEYE",
        2,
        12,
    ),
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

    /// Finds a model by its number in COLMAP's binary files.
    pub fn from_id(id: u32) -> Option<Self> {
        MODELS.get(id as usize).map(|m| m.0)
    }

    /// Finds a model by its name in COLMAP's text files.
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

    /// Number of focal lengths: 1 (the same for both axes), 2, or 0 (equirectangular).
    pub fn focal_length_count(self) -> usize {
        MODELS[self as usize].2
    }
}

/// Invalid intrinsics.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CameraError {
    #[error("{model} takes {expected} parameters, found {found}")]
    ParameterCount {
        model: &'static str,
        expected: usize,
        found: usize,
    },
    #[error("parameter {index} is {value}, not a finite number")]
    NotFinite { index: usize, value: f64 },
    #[error("focal length {0} is not positive")]
    FocalLength(f64),
    #[error("image size {width} x {height} is not 1 to {MOST_PIXELS} pixels")]
    ImageSize { width: u64, height: u64 },
}

/// Intrinsics of an image of `width` x `height` pixels; the centre of the first pixel is at (0.5,
/// 0.5).
#[derive(Clone, Debug, PartialEq)]
pub struct Camera {
    /// Camera id in the source file.
    pub id: u32,
    pub width: u32,
    pub height: u32,
    model: CameraModel,
    params: Vec<f64>,
    /// `params`, prepared for projection.
    lens: Lens,
}

/// Largest difference of aspect ratios that is taken for rounding; almost any image of a few pixels
/// could be explained by it otherwise.
const LARGEST_ROUNDING: f64 = 0.02;

/// Most pixels of a camera: more than a scan of aerial film (23 cm at 8 µm). The triangles of the
/// surface, and the time for them, are in proportion.
const MOST_PIXELS: u64 = 1 << 30;

/// Pixels up to which an image may have more than its camera: models are made from scaled copies,
/// too.
const COPY_PIXELS: u64 = 1 << 25;

fn check_params(model: CameraModel, params: &[f64]) -> Result<(), CameraError> {
    let expected = model.parameter_count();
    if params.len() != expected {
        return Err(CameraError::ParameterCount {
            model: model.name(),
            expected,
            found: params.len(),
        });
    }
    if let Some(index) = params.iter().position(|p| !p.is_finite()) {
        return Err(CameraError::NotFinite {
            index,
            value: params[index],
        });
    }
    // For an equirectangular image the two "focal lengths" are its width and height.
    let positive = model.focal_length_count()
        + if model == CameraModel::Equirectangular {
            2
        } else {
            0
        };
    if let Some(&bad) = params[..positive].iter().find(|&&f| f <= 0.0) {
        return Err(CameraError::FocalLength(bad));
    }
    Ok(())
}

impl Camera {
    /// Makes a camera from parameters in COLMAP's order for the model.
    ///
    /// # Errors
    /// If the number of parameters, one of their values or the image size is invalid.
    pub fn new(
        id: u32,
        model: CameraModel,
        width: u64,
        height: u64,
        params: Vec<f64>,
    ) -> Result<Self, CameraError> {
        check_params(model, &params)?;
        let size = |n: u64| u32::try_from(n).ok().filter(|&n| n > 0);
        let fits = width.saturating_mul(height) <= MOST_PIXELS;
        let (Some(w), Some(h), true) = (size(width), size(height), fits) else {
            return Err(CameraError::ImageSize { width, height });
        };
        let lens = Lens::new(model, &params);
        Ok(Self {
            id,
            width: w,
            height: h,
            model,
            params,
            lens,
        })
    }

    pub fn model(&self) -> CameraModel {
        self.model
    }

    /// Parameters in COLMAP's order for the model; all finite.
    pub fn params(&self) -> &[f64] {
        &self.params
    }

    /// Projects a point in camera coordinates to a pixel; `None` if it is behind the camera or
    /// outside the field in which the projection is one to one.
    pub fn project(&self, x_cam: &Point3<f64>) -> Option<Point2<f64>> {
        self.lens.project(x_cam).map(Point2::from)
    }

    /// Projects a point and returns the Jacobian of the pixel with respect to the point in camera
    /// coordinates, pixels per scene unit; `None` as for [`Camera::project`].
    pub fn project_with_jacobian(
        &self,
        x_cam: &Point3<f64>,
    ) -> Option<(Point2<f64>, Matrix2x3<f64>)> {
        self.lens
            .project_with_jacobian(x_cam)
            .map(|(p, j)| (Point2::from(p), j))
    }

    /// Projects a point even outside the field in which the model is one to one, like COLMAP's
    /// `img_from_cam`. For reprojection errors of measured observations, not for visibility tests.
    pub fn project_beyond_field(&self, x_cam: &Point3<f64>) -> Option<Point2<f64>> {
        self.lens.project_beyond_field(x_cam).map(Point2::from)
    }

    /// Distance in pixels between a measured pixel and the projection of a point
    /// ([`Camera::project_beyond_field`]); `None` without a projection. Pixels of equirectangular
    /// images have no common scale: there the error is the angle between the rays times the pixels
    /// per radian at the equator, as in COLMAP.
    pub fn reprojection_error(&self, x_cam: &Point3<f64>, measured: &Point2<f64>) -> Option<f64> {
        if self.model == CameraModel::Equirectangular {
            let angle = self.ray(measured)?.angle(&x_cam.coords);
            return Some(angle * f64::from(self.width) / std::f64::consts::TAU);
        }
        Some((self.project_beyond_field(x_cam)? - measured).norm())
    }

    /// Unit direction, in camera coordinates, of the ray through a pixel: the inverse of
    /// [`Camera::project`]. `None` if no point of the field projects to the pixel.
    pub fn ray(&self, pixel: &Point2<f64>) -> Option<Unit<Vector3<f64>>> {
        self.lens.ray(pixel.coords)
    }

    /// Depth of a point, scene units; divided by the focal length it gives the size of a pixel
    /// there. It is z, and the distance from the centre for equirectangular images, where no point
    /// is behind the camera.
    pub fn depth(&self, x_cam: &Point3<f64>) -> f64 {
        if self.model == CameraModel::Equirectangular {
            x_cam.coords.norm()
        } else {
            x_cam.z
        }
    }

    /// Returns whether the pixel is inside the image.
    pub fn contains(&self, pixel: &Point2<f64>) -> bool {
        pixel.x >= 0.0
            && pixel.y >= 0.0
            && pixel.x < f64::from(self.width)
            && pixel.y < f64::from(self.height)
    }

    /// Mean of the two focal lengths, pixels (equirectangular: pixels per radian).
    pub fn mean_focal_length(&self) -> f64 {
        let (focal, _) = self.pinhole_part();
        0.5 * (focal.x + focal.y)
    }

    /// Focal lengths and principal point, pixels: the camera without its distortion
    /// (equirectangular: pixels per radian and the image centre).
    pub fn pinhole_part(&self) -> (Vector2<f64>, Point2<f64>) {
        (self.lens.focal, Point2::from(self.lens.centre))
    }

    /// Pixels that a depth map of this camera may have; programs round sides up.
    pub fn most_map_pixels(&self) -> PixelBound {
        PixelBound::new((u64::from(self.width) + 1).saturating_mul(u64::from(self.height) + 1))
    }

    /// Pixels that an image or a mask of this camera may have: as many as the camera, or as a
    /// picture of `COPY_PIXELS`.
    pub fn most_picture_pixels(&self) -> PixelBound {
        PixelBound::new((u64::from(self.width) * u64::from(self.height)).max(COPY_PIXELS))
    }

    /// Returns whether an image of this width and height has the aspect ratio of the camera's, up
    /// to the rounding of their sides.
    pub fn has_aspect_ratio_of(&self, [width, height]: [u32; 2]) -> bool {
        let [width, height, own_width, own_height] =
            [width, height, self.width, self.height].map(f64::from);
        let rounding = 1.0 / width + 1.0 / height + 1.0 / own_width + 1.0 / own_height;
        (width * own_height / (height * own_width) - 1.0).abs() <= rounding.min(LARGEST_ROUNDING)
    }

    /// The camera as PINHOLE if its model is that with distortion and the distortion is zero but
    /// for rounding, as in models of images that a program has undistorted; many backends take
    /// pinhole cameras only.
    pub fn without_zero_distortion(self) -> Self {
        use CameraModel::{
            Division, Eucm, Fov, FullOpenCv, OpenCv, Pinhole, Radial, SimpleDivision, SimpleRadial,
        };
        // It moves no ray that an image shows by a millionth of a pixel.
        let is_zero = |parameter: &f64| parameter.abs() < 1e-12;
        let are_zero = |parameters: &[f64]| parameters.iter().all(is_zero);
        let params = match (self.model, &self.params[..]) {
            (SimpleRadial | Radial | SimpleDivision, &[f, cx, cy, ref k @ ..]) if are_zero(k) => {
                vec![f, f, cx, cy]
            }
            (OpenCv | FullOpenCv | Fov | Division, &[fx, fy, cx, cy, ref k @ ..])
                if are_zero(k) =>
            {
                vec![fx, fy, cx, cy]
            }
            // Without alpha, beta has no effect.
            (Eucm, [intrinsics @ .., alpha, _]) if is_zero(alpha) => intrinsics.to_vec(),
            _ => return self,
        };
        Self {
            lens: Lens::new(Pinhole, &params),
            model: Pinhole,
            params,
            ..self
        }
    }

    /// Returns whether the model is PINHOLE or SIMPLE_PINHOLE, without distortion.
    pub fn is_pinhole(&self) -> bool {
        matches!(
            self.model,
            CameraModel::SimplePinhole | CameraModel::Pinhole
        )
    }
}

#[cfg(test)]
mod tests;
