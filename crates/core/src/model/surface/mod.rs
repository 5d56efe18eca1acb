//! The surface of a scene as a triangle mesh, with what its edges join.

pub mod corners;
#[cfg(test)]
pub mod manifold;
pub mod shapes;

use nalgebra::{Point3, Vector3};
use serde::{Deserialize, Serialize};

/// Method by which the surface was made.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "lowercase")]
pub enum SurfaceKind {
    #[serde(rename = "3d")]
    Carved,
    Terrain,
    Mesh,
}

/// An oriented triangle mesh with borders; each edge has at most two triangles, normals point
/// outwards.
#[derive(Clone, Debug)]
pub struct Surface {
    pub kind: SurfaceKind,
    /// Vertices in world coordinates, scene units.
    pub vertices: Vec<Point3<f64>>,
    /// Vertex indices, counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
}

impl Surface {
    #[inline]
    pub fn corners(&self, triangle: u32) -> [Point3<f64>; 3] {
        self.triangles[triangle as usize].map(|v| self.vertices[v as usize])
    }

    pub fn centroid(&self, triangle: u32) -> Point3<f64> {
        let [a, b, c] = self.corners(triangle);
        Point3::from((a.coords + b.coords + c.coords) / 3.0)
    }

    pub fn centroids(&self) -> Vec<Point3<f64>> {
        let triangles = 0..self.triangles.len() as u32;
        triangles.map(|t| self.centroid(t)).collect()
    }

    /// Lengths of the sides of a triangle.
    pub fn sides(&self, triangle: u32) -> [f64; 3] {
        let [a, b, c] = self.corners(triangle);
        [(b - a).norm(), (c - b).norm(), (a - c).norm()]
    }

    /// Returns the normal, whose length is twice the triangle's area.
    pub fn area_normal(&self, triangle: u32) -> Vector3<f64> {
        let [a, b, c] = self.corners(triangle);
        (b - a).cross(&(c - a))
    }

    pub fn area(&self, triangle: u32) -> f64 {
        0.5 * self.area_normal(triangle).norm()
    }

    /// Returns the surface of the triangles to keep, in their order. Unused vertices are removed,
    /// and a vertex whose fans were connected only by dropped triangles is split, so that the
    /// result is again a manifold.
    pub fn keep(&self, keep: &[bool]) -> Surface {
        let kept = self
            .triangles
            .iter()
            .zip(keep)
            .filter_map(|(&t, &k)| k.then_some(t));
        corners::split_fans(Surface {
            kind: self.kind,
            vertices: self.vertices.clone(),
            triangles: kept.collect(),
        })
    }

    /// Appends another surface.
    pub fn append(&mut self, other: Surface) {
        let offset = self.vertices.len() as u32;
        self.vertices.extend(other.vertices);
        self.triangles.extend(
            other
                .triangles
                .iter()
                .map(|corners| corners.map(|v| v + offset)),
        );
    }
}
