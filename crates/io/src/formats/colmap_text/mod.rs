//! COLMAP's text model files (`cameras.txt`, `images.txt`, `points3D.txt`; since 3.12 `rigs.txt`,
//! `frames.txt`): one line per record, two lines per image, fields separated by blanks; lines that
//! begin with `#` are comments.
//!
//! An image name is the rest of its line, including blanks; COLMAP itself stops at the first blank.

mod write;

pub use write::write;

use std::{borrow::Cow, collections::BTreeMap, str::FromStr};

use nom::{
    IResult, Parser, bytes::complete::take_till1, character::complete::space0, combinator::map_res,
    sequence::preceded,
};
use rayon::prelude::*;
use viewrank_core::model::{
    camera::{Camera, CameraModel},
    scene::{ModelWarning, WarningKind},
};

use super::{
    Bytes, Fault, MOST_IMAGES, Place, Problem, check_images,
    colmap::{
        ColmapImage, ColmapModel, ColmapPoint, Frame, FrameData, Point2d, Rig, Sensor, StoredPose,
        TrackElement,
    },
    start_of, words,
};

/// Reads a model; [`ColmapModel::scene`] checks its cross-references.
pub fn read<'a>(bytes: &Bytes<'a>) -> Result<ColmapModel<'a>, Fault> {
    let mut warnings = Vec::new();
    Ok(ColmapModel {
        cameras: cameras(bytes.cameras)?,
        images: images(bytes.images, &mut warnings)?,
        points: records("points3D", bytes.points3d, point)?,
        rigs: bytes.rigs.map(|b| records("rigs", b, rig)).transpose()?,
        frames: bytes
            .frames
            .map(|b| records("frames", b, frame))
            .transpose()?,
        warnings,
    })
}

/// A line of a file, parsed field by field.
#[derive(Clone, Copy)]
struct Line<'a> {
    file: &'static str,
    number: u64,
    rest: &'a [u8],
}

/// All lines, trimmed (like COLMAP; Windows has CR LF).
fn lines<'a>(file: &'static str, bytes: &'a [u8]) -> impl Iterator<Item = Line<'a>> {
    // An empty rest after the last line end is not a line.
    let bytes = bytes.strip_suffix(b"\n").unwrap_or(bytes);
    let lines = bytes.split(|&b| b == b'\n').zip(1..);
    lines.map(move |(line, number)| Line {
        file,
        number,
        rest: line.trim_ascii(),
    })
}

impl<'a> Line<'a> {
    fn is_record(&self) -> bool {
        !self.rest.is_empty() && self.rest[0] != b'#'
    }

    fn at_end(&self) -> bool {
        self.rest.trim_ascii_start().is_empty()
    }

    fn place(&self) -> Place {
        Place::Line(self.number)
    }

    fn fault(&self, problem: Problem) -> Fault {
        Fault::new(self.file, self.place(), problem)
    }

    fn parse<T>(
        &mut self,
        expected: &'static str,
        mut parser: impl Parser<&'a [u8], Output = T, Error = nom::error::Error<&'a [u8]>>,
    ) -> Result<T, Fault> {
        match parser.parse(self.rest) {
            Ok((rest, value)) => {
                self.rest = rest;
                Ok(value)
            }
            Err(_) => Err(self.unexpected(expected)),
        }
    }

    fn number<T: FromStr>(&mut self, expected: &'static str) -> Result<T, Fault> {
        self.parse(expected, number)
    }

    fn numbers<const N: usize>(&mut self, expected: &'static str) -> Result<[f64; N], Fault> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.number(expected)?;
        }
        Ok(values)
    }

    fn unexpected(&self, expected: &'static str) -> Fault {
        let found = match token(self.rest) {
            Ok((_, token)) => start_of(token),
            Err(_) => "the end of the line".into(),
        };
        self.fault(Problem::Syntax { expected, found })
    }

    /// Checks that the line ends here.
    fn end<T>(&self, value: T) -> Result<T, Fault> {
        if self.at_end() {
            Ok(value)
        } else {
            Err(self.unexpected("the end of the line"))
        }
    }
}

