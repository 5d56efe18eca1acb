//! Quadric edge collapse (method 1.5; Garland, Heckbert, "Surface Simplification Using Quadric
//! Error Metrics", 1997).
//!
//! The quadric of a vertex has the planes of its triangles, planes perpendicular to its border
//! edges, and a small pull to its position, which keeps the minimum unique on planes and the
//! triangles well shaped. The edge of least cost that is shorter than the limit and whose collapse
//! preserves manifold, border and orientation is collapsed first, until enough edges are long.

use std::cmp::Reverse;

use dary_heap::QuaternaryHeap;
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

use super::quadric::{Quadric, vertex_quadrics};
use crate::{
    base::progress::{Cancelled, Watcher},
    model::surface::{
        Surface,
        corners::{BORDER, next, opposites, prev, swing, unswing, vertex},
    },
};

/// Required share of edges longer than the target.
const LONG_SHARE: f64 = 0.95;
/// Limit on the length of collapsed edges, multiples of the target.
const CANDIDATE_FACTOR: f64 = 1.33;
/// Cosine of the largest rotation of a normal in one collapse: 80 degrees.
const MIN_TURN_COSINE: f64 = 0.173_648_177_666_930_33;
/// Collapses between two checks for cancellation; well under 50 ms.
const CHECK_INTERVAL: usize = 4096;

/// Collapses edges until 95 % of them are at least as long as the mean target of their ends, or no
/// edge can be collapsed. `targets`: by vertex, scene units. The surface must be an oriented
/// manifold with borders and remains one.
pub fn simplify(
    surface: Surface,
    targets: Vec<f64>,
    watcher: &dyn Watcher,
) -> Result<Surface, Cancelled> {
    let mut mesh = EdgeCollapse::new(surface, targets);
    // A rejected collapse may become valid after its neighbourhood has changed, hence rounds.
    while !mesh.is_done() && mesh.collapse_round(watcher)? > 0 {}
    // Some edges may still be short: holes shrink to three sides, which no collapse can close.
    Ok(mesh.finish())
}

/// Candidate edge, ordered by cost, then vertices; stale if the stamps of its vertices have
/// changed.
///
/// Packs the bits of the non-negative cost, which are ordered like the cost, the two vertices and
/// their stamps: one comparison.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Candidate(u128);

impl Candidate {
    fn new(cost: f64, from: u32, to: u32, stamps: u32) -> Self {
        let [cost, from, to, stamps] = [(cost as f32).to_bits(), from, to, stamps].map(u128::from);
        Self(cost << 96 | from << 64 | to << 32 | stamps)
    }

    /// Its vertices and their stamps.
    fn edge(self) -> (u32, u32, u32) {
        ((self.0 >> 64) as u32, (self.0 >> 32) as u32, self.0 as u32)
    }
}

struct EdgeCollapse {
    /// Relative to `shift`, so that large coordinates don't lose digits.
    surface: Surface,
    shift: Vector3<f64>,
    opposite: Vec<u32>,
    quadrics: Vec<Quadric>,
    /// A corner at each vertex; [`BORDER`] if the vertex is removed.
    corner_of: Vec<u32>,
    is_border: Vec<bool>,
    is_kept: Vec<bool>,
    /// Number of moves of each vertex.
    stamps: Vec<u32>,
    /// A 4-ary heap has half the levels of a binary one, and four children share a cache line.
    queue: QuaternaryHeap<Reverse<Candidate>>,
    /// By vertex.
    targets: Vec<f64>,
    edges: usize,
    long_edges: usize,
    marks: Marks,
}

impl EdgeCollapse {
    fn new(mut surface: Surface, targets: Vec<f64>) -> Self {
        let opposite = opposites(&surface);
        let first = surface.vertices.first();
        let shift = first.map_or(Vector3::zeros(), |v| v.coords);
        surface.vertices.iter_mut().for_each(|v| *v -= shift);
        let vertices = surface.vertices.len();
        let mut mesh = Self {
            quadrics: vertex_quadrics(&surface, &opposite),
            corner_of: vec![BORDER; vertices],
            is_border: vec![false; vertices],
            is_kept: vec![true; surface.triangles.len()],
            stamps: vec![0; vertices],
            queue: QuaternaryHeap::new(),
            targets,
            edges: 0,
            long_edges: 0,
            marks: Marks::new(vertices),
            opposite,
            shift,
            surface,
        };
        mesh.mark_corners();
        for c in mesh.edge_corners().collect::<Vec<_>>() {
            let (a, b) = mesh.ends(c);
            mesh.count_edge(a, b, 1);
        }
        mesh
    }

