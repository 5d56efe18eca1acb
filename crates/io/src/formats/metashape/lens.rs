//! The cameras of Metashape's sensors.

use viewrank_core::model::{
    camera::{Camera, CameraModel},
    scene::WarningKind,
};

use super::super::{
    Fault, Problem,
    foreign::{ForeignModel, brown, camera},
    xml::Element,
};

/// Largest error in pixels that leaving out a term of the distortion may cause.
const NEGLIGIBLE_PX: f64 = 0.5;

/// The camera of a sensor, and by how many pixels the terms that COLMAP's models lack move the
/// corner of an image.
#[derive(Clone)]
pub(super) struct Lens {
    pub camera: Camera,
    left_out_px: f64,
}

impl Lens {
    pub fn read(sensor: &Element, id: u32) -> Result<Self, Fault> {
        let calibration = adjusted_calibration(sensor);
        let kind = [calibration, Some(sensor)]
            .into_iter()
            .flatten()
            .find_map(|element| element.attribute("type"));
        let kind = kind.unwrap_or("frame");
        let [width, height] = size(sensor, calibration)?;
        let sides = [width as f64, height as f64];
        let projection = match kind {
            // Panoramas have no calibration.
            "spherical" => Projection {
                model: CameraModel::Equirectangular,
                params: sides.to_vec(),
                left_out_px: 0.0,
            },
            _ => {
                let calibration = calibration.ok_or_else(|| sensor.lacks("calibration"))?;
                calibrated(kind, sensor, calibration, sides)?
            }
        };
        let Projection { model, params, .. } = projection;
        let lens = Camera::new(id, model, width, height, params);
        Ok(Self {
            camera: camera(lens, || "its camera".into())?,
            left_out_px: projection.left_out_px,
        })
    }

    /// Warns of the lens that loses most.
    pub fn warn(lenses: &[Self], foreign: &mut ForeignModel) {
        let losing = || {
            lenses
                .iter()
                .filter(|lens| lens.left_out_px > NEGLIGIBLE_PX)
        };
        let Some(most) = losing().max_by(|a, b| a.left_out_px.total_cmp(&b.left_out_px)) else {
            return;
        };
        let (id, left_out) = (most.camera.id, most.left_out_px);
        let others = match losing().count() - 1 {
            0 => String::new(),
            others => format!(" and {others} others"),
        };
        let text = format!(
            "b2, k4, p3 and p4 of sensor {id}{others} are left out, which moves pixels by up to {left_out:.1}"
        );
        foreign.warn(WarningKind::Format, text);
    }
}

/// The calibration after the adjustment, else the initial one.
fn adjusted_calibration(sensor: &Element) -> Option<&Element> {
    let mut calibrations = sensor.children("calibration");
    let adjusted = calibrations.find(|one| one.attribute("class") != Some("initial"));
    adjusted.or(sensor.child("calibration"))
}

/// COLMAP's model with its parameters, and by how many pixels the terms that it lacks move the
/// corner of an image.
struct Projection {
    model: CameraModel,
    params: Vec<f64>,
    left_out_px: f64,
}

/// The projection of a calibrated sensor of this kind, with images of this width and height.
fn calibrated(
    kind: &str,
    sensor: &Element,
    calibration: &Element,
    sides: [f64; 2],
) -> Result<Projection, Fault> {
    let terms = Terms::read(calibration, sides)?;
    let projection = terms.in_colmap(kind, sides).ok_or_else(|| {
        let problem = Problem::CameraModel(format!("{kind} (Metashape)"));
        problem.at(sensor.at())
    })?;
    refuse_much_left_out(projection.left_out_px, calibration)?;
    Ok(projection)
}

