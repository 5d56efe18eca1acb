//! The mathematics of the camera models, each composed of three steps:
//!
//! 1. [`Base`]: from camera coordinates to a plane (perspective division, equidistant fisheye,
//!    ...),
//! 2. [`Warp`]: distortion within that plane,
//! 3. focal lengths and principal point.
//!
//! Formulas and small-angle approximations are COLMAP's, so reprojections agree with it.

use nalgebra::{Matrix2, Matrix2x3, Point3, Unit, Vector2, Vector3};
use std::f64::consts::{FRAC_PI_2, PI};

use super::CameraModel;

/// Least depth of a point in front of the camera, as in COLMAP.
const MIN_DEPTH: f64 = f64::EPSILON;
/// Squared radius or squared omega below which COLMAP evaluates the FOV model as a power series.
const FOV_SERIES: f64 = 1e-4;

/// A camera model with its parameters.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Lens {
    base: Base,
    warp: Warp,
    /// Pixels per unit of the plane.
    pub focal: Vector2<f64>,
    pub centre: Vector2<f64>,
    /// Squared radius in the plane, before the warp, up to which the radial part is one to one.
    limit: f64,
}

/// From camera coordinates to the plane.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Base {
    /// (x/z, y/z)
    Perspective,
    /// (x, y)/ρ · atan(ρ/z), ρ the distance from the axis
    Equidistant,
    /// Fitzgibbon 2001: the plane point p such that (p, 1 + k p²) is parallel to the ray
    Division { k: f64 },
    /// Khomutenko, Garcia, Martinet 2016
    Eucm { alpha: f64, beta: f64 },
    /// (azimuth, elevation downwards), radians
    Spherical,
}

/// Distortion within the plane.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Warp {
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
struct Brown {
    radial: [f64; 6],
    denominator: [f64; 3],
    /// p1, p2 of OpenCV
    tangential: [f64; 2],
    /// Coefficients of s and s², first of x, then of y
    prism: [f64; 4],
    /// True: q is the radially distorted point (Project Aria's model); false: q = p.
    after_radial: bool,
}

impl Lens {
    /// Makes a lens; the length of `params` must be the model's parameter count.
    pub fn new(model: CameraModel, params: &[f64]) -> Self {
        if model == CameraModel::Equirectangular {
            let (w, h) = (params[0], params[1]);
            let (focal, centre) = (
                Vector2::new(w / (2.0 * PI), h / PI),
                Vector2::new(w / 2.0, h / 2.0),
            );
            return Self {
                base: Base::Spherical,
                warp: Warp::None,
                focal,
                centre,
                limit: f64::INFINITY,
            };
        }
        let n = model.focal_length_count();
        let focal = Vector2::new(params[0], params[n - 1]);
        let centre = Vector2::new(params[n], params[n + 1]);
        let (base, warp) = base_and_warp(model, &params[n + 2..]);
        let limit = match base {
            // COLMAP projects only points in front of the camera.
            Base::Equidistant => warp.radial_limit().min(FRAC_PI_2 * FRAC_PI_2),
            _ => warp.radial_limit(),
        };
        Self {
            base,
            warp,
            focal,
            centre,
            limit,
        }
    }

    pub fn project(&self, x: &Point3<f64>) -> Option<Vector2<f64>> {
        let plane = self.base.to_plane(x)?;
        let (warped, jacobian) = match self.warp {
            Warp::None => return Some(self.pixel(&plane)),
            warp => warp.apply_with_jacobian(&plane),
        };
        self.in_field(&plane, &jacobian)
            .then(|| self.pixel(&warped))
    }

    pub fn project_with_jacobian(&self, x: &Point3<f64>) -> Option<(Vector2<f64>, Matrix2x3<f64>)> {
        let plane = self.base.to_plane(x)?;
        let by_point = self.base.jacobian(x)?;
        let (warped, by_plane) = self.warp.apply_with_jacobian(&plane);
        let jacobian = Matrix2::from_diagonal(&self.focal) * by_plane * by_point;
        self.in_field(&plane, &by_plane)
            .then(|| (self.pixel(&warped), jacobian))
    }

    pub fn project_beyond_field(&self, x: &Point3<f64>) -> Option<Vector2<f64>> {
        let plane = self.base.to_plane(x)?;
        Some(self.pixel(&self.warp.apply(&plane)))
    }