    /// Notes a corner at each vertex, and the vertices at the border.
    fn mark_corners(&mut self) {
        for c in 0..self.opposite.len() as u32 {
            self.corner_of[vertex(&self.surface.triangles, c) as usize] = c;
            if self.opposite[c as usize] == BORDER {
                let (a, b) = self.ends(c);
                self.is_border[a as usize] = true;
                self.is_border[b as usize] = true;
            }
        }
    }

    /// One corner per remaining edge.
    fn edge_corners(&self) -> impl Iterator<Item = u32> + '_ {
        let is_first = |&c: &u32| self.is_kept[c as usize / 3] && c < self.opposite[c as usize];
        (0..self.opposite.len() as u32).filter(is_first)
    }

    fn is_done(&self) -> bool {
        self.long_edges as f64 >= LONG_SHARE * self.edges as f64
    }

    fn ends(&self, corner: u32) -> (u32, u32) {
        (
            vertex(&self.surface.triangles, next(corner)),
            vertex(&self.surface.triangles, prev(corner)),
        )
    }

    fn position(&self, vertex: u32) -> Point3<f64> {
        self.surface.vertices[vertex as usize]
    }

    /// Returns the length of the edge between two vertices relative to its target.
    fn relative_length(&self, a: u32, b: u32) -> f64 {
        let target = (self.targets[a as usize] + self.targets[b as usize]) / 2.0;
        (self.position(a) - self.position(b)).norm() / target
    }

    fn count_edge(&mut self, a: u32, b: u32, change: isize) {
        self.edges = self.edges.wrapping_add_signed(change);
        if self.relative_length(a, b) >= 1.0 {
            self.long_edges = self.long_edges.wrapping_add_signed(change);
        }
    }

    /// Tries every candidate, cheapest first, until enough edges are long. Returns the number of
    /// collapses.
    fn collapse_round(&mut self, watcher: &dyn Watcher) -> Result<usize, Cancelled> {
        let edges: Vec<u32> = self.edge_corners().collect();
        let candidate = |&corner: &u32| self.candidate(self.ends(corner)).map(Reverse);
        let candidates: Vec<_> = edges.par_iter().filter_map(candidate).collect();
        self.queue = candidates.into();
        let (mut tries, mut collapses) = (0usize, 0);
        while !self.is_done()
            && let Some(Reverse(candidate)) = self.queue.pop()
        {
            collapses += usize::from(self.try_collapse(candidate));
            tries += 1;
            if tries.is_multiple_of(CHECK_INTERVAL) {
                watcher.check()?;
            }
        }
        Ok(collapses)
    }

    /// Returns the candidate for the edge between two vertices, unless it is too long.
    fn candidate(&self, (a, b): (u32, u32)) -> Option<Candidate> {
        if self.relative_length(a, b) >= CANDIDATE_FACTOR {
            return None;
        }
        let (from, to) = (a.min(b), a.max(b));
        let (_, cost) = self.placement(from, to);
        Some(Candidate::new(cost, from, to, self.stamps_of(from, to)))
    }

    /// Grows with each move of either vertex.
    fn stamps_of(&self, a: u32, b: u32) -> u32 {
        self.stamps[a as usize].wrapping_add(self.stamps[b as usize])
    }

    /// Returns the position of the merged vertex and the quadric error there. A border vertex keeps
    /// its position if an inner one is merged into it.
    fn placement(&self, a: u32, b: u32) -> (Point3<f64>, f64) {
        let mut quadric = self.quadrics[a as usize];
        quadric.add(&self.quadrics[b as usize]);
        let (p, q) = (self.position(a).coords, self.position(b).coords);
        let middle = (p + q) / 2.0;
        let best = match (self.is_border[a as usize], self.is_border[b as usize]) {
            (true, false) => p,
            (false, true) => q,
            // An ill-conditioned minimum may be far away.
            _ => quadric
                .minimum()
                .filter(|x| (x - middle).norm() <= (p - q).norm())
                .unwrap_or(middle),
        };
        (Point3::from(best), quadric.evaluate(&best))
    }

    fn try_collapse(&mut self, candidate: Candidate) -> bool {
        let (from, to, stamps) = candidate.edge();
        let is_gone = |v: u32| self.corner_of[v as usize] == BORDER;
        if is_gone(from) || is_gone(to) || stamps != self.stamps_of(from, to) {
            return false;
        }
        let rings = [self.ring(from), self.ring(to)];
        let Some(corner) = self.corner_facing(&rings[0], to) else {
            return false;
        };
        let (place, _) = self.placement(from, to);
        if !self.keeps_manifold(corner, &rings) || !self.keeps_orientation(corner, &rings, place) {
            return false;
        }
        self.collapse(corner, from, to, &rings, place);
        true
    }

    /// Collects the corners at a vertex, counter-clockwise; from border to border at a border.
    fn ring(&self, vertex: u32) -> Vec<u32> {
        let mut start = self.corner_of[vertex as usize];
        let first = start;
        while let Some(c) = unswing(&self.opposite, start) {
            start = c;
            if c == first {
                break;
            }
        }
        let mut ring = vec![start];
        while let Some(c) = swing(&self.opposite, *ring.last().expect("starts with one")) {
            if c == start {
                break;
            }
            ring.push(c);
        }
        ring
    }

    /// Returns a corner that faces the edge from the ring's vertex to the other.
    fn corner_facing(&self, ring: &[u32], other: u32) -> Option<u32> {
        let at = |c| vertex(&self.surface.triangles, c);
        ring.iter().find_map(|&c| {
            if at(next(c)) == other {
                Some(prev(c))
            } else {
                (at(prev(c)) == other).then(|| next(c))
            }
        })
    }

    /// Returns whether the link condition holds: the two ends share only the apexes of the
    /// triangles at the edge; the border counts as a vertex that all border vertices share.
    fn keeps_manifold(&mut self, corner: u32, rings: &[Vec<u32>; 2]) -> bool {
        let Some(sides) = self.sides(corner, rings) else {
            return false;
        };
        let triangles = &self.surface.triangles;
        let neighbours = |ring: &[u32]| {
            let corners = ring.iter().flat_map(|&c| [next(c), prev(c)]);
            corners.map(|c| vertex(triangles, c)).collect::<Vec<_>>()
        };
        self.marks
            .common(&neighbours(&rings[0]), &neighbours(&rings[1]))
            == sides
    }

    /// Returns the number of triangles at an edge; `None` if it must stay because of the border, or
    /// as part of a tetrahedron.
    fn sides(&self, corner: u32, rings: &[Vec<u32>; 2]) -> Option<usize> {
        let is_border = |c: u32| self.opposite[c as usize] == BORDER;
        if is_border(corner) {
            // The last triangle of a part would vanish.
            let is_last = is_border(next(corner)) && is_border(prev(corner));
            return (!is_last).then_some(1);
        }
        let (a, b) = self.ends(corner);
        // An inner edge between border vertices would pinch the surface, one of a tetrahedron fold
        // it.
        let both_border = self.is_border[a as usize] && self.is_border[b as usize];
        let is_tetrahedron = rings[0].len() == 3 && rings[1].len() == 3;
        (!both_border && !is_tetrahedron).then_some(2)
    }

    /// Returns whether no normal rotates by more than 80 degrees and no triangle degenerates.
    fn keeps_orientation(&self, corner: u32, rings: &[Vec<u32>; 2], place: Point3<f64>) -> bool {
        // At a border, the second number is beyond all triangles whose corners 32 bits can number.
        let removed = [corner / 3, self.opposite[corner as usize] / 3];
        let mut left = rings
            .iter()
            .flatten()
            .filter(|&&c| !removed.contains(&(c / 3)));
        left.all(|&c| {
            let at = |c| self.position(vertex(&self.surface.triangles, c));
            let (p, q) = (at(next(c)), at(prev(c)));
            let before = (p - at(c)).cross(&(q - at(c)));
            let after = (p - place).cross(&(q - place));
            let size = before.norm() * after.norm();
            after.norm_squared() > 0.0
                // A triangle without area has no normal to keep.
                && (before.dot(&after) >= MIN_TURN_COSINE * size || before.norm_squared() == 0.0)
        })
    }

    /// Merges `to` into `from` at the position and removes the triangles at the edge that the
    /// corner faces.
    fn collapse(
        &mut self,
        corner: u32,
        from: u32,
        to: u32,
        rings: &[Vec<u32>; 2],
        place: Point3<f64>,
    ) {
        self.count_ring_edges(&rings[0], from, None, -1);
        self.count_ring_edges(&rings[1], to, Some(from), -1);
        let across = self.opposite[corner as usize];
        self.take_out(corner);
        if across != BORDER {
            self.take_out(across);
        }
        for &c in &rings[1] {
            self.surface.triangles[c as usize / 3][c as usize % 3] = from;
        }
        let is_left = |c: &&u32| self.is_kept[**c as usize / 3];
        self.corner_of[from as usize] = *rings
            .iter()
            .flatten()
            .find(is_left)
            .expect("the link condition leaves a triangle");
        self.absorb(from, to);
        self.surface.vertices[from as usize] = place;
        let ring = self.ring(from);
        self.count_ring_edges(&ring, from, None, 1);
        self.for_ring_neighbours(&ring, |mesh, v| {
            let candidate = mesh.candidate((from, v));
            mesh.queue.extend(candidate.map(Reverse));
        });
    }

    /// Adds what is known of a vertex to another, into which it is merged.
    fn absorb(&mut self, into: u32, removed: u32) {
        // Only ever larger, so that older candidates of `into` are stale; those of `removed` are
        // gone with it.
        let stamp = self.stamps_of(into, removed).wrapping_add(1);
        let (into, removed) = (into as usize, removed as usize);
        self.corner_of[removed] = BORDER;
        self.is_border[into] |= self.is_border[removed];
        let absorbed = self.quadrics[removed];
        self.quadrics[into].add(&absorbed);
        self.stamps[into] = stamp;
        self.targets[into] = (self.targets[into] + self.targets[removed]) / 2.0;
    }

    /// Calls `call` once for each vertex adjacent to the ring's vertex.
    fn for_ring_neighbours(&mut self, ring: &[u32], mut call: impl FnMut(&mut Self, u32)) {
        for &c in ring {
            call(self, vertex(&self.surface.triangles, next(c)));
        }
        let last = ring[ring.len() - 1];
        if self.opposite[next(last) as usize] == BORDER {
            call(self, vertex(&self.surface.triangles, prev(last)));
        }
    }

    fn count_ring_edges(&mut self, ring: &[u32], at: u32, except: Option<u32>, change: isize) {
        self.for_ring_neighbours(ring, |mesh, v| {
            if Some(v) != except {
                mesh.count_edge(at, v, change);
            }
        });
    }

    /// Removes the triangle of a corner whose facing edge collapses: its two other sides become
    /// one.
    fn take_out(&mut self, corner: u32) {
        let apex = vertex(&self.surface.triangles, corner) as usize;
        let [left, right] = [next(corner), prev(corner)].map(|c| self.opposite[c as usize]);
        if left != BORDER {
            self.opposite[left as usize] = right;
            self.corner_of[apex] = next(left);
        }
        if right != BORDER {
            self.opposite[right as usize] = left;
            self.corner_of[apex] = prev(right);
        }
        self.is_kept[corner as usize / 3] = false;
    }

    fn finish(mut self) -> Surface {
        self.surface
            .vertices
            .iter_mut()
            .for_each(|v| *v += self.shift);
        self.surface.keep(&self.is_kept)
    }
}

