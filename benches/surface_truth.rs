//! How near is the surface from sparse points to an exact scene, and how right is what it says about visibility?
//!
//!     cargo bench --bench surface_truth -- [SETTINGS.toml] FOLDER...
//!
//! Settings hold for the folders after them. Each folder holds a COLMAP model and `truth/scene.ply`, as `../shared/data/valley` and the output of `render_valley.py` do. Printed:
//! - near: share of the surface's area within 3 g_d of the exact scene, and the median distance in g_d;
//! - covered: share of what the views see of the exact scene that lies within 3 g_d of the surface;
//! - precision and recall of (triangle, view) pairs, where a pair is right when the line of sight from the camera to the triangle's
//!   centroid is free in the exact scene, up to the tolerance of method 2.

use std::{path::Path, time::Instant};

use nalgebra::{Point3, Vector3};
use viewrank::{
    config::Settings,
    progress::Unwatched,
    project::Project,
    scene::{Scene, ViewIndex},
    surface::{self, Surface, ply},
    visibility,
};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut settings = Settings::default();
    for argument in std::env::args().skip(1).filter(|a| a != "--bench") {
        if argument.ends_with(".toml") {
            settings = toml::from_str(&std::fs::read_to_string(&argument)?)?;
            println!("{argument}");
        } else {
            evaluate(Path::new(&argument), &settings)?;
        }
    }
    Ok(())
}

fn evaluate(folder: &Path, settings: &Settings) -> Result<(), Box<dyn std::error::Error>> {
    let scene = Project::open(folder, None)?.read_scene()?;
    let truth = Bvh::new(ply::read(&std::fs::read(folder.join("truth/scene.ply"))?)?);
    let gsd = 1.25 * scene.median_gsd().ok_or("the model has no points")?;
    let start = Instant::now();
    let (surface, stats) = surface::build(&scene, gsd, &settings.surface, None, &Unwatched)?;
    let seconds = start.elapsed().as_secs_f64();
    let edge = settings.surface.edge_factor * gsd;
    let table = own(&scene, &surface, settings, edge);
    let keep = table.seen(surface.triangles.len());
    let (surface, table) = (surface.keep(&keep), table.keep(&keep));
    let distances = sorted(samples(&surface, 0.25 * edge).iter().map(|p| truth.distance(p) / gsd).collect());
    let mine = Bvh::new(surface.clone());
    let seen = sorted(visible_truth(&scene, &truth).iter().map(|p| mine.distance(p) / gsd).collect());
    let (precision, recall) = pairs(&scene, &surface, &table, &truth, settings, edge);
    println!(
        "{}: {stats:?}\n  {} triangles in {seconds:.2} s; near {:.3} (median {:.2} g_d), covered {:.3} (median {:.2} g_d), \
         pairs: precision {precision:.3}, recall {recall:.3}",
        folder.display(),
        surface.triangles.len(),
        share_below(&distances, 3.0),
        distances[distances.len() / 2],
        share_below(&seen, 3.0),
        seen[seen.len() / 2],
    );
    Ok(())
}

fn sorted(mut values: Vec<f64>) -> Vec<f64> {
    values.sort_by(f64::total_cmp);
    values
}

fn share_below(sorted: &[f64], limit: f64) -> f64 {
    sorted.partition_point(|&d| d <= limit) as f64 / sorted.len() as f64
}

/// Points spread evenly over the surface, about one per `spacing`².
fn samples(surface: &Surface, spacing: f64) -> Vec<Point3<f64>> {
    let mut points = Vec::new();
    let mut due = 0.0;
    for t in 0..surface.triangles.len() as u32 {
        let [a, b, c] = surface.corners(t);
        due += surface.area(t) / (spacing * spacing);
        for i in 0..due as u32 {
            // The R2 sequence, folded into the triangle.
            let (mut u, mut v) = ((0.754877666 * f64::from(i + t)).fract(), (0.569840291 * f64::from(i + t)).fract());
            if u + v > 1.0 {
                (u, v) = (1.0 - u, 1.0 - v);
            }
            points.push(a + (b - a) * u + (c - a) * v);
        }
        due -= due.floor();
    }
    points
}