    pub fn ray(&self, pixel: Vector2<f64>) -> Option<Unit<Vector3<f64>>> {
        let warped = (pixel - self.centre).component_div(&self.focal);
        let plane = self.unwarp(&warped)?;
        Unit::try_new(self.base.to_ray(&plane)?, 0.0)
    }

    fn pixel(&self, plane: &Vector2<f64>) -> Vector2<f64> {
        self.focal.component_mul(plane) + self.centre
    }

    /// Returns whether the warp is one to one up to this plane point.
    fn in_field(&self, plane: &Vector2<f64>, jacobian: &Matrix2<f64>) -> bool {
        plane.norm_squared() < self.limit && jacobian.determinant() > 0.0
    }

    /// Inverts the warp within the field: bracketing for the radial part, then Newton's method for
    /// the whole.
    fn unwarp(&self, warped: &Vector2<f64>) -> Option<Vector2<f64>> {
        if self.warp == Warp::None {
            return warped.iter().all(|c| c.is_finite()).then_some(*warped);
        }
        let radius = warped.norm();
        if !radius.is_finite() {
            return None;
        }
        let scale = if radius > 0.0 {
            self.unwarp_radius(radius)? / radius
        } else {
            1.0
        };
        let mut plane = warped * scale;
        for _ in 0..50 {
            let (there, jacobian) = self.warp.apply_with_jacobian(&plane);
            let miss = there - warped;
            if miss.norm() <= 1e-14 * (1.0 + radius) {
                return self.in_field(&plane, &jacobian).then_some(plane);
            }
            let step = jacobian.try_inverse()? * miss;
            plane -= step;
            if step.norm() <= 1e-15 * (1.0 + plane.norm()) {
                let (there, jacobian) = self.warp.apply_with_jacobian(&plane);
                let arrived = (there - warped).norm() <= 1e-9 * (1.0 + radius);
                return (arrived && self.in_field(&plane, &jacobian)).then_some(plane);
            }
        }
        None
    }

    /// Inverts the radial part of the warp by bisection; at most the limit of the field.
    fn unwarp_radius(&self, warped: f64) -> Option<f64> {
        let mut high = self.limit.sqrt();
        if high.is_infinite() {
            high = warped.max(1.0);
            while self.warp.radius(high) < warped {
                high *= 2.0;
                if high > 1e9 {
                    return None;
                }
            }
        }
        let mut low = 0.0;
        // 100 halvings end at neighbouring floating-point numbers from any bracket below 1e9.
        for _ in 0..100 {
            let middle = 0.5 * (low + high);
            if middle <= low || middle >= high {
                break;
            }
            if self.warp.radius(middle) < warped {
                low = middle
            } else {
                high = middle
            }
        }
        Some(low)
    }
}

fn base_and_warp(model: CameraModel, extra: &[f64]) -> (Base, Warp) {
    use CameraModel::*;
    let brown = |radial: &[f64]| {
        let mut brown = Brown::default();
        brown.radial[..radial.len()].copy_from_slice(radial);
        brown
    };
    match model {
        SimplePinhole | Pinhole | Equirectangular => (Base::Perspective, Warp::None),
        SimpleRadial | Radial => (Base::Perspective, Warp::Brown(brown(extra))),
        OpenCv => (
            Base::Perspective,
            Warp::Brown(Brown {
                tangential: [extra[2], extra[3]],
                ..brown(&extra[..2])
            }),
        ),
        FullOpenCv => {
            let radial = [extra[0], extra[1], extra[4]];
            let denominator = [extra[5], extra[6], extra[7]];
            let tangential = [extra[2], extra[3]];
            (
                Base::Perspective,
                Warp::Brown(Brown {
                    denominator,
                    tangential,
                    ..brown(&radial)
                }),
            )
        }
        Fov => (Base::Perspective, Warp::Fov { omega: extra[0] }),
        SimpleFisheye | Fisheye => (Base::Equidistant, Warp::None),
        SimpleRadialFisheye | RadialFisheye | OpenCvFisheye => {
            (Base::Equidistant, Warp::Brown(brown(extra)))
        }
        ThinPrismFisheye => {
            let radial = [extra[0], extra[1], extra[4], extra[5]];
            let (tangential, prism) = ([extra[2], extra[3]], [extra[6], 0.0, extra[7], 0.0]);
            (
                Base::Equidistant,
                Warp::Brown(Brown {
                    tangential,
                    prism,
                    ..brown(&radial)
                }),
            )
        }
        RadTanThinPrismFisheye => {
            // p0 and p1 are OpenCV's p2 and p1.
            let (tangential, prism) = (
                [extra[7], extra[6]],
                [extra[8], extra[9], extra[10], extra[11]],
            );
            let warp = Brown {
                tangential,
                prism,
                after_radial: true,
                ..brown(&extra[..6])
            };
            (Base::Equidistant, Warp::Brown(warp))
        }
        SimpleDivision | Division => (Base::Division { k: extra[0] }, Warp::None),
        Eucm => (
            Base::Eucm {
                alpha: extra[0],
                beta: extra[1],
            },
            Warp::None,
        ),
    }
}

