//! Confidence ([method 7]): predicts where the backend will succeed.
//!
//! p_i(t), the probability that the pair (key view, partner i) measures triangle t, comes from the
//! agreement of the two pictures on the surface ([`Agreement`]), or, without pictures, from the
//! geometry of the pair ([`PairConfidence`]) and the sparse points and masks around ([`Unary`]).
//!
//! ```text
//! photometric   p_i = differ + (agree − differ) · min(max(NCC_i, 0) / full_agreement, 1)
//! geometric     p_i = g_i · (u_key + u_i) / 2 · m_key · m_i
//!               g_i = p₀ · min(cos θ_key, cos θ_i)^γ · min(angle / a, 1)
//!                     · exp(−½ (log2(l_i / l_key) / s)²)
//! f_conf        P(at least min_matches of the independent matches i succeed)
//! ```
//!
//! θ is the incidence at t, l the distance of a camera from t, s in octaves, angle and a in
//! degrees; u and m, of a view by itself, and all else are 0 to 1.
//!
//! ```
//! use viewrank_core::method::confidence::{Confidence, Constellation, PairConfidence, Photometric};
//!
//! let numbers = PairConfidence {
//!     min_matches: 1,
//!     p0: 0.6,
//!     cosine_power: 0.0,
//!     scale_octaves: None,
//!     full_angle_deg: Some(8.0),
//! };
//! let confidence = Confidence::Pair(numbers);
//! // Half of the full angle: half of p₀.
//! let pair = Constellation { cos_key: 1.0, cos_partner: 0.9, octaves: 0.0, angle_deg: 4.0 };
//! let p = confidence.pair(&pair, 1.0);
//! assert!((p - 0.3).abs() < 1e-12);
//! // One of two such matches is enough: 1 − 0.7².
//! assert!((confidence.at_least([p, p].into_iter()) - 0.51).abs() < 1e-12);
//!
//! // Agreement is stored as 1 + 254 NCC, or 0 where two pictures share no patch.
//! let pictures = Photometric { agree: 0.95, differ: 0.02, full_agreement: 0.9 };
//! assert!((pictures.chance(255) - 0.95).abs() < 1e-12);
//! assert_eq!([pictures.chance(1), pictures.chance(0)], [0.02, 0.0]);
//! ```
//!
//! [method 7]: https://github.com/viewrank/viewrank/blob/main/docs/method.md#7-confidence

mod geometric;
mod mask;
mod nearby;
pub mod photometric;
mod pictures;
mod settings;
mod unary;

pub use geometric::{Constellation, PairConfidence};
pub use mask::Mask;
pub use nearby::nearby;
pub use photometric::{
    Agreement, Grey, NO_AGREEMENT, PairAgreement, Photometric, ProgramReach, ReachOfPartner,
    SPACING, SampleRoom, Sharpness,
};
pub use pictures::{
    ALL_COUNTS, NOT_COMPARED, NOT_PLANNED, NoPictures, PictureError, PictureFault, Pictures,
    picture_warnings,
};
pub use settings::{ConfidenceSettings, ConfidenceSource};
pub use unary::{AROUND, AtTriangle, Unary};

/// Form of p_i (method 3.4).
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Confidence {
    /// f_conf = 1 if f_cov = 1.
    None,
    /// Method 7.2, with the unary confidence of both views.
    Pair(PairConfidence),
    /// Method 7.4 if the pictures of both views are available, else method 7.2.
    Photometric {
        agreement: Photometric,
        otherwise: PairConfidence,
    },
}

impl Confidence {
    /// `source`: in force. `numbers`, `photometric`: those of the backend.
    pub fn new(
        source: ConfidenceSource,
        settings: &ConfidenceSettings,
        numbers: &PairConfidence,
        photometric: &Photometric,
    ) -> Self {
        let otherwise = numbers.with(settings);
        match source {
            ConfidenceSource::None => Self::None,
            ConfidenceSource::Photometric => Self::Photometric {
                agreement: photometric.with(settings),
                otherwise,
            },
            ConfidenceSource::Geometric | ConfidenceSource::Auto => Self::Pair(otherwise),
        }
    }

