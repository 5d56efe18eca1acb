//! Movement of a depth map's points in the images of its cluster after the model has changed.
//!
//! The depth map stays in the frame of its key view. Its pixels are projected into each partner's
//! image through the earlier and the current poses and cameras; their distance there is the error
//! of an earlier match now. A cluster that moved as a whole has not moved at all; one whose scale
//! changed has.

use nalgebra::Point2;

use crate::{
    io::depthmaps::DepthMap,
    model::{
        camera::Camera,
        scene::{Pose, Scene, ViewIndex},
    },
    plan::PlannedView,
};

/// Sampled pixels of the depth map, along its width and height.
const GRID: u32 = 16;
/// Quantile of the movements that counts; larger ones may come from wrong depths.
const SHARE: f64 = 0.9;

/// Camera and pose of a view, earlier and now.
pub(super) struct MovedView {
    then: (Camera, Pose),
    now: (Camera, Pose),
}

impl MovedView {
    /// Returns `None` if the earlier record is broken.
    pub fn new(then: &PlannedView, scene: &Scene, view: ViewIndex) -> Option<Self> {
        let now = (
            scene.camera_of(view).clone(),
            scene.view(view).cam_from_world,
        );
        Some(Self {
            then: then.camera_and_pose()?,
            now,
        })
    }
}

/// Returns the movement of the depth map's points in the partner's image, pixels of the model's
/// image; 0 if it shows none of them.
pub(super) fn movement(map: &DepthMap, key: &MovedView, partner: &MovedView) -> f64 {
    let (columns, rows) = (GRID.min(map.width), GRID.min(map.height));
    let at = |i: u32, of: u32, all: u32| (2 * i + 1) * all / (2 * of);
    let pixels = (0..rows).flat_map(|j| (0..columns).map(move |i| (i, j)));
    let moved = pixels.filter_map(|(i, j)| {
        let (column, row) = (at(i, columns, map.width), at(j, rows, map.height));
        let then = shown(map, (column, row), &key.then, &partner.then)?;
        let now = shown(map, (column, row), &key.now, &partner.now)?;
        Some((now - then).norm())
    });
    let mut moved: Vec<f64> = moved.collect();
    moved.sort_by(f64::total_cmp);
    let place = (SHARE * moved.len() as f64) as usize;
    moved
        .get(place.min(moved.len().saturating_sub(1)))
        .copied()
        .unwrap_or(0.0)
}

/// Projects a pixel of the depth map into the partner's image.
fn shown(
    map: &DepthMap,
    pixel: (u32, u32),
    key: &(Camera, Pose),
    partner: &(Camera, Pose),
) -> Option<Point2<f64>> {
    let depth = map.depth_at(pixel.0, pixel.1)?;
    let ray = key.0.ray(&map.image_position(&key.0, pixel.0, pixel.1))?;
    let in_key = ray.into_inner() * (depth / ray.z);
    let in_world = key.1.rotation.inverse() * (in_key - key.1.translation);
    partner
        .0
        .project(&partner.1.camera_from_world(&in_world.into()))
}
