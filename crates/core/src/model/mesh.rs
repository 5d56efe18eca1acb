//! Triangle meshes as files have them.

use nalgebra::Point3;

/// A triangle mesh.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mesh {
    pub vertices: Vec<Point3<f64>>,
    /// Vertex indices.
    pub triangles: Vec<[u32; 3]>,
}