    /// Writes the parameters in force into the settings that apply to this form.
    pub fn fill_in(&self, settings: &mut ConfidenceSettings) {
        if let Self::Photometric { agreement, .. } = self {
            settings.agree = Some(agreement.agree);
            settings.differ = Some(agreement.differ);
            settings.full_agreement = Some(agreement.full_agreement);
        }
        if let Self::Pair(numbers)
        | Self::Photometric {
            otherwise: numbers, ..
        } = self
        {
            settings.min_matches = Some(numbers.min_matches);
            settings.p0 = Some(numbers.p0);
            settings.cosine_power = Some(numbers.cosine_power);
            settings.scale_octaves = Some(numbers.scale_octaves.unwrap_or(0.0));
            settings.full_angle = Some(numbers.full_angle_deg.unwrap_or(0.0));
        }
    }

    /// Minimum number of successful matches; 0: f_conf is 1.
    pub fn min_matches(&self) -> u32 {
        match self {
            Self::None => 0,
            Self::Pair(numbers)
            | Self::Photometric {
                otherwise: numbers, ..
            } => numbers.min_matches,
        }
    }

    /// Returns p_i of a partner that sees the triangle, from the geometry of the pair and the
    /// factor of its views by themselves ([`AtTriangle::with`]).
    pub fn pair(&self, constellation: &Constellation, by_view: f64) -> f64 {
        match self {
            Self::None => 1.0,
            Self::Pair(numbers)
            | Self::Photometric {
                otherwise: numbers, ..
            } => numbers.confidence(constellation) * by_view,
        }
    }

    /// Returns f_conf of method 3.4: the probability that at least [`Confidence::min_matches`] of
    /// independent matches succeed.
    pub fn at_least(&self, matches: impl Iterator<Item = f64>) -> f64 {
        at_least(self.min_matches(), matches)
    }
}

/// Returns the probability that at least `least` (0 to 3) of independent matches succeed.
///
/// `at_least[m]` is the probability of m successes among the matches so far. A match of probability
/// p turns "exactly m - 1" into m. Only adding to "at least m", never subtracting from 1, keeps
/// small probabilities exact.
pub fn at_least(least: u32, matches: impl Iterator<Item = f64>) -> f64 {
    let mut at_least = [1.0, 0.0, 0.0, 0.0];
    for p in matches {
        for m in (1..4).rev() {
            at_least[m] += p * (at_least[m - 1] - at_least[m]);
        }
    }
    at_least[least.min(3) as usize]
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
        (2..e.len())
            .map(|i| (i as f64 - 1.0) * if i % 2 == 0 { e[i] } else { -e[i] })
            .sum()
    }

    /// Enumerates all outcomes.
    fn by_outcomes(p: &[f64], least: u32) -> f64 {
        let chance = |outcome: u32| {
            let one = |(i, &p): (usize, &f64)| if outcome >> i & 1 == 1 { p } else { 1.0 - p };
            p.iter().enumerate().map(one).product::<f64>()
        };
        (0..1u32 << p.len())
            .filter(|o| o.count_ones() >= least)
            .map(chance)
            .sum()
    }

    proptest! {
        #[test]
        fn two_matches_are_the_papers_sum(p in proptest::collection::vec(0.0..=1.0f64, 0..=12)) {
            let ours = at_least(2, p.iter().copied());
            prop_assert!((ours - alternating_sum(&p)).abs() < 1e-9, "{} {}", ours, alternating_sum(&p));
        }

        #[test]
        fn is_the_chance_of_enough_matches(p in proptest::collection::vec(0.0..=1.0f64, 0..=10), least in 1u32..=3) {
            let ours = at_least(least, p.iter().copied());
            let expected = by_outcomes(&p, least);
            prop_assert!((ours - expected).abs() <= 1e-12 + 1e-9 * expected, "{ours} {expected}");
        }
    }

    #[test]
    fn without_confidence_everything_succeeds() {
        assert_eq!(Confidence::None.at_least([].into_iter()), 1.0);
    }
}
