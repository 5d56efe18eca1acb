//! Shared code of the readers of other programs' formats: each builds a model in COLMAP's
//! conventions, which is then checked and converted to a scene like a COLMAP model.

use std::{
    borrow::Cow,
    collections::{BTreeMap, HashMap, HashSet},
};

use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use viewrank_core::model::{
    camera::{Camera, CameraError, CameraModel},
    georeference::Georeference,
    scene::{Scene, ViewIndex, WarningKind},
};

use super::{
    Fault, LONGEST_NAME, Place, Problem, SPLIT, check_length,
    colmap::{ColmapImage, ColmapModel, ColmapPoint, Point2d, StoredPose, TrackElement},
    name_parts, start_of,
};
use crate::bounded::MORE_THAN;

/// Largest deviation of a rotation matrix from orthonormality (Frobenius norm of R Rᵀ - I); some
/// programs print six digits.
const ROTATION_TOLERANCE: f64 = 1e-3;

/// Models that a warning names.
const NAMED: usize = 3;

/// A model in COLMAP's conventions, with the additional data of its format.
#[derive(Clone, Debug, Default)]
pub struct ForeignModel {
    pub model: ColmapModel<'static>,
    /// Names of images without a pose.
    pub unregistered: Vec<String>,
    /// Names of images that the user took out of the model.
    pub left_out: Vec<String>,
    /// Ids of images that are kept apart for tests.
    pub tests: HashSet<u32>,
    /// Paths of masks, relative to the file, by the ids of their images.
    pub masks: HashMap<u32, String>,
    /// The folder to which image names are relative, for formats that store it.
    pub image_folder: Option<String>,
    /// Place on earth, for formats that store it.
    pub georeference: Option<Georeference>,
}

impl ForeignModel {
    pub fn scene(&self) -> Result<Scene, Fault> {
        // The names of views are checked with the model, these are not.
        for name in self.unregistered.iter().chain(&self.left_out) {
            check_length(name).map_err(|problem| problem.at(Place::File))?;
        }
        let mut scene = self.model.scene()?;
        scene.georeference = self.georeference;
        scene.unregistered = self.unregistered.clone();
        scene.unregistered.sort_unstable();
        scene.left_out = self.left_out.clone();
        scene.left_out.sort_unstable();
        let views = scene.view_indices();
        let is_test = |view: &ViewIndex| self.tests.contains(&scene.view(*view).image_id);
        scene.tests = views.filter(is_test).collect();
        Ok(scene)
    }

    /// Adds a view without 2D points.
    pub fn add_image(
        &mut self,
        id: u32,
        name: String,
        camera_id: u32,
        cam_from_world: StoredPose,
        at: Place,
    ) {
        let points2d = Cow::Owned(Vec::new());
        self.model.images.push(ColmapImage {
            id,
            cam_from_world,
            camera_id,
            name: Cow::Owned(name),
            points2d,
            at,
        });
    }

    /// Adds a point with its observations (index of the image in `model.images`, pixel).
    pub(super) fn add_point(
        &mut self,
        id: u64,
        xyz: [f64; 3],
        colour: [u8; 3],
        observations: impl IntoIterator<Item = (usize, [f64; 2])>,
        at: Place,
    ) {
        let images = &mut self.model.images;
        let track = observations.into_iter().map(|(image, pixel)| {
            let image = &mut images[image];
            image.points2d.to_mut().push(Point2d::new(pixel, Some(id)));
            TrackElement::new(image.id, image.points2d.len() as u32 - 1)
        });
        let track = Cow::Owned(track.collect());
        self.model.points.push(ColmapPoint {
            id,
            xyz,
            colour,
            error: -1.0,
            track,
            at,
        });
    }

    /// Leaves out the images of some positions, and their observations.
    pub(super) fn keep_images(&mut self, is_kept: impl Fn(usize) -> bool) {
        let images = std::mem::take(&mut self.model.images)
            .into_iter()
            .enumerate();
        let (kept, left): (Vec<_>, Vec<_>) = images.partition(|(n, _)| is_kept(*n));
        let left: HashSet<u32> = left.iter().map(|(_, image)| image.id).collect();
        self.model.images = kept.into_iter().map(|(_, image)| image).collect();
        for point in &mut self.model.points {
            let track = point.track.to_mut();
            track.retain(|element| !left.contains(&element.image()));
        }
    }

