//! 2.5D surface for nadir flights and flat scenes (method 1.7): Delaunay triangulation of robust
//! heights over a plane.

use std::cmp::Ordering;

use nalgebra::Point3;
use spade::{DelaunayTriangulation, HasPosition, Point2, Triangulation};

use crate::{
    base::median::upper_median,
    model::{
        georeference::UprightFrame,
        surface::{Surface, SurfaceKind},
    },
};

/// Number of nodes below which the cells of the height grid are halved.
const ENOUGH_NODES: usize = 100;
/// Maximum number of halvings.
const MAX_HALVINGS: u32 = 10;
/// Limit on the difference of a height from the median of its neighbours, multiples of 1.4826
/// median absolute deviations.
const MAX_DEVIATIONS: f64 = 3.0;
/// Triangulates robust heights of the points, one per square of half the edge length (scene units),
/// normals up. No triangles if the points are collinear seen from above.
pub fn triangulate(points: &[Point3<f64>], frame: &UprightFrame, edge: f64) -> Surface {
    let local: Vec<[f64; 3]> = points.iter().map(|p| frame.local(p)).collect();
    let mut cell = edge / 2.0;
    let mut nodes = median_heights(&local, cell);
    for _ in 0..MAX_HALVINGS {
        if nodes.len() >= ENOUGH_NODES.min(points.len()) {
            break;
        }
        cell /= 2.0;
        nodes = median_heights(&local, cell);
    }
    let nodes = drop_spikes(nodes, edge);
    let mesh = delaunay(&nodes);
    let triangles = mesh
        .inner_faces()
        .map(|face| face.vertices().map(|v| v.data().node))
        .collect();
    let all = Surface {
        kind: SurfaceKind::Terrain,
        vertices: nodes.iter().map(|&n| frame.world(n)).collect(),
        triangles,
    };
    all.keep(&vec![true; all.triangles.len()])
}

/// Returns mean position and median height of the points in each occupied square of the grid,
/// ordered by square.
fn median_heights(local: &[[f64; 3]], cell: f64) -> Vec<[f64; 3]> {
    let square = |p: &[f64; 3]| [p[0], p[1]].map(|x| (x / cell).floor() as i64);
    let mut sorted: Vec<([i64; 2], [f64; 3])> = local.iter().map(|p| (square(p), *p)).collect();
    // By height for the median, ties by position: sums must not depend on the order of the points.
    sorted.sort_unstable_by(|a, b| a.0.cmp(&b.0).then_with(|| by_height(&a.1, &b.1)));
    let of_square = sorted.chunk_by(|a, b| a.0 == b.0);
    of_square.map(node).collect()
}

fn by_height(a: &[f64; 3], b: &[f64; 3]) -> Ordering {
    a[2].total_cmp(&b[2])
        .then(a[0].total_cmp(&b[0]))
        .then(a[1].total_cmp(&b[1]))
}

/// Returns mean position and median height of points that are sorted by height.
fn node(group: &[([i64; 2], [f64; 3])]) -> [f64; 3] {
    let n = group.len();
    let mean = |axis: usize| group.iter().map(|p| p.1[axis]).sum::<f64>() / n as f64;
    [
        mean(0),
        mean(1),
        (group[(n - 1) / 2].1[2] + group[n / 2].1[2]) / 2.0,
    ]
}

/// Drops nodes whose height is far from the median of their neighbours, relative to the spread of
/// these and the edge length.
fn drop_spikes(nodes: Vec<[f64; 3]>, edge: f64) -> Vec<[f64; 3]> {
    let mesh = delaunay(&nodes);
    let mut keep = vec![true; nodes.len()];
    for vertex in mesh.vertices() {
        let node = vertex.data().node as usize;
        let mut heights: Vec<f64> = vertex
            .out_edges()
            .map(|e| nodes[e.to().data().node as usize][2])
            .collect();
        if heights.len() < 3 {
            continue;
        }
        let middle = upper_median(heights.iter().copied()).unwrap_or(0.0);
        heights.iter_mut().for_each(|h| *h = (*h - middle).abs());
        let deviation = upper_median(heights).unwrap_or(0.0);
        let limit = (MAX_DEVIATIONS * 1.4826 * deviation).max(edge);
        keep[node] = (nodes[node][2] - middle).abs() <= limit;
    }
    nodes
        .into_iter()
        .zip(keep)
        .filter_map(|(n, k)| k.then_some(n))
        .collect()
}

struct Node {
    position: Point2<f64>,
    node: u32,
}

impl HasPosition for Node {
    type Scalar = f64;

    fn position(&self) -> Point2<f64> {
        self.position
    }
}

/// Returns the plane triangulation of the nodes; empty if they are collinear.
fn delaunay(nodes: &[[f64; 3]]) -> DelaunayTriangulation<Node> {
    let largest = nodes
        .iter()
        .flat_map(|n| [n[0].abs(), n[1].abs()])
        .fold(f64::MIN_POSITIVE, f64::max);
    // spade takes coordinates from 2^-142 to 2^201, and zero.
    let scaled = |x: f64| {
        if (x / largest).abs() < 1e-30 {
            0.0
        } else {
            x / largest
        }
    };
    let node = |(i, n): (usize, &[f64; 3])| Node {
        position: Point2::new(scaled(n[0]), scaled(n[1])),
        node: i as u32,
    };
    DelaunayTriangulation::bulk_load(nodes.iter().enumerate().map(node).collect())
        .expect("coordinates are finite and scaled into spade's range")
}
