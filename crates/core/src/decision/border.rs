//! Method 5.3: triangles at the border of the surveyed site.

use nalgebra::{Matrix3, Point2, Point3, SymmetricEigen, Vector3};
use rayon::prelude::*;

use crate::model::surface::Surface;

/// Width of the border over that of the site.
const BORDER: f64 = 0.1;
/// Share of the weight that is beyond the site on either side: far background would widen it.
const BEYOND: f64 = 0.01;
/// Number of cells across the width of the site, and the largest number along it.
const CELLS: (f64, f64) = (40.0, 4000.0);
/// A triangle of the border is seen by fewer views than this share of the typical number: the walls
/// of a room are at its outline, too.
const FEW: f64 = 0.5;
/// Largest number of samples along an edge.
const SAMPLES: usize = 200;

/// True for triangles that are within a tenth of the site's width of its outline, along the
/// principal plane, and that few views see. `views`: number that sees each triangle.
pub fn border(surface: &Surface, views: &[u32], weights: &[f64]) -> Vec<bool> {
    let triangles = surface.triangles.len() as u32;
    let mut counts: Vec<_> = views
        .iter()
        .copied()
        .map(f64::from)
        .zip(weights.iter().copied())
        .collect();
    let typical = quantile(&mut counts, 0.5);
    let Some(site) = Site::new(surface, weights) else {
        return vec![false; weights.len()];
    };
    let is_border = |t: u32| {
        f64::from(views[t as usize]) < FEW * typical && site.is_near_outline(&surface.centroid(t))
    };
    (0..triangles).into_par_iter().map(is_border).collect()
}

/// Area that the views show, as cells of a grid in its principal plane.
struct Site {
    axes: [Vector3<f64>; 2],
    low: Point2<f64>,
    cell: f64,
    columns: usize,
    rows: usize,
    /// By cell, row by row: within the width of the border from the outside.
    near: Vec<bool>,
}

impl Site {
    /// `None` where it has no width.
    fn new(surface: &Surface, weights: &[f64]) -> Option<Self> {
        let centroids = surface.centroids();
        let axes = principal_axes(&centroids, weights);
        let ranges = axes.map(|axis| range_along(&axis, &centroids, weights));
        let [first, second] = ranges.map(|[low, high]| high - low);
        let width = first.min(second);
        let cell = (width / CELLS.0).max(first.max(second) / CELLS.1);
        if !(width > 0.0 && cell.is_finite()) {
            return None;
        }
        let mut site = Self::framed(axes, ranges, cell);
        let mut occupied = vec![false; site.columns * site.rows];
        for t in 0..surface.triangles.len() as u32 {
            site.occupy(&surface.corners(t), &mut occupied);
        }
        site.near = site.near(&site.outside(&occupied), BORDER * width / cell);
        Some(site)
    }

    /// Returns a grid of these ranges in a frame of one empty cell, from which the outside is
    /// filled.
    fn framed(axes: [Vector3<f64>; 2], ranges: [[f64; 2]; 2], cell: f64) -> Self {
        let [columns, rows] = ranges.map(|[low, high]| ((high - low) / cell).ceil() as usize + 2);
        Self {
            axes,
            low: Point2::new(ranges[0][0] - cell, ranges[1][0] - cell),
            cell,
            columns,
            rows,
            near: Vec::new(),
        }
    }

    /// Returns column and row of a point; `None` outside of the grid.
    fn cell_of(&self, point: &Point3<f64>) -> Option<(usize, usize)> {
        let [u, v] = self.axes.map(|axis| point.coords.dot(&axis));
        let (column, row) = ((u - self.low.x) / self.cell, (v - self.low.y) / self.cell);
        let inside =
            column >= 0.0 && row >= 0.0 && column < self.columns as f64 && row < self.rows as f64;
        inside.then_some((column as usize, row as usize))
    }

    fn occupy(&self, corners: &[Point3<f64>; 3], occupied: &mut [bool]) {
        let edges = [
            corners[1] - corners[0],
            corners[2] - corners[0],
            corners[2] - corners[1],
        ];
        let longest = edges.iter().map(|edge| edge.norm()).fold(0.0, f64::max);
        // At most half a cell apart, so that no cell inside is missed; only triangles longer than
        // 100 cells may leave gaps.
        let steps = ((2.0 * longest / self.cell).ceil() as usize).clamp(1, SAMPLES);
        for i in 0..=steps {
            for j in 0..=steps - i {
                let point = corners[0] + (edges[0] * i as f64 + edges[1] * j as f64) / steps as f64;
                if let Some((column, row)) = self.cell_of(&point)
                    && (1..self.columns - 1).contains(&column)
                    && (1..self.rows - 1).contains(&row)
                {
                    occupied[row * self.columns + column] = true;
                }
            }
        }
    }

