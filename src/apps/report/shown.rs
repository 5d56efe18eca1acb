//! The surface as drawn: unchanged, or coarser if it has too many triangles for a page.

use std::collections::{BTreeMap, btree_map::Entry};

use nalgebra::{Point3, Vector3};

use crate::model::surface::Surface;

/// Largest number of triangles on the page, about 2 MB with their histories.
const BUDGET: usize = 40_000;

/// The surface to draw; each triangle shows the state of one triangle of the plan's surface.
pub struct DrawnSurface {
    /// World coordinates.
    pub vertices: Vec<Point3<f64>>,
    pub triangles: Vec<[u32; 3]>,
    /// Index of the surface's triangle, per drawn triangle.
    pub original: Vec<u32>,
}

impl DrawnSurface {
    pub fn new(surface: &Surface) -> Self {
        Self::within(surface, BUDGET)
    }

    /// Reduces the surface to at most `budget` triangles by vertex clustering: vertices in the same
    /// cube are merged. The edge of the cubes grows by a tenth until the budget is met. Of
    /// triangles that coincide, the largest is kept.
    fn within(surface: &Surface, budget: usize) -> Self {
        if surface.triangles.len() <= budget {
            return Self {
                vertices: surface.vertices.clone(),
                triangles: surface.triangles.clone(),
                original: (0..surface.triangles.len() as u32).collect(),
            };
        }
        let area: f64 = (0..surface.triangles.len() as u32)
            .map(|t| surface.area(t))
            .sum();
        let mut cube = (area / budget as f64).sqrt().max(f64::MIN_POSITIVE);
        loop {
            let drawn = Self::in_cubes(surface, cube);
            if drawn.triangles.len() <= budget {
                return drawn;
            }
            cube *= 1.1;
        }
    }

    /// Returns the edges between drawn triangles of which one counts and the other doesn't, as
    /// pairs of vertices, ascending.
    pub fn border(&self, counts: impl Fn(u32) -> bool) -> Vec<[u32; 2]> {
        let mut edges: Vec<([u32; 2], bool)> = Vec::with_capacity(3 * self.triangles.len());
        for (&[a, b, c], &t) in self.triangles.iter().zip(&self.original) {
            edges.extend([[a, b], [b, c], [c, a]].map(|[a, b]| ([a.min(b), a.max(b)], counts(t))));
        }
        edges.sort_unstable();
        // Those that count come after the others: the ends of a run tell whether both kinds meet.
        let same = edges.chunk_by(|a, b| a.0 == b.0);
        same.filter(|same| same[0].1 != same[same.len() - 1].1)
            .map(|same| same[0].0)
            .collect()
    }

    fn in_cubes(surface: &Surface, cube: f64) -> Self {
        let mut number = BTreeMap::new();
        let mut sums: Vec<(Vector3<f64>, f64)> = Vec::new();
        // Sums are relative to a vertex: those of large coordinates would lose digits.
        let anchor = surface
            .vertices
            .first()
            .copied()
            .unwrap_or_else(Point3::origin);
        let of_vertex = |v: &Point3<f64>| {
            let offset = v - anchor;
            let key = [0, 1, 2].map(|axis| (offset[axis] / cube).floor() as i64);
            let place = *number.entry(key).or_insert(sums.len());
            sums.resize(sums.len().max(place + 1), (Vector3::zeros(), 0.0));
            sums[place].0 += offset;
            sums[place].1 += 1.0;
            place as u32
        };
        let cube_of: Vec<u32> = surface.vertices.iter().map(of_vertex).collect();
        // Sorted, so that a page has the same bytes each time.
        let mut largest: BTreeMap<[u32; 3], ([u32; 3], u32, f64)> = BTreeMap::new();
        for (t, corners) in surface.triangles.iter().enumerate() {
            let triangle = corners.map(|v| cube_of[v as usize]);
            let [a, b, c] = triangle;
            if a == b || b == c || c == a {
                continue;
            }
            let mut key = triangle;
            // Triangles with the same corners coincide, whichever way they face.
            key.sort_unstable();
            let found = (triangle, t as u32, surface.area(t as u32));
            match largest.entry(key) {
                Entry::Vacant(place) => drop(place.insert(found)),
                Entry::Occupied(mut place) if found.2 > place.get().2 => drop(place.insert(found)),
                Entry::Occupied(_) => {}
            }
        }
        Self {
            vertices: sums.into_iter().map(|(sum, n)| anchor + sum / n).collect(),
            triangles: largest.values().map(|found| found.0).collect(),
            original: largest.values().map(|found| found.1).collect(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::method::synthetic::Town;

    #[test]
    fn a_coarser_surface_keeps_its_place_and_its_size() {
        let surface = Town {
            boxes: 0,
            edge: 0.5,
            ..Town::default()
        }
        .surface();
        let coarse = DrawnSurface::within(&surface, 5000);
        assert!(
            (2500..=5000).contains(&coarse.triangles.len()),
            "{}",
            coarse.triangles.len()
        );
        let drawn = Surface {
            kind: surface.kind,
            vertices: coarse.vertices,
            triangles: coarse.triangles,
        };
        let area = |s: &Surface| {
            (0..s.triangles.len() as u32)
                .map(|t| s.area(t))
                .sum::<f64>()
        };
        assert!((area(&drawn) / area(&surface) - 1.0).abs() < 0.05);
        for (t, &original) in coarse.original.iter().enumerate() {
            assert!((drawn.centroid(t as u32) - surface.centroid(original)).norm() < 3.0);
        }
    }

    #[test]
    fn the_border_of_a_half_is_the_line_between_the_halves() {
        let surface = Town {
            boxes: 0,
            relief: 0.0,
            edge: 2.0,
            ..Town::default()
        }
        .surface();
        let drawn = DrawnSurface::new(&surface);
        let border = drawn.border(|t| surface.centroid(t).x < 4.0);
        assert_eq!(border.len(), 40, "80 m in steps of 2 m");
        assert!(
            border
                .iter()
                .flatten()
                .all(|&v| (drawn.vertices[v as usize].x - 4.0).abs() < 1e-9)
        );
        assert!(drawn.border(|_| true).is_empty());
    }

    #[test]
    fn a_small_surface_is_shown_as_it_is() {
        let surface = Town::default().surface();
        let drawn = DrawnSurface::new(&surface);
        assert_eq!(drawn.triangles, surface.triangles);
        assert!(
            drawn
                .original
                .iter()
                .enumerate()
                .all(|(i, &t)| i == t as usize)
        );
    }
}