/// Marks of vertices that never have to be cleared.
struct Marks {
    marks: Vec<u32>,
    latest: u32,
}

impl Marks {
    fn new(vertices: usize) -> Self {
        Self {
            marks: vec![0; vertices],
            latest: 0,
        }
    }

    /// Returns the number of distinct vertices in both lists.
    fn common(&mut self, some: &[u32], others: &[u32]) -> usize {
        if self.latest >= u32::MAX - 2 {
            self.marks.fill(0);
            self.latest = 0;
        }
        self.latest += 2;
        let (first, both) = (self.latest - 1, self.latest);
        some.iter().for_each(|&v| self.marks[v as usize] = first);
        let mut count = 0;
        for &v in others {
            if self.marks[v as usize] == first {
                self.marks[v as usize] = both;
                count += 1;
            }
        }
        count
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        base::progress::NoWatcher,
        model::surface::{manifold::check_manifold, shapes},
    };

    fn evenly(surface: Surface, target: f64) -> Surface {
        let targets = vec![target; surface.vertices.len()];
        simplify(surface, targets, &NoWatcher).unwrap()
    }

    fn long_share(surface: &Surface, target: f64) -> f64 {
        let (long, all) =
            shapes::sides(surface).fold((0, 0), |(l, n), s| (l + u32::from(s >= target), n + 1));
        f64::from(long) / f64::from(all)
    }

