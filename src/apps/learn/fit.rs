//! Maximum likelihood of the four numbers, by a search on ever finer grids.

use super::Numbers;
use crate::method::confidence::{Photometric, at_least};

/// Limits of the predicted chance, so that no single outcome decides.
const CHANCES: (f64, f64) = (0.001, 0.999);
/// First step of the search, and the step below which it ends.
const STEPS: (f64, f64) = (0.16, 0.01);
/// Ranges of agree, differ and full_agreement.
const RANGES: [(f64, f64); 3] = [(0.05, 0.99), (0.0, 0.98), (0.2, 1.0)];

/// What came of the triangles of finished clusters.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Outcomes {
    /// End of each triangle's pairs.
    ends: Vec<u32>,
    /// Agreement of each pair (method 7.4).
    pairs: Vec<u8>,
    /// Share of the triangle's pixels with a depth, 0 to 1.
    shares: Vec<f32>,
    weights: Vec<f32>,
}

impl Outcomes {
    pub fn push(&mut self, pairs: &[u8], share: f32, weight: f32) {
        self.pairs.extend(pairs);
        self.ends.push(self.pairs.len() as u32);
        self.shares.push(share);
        self.weights.push(weight);
    }

    pub fn len(&self) -> usize {
        self.ends.len()
    }

    pub fn is_empty(&self) -> bool {
        self.ends.is_empty()
    }

    fn each(&self) -> impl Iterator<Item = (&[u8], f32, f32)> {
        let starts = std::iter::once(0).chain(self.ends.iter().copied());
        let pairs = starts
            .zip(&self.ends)
            .map(|(start, &end)| &self.pairs[start as usize..end as usize]);
        pairs
            .zip(&self.shares)
            .zip(&self.weights)
            .map(|((pairs, &share), &weight)| (pairs, share, weight))
    }

    pub fn joined(all: &[Self]) -> Self {
        Self::of(all.iter().flat_map(Self::each))
    }

    fn of<'a>(triangles: impl Iterator<Item = (&'a [u8], f32, f32)>) -> Self {
        let mut outcomes = Self::default();
        triangles.for_each(|(pairs, share, weight)| outcomes.push(pairs, share, weight));
        outcomes
    }

    /// Every n-th triangle, at most `most`.
    pub fn thinned(self, most: usize) -> Self {
        match self.len().div_ceil(most) {
            0 | 1 => self,
            step => Self::of(self.each().step_by(step)),
        }
    }

    /// Prediction, share and weight of each triangle.
    pub fn predicted(&self, numbers: &Numbers) -> Vec<(f32, f32, f32)> {
        let chances = Chances::new(numbers);
        self.each()
            .map(|(pairs, share, weight)| (chances.of(pairs) as f32, share, weight))
            .collect()
    }

    fn loss(&self, numbers: &Numbers) -> f64 {
        let chances = Chances::new(numbers);
        let of = |(pairs, share, weight): (&[u8], f32, f32)| {
            let (chance, share) = (
                chances.of(pairs).clamp(CHANCES.0, CHANCES.1),
                f64::from(share),
            );
            f64::from(weight) * -(share * chance.ln() + (1.0 - share) * (1.0 - chance).ln())
        };
        let weight: f64 = self.weights.iter().map(|&w| f64::from(w)).sum();
        self.each().map(of).sum::<f64>() / weight.max(1.0)
    }
}

/// p by agreement.
struct Chances {
    min_matches: u32,
    by_agreement: [f64; 256],
}

impl Chances {
    fn new(numbers: &Numbers) -> Self {
        let by_agreement =
            std::array::from_fn(|agreement| numbers.photometric.chance(agreement as u8));
        Self {
            min_matches: numbers.min_matches,
            by_agreement,
        }
    }

    fn of(&self, pairs: &[u8]) -> f64 {
        at_least(
            self.min_matches,
            pairs
                .iter()
                .map(|&pair| self.by_agreement[usize::from(pair)]),
        )
    }
}

/// Returns the numbers of the largest likelihood; each scene counts the same.
pub(super) fn fit(scenes: &[&Outcomes]) -> Numbers {
    let loss = |numbers: &Numbers| {
        scenes
            .iter()
            .map(|outcomes| outcomes.loss(numbers))
            .sum::<f64>()
    };
    let of_matches = |min_matches| search(min_matches, &loss);
    (1..=3)
        .map(of_matches)
        .min_by(|a, b| a.0.total_cmp(&b.0))
        .expect("three candidates")
        .1
}

