//! Rays from a vertex through the cells (method 1.2).
//!
//! The target is rounded to the same grid, extended beyond its range, and each choice of the next
//! facet is the exact sign of a 3 x 3 determinant. A ray through a vertex or along an edge or facet
//! is treated as if its target were moved by (ε, ε², ε³): a perturbed ray crosses only the interior
//! of triangles, so the walk never stops early and never enters a cell twice.

use super::grid::Site;
use super::predicates::{cross, difference, wide_dot};
use super::{Delaunay, FACET_VERTICES, Facet};
use nalgebra::Point3;

/// Crossing of the ray out of a cell.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Crossing {
    /// The triangle, as a facet of the cell that the ray leaves.
    pub facet: Facet,
    /// Position on the ray: 0 at the vertex, 1 at the target; non-decreasing.
    pub t: f64,
}

/// Walk from a vertex to a target, one crossing per step; ends in the cell that contains the target
/// or in an infinite cell.
#[derive(Clone, Debug)]
pub struct Ray<'a> {
    delaunay: &'a Delaunay,
    vertex: u32,
    origin: Site,
    /// The first cell: incident to the vertex.
    first: u32,
    cell: u32,
    direction: Direction,
    ended: bool,
    t: f64,
    /// Exit of the ray from the current cell.
    exit: Exit,
}

/// Direction of a ray in grid units.
#[derive(Clone, Copy, Debug)]
struct Direction {
    exact: [i64; 3],
    rounded: [f64; 3],
    /// Bound of the rounding error of [`Direction::side`] in f64.
    error: f64,
    /// 1 / (squared length up to the target): turns a dot product with the direction into a
    /// position on the ray.
    scale: f64,
}

/// A corner of a triangle as seen from the ray's vertex, grid units.
#[derive(Clone, Copy, Debug, Default)]
struct Corner {
    /// Integers.
    offset: [f64; 3],
    /// offset × direction.
    moment: [f64; 3],
    /// offset · direction.
    along: f64,
    vertex: u32,
}

/// A triangle that the ray crosses, counter-clockwise seen along the ray.
#[derive(Clone, Copy, Debug, Default)]
struct Exit {
    /// Corners of the facet in the cell that the ray leaves.
    index: usize,
    corners: [Corner; 3],
    /// Side of the ray relative to the edge opposite to each corner; all positive.
    sides: [f64; 3],
}

impl Delaunay {
    /// Returns a ray from a vertex that has ended, until it is aimed.
    ///
    /// # Panics
    /// Below three dimensions, and if the vertex does not exist.
    pub fn ray(&self, vertex: u32) -> Ray<'_> {
        let cell = self.cell_of(vertex);
        let direction = Direction {
            exact: [0; 3],
            rounded: [0.0; 3],
            error: 0.0,
            scale: 0.0,
        };
        let (origin, exit) = (self.sites[vertex as usize], Exit::default());
        Ray {
            delaunay: self,
            vertex,
            origin,
            first: cell,
            cell,
            direction,
            ended: true,
            t: 0.0,
            exit,
        }
    }
}

