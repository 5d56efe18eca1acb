//! Observations that a model lacks, by projection: of points without tracks, of the points of a PLY
//! file beside a model that has cameras only, and of tracks whose images list no 2D points.

mod blocks;

use std::{borrow::Cow, collections::HashMap};

use nalgebra::Point3;
use rayon::prelude::*;
use viewrank_core::{
    base::median::upper_median,
    model::{camera::Camera, scene::WarningKind},
};

use self::blocks::{Blocks, Cone, Mantle, mantle};
use super::{
    Place,
    colmap::{ColmapImage, ColmapModel, ColmapPoint, Point2d, TrackElement},
};

/// Largest number of points used from a cloud without tracks, and largest number of observations
/// made from them: each takes 60 bytes until the scene is made.
const CLOUD_POINTS: usize = 1 << 20;
const MOST_OBSERVATIONS: usize = 5_000_000;
/// Largest number of points in images that are looked at, of which a small file may ask for
/// billions; projections, and points whose block is looked at.
const PROJECTIONS: usize = 1 << 24;
const LOOKED_AT: usize = 1 << 31;
/// Number of points sampled to estimate how many views a point projects into, and largest number of
/// their projections.
const CLOUD_SAMPLE: usize = 1 << 12;
const SAMPLE_PROJECTIONS: usize = 1 << 24;
/// Observations that may be made at a time, beyond the most.
const AT_ONCE: usize = 1 << 22;

/// Cameras up to which what their images may show is found, since that takes dozens of rays each.
const MOST_MANTLES: usize = 1 << 16;

/// Poses and cameras of the images of a model, by position; `None` if the model lacks one.
struct Projection<'a> {
    views: Vec<Option<Cone<'a>>>,
}

impl<'a> Projection<'a> {
    fn new(model: &'a ColmapModel) -> Self {
        let has_mantles = model.cameras.len() <= MOST_MANTLES;
        let with_mantle = |camera| (camera, has_mantles.then(|| mantle(camera)).flatten());
        let cameras = model.cameras.par_iter().map(with_mantle);
        let cameras: HashMap<u32, (&Camera, Mantle)> =
            cameras.map(|camera| (camera.0.id, camera)).collect();
        let view = |image: &ColmapImage| {
            let &(camera, mantle) = cameras.get(&image.camera_id)?;
            Some(Cone::new(image.cam_from_world.pose().ok()?, camera, mantle))
        };
        Self {
            views: model.images.par_iter().map(view).collect(),
        }
    }

    /// The pixel of a point in an image, inside or not.
    fn pixel(&self, image: usize, x: &Point3<f64>) -> Option<[f64; 2]> {
        let Cone { pose, camera, .. } = self.views[image].as_ref()?;
        let pixel = camera.project_beyond_field(&pose.camera_from_world(x))?;
        Some(pixel.into())
    }

    /// Number of images into which a point projects.
    fn seen_by(&self, x: &Point3<f64>) -> usize {
        let views = self.views.iter().flatten();
        views.filter(|view| view.pixel(x).is_some()).count()
    }
}

/// Mean number of views into which a point projects, estimated from some of the points.
pub fn views_per_point(model: &ColmapModel, points: &[Point3<f64>]) -> f64 {
    let projection = Projection::new(model);
    let most = SAMPLE_PROJECTIONS / model.images.len().max(1);
    let mut sample: Vec<u32> = Vec::new();
    let share = CLOUD_SAMPLE.min(most).max(1) as f64 / points.len() as f64;
    sample.extend((0..points.len() as u32).filter(|&point| is_kept(point, share)));
    let seen = sample
        .par_iter()
        .map(|&p| projection.seen_by(&points[p as usize]));
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
    // Medians, so that a few stray points do not move the middle.
    let along = |axis: usize| upper_median(places.iter().map(|place| place[axis]));
    let centre = Point3::new(along(0)?, along(1)?, along(2)?);
    let distances = places.iter().map(|place| (place - centre).norm());
    Some((centre, upper_median(distances)?))
}