impl Base {
    /// Maps a point in camera coordinates to the plane, if it has a plane point.
    fn to_plane(self, x: &Point3<f64>) -> Option<Vector2<f64>> {
        let xy = Vector2::new(x.x, x.y);
        match self {
            Base::Perspective => (x.z >= MIN_DEPTH).then(|| xy / x.z),
            Base::Equidistant => (x.z >= MIN_DEPTH).then(|| {
                let axis = x.x.hypot(x.y);
                let t = axis / x.z;
                if t > f64::EPSILON {
                    xy * (t.atan() / axis)
                } else {
                    xy / x.z
                }
            }),
            Base::Division { k } => {
                let axis = x.x.hypot(x.y);
                let root = (x.z * x.z - 4.0 * k * axis * axis).sqrt();
                // NaN (no real solution) fails the comparison, too; 0 and below is the other branch
                // of the solution.
                (x.z + root > 0.0).then(|| xy * (2.0 / (x.z + root)))
            }
            Base::Eucm { .. } => {
                let (denominator, one_to_one) = self.eucm_denominator(x)?;
                one_to_one.then(|| xy / denominator)
            }
            Base::Spherical => {
                let horizontal = x.x.hypot(x.z);
                let somewhere = horizontal + x.y.abs() >= f64::EPSILON;
                somewhere.then(|| Vector2::new(x.x.atan2(x.z), x.y.atan2(horizontal)))
            }
        }
    }

    /// Denominator of the enhanced unified model, and true where the plane radius grows with the
    /// angle of the ray to the axis.
    fn eucm_denominator(self, x: &Point3<f64>) -> Option<(f64, bool)> {
        let Base::Eucm { alpha, beta } = self else {
            return None;
        };
        let rho = (beta * (x.x * x.x + x.y * x.y) + x.z * x.z).sqrt();
        let denominator = alpha * rho + (1.0 - alpha) * x.z;
        let in_front = x.z >= MIN_DEPTH && denominator >= MIN_DEPTH;
        in_front.then(|| (denominator, alpha * x.z / rho + 1.0 - alpha > 0.0))
    }

    /// Jacobian of [`Base::to_plane`] with respect to the point.
    fn jacobian(self, x: &Point3<f64>) -> Option<Matrix2x3<f64>> {
        let xy = Vector2::new(x.x, x.y);
        let axis_squared = xy.norm_squared();
        // The first four are `xy * q` with q a function of ρ² and z: the Jacobian is q·I plus xy
        // times the gradient of q.
        let (q, by_axis, by_z) = match self {
            Base::Perspective => (1.0 / x.z, 0.0, -1.0 / (x.z * x.z)),
            Base::Equidistant => equidistant_factor(axis_squared.sqrt(), x.z),
            Base::Division { k } => {
                let root = (x.z * x.z - 4.0 * k * axis_squared).sqrt();
                let q = 2.0 / (x.z + root);
                (q, q * q * 2.0 * k / root, -0.5 * q * q * (1.0 + x.z / root))
            }
            Base::Eucm { alpha, beta } => {
                let rho = (beta * axis_squared + x.z * x.z).sqrt();
                let q = 1.0 / (alpha * rho + (1.0 - alpha) * x.z);
                (
                    q,
                    -q * q * alpha * beta / rho,
                    -q * q * (alpha * x.z / rho + 1.0 - alpha),
                )
            }
            Base::Spherical => return spherical_jacobian(x),
        };
        let gradient = Vector3::new(x.x * by_axis, x.y * by_axis, by_z);
        let mut jacobian = xy * gradient.transpose();
        jacobian[(0, 0)] += q;
        jacobian[(1, 1)] += q;
        jacobian.iter().all(|v| v.is_finite()).then_some(jacobian)
    }

