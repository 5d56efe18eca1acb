//! Checks all properties of a triangulation; slow, for tests.

use super::predicates::{in_sphere, orient};
use super::{Delaunay, Dimension, Facet, INFINITE};
use std::collections::HashSet;

/// Defect of a triangulation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Flaw {
    #[error(
        "cell {cell} repeats a corner, refers to a missing vertex, or has the infinite vertex not last"
    )]
    Corners { cell: u32 },
    #[error("cell {cell} is not positively oriented")]
    Orientation { cell: u32 },
    #[error("facet {0:?} and its neighbour do not refer to each other or differ in their corners")]
    Neighbour(Facet),
    #[error("the circumsphere of the cell of facet {0:?} contains the corner beyond the facet")]
    NotDelaunay(Facet),
    #[error("vertex {vertex} has no cell, or its recorded cell does not contain it")]
    Vertex { vertex: u32 },
    #[error("vertices − edges + triangles − cells is {0}, not 0")]
    Euler(i64),
    #[error("there are cells below three dimensions")]
    Dimension,
}

impl Delaunay {
    /// Neighbours, orientation, empty spheres across each facet (which makes all spheres empty, by
    /// Delaunay's lemma) and the Euler sum. Linear in the number of cells.
    ///
    /// # Errors
    /// The first flaw found.
    pub fn validate(&self) -> Result<(), Flaw> {
        if self.dimension != Dimension::Three {
            return if self.cells.is_empty() {
                Ok(())
            } else {
                Err(Flaw::Dimension)
            };
        }
        for cell in 0..self.cells.len() as u32 {
            self.validate_corners(cell)?;
            for index in 0..4 {
                let facet = Facet::new(cell, index);
                self.validate_neighbour(facet)?;
                if self.in_conflict(cell, self.beyond(facet)) {
                    return Err(Flaw::NotDelaunay(facet));
                }
            }
        }
        self.validate_vertices()?;
        match self.euler_sum() {
            0 => Ok(()),
            sum => Err(Flaw::Euler(sum)),
        }
    }

    fn validate_corners(&self, cell: u32) -> Result<(), Flaw> {
        let vertices = self.cells[cell as usize].vertices;
        let distinct: HashSet<u32> = vertices.into_iter().collect();
        let finite = if self.is_infinite(cell) {
            &vertices[..3]
        } else {
            &vertices[..]
        };
        if distinct.len() != 4 || finite.iter().any(|&v| v as usize >= self.sites.len()) {
            return Err(Flaw::Corners { cell });
        }
        if !self.is_infinite(cell) {
            let [a, b, c, d] = vertices.map(|v| &self.sites[v as usize]);
            if orient(a, b, c, d) <= 0 {
                return Err(Flaw::Orientation { cell });
            }
        }
        Ok(())
    }

    fn validate_neighbour(&self, facet: Facet) -> Result<(), Flaw> {
        let other = self.cells[facet.cell() as usize].neighbours[facet.index()];
        let named = (other.cell() as usize) < self.cells.len() && self.neighbour(other) == facet;
        if !named || other.cell() == facet.cell() {
            return Err(Flaw::Neighbour(facet));
        }
        // Seen from the other side, the same triangle has the opposite orientation.
        let [a, b, c] = self.facet_vertices(facet);
        let seen = self.facet_vertices(other);
        if [[a, c, b], [c, b, a], [b, a, c]].contains(&seen) {
            Ok(())
        } else {
            Err(Flaw::Neighbour(facet))
        }
    }

    fn beyond(&self, facet: Facet) -> u32 {
        let other = self.neighbour(facet);
        self.cells[other.cell() as usize].vertices[other.index()]
    }

    fn in_conflict(&self, cell: u32, vertex: u32) -> bool {
        if vertex == INFINITE {
            return false;
        }
        let site = &self.sites[vertex as usize];
        let vertices = self.cells[cell as usize].vertices;
        if self.is_infinite(cell) {
            let [a, b, c] = [0, 1, 2].map(|i| &self.sites[vertices[i] as usize]);
            let finite = self.neighbour(Facet::new(cell, 3)).cell();
            let side = orient(a, b, c, site);
            return side > 0 || side == 0 && self.in_conflict(finite, vertex);
        }
        !vertices.contains(&vertex) && in_sphere(vertices.map(|v| &self.sites[v as usize]), site)
    }

    fn validate_vertices(&self) -> Result<(), Flaw> {
        for vertex in 0..self.sites.len() as u32 {
            let cell = self
                .cell_of_vertex
                .get(vertex as usize)
                .map(|&cell| &self.cells[cell as usize]);
            if !cell
                .is_some_and(|cell| cell.vertices.contains(&vertex) && cell.vertices[3] != INFINITE)
            {
                return Err(Flaw::Vertex { vertex });
            }
        }
        Ok(())
    }

    /// Vertices − edges + triangles − cells with the infinite ones: 0 on the three-sphere.
    fn euler_sum(&self) -> i64 {
        let mut edges = HashSet::new();
        for cell in &self.cells {
            for (i, j) in [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)] {
                let (u, v) = (cell.vertices[i], cell.vertices[j]);
                edges.insert((u.min(v), u.max(v)));
            }
        }
        // Each cell has four triangles, each triangle two cells.
        self.sites.len() as i64 + 1 - edges.len() as i64 + self.cells.len() as i64
    }
}
