//! Refines the surface (method 1.6): repeatedly splits the edge that exceeds its limit most at its
//! midpoint, with both adjacent triangles, until every edge is short enough; no vertex is ever on
//! another triangle's edge.

use std::collections::BinaryHeap;

use nalgebra::Point3;

use crate::{
    base::progress::{Cancelled, Watcher},
    model::surface::{
        Surface,
        corners::{BORDER, next, opposites, prev, vertex},
    },
};

/// Largest number of triangles, whatever the memory.
pub const MAX_TRIANGLES: u64 = 30_000_000;
/// Memory per triangle while edges are split, bytes: corners, vertices and the queue, with room to
/// grow.
pub const TRIANGLE_BYTES: u64 = 120;
/// Splits between two checks for cancellation; well under 50 ms.
const CHECK_INTERVAL: usize = 4096;

/// An error of refining a surface.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum RefineError {
    #[error(
        "edges of at most {limit:.3e} scene units would make about {triangles:.1e} triangles; there is room for {:.1e}", *most as f64
    )]
    TooFine {
        limit: f64,
        triangles: f64,
        most: u64,
    },
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
}

/// Splits edges until each is shorter than the mean limit of its ends, those that exceed it most
/// first; into at most about `most` triangles. `limits`: by vertex, scene units, above 0.
pub fn refine(
    surface: Surface,
    limits: Vec<f64>,
    most: u64,
    watcher: &dyn Watcher,
) -> Result<Surface, RefineError> {
    let triangles: f64 = (0..surface.triangles.len() as u32)
        .map(|t| expected_pieces(&surface, &limits, t))
        .sum();
    // NaN would pass the comparison.
    if triangles.is_nan() || triangles > most as f64 {
        let limit = limits.iter().copied().fold(f64::INFINITY, f64::min);
        return Err(RefineError::TooFine {
            limit,
            triangles,
            most,
        });
    }
    let mut mesh = Splitting::new(surface, limits);
    let mut splits = 0usize;
    while let Some(edge) = mesh.queue.pop() {
        splits += usize::from(mesh.split_if_fresh(edge));
        if splits.is_multiple_of(CHECK_INTERVAL) {
            watcher.check()?;
        }
    }
    Ok(mesh.surface)
}

/// Estimates the number of triangles with short enough edges that the triangle is split into; never
/// much too low.
fn expected_pieces(surface: &Surface, limits: &[f64], triangle: u32) -> f64 {
    let [a, b, c] = surface.corners(triangle);
    let longest = (b - a).norm().max((c - b).norm()).max((a - c).norm());
    let corners = surface.triangles[triangle as usize].map(|v| limits[v as usize]);
    let middle = corners.iter().sum::<f64>() / 3.0;
    // Limits change linearly over the triangle: the rule that is exact for cubic functions, from
    // the corners and the centroid.
    let per_area = 0.75 / (middle * middle)
        + corners
            .iter()
            .map(|limit| 1.0 / (12.0 * limit * limit))
            .sum::<f64>();
    1.0 + longest / middle + 8.0 * surface.area(triangle) * per_area
}

/// An edge that is too long; sorted by its length relative to its limit, then by the corner that
/// faces it.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct LongEdge {
    /// Bits of length over limit, ordered like that.
    excess: u64,
    corner: u32,
}

struct Splitting {
    surface: Surface,
    opposite: Vec<u32>,
    queue: BinaryHeap<LongEdge>,
    /// By vertex.
    limits: Vec<f64>,
}

impl Splitting {
    fn new(surface: Surface, limits: Vec<f64>) -> Self {
        let opposite = opposites(&surface);
        let mut mesh = Self {
            surface,
            opposite,
            queue: BinaryHeap::new(),
            limits,
        };
        let corners = 0..mesh.opposite.len() as u32;
        corners
            // Each edge once; at a border the opposite is the largest number.
            .filter(|&c| c < mesh.opposite[c as usize])
            .collect::<Vec<_>>()
            .into_iter()
            .for_each(|c| mesh.push(c));
        mesh
    }

    /// Returns the vertices of the edge that the corner faces.
    fn edge(&self, corner: u32) -> [usize; 2] {
        [next(corner), prev(corner)].map(|c| vertex(&self.surface.triangles, c) as usize)
    }

    fn ends(&self, corner: u32) -> [Point3<f64>; 2] {
        self.edge(corner).map(|v| self.surface.vertices[v])
    }

    /// Returns the mean limit of the ends.
    fn limit(&self, corner: u32) -> f64 {
        let [a, b] = self.edge(corner).map(|v| self.limits[v]);
        (a + b) / 2.0
    }

    fn long_edge(&self, corner: u32) -> LongEdge {
        let [a, b] = self.ends(corner);
        LongEdge {
            excess: ((b - a).norm() / self.limit(corner)).to_bits(),
            corner,
        }
    }

