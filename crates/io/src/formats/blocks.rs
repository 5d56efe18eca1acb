//! BlocksExchange XML of ContextCapture (iTwin Capture), which Metashape and RealityScan write,
//! too.
//!
//! ```text
//! BlocksExchange/SpatialReferenceSystems/SRS    Id, Definition
//! BlocksExchange/Block                          SRSId
//!   Photogroups/Photogroup    ImageDimensions, FocalLengthPixels (or FocalLength and SensorSize), CameraOrientation, PrincipalPoint, Distortion
//!     Photo                   Id, ImagePath, Component, Pose: Rotation M_00..M_22, Center
//!   TiePoints/TiePoint        Position, Color, Measurement: PhotoId, x, y
//! ```
//!
//! Rotations are world to camera, with the axes that CameraOrientation names (XRightYDown: as in
//! COLMAP); the centre of the first pixel is (0, 0). P1 belongs to r² + 2x², as in Brown's model:
//! OpenCV's p2.

use std::collections::HashMap;

use nalgebra::{Matrix3, Vector3};
use viewrank_core::model::{
    camera::{Camera, CameraModel},
    georeference::{Georeference, Zone},
};

use super::{
    Fault, Place, Problem, check_images,
    colmap::StoredPose,
    foreign::{ForeignModel, camera, largest_component, pose_with_centre, shift},
    xml::{Element, Xml},
};

/// Reads the block with most images, of that the component with most.
pub fn read(bytes: &[u8]) -> Result<ForeignModel, Fault> {
    let mut xml = Xml::in_root(bytes, "BlocksExchange", "<BlocksExchange>")?;
    let mut systems = Systems::new();
    let mut largest = Block::default();
    let mut others = Vec::new();
    while let Some(entered) = xml.enter()? {
        match &*entered.name {
            "SpatialReferenceSystems" => systems = read_systems(&mut xml)?,
            "Block" => {
                let mut block = Block::default();
                block.read(&mut xml, &systems)?;
                if block.images() > largest.images() {
                    std::mem::swap(&mut block, &mut largest);
                }
                if block.images() > 0 {
                    others.push((block.name.clone(), block.images()));
                }
            }
            _ => xml.skip()?,
        }
    }
    let mut foreign = largest.into_largest_component();
    foreign.warn_of_others("blocks", &others);
    Ok(foreign)
}

/// A reference system.
struct System {
    /// Beginning of its definition, if coordinates are longitude and latitude.
    geographic: Option<String>,
    zone: Option<Zone>,
}

/// Reference systems by id.
type Systems = HashMap<String, System>;

impl System {
    fn read(definition: &str) -> Self {
        let plain = definition.trim().to_ascii_uppercase();
        let code = plain
            .strip_prefix("EPSG:")
            .map(|code| code.split('+').next().unwrap_or_default());
        let is_geographic = ["GEOGCS[", "GEOGCRS[", "GEODCRS["]
            .iter()
            .any(|head| plain.starts_with(head))
            || matches!(code, Some("4326" | "4979" | "4258" | "4269" | "4937"))
            || plain == "WGS84"
            || plain.contains("+PROJ=LONGLAT");
        Self {
            geographic: is_geographic.then(|| definition.chars().take(40).collect()),
            zone: Zone::of_reference_system(definition),
        }
    }

    /// Fails for a geographic system that an element refers to: degrees are no lengths.
    fn check(systems: &Systems, id: &Element) -> Result<(), Fault> {
        let system = systems.get(id.text());
        let Some(definition) = system.and_then(|system| system.geographic.as_ref()) else {
            return Ok(());
        };
        let what = format!("coordinates are longitude and latitude ({definition})");
        let hint = "export the block in a projected or local coordinate system";
        Err(Fault::new("", id.at(), Problem::Unsupported { what, hint }))
    }
}

fn read_systems(xml: &mut Xml) -> Result<Systems, Fault> {
    let mut systems = Systems::new();
    let mut count = 0;
    while let Some(system) = xml.enter()? {
        count += 1;
        check_images(count)?;
        let system = xml.whole(system)?;
        let text = |name| system.child(name).map_or("", Element::text);
        systems.insert(text("Id").to_owned(), System::read(text("Definition")));
    }
    Ok(systems)
}

