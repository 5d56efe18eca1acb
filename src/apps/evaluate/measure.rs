//! Compares a finished depth map with its reference: the pixels that are right, and the share of
//! each triangle that they show (method 8).

use super::MapSize;
use crate::{
    io::depthmaps::DepthMap,
    method::{
        fulfilment::Model,
        pilot::{Part, Places},
        visibility::{NOTHING, front},
    },
    model::{
        camera::Camera,
        scene::{Scene, ViewIndex},
    },
};

/// Largest error of a right measurement, in multiples of a_d.
const RIGHT_WITHIN: f64 = 3.0;
/// Relative difference of a depth to that of a place of the pilot.
const PLACE_WITHIN: f64 = 0.02;
/// Part of that difference within which fusion is expected to keep the depth, as it is of the
/// pilot's own: 1 %.
const KEPT_WITHIN: f64 = 0.5;
/// Part of the depths beyond that which fusion keeps: it compares maps with each other, not with
/// thumbnails. By the clouds of eight sets and three programs.
const KEPT_BEYOND: f32 = 0.35;
/// Relative difference of reference depths beyond which they belong to two surfaces and are not
/// interpolated.
const SAME_SURFACE: f64 = 0.02;
/// Pixels whose frontmost triangles are drawn at once, of 12 bytes each.
const BAND_PIXELS: u32 = 1 << 23;

/// Quality of the depth map of a key view, or of several together.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
pub struct Quality {
    /// Pixels with a depth.
    pub measured: u64,
    /// Pixels with a reference depth; all pixels that show the surface where there is no reference.
    pub reference: u64,
    /// Pixels with both.
    pub both: u64,
    /// Pixels with both that agree within 3 a_d.
    pub right: u64,
    /// Sum of the squared errors of the right pixels, square scene units.
    pub squares: f64,
}

impl Quality {
    /// Returns the share of the reference's pixels that are right.
    pub fn completeness(&self) -> f64 {
        share(self.right, self.reference)
    }

    /// Returns the share of the pixels with both depths that are wrong.
    pub fn outliers(&self) -> f64 {
        share(self.both - self.right, self.both)
    }

    /// Returns the root mean square error of the right pixels, scene units.
    pub fn rmse(&self) -> f64 {
        if self.right == 0 {
            0.0
        } else {
            (self.squares / self.right as f64).sqrt()
        }
    }

    pub fn add(&mut self, other: &Self) {
        self.measured += other.measured;
        self.reference += other.reference;
        self.both += other.both;
        self.right += other.right;
        self.squares += other.squares;
    }
}

fn share(part: u64, whole: u64) -> f64 {
    if whole == 0 {
        0.0
    } else {
        part as f64 / whole as f64
    }
}

/// Measurement of a depth map.
#[derive(Clone, Debug, PartialEq)]
pub struct MapMeasurement {
    pub quality: Quality,
    /// For each triangle that the key view sees, in the order of the visibility table: share of the
    /// pixels of its visible part with a right depth; 0 where the view's mask excludes all of the
    /// triangle. A triangle that covers no centre of a pixel is judged by the pixel of its
    /// centroid.
    pub shares: Vec<f32>,
    /// Number of pixels of the visible part of each triangle.
    pub pixels: Vec<u32>,
    pub size: MapSize,
    /// Places of the pilot on which the map agrees with it, ascending; empty without a pilot.
    pub places: Vec<Part>,
    /// Ids of the key view and the partners, as recorded in the map's file.
    pub ids: Vec<u32>,
}

/// Measures a depth map. `elsewhere`: a_d for pixels that show no triangle, scene units. Without a
/// reference, every depth on the surface is right.
pub fn measure(
    model: &Model,
    key: ViewIndex,
    map: DepthMap,
    reference: Option<&DepthMap>,
    elsewhere: f64,
    places: Option<&Places>,
) -> MapMeasurement {
    let size = MapSize::new(model, key, &map);
    let judged = JudgedPixels::new(model, key, &map, reference, elsewhere);
    let seen = model.visibility.triangles_seen_by(key);
    // Nothing is expected where the mask excludes all, but the program may not know the mask.
    let mask = model.unary.of_rows(model.visibility.rows(key));
    let share = |(row, &triangle): (usize, &u32)| match judged.counts[row] {
        _ if mask.at(row).allowed <= 0.0 => 0.0,
        (0, _) => f32::from(u8::from(judged.is_right_at(model, key, &map, triangle))),
        (pixels, right) => right as f32 / pixels as f32,
    };
    MapMeasurement {
        places: places.map_or_else(Vec::new, |places| agreed(places, model.scene, key, &map)),
        quality: judged.quality,
        shares: seen.iter().enumerate().map(share).collect(),
        pixels: judged.counts.iter().map(|(pixels, _)| *pixels).collect(),
        size,
        ids: map.ids,
    }
}

/// The pixels of a map, compared with the reference.
struct JudgedPixels {
    quality: Quality,
    /// By pixel.
    right: Vec<bool>,
    /// By triangle that the key view sees: pixels of its visible part, and right ones among them.
    counts: Vec<(u32, u32)>,
}

