//! Size of a finished depth map, for backends that mix two sizes in one plan.

use std::f64::consts::FRAC_1_SQRT_2;

use crate::{
    io::depthmaps::{DepthMap, DepthMapFormat},
    method::fulfilment::Model,
    model::{cluster::MapScale, scene::ViewIndex},
};

/// Ratio up to which two widths are the same: programs crop images to whole blocks.
const SAME_SIZE: f64 = 1.15;

/// Size of a depth map against the planned one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MapSize {
    /// The nearer of both sizes, as a ratio.
    pub scale: MapScale,
    /// False for a map that has neither: made with another `image_scale`, it cannot be fused with those of the plan.
    pub is_planned: bool,
}

impl MapSize {
    pub fn new(model: &Model, key: ViewIndex, map: &DepthMap) -> Self {
        let planned = f64::from(model.scene.camera_of(key).width) * model.rule.image_scale;
        let ratio = f64::from(map.width) / planned;
        let scale = if ratio < FRAC_1_SQRT_2 { MapScale::Half } else { MapScale::Full };
        // Other programs reduce images to one longest side for all, or only by halves: their maps differ from the plan, and their fusion allows for it.
        let is_exact = matches!(map.format, DepthMapFormat::OpenMvs | DepthMapFormat::Npy);
        Self { scale, is_planned: !is_exact || (ratio / scale.factor()).ln().abs() <= SAME_SIZE.ln() }
    }
}
