//! Incremental construction (Bowyer 1981, Watson 1981): each vertex removes the cells whose
//! circumspheres contain it and is connected to the boundary of the cavity.
//!
//! A walk from the newest cell finds the cell that contains the vertex; the cavity is searched
//! breadth first from there. New cells reuse the memory of removed ones. Within this file the
//! vertex at infinity is the last site, which saves special cases.

use super::grid::Site;
use super::order::{round_from_last, rounds};
use super::predicates::{collinear, in_sphere, orient};
use super::{Cell, DelaunayError, Dimension, FACET_VERTICES, Facet};
use crate::base::progress::{Cancelled, Watcher};

/// Number of boundary facets up to which the cavity's edges are matched in a table: a closed
/// surface of 2n − 4 triangles has n vertices.
const TABLE_FACETS: usize = 2 * TABLE_VERTICES - 4;
const TABLE_VERTICES: usize = 64;

/// New cells between two checks for cancellation: under a millisecond of work.
const CELLS_PER_CHECK: usize = 1 << 12;

/// Facet codes have 30 bits for the cell.
const MAX_CELLS: usize = 1 << 30;

/// Cells per point allowed: points of a surface or a volume have six to seven, those on pairs of
/// skew curves up to half the number of points.
const MAX_CELLS_PER_VERTEX: usize = 64;
/// Number of cells that is always allowed.
const FREE_CELLS: usize = 1 << 20;

/// State of a cell in the search for the cavity; `Unseen` between two insertions.
#[derive(Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
enum Mark {
    Unseen,
    Removed,
    Kept,
}

/// A triangle of the cavity's boundary, counter-clockwise seen from outside the cavity, and the
/// facet on its other side.
#[derive(Clone, Copy)]
struct BoundaryFacet {
    vertices: [u32; 3],
    outer: Facet,
}

/// The cells so far; `cells` and `marks` have the same indices.
pub(super) struct Construction<'a> {
    /// Distinct sites, then one for the vertex at infinity.
    sites: &'a mut [Site],
    infinite: u32,
    pub cells: Vec<Cell>,
    marks: Vec<Mark>,
    free: Vec<u32>,
    /// A cell of the last insertion.
    last: u32,
    removed: Vec<u32>,
    boundary: Vec<BoundaryFacet>,
    /// Labelled vertices of the boundary, and per directed edge between labels the new facet on it.
    labelled: [u32; TABLE_VERTICES],
    edge_facets: Box<[[Facet; TABLE_VERTICES]; TABLE_VERTICES]>,
}

/// Triangulates distinct sites; the last one represents the vertex at infinity. No cells (`None`)
/// below three dimensions.
pub(super) fn triangulate(
    sites: &mut [Site],
    watcher: &dyn Watcher,
) -> Result<(Dimension, Vec<Cell>, Vec<u32>), DelaunayError> {
    let infinite = sites.len() as u32 - 1;
    let simplex = match first_simplex(&sites[..infinite as usize]) {
        Ok(simplex) => simplex,
        Err(dimension) => return Ok((dimension, Vec::new(), Vec::new())),
    };
    let mut construction = Construction::new(sites, simplex);
    construction.insert_all(simplex, watcher)?;
    Ok((Dimension::Three, construction.cells, construction.free))
}

/// Returns four sites that span space, positively oriented; otherwise the dimension of all sites.
fn first_simplex(sites: &[Site]) -> Result<[u32; 4], Dimension> {
    if sites.len() < 2 {
        return Err(Dimension::Zero);
    }
    let find = |wanted: &dyn Fn(&Site) -> bool| sites.iter().position(wanted);
    let (a, b) = (&sites[0], &sites[1]);
    let third = find(&|s| !collinear(a, b, s)).ok_or(Dimension::One)?;
    let c = &sites[third];
    let fourth = find(&|s| orient(a, b, c, s) != 0).ok_or(Dimension::Two)?;
    let (third, fourth) = if orient(a, b, c, &sites[fourth]) > 0 {
        (third, fourth)
    } else {
        (fourth, third)
    };
    Ok([0, 1, third as u32, fourth as u32])
}

/// Returns the facet of one of the first five cells that is on the other side of another's.
fn facet_beyond(cells: &[[u32; 4]], cell: &[u32; 4], index: usize) -> Facet {
    let mut shared = *cell;
    shared[index] = u32::MAX;
    let faces = |other: &[u32; 4]| {
        other != cell && shared.iter().filter(|v| other.contains(v)).count() == 3
    };
    let beyond = cells
        .iter()
        .position(faces)
        .expect("each two of the five cells share a triangle");
    let opposite = cells[beyond]
        .iter()
        .position(|v| !shared.contains(v))
        .expect("two cells differ in one vertex");
    Facet::new(beyond as u32, opposite)
}