fn token(input: &[u8]) -> IResult<&[u8], &[u8]> {
    preceded(space0, take_till1(|b: u8| b.is_ascii_whitespace())).parse(input)
}

fn number<T: FromStr>(input: &[u8]) -> IResult<&[u8], T> {
    map_res(token, words::parse).parse(input)
}

/// Lines parsed at once: a file may be nothing but short lines that are no records.
const BATCH: usize = 1 << 16;

/// Parses a file with one record per line, in parallel; returns the first fault in file order.
fn records<'a, T: Send>(
    file: &'static str,
    bytes: &'a [u8],
    record: impl Fn(Line<'a>) -> Result<T, Fault> + Sync,
) -> Result<Vec<T>, Fault> {
    in_batches(lines(file, bytes).filter(Line::is_record), record)
}

/// Maps in parallel up to the first fault.
fn in_batches<L: Send, T: Send>(
    mut lines: impl Iterator<Item = L>,
    record: impl Fn(L) -> Result<T, Fault> + Sync,
) -> Result<Vec<T>, Fault> {
    let mut records = Vec::new();
    loop {
        let batch: Vec<L> = lines.by_ref().take(BATCH).collect();
        if batch.is_empty() {
            return Ok(records);
        }
        let parsed: Vec<_> = batch.into_par_iter().map(&record).collect();
        for record in parsed {
            records.push(record?);
        }
    }
}

/// Reads `cameras.txt`.
pub fn cameras(bytes: &[u8]) -> Result<Vec<Camera>, Fault> {
    let lines = || lines("cameras", bytes).filter(Line::is_record);
    let cameras = in_batches(lines().take(MOST_IMAGES), camera)?;
    // Only now: the line of a damaged record says more than the length of the file.
    check_images(lines().count()).map_err(|fault| fault.in_file("cameras"))?;
    Ok(cameras)
}

fn camera(mut line: Line) -> Result<Camera, Fault> {
    let id = line.number("a camera id")?;
    let name = line.parse("a camera model", token)?;
    let name = String::from_utf8_lossy(name);
    let model = CameraModel::from_name(&name)
        .ok_or_else(|| line.fault(Problem::CameraModel(name.into_owned())))?;
    let width = line.number("the width of the image")?;
    let height = line.number("the height of the image")?;
    let mut params = Vec::new();
    while !line.at_end() {
        params.push(line.number("a camera parameter")?);
    }
    Camera::new(id, model, width, height, params)
        .map(Camera::without_zero_distortion)
        .map_err(|error| line.fault(error.into()))
}

/// Pairs the two lines of each image. The second may be empty, so blank lines and comments are not
/// skipped before it.
fn image_lines(bytes: &[u8]) -> impl Iterator<Item = (Line<'_>, Option<Line<'_>>)> {
    let mut lines = lines("images", bytes);
    std::iter::from_fn(move || {
        let head = lines.find(Line::is_record)?;
        Some((head, lines.next()))
    })
}

/// Number of images in `images.txt`, from its number of lines.
pub fn count_images(bytes: &[u8]) -> u64 {
    image_lines(bytes).count() as u64
}

/// Reads the poses of the images in `images.txt`, by name.
pub fn poses(images: &[u8]) -> Result<BTreeMap<String, StoredPose>, Fault> {
    image_lines(images)
        .map(|(head, _)| {
            let image = image(head, None)?;
            Ok((image.name.into_owned(), image.cam_from_world))
        })
        .collect()
}

fn images<'a>(
    bytes: &'a [u8],
    warnings: &mut Vec<ModelWarning>,
) -> Result<Vec<ColmapImage<'a>>, Fault> {
    let images = in_batches(image_lines(bytes), |(head, points)| image(head, points))?;
    if let Some((head, None)) = image_lines(bytes).last() {
        let text = format!(
            "images.txt, line {}: the last image has no line of 2D points",
            head.number
        );
        warnings.push(ModelWarning::new(WarningKind::Damaged, text));
    }
    Ok(images)
}

