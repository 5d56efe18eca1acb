//! The second step of a camera model: distortion within the plane.

use nalgebra::{Matrix2, Vector2};

use crate::model::camera::CameraModel;

/// Squared radius or squared omega below which COLMAP evaluates the FOV model as a power series.
const FOV_SERIES: f64 = 1e-4;

/// Distortion within the plane.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Warp {
    None,
    Brown(Brown),
    /// Devernay, Faugeras 2001
    Fov {
        omega: f64,
    },
}

/// Radial, tangential and thin-prism distortion, s the squared radius:
/// `p·R(s) + tangential(q) + prism(q)`, `R = (1 + Σ radial_i s^i) / (1 + Σ denominator_i s^i)`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Brown {
    radial: [f64; 6],
    denominator: [f64; 3],
    /// p1, p2 of OpenCV
    tangential: [f64; 2],
    /// Coefficients of s and s², first of x, then of y
    prism: [f64; 4],
    /// True: q is the radially distorted point (Project Aria's model); false: q = p.
    after_radial: bool,
}

impl Warp {
    /// `extra`: the model's parameters after the principal point.
    pub fn new(model: CameraModel, extra: &[f64]) -> Self {
        use CameraModel::*;
        match model {
            SimplePinhole | Pinhole | SimpleFisheye | Fisheye | SimpleDivision | Division
            | Eucm | Equirectangular => Self::None,
            Fov => Self::Fov { omega: extra[0] },
            SimpleRadial | Radial | SimpleRadialFisheye | RadialFisheye | OpenCvFisheye => {
                Self::Brown(Brown::radial(extra))
            }
            OpenCv => Self::Brown(Brown {
                tangential: [extra[2], extra[3]],
                ..Brown::radial(&extra[..2])
            }),
            // In OpenCV's order, the tangential p1 and p2 come between k2 and k3.
            FullOpenCv => Self::Brown(Brown {
                tangential: [extra[2], extra[3]],
                denominator: [extra[5], extra[6], extra[7]],
                ..Brown::radial(&[extra[0], extra[1], extra[4]])
            }),
            ThinPrismFisheye => Self::Brown(Brown {
                tangential: [extra[2], extra[3]],
                prism: [extra[6], 0.0, extra[7], 0.0],
                ..Brown::radial(&[extra[0], extra[1], extra[4], extra[5]])
            }),
            RadTanThinPrismFisheye => Self::Brown(Brown {
                // p0 and p1 are OpenCV's p2 and p1.
                tangential: [extra[7], extra[6]],
                prism: [extra[8], extra[9], extra[10], extra[11]],
                after_radial: true,
                ..Brown::radial(&extra[..6])
            }),
        }
    }

    pub fn apply(&self, p: &Vector2<f64>) -> Vector2<f64> {
        match self {
            Warp::None => *p,
            Warp::Brown(brown) => brown.apply(p),
            Warp::Fov { omega } => p * fov_factor(*omega, p.norm_squared()).0,
        }
    }

    pub fn apply_with_jacobian(&self, p: &Vector2<f64>) -> (Vector2<f64>, Matrix2<f64>) {
        match self {
            Warp::None => (*p, Matrix2::identity()),
            Warp::Brown(brown) => brown.apply_with_jacobian(p),
            Warp::Fov { omega } => {
                let (factor, by_s) = fov_factor(*omega, p.norm_squared());
                (
                    p * factor,
                    Matrix2::from_diagonal_element(factor) + p * p.transpose() * (2.0 * by_s),
                )
            }
        }
    }

    /// Radius after the radial part of the warp.
    pub fn radius(&self, r: f64) -> f64 {
        match self {
            Warp::None => r,
            Warp::Brown(brown) => r * brown.factor(r * r).0,
            Warp::Fov { omega } => r * fov_factor(*omega, r * r).0,
        }
    }

    /// Squared radius up to which the radial part is monotonic.
    pub fn radial_limit(&self) -> f64 {
        match self {
            Warp::None => f64::INFINITY,
            Warp::Brown(brown) => brown.radial_limit(),
            Warp::Fov { omega } => {
                if fov_factor(*omega, 1.0).0 > 0.0 {
                    f64::INFINITY
                } else {
                    0.0
                }
            }
        }
    }
}

impl Brown {
    fn radial(coefficients: &[f64]) -> Self {
        let mut brown = Self::default();
        brown.radial[..coefficients.len()].copy_from_slice(coefficients);
        brown
    }

    fn apply(&self, p: &Vector2<f64>) -> Vector2<f64> {
        let radial = p * self.factor(p.norm_squared()).0;
        radial + self.decentring(if self.after_radial { &radial } else { p })
    }

    fn apply_with_jacobian(&self, p: &Vector2<f64>) -> (Vector2<f64>, Matrix2<f64>) {
        let (factor, by_s) = self.factor(p.norm_squared());
        let radial = p * factor;
        let by_p = Matrix2::from_diagonal_element(factor) + p * p.transpose() * (2.0 * by_s);
        if self.after_radial {
            (
                radial + self.decentring(&radial),
                (Matrix2::identity() + self.decentring_jacobian(&radial)) * by_p,
            )
        } else {
            (
                radial + self.decentring(p),
                by_p + self.decentring_jacobian(p),
            )
        }
    }

    /// R and dR/ds.
    fn factor(&self, s: f64) -> (f64, f64) {
        let (n, dn) = one_plus_series(&self.radial, s);
        let (d, dd) = one_plus_series(&self.denominator, s);
        (n / d, (dn * d - n * dd) / (d * d))
    }

