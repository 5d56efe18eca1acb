//! Options of coverage and fulfilment.

use serde::{Deserialize, Serialize};

/// Method 3.1.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct CoverageSettings {
    /// Cameras that must see a triangle, the key view included (x). A higher value demands more
    /// overlap. With k = 1: 2.
    #[cfg_attr(feature = "schema", schemars(range(min = 2), extend("unit" = "cameras")))]
    pub min_cameras: u32,
}

impl Default for CoverageSettings {
    fn default() -> Self {
        Self { min_cameras: 3 }
    }
}

/// Method 3.2 to 3.5.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct FulfilmentSettings {
    /// Weight of resolution against uncertainty, 0 to 1 (alpha). A higher value counts resolution
    /// more.
    #[cfg_attr(feature = "schema", schemars(range(min = 0, max = 1)))]
    pub alpha: f64,
    /// Standard deviation of a match, pixels of the matched image (sigma_px). A higher value
    /// predicts less accurate points.
    #[cfg_attr(feature = "schema", schemars(extend("unit" = "px", "exclusiveMinimum" = 0)))]
    pub sigma_px: f64,
}

impl Default for FulfilmentSettings {
    fn default() -> Self {
        Self {
            alpha: 0.5,
            sigma_px: 0.5,
        }
    }
}
