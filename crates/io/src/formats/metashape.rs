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

use std::collections::{HashMap, HashSet};

use nalgebra::{Matrix3, Vector3};
use viewrank_core::model::{
    camera::{Camera, CameraModel},
    scene::WarningKind,
};

use super::{
    Fault, Problem, check_images,
    colmap::StoredPose,
    foreign::{ForeignModel, camera, largest_component, pose_with_centre},
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

/// Largest error in pixels that leaving out a term of the distortion may cause.
const NEGLIGIBLE_PX: f64 = 0.5;

/// Reads cameras and poses of the chunk with most aligned cameras, of that the component with most,
/// in each of some frames. `spelled` completes labels, which may lack the extension of the image.
pub fn read<const N: usize>(
    bytes: &[u8],
    frames: [Frame; N],
    spelled: &dyn Fn(&str) -> String,
) -> Result<[ForeignModel; N], Fault> {
    let mut xml = Xml::in_root(bytes, "document", "<document> of Metashape")?;
    let mut largest = Chunk::default();
    let mut others = Vec::new();
    while let Some(entered) = xml.enter()? {
        if entered.name != "chunk" {
            xml.skip()?;
            continue;
        }
        let mut chunk = Chunk::read(&entered, &mut xml)?;
        if chunk.aligned() > largest.aligned() {
            std::mem::swap(&mut chunk, &mut largest);
        }
        if chunk.aligned() > 0 {
            others.push((format!("chunk {}", chunk.label), chunk.aligned()));
        }
    }
    let mut models: [ForeignModel; N] = std::array::from_fn(|_| ForeignModel::default());
    for (model, frame) in models.iter_mut().zip(frames) {
        *model = largest.model(frame, spelled)?;
        model.warn_of_others("chunks", &others);
    }
    Ok(models)
}

#[derive(Default)]
struct Chunk {
    label: String,
    /// By id as in the file.
    sensors: HashMap<String, (u32, Element)>,
    components: HashMap<String, Similarity>,
    transform: Option<Similarity>,
    cameras: Vec<ChunkCamera>,
    /// Number of sensors and components read.
    parts: usize,
}

struct ChunkCamera {
    /// Label of its group.
    group: Option<String>,
    element: Element,
}

impl ChunkCamera {
    fn label(&self) -> &str {
        self.element.attribute("label").unwrap_or_default()
    }

    fn is_enabled(&self) -> bool {
        !matches!(self.element.attribute("enabled"), Some("false" | "0"))
    }
}

impl Chunk {
    fn read(entered: &Element, xml: &mut Xml) -> Result<Self, Fault> {
        let mut chunk = Self {
            label: entered.attribute("label").unwrap_or_default().to_owned(),
            ..Self::default()
        };
        while let Some(entered) = xml.enter()? {
            match &*entered.name {
                "sensors" => {
                    while let Some(sensor) = xml.enter()? {
                        chunk.count()?;
                        let sensor = xml.whole(sensor)?;
                        let (id, number) = (id_of(&sensor, "id"), chunk.sensors.len() as u32 + 1);
                        chunk.sensors.insert(id, (number, sensor));
                    }
                }
                "components" => {
                    while let Some(component) = xml.enter()? {
                        chunk.count()?;
                        // The partition below, a list of all cameras, may be long.
                        let component = xml.whole(component)?;
                        if let Some(transform) = component.child("transform") {
                            chunk
                                .components
                                .insert(id_of(&component, "id"), Similarity::read(transform)?);
                        }
                    }
                }
                "transform" => chunk.transform = Some(Similarity::read(&xml.whole(entered)?)?),
                "cameras" => chunk.read_cameras(None, xml)?,
                _ => xml.skip()?,
            }
        }
        Ok(chunk)
    }

    /// Counts a sensor or a component, of which several may have the same id.
    fn count(&mut self) -> Result<(), Fault> {
        self.parts += 1;
        check_images(self.parts)
    }

    /// Cameras, some of them in groups.
    fn read_cameras(&mut self, group: Option<&str>, xml: &mut Xml) -> Result<(), Fault> {
        while let Some(entered) = xml.enter()? {
            match &*entered.name {
                "camera" => {
                    self.cameras.push(ChunkCamera {
                        group: group.map(str::to_owned),
                        element: xml.whole(entered)?,
                    });
                    check_images(self.cameras.len())?;
                }
                "group" => self.read_cameras(entered.attribute("label"), xml)?,
                _ => xml.skip()?,
            }
        }
        Ok(())
    }

    /// Number of enabled cameras that have a pose or a master.
    fn aligned(&self) -> usize {
        let is_aligned = |camera: &&ChunkCamera| {
            let element = &camera.element;
            let placed = element.child("transform").is_some();
            camera.is_enabled() && (placed || element.attribute("master_id").is_some())
        };
        self.cameras.iter().filter(is_aligned).count()
    }

    fn model(&self, frame: Frame, spelled: &dyn Fn(&str) -> String) -> Result<ForeignModel, Fault> {
        let mut foreign = ForeignModel::default();
        let by_id: HashMap<&str, &ChunkCamera> = self
            .cameras
            .iter()
            .filter_map(|camera| Some((camera.element.attribute("id")?, camera)))
            .collect();
        let names = self.names(spelled);
        let mut used = HashSet::new();
        let (mut components, mut disabled) = (Vec::new(), Vec::new());
        for ((n, camera), name) in (1..).zip(&self.cameras).zip(names) {
            let (label, element) = (camera.label(), &camera.element);
            let what = || format!("camera {n}, {label:?}");
            if !camera.is_enabled() {
                disabled.push(name);
                continue;
            }
            let placement = self.placement(camera, &by_id);
            let Some(placement) = placement.map_err(|fault| fault.in_record(what))? else {
                foreign.unregistered.push(name);
                continue;
            };
            let (id, sensor) = self.sensor(element).map_err(|f| f.in_record(what))?;
            if used.insert(*id) {
                let camera = lens(sensor, *id, &mut foreign)
                    .map_err(|fault| fault.in_record(|| format!("sensor {id}")))?;
                foreign.model.cameras.push(camera);
            }
            let component = id_of(placement.component_of, "component_id");
            let world = self
                .components
                .get(&component)
                .or(self.transform.as_ref())
                .filter(|_| frame == Frame::World);
            let pose = placement.pose(world);
            let pose =
                pose.map_err(|problem| Fault::new("", element.at(), problem).in_record(what))?;
            foreign.add_image(n, name, *id, pose, element.at());
            components.push(component);
        }
        let (largest, others) = largest_component(components.iter().map(String::as_str));
        foreign.keep_images(|image| components[image] == largest);
        foreign.warn_of_others("components", &others);
        if let Some(first) = disabled.first() {
            let text = format!(
                "{} disabled cameras are left out, e.g. {first}",
                disabled.len()
            );
            foreign.warn(WarningKind::Format, text);
        }
        foreign.left_out = disabled;
        Ok(foreign)
    }

    /// Names of the images of all cameras: their labels. Of several cameras of a label, each has its
    /// group, or its sensor, for a folder, and its id where that does not tell them apart.
    fn names(&self, spelled: &dyn Fn(&str) -> String) -> Vec<String> {
        let folder = |camera: &ChunkCamera| {
            let of_sensor = || {
                let (_, sensor) = self.sensor(&camera.element).ok()?;
                Some(sensor.attribute("label")?.to_owned())
            };
            camera.group.clone().or_else(of_sensor)
        };
        let mut labels: HashMap<&str, usize> = HashMap::new();
        let mut places: HashMap<(&str, Option<String>), usize> = HashMap::new();
        for camera in &self.cameras {
            *labels.entry(camera.label()).or_default() += 1;
            *places.entry((camera.label(), folder(camera))).or_default() += 1;
        }
        let name = |camera: &ChunkCamera| {
            let label = camera.label();
            if labels[label] == 1 {
                return spelled(&label.replace('\\', "/"));
            }
            let folder = folder(camera);
            let is_apart = places[&(label, folder.clone())] == 1;
            let id = id_of(&camera.element, "id");
            spelled(&match folder {
                Some(folder) if is_apart => format!("{folder}/{label}"),
                Some(folder) => format!("{folder}_{id}/{label}"),
                None => format!("camera_{id}/{label}"),
            })
        };
        self.cameras.iter().map(name).collect()
    }

    fn sensor(&self, camera: &Element) -> Result<&(u32, Element), Fault> {
        let id = id_of(camera, "sensor_id");
        self.sensors.get(&id).ok_or_else(|| {
            let problem = Problem::Syntax {
                expected: "the id of a sensor",
                found: format!("sensor_id {id:?}"),
            };
            Fault::new("", camera.at(), problem)
        })
    }

    /// The placement of a camera in the chunk: its own, or by that of its master in a rig; `None`
    /// if it is not aligned.
    fn placement<'a>(
        &'a self,
        camera: &'a ChunkCamera,
        by_id: &HashMap<&str, &'a ChunkCamera>,
    ) -> Result<Option<Placement<'a>>, Fault> {
        if let Some(transform) = camera.element.child("transform") {
            return Ok(Some(Placement::read(transform, &camera.element)?));
        }
        let master = camera.element.attribute("master_id");
        let master = master.and_then(|id| by_id.get(id));
        let Some((master, transform)) =
            master.and_then(|master| Some((master, master.element.child("transform")?)))
        else {
            return Ok(None);
        };
        let (_, sensor) = self.sensor(&camera.element)?;
        let rotation = sensor.child("rotation").map(Element::numbers::<9>);
        let location = sensor.child("location").map(Element::numbers::<3>);
        let rotation = rotation.transpose()?.map(|r| Matrix3::from_row_slice(&r));
        let location = location.transpose()?.map(Vector3::from);
        let of_master = Placement::read(transform, &master.element)?;
        Ok(Some(of_master.followed_by(
            rotation.unwrap_or_else(Matrix3::identity),
            location.unwrap_or_default(),
        )))
    }
}

