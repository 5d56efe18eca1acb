//! Confidence of each view at each triangle that it sees: the sparse points and the mask there
//! (method 7.2). The table has as many rows as that of visibility, so it holds what a row is
//! computed from: a byte for the points, and numbers only where there are masks.

use std::{ops::Range, sync::Mutex};

use nalgebra::Point2;

use super::{
    mask::Mask,
    pictures::{PictureFault, Pictures},
};
use crate::{
    base::{
        column::{Column, TableError},
        progress::Watcher,
    },
    method::geometry::Geometry,
    model::{
        camera::Camera,
        scene::{Scene, ViewIndex},
        surface::Surface,
    },
};

/// Number of sparse points nearest to a triangle that are considered.
pub const AROUND: usize = 8;
/// Confidence if a view observes none of them.
const UNOBSERVED: f32 = 0.5;

/// Unary confidence of each row of the visibility table.
#[derive(Clone, Debug, PartialEq)]
pub struct Unary {
    /// Number of the nearest sparse points that the view observes; empty: no influence.
    observed: Column<u8>,
    /// Number of the nearest sparse points, 1 to [`AROUND`].
    around: u8,
    /// Confidence by that number.
    levels: [f32; AROUND + 1],
    /// Share of the triangle that the view's mask allows, 0 to 1; empty: 1 everywhere.
    allowed: Column<f32>,
}

/// Unary confidence of one view at a triangle (method 7.2).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AtTriangle {
    /// u, by the sparse points that the view observes, 0.5 to 1; 1 without influence.
    pub observed: f32,
    /// m, the share of the triangle that the view's mask allows, 0 to 1.
    pub allowed: f32,
}

impl AtTriangle {
    /// Returns the factor of p_i that the two views of a pair have by themselves, 0 to 1: what one
    /// mask excludes cannot be matched at all.
    pub fn with(self, other: Self) -> f64 {
        let observed = f64::from(self.observed) + f64::from(other.observed);
        0.5 * observed * f64::from(self.allowed) * f64::from(other.allowed)
    }
}

impl Default for Unary {
    fn default() -> Self {
        Self::of_points(Column::default(), AROUND as u8)
    }
}

impl Unary {
    /// Returns 1 everywhere.
    pub fn certain() -> Self {
        Self::default()
    }

    /// Returns 0.5 to 1 by the share of the `around` nearest sparse points that a view observes, at
    /// most all of them.
    pub fn of_points(observed: Column<u8>, around: u8) -> Self {
        let share = |number: usize| (number as f32 / f32::from(around)).min(1.0);
        // On `valley`, the share that `sgm` measures right is 0.54 where the key view observes none
        // of the eight points, and 0.92 where it observes more than a quarter. With 4 to 32 points,
        // orders hardly differ.
        let levels = std::array::from_fn(|number| UNOBSERVED + (1.0 - UNOBSERVED) * share(number));
        Self {
            observed,
            around,
            levels,
            allowed: Column::default(),
        }
    }

    /// Returns this confidence with the shares that masks allow.
    pub fn within(self, allowed: Column<f32>) -> Self {
        Self { allowed, ..self }
    }

    /// Returns the numbers of observed points, of how many, and the shares that masks allow.
    pub fn columns(&self) -> (&Column<u8>, u8, &Column<f32>) {
        (&self.observed, self.around, &self.allowed)
    }

    /// Returns true if it is 1 everywhere.
    pub fn is_certain(&self) -> bool {
        self.observed.is_empty() && self.allowed.is_empty()
    }

    pub fn at(&self, row: usize) -> AtTriangle {
        self.of_rows(row..row + 1).at(0)
    }

