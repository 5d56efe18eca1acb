//! Correlation of windows of the key picture and of a partner that is seen through a plane.

use nalgebra::Vector3;

use super::{BESIDE, NOISE, PIXELS, Scratch, WINDOW, Warp, clear};
use crate::{base::vector::Kernel, method::pilot::thumbnail::Thumbnail};

const PART: f32 = 1.0 / PIXELS;

/// Positions of a row of samples.
#[derive(Default)]
pub(super) struct Row {
    at: Vec<u32>,
    right: Vec<f32>,
    down: Vec<f32>,
    quad: Vec<u32>,
}

/// Sums over windows.
#[derive(Default)]
pub(super) struct Sums {
    /// Of the last [`WINDOW`] rows: sums over the columns of a window of the partner, its square,
    /// and its product with the key picture.
    ring: Vec<f32>,
    product: Vec<f32>,
    /// Of a row of pixels: the same over whole windows, and the correlation.
    means: Vec<f32>,
    correlation: Vec<f32>,
}

/// Correlation of the key picture with a partner that is seen through a plane.
pub(super) struct Compare<'a> {
    pub key: &'a Thumbnail,
    pub partner: &'a Thumbnail,
    /// The partner's.
    pub quads: &'a [u32],
    pub warp: &'a Warp,
    pub inverse: f64,
    pub scratch: &'a mut Scratch,
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
            (self.partner, self.quads),
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
    partner: (&Thumbnail, &[u32]),
    (width, height): (usize, usize),
    scratch: &mut Scratch,
) {
    let wide = width + 2 * BESIDE;
    let shift = warp.shift * inverse;
    for y in 0..height {
        let line = warp.line(y, &shift);
        let inside = &mut scratch.inside[y * width..(y + 1) * width];
        scratch.row.find(&line, partner, inside);
        let out = &mut scratch.warped[(y + BESIDE) * wide..(y + BESIDE + 1) * wide];
        let (first, rest) = out.split_at_mut(BESIDE);
        let (row, last) = rest.split_at_mut(width);
        scratch.row.sample(row);
        first.fill(row[0]);
        last.fill(row[width - 1]);
    }
    repeat_border(&mut scratch.warped, wide, height);
}

/// Copies the first and the last row of a picture into those before and after it.
fn repeat_border(padded: &mut [f32], wide: usize, height: usize) {
    for y in 0..BESIDE {
        padded.copy_within(BESIDE * wide..(BESIDE + 1) * wide, y * wide);
        let from = (height + BESIDE - 1) * wide;
        padded.copy_within(from..from + wide, (height + BESIDE + y) * wide);
    }
}

/// Homogeneous pixels of the partner along a row of the key picture: `start + across * column`.
struct Line {
    start: [f32; 3],
    across: [f32; 3],
}

impl Warp {
    /// `shift`: times the inverse depth.
    #[inline(always)]
    fn line(&self, y: usize, shift: &Vector3<f64>) -> Line {
        let rotation = &self.rotation;
        Line {
            start: [0, 1, 2].map(|axis| {
                (rotation[(axis, 1)] * y as f64 + rotation[(axis, 2)] + shift[axis]) as f32
            }),
            across: [0, 1, 2].map(|axis| rotation[(axis, 0)] as f32),
        }
    }
}

impl Line {
    /// Returns the pixel of the partner at a column.
    #[inline(always)]
    fn pixel(&self, column: f32) -> [f32; 2] {
        let Self { start, across } = self;
        // Behind the partner: far outside.
        let scale = 1.0 / (start[2] + across[2] * column).max(1e-6);
        [
            (start[0] + across[0] * column) * scale,
            (start[1] + across[1] * column) * scale,
        ]
    }
}

impl Row {
    pub fn resize(&mut self, width: usize) {
        clear(&mut self.right, width);
        clear(&mut self.down, width);
        self.at.resize(width, 0);
        self.quad.resize(width, 0);
    }