#[derive(Default)]
struct Block {
    name: String,
    foreign: ForeignModel,
    /// Component of each image, as in the file; empty where none is given.
    components: Vec<String>,
    /// Position in the model of each photo, by id.
    photos: HashMap<String, usize>,
    groups: u32,
}

impl Block {
    fn read(&mut self, xml: &mut Xml, systems: &Systems) -> Result<(), Fault> {
        while let Some(entered) = xml.enter()? {
            match &*entered.name {
                "Name" => self.name = xml.whole(entered)?.text().to_owned(),
                "SRSId" => {
                    let id = xml.whole(entered)?;
                    System::check(systems, &id)?;
                    let zone = systems.get(id.text()).and_then(|system| system.zone);
                    self.foreign.georeference = zone.map(|zone| Georeference::Utm {
                        zone,
                        offset: [0.0; 2],
                    });
                }
                "Photogroups" => {
                    while let Some(entered) = xml.enter()? {
                        if entered.name == "Photogroup" {
                            self.read_group(xml, entered, systems)?
                        } else {
                            xml.skip()?
                        }
                    }
                }
                "TiePoints" => {
                    while let Some(entered) = xml.enter()? {
                        let point = xml.whole(entered)?;
                        match &*point.name {
                            "TiePoint" => self.add_tie_point(&point)?,
                            "SRSId" => System::check(systems, &point)?,
                            _ => {}
                        }
                    }
                }
                _ => xml.skip()?,
            }
        }
        Ok(())
    }

    fn images(&self) -> usize {
        self.foreign.model.images.len()
    }

    /// The model without the images of all components but the one with most: their poses are in
    /// coordinates of their own.
    fn into_largest_component(self) -> ForeignModel {
        let (mut foreign, components) = (self.foreign, self.components);
        let (largest, others) = largest_component(components.iter().map(String::as_str));
        foreign.keep_images(|image| components[image] == largest);
        foreign.warn_of_others("components", &others);
        foreign
    }

    /// Reads a group: what its photos have in common stands before them.
    fn read_group(
        &mut self,
        xml: &mut Xml,
        entered: Element,
        systems: &Systems,
    ) -> Result<(), Fault> {
        let mut common = Group {
            at: entered.at(),
            parts: HashMap::new(),
            camera: None,
        };
        self.groups += 1;
        check_images(self.groups as usize)?;
        let id = self.groups;
        while let Some(entered) = xml.enter()? {
            match &*entered.name {
                "Photo" => {
                    let count = self.images() + self.foreign.unregistered.len() + 1;
                    check_images(count)?;
                    self.add_photo(&xml.whole(entered)?, &mut common, id)?;
                }
                "SRSId" => System::check(systems, &xml.whole(entered)?)?,
                name if PARTS.contains(&name) && !common.parts.contains_key(name) => {
                    let part = xml.whole(entered)?;
                    common.parts.insert(part.name.clone(), part);
                }
                _ => xml.skip()?,
            }
        }
        Ok(())
    }

    fn add_photo(&mut self, photo: &Element, group: &mut Group, id: u32) -> Result<(), Fault> {
        let path = photo
            .child("ImagePath")
            .map(Element::text)
            .unwrap_or_default();
        let what = || format!("photo {path:?}");
        let pose = photo.child("Pose");
        let rotation = pose
            .and_then(|pose| pose.child("Rotation"))
            .filter(|rotation| rotation.child("M_00").is_some());
        let Some((rotation, centre)) = rotation.zip(pose.and_then(|pose| pose.child("Center")))
        else {
            self.foreign.unregistered.push(path.replace('\\', "/"));
            return Ok(());
        };
        let axes = match group.camera {
            Some(axes) => axes,
            None => {
                let (camera, axes) = group
                    .read(id)
                    .map_err(|fault| fault.in_record(|| format!("photogroup {id}")))?;
                self.foreign.model.cameras.push(camera);
                *group.camera.insert(axes)
            }
        };
        let pose = pose_of(rotation, centre, axes).map_err(|fault| fault.in_record(what))?;
        let position = self.foreign.model.images.len();
        if let Some(id) = photo.child("Id") {
            self.photos.insert(id.text().to_owned(), position);
        }
        self.foreign.add_image(
            position as u32 + 1,
            path.replace('\\', "/"),
            id,
            pose,
            photo.at(),
        );
        let component = photo.child("Component");
        self.components
            .push(component.map_or(String::new(), |id| id.text().to_owned()));
        Ok(())
    }

