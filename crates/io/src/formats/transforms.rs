//! `transforms.json` of nerfstudio, instant-ngp and the converters of scanning apps, with the
//! points of the PLY that it names.
//!
//! ```text
//! camera_model fl_x fl_y cx cy w h k1..k4 p1 p2   for all frames, or in a frame for that one; camera_angle_x in place of fl_x
//! frames: [{ file_path, transform_matrix }]       camera to world, x right, y up, z backward
//! ply_file_path                                   in the same coordinates
//! ```
//!
//! Pixels are as in COLMAP, distortion as in OpenCV.

use std::collections::HashMap;

use nalgebra::{Matrix3, Vector3};
use serde::Deserialize;
use serde_json::value::RawValue;
use viewrank_core::model::camera::{Camera, CameraModel};

use super::{
    Fault, MOST_IMAGES, Place, Problem,
    colmap::StoredPose,
    foreign::{ForeignModel, SizeLookup, camera, json, pose_with_centre},
};
use crate::bounded;

/// The file, without the lens of all frames, which is read from the same object. Frames are read
/// one at a time.
#[derive(Deserialize)]
struct Transforms<'a> {
    #[serde(borrow, deserialize_with = "bounded::list::<_, _, MOST_IMAGES>")]
    frames: Vec<&'a RawValue>,
    ply_file_path: Option<String>,
}

/// A frame without its lens.
#[derive(Deserialize)]
struct Frame {
    file_path: String,
    transform_matrix: Vec<[f64; 4]>,
}

#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
struct Lens {
    camera_model: Option<String>,
    is_fisheye: Option<bool>,
    w: Option<f64>,
    h: Option<f64>,
    fl_x: Option<f64>,
    fl_y: Option<f64>,
    camera_angle_x: Option<f64>,
    camera_angle_y: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    k1: Option<f64>,
    k2: Option<f64>,
    k3: Option<f64>,
    k4: Option<f64>,
    p1: Option<f64>,
    p2: Option<f64>,
}

/// Reads cameras and poses; returns the path of the points, relative to the file, too. `spelled`
/// completes the names of images, which some writers leave without extension.
pub fn read(
    bytes: &[u8],
    size_of: SizeLookup,
    spelled: &dyn Fn(&str) -> String,
) -> Result<(ForeignModel, Option<String>), Fault> {
    let (data, of_all): (Transforms, Lens) = (json(bytes)?, json(bytes)?);
    let mut foreign = ForeignModel::default();
    // Camera ids by the text of the lens, as numbers have no hash.
    let mut known: HashMap<String, u32> = HashMap::new();
    for (n, frame) in (1..).zip(&data.frames) {
        let in_frame = |fault: Fault| {
            Fault {
                place: Place::File,
                ..fault
            }
            .in_record(|| format!("frame {n}"))
        };
        let text = frame.get().as_bytes();
        let (frame, lens): (Frame, Lens) =
            (json(text).map_err(in_frame)?, json(text).map_err(in_frame)?);
        let what = || format!("frame {n}, {:?}", frame.file_path);
        let name = spelled(&frame.file_path.replace('\\', "/"))
            .trim_start_matches("./")
            .to_string();
        let mut lens = lens.or(&of_all);
        if let (None, Some((width, height))) = (lens.w.zip(lens.h), size_of(&name)) {
            (lens.w, lens.h) = (Some(width.into()), Some(height.into()));
        }
        let next = known.len() as u32 + 1;
        let id = *known.entry(format!("{lens:?}")).or_insert(next);
        if id == next {
            foreign
                .model
                .cameras
                .push(lens.camera(id).map_err(|fault| fault.in_record(what))?);
        }
        let pose = frame
            .pose()
            .map_err(|problem| Fault::new("", Place::File, problem).in_record(what))?;
        foreign.add_image(n, name, id, pose, Place::File);
    }
    foreign.shorten_names();
    Ok((foreign, data.ply_file_path))
}

impl Frame {
    fn pose(&self) -> Result<StoredPose, Problem> {
        let rows = &self.transform_matrix[..];
        let [a, b, c, ..] = rows else {
            return Err(Problem::Json(format!(
                "a transform_matrix of {} rows, expected 4",
                rows.len()
            )));
        };
        // The rows of the rotation from world to camera are the camera's axes, of which two are the
        // other way round here.
        let axis = |i: usize, sign: f64| sign * Vector3::new(a[i], b[i], c[i]).transpose();
        let rotation = Matrix3::from_rows(&[axis(0, 1.0), axis(1, -1.0), axis(2, -1.0)]);
        pose_with_centre(rotation, Vector3::new(a[3], b[3], c[3]))
    }
}

impl Lens {
    /// This lens where it says something, else the other.
    fn or(self, other: &Self) -> Self {
        Self {
            camera_model: self.camera_model.or_else(|| other.camera_model.clone()),
            is_fisheye: self.is_fisheye.or(other.is_fisheye),
            w: self.w.or(other.w),
            h: self.h.or(other.h),
            fl_x: self.fl_x.or(other.fl_x),
            fl_y: self.fl_y.or(other.fl_y),
            camera_angle_x: self.camera_angle_x.or(other.camera_angle_x),
            camera_angle_y: self.camera_angle_y.or(other.camera_angle_y),
            cx: self.cx.or(other.cx),
            cy: self.cy.or(other.cy),
            k1: self.k1.or(other.k1),
            k2: self.k2.or(other.k2),
            k3: self.k3.or(other.k3),
            k4: self.k4.or(other.k4),
            p1: self.p1.or(other.p1),
            p2: self.p2.or(other.p2),
        }
    }

