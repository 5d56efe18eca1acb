//! `transforms.json` of nerfstudio, instant-ngp and the converters of scanning apps, with the
//! points of the PLY that it names.
//!
//! ```text
//! camera_model fl_x fl_y cx cy w h k1..k4 p1 p2   for all frames, or in a frame for that one; camera_angle_x in place of fl_x
//! frames: [{ file_path, transform_matrix }]       camera to world, x right, y up, z backward
//! mask_path                                       in a frame: black where its image may not be used
//! ply_file_path                                   in the same coordinates
//! train_filenames val_filenames test_filenames    paths of frames; those of the last two alone are kept apart for tests
//! ```
//!
//! Pixels are as in COLMAP, distortion as in OpenCV.

use std::collections::{HashMap, HashSet};

use nalgebra::{Matrix3, Vector3};
use serde::Deserialize;
use serde_json::value::RawValue;
use viewrank_core::model::camera::{Camera, CameraModel};

use super::{
    Fault, MOST_IMAGES, Place, Problem,
    colmap::StoredPose,
    foreign::{
        ForeignModel, SizeLookup, brown, camera, fault_in, json, json_object, pose_with_centre,
    },
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

/// Lists of paths of frames, as those name them.
#[derive(Default, Deserialize)]
#[serde(default)]
struct Splits<'a> {
    #[serde(borrow)]
    train_filenames: Option<&'a RawValue>,
    #[serde(borrow)]
    val_filenames: Option<&'a RawValue>,
    #[serde(borrow)]
    test_filenames: Option<&'a RawValue>,
}

#[derive(Default, Deserialize)]
struct Paths(#[serde(deserialize_with = "bounded::list::<_, _, MOST_IMAGES>")] Vec<String>);

impl Splits<'_> {
    /// Returns the paths that are for tests only. Writers without a split of their own repeat
    /// training images there. A list that is none keeps neither the model nor the others from being
    /// read.
    fn tests(&self) -> HashSet<String> {
        let paths = |list: Option<&RawValue>| {
            let list = list.and_then(|list| serde_json::from_str(list.get()).ok());
            let Paths(paths) = list.unwrap_or_default();
            paths
        };
        let judged = [self.val_filenames, self.test_filenames].map(paths);
        let mut tests: HashSet<String> = judged.into_iter().flatten().collect();
        for trained in paths(self.train_filenames) {
            tests.remove(&trained);
        }
        tests
    }
}

/// A frame without its lens.
#[derive(Deserialize)]
struct Frame {
    file_path: String,
    mask_path: Option<String>,
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

/// Returns the paths that a file keeps apart for tests, sorted; none of another file.
pub fn tests(bytes: &[u8]) -> Vec<String> {
    let splits: Splits = json(bytes).unwrap_or_default();
    let mut tests: Vec<String> = splits.tests().into_iter().collect();
    tests.sort_unstable();
    tests
}

/// Reads cameras and poses; returns the path of the points, relative to the file, too. `spelled`
/// completes the names of images, which some writers leave without extension.
pub fn read(
    bytes: &[u8],
    size_of: SizeLookup,
    spelled: &dyn Fn(&str) -> String,
) -> Result<(ForeignModel, Option<String>), Fault> {
    let data: Transforms = json_object(bytes, "an object with a list of \"frames\"")?;
    let of_all: Lens = json(bytes)?;
    let splits: Splits = json(bytes).unwrap_or_default();
    let tests = splits.tests();
    let mut cameras = Cameras::default();
    let mut foreign = ForeignModel::default();
    for (n, frame) in (1..).zip(&data.frames) {
        let (frame, lens) = Frame::read(n, frame)?;
        let what = || format!("frame {n}, {:?}", frame.file_path);
        let name = frame.image(spelled);
        let lens = lens.or(&of_all).with_size(|| size_of(&name));
        let camera_id = cameras.add(&lens);
        let camera_id = camera_id.map_err(|fault| fault.in_record(what))?;
        let pose = frame.pose().map_err(|problem| fault_in(problem, what))?;
        if tests.contains(frame.file_path.as_str()) {
            foreign.tests.insert(n);
        }
        foreign.add_image(n, name, camera_id, pose, Place::File);
        foreign.masks.extend(frame.mask_path.map(|mask| (n, mask)));
    }
    foreign.model.cameras = cameras.different;
    foreign.shorten_names();
    Ok((foreign, data.ply_file_path))
}

/// The cameras of the frames, each once.
#[derive(Default)]
struct Cameras {
    different: Vec<Camera>,
    /// Ids by the text of the lens, as numbers have no hash.
    ids: HashMap<String, u32>,
}

impl Cameras {
    /// Returns the id of the camera, which is added if there was none of this lens.
    fn add(&mut self, lens: &Lens) -> Result<u32, Fault> {
        let next = self.different.len() as u32 + 1;
        let id = *self.ids.entry(format!("{lens:?}")).or_insert(next);
        if id == next {
            self.different.push(lens.camera(id)?);
        }
        Ok(id)
    }
}

impl Frame {
    /// Reads the frame and its own lens. A fault has no line: it would be counted from the frame.
    fn read(n: u32, frame: &RawValue) -> Result<(Self, Lens), Fault> {
        let text = frame.get().as_bytes();
        let without_line = |fault| {
            let fault = Fault {
                place: Place::File,
                ..fault
            };
            fault.in_record(|| format!("frame {n}"))
        };
        let expected = "an object with \"file_path\" and \"transform_matrix\"";
        let frame = json_object(text, expected).map_err(without_line)?;
        Ok((frame, json(text).map_err(without_line)?))
    }

