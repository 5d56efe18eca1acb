//! Image pyramid of a grey picture.

use std::array::from_fn;

/// Grey picture with its pyramid.
#[derive(Clone, Debug)]
pub struct Grey {
    /// Levels, largest first; each has half the side of the one before, grey levels row by row.
    levels: Vec<Level>,
}

#[derive(Clone, Debug)]
struct Level {
    width: usize,
    height: usize,
    pixels: Vec<u8>,
}

/// Minimum side of a level, pixels.
const LEAST_SIDE: usize = 16;

impl Grey {
    /// Builds the pyramid of `pixels`: width x height grey levels, row by row.
    pub fn new(width: usize, height: usize, pixels: Vec<u8>) -> Self {
        let mut levels = vec![Level {
            width,
            height,
            pixels,
        }];
        while let Some(half) = levels.last().and_then(Level::halved) {
            levels.push(half);
        }
        Self { levels }
    }

    /// Width and height of the largest level.
    pub fn size(&self) -> [usize; 2] {
        [self.levels[0].width, self.levels[0].height]
    }

    /// Returns the smallest level whose longer side has at least `side` pixels, else the largest.
    pub fn level_of(&self, side: f64) -> usize {
        let is_enough = |level: &Level| level.width.max(level.height) as f64 >= side;
        self.levels.iter().rposition(is_enough).unwrap_or_default()
    }

    /// Samples a level bilinearly at a position in shares of the picture's width and height,
    /// clamped to the picture; rounded to a grey level.
    pub fn at(&self, level: usize, [x, y]: [f64; 2]) -> u8 {
        let level = &self.levels[level];
        let clamp =
            |share: f64, side: usize| (share * side as f64 - 0.5).clamp(0.0, (side - 1) as f64);
        let (x, y) = (clamp(x, level.width), clamp(y, level.height));
        let (left, top) = (x as usize, y as usize);
        let (fx, fy) = (x - left as f64, y - top as f64);
        let across =
            |row| level.clamped(left, row) * (1.0 - fx) + level.clamped(left + 1, row) * fx;
        (across(top) * (1.0 - fy) + across(top + 1) * fy).round() as u8
    }

    /// Returns the energy of the two finest bands of the picture, squared grey levels: the mean
    /// variance of blocks of 2 x 2 pixels, and that of blocks of 2 x 2 such blocks; 0 where the
    /// picture is too small. Blur takes from the first what the second still has.
    pub fn detail(&self) -> [f64; 2] {
        [0, 1].map(|level| {
            self.levels
                .get(level)
                .map_or(0.0, Level::variance_of_blocks)
        })
    }

    pub fn levels(&self) -> usize {
        self.levels.len()
    }

    /// Samples a level bilinearly on a grid of `N x N` around `centre`, with the steps `right` and
    /// `down`; all in pixels of the largest level, whose first pixel has its centre at (0.5, 0.5).
    /// `None` if the grid leaves the picture.
    pub fn sample<const N: usize>(
        &self,
        level: usize,
        centre: [f32; 2],
        right: [f32; 2],
        down: [f32; 2],
    ) -> Option<[[f32; N]; N]> {
        let scale = 1.0 / (1u32 << level) as f32;
        let level = &self.levels[level];
        let middle = (N - 1) as f32 / 2.0;
        let [centre, right, down] = [centre, right, down].map(|v| v.map(|x| x * scale));
        let reach = [0, 1].map(|axis| middle * (right[axis].abs() + down[axis].abs()));
        if !level.shows(centre, reach) {
            return None;
        }
        let sample = |i: usize, j: usize| {
            let (a, b) = (j as f32 - middle, i as f32 - middle);
            let at = |axis: usize| centre[axis] - 0.5 + a * right[axis] + b * down[axis];
            level.interpolated(at(0), at(1))
        };
        Some(from_fn(|i| from_fn(|j| sample(i, j))))
    }
}

impl Level {
    /// Returns the pixel, or that at the nearest place of the border.
    fn clamped(&self, column: usize, row: usize) -> f64 {
        let (column, row) = (column.min(self.width - 1), row.min(self.height - 1));
        f64::from(self.pixels[row * self.width + column])
    }

    /// Returns whether all that is within `reach` of a position can be interpolated.
    fn shows(&self, centre: [f32; 2], reach: [f32; 2]) -> bool {
        let inside = |axis: usize, side: usize| {
            let at = centre[axis] - 0.5;
            at - reach[axis] >= 0.0 && at + reach[axis] < (side - 1) as f32
        };
        inside(0, self.width) && inside(1, self.height)
    }

    /// Interpolates bilinearly at a position inside, in pixels from the centre of the first one.
    #[inline]
    fn interpolated(&self, x: f32, y: f32) -> f32 {
        let width = self.width;
        // Rounding may move a sample at the edge beyond it by a negligible amount.
        let (column, row) = (
            (x as usize).min(width - 2),
            (y as usize).min(self.height - 2),
        );
        let (fx, fy) = (x - column as f32, y - row as f32);
        let upper = &self.pixels[row * width + column..][..2];
        let lower = &self.pixels[(row + 1) * width + column..][..2];
        let across =
            |pair: &[u8]| f32::from(pair[0]) + fx * (f32::from(pair[1]) - f32::from(pair[0]));
        let (upper, lower) = (across(upper), across(lower));
        upper + fy * (lower - upper)
    }

