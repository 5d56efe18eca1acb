//! Compares the fused cloud of the chosen depth maps with that of a full run.

use std::{collections::HashSet, path::Path};

use nalgebra::Point3;
use rayon::prelude::*;
use serde::Serialize;

use super::EvaluateError;
use crate::{
    base::{
        input::{self, FileKind},
        kd_tree::KdTree,
    },
    io::ply,
};

/// Comparison of a fused cloud with a reference that counts as complete and right.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CloudComparison {
    pub points: usize,
    pub reference_points: usize,
    /// Area that the cloud covers, square scene units: one face for each occupied cube, whose edge
    /// is twice the wanted GSD.
    pub area: f64,
    pub reference_area: f64,
    /// Completeness and precision at 2 and 3 times the wanted GSD.
    pub within: Vec<Within>,
    /// Median distance to the nearest reference point, over the points within 3 GSD of the
    /// reference, scene units; null without such points.
    pub error: Option<f64>,
}

/// Shares of the points that have a point of the other cloud nearby.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Within {
    /// Largest distance to count as nearby, in multiples of the wanted GSD.
    pub gsd: f64,
    /// Share of the reference's points with a point of the cloud nearby.
    pub completeness: f64,
    /// Share of the cloud's points with a reference point nearby.
    pub precision: f64,
}

impl CloudComparison {
    /// Reads both PLY files. `gsd`: wanted ground sampling distance, scene units.
    pub fn read(cloud: &Path, reference: &Path, gsd: f64) -> Result<Self, EvaluateError> {
        Ok(Self::new(&points(cloud)?, &points(reference)?, gsd))
    }

    fn new(cloud: &[Point3<f64>], reference: &[Point3<f64>], gsd: f64) -> Self {
        let (distances, back) = (nearest(cloud, reference), nearest(reference, cloud));
        let share = |distances: &[f64], limit: f64| {
            let near = distances.iter().filter(|d| **d <= limit).count();
            if distances.is_empty() {
                0.0
            } else {
                near as f64 / distances.len() as f64
            }
        };
        let within = |gsds: f64| Within {
            gsd: gsds,
            completeness: share(&back, gsds * gsd),
            precision: share(&distances, gsds * gsd),
        };
        let mut near: Vec<f64> = distances
            .iter()
            .copied()
            .filter(|d| *d <= 3.0 * gsd)
            .collect();
        near.sort_by(f64::total_cmp);
        let edge = 2.0 * gsd;
        let area = |points: &[Point3<f64>]| {
            let cubes: HashSet<[i64; 3]> = points.iter().map(|point| cube(point, edge)).collect();
            cubes.len() as f64 * edge.powi(2)
        };
        Self {
            points: cloud.len(),
            reference_points: reference.len(),
            area: area(cloud),
            reference_area: area(reference),
            within: [2.0, 3.0].map(within).to_vec(),
            error: near.get(near.len() / 2).copied(),
        }
    }
}

fn points(path: &Path) -> Result<Vec<Point3<f64>>, EvaluateError> {
    let bytes = input::read(path, FileKind::Mesh).map_err(|source| EvaluateError::CloudFile {
        path: path.into(),
        source,
    })?;
    let cloud = ply::read(&bytes).map_err(|source| EvaluateError::Cloud {
        path: path.into(),
        source,
    })?;
    Ok(cloud.vertices)
}

/// Returns the distance of each point to the nearest of the others, or infinity without any.
fn nearest(points: &[Point3<f64>], others: &[Point3<f64>]) -> Vec<f64> {
    let tree = KdTree::new(others);
    let distance = |point: &Point3<f64>| {
        let [nearest] = tree.nearest(point);
        let nearest = others.get(nearest as usize);
        nearest.map_or(f64::INFINITY, |other| (other - point).norm())
    };
    points.par_iter().map(distance).collect()
}

/// Returns the cube of a grid, of this edge, that a point is in.
pub fn cube(point: &Point3<f64>, edge: f64) -> [i64; 3] {
    [0, 1, 2].map(|axis| (point[axis] / edge).floor() as i64)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A square of `side` points on each side, 1 apart, at a height.
    fn square(side: i32, height: f64) -> Vec<Point3<f64>> {
        (0..side * side)
            .map(|i| Point3::new(f64::from(i % side), f64::from(i / side), height))
            .collect()
    }

    #[test]
    fn half_a_square_is_half_complete_and_precise() {
        let reference = square(20, 0.0);
        let half: Vec<Point3<f64>> = reference
            .iter()
            .filter(|p| p.x < 10.0)
            .map(|p| p + nalgebra::Vector3::z() * 0.1)
            .collect();
        let compared = CloudComparison::new(&half, &reference, 0.3);
        assert_eq!((compared.points, compared.reference_points), (200, 400));
        assert!(
            compared
                .within
                .iter()
                .all(|at| at.precision == 1.0 && at.completeness == 0.5),
            "{compared:?}"
        );
        assert!(
            (compared.error.unwrap() - 0.1).abs() < 1e-9
                && compared.area == 0.5 * compared.reference_area
        );
    }

    #[test]
    fn precision_depends_on_the_distance() {
        let compared = CloudComparison::new(&square(10, 2.5), &square(10, 0.0), 1.0);
        assert_eq!(
            compared
                .within
                .iter()
                .map(|at| at.precision)
                .collect::<Vec<_>>(),
            [0.0, 1.0]
        );
        let nothing = CloudComparison::new(&[], &square(10, 0.0), 1.0);
        assert_eq!((nothing.error, nothing.within[1].completeness), (None, 0.0));
    }
}
