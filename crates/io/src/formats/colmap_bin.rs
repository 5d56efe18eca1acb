//! COLMAP's binary model files (`cameras.bin`, `images.bin`, `points3D.bin`; since 3.12 `rigs.bin`,
//! `frames.bin`): little-endian, no padding, a u64 count followed by the records.
//!
//! Counts are checked against the remaining bytes before anything is allocated. 2D points and
//! tracks are borrowed from the input.

use std::{borrow::Cow, collections::BTreeMap};

use nom::{
    IResult, Parser,
    bytes::complete::{tag, take, take_till},
    number::complete::{le_f64, le_i32, le_u8, le_u32, le_u64},
    sequence::terminated,
};
use viewrank_core::{
    base::large_pages,
    model::{
        camera::{Camera, CameraModel},
        scene::{ModelWarning, WarningKind},
    },
};

use super::{
    Bytes, Fault, Place, Problem, check_images,
    colmap::{
        ColmapImage, ColmapModel, ColmapPoint, Frame, FrameData, Point2d, Rig, Sensor, StoredPose,
        TrackElement,
    },
};

/// Reads a model; [`ColmapModel::scene`] checks its cross-references.
pub fn read<'a>(bytes: &Bytes<'a>) -> Result<ColmapModel<'a>, Fault> {
    let mut warnings = Vec::new();
    Ok(ColmapModel {
        // The numbers are the bytes of a record without its name, parameters and lists.
        cameras: records(
            "cameras",
            bytes.cameras,
            "camera",
            24,
            camera,
            &mut warnings,
        )?,
        images: records("images", bytes.images, "image", 73, image, &mut warnings)?,
        points: records(
            "points3D",
            bytes.points3d,
            "point",
            51,
            point,
            &mut warnings,
        )?,
        rigs: bytes
            .rigs
            .map(|b| records("rigs", b, "rig", 8, rig, &mut warnings))
            .transpose()?,
        frames: bytes
            .frames
            .map(|b| records("frames", b, "frame", 68, frame, &mut warnings))
            .transpose()?,
        warnings,
    })
}

/// Reads the poses of the images in `images.bin`, by name.
pub fn poses(images: &[u8]) -> Result<BTreeMap<String, StoredPose>, Fault> {
    let images = records("images", images, "image", 73, image, &mut Vec::new())?;
    Ok(images
        .into_iter()
        .map(|image| (image.name.into_owned(), image.cam_from_world))
        .collect())
}

/// Reads `cameras.bin`.
pub fn cameras(cameras: &[u8]) -> Result<Vec<Camera>, Fault> {
    records("cameras", cameras, "camera", 24, camera, &mut Vec::new())
}

/// Reads the names of the images in `images.bin`, by ascending id: the order of COLMAP's own
/// indices.
pub fn names_by_id(images: &[u8]) -> Result<Vec<String>, Fault> {
    let mut images = records("images", images, "image", 73, image, &mut Vec::new())?;
    images.sort_by_key(|image| image.id);
    Ok(images
        .into_iter()
        .map(|image| image.name.into_owned())
        .collect())
}

/// Reads a whole file: the count, and that number of records of at least `smallest` bytes each.
fn records<'a, T>(
    file: &'static str,
    bytes: &'a [u8],
    what: &'static str,
    smallest: usize,
    mut record: impl FnMut(&mut Reader<'a>) -> Result<T, Fault>,
    warnings: &mut Vec<ModelWarning>,
) -> Result<Vec<T>, Fault> {
    let mut reader = Reader {
        file,
        whole: bytes,
        rest: bytes,
    };
    let count = reader.count("records", smallest)?;
    if file == "cameras" {
        check_images(count).map_err(|fault| fault.in_file(file))?;
    }
    // In proportion to the file, with which the count has been compared.
    let mut all = large_pages::room_for(count);
    for n in 0..count {
        all.push(
            record(&mut reader)
                .map_err(|fault| fault.in_record(|| format!("{what} {} of {count}", n + 1)))?,
        );
    }
    if !reader.rest.is_empty() {
        let left = reader.rest.len();
        let text =
            format!("{file}.bin: {left} bytes after the last of {count} records are ignored");
        warnings.push(ModelWarning::new(WarningKind::Damaged, text));
    }
    Ok(all)
}

/// The unread bytes of a file.
struct Reader<'a> {
    file: &'static str,
    whole: &'a [u8],
    rest: &'a [u8],
}

impl<'a> Reader<'a> {
    /// Applies a parser, which can fail only at the end of the file.
    fn take<T>(
        &mut self,
        what: &'static str,
        mut parser: impl Parser<&'a [u8], Output = T, Error = nom::error::Error<&'a [u8]>>,
    ) -> Result<T, Fault> {
        match parser.parse(self.rest) {
            Ok((rest, value)) => {
                self.rest = rest;
                Ok(value)
            }
            Err(_) => Err(self.fault(Problem::Truncated(what))),
        }
    }

