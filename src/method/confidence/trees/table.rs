//! Training rows, quantised feature by feature.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Maximum number of bins per feature.
pub const BINS: usize = 64;
/// Sample size for the quantiles of a feature, rows.
const SAMPLE: usize = 50_000;

/// Bin boundaries of each feature.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Binning {
    /// Ascending thresholds per feature, at most `BINS - 1`; a value belongs to the bin of the first threshold that it doesn't exceed.
    thresholds: Vec<Vec<f32>>,
}

impl Binning {
    pub fn features(&self) -> usize {
        self.thresholds.len()
    }

    /// Returns the bin of each feature of a row; NaN is in the last one.
    pub fn quantise(&self, features: &[f32], bins: &mut [u8]) {
        for ((bin, thresholds), value) in bins.iter_mut().zip(&self.thresholds).zip(features) {
            *bin = bin_of(thresholds, *value);
        }
    }

    /// Returns whether the thresholds ascend and fit into `BINS`.
    pub fn is_sound(&self) -> bool {
        let ascending =
            |t: &Vec<f32>| t.len() < BINS && t.windows(2).all(|w| w[0] < w[1]) && t.iter().all(|v| !v.is_nan());
        !self.thresholds.is_empty()
            && self.thresholds.len() <= usize::from(u16::MAX)
            && self.thresholds.iter().all(ascending)
    }
}

fn bin_of(thresholds: &[f32], value: f32) -> u8 {
    // NaN compares as above every threshold.
    thresholds.partition_point(|threshold| value > *threshold || value.is_nan()) as u8
}

/// Rows of quantised features, one column per feature.
pub struct Table {
    pub binning: Binning,
    columns: Vec<Vec<u8>>,
    rows: usize,
}

impl Table {
    /// Quantises `value(row, feature)` of all rows by quantiles.
    pub fn new(features: usize, rows: usize, value: impl Fn(usize, usize) -> f32 + Sync) -> Self {
        let quantised: Vec<(Vec<f32>, Vec<u8>)> = (0..features)
            .into_par_iter()
            .map(|feature| {
                let thresholds = quantiles(rows, |row| value(row, feature));
                let column = (0..rows).map(|row| bin_of(&thresholds, value(row, feature))).collect();
                (thresholds, column)
            })
            .collect();
        let (thresholds, columns) = quantised.into_iter().unzip();
        Self { binning: Binning { thresholds }, columns, rows }
    }

    pub fn rows(&self) -> usize {
        self.rows
    }

    pub fn column(&self, feature: usize) -> &[u8] {
        &self.columns[feature]
    }

    /// Returns the bins of a row.
    pub fn row(&self, row: usize) -> Vec<u8> {
        self.columns.iter().map(|column| column[row]).collect()
    }
}

/// Returns at most `BINS - 1` thresholds at equal quantiles of an evenly spaced sample of the rows.
fn quantiles(rows: usize, value: impl Fn(usize) -> f32) -> Vec<f32> {
    let step = rows.div_ceil(SAMPLE).max(1);
    let mut values: Vec<f32> = (0..rows).step_by(step).map(value).filter(|v| !v.is_nan()).collect();
    values.sort_unstable_by(f32::total_cmp);
    let at = |i: usize| values[i * values.len() / BINS];
    let mut thresholds: Vec<f32> = if values.is_empty() { Vec::new() } else { (1..BINS).map(at).collect() };
    thresholds.dedup();
    if values.last().is_some_and(|largest| thresholds.last() == Some(largest)) {
        thresholds.pop();
    }
    thresholds
}
