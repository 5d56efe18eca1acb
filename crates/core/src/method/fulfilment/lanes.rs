//! f of [`LANES`] triangles at once: straight-line arithmetic over small arrays, which the compiler
//! turns into vector instructions.
//!
//! Information matrices are expressed in an orthonormal frame whose third axis points to the key
//! view, and divided by the squared norm of the key view's Jacobian. In this frame the key view
//! measures nothing along the third axis. The partners' contribution along it decides f_unc and is
//! small at small angles; as a component of its own it keeps its relative precision in f32.

use nalgebra::{RealField, convert};

use super::FulfilmentRule;

/// Triangles processed together.
pub const LANES: usize = 16;

/// One number per triangle.
pub type Lanes = [f32; LANES];

/// The key view's contribution to its triangles.
#[derive(Clone, Copy)]
pub struct KeyLanes {
    /// Information matrix of the key view: xx, xy, yy. Its trace is 1.
    pub information: [Lanes; 3],
    /// a_d over the standard deviation of the key view's best direction: f_unc = min(unit
    /// sqrt(smallest eigenvalue), 1).
    pub unit: Lanes,
    /// alpha * f_res.
    pub resolution: Lanes,
}

impl KeyLanes {
    /// No triangles: f is 0.
    pub const EMPTY: Self = Self {
        // A trace of 1, which `smallest_eigenvalue` asks for, in lanes without a triangle, too.
        information: [[0.5; LANES], [0.0; LANES], [0.5; LANES]],
        unit: [0.0; LANES],
        resolution: [0.0; LANES],
    };

    /// Sets the information matrix of a triangle: xx, xy, yy.
    pub fn set_information(&mut self, lane: usize, values: [f64; 3]) {
        for (component, value) in self.information.iter_mut().zip(values) {
            component[lane] = value as f32;
        }
    }
}

/// A partner's contribution; all 0 for triangles that it does not see.
#[derive(Clone, Copy)]
pub struct PartnerLanes {
    /// Information matrix: xx, xy, yy, xz, yz, zz.
    pub information: [Lanes; 6],
    /// Probability of a match, p_i.
    pub confidence: Lanes,
    /// 1 if the partner sees the triangle, else 0.
    pub sees: Lanes,
}

impl PartnerLanes {
    /// Triangles that the partner does not see.
    pub const EMPTY: Self = Self {
        information: [[0.0; LANES]; 6],
        confidence: [0.0; LANES],
        sees: [0.0; LANES],
    };
}

/// Sum over the key view and a set of partners.
#[derive(Clone, Copy)]
pub struct ClusterLanes {
    information: [Lanes; 6],
    /// Probabilities that at least 1, 2 and 3 matches succeed.
    at_least: [Lanes; 3],
    /// Number of partners that see the triangle.
    seeing: Lanes,
}

/// Parameters of f that all triangles share.
#[derive(Clone, Copy)]
pub struct Weights {
    /// 1 - alpha.
    pub uncertainty: f32,
    /// Minimum number of partners that see a triangle.
    pub min_partners: f32,
    /// Minimum number of successful matches; 0: f_conf is 1.
    pub min_matches: u32,
}

impl Weights {
    pub fn new(rule: &FulfilmentRule) -> Self {
        Self {
            uncertainty: (1.0 - rule.alpha) as f32,
            min_partners: rule.min_cameras.saturating_sub(1) as f32,
            min_matches: rule.confidence.min_matches().min(3),
        }
    }
}

impl ClusterLanes {
    #[inline(always)]
    pub fn new(key: &KeyLanes) -> Self {
        let [xx, xy, yy] = key.information;
        let zero = [0.0; LANES];
        Self {
            information: [xx, xy, yy, zero, zero, zero],
            at_least: [zero; 3],
            seeing: zero,
        }
    }

    #[inline(always)]
    pub fn with(mut self, partner: &PartnerLanes) -> Self {
        for i in 0..LANES {
            for c in 0..6 {
                self.information[c][i] += partner.information[c][i];
            }
            let p = partner.confidence[i];
            // From the most matches down: each depends on the next lower one without this partner.
            self.at_least[2][i] += p * (self.at_least[1][i] - self.at_least[2][i]);
            self.at_least[1][i] += p * (self.at_least[0][i] - self.at_least[1][i]);
            self.at_least[0][i] += p * (1.0 - self.at_least[0][i]);
            self.seeing[i] += partner.sees[i];
        }
        self
    }

