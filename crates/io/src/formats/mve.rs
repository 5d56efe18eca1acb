//! MVE's `synth_0.out` with the `meta.ini` of its views.
//!
//! ```text
//! drews 1.0
//! CAMERAS POINTS
//! camera  f k1 k2   R (3 lines)   t          f = 0: not registered
//! point   X   r g b   n (view feature 0) ...
//! ```
//!
//! Poses are world to camera, axes as in COLMAP; f is in units of the larger side of the image. The
//! cameras are those of the undistorted images, so k1 and k2, of the original ones, are left out.
//! The file has no pixels: observations are the projections of their points.

use std::collections::HashMap;

use nalgebra::{Matrix3, Point3, Vector3};
use viewrank_core::model::{
    camera::{Camera, CameraModel},
    scene::{Pose, WarningKind},
};

use super::{
    Fault, Place, Problem, check_images,
    foreign::{ForeignModel, SizeLookup, camera, pose},
    words::Words,
};

/// Camera of a view, from its `meta.ini`.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// Position of its camera in the bundle.
    pub id: usize,
    /// Over width and height.
    principal_point: [f64; 2],
    pixel_aspect: f64,
    /// File name of the undistorted image, relative to `views`.
    pub image: String,
}

impl View {
    /// Reads a `meta.ini`; `None` without an id. Values that are missing are MVE's defaults.
    pub fn read(meta: &str, image: String) -> Option<Self> {
        let mut section = "";
        let mut view = Self {
            id: usize::MAX,
            principal_point: [0.5; 2],
            pixel_aspect: 1.0,
            image,
        };
        for line in meta.lines().map(str::trim) {
            if let Some(name) = line.strip_prefix('[') {
                section = name.trim_end_matches(']');
            }
            if let Some((key, value)) = line.split_once('=') {
                view.set(section, key.trim(), value.trim())?;
            }
        }
        (view.id != usize::MAX).then_some(view)
    }

    /// Takes an entry; `None` for an id that is no number.
    fn set(&mut self, section: &str, key: &str, value: &str) -> Option<()> {
        let numbers: Vec<f64> = value
            .split_ascii_whitespace()
            .filter_map(|word| word.parse().ok())
            .collect();
        match (section, key, &numbers[..]) {
            ("view", "id", _) => self.id = value.parse().ok()?,
            ("camera", "principal_point", &[x, y]) => self.principal_point = [x, y],
            ("camera", "pixel_aspect", &[aspect]) => self.pixel_aspect = aspect,
            _ => {}
        }
        Some(())
    }

    fn camera(&self, focal: f64, size_of: SizeLookup) -> Result<Camera, Fault> {
        let id = self.id as u32 + 1;
        let (width, height) = size_of(&self.image).ok_or_else(|| {
            let what = format!(
                "the image views/{} is missing, and its size with it",
                self.image
            );
            Problem::Unsupported {
                what,
                hint: "copy the whole folder of the MVE scene",
            }
            .at(Place::File)
        })?;
        let (w, h) = (f64::from(width), f64::from(height));
        // The larger side is that of the image as it is shown: `pixel_aspect` is the width of a
        // pixel over its height.
        let fx = if w * self.pixel_aspect < h {
            focal * h / self.pixel_aspect
        } else {
            focal * w
        };
        let [x, y] = self.principal_point;
        let params = vec![fx, fx * self.pixel_aspect, x * w, y * h];
        camera(
            Camera::new(
                id,
                CameraModel::Pinhole,
                width.into(),
                height.into(),
                params,
            ),
            || format!("view {}", self.id),
        )
    }
}

