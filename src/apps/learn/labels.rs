//! Labels without ground truth (method 7.3): success of the backend, judged by other depth maps of the same place.
//!
//! A measured pixel is *positive* if enough other depth maps from clearly other viewpoints put the surface at the same place, *negative* if
//! more of them see through it; a pixel without depth is negative if a visible triangle of the surface could have been measured there.
//! A place is judged only if enough other maps cover it, so that being judged doesn't depend on the outcome, and only if enough of the cluster's
//! partners see it (method 3.1): without them failure says nothing about the picture, and the plan predicts it without a model.

use nalgebra::{Matrix3, Point2, Point3, Vector3};

use crate::{
    io::depthmaps::DepthMap,
    method::{
        fulfilment::{Model, information},
        visibility::{NOTHING, front},
    },
    model::{cluster::ViewCluster, scene::ViewIndex},
};

/// Minimum number of other depth maps that must agree.
const LEAST_AGREEING: u32 = 2;
/// Cosine of the angle between two viewpoints, 5 degrees, from which their depth maps count as independent.
const COS_APART: f64 = 0.996_194_7;
/// Depths agree within the first number of standard deviations and contradict beyond the second.
const AGREES: f64 = 2.0;
const CONTRADICTS: f64 = 4.0;
/// In units of a_d. Smaller errors than the first never count against a depth; maps that differ by more than the second never agree, because shared
/// errors add to it (`benches/labels.rs`); an error above the third is wrong by method 8.
const LEAST_ERROR: f64 = 1.0;
const MOST_AGREEING: f64 = 2.5;
const MOST_ERROR: f64 = 3.0;
/// Largest number of other depth maps consulted.
const MOST_OTHERS: usize = 12;
/// Largest number of judged pixels per map.
const MOST_PIXELS: u32 = 40_000;

/// A finished view cluster with its depth map.
pub struct LabelledMap {
    pub cluster: ViewCluster,
    pub map: DepthMap,
}

/// A judged pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Label {
    /// Row of the key view and the pixel's triangle in the visibility table.
    pub row: usize,
    /// Position in the image, as shares of width and height.
    pub x: f32,
    pub y: f32,
    pub success: bool,
    /// True if the pixel has a depth.
    pub measured: bool,
}

/// Inputs of the labels of one key view.
pub struct Labelling<'a> {
    pub model: Model<'a>,
    /// Finished clusters by view; `None` without a depth map.
    pub finished: &'a [Option<LabelledMap>],
    /// Returns the other views that see the same places as a view, best first.
    pub others: &'a (dyn Fn(ViewIndex) -> Vec<ViewIndex> + Sync),
}

/// Another view with the covariance of its measurements per triangle.
struct Other<'a> {
    view: ViewIndex,
    centre: Point3<f64>,
    finished: &'a LabelledMap,
}

impl<'a> Labelling<'a> {
    /// Returns the judged pixels of a key view, row by row.
    pub fn labels(&self, key: ViewIndex) -> Vec<Label> {
        let Some(finished) = &self.finished[key.index()] else { return Vec::new() };
        let map = &finished.map;
        let triangles = front(self.model.scene, self.model.surface, key, map.width, map.height);
        let others = self.others_of(key, finished);
        let step = steps(map.width, map.height);
        let mut covariances = Covariances::default();
        let mut labels = Vec::new();
        for row in (step / 2..map.height).step_by(step as usize) {
            for column in (step / 2..map.width).step_by(step as usize) {
                let triangle = triangles[(row * map.width + column) as usize];
                if triangle == NOTHING {
                    continue;
                }
                let Some(table_row) = self.model.visibility.row(key, triangle) else { continue };
                if !self.is_covered(&finished.cluster, triangle) {
                    continue;
                }
                let pixel = Pixel { key, map, column, row, triangle };
                let Some(success) = self.judge(&pixel, finished, &others, &mut covariances) else { continue };
                labels.push(Label {
                    row: table_row,
                    x: (column as f32 + 0.5) / map.width as f32,
                    y: (row as f32 + 0.5) / map.height as f32,
                    success,
                    measured: map.depth_at(column, row).is_some(),
                });
            }
        }
        labels
    }

