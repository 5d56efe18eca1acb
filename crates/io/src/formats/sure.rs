//! SURE's `.ori`: interior and exterior orientation of one image, a text file of keys and values.
//!
//! The rotation is world to camera, the "translation vector" is the camera *centre*; axes as in
//! COLMAP; the centre of the first pixel is (0, 0). The camera matrix is in pixels, so the focal
//! length in mm and the pixel size are ignored. Distortion is `NONE`, or `Brown5` with K1 K2 K3 T1
//! T2.

use std::collections::{HashMap, HashSet};

use nalgebra::{Matrix3, Vector3};
use viewrank_core::model::{
    camera::{Camera, CameraModel},
    scene::{Pose, WarningKind},
};

use super::{
    Fault, Place, Problem,
    colmap::StoredPose,
    foreign::{ForeignModel, brown, camera, pose_with_centre, shift, unexpected},
    words::parse,
};

/// One oriented image.
#[derive(Clone, Debug)]
pub struct Orientation {
    /// File name of the image.
    pub image: String,
    /// Pose in COLMAP's conventions.
    pub camera: Camera,
    pub cam_from_world: StoredPose,
}

/// Reads one `.ori` file; `id` becomes the id of its camera.
pub fn read(bytes: &[u8], id: u32) -> Result<Orientation, Fault> {
    let entries = entries(bytes)?;
    let image = image_id(&entries)?;
    let [width, height] = numbers(&entries, "IntOri_SensorSize")?;
    let (model, params) = distortion(&entries, pinhole_part(&entries)?)?;
    let camera = camera(
        Camera::new(id, model, width as u64, height as u64, params),
        || format!("image {image:?}"),
    )?;
    Ok(Orientation {
        image: image.to_owned(),
        camera,
        cam_from_world: pose(&entries)?,
    })
}

/// File name of the image.
fn image_id<'a>(entries: &Entries<'a>) -> Result<&'a str, Fault> {
    let text = entries.get("ImageID").map(|entry| entry.text.trim_ascii());
    let line = text.unwrap_or_default().split(|&b| b == b'\n').next();
    let line = line.unwrap_or_default().trim_ascii();
    std::str::from_utf8(line).map_err(|_| {
        let problem = Problem::Content("the image id is not UTF-8".into());
        problem.at(Place::File)
    })
}

/// fx, fy, cx, cy, in COLMAP's pixels.
fn pinhole_part(entries: &Entries) -> Result<[f64; 4], Fault> {
    let (focal, centre) = if entries.contains_key("IntOri_CameraMatrix") {
        let matrix = numbers::<9>(entries, "IntOri_CameraMatrix")?;
        ([matrix[0], matrix[4]], [matrix[2], matrix[5]])
    } else {
        let [f] = numbers(entries, "IntOri_FocalLength")?;
        let [px, py] = numbers(entries, "IntOri_PixelSize")?;
        let centre = numbers(entries, "IntOri_PrincipalPoint")?;
        ([f / px, f / py], centre)
    };
    let ([fx, fy], [cx, cy]) = (focal, shift(centre));
    Ok([fx, fy, cx, cy])
}

fn pose(entries: &Entries) -> Result<StoredPose, Fault> {
    let rotation = Matrix3::from_row_slice(&numbers::<9>(entries, "ExtOri_RotationMatrix")?);
    let centre = Vector3::from(numbers::<3>(entries, "ExtOri_TranslationVector")?);
    let at = entries["ExtOri_RotationMatrix"].at;
    pose_with_centre(rotation, centre).map_err(|problem| problem.at(at))
}

/// The lines after a key.
struct Entry<'a> {
    at: Place,
    text: &'a [u8],
}