/// Adds points without tracks to a model that has none.
pub fn add_cloud(model: &mut ColmapModel, points: &[Point3<f64>]) {
    let observed = observed(model, points, MOST_OBSERVATIONS);
    let point = |(id, &p): (u64, &u32)| ColmapPoint {
        id,
        xyz: points[p as usize].into(),
        colour: [255; 3],
        error: -1.0,
        track: Cow::Borrowed(&[]),
        at: Place::File,
    };
    model.points = (1..).zip(&observed.points).map(point).collect();
    let why = "the points of the PLY file have no tracks";
    observed.attach(model, why, points.len());
}

/// What the views of a model show of a cloud without tracks: every point that projects into a view;
/// hidden ones count, too.
struct Observed {
    /// Indices of the points that are used, ascending: of very many some, the same at each reading.
    points: Vec<u32>,
    /// For each image the points that it shows, ascending, as positions in `points`.
    by_image: Vec<Vec<Point2d>>,
}

/// Projects a cloud into the views. Points are left out until observations are no more than `most`.
fn observed(model: &ColmapModel, cloud: &[Point3<f64>], most: usize) -> Observed {
    let projection = Projection::new(model);
    let (mut points, mut share) = chosen(&projection, cloud);
    let mut blocks = Blocks::new(cloud, points.clone());
    let (mut by_image, mut observations) = (Vec::new(), 0);
    let mut views = &projection.views[..];
    while !views.is_empty() {
        // Each view may observe every point.
        let at_once = (AT_ONCE / points.len().max(1)).clamp(1, views.len());
        let (now, later) = views.split_at(at_once);
        views = later;
        let shown = now.par_iter().map(|view| {
            let view = view.as_ref();
            view.map_or(Vec::new(), |view| shown(view, &blocks, cloud))
        });
        by_image.extend(shown.collect::<Vec<_>>());
        let new = &by_image[by_image.len() - at_once..];
        observations += new.iter().map(Vec::len).sum::<usize>();
        while observations > most && points.len() > 1 {
            // The points of half the share are among those of the whole, so no view is projected
            // again.
            share /= 2.0;
            points.retain(|&point| is_kept(point, share));
            by_image.par_iter_mut().for_each(|points2d| {
                points2d.retain(|point2d| is_kept(index(point2d), share));
                points2d.shrink_to_fit();
            });
            observations = by_image.iter().map(Vec::len).sum();
            blocks = Blocks::new(cloud, points.clone());
        }
    }
    Observed { points, by_image }
}

/// Chooses points so that few enough are looked at in all views; also returns their share.
fn chosen(projection: &Projection, cloud: &[Point3<f64>]) -> (Vec<u32>, f64) {
    let of_share = |share: f64| {
        let points = 0..cloud.len() as u32;
        points.filter(|&point| is_kept(point, share)).collect()
    };
    let most = CLOUD_POINTS.min(LOOKED_AT / projection.views.len().max(1));
    let share = (most as f64 / cloud.len() as f64).min(1.0);
    let points: Vec<u32> = of_share(share);
    let blocks = Blocks::new(cloud, points.clone());
    let views = projection.views.par_iter().flatten();
    let candidates: usize = views.map(|view| blocks.count(view)).sum();
    if candidates <= PROJECTIONS {
        return (points, share);
    }
    // Of a share of the points, about that share of the candidates remains.
    let share = share * PROJECTIONS as f64 / candidates as f64;
    (of_share(share), share)
}

/// The points of the blocks that a view shows, by index.
fn shown(view: &Cone, blocks: &Blocks, cloud: &[Point3<f64>]) -> Vec<Point2d> {
    let pixels = blocks.candidates(view).filter_map(|point| {
        let pixel = view.pixel(&cloud[point as usize])?;
        Some(Point2d::new(pixel, Some(point.into())))
    });
    let mut points2d: Vec<Point2d> = pixels.collect();
    points2d.sort_unstable_by_key(index);
    // Each list is kept until the last view is done.
    points2d.shrink_to_fit();
    points2d
}

