//! Metashape's (PhotoScan's) `cameras.xml`, with the points of a PLY file exported beside it.
//!
//! ```text
//! document version
//!   chunk (transform)
//!     sensors/sensor id type master_id    resolution, calibration: f cx cy b1 b2 k1..k4 p1..p4; rotation, location: slave to master
//!     components/component id             transform: rotation, translation, scale
//!     cameras (group label)/camera id label sensor_id component_id master_id enabled    transform: 16 numbers, camera to chunk
//! ```
//!
//! Camera axes and pixels are as in COLMAP. cx and cy are relative to the image centre; beside fx
//! and fy, which PhotoScan wrote before 1.4, to its corner. p1 and p2 are OpenCV's p2 and p1; b1 is
//! added to f along x. The transform of the component or the chunk, where there is one, leads to
//! the world, but points may have been exported without it: [`Frame`].

mod lens;
mod model;
mod placement;

use std::{collections::HashMap, rc::Rc};

use nalgebra::{Matrix3, Vector3};

use self::{
    lens::Lens,
    placement::{Placement, Similarity},
};
use super::{
    Fault, Place, Problem, check_images,
    foreign::ForeignModel,
    xml::{Element, Xml},
};

/// Coordinates of cameras and points.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Frame {
    /// With the transform of the component or the chunk.
    World,
    /// Without: as the cameras are stored.
    Chunk,
}

/// Reads cameras and poses of the enabled chunk with most aligned cameras, of that the component
/// with most, in each of some frames. `spelled` completes labels, which may lack the extension of
/// the image.
pub fn read<const N: usize>(
    bytes: &[u8],
    frames: [Frame; N],
    spelled: &dyn Fn(&str) -> String,
) -> Result<[ForeignModel; N], Fault> {
    let (largest, others) = largest_chunk(bytes)?;
    let mut models: [ForeignModel; N] = std::array::from_fn(|_| ForeignModel::default());
    let names = largest.names(spelled);
    for (model, frame) in models.iter_mut().zip(frames) {
        *model = largest.model(frame, &names)?;
        model.warn_of_others("chunks", &others);
    }
    Ok(models)
}

/// The chunk with most aligned cameras, enabled if any is, and the names of the others with their
/// numbers of them.
fn largest_chunk(bytes: &[u8]) -> Result<(Chunk, Vec<(String, usize)>), Fault> {
    let mut xml = Xml::in_root(bytes, "document", "<document> of Metashape")?;
    let mut largest = Chunk::default();
    let mut others = Vec::new();
    while let Some(entered) = xml.enter()? {
        match &*entered.name {
            "chunk" => {}
            // Its chunks come next.
            "chunks" => continue,
            _ => {
                xml.skip()?;
                continue;
            }
        }
        let mut chunk = Chunk::read(&entered, &mut xml)?;
        if chunk.rank() > largest.rank() {
            std::mem::swap(&mut chunk, &mut largest);
        }
        if chunk.aligned() > 0 {
            let disabled = if chunk.is_enabled { "" } else { "disabled " };
            others.push((format!("{disabled}chunk {}", chunk.label), chunk.aligned()));
        }
    }
    Ok((largest, others))
}

#[derive(Default)]
struct Chunk {
    label: String,
    is_enabled: bool,
    /// By id as in the file.
    sensors: HashMap<String, Sensor>,
    components: HashMap<String, Similarity>,
    transform: Option<Similarity>,
    cameras: Vec<ChunkCamera>,
    /// Number of sensors and components read.
    parts: usize,
}

/// A sensor. Its faults matter only if a camera needs it.
struct Sensor {
    number: u32,
    label: Option<String>,
    lens: Result<Lens, Fault>,
    /// Where it is a slave in a rig: its rotation and location in the axes of the master.
    mounting: Result<(Matrix3<f64>, Vector3<f64>), Fault>,
}

struct ChunkCamera {
    at: Place,
    /// Label of its group.
    group: Option<Rc<str>>,
    label: String,
    id: Option<String>,
    sensor_id: String,
    component_id: String,
    master_id: Option<String>,
    is_enabled: bool,
    placement: Result<Option<Placement>, Fault>,
}

impl ChunkCamera {
    fn read(camera: &Element, group: Option<Rc<str>>) -> Result<Self, Fault> {
        let label = camera.attribute("label").unwrap_or_default();
        let id = |attribute| Ok(id_of(camera, attribute)?.map(str::to_owned));
        let transform = camera.child("transform").map(Placement::read);
        Ok(Self {
            at: camera.at(),
            group,
            label: label.to_owned(),
            id: id("id")?,
            sensor_id: id("sensor_id")?.unwrap_or_default(),
            component_id: id("component_id")?.unwrap_or_default(),
            master_id: id("master_id")?,
            is_enabled: is_enabled(camera),
            placement: transform.transpose(),
        })
    }