/// Reads `synth_0.out`.
pub fn read(bundle: &[u8], views: &[View], size_of: SizeLookup) -> Result<ForeignModel, Fault> {
    let mut words = Words::new(bundle);
    if words.line() != Some(b"drews 1.0") {
        return Err(Words::new(bundle).unexpected("drews 1.0"));
    }
    let cameras = words.count("cameras", 30)?;
    check_images(cameras)?;
    let points = words.count("points", 14)?;
    let mut read = Bundle {
        words,
        foreign: ForeignModel::default(),
        registered: Vec::with_capacity(cameras),
        without_folder: 0,
    };
    let by_id: HashMap<usize, &View> = views.iter().map(|view| (view.id, view)).collect();
    for n in 0..cameras {
        read.camera(n, by_id.get(&n).copied(), size_of)?;
    }
    for n in 0..points {
        read.point(n)?;
    }
    Ok(read.into_model())
}

/// Position of the image in the model, and pixel.
type Observation = (usize, [f64; 2]);

/// A bundle that is being read.
struct Bundle<'a> {
    words: Words<'a>,
    foreign: ForeignModel,
    /// By position in the file; `None` for cameras that are left out.
    registered: Vec<Option<Registered>>,
    /// Number of registered cameras that no view has.
    without_folder: usize,
}

struct Registered {
    /// Position in the model.
    image: usize,
    camera: Camera,
    pose: Pose,
}

/// A camera as in the file.
struct Stored {
    at: Place,
    focal: f64,
    rotation: Matrix3<f64>,
    translation: Vector3<f64>,
}

impl Stored {
    fn read(words: &mut Words) -> Result<Self, Fault> {
        let at = words.place();
        // The distortion is that of the original image, and the model has the undistorted one.
        let [focal, _, _] = words.numbers("the focal length, k1 and k2")?;
        let rotation = words.numbers::<9>("a rotation matrix")?;
        let translation = words.numbers::<3>("a translation")?;
        Ok(Self {
            at,
            focal,
            rotation: Matrix3::from_row_slice(&rotation),
            translation: Vector3::from(translation),
        })
    }
}

