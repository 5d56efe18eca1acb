//! Point in a closed mesh, exactly: parity of the number of triangles above the point, by the signs
//! of adaptive predicates.
//!
//! The triangles are sorted into vertical columns. A vertical line through an edge or a vertex
//! crosses exactly one of the triangles on each side, because the crossing is decided per edge, not
//! per triangle. Orientation does not matter. Where parts overlap, the interior of an even number
//! of them counts as outside.

use nalgebra::Point3;
use robust::{Coord3D, orient3d};

use super::{
    columns::{Columns, Rectangle},
    polygon::{crosses, side},
};
use crate::model::mesh::Mesh;

type Corners = [Point3<f64>; 3];

/// A closed mesh, indexed for queries.
#[derive(Clone, Debug)]
pub struct Solid {
    triangles: Vec<Corners>,
    columns: Columns,
    pub low: Point3<f64>,
    pub high: Point3<f64>,
}

/// The mesh doesn't enclose a volume.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum OpenMesh {
    #[error("it has no triangles")]
    Empty,
    /// `edges` edges belong to an odd number of triangles; `middle` is that of the first.
    #[error("it is open: {edges} of its edges belong to one triangle only, one of them at {:.6} {:.6} {:.6}", middle.x, middle.y, middle.z)]
    Open { edges: usize, middle: Point3<f64> },
}

impl Solid {
    pub fn new(mesh: &Mesh) -> Result<Self, OpenMesh> {
        let faces = faces(mesh);
        if faces.is_empty() {
            return Err(OpenMesh::Empty);
        }
        check_closed(&faces, &mesh.vertices)?;
        let corners = |face: &[u32; 3]| face.map(|v| mesh.vertices[v as usize]);
        let triangles: Vec<Corners> = faces.iter().map(corners).collect();
        let shadows: Vec<Rectangle> = triangles.iter().map(shadow).collect();
        let points = || triangles.iter().flatten();
        let low = points().fold(triangles[0][0], |low, p| low.inf(p));
        let high = points().fold(triangles[0][0], |high, p| high.sup(p));
        Ok(Self {
            columns: Columns::new(&shadows),
            triangles,
            low,
            high,
        })
    }

    /// Returns the corners of all triangles.
    pub fn vertices(&self) -> impl Iterator<Item = Point3<f64>> {
        self.triangles.iter().flatten().copied()
    }

    /// Adds the number of triangles that it looks at to `looked_at`.
    pub fn contains(&self, point: &Point3<f64>, looked_at: &mut u64) -> bool {
        if !(self.low[2] <= point.z && point.z <= self.high[2]) {
            return false;
        }
        let column = self.columns.cell(flat(*point));
        *looked_at += column.len() as u64;
        let above = column
            .iter()
            .filter(|&&t| is_below(point, &self.triangles[t as usize]));
        above.count() % 2 == 1
    }
}

fn shadow(corners: &Corners) -> Rectangle {
    Rectangle::around(&corners.map(flat))
}

fn flat(point: Point3<f64>) -> [f64; 2] {
    [point.x, point.y]
}

/// Returns whether the vertical line through the point crosses the triangle above it.
fn is_below(point: &Point3<f64>, corners: &Corners) -> bool {
    let [a, b, c] = corners.map(flat);
    let at = flat(*point);
    let is_crossed = crosses([a, b], at) ^ crosses([b, c], at) ^ crosses([c, a], at);
    if !is_crossed {
        return false;
    }
    let [p, q, r, s] = [corners[0], corners[1], corners[2], *point].map(|p| Coord3D {
        x: p.x,
        y: p.y,
        z: p.z,
    });
    // Positive below the plane where the corners run counter-clockwise seen from above.
    let below = orient3d(p, q, r, s);
    if side(a, b, c) > 0.0 {
        below > 0.0
    } else {
        below < 0.0
    }
}

/// Returns the triangles that are not degenerate, with merged vertices: the others have no inside,
/// and their edges cancel each other.
fn faces(mesh: &Mesh) -> Vec<[u32; 3]> {
    let place = merged(&mesh.vertices);
    let faces = mesh.triangles.iter().map(|t| t.map(|v| place[v as usize]));
    faces
        .filter(|&[a, b, c]| a != b && b != c && c != a)
        .collect()
}

/// Returns, for each vertex, the first one at its position: PLY files often repeat vertices for
/// each triangle.
fn merged(vertices: &[Point3<f64>]) -> Vec<u32> {
    // Adding 0 turns -0 into 0, so that equal positions have equal bits.
    let bits = |v: &Point3<f64>| [v.x, v.y, v.z].map(|x| (x + 0.0).to_bits());
    let mut order: Vec<u32> = (0..vertices.len() as u32).collect();
    order.sort_unstable_by_key(|&v| (bits(&vertices[v as usize]), v));
    let mut first = vec![0; vertices.len()];
    let mut current = 0;
    for &v in &order {
        if bits(&vertices[v as usize]) != bits(&vertices[current as usize]) || v == order[0] {
            current = v;
        }
        first[v as usize] = current;
    }
    first
}

/// Returns the edges of all triangles, each with its smaller end first.
fn sorted_edges(faces: &[[u32; 3]]) -> Vec<[u32; 2]> {
    let edges = faces
        .iter()
        .flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]])
        .map(|[a, b]| [a.min(b), a.max(b)]);
    let mut edges: Vec<[u32; 2]> = edges.collect();
    edges.sort_unstable();
    edges
}