impl<'a> Entry<'a> {
    fn words(&self) -> impl Iterator<Item = &'a [u8]> {
        let words = self.text.split(u8::is_ascii_whitespace);
        words.filter(|word| !word.is_empty())
    }

    /// The first words, for an error.
    fn beginning(&self) -> String {
        let words = self.words().take(10).map(String::from_utf8_lossy);
        words.collect::<Vec<_>>().join(" ")
    }
}

/// The keys that are read.
const KEYS: [&str; 9] = [
    "ImageID",
    "IntOri_SensorSize",
    "IntOri_CameraMatrix",
    "IntOri_FocalLength",
    "IntOri_PixelSize",
    "IntOri_PrincipalPoint",
    "IntOri_Distortion",
    "ExtOri_RotationMatrix",
    "ExtOri_TranslationVector",
];

type Entries<'a> = HashMap<&'static str, Entry<'a>>;

/// Entries of the keys that are read.
fn entries(bytes: &[u8]) -> Result<Entries<'_>, Fault> {
    let mut entries = Entries::new();
    // The last key, where its text begins, and which of those that are read it is.
    let mut last = None;
    let mut end = 0;
    for (n, line) in (1..).zip(bytes.split_inclusive(|&b| b == b'\n')) {
        end += line.len();
        let (at, line) = (Place::Line(n), line.trim_ascii());
        if let Some(head) = line.strip_prefix(b"$") {
            // Other keys take no memory: a file may have millions.
            let key = known_key(head);
            if let Some(key) = key {
                entries.insert(key, Entry { at, text: &[] });
            }
            last = Some((key, end));
        } else if let Some((key, start)) = last {
            if let Some(entry) = key.and_then(|key| entries.get_mut(key)) {
                entry.text = &bytes[start..end];
            }
        } else if !line.is_empty() {
            let expected = "a key that begins with $";
            return Err(unexpected(line, expected).at(at));
        }
    }
    Ok(entries)
}

/// The key in a line after `$`, if it is one that is read.
fn known_key(head: &[u8]) -> Option<&'static str> {
    let key = key_in(head);
    KEYS.into_iter().find(|known| known.as_bytes() == key)
}

/// The key in a line: the text between `$` and the first bracket or run of underscores.
fn key_in(head: &[u8]) -> &[u8] {
    let underscores = head.windows(2).position(|pair| pair == b"__");
    let bracket = head.iter().position(|b| b"([".contains(b));
    let end = underscores.into_iter().chain(bracket).min();
    let key = &head[..end.unwrap_or(head.len())];
    key.strip_suffix(b"_").unwrap_or(key)
}

fn numbers<const N: usize>(entries: &Entries, key: &'static str) -> Result<[f64; N], Fault> {
    let fault = |at, found: String| {
        let problem = Problem::syntax(key, found);
        problem.at(at)
    };
    let entry = entries
        .get(key)
        .ok_or_else(|| fault(Place::File, "no such key".into()))?;
    // One more than wanted shows a surplus; the text may have millions.
    let words = entry.words().take(N + 1);
    let values: Option<Vec<f64>> = words.map(|word| parse(word).ok()).collect();
    values
        .and_then(|values| values.try_into().ok())
        .ok_or_else(|| fault(entry.at, entry.beginning()))
}

/// COLMAP's model, and its parameters.
fn distortion(entries: &Entries, pinhole: [f64; 4]) -> Result<(CameraModel, Vec<f64>), Fault> {
    let without = (CameraModel::Pinhole, pinhole.to_vec());
    let Some(entry) = entries.get("IntOri_Distortion") else {
        return Ok(without);
    };
    // After the name of the model and the number of its parameters.
    let values = entry.words().skip(2).filter_map(|word| parse(word).ok());
    let values: Vec<f64> = values.take(6).collect();
    match (entry.words().next(), &values[..]) {
        (None | Some(b"NONE"), _) => Ok(without),
        (Some(b"Brown5"), &[k1, k2, k3, t1, t2]) => Ok(brown(pinhole, [k1, k2, k3], [t1, t2])),
        _ => {
            let problem = Problem::CameraModel(format!("{} (SURE)", entry.beginning()));
            Err(problem.at(entry.at))
        }
    }
}