    /// Finds where the partner shows the pixels of a row, and the four levels around each.
    #[inline(always)]
    fn find(&mut self, line: &Line, (partner, quads): (&Thumbnail, &[u32]), inside: &mut [f32]) {
        let width = inside.len();
        // Slices of one length: without checks of bounds, the loop is compiled for vectors.
        let (at, right, down) = (
            &mut self.at[..width],
            &mut self.right[..width],
            &mut self.down[..width],
        );
        let [most_x, most_y] =
            [partner.camera.width, partner.camera.height].map(|side| (side - 1) as f32);
        let partner_width = partner.camera.width as u32;
        for x in 0..width {
            let [u, v] = line.pixel(x as f32);
            // Clamped, so that each pixel loads something; `inside` takes it out again.
            let (cu, cv) = (u.max(0.0).min(most_x), v.max(0.0).min(most_y));
            inside[x] = if cu == u && cv == v { 1.0 } else { 0.0 };
            let (left, top) = (cu as i32, cv as i32);
            at[x] = (top as u32)
                .wrapping_mul(partner_width)
                .wrapping_add(left as u32);
            right[x] = cu - left as f32;
            down[x] = cv - top as f32;
        }
        for (quad, &at) in self.quad[..width].iter_mut().zip(at.iter()) {
            *quad = quads[at as usize];
        }
    }

    /// Interpolates between the four levels.
    #[inline(always)]
    fn sample(&self, row: &mut [f32]) {
        let width = row.len();
        let (right, down, quad) = (
            &self.right[..width],
            &self.down[..width],
            &self.quad[..width],
        );
        for x in 0..width {
            // Through i32: before AVX-512, x86 has no vector conversion from u32.
            let level = |byte: u32| (quad[x] >> (8 * byte) & 255) as i32 as f32;
            let upper = level(0) + right[x] * (level(1) - level(0));
            let lower = level(2) + right[x] * (level(3) - level(2));
            row[x] = upper + down[x] * (lower - upper);
        }
    }
}

/// Correlates the windows, and keeps the best partners of each pixel.
#[inline(always)]
fn correlate((width, height): (usize, usize), scratch: &mut Scratch) {
    let (wide, high) = (width + 2 * BESIDE, height + 2 * BESIDE);
    for y in 0..high {
        let warped = &scratch.warped[y * wide..(y + 1) * wide];
        let key = &scratch.padded[y * wide..(y + 1) * wide];
        scratch.sums.add_row(y, width, warped, key);
        let Some(row) = y.checked_sub(2 * BESIDE) else {
            continue;
        };
        let pixels = row * width..(row + 1) * width;
        let of_key = (
            &scratch.mean[pixels.clone()],
            &scratch.inverse_deviation[pixels.clone()],
        );
        let inside = &scratch.inside[pixels.clone()];
        let next = scratch.sums.correlation(of_key, inside);
        let [first, second, third] = &mut scratch.best;
        for best in [first, second, third] {
            keep_larger(&mut best[pixels.clone()], next);
        }
    }
}

impl Sums {
    pub fn resize(&mut self, width: usize) {
        clear(&mut self.ring, 3 * WINDOW * width);
        clear(&mut self.product, width + 2 * BESIDE);
        clear(&mut self.means, 3 * width);
        clear(&mut self.correlation, width);
    }

    /// Adds up a row over the columns of each window, in the place of that which leaves the
    /// windows.
    #[inline(always)]
    fn add_row(&mut self, y: usize, width: usize, warped: &[f32], key: &[f32]) {
        let wide = warped.len();
        let product = &mut self.product[..wide];
        let sums = &mut self.ring[3 * (y % WINDOW) * width..][..3 * width];
        let (of_partner, rest) = sums.split_at_mut(width);
        let (of_squares, of_products) = rest.split_at_mut(width);
        across(warped, of_partner);
        (0..wide).for_each(|x| product[x] = warped[x] * warped[x]);
        across(product, of_squares);
        (0..wide).for_each(|x| product[x] = warped[x] * key[x]);
        across(product, of_products);
    }

    /// Returns the correlation of the windows around the pixels of a row. `of_key`: mean and 1 /
    /// standard deviation of those of the key picture.
    #[inline(always)]
    fn correlation(&mut self, of_key: (&[f32], &[f32]), inside: &[f32]) -> &mut [f32] {
        let width = inside.len();
        let ring = &self.ring;
        for (kind, mean) in self.means.chunks_exact_mut(width).enumerate() {
            let rows = std::array::from_fn(|i| &ring[(3 * i + kind) * width..][..width]);
            down(rows, mean);
        }
        let (sums, rest) = self.means.split_at(width);
        let (squares, products) = rest.split_at(width);
        let correlation = &mut self.correlation[..width];
        correlations((sums, squares, products), of_key, inside, correlation);
        correlation
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
