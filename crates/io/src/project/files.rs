//! Reads the files of a COLMAP model.

use std::{
    collections::{BTreeMap, HashSet},
    fs::File,
    io::{self, BufRead, BufReader, Read},
    path::{Path, PathBuf},
};

use viewrank_core::model::camera::Camera;

use super::{
    ModelContents, ModelFormat, ModelLocation, ProjectError, complete::cloud_beside,
    folder::SoughtImages, images::PROBED,
};
use crate::{
    formats::{
        Bytes, Fault, LONGEST_NAME,
        colmap::{ColmapModel, StoredPose},
        colmap_bin, colmap_text,
    },
    input::{self, FileKind},
};

/// Required files of a COLMAP model.
pub(super) const REQUIRED: [&str; 3] = ["cameras", "images", "points3D"];

/// Bytes of a list of cameras that show whose it is.
const START: u64 = 4096;

/// Returns whether a text file has COLMAP's cameras, by its first one; true for one without any.
pub(super) fn are_cameras(path: &Path) -> bool {
    let start = input::read_start(path, FileKind::Sparse, START).unwrap_or_default();
    let start = String::from_utf8_lossy(&start);
    let mut lines = start.trim_start_matches('\u{feff}').lines().map(str::trim);
    let first = lines.find(|line| !line.is_empty() && !line.starts_with('#'));
    // Lists of other programs begin with the name of a photograph.
    let is_of_name = |byte: u8| byte.is_ascii_uppercase() || byte.is_ascii_digit() || byte == b'_';
    first.is_none_or(|first| {
        let mut words = first.split_whitespace();
        let (id, model) = (words.next(), words.next());
        id.is_some_and(|id| id.parse::<u32>().is_ok())
            && model.is_some_and(|model| model.bytes().all(is_of_name))
    })
}

/// Reads a regular file. It is not memory-mapped: another process that truncated it would crash
/// this one.
pub(super) fn read(path: &Path) -> Result<Vec<u8>, ProjectError> {
    let file = input::open(path).map_err(ProjectError::io(path))?;
    let bytes = input::read_large(&file, FileKind::Sparse).map_err(ProjectError::io(path))?;
    let is_binary = path
        .extension()
        .is_some_and(|extension| BINARY.iter().any(|binary| extension == *binary));
    // A binary file may begin with the bytes of the mark by chance.
    Ok(if is_binary {
        bytes
    } else {
        input::without_mark(bytes)
    })
}

/// Extensions of model files that are not text.
const BINARY: [&str; 3] = ["bin", "mvs", "ply"];

/// Poses of the images of a COLMAP model by name, without reading the rest of it; `None` if they
/// cannot be read.
pub(super) fn poses(model: &ModelLocation) -> Option<BTreeMap<String, StoredPose>> {
    let images = read(&colmap_file(&model.path, "images", model.format)).ok()?;
    let is_text = model.format == ModelFormat::ColmapText;
    if is_text {
        colmap_text::poses(&images)
    } else {
        colmap_bin::poses(&images)
    }
    .ok()
}

/// Cameras of a COLMAP model, without reading the rest of it; `None` if they cannot be read.
fn cameras(model: &ModelLocation) -> Option<Vec<Camera>> {
    let cameras = read(&colmap_file(&model.path, "cameras", model.format)).ok()?;
    let is_text = model.format == ModelFormat::ColmapText;
    if is_text {
        colmap_text::cameras(&cameras)
    } else {
        colmap_bin::cameras(&cameras)
    }
    .ok()
}

/// Returns whether any camera of a COLMAP model has lens distortion; `None` if they cannot be read.
pub(super) fn is_distorted(model: &ModelLocation) -> Option<bool> {
    Some(cameras(model)?.iter().any(|camera| !camera.is_pinhole()))
}

/// Width and height of each camera of a COLMAP model; none if they cannot be read.
fn camera_sizes(model: &ModelLocation) -> HashSet<[u32; 2]> {
    let cameras = cameras(model).unwrap_or_default();
    let size = |camera: &Camera| [camera.width, camera.height];
    cameras.iter().map(size).collect()
}

/// What is known of the images of a COLMAP model by reading little of its files.
pub(super) fn sought_images(model: &ModelLocation) -> SoughtImages {
    SoughtImages {
        names: first_names(model),
        sizes: camera_sizes(model),
    }
}