impl<'a> Construction<'a> {
    fn new(sites: &'a mut [Site], simplex: [u32; 4]) -> Self {
        let infinite = sites.len() as u32 - 1;
        // Points of a surface or a volume have six to seven cells each.
        let expected = 7 * sites.len();
        let mut construction = Construction {
            sites,
            infinite,
            cells: Vec::with_capacity(expected),
            marks: Vec::with_capacity(expected),
            free: Vec::new(),
            last: 0,
            removed: Vec::new(),
            boundary: Vec::new(),
            labelled: [0; TABLE_VERTICES],
            edge_facets: Box::new([[Facet(0); TABLE_VERTICES]; TABLE_VERTICES]),
        };
        construction.start(simplex);
        construction
    }

    /// The first cell and the four infinite ones around it.
    fn start(&mut self, simplex: [u32; 4]) {
        let outside = |facet: usize| {
            let [a, b, c] = FACET_VERTICES[facet].map(|i| simplex[i]);
            [a, b, c, self.infinite]
        };
        let mut cells = vec![simplex];
        cells.extend((0..4).map(outside));
        for &vertices in &cells {
            self.cells.push(Cell {
                vertices,
                neighbours: [0, 1, 2, 3].map(|index| facet_beyond(&cells, &vertices, index)),
            });
            self.marks.push(Mark::Unseen);
        }
    }

    fn insert_all(
        &mut self,
        simplex: [u32; 4],
        watcher: &dyn Watcher,
    ) -> Result<(), DelaunayError> {
        let vertices = self.infinite;
        let mut unchecked = 0;
        for round in (0..rounds(vertices as usize)).rev() {
            for vertex in 0..vertices {
                if round_from_last(vertex) != round || simplex.contains(&vertex) {
                    continue;
                }
                self.insert(vertex, watcher)?;
                unchecked += self.boundary.len();
                if unchecked > CELLS_PER_CHECK {
                    unchecked = 0;
                    watcher.check()?;
                }
            }
        }
        Ok(())
    }

    fn insert(&mut self, vertex: u32, watcher: &dyn Watcher) -> Result<(), DelaunayError> {
        let site = self.sites[vertex as usize];
        let start = self.locate(&site);
        self.find_cavity(start, &site, watcher)?;
        self.reserve()?;
        self.fill_cavity(vertex);
        if self.boundary.len() <= TABLE_FACETS {
            self.match_edges_by_table()
        } else {
            self.match_edges_by_sorting()
        }
        Ok(())
    }

    /// Visibility walk to the cell that contains the site, or to an infinite cell whose facet has
    /// it strictly outside.
    fn locate(&self, site: &Site) -> u32 {
        let mut cell = self.last;
        // A walk goes through finite cells; the last insertion may have ended with an infinite one.
        if self.cells[cell as usize].vertices[3] == self.infinite {
            cell = self.cells[cell as usize].neighbours[3].cell();
        }
        let mut entered = 4;
        loop {
            let Cell {
                vertices,
                neighbours,
            } = self.cells[cell as usize];
            if vertices[3] == self.infinite {
                return cell;
            }
            let corners = vertices.map(|v| &self.sites[v as usize]);
            // The first facet varies from cell to cell; in a Delaunay triangulation, the walk ends
            // with any choice (Edelsbrunner 1990).
            let beyond = (0..4).map(|i| (i + cell as usize) & 3).find(|&i| {
                let [u, v, w] = FACET_VERTICES[i].map(|k| corners[k]);
                // The walk came through facet `entered`, so that the site is not beyond it.
                i != entered && orient(u, v, w, site) > 0
            });
            let Some(index) = beyond else { return cell };
            cell = neighbours[index].cell();
            entered = neighbours[index].index();
        }
    }

    fn find_cavity(
        &mut self,
        start: u32,
        site: &Site,
        watcher: &dyn Watcher,
    ) -> Result<(), Cancelled> {
        self.removed.clear();
        self.boundary.clear();
        self.removed.push(start);
        self.marks[start as usize] = Mark::Removed;
        let mut next = 0;
        while next < self.removed.len() {
            let cell = self.cells[self.removed[next] as usize];
            next += 1;
            if next % CELLS_PER_CHECK == 0 {
                watcher.check()?;
            }
            for index in 0..4 {
                self.cross(&cell, index, site);
            }
        }
        Ok(())
    }

    /// Removes the cell beyond a facet of a removed one, or adds the facet to the boundary.
    #[inline]
    fn cross(&mut self, cell: &Cell, index: usize, site: &Site) {
        let outer = cell.neighbours[index];
        let beyond = outer.cell();
        let mark = self.marks[beyond as usize];
        if mark == Mark::Removed {
            return;
        }
        if mark == Mark::Unseen && self.in_conflict(beyond, site) {
            self.marks[beyond as usize] = Mark::Removed;
            self.removed.push(beyond);
            return;
        }
        // So that it is not tested again when another facet leads to it.
        self.marks[beyond as usize] = Mark::Kept;
        self.boundary.push(BoundaryFacet {
            vertices: FACET_VERTICES[index].map(|i| cell.vertices[i]),
            outer,
        });
    }