    /// Returns f_cov * f_conf of each triangle: the probability that it is measured, well or not.
    #[inline(always)]
    pub fn chance(&self, weights: &Weights) -> Lanes {
        let mut chance = match weights.min_matches {
            0 => [1.0; LANES],
            1 => self.at_least[0],
            2 => self.at_least[1],
            _ => self.at_least[2],
        };
        for (chance, seeing) in chance.iter_mut().zip(self.seeing) {
            *chance = if seeing >= weights.min_partners {
                *chance
            } else {
                0.0
            };
        }
        chance
    }

    /// Returns f of each triangle. `T`: f32 to choose by, f64 for results.
    #[inline(always)]
    pub fn value<T: RealField + Copy>(&self, key: &KeyLanes, weights: &Weights) -> [T; LANES] {
        let chance = self.chance(weights);
        let mut f = [T::zero(); LANES];
        for i in 0..LANES {
            let [xx, xy, yy, xz, yz, zz] = &self.information;
            let component = |c: &Lanes| convert::<f64, T>(f64::from(c[i]));
            let smallest = smallest_eigenvalue([xx, xy, yy, xz, yz, zz].map(component));
            let spread = convert::<f64, T>(f64::from(key.unit[i])) * smallest.sqrt();
            // One vector instruction; `min` must handle NaN and takes several.
            let uncertainty = if spread < T::one() { spread } else { T::one() };
            let resolution = convert::<f64, T>(f64::from(key.resolution[i]));
            let weight = convert::<f64, T>(f64::from(weights.uncertainty));
            f[i] = (resolution + weight * uncertainty) * convert::<f64, T>(f64::from(chance[i]));
        }
        f
    }
}

/// Approximates cos((acos(r) + 2 pi) / 3) by a polynomial in sqrt(1 - r), in which it is smooth up
/// to the double root at r = 1; error below 1e-10.
const COSINE: [f64; 11] = [
    -0.50000000008108,
    -0.40824827654124,
    0.055555154875615,
    -0.018895817540484,
    0.0082032578395988,
    -0.0039456398769558,
    0.0019099985782702,
    -0.00082891753541475,
    0.00028033094442683,
    -6.1981782475631e-05,
    6.4873863514301e-06,
];

/// Returns the smallest eigenvalue, at least 0, of a positive semidefinite matrix given by xx, xy,
/// yy, xz, yz, zz, with a trace of at least 1.
///
/// Closed form. Where the eigenvalue is much smaller than the others this form cancels; one Newton
/// step from there finds the root of the characteristic polynomial, whose coefficients do not
/// cancel.
#[inline(always)]
pub fn smallest_eigenvalue<T: RealField + Copy>(matrix: [T; 6]) -> T {
    let c = convert::<f64, T>;
    let closed = closed_form(matrix);
    let [xx, _, yy, ..] = matrix;
    let mean = (xx + yy + matrix[5]) * c(1.0 / 3.0);
    let best = if closed < mean * c(0.05) {
        polished(closed, matrix)
    } else {
        closed
    };
    if best > T::zero() { best } else { T::zero() }
}

#[inline(always)]
fn closed_form<T: RealField + Copy>([xx, xy, yy, xz, yz, zz]: [T; 6]) -> T {
    let c = convert::<f64, T>;
    let mean = (xx + yy + zz) * c(1.0 / 3.0);
    let (kx, ky, kz) = (xx - mean, yy - mean, zz - mean);
    let spread =
        (kx * kx + ky * ky + kz * kz + (xy * xy + xz * xz + yz * yz) * c(2.0)) * c(1.0 / 6.0);
    // With three equal eigenvalues r would be 0 / 0.
    let p = (if spread > c(1e-20) { spread } else { c(1e-20) }).sqrt();
    let determinant =
        kx * (ky * kz - yz * yz) - xy * (xy * kz - xz * yz) + xz * (xy * yz - ky * xz);
    let r = determinant / (p * p * p * c(2.0));
    let below = T::one() - r;
    // Rounding may take r beyond -1 and 1, where the root or the fit does not hold.
    let below = if below < T::zero() { T::zero() } else { below };
    let below = if below > c(2.0) { c(2.0) } else { below };
    let s = below.sqrt();
    let cosine = COSINE
        .iter()
        .rev()
        .fold(T::zero(), |sum, &k| sum * s + c(k));
    mean + p * cosine * c(2.0)
}

