//! What measurements say of a point: the information matrix of section 3.3 and its smallest eigenvalue.

use std::ops::{Add, AddAssign};

use nalgebra::{Matrix2x3, Matrix3};

/// A symmetric 3 x 3 matrix: xx, xy, xz, yy, yz, zz. In units of 1 / a_d², so that 1 stands for the wanted accuracy.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Information(pub [f64; 6]);

/// Newton steps that a simple root needs at most; near a multiple one the method is slow and inexact.
const MOST_STEPS: usize = 12;

impl Information {
    /// `factor` · JᵀJ for a Jacobian J of pixels by world coordinates.
    pub fn of(jacobian: &Matrix2x3<f64>, factor: f64) -> Self {
        let [a, b] = [jacobian.row(0), jacobian.row(1)];
        let entry = |i: usize, j: usize| factor * (a[i] * a[j] + b[i] * b[j]);
        Self([entry(0, 0), entry(0, 1), entry(0, 2), entry(1, 1), entry(1, 2), entry(2, 2)])
    }

    /// The smallest eigenvalue, as far as it is below 1; 1 where it is 1 or more; 0 for a singular matrix.
    ///
    /// The smallest root of the characteristic polynomial λ³ − c₂λ² + c₁λ − c₀ by Newton's method from 0: left of the smallest root the
    /// polynomial of a positive semidefinite matrix is increasing and concave, so the steps rise to the root and never pass it.
    pub fn smallest_eigenvalue_to_one(&self) -> f64 {
        let [xx, xy, xz, yy, yz, zz] = self.0;
        let (m0, m1, m2) = (yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy);
        let c2 = xx + yy + zz;
        let c1 = m0 + m1 + m2;
        let c0 = xx * m0 - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz);
        // Below the rounding error of the determinant nothing is known of the smallest eigenvalue.
        if c0.is_nan() || c0 <= 1e-14 * c1 * c2 {
            return 0.0;
        }
        let mut root = 0.0;
        for _ in 0..MOST_STEPS {
            let value = ((c2 - root) * root - c1) * root + c0;
            let slope = (2.0 * c2 - 3.0 * root) * root - c1;
            let step = -value / slope;
            root += step;
            if root >= 1.0 {
                return 1.0;
            }
            if step <= 1e-12 * root {
                return root;
            }
        }
        self.matrix().symmetric_eigenvalues().min().clamp(0.0, 1.0)
    }

    /// As a matrix, for tests and for people.
    pub fn matrix(&self) -> Matrix3<f64> {
        let [xx, xy, xz, yy, yz, zz] = self.0;
        Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz)
    }
}

impl AddAssign for Information {
    fn add_assign(&mut self, other: Self) {
        self.0.iter_mut().zip(other.0).for_each(|(a, b)| *a += b);
    }
}

impl Add for Information {
    type Output = Self;

    fn add(mut self, other: Self) -> Self {
        self += other;
        self
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn the_smallest_eigenvalue_is_nalgebra_s(entries in prop::array::uniform18(-1.0f64..1.0), scale in 1e-3f64..1e3) {
            let mut sum = Information::default();
            for j in entries.chunks_exact(6) {
                sum += Information::of(&Matrix2x3::from_row_slice(j), scale);
            }
            let expected = sum.matrix().symmetric_eigenvalues().min().clamp(0.0, 1.0);
            let found = sum.smallest_eigenvalue_to_one();
            let largest = sum.matrix().symmetric_eigenvalues().max();
            prop_assert!((found - expected).abs() <= 1e-9 * expected + 1e-12 * largest, "{found} {expected}");
        }
    }

    #[test]
    fn a_single_camera_knows_nothing_along_its_ray() {
        let one = Information::of(&Matrix2x3::new(3.0, 0.0, 1.0, 0.0, 2.0, 1.0), 1.0);
        assert_eq!(one.smallest_eigenvalue_to_one(), 0.0);
        assert_eq!(Information::default().smallest_eigenvalue_to_one(), 0.0);
    }

    #[test]
    fn three_equal_eigenvalues_are_found() {
        let ball = Information([0.3, 0.0, 0.0, 0.3, 0.0, 0.3]);
        assert!((ball.smallest_eigenvalue_to_one() - 0.3).abs() < 1e-12);
        assert_eq!(Information([5.0, 0.0, 0.0, 5.0, 0.0, 5.0]).smallest_eigenvalue_to_one(), 1.0);
    }
}
