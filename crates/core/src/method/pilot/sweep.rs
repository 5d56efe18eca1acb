//! Plane sweep of a thumbnail against those of its partners.
//!
//! Planes of equal steps in inverse depth, parallel to the picture; the cost of a plane is 1 less the
//! normalised cross-correlation of 5 x 5 pixels, in the mean of the three best partners, so that a
//! partner that does not see the place does no harm; aggregated along eight paths.

use nalgebra::{Matrix3, Vector3};

use super::{
    aggregate::{Aggregation, Volume},
    pinhole::Pinhole,
    thumbnail::Thumbnail,
};
use crate::base::vector::{Kernel, vectorised};

/// Pixels of a window beside its middle.
const BESIDE: usize = 2;
const WINDOW: usize = 2 * BESIDE + 1;
const PIXELS: f32 = (WINDOW * WINDOW) as f32;
const PART: f32 = 1.0 / PIXELS;
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
    /// 1 / z, per scene unit, row by row; 0 for no depth.
    pub inverse: Vec<f32>,
}

/// Buffers of a sweep, for one view after another.
#[derive(Default)]
pub struct Scratch {
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

/// Positions of a row of samples.
#[derive(Default)]
struct Row {
    at: Vec<u32>,
    right: Vec<f32>,
    down: Vec<f32>,
    quad: Vec<u32>,
}

/// Sums over windows.
#[derive(Default)]
struct Sums {
    /// Of the last [`WINDOW`] rows: sums over the columns of a window of the partner, its square, and
    /// its product with the key picture.
    ring: Vec<f32>,
    product: Vec<f32>,
    /// Of a row of pixels: the same over whole windows, and the correlation.
    means: Vec<f32>,
    correlation: Vec<f32>,
}

impl Planes {
    /// Steps of about a pixel in the median partner.
    pub fn new(key: &Thumbnail, partners: &[&Thumbnail], [near, far]: [f64; 2]) -> Self {
        let ends = [1.0 / far, 1.0 / near];
        let mut shifts = Vec::new();
        for partner in partners {
            let warp = Warp::new(key, partner);
            for i in 0..9 {
                let share = |i: usize| [0.2, 0.5, 0.8][i];
                let (x, y) = (
                    share(i % 3) * key.camera.width as f64,
                    share(i / 3) * key.camera.height as f64,
                );
                let [a, b] = ends.map(|inverse| warp.position(x, y, inverse));
                shifts.extend(a.zip(b).map(|(a, b)| (a - b).norm()));
            }
        }
        shifts.sort_by(f64::total_cmp);
        let median = shifts.get(shifts.len() / 2).copied().unwrap_or(64.0);
        let steps = median.ceil().clamp(LEAST_PLANES, MOST_PLANES);
        Self {
            first: ends[0],
            step: (ends[1] - ends[0]) / steps,
            count: steps as usize + 1,
        }
    }
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
    for plane in 0..planes.count {
        let inverse = planes.first + planes.step * plane as f64;
        scratch.best.iter_mut().for_each(|best| best.fill(0.0));
        for (partner, warp) in partners.iter().zip(&warps) {
            vectorised(Compare {
                key,
                partner,
                warp,
                inverse,
                scratch,
            });
        }
        scratch.store(plane, planes.count, partners.len());
    }
    let volume = Volume {
        costs: &scratch.costs,
        width: key.camera.width,
        height: key.camera.height,
        planes: planes.count,
    };
    scratch.aggregation.run(volume);
    let sums = scratch.aggregation.sums.chunks_exact(planes.count);
    let is_allowed = |pixel: usize| key.allowed.get(pixel).copied().unwrap_or(true);
    let inverse = sums.enumerate().map(|(pixel, sums)| {
        let found = winner(sums).filter(|_| is_allowed(pixel));
        found.map_or(0.0, |plane| {
            (planes.first + planes.step * plane).max(0.0) as f32
        })
    });
    PilotMap {
        camera: key.camera.clone(),
        step: planes.step,
        inverse: inverse.collect(),
    }
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
        let (wide, high, pixels) = (width + 2 * BESIDE, height + 2 * BESIDE, width * height);
        let sized = |list: &mut Vec<f32>, length: usize| {
            list.clear();
            list.resize(length, 0.0);
        };
        sized(&mut self.warped, wide * high);
        sized(&mut self.padded, wide * high);
        sized(&mut self.inside, pixels);
        sized(&mut self.mean, pixels);
        sized(&mut self.inverse_deviation, pixels);
        self.best.iter_mut().for_each(|best| sized(best, pixels));
        sized(&mut self.sums.ring, 3 * WINDOW * width);
        sized(&mut self.sums.product, wide);
        sized(&mut self.sums.means, 3 * width);
        sized(&mut self.sums.correlation, width);
        sized(&mut self.row.right, width);
        sized(&mut self.row.down, width);
        self.row.at.resize(width, 0);
        self.row.quad.resize(width, 0);
        self.costs.clear();
        self.costs.resize(pixels * planes, 0);
        for y in 0..high {
            let row = y.saturating_sub(BESIDE).min(height - 1);
            for x in 0..wide {
                let column = x.saturating_sub(BESIDE).min(width - 1);
                self.padded[y * wide + x] = f32::from(key.grey[row * width + column]);
            }
        }
        for y in 0..height {
            for x in 0..width {
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
                self.inverse_deviation[y * width + x] = 1.0 / (variance + NOISE).sqrt();
            }
        }
    }