/// Moves to the best neighbour on a grid of the three numbers, which may trade one for another, as
/// long as the loss falls, then halves the step.
fn search(min_matches: u32, loss: &dyn Fn(&Numbers) -> f64) -> (f64, Numbers) {
    let numbers = |[agree, differ, full_agreement]: [f64; 3]| Numbers {
        min_matches,
        photometric: Photometric {
            agree,
            // The search may move `differ` above `agree`, which the settings refuse.
            differ: differ.min(agree),
            full_agreement,
        },
    };
    let mut at = [0.9, 0.1, 0.8];
    let mut least = loss(&numbers(at));
    let mut step = STEPS.0;
    while step >= STEPS.1 {
        let moved = |direction: u32, axis: u32| f64::from(direction / 3u32.pow(axis) % 3) - 1.0;
        let neighbour = |direction: u32| -> [f64; 3] {
            let along = |axis: usize| at[axis] + step * moved(direction, axis as u32);
            [0, 1, 2].map(|axis| along(axis).clamp(RANGES[axis].0, RANGES[axis].1))
        };
        let around = (0..27)
            .map(neighbour)
            .map(|next| (loss(&numbers(next)), next));
        let best = around
            .min_by(|a, b| a.0.total_cmp(&b.0))
            .expect("27 neighbours");
        if best.0 < least {
            (least, at) = best;
        } else {
            step /= 2.0;
        }
    }
    // Two decimals are what the data can tell.
    let rounded = numbers(at.map(|x| (100.0 * x).round() / 100.0));
    (least, rounded)
}

#[cfg(test)]
mod tests {
    use rand_core::{Rng, SeedableRng};

    use super::*;

    /// Triangles whose pixels succeed by these numbers.
    fn drawn(numbers: &Numbers, count: usize, seed: u64) -> Outcomes {
        let mut random = rand_pcg::Pcg64Mcg::seed_from_u64(seed);
        let chances = Chances::new(numbers);
        let mut outcomes = Outcomes::default();
        for _ in 0..count {
            let pairs: [u8; 5] = std::array::from_fn(|_| (random.next_u32() >> 24) as u8);
            let success = f64::from(random.next_u32()) / f64::from(u32::MAX) < chances.of(&pairs);
            outcomes.push(&pairs, f32::from(u8::from(success)), 1.0);
        }
        outcomes
    }

    #[test]
    fn finds_the_numbers_that_outcomes_were_drawn_with() {
        for (min_matches, agree, differ, full_agreement) in
            [(1, 0.6, 0.05, 0.7), (2, 0.9, 0.2, 0.9), (3, 0.95, 0.4, 0.6)]
        {
            let numbers = Numbers {
                min_matches,
                photometric: Photometric {
                    agree,
                    differ,
                    full_agreement,
                },
            };
            let fitted = fit(&[&drawn(&numbers, 20_000, 7)]);
            assert_eq!(fitted.min_matches, min_matches, "{fitted:?}");
            let (a, b) = (fitted.photometric, numbers.photometric);
            assert!(
                (a.agree - b.agree).abs() < 0.05 && (a.differ - b.differ).abs() < 0.05,
                "{fitted:?}"
            );
            assert!(
                (a.full_agreement - b.full_agreement).abs() < 0.1,
                "{fitted:?}"
            );
        }
    }

    #[test]
    fn parts_are_all_of_it() {
        let numbers = Numbers {
            min_matches: 2,
            photometric: Photometric {
                agree: 0.9,
                differ: 0.1,
                full_agreement: 0.8,
            },
        };
        let all = drawn(&numbers, 101, 1);
        let parts = [drawn(&numbers, 40, 2), all.clone()];
        let joined = Outcomes::joined(&parts);
        assert_eq!(joined.len(), 141);
        assert_eq!(joined.predicted(&numbers)[40..], all.predicted(&numbers));
        assert_eq!(all.clone().thinned(40).len(), 34);
        assert_eq!(all.clone().thinned(101), all);
    }
}
