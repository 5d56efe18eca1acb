//! Generalised additive model of the trained confidence: log odds as a sum of piecewise linear functions of one number each.
//!
//! Hastie and Tibshirani 1986. The model is small, fast and smooth, shows the effect of each number, and extrapolates as a
//! constant beyond the range of the training data.

use serde::{Deserialize, Serialize};

/// Number of knots.
pub const KNOTS: usize = 12;

/// A function of one number: linear between equally spaced knots, constant beyond the first and the last; 0 for unknown numbers
/// (NaN).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PiecewiseLinear {
    /// Position of the first and of the last knot.
    pub low: f32,
    pub high: f32,
    pub values: [f32; KNOTS],
}

/// A knot with the weights of its value and of the next knot's.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Segment {
    pub knot: usize,
    pub share: f32,
    pub next: f32,
}

impl PiecewiseLinear {
    /// Returns the function that is 0 everywhere.
    pub const fn flat(low: f32, high: f32) -> Self {
        Self { low, high, values: [0.0; KNOTS] }
    }

    #[inline]
    pub fn between(&self, x: f32) -> Option<Segment> {
        let position = (x - self.low) / (self.high - self.low) * (KNOTS - 1) as f32;
        if position.is_nan() {
            return None;
        }
        let position = position.clamp(0.0, (KNOTS - 1) as f32);
        let knot = (position as usize).min(KNOTS - 2);
        let next = position - knot as f32;
        Some(Segment { knot, share: 1.0 - next, next })
    }

    #[inline]
    pub fn value(&self, x: f32) -> f32 {
        let of = |b: Segment| self.values[b.knot] * b.share + self.values[b.knot + 1] * b.next;
        self.between(x).map_or(0.0, of)
    }

    /// Returns whether the values are finite and the range is not empty; for curves read from a file.
    pub fn is_sound(&self) -> bool {
        self.low < self.high && [self.low, self.high].iter().chain(&self.values).all(|v| v.is_finite())
    }
}

/// Returns the sum of the curves.
#[inline]
pub fn sum<const N: usize>(curves: &[PiecewiseLinear; N], numbers: &[f32; N]) -> f32 {
    curves.iter().zip(numbers).map(|(curve, &x)| curve.value(x)).sum()
}

/// Input ranges of the curves of a pair: see [`Constellation::numbers`](super::Constellation::numbers).
pub const PAIR: [PiecewiseLinear; 4] = [
    PiecewiseLinear::flat(0.0, 1.0),
    PiecewiseLinear::flat(0.0, 1.0),
    PiecewiseLinear::flat(-2.5, 2.5),
    PiecewiseLinear::flat(-1.0, 6.5),
];
/// Input ranges of the curves of a triangle in a view: see [`PlaceFeatures::numbers`](super::place::PlaceFeatures::numbers).
pub const PLACE: [PiecewiseLinear; 9] = [
    PiecewiseLinear::flat(-4.0, 4.0),
    PiecewiseLinear::flat(0.0, 1.0),
    PiecewiseLinear::flat(0.0, 1.0),
    PiecewiseLinear::flat(-0.5, 3.5),
    PiecewiseLinear::flat(0.0, 1.0),
    PiecewiseLinear::flat(0.5, 7.0),
    PiecewiseLinear::flat(0.0, 6.0),
    PiecewiseLinear::flat(1.0, 5.0),
    PiecewiseLinear::flat(0.0, 1.5),
];

/// The trained confidence of a pair of views at a triangle, without picture features.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PairCurves {
    /// Minimum number of successful matches for a pixel (method 3.4), 1 to 3.
    pub min_matches: u32,
    pub bias: f32,
    pub curves: [PiecewiseLinear; PAIR.len()],
}

impl PairCurves {
    /// Returns the log odds of a match.
    #[inline]
    pub fn odds(&self, numbers: &[f32; PAIR.len()]) -> f32 {
        self.bias + sum(&self.curves, numbers)
    }

    pub fn is_sound(&self) -> bool {
        (1..=3).contains(&self.min_matches)
            && self.bias.is_finite()
            && self.curves.iter().all(PiecewiseLinear::is_sound)
    }
}

/// Contribution of a place: for the key view, the probability that it can be measured at all; for a partner, log odds of its match.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PlaceCurves {
    pub bias: f32,
    pub key: [PiecewiseLinear; PLACE.len()],
    pub partner: [PiecewiseLinear; PLACE.len()],
}

impl PlaceCurves {
    pub fn is_sound(&self) -> bool {
        self.bias.is_finite() && self.key.iter().chain(&self.partner).all(PiecewiseLinear::is_sound)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn a_curve_through_a_line_is_the_line(a in -3.0..3.0f32, b in -3.0..3.0f32, x in -1.0..4.0f32) {
            let mut curve = PiecewiseLinear::flat(-1.0, 4.0);
            curve.values = std::array::from_fn(|i| a + b * (-1.0 + 5.0 * i as f32 / (KNOTS - 1) as f32));
            prop_assert!((curve.value(x) - (a + b * x)).abs() < 1e-4);
            prop_assert_eq!(curve.value(100.0), curve.values[KNOTS - 1]);
            prop_assert_eq!(curve.value(-100.0), curve.values[0]);
        }
    }

    #[test]
    fn what_is_not_known_says_nothing() {
        let curve = PiecewiseLinear { values: [3.0; KNOTS], ..PiecewiseLinear::flat(0.0, 1.0) };
        assert_eq!((curve.value(0.3), curve.value(f32::NAN)), (3.0, 0.0));
    }

    #[test]
    fn broken_curves_are_not_sound() {
        assert!(PiecewiseLinear::flat(0.0, 1.0).is_sound());
        assert!(!PiecewiseLinear::flat(1.0, 1.0).is_sound() && !PiecewiseLinear::flat(0.0, f32::NAN).is_sound());
    }
}