    /// Returns whether it has a pose or a master.
    fn is_aligned(&self) -> bool {
        !matches!(self.placement, Ok(None)) || self.master_id.is_some()
    }
}

impl Sensor {
    fn read(sensor: &Element, number: u32) -> Self {
        let mounting = || {
            let rotation = sensor.child("rotation").map(Element::numbers::<9>);
            let location = sensor.child("location").map(Element::numbers::<3>);
            let rotation = rotation.transpose()?.map(|r| Matrix3::from_row_slice(&r));
            let location = location.transpose()?.map(Vector3::from);
            Ok((
                rotation.unwrap_or_else(Matrix3::identity),
                location.unwrap_or_default(),
            ))
        };
        Self {
            number,
            label: sensor.attribute("label").map(str::to_owned),
            lens: Lens::read(sensor, number),
            mounting: mounting(),
        }
    }
}

impl Chunk {
    fn read(entered: &Element, xml: &mut Xml) -> Result<Self, Fault> {
        let mut chunk = Self {
            label: entered.attribute("label").unwrap_or_default().to_owned(),
            is_enabled: is_enabled(entered),
            ..Self::default()
        };
        while let Some(entered) = xml.enter()? {
            match &*entered.name {
                "sensors" => chunk.read_sensors(xml)?,
                "components" => chunk.read_components(xml)?,
                "transform" => chunk.transform = Some(Similarity::read(&xml.whole(entered)?)?),
                "cameras" => chunk.read_cameras(None, xml)?,
                _ => xml.skip()?,
            }
        }
        Ok(chunk)
    }

    fn read_sensors(&mut self, xml: &mut Xml) -> Result<(), Fault> {
        while let Some(sensor) = xml.enter()? {
            self.count()?;
            let sensor = xml.whole(sensor)?;
            let number = self.sensors.len() as u32 + 1;
            let read = Sensor::read(&sensor, number);
            self.sensors.insert(own_id(&sensor)?, read);
        }
        Ok(())
    }

    fn read_components(&mut self, xml: &mut Xml) -> Result<(), Fault> {
        while let Some(component) = xml.enter()? {
            self.count()?;
            // The partition below, a list of all cameras, may be long.
            let component = xml.whole(component)?;
            if let Some(transform) = component.child("transform") {
                let transform = Similarity::read(transform)?;
                self.components.insert(own_id(&component)?, transform);
            }
        }
        Ok(())
    }

    /// Counts a sensor or a component, of which several may have the same id.
    fn count(&mut self) -> Result<(), Fault> {
        self.parts += 1;
        check_images(self.parts)
    }

    /// Cameras, some of them in groups.
    fn read_cameras(&mut self, group: Option<Rc<str>>, xml: &mut Xml) -> Result<(), Fault> {
        while let Some(entered) = xml.enter()? {
            match &*entered.name {
                "camera" => {
                    let camera = xml.whole(entered)?;
                    // A group's label is shared: one of a megabyte may stand above thousands of
                    // cameras.
                    let camera = ChunkCamera::read(&camera, group.clone())?;
                    self.cameras.push(camera);
                    check_images(self.cameras.len())?;
                }
                // The depth is bounded by the XML reader.
                "group" => self.read_cameras(entered.attribute("label").map(Rc::from), xml)?,
                _ => xml.skip()?,
            }
        }
        Ok(())
    }

    /// Enabled chunks come first, then those of most cameras; none is without a camera.
    fn rank(&self) -> (bool, bool, usize) {
        let aligned = self.aligned();
        (aligned > 0, self.is_enabled, aligned)
    }

    /// Number of enabled cameras that have a pose or a master.
    fn aligned(&self) -> usize {
        let is_aligned = |camera: &&ChunkCamera| camera.is_enabled && camera.is_aligned();
        self.cameras.iter().filter(is_aligned).count()
    }
}

fn is_enabled(element: &Element) -> bool {
    !matches!(element.attribute("enabled"), Some("false" | "0"))
}

/// Longest id, bytes: that of a master's component is compared for each of its slaves.
const LONGEST_ID: usize = 255;

/// The id in an attribute, usually a number.
fn id_of<'a>(element: &'a Element, attribute: &str) -> Result<Option<&'a str>, Fault> {
    let id = element.attribute(attribute);
    let Some(long) = id.filter(|id| id.len() > LONGEST_ID) else {
        return Ok(id);
    };
    let problem = Problem::syntax("an id of at most 255 bytes", long);
    Err(problem.at(element.at()))
}

