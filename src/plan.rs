//! The one function that runs the stages of the method, and what comes out of it.

use crate::{
    confidence::Unary,
    config::Settings,
    fulfilment::{FulfilmentTable, Target},
    partners::{Candidates, ViewCluster},
    ranking::Ranking,
    scene::Scene,
    surface::Surface,
    visibility::Visibility,
};

/// Why a view is not taken, a key view has few partners, or a triangle has no fulfilment (method 5.5).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, serde::Serialize, schemars::JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Reason {
    NoSharedPoints,
    RotationOnly,
    DuplicateOfBetterView,
    TooFewCameras,
    Hidden,
    TooCoarse,
    TooInaccurate,
    NotMatchable,
    NoGainLeft,
}

/// What becomes of a registered view.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, schemars::JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum ViewStatus {
    Key,
    Partner,
    Unused,
}

/// How much of the ranking is to be computed (method 5.3).
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Cut {
    pub clusters: usize,
    pub pairs: usize,
    pub share: f64,
    pub fulfilment: f64,
}

/// Everything that a plan consists of: the value of each stage.
#[derive(Clone, Debug)]
pub struct Plan {
    /// All settings in force; what was chosen from the data or by the backend is filled in.
    pub settings: Settings,
    /// Name of the backend that the plan is made for.
    pub backend: &'static str,
    pub scene: Scene,
    pub surface: Surface,
    pub visibility: Visibility,
    /// Unary confidence of each row of `visibility`.
    pub unary: Unary,
    /// g_d and a_d of each triangle (method 3.6).
    pub target: Target,
    pub candidates: Candidates,
    /// One per view that can be a key view, in the order of views.
    pub clusters: Vec<ViewCluster>,
    pub fulfilment: FulfilmentTable,
    pub ranking: Ranking,
    pub cut: Cut,
    /// Status and reason of each view.
    pub views: Vec<(ViewStatus, Option<Reason>)>,
    /// Reason of each triangle that no cluster fulfils.
    pub triangle_reasons: Vec<Option<Reason>>,
    pub warnings: Vec<String>,
}

impl Plan {
    /// The clusters to compute, best first.
    pub fn chosen(&self) -> impl ExactSizeIterator<Item = &ViewCluster> {
        self.ranking.order[..self.cut.clusters].iter().map(|&c| &self.clusters[c as usize])
    }
}