/// Makes a model of oriented images, without points. `name_of` completes image names: the file may
/// omit the extension.
pub fn model(oriented: Vec<Orientation>, name_of: impl Fn(&str) -> String) -> ForeignModel {
    let mut foreign = ForeignModel::default();
    for Orientation {
        image,
        camera,
        cam_from_world,
    } in oriented
    {
        let id = camera.id;
        foreign.model.cameras.push(camera);
        foreign.add_image(id, name_of(&image), id, cam_from_world, Place::File);
    }
    foreign
}

/// Adds the points and measured pixels of another model of the same images. Images are matched by
/// name without extensions and, if that is unambiguous, without folders: SURE's files may have
/// neither.
pub fn add_tracks(foreign: &mut ForeignModel, cloud: &ForeignModel) -> Result<(), Problem> {
    let images = &cloud.model.images;
    let own = positions(foreign, images.iter().map(|image| &*image.name));
    report_unmatched(foreign, cloud, &own)?;
    let position: HashMap<u32, usize> = images
        .iter()
        .enumerate()
        .map(|(n, image)| (image.id, n))
        .collect();
    for point in &cloud.model.points {
        let track = point.track.iter().filter_map(|element| {
            let n = *position.get(&element.image())?;
            let pixel = images[n].points2d.get(element.index() as usize)?.pixel();
            Some((own[n]?, pixel))
        });
        foreign.add_point(
            point.id,
            point.xyz,
            point.colour,
            track.collect::<Vec<_>>(),
            Place::File,
        );
    }
    Ok(())
}

/// Index of the oriented image for each name.
fn positions<'a>(
    oriented: &ForeignModel,
    names: impl Iterator<Item = &'a str>,
) -> Vec<Option<usize>> {
    let images = oriented.model.images.iter();
    let own: Vec<String> = images.map(|image| stem(&image.name)).collect();
    let names: Vec<String> = names.map(stem).collect();
    let by_stem: HashMap<&str, usize> = own.iter().map(String::as_str).zip(0..).collect();
    let (own_by_file, names_by_file) = (by_file(&own), by_file(&names));
    let only_of_file = |stem: &str| match own_by_file.get(file_of(stem))?[..] {
        [n] if names_by_file[file_of(stem)].len() == 1 => Some(n),
        _ => None,
    };
    names
        .iter()
        .map(|stem| by_stem.get(&**stem).copied().or_else(|| only_of_file(stem)))
        .collect()
}

/// A name with `/`, without its extension and in lower case.
fn stem(name: &str) -> String {
    crate::paths::stem(&name.replace('\\', "/")).to_lowercase()
}

/// The last part of a stem.
fn file_of(stem: &str) -> &str {
    stem.rsplit('/').next().unwrap_or_default()
}

/// Positions of the stems by their last parts.
fn by_file(stems: &[String]) -> HashMap<&str, Vec<usize>> {
    let mut by_file: HashMap<&str, Vec<usize>> = HashMap::new();
    for (n, stem) in stems.iter().enumerate() {
        by_file.entry(file_of(stem)).or_default().push(n);
    }
    by_file
}

/// Warns of images without a counterpart; an error if no image has one, since the two models then
/// don't match.
fn report_unmatched(
    foreign: &mut ForeignModel,
    cloud: &ForeignModel,
    own: &[Option<usize>],
) -> Result<(), Problem> {
    let matched: HashSet<usize> = own.iter().flatten().copied().collect();
    let oriented = names_of(foreign, |n| !matched.contains(&n));
    let others = names_of(cloud, |n| own[n].is_none());
    if let (true, [first, ..], [other, ..]) = (matched.is_empty(), &oriented[..], &others[..]) {
        return Err(Problem::Contradiction(format!(
            "no image of the sparse cloud (e.g. {other}) is among the oriented images (e.g. {first})"
        )));
    }
    let of_oriented = "oriented images are not in the sparse cloud";
    warn_of_unmatched(foreign, &oriented, of_oriented);
    let of_others = "images of the sparse cloud are not oriented";
    warn_of_unmatched(foreign, &others, of_others);
    Ok(())
}

