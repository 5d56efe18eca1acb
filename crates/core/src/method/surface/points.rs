//! Selects the sparse points of the surface and estimates their uncertainty (method 1.1).

use nalgebra::{Matrix3, Point2, Point3, Vector3};
use rayon::prelude::*;

use crate::{
    base::median::upper_median,
    model::scene::{PointIndex, Scene, ViewIndex},
};

/// Mean reprojection error, pixels, above which a point is rejected, unless the model's median is
/// large.
const MAX_ERROR_PX: f64 = 4.0;
/// Multiple of the model's median error that is accepted in any case.
const MAX_ERROR_MEDIANS: f64 = 3.0;
/// Multiple of the median distance from the centre of the points beyond which a point is an
/// outlier: a false match near the horizon is consistent with its rays at any distance, and one
/// such point would coarsen the grid of all others.
const MAX_DISTANCE_MEDIANS: f64 = 1000.0;
/// Standard deviation of an observation of a sparse point, px: of a feature, not of a dense match
/// (`fulfilment.sigma_px`).
const SIGMA_PX: f64 = 0.5;

/// Returns the sparse points that at least two views observe, in front of all of them, whose mean
/// reprojection error is below the larger of 4 px and 3 times the median, and that are not outliers
/// in distance; ascending.
pub fn usable_points(scene: &Scene) -> Vec<PointIndex> {
    let errors: Vec<Option<f64>> = (0..scene.points.len() as u32)
        .into_par_iter()
        .map(|p| mean_error_px(scene, PointIndex(p)))
        .collect();
    let Some(median) = upper_median(errors.iter().flatten().copied()) else {
        return Vec::new();
    };
    let limit = MAX_ERROR_PX.max(MAX_ERROR_MEDIANS * median);
    let is_usable = |p: &PointIndex| errors[p.index()].is_some_and(|e| e <= limit);
    near(
        scene,
        (0..scene.points.len() as u32)
            .map(PointIndex)
            .filter(is_usable)
            .collect(),
    )
}

/// Removes the points farther away than [`MAX_DISTANCE_MEDIANS`].
pub(super) fn near(scene: &Scene, mut points: Vec<PointIndex>) -> Vec<PointIndex> {
    let along = |axis: usize| upper_median(points.iter().map(|p| scene.points[p.index()][axis]));
    let [Some(x), Some(y), Some(z)] = [0, 1, 2].map(along) else {
        return points;
    };
    let distance = |p: &PointIndex| (scene.points[p.index()] - Point3::new(x, y, z)).norm();
    let limit = MAX_DISTANCE_MEDIANS * upper_median(points.iter().map(distance)).unwrap_or(0.0);
    // If most points coincide, the median distance is 0 and no limit applies.
    points.retain(|p| limit == 0.0 || distance(p) <= limit);
    points
}

/// Returns the mean reprojection error of a point over its observations with a known pixel; `None`
/// with fewer than two views, or if a camera does not project it.
fn mean_error_px(scene: &Scene, point: PointIndex) -> Option<f64> {
    let track = scene.track(point);
    let views = &scene.track_views[track.clone()];
    // Views of a track ascend: with the same at both ends it has one view or none.
    if views.first() == views.last() {
        return None;
    }
    let (mut sum, mut count) = (0.0, 0u32);
    for (view, pixel) in views.iter().zip(&scene.track_pixels[track]) {
        let x_cam = scene
            .view(*view)
            .cam_from_world
            .camera_from_world(&scene.points[point.index()]);
        let camera = scene.camera_of(*view);
        camera.project(&x_cam)?;
        // Equirectangular images: the angle counts, also across the seam.
        let error = camera
            .reprojection_error(&x_cam, &Point2::from(*pixel))
            .unwrap_or(f64::NAN);
        if error.is_finite() {
            sum += error;
            count += 1;
        }
    }
    Some(sum / f64::from(count.max(1)))
}

/// Returns the standard deviation of a point along the mean ray to the centres of the views that
/// see it, scene units: method 3.3 with J = f / r perpendicular to the ray. `None` if the rays are
/// parallel.
pub fn depth_sigma(
    point: &Point3<f64>,
    centres_and_focals: impl Iterator<Item = (Point3<f64>, f64)>,
) -> Option<f64> {
    let mut information = Matrix3::zeros();
    let mut mean = Vector3::zeros();
    for (centre, focal) in centres_and_focals {
        let ray = centre - point;
        let distance = ray.norm();
        let direction = ray / distance;
        let weight = (focal / distance / SIGMA_PX).powi(2);
        information += (Matrix3::identity() - direction * direction.transpose()) * weight;
        mean += direction;
    }
    let mean = mean.try_normalize(1e-9)?;
    let variance = mean.dot(&(information.try_inverse()? * mean));
    (variance > 0.0 && variance.is_finite()).then(|| variance.sqrt())
}

/// Returns the views of several points, ascending, without duplicates.
pub fn views_of(scene: &Scene, points: &[PointIndex], views: &mut Vec<ViewIndex>) {
    views.clear();
    points
        .iter()
        .for_each(|&p| views.extend(scene.track_views(p)));
    views.sort_unstable();
    views.dedup();
}

/// Keeps at most `most` of the directions: the one farthest from their mean, then repeatedly the
/// one farthest from those kept. Returns their indices in `directions` (unit vectors), in that
/// order.
pub fn extremes(directions: &[Vector3<f64>], most: usize) -> Vec<usize> {
    if directions.len() <= most {
        return (0..directions.len()).collect();
    }
    let mean: Vector3<f64> = directions.iter().sum();
    let mut kept = Vec::with_capacity(most);
    // Cosine to the nearest direction that is kept.
    let mut nearness: Vec<f64> = directions.iter().map(|d| d.dot(&mean)).collect();
    while kept.len() < most {
        let farthest = (0..directions.len())
            .min_by(|&a, &b| nearness[a].total_cmp(&nearness[b]))
            .unwrap_or(0);
        if kept.is_empty() {
            // The mean only picks the first one.
            nearness.fill(f64::NEG_INFINITY);
        }
        kept.push(farthest);
        for (near, direction) in nearness.iter_mut().zip(directions) {
            *near = near.max(direction.dot(&directions[farthest]));
        }
        nearness[farthest] = f64::INFINITY;
    }
    kept
}