    /// Says which of several models in a file is read. `others`: those that are not, with their
    /// numbers of images.
    pub(super) fn warn_of_others(&mut self, what: &str, others: &[(String, usize)]) {
        if others.is_empty() {
            return;
        }
        let named: Vec<String> = others
            .iter()
            .take(NAMED)
            .map(|(name, images)| format!("{name} ({images} images)"))
            .collect();
        let more = if others.len() > NAMED { ", ..." } else { "" };
        let used = self.model.images.len();
        let text = format!(
            "of {} {what} one ({used} images) is read; left out: {}{more}",
            others.len() + 1,
            named.join(", ")
        );
        self.warn(WarningKind::OtherParts, text);
    }

    /// Warns of guessed image sizes, for formats that don't store them.
    pub(super) fn warn_of_guessed_sizes(&mut self, guessed: usize) {
        if guessed > 0 {
            let all = self.model.images.len();
            let text = format!(
                "images missing: {guessed} of {all}; their sizes are guessed from the measured pixels: copy the images next to the model"
            );
            self.warn(WarningKind::Guessed, text);
        }
    }

    pub fn warn(&mut self, kind: WarningKind, text: impl AsRef<str>) {
        self.model.warn(kind, text);
    }

    /// Writes names with `/` and without `.` and `..`, and makes absolute ones, or those that lead
    /// out of the folder of the model, relative to their common folder, which becomes the image
    /// folder. Paths of Windows count, too (`C:\photos\a.jpg`).
    pub fn shorten_names(&mut self) {
        let of_windows = self.names_mut().filter_map(normalise);
        // Names are rewritten as the iterator passes them, so all must be visited.
        let drive = of_windows.last().unwrap_or(false);
        let is_absolute = |name: &str| name.starts_with('/');
        let leads_out = |name: &str| is_absolute(name) || name.starts_with("../");
        // What leads further than to the parent stays, and is refused.
        let leads_away = |name: &str| !is_absolute(name) && name_parts(name).is_none();
        if !self.names().any(leads_out) || self.names().any(leads_away) {
            return;
        }
        let common = common_folder(self.names());
        self.names_mut()
            .for_each(|name| _ = name.drain(..common.len()));
        // Of several drives, none is left.
        let is_on_drive = drive && common.len() > 2;
        self.image_folder = Some(if is_on_drive {
            format!("{}:{}", &common[1..2], &common[2..])
        } else {
            common
        });
    }

    /// Names of all images, with a pose and without.
    fn names(&self) -> impl Iterator<Item = &str> {
        let registered = self.model.images.iter().map(|image| &*image.name);
        registered.chain(self.unregistered.iter().map(String::as_str))
    }

    fn names_mut(&mut self) -> impl Iterator<Item = &mut String> {
        let registered = self.model.images.iter_mut();
        let registered = registered.map(|image| image.name.to_mut());
        registered.chain(&mut self.unregistered)
    }
}

/// Writes a name with `/` and without `.` and `..`, a URL of a file as its path, an absolute path
/// of Windows with its drive as the first folder; returns for such a path whether it has a drive.
fn normalise(name: &mut String) -> Option<bool> {
    if let Some(path) = name.strip_prefix("file://") {
        // `file:///D:/a.jpg` has a slash before the drive.
        let below = path.trim_start_matches('/');
        *name = if is_of_windows(below) { below } else { path }.to_owned();
    }
    if is_of_windows(name) {
        let has_drive = !name.starts_with('\\');
        let slash = if has_drive { "/" } else { "" };
        // With the drive as a folder, names on several drives have no folder in common.
        *name = slash.to_owned() + &name.replace('\\', "/").replacen(':', "", 1);
        return Some(has_drive);
    }
    if !name.starts_with('/')
        && let Some(parts) = name_parts(name)
    {
        *name = parts.join("/");
    }
    None
}

/// The longest folder, with its `/`, that all names begin with; empty without one.
fn common_folder<'a>(mut names: impl Iterator<Item = &'a str>) -> String {
    let folder = |path: &str| path.rfind('/').map_or(0, |end| end + 1);
    let first = names.next().unwrap_or_default();
    let mut common = first[..folder(first)].to_owned();
    for name in names {
        let pairs = common.bytes().zip(name.bytes());
        let shared = pairs.take_while(|(a, b)| a == b).count();
        // Cut behind a slash, which is a whole character in UTF-8.
        let slash = common.as_bytes()[..shared].iter().rposition(|&b| b == b'/');
        common.truncate(slash.map_or(0, |end| end + 1));
    }
    common
}

/// The component of most images, ties by name, and the others with their numbers of images.
pub(super) fn largest_component<'a>(
    of_images: impl Iterator<Item = &'a str>,
) -> (String, Vec<(String, usize)>) {
    let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
    of_images.for_each(|component| *counts.entry(component).or_default() += 1);
    // `max_by_key` takes the last of equals; reversed, that is the first by name.
    let largest = counts.iter().rev().max_by_key(|(_, images)| **images);
    let largest = largest.map_or("", |(component, _)| *component).to_owned();
    let others = counts
        .into_iter()
        .filter(|(component, _)| **component != largest)
        .map(|(component, images)| (format!("component {component}"), images));
    let others = others.collect();
    (largest, others)
}