/// Names of the images of some positions.
fn names_of(foreign: &ForeignModel, is_wanted: impl Fn(usize) -> bool) -> Vec<String> {
    let images = foreign.model.images.iter().enumerate();
    let wanted = images.filter(|(n, _)| is_wanted(*n));
    wanted.map(|(_, image)| image.name.to_string()).collect()
}

fn warn_of_unmatched(foreign: &mut ForeignModel, names: &[String], what: &str) {
    if names.is_empty() {
        return;
    }
    let some = &names[..names.len().min(3)];
    let more = if names.len() > 3 { ", ..." } else { "" };
    let text = format!(
        "{} {what}, so their observations are missing: {}{more}",
        names.len(),
        some.join(", ")
    );
    foreign.warn(WarningKind::Damaged, text);
}

/// Text of the `.ori` file of an undistorted image; `None` for cameras with distortion.
pub fn write(image: &str, camera: &Camera, cam_from_world: &Pose) -> Option<String> {
    if !camera.is_pinhole() {
        return None;
    }
    let id = [key("ImageID", "(ORI_Ver_1.0)"), format!("\t{image}")];
    let distortion = [
        key(
            "IntOri_Distortion_____(Model|ParameterCount|(Parameters))",
            "",
        ),
        "\tNONE\t0".into(),
    ];
    let (interior, exterior) = (interior(camera), exterior(cam_from_world));
    let lines = [&id[..], &interior, &exterior, &distortion].concat();
    Some(lines.join("\n") + "\n")
}

/// A line with a key, filled with underscores.
fn key(name: &str, note: &str) -> String {
    let fill = 71usize.saturating_sub(name.len() + note.len());
    format!("${name}{}{note}", "_".repeat(fill))
}

fn interior(camera: &Camera) -> [String; 12] {
    let (focal, centre) = camera.pinhole_part();
    // The centre of SURE's first pixel is (0, 0).
    let (cx, cy) = (centre.x - 0.5, centre.y - 0.5);
    [
        // Length and pixel size are ignored beside the camera matrix, but belong to the file.
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
    ]
}

fn exterior(cam_from_world: &Pose) -> [String; 6] {
    let r = cam_from_world.rotation.matrix();
    let row = |i: usize| format!("\t{}\t{}\t{}", r[(i, 0)], r[(i, 1)], r[(i, 2)]);
    let c = cam_from_world.centre();
    [
        key("ExtOri_RotationMatrix", "(World->ImageCoordinateSystem)"),
        row(0),
        row(1),
        row(2),
        key("ExtOri_TranslationVector", "(WorldCoordinateSystem)"),
        format!("\t{}\t{}\t{}", c.x, c.y, c.z),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_entries_that_are_read_are_kept() {
        let unwanted: String = (0..1000).map(|n| format!("$a{n}\n{n}\n")).collect();
        let text = format!(
            "$ImageID__(v)\n\n\ta b.jpg \r\n{unwanted}$IntOri_PixelSize_(x|y)[mm]\n1\n 2\n"
        );
        let entries = entries(text.as_bytes()).unwrap();
        assert_eq!(entries.len(), 2);
        assert_eq!(entries["ImageID"].text.trim_ascii(), b"a b.jpg");
        assert_eq!(numbers(&entries, "IntOri_PixelSize"), Ok([1.0, 2.0]));
        assert!(numbers::<3>(&entries, "IntOri_PixelSize").is_err());
        assert!(super::entries(b"\n1 2\n$ImageID\na").is_err());
    }
}
