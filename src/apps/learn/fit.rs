//! Fits the curves of the trained confidence.
//!
//! A row is a triangle that a finished view cluster could have measured, with the share of it that succeeded. The predicted probability has the form
//! that the plan uses: q(key) · P(at least m of the pairs match). All curves are fitted together to the likelihood of the rows, so the result is
//! calibrated for whole clusters, although single pairs are never observed.

use rayon::prelude::*;

use crate::method::confidence::{
    curves::{self, KNOTS, PAIR, PLACE, PairCurves, PiecewiseLinear, PlaceCurves},
    trees::logistic,
};

/// Number of gradient steps, and the length of the first ones.
const STEPS: usize = 200;
const RATE: f32 = 0.08;
/// Regularisation: weights of the squared second differences of a curve and of its squared values, against the mean loss of a row.
const ROUGHNESS: f32 = 2e-4;
const SIZE: f32 = 2e-5;
/// Rows per partial sum of gradients.
const CHUNK: usize = 2048;

/// A pair of the row's cluster whose partner sees the triangle.
#[derive(Clone, Copy, Debug)]
pub struct PairRow {
    pub numbers: [f32; PAIR.len()],
    /// Features in the partner's view.
    pub place: [f32; PLACE.len()],
}

/// A triangle of a finished cluster.
#[derive(Clone, Debug)]
pub struct TrainingRow {
    /// Features in the key view.
    pub place: [f32; PLACE.len()],
    pub pairs: Vec<PairRow>,
    /// Share of the triangle's judged pixels that succeeded.
    pub success: f32,
    pub weight: f32,
}

/// All curves.
#[derive(Clone, Debug, PartialEq)]
pub struct FittedCurves {
    pub pair: PairCurves,
    pub place: PlaceCurves,
}

/// Parameters: bias of q, bias of pairs, then the knots of the key's, the partner's and the pair's curves.
const KEY: usize = 2;
const PARTNER: usize = KEY + PLACE.len() * KNOTS;
const BETWEEN: usize = PARTNER + PLACE.len() * KNOTS;
const COUNT: usize = BETWEEN + PAIR.len() * KNOTS;

impl FittedCurves {
    /// Returns the probability that the row succeeds.
    pub fn chance(&self, row: &TrainingRow) -> f32 {
        let q = logistic(self.place.bias + curves::sum(&self.place.key, &row.place));
        let odds = |pair: &PairRow| self.pair.odds(&pair.numbers) + curves::sum(&self.place.partner, &pair.place);
        q * at_least(row.pairs.iter().map(|pair| logistic(odds(pair))), self.pair.min_matches as usize)
    }

    /// Fits the curves to the likelihood of the rows.
    pub fn fit(rows: &[TrainingRow], min_matches: u32) -> Self {
        let total: f32 = rows.iter().map(|row| row.weight).sum::<f32>().max(f32::MIN_POSITIVE);
        let mut parameters = vec![0.0f32; COUNT];
        (parameters[0], parameters[1]) = (2.0, 1.0);
        let (mut first, mut second) = (vec![0.0f32; COUNT], vec![0.0f32; COUNT]);
        for step in 1..=STEPS {
            let mut gradient = gradient(rows, &parameters, min_matches as usize);
            gradient.iter_mut().for_each(|g| *g /= total);
            add_penalties(&parameters, &mut gradient);
            // Adam (Kingma, Ba 2015), its rate falling to 0.
            let rate = RATE * (1.0 - (step - 1) as f32 / STEPS as f32);
            let (correct1, correct2) = (1.0 - 0.9f32.powi(step as i32), 1.0 - 0.999f32.powi(step as i32));
            for i in 0..COUNT {
                first[i] = 0.9 * first[i] + 0.1 * gradient[i];
                second[i] = 0.999 * second[i] + 0.001 * gradient[i] * gradient[i];
                parameters[i] -= rate * (first[i] / correct1) / ((second[i] / correct2).sqrt() + 1e-8);
            }
        }
        Self::from_parameters(&parameters, min_matches)
    }

