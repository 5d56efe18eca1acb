//! Point in polygon, exactly: even-odd over the outer ring and the holes, by the signs of adaptive
//! predicates.
//!
//! A point on a shared edge belongs to exactly one of the two polygons.
//! Edges are sorted into horizontal bands; a query reads those of one band.

use robust::{Coord, orient2d};

use super::columns::Rectangle;
use crate::base::rows::Offsets;

/// Average number of bands per edge; a limit, because long edges would fill many bands.
const ENTRIES: f64 = 8.0;

/// An edge between two points of the plane.
pub type Edge = [[f64; 2]; 2];

/// Returns whether the ray from the point in the direction of x crosses the edge. The order of the
/// two ends does not matter; the lower end belongs to the edge, the upper one does not.
#[inline]
pub fn crosses([a, b]: Edge, point: [f64; 2]) -> bool {
    let (low, high) = if a[1] <= b[1] { (a, b) } else { (b, a) };
    low[1] <= point[1] && point[1] < high[1] && side(low, high, point) > 0.0
}

/// Returns a value that is positive if the point is on the left of the line from `a` to `b`; the
/// sign is exact.
#[inline]
pub fn side(a: [f64; 2], b: [f64; 2], point: [f64; 2]) -> f64 {
    let [a, b, point] = [a, b, point].map(|[x, y]| Coord { x, y });
    orient2d(a, b, point)
}

/// Returns the edges of a ring, which is not closed.
pub fn ring_edges(ring: &[[f64; 2]]) -> impl Iterator<Item = Edge> {
    (0..ring.len()).map(|i| [ring[i], ring[(i + 1) % ring.len()]])
}

/// Returns the area within the outer ring and outside of the holes, in whatever direction they run.
pub fn polygon_area(rings: &[Vec<[f64; 2]>]) -> f64 {
    let of_ring = |ring: &Vec<[f64; 2]>| {
        // From the first corner: coordinates may be large against the ring.
        let [x, y] = ring.first().copied().unwrap_or_default();
        let twice = ring_edges(ring)
            .map(|[a, b]| (a[0] - x) * (b[1] - y) - (b[0] - x) * (a[1] - y))
            .sum::<f64>();
        0.5 * twice.abs()
    };
    let mut areas = rings.iter().map(of_ring);
    areas.next().unwrap_or_default() - areas.sum::<f64>()
}

/// A polygon with holes, indexed for queries.
#[derive(Clone, Debug)]
pub struct PreparedPolygon {
    pub bounds: Rectangle,
    edges: Vec<Edge>,
    bands: usize,
    offsets: Offsets,
    /// Indices of edges by band.
    entries: Vec<u32>,
}

impl PreparedPolygon {
    /// `rings`: the outer ring and the holes; the first position may be repeated at the end.
    pub fn new(rings: &[Vec<[f64; 2]>]) -> Self {
        let mut edges: Vec<Edge> = rings.iter().flat_map(|ring| ring_edges(ring)).collect();
        // The ray crosses no horizontal edge.
        edges.retain(|[a, b]| a[1] != b[1]);
        let bounds = Rectangle::around(rings.iter().flatten());
        let height = bounds.high[1] - bounds.low[1];
        let climbed: f64 = edges.iter().map(|[a, b]| (b[1] - a[1]).abs()).sum();
        // Each edge is in the bands that it climbs through, and at most two more.
        let most = (ENTRIES - 2.0) * edges.len() as f64 * height / climbed;
        let bands = (edges.len() as f64).min(most).max(1.0) as usize;
        let mut polygon = Self {
            bounds,
            edges,
            bands,
            offsets: Offsets::default(),
            entries: Vec::new(),
        };
        polygon.fill();
        polygon
    }

    fn fill(&mut self) {
        let bands = |(i, [a, b]): (u32, &Edge)| {
            let bands = self.band(a[1].min(b[1]))..self.band(a[1].max(b[1])) + 1;
            bands.map(move |band| (band, i))
        };
        let all = || (0..).zip(&self.edges).flat_map(bands);
        (self.offsets, self.entries) = Offsets::sorted(self.bands, all);
    }

    fn band(&self, y: f64) -> usize {
        let place = (y - self.bounds.low[1]) / (self.bounds.high[1] - self.bounds.low[1])
            * self.bands as f64;
        (place as usize).min(self.bands - 1)
    }

