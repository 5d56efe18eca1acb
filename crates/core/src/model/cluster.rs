//! View clusters (a key view with the views that it is matched against) and the limits on pairs of
//! views.

use std::iter;

use nalgebra::Point3;
use serde::{Deserialize, Serialize};

use super::scene::ViewIndex;

/// A key view with its matching partners, best first.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ViewCluster {
    pub key: ViewIndex,
    pub partners: Vec<ViewIndex>,
}

impl ViewCluster {
    /// Returns the key view, then the partners.
    pub fn views(&self) -> impl Iterator<Item = ViewIndex> {
        iter::once(self.key).chain(self.partners.iter().copied())
    }
}

/// Size at which a depth map is matched, over the size that the plan matches images at.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(try_from = "f64", into = "f64")]
#[cfg_attr(feature = "schema", schemars(with = "f64", extend("enum" = [1.0, 0.5])))]
pub enum MapScale {
    #[default]
    Full,
    Half,
}

impl MapScale {
    /// 1 or 0.5.
    pub fn factor(self) -> f64 {
        match self {
            Self::Full => 1.0,
            Self::Half => 0.5,
        }
    }
}

impl From<MapScale> for f64 {
    fn from(scale: MapScale) -> Self {
        scale.factor()
    }
}

impl TryFrom<f64> for MapScale {
    type Error = String;

    fn try_from(factor: f64) -> Result<Self, String> {
        [Self::Full, Self::Half]
            .into_iter()
            .find(|scale| scale.factor() == factor)
            .ok_or_else(|| format!("{factor} must be 1 or 0.5"))
    }
}

/// A view cluster with its place in the ranking.
#[derive(Clone, Debug, PartialEq)]
pub struct RankedCluster {
    pub key: ViewIndex,
    /// Best first.
    pub partners: Vec<ViewIndex>,
    pub scale: MapScale,
    /// Fulfilment of the ranking up to and including this cluster, as a share of the fulfilment of
    /// all clusters, 0 to 1.
    pub share: f64,
}

impl RankedCluster {
    /// Returns the key view, then the partners.
    pub fn views(&self) -> impl Iterator<Item = ViewIndex> {
        iter::once(self.key).chain(self.partners.iter().copied())
    }
}

/// What a program can match of a pair of views, by its own rule (method 7.1).
pub enum Reach {
    /// It refuses the pair.
    Nothing,
    Everything,
    /// The points of the scene for which this is true.
    Part(Box<IsReached>),
}

/// True for points of the scene that a program can match.
pub type IsReached = dyn Fn(&Point3<f64>) -> bool + Send + Sync;

impl Reach {
    pub fn is_nothing(&self) -> bool {
        matches!(self, Self::Nothing)
    }

    /// Returns whether a point of the scene can be matched; it is computed only where that matters.
    pub fn includes(&self, point: impl FnOnce() -> Point3<f64>) -> bool {
        match self {
            Self::Nothing => false,
            Self::Everything => true,
            Self::Part(is_reached) => is_reached(&point()),
        }
    }
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
