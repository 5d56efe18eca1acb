//! VisualSFM's `NVM_V3`, also written by COLMAP and OpenMVG.
//!
//! ```text
//! NVM_V3 [FixedK fx cx fy cy [r]]
//! CAMERAS   then per line: NAME f  qw qx qy qz  Cx Cy Cz  r 0
//! POINTS    then per line: X Y Z  r g b  n (camera key x y) ...
//! ```
//!
//! Quaternions are world to camera, axes as in COLMAP, C is the camera centre. Pixels are relative
//! to the image centre (VisualSFM) or corner (COLMAP, OpenMVG); a negative one in the file means
//! the former. The distortion r applies to *measured* pixels; to first order it is SIMPLE_RADIAL
//! with k = -r, which is how COLMAP writes it. The file doesn't store image sizes. Of several
//! models of a file the one with most cameras is read.

use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use viewrank_core::model::{
    camera::{Camera, CameraModel},
    scene::WarningKind,
};

use super::{
    Fault, Place, Problem, check_images,
    foreign::{ForeignModel, SizeLookup, camera, guessed_size, pose_with_centre, unexpected},
    measured::{MeasuredPoints, image_id},
    words::{Words, name_and_numbers},
};

struct NvmCamera {
    name: String,
    /// f, quaternion, centre, r, 0
    numbers: [f64; 10],
    at: Place,
}

pub fn read(nvm: &[u8], size_of: SizeLookup) -> Result<ForeignModel, Fault> {
    let mut words = Words::new(nvm);
    let head = words.line().and_then(|line| line.strip_prefix(b"NVM_V3"));
    let fixed = head.ok_or_else(|| Words::new(nvm).unexpected("NVM_V3"))?;
    let (mut largest, mut position) = (model(&mut words)?, 1);
    let mut others = Vec::new();
    let mut cut_off = None;
    // What follows the models, a list of PLY files, may say anything.
    for n in 2.. {
        let has_cameras = words
            .clone()
            .number::<u64>("cameras")
            .is_ok_and(|count| count > 0);
        if !has_cameras {
            break;
        }
        let mut next = match model(&mut words) {
            Ok(next) => next,
            // A whole model was read, so damage to a later one is only worth a warning.
            Err(fault) => {
                cut_off = Some(format!("model {n} of the NVM file cannot be read: {fault}"));
                break;
            }
        };
        let mut left = n;
        if next.cameras.len() > largest.cameras.len() {
            std::mem::swap(&mut next, &mut largest);
            std::mem::swap(&mut left, &mut position);
        }
        others.push((format!("model {left}"), next.cameras.len()));
    }
    let mut foreign = assemble(largest, size_of)?;
    if !fixed.trim_ascii().is_empty() {
        foreign.warn(
            WarningKind::Format,
            "FixedK of the NVM file is ignored in favour of the focal length of each camera",
        );
    }
    foreign.warn_of_others("models of the NVM file", &others);
    if let Some(text) = cut_off {
        foreign.warn(WarningKind::Damaged, text);
    }
    Ok(foreign)
}

struct NvmModel {
    cameras: Vec<NvmCamera>,
    points: MeasuredPoints,
}

fn model(words: &mut Words) -> Result<NvmModel, Fault> {
    let count = words.count("cameras", 22)?;
    check_images(count)?;
    // The rest of the line with the count: cameras are whole lines.
    words.line();
    let cameras = words.records("camera", count, nvm_camera)?;
    let count = if words.at_end() {
        0
    } else {
        words.count("points", 14)?
    };
    let points = MeasuredPoints::read(words, count, &vec![true; cameras.len()], colour)?;
    Ok(NvmModel { cameras, points })
}

fn nvm_camera(words: &mut Words) -> Result<NvmCamera, Fault> {
    let at = words.place();
    let expected = "a name, focal length, quaternion, centre, distortion and 0";
    let fault = |problem: Problem| problem.at(at);
    let line = words
        .full_line()
        .ok_or_else(|| fault(Problem::Truncated("the cameras")))?;
    let (name, numbers) =
        name_and_numbers::<10>(line).ok_or_else(|| fault(unexpected(line, expected)))?;
    let name = std::str::from_utf8(name).map_err(|_| {
        fault(Problem::Name {
            name: String::from_utf8_lossy(name).into_owned(),
            why: "is not UTF-8",
        })
    })?;
    Ok(NvmCamera {
        name: name.to_owned(),
        numbers,
        at,
    })
}

fn colour(words: &mut Words) -> Result<[u8; 3], Fault> {
    // Some writers print colours as floating-point numbers.
    let colour = words.numbers::<3>("a colour")?;
    Ok(colour.map(|c| c.round().clamp(0.0, 255.0) as u8))
}

fn assemble(nvm: NvmModel, size_of: SizeLookup) -> Result<ForeignModel, Fault> {
    let NvmModel {
        cameras,
        mut points,
    } = nvm;
    let mut foreign = ForeignModel::default();
    let from_centre = points.are_from_centre();
    let mut guessed = 0;
    for (n, nvm) in cameras.iter().enumerate() {
        let [f, w, x, y, z, cx, cy, cz, r, _] = nvm.numbers;
        let (width, height) = size_of(&nvm.name).unwrap_or_else(|| {
            guessed += 1;
            guessed_size(points.farthest(n), from_centre)
        });
        let half = [f64::from(width) / 2.0, f64::from(height) / 2.0];
        let id = image_id(n);
        let what = || format!("camera {id}, {:?}", nvm.name);
        // VisualSFM's r undistorts; to first order the opposite distorts.
        let params = vec![f, half[0], half[1], -r];
        let intrinsics = Camera::new(
            id,
            CameraModel::SimpleRadial,
            width.into(),
            height.into(),
            params,
        );
        foreign.model.cameras.push(camera(intrinsics, what)?);
        let quaternion = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
        let rotation = quaternion.to_rotation_matrix().into_inner();
        let pose = pose_with_centre(rotation, Vector3::new(cx, cy, cz));
        let pose = pose.map_err(|problem| problem.at(nvm.at).in_record(what))?;
        foreign.add_image(id, nvm.name.clone(), id, pose, nvm.at);
        let [x, y] = if from_centre { half } else { [0.0; 2] };
        foreign.model.images[n].points2d =
            points.take_points2d(n, |pixel| [pixel[0] + x, pixel[1] + y]);
    }
    foreign.model.points = points.points;
    foreign.warn_of_guessed_sizes(guessed);
    Ok(foreign)
}
