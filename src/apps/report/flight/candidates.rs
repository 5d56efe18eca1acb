//! Candidate poses around the holes.

use nalgebra::{Matrix3, Point3, Rotation3, Vector3};
use rayon::prelude::*;

use super::super::holes::Hole;
use crate::{
    method::target::GSD_MARGIN,
    model::{
        camera::Camera,
        georeference::MapFrame,
        scene::{CameraIndex, Pose, Scene},
        surface::Surface,
    },
    plan::Plan,
};

/// A pose that could be flown.
pub struct Candidate {
    pub centre: Point3<f64>,
    pub direction: Vector3<f64>,
    pub pose: Pose,
    pub camera: CameraIndex,
    /// Place that it looks at.
    pub target: Point3<f64>,
    pub hole: usize,
}

/// Angle between the rays of neighbouring candidates, degrees: wide enough for depth, narrow enough
/// to match.
pub const STEP_DEG: f64 = 14.0;
/// Least distance from the surface, as a share of the distance from which the wanted resolution is
/// reached.
const CLEARANCE: f64 = 0.6;
/// Largest number of places per hole that poses look at.
const PLACES: usize = 40;
/// Distance, as a share of the step, within which poses with nearly the same direction are merged.
const SAME: f64 = 0.4;
/// Smallest sine of the elevation of a pose above its target; lower poses could be below ground.
const LOWEST: f64 = -0.2;

/// Returns poses on a grid in front of each hole, facing it, with four more around each: at the
/// distance that gives the wanted resolution with the camera that took the most images, and clear
/// of the surface.
pub fn around(plan: &Plan, holes: &[Hole], frame: &MapFrame) -> Vec<Candidate> {
    let Some(camera) = usual_camera(&plan.stages.scene) else {
        return Vec::new();
    };
    let lens = &plan.stages.scene.cameras[camera.index()];
    let mut all: Vec<Candidate> = Vec::new();
    for (number, hole) in holes.iter().enumerate() {
        let gsd = f64::from(plan.stages.target.gsd[hole.deepest as usize]);
        let distance = distance(plan.stages.settings.image_scale(), gsd, lens);
        let step = step(distance);
        for (place, normal) in places(&plan.stages.surface, hole, step) {
            for direction in directions(&normal, &frame.axes[2]) {
                let centre = place + direction * distance;
                let is_new = |other: &Candidate| {
                    (other.centre - centre).norm() > SAME * step
                        // More than one `STEP_DEG`, of which this is the cosine, rounded down.
                        || other.direction.dot(&-direction) < 0.97
                };
                if direction.dot(&frame.axes[2]) >= LOWEST && all.iter().all(is_new) {
                    let pose = looking(&centre, &-direction, &frame.axes[2], &frame.axes[1]);
                    all.push(Candidate {
                        centre,
                        direction: -direction,
                        pose,
                        camera,
                        target: place,
                        hole: number,
                    });
                }
            }
        }
    }
    let clear = |c: &Candidate| {
        let room = CLEARANCE * (c.centre - c.target).norm();
        plan.stages
            .surface
            .vertices
            .iter()
            .all(|vertex| (vertex - c.centre).norm() >= room)
    };
    let is_clear: Vec<bool> = all.par_iter().map(clear).collect();
    let mut is_clear = is_clear.into_iter();
    all.retain(|_| is_clear.next() == Some(true));
    all
}

/// Distance from which a camera reaches a ground sampling distance at a size of its images, scene
/// units.
pub fn distance(image_scale: f64, gsd: f64, camera: &Camera) -> f64 {
    gsd * camera.mean_focal_length() * image_scale / GSD_MARGIN
}

/// Distance between neighbouring candidates at a distance from what they look at.
pub fn step(distance: f64) -> f64 {
    distance * STEP_DEG.to_radians().tan()
}

/// Returns the camera with the most views, the first one in a tie; `None` if it has no valid focal
/// length.
pub fn usual_camera(scene: &Scene) -> Option<CameraIndex> {
    let mut views = vec![0usize; scene.cameras.len()];
    scene
        .views
        .iter()
        .for_each(|view| views[view.camera.index()] += 1);
    let most = views.iter().copied().max()?;
    let has_focal = |camera: &Camera| {
        camera.mean_focal_length().is_finite() && camera.mean_focal_length() > 0.0
    };
    let found = views.iter().position(|&n| n == most)?;
    has_focal(&scene.cameras[found]).then_some(CameraIndex(found as u32))
}

