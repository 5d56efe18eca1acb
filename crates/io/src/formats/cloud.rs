//! Points without tracks, from a PLY file beside a model that has cameras only: observations are
//! the projections.

use std::collections::HashMap;

use nalgebra::Point3;
use rayon::prelude::*;
use viewrank_core::model::{
    camera::Camera,
    scene::{Pose, WarningKind},
};

use super::{Place, foreign::ForeignModel};

/// Largest number of points used from a cloud without tracks, and largest number of observations
/// made from them.
const CLOUD_POINTS: usize = 1 << 20;
const CLOUD_OBSERVATIONS: usize = 20_000_000;
/// Number of points sampled to estimate how many views a point projects into.
const CLOUD_SAMPLE: usize = 1 << 12;

/// Mean number of views into which a point projects, estimated from some of the points.
pub fn views_per_point(foreign: &ForeignModel, points: &[Point3<f64>]) -> f64 {
    let sample = thinned(points, CLOUD_SAMPLE);
    let observed: usize = tracks(foreign, &sample).iter().map(Vec::len).sum();
    observed as f64 / sample.len().max(1) as f64
}

/// The views into which each point projects, and where.
fn tracks(foreign: &ForeignModel, points: &[&Point3<f64>]) -> Vec<Vec<(usize, [f64; 2])>> {
    let cameras: HashMap<u32, Camera> = foreign
        .model
        .cameras
        .iter()
        .map(|c| (c.id, c.clone()))
        .collect();
    let poses = foreign.model.images.iter().map(|image| {
        Some((
            image.cam_from_world.pose().ok()?,
            cameras.get(&image.camera_id)?,
        ))
    });
    let poses: Vec<_> = poses.collect();
    let seen_by = |x: &&Point3<f64>| -> Vec<(usize, [f64; 2])> {
        let pixel = |(pose, camera): &(Pose, &Camera)| {
            camera
                .project(&pose.camera_from_world(x))
                .filter(|pixel| camera.contains(pixel))
        };
        let views = poses.iter().enumerate();
        views
            .filter_map(|(n, view)| view.as_ref().and_then(pixel).map(|p| (n, [p.x, p.y])))
            .collect()
    };
    points.par_iter().map(seen_by).collect()
}

/// Adds points without tracks: all views into which a point projects are taken to observe it, even
/// if it is hidden there; pixels are the projections. A huge cloud is subsampled, in the same way
/// at each reading.
pub fn add_cloud(foreign: &mut ForeignModel, points: &[Point3<f64>]) {
    let most = CLOUD_OBSERVATIONS / (views_per_point(foreign, points) as usize).max(1);
    let used = thinned(points, most.min(CLOUD_POINTS));
    let tracks = tracks(foreign, &used);
    for (n, (x, track)) in used.iter().zip(tracks).enumerate() {
        foreign.add_point(n as u64 + 1, (**x).into(), [255; 3], track, Place::File);
    }
    let text = "the points of the PLY file have no tracks: every view into which a point projects counts as observing it";
    foreign.warn(WarningKind::Format, text);
    if used.len() < points.len() {
        let (all, used) = (points.len(), used.len());
        let text = format!("the PLY file has {all} points, of which a random {used} are used");
        foreign.warn(WarningKind::Format, text);
    }
}

/// Chooses about `most` points by a hash of their index: with a fixed stride, only some lines of a
/// grid would remain.
fn thinned(points: &[Point3<f64>], most: usize) -> Vec<&Point3<f64>> {
    // SplitMix64.
    let hash = |n: usize| {
        let z = (n as u64)
            .wrapping_add(1)
            .wrapping_mul(0x9e37_79b9_7f4a_7c15);
        let z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    };
    let limit = most as f64 / points.len() as f64 * u64::MAX as f64;
    let all = points.len() <= most;
    points
        .iter()
        .enumerate()
        .filter(|(n, _)| all || (hash(*n) as f64) < limit)
        .map(|(_, x)| x)
        .collect()
}