    /// Returns a part of the table, which is faster to read in loops.
    pub fn of_rows(&self, rows: Range<usize>) -> UnaryRows<'_> {
        let observed = if self.observed.is_empty() {
            &[][..]
        } else {
            &self.observed[rows.clone()]
        };
        let allowed = if self.allowed.is_empty() {
            &[][..]
        } else {
            &self.allowed[rows]
        };
        UnaryRows {
            observed,
            levels: &self.levels,
            allowed,
        }
    }

    /// Bytes of heap memory.
    pub fn bytes(&self) -> usize {
        self.observed.bytes() + self.allowed.bytes()
    }

    /// Lets the operating system drop pages of a table on disk; they are read again when needed.
    pub fn release(&self) {
        self.observed.release();
        self.allowed.release();
    }

    /// Returns the share of each triangle that the view's mask allows, 1 in views without a mask,
    /// and the faults of masks that cannot be used, by view. `views_at_once`: whose masks are read
    /// at once.
    pub fn of_masks(
        geometry: &Geometry,
        pictures: &dyn Pictures,
        views_at_once: usize,
        watcher: &dyn Watcher,
    ) -> Result<(Column<f32>, Vec<PictureFault>), TableError> {
        let found = Mutex::new(Vec::new());
        let of_view = |_: &mut (), view: ViewIndex| {
            watcher.check()?;
            let mask = pictures.mask(geometry.scene, view).unwrap_or_else(|fault| {
                found.lock().map(|mut found| found.push((view, fault))).ok();
                None
            });
            Ok(allowed_shares(geometry, view, mask.as_ref()))
        };
        let values = geometry.visibility.column(views_at_once, || (), of_view)?;
        let mut faults: Vec<PictureFault> = found.into_inner().unwrap_or_default();
        faults.sort_by_key(|(view, _)| *view);
        Ok((values, faults))
    }
}

/// Unary confidence of some rows of the visibility table.
#[derive(Clone, Copy)]
pub struct UnaryRows<'a> {
    observed: &'a [u8],
    levels: &'a [f32; AROUND + 1],
    allowed: &'a [f32],
}

impl UnaryRows<'_> {
    /// `row`: from the first of these.
    pub fn at(&self, row: usize) -> AtTriangle {
        let observed = self
            .observed
            .get(row)
            .map_or(1.0, |&number| self.levels[usize::from(number)]);
        AtTriangle {
            observed,
            allowed: self.allowed.get(row).copied().unwrap_or(1.0),
        }
    }
}

/// Side of a cell, pixels of the mask.
const CELL: u32 = 8;

/// Share of usable pixels, 0 to 1, in each cell of a grid that covers a mask.
struct UsableShares {
    columns: u32,
    rows: u32,
    /// Row by row.
    values: Vec<f32>,
}

impl UsableShares {
    fn new(mask: &Mask) -> Self {
        let [columns, rows] = [mask.width, mask.height].map(|side| side.div_ceil(CELL));
        let cells = (0..rows).flat_map(|row| (0..columns).map(move |column| (column, row)));
        Self {
            columns,
            rows,
            values: cells
                .map(|(column, row)| mask.share([columns, rows], column, row))
                .collect(),
        }
    }

    fn cell(&self, column: usize, row: usize) -> f32 {
        self.values[row * self.columns as usize + column]
    }
}

/// Returns the share of each triangle that the view sees which its mask allows.
fn allowed_shares(geometry: &Geometry, view: ViewIndex, mask: Option<&Mask>) -> Vec<f32> {
    let triangles = geometry.visibility.triangles_seen_by(view);
    let Some(mask) = mask else {
        return vec![1.0; triangles.len()];
    };
    let shares = UsableShares::new(mask);
    let share = |&t: &u32| mean_over(geometry.scene, geometry.surface, view, t, &shares);
    triangles.iter().map(share).collect()
}