/// Returns places on the hole, the deepest first, at least `step` apart, each with the mean normal
/// around it.
fn places(surface: &Surface, hole: &Hole, step: f64) -> Vec<(Point3<f64>, Vector3<f64>)> {
    let mut order = vec![hole.deepest];
    order.extend(hole.members.iter().copied().filter(|&t| t != hole.deepest));
    let mut found: Vec<Point3<f64>> = Vec::new();
    for t in order {
        let place = surface.centroid(t);
        if found.len() < PLACES && found.iter().all(|other| (other - place).norm() >= step) {
            found.push(place);
        }
    }
    let normal = |place: &Point3<f64>| {
        let near = hole
            .members
            .iter()
            .filter(|&&t| (surface.centroid(t) - place).norm() <= step);
        let sum: Vector3<f64> = near.map(|&t| surface.area_normal(t)).sum();
        // Normals that cancel out leave no side to look from.
        Some((*place, sum.try_normalize(0.0)?))
    };
    found.iter().filter_map(normal).collect()
}

/// Returns the directions from a place to its candidates: along its normal, and tilted by
/// [`STEP_DEG`] to each of four sides.
fn directions(normal: &Vector3<f64>, up: &Vector3<f64>) -> [Vector3<f64>; 5] {
    // Over level ground normal and up are nearly parallel, and their product has no sure direction.
    let side = normal
        .cross(up)
        .try_normalize(0.1)
        .unwrap_or_else(|| normal.cross(&Vector3::ith(normal.iamin(), 1.0)).normalize());
    let other = normal.cross(&side);
    let tilt = STEP_DEG.to_radians().tan();
    [Vector3::zeros(), side, -side, other, -other].map(|aside| (normal + aside * tilt).normalize())
}

/// Returns the pose at `centre` that looks along `direction` with its image upright, or, if it
/// looks straight down, with the top towards `ahead`.
fn looking(
    centre: &Point3<f64>,
    direction: &Vector3<f64>,
    up: &Vector3<f64>,
    ahead: &Vector3<f64>,
) -> Pose {
    let right = direction.cross(up);
    let right = right
        .try_normalize(0.3)
        .unwrap_or_else(|| direction.cross(ahead).normalize());
    let down = direction.cross(&right);
    let rows = Matrix3::from_rows(&[right.transpose(), down.transpose(), direction.transpose()]);
    // The rows are perpendicular unit vectors by construction.
    let rotation = Rotation3::from_matrix_unchecked(rows);
    Pose {
        rotation,
        translation: -(rotation * centre.coords),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pose_is_where_it_should_be_and_looks_there() {
        let (centre, up, ahead) = (Point3::new(3.0, -2.0, 7.0), Vector3::z(), Vector3::y());
        for direction in [
            -Vector3::z(),
            Vector3::new(1.0, 0.0, -0.2).normalize(),
            Vector3::new(0.1, -0.9, 0.3).normalize(),
        ] {
            let pose = looking(&centre, &direction, &up, &ahead);
            assert!((pose.centre() - centre).norm() < 1e-12);
            assert!((pose.viewing_direction() - direction).norm() < 1e-12);
            assert!((pose.rotation.matrix().determinant() - 1.0).abs() < 1e-12);
            let above =
                pose.camera_from_world(&(centre + direction * 5.0 + ahead * 0.1 + up * 0.5));
            assert!(above.y < 0.0, "what is above is at the top of the image");
        }
    }

    #[test]
    fn candidates_of_a_place_are_a_step_apart() {
        for normal in [
            Vector3::z(),
            Vector3::x(),
            Vector3::new(0.3, 0.4, 0.6).normalize(),
        ] {
            let [straight, aside @ ..] = directions(&normal, &Vector3::z());
            assert!((straight - normal).norm() < 1e-12);
            assert!(
                aside
                    .iter()
                    .all(|d| (d.angle(&normal).to_degrees() - STEP_DEG).abs() < 1e-6)
            );
        }
    }
}