    /// Returns whether enough partners see the triangle (f_cov of method 3.1).
    fn is_covered(&self, cluster: &ViewCluster, triangle: u32) -> bool {
        let seeing = cluster.partners.iter().filter(|&&p| self.model.visibility.row(p, triangle).is_some());
        1 + seeing.count() >= self.model.rule.min_cameras as usize
    }

    /// Returns the depth maps that share no pair with this one.
    fn others_of(&self, key: ViewIndex, own: &LabelledMap) -> Vec<Other<'a>> {
        let shares_pair = |other: &LabelledMap| {
            own.cluster.partners.contains(&other.cluster.key) && other.cluster.partners.contains(&key)
        };
        let of = |view: ViewIndex| {
            let finished = self.finished[view.index()].as_ref().filter(|f| view != key && !shares_pair(f))?;
            Some(Other { view, centre: self.model.scene.view(view).cam_from_world.centre(), finished })
        };
        (self.others)(key).into_iter().filter_map(of).take(MOST_OTHERS).collect()
    }

    /// Returns success or failure; `None` if undecided.
    fn judge(&self, pixel: &Pixel, own: &LabelledMap, others: &[Other], covariances: &mut Covariances) -> Option<bool> {
        let scene = self.model.scene;
        let pose = &scene.view(pixel.key).cam_from_world;
        let camera = scene.camera_of(pixel.key);
        let position = pixel.map.image_position(camera, pixel.column, pixel.row);
        let ray = camera.ray(&position)?;
        let centre = pose.centre();
        let towards = pose.rotation.inverse() * ray.into_inner();
        let on_surface = self.on_triangle(&centre, &towards, pixel.triangle)?;
        let depth = pixel.map.depth_at(pixel.column, pixel.row);
        let point = depth.map_or(on_surface, |z| centre + towards * (z / ray.z));
        let looking = |other: &&Other| {
            let seen = self.model.visibility.row(other.view, pixel.triangle).is_some();
            let apart = (centre - point).normalize().dot(&(other.centre - point).normalize()) < COS_APART;
            seen && apart
        };
        let looking: Vec<&Other> = others.iter().filter(looking).collect();
        if looking.len() < LEAST_AGREEING as usize {
            return None;
        }
        if depth.is_none() {
            return Some(false);
        }
        let own_covariance = covariances.get(&self.model, &own.cluster, pixel.triangle);
        let accuracy = self.model.target.accuracy(pixel.triangle);
        let (mut agreeing, mut contradicting) = (0, 0);
        for other in looking {
            let covariance = own_covariance + covariances.get(&self.model, &other.finished.cluster, pixel.triangle);
            match self.held_against(other, &point, &covariance, accuracy) {
                Some(Verdict::Agrees) => agreeing += 1,
                Some(Verdict::SawThrough) => contradicting += 1,
                None => {}
            }
        }
        match (agreeing, contradicting) {
            (a, c) if a >= LEAST_AGREEING && a > 2 * c => Some(true),
            (a, c) if c >= LEAST_AGREEING && c > 2 * a => Some(false),
            _ => None,
        }
    }

    fn on_triangle(&self, centre: &Point3<f64>, towards: &Vector3<f64>, triangle: u32) -> Option<Point3<f64>> {
        let normal = self.model.surface.area_normal(triangle);
        let distance = normal.dot(&(self.model.surface.centroid(triangle) - centre)) / normal.dot(towards);
        distance.is_finite().then(|| centre + towards * distance)
    }

    /// Compares another depth map with a point.
    fn held_against(
        &self,
        other: &Other,
        point: &Point3<f64>,
        covariance: &Matrix3<f64>,
        accuracy: f64,
    ) -> Option<Verdict> {
        let scene = self.model.scene;
        let camera = scene.camera_of(other.view);
        let x_cam = scene.view(other.view).cam_from_world.camera_from_world(point);
        let position = camera.project(&x_cam)?;
        let map = &other.finished.map;
        let ray = (point - other.centre).normalize();
        let along = (point - other.centre).norm() / x_cam.z;
        let sigma = ray.dot(&(covariance * ray)).sqrt();
        let near = (AGREES * sigma).clamp(LEAST_ERROR * accuracy, MOST_AGREEING * accuracy);
        let far = (CONTRADICTS * sigma).max(MOST_ERROR * accuracy);
        let measured = map.interpolated(camera, &position, SAME_SURFACE)?;
        let behind = (measured - x_cam.z) * along;
        if behind.abs() <= near {
            return Some(Verdict::Agrees);
        }
        // At an occluding edge, a depth map may be off by a pixel.
        let all_behind = || around(map, camera, &position).all(|z| (z - x_cam.z) * along > far);
        (behind > far && all_behind()).then_some(Verdict::SawThrough)
    }
}