    /// Writes the costs of a plane.
    fn store(&mut self, plane: usize, planes: usize, partners: usize) {
        let counted = partners.min(BEST);
        let scale = WORST / counted as f32;
        for (pixel, costs) in self.costs.chunks_exact_mut(planes).enumerate() {
            let sum: f32 = self.best[..counted].iter().map(|best| best[pixel]).sum();
            costs[plane] = (WORST + 0.5 - scale * sum).max(0.0) as u8;
        }
    }
}

/// Correlation of the key picture with a partner that is seen through a plane.
struct Compare<'a> {
    key: &'a Thumbnail,
    partner: &'a Thumbnail,
    warp: &'a Warp,
    inverse: f64,
    scratch: &'a mut Scratch,
}

impl Kernel for Compare<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let (width, height) = (self.key.camera.width, self.key.camera.height);
        let scratch = self.scratch;
        warp_rows(
            self.warp,
            self.inverse,
            self.partner,
            (width, height),
            scratch,
        );
        correlate((width, height), scratch);
    }
}

/// Samples the partner where the pixels of the key picture are on the plane, clamped to its border.
#[inline(always)]
fn warp_rows(
    warp: &Warp,
    inverse: f64,
    partner: &Thumbnail,
    (width, height): (usize, usize),
    scratch: &mut Scratch,
) {
    let wide = width + 2 * BESIDE;
    let (rotation, shift) = (&warp.rotation, warp.shift * inverse);
    let [most_x, most_y] =
        [partner.camera.width, partner.camera.height].map(|side| (side - 1) as f32);
    let across = [0, 1, 2].map(|axis| rotation[(axis, 0)] as f32);
    let Row {
        at,
        right,
        down,
        quad,
    } = &mut scratch.row;
    let (at, right, down, quad) = (
        &mut at[..width],
        &mut right[..width],
        &mut down[..width],
        &mut quad[..width],
    );
    let partner_width = partner.camera.width as u32;
    for y in 0..height {
        let start = [0, 1, 2].map(|axis| {
            (rotation[(axis, 1)] * y as f64 + rotation[(axis, 2)] + shift[axis]) as f32
        });
        let inside = &mut scratch.inside[y * width..(y + 1) * width];
        for x in 0..width {
            let column = x as f32;
            // Behind the partner: far outside.
            let scale = 1.0 / (start[2] + across[2] * column).max(1e-6);
            let u = (start[0] + across[0] * column) * scale;
            let v = (start[1] + across[1] * column) * scale;
            let (cu, cv) = (u.max(0.0).min(most_x), v.max(0.0).min(most_y));
            inside[x] = if cu == u && cv == v { 1.0 } else { 0.0 };
            let (left, top) = (cu as i32, cv as i32);
            at[x] = (top as u32)
                .wrapping_mul(partner_width)
                .wrapping_add(left as u32);
            right[x] = cu - left as f32;
            down[x] = cv - top as f32;
        }
        for (quad, &at) in quad.iter_mut().zip(at.iter()) {
            *quad = partner.quads[at as usize];
        }
        let out = &mut scratch.warped[(y + BESIDE) * wide..(y + BESIDE + 1) * wide];
        let (first, rest) = out.split_at_mut(BESIDE);
        let (row, last) = rest.split_at_mut(width);
        for x in 0..width {
            let level = |byte: u32| (quad[x] >> (8 * byte) & 255) as i32 as f32;
            let upper = level(0) + right[x] * (level(1) - level(0));
            let lower = level(2) + right[x] * (level(3) - level(2));
            row[x] = upper + down[x] * (lower - upper);
        }
        first.fill(row[0]);
        last.fill(row[width - 1]);
    }
    for y in 0..BESIDE {
        scratch
            .warped
            .copy_within(BESIDE * wide..(BESIDE + 1) * wide, y * wide);
        let from = (height + BESIDE - 1) * wide;
        scratch
            .warped
            .copy_within(from..from + wide, (height + BESIDE + y) * wide);
    }
}

