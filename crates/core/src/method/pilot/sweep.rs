//! Plane sweep of a thumbnail against those of its partners.
//!
//! Planes of equal steps in inverse depth, parallel to the picture; the cost of a plane is 1 less
//! the normalised cross-correlation of 5 x 5 pixels, in the mean of the three best partners, so
//! that a partner that does not see the place does no harm; aggregated along eight paths.

mod compare;

use nalgebra::{Matrix3, Vector3};

use self::compare::{Compare, Row, Sums};
use super::{
    aggregate::{Aggregation, Volume},
    pinhole::Pinhole,
    thumbnail::Thumbnail,
};
use crate::base::{median::upper_median, vector::vectorised};

/// Pixels of a window beside its middle.
const BESIDE: usize = 2;
const WINDOW: usize = 2 * BESIDE + 1;
const PIXELS: f32 = (WINDOW * WINDOW) as f32;
/// Partners whose correlation counts.
const BEST: usize = 3;
/// Variance that noise has, square grey levels.
const NOISE: f32 = 4.0;
/// Cost of no correlation.
const WORST: f32 = 64.0;
/// Numbers of planes, whatever the range of depths.
const LEAST_PLANES: f64 = 24.0;
pub(super) const MOST_PLANES: f64 = 128.0;

/// Inverse depths to search: `first + step d`, d = 0, ..., `count - 1`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Planes {
    first: f64,
    step: f64,
    count: usize,
}

/// Depth map of a thumbnail.
#[derive(Clone, Debug, PartialEq)]
pub struct PilotMap {
    pub camera: Pinhole,
    /// Step between planes, in inverse depth.
    pub step: f64,
    /// 1 / z, per scene unit, row by row; 0 for no depth, negative for one that is not confirmed.
    pub inverse: Vec<f32>,
}

/// Buffers of a sweep, for one view after another.
#[derive(Default)]
pub struct Scratch {
    /// By partner: the four neighbours of each pixel in one word, so that a sample is one load.
    quads: Vec<Vec<u32>>,
    /// The key picture with its border repeated, and the warped partner likewise.
    padded: Vec<f32>,
    warped: Vec<f32>,
    /// 1 where the partner has a pixel.
    inside: Vec<f32>,
    /// By pixel of the key picture, over its window: mean, and 1 / standard deviation.
    mean: Vec<f32>,
    inverse_deviation: Vec<f32>,
    /// The best correlations with the partners at the current plane.
    best: [Vec<f32>; BEST],
    row: Row,
    sums: Sums,
    costs: Vec<u8>,
    aggregation: Aggregation,
}

impl Planes {
    /// Steps of about a pixel in the median partner.
    pub fn new(key: &Thumbnail, partners: &[&Thumbnail], [near, far]: [f64; 2]) -> Self {
        let ends = [1.0 / far, 1.0 / near];
        let median = median_shift(key, partners, ends).unwrap_or(64.0);
        let steps = median.ceil().clamp(LEAST_PLANES, MOST_PLANES);
        Self {
            first: ends[0],
            step: (ends[1] - ends[0]) / steps,
            count: steps as usize + 1,
        }
    }

    fn inverse(&self, plane: f64) -> f64 {
        self.first + self.step * plane
    }
}

/// Returns by how many pixels places move in the median partner between two inverse depths; `None`
/// if no partner shows any.
fn median_shift(key: &Thumbnail, partners: &[&Thumbnail], ends: [f64; 2]) -> Option<f64> {
    let shares = [0.2, 0.5, 0.8];
    let [width, height] = [key.camera.width, key.camera.height].map(|side| side as f64);
    let mut shifts = Vec::new();
    for partner in partners {
        let warp = Warp::new(key, partner);
        for (row, column) in shares.iter().flat_map(|y| shares.map(|x| (y, x))) {
            let [a, b] = ends.map(|inverse| warp.position(column * width, row * height, inverse));
            shifts.extend(a.zip(b).map(|(a, b)| (a - b).norm()));
        }
    }
    upper_median(shifts)
}

/// The way from a pixel of the key picture at an inverse depth to the partner's: `rotation (x, y,
/// 1) + shift * inverse depth`, in homogeneous pixels.
struct Warp {
    rotation: Matrix3<f64>,
    shift: Vector3<f64>,
}

impl Warp {
    fn new(key: &Thumbnail, partner: &Thumbnail) -> Self {
        let between = partner.camera.pose.rotation * key.camera.pose.rotation.inverse();
        let shift = partner.camera.pose.translation - between * key.camera.pose.translation;
        let rays = key
            .camera
            .matrix()
            .try_inverse()
            .unwrap_or_else(Matrix3::identity);
        Self {
            rotation: partner.camera.matrix() * between.matrix() * rays,
            shift: partner.camera.matrix() * shift,
        }
    }

    /// `None` behind the partner.
    fn position(&self, x: f64, y: f64, inverse: f64) -> Option<nalgebra::Vector2<f64>> {
        let at = self.rotation * Vector3::new(x, y, 1.0) + self.shift * inverse;
        (at.z > 0.0).then(|| at.xy() / at.z)
    }
}