/// Returns the mean of the cells whose centres are in the projected triangle; if there are none,
/// the cell of its centroid.
fn mean_over(
    scene: &Scene,
    surface: &Surface,
    view: ViewIndex,
    triangle: u32,
    shares: &UsableShares,
) -> f32 {
    let (camera, pose) = (scene.camera_of(view), &scene.view(view).cam_from_world);
    let place = |x| {
        camera
            .project(&pose.camera_from_world(&x))
            .map(|pixel| in_cells(camera, shares, &pixel))
    };
    let [a, b, c] = surface.corners(triangle).map(place);
    let inside = match (a, b, c) {
        (Some(a), Some(b), Some(c)) => mean_inside(shares, [a, b, c]),
        _ => None,
    };
    inside.unwrap_or_else(|| {
        // It projects, or the view would not see the triangle.
        let centroid = place(surface.centroid(triangle)).unwrap_or_default();
        shares.cell(
            cell(centroid.x, shares.columns),
            cell(centroid.y, shares.rows),
        )
    })
}

/// Converts a pixel of the camera's image to cells of the grid.
fn in_cells(camera: &Camera, shares: &UsableShares, pixel: &Point2<f64>) -> Point2<f64> {
    Point2::new(
        pixel.x / f64::from(camera.width) * f64::from(shares.columns),
        pixel.y / f64::from(camera.height) * f64::from(shares.rows),
    )
}

fn cell(position: f64, cells: u32) -> usize {
    // `as` saturates at the ends of the range.
    (position as usize).min(cells as usize - 1)
}

fn mean_inside(shares: &UsableShares, corners: [Point2<f64>; 3]) -> Option<f32> {
    let columns = cells_between(corners.map(|corner| corner.x), shares.columns);
    let rows = cells_between(corners.map(|corner| corner.y), shares.rows);
    let (mut sum, mut count) = (0.0, 0u32);
    for (row, column) in rows.flat_map(|row| columns.clone().map(move |column| (row, column))) {
        let centre = Point2::new(column as f64 + 0.5, row as f64 + 0.5);
        if is_inside(corners, centre) {
            sum += shares.cell(column, row);
            count += 1;
        }
    }
    (count > 0).then(|| sum / count as f32)
}

/// Returns the columns or rows of the cells that three coordinates span.
fn cells_between([a, b, c]: [f64; 3], cells: u32) -> Range<usize> {
    cell(a.min(b).min(c), cells)..cell(a.max(b).max(c), cells) + 1
}

/// Returns whether a point is in a triangle, whichever way its corners go around.
fn is_inside([a, b, c]: [Point2<f64>; 3], x: Point2<f64>) -> bool {
    let side = |p: Point2<f64>, q: Point2<f64>| (q - p).perp(&(x - p));
    let sides = [side(a, b), side(b, c), side(c, a)];
    sides.iter().all(|&s| s >= 0.0) || sides.iter().all(|&s| s <= 0.0)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// A grid that grows linearly to the right: its mean over a region is its value at the region's
    /// centre.
    fn ramp(columns: u32, rows: u32) -> UsableShares {
        let value = move |i: u32| (i % columns) as f32 / (columns - 1) as f32;
        UsableShares {
            columns,
            rows,
            values: (0..columns * rows).map(value).collect(),
        }
    }

    proptest! {
        #[test]
        fn the_mean_of_a_ramp_is_its_value_at_the_centroid(
            x in proptest::array::uniform3(0.0..100.0f64),
            y in proptest::array::uniform3(0.0..80.0f64),
        ) {
            let corners = [0, 1, 2].map(|i| Point2::new(x[i], y[i]));
            let area = 0.5 * (corners[1] - corners[0]).perp(&(corners[2] - corners[0])).abs();
            prop_assume!(area > 400.0);
            let mean = f64::from(mean_inside(&ramp(100, 80), corners).unwrap());
            let expected = ((x.iter().sum::<f64>() / 3.0 - 0.5) / 99.0).clamp(0.0, 1.0);
            prop_assert!((mean - expected).abs() < 0.02, "{} {}", mean, expected);
        }
    }

    #[test]
    fn a_triangle_between_the_centres_holds_none() {
        let corners = [[0.6, 0.6], [0.9, 0.6], [0.6, 0.9]].map(Point2::from);
        assert_eq!(mean_inside(&ramp(10, 10), corners), None);
    }
}