/// Correlates the windows, and keeps the best partners of each pixel.
#[inline(always)]
fn correlate((width, height): (usize, usize), scratch: &mut Scratch) {
    let (wide, high) = (width + 2 * BESIDE, height + 2 * BESIDE);
    let Sums {
        ring,
        product,
        means,
        correlation,
    } = &mut scratch.sums;
    let product = &mut product[..wide];
    for y in 0..high {
        let warped = &scratch.warped[y * wide..(y + 1) * wide];
        let key = &scratch.padded[y * wide..(y + 1) * wide];
        let sums = &mut ring[3 * (y % WINDOW) * width..][..3 * width];
        let (of_partner, rest) = sums.split_at_mut(width);
        let (of_squares, of_products) = rest.split_at_mut(width);
        across(warped, of_partner);
        (0..wide).for_each(|x| product[x] = warped[x] * warped[x]);
        across(product, of_squares);
        (0..wide).for_each(|x| product[x] = warped[x] * key[x]);
        across(product, of_products);
        let Some(row) = y.checked_sub(2 * BESIDE) else {
            continue;
        };
        let pixels = row * width..(row + 1) * width;
        for (kind, mean) in means.chunks_exact_mut(width).enumerate() {
            let rows = std::array::from_fn(|i| &ring[(3 * i + kind) * width..][..width]);
            down(rows, mean);
        }
        let (sums, rest) = means.split_at(width);
        let (squares, products) = rest.split_at(width);
        let of_key = (
            &scratch.mean[pixels.clone()],
            &scratch.inverse_deviation[pixels.clone()],
        );
        let inside = &scratch.inside[pixels.clone()];
        correlations((sums, squares, products), of_key, inside, correlation);
        let [first, second, third] = &mut scratch.best;
        let next = &mut correlation[..width];
        for best in [first, second, third] {
            keep_larger(&mut best[pixels.clone()], next);
        }
    }
}

// Each loop below has few slices: with more, the compiler would not prove that they are apart, and
// not use vectors.

/// Means over the rows of a window of sums over its columns.
#[inline(always)]
fn down(rows: [&[f32]; WINDOW], means: &mut [f32]) {
    let width = means.len();
    let rows = rows.map(|row| &row[..width]);
    for x in 0..width {
        means[x] = (rows[0][x] + rows[1][x] + rows[2][x] + rows[3][x] + rows[4][x]) * PART;
    }
}

/// Correlation by the means of the partner, of its square, and of its product with the key picture.
#[inline(always)]
fn correlations(
    (sums, squares, products): (&[f32], &[f32], &[f32]),
    (mean, deviation): (&[f32], &[f32]),
    inside: &[f32],
    correlation: &mut [f32],
) {
    let width = correlation.len();
    let [sums, squares, products] = [sums, squares, products].map(|of| &of[..width]);
    let [mean, deviation, inside] = [mean, deviation, inside].map(|of| &of[..width]);
    for x in 0..width {
        let variance = (squares[x] - sums[x] * sums[x]).max(0.0);
        let covariance = products[x] - sums[x] * mean[x];
        let found = covariance * deviation[x] / (variance + NOISE).sqrt() * inside[x];
        correlation[x] = found.max(0.0);
    }
}

/// Keeps the larger of two numbers in `best`, and the smaller in `next`.
#[inline(always)]
fn keep_larger(best: &mut [f32], next: &mut [f32]) {
    for (best, next) in best.iter_mut().zip(next) {
        (*best, *next) = (best.max(*next), best.min(*next));
    }
}

/// Sums over the columns of a window.
#[inline(always)]
fn across(row: &[f32], sums: &mut [f32]) {
    let width = sums.len();
    let shifted: [&[f32]; WINDOW] = std::array::from_fn(|i| &row[i..i + width]);
    for x in 0..width {
        sums[x] = shifted[0][x] + shifted[1][x] + shifted[2][x] + shifted[3][x] + shifted[4][x];
    }
}
