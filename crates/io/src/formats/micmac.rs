//! MicMac's `Ori-` folders: an `Orientation-IMAGE.xml` per image, which names a calibration
//! (`AutoCal….xml`) in the same folder.
//!
//! ```text
//! OrientationConique    FileInterne, Externe: Centre, ParamRotation/CodageMatr L1 L2 L3
//! CalibrationInternConique    PP F SzIm CalibDistortion: ModNoDist | ModRad CDist CoeffDist | ModPhgrStd RadialePart P1 P2 b1 b2
//! ```
//!
//! Rows of the rotation are those from camera to world; camera axes are as in COLMAP. The
//! distortion (convention `DistM2C`) moves ideal to measured pixels and is in pixels: p + (p -
//! CDist) (c0 r² + c1 r⁴ + c2 r⁶), then Brown's P1 (of r² + 2x²), P2, and an affinity b1, b2. The
//! centre of the first pixel is (0, 0), by the source (f8fe432).

use nalgebra::{Matrix3, Point3, Vector3};
use viewrank_core::model::camera::{Camera, CameraError};

use super::{
    Fault, Place, Problem,
    colmap::StoredPose,
    foreign::{brown, camera, pose_with_centre},
    xml::{Element, Xml},
};

/// The pose of an image, and the file of its calibration.
#[derive(Clone, Debug)]
pub struct Oriented {
    pub cam_from_world: StoredPose,
    /// File name, without its folder.
    pub calibration: String,
}

/// Reads an `Orientation-*.xml`.
pub fn read_orientation(bytes: &[u8]) -> Result<Oriented, Fault> {
    let root = named(bytes, "OrientationConique")?;
    let projection = root.child("TypeProj").map_or(PINHOLE, Element::text);
    if projection != PINHOLE {
        return Err(unknown(&root, projection));
    }
    let calibration = root.required_child("FileInterne")?.text();
    // The path is that of another machine, and a stranger's may lead anywhere.
    let calibration = calibration.rsplit(['/', '\\']).next();
    Ok(Oriented {
        cam_from_world: pose_of(root.required_child("Externe")?)?,
        calibration: calibration.unwrap_or_default().to_owned(),
    })
}

/// MicMac's name of the only projection that is read.
const PINHOLE: &str = "eProjStenope";

/// The pose in an `Externe`.
fn pose_of(outer: &Element) -> Result<StoredPose, Fault> {
    let centre = outer.required_child("Centre")?.numbers()?;
    let matrix = outer
        .child("ParamRotation")
        .and_then(|rotation| rotation.child("CodageMatr"));
    let matrix = matrix.ok_or_else(|| outer.lacks("CodageMatr"))?;
    let row = |name| Ok(Vector3::from(matrix.required_child(name)?.numbers()?));
    // Rows from camera to world are columns from world to camera.
    let rotation = Matrix3::from_columns(&[row("L1")?, row("L2")?, row("L3")?]);
    pose_with_centre(rotation, Vector3::from(centre)).map_err(|problem| problem.at(outer.at()))
}

/// Reads a calibration; returns the camera and by how many pixels it is off, at most, since COLMAP
/// has no model with a distortion centre of its own.
pub fn read_calibration(bytes: &[u8], id: u32) -> Result<(Camera, f64), Fault> {
    let root = named(bytes, "CalibrationInternConique")?;
    let calibration = Calibration::read(&root)?;
    let camera = camera(calibration.camera(id), || "its camera".into())?;
    let off = calibration.largest_error_px(&camera);
    if off.is_nan() || off > MOST_OFF_PX {
        let what =
            "no camera model of COLMAP has the distortion of this calibration: its centre is too far from the principal point"
                .into();
        let hint = "calibrate with Tapas RadialBasic or FraserBasic, or undistort the images with mm3d Drunk";
        return Err(Problem::Unsupported { what, hint }.at(root.at()));
    }
    Ok((camera, off))
}

/// Turns MicMac's pixels, whose first centre is (0, 0), into COLMAP's.
fn from_corner(pixel: [f64; 2]) -> [f64; 2] {
    pixel.map(|x| x + 0.5)
}

/// Error of a camera from which it is refused.
const MOST_OFF_PX: f64 = 20.0;

/// The element of this name, which is the root or its child.
fn named(bytes: &[u8], name: &'static str) -> Result<Element, Fault> {
    let mut xml = Xml::new(bytes)?;
    let root = xml.enter()?;
    if let Some(root) = root {
        if root.name == name {
            return xml.whole(root);
        }
        while let Some(entered) = xml.enter()? {
            if entered.name == name {
                return xml.whole(entered);
            }
            xml.skip()?;
        }
    }
    Err(Problem::syntax(name, "no such element").at(Place::File))
}

/// The fault of an element with a projection or distortion that is not read.
fn unknown(element: &Element, what: &str) -> Fault {
    let problem = Problem::CameraModel(format!("{what} (MicMac)"));
    problem.at(element.at())
}

/// A calibration, in COLMAP's pixels.
struct Calibration {
    principal_point: [f64; 2],
    focal: f64,
    size: [f64; 2],
    distortion: Distortion,
}

