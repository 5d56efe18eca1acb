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

mod group;

use std::collections::HashMap;

use nalgebra::{Matrix3, Vector3};
use viewrank_core::model::georeference::{Geodetic, Georeference, Zone};

use self::group::Group;
use super::{
    Fault, Problem, check_images,
    colmap::StoredPose,
    foreign::{ForeignModel, largest_component, pose_with_centre, shift},
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
                // After the exchange, this is the one that was the largest before.
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
    place: Option<Georeference>,
}

/// Reference systems by id.
type Systems = HashMap<String, System>;

impl System {
    fn read(definition: &str) -> Self {
        let plain = definition.trim().to_ascii_uppercase();
        // The code of a vertical system may follow (EPSG:4326+5773).
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
            place: local_frame(&plain).or_else(|| projection(definition)),
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
        Err(Problem::Unsupported { what, hint }.at(id.at()))
    }
}

/// Metres east, north and up of a latitude and a longitude on the ellipsoid ("ENU:30.17,-98.08").
fn local_frame(definition: &str) -> Option<Georeference> {
    let numbers = definition.strip_prefix("ENU:")?.split(',');
    let numbers: Option<Vec<f64>> = numbers.map(|number| number.trim().parse().ok()).collect();
    let (latitude, longitude, height) = match numbers?[..] {
        [latitude, longitude] => (latitude, longitude, 0.0),
        [latitude, longitude, height] => (latitude, longitude, height),
        _ => return None,
    };
    let is_on_earth = latitude.abs() <= 90.0 && longitude.abs() <= 180.0 && height.is_finite();
    is_on_earth.then(|| {
        Georeference::east_north_up(Geodetic {
            longitude,
            latitude,
            height,
        })
    })
}

fn projection(definition: &str) -> Option<Georeference> {
    let zone = Zone::of_reference_system(definition)?;
    let offset = [0.0; 2];
    Some(Georeference::Utm { zone, offset })
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
                "SRSId" => self.read_system(&xml.whole(entered)?, systems)?,
                "Photogroups" => self.read_groups(xml, systems)?,
                "TiePoints" => self.read_tie_points(xml, systems)?,
                _ => xml.skip()?,
            }
        }
        Ok(())
    }

    fn read_system(&mut self, id: &Element, systems: &Systems) -> Result<(), Fault> {
        System::check(systems, id)?;
        let system = systems.get(id.text());
        self.foreign.georeference = system.and_then(|system| system.place);
        Ok(())
    }

    fn read_groups(&mut self, xml: &mut Xml, systems: &Systems) -> Result<(), Fault> {
        while let Some(entered) = xml.enter()? {
            if entered.name == "Photogroup" {
                self.read_group(xml, &entered, systems)?;
            } else {
                xml.skip()?;
            }
        }
        Ok(())
    }

    fn read_tie_points(&mut self, xml: &mut Xml, systems: &Systems) -> Result<(), Fault> {
        while let Some(entered) = xml.enter()? {
            let point = xml.whole(entered)?;
            match &*point.name {
                "TiePoint" => self.add_tie_point(&point)?,
                "SRSId" => System::check(systems, &point)?,
                _ => {}
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
        entered: &Element,
        systems: &Systems,
    ) -> Result<(), Fault> {
        self.groups += 1;
        check_images(self.groups as usize)?;
        let mut group = Group::new(self.groups, entered.at());
        while let Some(entered) = xml.enter()? {
            match &*entered.name {
                "Photo" => {
                    let count = self.images() + self.foreign.unregistered.len() + 1;
                    check_images(count)?;
                    self.add_photo(&xml.whole(entered)?, &mut group)?;
                }
                "SRSId" => System::check(systems, &xml.whole(entered)?)?,
                name if group.wants(name) => group.add(xml.whole(entered)?),
                _ => xml.skip()?,
            }
        }
        Ok(())
    }

    fn add_photo(&mut self, photo: &Element, group: &mut Group) -> Result<(), Fault> {
        let path = photo.child("ImagePath").map_or("", Element::text);
        let name = path.replace('\\', "/");
        let Some((rotation, centre)) = rotation_and_centre(photo) else {
            self.foreign.unregistered.push(name);
            return Ok(());
        };
        // Not before a photo has a pose: the faults of a camera that none needs do not matter.
        let axes = group.axes(&mut self.foreign.model.cameras)?;
        let pose = pose_of(rotation, centre, axes);
        let pose = pose.map_err(|fault| fault.in_record(|| format!("photo {path:?}")))?;
        let position = self.images();
        if let Some(id) = photo.child("Id") {
            self.photos.insert(id.text().to_owned(), position);
        }
        let id = position as u32 + 1;
        self.foreign
            .add_image(id, name, group.id(), pose, photo.at());
        self.components.push(component_of(photo));
        Ok(())
    }

    fn add_tie_point(&mut self, point: &Element) -> Result<(), Fault> {
        let xyz = point.required_child("Position")?;
        let xyz = xyz.required(["x", "y", "z"])?;
        let colour = point.child("Color").map_or(Ok([255; 3]), colour)?;
        let mut track: Vec<(usize, [f64; 2])> = Vec::new();
        for measured in point.children("Measurement") {
            let id = measured.required_child("PhotoId")?;
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

/// The colour in parts from 0 to 1.
fn colour(element: &Element) -> Result<[u8; 3], Fault> {
    let mut colour = [0; 3];
    for (to, name) in colour.iter_mut().zip(["Red", "Green", "Blue"]) {
        let part = element.number(name)?.unwrap_or(1.0);
        *to = (part * 255.0).round().clamp(0.0, 255.0) as u8;
    }
    Ok(colour)
}

/// The id of a photo's component; empty without one.
fn component_of(photo: &Element) -> String {
    photo
        .child("Component")
        .map_or("", Element::text)
        .to_owned()
}

/// The elements of a photo's pose, if it has one.
fn rotation_and_centre(photo: &Element) -> Option<(&Element, &Element)> {
    let pose = photo.child("Pose")?;
    let rotation = pose.child("Rotation")?;
    rotation.child("M_00")?;
    Some((rotation, pose.child("Center")?))
}

fn pose_of(rotation: &Element, centre: &Element, axes: Matrix3<f64>) -> Result<StoredPose, Fault> {
    let names = [
        "M_00", "M_01", "M_02", "M_10", "M_11", "M_12", "M_20", "M_21", "M_22",
    ];
    let matrix = Matrix3::from_row_slice(&rotation.required(names)?);
    let centre = Vector3::from(centre.required(["x", "y", "z"])?);
    pose_with_centre(axes * matrix, centre).map_err(|problem| problem.at(rotation.at()))
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;

    use super::{group::axes, *};

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