    fn add_tie_point(&mut self, point: &Element) -> Result<(), Fault> {
        let position = point
            .child("Position")
            .ok_or_else(|| point.lacks("Position"))?;
        let xyz = position.required(["x", "y", "z"])?;
        let mut colour = [255; 3];
        if let Some(found) = point.child("Color") {
            for (to, name) in colour.iter_mut().zip(["Red", "Green", "Blue"]) {
                *to = (found.number(name)?.unwrap_or(1.0) * 255.0)
                    .round()
                    .clamp(0.0, 255.0) as u8;
            }
        }
        let mut track: Vec<(usize, [f64; 2])> = Vec::new();
        for measured in point.children("Measurement") {
            let id = measured
                .child("PhotoId")
                .ok_or_else(|| measured.lacks("PhotoId"))?;
            // Photos without a pose have measurements, too.
            if let Some(&photo) = self.photos.get(id.text()) {
                track.push((photo, shift(measured.required(["x", "y"])?)));
            }
        }
        let id = self.foreign.model.points.len() as u64 + 1;
        self.foreign.add_point(id, xyz, colour, track, point.at());
        Ok(())
    }
}

fn pose_of(rotation: &Element, centre: &Element, axes: Matrix3<f64>) -> Result<StoredPose, Fault> {
    let names = [
        "M_00", "M_01", "M_02", "M_10", "M_11", "M_12", "M_20", "M_21", "M_22",
    ];
    let matrix = Matrix3::from_row_slice(&rotation.required(names)?);
    let centre = Vector3::from(centre.required(["x", "y", "z"])?);
    pose_with_centre(axes * matrix, centre)
        .map_err(|problem| Fault::new("", rotation.at(), problem))
}

/// Elements of a group that are read, beside its photos.
const PARTS: [&str; 11] = [
    "AspectRatio",
    "CameraModelType",
    "CameraOrientation",
    "Distortion",
    "FocalLength",
    "FocalLengthPixels",
    "ImageDimensions",
    "PixelSize",
    "PrincipalPoint",
    "SensorSize",
    "Skew",
];

/// The parameters that all photos of a group share.
struct Group {
    at: Place,
    parts: HashMap<String, Element>,
    /// Axes of the camera in COLMAP's, once it is read.
    camera: Option<Matrix3<f64>>,
}

impl Group {
    fn part(&self, name: &'static str) -> Result<&Element, Fault> {
        let missing = || Problem::Syntax {
            expected: name,
            found: "a photogroup without it".into(),
        };
        self.parts
            .get(name)
            .ok_or_else(|| Fault::new("", self.at, missing()))
    }

    fn number(&self, name: &str) -> Result<Option<f64>, Fault> {
        self.parts
            .get(name)
            .map(|part| part.numbers::<1>().map(|[value]| value))
            .transpose()
    }

    /// Returns the camera that the photos share, and its axes.
    fn read(&self, id: u32) -> Result<(Camera, Matrix3<f64>), Fault> {
        let [w, h] = self
            .part("ImageDimensions")?
            .required(["Width", "Height"])?;
        let axes = self.axes()?;
        let kind = self.text_or("CameraModelType", "Perspective");
        let (model, params) = match kind {
            "Spherical" => (CameraModel::Equirectangular, vec![w, h]),
            "Perspective" => (CameraModel::FullOpenCv, self.perspective([w, h])?),
            _ => {
                let problem = Problem::CameraModel(format!("{kind} (BlocksExchange)"));
                return Err(Fault::new("", self.at, problem));
            }
        };
        let found = Camera::new(id, model, w as u64, h as u64, params);
        Ok((camera(found, || "its camera".into())?, axes))
    }

    fn text_or<'a>(&'a self, name: &str, default: &'a str) -> &'a str {
        self.parts.get(name).map_or(default, Element::text)
    }

    fn axes(&self) -> Result<Matrix3<f64>, Fault> {
        let name = "CameraOrientation";
        axes(self.text_or(name, "XRightYDown")).ok_or_else(|| {
            let problem = Problem::Syntax {
                expected: "a CameraOrientation such as XRightYDown",
                found: self.text_or(name, "").chars().take(40).collect(),
            };
            Fault::new("", self.at, problem)
        })
    }

