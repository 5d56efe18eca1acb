//! Small scenes with known answers, for tests and benchmarks: a grid of cameras over rolling
//! terrain with boxes ("box town").
//!
//! Metres, z up. Everything is drawn from one seed. Sparse points are on the exact surface, and a
//! view observes a point only if the line of sight is free.

use nalgebra::{Matrix3, Point2, Point3, Rotation3, Vector3};
use rand_core::{Rng, SeedableRng};
use rand_pcg::Pcg64;

use crate::{
    base::{column::Storage, progress::NoWatcher},
    method::{
        confidence::{Confidence, NO_AGREEMENT, Unary},
        fulfilment::{CoverageSettings, FulfilmentRule, FulfilmentSettings, Model},
        geometry::Geometry,
        target::{Target, TargetSettings},
        visibility::{self, Shown, Visibility, VisibilitySettings},
    },
    model::{
        camera::{Camera, CameraModel},
        mesh::Mesh,
        scene::{CameraIndex, Pose, Scene, View, ViewIndex},
        surface::{Surface, SurfaceKind},
    },
};

/// Parameters of a scene.
#[derive(Clone, Debug)]
pub struct Town {
    /// Side of the square terrain, metres.
    pub side: f64,
    /// Edge of the triangles, metres.
    pub edge: f64,
    /// Height of the hills, metres.
    pub relief: f64,
    /// Boxes along each side of the square.
    pub boxes: u32,
    /// Edge and height of a box, metres.
    pub box_size: f64,
    /// Flying height, metres.
    pub altitude: f64,
    /// Views along each side of the square, looking down; as many again look aside.
    pub grid: u32,
    /// Tilt of the oblique views, degrees from the vertical; `None`: no oblique views.
    pub tilt: Option<f64>,
    pub camera: Camera,
    /// Number of sparse points drawn; some are observed by no view.
    pub points: u32,
    /// Probability that a view observes a point that it sees.
    pub found: f64,
    pub seed: u64,
}

/// A town, and what its views see.
#[derive(Clone)]
pub struct SeenTown {
    pub scene: Scene,
    pub surface: Surface,
    pub visibility: Visibility,
    pub target: Target,
}

impl SeenTown {
    pub fn geometry(&self, image_scale: f64) -> Geometry<'_> {
        let Self {
            scene,
            surface,
            visibility,
            target,
        } = self;
        Geometry {
            scene,
            surface,
            visibility,
            target,
            image_scale,
        }
    }

    /// Returns f by the default settings, without confidence (the paper's NoCP).
    pub fn model<'a>(&'a self, unary: &'a Unary) -> Model<'a> {
        let FulfilmentSettings { alpha, sigma_px } = FulfilmentSettings::default();
        let rule = FulfilmentRule {
            alpha,
            sigma_px,
            min_cameras: CoverageSettings::default().min_cameras,
            image_scale: 1.0,
            confidence: Confidence::None,
        };
        Model::new(self.geometry(1.0), unary, &NO_AGREEMENT, rule)
    }
}

/// That of most tests: its cameras are pinholes of 1,000 by 750 pixels, 61° wide.
impl Default for Town {
    fn default() -> Self {
        Self::new(
            Camera::new(
                1,
                CameraModel::Pinhole,
                1000,
                750,
                vec![850.0, 850.0, 500.0, 375.0],
            )
            .unwrap(),
        )
    }
}

impl Town {
    /// 80 m of terrain with nine boxes, seen by 25 nadir and 25 oblique views from 40 m.
    pub fn new(camera: Camera) -> Self {
        Self {
            side: 80.0,
            edge: 2.0,
            relief: 3.0,
            boxes: 3,
            box_size: 8.0,
            altitude: 40.0,
            grid: 5,
            tilt: Some(40.0),
            camera,
            points: 3000,
            found: 0.7,
            seed: 1,
        }
    }

    /// Returns terrain and boxes as oriented manifolds; the boxes are not connected to the ground.
    pub fn surface(&self) -> Surface {
        let mut surface = Surface {
            kind: SurfaceKind::Mesh,
            vertices: Vec::new(),
            triangles: Vec::new(),
        };
        let half = 0.5 * self.side;
        let steps = (self.side / self.edge).ceil() as u32;
        let ground = |u: f64, v: f64| {
            let (x, y) = (self.side * u - half, self.side * v - half);
            Point3::new(x, y, self.ground(x, y))
        };
        add_patch(&mut surface, steps, steps, ground);
        for (x, y) in self.box_centres() {
            self.add_box(&mut surface, x, y);
        }
        surface
    }

    /// Returns the views with the sparse points that they observe.
    pub fn scene(&self) -> Scene {
        let mut random = Pcg64::seed_from_u64(self.seed);
        let mut scene = Scene {
            cameras: vec![self.camera.clone()],
            track_offsets: vec![0],
            ..Default::default()
        };
        scene.views = self.views();
        for (i, view) in scene.views.iter_mut().enumerate() {
            (view.image_id, view.file_position) = (i as u32 + 1, i as u32);
        }
        while scene.points.len() < self.points as usize {
            self.add_point(&mut scene, &mut random);
        }
        scene
    }