/// Rotation and centre of a camera, from its axes to the chunk's.
struct Placement<'a> {
    rotation: Matrix3<f64>,
    centre: Vector3<f64>,
    /// The camera in whose component it is.
    component_of: &'a Element,
}

impl<'a> Placement<'a> {
    /// Reads a 4 x 4 matrix, row by row.
    fn read(transform: &Element, component_of: &'a Element) -> Result<Self, Fault> {
        let numbers = transform.numbers::<16>()?;
        let m = |row: usize, column: usize| numbers[4 * row + column];
        Ok(Self {
            rotation: Matrix3::from_fn(m),
            centre: Vector3::from_fn(|row, _| m(row, 3)),
            component_of,
        })
    }

    /// The placement of a slave, whose axes and centre are given in those of this camera.
    fn followed_by(self, rotation: Matrix3<f64>, location: Vector3<f64>) -> Self {
        Self {
            centre: self.rotation * location + self.centre,
            rotation: self.rotation * rotation,
            ..self
        }
    }

    fn pose(&self, world: Option<&Similarity>) -> Result<StoredPose, Problem> {
        let (mut rotation, mut centre) = (self.rotation, self.centre);
        if let Some(Similarity {
            rotation: turn,
            translation,
            scale,
        }) = world
        {
            rotation = turn * rotation;
            centre = turn * centre * *scale + translation;
        }
        pose_with_centre(rotation.transpose(), centre)
    }
}