/// Most folders of a moved image's path that still hold.
const KEPT_FOLDERS: usize = 16;

/// The name, and if it is an absolute path, or leads further than to the parent of its folder, what
/// is left without its first folders: the image may have moved.
pub fn last_parts(name: &str) -> Vec<String> {
    if name.len() > LONGEST_NAME {
        return vec![name.to_owned()];
    }
    let is_absolute = name.starts_with('/');
    let has_moved = is_of_windows(name) || is_absolute || name_parts(name).is_none();
    let slashes = if has_moved && !is_absolute {
        name.replace('\\', "/")
    } else {
        name.to_owned()
    };
    let ends = slashes
        .rmatch_indices('/')
        .filter(|_| has_moved)
        .take(KEPT_FOLDERS);
    let mut parts: Vec<String> = ends.map(|(at, _)| slashes[at + 1..].to_owned()).collect();
    parts.push(name.to_owned());
    // The longest end first: a shorter one fits more files.
    parts.reverse();
    parts
}

/// Returns whether a name is an absolute path of Windows: a drive or a server.
pub fn is_of_windows(name: &str) -> bool {
    let drive = name.as_bytes();
    name.starts_with(r"\\")
        || matches!(drive, [letter, b':', b'\\' | b'/', ..] if letter.is_ascii_alphabetic())
}

/// Makes a pose from a rotation matrix (world to camera) and a translation; orthonormalises the
/// rotation.
pub(super) fn pose(
    rotation: Matrix3<f64>,
    translation: Vector3<f64>,
) -> Result<StoredPose, Problem> {
    if !rotation
        .iter()
        .chain(translation.iter())
        .all(|v| v.is_finite())
    {
        return Err(Problem::NotFinite("the pose"));
    }
    // The rows of a mirrored frame are orthonormal, too: only its determinant tells.
    let off = (rotation * rotation.transpose() - Matrix3::identity()).norm();
    if off > ROTATION_TOLERANCE || rotation.determinant() < 0.0 {
        return Err(Problem::Contradiction(
            "the rows of the rotation matrix are not orthonormal".into(),
        ));
    }
    // Orthonormalised by the polar decomposition.
    let svd = rotation.svd(true, true);
    let rotation = svd.u.zip(svd.v_t).map_or(rotation, |(u, v_t)| u * v_t);
    let q = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
    Ok(StoredPose {
        quaternion: [q.w, q.i, q.j, q.k],
        translation: translation.into(),
    })
}

/// Makes a pose from a rotation matrix (world to camera) and the camera centre.
pub(super) fn pose_with_centre(
    rotation: Matrix3<f64>,
    centre: Vector3<f64>,
) -> Result<StoredPose, Problem> {
    pose(rotation, -(rotation * centre))
}

/// Adds half a pixel: converts from pixel centres at integers to COLMAP's convention (first centre
/// at 0.5, 0.5).
pub(super) fn shift(pixel: [f64; 2]) -> [f64; 2] {
    pixel.map(|c| c + 0.5)
}

/// Returns the camera, as a pinhole camera if its distortion is zero, or the fault.
pub(super) fn camera(
    camera: Result<Camera, CameraError>,
    what: impl FnOnce() -> String,
) -> Result<Camera, Fault> {
    camera
        // Programs that undistort images leave the distortion in the file, as zeros.
        .map(Camera::without_zero_distortion)
        .map_err(|error| fault_in(error.into(), what))
}

/// `FULL_OPENCV` of a pinhole camera (fx, fy, cx, cy) with Brown's distortion: k1, k2, k3 and
/// OpenCV's p1, p2.
pub(super) fn brown(
    pinhole: [f64; 4],
    [k1, k2, k3]: [f64; 3],
    [p1, p2]: [f64; 2],
) -> (CameraModel, Vec<f64>) {
    let distortion = [k1, k2, p1, p2, k3, 0.0, 0.0, 0.0];
    let params = [&pinhole[..], &distortion].concat();
    (CameraModel::FullOpenCv, params)
}

/// Returns the width and height of an image by name, for formats that don't store them.
pub type SizeLookup<'a> = &'a dyn Fn(&str) -> Option<(u32, u32)>;

