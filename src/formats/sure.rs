//! SURE's `.ori`: interior and exterior orientation of one image, a text file of keys and values.
//!
//! World to camera; the "translation vector" is the camera's *centre*; axes as in COLMAP; the centre of the first pixel is (0, 0).
//! Focal length in mm and pixel size are not used: the camera matrix is in pixels. Distortion is `NONE`, or `Brown5` with
//! K1 K2 K3 T1 T2.

use std::collections::HashMap;

use nalgebra::{Matrix3, Point3, Vector3};
use rayon::prelude::*;

use super::{
    Fault, Place, Problem,
    colmap::StoredPose,
    foreign::{Foreign, camera, pose_with_centre, shift},
    words::parse,
};
use crate::{
    camera::{Camera, CameraModel},
    scene::Pose,
};

/// One oriented image.
#[derive(Clone, Debug)]
pub struct Orientation {
    /// The image's file name.
    pub image: String,
    /// In COLMAP's conventions.
    pub camera: Camera,
    pub cam_from_world: StoredPose,
}

/// Reads one `.ori` file; `id` becomes the id of its camera.
pub fn read(bytes: &[u8], id: u32) -> Result<Orientation, Fault> {
    let entries = entries(bytes)?;
    let image = entries.get("ImageID").and_then(|entry| entry.lines.first()).copied().unwrap_or_default();
    let image = std::str::from_utf8(image)
        .map_err(|_| Fault::new("", Place::File, Problem::Json("the image id is not UTF-8".into())))?;
    let [width, height] = numbers(&entries, "IntOri_SensorSize")?;
    let matrix = match entries.contains_key("IntOri_CameraMatrix") {
        true => numbers::<9>(&entries, "IntOri_CameraMatrix")?,
        false => {
            let [f] = numbers(&entries, "IntOri_FocalLength")?;
            let [px, py] = numbers(&entries, "IntOri_PixelSize")?;
            let [cx, cy] = numbers(&entries, "IntOri_PrincipalPoint")?;
            [f / px, 0.0, cx, 0.0, f / py, cy, 0.0, 0.0, 1.0]
        }
    };
    let [cx, cy] = shift([matrix[2], matrix[5]]);
    let (model, params) = distortion(&entries, [matrix[0], matrix[4], cx, cy])?;
    let camera = camera(Camera::new(id, model, width as u64, height as u64, params), || format!("image {image:?}"))?;
    let rotation = Matrix3::from_row_slice(&numbers::<9>(&entries, "ExtOri_RotationMatrix")?);
    let centre = Vector3::from(numbers::<3>(&entries, "ExtOri_TranslationVector")?);
    let at = entries["ExtOri_RotationMatrix"].at;
    let cam_from_world = pose_with_centre(rotation, centre).map_err(|problem| Fault::new("", at, problem))?;
    Ok(Orientation { image: image.to_owned(), camera, cam_from_world })
}

/// A key and the lines below it.
struct Entry<'a> {
    at: Place,
    lines: Vec<&'a [u8]>,
}

/// By key: what stands between `$` and the first run of underscores or bracket.
fn entries(bytes: &[u8]) -> Result<HashMap<String, Entry<'_>>, Fault> {
    let mut entries: HashMap<String, Entry> = HashMap::new();
    let mut current = None;
    for (n, line) in bytes.split(|&b| b == b'\n').enumerate() {
        let line = line.trim_ascii();
        if let Some(key) = line.strip_prefix(b"$") {
            let key = String::from_utf8_lossy(key);
            let ends = [key.find("__"), key.find(['(', '['])];
            let end = ends.into_iter().flatten().min().unwrap_or(key.len());
            let key = key[..end].trim_end_matches('_').to_owned();
            entries.insert(key.clone(), Entry { at: Place::Line(n as u64 + 1), lines: Vec::new() });
            current = Some(key);
        } else if !line.is_empty() {
            let entry = current.as_ref().and_then(|key| entries.get_mut(key));
            let found = || String::from_utf8_lossy(&line[..line.len().min(40)]).into_owned();
            let problem = || Problem::Syntax { expected: "a key that begins with $", found: found() };
            entry.ok_or_else(|| Fault::new("", Place::Line(n as u64 + 1), problem()))?.lines.push(line);
        }
    }
    Ok(entries)
}

fn numbers<const N: usize>(entries: &HashMap<String, Entry>, key: &'static str) -> Result<[f64; N], Fault> {
    let missing = || Fault::new("", Place::File, Problem::Syntax { expected: key, found: "no such key".into() });
    let entry = entries.get(key).ok_or_else(missing)?;
    let words = entry.lines.iter().flat_map(|line| line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty()));
    let values: Option<Vec<f64>> = words.map(|word| parse(word).ok()).collect();
    values.and_then(|values| values.try_into().ok()).ok_or_else(|| {
        let found = entry.lines.iter().map(|line| String::from_utf8_lossy(line)).collect::<Vec<_>>().join(" ");
        Fault::new("", entry.at, Problem::Syntax { expected: key, found })
    })
}

