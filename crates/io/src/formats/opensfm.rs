//! OpenSfM's `reconstruction.json` with its `tracks.csv` (also OpenDroneMap's).
//!
//! Poses are world-to-camera angle-axis rotations and translations; axes as in COLMAP. Pixels are
//! normalised: `(u - w/2) / max(w, h)` with COLMAP's u; focal lengths and principal points have the
//! same unit. Of several reconstructions the one with the most shots is read, ties by position in
//! the file.

use std::{collections::HashMap, fmt};

use nalgebra::{Rotation3, UnitQuaternion, Vector3};
use serde::{
    Deserialize, Deserializer,
    de::{SeqAccess, Visitor},
};
use viewrank_core::model::{
    camera::{Camera, CameraModel},
    georeference::{Geodetic, Georeference},
    scene::WarningKind,
};

use super::{
    Fault, MOST_IMAGES, Place, Problem,
    colmap::StoredPose,
    foreign::{ForeignModel, camera, json},
    words::parse,
};
use crate::bounded;

/// The reconstructions of a file, with no more cameras and shots together than a model may have.
struct Reconstructions(Vec<Reconstruction>);

impl<'de> Deserialize<'de> for Reconstructions {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct All;
        impl<'de> Visitor<'de> for All {
            type Value = Vec<Reconstruction>;
            fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
                f.write_str("a list of reconstructions")
            }
            fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Self::Value, A::Error> {
                let (mut all, mut images) = (Vec::<Reconstruction>::new(), 0);
                while let Some(one) = list.next_element::<Reconstruction>()? {
                    images += one.cameras.len().max(one.shots.len());
                    if images > MOST_IMAGES {
                        return Err(bounded::too_many(MOST_IMAGES));
                    }
                    all.push(one);
                }
                Ok(all)
            }
        }
        deserializer.deserialize_seq(All).map(Self)
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

#[derive(Deserialize)]
struct Point {
    coordinates: [f64; 3],
    #[serde(default)]
    color: [f64; 3],
}

/// Observations of each point, in the order of their names: index of the image, and pixel.
type Observations = Vec<Vec<(usize, [f64; 2])>>;

/// Reads the reconstruction and the tracks; without tracks, points have no observations.
pub fn read(reconstruction: &[u8], tracks: Option<&[u8]>) -> Result<ForeignModel, Fault> {
    let Reconstructions(reconstructions) = json(reconstruction)?;
    let all = reconstructions.len();
    let largest = reconstructions
        .into_iter()
        .rev()
        .max_by_key(|r| r.shots.len());
    let mut foreign = ForeignModel::default();
    let Some(largest) = largest else {
        return Ok(foreign);
    };
    foreign.georeference = largest.reference_lla.as_ref().map(|origin| {
        Georeference::east_north_up(Geodetic {
            longitude: origin.longitude,
            latitude: origin.latitude,
            height: origin.altitude,
        })
    });
    if all > 1 {
        let shots = largest.shots.len();
        let text =
            format!("of {all} reconstructions only the one with the most shots ({shots}) is read");
        foreign.warn(WarningKind::OtherModels, text);
    }
    let mut camera_ids = HashMap::new();
    for (n, (name, camera)) in largest.cameras.iter().enumerate() {
        camera_ids.insert(name.as_str(), (n as u32 + 1, camera));
        foreign
            .model
            .cameras
            .push(intrinsics(n as u32 + 1, name, camera)?);
    }
    let mut shots = HashMap::new();
    for (n, (name, shot)) in largest.shots.iter().enumerate() {
        let fault =
            |problem| Fault::new("", Place::File, problem).in_record(|| format!("shot {name:?}"));
        let unknown = || fault(Problem::Json(format!("unknown camera {:?}", shot.camera)));
        let &(camera_id, camera) = camera_ids.get(shot.camera.as_str()).ok_or_else(unknown)?;
        let rotation = Rotation3::new(Vector3::from(shot.rotation));
        let q = UnitQuaternion::from_rotation_matrix(&rotation);
        let pose = StoredPose {
            quaternion: [q.w, q.i, q.j, q.k],
            translation: shot.translation,
        };
        shots.insert(name.as_bytes(), (foreign.model.images.len(), camera));
        foreign.add_image(n as u32 + 1, name.clone(), camera_id, pose, Place::File);
    }
    let observations = tracks.map_or(Ok(Vec::new()), |tracks| {
        observations(tracks, &shots, &largest.points)
    })?;
    add_points(&mut foreign, &largest.points, &observations);
    if tracks.is_none() && !largest.points.is_empty() {
        let text = "points have no observations: tracks.csv is missing next to the reconstruction";
        foreign.warn(WarningKind::Damaged, text);
    }
    Ok(foreign)
}

