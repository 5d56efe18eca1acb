//! Writes COLMAP's text models, for tests of the readers.

use std::fmt::Write as _;

use viewrank_core::model::camera::Camera;

use super::{Problem, StoredPose};
use crate::formats::colmap::{ColmapImage, ColmapModel, ColmapPoint, Frame, Rig, Sensor};

/// Text files of a model. Image names with blanks are refused, since COLMAP cannot read them.
pub fn write(model: &ColmapModel) -> Result<Vec<(&'static str, Vec<u8>)>, Problem> {
    if let Some(image) = model
        .images
        .iter()
        .find(|image| image.name.contains(char::is_whitespace))
    {
        let why = "contains a blank, which COLMAP's text models don't support";
        return Err(Problem::Name {
            name: image.name.clone().into_owned(),
            why,
        });
    }
    let mut files = vec![
        (
            "cameras.txt",
            file(
                "CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]",
                &model.cameras,
                write_camera,
            ),
        ),
        (
            "images.txt",
            file(
                "IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME, then a line of POINTS2D[] as (X, Y, POINT3D_ID)",
                &model.images,
                write_image,
            ),
        ),
        (
            "points3D.txt",
            file(
                "POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)",
                &model.points,
                write_point,
            ),
        ),
    ];
    if let Some(rigs) = &model.rigs {
        files.push(("rigs.txt", file("RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, SENSORS[] as (SENSOR_TYPE, SENSOR_ID, HAS_POSE, [QW, QX, QY, QZ, TX, TY, TZ])", rigs, write_rig)));
    }
    if let Some(frames) = &model.frames {
        files.push(("frames.txt", file("FRAME_ID, RIG_ID, QW, QX, QY, QZ, TX, TY, TZ, NUM_DATA_IDS, DATA_IDS[] as (SENSOR_TYPE, SENSOR_ID, DATA_ID)", frames, write_frame)));
    }
    Ok(files)
}

fn file<T>(
    columns: &str,
    records: &[T],
    write: impl Fn(&mut String, &T) -> std::fmt::Result,
) -> Vec<u8> {
    let mut text = format!("# {columns}\n");
    for record in records {
        // Writing to a string cannot fail.
        let _ = write(&mut text, record);
        text.push('\n');
    }
    text.into_bytes()
}

fn write_numbers(text: &mut String, numbers: &[f64]) -> std::fmt::Result {
    numbers
        .iter()
        .try_for_each(|number| write!(text, " {number}"))
}

fn write_pose(text: &mut String, pose: &StoredPose) -> std::fmt::Result {
    write_numbers(text, &pose.quaternion)?;
    write_numbers(text, &pose.translation)
}

fn write_camera(text: &mut String, camera: &Camera) -> std::fmt::Result {
    write!(
        text,
        "{} {} {} {}",
        camera.id,
        camera.model().name(),
        camera.width,
        camera.height
    )?;
    write_numbers(text, camera.params())
}

fn write_image(text: &mut String, image: &ColmapImage) -> std::fmt::Result {
    write!(text, "{}", image.id)?;
    write_pose(text, &image.cam_from_world)?;
    writeln!(text, " {} {}", image.camera_id, image.name)?;
    for (n, point) in image.points2d.iter().enumerate() {
        let [x, y] = point.pixel();
        write!(text, "{}{x} {y} ", if n == 0 { "" } else { " " })?;
        match point.point() {
            Some(id) => write!(text, "{id}")?,
            None => text.push_str("-1"),
        }
    }
    Ok(())
}

fn write_point(text: &mut String, point: &ColmapPoint) -> std::fmt::Result {
    let [x, y, z] = point.xyz;
    let [r, g, b] = point.colour;
    write!(text, "{} {x} {y} {z} {r} {g} {b} {}", point.id, point.error)?;
    point
        .track
        .iter()
        .try_for_each(|e| write!(text, " {} {}", e.image(), e.index()))
}

fn write_sensor(text: &mut String, sensor: &Sensor) -> std::fmt::Result {
    let kind = if sensor.kind == Sensor::CAMERA {
        "CAMERA"
    } else {
        "IMU"
    };
    write!(text, " {kind} {}", sensor.id)
}

fn write_rig(text: &mut String, rig: &Rig) -> std::fmt::Result {
    write!(text, "{} {}", rig.id, rig.sensors.len())?;
    for (n, (sensor, pose)) in rig.sensors.iter().enumerate() {
        write_sensor(text, sensor)?;
        match pose {
            // The reference sensor has the axes of the rig.
            _ if n == 0 => {}
            None => text.push_str(" 0"),
            Some(pose) => {
                text.push_str(" 1");
                write_pose(text, pose)?;
            }
        }
    }
    Ok(())
}

fn write_frame(text: &mut String, frame: &Frame) -> std::fmt::Result {
    write!(text, "{} {}", frame.id, frame.rig_id)?;
    write_pose(text, &frame.rig_from_world)?;
    write!(text, " {}", frame.data.len())?;
    for datum in &frame.data {
        write_sensor(text, &datum.sensor)?;
        write!(text, " {}", datum.id)?;
    }
    Ok(())
}