    /// Name of the image, relative to the file.
    fn image(&self, spelled: &dyn Fn(&str) -> String) -> String {
        let name = spelled(&self.file_path.replace('\\', "/"));
        name.trim_start_matches("./").to_owned()
    }

    fn pose(&self) -> Result<StoredPose, Problem> {
        let rows = &self.transform_matrix[..];
        let [a, b, c, ..] = rows else {
            return Err(Problem::Content(format!(
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

    /// This lens with the size of the image where the file doesn't say it.
    fn with_size(self, of_image: impl FnOnce() -> Option<(u32, u32)>) -> Self {
        if self.w.is_some() && self.h.is_some() {
            return self;
        }
        match of_image() {
            Some((width, height)) => Self {
                w: Some(width.into()),
                h: Some(height.into()),
                ..self
            },
            None => self,
        }
    }

    fn camera(&self, id: u32) -> Result<Camera, Fault> {
        let fault = |problem: Problem| problem.at(Place::File);
        let [w, h] = self.size().map_err(fault)?;
        let (model, params) = self.model([w, h]).map_err(fault)?;
        camera(Camera::new(id, model, w as u64, h as u64, params), || {
            "its camera".into()
        })
    }

    /// Pixels.
    fn size(&self) -> Result<[f64; 2], Problem> {
        let size = self
            .w
            .zip(self.h)
            .filter(|(w, h)| (1.0..1e6).contains(w) && (1.0..1e6).contains(h));
        let unknown = || Problem::Unsupported {
            what: "the size of the image is neither in the file (w, h) nor known from the image"
                .into(),
            hint: "copy the images next to the file, or add \"w\" and \"h\" to it",
        };
        size.map(<[f64; 2]>::from).ok_or_else(unknown)
    }

    /// COLMAP's model, and its parameters.
    fn model(&self, [w, h]: [f64; 2]) -> Result<(CameraModel, Vec<f64>), Problem> {
        let kind = self.camera_model.as_deref().unwrap_or("OPENCV");
        if kind.eq_ignore_ascii_case("EQUIRECTANGULAR") {
            return Ok((CameraModel::Equirectangular, vec![w, h]));
        }
        let (fx, fy) = self
            .focal_lengths([w, h])
            .ok_or_else(|| Problem::Content("neither fl_x nor camera_angle_x".into()))?;
        let (cx, cy) = (self.cx.unwrap_or(w / 2.0), self.cy.unwrap_or(h / 2.0));
        self.distorted(kind, [fx, fy, cx, cy])
            .ok_or_else(|| Problem::CameraModel(format!("{kind} (transforms.json)")))
    }

    /// `pinhole`: fx, fy, cx, cy.
    fn distorted(&self, kind: &str, pinhole: [f64; 4]) -> Option<(CameraModel, Vec<f64>)> {
        let k = [self.k1, self.k2, self.k3, self.k4].map(Option::unwrap_or_default);
        let p = [self.p1, self.p2].map(Option::unwrap_or_default);
        let is_fisheye = kind == "OPENCV_FISHEYE" || self.is_fisheye == Some(true);
        let [k1, k2, k3, k4] = k;
        match kind {
            _ if is_fisheye => Some((CameraModel::OpenCvFisheye, [pinhole, k].concat())),
            // Brown's model has three radial terms.
            "OPENCV" | "PINHOLE" | "SIMPLE_PINHOLE" | "SIMPLE_RADIAL" | "RADIAL" if k4 == 0.0 => {
                Some(brown(pinhole, [k1, k2, k3], p))
            }
            _ => None,
        }
    }

    /// Pixels; from the field of view where they are not in the file.
    fn focal_lengths(&self, [w, h]: [f64; 2]) -> Option<(f64, f64)> {
        let of_angle =
            |side: f64, angle: Option<f64>| angle.map(|angle| side / 2.0 / (angle / 2.0).tan());
        let fx = self.fl_x.or(of_angle(w, self.camera_angle_x));
        let fy = self.fl_y.or(of_angle(h, self.camera_angle_y)).or(fx);
        fx.zip(fy)
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
    fn frames_of_the_other_splits_alone_are_for_tests() {
        let tests = |splits: &str| {
            let scene = read(&file(splits, "")).unwrap().0.scene().unwrap();
            let names = scene.tests.iter().map(|&view| scene.name(view).to_owned());
            names.collect::<Vec<_>>()
        };
        assert!(tests("").is_empty());
        let judged = r#""val_filenames":["./images/a"],"test_filenames":["images\\b.png"],"#;
        assert_eq!(tests(judged), ["images/a.png", "images/b.png"]);
        let trained = format!(r#""train_filenames":["./images/a"],{judged}"#);
        assert_eq!(tests(&trained), ["images/b.png"]);
        for none in ["null", "7", "[1]"] {
            let damaged = format!(r#""train_filenames":{none},{judged}"#);
            assert_eq!(tests(&damaged), ["images/a.png", "images/b.png"]);
        }
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
