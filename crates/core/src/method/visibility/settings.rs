//! Options of visibility.

use serde::{Deserialize, Serialize};

/// Method 2.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct VisibilitySettings {
    /// Largest angle between a triangle's normal and the direction to the camera, degrees. A higher
    /// value admits more oblique views.
    #[cfg_attr(feature = "schema", schemars(range(max = 90), extend("unit" = "degrees", "exclusiveMinimum" = 0)))]
    pub max_incidence_deg: f64,
    /// Share of a triangle's samples that must be unoccluded. A higher value counts fewer views as
    /// seeing it.
    #[cfg_attr(feature = "schema", schemars(range(min = 0, max = 1)))]
    pub min_free_share: f64,
    /// Tolerance in front of a triangle, in units of `surface.edge_factor` x g_d. A higher value
    /// counts fewer triangles as occluded.
    #[cfg_attr(feature = "schema", schemars(range(min = 0), extend("unit" = "edge_factor x g_d")))]
    pub tolerance_edges: f64,
    /// Tolerance in front of a triangle, share of the depth; the larger of the two counts. A higher
    /// value counts fewer triangles as occluded.
    #[cfg_attr(feature = "schema", schemars(range(min = 0), extend("unit" = "of the depth")))]
    pub tolerance_depth: f64,
    /// Long side of the id buffer, pixels. A higher value resolves smaller occlusions and takes
    /// longer.
    #[cfg_attr(feature = "schema", schemars(range(min = 16, max = 4096), extend("unit" = "px")))]
    pub buffer_px: u32,
}

impl Default for VisibilitySettings {
    fn default() -> Self {
        Self {
            max_incidence_deg: 85.0,
            min_free_share: 0.5,
            tolerance_edges: 0.1,
            tolerance_depth: 0.005,
            buffer_px: 700,
        }
    }
}
