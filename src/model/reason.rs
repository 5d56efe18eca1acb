//! Method 5.5: the reasons why a pair, a view or a triangle gets less than it could.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// One reason of a fixed list.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Reason {
    /// Too few sparse points in common with any other view.
    NoSharedPoints,
    /// No baseline: the other views stand at the same place.
    RotationOnly,
    /// A chosen key view does nearly all that this one could.
    DuplicateOfBetterView,
    /// Not enough cameras of a cluster see it.
    TooFewCameras,
    /// The view sees nothing of the surface.
    Hidden,
    /// No view is near enough for the wanted resolution.
    TooCoarse,
    /// The rays meet at angles too small for the wanted accuracy.
    TooInaccurate,
    /// The backend cannot match the pairs that there are.
    NotMatchable,
    /// What it would add is nothing, or less than what was taken.
    NoGainLeft,
}

impl Reason {
    /// In words that follow "because".
    pub fn words(self) -> &'static str {
        match self {
            Self::NoSharedPoints => "it has too few sparse points in common with any other view",
            Self::RotationOnly => "there is no baseline: the other views stand at the same place",
            Self::DuplicateOfBetterView => "a chosen key view does nearly all that it could",
            Self::TooFewCameras => "not enough cameras of a view cluster see the same places",
            Self::Hidden => "it sees nothing of the surface",
            Self::TooCoarse => "no view is near enough for the wanted resolution",
            Self::TooInaccurate => "the rays meet at angles too small for the wanted accuracy",
            Self::NotMatchable => "the backend cannot match the pairs that there are",
            Self::NoGainLeft => "what it would add is nothing, or less than what was taken",
        }
    }
}