fn distortion(entries: &HashMap<String, Entry>, [fx, fy, cx, cy]: [f64; 4]) -> Result<(CameraModel, Vec<f64>), Fault> {
    let Some(entry) = entries.get("IntOri_Distortion") else { return Ok((CameraModel::Pinhole, vec![fx, fy, cx, cy])) };
    let text = entry.lines.iter().map(|line| String::from_utf8_lossy(line)).collect::<Vec<_>>().join(" ");
    let words: Vec<&str> = text.split_whitespace().collect();
    let values: Vec<f64> = words.iter().skip(2).filter_map(|word| word.parse().ok()).collect();
    match (words.first().copied(), &values[..]) {
        (None | Some("NONE"), _) => Ok((CameraModel::Pinhole, vec![fx, fy, cx, cy])),
        (Some("Brown5"), &[k1, k2, k3, t1, t2]) => {
            Ok((CameraModel::FullOpenCv, vec![fx, fy, cx, cy, k1, k2, t1, t2, k3, 0.0, 0.0, 0.0]))
        }
        _ => Err(Fault::new("", entry.at, Problem::CameraModel(format!("{text} (SURE)")))),
    }
}

/// The model of oriented images, without points. `name_of` finds the image's name, for the file may leave the extension out.
pub fn model(oriented: Vec<Orientation>, name_of: impl Fn(&str) -> String) -> Foreign {
    let mut foreign = Foreign::default();
    for Orientation { image, camera, cam_from_world } in oriented {
        let id = camera.id;
        foreign.model.cameras.push(camera);
        foreign.add_image(id, name_of(&image), id, cam_from_world, Place::File);
    }
    foreign
}

/// Adds points that nothing is known of but their places: each is taken as seen by all views that it projects into, hidden or
/// not; pixels are the projections.
pub fn add_cloud(foreign: &mut Foreign, points: &[Point3<f64>]) {
    let cameras: HashMap<u32, Camera> = foreign.model.cameras.iter().map(|c| (c.id, c.clone())).collect();
    let poses =
        foreign.model.images.iter().map(|image| Some((image.cam_from_world.pose().ok()?, &cameras[&image.camera_id])));
    let poses: Vec<_> = poses.collect();
    let seen_by = |x: &Point3<f64>| -> Vec<(usize, [f64; 2])> {
        let pixel = |(pose, camera): &(Pose, &Camera)| {
            camera.project(&pose.camera_from_world(x)).filter(|pixel| camera.contains(pixel))
        };
        let views = poses.iter().enumerate();
        views.filter_map(|(n, view)| view.as_ref().and_then(pixel).map(|p| (n, [p.x, p.y]))).collect()
    };
    let tracks: Vec<_> = points.par_iter().map(seen_by).collect();
    for (n, (x, track)) in points.iter().zip(tracks).enumerate() {
        foreign.add_point(n as u64 + 1, (*x).into(), [255; 3], track, Place::File);
    }
    foreign
        .model
        .warnings
        .push("the points of the PLY file have no tracks: all views that they project into count".into());
}

/// Adds the points of another model of the same images, found by their names, extensions aside. Pixels are as measured there.
pub fn add_tracks(foreign: &mut Foreign, cloud: &Foreign) {
    let stem = |name: &str| name.rsplit_once('.').map_or(name, |(stem, _)| stem).to_owned();
    let own: HashMap<String, usize> =
        foreign.model.images.iter().enumerate().map(|(n, image)| (stem(&image.name), n)).collect();
    let images = &cloud.model.images;
    let position: HashMap<u32, usize> = images.iter().enumerate().map(|(n, image)| (image.id, n)).collect();
    for point in &cloud.model.points {
        let track = point.track.iter().filter_map(|element| {
            let image = &images[*position.get(&element.image())?];
            let pixel = image.points2d.get(element.index() as usize)?.pixel();
            Some((*own.get(&stem(&image.name))?, pixel))
        });
        foreign.add_point(point.id, point.xyz, point.colour, track.collect::<Vec<_>>(), Place::File);
    }
}

/// The `.ori` file of an undistorted image; `None` for cameras with distortion.
pub fn write(image: &str, camera: &Camera, cam_from_world: &Pose) -> Option<String> {
    if !camera.is_pinhole() {
        return None;
    }
    let (focal, centre) = camera.pinhole_part();
    let (cx, cy) = (centre.x - 0.5, centre.y - 0.5);
    let r = cam_from_world.rotation.matrix();
    let row = |i: usize| format!("\t{}\t{}\t{}", r[(i, 0)], r[(i, 1)], r[(i, 2)]);
    let c = cam_from_world.centre();
    let key = |name: &str, note: &str| {
        format!("${name}{}{note}", "_".repeat(71usize.saturating_sub(name.len() + note.len())))
    };
    let lines = [
        key("ImageID", "(ORI_Ver_1.0)"),
        format!("\t{image}"),
        key("IntOri_FocalLength", "[mm]"),
        "\t1.0".into(),
        key("IntOri_PixelSize______(x|y)", "[mm]"),
        "\t1.0\t1.0".into(),
        key("IntOri_SensorSize_____(x|y)", "[pixel]"),
        format!("\t{}\t{}", camera.width, camera.height),
        key("IntOri_PrincipalPoint_(x|y)", "[pixel]"),
        format!("\t{cx}\t{cy}"),
        key("IntOri_CameraMatrix", "(ImageCoordinateSystem)"),
        format!("\t{}\t0.0\t{cx}", focal.x),
        format!("\t0.0\t{}\t{cy}", focal.y),
        "\t0.0\t0.0\t1.0".into(),
        key("ExtOri_RotationMatrix", "(World->ImageCoordinateSystem)"),
        row(0),
        row(1),
        row(2),
        key("ExtOri_TranslationVector", "(WorldCoordinateSystem)"),
        format!("\t{}\t{}\t{}", c.x, c.y, c.z),
        key("IntOri_Distortion_____(Model|ParameterCount|(Parameters))", ""),
        "\tNONE\t0".into(),
    ];
    Some(lines.join("\n") + "\n")
}