/// The index of the point that [`shown`] noted.
fn index(point2d: &Point2d) -> u32 {
    point2d.point().map_or(u32::MAX, |point| point as u32)
}

impl Observed {
    /// Gives the points that are used, which are now those of the model, their tracks. `why`:
    /// begins the warning; `all`: points of the cloud.
    fn attach(mut self, model: &mut ColmapModel, why: &str, all: usize) {
        let places: HashMap<u32, usize> = self.points.iter().copied().zip(0..).collect();
        // Counted first: tracks that grow by doubling could hold twice their memory.
        let mut lengths = vec![0; self.points.len()];
        for points2d in &mut self.by_image {
            for point2d in points2d {
                let place = places[&index(point2d)];
                lengths[place] += 1;
                *point2d = Point2d::new(point2d.pixel(), Some(place as u64));
            }
        }
        let mut tracks: Vec<Vec<TrackElement>> =
            lengths.into_iter().map(Vec::with_capacity).collect();
        for (image, mut points2d) in model.images.iter_mut().zip(self.by_image) {
            for (number, point2d) in (0..).zip(&mut points2d) {
                let place = index(point2d) as usize;
                tracks[place].push(TrackElement::new(image.id, number));
                *point2d = Point2d::new(point2d.pixel(), Some(model.points[place].id));
            }
            image.points2d = Cow::Owned(points2d);
        }
        for (point, track) in model.points.iter_mut().zip(tracks) {
            point.track = Cow::Owned(track);
        }
        let text = format!("{why}: every view into which a point projects counts as observing it");
        model.warn(WarningKind::Projected, text);
        let used = model.points.len();
        if used < all {
            let text = format!("the cloud has {all} points, of which a random {used} are used");
            model.warn(WarningKind::Format, text);
        }
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
    // With a single image no point could get a second observation.
    if !has_tracks(model) && !model.points.is_empty() && model.images.len() > 1 {
        let why = if model.points.iter().any(|point| !point.track.is_empty()) {
            "no point is observed by two images"
        } else {
            "the points have no tracks"
        };
        let positions: Vec<Point3<f64>> = model.points.iter().map(|p| p.xyz.into()).collect();
        let observed = observed(model, &positions, MOST_OBSERVATIONS);
        let mut points: Vec<Option<ColmapPoint>> = std::mem::take(&mut model.points)
            .into_iter()
            .map(Some)
            .collect();
        let used = observed.points.iter();
        model.points = used.filter_map(|&p| points[p as usize].take()).collect();
        observed.attach(model, why, positions.len());
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

/// Gives images without 2D points those that tracks name, at the projections of the points: one of
/// each point, however often its track names the image.
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
    // The point that each image was given last, in place of a set of images for each point.
    let mut last = vec![usize::MAX; model.images.len()];
    let mut track = |number: usize, point: &ColmapPoint| {
        let x = Point3::from(point.xyz);
        let mut track = Vec::new();
        for element in point.track.iter() {
            // Images that list 2D points keep them.
            let Some(&image) = positions.get(&element.image()) else {
                track.push(*element);
                continue;
            };
            if std::mem::replace(&mut last[image], number) == number {
                continue;
            }
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
        .enumerate()
        .map(|(number, point)| names_one(point).then(|| track(number, point)))
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

/// Returns whether a point is of a share of them, by a hash of its index: with a fixed stride, only
/// some lines of a grid would remain. The points of a smaller share are among those of a larger
/// one.
fn is_kept(point: u32, share: f64) -> bool {
    // SplitMix64.
    let z = (u64::from(point))
        .wrapping_add(1)
        .wrapping_mul(0x9e37_79b9_7f4a_7c15);
    let z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    share >= 1.0 || ((z ^ (z >> 31)) as f64) < share * u64::MAX as f64
}

#[cfg(test)]
mod tests {
    use viewrank_core::model::camera::CameraModel;

    use super::*;
    use crate::formats::{colmap::StoredPose, foreign::ForeignModel};

    /// Images beside each other that look along z, and points at a distance of one.
    fn model(images: u32, points: usize) -> ColmapModel<'static> {
        let mut foreign = ForeignModel::default();
        let model = CameraModel::SimplePinhole;
        let camera = Camera::new(1, model, 100, 100, vec![90.0, 50.0, 50.0]);
        foreign.model.cameras.push(camera.unwrap());
        for id in 1..=images {
            let pose = StoredPose {
                quaternion: [1.0, 0.0, 0.0, 0.0],
                translation: [1e-6 * f64::from(id), 0.0, 0.0],
            };
            foreign.add_image(id, format!("{id}.jpg"), 1, pose, Place::File);
        }
        let mut model = foreign.model;
        let point = |n: usize| ColmapPoint {
            id: 7 * n as u64 + 1,
            xyz: [1e-5 * n as f64, 0.0, 1.0],
            colour: [255; 3],
            error: -1.0,
            track: Cow::Borrowed(&[]),
            at: Place::File,
        };
        model.points = (0..points).map(point).collect();
        model
    }

    fn positions(model: &ColmapModel) -> Vec<Point3<f64>> {
        model.points.iter().map(|p| p.xyz.into()).collect()
    }

    #[test]
    fn points_without_tracks_are_observed_where_they_project() {
        let mut model = model(100, 900);
        complete(&mut model);
        assert_eq!(model.points.len(), 900);
        for (n, point) in model.points.iter().enumerate() {
            assert_eq!(point.id, 7 * n as u64 + 1);
            let images = point.track.iter().map(TrackElement::image);
            assert!(images.eq(1..=100));
            let seen = model.images[0].points2d[point.track[0].index() as usize];
            assert_eq!(seen.point(), Some(point.id));
            let x = 50.0 + 90.0 * (1e-5 * n as f64 + 1e-6);
            assert!((seen.pixel()[0] - x).abs() < 1e-9);
        }
        assert_eq!(model.warnings.len(), 1);
    }

    #[test]
    fn a_point_is_placed_once_in_each_image_that_its_track_names() {
        let mut model = model(2, 3);
        let track = [1, 1, 2, 1, 2].map(|image| TrackElement::new(image, 0));
        for point in &mut model.points {
            point.track = Cow::Owned(track.to_vec());
        }
        complete(&mut model);
        for point in &model.points {
            let images = point.track.iter().map(TrackElement::image);
            assert!(images.eq([1, 2]));
        }
        assert!(model.images.iter().all(|image| image.points2d.len() == 3));
    }

    #[test]
    fn of_points_with_too_many_observations_some_are_used() {
        let model = model(1000, 9000);
        let observed = observed(&model, &positions(&model), 5_000_000);
        let used = observed.points.len();
        assert!((2500..=5000).contains(&used), "{used}");
        assert!(observed.by_image.iter().all(|image| image.len() == used));
    }

    #[test]
    fn of_points_that_no_image_shows_few_are_projected() {
        // Each is within the cone of each image, and outside of the image.
        let mut model = model(20_000, 9000);
        model.cameras[0] = Camera::new(
            1,
            CameraModel::SimplePinhole,
            1000,
            1,
            vec![90.0, 50.0, 0.5],
        )
        .unwrap();
        let above = |point: &ColmapPoint| Point3::new(point.xyz[0], 1.0, 1.0);
        let points: Vec<Point3<f64>> = model.points.iter().map(above).collect();
        let projection = Projection::new(&model);
        let (used, _) = chosen(&projection, &points);
        assert!(
            (500..PROJECTIONS / 15_000).contains(&used.len()),
            "{}",
            used.len()
        );
        // And all where blocks are behind the images.
        let behind: Vec<Point3<f64>> = points.iter().map(|p| Point3::new(p.x, p.y, -p.z)).collect();
        assert_eq!(chosen(&projection, &behind).0.len(), 9000);
    }
}