/// Relative difference of depths beyond which they belong to two surfaces.
const SAME_SURFACE: f64 = 0.02;

enum Verdict {
    Agrees,
    SawThrough,
}

struct Pixel<'a> {
    key: ViewIndex,
    map: &'a DepthMap,
    column: u32,
    row: u32,
    triangle: u32,
}

/// Returns the step, in rows and columns, between judged pixels.
fn steps(width: u32, height: u32) -> u32 {
    (1..).find(|step| (width / step) * (height / step) <= MOST_PIXELS).unwrap_or(1)
}

/// Returns the depths of the pixels around a position.
fn around<'a>(
    map: &'a DepthMap,
    camera: &crate::model::camera::Camera,
    position: &Point2<f64>,
) -> impl Iterator<Item = f64> + 'a {
    let (column, row) = map.pixel_at(camera, position).unwrap_or((0, 0));
    let columns = column.saturating_sub(1)..(column + 2).min(map.width);
    let rows = row.saturating_sub(1)..(row + 2).min(map.height);
    rows.flat_map(move |r| columns.clone().map(move |c| (c, r))).filter_map(|(c, r)| map.depth_at(c, r))
}

/// Covariances of a cluster's measurements (method 3.3), computed on demand.
#[derive(Default)]
struct Covariances(std::collections::HashMap<(ViewIndex, u32), Matrix3<f64>>);

impl Covariances {
    /// Covariance, square scene units.
    fn get(&mut self, model: &Model, cluster: &ViewCluster, triangle: u32) -> Matrix3<f64> {
        let make = || {
            let seeing = cluster.partners.iter().filter(|&&p| model.visibility.row(p, triangle).is_some());
            let views = seeing.copied().chain([cluster.key]);
            let sum = views.map(|view| information(model, view, triangle)).sum::<Matrix3<f64>>();
            // Without a second view the depth could be anything; the caller's bounds hold.
            sum.try_inverse().unwrap_or_else(Matrix3::zeros)
        };
        *self.0.entry((cluster.key, triangle)).or_insert_with(make)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        base::progress::NoWatcher,
        config::{TargetSettings, VisibilitySettings},
        io::depthmaps::DepthMapFormat,
        method::{
            confidence::{Confidence, NO_AGREEMENT, Unary},
            fulfilment::FulfilmentRule,
            synthetic::Town,
            target::Target,
            visibility,
        },
        model::camera::{Camera, CameraModel},
    };

    const WIDTH: u32 = 200;
    const HEIGHT: u32 = 150;

    /// Returns whether the pixel is in a faulty block of the synthetic map, which moves from view to view. `shift` selects the block
    /// that is too near or the one without depth.
    fn block(view: ViewIndex, column: u32, row: u32, shift: u32) -> bool {
        let (left, top) = (13 * (view.0 + shift) % (WIDTH - 40), 29 * (view.0 + shift) % (HEIGHT - 30));
        (left..left + 40).contains(&column) && (top..top + 30).contains(&row)
    }

