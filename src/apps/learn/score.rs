//! Quality measures of predicted probabilities.

/// Number of equal ranges of prediction for the calibration error.
const RANGES: usize = 10;

/// Quality of predictions against outcomes.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize)]
pub struct Scores {
    pub count: usize,
    /// Area under the ROC curve; an outcome between 0 and 1 counts as that share of a success and
    /// the rest as a failure.
    pub auc: f64,
    /// Mean squared error.
    pub brier: f64,
    /// Mean distance between predicted and observed shares.
    pub calibration_error: f64,
}

impl Scores {
    /// Computes the scores. Each entry is a prediction, its outcome (0 to 1) and a weight.
    pub fn new(mut of: Vec<(f32, f32, f32)>) -> Self {
        of.sort_by(|a, b| a.0.total_cmp(&b.0));
        let weight: f64 = of
            .iter()
            .map(|o| f64::from(o.2))
            .sum::<f64>()
            .max(f64::MIN_POSITIVE);
        let squares: f64 = of
            .iter()
            .map(|&(p, y, w)| f64::from(w) * f64::from(p - y).powi(2))
            .sum();
        let mut ranges = [(0.0f64, 0.0f64); RANGES];
        for &(p, y, w) in &of {
            // A sure success is in the last range, too.
            let range = &mut ranges[((p * RANGES as f32) as usize).min(RANGES - 1)];
            *range = (range.0 + f64::from(w * p), range.1 + f64::from(w * y));
        }
        Self {
            count: of.len(),
            auc: area(&of),
            brier: squares / weight,
            calibration_error: ranges.iter().map(|(p, y)| (p - y).abs()).sum::<f64>() / weight,
        }
    }
}

/// Returns the probability that a success has a larger prediction than a failure; ties count half.
/// `of` must be ascending.
fn area(of: &[(f32, f32, f32)]) -> f64 {
    let (mut failures, mut area, mut successes) = (0.0, 0.0, 0.0);
    for tied in of.chunk_by(|a, b| a.0 == b.0) {
        let right: f64 = tied.iter().map(|o| f64::from(o.2 * o.1)).sum();
        let wrong: f64 = tied.iter().map(|o| f64::from(o.2 * (1.0 - o.1))).sum();
        area += right * (failures + 0.5 * wrong);
        failures += wrong;
        successes += right;
    }
    let pairs = failures * successes;
    if pairs > 0.0 { area / pairs } else { 0.5 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_of_four_predictions() {
        let scores = Scores::new(vec![
            (0.9, 1.0, 1.0),
            (0.8, 0.0, 1.0),
            (0.2, 1.0, 1.0),
            (0.1, 0.0, 1.0),
        ]);
        // Three of the four pairs of success and failure are in order.
        assert_eq!(scores.auc, 0.75);
        assert!((scores.brier - (0.01 + 0.64 + 0.64 + 0.01) / 4.0).abs() < 1e-6);
        assert!((scores.calibration_error - (0.1 + 0.8 + 0.8 + 0.1) / 4.0).abs() < 1e-6);
    }

    #[test]
    fn a_constant_tells_nothing() {
        let scores = Scores::new(vec![(0.5, 1.0, 1.0), (0.5, 0.0, 3.0)]);
        assert_eq!(scores.auc, 0.5);
        assert!((scores.calibration_error - 0.25).abs() < 1e-9);
    }
}
