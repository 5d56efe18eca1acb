//! Method 1.7: a 2.5D surface for nadir flights and flat scenes: the Delaunay triangulation of robust heights over a plane.

use nalgebra::{Matrix3, Point3, Vector3};
use spade::{DelaunayTriangulation, HasPosition, Point2, Triangulation};

use super::{Surface, SurfaceKind};
use crate::scene::Scene;

/// Fewer nodes than this and the cells of the height grid are made smaller.
const ENOUGH_NODES: usize = 100;
/// Times that the cells may be halved.
const MAX_HALVINGS: u32 = 10;
/// Times 1.4826 median absolute deviations, a height may differ from its neighbours' median.
const MAX_DEVIATIONS: f64 = 3.0;
/// Ratio of the two smaller standard deviations of the points, below which their plane says what is up.
const FLAT_RATIO: f64 = 0.3;
/// Length of the mean of the viewing directions from which on all views look the same way.
const ONE_DIRECTION: f64 = 0.8;
/// Cosine of the angle to the longest axis of the points, beyond which views look along the scene and not upon it.
const ALONG: f64 = 0.7;
/// Cosine of the angle between the tops of the images and the third axis of the world, from which on they agree on what is up.
const UPRIGHT: f64 = 0.9;

/// A right-handed frame with the third axis up and the origin among the points.
pub struct Frame {
    origin: Point3<f64>,
    axes: [Vector3<f64>; 3],
}

impl Frame {
    /// Up is as given, or the normal of the points' plane on the side of the cameras where the points are flat; or else, where all views
    /// look upon the scene in one direction (a nadir flight of one heading has no image whose top is up), against that direction, and else
    /// the mean upward direction of the images; this first where it is the third axis of the world.
    pub fn new(points: &[Point3<f64>], scene: &Scene, up: Option<[f64; 3]>) -> Self {
        let (origin, spread) = plane_fit(points);
        let up =
            up.and_then(|u| Vector3::from(u).try_normalize(0.0)).unwrap_or_else(|| fitted_up(scene, origin, &spread));
        let first = up.cross(&Vector3::ith(up.iamin(), 1.0)).normalize();
        Self { origin, axes: [first, up.cross(&first), up] }
    }

    /// Unit vector, world coordinates.
    pub fn up(&self) -> Vector3<f64> {
        self.axes[2]
    }

    /// Among the points, world coordinates.
    pub fn origin(&self) -> Point3<f64> {
        self.origin
    }

    fn local(&self, point: &Point3<f64>) -> [f64; 3] {
        self.axes.map(|axis| axis.dot(&(point - self.origin)))
    }

    fn world(&self, local: [f64; 3]) -> Point3<f64> {
        self.origin + self.axes[0] * local[0] + self.axes[1] * local[1] + self.axes[2] * local[2]
    }
}

/// Principal directions of points about their mean, with the standard deviation along each; the smallest first.
type Spread = [(f64, Vector3<f64>); 3];

fn plane_fit(points: &[Point3<f64>]) -> (Point3<f64>, Spread) {
    let n = points.len().max(1) as f64;
    let anchor = points.first().map_or(Vector3::zeros(), |p| p.coords);
    let mean = anchor + points.iter().map(|p| p.coords - anchor).sum::<Vector3<f64>>() / n;
    let covariance: Matrix3<f64> = points.iter().map(|p| (p.coords - mean) * (p.coords - mean).transpose()).sum();
    let eigen = (covariance / n).symmetric_eigen();
    let mut spread: Spread =
        std::array::from_fn(|i| (eigen.eigenvalues[i].max(0.0).sqrt(), eigen.eigenvectors.column(i).into_owned()));
    spread.sort_by(|a, b| a.0.total_cmp(&b.0));
    (Point3::from(mean), spread)
}

/// Standard deviations of points along their three principal directions, the smallest first.
pub fn spread(points: &[Point3<f64>]) -> [f64; 3] {
    plane_fit(points).1.map(|(deviation, _)| deviation)
}

