//! How far what a depth map shows has moved in the images of its cluster, when the model is another one now.
//!
//! The depth map is in the frame of its key view and stays there. Its pixels go through the poses and cameras of then, and those of
//! now, into each partner's image; the distance there says how wrong a match of then is now. A cluster that moved as a whole has not moved
//! at all; one whose scale changed has.

use nalgebra::Point2;

use crate::{
    io::depthmaps::DepthMap,
    model::{
        camera::Camera,
        scene::{Pose, Scene, ViewIndex},
    },
    plan::PlannedView,
};

/// Pixels of the depth map that are looked at, along its width and height.
const GRID: u32 = 16;
/// So much of what is looked at moved by no more than what is said; the rest may be wrong depths.
const SHARE: f64 = 0.9;

/// A view then and now.
pub(super) struct MovedView {
    then: (Camera, Pose),
    now: (Camera, Pose),
}

impl MovedView {
    /// `None` where the record of then is broken.
    pub fn new(then: &PlannedView, scene: &Scene, view: ViewIndex) -> Option<Self> {
        let now = (scene.camera_of(view).clone(), scene.view(view).cam_from_world);
        Some(Self { then: then.camera_and_pose()?, now })
    }
}

/// Pixels of the model's image by which the depth map's points moved in the partner's image; 0 where it shows nothing there.
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
    moved.get(place.min(moved.len().saturating_sub(1))).copied().unwrap_or(0.0)
}

/// Where a pixel of the depth map appears in the partner's image.
fn shown(map: &DepthMap, pixel: (u32, u32), key: &(Camera, Pose), partner: &(Camera, Pose)) -> Option<Point2<f64>> {
    let depth = map.depth_at(pixel.0, pixel.1)?;
    let ray = key.0.ray(&map.image_position(&key.0, pixel.0, pixel.1))?;
    let in_key = ray.into_inner() * (depth / ray.z);
    let in_world = key.1.rotation.inverse() * (in_key - key.1.translation);
    partner.0.project(&partner.1.camera_from_world(&in_world.into()))
}