    fn from_parameters(parameters: &[f32], min_matches: u32) -> Self {
        let curve = |base: PiecewiseLinear, start: usize| PiecewiseLinear {
            values: std::array::from_fn(|knot| parameters[start + knot]),
            ..base
        };
        let of_place = |start: usize| std::array::from_fn(|i| curve(PLACE[i], start + i * KNOTS));
        Self {
            pair: PairCurves {
                min_matches,
                bias: parameters[1],
                curves: std::array::from_fn(|i| curve(PAIR[i], BETWEEN + i * KNOTS)),
            },
            place: PlaceCurves { bias: parameters[0], key: of_place(KEY), partner: of_place(PARTNER) },
        }
    }
}

fn at_least(chances: impl Iterator<Item = f32>, m: usize) -> f32 {
    let mut at_least = [1.0f32, 0.0, 0.0, 0.0];
    for p in chances {
        for i in (1..4).rev() {
            at_least[i] += p * (at_least[i - 1] - at_least[i]);
        }
    }
    at_least[m]
}

/// Returns the gradient of the negative log likelihood, summed over the rows in a fixed order.
fn gradient(rows: &[TrainingRow], parameters: &[f32], m: usize) -> Vec<f32> {
    let of_chunk = |chunk: &[TrainingRow]| {
        let mut sum = vec![0.0f32; COUNT];
        chunk.iter().for_each(|row| add_row(row, parameters, m, &mut sum));
        sum
    };
    let chunks: Vec<Vec<f32>> = rows.par_chunks(CHUNK).map(of_chunk).collect();
    let mut total = vec![0.0; COUNT];
    for chunk in chunks {
        total.iter_mut().zip(chunk).for_each(|(sum, g)| *sum += g);
    }
    total
}

fn add_row(row: &TrainingRow, parameters: &[f32], m: usize, sum: &mut [f32]) {
    let q = logistic(parameters[0] + value(&PLACE, &row.place, parameters, KEY));
    let odds = |pair: &PairRow| {
        parameters[1]
            + value(&PAIR, &pair.numbers, parameters, BETWEEN)
            + value(&PLACE, &pair.place, parameters, PARTNER)
    };
    let chances: Vec<f32> = row.pairs.iter().map(|pair| logistic(odds(pair))).collect();
    let enough = at_least(chances.iter().copied(), m);
    let f = (q * enough).clamp(1e-4, 1.0 - 1e-4);
    let by_f = row.weight * ((1.0 - row.success) / (1.0 - f) - row.success / f);
    let by_q = by_f * enough * q * (1.0 - q);
    sum[0] += by_q;
    add(&PLACE, &row.place, by_q, sum, KEY);
    for (i, (pair, &p)) in row.pairs.iter().zip(&chances).enumerate() {
        let rest = || chances.iter().enumerate().filter(|(j, _)| *j != i).map(|(_, &p)| p);
        // One more match decides where exactly m - 1 of the others succeed.
        let decisive = at_least(rest(), m - 1) - at_least(rest(), m);
        let by_odds = by_f * q * decisive * p * (1.0 - p);
        sum[1] += by_odds;
        add(&PAIR, &pair.numbers, by_odds, sum, BETWEEN);
        add(&PLACE, &pair.place, by_odds, sum, PARTNER);
    }
}

/// Returns the sum of the curves whose knots begin at `start`.
fn value(curves: &[PiecewiseLinear], numbers: &[f32], parameters: &[f32], start: usize) -> f32 {
    let each = curves.iter().zip(numbers).enumerate();
    each.filter_map(|(i, (curve, &x))| {
        let b = curve.between(x)?;
        let knot = start + i * KNOTS + b.knot;
        Some(parameters[knot] * b.share + parameters[knot + 1] * b.next)
    })
    .sum()
}

fn add(curves: &[PiecewiseLinear], numbers: &[f32], slope: f32, sum: &mut [f32], start: usize) {
    for (i, (curve, &x)) in curves.iter().zip(numbers).enumerate() {
        if let Some(b) = curve.between(x) {
            let knot = start + i * KNOTS + b.knot;
            sum[knot] += slope * b.share;
            sum[knot + 1] += slope * b.next;
        }
    }
}

