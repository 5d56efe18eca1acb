//! Observations that a model lacks, by projection: of points without tracks, of the points of a PLY
//! file beside a model that has cameras only, and of tracks whose images list no 2D points.

use std::{borrow::Cow, collections::HashMap};

use nalgebra::Point3;
use rayon::prelude::*;
use viewrank_core::{
    base::median::upper_median,
    model::{
        camera::Camera,
        scene::{Pose, WarningKind},
    },
};

use super::{
    Place,
    colmap::{ColmapImage, ColmapModel, ColmapPoint, Point2d, TrackElement},
};

/// Largest number of points used from a cloud without tracks, and largest number of observations
/// made from them.
const CLOUD_POINTS: usize = 1 << 20;
const CLOUD_OBSERVATIONS: usize = 20_000_000;
/// Largest number that is made where a sample promised fewer.
const MOST_OBSERVATIONS: usize = CLOUD_OBSERVATIONS / 2 * 3;
/// Largest number of projections of points into images, of which a small file may ask for billions.
const PROJECTIONS: usize = 1 << 30;
/// Number of points sampled to estimate how many views a point projects into, and largest number of
/// their projections.
const CLOUD_SAMPLE: usize = 1 << 12;
const SAMPLE_PROJECTIONS: usize = 1 << 26;
/// Projections that are made at a time: all may be observations.
const PROJECTIONS_AT_ONCE: usize = 1 << 22;

/// Poses and cameras of the images of a model, by position; `None` if the model lacks one.
struct Projection<'a> {
    views: Vec<Option<(Pose, &'a Camera)>>,
}

impl<'a> Projection<'a> {
    fn new(model: &'a ColmapModel) -> Self {
        let cameras: HashMap<u32, &Camera> = model.cameras.iter().map(|c| (c.id, c)).collect();
        let view = |image: &ColmapImage| {
            let camera = cameras.get(&image.camera_id)?;
            Some((image.cam_from_world.pose().ok()?, *camera))
        };
        Self {
            views: model.images.iter().map(view).collect(),
        }
    }

    /// The pixel of a point in an image, inside or not.
    fn pixel(&self, image: usize, x: &Point3<f64>) -> Option<[f64; 2]> {
        let (pose, camera) = self.views[image].as_ref()?;
        let pixel = camera.project_beyond_field(&pose.camera_from_world(x))?;
        Some(pixel.into())
    }

    /// The images into which a point projects, and where.
    fn seen_by(&self, x: &Point3<f64>) -> Vec<(usize, [f64; 2])> {
        let pixel = |(pose, camera): &(Pose, &Camera)| {
            camera
                .project(&pose.camera_from_world(x))
                .filter(|pixel| camera.contains(pixel))
        };
        let views = self.views.iter().enumerate();
        views
            .filter_map(|(n, view)| view.as_ref().and_then(pixel).map(|p| (n, [p.x, p.y])))
            .collect()
    }
}

/// Mean number of views into which a point projects, estimated from some of the points.
pub fn views_per_point(model: &ColmapModel, points: &[Point3<f64>]) -> f64 {
    let projection = Projection::new(model);
    let most = SAMPLE_PROJECTIONS / model.images.len().max(1);
    let sample = thinned(points.len(), CLOUD_SAMPLE.min(most).max(1));
    let seen = sample
        .par_iter()
        .map(|&p| projection.seen_by(&points[p]).len());
    seen.sum::<usize>() as f64 / sample.len().max(1) as f64
}

/// Distance of a cloud from the cameras, in extents of both together, from which on they are in
/// different coordinates: from so far away every camera sees all of it.
const FAR: f64 = 30.0;

/// Returns whether points and cameras are so far from each other that they cannot belong together.
pub fn is_far_away(model: &ColmapModel, points: &[Point3<f64>]) -> bool {
    let centre = |image: &ColmapImage| Some(image.cam_from_world.pose().ok()?.centre());
    let centres: Vec<Point3<f64>> = model.images.iter().filter_map(centre).collect();
    let (Some((cameras, around)), Some((cloud, across))) = (middle(&centres), middle(points))
    else {
        return false;
    };
    // Of a single camera and a single point nothing can be said.
    let extent = around + across;
    extent > 0.0 && (cameras - cloud).norm() > FAR * extent
}

/// The middle of places, and their median distance from it.
fn middle(places: &[Point3<f64>]) -> Option<(Point3<f64>, f64)> {
    let along = |axis: usize| upper_median(places.iter().map(|place| place[axis]));
    let centre = Point3::new(along(0)?, along(1)?, along(2)?);
    let distances = places.iter().map(|place| (place - centre).norm());
    Some((centre, upper_median(distances)?))
}