/// Guesses the width and height of a missing image so that it contains all measured pixels.
/// `farthest`: largest coordinate along each axis, absolute and relative to the image centre if
/// `from_centre`.
pub(super) fn guessed_size(farthest: [f64; 2], from_centre: bool) -> (u32, u32) {
    let factor = if from_centre { 2.0 } else { 1.0 };
    let [w, h] = farthest.map(|c| (c * factor).ceil().clamp(1.0, 1e6) as u32);
    // Even, so the centre has integer coordinates.
    (w + w % 2, h + h % 2)
}

/// The fault of a record whose position in the file is unknown.
pub(super) fn fault_in(problem: Problem, record: impl FnOnce() -> String) -> Fault {
    problem.at(Place::File).in_record(record)
}

/// The problem of a line that isn't what was expected.
pub(super) fn unexpected(line: &[u8], expected: &'static str) -> Problem {
    Problem::syntax(expected, start_of(line))
}

/// Parses JSON; a fault has its line.
pub(super) fn json<'a, T: serde::Deserialize<'a>>(bytes: &'a [u8]) -> Result<T, Fault> {
    serde_json::from_slice(bytes).map_err(|error| {
        let place = if error.line() > 0 {
            Place::Line(error.line() as u64)
        } else {
            Place::File
        };
        // Serde passes on errors of `bounded` as text only.
        let text = error.to_string();
        let problem = if text.starts_with(MORE_THAN) {
            Problem::Unsupported {
                what: text,
                hint: SPLIT,
            }
        } else {
            Problem::Content(crate::json::fault(&error, bytes))
        };
        problem.at(place)
    })
}

/// Reads an object, with `expected` as its description: of a list, too, the fields of a structure
/// would be read, one after the other.
pub(super) fn json_object<'a, T: serde::Deserialize<'a>>(
    bytes: &'a [u8],
    expected: &str,
) -> Result<T, Fault> {
    let start = bytes.iter().find(|byte| !byte.is_ascii_whitespace());
    let found = match start {
        Some(b'[') => "a list",
        Some(b'"') => "a text",
        Some(b'-' | b'0'..=b'9') => "a number",
        Some(b't' | b'f' | b'n') => "a word",
        _ => return json(bytes),
    };
    // What is no JSON at all has a fault of its own.
    json::<serde::de::IgnoredAny>(bytes)?;
    let what = format!("{found}, where {expected} is expected");
    Err(Problem::Content(what).at(Place::File))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_of_other_machines_are_shortened() {
        let shortened = |names: &[&str]| {
            let mut foreign = ForeignModel::default();
            let pose = || StoredPose {
                quaternion: [1.0, 0.0, 0.0, 0.0],
                translation: [0.0; 3],
            };
            (1..).zip(names).for_each(|(id, name)| {
                foreign.add_image(id, name.to_string(), 1, pose(), Place::File)
            });
            foreign.shorten_names();
            let names: Vec<String> = foreign
                .model
                .images
                .iter()
                .map(|image| image.name.to_string())
                .collect();
            (names.join(" "), foreign.image_folder)
        };
        let of = |names: &str, folder: &str| (names.to_string(), Some(folder.to_string()));
        assert_eq!(
            shortened(&[r"D:\photos\1\a.jpg", "D:/photos/2/b.jpg"]),
            of("1/a.jpg 2/b.jpg", "D:/photos/")
        );
        assert_eq!(
            shortened(&["file:///D:/photos/1/a.jpg", "file:///D:/photos/2/b.jpg"]),
            of("1/a.jpg 2/b.jpg", "D:/photos/")
        );
        assert_eq!(
            shortened(&["file:///home/me/a.jpg"]),
            of("a.jpg", "/home/me/")
        );
        assert_eq!(
            shortened(&[r"\\server\photos\a.jpg"]),
            of("a.jpg", "//server/photos/")
        );
        assert_eq!(
            shortened(&["/home/me/a.jpg", "/home/you/b.jpg"]),
            of("me/a.jpg you/b.jpg", "/home/")
        );
        assert_eq!(
            shortened(&[r"back\slash.jpg", "./c/x/../d.jpg"]),
            ("back/slash.jpg c/d.jpg".into(), None)
        );
        assert_eq!(
            shortened(&["../photos/1/a.jpg", r"..\photos\b.jpg"]),
            of("1/a.jpg b.jpg", "../photos/")
        );
        assert_eq!(
            shortened(&["../../photos/a.jpg", "../b.jpg"]),
            ("../../photos/a.jpg ../b.jpg".into(), None)
        );
        assert_eq!(
            last_parts(r"D:\p\a.jpg"),
            [r"D:\p\a.jpg", "p/a.jpg", "a.jpg"]
        );
        assert_eq!(last_parts("p/a.jpg"), ["p/a.jpg"]);
    }
}