fn check_closed(faces: &[[u32; 3]], vertices: &[Point3<f64>]) -> Result<(), OpenMesh> {
    let edges = sorted_edges(faces);
    let same = edges.chunk_by(|a, b| a == b);
    let odd: Vec<&[[u32; 2]]> = same.filter(|same| same.len() % 2 == 1).collect();
    let Some(first) = odd.first() else {
        return Ok(());
    };
    let [a, b] = first[0].map(|v| vertices[v as usize]);
    Err(OpenMesh::Open {
        edges: odd.len(),
        middle: nalgebra::center(&a, &b),
    })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::method::synthetic::block;

    /// An octahedron, each triangle split into four `times` times, its vertices moved to the unit
    /// sphere.
    fn sphere(times: u32) -> Mesh {
        let axes = [
            [1, 0, 0],
            [0, 1, 0],
            [-1, 0, 0],
            [0, -1, 0],
            [0, 0, 1],
            [0, 0, -1],
        ];
        let at = |i: usize| Point3::from(axes[i].map(f64::from));
        let mut triangles: Vec<Corners> = (0..4)
            .flat_map(|i| {
                [
                    [at(i), at((i + 1) % 4), at(4)],
                    [at((i + 1) % 4), at(i), at(5)],
                ]
            })
            .collect();
        for _ in 0..times {
            let split = |[a, b, c]: Corners| {
                let middle = |p: Point3<f64>, q: Point3<f64>| {
                    Point3::from((p.coords + q.coords).normalize())
                };
                let [ab, bc, ca] = [middle(a, b), middle(b, c), middle(c, a)];
                [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
            };
            triangles = triangles.into_iter().flat_map(split).collect();
        }
        let vertices: Vec<Point3<f64>> = triangles.into_iter().flatten().collect();
        let triangles = (0..vertices.len() as u32 / 3)
            .map(|t| [3 * t, 3 * t + 1, 3 * t + 2])
            .collect();
        Mesh {
            vertices,
            triangles,
        }
    }

    #[test]
    fn the_share_of_samples_inside_is_the_volume() {
        let mesh = sphere(4);
        let solid = Solid::new(&mesh).expect("repeated vertices are merged, so that it is closed");
        let of_cone = |t: &[u32; 3]| {
            let [a, b, c] = t.map(|v| mesh.vertices[v as usize].coords);
            a.dot(&b.cross(&c)) / 6.0
        };
        let expected: f64 = mesh.triangles.iter().map(of_cone).sum();
        assert!(
            (4.1..4.19).contains(&expected),
            "nearly the ball: {expected}"
        );
        let n = 60;
        let at = |i: usize| 2.0 * (i as f64 + 0.5) / n as f64 - 1.0;
        let points = (0..n * n * n).map(|i| Point3::new(at(i % n), at(i / n % n), at(i / n / n)));
        let inside = points.filter(|p| solid.contains(p, &mut 0)).count() as f64;
        let volume = 8.0 * inside / (n * n * n) as f64;
        assert!((volume - expected).abs() < 0.01, "{volume} {expected}");
    }

    #[test]
    fn lines_through_edges_and_vertices_are_counted_once() {
        // Every sample is straight below vertices and edges.
        let solid = Solid::new(&block([0.0; 3], [2.0; 3])).unwrap();
        for (x, y) in [(0.0, 0.0), (1.0, 1.0), (0.0, 1.0), (1.0, 0.0), (1.5, 1.5)] {
            assert!(solid.contains(&Point3::new(x, y, 1.0), &mut 0), "{x} {y}");
            assert!(
                !solid.contains(&Point3::new(x, y, -1.0), &mut 0)
                    && !solid.contains(&Point3::new(x, y, 3.0), &mut 0),
                "{x} {y}"
            );
        }
        let octahedron = Solid::new(&sphere(0)).unwrap();
        assert!(
            octahedron.contains(&Point3::origin(), &mut 0)
                && !octahedron.contains(&Point3::new(0.0, 0.0, -1.5), &mut 0)
        );
    }

    #[test]
    fn open_and_empty_meshes_are_refused() {
        let mut open = block([0.0; 3], [1.0; 3]);
        open.triangles.pop();
        assert!(matches!(
            Solid::new(&open),
            Err(OpenMesh::Open { edges: 3, .. })
        ));
        assert!(matches!(Solid::new(&Mesh::default()), Err(OpenMesh::Empty)));
        let collapsed = Mesh {
            vertices: vec![Point3::origin(); 3],
            triangles: vec![[0, 1, 2]],
        };
        assert!(matches!(Solid::new(&collapsed), Err(OpenMesh::Empty)));
    }

    #[test]
    fn a_cavity_is_outside() {
        let (mut hollow, inner) = (block([0.0; 3], [3.0; 3]), block([1.0; 3], [2.0; 3]));
        let offset = hollow.vertices.len() as u32;
        hollow.vertices.extend(inner.vertices);
        hollow
            .triangles
            .extend(inner.triangles.iter().map(|t| t.map(|v| v + offset)));
        let solid = Solid::new(&hollow).unwrap();
        assert!(
            solid.contains(&Point3::new(0.5, 1.5, 1.5), &mut 0)
                && !solid.contains(&Point3::new(1.5, 1.4, 1.6), &mut 0)
        );
    }

    proptest! {
        #[test]
        fn a_mesh_of_a_box_is_the_box(
            point in proptest::array::uniform3(-2.0..3.0f64),
            low in proptest::array::uniform3(-1.0..0.0f64),
            high in proptest::array::uniform3(0.5..2.0f64),
        ) {
            let inside = (0..3).all(|axis| low[axis] < point[axis] && point[axis] < high[axis]);
            prop_assert_eq!(Solid::new(&block(low, high)).unwrap().contains(&point.into(), &mut 0), inside);
        }
    }
}
