//! The reasons why a pair, a view or a triangle gets less fulfilment than it could (method 5.5).

use serde::{Deserialize, Serialize};

/// The reason for a missing or reduced fulfilment.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum Reason {
    /// It shares too few sparse points with every other view.
    NoSharedPoints,
    /// There is no baseline: the other views are at the same position.
    RotationOnly,
    /// A chosen key view fulfils nearly everything that this one could.
    DuplicateOfBetterView,
    /// Too few cameras of a cluster see it.
    TooFewCameras,
    /// The view sees no part of the surface.
    Hidden,
    /// No view is close enough for the target resolution.
    TooCoarse,
    /// The triangulation angles are too small for the target accuracy.
    TooInaccurate,
    /// The backend cannot match the available pairs: f_conf is the smallest factor, or the gate
    /// (method 7.1) refuses them.
    NotMatchable,
    /// Its gain is 0 or below the cut.
    NoGainLeft,
    /// All that it could give is outside the region.
    OutsideRegion,
    /// Its image is not there, or cannot be read.
    NoImage,
    /// Another view shows the same from the same place, and sharper.
    TwinOfSharperView,
    /// It is kept apart for tests (`test_every`).
    KeptForTests,
}

impl Reason {
    /// The reasons in the order of their numbers in files, from 1; 0 stands for no reason.
    pub const NUMBERED: [Self; 13] = [
        Self::NoSharedPoints,
        Self::RotationOnly,
        Self::DuplicateOfBetterView,
        Self::TooFewCameras,
        Self::Hidden,
        Self::TooCoarse,
        Self::TooInaccurate,
        Self::NotMatchable,
        Self::NoGainLeft,
        Self::OutsideRegion,
        Self::NoImage,
        Self::TwinOfSharperView,
        Self::KeptForTests,
    ];

    /// Returns the number of a reason, from 1; 0 for `None`.
    pub fn number(reason: Option<Self>) -> u8 {
        let position = reason.and_then(|reason| {
            Self::NUMBERED
                .iter()
                .position(|&numbered| numbered == reason)
        });
        position.map_or(0, |i| i as u8 + 1)
    }

    /// Returns the reason with this [`Self::number`], `Some(None)` for 0, `None` for a number of no
    /// reason.
    pub fn from_number(number: u8) -> Option<Option<Self>> {
        match number.checked_sub(1) {
            None => Some(None),
            Some(i) => Self::NUMBERED.get(i as usize).copied().map(Some),
        }
    }

    /// A clause that follows "because".
    pub fn describe(self) -> &'static str {
        match self {
            Self::NoSharedPoints => "it shares too few sparse points with every other view",
            Self::RotationOnly => "there is no baseline: the other views are at the same position",
            Self::DuplicateOfBetterView => "a chosen image gives nearly everything that it could",
            Self::TooFewCameras => "too few cameras of a view cluster see the same places",
            Self::Hidden => "it sees no part of the surface",
            Self::TooCoarse => "no view is close enough for the target resolution",
            Self::TooInaccurate => "the triangulation angles are too small for the target accuracy",
            Self::NotMatchable => "the backend cannot match the available pairs",
            Self::OutsideRegion => "all that it could give is outside the region",
            Self::NoImage => "its image is missing, cannot be read or is not of this view",
            Self::TwinOfSharperView => "a sharper view shows the same from the same place",
            Self::KeptForTests => "it is kept apart for tests",
            Self::NoGainLeft => "its gain is zero or below the cut",
        }
    }
}

#[cfg(all(test, feature = "schema"))]
mod tests {
    use super::*;

    #[test]
    fn every_reason_has_a_number() {
        let schema = serde_json::to_value(schemars::schema_for!(Reason)).unwrap();
        assert_eq!(
            schema["oneOf"].as_array().unwrap().len(),
            Reason::NUMBERED.len()
        );
        let reasons = Reason::NUMBERED.map(Some).into_iter().chain([None]);
        assert!(
            reasons
                .clone()
                .all(|reason| Reason::from_number(Reason::number(reason)) == Some(reason))
        );
        assert_eq!(Reason::from_number(reasons.count() as u8), None);
    }
}
