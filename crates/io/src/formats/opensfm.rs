//! OpenSfM's `reconstruction.json` with its `tracks.csv` (also OpenDroneMap's).
//!
//! Poses are world-to-camera angle-axis rotations and translations; axes as in COLMAP. Pixels are
//! normalised: `(u - w/2) / max(w, h)` with COLMAP's u; focal lengths and principal points have the
//! same unit. Of several reconstructions the one with the most shots is read, ties by position in
//! the file.

use std::{cmp::Reverse, collections::HashMap, fmt};

use nalgebra::{Rotation3, UnitQuaternion, Vector3};
use serde::{
    Deserialize, Deserializer,
    de::{SeqAccess, Visitor},
};
use viewrank_core::model::{
    camera::{Camera, CameraModel},
    georeference::{Geodetic, Georeference},
    scene::{ModelWarning, WarningKind},
};

use super::{
    Fault, MOST_IMAGES, Place, Problem,
    colmap::StoredPose,
    foreign::{ForeignModel, brown, camera, fault_in, json, unexpected},
    words::parse,
};
use crate::bounded;

/// The reconstructions of a file, with no more cameras and shots together than a model may have.
#[derive(Default)]
struct Reconstructions {
    /// The number of shots of each.
    sizes: Vec<usize>,
    /// The first with the most shots. Others are not kept: they may have as many points.
    largest: Option<Reconstruction>,
}

impl<'de> Deserialize<'de> for Reconstructions {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct All;
        impl<'de> Visitor<'de> for All {
            type Value = Reconstructions;
            fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
                f.write_str("a list of reconstructions")
            }
            fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Self::Value, A::Error> {
                let (mut all, mut images) = (Reconstructions::default(), 0);
                while let Some(one) = list.next_element::<Reconstruction>()? {
                    images += one.cameras.len().max(one.shots.len());
                    if images > MOST_IMAGES {
                        return Err(bounded::too_many(MOST_IMAGES));
                    }
                    all.add(one);
                }
                Ok(all)
            }
        }
        deserializer.deserialize_seq(All)
    }
}

impl Reconstructions {
    fn add(&mut self, one: Reconstruction) {
        self.sizes.push(one.shots.len());
        let largest = self.largest.as_ref();
        if largest.is_none_or(|largest| largest.shots.len() < one.shots.len()) {
            self.largest = Some(one);
        }
    }
}

#[derive(Deserialize)]
struct Reconstruction {
    #[serde(deserialize_with = "bounded::map::<_, _, MOST_IMAGES>")]
    cameras: JsonMap<OpenSfmCamera>,
    #[serde(deserialize_with = "bounded::map::<_, _, MOST_IMAGES>")]
    shots: JsonMap<Shot>,
    #[serde(default)]
    points: JsonMap<Point>,
    reference_lla: Option<Reference>,
}

/// Origin of the coordinates, degrees and metres.
#[derive(Deserialize)]
struct Reference {
    latitude: f64,
    longitude: f64,
    altitude: f64,
}

impl Reference {
    fn georeference(&self) -> Georeference {
        Georeference::east_north_up(Geodetic {
            longitude: self.longitude,
            latitude: self.latitude,
            height: self.altitude,
        })
    }
}

/// A JSON object as a map.
type JsonMap<T> = std::collections::BTreeMap<String, T>;

#[derive(Deserialize)]
#[serde(default)]
struct OpenSfmCamera {
    projection_type: String,
    width: u64,
    height: u64,
    focal: f64,
    focal_x: Option<f64>,
    focal_y: Option<f64>,
    c_x: f64,
    c_y: f64,
    k1: f64,
    k2: f64,
    k3: f64,
    k4: f64,
    k5: f64,
    k6: f64,
    p1: f64,
    p2: f64,
}

impl Default for OpenSfmCamera {
    fn default() -> Self {
        let [focal, c_x, c_y, k1, k2, k3, k4, k5, k6, p1, p2] = [0.0; 11];
        let projection_type = "perspective".into();
        let (focal_x, focal_y) = (None, None);
        Self {
            projection_type,
            width: 0,
            height: 0,
            focal,
            focal_x,
            focal_y,
            c_x,
            c_y,
            k1,
            k2,
            k3,
            k4,
            k5,
            k6,
            p1,
            p2,
        }
    }
}

#[derive(Deserialize)]
struct Shot {
    rotation: [f64; 3],
    translation: [f64; 3],
    camera: String,
}

impl Shot {
    fn pose(&self) -> StoredPose {
        let rotation = Rotation3::new(Vector3::from(self.rotation));
        let q = UnitQuaternion::from_rotation_matrix(&rotation);
        StoredPose {
            quaternion: [q.w, q.i, q.j, q.k],
            translation: self.translation,
        }
    }
}

#[derive(Deserialize)]
struct Point {
    coordinates: [f64; 3],
    #[serde(default)]
    color: [f64; 3],
}

