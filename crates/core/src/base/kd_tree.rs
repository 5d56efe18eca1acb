//! Nearest points by an implicit k-d tree.

use std::ops::Range;

use nalgebra::{Point3, Vector3};

use super::tiles::longest_axis;

/// Points of a part of the tree that is not split.
const LEAF: usize = 8;

/// Points in the order of the tree: the one in the middle of each range splits the range.
pub struct KdTree {
    places: Vec<Point3<f64>>,
    /// Index of each point in the list that the tree was made of.
    indices: Vec<u32>,
    /// Axis along which each point splits its range.
    axes: Vec<u8>,
    /// Low and high corner of all points.
    bounds: [Point3<f64>; 2],
}

impl KdTree {
    pub fn new(points: &[Point3<f64>]) -> Self {
        let mut indices: Vec<u32> = (0..points.len() as u32).collect();
        let mut axes = vec![0; points.len()];
        split(points, &mut indices, &mut axes);
        let places = indices
            .iter()
            .map(|&index| points[index as usize])
            .collect();
        let mut bounds = [f64::INFINITY, f64::NEG_INFINITY].map(|x| Point3::new(x, x, x));
        for (point, axis) in points.iter().flat_map(|p| [0, 1, 2].map(|axis| (p, axis))) {
            bounds[0][axis] = point[axis].min(bounds[0][axis]);
            bounds[1][axis] = point[axis].max(bounds[1][axis]);
        }
        Self {
            places,
            indices,
            axes,
            bounds,
        }
    }

    /// Returns the indices of the N nearest points, nearest first, ties by index; fewer points are
    /// followed by `u32::MAX`.
    pub fn nearest<const N: usize>(&self, to: &Point3<f64>) -> [u32; N] {
        let mut found = [(f64::INFINITY, u32::MAX); N];
        let [low, high] = &self.bounds;
        let away = |axis: usize| (low[axis] - to[axis]).max(to[axis] - high[axis]).max(0.0);
        let away = Vector3::new(away(0), away(1), away(2));
        self.look(to, 0..self.places.len(), away, &mut found);
        found.map(|(_, index)| index)
    }

    /// Returns the place in the box of all points that is nearest to this one. From there a search
    /// ends soon; from far away all points are about equally far.
    pub fn in_bounds(&self, place: &Point3<f64>) -> Point3<f64> {
        let [low, high] = &self.bounds;
        Point3::from([0, 1, 2].map(|axis| place[axis].max(low[axis]).min(high[axis])))
    }

    /// `away`: distance to the box of the range along each axis. From far away all points of a
    /// cloud are about equally far along the axis of a split, but not in space.
    fn look<const N: usize>(
        &self,
        to: &Point3<f64>,
        range: Range<usize>,
        away: Vector3<f64>,
        found: &mut [(f64, u32); N],
    ) {
        if range.len() <= LEAF {
            range.for_each(|at| self.offer(to, at, found));
            return;
        }
        let middle = range.start + range.len() / 2;
        let axis = self.axes[middle] as usize;
        let ahead = to[axis] - self.places[middle][axis];
        let (before, after) = (range.start..middle, middle + 1..range.end);
        let (near, far) = if ahead < 0.0 {
            (before, after)
        } else {
            (after, before)
        };
        self.look(to, near, away, found);
        self.offer(to, middle, found);
        let mut beyond = away;
        beyond[axis] = ahead.abs();
        // As the distance of a point is computed, so that rounding hides none.
        let (farthest, last) = found[N - 1];
        let is_too_far = farthest < beyond.norm_squared();
        if last == u32::MAX || !is_too_far {
            self.look(to, far, beyond, found);
        }
    }

    #[inline]
    fn offer<const N: usize>(&self, to: &Point3<f64>, at: usize, found: &mut [(f64, u32); N]) {
        #[cfg(test)]
        tests::OFFERED.with(|offered| offered.set(offered.get() + 1));
        // Not a number counts as infinitely far.
        let entry = (
            (self.places[at] - to).norm_squared().min(f64::INFINITY),
            self.indices[at],
        );
        let is_nearer =
            |other: &(f64, u32)| entry.0 < other.0 || entry.0 == other.0 && entry.1 < other.1;
        if is_nearer(&found[N - 1]) {
            let place = found.partition_point(|other| !is_nearer(other));
            found[place..].rotate_right(1);
            found[place] = entry;
        }
    }
}