/// Names of the first images of a COLMAP model; empty if they cannot be read.
fn first_names(model: &ModelLocation) -> Vec<String> {
    let file = input::open(&colmap_file(&model.path, "images", model.format));
    let Ok(file) = file.map(BufReader::new) else {
        return Vec::new();
    };
    match model.format {
        ModelFormat::ColmapText => names_in_text(file),
        _ => names_in_binary(file).unwrap_or_default(),
    }
}

/// Bytes of a binary record before its name: id, quaternion, translation, camera.
const BEFORE_NAME: i64 = 4 + 7 * 8 + 4;

fn names_in_binary(mut file: BufReader<File>) -> io::Result<Vec<String>> {
    let count = number(&mut file)?;
    let mut names = Vec::new();
    for _ in 0..count.min(PROBED as u64) {
        // `seek` would discard the buffer at each record.
        file.seek_relative(BEFORE_NAME)?;
        let mut name = Vec::new();
        (&mut file)
            .take(LONGEST_NAME as u64)
            .read_until(0, &mut name)?;
        name.pop();
        names.extend(String::from_utf8(name));
        let observations = number(&mut file)?;
        // A forged number is an error, and must not lead back in the file.
        let length = observations
            .checked_mul(24)
            .and_then(|length| i64::try_from(length).ok());
        file.seek_relative(length.ok_or(io::ErrorKind::InvalidData)?)?;
    }
    Ok(names)
}

/// Bytes of a text model to search.
const SEARCHED: u64 = 16 << 20;

fn names_in_text(file: BufReader<File>) -> Vec<String> {
    // Up to the first error: a reader that fails again and again would give lines without end.
    let mut lines = file
        .take(SEARCHED)
        .lines()
        .map_while(Result::ok)
        .map(|line| line.trim_start_matches('\u{feff}').to_owned())
        .filter(|line| !line.starts_with('#'));
    let heads = std::iter::from_fn(|| {
        let head = lines.find(|line| !line.trim().is_empty())?;
        // The line after it is a list of 2D points, which may be empty.
        lines.next();
        Some(head)
    });
    // ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; names may have blanks.
    heads
        .take(PROBED)
        .filter_map(|line| {
            line.trim()
                .splitn(10, ' ')
                .nth(9)
                .map(|name| name.trim().to_owned())
        })
        .collect()
}

/// The files of a COLMAP model, in memory.
pub struct ColmapFiles {
    folder: PathBuf,
    format: ModelFormat,
    cameras: Vec<u8>,
    images: Vec<u8>,
    points3d: Vec<u8>,
    rigs: Option<Vec<u8>>,
    frames: Option<Vec<u8>>,
}

/// `points3D.bin` without points, for models whose points are in a PLY file only.
const NO_POINTS: [u8; 8] = [0; 8];

impl ColmapFiles {
    pub(super) fn open(model: &ModelLocation) -> Result<Self, ProjectError> {
        let path = |stem| colmap_file(&model.path, stem, model.format);
        let optional = |stem| {
            let path = path(stem);
            path.is_file().then(|| read(&path)).transpose()
        };
        let [cameras, images, points3d] = REQUIRED.map(path);
        let points = || {
            // Without either, the error is to name the file that is missing.
            if points3d.is_file() || cloud_beside(model).is_none() {
                read(&points3d)
            } else if model.format == ModelFormat::ColmapText {
                Ok(Vec::new())
            } else {
                Ok(NO_POINTS.to_vec())
            }
        };
        let (images, points3d) = rayon::join(|| read(&images), points);
        Ok(Self {
            folder: model.path.clone(),
            format: model.format,
            cameras: read(&cameras)?,
            images: images?,
            points3d: points3d?,
            rigs: optional("rigs")?,
            frames: optional("frames")?,
        })
    }

    /// Parses the files.
    pub fn model(&self) -> Result<ColmapModel<'_>, ProjectError> {
        let bytes = Bytes {
            cameras: &self.cameras,
            images: &self.images,
            points3d: &self.points3d,
            rigs: self.rigs.as_deref(),
            frames: self.frames.as_deref(),
        };
        let model = if self.format == ModelFormat::ColmapText {
            colmap_text::read(&bytes)
        } else {
            colmap_bin::read(&bytes)
        };
        model.map_err(|fault| self.locate(fault))
    }

    pub(super) fn locate(&self, fault: Fault) -> ProjectError {
        ProjectError::fault(&colmap_file(&self.folder, fault.file, self.format))(fault)
    }
}