    fn camera(&self, id: u32) -> Result<Camera, Fault> {
        let fault = |problem| Fault::new("", Place::File, problem);
        let size = self
            .w
            .zip(self.h)
            .filter(|(w, h)| (1.0..1e6).contains(w) && (1.0..1e6).contains(h));
        let (w, h) = size.ok_or_else(|| {
            let what =
                "the size of the image is neither in the file (w, h) nor known from the image"
                    .into();
            fault(Problem::Unsupported {
                what,
                hint: "copy the images next to the file, or add \"w\" and \"h\" to it",
            })
        })?;
        let of_angle =
            |side: f64, angle: Option<f64>| angle.map(|angle| side / 2.0 / (angle / 2.0).tan());
        let fx = self.fl_x.or(of_angle(w, self.camera_angle_x));
        let fy = self.fl_y.or(of_angle(h, self.camera_angle_y)).or(fx);
        let (cx, cy) = (self.cx.unwrap_or(w / 2.0), self.cy.unwrap_or(h / 2.0));
        let [k1, k2, k3, k4, p1, p2] =
            [self.k1, self.k2, self.k3, self.k4, self.p1, self.p2].map(Option::unwrap_or_default);
        let kind = self.camera_model.as_deref().unwrap_or("OPENCV");
        if kind.eq_ignore_ascii_case("EQUIRECTANGULAR") {
            return camera(
                Camera::new(
                    id,
                    CameraModel::Equirectangular,
                    w as u64,
                    h as u64,
                    vec![w, h],
                ),
                || "camera".into(),
            );
        }
        let (fx, fy) = fx
            .zip(fy)
            .ok_or_else(|| fault(Problem::Json("neither fl_x nor camera_angle_x".into())))?;
        let (model, params) = match kind {
            "OPENCV_FISHEYE" => (
                CameraModel::OpenCvFisheye,
                vec![fx, fy, cx, cy, k1, k2, k3, k4],
            ),
            _ if self.is_fisheye == Some(true) => (
                CameraModel::OpenCvFisheye,
                vec![fx, fy, cx, cy, k1, k2, k3, k4],
            ),
            "OPENCV" | "PINHOLE" | "SIMPLE_PINHOLE" | "SIMPLE_RADIAL" | "RADIAL" if k4 == 0.0 => (
                CameraModel::FullOpenCv,
                vec![fx, fy, cx, cy, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0],
            ),
            _ => {
                return Err(fault(Problem::CameraModel(format!(
                    "{kind} (transforms.json)"
                ))));
            }
        };
        camera(Camera::new(id, model, w as u64, h as u64, params), || {
            "its camera".into()
        })
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;

    use super::*;

    /// Two frames: the camera of both at the top, the second with a focal length of its own.
    fn file(more: &str, second: &str) -> String {
        format!(
            r#"{{"camera_angle_x":1.0,{more}"k1":0.1,"frames":[
            {{"file_path":"./images/a","transform_matrix":[[1,0,0,1],[0,1,0,2],[0,0,1,3],[0,0,0,1]]}},
            {{"file_path":"images\\b.png",{second}"transform_matrix":[[0,0,1,4],[1,0,0,5],[0,1,0,6]]}}],"ply_file_path":"p.ply"}}"#
        )
    }

    fn read(text: &str) -> Result<(ForeignModel, Option<String>), Fault> {
        let spelled = |name: &str| {
            if name.contains('.') && !name.ends_with("/a") {
                name.into()
            } else {
                format!("{name}.png")
            }
        };
        super::read(text.as_bytes(), &|_| Some((200, 100)), &spelled)
    }

    #[test]
    fn cameras_look_along_minus_z_and_y_is_up() {
        let (foreign, cloud) = read(&file(r#""k2":0,"#, r#""fl_x":50,"#)).unwrap();
        assert_eq!(cloud.as_deref(), Some("p.ply"));
        let scene = foreign.scene().unwrap();
        assert_eq!(
            scene
                .views
                .iter()
                .map(|v| v.name.as_str())
                .collect::<Vec<_>>(),
            ["images/a.png", "images/b.png"]
        );
        let in_camera = |view: usize, x: [f64; 3]| {
            scene.views[view]
                .cam_from_world
                .camera_from_world(&Point3::from(x))
        };
        // 5 before the first camera, 1 to the right and 2 up.
        assert!((in_camera(0, [2.0, 4.0, -2.0]) - Point3::new(1.0, -2.0, 5.0)).norm() < 1e-12);
        // The axes of the second: x right is the world's y, y up its z, backward its x.
        assert!((in_camera(1, [-1.0, 6.0, 8.0]) - Point3::new(1.0, -2.0, 5.0)).norm() < 1e-12);
        let focal = |view: usize| {
            scene.cameras[scene.views[view].camera.index()]
                .pinhole_part()
                .0
                .x
        };
        assert!((focal(0) - 100.0 / 0.5f64.tan()).abs() < 1e-9);
        assert_eq!(focal(1), 50.0);
    }

    #[test]
    fn what_is_not_there_or_unknown_is_named() {
        let said = |text: &str| {
            super::read(text.as_bytes(), &|_| None, &str::to_owned)
                .unwrap_err()
                .to_string()
        };
        assert!(said(&file("", "")).contains("size of the image"));
        assert!(said(&file(r#""w":9,"h":9,"camera_model":"ORTHO","#, "")).contains("ORTHO"));
        assert!(said(&file(r#""w":9,"h":9,"k4":0.1,"#, "")).contains("camera model"));
        assert!(
            said(r#"{"frames":[{"file_path":"a","w":9,"h":9,"fl_x":9,"transform_matrix":[]}]}"#)
                .contains("0 rows")
        );
    }
}