impl Bundle<'_> {
    /// Reads the next camera, which is that of `view`.
    fn camera(&mut self, n: usize, view: Option<&View>, size_of: SizeLookup) -> Result<(), Fault> {
        let read = Stored::read(&mut self.words);
        let read = read.map_err(|fault| fault.in_record(|| format!("camera {n}")))?;
        let is_registered = read.focal != 0.0;
        if let (Some(view), true) = (view, is_registered) {
            return self.register(n, &read, view, size_of);
        }
        self.without_folder += usize::from(is_registered);
        let name = view.map(|view| view.image.clone());
        self.foreign.unregistered.extend(name);
        // Observations count all cameras by their position.
        self.registered.push(None);
        Ok(())
    }

    fn register(
        &mut self,
        n: usize,
        read: &Stored,
        view: &View,
        size_of: SizeLookup,
    ) -> Result<(), Fault> {
        let fault = |problem: Problem| problem.at(read.at).in_record(|| format!("camera {n}"));
        let stored = pose(read.rotation, read.translation).map_err(fault)?;
        let pose = stored.pose().map_err(fault)?;
        let camera = view.camera(read.focal, size_of)?;
        let foreign = &mut self.foreign;
        self.registered.push(Some(Registered {
            image: foreign.model.images.len(),
            camera: camera.clone(),
            pose,
        }));
        let id = n as u32 + 1;
        foreign.add_image(id, view.image.clone(), camera.id, stored, read.at);
        foreign.model.cameras.push(camera);
        Ok(())
    }

    fn point(&mut self, n: usize) -> Result<(), Fault> {
        let what = || format!("point {n}");
        let words = &mut self.words;
        let at = words.place();
        let xyz = words
            .numbers("a position")
            .map_err(|fault| fault.in_record(what))?;
        let colour = words
            .numbers::<3>("a colour")
            .map_err(|fault| fault.in_record(what))?;
        let track = self.observations(&Point3::from(xyz))?;
        let colour = colour.map(|c| c.round().clamp(0.0, 255.0) as u8);
        self.foreign.add_point(n as u64 + 1, xyz, colour, track, at);
        Ok(())
    }

    /// Reads the observations of a point, and projects it.
    fn observations(&mut self, point: &Point3<f64>) -> Result<Vec<Observation>, Fault> {
        let words = &mut self.words;
        let count = words.count("observations", 6)?;
        let mut track = Vec::with_capacity(count);
        for _ in 0..count {
            let view: usize = words.number("a view")?;
            let _ = words.numbers::<2>("a feature and 0")?;
            let known = self.registered.get(view);
            let known = known.ok_or_else(|| words.fault(Problem::absent("view", view as u64)))?;
            if let Some(registered) = known {
                let in_camera = registered.pose.camera_from_world(point);
                let pixel = registered.camera.project(&in_camera);
                track.extend(pixel.map(|pixel| (registered.image, [pixel.x, pixel.y])));
            }
        }
        Ok(track)
    }

    fn into_model(self) -> ForeignModel {
        let mut foreign = self.foreign;
        if self.without_folder > 0 {
            let text = format!(
                "{} cameras of the bundle have no folder in views, and are left out",
                self.without_folder
            );
            foreign.warn(WarningKind::Damaged, text);
        }
        foreign.image_folder = Some("views".into());
        foreign
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const META: &str = "[camera]\nfocal_length = 1\npixel_aspect = 1\nprincipal_point = 0.5 0.25\n[view]\nid = 1\nname = a\n";
    const BUNDLE: &str = "drews 1.0\n3 2\n0 0 0\n0 0 0\n0 0 0\n0 0 0\n0 0 0\n0.5 0.1 0\n1 0 0\n0 1 0\n0 0 1\n0 0 5\n\
                          0.5 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 5\n1 2 5\n10 20 30\n2 1 7 0 2 8 0\n0 0 0\n1 2 3\n0\n";

    fn views() -> Vec<View> {
        let of = |id: usize| {
            let meta = META.replace("id = 1", &format!("id = {id}"));
            View::read(&meta, format!("view_000{id}.mve/undistorted.jpg")).unwrap()
        };
        vec![of(0), of(1)]
    }

    #[test]
    fn a_bundle_goes_with_the_views_by_their_ids() {
        let foreign = read(BUNDLE.as_bytes(), &views(), &|_| Some((200, 100))).unwrap();
        assert_eq!(
            foreign.model.warnings.len(),
            1,
            "the third camera has no folder"
        );
        let scene = foreign.scene().unwrap();
        assert_eq!(scene.views.len(), 1);
        assert_eq!(scene.views[0].name, "view_0001.mve/undistorted.jpg");
        assert_eq!(scene.unregistered, ["view_0000.mve/undistorted.jpg"]);
        assert_eq!(scene.cameras[0].params(), [100.0, 100.0, 100.0, 25.0]);
        assert_eq!(
            (scene.observations(), scene.track_pixels[0]),
            (1, [110.0, 45.0])
        );
        let upright = read(BUNDLE.as_bytes(), &views(), &|_| Some((100, 200))).unwrap();
        assert_eq!(
            upright.model.cameras[0].params(),
            [100.0, 100.0, 50.0, 50.0],
            "f is of the larger side"
        );
    }

    #[test]
    fn a_damaged_bundle_is_refused() {
        let read = |text: &str| read(text.as_bytes(), &views(), &|_| Some((200, 100)));
        (1..BUNDLE.len() - 2)
            .step_by(3)
            .for_each(|end| _ = read(&BUNDLE[..end]).unwrap_err());
        assert!(
            read(&BUNDLE.replace("2 1 7 0 2 8 0", "2 1 7 0 3 8 0"))
                .unwrap_err()
                .to_string()
                .contains("view 3")
        );
        assert!(read(&BUNDLE.replace("3 2\n", "3 4000000000\n")).is_err());
        let missing = super::read(BUNDLE.as_bytes(), &views(), &|_| None).unwrap_err();
        assert!(missing.to_string().contains("view_0001.mve"));
        assert_eq!(View::read("[view]\nid = x\n", String::new()), None);
    }
}
