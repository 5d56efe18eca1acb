//! Method 7: where will the backend succeed?
//!
//! Two kinds of knowledge meet in p_i(t), the chance that the pair (key view, partner i) measures triangle t: the picture (unary
//! confidence per view and triangle, from a [`Predictor`]) and the constellation ([`PairConfidence`], which needs no image).

mod geometric;
mod nearby;
pub mod trees;

pub use geometric::{Constellation, PairConfidence};
pub use nearby::nearby;

use crate::{
    config::{ConfidenceForm, ConfidenceSettings},
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

/// Where confidence comes from (`confidence.source`).
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Source {
    /// f_conf = 1: the paper's NoCP.
    None,
    /// The constellation and the sparse points around (method 7.2).
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
    /// Matches that must succeed; 0: none, f_conf is 1.
    pub fn min_matches(&self) -> u32 {
        match self {
            Self::None => 0,
            Self::Pair(numbers) => numbers.min_matches,
            Self::Paper { min_matches } => *min_matches,
        }
    }

    /// p_i of a partner that sees the triangle, from its constellation with the key view and the mean of the two unary confidences.
    pub fn pair(&self, constellation: &Constellation, unary: f64) -> f64 {
        match self {
            Self::None => 1.0,
            Self::Pair(numbers) => numbers.confidence(constellation) * unary,
            Self::Paper { .. } => unary,
        }
    }

    /// f_conf of method 3.4: the chance that at least [`Confidence::min_matches`] of independent matches succeed.
    ///
    /// `at_least[m]` is that chance for m among the matches so far. One more match of chance p turns "exactly m - 1" into m; adding
    /// to the chance of at least m, never taking the difference from 1, keeps small chances exact.
    pub fn at_least(&self, matches: impl Iterator<Item = f64>) -> f64 {
        let mut at_least = [1.0, 0.0, 0.0, 0.0];
        for p in matches {
            for m in (1..4).rev() {
                at_least[m] += p * (at_least[m - 1] - at_least[m]);
            }
        }
        at_least[self.min_matches().min(3) as usize]
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

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// The paper's alternating sum over the elementary symmetric polynomials.
    fn alternating_sum(p: &[f64]) -> f64 {
        let mut e = vec![0.0; p.len() + 1];
        e[0] = 1.0;
        for &p in p {
            for i in (1..e.len()).rev() {
                e[i] += p * e[i - 1];
            }
        }
        (2..e.len()).map(|i| (i as f64 - 1.0) * if i % 2 == 0 { e[i] } else { -e[i] }).sum()
    }

    /// By going through all outcomes.
    fn by_outcomes(p: &[f64], least: u32) -> f64 {
        let chance = |outcome: u32| {
            let one = |(i, &p): (usize, &f64)| if outcome >> i & 1 == 1 { p } else { 1.0 - p };
            p.iter().enumerate().map(one).product::<f64>()
        };
        (0..1u32 << p.len()).filter(|o| o.count_ones() >= least).map(chance).sum()
    }

    proptest! {
        #[test]
        fn two_matches_are_the_papers_sum(p in proptest::collection::vec(0.0..=1.0f64, 0..=12)) {
            let ours = Confidence::Paper { min_matches: 2 }.at_least(p.iter().copied());
            prop_assert!((ours - alternating_sum(&p)).abs() < 1e-9, "{} {}", ours, alternating_sum(&p));
        }

        #[test]
        fn is_the_chance_of_enough_matches(p in proptest::collection::vec(0.0..=1.0f64, 0..=10), least in 1u32..=3) {
            let ours = Confidence::Paper { min_matches: least }.at_least(p.iter().copied());
            let expected = by_outcomes(&p, least);
            prop_assert!((ours - expected).abs() <= 1e-12 + 1e-9 * expected, "{ours} {expected}");
        }
    }

    #[test]
    fn without_confidence_everything_succeeds() {
        assert_eq!(Confidence::None.at_least([].into_iter()), 1.0);
    }
}