/// A shot in the model.
struct PlacedShot<'a> {
    /// Index of the image.
    image: usize,
    camera: &'a OpenSfmCamera,
}

/// By name.
type PlacedShots<'a> = HashMap<&'a [u8], PlacedShot<'a>>;

/// Observations of each point, in the order of their names: index of the image, and pixel.
type Observations = Vec<Vec<(usize, [f64; 2])>>;

/// Reads the reconstruction and the tracks; without tracks, points have no observations.
pub fn read(reconstruction: &[u8], tracks: Option<&[u8]>) -> Result<ForeignModel, Fault> {
    let Reconstructions { sizes, largest } = json(reconstruction)?;
    let Some(largest) = largest else {
        return Ok(ForeignModel::default());
    };
    let origin = largest.reference_lla.as_ref();
    let mut foreign = ForeignModel {
        georeference: origin.map(Reference::georeference),
        ..ForeignModel::default()
    };
    warn_of_smaller(&mut foreign, sizes);
    let shots = largest.add_shots(&mut foreign)?;
    let observations = match tracks {
        Some(tracks) => observations(tracks, &shots, &largest.points)?,
        None => Vec::new(),
    };
    add_points(&mut foreign, &largest.points, &observations);
    if tracks.is_none() && !largest.points.is_empty() {
        let text = "points have no observations: tracks.csv is missing next to the reconstruction";
        let cure = "copy tracks.csv of the OpenSfM project beside the reconstruction";
        let warning = ModelWarning::new(WarningKind::Damaged, text).with_cure(cure);
        foreign.model.warnings.push(warning);
    }
    Ok(foreign)
}

/// Reconstructions that a warning names.
const NAMED: usize = 5;

/// Warns of the reconstructions that are not read. `sizes`: the shots of each.
fn warn_of_smaller(foreign: &mut ForeignModel, mut sizes: Vec<usize>) {
    sizes.sort_unstable_by_key(|size| Reverse(*size));
    if let [largest, others @ ..] = &sizes[..]
        && !others.is_empty()
    {
        let named: Vec<String> = others.iter().take(NAMED).map(usize::to_string).collect();
        let more = if others.len() > NAMED { ", ..." } else { "" };
        let text = format!(
            "of {} reconstructions only the one with the most shots ({largest}) is read, not those with {}{more}",
            sizes.len(),
            named.join(", ")
        );
        foreign.warn(WarningKind::OtherParts, text);
    }
}

impl Reconstruction {
    /// Adds cameras and shots.
    fn add_shots(&self, foreign: &mut ForeignModel) -> Result<PlacedShots<'_>, Fault> {
        let mut cameras = HashMap::new();
        for (id, (name, camera)) in (1..).zip(&self.cameras) {
            cameras.insert(name, (id, camera));
            foreign.model.cameras.push(camera.intrinsics(id, name)?);
        }
        let mut placed = HashMap::new();
        for (image, (name, shot)) in self.shots.iter().enumerate() {
            let unknown = || {
                let problem = Problem::Content(format!("unknown camera {:?}", shot.camera));
                fault_in(problem, || format!("shot {name:?}"))
            };
            let &(camera_id, camera) = cameras.get(&shot.camera).ok_or_else(unknown)?;
            // As bytes, so that the rows of tracks need not be text.
            placed.insert(name.as_bytes(), PlacedShot { image, camera });
            let id = image as u32 + 1;
            foreign.add_image(id, name.clone(), camera_id, shot.pose(), Place::File);
        }
        Ok(placed)
    }
}

/// Point ids: those of the file if all are numbers, otherwise 1, 2, ...
fn add_points(foreign: &mut ForeignModel, points: &JsonMap<Point>, observations: &Observations) {
    let ids: Option<Vec<u64>> = points.keys().map(|id| id.parse().ok()).collect();
    let mut order: Vec<_> = points
        .values()
        .enumerate()
        .map(|(n, p)| (ids.as_ref().map_or(n as u64 + 1, |ids| ids[n]), n, p))
        .collect();
    // The map has the ids as text, 10 before 2.
    order.sort_by_key(|&(id, ..)| id);
    for (id, n, point) in order {
        let colour = point.color.map(|c| c.round().clamp(0.0, 255.0) as u8);
        let track = observations.get(n).map_or(&[][..], Vec::as_slice);
        foreign.add_point(
            id,
            point.coordinates,
            colour,
            track.iter().copied(),
            Place::File,
        );
    }
}

/// A row of the tracks: `shot, track, feature, x, y, ...`, separated by tabs.
struct Row<'a> {
    shot: &'a [u8],
    track: &'a [u8],
    normalised: [f64; 2],
}

impl<'a> Row<'a> {
    fn read(line: &'a [u8], at: Place) -> Result<Self, Fault> {
        Self::parse(line).ok_or_else(|| {
            let problem = unexpected(line, "shot, track, feature, x, y separated by tabs");
            Fault::new("tracks", at, problem)
        })
    }