/// Takes a Newton step from a root of the characteristic polynomial.
#[inline(always)]
fn polished<T: RealField + Copy>(root: T, [xx, xy, yy, xz, yz, zz]: [T; 6]) -> T {
    let c = convert::<f64, T>;
    let trace = xx + yy + zz;
    let minor = xx * yy - xy * xy;
    let determinant = zz * minor - (xz * xz * yy - xz * yz * xy * c(2.0) + yz * yz * xx);
    let minors = minor + zz * (xx + yy) - xz * xz - yz * yz;
    let value = ((root - trace) * root + minors) * root - determinant;
    let slope = (root * c(3.0) - trace * c(2.0)) * root + minors;
    root - value / slope
}

/// log2 of a positive, normal number; absolute error below 1e-7.
#[inline(always)]
pub fn log2(x: f32) -> f32 {
    // A polynomial fit; its first coefficient is close to a mathematical constant by chance.
    #[allow(clippy::approx_constant)]
    const SERIES: [f32; 9] = [
        1.442695,
        -0.7213475,
        0.48091075,
        -0.36069327,
        0.28790326,
        -0.23916988,
        0.21607823,
        -0.20586188,
        0.12310968,
    ];
    // Chooses the exponent that puts the mantissa between sqrt(1/2) and sqrt(2).
    let exponent = (x.to_bits() as i32 - 0x3f35_04f3) >> 23;
    let m = f32::from_bits((x.to_bits() as i32 - (exponent << 23)) as u32) - 1.0;
    exponent as f32 + m * SERIES.iter().rev().fold(0.0, |sum, k| sum * m + k)
}

/// Returns 2^x for x up to 100; relative error below 1e-7, 0 for x far below 0.
#[inline(always)]
pub fn exp2(x: f32) -> f32 {
    // A polynomial fit, as above, with all digits.
    #[allow(clippy::approx_constant, clippy::excessive_precision)]
    const SERIES: [f32; 7] = [
        1.0,
        0.6931472,
        0.24022651,
        0.055503272,
        0.009618057,
        0.0013400428,
        0.00015461445,
    ];
    /// Adding this constant rounds to an integer, which appears in the lowest bits.
    const ROUND: f32 = 12_582_912.0;
    // Below -127 the exponent would wrap into the sign bit.
    let x = if x > -125.0 { x } else { -125.0 };
    let whole = x + ROUND;
    let rest = x - (whole - ROUND);
    let power =
        f32::from_bits(((whole.to_bits() as i32 - ROUND.to_bits() as i32 + 127) << 23) as u32);
    power * SERIES.iter().rev().fold(0.0, |sum, k| sum * rest + k)
}

