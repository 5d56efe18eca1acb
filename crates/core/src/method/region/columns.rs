//! Spatial index of rectangles: finds those that may contain a point.

use crate::base::rows::Offsets;

/// Largest number of columns along each side.
const MOST: usize = 1024;
/// Average number of entries per rectangle beyond which the grid is made coarser.
const ENTRIES: usize = 16;

/// A rectangle in the plane: low corner, high corner.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rectangle {
    pub low: [f64; 2],
    pub high: [f64; 2],
}

impl Rectangle {
    /// Returns the bounding rectangle of points; empty (low above high) without points.
    pub fn around<'a>(points: impl IntoIterator<Item = &'a [f64; 2]>) -> Self {
        let mut all = Self {
            low: [f64::INFINITY; 2],
            high: [f64::NEG_INFINITY; 2],
        };
        for point in points {
            all.low = [0, 1].map(|axis| all.low[axis].min(point[axis]));
            all.high = [0, 1].map(|axis| all.high[axis].max(point[axis]));
        }
        all
    }

    fn corners(&self) -> [&[f64; 2]; 2] {
        [&self.low, &self.high]
    }
}

/// A grid of square columns, each with the rectangles that touch it.
#[derive(Clone, Debug)]
pub struct Columns {
    all: Rectangle,
    /// Number of columns along each side.
    side: usize,
    offsets: Offsets,
    /// Indices of rectangles, ascending in each column.
    entries: Vec<u32>,
}

impl Columns {
    pub fn new(rectangles: &[Rectangle]) -> Self {
        let all = Rectangle::around(rectangles.iter().flat_map(Rectangle::corners));
        let of_side = |side| Self {
            all,
            side,
            offsets: Offsets::default(),
            entries: Vec::new(),
        };
        let entries = |grid: &Self| {
            rectangles
                .iter()
                .map(|r| grid.touched(r))
                .map(|[x, y]| x.len() * y.len())
                .sum()
        };
        let mut grid = of_side(((rectangles.len() as f64).sqrt() as usize).clamp(1, MOST));
        // Many large rectangles would fill every column.
        while grid.side > 1 && ENTRIES * rectangles.len() < entries(&grid) {
            grid = of_side(grid.side / 2);
        }
        grid.fill(rectangles);
        grid
    }

    fn fill(&mut self, rectangles: &[Rectangle]) {
        let side = self.side;
        let columns = |(i, r): (u32, &Rectangle)| {
            let [x, y] = self.touched(r);
            y.flat_map(move |row| x.clone().map(move |column| (row * side + column, i)))
        };
        let all = || (0..).zip(rectangles).flat_map(columns);
        (self.offsets, self.entries) = Offsets::sorted(side * side, all);
    }

    /// Returns the ranges of columns, along x and y, that a rectangle touches.
    fn touched(&self, rectangle: &Rectangle) -> [std::ops::Range<usize>; 2] {
        [0, 1].map(|axis| {
            self.place(rectangle.low[axis], axis)..self.place(rectangle.high[axis], axis) + 1
        })
    }

    /// Returns the column of a coordinate. The function is monotonic and the same for rectangles
    /// and points, so rounding never separates a point from its rectangles.
    fn place(&self, x: f64, axis: usize) -> usize {
        let extent = self.all.high[axis] - self.all.low[axis];
        let place = (x - self.all.low[axis]) / extent * self.side as f64;
        // An extent of 0 gives NaN, which is column 0.
        (place as usize).min(self.side - 1)
    }

    /// Returns the rectangles that may contain the point, ascending; none if it is outside all of
    /// them.
    pub fn cell(&self, point: [f64; 2]) -> &[u32] {
        let inside = (0..2)
            .all(|axis| self.all.low[axis] <= point[axis] && point[axis] <= self.all.high[axis]);
        if inside {
            &self.entries[self
                .offsets
                .row(self.place(point[1], 1) * self.side + self.place(point[0], 0))]
        } else {
            &[]
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn every_rectangle_around_a_point_is_found(
            corners in proptest::collection::vec((-9.0..9.0f64, -9.0..9.0f64, 0.0..3.0f64, 0.0..9.0f64), 1..60),
            x in -10.0..12.0f64,
            y in -10.0..20.0f64,
        ) {
            let rectangle = |&(x, y, w, h): &(f64, f64, f64, f64)| Rectangle { low: [x, y], high: [x + w, y + h] };
            let all: Vec<Rectangle> = corners.iter().map(rectangle).collect();
            let found = Columns::new(&all);
            for point in [[x, y], all[0].low, all[all.len() - 1].high] {
                let holds = |r: &Rectangle| (0..2).all(|i| r.low[i] <= point[i] && point[i] <= r.high[i]);
                let list = found.cell(point);
                prop_assert!(list.is_sorted());
                prop_assert!((0..all.len()).filter(|&i| holds(&all[i])).all(|i| list.contains(&(i as u32))));
            }
        }
    }
}
