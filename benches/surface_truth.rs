//! How near is the surface from sparse points to an exact scene, and how right is what it says
//! about visibility?
//!
//!     cargo bench --bench surface_truth -- [SETTINGS.toml...] FOLDER...
//!
//! Each folder holds a COLMAP model and `truth/scene.ply`, as the rendered sets of
//! `benches/sets.py` do; each is measured with each file of settings, or with the defaults.
//! Printed:
//! - near: share of the surface's area within 3 g_d of the exact scene, and the median distance in
//!   g_d;
//! - covered: share of what the views see of the exact scene that lies within 3 g_d of the surface,
//!   and the median distance;
//! - precision and recall of (triangle, view) pairs, where a pair is right when the line of sight
//!   from the camera to the triangle's centroid is free in the exact scene, up to the tolerance of
//!   method 2; strict: and meets the exact scene at the triangle.

use std::{path::Path, time::Instant};

use nalgebra::{Point2, Point3, Vector3};
use rayon::prelude::*;
use viewrank::Settings;
use viewrank_core::{
    base::{column::Storage, progress::NoWatcher},
    method::{
        surface::{self, WantedGsd, refine::MAX_TRIANGLES},
        target::GSD_MARGIN,
        visibility::{self, Visibility},
    },
    model::{
        scene::{Scene, ViewIndex},
        surface::{Surface, SurfaceKind},
    },
};
use viewrank_io::{ply, project::Project};

type Fallible<T> = Result<T, Box<dyn std::error::Error>>;

fn main() -> Fallible<()> {
    let arguments: Vec<String> = std::env::args()
        .skip(1)
        .filter(|a| a != "--bench")
        .collect();
    let (files, folders): (Vec<_>, Vec<_>) = arguments.iter().partition(|a| a.ends_with(".toml"));
    let read = |file: &&String| -> Fallible<_> {
        Ok((
            file.to_string(),
            toml::from_str(&std::fs::read_to_string(file)?)?,
        ))
    };
    let mut settings: Vec<(String, Settings)> = files.iter().map(read).collect::<Fallible<_>>()?;
    if settings.is_empty() {
        settings.push(("defaults".into(), Settings::default()));
    }
    for folder in folders {
        let exact = Exact::read(Path::new(folder))?;
        for (name, settings) in &settings {
            println!("{folder}, {name}");
            evaluate(&exact, settings)?;
        }
    }
    Ok(())
}

/// A scene and the mesh that it was rendered from.
struct Exact {
    scene: Scene,
    mesh: Bvh,
    /// Points of the mesh that the views see.
    visible: Vec<Point3<f64>>,
}

fn exact_surface(folder: &Path) -> Fallible<Surface> {
    let mesh = ply::read(&std::fs::read(folder.join("truth/scene.ply"))?)?;
    Ok(Surface {
        kind: SurfaceKind::Mesh,
        vertices: mesh.vertices,
        triangles: mesh.triangles,
    })
}

impl Exact {
    fn read(folder: &Path) -> Fallible<Self> {
        let scene = Project::open(folder, None)?.read_scene()?;
        let mesh = Bvh::new(exact_surface(folder)?);
        let visible = visible_points(&scene, &mesh);
        Ok(Self {
            scene,
            mesh,
            visible,
        })
    }
}

fn evaluate(exact: &Exact, settings: &Settings) -> Fallible<()> {
    let scene = &exact.scene;
    let gsd = GSD_MARGIN * scene.median_gsd().ok_or("the model has no points")?;
    let start = Instant::now();
    let wanted = WantedGsd::finest(scene, gsd, GSD_MARGIN);
    let (surface, stats) = surface::build(
        scene,
        &wanted,
        &settings.surface,
        None,
        MAX_TRIANGLES,
        &NoWatcher,
    )?;
    let seconds = start.elapsed().as_secs_f64();
    let edge = settings.surface.edge_factor * gsd;
    let table = visibility::estimate(
        scene,
        &scene.view_points(),
        &surface,
        &settings.visibility,
        edge,
        Storage::Memory,
        &NoWatcher,
    )?;
    let keep = table.seen_triangles(surface.triangles.len());
    let (surface, table) = (surface.keep(&keep), table.keep(&keep)?);
    let near = distances(&samples(&surface, 0.5 * edge), &exact.mesh, gsd);
    let covered = distances(&exact.visible, &Bvh::new(surface.clone()), gsd);
    println!("  {stats:?}");
    println!("  {} triangles in {seconds:.2} s", surface.triangles.len());
    for (name, distances) in [("near", near), ("covered", covered)] {
        let below =
            |limit: f64| distances.partition_point(|&d| d <= limit) as f64 / distances.len() as f64;
        println!(
            "  {name} {:.3}, median {:.2} g_d",
            below(3.0),
            distances[distances.len() / 2]
        );
    }
    println!(
        "  pairs: {}",
        Pairs::count(exact, &surface, &table, settings, edge)
    );
    Ok(())
}

