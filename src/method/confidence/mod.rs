//! Confidence (method 7): predicts where the backend will succeed.
//!
//! p_i(t), the probability that the pair (key view, partner i) measures triangle t, has two sources: the picture ([`Unary`]
//! confidence per view and triangle, from a [`Predictor`]) and the geometry of the pair ([`PairConfidence`], which needs no image).

mod cache;
pub mod curves;
pub mod features;
mod geometric;
pub mod image;
mod nearby;
pub mod photometric;
mod pictures;
pub mod place;
mod proxy;
pub mod trained;
pub mod trees;
mod unary;

pub use curves::PairCurves;
pub use geometric::{Constellation, PairConfidence};
pub use image::{Image, ImageError, Mask, size_for_confidence};
pub use nearby::nearby;
#[cfg(test)]
pub use photometric::NO_AGREEMENT;
pub use photometric::{AGREEMENT_CACHE, Agreement, PairAgreement, Photometric, ProgramReach};
pub use pictures::{CACHE, MASKS, PicturePredictions, Pictures};
pub use proxy::Proxy;
pub use trained::{TrainedError, TrainedModel, TrainedOn};
pub use unary::Unary;

use std::path::{Path, PathBuf};

use crate::{
    config::{ConfidenceForm, ConfidenceSettings},
    io::project::Project,
};

/// Probability that the backend reconstructs each cell of a grid that covers the image.
#[derive(Clone, Debug, PartialEq)]
pub struct ConfidenceMap {
    pub columns: u32,
    pub rows: u32,
    /// In 255ths, row by row: the format of the cache, so that a cached map gives the same plan.
    values: Vec<u8>,
}

impl ConfidenceMap {
    /// `values`: 0 to 1, row by row, one per cell of the grid (columns, rows).
    pub fn new(grid: [u32; 2], values: impl Iterator<Item = f32>) -> Self {
        let values: Vec<u8> = values.map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
        debug_assert_eq!(values.len(), grid[0] as usize * grid[1] as usize);
        Self { columns: grid[0], rows: grid[1], values }
    }

    /// Builds a map from the result of [`Self::bytes`]; `None` if the number of bytes is wrong.
    pub(crate) fn from_bytes(grid: [u32; 2], values: Vec<u8>) -> Option<Self> {
        let cells = u64::from(grid[0]) * u64::from(grid[1]);
        (cells > 0 && cells == values.len() as u64).then_some(Self { columns: grid[0], rows: grid[1], values })
    }

    pub(crate) fn bytes(&self) -> &[u8] {
        &self.values
    }

    /// Values row by row, 0 to 1.
    pub fn values(&self) -> impl ExactSizeIterator<Item = f32> {
        self.values.iter().map(|&v| f32::from(v) / 255.0)
    }

    /// Returns the value at a position given as shares of the image's width and height, in [0, 1).
    pub fn value_at(&self, x: f64, y: f64) -> f32 {
        let column = ((x * f64::from(self.columns)) as usize).min(self.columns as usize - 1);
        let row = ((y * f64::from(self.rows)) as usize).min(self.rows as usize - 1);
        self.cell(column, row)
    }

    pub fn cell(&self, column: usize, row: usize) -> f32 {
        f32::from(self.values[row * self.columns as usize + column]) / 255.0
    }

    /// Returns a map of 1 everywhere, on the grid of an image of the mask's size.
    fn certain(mask: &Mask) -> Self {
        let grid = features::grid(mask.width, mask.height);
        Self { columns: grid[0], rows: grid[1], values: vec![255; grid[0] as usize * grid[1] as usize] }
    }

    /// Scales the values by the share of each cell that the mask allows.
    fn masked(&self, mask: &Mask) -> Self {
        let grid = [self.columns, self.rows];
        let cells = (0..self.rows).flat_map(|row| (0..self.columns).map(move |column| (column, row)));
        let usable = cells.map(|(column, row)| mask.share(grid, column, row));
        Self::new(grid, self.values().zip(usable).map(|(value, usable)| value * usable))
    }
}

/// Output of a predictor for a picture.
#[derive(Clone, Debug, PartialEq)]
pub struct Prediction {
    pub map: ConfidenceMap,
    /// Dissimilarity to the pictures of the training set: 1 is the most dissimilar of them; 0 if the predictor was
    /// not trained.
    pub distance: f32,
}

/// Predicts unary confidence from a picture (method 7.3).
pub trait Predictor: Sync {
    /// Fingerprint of the predictor: equal for predictors that give the same result for every picture.
    fn fingerprint(&self) -> blake3::Hash;

    fn predict(&self, image: &Image) -> Prediction;
}

/// Source of confidence (`confidence.source`).
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Source {
    /// f_conf = 1: the paper's NoCP.
    None,
    /// The geometry of the pair and the surrounding sparse points (method 7.2).
    Geometric,
    /// Agreement of the pictures on the surface (method 7.4).
    Photometric,
    /// The geometry of the pair and an untrained measure of texture (method 7.3).
    Proxy,
    /// The model that comes with the program, trained on depth maps of `integrations/sgm`.
    Shipped,
    /// The model that was trained for the project: [`PROJECT_MODEL`].
    Project,
    /// A trained model file.
    Model(PathBuf),
}

/// Path of a project's own model, relative to the project.
pub const PROJECT_MODEL: &str = "viewrank/confidence.model";

impl Source {
    /// Resolves `auto`: the project's own model if there is one, else `photometric` if there are images, else `geometric`.
    pub fn new(source: &str, project: &Project) -> Self {
        match source {
            "none" => Self::None,
            "geometric" => Self::Geometric,
            "photometric" => Self::Photometric,
            "proxy" => Self::Proxy,
            "shipped" => Self::Shipped,
            "project" => Self::Project,
            "auto" if project.root.join(PROJECT_MODEL).is_file() => Self::Project,
            "auto" if project.images.is_some() => Self::Photometric,
            "auto" => Self::Geometric,
            file => Self::Model(file.into()),
        }
    }