    /// The tangential and thin-prism terms.
    fn decentring(&self, q: &Vector2<f64>) -> Vector2<f64> {
        let [p1, p2] = self.tangential;
        let [sx1, sx2, sy1, sy2] = self.prism;
        let s = q.norm_squared();
        let xy2 = 2.0 * q.x * q.y;
        Vector2::new(
            p1 * xy2 + p2 * (s + 2.0 * q.x * q.x) + (sx1 + sx2 * s) * s,
            p2 * xy2 + p1 * (s + 2.0 * q.y * q.y) + (sy1 + sy2 * s) * s,
        )
    }

    fn decentring_jacobian(&self, q: &Vector2<f64>) -> Matrix2<f64> {
        let [p1, p2] = self.tangential;
        let [sx1, sx2, sy1, sy2] = self.prism;
        let s = q.norm_squared();
        let (x_by_s, y_by_s) = (2.0 * (sx1 + 2.0 * sx2 * s), 2.0 * (sy1 + 2.0 * sy2 * s));
        Matrix2::new(
            2.0 * p1 * q.y + 6.0 * p2 * q.x + x_by_s * q.x,
            2.0 * p1 * q.x + 2.0 * p2 * q.y + x_by_s * q.y,
            2.0 * p2 * q.y + 2.0 * p1 * q.x + y_by_s * q.x,
            2.0 * p2 * q.x + 6.0 * p1 * q.y + y_by_s * q.y,
        )
    }

    /// The smaller of the first positive roots, in s, of d(r R)/dr, whose numerator is `N D + 2 s
    /// (N' D - N D')`, and of D.
    fn radial_limit(&self) -> f64 {
        let n = [&[1.0], &self.radial[..]].concat();
        let d = [&[1.0], &self.denominator[..]].concat();
        let mut numerator = vec![0.0; n.len() + d.len() - 1];
        for (i, a) in n.iter().enumerate() {
            for (j, b) in d.iter().enumerate() {
                numerator[i + j] += a * b * (1.0 + 2.0 * (i as f64 - j as f64));
            }
        }
        let first = |polynomial: &[f64]| {
            positive_roots(polynomial)
                .first()
                .copied()
                .unwrap_or(f64::INFINITY)
        };
        first(&numerator).min(first(&d))
    }
}

/// 1 + c₁ s + c₂ s² + ... and its derivative.
fn one_plus_series(c: &[f64], s: f64) -> (f64, f64) {
    let (mut value, mut derivative) = (0.0, 0.0);
    for &c in c.iter().rev() {
        derivative = derivative * s + value;
        value = value * s + c;
    }
    (1.0 + value * s, derivative * s + value)
}

/// Factor of the FOV model at squared radius s, and its derivative by s. COLMAP's power series for
/// small omega has the sign of the inverse; its models were optimised with that sign, so it is kept
/// here.
fn fov_factor(omega: f64, s: f64) -> (f64, f64) {
    let omega2 = omega * omega;
    if omega2 < FOV_SERIES {
        return (1.0 + omega2 * (s / 3.0 - 1.0 / 12.0), omega2 / 3.0);
    }
    let t = (0.5 * omega).tan();
    if s < FOV_SERIES {
        return (
            2.0 * t * (3.0 - 4.0 * s * t * t) / (3.0 * omega),
            -8.0 * t * t * t / (3.0 * omega),
        );
    }
    let r = s.sqrt();
    let angle = (2.0 * r * t).atan();
    let by_r = 2.0 * t / (1.0 + 4.0 * s * t * t);
    (angle / (r * omega), (by_r - angle / r) / (2.0 * s * omega))
}

/// Positive roots of `Σ c_i s^i` where it changes sign, ascending. Between two neighbouring roots
/// of the derivative there is at most one.
fn positive_roots(c: &[f64]) -> Vec<f64> {
    let Some(last) = c.iter().rposition(|&c| c != 0.0).filter(|&last| last > 0) else {
        return Vec::new();
    };
    let c = &c[..=last];
    let derivative: Vec<f64> = c
        .iter()
        .enumerate()
        .skip(1)
        .map(|(i, c)| i as f64 * c)
        .collect();
    let bound = cauchy_bound(&c[..last], c[last]);
    let between = positive_roots(&derivative);
    let between = between.into_iter().filter(|&s| s < bound);
    let mut stops = vec![0.0];
    stops.extend(between);
    stops.push(bound.min(f64::MAX));
    let crossing = |ends: &[f64]| crossing(c, ends[0], ends[1]);
    stops.windows(2).filter_map(crossing).collect()
}

/// Returns a bound on the roots of a polynomial with this last coefficient.
fn cauchy_bound(others: &[f64], last: f64) -> f64 {
    let ratios = others.iter().map(|c| (c / last).abs());
    1.0 + ratios.fold(0.0, f64::max)
}

/// Returns where `Σ c_i s^i` changes sign, by bisection; `None` if it has the same sign at both
/// ends.
fn crossing(c: &[f64], mut low: f64, mut high: f64) -> Option<f64> {
    let is_positive = |s: f64| c.iter().rev().fold(0.0, |sum, c| sum * s + c) > 0.0;
    let rising = is_positive(high);
    if is_positive(low) == rising {
        return None;
    }
    // The bracket may end at the largest number, a thousand halvings above 1.
    for _ in 0..2000 {
        let middle = low + 0.5 * (high - low);
        if middle <= low || middle >= high {
            break;
        }
        if is_positive(middle) == rising {
            high = middle
        } else {
            low = middle
        }
    }
    Some(low)
}