/// Returns the angle, radians, from the squared length of its chord on the unit circle; relative
/// error below 1e-6.
#[inline(always)]
pub fn angle_of_chord(squared: f32) -> f32 {
    const SERIES: [f32; 6] = [
        1.0,
        0.16666782,
        0.07494697,
        0.045520636,
        0.023994,
        0.042417374,
    ];
    // From sin^2 of half the angle; beyond 60 degrees from the complement.
    let sin2 = 0.25 * squared;
    let sin2 = if sin2 < 1.0 { sin2 } else { 1.0 };
    let small = sin2 <= 0.25;
    let t = if small {
        sin2
    } else {
        0.5 * (1.0 - sin2.sqrt())
    };
    let asin = t.sqrt() * SERIES.iter().rev().fold(0.0, |sum, k| sum * t + k);
    2.0 * if small {
        asin
    } else {
        std::f32::consts::FRAC_PI_2 - 2.0 * asin
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Vector3};
    use proptest::prelude::*;

    use super::*;

    fn components(m: &Matrix3<f64>) -> [f64; 6] {
        [m.m11, m.m12, m.m22, m.m13, m.m23, m.m33]
    }

    /// Information of views in directions within `spread` of the third axis, at scales of 1/8 to 8;
    /// the first along the axis.
    fn information(views: &[(f64, f64, f64)], spread: f64) -> Matrix3<f64> {
        let of_view = |&(x, y, scale): &(f64, f64, f64)| {
            let d = Vector3::new(spread * x, spread * y, 1.0).normalize();
            (Matrix3::identity() - d * d.transpose()) * 64f64.powf(scale)
        };
        Matrix3::from_diagonal(&Vector3::new(0.5, 0.5, 0.0))
            + views.iter().map(of_view).sum::<Matrix3<f64>>()
    }

    proptest! {
        #[test]
        fn smallest_eigenvalue_is_exact_for_views(
            views in proptest::collection::vec((-1.0..1.0, -1.0..1.0, -1.0..1.0), 1..6),
            spread in -7.0..2.0f64,
        ) {
            let matrix = information(&views, spread.exp2());
            let expected = matrix.symmetric_eigenvalues().min();
            prop_assume!(expected > 1e-9 * matrix.trace());
            let exact = smallest_eigenvalue(components(&matrix));
            prop_assert!((exact / expected - 1.0).abs() < 1e-6, "{exact} {expected}");
            // Rounded as the columns store it.
            let rounded = components(&matrix).map(|c| f64::from(c as f32));
            let written = smallest_eigenvalue(rounded).sqrt();
            let scale_apart = views.iter().map(|v| v.2).fold(0.0, f64::max) > 0.5;
            let tolerance = if scale_apart { 1e-4 } else { 5e-6 };
            prop_assert!((written / expected.sqrt() - 1.0).abs() < tolerance, "{written} {}", expected.sqrt());
            let quick = f64::from(smallest_eigenvalue(components(&matrix).map(|c| c as f32))).sqrt();
            prop_assert!((quick / expected.sqrt() - 1.0).abs() < 2e-3, "{quick} {}", expected.sqrt());
        }

        #[test]
        fn smallest_eigenvalue_is_a_number(c in proptest::array::uniform6(-3.0..3.0f32)) {
            // A sum of squares, possibly singular.
            let rows = [[c[0], c[1], c[2]], [c[3], c[4], c[5]]];
            let product = |a: usize, b: usize| rows[0][a] * rows[0][b] + rows[1][a] * rows[1][b];
            let matrix = [product(0, 0) + 1.0, product(0, 1), product(1, 1), product(0, 2), product(1, 2), product(2, 2)];
            prop_assert!(smallest_eigenvalue(matrix) >= 0.0);
        }

        #[test]
        fn quick_functions_are_exact_enough(x in 1e-6..1e6f32, y in -20.0..20.0f32, angle in 1e-4..3.1f64) {
            prop_assert!((f64::from(log2(x)) - f64::from(x).log2()).abs() < 1e-6 * f64::from(x).log2().abs().max(1.0));
            prop_assert!((f64::from(exp2(y)) / f64::from(y).exp2() - 1.0).abs() < 3e-7);
            let chord = (2.0 * (angle / 2.0).sin()).powi(2);
            prop_assert!((f64::from(angle_of_chord(chord as f32)) / angle - 1.0).abs() < 1e-6 / (3.15 - angle));
        }
    }

    #[test]
    fn degenerate_matrices_have_their_eigenvalues() {
        for (matrix, smallest) in [
            ([1.0, 0.0, 1.0, 0.0, 0.0, 1.0], 1.0),
            ([1.0, 0.0, 1.0, 0.0, 0.0, 3.0], 1.0),
            ([2.0, 0.0, 2.0, 0.0, 0.0, 1.0], 1.0),
            ([0.5, 0.0, 0.5, 0.0, 0.0, 0.0], 0.0),
        ] {
            assert!((smallest_eigenvalue::<f64>(matrix) - smallest).abs() < 1e-7);
            assert!((smallest_eigenvalue(matrix.map(|c| c as f32)) - smallest as f32).abs() < 1e-3);
        }
    }

    #[test]
    fn no_triangle_fulfils_nothing() {
        let weights = Weights {
            uncertainty: 0.5,
            min_partners: 0.0,
            min_matches: 0,
        };
        assert_eq!(
            ClusterLanes::new(&KeyLanes::EMPTY).value::<f32>(&KeyLanes::EMPTY, &weights),
            [0.0; LANES]
        );
        assert_eq!(
            ClusterLanes::new(&KeyLanes::EMPTY).value::<f64>(&KeyLanes::EMPTY, &weights),
            [0.0; LANES]
        );
    }
}
