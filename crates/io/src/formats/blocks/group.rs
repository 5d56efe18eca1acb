//! The camera that the photos of a group share.

use std::collections::HashMap;

use nalgebra::{Matrix3, Vector3};
use viewrank_core::model::camera::{Camera, CameraModel};

use crate::formats::{
    Fault, Place, Problem,
    foreign::{brown, camera, shift},
    xml::Element,
};

/// Elements of a group that are read, beside its photos.
const PARTS: [&str; 11] = [
    "AspectRatio",
    "CameraModelType",
    "CameraOrientation",
    "Distortion",
    "FocalLength",
    "FocalLengthPixels",
    "ImageDimensions",
    "PixelSize",
    "PrincipalPoint",
    "SensorSize",
    "Skew",
];

/// The parameters that all photos of a group share.
pub(super) struct Group {
    /// From 1, in the order of the file.
    id: u32,
    at: Place,
    parts: HashMap<String, Element>,
    /// Axes of the camera in COLMAP's, once it is read.
    axes: Option<Matrix3<f64>>,
}

impl Group {
    pub fn new(id: u32, at: Place) -> Self {
        Self {
            id,
            at,
            parts: HashMap::new(),
            axes: None,
        }
    }

    /// Id of the group and of its camera.
    pub fn id(&self) -> u32 {
        self.id
    }

    /// Returns whether an element of this name is still to be read.
    pub fn wants(&self, name: &str) -> bool {
        PARTS.contains(&name) && !self.parts.contains_key(name)
    }

    pub fn add(&mut self, part: Element) {
        self.parts.insert(part.name.clone(), part);
    }

    /// Returns the axes of the camera, which is read, and added to `cameras`, for the first photo.
    pub fn axes(&mut self, cameras: &mut Vec<Camera>) -> Result<Matrix3<f64>, Fault> {
        if let Some(axes) = self.axes {
            return Ok(axes);
        }
        let (camera, axes) = self
            .read()
            .map_err(|fault| fault.in_record(|| format!("photogroup {}", self.id)))?;
        cameras.push(camera);
        Ok(*self.axes.insert(axes))
    }

    fn part(&self, name: &'static str) -> Result<&Element, Fault> {
        let missing = || Problem::syntax(name, "a photogroup without it");
        self.parts.get(name).ok_or_else(|| missing().at(self.at))
    }

    fn number(&self, name: &str) -> Result<Option<f64>, Fault> {
        self.parts
            .get(name)
            .map(|part| part.numbers::<1>().map(|[value]| value))
            .transpose()
    }

    /// Returns the camera that the photos share, and its axes.
    fn read(&self) -> Result<(Camera, Matrix3<f64>), Fault> {
        let [w, h] = self
            .part("ImageDimensions")?
            .required(["Width", "Height"])?;
        let axes = self.orientation()?;
        let kind = self.text_or("CameraModelType", "Perspective");
        let (model, params) = match kind {
            "Spherical" => (CameraModel::Equirectangular, vec![w, h]),
            "Perspective" => self.perspective([w, h])?,
            _ => {
                let problem = Problem::CameraModel(format!("{kind} (BlocksExchange)"));
                return Err(problem.at(self.at));
            }
        };
        let found = Camera::new(self.id, model, w as u64, h as u64, params);
        Ok((camera(found, || "its camera".into())?, axes))
    }

    fn text_or<'a>(&'a self, name: &str, default: &'a str) -> &'a str {
        self.parts.get(name).map_or(default, Element::text)
    }

    fn orientation(&self) -> Result<Matrix3<f64>, Fault> {
        let name = "CameraOrientation";
        axes(self.text_or(name, "XRightYDown")).ok_or_else(|| {
            let found: String = self.text_or(name, "").chars().take(40).collect();
            Problem::syntax("a CameraOrientation such as XRightYDown", found).at(self.at)
        })
    }

    /// COLMAP's model, and its parameters.
    fn perspective(&self, [w, h]: [f64; 2]) -> Result<(CameraModel, Vec<f64>), Fault> {
        let focal = self.focal_px(w.max(h))?;
        let [cx, cy] = match self.parts.get("PrincipalPoint") {
            Some(point) => principal_point(point)?,
            None => [w / 2.0, h / 2.0],
        };
        self.refuse_skew(h, focal)?;
        let k = [
            self.distortion("K1")?,
            self.distortion("K2")?,
            self.distortion("K3")?,
        ];
        // OpenCV's p1 and p2 are the other way round.
        let (p2, p1) = (self.distortion("P1")?, self.distortion("P2")?);
        let fy = focal * self.number("AspectRatio")?.unwrap_or(1.0);
        Ok(brown([focal, fy, cx, cy], k, [p1, p2]))
    }

    /// A term of the distortion; 0 without it.
    fn distortion(&self, name: &str) -> Result<f64, Fault> {
        let distortion = self.parts.get("Distortion");
        let term = distortion.map_or(Ok(None), |distortion| distortion.number(name));
        term.map(Option::unwrap_or_default)
    }

    /// `longer`: side of the image, pixels; it is as long as SensorSize.
    fn focal_px(&self, longer: f64) -> Result<f64, Fault> {
        if let Some(focal) = self.number("FocalLengthPixels")? {
            return Ok(focal);
        }
        let [focal_mm] = self.part("FocalLength")?.numbers()?;
        Ok(match self.number("PixelSize")? {
            Some(pixel_mm) => focal_mm / pixel_mm,
            None => focal_mm * longer / self.part("SensorSize")?.numbers::<1>()?[0],
        })
    }

    fn refuse_skew(&self, height: f64, focal: f64) -> Result<(), Fault> {
        let skew = self.number("Skew")?.unwrap_or_default();
        // Half a pixel is less than other errors of a camera.
        if (skew * height / 2.0 / focal).abs() <= 0.5 {
            return Ok(());
        }
        let what = format!("a camera with skew ({skew}), which COLMAP's models do not have");
        let hint = "export undistorted photos with their block";
        Err(Problem::Unsupported { what, hint }.at(self.at))
    }
}

fn principal_point(point: &Element) -> Result<[f64; 2], Fault> {
    if point.child("xmm").is_some() {
        let what = "the principal point is in millimetres".into();
        let hint = "export the block with the principal point in pixels";
        return Err(Problem::Unsupported { what, hint }.at(point.at()));
    }
    Ok(shift(point.required(["x", "y"])?))
}

/// The camera's axes as columns, in COLMAP's (x right, y down), from a name such as `XRightYUp`.
pub(super) fn axes(orientation: &str) -> Option<Matrix3<f64>> {
    let (x, y) = orientation.strip_prefix('X')?.split_once('Y')?;
    let axis = |name: &str| match name {
        "Right" => Some(Vector3::x()),
        "Left" => Some(-Vector3::x()),
        "Down" => Some(Vector3::y()),
        "Up" => Some(-Vector3::y()),
        _ => None,
    };
    let (x, y) = (axis(x)?, axis(y)?);
    (x.dot(&y) == 0.0).then(|| Matrix3::from_columns(&[x, y, x.cross(&y)]))
}
