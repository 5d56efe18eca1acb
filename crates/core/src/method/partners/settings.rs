//! Options of the choice of partners.

use serde::{Deserialize, Serialize};

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "lowercase")]
pub enum PartnerMethod {
    /// The paper's random combinations.
    Sampled,
    /// Local search by exchange, from the better of `sampled` and greedy addition.
    #[default]
    Search,
}

/// Method 4.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct PartnerSettings {
    /// Partners per key view (k). A higher value matches more pairs per depth map.
    #[cfg_attr(feature = "schema", schemars(range(min = 1), extend("unit" = "partners")))]
    pub k: u32,
    /// Candidates per key view, by shared points (n). A higher value offers more choice and takes
    /// longer.
    #[cfg_attr(feature = "schema", schemars(range(min = 1), extend("unit" = "views")))]
    pub candidates: u32,
    /// Random combinations per key view (y). A higher value takes longer.
    #[cfg_attr(feature = "schema", schemars(range(min = 1, max = 100_000), extend("unit" = "combinations")))]
    pub draws: u32,
    /// Every z-th triangle rates the combinations (z). A higher value is faster and less exact.
    #[cfg_attr(feature = "schema", schemars(range(min = 1), extend("unit" = "triangles")))]
    pub triangle_fraction: u32,
    /// Choice of partners: the paper's random combinations ("sampled"), or local search that starts
    /// from the best of them ("search").
    pub method: PartnerMethod,
    pub gate: GateSettings,
}

impl Default for PartnerSettings {
    fn default() -> Self {
        Self {
            k: 5,
            candidates: 22,
            draws: 100,
            triangle_fraction: 10,
            method: PartnerMethod::Search,
            gate: GateSettings::default(),
        }
    }
}

/// Method 7.1: pairs beyond these limits are partners only where others are missing. Unset numbers
/// are the backend's.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct GateSettings {
    /// Least number of sparse points that both views observe. A higher value refuses weakly
    /// connected pairs. Unset: the backend's.
    #[cfg_attr(feature = "schema", schemars(range(min = 1), extend("unit" = "points")))]
    pub min_shared_points: Option<u32>,
    /// Least median triangulation angle at the shared points, degrees. A higher value refuses short
    /// baselines. Unset: the backend's.
    #[cfg_attr(feature = "schema", schemars(range(min = 0, max = 180), extend("unit" = "degrees")))]
    pub min_angle: Option<f64>,
    /// Largest median triangulation angle, degrees. A higher value admits wider baselines. Unset:
    /// the backend's.
    #[cfg_attr(feature = "schema", schemars(range(min = 0, max = 180), extend("unit" = "degrees")))]
    pub max_angle: Option<f64>,
    /// Largest median ratio of the two images' scales, octaves. A higher value admits pairs of
    /// different scale. Unset: the backend's.
    #[cfg_attr(feature = "schema", schemars(range(min = 0), extend("unit" = "octaves")))]
    pub max_scale_octaves: Option<f64>,
    /// True if the centre of one camera may project into the image of the other. Unset: the
    /// backend's.
    pub epipole_inside: Option<bool>,
}
