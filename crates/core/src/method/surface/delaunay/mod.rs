//! 3D Delaunay triangulation (method 1.1), exact on a grid of 30 bits per axis, and rays through it
//! (method 1.2).
//!
//! `grid` snaps the points, `order` sorts them, `predicates` computes signs exactly, `insertion`
//! builds the cells, `ray` walks through them, `validate` checks the result.
//!
//! The result depends only on the set of points, not on their order: ties of cospherical points are
//! broken by symbolic perturbation. Expected time is n log n with a small constant for points on
//! surfaces and in volumes. On pairs of skew curves the number of cells is quadratic, which is an
//! error. Flat input is not an error: see [`Dimension`].

mod grid;
mod insertion;
mod order;
mod predicates;
mod ray;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod validate;

use crate::base::progress::{Cancelled, Watcher};
use bytemuck::Zeroable;
use grid::{Grid, Site};
use nalgebra::Point3;

/// The vertex at infinity. Each triangle of the convex hull forms an infinite cell with it.
pub const INFINITE: u32 = u32::MAX;

/// Corners of the facet opposite to each corner of a cell, counter-clockwise seen from outside the
/// cell.
pub const FACET_VERTICES: [[usize; 3]; 4] = [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]];

/// One side of a triangle: a cell and the index of the corner opposite to the triangle.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Zeroable)]
#[repr(transparent)]
pub struct Facet(pub u32);

impl Facet {
    #[inline]
    pub fn new(cell: u32, index: usize) -> Self {
        Facet(4 * cell + index as u32)
    }

    #[inline]
    pub fn cell(self) -> u32 {
        self.0 >> 2
    }

    #[inline]
    pub fn index(self) -> usize {
        (self.0 & 3) as usize
    }
}

/// A tetrahedron, positively oriented: det(b − a, c − a, d − a) > 0; [`INFINITE`] is always last.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(C, align(32))]
pub struct Cell {
    pub vertices: [u32; 4],
    /// `neighbours[i]` is the triangle opposite to corner i, as a facet of the cell behind it.
    pub neighbours: [Facet; 4],
}

/// Dimension of the affine hull of the distinct points. Only [`Dimension::Three`] has cells.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Dimension {
    /// No or one distinct point.
    Zero,
    One,
    Two,
    Three,
}

#[derive(Debug, thiserror::Error)]
pub enum DelaunayError {
    #[error("point {point} has a coordinate that is not a finite number; remove it from the model")]
    NotFinite { point: usize },
    #[error(
        "the triangulation of {vertices} points needs more than {limit} cells; \
         the points lie on a few thin curves: remove outliers or set surface.kind = terrain"
    )]
    TooManyCells { vertices: usize, limit: usize },
    #[error("{points} points are more than 32-bit indices can number; thin the model")]
    TooManyPoints { points: usize },
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
}

/// A Delaunay triangulation. Vertices are the distinct grid points in the order of a space-filling
/// curve.
#[derive(Clone, Debug)]
pub struct Delaunay {
    pub dimension: Dimension,
    pub cells: Vec<Cell>,
    /// Vertex of each input point; points with the same grid point share one.
    pub vertex_of_point: Vec<u32>,
    sites: Vec<Site>,
    grid: Grid,
    /// A finite cell at each vertex.
    cell_of_vertex: Vec<u32>,
}

impl Delaunay {
    /// Triangulates points given in world coordinates.
    ///
    /// # Errors
    /// Points that are not finite or too many, a triangulation of quadratic size, cancellation.
    pub fn triangulate(
        points: &[Point3<f64>],
        watcher: &dyn Watcher,
    ) -> Result<Self, DelaunayError> {
        if let Some(point) = points.iter().position(|p| !p.iter().all(|v| v.is_finite())) {
            return Err(DelaunayError::NotFinite { point });
        }
        if points.len() >= INFINITE as usize {
            return Err(DelaunayError::TooManyPoints {
                points: points.len(),
            });
        }
        let grid = Grid::around(points);
        let (mut sites, vertex_of_point) = order::sorted_sites(points, &grid, watcher)?;
        // The vertex at infinity, which `insertion` numbers like a site.
        sites.push(Site::default());
        let (dimension, cells, free) = insertion::triangulate(&mut sites, watcher)?;
        sites.pop();
        let cells = compact(&cells, &free, sites.len() as u32);
        watcher.check()?;
        let cell_of_vertex = cells_of_vertices(&cells, sites.len());
        Ok(Delaunay {
            dimension,
            cells,
            vertex_of_point,
            sites,
            grid,
            cell_of_vertex,
        })
    }

