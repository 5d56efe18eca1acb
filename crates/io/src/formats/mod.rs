//! File formats of sparse models, one module each: bytes <->
//! [`viewrank_core::model::scene::Scene`], without file access. Conventions of a format (axes,
//! pixel centre, distortion) don't leave its module.

pub mod alicevision;
pub mod blocks;
pub mod bundler;
pub mod cloud;
pub mod colmap;
pub mod colmap_bin;
pub mod colmap_text;
pub mod exif;
pub mod foreign;
mod measured;
pub mod metashape;
pub mod micmac;
pub mod mve;
pub mod nvm;
pub mod openmvg;
pub mod openmvs;
pub mod opensfm;
pub mod sure;
pub mod transforms;
mod words;
pub(super) mod xml;

use std::{
    fmt,
    path::{Component, Path},
};

use viewrank_core::{
    base::error::{Advice, shortened},
    model::camera::CameraError,
};

/// Contents of the files of a COLMAP model, binary or text.
#[derive(Clone, Copy, Debug, Default)]
pub struct Bytes<'a> {
    pub cameras: &'a [u8],
    pub images: &'a [u8],
    pub points3d: &'a [u8],
    pub rigs: Option<&'a [u8]>,
    pub frames: Option<&'a [u8]>,
}

/// A fault in a model file, with its position. Its text is short, whatever it quotes.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error(
    "{place}{}: {}",
    record.iter().map(|r| format!(" ({})", shortened(r))).collect::<String>(),
    shortened(&problem.to_string())
)]
pub struct Fault {
    /// Stem of the COLMAP file, such as `images`; empty for models of one file.
    pub file: &'static str,
    pub place: Place,
    /// The record at fault, such as `image 3 of 12`.
    pub record: Option<String>,
    pub problem: Problem,
}

impl Fault {
    pub fn new(file: &'static str, place: Place, problem: Problem) -> Self {
        Self {
            file,
            place,
            record: None,
            problem,
        }
    }

    /// The same fault in the file of this stem.
    fn in_file(self, file: &'static str) -> Self {
        Self { file, ..self }
    }

    /// Adds the record, unless there is one.
    pub fn in_record(mut self, record: impl FnOnce() -> String) -> Self {
        self.record.get_or_insert_with(record);
        self
    }
}

/// Position in a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// Offset from the start of the file.
    Byte(u64),
    /// Line number, from 1.
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