/// Where the rays of a grid of pixels, every 25th along both axes, first meet the exact scene.
fn visible_truth(scene: &Scene, truth: &Bvh) -> Vec<Point3<f64>> {
    let mut points = Vec::new();
    for view in scene.view_indices() {
        let (camera, pose) = (scene.camera_of(view), &scene.view(view).cam_from_world);
        for y in (12..camera.height).step_by(25) {
            for x in (12..camera.width).step_by(25) {
                let Some(ray) = camera.ray(&nalgebra::Point2::new(f64::from(x), f64::from(y))) else { continue };
                let direction = pose.rotation.inverse() * ray.into_inner();
                points.extend(truth.first_hit(&pose.centre(), &direction).map(|t| pose.centre() + direction * t));
            }
        }
    }
    points
}

/// Precision and recall of the table against lines of sight in the exact scene, over the pairs that satisfy the conditions of method 2
/// other than occlusion.
fn pairs(
    scene: &Scene,
    surface: &Surface,
    table: &visibility::Visibility,
    truth: &Bvh,
    settings: &Settings,
    edge: f64,
) -> (f64, f64) {
    let (mut said, mut right, mut free) = (0u64, 0u64, 0u64);
    for view in scene.view_indices() {
        let mut seen = vec![false; surface.triangles.len()];
        table.of(view).iter().for_each(|&t| seen[t as usize] = true);
        for t in 0..surface.triangles.len() as u32 {
            let is_free = is_in_view(scene, surface, view, t, settings)
                && is_free(scene, surface, view, t, truth, settings, edge);
            said += u64::from(seen[t as usize]);
            free += u64::from(is_free);
            right += u64::from(seen[t as usize] && is_free);
        }
    }
    (right as f64 / said as f64, right as f64 / free as f64)
}

fn own(scene: &Scene, surface: &Surface, settings: &Settings, edge: f64) -> visibility::Visibility {
    let mine = Bvh::new(surface.clone());
    let mut table = visibility::Visibility { offsets: vec![0], ..Default::default() };
    for view in scene.view_indices() {
        for t in 0..surface.triangles.len() as u32 {
            if is_in_view(scene, surface, view, t, settings) && is_free(scene, surface, view, t, &mine, settings, edge)
            {
                table.triangles.push(t);
            }
        }
        table.offsets.push(table.triangles.len());
    }
    table
}

fn is_in_view(scene: &Scene, surface: &Surface, view: ViewIndex, triangle: u32, settings: &Settings) -> bool {
    let (camera, pose) = (scene.camera_of(view), &scene.view(view).cam_from_world);
    let projects = |p: &Point3<f64>| camera.project(&pose.camera_from_world(p));
    let corners = surface.corners(triangle);
    let centroid = surface.centroid(triangle);
    let towards = pose.centre() - centroid;
    let facing = surface.area_normal(triangle).normalize().dot(&towards.normalize());
    corners.iter().all(|p| projects(p).is_some())
        && projects(&centroid).is_some_and(|pixel| camera.contains(&pixel))
        && facing > settings.visibility.max_incidence_deg.to_radians().cos()
}

fn is_free(
    scene: &Scene,
    surface: &Surface,
    view: ViewIndex,
    triangle: u32,
    truth: &Bvh,
    settings: &Settings,
    edge: f64,
) -> bool {
    let pose = &scene.view(view).cam_from_world;
    let line = surface.centroid(triangle) - pose.centre();
    let depth = pose.camera_from_world(&surface.centroid(triangle)).z;
    let tolerance = (settings.visibility.tolerance_edges * edge).max(settings.visibility.tolerance_depth * depth);
    // The tolerance is along the optical axis.
    truth.first_hit(&pose.centre(), &line).is_none_or(|t| (1.0 - t) * depth <= tolerance)
}

/// A hierarchy of boxes about the triangles of a mesh.
struct Bvh {
    mesh: Surface,
    /// Triangles in the order of the leaves.
    order: Vec<u32>,
    boxes: Vec<Node>,
}

struct Node {
    low: Vector3<f64>,
    high: Vector3<f64>,
    range: std::ops::Range<usize>,
    /// The second child; the first comes right after its parent. 0: a leaf.
    second: usize,
}

impl Bvh {
    fn new(mesh: Surface) -> Self {
        let order: Vec<u32> = (0..mesh.triangles.len() as u32).collect();
        let mut bvh = Self { mesh, order, boxes: Vec::new() };
        bvh.split(0..bvh.order.len());
        bvh
    }