/// Adds points without tracks to a model that has none.
pub fn add_cloud(model: &mut ColmapModel, points: &[Point3<f64>]) {
    let used = used(model, points);
    let point = |(n, &p): (usize, &usize)| ColmapPoint {
        id: n as u64 + 1,
        xyz: points[p].into(),
        colour: [255; 3],
        error: -1.0,
        track: Cow::Borrowed(&[]),
        at: Place::File,
    };
    model.points = used.iter().enumerate().map(point).collect();
    observe(
        model,
        "the points of the PLY file have no tracks",
        points.len(),
        MOST_OBSERVATIONS,
    );
}

/// Indices of the points that are used of a cloud: of very many some, the same at each reading.
fn used(model: &ColmapModel, points: &[Point3<f64>]) -> Vec<usize> {
    let most = most_points(model.images.len(), views_per_point(model, points));
    thinned(points.len(), most)
}

/// Largest number of points used from a cloud that this number of views shows.
fn most_points(views: usize, views_per_point: f64) -> usize {
    let by_projections = PROJECTIONS / views.max(1);
    let by_observations = CLOUD_OBSERVATIONS / (views_per_point as usize).max(1);
    CLOUD_POINTS.min(by_projections).min(by_observations)
}

/// Gives all points the tracks of the images into which they project; hidden ones count, too.
/// Those beyond `most` observations are left out: the sample of [`used`] may have missed where
/// points are. `why`: begins the warning; `all`: points of the cloud that these were chosen from.
fn observe(model: &mut ColmapModel, why: &str, all: usize, most: usize) {
    let mut points = std::mem::take(&mut model.points);
    let mut observed = vec![Vec::new(); model.images.len()];
    let (mut observations, mut done) = (0, 0);
    let projection = Projection::new(model);
    for points in points.chunks_mut((PROJECTIONS_AT_ONCE / model.images.len().max(1)).max(1)) {
        if observations > most {
            break;
        }
        let tracks = points.par_iter();
        let tracks: Vec<Vec<(usize, [f64; 2])>> = tracks
            .map(|point| projection.seen_by(&point.xyz.into()))
            .collect();
        for (point, track) in points.iter_mut().zip(tracks) {
            observations += track.len();
            let element = |(image, pixel): (usize, [f64; 2])| {
                let points2d: &mut Vec<Point2d> = &mut observed[image];
                points2d.push(Point2d::new(pixel, Some(point.id)));
                TrackElement::new(model.images[image].id, points2d.len() as u32 - 1)
            };
            point.track = Cow::Owned(track.into_iter().map(element).collect());
        }
        done += points.len();
    }
    points.truncate(done);
    model.points = points;
    for (image, points2d) in model.images.iter_mut().zip(observed) {
        image.points2d = Cow::Owned(points2d);
    }
    let text = format!("{why}: every view into which a point projects counts as observing it");
    model.warn(WarningKind::Projected, text);
    let used = model.points.len();
    if used < all {
        let text = format!("the cloud has {all} points, of which a random {used} are used");
        model.warn(WarningKind::Format, text);
    }
}

/// Completes the observations of a model with points: 2D points that tracks name, but no image
/// lists, are placed at the projections; tracks are made of the images' lists if no point has one;
/// points that no two images observe are observed by all into which they project.
pub fn complete(model: &mut ColmapModel) {
    place_2d_points(model);
    if model.points.iter().all(|point| point.track.is_empty()) {
        follow_lists(model);
    }
    if !has_tracks(model) && !model.points.is_empty() && model.images.len() > 1 {
        let why = if model.points.iter().any(|point| !point.track.is_empty()) {
            "no point is observed by two images"
        } else {
            "the points have no tracks"
        };
        let positions: Vec<Point3<f64>> = model.points.iter().map(|p| p.xyz.into()).collect();
        let used = used(model, &positions);
        let mut points: Vec<Option<ColmapPoint>> = std::mem::take(&mut model.points)
            .into_iter()
            .map(Some)
            .collect();
        model.points = used.iter().filter_map(|&p| points[p].take()).collect();
        observe(model, why, positions.len(), MOST_OBSERVATIONS);
    }
}

/// Returns whether any point is observed by two images.
pub fn has_tracks(model: &ColmapModel) -> bool {
    let by_two = |point: &ColmapPoint| {
        let first = point.track.first().map(TrackElement::image);
        point.track.iter().any(|t| Some(t.image()) != first)
    };
    model.points.iter().any(by_two)
}