    /// Returns the empty cells that are connected to the edge of the grid: interior holes are not
    /// outside.
    fn outside(&self, occupied: &[bool]) -> Vec<bool> {
        let mut outside = vec![false; occupied.len()];
        let mut open = vec![(0, 0)];
        while let Some((column, row)) = open.pop() {
            let at = row * self.columns + column;
            if std::mem::replace(&mut outside[at], true) {
                continue;
            }
            let around = [
                // 0 wraps to usize::MAX, which `empty` rejects as beyond the last column.
                (column.wrapping_sub(1), row),
                (column + 1, row),
                (column, row.wrapping_sub(1)),
                (column, row + 1),
            ];
            let empty = |&(c, r): &(usize, usize)| {
                c < self.columns && r < self.rows && !occupied[r * self.columns + c]
            };
            open.extend(
                around
                    .into_iter()
                    .filter(empty)
                    .filter(|&(c, r)| !outside[r * self.columns + c]),
            );
        }
        outside
    }

    /// Returns the cells within `radius` cells of an outside cell.
    fn near(&self, outside: &[bool], radius: f64) -> Vec<bool> {
        let mut near = outside.to_vec();
        let reach = radius.floor() as isize;
        let disc: Vec<(isize, isize)> = (-reach..=reach)
            .flat_map(|r| (-reach..=reach).map(move |c| (c, r)))
            .filter(|(c, r)| ((c * c + r * r) as f64) <= radius * radius)
            .collect();
        let cells = (0..self.rows as isize)
            .flat_map(|row| (0..self.columns as isize).map(move |column| (column, row)));
        for (column, row) in cells.filter(|&(c, r)| self.is_outline(outside, c, r)) {
            let around = disc
                .iter()
                .filter_map(|(c, r)| self.index(column + c, row + r));
            around.for_each(|cell| near[cell] = true);
        }
        near
    }

    /// Returns true for the outside cells that others adjoin: only around these can a cell be near
    /// that is not outside itself.
    fn is_outline(&self, outside: &[bool], column: isize, row: isize) -> bool {
        let is_outside = |c, r| self.index(c, r).is_none_or(|cell| outside[cell]);
        is_outside(column, row)
            && [(1, 0), (-1, 0), (0, 1), (0, -1)]
                .iter()
                .any(|(c, r)| !is_outside(column + c, row + r))
    }

    /// Returns the index of a cell; `None` outside of the grid.
    fn index(&self, column: isize, row: isize) -> Option<usize> {
        let inside =
            (0..self.columns as isize).contains(&column) && (0..self.rows as isize).contains(&row);
        inside.then(|| row as usize * self.columns + column as usize)
    }

    fn is_near_outline(&self, point: &Point3<f64>) -> bool {
        self.cell_of(point)
            // Beyond the grid it is beyond the outline, too.
            .is_none_or(|(column, row)| self.near[row * self.columns + column])
    }
}

/// Returns the two principal directions of weighted points.
fn principal_axes(points: &[Point3<f64>], weights: &[f64]) -> [Vector3<f64>; 2] {
    let SymmetricEigen {
        eigenvectors,
        eigenvalues,
    } = covariance(points, weights).symmetric_eigen();
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigenvalues[b].total_cmp(&eigenvalues[a]));
    [
        eigenvectors.column(order[0]).into(),
        eigenvectors.column(order[1]).into(),
    ]
}

/// Returns the covariance of weighted points, times their weight.
fn covariance(points: &[Point3<f64>], weights: &[f64]) -> Matrix3<f64> {
    let all: f64 = weights.iter().sum();
    let sum: Vector3<f64> = points.iter().zip(weights).map(|(p, &w)| p.coords * w).sum();
    let mean = sum / all.max(f64::MIN_POSITIVE);
    let spread = |(p, &w): (&Point3<f64>, &f64)| {
        let from = p.coords - mean;
        from * from.transpose() * w
    };
    points.iter().zip(weights).map(spread).sum()
}

