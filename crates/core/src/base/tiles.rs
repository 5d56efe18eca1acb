//! Partition of space into tiles with about equal numbers of points.
//!
//! The bounding box is halved across its longest side, at the median, until each part has few
//! enough; the outermost tiles extend to infinity, so that every point of space is in exactly one
//! tile.

use nalgebra::Point3;

/// A box, including `low` and excluding `high`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tile {
    low: [f64; 3],
    high: [f64; 3],
}

impl Tile {
    const EVERYTHING: Self = Self {
        low: [f64::NEG_INFINITY; 3],
        high: [f64::INFINITY; 3],
    };

    pub fn contains(&self, point: &Point3<f64>) -> bool {
        (0..3).all(|axis| self.low[axis] <= point[axis] && point[axis] < self.high[axis])
    }

    /// Returns whether the point is in the tile or within `margin` of it along each axis.
    pub fn is_near(&self, point: &Point3<f64>, margin: f64) -> bool {
        (0..3).all(|axis| {
            self.low[axis] - margin <= point[axis] && point[axis] < self.high[axis] + margin
        })
    }
}

/// Returns tiles with at most `most` points each, except where more points coincide.
pub fn split(points: &[Point3<f64>], most: usize) -> Vec<Tile> {
    let mut tiles = Vec::new();
    halve(points.to_vec(), Tile::EVERYTHING, most.max(1), &mut tiles);
    tiles
}

/// Returns `count` tiles with about equal numbers of points; fewer if there are fewer distinct
/// points.
pub fn split_into(points: &[Point3<f64>], count: usize) -> Vec<Tile> {
    let mut tiles = Vec::new();
    part(
        points.to_vec(),
        Tile::EVERYTHING,
        count.clamp(1, points.len().max(1)),
        &mut tiles,
    );
    tiles
}

fn halve(mut points: Vec<Point3<f64>>, tile: Tile, most: usize, tiles: &mut Vec<Tile>) {
    let middle = points.len() / 2;
    let cut = if points.len() > most {
        cut(&mut points, middle)
    } else {
        None
    };
    let Some((axis, at)) = cut else {
        return tiles.push(tile);
    };
    let [(left, below), (right, above)] = cut_at(points, tile, axis, at);
    halve(left, below, most, tiles);
    halve(right, above, most, tiles);
}

/// Cuts into `count` tiles with about equal numbers of points.
fn part(mut points: Vec<Point3<f64>>, tile: Tile, count: usize, tiles: &mut Vec<Tile>) {
    let few = count / 2;
    let rank = points.len() * few / count;
    let cut = if count > 1 && points.len() > 1 {
        cut(&mut points, rank)
    } else {
        None
    };
    let Some((axis, at)) = cut else {
        return tiles.push(tile);
    };
    let [(left, below), (right, above)] = cut_at(points, tile, axis, at);
    part(left, below, few, tiles);
    part(right, above, count - few, tiles);
}

/// Returns the points and the part of the tile on each side.
fn cut_at(
    points: Vec<Point3<f64>>,
    tile: Tile,
    axis: usize,
    at: f64,
) -> [(Vec<Point3<f64>>, Tile); 2] {
    let (mut below, mut above) = (tile, tile);
    below.high[axis] = at;
    above.low[axis] = at;
    let (left, right) = points.into_iter().partition(|point| point[axis] < at);
    [(left, below), (right, above)]
}

/// Returns the axis of the longest side and the coordinate of that rank along it; `None` if no cut
/// separates the points.
fn cut(points: &mut [Point3<f64>], rank: usize) -> Option<(usize, f64)> {
    // Of the points, not of the tile, whose sides may be infinite.
    let axis = longest_axis(points.iter());
    let (_, median, _) = points.select_nth_unstable_by(rank, |a, b| a[axis].total_cmp(&b[axis]));
    let at = median[axis];
    if points.iter().any(|point| point[axis] < at) {
        return Some((axis, at));
    }
    // The points up to this rank share the smallest coordinate: cut at the next one.
    let beyond = points.iter().map(|point| point[axis]).filter(|x| *x > at);
    beyond.min_by(f64::total_cmp).map(|at| (axis, at))
}

/// Returns the axis along which points extend most, the first of equals.
pub(super) fn longest_axis<'a>(points: impl Iterator<Item = &'a Point3<f64>> + Clone) -> usize {
    let extent = |axis: usize| {
        let along = points.clone().map(|point| point[axis]);
        along.clone().fold(f64::NEG_INFINITY, f64::max) - along.fold(f64::INFINITY, f64::min)
    };
    let extents = [0, 1, 2].map(extent);
    (1..3).fold(0, |longest, axis| {
        if extents[axis] > extents[longest] {
            axis
        } else {
            longest
        }
    })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn each_place_lies_in_one_tile_and_none_is_overfull(
            points in proptest::collection::vec((-9i8..9, -5i8..5, -2i8..2), 1..80),
            place in (-20.0..20.0, -20.0..20.0, -20.0..20.0),
            most in 1usize..20,
        ) {
            let points: Vec<Point3<f64>> =
                points.into_iter().map(|(x, y, z)| Point3::new(x.into(), y.into(), z.into())).collect();
            let tiles = split(&points, most);
            let place = Point3::new(place.0, place.1, place.2);
            for point in points.iter().chain([&place]) {
                prop_assert_eq!(tiles.iter().filter(|tile| tile.contains(point)).count(), 1);
            }
            for tile in &tiles {
                let own: Vec<_> = points.iter().filter(|point| tile.contains(point)).collect();
                let same = own.iter().all(|point| *point == own[0]);
                prop_assert!(own.len() <= most || same);
                prop_assert!(own.iter().all(|point| tile.is_near(point, 0.0)));
            }
        }
    }

    proptest! {
        /// The requested number of tiles, none of them empty or far larger than the others.
        #[test]
        fn as_many_tiles_as_asked_for(places in proptest::collection::hash_set(-900i32..900, 1..60), count in 1usize..12) {
            let points: Vec<_> = places.iter().map(|&x| Point3::new(f64::from(x), f64::from(x % 7), 0.0)).collect();
            let count = count.min(points.len());
            let tiles = split_into(&points, count);
            let sizes: Vec<usize> =
                tiles.iter().map(|tile| points.iter().filter(|p| tile.contains(p)).count()).collect();
            prop_assert_eq!(sizes.len(), count);
            prop_assert_eq!(sizes.iter().sum::<usize>(), points.len());
            let (least, most) = (points.len() / count, points.len().div_ceil(count));
            prop_assert!(sizes.iter().all(|n| *n > 0 && n + 1 >= least && *n <= most + 1), "{:?}", sizes);
        }
    }

    #[test]
    fn a_flight_is_halved_across_its_longest_side() {
        let points: Vec<_> = (0..100)
            .map(|i| Point3::new(f64::from(i), f64::from(i % 7), 0.0))
            .collect();
        let tiles = split(&points, 25);
        assert_eq!(
            tiles
                .iter()
                .map(|tile| points.iter().filter(|p| tile.contains(p)).count())
                .collect::<Vec<_>>(),
            [25; 4]
        );
        assert!(tiles[0].is_near(&points[26], 2.5) && !tiles[0].is_near(&points[28], 2.5));
    }
}