/// Matches a thumbnail against its partners. Depths of the first and last plane count as none: the
/// true depth may be beyond them.
pub fn sweep(
    key: &Thumbnail,
    partners: &[&Thumbnail],
    planes: Planes,
    scratch: &mut Scratch,
) -> PilotMap {
    let warps: Vec<Warp> = partners
        .iter()
        .map(|partner| Warp::new(key, partner))
        .collect();
    scratch.prepare(key, planes.count);
    let mut quads = std::mem::take(&mut scratch.quads);
    quads.resize_with(quads.len().max(partners.len()), Vec::new);
    let of_partners = partners.iter().zip(&mut quads);
    of_partners.for_each(|(partner, quads)| partner.write_quads(quads));
    // Partners within planes, so that only the best correlations of one plane are held.
    for plane in 0..planes.count {
        let inverse = planes.inverse(plane as f64);
        scratch.best.iter_mut().for_each(|best| best.fill(0.0));
        for ((partner, quads), warp) in partners.iter().zip(&quads).zip(&warps) {
            vectorised(Compare {
                key,
                partner,
                quads,
                warp,
                inverse,
                scratch,
            });
        }
        scratch.store(plane, planes.count, partners.len());
    }
    scratch.quads = quads;
    scratch.aggregation.run(Volume {
        costs: &scratch.costs,
        width: key.camera.width,
        height: key.camera.height,
        planes: planes.count,
    });
    PilotMap {
        camera: key.camera.clone(),
        step: planes.step,
        inverse: inverse_depths(key, planes, &scratch.aggregation.sums),
    }
}

/// Returns the inverse depth of each pixel by the sums of its costs; 0 for no depth.
fn inverse_depths(key: &Thumbnail, planes: Planes, sums: &[u16]) -> Vec<f32> {
    let is_allowed = |pixel: usize| key.allowed.get(pixel).copied().unwrap_or(true);
    let of_pixel = |(pixel, sums): (usize, &[u16])| {
        let found = winner(sums).filter(|_| is_allowed(pixel));
        found.map_or(0.0, |plane| planes.inverse(plane).max(0.0) as f32)
    };
    let pixels = sums.chunks_exact(planes.count).enumerate();
    pixels.map(of_pixel).collect()
}

/// Returns the plane of the least sum, the first of equals, refined by a parabola through its
/// neighbours; `None` for the first and last plane.
fn winner(sums: &[u16]) -> Option<f64> {
    let (plane, _) = sums.iter().enumerate().min_by_key(|(_, sum)| **sum)?;
    let [before, at, after] =
        [plane.checked_sub(1)?, plane, plane + 1].map(|plane| sums.get(plane).copied());
    let [before, at, after] = [before?, at?, after?].map(f64::from);
    let curvature = before - 2.0 * at + after;
    let offset = if curvature > 0.0 {
        (0.5 * (before - after) / curvature).clamp(-0.5, 0.5)
    } else {
        0.0
    };
    Some(plane as f64 + offset)
}

impl Scratch {
    fn prepare(&mut self, key: &Thumbnail, planes: usize) {
        let (width, height) = (key.camera.width, key.camera.height);
        self.resize(width, height, planes);
        self.pad(key);
        self.measure_windows(width, height);
    }

    fn resize(&mut self, width: usize, height: usize, planes: usize) {
        let (wide, high, pixels) = (width + 2 * BESIDE, height + 2 * BESIDE, width * height);
        clear(&mut self.warped, wide * high);
        clear(&mut self.padded, wide * high);
        clear(&mut self.inside, pixels);
        clear(&mut self.mean, pixels);
        clear(&mut self.inverse_deviation, pixels);
        self.best.iter_mut().for_each(|best| clear(best, pixels));
        self.sums.resize(width);
        self.row.resize(width);
        self.costs.clear();
        self.costs.resize(pixels * planes, 0);
    }

    /// Copies the key picture, with its border repeated.
    fn pad(&mut self, key: &Thumbnail) {
        let (width, height) = (key.camera.width, key.camera.height);
        let rows = self.padded.chunks_exact_mut(width + 2 * BESIDE);
        for (y, padded) in rows.enumerate() {
            let row = y.saturating_sub(BESIDE).min(height - 1);
            for (x, level) in padded.iter_mut().enumerate() {
                let column = x.saturating_sub(BESIDE).min(width - 1);
                *level = f32::from(key.grey[row * width + column]);
            }
        }
    }

    /// Computes mean and deviation of the windows of the key picture.
    fn measure_windows(&mut self, width: usize, height: usize) {
        let wide = width + 2 * BESIDE;
        for y in 0..height {
            for x in 0..width {
                // Whole numbers below 2^24, exact in f32, so that the variance below loses little.
                let (mut sum, mut squares) = (0.0, 0.0);
                for row in self.padded[y * wide..].chunks(wide).take(WINDOW) {
                    for level in &row[x..x + WINDOW] {
                        sum += level;
                        squares += level * level;
                    }
                }
                let mean = sum / PIXELS;
                let variance = (squares / PIXELS - mean * mean).max(0.0);
                self.mean[y * width + x] = mean;
                // With the variance of noise added, flat windows correlate with nothing.
                self.inverse_deviation[y * width + x] = 1.0 / (variance + NOISE).sqrt();
            }
        }
    }

    /// Writes the costs of a plane.
    fn store(&mut self, plane: usize, planes: usize, partners: usize) {
        let counted = partners.min(BEST);
        let scale = WORST / counted as f32;
        // The planes of a pixel are side by side, as the aggregation reads them.
        for (pixel, costs) in self.costs.chunks_exact_mut(planes).enumerate() {
            let sum: f32 = self.best[..counted].iter().map(|best| best[pixel]).sum();
            costs[plane] = (WORST + 0.5 - scale * sum).max(0.0) as u8;
        }
    }
}

fn clear(list: &mut Vec<f32>, length: usize) {
    list.clear();
    list.resize(length, 0.0);
}