    pub fn vertex_count(&self) -> usize {
        self.sites.len()
    }

    /// Returns the world position of a vertex: that of its points within half a [`Delaunay::step`]
    /// per axis.
    pub fn position(&self, vertex: u32) -> Point3<f64> {
        self.grid.position(&self.sites[vertex as usize])
    }

    /// Returns a finite cell at the vertex.
    pub fn cell_of(&self, vertex: u32) -> u32 {
        self.cell_of_vertex[vertex as usize]
    }

    /// Returns the step of the grid, scene units.
    pub fn step(&self) -> f64 {
        self.grid.step
    }

    #[inline]
    pub fn is_infinite(&self, cell: u32) -> bool {
        self.cells[cell as usize].vertices[3] == INFINITE
    }

    /// Returns the same triangle as a facet of the cell behind it.
    #[inline]
    pub fn neighbour(&self, facet: Facet) -> Facet {
        self.cells[facet.cell() as usize].neighbours[facet.index()]
    }

    /// Returns the corners, counter-clockwise seen from outside the facet's cell; one may be
    /// [`INFINITE`] in infinite cells.
    pub fn facet_vertices(&self, facet: Facet) -> [u32; 3] {
        FACET_VERTICES[facet.index()].map(|i| self.cells[facet.cell() as usize].vertices[i])
    }
}

/// Renumbers the used cells by their first vertex along the space-filling curve, so that cells near
/// in space are near in memory for rays and the cut. Replaces the site at infinity by [`INFINITE`].
fn compact(cells: &[Cell], free: &[u32], infinite: u32) -> Vec<Cell> {
    let place = places(cells, free, infinite);
    let mut order = vec![0; cells.len() - free.len()];
    for (from, &to) in (0..).zip(&place).filter(|(_, place)| **place != UNUSED) {
        order[to as usize] = from;
    }
    let placed = |from: usize| {
        let Cell {
            mut vertices,
            neighbours,
        } = cells[from];
        if vertices[3] == infinite {
            vertices[3] = INFINITE;
        }
        Cell {
            vertices,
            neighbours: neighbours.map(|f| Facet::new(place[f.cell() as usize], f.index())),
        }
    };
    order.into_iter().map(placed).collect()
}

/// Number of a cell that is not used.
const UNUSED: u32 = u32::MAX;

/// Returns the new number of each cell, by counting those of each first vertex.
fn places(cells: &[Cell], free: &[u32], infinite: u32) -> Vec<u32> {
    let mut place = vec![0; cells.len()];
    free.iter().for_each(|&gap| place[gap as usize] = UNUSED);
    let mut next = vec![0; infinite as usize + 2];
    for (cell, _) in cells
        .iter()
        .zip(&place)
        .filter(|(_, place)| **place != UNUSED)
    {
        next[first_vertex(cell) + 1] += 1;
    }
    for vertex in 1..next.len() {
        next[vertex] += next[vertex - 1];
    }
    let used = |(_, place): &(&Cell, &mut u32)| **place != UNUSED;
    for (cell, place) in cells.iter().zip(&mut place).filter(used) {
        let next = &mut next[first_vertex(cell)];
        *place = *next;
        *next += 1;
    }
    place
}

fn first_vertex(cell: &Cell) -> usize {
    let first = cell.vertices.into_iter().min();
    first.expect("a cell has four vertices") as usize
}

fn cells_of_vertices(cells: &[Cell], vertices: usize) -> Vec<u32> {
    let mut cell_of_vertex = vec![0; if cells.is_empty() { 0 } else { vertices }];
    for (index, cell) in cells.iter().enumerate() {
        if cell.vertices[3] != INFINITE {
            for v in cell.vertices {
                cell_of_vertex[v as usize] = index as u32;
            }
        }
    }
    cell_of_vertex
}