    /// Adds a sparse point at a random place, with some of the views that see it.
    fn add_point(&self, scene: &mut Scene, random: &mut Pcg64) {
        let (x, y) = (
            self.side * (unit(random) - 0.5),
            self.side * (unit(random) - 0.5),
        );
        let point = Point3::new(x, y, self.height(x, y));
        for view in (0..scene.views.len() as u32).map(ViewIndex) {
            let found = unit(random) < self.found;
            if let Some(pixel) = self.observation(scene, view, &point).filter(|_| found) {
                scene.track_views.push(view);
                scene.track_pixels.push([pixel.x, pixel.y]);
            }
        }
        scene.points.push(point);
        scene.point_ids.push(scene.points.len() as u64);
        scene.colours.push([128; 3]);
        scene.track_offsets.push(scene.track_views.len());
    }

    /// Returns the scene with what its views see.
    pub fn seen(&self, wanted: &TargetSettings, gsd: f64, keep: Storage) -> SeenTown {
        let (scene, surface, settings) =
            (self.scene(), self.surface(), VisibilitySettings::default());
        let points = scene.view_points();
        let visibility = visibility::estimate(
            &scene, &points, &surface, &settings, self.edge, keep, &NoWatcher,
        )
        .unwrap();
        let target = Target::new(&Shown::new(&scene, &surface, &visibility), wanted, gsd, 1.0);
        SeenTown {
            scene,
            surface,
            visibility,
            target,
        }
    }

    /// Returns the height of the ground.
    fn ground(&self, x: f64, y: f64) -> f64 {
        0.5 * self.relief * ((0.11 * x + 0.4).sin() + (0.13 * y).cos() * (0.05 * x).sin())
    }

    /// Returns the height of the topmost surface.
    fn height(&self, x: f64, y: f64) -> f64 {
        let inside =
            |&(bx, by): &(f64, f64)| (x - bx).abs().max((y - by).abs()) <= 0.5 * self.box_size;
        match self.box_centres().find(inside) {
            Some((bx, by)) => self.ground(bx, by) + self.box_size,
            None => self.ground(x, y),
        }
    }

    fn box_centres(&self) -> impl Iterator<Item = (f64, f64)> {
        let n = self.boxes;
        let at = move |i: u32, side: f64| side * ((f64::from(i) + 0.5) / f64::from(n) - 0.5);
        let side = self.side;
        (0..n * n).map(move |i| (at(i % n, side), at(i / n, side)))
    }

    fn add_box(&self, surface: &mut Surface, x: f64, y: f64) {
        let (half, top) = (0.5 * self.box_size, self.ground(x, y) + self.box_size);
        let bottom = top - self.box_size - self.relief;
        let steps = (self.box_size / self.edge).ceil() as u32;
        let corner = |u: f64, v: f64, z: f64| {
            Point3::new(
                x + self.box_size * u - half,
                y + self.box_size * v - half,
                z,
            )
        };
        add_patch(surface, steps, steps, |u, v| corner(u, v, top));
        let height = |v: f64| bottom + (top - bottom) * v;
        add_patch(surface, steps, steps, |u, v| corner(u, 0.0, height(v)));
        add_patch(surface, steps, steps, |u, v| {
            corner(1.0 - u, 1.0, height(v))
        });
        add_patch(surface, steps, steps, |u, v| corner(1.0, u, height(v)));
        add_patch(surface, steps, steps, |u, v| {
            corner(0.0, 1.0 - u, height(v))
        });
    }

    fn views(&self) -> Vec<View> {
        let nadir = (0..self.grid * self.grid).map(|i| {
            let centre = self.on_grid(i, 0.0, self.altitude + f64::from(i % 3));
            view(format!("nadir_{i:04}.jpg"), centre, 0.0, 0.0)
        });
        let mut views: Vec<View> = nadir.collect();
        if let Some(tilt) = self.tilt {
            views.extend((0..self.grid * self.grid).map(|i| {
                // Between the nadir views: at the same position, the two would differ by a rotation
                // only.
                let half = 0.4 * self.side / f64::from(self.grid);
                let centre = self.on_grid(i, half, self.altitude - f64::from(i % 2));
                let heading = f64::from(i % 4) * std::f64::consts::FRAC_PI_2;
                let name = format!("oblique_{i:04}.jpg");
                view(name, centre, heading, tilt.to_radians())
            }));
        }
        views
    }

    /// Returns a place of the grid of views, shifted along both axes.
    fn on_grid(&self, i: u32, shift: f64, altitude: f64) -> Point3<f64> {
        let n = self.grid;
        let at = |i: u32| 0.8 * self.side * ((f64::from(i) + 0.5) / f64::from(n) - 0.5);
        Point3::new(at(i % n) + shift, at(i / n) + shift, altitude)
    }