/// Returns the range of weighted points along an axis, without the share [`BEYOND`] at either end.
fn range_along(axis: &Vector3<f64>, points: &[Point3<f64>], weights: &[f64]) -> [f64; 2] {
    let along = points.iter().map(|point| point.coords.dot(axis));
    let mut along: Vec<_> = along.zip(weights.iter().copied()).collect();
    [BEYOND, 1.0 - BEYOND].map(|share| quantile(&mut along, share))
}

/// Returns the weighted quantile: the smallest value up to which the weight reaches `share`; 0
/// without values.
fn quantile(values: &mut [(f64, f64)], share: f64) -> f64 {
    let weight = |values: &[(f64, f64)]| values.iter().map(|(_, weight)| weight).sum::<f64>();
    let mut wanted = share * weight(values);
    let mut left = values;
    while left.len() > 1 {
        let middle = (left.len() - 1) / 2;
        // Ties by weight: sums are rounded, and must not depend on the order of equal values.
        let order = |a: &(f64, f64), b: &(f64, f64)| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1));
        left.select_nth_unstable_by(middle, order);
        let (low, high) = left.split_at_mut(middle + 1);
        let below = weight(low);
        (left, wanted) = if below >= wanted {
            (low, wanted)
        } else {
            (high, wanted - below)
        };
    }
    left.first().map_or(0.0, |(value, _)| *value)
}

#[cfg(test)]
mod tests {
    use proptest::{collection::vec, prelude::*};

    use super::*;
    use crate::model::surface::SurfaceKind;

    /// A field of squares of side 1, without `holes`.
    fn field(columns: u32, rows: u32, holes: &[(u32, u32)]) -> Surface {
        let vertices = (0..=rows)
            .flat_map(|r| (0..=columns).map(move |c| Point3::new(f64::from(c), f64::from(r), 0.0)));
        let at = |c: u32, r: u32| r * (columns + 1) + c;
        let squares = (0..rows)
            .flat_map(|r| (0..columns).map(move |c| (c, r)))
            .filter(|square| !holes.contains(square));
        let triangles = squares.flat_map(|(c, r)| {
            [
                [at(c, r), at(c + 1, r), at(c, r + 1)],
                [at(c + 1, r), at(c + 1, r + 1), at(c, r + 1)],
            ]
        });
        Surface {
            vertices: vertices.collect(),
            triangles: triangles.collect(),
            kind: SurfaceKind::Terrain,
        }
    }

    #[test]
    fn the_outline_is_around_the_site_and_not_around_holes() {
        let surface = field(60, 40, &[(30, 20), (31, 20), (30, 21), (31, 21)]);
        let site = Site::new(&surface, &vec![1.0; surface.triangles.len()]).unwrap();
        let is_near = |x: f64, y: f64| site.is_near_outline(&Point3::new(x, y, 5.0));
        assert!(
            is_near(2.0, 20.0) && is_near(30.0, 38.0) && is_near(58.0, 2.0) && is_near(90.0, 20.0)
        );
        assert!(!is_near(29.0, 20.0) && !is_near(8.0, 20.0) && !is_near(30.0, 32.0));
    }

    #[test]
    fn a_site_without_width_has_no_outline() {
        let surface = field(1, 0, &[]);
        assert!(Site::new(&surface, &[]).is_none());
    }

    #[test]
    fn quantiles_go_by_weight() {
        let mut values = [(3.0, 1.0), (1.0, 8.0), (2.0, 1.0)];
        assert_eq!(
            [0.5, 0.85, 1.0].map(|share| quantile(&mut values, share)),
            [1.0, 2.0, 3.0]
        );
        assert_eq!(quantile(&mut [], 0.5), 0.0);
    }

    proptest! {
        #[test]
        fn a_quantile_is_the_first_value_in_order_that_reaches_the_share(
            values in vec((0u8..9, 0u8..4).prop_map(|(value, weight)| (f64::from(value), f64::from(weight))), 1..30),
            share in (0u8..=8).prop_map(|eighths| f64::from(eighths) / 8.0),
        ) {
            let mut sorted = values.clone();
            sorted.sort_by(|a, b| a.partial_cmp(b).unwrap());
            let wanted = share * sorted.iter().map(|(_, weight)| weight).sum::<f64>();
            let mut sum = 0.0;
            let first = sorted.iter().find(|(_, weight)| {
                sum += weight;
                sum >= wanted
            });
            prop_assert_eq!(quantile(&mut values.clone(), share), first.unwrap().0);
        }
    }
}