    /// Reads a u64 count of records of at least `smallest` bytes each, and checks that they fit in
    /// the rest of the file.
    fn count(&mut self, what: &'static str, smallest: usize) -> Result<usize, Fault> {
        let at = self.place();
        let count = self.take("a count", le_u64)?;
        self.fits(count, what, smallest)
            .map_err(|problem| Fault::new(self.file, at, problem))
    }

    fn fits(&self, count: u64, what: &'static str, smallest: usize) -> Result<usize, Problem> {
        let room = self.rest.len() / smallest;
        usize::try_from(count)
            .ok()
            .filter(|&n| n <= room)
            .ok_or(Problem::Count {
                what,
                count,
                room: room as u64,
            })
    }

    /// Borrows `count` elements of a type without padding or alignment.
    fn slice<T: bytemuck::AnyBitPattern>(
        &mut self,
        what: &'static str,
        count: usize,
    ) -> Result<&'a [T], Fault> {
        self.take(what, take(count * size_of::<T>()))
            .map(bytemuck::cast_slice)
    }

    fn place(&self) -> Place {
        Place::Byte((self.whole.len() - self.rest.len()) as u64)
    }

    fn fault(&self, problem: Problem) -> Fault {
        Fault::new(self.file, self.place(), problem)
    }
}

fn camera(reader: &mut Reader) -> Result<Camera, Fault> {
    let at = reader.place();
    let fault = |problem| Fault::new("cameras", at, problem);
    let (id, model, width, height) = reader.take("a camera", (le_u32, le_u32, le_u64, le_u64))?;
    let model = CameraModel::from_id(model)
        .ok_or_else(|| fault(Problem::CameraModel(model.to_string())))?;
    let params = reader.take(
        "the camera parameters",
        nom::multi::count(le_f64, model.parameter_count()),
    )?;
    // A model whose distortion is zero needs no undistortion before it is matched.
    Camera::new(id, model, width, height, params)
        .map(Camera::without_zero_distortion)
        .map_err(|error| fault(error.into()))
}

fn pose(input: &[u8]) -> IResult<&[u8], StoredPose> {
    let quaternion = (le_f64, le_f64, le_f64, le_f64).map(<[f64; 4]>::from);
    let translation = (le_f64, le_f64, le_f64).map(<[f64; 3]>::from);
    (quaternion, translation)
        .map(|(quaternion, translation)| StoredPose {
            quaternion,
            translation,
        })
        .parse(input)
}

fn image<'a>(reader: &mut Reader<'a>) -> Result<ColmapImage<'a>, Fault> {
    let at = reader.place();
    let (id, cam_from_world, camera_id) = reader.take("an image", (le_u32, pose, le_u32))?;
    let name_at = reader.place();
    let name = reader.take(
        "an image name",
        terminated(take_till(|b| b == 0), tag(&[0][..])),
    )?;
    let name = std::str::from_utf8(name).map_err(|_| {
        let name = String::from_utf8_lossy(name).into_owned();
        Fault::new(
            "images",
            name_at,
            Problem::Name {
                name,
                why: "is not UTF-8",
            },
        )
    })?;
    let count = reader.count("2D points", size_of::<Point2d>())?;
    let points2d = Cow::Borrowed(reader.slice("the 2D points", count)?);
    Ok(ColmapImage {
        id,
        cam_from_world,
        camera_id,
        name: Cow::Borrowed(name),
        points2d,
        at,
    })
}

fn point<'a>(reader: &mut Reader<'a>) -> Result<ColmapPoint<'a>, Fault> {
    let at = reader.place();
    let (id, x, y, z, rgb, error) = reader.take(
        "a point",
        (le_u64, le_f64, le_f64, le_f64, take(3usize), le_f64),
    )?;
    let count = reader.count("track elements", size_of::<TrackElement>())?;
    let track = Cow::Borrowed(reader.slice("the track", count)?);
    Ok(ColmapPoint {
        id,
        xyz: [x, y, z],
        colour: [rgb[0], rgb[1], rgb[2]],
        error,
        track,
        at,
    })
}

fn sensor(input: &[u8]) -> IResult<&[u8], Sensor> {
    (le_i32, le_u32)
        .map(|(kind, id)| Sensor { kind, id })
        .parse(input)
}

fn rig(reader: &mut Reader) -> Result<Rig, Fault> {
    let at = reader.place();
    let (id, count) = reader.take("a rig", (le_u32, le_u32))?;
    let others = count.saturating_sub(1);
    reader
        .fits(others.into(), "sensors", 9)
        .map_err(|problem| Fault::new("rigs", at, problem))?;
    let mut sensors = Vec::with_capacity(count as usize);
    if count > 0 {
        sensors.push((
            reader.take("the reference sensor", sensor)?,
            Some(StoredPose::IDENTITY),
        ));
    }
    for _ in 0..others {
        let (sensor, has_pose) = reader.take("a sensor", (sensor, le_u8))?;
        let pose = if has_pose == 0 {
            None
        } else {
            Some(reader.take("the pose of a sensor", pose)?)
        };
        sensors.push((sensor, pose));
    }
    Ok(Rig { id, sensors, at })
}