    /// Parameters of `FULL_OPENCV`.
    fn perspective(&self, [w, h]: [f64; 2]) -> Result<Vec<f64>, Fault> {
        let focal = self.focal_px(w.max(h))?;
        let [cx, cy] = match self.parts.get("PrincipalPoint") {
            Some(point) => principal_point(point)?,
            None => [w / 2.0, h / 2.0],
        };
        self.refuse_skew(h, focal)?;
        let term = |name| {
            let distortion = self.parts.get("Distortion");
            let term = distortion.map_or(Ok(None), |distortion| distortion.number(name));
            term.map(Option::unwrap_or_default)
        };
        let [k1, k2, k3] = [term("K1")?, term("K2")?, term("K3")?];
        let [p1, p2] = [term("P1")?, term("P2")?];
        let fy = focal * self.number("AspectRatio")?.unwrap_or(1.0);
        Ok(vec![focal, fy, cx, cy, k1, k2, p2, p1, k3, 0.0, 0.0, 0.0])
    }

    /// `longer`: side of the image, pixels; it is as long as SensorSize.
    fn focal_px(&self, longer: f64) -> Result<f64, Fault> {
        if let Some(focal) = self.number("FocalLengthPixels")? {
            return Ok(focal);
        }
        let [focal_mm] = self.part("FocalLength")?.numbers()?;
        Ok(match self.number("PixelSize")? {
            Some(pixel_mm) => focal_mm / pixel_mm,
            None => focal_mm * longer / self.part("SensorSize")?.numbers::<1>()?[0],
        })
    }

    fn refuse_skew(&self, height: f64, focal: f64) -> Result<(), Fault> {
        let skew = self.number("Skew")?.unwrap_or_default();
        // Half a pixel is less than other errors of a camera.
        if (skew * height / 2.0 / focal).abs() <= 0.5 {
            return Ok(());
        }
        let what = format!("a camera with skew ({skew}), which COLMAP's models do not have");
        let hint = "export undistorted photos with their block";
        Err(Fault::new("", self.at, Problem::Unsupported { what, hint }))
    }
}

fn principal_point(point: &Element) -> Result<[f64; 2], Fault> {
    if point.child("xmm").is_some() {
        let what = "the principal point is in millimetres".into();
        let hint = "export the block with the principal point in pixels";
        return Err(Fault::new(
            "",
            point.at(),
            Problem::Unsupported { what, hint },
        ));
    }
    Ok(shift(point.required(["x", "y"])?))
}