    fn parse(line: &'a [u8]) -> Option<Self> {
        let mut fields = line.split(|&b| b == b'\t');
        let (shot, track, _feature) = (fields.next()?, fields.next()?, fields.next()?);
        let [x, y] = [fields.next()?, fields.next()?].map(parse);
        Some(Self {
            shot,
            track,
            normalised: [x.ok()?, y.ok()?],
        })
    }
}

/// Parses the tracks. Most may be none of the points.
fn observations(
    tracks: &[u8],
    shots: &PlacedShots,
    points: &JsonMap<Point>,
) -> Result<Observations, Fault> {
    let mut of_points = vec![Vec::new(); points.len()];
    // In the order of the map, in which `add_points` counts them.
    let point_of: HashMap<&[u8], usize> = points.keys().map(String::as_bytes).zip(0..).collect();
    for (n, line) in tracks.split(|&b| b == b'\n').enumerate() {
        let line = line.strip_suffix(b"\r").unwrap_or(line);
        if line.is_empty() || line.starts_with(b"OPENSFM_TRACKS_VERSION") {
            continue;
        }
        let at = Place::Line(n as u64 + 1);
        let row = Row::read(line, at)?;
        // The file has the tracks of all images, also of those in other reconstructions or none.
        if let (Some(shot), Some(&point)) = (shots.get(row.shot), point_of.get(row.track)) {
            of_points[point].push((shot.image, shot.camera.pixel(row.normalised)));
        }
    }
    Ok(of_points)
}

impl OpenSfmCamera {
    /// Width and height, and the longer of both: the unit of normalised coordinates.
    fn size(&self) -> [f64; 3] {
        let (w, h) = (self.width as f64, self.height as f64);
        [w, h, w.max(h)]
    }

    fn pixel(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let [w, h, longer] = self.size();
        [x * longer + w / 2.0, y * longer + h / 2.0]
    }

    fn intrinsics(&self, id: u32, name: &str) -> Result<Camera, Fault> {
        let what = || format!("camera {name:?}");
        let (model, params) = self.model().ok_or_else(|| {
            let problem = Problem::CameraModel(format!("{} (OpenSfM)", self.projection_type));
            fault_in(problem, what)
        })?;
        camera(
            Camera::new(id, model, self.width, self.height, params),
            what,
        )
    }

    /// COLMAP's model, and its parameters.
    fn model(&self) -> Option<(CameraModel, Vec<f64>)> {
        let [k1, k2, k3, k4] = [self.k1, self.k2, self.k3, self.k4];
        let [p1, p2] = [self.p1, self.p2];
        let pinhole = self.pinhole_part();
        let [fx, _, cx, cy] = pinhole;
        let with = |distortion: &[f64]| [&pinhole[..], distortion].concat();
        Some(match self.projection_type.as_str() {
            "perspective" => (CameraModel::Radial, vec![fx, cx, cy, k1, k2]),
            "radial" | "simple_radial" => (CameraModel::OpenCv, with(&[k1, k2, 0.0, 0.0])),
            "brown" => brown(pinhole, [k1, k2, k3], [p1, p2]),
            "fisheye" => (CameraModel::RadialFisheye, vec![fx, cx, cy, k1, k2]),
            "fisheye_opencv" => (CameraModel::OpenCvFisheye, with(&[k1, k2, k3, k4])),
            "fisheye62" => self.fisheye62()?,
            "spherical" | "equirectangular" => {
                let [w, h, _] = self.size();
                (CameraModel::Equirectangular, vec![w, h])
            }
            _ => return None,
        })
    }

    /// fx, fy, cx, cy, pixels.
    fn pinhole_part(&self) -> [f64; 4] {
        let [_, _, longer] = self.size();
        let fx = self.focal_x.unwrap_or(self.focal);
        let fy = self.focal_y.or(self.focal_x).unwrap_or(self.focal);
        let [cx, cy] = self.pixel([self.c_x, self.c_y]);
        [fx * longer, fy * longer, cx, cy]
    }

    /// Tangential plus radial distortion, for which COLMAP has four radial coefficients, or six
    /// without the tangential ones.
    fn fisheye62(&self) -> Option<(CameraModel, Vec<f64>)> {
        let pinhole = self.pinhole_part();
        let [k1, k2, k3, k4] = [self.k1, self.k2, self.k3, self.k4];
        let [k5, k6, p1, p2] = [self.k5, self.k6, self.p1, self.p2];
        if k5 == 0.0 && k6 == 0.0 {
            let distortion = [k1, k2, p1, p2, k3, k4, 0.0, 0.0];
            let params = [&pinhole[..], &distortion].concat();
            return Some((CameraModel::ThinPrismFisheye, params));
        }
        let mut params = [&pinhole[..], &[k1, k2, k3, k4, k5, k6]].concat();
        // COLMAP's model has tangential and thin-prism terms, too.
        params.resize(16, 0.0);
        (p1 == 0.0 && p2 == 0.0).then_some((CameraModel::RadTanThinPrismFisheye, params))
    }
}
