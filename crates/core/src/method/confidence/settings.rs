//! Options of confidence.

use std::fmt;

use serde::{Deserialize, Serialize};

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "lowercase")]
pub enum ConfidenceSource {
    /// `photometric` where there are images, else `geometric`.
    #[default]
    Auto,
    /// Agreement of the pictures on the surface (method 7.4).
    Photometric,
    /// Angles and scales of the pair, and the sparse points around; needs no image (method 7.2).
    Geometric,
    /// Every match succeeds: the paper's NoCP.
    None,
}

impl fmt::Display for ConfidenceSource {
    /// As in the settings.
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            Self::Auto => "auto",
            Self::Photometric => "photometric",
            Self::Geometric => "geometric",
            Self::None => "none",
        })
    }
}

impl ConfidenceSource {
    /// Resolves `auto`.
    pub fn in_force(self, has_images: bool) -> Self {
        match self {
            Self::Auto if has_images => Self::Photometric,
            Self::Auto => Self::Geometric,
            source => source,
        }
    }
}

/// Method 7. Unset numbers are the backend's; in a manifest, numbers that the source of confidence
/// does not use are unset.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct ConfidenceSettings {
    /// What predicts success.
    pub source: ConfidenceSource,
    /// Probability of a match in the best constellation. A higher value expects more matches to
    /// succeed.
    #[cfg_attr(feature = "schema", schemars(range(max = 1), extend("exclusiveMinimum" = 0)))]
    pub p0: Option<f64>,
    /// Power of the cosine of incidence (gamma). A higher value penalises oblique views more.
    #[cfg_attr(feature = "schema", schemars(range(min = 0)))]
    pub cosine_power: Option<f64>,
    /// Standard deviation of the scale ratio, octaves (s). A higher value tolerates larger
    /// differences of scale; 0: scale is ignored.
    #[cfg_attr(feature = "schema", schemars(range(min = 0), extend("unit" = "octaves")))]
    pub scale_octaves: Option<f64>,
    /// Triangulation angle from which a match has full confidence, degrees (a). A higher value
    /// penalises short baselines more; 0: no penalty.
    #[cfg_attr(feature = "schema", schemars(range(min = 0, max = 180), extend("unit" = "degrees")))]
    pub full_angle: Option<f64>,
    /// Chance of a match where the two pictures agree on the surface. A higher value expects more
    /// of each pair.
    #[cfg_attr(feature = "schema", schemars(range(max = 1), extend("exclusiveMinimum" = 0)))]
    pub agree: Option<f64>,
    /// Chance of a match where they don't. A higher value trusts the pictures less; at most
    /// `agree`.
    #[cfg_attr(feature = "schema", schemars(range(min = 0, max = 1)))]
    pub differ: Option<f64>,
    /// Correlation of the two pictures from which they count as in full agreement. A higher value
    /// asks for more alike pictures.
    #[cfg_attr(feature = "schema", schemars(range(max = 1), extend("exclusiveMinimum" = 0)))]
    pub full_agreement: Option<f64>,
    /// Matches that must succeed for a pixel, 1 to 3. A higher value is stricter.
    #[cfg_attr(feature = "schema", schemars(range(min = 1, max = 3), extend("unit" = "matches")))]
    pub min_matches: Option<u32>,
}
