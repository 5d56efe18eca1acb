//! View clusters: a key view with the views that it is matched against, and which pairs of views may be matched at all.

use serde::Serialize;

use super::scene::ViewIndex;

/// A key view with its matching partners, best first.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ViewCluster {
    pub key: ViewIndex,
    pub partners: Vec<ViewIndex>,
}

/// A view cluster with its place in the ranking.
#[derive(Clone, Debug, PartialEq)]
pub struct RankedCluster {
    pub key: ViewIndex,
    /// Best first.
    pub partners: Vec<ViewIndex>,
    /// Fulfilment up to and including this cluster, as a share of what all clusters reach together, 0 to 1.
    pub share: f64,
}

/// Which pairs a backend can match at all (method 7.1).
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Gate {
    /// Sparse points that both views observe.
    pub min_shared_points: usize,
    /// Median triangulation angle at the shared points, degrees.
    pub min_angle_deg: f64,
    pub max_angle_deg: f64,
    /// Largest scale ratio of the two images, octaves.
    pub max_scale_octaves: f64,
    /// Whether one camera's centre may be inside the other's image.
    pub epipole_inside: bool,
}

impl Gate {
    /// Lets every pair pass that shares points.
    pub const OPEN: Gate = Gate {
        min_shared_points: 1,
        min_angle_deg: 0.0,
        max_angle_deg: 180.0,
        max_scale_octaves: f64::INFINITY,
        epipole_inside: true,
    };
}
