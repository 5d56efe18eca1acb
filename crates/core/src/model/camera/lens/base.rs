//! The first step of a camera model: from camera coordinates to a plane.

use std::f64::consts::{FRAC_PI_2, PI};

use nalgebra::{Matrix2x3, Point3, Vector2, Vector3};

use crate::model::camera::CameraModel;

/// Least depth of a point in front of the camera, as in COLMAP.
const MIN_DEPTH: f64 = f64::EPSILON;

/// From camera coordinates to the plane.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Base {
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

/// q of a base that maps (x, y) to `(x, y) q`, with its derivatives.
struct Factor {
    q: f64,
    /// (dq/dρ)/ρ, ρ the distance from the axis.
    by_axis: f64,
    by_z: f64,
}

impl Base {
    /// `extra`: the model's parameters after the principal point.
    pub fn new(model: CameraModel, extra: &[f64]) -> Self {
        use CameraModel::*;
        match model {
            SimplePinhole | Pinhole | SimpleRadial | Radial | OpenCv | FullOpenCv | Fov => {
                Self::Perspective
            }
            SimpleFisheye
            | Fisheye
            | SimpleRadialFisheye
            | RadialFisheye
            | OpenCvFisheye
            | ThinPrismFisheye
            | RadTanThinPrismFisheye => Self::Equidistant,
            SimpleDivision | Division => Self::Division { k: extra[0] },
            Eucm => Self::Eucm {
                alpha: extra[0],
                beta: extra[1],
            },
            Equirectangular => Self::Spherical,
        }
    }

    /// Maps a point in camera coordinates to the plane, if it has a plane point.
    pub fn to_plane(self, x: &Point3<f64>) -> Option<Vector2<f64>> {
        let xy = Vector2::new(x.x, x.y);
        match self {
            Base::Perspective => (x.z >= MIN_DEPTH).then(|| xy / x.z),
            Base::Equidistant => (x.z >= MIN_DEPTH).then(|| equidistant(x)),
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
            Base::Spherical => spherical_angles(x),
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
    pub fn jacobian(self, x: &Point3<f64>) -> Option<Matrix2x3<f64>> {
        if self == Base::Spherical {
            return spherical_jacobian(x);
        }
        // The others are `xy * q` with q a function of ρ² and z: the Jacobian is q·I plus xy times
        // the gradient of q.
        let xy = Vector2::new(x.x, x.y);
        let Factor { q, by_axis, by_z } = self.factor(xy.norm_squared(), x.z);
        let gradient = Vector3::new(x.x * by_axis, x.y * by_axis, by_z);
        let mut jacobian = xy * gradient.transpose();
        jacobian[(0, 0)] += q;
        jacobian[(1, 1)] += q;
        jacobian.iter().all(|v| v.is_finite()).then_some(jacobian)
    }

    /// Returns q where that is defined. `axis_squared`: ρ².
    fn factor(self, axis_squared: f64, z: f64) -> Factor {
        match self {
            Base::Perspective | Base::Spherical => Factor {
                q: 1.0 / z,
                by_axis: 0.0,
                by_z: -1.0 / (z * z),
            },
            Base::Equidistant => equidistant_factor(axis_squared.sqrt(), z),
            Base::Division { k } => {
                let root = (z * z - 4.0 * k * axis_squared).sqrt();
                let q = 2.0 / (z + root);
                Factor {
                    q,
                    by_axis: q * q * 2.0 * k / root,
                    by_z: -0.5 * q * q * (1.0 + z / root),
                }
            }
            Base::Eucm { alpha, beta } => {
                let rho = (beta * axis_squared + z * z).sqrt();
                let q = 1.0 / (alpha * rho + (1.0 - alpha) * z);
                Factor {
                    q,
                    by_axis: -q * q * alpha * beta / rho,
                    by_z: -q * q * (alpha * z / rho + 1.0 - alpha),
                }
            }
        }
    }

    /// Maps a plane point to a vector along its ray: the inverse of [`Base::to_plane`].
    pub fn to_ray(self, plane: &Vector2<f64>) -> Option<Vector3<f64>> {
        let r2 = plane.norm_squared();
        match self {
            Base::Perspective => Some(plane.push(1.0)),
            Base::Equidistant => {
                let theta = r2.sqrt();
                // On the axis it would be 0 / 0.
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
            Base::Spherical => spherical_ray(plane.x, plane.y),
        }
    }
}

fn equidistant(x: &Point3<f64>) -> Vector2<f64> {
    let xy = Vector2::new(x.x, x.y);
    let axis = x.x.hypot(x.y);
    let t = axis / x.z;
    if t > f64::EPSILON {
        xy * (t.atan() / axis)
    } else {
        xy / x.z
    }
}

/// Returns the direction of a point; `None` at the centre.
fn spherical_angles(x: &Point3<f64>) -> Option<Vector2<f64>> {
    let horizontal = x.x.hypot(x.z);
    let somewhere = horizontal + x.y.abs() >= f64::EPSILON;
    somewhere.then(|| Vector2::new(x.x.atan2(x.z), x.y.atan2(horizontal)))
}

/// Returns the vector in a direction; `None` beyond the panorama.
fn spherical_ray(azimuth: f64, down: f64) -> Option<Vector3<f64>> {
    let inside = azimuth.abs() <= PI && down.abs() <= FRAC_PI_2;
    let ray = Vector3::new(
        down.cos() * azimuth.sin(),
        down.sin(),
        down.cos() * azimuth.cos(),
    );
    inside.then_some(ray)
}

/// q = atan(ρ/z)/ρ.
fn equidistant_factor(axis: f64, z: f64) -> Factor {
    let t = axis / z;
    let by_z = -1.0 / (axis * axis + z * z);
    // Near the axis, the difference below cancels.
    if t < 1e-3 {
        let series = 1.0 - t * t / 3.0;
        return Factor {
            q: series / z,
            by_axis: (-2.0 / 3.0 + 0.8 * t * t) / (z * z * z),
            by_z,
        };
    }
    let theta = t.atan();
    Factor {
        q: theta / axis,
        by_axis: (t / (1.0 + t * t) - theta) / (axis * axis * axis),
        by_z,
    }
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
