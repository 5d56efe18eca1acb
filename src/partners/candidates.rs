//! The candidates of each key view, and why the other views that share points with it are none.

use crate::{
    backends::Backend,
    config::PartnerSettings,
    plan::Reason,
    progress::{Cancelled, Watcher},
    scene::{PointIndex, Scene, ViewIndex, ViewPoints},
};

/// How two views stand to each other: what a backend needs to say whether it can match them (method 7.1).
#[derive(Clone, Copy)]
pub struct PairGeometry<'a> {
    pub scene: &'a Scene,
    pub key: ViewIndex,
    pub partner: ViewIndex,
    /// Sparse points that both observe, ascending, each once.
    pub shared: &'a [PointIndex],
    /// Median triangulation angle at the shared points, degrees.
    pub angle_deg: f64,
    /// Share of the shared points with an angle below 0.5 degrees.
    pub still_share: f64,
    /// Median over the shared points of the partner's scale over the key view's, octaves; positive: the partner is finer.
    pub scale_octaves: f64,
    /// Does the line through the two centres meet one of the images?
    pub epipole_inside: bool,
}

/// A pair of views with shared points that is no candidate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Refusal {
    pub partner: ViewIndex,
    pub reason: Reason,
}

/// The candidates of every view, best first, CSR by view; only pairs that the backend can match.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Candidates {
    /// Views + 1 entries.
    pub offsets: Vec<usize>,
    pub views: Vec<ViewIndex>,
    /// Views + 1 entries.
    pub refusal_offsets: Vec<usize>,
    /// Pairs with shared points that were refused, most shared points first, CSR by view.
    pub refusals: Vec<Refusal>,
}

impl Candidates {
    pub fn of(&self, view: ViewIndex) -> &[ViewIndex] {
        &self.views[self.offsets[view.at()]..self.offsets[view.at() + 1]]
    }

    /// Why other views that share points with this one are no candidates.
    pub fn refused(&self, view: ViewIndex) -> &[Refusal] {
        &self.refusals[self.refusal_offsets[view.at()]..self.refusal_offsets[view.at() + 1]]
    }
}

/// The n views with the most shared points of those that have a baseline and that the backend can match, ties by name.
pub fn candidates(
    scene: &Scene,
    points: &ViewPoints,
    settings: &PartnerSettings,
    backend: &dyn Backend,
    watcher: &dyn Watcher,
) -> Result<Candidates, Cancelled> {
    let _ = (points, settings, backend, watcher);
    let offsets = vec![0; scene.views.len() + 1];
    Ok(Candidates { refusal_offsets: offsets.clone(), offsets, ..Default::default() })
}
