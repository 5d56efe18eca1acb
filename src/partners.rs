//! Method 4: which matching partners each key view gets.

use crate::scene::ViewIndex;

/// A key view with its matching partners, best first.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ViewCluster {
    pub key: ViewIndex,
    pub partners: Vec<ViewIndex>,
}

/// How two views stand to each other: what a backend needs to say whether it can match them (method 7.1).
#[derive(Clone, Copy, Debug)]
pub struct PairGeometry {
    pub key: ViewIndex,
    pub partner: ViewIndex,
    /// Sparse points that both observe.
    pub shared_points: u32,
    /// Median triangulation angle at the shared points, degrees.
    pub angle_deg: f64,
    /// Share of the shared points with an angle below 0.5 degrees.
    pub still_share: f64,
    /// Median over the shared points of the partner's scale over the key view's, octaves; positive: the partner is finer.
    pub scale_octaves: f64,
    /// Is the partner's centre seen inside the key view's image, or the key view's inside the partner's?
    pub epipole_inside: bool,
}

/// The candidates of every view, best first, CSR by view; only pairs that the backend can match.
#[derive(Clone, Debug, Default)]
pub struct Candidates {
    /// Views + 1 entries.
    pub offsets: Vec<usize>,
    pub views: Vec<ViewIndex>,
}

impl Candidates {
    pub fn of(&self, view: ViewIndex) -> &[ViewIndex] {
        &self.views[self.offsets[view.at()]..self.offsets[view.at() + 1]]
    }
}