fn own_id(element: &Element) -> Result<String, Fault> {
    Ok(id_of(element, "id")?.unwrap_or_default().to_owned())
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;

    use super::*;

    /// Two aligned cameras, the second in a group, turned by 180 degrees about x and 10 above; one
    /// that isn't aligned.
    fn file(calibration: &str, more: &str) -> String {
        format!(
            r#"<?xml version="1.0" encoding="UTF-8"?><document version="2.0.0"><chunk label="C &amp; D"><sensors next_id="1">
            <sensor id="4" label="a" type="frame"><resolution width="200" height="100"/>
            <calibration type="frame" class="initial"><f>1</f></calibration>
            <calibration type="frame" class="adjusted">{calibration}</calibration></sensor></sensors>
            {more}<cameras><camera id="0" label="a" sensor_id="4" component_id="0">
            <transform>1 0 0 1 0 1 0 2 0 0 1 3 0 0 0 1</transform></camera>
            <group label="g"><camera id="1" label="b" sensor_id="4" component_id="0">
            <transform>1 0 0 0 0 -1 0 0 0 0 -1 10 0 0 0 1</transform></camera></group>
            <camera id="2" label="c" sensor_id="4"/></cameras></chunk></document>"#
        )
    }

    fn read(text: &str, frame: Frame) -> Result<ForeignModel, Fault> {
        super::read(text.as_bytes(), [frame], &|label| format!("{label}.jpg")).map(|[model]| model)
    }

    #[test]
    fn cameras_are_as_in_colmap_but_for_their_centre_and_p1_p2() {
        let text = file(
            "<f>80</f><cx>3</cx><cy>-2</cy><b1>1</b1><k1>0.1</k1><p1>0.01</p1><p2>0.02</p2>",
            "",
        );
        let foreign = read(&text, Frame::World).unwrap();
        let scene = foreign.scene().unwrap();
        assert_eq!(
            scene
                .views
                .iter()
                .map(|v| v.name.as_str())
                .collect::<Vec<_>>(),
            ["a.jpg", "b.jpg"]
        );
        assert_eq!(scene.unregistered, ["c.jpg"]);
        let expected = [
            81.0, 80.0, 103.0, 48.0, 0.1, 0.0, 0.02, 0.01, 0.0, 0.0, 0.0, 0.0,
        ];
        assert_eq!(scene.cameras[0].params(), expected);
        let seen = scene.views[1]
            .cam_from_world
            .camera_from_world(&Point3::new(1.0, 2.0, 4.0));
        assert!(
            (seen - Point3::new(1.0, -2.0, 6.0)).norm() < 1e-12,
            "{seen}"
        );
        let old = file("<fx>81</fx><fy>80</fy><cx>103</cx><cy>48</cy>", "");
        assert_eq!(
            read(&old, Frame::World).unwrap().scene().unwrap().cameras[0].params(),
            [81.0, 80.0, 103.0, 48.0]
        );
    }

    #[test]
    fn the_transform_of_the_component_leads_to_the_world() {
        let component = "<components><component id=\"0\"><transform><rotation>0 -1 0 1 0 0 0 0 1</rotation>\
                         <translation>100 200 300</translation><scale>2</scale></transform></component></components>";
        let text = file("<f>80</f>", component);
        let centre = |frame| {
            let scene = read(&text, frame).unwrap().scene().unwrap();
            scene.views[0].cam_from_world.centre()
        };
        assert!((centre(Frame::World) - Point3::new(96.0, 202.0, 306.0)).norm() < 1e-9);
        assert!((centre(Frame::Chunk) - Point3::new(1.0, 2.0, 3.0)).norm() < 1e-12);
    }

    #[test]
    fn what_colmap_cannot_say_is_left_out_with_a_warning_or_refused() {
        let warnings = |calibration: &str| {
            read(&file(calibration, ""), Frame::World)
                .unwrap()
                .model
                .warnings
                .len()
        };
        assert_eq!(warnings("<f>80</f><k4>1e-9</k4>"), 0);
        assert_eq!(warnings("<f>80</f><b2>3</b2>"), 1);
        let said = |text: &str| read(text, Frame::World).unwrap_err().to_string();
        assert!(said(&file("<f>80</f><b2>300</b2>", "")).contains("b2"));
        assert!(said(&file("<f>eighty</f>", "")).contains("<f>"));
        assert!(said(&file("", "")).contains("fx"));
        assert!(said("<a><b/></a>").contains("<document>"));
        assert!(said("<document><chunk>").contains("ends"));
        assert!(said("<document><chunk></document>").contains("XML"));
        assert!(said(&file("&lol;", "")).contains("&lol;"));
        assert!(said(&format!("<document>{}", "<a>".repeat(1000))).contains("deeper"));
        let long = format!("component_id=\"{}\"", "0".repeat(300));
        let long = file("<f>80</f>", "").replace("component_id=\"0\"", &long);
        assert!(said(&long).contains("an id of at most 255 bytes"));
        assert!(
            said(&file("<f>80</f>", "").replace("sensor_id=\"4\"", "sensor_id=\"5\""))
                .contains("sensor")
        );
    }
}