/// The existing files of a COLMAP model, and the PLY file of its points if it has none of its own.
pub(super) fn all(model: &ModelLocation) -> Vec<PathBuf> {
    let files = ["cameras", "images", "points3D", "rigs", "frames"]
        .map(|stem| colmap_file(&model.path, stem, model.format));
    // A plan depends on this cloud as on the model's own files.
    let cloud = match own_contents(model) {
        ModelContents::Poses => cloud_beside(model),
        _ => None,
    };
    files
        .into_iter()
        .filter(|path| path.is_file())
        .chain(cloud)
        .collect()
}

/// What a COLMAP model has, by the beginning of its file of points and the files beside it.
pub(super) fn contents(model: &ModelLocation) -> ModelContents {
    match own_contents(model) {
        ModelContents::Poses if cloud_beside(model).is_some() => ModelContents::Points,
        own => own,
    }
}

/// Points that are looked at for tracks.
const LOOKED_AT: u64 = 256;

fn own_contents(model: &ModelLocation) -> ModelContents {
    let path = colmap_file(&model.path, "points3D", model.format);
    let Ok(file) = input::open(&path).map(BufReader::new) else {
        return ModelContents::Poses;
    };
    let longest = match model.format {
        ModelFormat::ColmapText => longest_track_in_text(file),
        _ => longest_track_in_binary(file).unwrap_or_default(),
    };
    match longest {
        None => ModelContents::Poses,
        Some(0 | 1) => ModelContents::Points,
        Some(_) => ModelContents::Tracks,
    }
}

/// Elements of the longest track among the first points; `None` without points.
fn longest_track_in_binary(mut file: BufReader<File>) -> io::Result<Option<u64>> {
    /// Bytes of a record before its track: id, position, colour, error.
    const BEFORE_TRACK: i64 = 8 + 3 * 8 + 3 + 8;
    const ELEMENT: u64 = 8;
    let count = number(&mut file)?;
    let mut longest = None;
    for _ in 0..count.min(LOOKED_AT) {
        file.seek_relative(BEFORE_TRACK)?;
        let length = number(&mut file)?;
        longest = longest.max(Some(length));
        let bytes = i64::try_from(length.saturating_mul(ELEMENT));
        file.seek_relative(bytes.map_err(|_| io::ErrorKind::InvalidData)?)?;
    }
    Ok(longest)
}

fn longest_track_in_text(file: BufReader<File>) -> Option<u64> {
    /// Id, position, colour and error.
    const BEFORE_TRACK: usize = 8;
    let lines = file.take(SEARCHED).lines().map_while(Result::ok);
    lines
        .filter(|line| !line.trim().is_empty() && !line.starts_with('#'))
        .take(LOOKED_AT as usize)
        .map(|line| {
            let words = line.split_ascii_whitespace().count();
            (words.saturating_sub(BEFORE_TRACK) / 2) as u64
        })
        .max()
}

fn number(file: &mut BufReader<File>) -> io::Result<u64> {
    let mut bytes = [0; 8];
    file.read_exact(&mut bytes)?;
    Ok(u64::from_le_bytes(bytes))
}

/// Path of a file of a COLMAP model.
pub(super) fn colmap_file(folder: &Path, stem: &str, format: ModelFormat) -> PathBuf {
    let extension = if format == ModelFormat::ColmapText {
        "txt"
    } else {
        "bin"
    };
    folder.join(format!("{stem}.{extension}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blank_lines_before_an_image_are_no_list_of_points() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("images.txt");
        let text = "# heading\n\n1 1 0 0 0 0 0 0 1 a b.jpg\n\n\n2 1 0 0 0 0 0 0 1 c.jpg\n0 0 -1\n";
        std::fs::write(&path, text).unwrap();
        let names = names_in_text(BufReader::new(File::open(path).unwrap()));
        assert_eq!(names, ["a b.jpg", "c.jpg"]);
    }
}
