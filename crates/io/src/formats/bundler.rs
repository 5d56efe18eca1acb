//! Bundler's `bundle.out` (v0.3) with its list of images.
//!
//! ```text
//! # Bundle file v0.3
//! CAMERAS POINTS
//! camera  f k1 k2   R (3 lines)   t          f = 0: not registered
//! point   X   r g b   n (camera key x y) ...
//! ```
//!
//! Poses are world to camera with x right, y up, z backward; pixels are relative to the image
//! centre, y up; distortion is `f (1 + k1 r² + k2 r⁴)` of the undistorted radius, as in RADIAL. The
//! file doesn't store image sizes.

use nalgebra::{Matrix3, Vector3};
use viewrank_core::model::camera::{Camera, CameraModel};

use super::{
    Fault, Place, Problem, check_images,
    foreign::{ForeignModel, SizeLookup, camera, guessed_size, pose},
    measured::{MeasuredPoints, image_id},
    words::Words,
};

/// Least number of bytes of a camera (15 one-digit numbers) and of a point (7).
const SMALLEST: [usize; 2] = [30, 14];

struct BundlerCamera {
    focal: f64,
    k1: f64,
    k2: f64,
    rotation: Matrix3<f64>,
    translation: Vector3<f64>,
    at: Place,
}

impl BundlerCamera {
    fn is_registered(&self) -> bool {
        self.focal != 0.0
    }
}

/// Reads `bundle.out` and its image list: one line per image with the name, sometimes followed by
/// two numbers.
pub fn read(bundle: &[u8], list: &[u8], size_of: SizeLookup) -> Result<ForeignModel, Fault> {
    let names = names(list)?;
    let mut words = Words::new(bundle);
    if words
        .line()
        .is_none_or(|line| line != b"# Bundle file v0.3")
    {
        // From the start again, so that the error quotes the first word.
        return Err(Words::new(bundle).unexpected("# Bundle file v0.3"));
    }
    let cameras = words.count("cameras", SMALLEST[0])?;
    check_images(cameras)?;
    let points = words.count("points", SMALLEST[1])?;
    // Cameras have their names by position alone: with another list, all would be wrong.
    if names.len() != cameras {
        let message = format!(
            "{} images in the list, but {cameras} cameras in the bundle file",
            names.len()
        );
        return Err(words.fault(Problem::Contradiction(message)));
    }
    let cameras = words.records("camera", cameras, bundler_camera)?;
    let is_registered: Vec<bool> = cameras.iter().map(BundlerCamera::is_registered).collect();
    let points = MeasuredPoints::read(&mut words, points, &is_registered, colour)?;
    assemble(&names, &cameras, points, size_of)
}

fn bundler_camera(words: &mut Words) -> Result<BundlerCamera, Fault> {
    let at = words.place();
    let [focal, k1, k2] = words.numbers("the focal length, k1 and k2")?;
    let rotation = Matrix3::from_row_slice(&words.numbers::<9>("a rotation matrix")?);
    let translation = Vector3::from(words.numbers::<3>("a translation")?);
    Ok(BundlerCamera {
        focal,
        k1,
        k2,
        rotation,
        translation,
        at,
    })
}

fn colour(words: &mut Words) -> Result<[u8; 3], Fault> {
    let mut colour = [0; 3];
    for c in &mut colour {
        *c = words.number("a colour from 0 to 255")?;
    }
    Ok(colour)
}

fn names(list: &[u8]) -> Result<Vec<String>, Fault> {
    let fault = |n: usize, problem| Fault::new("list", Place::Line(n as u64 + 1), problem);
    let lines = list
        .split(|&b| b == b'\n')
        .enumerate()
        .filter(|(_, line)| !line.trim_ascii().is_empty());
    let name = |(n, line): (usize, &[u8])| {
        let line = line.trim_ascii();
        // "NAME 0 FOCAL" if the focal length was known.
        let name = super::words::name_and_numbers::<2>(line).map_or(line, |(name, _)| name);
        let text = std::str::from_utf8(name).map_err(|_| {
            fault(
                n,
                Problem::Name {
                    name: String::from_utf8_lossy(name).into_owned(),
                    why: "is not UTF-8",
                },
            )
        })?;
        Ok(text.strip_prefix("./").unwrap_or(text).to_owned())
    };
    check_images(lines.clone().count()).map_err(|fault| fault.in_file("list"))?;
    lines.map(name).collect()
}

fn assemble(
    names: &[String],
    cameras: &[BundlerCamera],
    mut points: MeasuredPoints,
    size_of: SizeLookup,
) -> Result<ForeignModel, Fault> {
    let mut foreign = ForeignModel::default();
    let mut guessed = 0;
    for (n, bundler) in cameras.iter().enumerate() {
        let (name, id, at) = (&names[n], image_id(n), bundler.at);
        if !bundler.is_registered() {
            foreign.unregistered.push(name.clone());
            continue;
        }
        let (w, h) = size_of(name).unwrap_or_else(|| {
            guessed += 1;
            guessed_size(points.farthest(n), true)
        });
        let half = [f64::from(w) / 2.0, f64::from(h) / 2.0];
        let params = vec![bundler.focal, half[0], half[1], bundler.k1, bundler.k2];
        let intrinsics = Camera::new(id, CameraModel::Radial, w.into(), h.into(), params);
        foreign
            .model
            .cameras
            .push(camera(intrinsics, || format!("camera {id}, {name:?}"))?);
        // Bundler's cameras have y up and z backward.
        let flip = Matrix3::from_diagonal(&Vector3::new(1.0, -1.0, -1.0));
        let pose = pose(flip * bundler.rotation, flip * bundler.translation);
        let pose = pose.map_err(|problem| problem.at(at).in_record(|| format!("camera {id}")))?;
        foreign.add_image(id, name.clone(), id, pose, at);
        if let Some(image) = foreign.model.images.last_mut() {
            // Bundler's pixels count from the centre, and upwards.
            image.points2d = points.take_points2d(n, |[x, y]| [half[0] + x, half[1] - y]);
        }
    }
    foreign.model.points = points.points;
    foreign.warn_of_guessed_sizes(guessed);
    Ok(foreign)
}