impl JudgedPixels {
    fn new(
        model: &Model,
        key: ViewIndex,
        map: &DepthMap,
        reference: Option<&DepthMap>,
        elsewhere: f64,
    ) -> Self {
        let camera = model.scene.camera_of(key);
        let seen = model.visibility.triangles_seen_by(key);
        let mut judged = Self {
            quality: Quality::default(),
            right: vec![false; map.depth.len()],
            counts: vec![(0, 0); seen.len()],
        };
        for (at, triangle) in triangles_in_front(model, key, [map.width, map.height]).enumerate() {
            let (column, row) = (
                (at % map.width as usize) as u32,
                (at / map.width as usize) as u32,
            );
            let accuracy = match triangle {
                NOTHING => elsewhere,
                t => model.target.accuracy_over_gsd * f64::from(model.target.gsd[t as usize]),
            };
            let pixel = Pixel::new(camera, map, reference, column, row, triangle != NOTHING);
            let is_right = pixel.add_to(&mut judged.quality, RIGHT_WITHIN * accuracy);
            judged.right[at] = is_right;
            // What is in front need not count as seen: it may be too oblique, or mostly hidden.
            if let Ok(row) = seen.binary_search(&triangle) {
                let (pixels, right) = &mut judged.counts[row];
                *pixels += 1;
                *right += u32::from(is_right);
            }
        }
        judged
    }

    /// Returns true if the depth at the triangle's centroid is right.
    fn is_right_at(&self, model: &Model, key: ViewIndex, map: &DepthMap, triangle: u32) -> bool {
        let (camera, pose) = (
            model.scene.camera_of(key),
            &model.scene.view(key).cam_from_world,
        );
        let x = pose.camera_from_world(&model.surface.centroid(triangle));
        let pixel = camera.project(&x).and_then(|p| map.pixel_at(camera, &p));
        pixel.is_some_and(|(column, row)| {
            self.right[row as usize * map.width as usize + column as usize]
        })
    }
}

/// Returns the frontmost triangle in each pixel of a map of this size, drawn in bands.
fn triangles_in_front(
    model: &Model,
    key: ViewIndex,
    [width, height]: [u32; 2],
) -> impl Iterator<Item = u32> {
    let rows = (BAND_PIXELS / width).max(1);
    (0..height).step_by(rows as usize).flat_map(move |row| {
        let band = row..height.min(row.saturating_add(rows));
        front(model.scene, model.surface, key, [width, height], band)
    })
}

/// Returns the places of the pilot that the map measured. A place is as exact as a thumbnail.
fn agreed(places: &Places, scene: &Scene, key: ViewIndex, map: &DepthMap) -> Vec<Part> {
    let (camera, pose) = (scene.camera_of(key), &scene.view(key).cam_from_world);
    let part = |place: u32| {
        let x = pose.camera_from_world(&places.centres[place as usize]);
        let at = (x.z > 0.0).then(|| camera.project(&x)).flatten();
        let depth = at
            .and_then(|at| map.pixel_at(camera, &at))
            .and_then(|(column, row)| map.depth_at(column, row));
        let tolerance = (PLACE_WITHIN * x.z).max(f64::from(places.sizes[place as usize]));
        let off = (depth? - x.z).abs() / tolerance;
        (off <= 1.0).then(|| Part {
            place,
            density: places.density(place, camera, x.z),
            kept: if off <= KEPT_WITHIN { 1.0 } else { KEPT_BEYOND },
        })
    };
    (0..places.centres.len() as u32).filter_map(part).collect()
}

/// A pixel of a depth map with its reference.
struct Pixel {
    depth: Option<f64>,
    /// Reference depth. `None`: no reference was given; `Some(None)`: the reference has no depth at
    /// this pixel.
    reference: Option<Option<f64>>,
    /// Length of the pixel's ray per unit of depth; 1 where no error is measured.
    ray: f64,
    shows_surface: bool,
}

impl Pixel {
    fn new(
        camera: &Camera,
        map: &DepthMap,
        reference: Option<&DepthMap>,
        column: u32,
        row: u32,
        shows_surface: bool,
    ) -> Self {
        let position = || map.image_position(camera, column, row);
        let depth = map.depth_at(column, row);
        let reference = reference.map(|r| r.interpolated(camera, &position(), SAME_SURFACE));
        let ray = match (depth, reference) {
            (Some(_), Some(Some(_))) => camera.ray(&position()).map_or(1.0, |ray| 1.0 / ray.z),
            _ => 1.0,
        };
        Self {
            depth,
            reference,
            ray,
            shows_surface,
        }
    }

    /// Adds the pixel to `quality`; returns whether it is right.
    fn add_to(&self, quality: &mut Quality, limit: f64) -> bool {
        quality.measured += u64::from(self.depth.is_some());
        let Some(reference) = self.reference else {
            quality.reference += u64::from(self.shows_surface);
            let right = self.depth.is_some() && self.shows_surface;
            quality.both += u64::from(right);
            quality.right += u64::from(right);
            return right;
        };
        quality.reference += u64::from(reference.is_some());
        let (Some(depth), Some(reference)) = (self.depth, reference) else {
            return false;
        };
        let error = (depth - reference).abs() * self.ray;
        let right = error <= limit;
        quality.both += 1;
        if right {
            quality.right += 1;
            quality.squares += error * error;
        }
        right
    }
}