    fn split(&mut self, range: std::ops::Range<usize>) {
        let mut low = Vector3::repeat(f64::INFINITY);
        let mut high = -low;
        for &t in &self.order[range.clone()] {
            for corner in self.mesh.corners(t) {
                low = low.inf(&corner.coords);
                high = high.sup(&corner.coords);
            }
        }
        let index = self.boxes.len();
        self.boxes.push(Node { low, high, range: range.clone(), second: 0 });
        if range.len() > 4 {
            let axis = (high - low).imax();
            let middle = range.len() / 2;
            let mesh = &self.mesh;
            let key = |t: &u32| mesh.centroid(*t)[axis];
            self.order[range.clone()].select_nth_unstable_by(middle, |a, b| key(a).total_cmp(&key(b)));
            self.split(range.start..range.start + middle);
            self.boxes[index].second = self.boxes.len();
            self.split(range.start + middle..range.end);
        }
    }

    /// Visits the leaves' triangles whose boxes are not ruled out.
    fn visit(&self, mut may_hold: impl FnMut(&Node) -> bool, mut visit: impl FnMut(u32)) {
        let mut open = vec![0];
        while let Some(i) = open.pop() {
            let node = &self.boxes[i];
            if !may_hold(node) {
                continue;
            }
            if node.second == 0 {
                self.order[node.range.clone()].iter().for_each(|&t| visit(t));
            } else {
                open.extend([node.second, i + 1]);
            }
        }
    }

    fn distance(&self, point: &Point3<f64>) -> f64 {
        let best = std::cell::Cell::new(f64::INFINITY);
        let box_distance =
            |n: &Node| (n.low - point.coords).sup(&(point.coords - n.high)).sup(&Vector3::zeros()).norm();
        self.visit(
            |n| box_distance(n) < best.get(),
            |t| best.set(best.get().min(triangle_distance(point, self.mesh.corners(t)))),
        );
        best.get()
    }

    /// The smallest t > 0 for which `from + t direction` lies on a triangle.
    fn first_hit(&self, from: &Point3<f64>, direction: &Vector3<f64>) -> Option<f64> {
        let best = std::cell::Cell::new(f64::INFINITY);
        let meets = |n: &Node| {
            let (a, b) =
                ((n.low - from.coords).component_div(direction), (n.high - from.coords).component_div(direction));
            a.inf(&b).max().max(0.0) <= a.sup(&b).min().min(best.get())
        };
        self.visit(meets, |t| {
            if let Some(hit) = ray_triangle(from, direction, self.mesh.corners(t)) {
                best.set(best.get().min(hit));
            }
        });
        best.get().is_finite().then(|| best.get())
    }
}

fn ray_triangle(from: &Point3<f64>, direction: &Vector3<f64>, [a, b, c]: [Point3<f64>; 3]) -> Option<f64> {
    let (u, v) = (b - a, c - a);
    let p = direction.cross(&v);
    let determinant = u.dot(&p);
    let s = from - a;
    let (x, q) = (s.dot(&p) / determinant, s.cross(&u));
    let (y, t) = (direction.dot(&q) / determinant, v.dot(&q) / determinant);
    (x >= 0.0 && y >= 0.0 && x + y <= 1.0 && t > 0.0).then_some(t)
}

/// Ericson, "Real-Time Collision Detection", 5.1.5, by way of the plane and the three sides.
fn triangle_distance(p: &Point3<f64>, [a, b, c]: [Point3<f64>; 3]) -> f64 {
    let normal = (b - a).cross(&(c - a));
    let is_left = |x: &Point3<f64>, y: &Point3<f64>| normal.cross(&(y - x)).dot(&(p - x)) >= 0.0;
    if normal.norm_squared() > 0.0 && is_left(&a, &b) && is_left(&b, &c) && is_left(&c, &a) {
        return normal.dot(&(p - a)).abs() / normal.norm();
    }
    let side = |x: &Point3<f64>, y: &Point3<f64>| {
        let along = y - x;
        let t = ((p - x).dot(&along) / along.norm_squared()).clamp(0.0, 1.0);
        (p - (x + along * t)).norm()
    };
    side(&a, &b).min(side(&b, &c)).min(side(&c, &a))
}