    /// Returns the pixel of a point if the view sees it, by marching over the heights.
    fn observation(
        &self,
        scene: &Scene,
        view: ViewIndex,
        point: &Point3<f64>,
    ) -> Option<Point2<f64>> {
        let pose = &scene.view(view).cam_from_world;
        let camera = scene.camera_of(view);
        let pixel = camera
            .project(&pose.camera_from_world(point))
            .filter(|p| camera.contains(p))?;
        let ray = pose.centre() - point;
        let step = 0.2 / ray.norm();
        let blocked = |share: f64| {
            let p = point + ray * share;
            self.height(p.x, p.y) > p.z
        };
        let steps = (1.0 / step) as u32;
        (!(1..steps).any(|i| blocked(f64::from(i) * step))).then_some(pixel)
    }
}

/// Returns a view from `centre` that looks down, turned by `heading` about the vertical and tilted
/// up from it, radians.
fn view(name: String, centre: Point3<f64>, heading: f64, tilt: f64) -> View {
    let forward = Vector3::new(
        heading.sin() * tilt.sin(),
        heading.cos() * tilt.sin(),
        -tilt.cos(),
    );
    let up = Vector3::new(
        heading.sin() * tilt.cos(),
        heading.cos() * tilt.cos(),
        tilt.sin(),
    );
    let rows = [
        forward.cross(&up).transpose(),
        -up.transpose(),
        forward.transpose(),
    ];
    let rotation = Rotation3::from_matrix_unchecked(Matrix3::from_rows(&rows));
    let cam_from_world = Pose {
        rotation,
        translation: -(rotation * centre.coords),
    };
    View {
        name,
        image_id: 0,
        file_position: 0,
        camera: CameraIndex(0),
        cam_from_world,
    }
}

/// Adds a grid of triangles over `at(u, v)`, u and v from 0 to 1; counter-clockwise in (u, v).
fn add_patch(surface: &mut Surface, columns: u32, rows: u32, at: impl Fn(f64, f64) -> Point3<f64>) {
    let first = surface.vertices.len() as u32;
    let number = |column: u32, row: u32| first + row * (columns + 1) + column;
    for row in 0..=rows {
        for column in 0..=columns {
            surface.vertices.push(at(
                f64::from(column) / f64::from(columns),
                f64::from(row) / f64::from(rows),
            ));
        }
    }
    for row in 0..rows {
        for column in 0..columns {
            let [a, b] = [number(column, row), number(column + 1, row)];
            let [d, c] = [number(column, row + 1), number(column + 1, row + 1)];
            surface.triangles.extend([[a, b, c], [a, c, d]]);
        }
    }
}

/// Returns a number uniformly distributed in [0, 1).
fn unit(random: &mut Pcg64) -> f64 {
    (random.next_u64() >> 11) as f64 / (1u64 << 53) as f64
}

/// A box with outward normals.
pub fn block(low: [f64; 3], high: [f64; 3]) -> Mesh {
    let corner = |i: usize| {
        Point3::from([0, 1, 2].map(|axis| {
            if i >> axis & 1 == 0 {
                low[axis]
            } else {
                high[axis]
            }
        }))
    };
    let quads = [
        [0, 2, 3, 1],
        [4, 5, 7, 6],
        [0, 1, 5, 4],
        [2, 6, 7, 3],
        [0, 4, 6, 2],
        [1, 3, 7, 5],
    ];
    Mesh {
        vertices: (0..8).map(corner).collect(),
        triangles: quads
            .iter()
            .flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]])
            .collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn triangles_face_outwards() {
        let town = Town::default();
        let surface = town.surface();
        let ground = 2 * (town.side / town.edge).powi(2) as u32;
        assert!((0..ground).all(|t| surface.area_normal(t).z > 0.0));
        let centres: Vec<_> = town.box_centres().collect();
        for t in ground..surface.triangles.len() as u32 {
            let (normal, centroid) = (surface.area_normal(t).normalize(), surface.centroid(t));
            let near = |c: &&(f64, f64)| {
                (c.0 - centroid.x).abs().max((c.1 - centroid.y).abs()) < town.box_size
            };
            let (x, y) = *centres.iter().find(near).unwrap();
            let outwards = Vector3::new(centroid.x - x, centroid.y - y, 0.0);
            assert!(normal.z > 0.99 || normal.dot(&outwards) > 0.0);
        }
    }

    #[test]
    fn views_are_sorted_and_look_at_the_town() {
        let scene = Town::default().scene();
        assert!(scene.views.windows(2).all(|v| v[0].name < v[1].name));
        assert_eq!(scene.views.len(), 50);
        assert!(
            scene
                .view(ViewIndex(0))
                .cam_from_world
                .viewing_direction()
                .z
                < -0.999
        );
        let mean_track = scene.observations() as f64 / scene.points.len() as f64;
        assert!((3.0..30.0).contains(&mean_track), "{mean_track}");
        let per_view = scene.view_points();
        assert!(
            scene
                .view_indices()
                .take(25)
                .all(|v| per_view.observed_by(v).len() > 50)
        );
    }
}