    fn in_conflict(&self, cell: u32, site: &Site) -> bool {
        let Cell {
            vertices,
            neighbours,
        } = &self.cells[cell as usize];
        let corners = vertices.map(|v| &self.sites[v as usize]);
        if vertices[3] != self.infinite {
            return in_sphere(corners, site);
        }
        match orient(corners[0], corners[1], corners[2], site) {
            // In the facet's plane its circumcircle decides, in which the sphere of the finite
            // neighbour intersects the plane.
            0 => self.in_conflict(neighbours[3].cell(), site),
            side => side > 0,
        }
    }

    /// Reserves the new cells, or returns an error if there would be too many.
    fn reserve(&mut self) -> Result<(), DelaunayError> {
        let limit = MAX_CELLS.min(FREE_CELLS.max(MAX_CELLS_PER_VERTEX * self.sites.len()));
        if self.cells.len() + self.boundary.len() > limit {
            return Err(DelaunayError::TooManyCells {
                vertices: self.sites.len() - 1,
                limit,
            });
        }
        while self.removed.len() < self.boundary.len() {
            let cell = self.free.pop().unwrap_or_else(|| {
                self.cells.push(Cell {
                    vertices: [0; 4],
                    neighbours: [Facet(0); 4],
                });
                self.marks.push(Mark::Unseen);
                self.cells.len() as u32 - 1
            });
            self.removed.push(cell);
        }
        Ok(())
    }

    /// Makes one cell per boundary facet: the new vertex first, the vertex at infinity, if any,
    /// last.
    fn fill_cavity(&mut self, vertex: u32) {
        let spare = self.removed.split_off(self.boundary.len());
        self.free.extend(
            spare
                .iter()
                .inspect(|&&cell| self.marks[cell as usize] = Mark::Unseen),
        );
        for (facet, &cell) in self.boundary.iter_mut().zip(&self.removed) {
            let [u, v, w] = facet.vertices;
            // Rotated, not swapped: the facet keeps its orientation.
            if u == self.infinite {
                facet.vertices = [v, w, u];
            } else if v == self.infinite {
                facet.vertices = [w, u, v];
            }
            let [u, v, w] = facet.vertices;
            let outer = facet.outer;
            self.cells[cell as usize] = Cell {
                vertices: [vertex, u, v, w],
                neighbours: [outer; 4],
            };
            self.cells[outer.cell() as usize].neighbours[outer.index()] = Facet::new(cell, 0);
            self.marks[outer.cell() as usize] = Mark::Unseen;
            self.marks[cell as usize] = Mark::Unseen;
        }
        self.last = self.removed[self.removed.len() - 1];
    }

    /// Connects the new cells: the edge from u to v of one boundary facet is the edge from v to u
    /// of the next.
    fn match_edges_by_table(&mut self) {
        let mut count = 0;
        for facet in 0..self.boundary.len() {
            let labels = self.boundary[facet].vertices.map(|v| {
                let site = &mut self.sites[v as usize];
                let old = site.label as usize;
                // Labels of earlier insertions are recognised by the entry that they point to, so
                // that none has to be cleared.
                // The masks change no label, but spare checks of bounds.
                let fresh = old >= count || self.labelled[old & (TABLE_VERTICES - 1)] != v;
                let label = if fresh { count } else { old } & (TABLE_VERTICES - 1);
                site.label = label as u32;
                self.labelled[label] = v;
                count += usize::from(fresh);
                label
            });
            // In place of the vertices, which the cells have already.
            self.boundary[facet].vertices = labels.map(|l| l as u32);
            let [u, v, w] = labels;
            let cell = self.removed[facet];
            self.edge_facets[v][w] = Facet::new(cell, 1);
            self.edge_facets[w][u] = Facet::new(cell, 2);
            self.edge_facets[u][v] = Facet::new(cell, 3);
        }
        for (facet, &cell) in self.boundary.iter().zip(&self.removed) {
            let [u, v, w] = facet
                .vertices
                .map(|label| label as usize & (TABLE_VERTICES - 1));
            let neighbours = &mut self.cells[cell as usize].neighbours;
            neighbours[1] = self.edge_facets[w][v];
            neighbours[2] = self.edge_facets[u][w];
            neighbours[3] = self.edge_facets[v][u];
        }
    }

    /// As above, for cavities of any size.
    fn match_edges_by_sorting(&mut self) {
        let mut edges: Vec<(u32, u32, Facet)> = Vec::with_capacity(3 * self.boundary.len());
        for (facet, &cell) in self.boundary.iter().zip(&self.removed) {
            let [u, v, w] = facet.vertices;
            for (index, (from, to)) in [(v, w), (w, u), (u, v)].into_iter().enumerate() {
                edges.push((from.min(to), from.max(to), Facet::new(cell, index + 1)));
            }
        }
        edges.sort_unstable_by_key(|&(low, high, facet)| (low, high, facet.0));
        for pair in edges.chunks_exact(2) {
            let (one, other) = (pair[0].2, pair[1].2);
            self.cells[one.cell() as usize].neighbours[one.index()] = other;
            self.cells[other.cell() as usize].neighbours[other.index()] = one;
        }
    }
}