/// The camera's axes as columns, in COLMAP's (x right, y down), from a name such as `XRightYUp`.
fn axes(orientation: &str) -> Option<Matrix3<f64>> {
    let (x, y) = orientation.strip_prefix('X')?.split_once('Y')?;
    let axis = |name: &str| match name {
        "Right" => Some(Vector3::x()),
        "Left" => Some(-Vector3::x()),
        "Down" => Some(Vector3::y()),
        "Up" => Some(-Vector3::y()),
        _ => None,
    };
    let (x, y) = (axis(x)?, axis(y)?);
    (x.dot(&y) == 0.0).then(|| Matrix3::from_columns(&[x, y, x.cross(&y)]))
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;

    use super::*;

    fn file(srs: &str, group: &str) -> String {
        let rotation = |m: [i32; 9]| {
            let name = |i: usize| format!("M_{}{}", i / 3, i % 3);
            m.iter()
                .enumerate()
                .map(|(i, v)| format!("<{0}>{v}</{0}>", name(i)))
                .collect::<String>()
        };
        let photo = |id: u32, path: &str, m, x: f64| {
            format!(
                "<Photo><Id>{id}</Id><ImagePath>{path}</ImagePath><Pose><Rotation>{}</Rotation><Center><x>{x}</x><y>0</y><z>10</z></Center></Pose></Photo>",
                rotation(m)
            )
        };
        format!(
            "<?xml version=\"1.0\" encoding=\"utf-8\"?>\n<BlocksExchange version=\"3.2\"><SpatialReferenceSystems><SRS><Id>0</Id>\
             <Definition>{srs}</Definition></SRS></SpatialReferenceSystems><Block><Name>b</Name><SRSId>0</SRSId><Photogroups><Photogroup>\
             <ImageDimensions><Width>200</Width><Height>100</Height></ImageDimensions>{group}{}{}<Photo><Id>9</Id><ImagePath>D:\\p\\c.jpg</ImagePath>\
             </Photo></Photogroup></Photogroups><TiePoints><TiePoint><Position><x>1</x><y>2</y><z>0</z></Position><Color><Red>1</Red><Green>0.5</Green>\
             <Blue>0</Blue></Color><Measurement><PhotoId>7</PhotoId><x>10</x><y>20</y></Measurement><Measurement><PhotoId>9</PhotoId><x>1</x><y>2</y>\
             </Measurement></TiePoint></TiePoints></Block></BlocksExchange>",
            photo(7, "D:\\p\\a.jpg", [1, 0, 0, 0, -1, 0, 0, 0, -1], 0.0),
            photo(8, "D:\\p\\b.jpg", [1, 0, 0, 0, -1, 0, 0, 0, -1], 5.0),
        )
    }

    #[test]
    fn a_block_has_cameras_paths_of_windows_and_tracks() {
        let group = "<FocalLength>20</FocalLength><SensorSize>40</SensorSize><AspectRatio>1.5</AspectRatio><PrincipalPoint><x>99</x><y>51</y>\
                     </PrincipalPoint><Distortion><K1>0.1</K1><P1>0.01</P1><P2>0.02</P2></Distortion>";
        let mut foreign = read(file("EPSG:2154", group).as_bytes()).unwrap();
        foreign.shorten_names();
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
            100.0, 150.0, 99.5, 51.5, 0.1, 0.0, 0.02, 0.01, 0.0, 0.0, 0.0, 0.0,
        ];
        assert_eq!(scene.cameras[0].params(), expected);
        assert_eq!(
            (scene.track_pixels[0], scene.observations()),
            ([10.5, 20.5], 1)
        );
        let seen = scene.views[1]
            .cam_from_world
            .camera_from_world(&Point3::new(6.0, 2.0, 0.0));
        assert!(
            (seen - Point3::new(1.0, -2.0, 10.0)).norm() < 1e-12,
            "{seen}"
        );
    }

    #[test]
    fn axes_of_the_camera_are_turned_to_colmaps() {
        // The same rotation in a camera whose y is up: what was below is above, and what was before
        // is behind.
        let group = "<FocalLengthPixels>100</FocalLengthPixels><CameraOrientation>XRightYUp</CameraOrientation>";
        let scene = read(file("Local", group).as_bytes())
            .unwrap()
            .scene()
            .unwrap();
        let seen = scene.views[0]
            .cam_from_world
            .camera_from_world(&Point3::new(1.0, 2.0, 0.0));
        assert!(
            (seen - Point3::new(1.0, 2.0, -10.0)).norm() < 1e-12,
            "{seen}"
        );
        assert_eq!(scene.cameras[0].params(), [100.0, 100.0, 100.0, 50.0]);
        assert_eq!(axes("XDownYLeft").unwrap() * Vector3::x(), Vector3::y());
        assert!(axes("XRightYLeft").is_none() && axes("YUp").is_none());
    }

    #[test]
    fn what_cannot_be_read_is_named() {
        let focal = "<FocalLengthPixels>100</FocalLengthPixels>";
        let said = |text: &str| read(text.as_bytes()).unwrap_err().to_string();
        assert!(said(&file("EPSG:4326+5773", focal)).contains("longitude"));
        assert!(
            said(&file(
                "",
                &format!("{focal}<CameraModelType>Fisheye</CameraModelType>")
            ))
            .contains("Fisheye")
        );
        assert!(said(&file("", &format!("{focal}<Skew>9</Skew>"))).contains("skew"));
        assert!(said(&file("", "<FocalLength>5</FocalLength>")).contains("SensorSize"));
        assert!(
            said(&file(
                "",
                &format!("{focal}<CameraOrientation>Up</CameraOrientation>")
            ))
            .contains("CameraOrientation")
        );
        assert!(said("<document/>").contains("BlocksExchange"));
        let whole = file("", focal);
        (1..whole.len())
            .step_by(7)
            .for_each(|end| _ = read(&whole.as_bytes()[..end]).unwrap_err());
        assert!(said(&whole.replace("<x>10</x>", "")).contains("x"));
    }
}