/// Point ids: those of the file if all are numbers, otherwise 1, 2, ...
fn add_points(foreign: &mut ForeignModel, points: &JsonMap<Point>, observations: &Observations) {
    let ids: Option<Vec<u64>> = points.keys().map(|id| id.parse().ok()).collect();
    let mut order: Vec<_> = points
        .values()
        .enumerate()
        .map(|(n, p)| (ids.as_ref().map_or(n as u64 + 1, |ids| ids[n]), n, p))
        .collect();
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

/// Parses rows of `shot, track, feature, x, y, ...`, separated by tabs. Most tracks may be none of
/// the points.
fn observations(
    tracks: &[u8],
    shots: &HashMap<&[u8], (usize, &OpenSfmCamera)>,
    points: &JsonMap<Point>,
) -> Result<Observations, Fault> {
    let mut of_points = vec![Vec::new(); points.len()];
    let point_of: HashMap<&[u8], usize> = points.keys().map(String::as_bytes).zip(0..).collect();
    for (n, line) in tracks.split(|&b| b == b'\n').enumerate() {
        let line = line.strip_suffix(b"\r").unwrap_or(line);
        if line.is_empty() || line.starts_with(b"OPENSFM_TRACKS_VERSION") {
            continue;
        }
        let mut fields = line.split(|&b| b == b'\t');
        let mut row = || {
            let (shot, track, _feature) = (fields.next()?, fields.next()?, fields.next()?);
            let [x, y] = [fields.next()?, fields.next()?].map(parse::<f64>);
            Some((shot, track, [x.ok()?, y.ok()?]))
        };
        let Some((shot, track, [x, y])) = row() else {
            let found = String::from_utf8_lossy(&line[..line.len().min(40)]).into_owned();
            let problem = Problem::Syntax {
                expected: "shot, track, feature, x, y separated by tabs",
                found,
            };
            return Err(Fault::new("tracks", Place::Line(n as u64 + 1), problem));
        };
        if let (Some(&(image, camera)), Some(&point)) = (shots.get(shot), point_of.get(track)) {
            let (w, h) = (camera.width as f64, camera.height as f64);
            let size = w.max(h);
            of_points[point].push((image, [x * size + w / 2.0, y * size + h / 2.0]));
        }
    }
    Ok(of_points)
}

fn intrinsics(id: u32, name: &str, c: &OpenSfmCamera) -> Result<Camera, Fault> {
    let (w, h) = (c.width as f64, c.height as f64);
    let size = w.max(h);
    let (fx, fy) = (
        c.focal_x.unwrap_or(c.focal) * size,
        c.focal_y.or(c.focal_x).unwrap_or(c.focal) * size,
    );
    let (cx, cy) = (w / 2.0 + c.c_x * size, h / 2.0 + c.c_y * size);
    let (model, params) = match c.projection_type.as_str() {
        "perspective" => (CameraModel::Radial, vec![fx, cx, cy, c.k1, c.k2]),
        "radial" | "simple_radial" => (
            CameraModel::OpenCv,
            vec![fx, fy, cx, cy, c.k1, c.k2, 0.0, 0.0],
        ),
        "brown" => (
            CameraModel::FullOpenCv,
            vec![fx, fy, cx, cy, c.k1, c.k2, c.p1, c.p2, c.k3, 0.0, 0.0, 0.0],
        ),
        "fisheye" => (CameraModel::RadialFisheye, vec![fx, cx, cy, c.k1, c.k2]),
        "fisheye_opencv" => (
            CameraModel::OpenCvFisheye,
            vec![fx, fy, cx, cy, c.k1, c.k2, c.k3, c.k4],
        ),
        // Tangential plus radial distortion, for which COLMAP has four radial coefficients.
        "fisheye62" if c.k5 == 0.0 && c.k6 == 0.0 => (
            CameraModel::ThinPrismFisheye,
            vec![fx, fy, cx, cy, c.k1, c.k2, c.p1, c.p2, c.k3, c.k4, 0.0, 0.0],
        ),
        "fisheye62" if c.p1 == 0.0 && c.p2 == 0.0 => {
            let mut params = vec![fx, fy, cx, cy, c.k1, c.k2, c.k3, c.k4, c.k5, c.k6];
            params.resize(16, 0.0);
            (CameraModel::RadTanThinPrismFisheye, params)
        }
        "spherical" | "equirectangular" => (CameraModel::Equirectangular, vec![w, h]),
        other => {
            let problem = Problem::CameraModel(format!("{other} (OpenSfM)"));
            return Err(
                Fault::new("", Place::File, problem).in_record(|| format!("camera {name:?}"))
            );
        }
    };
    camera(Camera::new(id, model, c.width, c.height, params), || {
        format!("camera {name:?}")
    })
}
