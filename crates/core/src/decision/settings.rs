//! Options of the cut and of the forecast.

use serde::{Deserialize, Serialize};

use crate::base::amounts::{Budget, Count, Share, TimeSpan};

/// Method 5.3; the first limit reached ends the plan. All unset: a target of 90 %.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct CutSettings {
    /// Clusters ("40"), or a share of the registered views ("5%").
    pub budget: Option<Budget>,
    /// Share of what all clusters together reach ("80%").
    pub target: Option<Share>,
    /// Forecast time of matching ("2h", "90min", "1d6h").
    pub time: Option<TimeSpan>,
    /// Forecast points of all depth maps ("50M").
    pub points: Option<Count>,
}

impl CutSettings {
    /// Number of limits that are set.
    pub fn limits(&self) -> usize {
        [
            self.budget.is_some(),
            self.target.is_some(),
            self.time.is_some(),
            self.points.is_some(),
        ]
        .into_iter()
        .filter(|is_set| *is_set)
        .count()
    }
}

/// Inputs to the forecast of time and points; unset where unknown.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct ForecastSettings {
    /// Seconds of matching per (key view, partner) pair.
    #[cfg_attr(feature = "schema", schemars(range(min = 0), extend("unit" = "s")))]
    pub seconds_per_pair: Option<f64>,
    /// Seconds of matching per depth map, in addition to its pairs.
    #[cfg_attr(feature = "schema", schemars(range(min = 0), extend("unit" = "s")))]
    pub seconds_per_map: Option<f64>,
    /// Points of a depth map before fusion. Unset: the predicted number of measured pixels.
    #[cfg_attr(feature = "schema", schemars(extend("unit" = "points", "exclusiveMinimum" = 0)))]
    pub points_per_map: Option<f64>,
}

impl ForecastSettings {
    /// Returns whether matching times can be forecast.
    pub fn knows_times(&self) -> bool {
        self.seconds_per_map.is_some() || self.seconds_per_pair.is_some()
    }
}