/// Gives images without 2D points those that tracks name, at the projections of the points.
fn place_2d_points(model: &mut ColmapModel) {
    let positions: HashMap<u32, usize> = (0..model.images.len())
        .filter(|&n| model.images[n].points2d.is_empty())
        .map(|n| (model.images[n].id, n))
        .collect();
    let names_one = |point: &ColmapPoint| {
        let mut images = point.track.iter().map(TrackElement::image);
        images.any(|image| positions.contains_key(&image))
    };
    if positions.is_empty() || !model.points.iter().any(names_one) {
        return;
    }
    let mut placed: Vec<Vec<Point2d>> = vec![Vec::new(); model.images.len()];
    let projection = Projection::new(model);
    let track = |point: &ColmapPoint, placed: &mut [Vec<Point2d>]| {
        let x = Point3::from(point.xyz);
        let mut track = Vec::with_capacity(point.track.len());
        for element in point.track.iter() {
            let Some(&image) = positions.get(&element.image()) else {
                track.push(*element);
                continue;
            };
            if let Some(pixel) = projection.pixel(image, &x) {
                placed[image].push(Point2d::new(pixel, Some(point.id)));
                let index = placed[image].len() as u32 - 1;
                track.push(TrackElement::new(element.image(), index));
            }
        }
        track
    };
    let tracks: Vec<Option<Vec<TrackElement>>> = model
        .points
        .iter()
        .map(|point| names_one(point).then(|| track(point, &mut placed)))
        .collect();
    let filled = placed.iter().filter(|points| !points.is_empty()).count();
    for (point, track) in model.points.iter_mut().zip(tracks) {
        if let Some(track) = track {
            point.track = Cow::Owned(track);
        }
    }
    for (image, points2d) in model.images.iter_mut().zip(placed) {
        if !points2d.is_empty() {
            image.points2d = Cow::Owned(points2d);
        }
    }
    let all = model.images.len();
    let text = format!(
        "{filled} of {all} images list no 2D points, but tracks name some: they are placed at the projections of the points"
    );
    model.warn(WarningKind::Damaged, text);
}

/// Makes the tracks of points without any from the images' lists of 2D points.
fn follow_lists(model: &mut ColmapModel) {
    let mut listed = model.images.iter().flat_map(|image| image.points2d.iter());
    if listed.all(|point2d| point2d.point().is_none()) {
        return;
    }
    let positions: HashMap<u64, usize> = (0..model.points.len())
        .map(|n| (model.points[n].id, n))
        .collect();
    let mut tracks: Vec<Vec<TrackElement>> = vec![Vec::new(); model.points.len()];
    for image in &model.images {
        for (index, point2d) in image.points2d.iter().enumerate() {
            if let Some(&point) = point2d.point().and_then(|id| positions.get(&id)) {
                tracks[point].push(TrackElement::new(image.id, index as u32));
            }
        }
    }
    if tracks.iter().all(Vec::is_empty) {
        return;
    }
    for (point, track) in model.points.iter_mut().zip(tracks) {
        point.track = Cow::Owned(track);
    }
    let text = "the points have no tracks: they are made of the images' lists of 2D points";
    model.warn(WarningKind::Damaged, text);
}

/// Chooses about `most` of a number of points by a hash of their index: with a fixed stride, only
/// some lines of a grid would remain.
fn thinned(all: usize, most: usize) -> Vec<usize> {
    // SplitMix64.
    let hash = |n: usize| {
        let z = (n as u64)
            .wrapping_add(1)
            .wrapping_mul(0x9e37_79b9_7f4a_7c15);
        let z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    };
    let limit = most as f64 / all as f64 * u64::MAX as f64;
    (0..all)
        .filter(|&n| all <= most || (hash(n) as f64) < limit)
        .collect()
}

#[cfg(test)]
mod tests {
    use viewrank_core::model::camera::CameraModel;

    use super::*;
    use crate::formats::{colmap::StoredPose, foreign::ForeignModel};

    #[test]
    fn a_cloud_of_few_views_is_used_whole_and_one_of_very_many_in_part() {
        assert_eq!(most_points(500, 12.5), CLOUD_POINTS);
        assert_eq!(most_points(500, 100.0), 200_000);
        assert!(200_000 * most_points(200_000, 0.0) <= PROJECTIONS);
    }

    #[test]
    fn points_beyond_the_most_observations_are_left_out() {
        let mut foreign = ForeignModel::default();
        let camera = Camera::new(
            1,
            CameraModel::SimplePinhole,
            100,
            100,
            vec![90.0, 50.0, 50.0],
        );
        foreign.model.cameras.push(camera.unwrap());
        let pose = || StoredPose {
            quaternion: [1.0, 0.0, 0.0, 0.0],
            translation: [0.0; 3],
        };
        for id in 1..=1000 {
            foreign.add_image(id, format!("{id}.jpg"), 1, pose(), Place::File);
        }
        let mut model = foreign.model;
        // More than are looked at together.
        let points = vec![Point3::new(0.0, 0.0, 1.0); 9000];
        let point = |n: usize| ColmapPoint {
            id: n as u64 + 1,
            xyz: points[n].into(),
            colour: [255; 3],
            error: -1.0,
            track: Cow::Borrowed(&[]),
            at: Place::File,
        };
        model.points = (0..9000).map(point).collect();
        observe(&mut model, "they have no tracks", 9000, 5_000_000);
        let used = model.points.len();
        assert!((5000..9000).contains(&used), "{used}");
        assert!(model.points.iter().all(|point| point.track.len() == 1000));
        let of_image = |image: &ColmapImage| image.points2d.len();
        assert!(model.images.iter().all(|image| of_image(image) == used));
        assert_eq!(model.warnings.len(), 2);
    }
}
