//! Method 1: from sparse points to an oriented triangle mesh.
//!
//! `delaunay` tetrahedralises the points, `carve` casts the rays of the observations through the cells, `cut` separates inside
//! from outside, `clean` keeps an oriented manifold that views see, `simplify` and `refine` bring its edges to the wanted length;
//! `terrain` is the 2.5D way for nadir flights, `ply` reads and writes meshes.

pub mod clean;
pub mod corners;
pub mod cut;
pub mod delaunay;
pub mod manifold;
pub mod ply;
mod quadric;
pub mod refine;
#[cfg(test)]
pub(crate) mod shapes;
pub mod simplify;

use nalgebra::{Point3, Vector3};

/// How the surface was made.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum SurfaceKind {
    #[serde(rename = "3d")]
    Carved,
    Terrain,
    Mesh,
}

/// An oriented triangle mesh with borders; each edge has at most two triangles, normals point to the outside.
#[derive(Clone, Debug)]
pub struct Surface {
    pub kind: SurfaceKind,
    /// World coordinates, scene units.
    pub vertices: Vec<Point3<f64>>,
    /// Counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
}

impl Surface {
    pub fn corners(&self, triangle: u32) -> [Point3<f64>; 3] {
        self.triangles[triangle as usize].map(|v| self.vertices[v as usize])
    }

    pub fn centroid(&self, triangle: u32) -> Point3<f64> {
        let [a, b, c] = self.corners(triangle);
        Point3::from((a.coords + b.coords + c.coords) / 3.0)
    }

    /// Normal with the length of twice the triangle's area.
    pub fn area_normal(&self, triangle: u32) -> Vector3<f64> {
        let [a, b, c] = self.corners(triangle);
        (b - a).cross(&(c - a))
    }

    pub fn area(&self, triangle: u32) -> f64 {
        0.5 * self.area_normal(triangle).norm()
    }

    /// The surface of the triangles to keep, in their order. Vertices that nothing uses go, and a vertex at which only the dropped
    /// triangles held two fans together is split, so that the result is a manifold again.
    pub fn keep(&self, keep: &[bool]) -> Surface {
        let kept = self.triangles.iter().zip(keep).filter_map(|(&t, &k)| k.then_some(t));
        let rest = Surface { kind: self.kind, vertices: self.vertices.clone(), triangles: kept.collect() };
        let opposite = corners::opposites(&rest);
        corners::split_fans(rest, &opposite)
    }
}
