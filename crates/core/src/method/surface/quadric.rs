//! Quadric error metrics (Garland, Heckbert 1997): weighted sums of squared distances to planes and
//! points.

use nalgebra::{Matrix3, Vector3};

use crate::model::surface::{
    Surface,
    corners::{BORDER, next, prev, vertex},
};

/// Weight of a border plane relative to a triangle's plane.
const BORDER_WEIGHT: f64 = 10.0;
/// Weight of the pull to the vertex relative to the planes.
const PULL_WEIGHT: f64 = 1e-3;

/// Σ w (n·x + d)² as xᵀ A x + 2 bᵀ x + c, A symmetric.
#[derive(Clone, Copy, Default)]
pub struct Quadric {
    /// xx, xy, xz, yy, yz, zz.
    a: [f64; 6],
    b: [f64; 3],
    c: f64,
}

impl Quadric {
    fn plane(normal: Vector3<f64>, through: Vector3<f64>, weight: f64) -> Self {
        let (n, d) = (normal, -normal.dot(&through));
        let w = weight;
        Self {
            a: [
                n.x * n.x,
                n.x * n.y,
                n.x * n.z,
                n.y * n.y,
                n.y * n.z,
                n.z * n.z,
            ]
            .map(|v| w * v),
            b: [w * d * n.x, w * d * n.y, w * d * n.z],
            c: w * d * d,
        }
    }

    /// w |x - p|².
    fn pull(p: Vector3<f64>, w: f64) -> Self {
        Self {
            a: [w, 0.0, 0.0, w, 0.0, w],
            b: [-w * p.x, -w * p.y, -w * p.z],
            c: w * p.norm_squared(),
        }
    }

    pub fn add(&mut self, other: &Quadric) {
        self.a.iter_mut().zip(other.a).for_each(|(x, y)| *x += y);
        self.b.iter_mut().zip(other.b).for_each(|(x, y)| *x += y);
        self.c += other.c;
    }

    pub fn evaluate(&self, x: &Vector3<f64>) -> f64 {
        let [xx, xy, xz, yy, yz, zz] = self.a;
        let square = xx * x.x * x.x + yy * x.y * x.y + zz * x.z * x.z;
        let mixed = xy * x.x * x.y + xz * x.x * x.z + yz * x.y * x.z;
        let linear = self.b[0] * x.x + self.b[1] * x.y + self.b[2] * x.z;
        // Rounding may leave less than 0, and costs are compared by their bits.
        (square + 2.0 * (mixed + linear) + self.c).max(0.0)
    }

    /// Returns the minimum; `None` if the quadric is flat.
    pub fn minimum(&self) -> Option<Vector3<f64>> {
        let [xx, xy, xz, yy, yz, zz] = self.a;
        let inverse = Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz).try_inverse()?;
        let x = -(inverse * Vector3::from(self.b));
        x.iter().all(|v| v.is_finite()).then_some(x)
    }
}

/// Returns the quadric of each vertex: the planes of its triangles weighted by a third of their
/// areas, planes perpendicular to its border edges weighted by the squared length of the edge, and
/// the pull to the vertex's position.
pub fn vertex_quadrics(surface: &Surface, opposite: &[u32]) -> Vec<Quadric> {
    let mut quadrics = vec![Quadric::default(); surface.vertices.len()];
    for t in 0..surface.triangles.len() {
        add_triangle(&mut quadrics, surface, t);
    }
    for c in (0..opposite.len() as u32).filter(|&c| opposite[c as usize] == BORDER) {
        add_border(&mut quadrics, surface, c);
    }
    quadrics
}

fn add_triangle(quadrics: &mut [Quadric], surface: &Surface, triangle: usize) {
    let normal = surface.area_normal(triangle as u32);
    let Some(unit) = normal.try_normalize(0.0) else {
        return;
    };
    let weight = normal.norm() / 6.0;
    let corners = surface.triangles[triangle].map(|v| v as usize);
    let at = |v: usize| surface.vertices[v].coords;
    let plane = Quadric::plane(unit, at(corners[0]), weight);
    for v in corners {
        quadrics[v].add(&plane);
        // The planes around a vertex of a flat part have no unique minimum by themselves.
        quadrics[v].add(&Quadric::pull(at(v), PULL_WEIGHT * weight));
    }
}

/// Adds the plane at the border edge that a corner faces.
fn add_border(quadrics: &mut [Quadric], surface: &Surface, corner: u32) {
    let ends = [next(corner), prev(corner)].map(|c| vertex(&surface.triangles, c) as usize);
    let from = surface.vertices[ends[0]].coords;
    let edge = surface.vertices[ends[1]].coords - from;
    let upright = edge.cross(&surface.area_normal(corner / 3));
    if let Some(upright) = upright.try_normalize(0.0) {
        let plane = Quadric::plane(upright, from, BORDER_WEIGHT * edge.norm_squared());
        ends.iter().for_each(|&v| quadrics[v].add(&plane));
    }
}