/// Sorts a range so that its median splits it along its longest axis.
fn split(points: &[Point3<f64>], order: &mut [u32], axes: &mut [u8]) {
    if order.len() <= LEAF {
        return;
    }
    let axis = longest_axis(order.iter().map(|&p| &points[p as usize]));
    let middle = order.len() / 2;
    let along = |p: &u32| points[*p as usize][axis];
    order.select_nth_unstable_by(middle, |a, b| along(a).total_cmp(&along(b)).then(a.cmp(b)));
    axes[middle] = axis as u8;
    let (before, after) = order.split_at_mut(middle);
    let (axes_before, axes_after) = axes.split_at_mut(middle);
    rayon::join(
        || split(points, before, axes_before),
        || split(points, &mut after[1..], &mut axes_after[1..]),
    );
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use proptest::prelude::*;

    use super::*;

    thread_local! {
        /// Points that searches of this thread have looked at.
        pub(super) static OFFERED: Cell<usize> = const { Cell::new(0) };
    }

    fn by_sorting<const N: usize>(points: &[Point3<f64>], to: &Point3<f64>) -> [u32; N] {
        let mut all: Vec<u32> = (0..points.len() as u32).collect();
        let far = |p: &u32| (points[*p as usize] - to).norm_squared();
        all.sort_by(|a, b| far(a).total_cmp(&far(b)).then(a.cmp(b)));
        all.resize(N, u32::MAX);
        all.try_into().unwrap()
    }

    #[test]
    fn from_far_away_a_search_from_the_bounds_looks_at_few_points() {
        let points: Vec<Point3<f64>> = (0..10_000)
            .map(|n| Point3::new(f64::from(n % 100), f64::from(n / 100), f64::from(n * 7 % 5)))
            .collect();
        let tree = KdTree::new(&points);
        let place = Point3::new(1e6, 50.2, -1e6);
        assert_eq!(tree.in_bounds(&place), Point3::new(99.0, 50.2, 0.0));
        assert_eq!(tree.in_bounds(&points[17]), points[17]);
        OFFERED.with(|offered| offered.set(0));
        let [near] = tree.nearest(&tree.in_bounds(&place));
        assert!(points[near as usize].x > 90.0);
        assert!(OFFERED.with(Cell::get) < 200);
    }

    proptest! {
        #[test]
        fn the_nearest_are_those_that_sorting_finds(
            // Integers, so that points coincide and distances tie.
            points in proptest::collection::vec(proptest::array::uniform3(-4i8..5), 0..200),
            to in proptest::array::uniform3(prop_oneof![-6i8..7, -100i8..100]),
        ) {
            let point = |x: [i8; 3]| Point3::from(x.map(f64::from));
            let (points, to): (Vec<_>, _) = (points.into_iter().map(point).collect(), point(to));
            let tree = KdTree::new(&points);
            prop_assert_eq!(tree.nearest::<8>(&to), by_sorting(&points, &to));
            prop_assert_eq!(tree.nearest::<1>(&to), by_sorting(&points, &to));
        }
    }

    #[test]
    fn a_search_from_far_away_looks_at_few_points() {
        let points: Vec<_> = (0..20)
            .flat_map(|x| (0..20).map(move |y| (x, y)))
            .flat_map(|(x, y)| (0..20).map(move |z| Point3::new(x, y, z).map(f64::from)))
            .collect();
        let tree = KdTree::new(&points);
        for to in [
            Point3::new(1e4, 2e4, -3e4),
            Point3::new(1e4, 5.2, 0.0),
            Point3::new(9.4, 9.6, 9.7),
        ] {
            assert_eq!(tree.nearest::<8>(&to), by_sorting(&points, &to));
            let offered = OFFERED.with(|offered| offered.replace(0));
            assert!(offered < points.len() / 8, "{offered} of {}", points.len());
        }
    }

    #[test]
    fn distances_that_are_no_numbers_hide_no_points() {
        let far = [1e200, -1e200].map(|x| Point3::new(x, 0.0, 0.0));
        assert_eq!(
            KdTree::new(&far).nearest::<3>(&Point3::origin()),
            [0, 1, u32::MAX]
        );
        let many: Vec<_> = (0..100)
            .map(|x| Point3::new(f64::from(x), 0.0, 0.0))
            .collect();
        let nowhere = Point3::new(f64::NAN, 0.0, 0.0);
        assert!(
            KdTree::new(&many)
                .nearest::<100>(&nowhere)
                .iter()
                .all(|&found| found < 100)
        );
    }
}
