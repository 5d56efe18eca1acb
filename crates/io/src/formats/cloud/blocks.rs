//! Blocks of neighbouring points, of which a view shows few: only the points of those are
//! projected.

use std::f64::consts::FRAC_PI_2;

use nalgebra::{Point2, Point3};
use viewrank_core::model::{
    camera::{Camera, CameraModel},
    scene::Pose,
};

/// Most points of a block.
const BLOCK: usize = 64;
/// Pixels at which rays are compared along each border of an image.
const BORDER: u32 = 16;
/// Added to the angle of an image, radians: borders may be curved between those pixels.
const MARGIN: f64 = 0.02;

/// A pose, its camera, and the cone around the viewing direction that has all of the image.
pub struct Cone<'a> {
    pub pose: Pose,
    pub camera: &'a Camera,
    mantle: Mantle,
}

/// Sine and cosine of the angle between axis and mantle of a cone; `None`: everywhere.
pub type Mantle = Option<(f64, f64)>;

/// The cone around the axis of a camera that has all of its image.
pub fn mantle(camera: &Camera) -> Mantle {
    let angle = largest_angle(camera).map(|angle| angle + MARGIN);
    // A wider cone would not be convex.
    let angle = angle.filter(|&angle| angle < FRAC_PI_2);
    angle.map(f64::sin_cos)
}

impl<'a> Cone<'a> {
    /// `mantle`: that of the camera.
    pub fn new(pose: Pose, camera: &'a Camera, mantle: Mantle) -> Self {
        Self {
            pose,
            camera,
            mantle,
        }
    }

    /// The pixel of a point in the image.
    pub fn pixel(&self, x: &Point3<f64>) -> Option<[f64; 2]> {
        let pixel = self.camera.project(&self.pose.camera_from_world(x))?;
        self.camera.contains(&pixel).then_some([pixel.x, pixel.y])
    }

    fn may_show(&self, sphere: &Sphere) -> bool {
        let Some((sine, cosine)) = self.mantle else {
            return true;
        };
        let Point3 { coords: centre } = self.pose.camera_from_world(&sphere.centre);
        // To the plane that touches the cone on this side.
        let distance = centre.xy().norm() * cosine - centre.z * sine;
        // What is not a number is looked at.
        distance.is_nan() || distance <= sphere.radius
    }
}

/// The largest angle between the axis and a ray of an image; `None` if not known.
fn largest_angle(camera: &Camera) -> Option<f64> {
    if camera.model() == CameraModel::Equirectangular {
        return None;
    }
    let (width, height) = (f64::from(camera.width), f64::from(camera.height));
    let parts = (0..=BORDER).map(|n| f64::from(n) / f64::from(BORDER));
    let pixels = parts.flat_map(|part| {
        let (x, y) = (part * width, part * height);
        [[x, 0.0], [x, height], [0.0, y], [width, y]].map(Point2::from)
    });
    // An image may not have the axis, so that its border is not around it.
    let centre = camera.pinhole_part().1;
    if !camera.contains(&centre) {
        return None;
    }
    pixels
        .map(|pixel| {
            let ray = camera.ray(&pixel)?;
            Some(ray.x.hypot(ray.y).atan2(ray.z))
        })
        .try_fold(0.0, |most: f64, angle| Some(most.max(angle?)))
}

struct Sphere {
    centre: Point3<f64>,
    radius: f64,
}

/// Blocks of points.
pub struct Blocks {
    /// Indices of the points, block by block.
    points: Vec<u32>,
    spheres: Vec<Sphere>,
}

impl Blocks {
    /// Makes blocks of these of the points.
    pub fn new(all: &[Point3<f64>], mut points: Vec<u32>) -> Self {
        split(all, &mut points);
        let spheres = points.chunks(BLOCK).map(|block| sphere(all, block));
        Self {
            spheres: spheres.collect(),
            points,
        }
    }

    /// The points that a view may show.
    pub fn candidates(&self, view: &Cone) -> impl Iterator<Item = u32> {
        let blocks = self.points.chunks(BLOCK).zip(&self.spheres);
        let shown = blocks.filter(|(_, sphere)| view.may_show(sphere));
        shown.flat_map(|(block, _)| block.iter().copied())
    }