    /// Returns the trained model of sources that have one.
    pub fn trained(&self, root: &Path) -> Result<Option<TrainedModel>, TrainedError> {
        match self {
            Self::None | Self::Geometric | Self::Photometric | Self::Proxy => Ok(None),
            Self::Shipped => TrainedModel::shipped().map(Some).ok_or(TrainedError::NotShipped),
            Self::Project => TrainedModel::read(&root.join(PROJECT_MODEL)).map(Some),
            Self::Model(path) => TrainedModel::read(path).map(Some),
        }
    }
}

impl std::fmt::Display for Source {
    /// Name as in the settings.
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        match self {
            Self::None => write!(f, "none"),
            Self::Geometric => write!(f, "geometric"),
            Self::Photometric => write!(f, "photometric"),
            Self::Proxy => write!(f, "proxy"),
            Self::Shipped => write!(f, "shipped"),
            Self::Project => write!(f, "project"),
            Self::Model(path) => write!(f, "{}", path.display()),
        }
    }
}

/// Form of p_i (method 3.4).
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Confidence {
    /// f_conf = 1 if f_cov = 1.
    None,
    /// Method 7.2 times the mean of the two unary confidences.
    Pair(PairConfidence),
    /// Mean of the two unary confidences.
    Paper { min_matches: u32 },
    /// Method 7.4 if the pictures of both views are available, else method 7.2 times the mean of the two unary confidences.
    Photometric { agreement: Photometric, otherwise: PairConfidence },
    /// Trained: the probability that the key view can measure the triangle at all, times that of enough matches.
    Trained(PairCurves),
}

impl Confidence {
    /// `numbers`: those of the backend. A trained model without a picture has no unary confidence for the paper's form.
    pub fn new(
        source: &Source,
        trained: Option<&TrainedModel>,
        settings: &ConfidenceSettings,
        numbers: &PairConfidence,
        photometric: &Photometric,
    ) -> Self {
        let numbers = numbers.with(settings);
        let min_matches = numbers.min_matches;
        match (source, settings.form, trained) {
            (Source::None, _, _) => Self::None,
            (Source::Photometric, _, _) => {
                Self::Photometric { agreement: photometric.with(settings), otherwise: numbers }
            }
            (Source::Proxy, ConfidenceForm::Paper, _) => Self::Paper { min_matches },
            (_, ConfidenceForm::Paper, Some(TrainedModel { picture: Some(_), .. })) => Self::Paper { min_matches },
            (_, _, Some(TrainedModel { pair, .. })) => {
                Self::Trained(PairCurves { min_matches: settings.min_matches.unwrap_or(pair.min_matches), ..*pair })
            }
            _ => Self::Pair(numbers),
        }
    }
}

impl Confidence {
    /// Writes the parameters in force into the settings that apply to this form.
    pub fn fill_in(&self, settings: &mut ConfidenceSettings) {
        if let Self::Photometric { agreement, .. } = self {
            settings.agree = Some(agreement.agree);
            settings.differ = Some(agreement.differ);
            settings.full_agreement = Some(agreement.full_agreement);
        }
        match self {
            Self::None => {}
            Self::Trained(curves) => settings.min_matches = Some(curves.min_matches),
            Self::Paper { min_matches } => settings.min_matches = Some(*min_matches),
            Self::Pair(numbers) | Self::Photometric { otherwise: numbers, .. } => {
                settings.min_matches = Some(numbers.min_matches);
                settings.p0 = Some(numbers.p0);
                settings.cosine_power = Some(numbers.cosine_power);
                settings.scale_octaves = Some(numbers.scale_octaves.unwrap_or(0.0));
                settings.full_angle = Some(numbers.full_angle_deg.unwrap_or(0.0));
            }
        }
    }

    /// Minimum number of successful matches; 0: f_conf is 1.
    pub fn min_matches(&self) -> u32 {
        match self {
            Self::None => 0,
            Self::Pair(numbers) | Self::Photometric { otherwise: numbers, .. } => numbers.min_matches,
            Self::Paper { min_matches } => *min_matches,
            Self::Trained(curves) => curves.min_matches,
        }
    }

    /// Returns p_i of a partner that sees the triangle, from the geometry of the pair, the key view's [`Unary::confidence`] and the partner's
    /// [`Unary::as_partner`].
    pub fn pair(&self, constellation: &Constellation, key: f64, partner: f64) -> f64 {
        match self {
            Self::None => 1.0,
            Self::Pair(numbers) | Self::Photometric { otherwise: numbers, .. } => {
                numbers.confidence(constellation) * 0.5 * (key + partner)
            }
            Self::Paper { .. } => 0.5 * (key + partner),
            Self::Trained(curves) => f64::from(trees::logistic(curves.odds(&constellation.numbers()) + partner as f32)),
        }
    }

    /// Returns the probability that the key view can measure the triangle at all, from its [`Unary::confidence`].
    pub fn measurable(&self, key: f32) -> f32 {
        if matches!(self, Self::Trained(_)) { key } else { 1.0 }
    }

    /// Returns f_conf of method 3.4: the probability that at least [`Confidence::min_matches`] of independent matches succeed.
    ///
    /// `at_least[m]` is the probability of m successes among the matches so far. A match of probability p turns "exactly m - 1" into m. Only adding
    /// to "at least m", never subtracting from 1, keeps small probabilities exact.
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

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// The paper's alternating sum over elementary symmetric polynomials.
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

    /// Enumerates all outcomes.
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