impl Calibration {
    fn read(root: &Element) -> Result<Self, Fault> {
        let principal_point = from_corner(root.required_child("PP")?.numbers()?);
        let [focal] = root.required_child("F")?.numbers()?;
        Ok(Self {
            principal_point,
            focal,
            size: root.required_child("SzIm")?.numbers()?,
            distortion: Distortion::read(root, principal_point)?,
        })
    }

    /// The most similar of COLMAP's cameras: a shift of the distortion's centre by d acts, to first
    /// order, as Brown's terms of -c0 d.
    fn camera(&self, id: u32) -> Result<Camera, CameraError> {
        let (focal, [cx, cy]) = (self.focal, self.principal_point);
        let Distortion {
            centre,
            radial: [c0, c1, c2],
            // COLMAP's models have no skew b2; `largest_error_px` shows what that costs.
            brown: [p1, p2, b1, _],
        } = self.distortion;
        let f2 = focal * focal;
        let k = [c0 * f2, c1 * f2 * f2, c2 * f2 * f2 * f2];
        let p = [
            (p2 - c0 * (centre[1] - cy)) * focal,
            (p1 - c0 * (centre[0] - cx)) * focal,
        ];
        let (model, params) = brown([focal * (1.0 + b1), focal, cx, cy], k, p);
        let [width, height] = self.size.map(|side| side as u64);
        Camera::new(id, model, width, height, params)
    }

    /// The largest distance between a measured pixel and that of the camera, over a grid of ideal
    /// pixels; infinite if the camera doesn't see one of them.
    fn largest_error_px(&self, camera: &Camera) -> f64 {
        let (focal, [cx, cy]) = (self.focal, self.principal_point);
        let [w, h] = self.size;
        let mut largest = 0.0f64;
        for i in 0..=20 {
            for j in 0..=20 {
                let ideal = [w * f64::from(i) / 20.0, h * f64::from(j) / 20.0];
                let ray = Point3::new((ideal[0] - cx) / focal, (ideal[1] - cy) / focal, 1.0);
                let [x, y] = self.distortion.measured(ideal);
                // What is moved far out of the image is nobody's pixel.
                if x > -0.1 * w && y > -0.1 * h && x < 1.1 * w && y < 1.1 * h {
                    let pixel = camera.project(&ray);
                    largest =
                        pixel.map_or(f64::INFINITY, |p| largest.max((p.x - x).hypot(p.y - y)));
                }
            }
        }
        largest
    }
}

/// MicMac's name of the only convention of distortion that is read.
const IDEAL_TO_MEASURED: &str = "eConvApero_DistM2C";

/// In pixels.
struct Distortion {
    centre: [f64; 2],
    radial: [f64; 3],
    /// P1, P2, b1, b2
    brown: [f64; 4],
}

impl Distortion {
    fn read(root: &Element, principal_point: [f64; 2]) -> Result<Self, Fault> {
        let mut distortion = Self {
            centre: principal_point,
            radial: [0.0; 3],
            brown: [0.0; 4],
        };
        let mut parts = root.children("CalibDistortion");
        let Some(part) = parts.next() else {
            return Ok(distortion);
        };
        if parts.next().is_some() {
            return Err(unknown(root, "several distortions, one after another"));
        }
        let convention = root
            .child("KnownConv")
            .map_or(IDEAL_TO_MEASURED, Element::text);
        if convention != IDEAL_TO_MEASURED {
            return Err(unknown(root, convention));
        }
        if let Some(standard) = part.child("ModPhgrStd") {
            distortion.read_radial(standard.required_child("RadialePart")?)?;
            distortion.read_brown(standard)?;
        } else if let Some(radial) = part.child("ModRad") {
            distortion.read_radial(radial)?;
        } else if part.child("ModNoDist").is_none() {
            return Err(unknown(part, "a distortion model"));
        }
        Ok(distortion)
    }

    fn read_radial(&mut self, radial: &Element) -> Result<(), Fault> {
        if let Some(centre) = radial.child("CDist") {
            self.centre = from_corner(centre.numbers()?);
        }
        for (n, coefficient) in radial.children("CoeffDist").enumerate() {
            let [value] = coefficient.numbers()?;
            match self.radial.get_mut(n) {
                Some(to) => *to = value,
                None if value == 0.0 => {}
                None => {
                    return Err(unknown(coefficient, "more than three radial coefficients"));
                }
            }
        }
        Ok(())
    }

    fn read_brown(&mut self, standard: &Element) -> Result<(), Fault> {
        for (to, name) in self.brown.iter_mut().zip(["P1", "P2", "b1", "b2"]) {
            *to = standard.number(name)?.unwrap_or_default();
        }
        Ok(())
    }

