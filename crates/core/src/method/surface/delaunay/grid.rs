//! Integer grid of the predicates.
//!
//! 30 bits per axis and one step for all three axes (different steps would deform spheres): 1 µm
//! for a scene of 1 km, 1 mm with an outlier at 1000 km. The step is a power of two and the origin
//! a multiple of it: a coordinate with few significant bits is not moved, and every grid point has
//! an exact f64 position.

use nalgebra::Point3;

/// Grid coordinates stay below this and above its negative.
pub(super) const HALF_RANGE: i32 = 1 << 29;

/// Ray targets stay within ± this around the ray's start: 128 times the range of the vertices.
pub(super) const TARGET_RANGE: f64 = (1u64 << 37) as f64;

/// Smallest binary exponent of a step whose reciprocal is finite.
const MIN_EXPONENT: i32 = -1000;

/// A distinct grid point. `label` is scratch space of the insertion: it numbers the vertices of the
/// cavity.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C, align(16))]
pub(super) struct Site {
    pub x: i32,
    pub y: i32,
    pub z: i32,
    pub label: u32,
}

impl Site {
    pub fn coordinates(&self) -> [i32; 3] {
        [self.x, self.y, self.z]
    }
}

/// World position = origin + step · grid coordinates.
#[derive(Clone, Copy, Debug)]
pub(super) struct Grid {
    pub origin: [f64; 3],
    pub step: f64,
}

impl Grid {
    /// Returns the finest grid that holds all points; all coordinates must be finite.
    pub fn around(points: &[Point3<f64>]) -> Self {
        let mut low = [f64::INFINITY; 3];
        let mut high = [f64::NEG_INFINITY; 3];
        for p in points {
            for axis in 0..3 {
                low[axis] = low[axis].min(p[axis]);
                high[axis] = high[axis].max(p[axis]);
            }
        }
        if points.is_empty() {
            return Grid {
                origin: [0.0; 3],
                step: 1.0,
            };
        }
        // Halves, because the difference of two finite numbers may be infinite.
        let half = (0..3)
            .map(|axis| 0.5 * high[axis] - 0.5 * low[axis])
            .fold(0.0, f64::max);
        let step = step_for(half);
        let origin = std::array::from_fn(|axis| round_to(0.5 * high[axis] + 0.5 * low[axis], step));
        Grid { origin, step }
    }

    pub fn snap(&self, point: &Point3<f64>) -> Site {
        let [x, y, z] = std::array::from_fn(|axis| {
            let cells = ((point[axis] - self.origin[axis]) / self.step).round();
            (cells as i32).clamp(1 - HALF_RANGE, HALF_RANGE - 1)
        });
        Site { x, y, z, label: 0 }
    }

    pub fn position(&self, site: &Site) -> Point3<f64> {
        let [x, y, z] = site.coordinates();
        Point3::new(
            self.origin[0] + self.step * f64::from(x),
            self.origin[1] + self.step * f64::from(y),
            self.origin[2] + self.step * f64::from(z),
        )
    }

    /// Returns the vector from a site to a world point in grid units, rounded to integers. A target
    /// beyond [`TARGET_RANGE`] is moved towards the site along the line; the second value is the
    /// ratio of the true length to the returned one (1 within the range).
    pub fn vector(&self, from: &Site, target: &Point3<f64>) -> ([i64; 3], f64) {
        let from = from.coordinates();
        let exact: [f64; 3] = std::array::from_fn(|axis| {
            (target[axis] - self.origin[axis]) / self.step - f64::from(from[axis])
        });
        let reach = exact.iter().fold(0.0, |reach: f64, v| reach.max(v.abs()));
        let stretch = (reach / TARGET_RANGE).max(1.0);
        (exact.map(|v| (v / stretch).round() as i64), stretch)
    }
}

/// Returns the smallest power of two that keeps ± `half` within the range, with a margin for
/// rounding.
fn step_for(half: f64) -> f64 {
    let mut exponent = MIN_EXPONENT;
    if half > 0.0 {
        exponent = exponent.max(half.log2().ceil() as i32 - 30);
    }
    while half > 2f64.powi(exponent) * f64::from(HALF_RANGE - 2) {
        exponent += 1;
    }
    2f64.powi(exponent)
}

fn round_to(value: f64, step: f64) -> f64 {
    let steps = value / step;
    // Above 2^52 steps, every f64 is already an integer number of steps.
    if steps.abs() < (1u64 << 52) as f64 {
        steps.round() * step
    } else {
        value
    }
}
