//! The cameras of SfMData's intrinsics.

use serde::Deserialize;
use viewrank_core::model::camera::{Camera, CameraModel};

use super::values::{List, Number, OneOrTwo};
use crate::formats::{
    Fault, Problem,
    foreign::{brown, camera, fault_in, shift},
};

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Intrinsic {
    pub intrinsic_id: Number<u32>,
    width: Number<u64>,
    height: Number<u64>,
    sensor_width: Option<Number<f64>>,
    sensor_height: Option<Number<f64>>,
    #[serde(rename = "type")]
    kind: String,
    distortion_type: Option<String>,
    undistortion_type: Option<String>,
    focal_length: Option<Number<f64>>,
    px_focal_length: Option<OneOrTwo>,
    pixel_ratio: Option<Number<f64>>,
    #[serde(default)]
    principal_point: List<Number<f64>>,
    #[serde(default)]
    distortion_params: List<Number<f64>>,
}

impl Intrinsic {
    pub fn camera(&self, version: &[u32]) -> Result<Camera, Fault> {
        let id = self.intrinsic_id.0;
        let what = || format!("intrinsic {id}");
        let model = self.model(version);
        let (model, params) = model.map_err(|problem| fault_in(problem, what))?;
        let (width, height) = (self.width.0, self.height.0);
        camera(Camera::new(id, model, width, height, params), what)
    }

    /// COLMAP's model, and its parameters.
    fn model(&self, version: &[u32]) -> Result<(CameraModel, Vec<f64>), Problem> {
        let [fx, fy] = self.focal_lengths(version)?;
        let [cx, cy] = self.principal_point(version)?;
        let lower = |name: Option<&str>| name.unwrap_or_default().to_ascii_lowercase();
        let kind = lower(Some(&self.kind));
        let distortion = lower(self.distortion_type.as_deref());
        let undistortion = lower(self.undistortion_type.as_deref());
        let known = match undistortion.as_str() {
            "" | "none" => self.distorted(&kind, &distortion, [fx, fy, cx, cy])?,
            _ => None,
        };
        known.ok_or_else(|| {
            Problem::CameraModel(format!("{kind} {distortion} {undistortion} (AliceVision)"))
        })
    }

    /// Pixels.
    fn focal_lengths(&self, version: &[u32]) -> Result<[f64; 2], Problem> {
        match &self.px_focal_length {
            Some(OneOrTwo::One(f)) => return Ok([f.0; 2]),
            Some(OneOrTwo::Two(list)) => return list.numbers("pxFocalLength"),
            None => {}
        }
        let missing = || Problem::Content("focalLength is missing".into());
        let pixels_per_mm = self.width.0 as f64 / self.sensor_width.map_or(36.0, |w| w.0);
        let f = self.focal_length.ok_or_else(missing)?.0 * pixels_per_mm;
        let ratio = self.pixel_ratio.map_or(1.0, |r| r.0);
        // The meaning of the ratio changed twice.
        Ok(match version {
            v if v < &[1, 2, 5][..] => [f, f / ratio],
            v if v < &[1, 2, 11][..] => [f, f * ratio],
            _ => [f / ratio, f],
        })
    }

    /// Pixels.
    fn principal_point(&self, version: &[u32]) -> Result<[f64; 2], Problem> {
        let [x, y] = self.principal_point.numbers("principalPoint")?;
        let from_centre = version >= &[1, 2, 1][..];
        Ok(shift(if from_centre {
            let (w, h) = (self.width.0 as f64, self.height.0 as f64);
            [x + w / 2.0, y + h / 2.0]
        } else {
            [x, y]
        }))
    }

    /// COLMAP's model of this kind and distortion, both in lower case, and its parameters; `None`
    /// if there is none. `pinhole`: fx, fy, cx, cy.
    fn distorted(
        &self,
        kind: &str,
        distortion: &str,
        pinhole: [f64; 4],
    ) -> Result<Option<(CameraModel, Vec<f64>)>, Problem> {
        Ok(Some(match (kind, distortion) {
            ("pinhole", "" | "none") => (CameraModel::Pinhole, pinhole.to_vec()),
            ("radial1", _) | ("pinhole", "radialk1") => {
                let [k1] = self.distortion_params()?;
                brown(pinhole, [k1, 0.0, 0.0], [0.0; 2])
            }
            ("radial3", _) | ("pinhole", "radialk3") => {
                brown(pinhole, self.distortion_params()?, [0.0; 2])
            }
            ("brown", _) | ("pinhole", "brown") => {
                let [k1, k2, k3, t1, t2] = self.distortion_params()?;
                brown(pinhole, [k1, k2, k3], [t1, t2])
            }
            ("fisheye4", _) | ("pinhole", "fisheye") => {
                let k: [f64; 4] = self.distortion_params()?;
                (CameraModel::OpenCvFisheye, [pinhole, k].concat())
            }
            ("fisheye1", _) | ("pinhole", "fisheye1") => {
                let omega: [f64; 1] = self.distortion_params()?;
                (CameraModel::Fov, [&pinhole[..], &omega].concat())
            }
            ("equidistant", "" | "none") => (CameraModel::Fisheye, self.equidistant(pinhole)),
            _ => return Ok(None),
        }))
    }

    fn distortion_params<const N: usize>(&self) -> Result<[f64; N], Problem> {
        self.distortion_params.numbers("distortionParams")
    }

    /// Parameters of `FISHEYE`. The scale maps half of the field of view to a radius of 1.
    fn equidistant(&self, [fx, fy, cx, cy]: [f64; 4]) -> Vec<f64> {
        let (sensor_width, sensor_height) = (
            self.sensor_width.map_or(36.0, |w| w.0),
            self.sensor_height.map_or(24.0, |h| h.0),
        );
        let longest = self.width.0.max(self.height.0) as f64;
        let per_radian = 2.0 * fx * sensor_width / (longest * sensor_width.min(sensor_height));
        vec![fx * per_radian, fy * per_radian, cx, cy]
    }
}