    /// Maps a plane point to a vector along its ray: the inverse of [`Base::to_plane`].
    fn to_ray(self, plane: &Vector2<f64>) -> Option<Vector3<f64>> {
        let r2 = plane.norm_squared();
        match self {
            Base::Perspective => Some(plane.push(1.0)),
            Base::Equidistant => {
                let theta = r2.sqrt();
                let sinc = if theta > 1e-8 {
                    theta.sin() / theta
                } else {
                    1.0
                };
                (theta < FRAC_PI_2).then(|| (plane * sinc).push(theta.cos()))
            }
            Base::Division { k } => Some(plane.push(1.0 + k * r2)),
            Base::Eucm { alpha, beta } => {
                let root = (1.0 - (2.0 * alpha - 1.0) * beta * r2).sqrt();
                let z = (1.0 - alpha * alpha * beta * r2) / (alpha * root + 1.0 - alpha);
                (z >= MIN_DEPTH).then(|| plane.push(z))
            }
            Base::Spherical => {
                let (azimuth, down) = (plane.x, plane.y);
                let inside = azimuth.abs() <= PI && down.abs() <= FRAC_PI_2;
                let ray = Vector3::new(
                    down.cos() * azimuth.sin(),
                    down.sin(),
                    down.cos() * azimuth.cos(),
                );
                inside.then_some(ray)
            }
        }
    }
}

/// q = atan(ρ/z)/ρ, (dq/dρ)/ρ and dq/dz.
fn equidistant_factor(axis: f64, z: f64) -> (f64, f64, f64) {
    let t = axis / z;
    let by_z = -1.0 / (axis * axis + z * z);
    if t < 1e-3 {
        let series = 1.0 - t * t / 3.0;
        return (series / z, (-2.0 / 3.0 + 0.8 * t * t) / (z * z * z), by_z);
    }
    let theta = t.atan();
    (
        theta / axis,
        (t / (1.0 + t * t) - theta) / (axis * axis * axis),
        by_z,
    )
}

fn spherical_jacobian(x: &Point3<f64>) -> Option<Matrix2x3<f64>> {
    let horizontal_squared = x.x * x.x + x.z * x.z;
    let horizontal = horizontal_squared.sqrt();
    let all = horizontal_squared + x.y * x.y;
    let down = -x.y / (all * horizontal);
    #[rustfmt::skip]
    let jacobian = Matrix2x3::new(
        x.z / horizontal_squared, 0.0, -x.x / horizontal_squared,
        down * x.x, horizontal / all, down * x.z,
    );
    jacobian.iter().all(|v| v.is_finite()).then_some(jacobian)
}

impl Warp {
    fn apply(&self, p: &Vector2<f64>) -> Vector2<f64> {
        match self {
            Warp::None => *p,
            Warp::Brown(brown) => brown.apply(p),
            Warp::Fov { omega } => p * fov_factor(*omega, p.norm_squared()).0,
        }
    }

    fn apply_with_jacobian(&self, p: &Vector2<f64>) -> (Vector2<f64>, Matrix2<f64>) {
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
    fn radius(&self, r: f64) -> f64 {
        match self {
            Warp::None => r,
            Warp::Brown(brown) => r * brown.factor(r * r).0,
            Warp::Fov { omega } => r * fov_factor(*omega, r * r).0,
        }
    }

    /// Squared radius up to which the radial part is monotonic.
    fn radial_limit(&self) -> f64 {
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
    let value = |s: f64| c.iter().rev().fold(0.0, |sum, c| sum * s + c);
    let derivative: Vec<f64> = c
        .iter()
        .enumerate()
        .skip(1)
        .map(|(i, c)| i as f64 * c)
        .collect();
    // Cauchy's bound on the roots.
    let bound = 1.0
        + c[..last]
            .iter()
            .fold(0.0f64, |max, a| max.max((a / c[last]).abs()));
    let mut stops = vec![0.0];
    stops.extend(
        positive_roots(&derivative)
            .into_iter()
            .filter(|&s| s < bound),
    );
    stops.push(bound.min(f64::MAX));
    let crossing = |ends: &[f64]| {
        let (mut low, mut high) = (ends[0], ends[1]);
        let rising = value(high) > 0.0;
        if (value(low) > 0.0) == rising {
            return None;
        }
        for _ in 0..2000 {
            let middle = low + 0.5 * (high - low);
            if middle <= low || middle >= high {
                break;
            }
            if (value(middle) > 0.0) == rising {
                high = middle
            } else {
                low = middle
            }
        }
        Some(low)
    };
    stops.windows(2).filter_map(crossing).collect()
}