    /// Number of points that a view may show, or somewhat more.
    pub fn count(&self, view: &Cone) -> usize {
        let shown = self.spheres.iter().filter(|sphere| view.may_show(sphere));
        shown.count() * BLOCK
    }
}

/// Sorts the points so that those of each block are neighbours.
fn split(all: &[Point3<f64>], points: &mut [u32]) {
    if points.len() <= BLOCK {
        return;
    }
    let (low, high) = corners(all, points);
    let axis = (high - low).imax();
    // A multiple, so that `chunks` later finds the same blocks.
    let middle = (points.len() / 2).next_multiple_of(BLOCK);
    let along = |&point: &u32| (all[point as usize][axis], point);
    if middle < points.len() {
        points.select_nth_unstable_by(middle, |a, b| {
            let ((x, a), (y, b)) = (along(a), along(b));
            x.total_cmp(&y).then(a.cmp(&b))
        });
        let (first, second) = points.split_at_mut(middle);
        rayon::join(|| split(all, first), || split(all, second));
    }
}

fn corners(all: &[Point3<f64>], points: &[u32]) -> (Point3<f64>, Point3<f64>) {
    let [low, high] = [f64::INFINITY, f64::NEG_INFINITY].map(|x| Point3::new(x, x, x));
    let points = points.iter().map(|&point| &all[point as usize]);
    points.fold((low, high), |(low, high), point| {
        (low.inf(point), high.sup(point))
    })
}

fn sphere(all: &[Point3<f64>], block: &[u32]) -> Sphere {
    let (low, high) = corners(all, block);
    let centre = nalgebra::center(&low, &high);
    let distances = block
        .iter()
        .map(|&point| (all[point as usize] - centre).norm());
    Sphere {
        radius: distances.fold(0.0, f64::max),
        centre,
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Rotation3, Vector3};

    use super::*;

    #[test]
    fn all_points_that_a_view_shows_are_candidates_and_few_others() {
        let point = |n: u32| {
            let n = f64::from(n);
            Point3::new((7.1 * n).sin(), (3.3 * n).cos(), (0.7 * n).sin()) * (n % 19.0)
        };
        let points: Vec<Point3<f64>> = (0..20_000).map(point).collect();
        let blocks = Blocks::new(&points, (0..20_000).collect());
        let lenses = [
            (CameraModel::SimplePinhole, vec![900.0, 400.0, 300.0]),
            (
                CameraModel::OpenCv,
                vec![700.0, 710.0, 390.0, 310.0, -0.2, 0.05, 0.01, -0.01],
            ),
            (CameraModel::SimpleRadial, vec![600.0, 400.0, 300.0, -0.25]),
            (
                CameraModel::OpenCvFisheye,
                vec![500.0, 500.0, 400.0, 300.0, 0.01, 0.0, 0.0, 0.0],
            ),
            (CameraModel::Equirectangular, vec![800.0, 600.0]),
            (CameraModel::SimplePinhole, vec![900.0, -400.0, 300.0]),
        ];
        for (model, parameters) in lenses {
            let camera = Camera::new(1, model, 800, 600, parameters).unwrap();
            for turn in 0..10 {
                let turn = 3.7 * f64::from(turn);
                let axis = Vector3::new(turn.sin(), turn.cos(), 0.3);
                let pose = Pose {
                    rotation: Rotation3::new(axis.normalize() * turn),
                    translation: Vector3::new(0.0, turn.cos() * 4.0, turn % 5.0),
                };
                let view = Cone::new(pose, &camera, mantle(&camera));
                let mut shown: Vec<u32> = blocks.candidates(&view).collect();
                assert!(shown.len() <= blocks.count(&view));
                if model == CameraModel::SimplePinhole && camera.contains(&camera.pinhole_part().1)
                {
                    assert!(shown.len() < 12_000, "{}", shown.len());
                }
                shown.retain(|&n| view.pixel(&points[n as usize]).is_some());
                shown.sort_unstable();
                let all = (0..20_000).filter(|&n| view.pixel(&points[n as usize]).is_some());
                assert_eq!(shown, all.collect::<Vec<u32>>(), "{model:?} {turn}");
            }
        }
    }
}