    /// Queues the edge that the corner faces if it is too long and there is a representable point
    /// between its ends.
    fn push(&mut self, corner: u32) {
        let edge = self.long_edge(corner);
        if f64::from_bits(edge.excess) < 1.0 {
            return;
        }
        let [a, b] = self.ends(corner);
        if ![a, b].contains(&middle(&a, &b)) {
            self.queue.push(edge);
        }
    }

    fn split_if_fresh(&mut self, edge: LongEdge) -> bool {
        // Splits leave stale entries in the queue rather than search it for them.
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
        self.limits.push(self.limit(corner));
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

    /// Cuts the corner's triangle from the corner to `middle`: it keeps the half at its `next`
    /// vertex. Returns the corner of the new half at the same vertex. The edges towards `middle` on
    /// the cut edge are left for the caller to pair.
    fn halve(&mut self, corner: u32, middle: u32) -> u32 {
        let (t, new) = (corner as usize / 3, self.surface.triangles.len() as u32);
        let [apex, end] = [corner, prev(corner)].map(|c| vertex(&self.surface.triangles, c));
        self.surface.triangles[t][prev(corner) as usize % 3] = middle;
        // The new triangle: apex, middle, end.
        self.surface.triangles.push([apex, middle, end]);
        let far = 3 * new;
        self.opposite.extend([BORDER; 3]);
        // The side from `end` to the apex now belongs to the new half; the cut from `middle` to the
        // apex joins the halves.
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
        base::progress::NoWatcher,
        model::surface::{manifold::check_manifold, shapes},
    };

    fn refine_evenly(surface: Surface, limit: f64, most: u64) -> Result<Surface, RefineError> {
        let limits = vec![limit; surface.vertices.len()];
        refine(surface, limits, most, &NoWatcher)
    }

    /// Area, volume and topology are unchanged, every edge is short, and new vertices are on the
    /// old surface.
    #[test]
    fn splits_until_short_and_changes_no_shape() {
        for surface in [
            shapes::sphere(1),
            shapes::torus(5),
            shapes::terrain(2, |x, y| x * y),
        ] {
            let (before, area, volume) = (
                check_manifold(&surface),
                shapes::total_area(&surface),
                shapes::volume(&surface),
            );
            let refined = refine_evenly(surface, 0.11, MAX_TRIANGLES).unwrap();
            let after = check_manifold(&refined);
            assert_eq!(
                after.map(|t| (t.euler, t.components)),
                before.map(|t| (t.euler, t.components))
            );
            assert!(shapes::sides(&refined).all(|s| s < 0.11));
            assert!((shapes::total_area(&refined) - area).abs() < 1e-12 * area);
            assert!((shapes::volume(&refined) - volume).abs() < 1e-12);
        }
    }

    #[test]
    fn leaves_short_edges_alone() {
        let refined = refine_evenly(shapes::sphere(2), 1.0, MAX_TRIANGLES).unwrap();
        assert_eq!(refined.triangles, shapes::sphere(2).triangles);
    }

    #[test]
    fn refuses_what_would_not_fit_into_memory() {
        for (limit, most) in [(1e-9, MAX_TRIANGLES), (0.1, 1000)] {
            let refused = refine_evenly(shapes::sphere(0), limit, most);
            assert!(
                matches!(refused, Err(RefineError::TooFine { .. })),
                "{refused:?}"
            );
        }
    }

    /// Each edge is below the limits of its ends, and no triangle is much smaller than needed.
    #[test]
    fn follows_limits_that_differ() {
        let limit = |x: f64| 0.02 + 0.3 * x;
        let surface = shapes::terrain(1, |_, _| 0.0);
        let limits: Vec<f64> = surface.vertices.iter().map(|v| limit(v.x)).collect();
        let expected: f64 = (0..2).map(|t| expected_pieces(&surface, &limits, t)).sum();
        let refined = refine(surface.clone(), limits, MAX_TRIANGLES, &NoWatcher).unwrap();
        for t in 0..refined.triangles.len() as u32 {
            let [a, b, c] = refined.corners(t);
            assert!(
                [(a, b), (b, c), (c, a)]
                    .iter()
                    .all(|(a, b)| (a - b).norm() < limit((a.x + b.x) / 2.0) + 1e-12)
            );
            let [x, area] = [refined.centroid(t).x, refined.area(t)];
            assert!(area > 0.005 * limit(x).powi(2), "{area} at {x}");
        }
        let evenly = refine_evenly(surface, limit(0.0), MAX_TRIANGLES).unwrap();
        let count = refined.triangles.len();
        assert!(
            count < evenly.triangles.len() / 5,
            "{count} of {}",
            evenly.triangles.len()
        );
        assert!(
            expected > count as f64 && expected < 8.0 * count as f64,
            "{expected} for {count}"
        );
    }
}
