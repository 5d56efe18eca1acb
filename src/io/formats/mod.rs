//! File formats of sparse models, one file each: bytes <-> [`crate::model::scene::Scene`], no file system logic. Each format's
//! conventions (axes, pixel centre, distortion) are known in its file and nowhere else.

pub mod alicevision;
pub mod bundler;
pub mod colmap;
pub mod colmap_bin;
pub mod colmap_text;
pub mod foreign;
pub mod nvm;
pub mod openmvg;
pub mod openmvs;
pub mod opensfm;
pub mod sure;
mod words;

use std::fmt;

use crate::model::camera::CameraError;

/// The contents of the files of a COLMAP model, binary or text.
#[derive(Clone, Copy, Debug, Default)]
pub struct Bytes<'a> {
    pub cameras: &'a [u8],
    pub images: &'a [u8],
    pub points3d: &'a [u8],
    pub rigs: Option<&'a [u8]>,
    pub frames: Option<&'a [u8]>,
}

/// What is wrong in a file, and where.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{place}{}: {problem}", record.iter().map(|r| format!(" ({r})")).collect::<String>())]
pub struct Fault {
    /// Which of the model's files: the stem of a COLMAP file (`images`), empty where the model is one file.
    pub file: &'static str,
    pub place: Place,
    /// The record, such as `image 3 of 12`.
    pub record: Option<String>,
    pub problem: Problem,
}

impl Fault {
    pub fn new(file: &'static str, place: Place, problem: Problem) -> Self {
        Self { file, place, record: None, problem }
    }

    /// Names the record unless one is named already.
    pub fn in_record(mut self, record: impl FnOnce() -> String) -> Self {
        self.record.get_or_insert_with(record);
        self
    }
}

/// Where in a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// Offset from the start of the file.
    Byte(u64),
    /// Counted from 1.
    Line(u64),
    /// The file as a whole.
    File,
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Place::Byte(offset) => write!(f, "byte {offset}"),
            Place::Line(line) => write!(f, "line {line}"),
            Place::File => write!(f, "whole file"),
        }
    }
}

/// What can be wrong with the contents of a model.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Problem {
    #[error("the file ends within {0}")]
    Truncated(&'static str),
    #[error("{count} {what} are announced, but the rest of the file has room for {room} at most")]
    Count { what: &'static str, count: u64, room: u64 },
    #[error("expected {expected}, found {found:?}")]
    Syntax { expected: &'static str, found: String },
    #[error("{0}")]
    Json(String),
    #[error("there is no camera model {0}")]
    CameraModel(String),
    #[error(transparent)]
    Camera(#[from] CameraError),
    #[error("{what} {id} occurs a second time")]
    Duplicate { what: &'static str, id: String },
    #[error("it refers to {what} {id}, which is not in the model")]
    Absent { what: &'static str, id: u64 },
    #[error("{0} is not a finite number")]
    NotFinite(&'static str),
    #[error("the rotation is a quaternion of length zero")]
    ZeroQuaternion,
    #[error("the image name {name:?} {why}")]
    Name { name: String, why: &'static str },
    #[error("its track names 2D point {index} of image {image}, {why}")]
    TrackIndex { image: u32, index: u32, why: String },
    #[error("{0}")]
    Contradiction(String),
    #[error("{what}")]
    Unsupported { what: String, hint: &'static str },
}

impl Problem {
    /// What to do about it.
    pub fn hint(&self) -> &'static str {
        match self {
            Self::Truncated(_) | Self::Count { .. } => {
                "Copy the file again or export the model again: it is incomplete or damaged."
            }
            Self::Syntax { .. } | Self::Json(_) => "Export the model again, or mend the line by hand.",
            Self::CameraModel(_) => {
                "Convert the cameras to a model that COLMAP 4.2 knows, or check that the file is what its name says."
            }
            Self::Camera(_) => "Correct the intrinsics, or export the model again.",
            Self::Duplicate { .. } => "Give each record its own id and each image its own name.",
            Self::Absent { .. } => "Export all files of the model at the same time: they do not belong together.",
            Self::NotFinite(_) | Self::ZeroQuaternion => {
                "Remove the record with the program that made the model; its bundle adjustment has probably failed there."
            }
            Self::Name { .. } => "Rename the image, in the image folder and in the model.",
            Self::TrackIndex { .. } | Self::Contradiction(_) => {
                "Export all files of the model at the same time; delete rigs and frames files left by another model."
            }
            Self::Unsupported { hint, .. } => hint,
        }
    }
}

/// Checks an image name, which is relative to the image folder: not empty, and not leading to places that have nothing to do
/// with the project. `../other/a.jpg` is met in practice and allowed; further up than the folder that holds the image
/// folder, or an absolute path, is not.
pub fn check_name(name: &str) -> Result<(), Problem> {
    let refuse = |why| Err(Problem::Name { name: name.into(), why });
    if name.is_empty() {
        return refuse("is empty");
    }
    if name.contains('\0') {
        return refuse("contains a zero byte");
    }
    if name.starts_with('/') {
        return refuse("is an absolute path");
    }
    let mut depth = 0i64;
    for part in name.split('/') {
        match part {
            ".." => depth -= 1,
            "" | "." => {}
            _ => depth += 1,
        }
        if depth < -1 {
            return refuse("leads out of the folder that holds the image folder");
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_stay_in_the_project() {
        for name in ["a.jpg", "../up/one.jpg", "./dot.jpg", "back\\slash.jpg", "a/../../b.jpg", "日本/写真 2.png"] {
            assert_eq!(check_name(name), Ok(()), "{name}");
        }
        for name in ["", "/etc/passwd", "../../etc/passwd", "a/../../../b", "..//../x", "a\0b"] {
            assert!(check_name(name).is_err(), "{name}");
        }
    }
}
