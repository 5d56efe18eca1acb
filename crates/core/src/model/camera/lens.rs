//! The mathematics of the camera models, each composed of three steps:
//!
//! 1. [`Base`]: from camera coordinates to a plane (perspective division, equidistant fisheye,
//!    ...),
//! 2. [`Warp`]: distortion within that plane,
//! 3. focal lengths and principal point.
//!
//! Formulas and small-angle approximations are COLMAP's, so reprojections agree with it.

mod base;
mod warp;

use std::f64::consts::{FRAC_PI_2, PI};

use nalgebra::{Matrix2, Matrix2x3, Point3, Unit, Vector2, Vector3};

use self::{base::Base, warp::Warp};
use super::CameraModel;

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

impl Lens {
    /// Makes a lens; the length of `params` must be the model's parameter count.
    pub fn new(model: CameraModel, params: &[f64]) -> Self {
        if model == CameraModel::Equirectangular {
            return Self::spherical(params[0], params[1]);
        }
        let n = model.focal_length_count();
        let focal = Vector2::new(params[0], params[n - 1]);
        let centre = Vector2::new(params[n], params[n + 1]);
        let extra = &params[n + 2..];
        let (base, warp) = (Base::new(model, extra), Warp::new(model, extra));
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

    /// Makes the lens of a panorama of this size, pixels.
    fn spherical(width: f64, height: f64) -> Self {
        Self {
            base: Base::Spherical,
            warp: Warp::None,
            focal: Vector2::new(width / (2.0 * PI), height / PI),
            centre: Vector2::new(width / 2.0, height / 2.0),
            limit: f64::INFINITY,
        }
    }

    pub fn project(&self, x: &Point3<f64>) -> Option<Vector2<f64>> {
        let plane = self.base.to_plane(x)?;
        let (warped, jacobian) = match self.warp {
            Warp::None => return Some(self.pixel(&plane)),
            // With the Jacobian, since tangential terms may fold the image within the radial limit.
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
        self.unwarp_near(warped * scale, warped)
    }

    /// Inverts the warp by Newton's method, starting at a plane point.
    fn unwarp_near(&self, mut plane: Vector2<f64>, warped: &Vector2<f64>) -> Option<Vector2<f64>> {
        let radius = warped.norm();
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