/// A problem with the contents of a model file.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Problem {
    #[error("the file ends within {0}")]
    Truncated(&'static str),
    #[error("{count} {what} declared, but at most {room} fit in the rest of the file")]
    Count {
        what: &'static str,
        count: u64,
        room: u64,
    },
    #[error("expected {expected}, found {found:?}")]
    Syntax {
        expected: &'static str,
        found: String,
    },
    /// What is wrong in the contents of a file, in words.
    #[error("{0}")]
    Content(String),
    #[error("unknown camera model {0}")]
    CameraModel(String),
    #[error(transparent)]
    Camera(#[from] CameraError),
    #[error("duplicate {what} {id}")]
    Duplicate { what: &'static str, id: String },
    #[error("reference to {what} {id}, which is not in the model")]
    Absent { what: &'static str, id: u64 },
    #[error("{0} is not a finite number")]
    NotFinite(&'static str),
    #[error("the rotation is a quaternion of length 0")]
    ZeroQuaternion,
    #[error("the image name {name:?} {why}")]
    Name { name: String, why: &'static str },
    #[error("the track refers to 2D point {index} of image {image}, {why}")]
    TrackIndex { image: u32, index: u32, why: String },
    #[error("{0}")]
    Contradiction(String),
    #[error("{what}")]
    Unsupported { what: String, hint: &'static str },
    #[error("{HIDDEN}")]
    Hidden,
}

/// The fault of a file outside of the project, which may be a stranger's.
pub(crate) const HIDDEN: &str =
    "it has a fault that is not shown, for it is outside of the project";

impl Problem {
    pub fn syntax(expected: &'static str, found: impl Into<String>) -> Self {
        let found = found.into();
        Self::Syntax { expected, found }
    }

    pub fn duplicate(what: &'static str, id: impl ToString) -> Self {
        let id = id.to_string();
        Self::Duplicate { what, id }
    }

    pub fn absent(what: &'static str, id: impl Into<u64>) -> Self {
        let id = id.into();
        Self::Absent { what, id }
    }

    /// The fault at a place of a model of one file.
    pub fn at(self, place: Place) -> Fault {
        Fault::new("", place, self)
    }

    /// Hint: what to do about the problem.
    pub fn hint(&self) -> Advice {
        let text = match self {
            Self::Truncated(_) | Self::Count { .. } => {
                "copy or export the file again: it is incomplete or damaged"
            }
            Self::Syntax { .. } | Self::Content(_) => {
                "export the model again, or correct the line by hand"
            }
            Self::CameraModel(_) => {
                "convert the cameras to a model that COLMAP 4.2 supports, or check that the file has the format of its name"
            }
            Self::Camera(_) => "correct the intrinsics, or export the model again",
            Self::Duplicate { .. } => {
                "make ids and image names unique; if the rest of the file is zeros, copy it again: it was copied in part"
            }
            Self::Absent { .. } => "export all files of the model together: they don't match",
            Self::NotFinite(_) | Self::ZeroQuaternion => {
                "remove the record in the program that made the model, whose bundle adjustment has probably failed"
            }
            // A file that was copied in part ends in zeros, which read as records without names.
            Self::Name { name, .. } if name.is_empty() => {
                "copy or export the file again: it is incomplete or damaged"
            }
            Self::Name { why: OUTSIDE, .. } => {
                return Advice::text("name the folder of the images with ")
                    .set("images")
                    .and(": there they are found by the last parts of their names");
            }
            Self::Name { .. } => "rename the image, in the image folder and in the model",
            Self::TrackIndex { .. } | Self::Contradiction(_) => {
                "export all files of the model together; delete rigs and frames files of other models"
            }
            Self::Unsupported { hint, .. } => hint,
            Self::Hidden => "copy the file into the project to see the fault",
        };
        text.into()
    }
}

/// The start of a line or a word, for the text of a fault: as much as tells what it is.
fn start_of(bytes: &[u8]) -> String {
    String::from_utf8_lossy(&bytes[..bytes.len().min(40)]).into_owned()
}

/// Most images, and most cameras, of a model: each takes up to a kilobyte while the model is read,
/// and a few bytes in some formats.
const MOST_IMAGES: usize = 1 << 18;

/// Checks the number of images or cameras of a model.
fn check_images(count: usize) -> Result<(), Fault> {
    if count <= MOST_IMAGES {
        return Ok(());
    }
    let what = format!("{count} images or cameras, at most {MOST_IMAGES} are read");
    Err(Problem::Unsupported { what, hint: SPLIT }.at(Place::File))
}

/// What to do about too many images.
const SPLIT: &str = "split the model";

/// Longest image name, bytes: no system opens a longer path.
pub const LONGEST_NAME: usize = 4096;

/// Checks the length of an image name.
fn check_length(name: &str) -> Result<(), Problem> {
    if name.len() <= LONGEST_NAME {
        return Ok(());
    }
    Err(Problem::Name {
        name: name.into(),
        why: "is longer than 4096 bytes",
    })
}

/// Checks an image name relative to the image folder: not empty, not absolute, and not outside the
/// parent of the image folder. `../other/a.jpg` occurs in practice and is allowed.
pub fn check_name(name: &str) -> Result<(), Problem> {
    let refuse = |why| {
        Err(Problem::Name {
            name: name.into(),
            why,
        })
    };
    if name.is_empty() {
        return refuse("is empty");
    }
    check_length(name)?;
    if name.contains('\0') {
        return refuse("contains a zero byte");
    }
    if name.starts_with(SEPARATORS) {
        return refuse("is an absolute path");
    }
    match name_parts(name) {
        Some(_) => Ok(()),
        None => refuse(OUTSIDE),
    }
}

/// What a name is that leads further than to the parent of its folder.
const OUTSIDE: &str = "is outside the parent of the image folder";

/// Separators in image names: models made on Windows have its own.
pub const SEPARATORS: [char; 2] = ['/', '\\'];

/// The folders and the file of an image name, without `.`; `..` is resolved, but for one at the
/// start. `None` for a name that leads out of the parent of its folder, or to a drive, and for one
/// that is too long.
pub fn name_parts(name: &str) -> Option<Vec<&str>> {
    if name.len() > LONGEST_NAME {
        return None;
    }
    let mut parts: Vec<&str> = Vec::new();
    for part in name.split(SEPARATORS) {
        match part {
            "" | "." => {}
            ".." if parts.last().is_some_and(|above| *above != "..") => _ = parts.pop(),
            ".." if parts.is_empty() => parts.push(part),
            ".." => return None,
            // Only a drive of Windows makes it more than a name.
            _ if !part.contains(':')
                || Path::new(part)
                    .components()
                    .eq([Component::Normal(part.as_ref())]) =>
            {
                parts.push(part)
            }
            _ => return None,
        }
    }
    Some(parts)
}

#[cfg(test)]
mod tests {
    use super::{
        foreign::{ForeignModel, json},
        *,
    };

    /// The fault of a file that is refused.
    #[track_caller]
    fn fault<T>(read: Result<T, Fault>) -> Fault {
        read.err().expect("it is refused")
    }

    #[test]
    fn more_images_than_any_model_has_are_refused_before_they_are_read() {
        let many = |before: &str, one: &dyn Fn(usize) -> String| {
            (0..=MOST_IMAGES).fold(before.to_owned(), |text, n| text + &one(n))
        };
        // None of the files goes on behind them.
        let cameras = many(r#"[{"shots":{},"cameras":{"#, &|n| format!("\"{n}\":{{}},"));
        let recordings = many("[", &|n| {
            format!(r#"{{"shots":{{}},"cameras":{{"{n}":{{}}}}}},"#)
        });
        let views = many(r#"{"version":[1],"views":["#, &|_| {
            r#"{"viewId":0},"#.into()
        });
        let poses = many(r#"{"extrinsics":["#, &|_| {
            r#"{"key":0,"value":{"rotation":[[0,0,0],[0,0,0],[0,0,0]],"center":[0,0,0]}},"#.into()
        });
        let frames = many(r#"{"frames":["#, &|_| "0,".into());
        let lines = many("", &|n| format!("{n} SIMPLE_PINHOLE 9 9 9 5 5\n"));
        // Version 1, no platforms, and empty names.
        let count = (MOST_IMAGES as u64 + 1).to_le_bytes();
        let scene = [b"MVSI\x01\0\0\0\0\0\0\0", &[0; 8][..], &count];
        let scene = [&scene.concat()[..], &vec![0; 20 * (MOST_IMAGES + 1)]].concat();
        let faults = [
            fault(opensfm::read(cameras.as_bytes(), None)),
            fault(opensfm::read(recordings.as_bytes(), None)),
            fault(alicevision::read(views.as_bytes())),
            fault(openmvg::read(poses.as_bytes())),
            fault(transforms::read(
                frames.as_bytes(),
                &|_| None,
                &str::to_owned,
            )),
            fault(bundler::read(b"", &b"a\n".repeat(MOST_IMAGES + 1), &|_| {
                None
            })),
            fault(colmap_text::read(&Bytes {
                cameras: lines.as_bytes(),
                ..Bytes::default()
            })),
            fault(openmvs::Mvs::read(&scene)),
        ];
        for fault in faults {
            assert_eq!(fault.problem.hint(), SPLIT.into(), "{fault}");
            assert!(fault.to_string().contains("262144"), "{fault}");
        }
    }

    #[test]
    fn names_of_images_that_are_longer_than_any_path_are_refused() {
        let longest = "a".repeat(LONGEST_NAME);
        assert_eq!(check_name(&longest), Ok(()));
        let longer = longest + "b";
        let is_refused = |problem: &Problem| matches!(problem, Problem::Name { .. });
        assert!(is_refused(&check_name(&longer).unwrap_err()));
        let without_pose = ForeignModel {
            unregistered: vec![longer.clone()],
            ..ForeignModel::default()
        };
        let left_out = ForeignModel {
            left_out: vec![longer],
            ..ForeignModel::default()
        };
        for model in [without_pose, left_out] {
            assert!(is_refused(&fault(model.scene()).problem));
        }
    }

    #[test]
    fn a_fault_is_short_whatever_it_quotes() {
        let long = "A".repeat(1 << 20);
        let of_json = fault(json::<u8>(format!("\"{long}\"").as_bytes()));
        let name = Problem::Name {
            name: long.clone(),
            why: "is an absolute path",
        };
        let of_name = name.at(Place::Line(3)).in_record(|| long);
        for (fault, why) in [
            (of_json, "a whole number from 0 up"),
            (of_name, "is an absolute path"),
        ] {
            let text = fault.to_string();
            assert!(text.len() < 3000, "{}", text.len());
            assert!(text.starts_with("line ") && text.contains(why), "{text}");
        }
    }

    #[test]
    fn names_outside_the_project_are_refused() {
        for name in [
            "a.jpg",
            "../up/one.jpg",
            "./dot.jpg",
            "back\\slash.jpg",
            "a/../../b.jpg",
            "日本/写真 2.png",
        ] {
            assert_eq!(check_name(name), Ok(()), "{name}");
        }
        for name in [
            "",
            "/etc/passwd",
            "../../etc/passwd",
            "a/../../../b",
            "..//../x",
            r"..\..\x",
            r"\\server\x",
            "a\0b",
            &"a/".repeat(LONGEST_NAME),
        ] {
            assert!(check_name(name).is_err(), "{name}");
        }
    }
}