    /// The measured pixel of an ideal one.
    fn measured(&self, [px, py]: [f64; 2]) -> [f64; 2] {
        let (x, y) = (px - self.centre[0], py - self.centre[1]);
        let r2 = x * x + y * y;
        let [c0, c1, c2] = self.radial;
        let radial = r2 * (c0 + r2 * (c1 + r2 * c2));
        let [p1, p2, b1, b2] = self.brown;
        let dx = x * radial + (r2 + 2.0 * x * x) * p1 + 2.0 * x * y * p2 + b1 * x + b2 * y;
        let dy = y * radial + (r2 + 2.0 * y * y) * p2 + 2.0 * x * y * p1;
        [px + dx, py + dy]
    }
}

#[cfg(test)]
mod tests {
    use viewrank_core::model::camera::CameraModel;

    use super::*;

    const ORIENTATION: &str = "<?xml version=\"1.0\" ?>\n<ExportAPERO><OrientationConique><TypeProj>eProjStenope</TypeProj>\
        <FileInterne>Ori-All/AutoCal_Foc-9.xml</FileInterne><Externe><Centre>1 2 3</Centre><ParamRotation><CodageMatr><L1>0 0 1</L1><L2>1 0 0</L2>\
        <L3>0 1 0</L3></CodageMatr></ParamRotation></Externe></OrientationConique></ExportAPERO>";

    fn calibration(distortion: &str) -> String {
        format!(
            "<ExportAPERO><CalibrationInternConique><KnownConv>eConvApero_DistM2C</KnownConv><PP>1000 700</PP><F>2000</F><SzIm>2000 1500</SzIm>\
             <CalibDistortion>{distortion}</CalibDistortion></CalibrationInternConique></ExportAPERO>"
        )
    }

    #[test]
    fn rows_are_from_camera_to_world() {
        let oriented = read_orientation(ORIENTATION.as_bytes()).unwrap();
        assert_eq!(oriented.calibration, "AutoCal_Foc-9.xml");
        let pose = oriented.cam_from_world.pose().unwrap();
        // The camera looks along the world's x, and its x is the world's y.
        assert!(
            (pose.camera_from_world(&Point3::new(6.0, 3.0, 5.0)) - Point3::new(1.0, 2.0, 5.0))
                .norm()
                < 1e-12
        );
        (1..ORIENTATION.len() - 14)
            .for_each(|end| _ = read_orientation(&ORIENTATION.as_bytes()[..end]).unwrap_err());
        assert!(
            read_orientation(
                ORIENTATION
                    .replace("eProjStenope", "eProjOrthographique")
                    .as_bytes()
            )
            .is_err()
        );
    }

    #[test]
    fn distortion_is_in_pixels() {
        let read = |distortion: &str| read_calibration(calibration(distortion).as_bytes(), 1);
        let (camera, off) =
            read("<ModRad><CDist>1000 700</CDist><CoeffDist>2.5e-8</CoeffDist></ModRad>").unwrap();
        assert!(
            (camera.params()[4] - 0.1).abs() < 1e-12 && off < 1e-6,
            "{off}"
        );
        // 500 pixels to the right of the centre, moved by 500 * 2.5e-8 * 500².
        let pixel = camera.project(&Point3::new(0.25, 0.0, 1.0)).unwrap();
        assert!((pixel.x - 1503.625).abs() < 1e-9);
        let fraser = "<ModPhgrStd><RadialePart><CDist>1000 700</CDist><CoeffDist>2.5e-8</CoeffDist></RadialePart><P1>1e-7</P1><P2>2e-7</P2></ModPhgrStd>";
        let (camera, off) = read(fraser).unwrap();
        assert!(
            (camera.params()[7] - 2e-4).abs() < 1e-12
                && (camera.params()[6] - 4e-4).abs() < 1e-12
                && off < 1e-6
        );
        assert_eq!(
            read("<ModNoDist/>").unwrap().0.model(),
            CameraModel::Pinhole
        );
    }

    #[test]
    fn a_centre_of_its_own_is_taken_in_by_browns_terms() {
        let read = |centre: &str| {
            let text =
                format!("<ModRad><CDist>{centre}</CDist><CoeffDist>2.5e-8</CoeffDist></ModRad>");
            read_calibration(calibration(&text).as_bytes(), 1)
        };
        let (_, off) = read("1010 705").unwrap();
        assert!(
            off > 0.0 && off < 0.2,
            "without these terms 1.3 pixels: {off}"
        );
        assert!(matches!(
            read("1900 700").unwrap_err().problem,
            Problem::Unsupported { .. }
        ));
    }

    #[test]
    fn other_models_are_named() {
        let said = |distortion: &str| {
            read_calibration(calibration(distortion).as_bytes(), 1)
                .unwrap_err()
                .to_string()
        };
        assert!(
            said("<ModUnif><TypeModele>eModele_FishEye_10_5_5</TypeModele></ModUnif>")
                .contains("MicMac")
        );
        assert!(
            said(&format!(
                "<ModRad>{}</ModRad>",
                "<CoeffDist>1e-30</CoeffDist>".repeat(4)
            ))
            .contains("three")
        );
        assert!(said("<ModRad><CDist>1</CDist></ModRad>").contains("CDist"));
        assert!(read_calibration(b"<a/>", 1).is_err() && read_calibration(b"", 1).is_err());
    }
}