impl Ray<'_> {
    /// Starts again from the vertex towards any world point; faster if its direction is similar to
    /// that of the last one. `start`: a cell at the vertex. What the ray was aimed at before has no
    /// influence on its cells: where it leaves the hull at once, the infinite cell that it ends in
    /// is the one that a turn from `start` leads to.
    pub fn aim(&mut self, target: &Point3<f64>, start: u32) {
        let (direction, stretch) = self.delaunay.grid.vector(&self.origin, target);
        self.direction = Direction::new(direction, stretch);
        self.t = 0.0;
        self.ended = direction == [0; 3] || !self.turn();
        if self.ended {
            (self.first, self.cell) = (start, start);
            self.ended = direction == [0; 3] || !self.turn();
        }
    }

    /// Returns the cell at the vertex that the ray goes through first; if it leaves the hull at
    /// once, the last finite one of its turn.
    pub fn first(&self) -> u32 {
        self.first
    }

    /// Returns the current cell: incident to the vertex before the first step; it contains the
    /// target or is infinite after the last.
    pub fn cell(&self) -> u32 {
        self.cell
    }

    /// Turns about the vertex to the cell that the ray starts in; false if that is an infinite
    /// cell. The link of a vertex is a regular triangulation, so that crossing any facet with the
    /// ray behind it leads there.
    fn turn(&mut self) -> bool {
        loop {
            let vertices = self.delaunay.cells[self.first as usize].vertices;
            let index = index_of(&vertices, self.vertex);
            let corners = FACET_VERTICES[index].map(|i| self.corner(&self.origin, vertices[i]));
            let sides = [1, 2, 0].map(|i| self.direction.side(&corners[i], &corners[(i + 1) % 3]));
            let Some(beyond) = sides.iter().position(|&side| side < 0.0) else {
                self.cell = self.first;
                self.exit = Exit {
                    index,
                    corners,
                    sides,
                };
                return true;
            };
            let towards = index_of(&vertices, corners[beyond].vertex);
            let next = self
                .delaunay
                .neighbour(Facet::new(self.first, towards))
                .cell();
            if self.delaunay.is_infinite(next) {
                self.cell = next;
                return false;
            }
            self.first = next;
        }
    }

    #[inline]
    fn corner(&self, origin: &Site, vertex: u32) -> Corner {
        let offset @ [x, y, z] = difference(&self.delaunay.sites[vertex as usize], origin);
        let [dx, dy, dz] = self.direction.rounded;
        let moment = [y * dz - z * dy, z * dx - x * dz, x * dy - y * dx];
        Corner {
            offset,
            moment,
            along: x * dx + y * dy + z * dz,
            vertex,
        }
    }

    /// In the cell entered through a triangle with corners a, b, c, the fourth corner d replaces
    /// one of them.
    #[inline]
    fn find_exit(&mut self, entered: Facet) {
        let cell = &self.delaunay.cells[entered.cell() as usize];
        let d = self.corner(&self.origin, cell.vertices[entered.index()]);
        let exit = &mut self.exit;
        let [a, b, c] = &exit.corners;
        let da = self.direction.side(&d, a);
        let db = self.direction.side(&d, b);
        // In spite of the perturbation, a side is 0 if d and the corner are collinear with the
        // ray's vertex. The ray crosses no triangle with both then, and strict signs choose none.
        let left = if da > 0.0 && db < 0.0 {
            (exit.sides[0], exit.sides[1]) = (-db, da);
            2
        } else {
            let dc = self.direction.side(&d, c);
            if da < 0.0 && dc > 0.0 {
                (exit.sides[0], exit.sides[2]) = (dc, -da);
                1
            } else {
                (exit.sides[1], exit.sides[2]) = (-dc, db);
                0
            }
        };
        exit.index = index_of(&cell.vertices, exit.corners[left].vertex);
        exit.corners[left] = d;
    }
}

impl Iterator for Ray<'_> {
    type Item = Crossing;

    fn next(&mut self) -> Option<Crossing> {
        if self.ended {
            return None;
        }
        let t = self
            .t
            .max(self.exit.position(&self.direction).unwrap_or(self.t));
        if t >= 1.0 {
            self.ended = true;
            return None;
        }
        self.t = t;
        let facet = Facet::new(self.cell, self.exit.index);
        let entered = self.delaunay.neighbour(facet);
        self.cell = entered.cell();
        if self.delaunay.is_infinite(self.cell) {
            self.ended = true;
        } else {
            self.find_exit(entered);
        }
        Some(Crossing { facet, t })
    }
}

impl std::iter::FusedIterator for Ray<'_> {}

impl Exit {
    /// Returns the position at which the ray crosses the triangle's plane; `None` if it is
    /// parallel.
    fn position(&self, direction: &Direction) -> Option<f64> {
        let [a, b, c] = &self.corners;
        let [bc, ca, ab] = self.sides;
        let sum = bc + ca + ab;
        // Sides are integers except for the perturbed ones, which are negligible.
        (sum > 0.5).then(|| (bc * a.along + ca * b.along + ab * c.along) / sum * direction.scale)
    }
}

impl Direction {
    fn new(exact: [i64; 3], stretch: f64) -> Self {
        let rounded = exact.map(|v| v as f64);
        let length = rounded
            .iter()
            .fold(0.0, |length: f64, v| length.max(v.abs()));
        let squared: f64 = rounded.iter().map(|v| v * v).sum();
        // Offsets stay below 2^30: at most 28 roundings of 2^-53 · 2^60 · length each.
        Direction {
            exact,
            rounded,
            error: 4096.0 * length,
            scale: 1.0 / (squared * stretch),
        }
    }

    /// Returns direction · (a × b) with the exact sign, perturbed if it is 0; 0 only if a, b and
    /// the ray's vertex are collinear.
    #[inline]
    fn side(&self, a: &Corner, b: &Corner) -> f64 {
        let [x, y, z] = a.offset;
        let side = x * b.moment[0] + y * b.moment[1] + z * b.moment[2];
        if side.abs() > self.error {
            side
        } else {
            self.exact_side(a, b)
        }
    }

    #[cold]
    #[inline(never)]
    fn exact_side(&self, a: &Corner, b: &Corner) -> f64 {
        let normal = cross(&a.offset.map(|v| v as i64), &b.offset.map(|v| v as i64));
        match wide_dot(&self.exact, &normal) {
            0 => normal
                .iter()
                .find(|&&n| n != 0)
                .map_or(0.0, |n| n.signum() as f64 * f64::MIN_POSITIVE),
            side => side as f64,
        }
    }
}

fn index_of(vertices: &[u32; 4], vertex: u32) -> usize {
    usize::from(vertices[1] == vertex)
        + 2 * usize::from(vertices[2] == vertex)
        + 3 * usize::from(vertices[3] == vertex)
}
