//! Meshes with known area, volume and topology, for tests.

use std::collections::HashMap;

use nalgebra::{Point3, Vector3};

use super::{Surface, SurfaceKind};

/// A square from (0, 0) to (1, 1) of n x n cells at the heights of a function of (x, y), normals
/// up.
pub fn terrain(n: u32, height: impl Fn(f64, f64) -> f64) -> Surface {
    let at = |i: u32| f64::from(i) / f64::from(n);
    let ids = (0..=n).flat_map(|y| (0..=n).map(move |x| (x, y)));
    let vertices = ids
        .map(|(x, y)| Point3::new(at(x), at(y), height(at(x), at(y))))
        .collect();
    let cell = |x: u32, y: u32| {
        let a = y * (n + 1) + x;
        [[a, a + 1, a + n + 2], [a, a + n + 2, a + n + 1]]
    };
    let triangles = (0..n)
        .flat_map(|y| (0..n).flat_map(move |x| cell(x, y)))
        .collect();
    Surface {
        kind: SurfaceKind::Mesh,
        vertices,
        triangles,
    }
}

/// The unit sphere about the origin: an octahedron with each triangle quartered `rounds` times.
pub fn sphere(rounds: u32) -> Surface {
    let axes = [Vector3::x(), Vector3::y(), Vector3::z()];
    let vertices = axes.into_iter().chain(axes.map(|axis| -axis));
    let mut vertices: Vec<Point3<f64>> = vertices.map(Point3::from).collect();
    let mut triangles = OCTAHEDRON.to_vec();
    for _ in 0..rounds {
        triangles = quartered(&triangles, &mut vertices);
    }
    Surface {
        kind: SurfaceKind::Mesh,
        vertices,
        triangles,
    }
}

const OCTAHEDRON: [[u32; 3]; 8] = [
    [0, 1, 2],
    [1, 3, 2],
    [3, 4, 2],
    [4, 0, 2],
    [1, 0, 5],
    [3, 1, 5],
    [4, 3, 5],
    [0, 4, 5],
];

/// Quarters triangles, with the middles of their edges moved to the unit sphere.
fn quartered(triangles: &[[u32; 3]], vertices: &mut Vec<Point3<f64>>) -> Vec<[u32; 3]> {
    let mut middles = HashMap::new();
    let mut middle = |a: u32, b: u32| {
        *middles.entry((a.min(b), a.max(b))).or_insert_with(|| {
            let m = (vertices[a as usize].coords + vertices[b as usize].coords).normalize();
            vertices.push(Point3::from(m));
            vertices.len() as u32 - 1
        })
    };
    let quarter = |&[a, b, c]: &[u32; 3]| {
        let [p, q, r] = [middle(a, b), middle(b, c), middle(c, a)];
        [[a, p, r], [p, b, q], [r, q, c], [p, q, r]]
    };
    triangles.iter().flat_map(quarter).collect()
}

/// A torus about the z axis with radii 1 and 0.4 of n x n cells.
pub fn torus(n: u32) -> Surface {
    let angle = |i: u32| f64::from(i) * std::f64::consts::TAU / f64::from(n);
    let at = |i: u32, j: u32| {
        let (u, v) = (angle(i), angle(j));
        let r = 1.0 + 0.4 * v.cos();
        Point3::new(r * u.cos(), r * u.sin(), 0.4 * v.sin())
    };
    let id = |i: u32, j: u32| (i % n) * n + j % n;
    let cell = |(i, j)| {
        let [a, b, c, d] = [id(i, j), id(i + 1, j), id(i + 1, j + 1), id(i, j + 1)];
        [[a, b, c], [a, c, d]]
    };
    let cells = || (0..n).flat_map(|i| (0..n).map(move |j| (i, j)));
    Surface {
        kind: SurfaceKind::Mesh,
        vertices: cells().map(|(i, j)| at(i, j)).collect(),
        triangles: cells().flat_map(cell).collect(),
    }
}

/// Volume inside a closed surface, negative where normals point inwards.
pub fn volume(surface: &Surface) -> f64 {
    let sixfold = |t: &[u32; 3]| {
        let [a, b, c] = t.map(|v| surface.vertices[v as usize].coords);
        a.dot(&b.cross(&c))
    };
    surface.triangles.iter().map(sixfold).sum::<f64>() / 6.0
}

/// Lengths of all sides of all triangles.
pub fn sides(surface: &Surface) -> impl Iterator<Item = f64> + '_ {
    (0..surface.triangles.len() as u32).flat_map(|t| surface.sides(t))
}

/// Sum of the triangles' areas.
pub fn total_area(surface: &Surface) -> f64 {
    (0..surface.triangles.len() as u32)
        .map(|t| surface.area(t))
        .sum()
}