    fn map(model: &Model, view: ViewIndex) -> DepthMap {
        let (camera, pose) = (model.scene.camera_of(view), &model.scene.view(view).cam_from_world);
        let triangles = front(model.scene, model.surface, view, WIDTH, HEIGHT);
        let mut map = DepthMap {
            format: DepthMapFormat::Npy,
            width: WIDTH,
            height: HEIGHT,
            depth: vec![0.0; triangles.len()],
            ids: Vec::new(),
        };
        for (at, &triangle) in triangles.iter().enumerate().filter(|(_, t)| **t != NOTHING) {
            let (column, row) = (at as u32 % WIDTH, at as u32 / WIDTH);
            let ray = camera.ray(&map.image_position(camera, column, row)).unwrap();
            let normal = pose.rotation * model.surface.area_normal(triangle);
            let corner = pose.camera_from_world(&model.surface.corners(triangle)[0]);
            let depth = normal.dot(&corner.coords) / normal.dot(&ray) * ray.z;
            let wrong = if block(view, column, row, 0) { 0.8 } else { 1.0 };
            map.depth[at] = if block(view, column, row, 7) { 0.0 } else { (wrong * depth) as f32 };
        }
        map
    }

    #[test]
    fn labels_say_what_the_exact_depth_says() {
        let camera = Camera::new(1, CameraModel::Pinhole, 1000, 750, vec![850.0, 850.0, 500.0, 375.0]).unwrap();
        let town = Town { edge: 4.0, points: 50, ..Town::new(camera) };
        let (scene, surface, unary) = (town.scene(), town.surface(), Unary::certain());
        let settings = VisibilitySettings::default();
        let visibility = visibility::estimate(
            &scene,
            &scene.view_points(),
            &surface,
            &settings,
            4.0,
            crate::base::column::Storage::Memory,
            &NoWatcher,
        )
        .unwrap();
        let target = Target::new(&scene, &surface, &visibility, &TargetSettings::default(), 0.3, 0.2);
        let rule = FulfilmentRule {
            alpha: 0.5,
            sigma_px: 0.5,
            min_cameras: 2,
            image_scale: 0.2,
            confidence: Confidence::None,
        };
        let (scene, surface, visibility) = (&scene, &surface, &visibility);
        let model =
            Model { scene, surface, visibility, target: &target, unary: &unary, agreement: &NO_AGREEMENT, rule };
        let views = scene.views.len() as u32;
        let next = |view: ViewIndex, by: u32| ViewIndex((view.0 + by) % views);
        let cluster = |key| ViewCluster { key, partners: vec![next(key, 1), next(key, 2)] };
        let finished = |view| Some(LabelledMap { cluster: cluster(view), map: map(&model, view) });
        let finished: Vec<Option<LabelledMap>> = scene.view_indices().map(finished).collect();
        let others = |key: ViewIndex| {
            let mut others: Vec<ViewIndex> = scene.view_indices().filter(|v| *v != key).collect();
            let centre = |v: ViewIndex| scene.view(v).cam_from_world.centre();
            others.sort_by(|a, b| (centre(*a) - centre(key)).norm().total_cmp(&(centre(*b) - centre(key)).norm()));
            others
        };
        let labelling = Labelling { model, finished: &finished, others: &others };
        // For each label: the number of pixels, and of those whose label is correct.
        let mut counts = [[0u32; 2]; 2];
        for key in scene.view_indices() {
            for label in labelling.labels(key) {
                let triangle = visibility.triangles[label.row];
                assert!(cluster(key).partners.iter().any(|&p| visibility.row(p, triangle).is_some()));
                let (column, row) = ((label.x * WIDTH as f32) as u32, (label.y * HEIGHT as f32) as u32);
                let right = !block(key, column, row, 0) && !block(key, column, row, 7);
                let count = &mut counts[usize::from(label.success)];
                *count = [count[0] + 1, count[1] + u32::from(right == label.success)];
            }
        }
        let [negative, positive] = counts;
        assert!(positive[0] > 100_000 && positive[1] as f64 > 0.97 * f64::from(positive[0]), "{positive:?}");
        assert!(negative[0] > 20_000 && negative[1] as f64 > 0.9 * f64::from(negative[0]), "{negative:?}");
    }
}
