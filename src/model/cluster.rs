//! View clusters (a key view with the views that it is matched against) and the limits on pairs of views.

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
    /// Fulfilment of the ranking up to and including this cluster, as a share of the fulfilment of all clusters, 0 to 1.
    pub share: f64,
}

/// Limits on the pairs of views that a backend can match (method 7.1).
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Gate {
    /// Least number of sparse points that both views observe.
    pub min_shared_points: usize,
    /// Least median triangulation angle at the shared points, degrees.
    pub min_angle_deg: f64,
    /// Largest median triangulation angle, degrees.
    pub max_angle_deg: f64,
    /// Largest scale ratio of the two images, octaves (log2).
    pub max_scale_octaves: f64,
    /// True if the centre of one camera may project into the image of the other.
    pub epipole_inside: bool,
}

impl Gate {
    /// Admits every pair with a shared point.
    pub const OPEN: Gate = Gate {
        min_shared_points: 1,
        min_angle_deg: 0.0,
        max_angle_deg: 180.0,
        max_scale_octaves: f64::INFINITY,
        epipole_inside: true,
    };
}