fn fitted_up(scene: &Scene, origin: Point3<f64>, spread: &Spread) -> Vector3<f64> {
    let [(thickness, normal), (width, _), (_, longest)] = *spread;
    let towards: Vector3<f64> = scene.views.iter().map(|v| v.cam_from_world.centre() - origin).sum();
    if thickness > FLAT_RATIO * width {
        let count = scene.views.len() as f64;
        // Axis of the images: 1 points down in them, 2 ahead.
        let mean_axis = |axis: usize| -> Vector3<f64> {
            scene.views.iter().map(|v| v.cam_from_world.rotation.matrix().row(axis).transpose()).sum()
        };
        let below_images = mean_axis(1).try_normalize(0.5 * count);
        let ahead = mean_axis(2).try_normalize(ONE_DIRECTION * count);
        let upon = ahead.filter(|ahead| ahead.dot(&longest).abs() < ALONG);
        // A front seen from one side, in a model whose third axis is up.
        let upright = below_images.filter(|down| -down.z > UPRIGHT);
        if let Some(down) = upright.or(upon).or(below_images) {
            return -down;
        }
    }
    if normal.dot(&towards) < 0.0 { -normal } else { normal }
}

/// Triangulates robust heights of the points, one for each square of half the edge length (scene units), with normals up. No
/// triangles where the points lie on a line seen from above.
pub fn triangulate(points: &[Point3<f64>], frame: &Frame, edge: f64) -> Surface {
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
    let triangles = mesh.inner_faces().map(|face| face.vertices().map(|v| v.data().node)).collect();
    let all =
        Surface { kind: SurfaceKind::Terrain, vertices: nodes.iter().map(|&n| frame.world(n)).collect(), triangles };
    all.keep(&vec![true; all.triangles.len()])
}

/// For each square of the grid that has points: their mean position and median height. Ordered by square.
fn median_heights(local: &[[f64; 3]], cell: f64) -> Vec<[f64; 3]> {
    let square = |p: &[f64; 3]| ((p[0] / cell).floor() as i64, (p[1] / cell).floor() as i64);
    let mut sorted: Vec<((i64, i64), [f64; 3])> = local.iter().map(|p| (square(p), *p)).collect();
    let by_height =
        |a: &[f64; 3], b: &[f64; 3]| a[2].total_cmp(&b[2]).then(a[0].total_cmp(&b[0])).then(a[1].total_cmp(&b[1]));
    sorted.sort_unstable_by(|a, b| a.0.cmp(&b.0).then_with(|| by_height(&a.1, &b.1)));
    let node = |group: &[((i64, i64), [f64; 3])]| {
        let n = group.len();
        let mean = |axis: usize| group.iter().map(|p| p.1[axis]).sum::<f64>() / n as f64;
        [mean(0), mean(1), (group[(n - 1) / 2].1[2] + group[n / 2].1[2]) / 2.0]
    };
    sorted.chunk_by(|a, b| a.0 == b.0).map(node).collect()
}

/// Drops nodes whose height is far from the median of their neighbours', measured by the spread of these and by the edge length.
fn drop_spikes(nodes: Vec<[f64; 3]>, edge: f64) -> Vec<[f64; 3]> {
    let mesh = delaunay(&nodes);
    let mut keep = vec![true; nodes.len()];
    for vertex in mesh.vertices() {
        let node = vertex.data().node as usize;
        let mut heights: Vec<f64> = vertex.out_edges().map(|e| nodes[e.to().data().node as usize][2]).collect();
        if heights.len() < 3 {
            continue;
        }
        let middle = median(&mut heights);
        heights.iter_mut().for_each(|h| *h = (*h - middle).abs());
        let limit = (MAX_DEVIATIONS * 1.4826 * median(&mut heights)).max(edge);
        keep[node] = (nodes[node][2] - middle).abs() <= limit;
    }
    nodes.into_iter().zip(keep).filter_map(|(n, k)| k.then_some(n)).collect()
}

fn median(values: &mut [f64]) -> f64 {
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
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

/// The plane triangulation of the nodes; empty where they lie on a line.
fn delaunay(nodes: &[[f64; 3]]) -> DelaunayTriangulation<Node> {
    let largest = nodes.iter().flat_map(|n| [n[0].abs(), n[1].abs()]).fold(f64::MIN_POSITIVE, f64::max);
    // spade takes coordinates from 2^-142 to 2^201, and zero.
    let scaled = |x: f64| if (x / largest).abs() < 1e-30 { 0.0 } else { x / largest };
    let node = |(i, n): (usize, &[f64; 3])| Node { position: Point2::new(scaled(n[0]), scaled(n[1])), node: i as u32 };
    DelaunayTriangulation::bulk_load(nodes.iter().enumerate().map(node).collect())
        .expect("coordinates are finite and scaled into spade's range")
}
