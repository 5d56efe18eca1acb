//! Options of the ranking.

use serde::{Deserialize, Serialize};

use crate::model::cluster::MapScale;

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "lowercase")]
pub enum TriangleWeight {
    /// Its number of pixels, averaged over the views that see it.
    #[default]
    Pixels,
    /// Its area.
    Area,
    /// Equal for all triangles, as in the paper.
    Count,
}

/// Default of `ranking.half_worth`, chosen by clouds that OpenMVS fused (method 5.8).
const HALF_WORTH: f64 = 0.8;

/// Method 5.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct RankingSettings {
    /// Depth maps that must see a triangle (m, method 5.2). A higher value asks for more overlap.
    /// Unset: the backend's.
    #[cfg_attr(feature = "schema", schemars(range(min = 1, max = 100), extend("unit" = "depth maps")))]
    pub support: Option<u32>,
    /// Weight of a triangle in the plan: "pixels" favours surfaces that the photographs show in
    /// detail, "area" large surfaces, "count" none.
    pub weight: TriangleWeight,
    /// Largest shift, in any image of its cluster, up to which a finished depth map stays in the
    /// plan of a changed model. A higher value keeps more maps.
    #[cfg_attr(feature = "schema", schemars(range(min = 0), extend("unit" = "px")))]
    pub keep_px: f64,
    /// Sizes at which a depth map may be matched, over `image_scale`: [1], or [1, 0.5] to match
    /// each key view at the one with which the plan gives most for its work. For backends that can
    /// match key views at different sizes.
    #[cfg_attr(feature = "schema", schemars(length(min = 1, max = 2)))]
    pub scales: Vec<MapScale>,
    /// Part of the loss of a half-size depth map, in resolution and accuracy, that does not count:
    /// 0 plans by what it fulfils, 1 by what it covers. A higher value plans more coarse maps.
    #[cfg_attr(feature = "schema", schemars(range(min = 0, max = 1)))]
    pub half_worth: f64,
}

impl RankingSettings {
    /// Returns true if depth maps may be matched at half the size.
    pub fn has_half(&self) -> bool {
        self.scales.contains(&MapScale::Half)
    }
}

impl Default for RankingSettings {
    fn default() -> Self {
        Self {
            support: None,
            weight: TriangleWeight::default(),
            keep_px: 1.0,
            scales: vec![MapScale::Full],
            half_worth: HALF_WORTH,
        }
    }
}