/// Distances of the points from the mesh in g_d, sorted.
fn distances(points: &[Point3<f64>], mesh: &Bvh, gsd: f64) -> Vec<f64> {
    let mut distances: Vec<f64> = points.par_iter().map(|p| mesh.distance(p) / gsd).collect();
    distances.sort_by(f64::total_cmp);
    distances
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
            let (mut u, mut v) = (
                (0.754877666 * f64::from(i + t)).fract(),
                (0.569840291 * f64::from(i + t)).fract(),
            );
            if u + v > 1.0 {
                (u, v) = (1.0 - u, 1.0 - v);
            }
            points.push(a + (b - a) * u + (c - a) * v);
        }
        due -= due.floor();
    }
    points
}

/// Where the rays of a grid of pixels, every 40th along both axes, first meet the exact scene.
fn visible_points(scene: &Scene, mesh: &Bvh) -> Vec<Point3<f64>> {
    let of_view = |view: u32| {
        let (camera, pose) = (
            scene.camera_of(ViewIndex(view)),
            &scene.view(ViewIndex(view)).cam_from_world,
        );
        let mut points = Vec::new();
        for y in (20..camera.height).step_by(40) {
            for x in (20..camera.width).step_by(40) {
                let Some(ray) = camera.ray(&Point2::new(f64::from(x), f64::from(y))) else {
                    continue;
                };
                let direction = pose.rotation.inverse() * ray.into_inner();
                points.extend(
                    mesh.first_hit(&pose.centre(), &direction)
                        .map(|t| pose.centre() + direction * t),
                );
            }
        }
        points
    };
    (0..scene.views.len() as u32)
        .into_par_iter()
        .flat_map_iter(of_view)
        .collect()
}

/// Counts of (triangle, view) pairs, of every fifth triangle, that satisfy the conditions of method
/// 2 other than occlusion.
#[derive(Default)]
struct Pairs {
    /// In the table.
    said: u64,
    /// With a free line of sight in the exact scene.
    free: u64,
    /// Both.
    right: u64,
    /// Both, and the line of sight ends at the triangle.
    exact: u64,
}

impl Pairs {
    fn count(
        exact: &Exact,
        surface: &Surface,
        table: &Visibility,
        settings: &Settings,
        edge: f64,
    ) -> Self {
        let of_view = |view: u32| {
            let view = ViewIndex(view);
            let mut pairs = Self::default();
            for t in (0..surface.triangles.len() as u32).step_by(5) {
                let said = table.triangles_seen_by(view).binary_search(&t).is_ok();
                pairs.said += u64::from(said);
                if !is_in_view(&exact.scene, surface, view, t, settings) {
                    continue;
                }
                let clearance = clearance(exact, surface, view, t, settings, edge);
                pairs.free += u64::from(clearance >= -1.0);
                pairs.right += u64::from(said && clearance >= -1.0);
                pairs.exact += u64::from(said && clearance.abs() <= 1.0);
            }
            pairs
        };
        let all: Vec<Self> = (0..exact.scene.views.len() as u32)
            .into_par_iter()
            .map(of_view)
            .collect();
        all.into_iter().fold(Self::default(), |a, b| Self {
            said: a.said + b.said,
            free: a.free + b.free,
            right: a.right + b.right,
            exact: a.exact + b.exact,
        })
    }
}

impl std::fmt::Display for Pairs {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        let share = |part: u64, whole: u64| part as f64 / whole as f64;
        let (precision, strict) = (share(self.right, self.said), share(self.exact, self.said));
        write!(
            f,
            "precision {precision:.3} (strict {strict:.3}), recall {:.3}",
            share(self.right, self.free)
        )
    }
}