fn image<'a>(mut line: Line<'a>, points: Option<Line<'a>>) -> Result<ColmapImage<'a>, Fault> {
    let at = line.place();
    let id = line.number("an image id")?;
    let cam_from_world = pose(&mut line)?;
    let camera_id = line.number("a camera id")?;
    let name = line.rest.trim_ascii_start();
    let name = std::str::from_utf8(name).map_err(|_| {
        let name = String::from_utf8_lossy(name).into_owned();
        line.fault(Problem::Name {
            name,
            why: "is not UTF-8",
        })
    })?;
    let points2d = points
        .map_or(Ok(Vec::new()), points2d)
        .map_err(|f| f.in_record(|| format!("image {id}, {name:?}")))?;
    Ok(ColmapImage {
        id,
        cam_from_world,
        camera_id,
        name: Cow::Borrowed(name),
        points2d: Cow::Owned(points2d),
        at,
    })
}

fn points2d(mut line: Line) -> Result<Vec<Point2d>, Fault> {
    let mut points = Vec::new();
    while !line.at_end() {
        let pixel = line.numbers::<2>("the x and y of a 2D point")?;
        let expected = "the id of the observed point, or -1";
        let before = line;
        // COLMAP reads a signed number; other programs write ids beyond its range.
        let point = match line.number::<i64>(expected) {
            Ok(-1) => None,
            Ok(id) => Some(u64::try_from(id).map_err(|_| before.unexpected(expected))?),
            Err(_) => Some(line.number::<u64>(expected)?),
        };
        points.push(Point2d::new(pixel, point));
    }
    points.shrink_to_fit();
    Ok(points)
}

fn pose(line: &mut Line) -> Result<StoredPose, Fault> {
    let quaternion = line.numbers("a quaternion")?;
    let translation = line.numbers("a translation")?;
    Ok(StoredPose {
        quaternion,
        translation,
    })
}

fn point(mut line: Line) -> Result<ColmapPoint<'static>, Fault> {
    let at = line.place();
    let id = line.number("a point id")?;
    let xyz = line.numbers("a position")?;
    let mut colour = [0; 3];
    for c in &mut colour {
        *c = line.number("a colour from 0 to 255")?;
    }
    let error = line.number("the reprojection error")?;
    let mut track = Vec::new();
    while !line.at_end() {
        let image = line.number("the image id of a track element")?;
        let index = line.number("the 2D point of a track element")?;
        track.push(TrackElement::new(image, index));
    }
    // There are millions of tracks: none is to keep room that it does not fill.
    track.shrink_to_fit();
    Ok(ColmapPoint {
        id,
        xyz,
        colour,
        error,
        track: Cow::Owned(track),
        at,
    })
}

fn sensor(line: &mut Line) -> Result<Sensor, Fault> {
    let before = *line;
    let kind = match line.parse("CAMERA or IMU", token)? {
        b"CAMERA" => Sensor::CAMERA,
        b"IMU" => Sensor::IMU,
        _ => return Err(before.unexpected("CAMERA or IMU")),
    };
    Ok(Sensor {
        kind,
        id: line.number("a sensor id")?,
    })
}

fn rig(mut line: Line) -> Result<Rig, Fault> {
    let at = line.place();
    let id = line.number("a rig id")?;
    let count: u64 = line.number("the number of sensors")?;
    // Without room for `count`, which a short line may claim.
    let mut sensors = Vec::new();
    for n in 0..count {
        let sensor = sensor(&mut line)?;
        let pose = match n {
            0 => Some(StoredPose::IDENTITY),
            _ if line.number::<u8>("0 or 1 (has a pose)")? == 0 => None,
            _ => Some(pose(&mut line)?),
        };
        sensors.push((sensor, pose));
    }
    line.end(Rig { id, sensors, at })
}

fn frame(mut line: Line) -> Result<Frame, Fault> {
    let at = line.place();
    let id = line.number("a frame id")?;
    let rig_id = line.number("a rig id")?;
    let rig_from_world = pose(&mut line)?;
    let count: u64 = line.number("the number of data ids")?;
    let mut data = Vec::new();
    for _ in 0..count {
        data.push(FrameData {
            sensor: sensor(&mut line)?,
            id: line.number("a data id")?,
        });
    }
    line.end(Frame {
        id,
        rig_id,
        rig_from_world,
        data,
        at,
    })
}