    /// Adds the number of edges that it looks at to `looked_at`.
    pub fn contains(&self, point: [f64; 2], looked_at: &mut u64) -> bool {
        let Rectangle { low, high } = &self.bounds;
        if !(0..2).all(|axis| low[axis] <= point[axis] && point[axis] <= high[axis]) {
            return false;
        }
        let band = &self.entries[self.offsets.row(self.band(point[1]))];
        *looked_at += band.len() as u64;
        band.iter()
            .filter(|&&edge| crosses(self.edges[edge as usize], point))
            .count()
            % 2
            == 1
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Returns the area enclosed by counter-clockwise rings minus that of clockwise rings.
    fn area(rings: &[Vec<[f64; 2]>]) -> f64 {
        let of_ring = |ring: &Vec<[f64; 2]>| -> f64 {
            (0..ring.len())
                .map(|i| (ring[i], ring[(i + 1) % ring.len()]))
                .map(|(a, b)| 0.5 * (a[0] * b[1] - b[0] * a[1]))
                .sum()
        };
        rings.iter().map(of_ring).sum()
    }

    /// Share of the centres of an n x n grid over the unit square that are inside.
    fn share(polygon: &PreparedPolygon, n: usize) -> f64 {
        let at = |i: usize| (i as f64 + 0.5) / n as f64;
        let inside = (0..n * n)
            .filter(|i| polygon.contains([at(i % n), at(i / n)], &mut 0))
            .count();
        inside as f64 / (n * n) as f64
    }

    fn star(points: usize, radius: impl Fn(usize) -> f64) -> Vec<[f64; 2]> {
        let corner = |i: usize| {
            let (sin, cos) = (std::f64::consts::TAU * i as f64 / points as f64).sin_cos();
            [0.5 + radius(i) * cos, 0.5 + radius(i) * sin]
        };
        (0..points).map(corner).collect()
    }

    #[test]
    fn the_share_of_samples_inside_is_the_area() {
        let outer = star(20, |i| if i % 2 == 0 { 0.48 } else { 0.3 });
        let hole: Vec<[f64; 2]> = star(7, |_| 0.2).into_iter().rev().collect();
        let mut comb = vec![[0.9, 0.1], [0.9, 0.05], [0.1, 0.05]];
        comb.extend((0..16).flat_map(|i| {
            [0.0, 0.05].map(|dx| {
                [
                    0.1 + 0.05 * f64::from(i) + dx,
                    0.95 - 0.8 * f64::from(i % 2),
                ]
            })
        }));
        for rings in [
            vec![outer.clone()],
            vec![outer, hole],
            vec![vec![[0.2, 0.1], [0.9, 0.3], [0.4, 0.8]]],
        ] {
            let (found, expected) = (share(&PreparedPolygon::new(&rings), 1000), area(&rings));
            assert!((found - expected).abs() < 1e-3, "{found} {expected}");
        }
        let comb = PreparedPolygon::new(&[comb]);
        assert!(
            comb.entries.len() as f64 <= ENTRIES * comb.edges.len() as f64,
            "bounded: {}",
            comb.entries.len()
        );
    }

    #[test]
    fn a_closed_ring_and_an_open_one_are_the_same() {
        let open = star(5, |_| 0.4);
        let closed: Vec<[f64; 2]> = open.iter().copied().chain([open[0]]).collect();
        let [open, closed] = [open, closed].map(|ring| PreparedPolygon::new(&[ring]));
        assert_eq!(share(&open, 200), share(&closed, 200));
    }

    proptest! {
        /// A square cut along any diagonal of a grid: each corner of the grid, many of them on the
        /// cut, is in one part.
        #[test]
        fn neighbours_share_no_point_and_lose_none(x in 0usize..=20, y in 0usize..=20) {
            let at = |i: usize| i as f64 * 0.1;
            let (from, to) = ([at(x), 0.0], [at(y), 2.0]);
            let left = PreparedPolygon::new(&[vec![[0.0, 0.0], from, to, [0.0, 2.0]]]);
            let right = PreparedPolygon::new(&[vec![from, [2.0, 0.0], [2.0, 2.0], to]]);
            let whole = PreparedPolygon::new(&[vec![[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]]]);
            for i in 0..=20 {
                for j in 0..=20 {
                    let point = [at(i), at(j)];
                    let parts = u8::from(left.contains(point, &mut 0)) + u8::from(right.contains(point, &mut 0));
                    prop_assert_eq!(parts, u8::from(whole.contains(point, &mut 0)), "{:?}", point);
                }
            }
        }
    }
}
