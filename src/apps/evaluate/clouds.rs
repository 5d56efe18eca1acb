//! Compares the fused cloud of the chosen depth maps with that of a full run.

use std::{collections::HashMap, path::Path};

use nalgebra::Point3;
use rayon::prelude::*;
use serde::Serialize;

use super::EvaluateError;
use crate::{
    base::input::{self, FileKind},
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
        let [of_cloud, of_reference] =
            [cloud, reference].map(|points| Cubes::new(points, 3.0 * gsd));
        let distances: Vec<f64> = cloud
            .par_iter()
            .map(|point| of_reference.nearest(point))
            .collect();
        let back: Vec<f64> = reference
            .par_iter()
            .map(|point| of_cloud.nearest(point))
            .collect();
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
        let area = |points| Cubes::new(points, 2.0 * gsd).cubes.len() as f64 * (2.0 * gsd).powi(2);
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

/// Points grouped by the cube that holds them.
struct Cubes<'a> {
    points: &'a [Point3<f64>],
    edge: f64,
    cubes: HashMap<[i64; 3], Vec<u32>>,
}

impl<'a> Cubes<'a> {
    fn new(points: &'a [Point3<f64>], edge: f64) -> Self {
        let mut cubes: HashMap<[i64; 3], Vec<u32>> = HashMap::new();
        (0u32..)
            .zip(points)
            .for_each(|(i, point)| cubes.entry(cube(point, edge)).or_default().push(i));
        Self {
            points,
            edge,
            cubes,
        }
    }

    /// Returns the distance to the nearest point, or infinity if it is farther than the edge of a
    /// cube.
    fn nearest(&self, point: &Point3<f64>) -> f64 {
        let middle = cube(point, self.edge);
        let around = (0..27).map(|i| [i % 3 - 1, i / 3 % 3 - 1, i / 9 - 1]);
        let near = around.filter_map(|offset| {
            self.cubes
                .get(&[0, 1, 2].map(|axis| middle[axis] + offset[axis]))
        });
        let distances = near
            .flatten()
            .map(|&i| (self.points[i as usize] - point).norm());
        distances
            .filter(|d| *d <= self.edge)
            .fold(f64::INFINITY, f64::min)
    }
}

fn cube(point: &Point3<f64>, edge: f64) -> [i64; 3] {
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