fn id_of(element: &Element, attribute: &str) -> String {
    element.attribute(attribute).unwrap_or_default().to_owned()
}

/// Scale, rotation and translation.
struct Similarity {
    rotation: Matrix3<f64>,
    translation: Vector3<f64>,
    scale: f64,
}

impl Similarity {
    fn read(transform: &Element) -> Result<Self, Fault> {
        let rotation = transform
            .child("rotation")
            .map(|rotation| rotation.numbers::<9>())
            .transpose()?;
        let translation = transform
            .child("translation")
            .map(|translation| translation.numbers::<3>())
            .transpose()?;
        Ok(Self {
            rotation: rotation.map_or_else(Matrix3::identity, |rotation| {
                Matrix3::from_row_slice(&rotation)
            }),
            translation: translation.map_or_else(Vector3::zeros, Vector3::from),
            scale: transform.number("scale")?.unwrap_or(1.0),
        })
    }
}

fn lens(sensor: &Element, id: u32, foreign: &mut ForeignModel) -> Result<Camera, Fault> {
    let adjusted = sensor
        .children("calibration")
        .find(|one| one.attribute("class") != Some("initial"));
    let calibration = adjusted.or(sensor.child("calibration"));
    let kind = [calibration, Some(sensor)]
        .into_iter()
        .flatten()
        .find_map(|element| element.attribute("type"));
    let kind = kind.unwrap_or("frame");
    let [width, height] = size(sensor, calibration)?;
    let (w, h) = (width as f64, height as f64);
    let (model, params) = if kind == "spherical" {
        (CameraModel::Equirectangular, vec![w, h])
    } else {
        let calibration = calibration.ok_or_else(|| sensor.lacks("calibration"))?;
        let terms = Terms::read(calibration, [w, h])?;
        let Some((model, params, left_out)) = terms.in_colmap(kind, [w, h]) else {
            let problem = Problem::CameraModel(format!("{kind} (Metashape)"));
            return Err(Fault::new("", sensor.at(), problem));
        };
        refuse_much_left_out(left_out, calibration)?;
        if left_out > NEGLIGIBLE_PX {
            let text = format!(
                "b2, k4, p3 and p4 of sensor {id} are left out, which moves pixels by up to {left_out:.1}"
            );
            foreign.warn(WarningKind::Format, text);
        }
        (model, params)
    };
    let lens = Camera::new(id, model, width, height, params);
    camera(lens, || "its camera".into())
}