    #[test]
    fn a_sphere_keeps_topology_and_volume() {
        let surface = shapes::sphere(5);
        let volume = shapes::volume(&surface);
        let simple = evenly(surface, 0.2);
        assert_eq!(
            check_manifold(&simple).map(|t| (t.euler, t.border_edges)),
            Ok((2, 0))
        );
        assert!(long_share(&simple, 0.2) >= 0.95);
        // Triangles of side s with corners on the sphere lose 3/8 s² of its volume.
        let loss = 1.0 - shapes::volume(&simple) / volume;
        assert!(loss.abs() < 0.375 * 0.2 * 0.2, "{loss}");
        assert!(
            simple
                .vertices
                .iter()
                .all(|v| (v.coords.norm() - 1.0).abs() < 0.02)
        );
    }

    #[test]
    fn a_torus_stays_a_torus() {
        let simple = evenly(shapes::torus(60), 0.15);
        assert_eq!(
            check_manifold(&simple).map(|t| (t.euler, t.border_edges, t.components)),
            Ok((0, 0, 1))
        );
    }

    #[test]
    fn a_plane_stays_plane_and_keeps_its_outline() {
        let simple = evenly(shapes::terrain(40, |_, _| 0.0), 0.12);
        assert_eq!(
            check_manifold(&simple).map(|t| (t.euler, t.components)),
            Ok((1, 1))
        );
        assert!(simple.vertices.iter().all(|v| v.z.abs() < 1e-12));
        assert!(
            (shapes::total_area(&simple) - 1.0).abs() < 0.02,
            "{}",
            shapes::total_area(&simple)
        );
        assert!((0..simple.triangles.len() as u32).all(|t| simple.area_normal(t).z > 0.0));
    }

