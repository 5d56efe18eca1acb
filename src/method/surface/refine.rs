//! Method 1.6: splits the longest edge at its midpoint until every edge is short enough, both triangles at an edge together, so that no
//! vertex ever lies on another triangle's edge.

use std::collections::BinaryHeap;

use nalgebra::Point3;

use super::{
    Surface,
    corners::{BORDER, next, opposites, prev, vertex},
};
use crate::base::progress::{Cancelled, Watcher};

/// Most triangles that a refinement makes, whatever memory there is.
pub const MAX_TRIANGLES: u64 = 30_000_000;
/// Memory that each takes while edges are split: corners, vertices and the queue, with room to grow.
pub const TRIANGLE_BYTES: u64 = 120;
/// Splits between two questions to the watcher, well under 50 ms.
const CHECK_INTERVAL: usize = 4096;

/// Why a surface was not refined.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum RefineError {
    #[error(
        "edges of at most {limit:.3e} scene units would make about {triangles:.0} triangles; there is room for {most}"
    )]
    TooFine { limit: f64, triangles: f64, most: u64 },
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
}

/// Splits edges until each is shorter than `limit` (scene units), the longest first; into at most about `most` triangles.
pub fn refine(surface: Surface, limit: f64, most: u64, watcher: &dyn Watcher) -> Result<Surface, RefineError> {
    let triangles: f64 = (0..surface.triangles.len() as u32).map(|t| expected_pieces(&surface, t, limit)).sum();
    if triangles.is_nan() || triangles > most as f64 {
        return Err(RefineError::TooFine { limit, triangles, most });
    }
    let mut mesh = Splitting::new(surface, limit);
    let mut splits = 0usize;
    while let Some(edge) = mesh.queue.pop() {
        splits += usize::from(mesh.split_if_fresh(edge));
        if splits.is_multiple_of(CHECK_INTERVAL) {
            watcher.check()?;
        }
    }
    Ok(mesh.surface)
}

/// About how many triangles with sides of at most `limit` the triangle falls into; never under the true count by much.
fn expected_pieces(surface: &Surface, triangle: u32, limit: f64) -> f64 {
    let [a, b, c] = surface.corners(triangle);
    let longest = (b - a).norm().max((c - b).norm()).max((a - c).norm());
    1.0 + longest / limit + 8.0 * surface.area(triangle) / (limit * limit)
}

/// An edge that is too long; ordered by length, then by the corner that faces it.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct LongEdge {
    /// Bits of the length, ordered like the length.
    length: u64,
    corner: u32,
}

struct Splitting {
    surface: Surface,
    opposite: Vec<u32>,
    queue: BinaryHeap<LongEdge>,
    limit: f64,
}

impl Splitting {
    fn new(surface: Surface, limit: f64) -> Self {
        let opposite = opposites(&surface);
        let mut mesh = Self { surface, opposite, queue: BinaryHeap::new(), limit };
        let corners = 0..mesh.opposite.len() as u32;
        corners.filter(|&c| c < mesh.opposite[c as usize]).collect::<Vec<_>>().into_iter().for_each(|c| mesh.push(c));
        mesh
    }

    fn ends(&self, corner: u32) -> [Point3<f64>; 2] {
        [next(corner), prev(corner)].map(|c| self.surface.vertices[vertex(&self.surface.triangles, c) as usize])
    }

    fn long_edge(&self, corner: u32) -> LongEdge {
        let [a, b] = self.ends(corner);
        LongEdge { length: (b - a).norm().to_bits(), corner }
    }

    /// Queues the edge that the corner faces if it is too long, and its coordinates leave room for a point between its ends.
    fn push(&mut self, corner: u32) {
        let edge = self.long_edge(corner);
        if f64::from_bits(edge.length) < self.limit {
            return;
        }
        let [a, b] = self.ends(corner);
        if ![a, b].contains(&middle(&a, &b)) {
            self.queue.push(edge);
        }
    }