fn add_penalties(parameters: &[f32], gradient: &mut [f32]) {
    for curve in (KEY..COUNT).step_by(KNOTS) {
        for i in curve..curve + KNOTS {
            gradient[i] += 2.0 * SIZE * parameters[i];
        }
        for i in curve + 1..curve + KNOTS - 1 {
            let bend = parameters[i - 1] - 2.0 * parameters[i] + parameters[i + 1];
            gradient[i - 1] += 2.0 * ROUGHNESS * bend;
            gradient[i] -= 4.0 * ROUGHNESS * bend;
            gradient[i + 1] += 2.0 * ROUGHNESS * bend;
        }
    }
}

#[cfg(test)]
mod tests {
    use rand_core::{Rng, SeedableRng};

    use super::*;

    fn rows(count: usize, seed: u64) -> (Vec<TrainingRow>, Vec<f32>) {
        let mut random = rand_pcg::Pcg64Mcg::seed_from_u64(seed);
        let mut unit = || (random.next_u32() >> 8) as f32 / (1 << 24) as f32;
        let mut truth = Vec::new();
        let mut row = || {
            let mut place = [f32::NAN; PLACE.len()];
            place[2] = unit();
            let pair = |unit: &mut dyn FnMut() -> f32| {
                let mut numbers = [f32::NAN; PAIR.len()];
                numbers[0] = unit();
                PairRow { numbers, place: [f32::NAN; PLACE.len()] }
            };
            let pairs: Vec<PairRow> = (0..4).map(|_| pair(&mut unit)).collect();
            let q = if place[2] > 0.5 { 0.9 } else { 0.3 };
            let chance = q * at_least(pairs.iter().map(|p| p.numbers[0]), 2);
            truth.push(chance);
            TrainingRow { place, pairs, success: f32::from(u8::from(unit() < chance)), weight: 1.0 }
        };
        let rows = (0..count).map(|_| row()).collect();
        (rows, truth)
    }

    #[test]
    fn finds_the_chances_of_pairs_that_are_never_observed_alone() {
        let curves = FittedCurves::fit(&rows(20_000, 1).0, 2);
        let (rows, truth) = rows(2000, 2);
        let errors = rows.iter().zip(&truth).map(|(row, truth)| (curves.chance(row) - truth).abs());
        let mean = errors.sum::<f32>() / rows.len() as f32;
        assert!(mean < 0.03, "{mean}");
    }

    #[test]
    fn the_gradient_is_that_of_the_likelihood() {
        let (rows, _) = rows(50, 3);
        let mut random = rand_pcg::Pcg64Mcg::seed_from_u64(4);
        let parameters: Vec<f32> =
            (0..COUNT).map(|_| (random.next_u32() >> 8) as f32 / (1 << 24) as f32 - 0.5).collect();
        let loss = |parameters: &[f32]| -> f64 {
            let curves = FittedCurves::from_parameters(parameters, 2);
            let of = |row: &TrainingRow| {
                let f = f64::from(curves.chance(row));
                -f64::from(row.success) * f.ln() - (1.0 - f64::from(row.success)) * (1.0 - f).ln()
            };
            rows.iter().map(of).sum()
        };
        let gradient = gradient(&rows, &parameters, 2);
        for i in [0, 1, KEY + 2 * KNOTS + 3, KEY + 2 * KNOTS + 9, BETWEEN + 2, BETWEEN + 8] {
            let moved = |by: f32| {
                let mut moved = parameters.clone();
                moved[i] += by;
                loss(&moved)
            };
            let numeric = (moved(1e-2) - moved(-1e-2)) / 2e-2;
            assert!(
                (numeric - f64::from(gradient[i])).abs() < 1e-2 * numeric.abs().max(1.0),
                "{i} {numeric} {}",
                gradient[i]
            );
        }
    }

    #[test]
    fn the_same_on_any_number_of_threads() {
        let (rows, _) = rows(5000, 5);
        let fit = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| gradient(&rows, &vec![0.1; COUNT], 2))
        };
        assert_eq!(fit(1), fit(3));
    }
}