    /// No edge of a closed tetrahedron or of a single triangle can collapse, however short.
    #[test]
    fn stops_where_nothing_can_be_collapsed() {
        let mut tetrahedron = shapes::sphere(0);
        tetrahedron.vertices.truncate(4);
        tetrahedron.vertices[3] = Point3::origin();
        tetrahedron.triangles = vec![[0, 1, 2], [1, 0, 3], [2, 1, 3], [0, 2, 3]];
        let lone = shapes::terrain(1, |_, _| 0.0).keep(&[true, false]);
        for surface in [tetrahedron, lone] {
            let simple = evenly(surface.clone(), 100.0);
            assert_eq!(simple.triangles.len(), surface.triangles.len());
        }
    }

    #[test]
    fn a_roof_ridge_is_kept_while_its_sides_are_thinned() {
        let simple = evenly(shapes::terrain(40, |x, _| (x - 0.5).abs()), 0.15);
        let height_error = simple
            .vertices
            .iter()
            .map(|v| (v.z - (v.x - 0.5).abs()).abs())
            .fold(0.0, f64::max);
        assert!(height_error < 0.01, "{height_error}");
    }

    #[test]
    fn large_offsets_change_nothing() {
        let offset = Vector3::new(400_000.0, 5_800_000.0, 100.0);
        let here = evenly(shapes::torus(40), 0.2);
        let mut there = shapes::torus(40);
        there.vertices.iter_mut().for_each(|v| *v += offset);
        let there = evenly(there, 0.2);
        assert_eq!(check_manifold(&there).map(|t| t.euler), Ok(0));
        let (a, b) = (shapes::total_area(&here), shapes::total_area(&there));
        assert!((a - b).abs() < 0.02 * a, "{a} {b}");
    }
}