/// Width and height of the calibration's images, else of the sensor.
fn size(sensor: &Element, calibration: Option<&Element>) -> Result<[u64; 2], Fault> {
    let resolution = calibration
        .and_then(|c| c.child("resolution"))
        .or(sensor.child("resolution"));
    let resolution = resolution.ok_or_else(|| sensor.lacks("resolution"))?;
    let side = |name: &'static str| {
        let side = resolution
            .attribute(name)
            .and_then(|side| side.parse::<u64>().ok());
        side.ok_or_else(|| resolution.lacks(name))
    };
    Ok([side("width")?, side("height")?])
}

/// Terms of a calibration, pixels of COLMAP.
struct Terms {
    focal: [f64; 2],
    centre: [f64; 2],
    k: [f64; 4],
    p: [f64; 4],
    b2: f64,
}

impl Terms {
    fn read(calibration: &Element, [w, h]: [f64; 2]) -> Result<Self, Fault> {
        let value = |name: &str| calibration.number(name).map(Option::unwrap_or_default);
        let k = [value("k1")?, value("k2")?, value("k3")?, value("k4")?];
        let p = [value("p1")?, value("p2")?, value("p3")?, value("p4")?];
        let (focal, centre) = match calibration.number("f")? {
            Some(f) => (
                [f + value("b1")?, f],
                [w / 2.0 + value("cx")?, h / 2.0 + value("cy")?],
            ),
            None => (
                calibration.required(["fx", "fy"])?,
                calibration.required(["cx", "cy"])?,
            ),
        };
        Ok(Self {
            focal,
            centre,
            k,
            p,
            b2: value("b2")?,
        })
    }

    /// The projection of this kind, if COLMAP has one.
    fn in_colmap(&self, kind: &str, [w, h]: [f64; 2]) -> Option<Projection> {
        let [fx, fy] = self.focal;
        let corner = (w / 2.0 / fx).hypot(h / 2.0 / fy);
        let mut projection = match kind {
            "frame" => self.frame(corner),
            "fisheye" | "equidistant_fisheye" => self.fisheye(corner),
            _ => return None,
        };
        let skew_px = self.b2.abs() * h / 2.0 / fy;
        projection.left_out_px += skew_px;
        Some(projection)
    }

    /// `corner`: tangent of the angle between the optical axis and the corner of an image.
    fn frame(&self, corner: f64) -> Projection {
        let ([fx, fy], [cx, cy]) = (self.focal, self.centre);
        let ([k1, k2, k3, k4], [p1, p2, p3, p4]) = (self.k, self.p);
        // Bounds at the corner r: k4 moves it by r⁹ at most, and r² + 2x² and 2xy are up to 3 r².
        let tangential =
            (p1.abs() + p2.abs()) * (p3.abs() * corner.powi(2) + p4.abs() * corner.powi(4));
        let (model, params) = brown([fx, fy, cx, cy], [k1, k2, k3], [p2, p1]);
        Projection {
            model,
            params,
            left_out_px: fx * (k4.abs() * corner.powi(9) + 3.0 * corner.powi(2) * tangential),
        }
    }

    /// `corner`: as in [`Terms::frame`].
    fn fisheye(&self, corner: f64) -> Projection {
        let ([fx, _], [p1, p2, ..]) = (self.focal, self.p);
        Projection {
            model: CameraModel::OpenCvFisheye,
            params: [&self.focal[..], &self.centre, &self.k].concat(),
            // In a fisheye image the corner is at the angle, not at its tangent.
            left_out_px: 3.0 * fx * (p1.abs() + p2.abs()) * corner.atan().powi(2),
        }
    }
}

fn refuse_much_left_out(left_out_px: f64, calibration: &Element) -> Result<(), Fault> {
    if left_out_px <= 100.0 * NEGLIGIBLE_PX {
        return Ok(());
    }
    let what = format!(
        "b2, k4, p3 or p4 of the calibration move pixels by {left_out_px:.0}, and COLMAP's models have no such term"
    );
    let hint = "undistort the photos in Metashape (Export > Undistort Photos), or fit the calibration without these terms";
    Err(Problem::Unsupported { what, hint }.at(calibration.at()))
}