/// Width and height of the calibration's images, else of the sensor.
fn size(sensor: &Element, calibration: Option<&Element>) -> Result<[u64; 2], Fault> {
    let resolution = calibration
        .and_then(|c| c.child("resolution"))
        .or(sensor.child("resolution"));
    let resolution = resolution.ok_or_else(|| sensor.lacks("resolution"))?;
    let side = |name: &'static str| {
        let side = resolution
            .attribute(name)
            .and_then(|side| side.parse::<u64>().ok());
        side.ok_or_else(|| resolution.lacks(name))
    };
    Ok([side("width")?, side("height")?])
}

/// Terms of a calibration, pixels of COLMAP.
struct Terms {
    focal: [f64; 2],
    centre: [f64; 2],
    k: [f64; 4],
    p: [f64; 4],
    b2: f64,
}

impl Terms {
    fn read(calibration: &Element, [w, h]: [f64; 2]) -> Result<Self, Fault> {
        let value = |name: &str| calibration.number(name).map(Option::unwrap_or_default);
        let k = [value("k1")?, value("k2")?, value("k3")?, value("k4")?];
        let p = [value("p1")?, value("p2")?, value("p3")?, value("p4")?];
        let (focal, centre) = match calibration.number("f")? {
            Some(f) => (
                [f + value("b1")?, f],
                [w / 2.0 + value("cx")?, h / 2.0 + value("cy")?],
            ),
            None => (
                calibration.required(["fx", "fy"])?,
                calibration.required(["cx", "cy"])?,
            ),
        };
        Ok(Self {
            focal,
            centre,
            k,
            p,
            b2: value("b2")?,
        })
    }

    /// Returns COLMAP's model of this kind with its parameters, and by how many pixels the terms
    /// that it lacks move the corner of an image.
    fn in_colmap(&self, kind: &str, [w, h]: [f64; 2]) -> Option<(CameraModel, Vec<f64>, f64)> {
        let ([fx, fy], [cx, cy]) = (self.focal, self.centre);
        let ([k1, k2, k3, k4], [p1, p2, p3, p4]) = (self.k, self.p);
        let corner = (w / 2.0 / fx).hypot(h / 2.0 / fy);
        let skew = self.b2.abs() * h / 2.0 / fy;
        Some(match kind {
            "frame" => {
                let tangential =
                    (p1.abs() + p2.abs()) * (p3.abs() * corner.powi(2) + p4.abs() * corner.powi(4));
                let off = fx * (k4.abs() * corner.powi(9) + 3.0 * corner.powi(2) * tangential);
                (
                    CameraModel::FullOpenCv,
                    vec![fx, fy, cx, cy, k1, k2, p2, p1, k3, 0.0, 0.0, 0.0],
                    off + skew,
                )
            }
            "fisheye" | "equidistant_fisheye" => {
                let off = 3.0 * fx * (p1.abs() + p2.abs()) * corner.atan().powi(2);
                (
                    CameraModel::OpenCvFisheye,
                    vec![fx, fy, cx, cy, k1, k2, k3, k4],
                    off + skew,
                )
            }
            _ => return None,
        })
    }
}

fn refuse_much_left_out(left_out_px: f64, calibration: &Element) -> Result<(), Fault> {
    if left_out_px <= 100.0 * NEGLIGIBLE_PX {
        return Ok(());
    }
    let what = format!(
        "b2, k4, p3 or p4 of the calibration move pixels by {left_out_px:.0}, and COLMAP's models have no such term"
    );
    let hint = "undistort the photos in Metashape (Export > Undistort Photos), or fit the calibration without these terms";
    Err(Fault::new(
        "",
        calibration.at(),
        Problem::Unsupported { what, hint },
    ))
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
        assert!(
            said(&file("<f>80</f>", "").replace("sensor_id=\"4\"", "sensor_id=\"5\""))
                .contains("sensor")
        );
    }
}
