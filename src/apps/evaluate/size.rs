//! Size of a finished depth map, for backends that mix two sizes in one plan.

use crate::{
    io::depthmaps::{DepthMap, DepthMapFormat},
    method::fulfilment::Model,
    model::{camera::Camera, cluster::MapScale, scene::ViewIndex},
    plan::Stages,
};

/// Pixels by which widths of one size differ: programs round in their own ways.
const ROUNDING: f64 = 1.5;

/// Size of a depth map against the planned one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MapSize {
    /// The nearer of both sizes, as a ratio.
    pub scale: MapScale,
    /// False for a map that has neither: made with another `image_scale`, it cannot be fused with
    /// those of the plan.
    is_planned: bool,
}

/// Says that the maps of some views are left out for their size; `None` without any.
pub fn other_sizes_in_words(stages: &Stages, views: &[ViewIndex]) -> Option<String> {
    let first = stages.scene.name(*views.first()?);
    let (number, image_scale) = (views.len(), stages.settings.image_scale());
    let maps = if number == 1 { "map" } else { "maps" };
    Some(format!(
        "left out: {number} depth {maps} of neither the size that image_scale = {image_scale} gives nor half of it, the first of {first}"
    ))
}

impl MapSize {
    /// Returns whether the map counts. `mixes_sizes`: the backend fuses the two planned sizes, and
    /// no others.
    pub fn counts(&self, mixes_sizes: bool) -> bool {
        !mixes_sizes || self.is_planned
    }

    pub fn new(model: &Model, key: ViewIndex, map: &DepthMap) -> Self {
        let side = |camera: &Camera| f64::from(camera.width.max(camera.height));
        let longest = model.scene.cameras.iter().map(side).fold(0.0, f64::max);
        Self::of(
            model.scene.camera_of(key),
            longest,
            model.rule.image_scale,
            (map.width, map.format),
        )
    }

    /// `longest`: the longest side of all images, pixels; `planned`: the matched size over the
    /// images'.
    fn of(
        camera: &Camera,
        longest: f64,
        planned: f64,
        (width, format): (u32, DepthMapFormat),
    ) -> Self {
        let (width, full) = (f64::from(width), f64::from(camera.width));
        let least = |scale: MapScale| planned * scale.factor();
        // Of the programs that reduce all images to one longest side, smaller ones less than
        // planned.
        let most = |scale: MapScale| {
            let is_limited = !matches!(format, DepthMapFormat::Npy | DepthMapFormat::Mve);
            let limit = least(scale) * longest / f64::from(camera.width.max(camera.height));
            if is_limited {
                limit.min(1.0).max(least(scale))
            } else {
                least(scale)
            }
        };
        // By ratio: the border between both sizes is at 0.71, not at 0.75.
        let off = |scale: MapScale| (width / (full * most(scale))).ln().abs();
        let scale = if off(MapScale::Half) < off(MapScale::Full) {
            MapScale::Half
        } else {
            MapScale::Full
        };
        // The images of the plan need not have the longest of all.
        let is_of = |scale: MapScale| {
            width >= full * least(scale) - ROUNDING && width <= full * most(scale) + ROUNDING
        };
        // Other programs only halve images, or fuse any sizes.
        let is_exact = matches!(format, DepthMapFormat::OpenMvs | DepthMapFormat::Npy);
        Self {
            scale,
            is_planned: !is_exact || is_of(MapScale::Full) || is_of(MapScale::Half),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::camera::CameraModel;

    #[test]
    fn maps_of_another_size_are_told_apart() {
        let camera = |width, height| {
            Camera::new(
                1,
                CameraModel::Pinhole,
                width,
                height,
                vec![1e3, 1e3, 1.0, 1.0],
            )
            .unwrap()
        };
        let size = |camera: &Camera, width| {
            let MapSize { scale, is_planned } =
                MapSize::of(camera, 4000.0, 0.4, (width, DepthMapFormat::OpenMvs));
            (scale, is_planned)
        };
        let large = camera(4000, 3000);
        assert_eq!([1600, 1599, 800, 801].map(|w| size(&large, w).1), [true; 4]);
        assert_eq!(
            (size(&large, 1600).0, size(&large, 800).0),
            (MapScale::Full, MapScale::Half)
        );
        // image_scale 0.3, 0.41, 0.5 and 1, and half of 0.3.
        assert_eq!(
            [1200, 1640, 2000, 4000, 600].map(|w| size(&large, w).1),
            [false; 5]
        );
        // To a longest side of 1600 or 800, if that is smaller, and as the plan has it.
        let upright = camera(1500, 2000);
        assert_eq!([1200, 600, 300].map(|w| size(&upright, w).1), [true; 3]);
        assert!(!size(&upright, 1500).1 && !size(&upright, 200).1);
        assert_eq!(
            (size(&upright, 1200).0, size(&upright, 600).0),
            (MapScale::Full, MapScale::Half)
        );
        // sgm reduces each image as planned.
        let of_sgm =
            |width| MapSize::of(&upright, 4000.0, 0.4, (width, DepthMapFormat::Npy)).is_planned;
        assert!(of_sgm(600) && of_sgm(300) && !of_sgm(1200));
        assert!(
            MapSize::of(&large, 4000.0, 0.4, (1200, DepthMapFormat::Mve)).is_planned,
            "it can only halve images"
        );
    }
}
