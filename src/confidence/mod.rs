//! Method 7: where will the backend succeed?
//!
//! Two kinds of knowledge meet in p_i(t), the chance that the pair (key view, partner i) measures triangle t: the picture (unary
//! confidence per view and triangle, from a [`Predictor`]) and the constellation ([`PairConfidence`], which needs no image).

pub mod trees;

use crate::{
    config::{ConfidenceForm, ConfidenceSettings},
    fulfilment::Look,
    scene::ViewIndex,
};

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

impl PairConfidence {
    /// These numbers with those that the user set in their place.
    pub fn with(&self, settings: &ConfidenceSettings) -> Self {
        let unless_zero = |set: Option<f64>, own: Option<f64>| match set {
            Some(0.0) => None,
            Some(value) => Some(value),
            None => own,
        };
        Self {
            min_matches: settings.min_matches.unwrap_or(self.min_matches),
            p0: settings.p0.unwrap_or(self.p0),
            cosine_power: settings.cosine_power.unwrap_or(self.cosine_power),
            scale_octaves: unless_zero(settings.scale_octaves, self.scale_octaves),
            full_angle_deg: unless_zero(settings.full_angle, self.full_angle_deg),
        }
    }
}

impl PairConfidence {
    /// p₀ · min(cos θ_key, cos θ_i)^γ · exp(−½ (log2(l_i / l_key) / s)²) · min(angle / a, 1).
    pub fn probability(&self, key: &Look, partner: &Look) -> f64 {
        let incidence = key.cos_incidence.min(partner.cos_incidence).powf(self.cosine_power);
        let scale = self.scale_octaves.map_or(1.0, |s| {
            let octaves = (partner.distance / key.distance).log2() / s;
            (-0.5 * octaves * octaves).exp()
        });
        let angle = self.full_angle_deg.map_or(1.0, |full| {
            let degrees = key.direction.dot(&partner.direction).clamp(-1.0, 1.0).acos().to_degrees();
            (degrees / full).min(1.0)
        });
        self.p0 * incidence * scale * angle
    }
}

/// Where confidence comes from (`confidence.source`).
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Source {
    /// f_conf = 1: the paper's NoCP.
    None,
    /// The constellation alone (method 7.2).
    Geometric,
    /// The constellation and a training-free look at the picture (method 7.3).
    Proxy,
    /// A trained model file.
    Model(std::path::PathBuf),
}

impl Source {
    /// `auto` is `geometric`.
    pub fn new(source: &str) -> Self {
        match source {
            "none" => Self::None,
            "geometric" | "auto" => Self::Geometric,
            "proxy" => Self::Proxy,
            file => Self::Model(file.into()),
        }
    }

    /// Does it look at pictures?
    pub fn needs_images(&self) -> bool {
        matches!(self, Self::Proxy | Self::Model(_))
    }
}

impl std::fmt::Display for Source {
    /// As it is typed.
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        match self {
            Self::None => write!(f, "none"),
            Self::Geometric => write!(f, "geometric"),
            Self::Proxy => write!(f, "proxy"),
            Self::Model(path) => write!(f, "{}", path.display()),
        }
    }
}

/// What p_i of method 3.4 is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Confidence {
    /// f_conf = 1 wherever f_cov = 1.
    None,
    /// Method 7.2 times the mean of the two unary confidences.
    Pair(PairConfidence),
    /// The mean of the two unary confidences.
    Paper { min_matches: u32 },
}

impl Confidence {
    /// `numbers`: the backend's.
    pub fn new(source: &Source, settings: &ConfidenceSettings, numbers: &PairConfidence) -> Self {
        let numbers = numbers.with(settings);
        match (source, settings.form) {
            (Source::None, _) => Self::None,
            (Source::Proxy | Source::Model(_), ConfidenceForm::Paper) => {
                Self::Paper { min_matches: numbers.min_matches }
            }
            _ => Self::Pair(numbers),
        }
    }
}

impl Confidence {
    /// Matches that must succeed for a pixel; `None`: success is certain.
    pub fn min_matches(&self) -> Option<u32> {
        match self {
            Self::None => None,
            Self::Pair(numbers) => Some(numbers.min_matches),
            Self::Paper { min_matches } => Some(*min_matches),
        }
    }

    /// p_i(t): the chance that the key view and a partner that both see the triangle match there (method 3.4, 7.2).
    pub fn pair(&self, key: &Look, partner: &Look) -> f64 {
        let unary = 0.5 * (key.unary + partner.unary);
        match self {
            Self::None => 1.0,
            Self::Pair(numbers) => numbers.probability(key, partner) * unary,
            Self::Paper { .. } => unary,
        }
    }
}

/// Unary confidence of each row of the visibility table.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Unary {
    /// 0 to 1; empty: 1 everywhere.
    pub values: Vec<f32>,
}

impl Unary {
    /// 1 everywhere: no picture was looked at.
    pub fn certain() -> Self {
        Self::default()
    }

    pub fn at(&self, row: usize) -> f32 {
        if self.values.is_empty() { 1.0 } else { self.values[row] }
    }
}