fn is_in_view(
    scene: &Scene,
    surface: &Surface,
    view: ViewIndex,
    triangle: u32,
    settings: &Settings,
) -> bool {
    let (camera, pose) = (scene.camera_of(view), &scene.view(view).cam_from_world);
    let projects = |p: &Point3<f64>| camera.project(&pose.camera_from_world(p));
    let centroid = surface.centroid(triangle);
    let towards = pose.centre() - centroid;
    let facing = surface
        .area_normal(triangle)
        .normalize()
        .dot(&towards.normalize());
    surface
        .corners(triangle)
        .iter()
        .all(|p| projects(p).is_some())
        && projects(&centroid).is_some_and(|pixel| camera.contains(&pixel))
        && facing > settings.visibility.max_incidence_deg.to_radians().cos()
}

/// How far behind the triangle's centroid the line of sight first meets the exact scene, along the
/// optical axis in tolerances of method 2.
fn clearance(
    exact: &Exact,
    surface: &Surface,
    view: ViewIndex,
    triangle: u32,
    settings: &Settings,
    edge: f64,
) -> f64 {
    let pose = &exact.scene.view(view).cam_from_world;
    let line = surface.centroid(triangle) - pose.centre();
    let depth = pose.camera_from_world(&surface.centroid(triangle)).z;
    let tolerance = (settings.visibility.tolerance_edges * edge)
        .max(settings.visibility.tolerance_depth * depth);
    exact
        .mesh
        .first_hit(&pose.centre(), &line)
        .map_or(f64::INFINITY, |t| (t - 1.0) * depth / tolerance)
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
        let mut bvh = Self {
            mesh,
            order,
            boxes: Vec::new(),
        };
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
        self.boxes.push(Node {
            low,
            high,
            range: range.clone(),
            second: 0,
        });
        if range.len() > 4 {
            let axis = (high - low).imax();
            let middle = range.len() / 2;
            let mesh = &self.mesh;
            let key = |t: &u32| mesh.centroid(*t)[axis];
            self.order[range.clone()]
                .select_nth_unstable_by(middle, |a, b| key(a).total_cmp(&key(b)));
            self.split(range.start..range.start + middle);
            self.boxes[index].second = self.boxes.len();
            self.split(range.start + middle..range.end);
        }
    }

    /// The smallest value of any triangle; `bound` is no larger than that of any triangle in a box.
    fn smallest(&self, bound: impl Fn(&Node) -> f64, value: impl Fn(u32) -> f64) -> f64 {
        let mut best = f64::INFINITY;
        let mut open = vec![(bound(&self.boxes[0]), 0)];
        while let Some((least, i)) = open.pop() {
            if least >= best {
                continue;
            }
            let node = &self.boxes[i];
            if node.second == 0 {
                best = self.order[node.range.clone()]
                    .iter()
                    .map(|&t| value(t))
                    .fold(best, f64::min);
            } else {
                let [a, b] = [i + 1, node.second].map(|child| (bound(&self.boxes[child]), child));
                open.extend(if a.0 < b.0 { [b, a] } else { [a, b] });
            }
        }
        best
    }

    fn distance(&self, point: &Point3<f64>) -> f64 {
        let outside = |n: &Node| {
            (n.low - point.coords)
                .sup(&(point.coords - n.high))
                .sup(&Vector3::zeros())
                .norm()
        };
        self.smallest(outside, |t| triangle_distance(point, self.mesh.corners(t)))
    }

    /// The smallest t > 0 for which `from + t direction` lies on a triangle.
    fn first_hit(&self, from: &Point3<f64>, direction: &Vector3<f64>) -> Option<f64> {
        let inverse = direction.map(|d| 1.0 / d);
        let entry = |n: &Node| {
            let (a, b) = (
                (n.low - from.coords).component_mul(&inverse),
                (n.high - from.coords).component_mul(&inverse),
            );
            let (enters, leaves) = (a.inf(&b).max().max(0.0), a.sup(&b).min());
            if enters <= leaves {
                enters
            } else {
                f64::INFINITY
            }
        };
        let hit = |t| ray_triangle(from, direction, self.mesh.corners(t)).unwrap_or(f64::INFINITY);
        Some(self.smallest(entry, hit)).filter(|t| t.is_finite())
    }
}

fn ray_triangle(
    from: &Point3<f64>,
    direction: &Vector3<f64>,
    [a, b, c]: [Point3<f64>; 3],
) -> Option<f64> {
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
