//! Section 3.4: the chance that enough of a triangle's matches succeed.

/// Most matches that can be asked for (`confidence.min_matches`).
pub const MOST_MATCHES: usize = 3;

/// P(exactly 0, 1, 2 of the matches so far succeed), for independent matches.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Successes([f64; MOST_MATCHES]);

impl Default for Successes {
    /// No matches yet.
    fn default() -> Self {
        Self([1.0, 0.0, 0.0])
    }
}

impl Successes {
    /// One more match, which succeeds with probability `p`.
    pub fn with(self, p: f64) -> Self {
        let [none, one, two] = self.0;
        let fails = 1.0 - p;
        Self([none * fails, one * fails + none * p, two * fails + one * p])
    }

    /// P(at least `matches` succeed), `matches` from 0 to 3. For 2 it is the closed form of the paper's alternating sum.
    pub fn at_least(&self, matches: u32) -> f64 {
        let fewer: f64 = self.0[..(matches as usize).min(MOST_MATCHES)].iter().sum();
        (1.0 - fewer).clamp(0.0, 1.0)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Σ_{i=2..k} (−1)^i (i − 1) e_i(p), the elementary symmetric polynomials by summing over all subsets.
    fn alternating_sum(p: &[f64]) -> f64 {
        let mut sum = 0.0;
        for subset in 0u32..1 << p.len() {
            let i = subset.count_ones() as i32;
            if i >= 2 {
                let product: f64 = (0..p.len()).filter(|j| subset >> j & 1 == 1).map(|j| p[j]).product();
                sum += (-1f64).powi(i) * f64::from(i - 1) * product;
            }
        }
        sum
    }

    fn successes(p: &[f64]) -> Successes {
        p.iter().fold(Successes::default(), |s, &p| s.with(p))
    }

    proptest! {
        #[test]
        fn two_matches_are_the_paper_s_alternating_sum(p in prop::collection::vec(0.0f64..=1.0, 0..=12)) {
            prop_assert!((successes(&p).at_least(2) - alternating_sum(&p)).abs() < 1e-9);
        }

        #[test]
        fn at_least_m_is_the_sum_over_all_outcomes(p in prop::collection::vec(0.0f64..=1.0, 0..=8), m in 1u32..=3) {
            let mut expected = 0.0;
            for outcome in 0u32..1 << p.len() {
                if outcome.count_ones() >= m {
                    let chance = |j: usize| if outcome >> j & 1 == 1 { p[j] } else { 1.0 - p[j] };
                    expected += (0..p.len()).map(chance).product::<f64>();
                }
            }
            prop_assert!((successes(&p).at_least(m) - expected).abs() < 1e-9);
        }
    }
}