fn frame(reader: &mut Reader) -> Result<Frame, Fault> {
    let at = reader.place();
    let (id, rig_id, rig_from_world, count) =
        reader.take("a frame", (le_u32, le_u32, pose, le_u32))?;
    let count = reader
        .fits(count.into(), "data ids", 16)
        .map_err(|problem| Fault::new("frames", at, problem))?;
    let datum = (sensor, le_u64).map(|(sensor, id)| FrameData { sensor, id });
    let data = reader.take("the data ids", nom::multi::count(datum, count))?;
    Ok(Frame {
        id,
        rig_id,
        rig_from_world,
        data,
        at,
    })
}

/// Writes the files of a model for COLMAP 3.x and 4.x.
pub fn write(model: &ColmapModel) -> Vec<(&'static str, Vec<u8>)> {
    let mut files = vec![
        ("cameras.bin", file(&model.cameras, write_camera)),
        ("images.bin", file(&model.images, write_image)),
        ("points3D.bin", file(&model.points, write_point)),
    ];
    files.extend(
        model
            .rigs
            .as_ref()
            .map(|rigs| ("rigs.bin", file(rigs, write_rig))),
    );
    files.extend(
        model
            .frames
            .as_ref()
            .map(|frames| ("frames.bin", file(frames, write_frame))),
    );
    files
}

fn file<T>(records: &[T], write: impl Fn(&mut Vec<u8>, &T)) -> Vec<u8> {
    let mut bytes = (records.len() as u64).to_le_bytes().to_vec();
    records.iter().for_each(|record| write(&mut bytes, record));
    bytes
}

fn write_camera(bytes: &mut Vec<u8>, camera: &Camera) {
    bytes.extend(camera.id.to_le_bytes());
    bytes.extend(camera.model().id().to_le_bytes());
    bytes.extend(u64::from(camera.width).to_le_bytes());
    bytes.extend(u64::from(camera.height).to_le_bytes());
    camera
        .params()
        .iter()
        .for_each(|p| bytes.extend(p.to_le_bytes()));
}

fn write_pose(bytes: &mut Vec<u8>, pose: &StoredPose) {
    pose.quaternion
        .iter()
        .chain(&pose.translation)
        .for_each(|v| bytes.extend(v.to_le_bytes()));
}

fn write_image(bytes: &mut Vec<u8>, image: &ColmapImage) {
    bytes.extend(image.id.to_le_bytes());
    write_pose(bytes, &image.cam_from_world);
    bytes.extend(image.camera_id.to_le_bytes());
    bytes.extend(image.name.bytes().chain([0]));
    bytes.extend((image.points2d.len() as u64).to_le_bytes());
    bytes.extend(bytemuck::cast_slice::<_, u8>(&image.points2d));
}

fn write_point(bytes: &mut Vec<u8>, point: &ColmapPoint) {
    bytes.extend(point.id.to_le_bytes());
    point.xyz.iter().for_each(|v| bytes.extend(v.to_le_bytes()));
    bytes.extend(point.colour);
    bytes.extend(point.error.to_le_bytes());
    bytes.extend((point.track.len() as u64).to_le_bytes());
    bytes.extend(bytemuck::cast_slice::<_, u8>(&point.track));
}

fn write_sensor(bytes: &mut Vec<u8>, sensor: &Sensor) {
    bytes.extend(sensor.kind.to_le_bytes());
    bytes.extend(sensor.id.to_le_bytes());
}

fn write_rig(bytes: &mut Vec<u8>, rig: &Rig) {
    bytes.extend(rig.id.to_le_bytes());
    bytes.extend((rig.sensors.len() as u32).to_le_bytes());
    for (n, (sensor, pose)) in rig.sensors.iter().enumerate() {
        write_sensor(bytes, sensor);
        // The axes of the reference sensor are those of the rig: no pose is stored for it.
        if n > 0 {
            bytes.push(pose.is_some().into());
            pose.iter().for_each(|pose| write_pose(bytes, pose));
        }
    }
}

fn write_frame(bytes: &mut Vec<u8>, frame: &Frame) {
    bytes.extend(frame.id.to_le_bytes());
    bytes.extend(frame.rig_id.to_le_bytes());
    write_pose(bytes, &frame.rig_from_world);
    bytes.extend((frame.data.len() as u32).to_le_bytes());
    for datum in &frame.data {
        write_sensor(bytes, &datum.sensor);
        bytes.extend(datum.id.to_le_bytes());
    }
}
