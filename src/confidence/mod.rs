//! Method 7: where will the backend succeed?
//!
//! Two kinds of knowledge meet in p_i(t), the chance that the pair (key view, partner i) measures triangle t: the picture (unary
//! confidence per view and triangle, from a [`Predictor`]) and the constellation ([`PairConfidence`], which needs no image).

use crate::scene::ViewIndex;

/// A reduced picture: RGB, 8 bit, row-major.
#[derive(Clone, Debug)]
pub struct Image {
    pub width: u32,
    pub height: u32,
    /// 3 x width x height bytes.
    pub rgb: Vec<u8>,
}

/// Probability per pixel that the backend reconstructs it, on a grid that covers the image.
#[derive(Clone, Debug)]
pub struct ConfidenceMap {
    pub width: u32,
    pub height: u32,
    /// Row-major, 0 to 1.
    pub values: Vec<f32>,
}

/// Predicts unary confidence from a picture (method 7.3).
pub trait Predictor: Sync {
    fn confidence(&self, view: ViewIndex, image: Option<&Image>) -> Result<ConfidenceMap, ConfidenceError>;
}

#[derive(Debug, thiserror::Error)]
pub enum ConfidenceError {
    #[error("no confidence for view {0}: {1}")]
    Image(String, String),
}

/// The numbers of the geometric confidence (method 7.2); each backend has its own.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct PairConfidence {
    /// Matches that must succeed for a pixel (method 3.4), 1 to 3.
    pub min_matches: u32,
    pub p0: f64,
    /// Power of the smaller cosine of incidence (gamma).
    pub cosine_power: f64,
    /// Standard deviation of the scale ratio in octaves (s); `None`: scale does no harm.
    pub scale_octaves: Option<f64>,
    /// Triangulation angle from which a match is as good as any, degrees (a); `None`: any angle.
    pub full_angle_deg: Option<f64>,
}