    /// Mean variance of the grey levels of blocks of 2 x 2 pixels.
    fn variance_of_blocks(&self) -> f64 {
        let (columns, rows) = (self.width / 2, self.height / 2);
        let mut sum = 0u64;
        for row in 0..rows {
            let [upper, lower] =
                [2 * row, 2 * row + 1].map(|row| &self.pixels[row * self.width..][..2 * columns]);
            for (a, b) in upper.chunks_exact(2).zip(lower.chunks_exact(2)) {
                let levels = [a[0], a[1], b[0], b[1]].map(u64::from);
                let (total, squares) = (
                    levels.iter().sum::<u64>(),
                    levels.iter().map(|level| level * level).sum::<u64>(),
                );
                // 16 times the variance: whole numbers.
                sum += 4 * squares - total * total;
            }
        }
        sum as f64 / (16 * columns * rows).max(1) as f64
    }

    /// Averages 2 x 2 pixels; an odd last row or column is dropped.
    fn halved(&self) -> Option<Self> {
        let (width, height) = (self.width / 2, self.height / 2);
        if width.min(height) < LEAST_SIDE {
            return None;
        }
        let mut pixels = Vec::with_capacity(width * height);
        for row in 0..height {
            let [upper, lower] =
                [2 * row, 2 * row + 1].map(|row| &self.pixels[row * self.width..][..2 * width]);
            let pairs = upper.chunks_exact(2).zip(lower.chunks_exact(2));
            let mean = |(a, b): (&[u8], &[u8])| {
                ((u16::from(a[0]) + u16::from(a[1]) + u16::from(b[0]) + u16::from(b[1]) + 2) / 4)
                    as u8
            };
            pixels.extend(pairs.map(mean));
        }
        Some(Self {
            width,
            height,
            pixels,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_of_a_ramp_lie_on_it_at_every_level() {
        // The centre of pixel (x, y) is at (x + 0.5, y + 0.5), where the ramp is x + 2 y.
        let pixels = (0..64)
            .flat_map(|y| (0..64).map(move |x| x + 2 * y))
            .collect();
        let grey = Grey::new(64, 64, pixels);
        assert_eq!((grey.levels(), grey.size()), (3, [64, 64]));
        for level in 0..3 {
            let samples = grey
                .sample::<3>(level, [32.0, 30.0], [2.0, 0.5], [-1.0, 3.0])
                .unwrap();
            for (i, line) in samples.iter().enumerate() {
                for (j, sample) in line.iter().enumerate() {
                    let (a, b) = (j as f32 - 1.0, i as f32 - 1.0);
                    let (x, y) = (32.0 + 2.0 * a - b, 30.0 + 0.5 * a + 3.0 * b);
                    // A mean of four pixels is rounded to a whole number.
                    assert!(
                        (sample - (x - 0.5 + 2.0 * (y - 0.5))).abs() < 0.01 + level as f32,
                        "{level} {i} {j}"
                    );
                }
            }
        }
    }

    #[test]
    fn a_grid_that_leaves_the_picture_has_no_samples() {
        let grey = Grey::new(20, 20, vec![7; 400]);
        assert!(
            grey.sample::<7>(0, [3.6, 10.0], [1.0, 0.0], [0.0, 1.0])
                .is_some()
        );
        assert!(
            grey.sample::<7>(0, [3.4, 10.0], [1.0, 0.0], [0.0, 1.0])
                .is_none()
        );
        assert!(
            grey.sample::<7>(0, [16.4, 16.4], [1.0, 0.0], [0.0, 1.0])
                .is_some()
        );
        assert!(
            grey.sample::<7>(0, [16.6, 10.0], [1.0, 0.0], [0.0, 1.0])
                .is_none()
        );
        assert!(
            grey.sample::<7>(0, [10.0, 3.4], [1.0, 0.0], [0.0, 1.0])
                .is_none()
        );
        assert!(
            grey.sample::<7>(0, [10.0, 16.6], [1.0, 0.0], [0.0, 1.0])
                .is_none()
        );
        assert!(
            grey.sample::<7>(0, [f32::NAN, 10.0], [1.0, 0.0], [0.0, 1.0])
                .is_none()
        );
    }

    #[test]
    fn means_are_rounded_to_the_nearest() {
        // Three of four pixels are 1.
        let grey = Grey::new(
            32,
            32,
            (0..32 * 32)
                .map(|i| u8::from(i % 2 == 0 || i / 32 % 2 == 0))
                .collect(),
        );
        assert_eq!(
            grey.sample::<3>(1, [16.0, 16.0], [2.0, 0.0], [0.0, 2.0]),
            Some([[1.0; 3]; 3])
        );
    }
}