    fn split_if_fresh(&mut self, edge: LongEdge) -> bool {
        let is_fresh = self.long_edge(edge.corner) == edge;
        if is_fresh {
            self.split(edge.corner);
        }
        is_fresh
    }

    /// Splits the edge that the corner faces, with the triangles on both sides.
    fn split(&mut self, corner: u32) {
        let [a, b] = self.ends(corner);
        let middle_vertex = self.surface.vertices.len() as u32;
        self.surface.vertices.push(middle(&a, &b));
        let across = self.opposite[corner as usize];
        let far = self.halve(corner, middle_vertex);
        let halves = if across == BORDER {
            [(corner, BORDER), (far, BORDER)]
        } else {
            let far_across = self.halve(across, middle_vertex);
            [(corner, far_across), (far, across)]
        };
        for (one, other) in halves {
            self.pair(one, other);
            self.push(one);
        }
        self.push(next(corner));
        if across != BORDER {
            self.push(next(across));
        }
    }

    /// Cuts the corner's triangle from the corner to `middle`: it keeps the half at its `next` vertex. Returns the corner of the new
    /// half at the same vertex. The edges towards `middle` on the cut edge are left for the caller to pair.
    fn halve(&mut self, corner: u32, middle: u32) -> u32 {
        let (t, new) = (corner as usize / 3, self.surface.triangles.len() as u32);
        let [apex, end] = [corner, prev(corner)].map(|c| vertex(&self.surface.triangles, c));
        self.surface.triangles[t][prev(corner) as usize % 3] = middle;
        // The new triangle: apex, middle, end.
        self.surface.triangles.push([apex, middle, end]);
        let far = 3 * new;
        self.opposite.extend([BORDER; 3]);
        // The side from `end` to the apex now belongs to the new half; the cut from `middle` to the apex joins the halves.
        self.pair(next(far), self.opposite[next(corner) as usize]);
        self.push(next(far));
        self.pair(next(corner), prev(far));
        far
    }

    fn pair(&mut self, one: u32, other: u32) {
        self.opposite[one as usize] = other;
        if other != BORDER {
            self.opposite[other as usize] = one;
        }
    }
}

fn middle(a: &Point3<f64>, b: &Point3<f64>) -> Point3<f64> {
    a + (b - a) / 2.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        base::progress::Unwatched,
        method::surface::{manifold::check_manifold, shapes},
    };

    /// Area, volume and topology stay; every edge is short; no new vertex lies off the old surface.
    #[test]
    fn splits_until_short_and_changes_no_shape() {
        for surface in [shapes::sphere(1), shapes::torus(5), shapes::terrain(2, |x, y| x * y)] {
            let (before, area, volume) =
                (check_manifold(&surface), shapes::total_area(&surface), shapes::volume(&surface));
            let refined = refine(surface, 0.11, MAX_TRIANGLES, &Unwatched).unwrap();
            let after = check_manifold(&refined);
            assert_eq!(after.map(|t| (t.euler, t.components)), before.map(|t| (t.euler, t.components)));
            assert!(shapes::sides(&refined).all(|s| s < 0.11));
            assert!((shapes::total_area(&refined) - area).abs() < 1e-12 * area);
            assert!((shapes::volume(&refined) - volume).abs() < 1e-12);
        }
    }

    #[test]
    fn leaves_short_edges_alone() {
        let refined = refine(shapes::sphere(2), 1.0, MAX_TRIANGLES, &Unwatched).unwrap();
        assert_eq!(refined.triangles, shapes::sphere(2).triangles);
    }

    #[test]
    fn refuses_what_would_not_fit_into_memory() {
        for (limit, most) in [(1e-9, MAX_TRIANGLES), (0.1, 1000)] {
            let refused = refine(shapes::sphere(0), limit, most, &Unwatched);
            assert!(matches!(refused, Err(RefineError::TooFine { .. })), "{refused:?}");
        }
    }
}
