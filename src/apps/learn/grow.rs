//! Grows decision trees from histograms.

use rand_core::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;
use rayon::prelude::*;

use crate::method::confidence::trees::{BINS, Classifier, Ensemble, Table, Tree, logistic};

/// Settings of one tree's growth.
#[derive(Clone, Copy, Debug)]
struct Growth {
    max_depth: u32,
    /// Minimum sum of h in a leaf.
    min_weight: f64,
    /// λ: shrinks the values of small leaves towards 0.
    shrinkage: f64,
}

/// Gradient boosting on the logistic loss: each tree fits the residual of the earlier ones.
#[derive(Clone, Copy, Debug)]
pub struct Boosting {
    pub trees: usize,
    pub max_depth: u32,
    /// Learning rate: share of each tree's values that is added.
    pub learning_rate: f64,
    /// Share of the rows that each tree is grown on.
    pub row_share: f64,
    /// Minimum sum of p (1 − p) in a leaf.
    pub min_leaf: f64,
}

impl Default for Boosting {
    fn default() -> Self {
        Self { trees: 100, max_depth: 5, learning_rate: 0.12, row_share: 0.6, min_leaf: 8.0 }
    }
}

impl Boosting {
    /// Trains on the labels of the rows. `weights` are not negative.
    pub fn train(&self, table: &Table, labels: &[bool], weights: &[f32], seed: u64) -> Classifier {
        let growth = Growth { max_depth: self.max_depth, min_weight: self.min_leaf, shrinkage: 1.0 };
        let start = log_odds(labels, weights);
        let mut odds = vec![start; table.rows()];
        let mut random = Pcg64Mcg::seed_from_u64(seed);
        let chosen_below = (self.row_share.clamp(0.0, 1.0) * f64::from(u32::MAX)) as u32;
        let mut trees = Vec::with_capacity(self.trees);
        for _ in 0..self.trees {
            let mut rows: Vec<u32> = (0..table.rows() as u32).filter(|_| random.next_u32() <= chosen_below).collect();
            let gradients = |row: u32| {
                let (row, p) = (row as usize, logistic(odds[row as usize]));
                let label = f32::from(u8::from(labels[row]));
                (weights[row] * (label - p), weights[row] * (p * (1.0 - p)))
            };
            let mut tree = growth.grow(table, &mut rows, &gradients);
            tree.value.iter_mut().for_each(|value| *value *= self.learning_rate as f32);
            odds.par_iter_mut().enumerate().for_each(|(row, odds)| *odds += tree.value(&table.row(row)));
            trees.push(tree);
        }
        Classifier { ensemble: Ensemble::Boosted, binning: table.binning.clone(), start, trees }
    }
}

fn log_odds(labels: &[bool], weights: &[f32]) -> f32 {
    let sum = |wanted: bool| -> f64 {
        labels.iter().zip(weights).filter(|(label, _)| **label == wanted).map(|(_, weight)| f64::from(*weight)).sum()
    };
    // One row of each class keeps the odds finite where there is only one.
    ((sum(true) + 1.0) / (sum(false) + 1.0)).ln() as f32
}

/// Σg and Σh of a bin or a node.
#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    g: f64,
    h: f64,
}

impl Sums {
    fn score(self, shrinkage: f64) -> f64 {
        if self.h > 0.0 { self.g * self.g / (self.h + shrinkage) } else { 0.0 }
    }

    fn value(self, shrinkage: f64) -> f32 {
        if self.h > 0.0 { (self.g / (self.h + shrinkage)) as f32 } else { 0.0 }
    }
}

/// A split of a node.
#[derive(Clone, Copy)]
struct Split {
    gain: f64,
    feature: usize,
    bin: u8,
}

impl Growth {
    fn grow(&self, table: &Table, rows: &mut [u32], gradients: &(dyn Fn(u32) -> (f32, f32) + Sync)) -> Tree {
        let mut tree = Tree::default();
        tree.leaf(0.0);
        let mut open = vec![(0, 0, rows.len(), 0)];
        while let Some((node, from, to, depth)) = open.pop() {
            let rows = &mut rows[from..to];
            let total = total(rows, gradients);
            tree.value[node] = total.value(self.shrinkage);
            let split = (depth < self.max_depth).then(|| self.best_split(table, rows, gradients, total)).flatten();
            let Some(split) = split else { continue };
            let column = table.column(split.feature);
            let left = partition(rows, |row| column[row as usize] <= split.bin);
            tree.feature[node] = split.feature as u16;
            tree.bin[node] = split.bin;
            let child = tree.leaf(0.0);
            tree.leaf(0.0);
            tree.child[node] = child as u32;
            open.push((child, from, from + left, depth + 1));
            open.push((child + 1, from + left, to, depth + 1));
        }
        tree
    }

    /// Returns the split with the largest gain; ties go to the first feature and the lowest bin.
    fn best_split(
        &self,
        table: &Table,
        rows: &[u32],
        gradients: &(dyn Fn(u32) -> (f32, f32) + Sync),
        total: Sums,
    ) -> Option<Split> {
        if total.h < 2.0 * self.min_weight {
            return None;
        }
        let row_gradients: Vec<(f32, f32)> = rows.iter().map(|&row| gradients(row)).collect();
        let best_of = |feature: usize| self.best_bin(table.column(feature), rows, &row_gradients, total, feature);
        let splits: Vec<Option<Split>> = (0..table.binning.features()).into_par_iter().map(best_of).collect();
        splits.into_iter().flatten().reduce(|best, split| if split.gain > best.gain { split } else { best })
    }

    fn best_bin(
        &self,
        column: &[u8],
        rows: &[u32],
        gradients: &[(f32, f32)],
        total: Sums,
        feature: usize,
    ) -> Option<Split> {
        let mut bins = [Sums::default(); BINS];
        for (&row, &(g, h)) in rows.iter().zip(gradients) {
            let sums = &mut bins[usize::from(column[row as usize])];
            sums.g += f64::from(g);
            sums.h += f64::from(h);
        }
        let whole = total.score(self.shrinkage);
        let (mut left, mut best): (Sums, Option<Split>) = (Sums::default(), None);
        for (bin, sums) in bins[..BINS - 1].iter().enumerate() {
            left = Sums { g: left.g + sums.g, h: left.h + sums.h };
            let right = Sums { g: total.g - left.g, h: total.h - left.h };
            if left.h < self.min_weight || right.h < self.min_weight {
                continue;
            }
            let gain = left.score(self.shrinkage) + right.score(self.shrinkage) - whole;
            if gain > 1e-9 * whole.abs().max(1e-9) && best.is_none_or(|b| gain > b.gain) {
                best = Some(Split { gain, feature, bin: bin as u8 });
            }
        }
        best
    }
}

fn total(rows: &[u32], gradients: &(dyn Fn(u32) -> (f32, f32) + Sync)) -> Sums {
    rows.iter().fold(Sums::default(), |sums, &row| {
        let (g, h) = gradients(row);
        Sums { g: sums.g + f64::from(g), h: sums.h + f64::from(h) }
    })
}

/// Moves the rows of the left child to the front, each side in its order; returns how many there are.
fn partition(rows: &mut [u32], goes_left: impl Fn(u32) -> bool) -> usize {
    let right: Vec<u32> = rows.iter().copied().filter(|&row| !goes_left(row)).collect();
    let mut left = 0;
    for i in 0..rows.len() {
        if goes_left(rows[i]) {
            rows[left] = rows[i];
            left += 1;
        }
    }
    rows[left..].copy_from_slice(&right);
    left
}

#[cfg(test)]
mod tests {
    use rand_core::{Rng, SeedableRng};

    use super::*;

    /// Returns rows of 6 features, of which the first two decide the label; a tenth of the labels are wrong.
    fn rows(count: usize, seed: u64) -> (Vec<Vec<f32>>, Vec<bool>) {
        let mut random = rand_pcg::Pcg64Mcg::seed_from_u64(seed);
        let mut unit = || (random.next_u32() >> 8) as f32 / (1 << 24) as f32;
        let features: Vec<Vec<f32>> = (0..count).map(|_| (0..6).map(|_| unit()).collect()).collect();
        let labels = features.iter().map(|f| ((f[0] - 0.5) * (f[1] - 0.5) > 0.0) != (unit() < 0.1)).collect();
        (features, labels)
    }

    fn table(features: &[Vec<f32>]) -> Table {
        Table::new(6, features.len(), |row, feature| features[row][feature])
    }

    /// Returns the share of the rows predicted on the correct side of one half.
    fn accuracy(classifier: &Classifier, seed: u64) -> f64 {
        let (features, labels) = rows(4000, seed);
        let right = features.iter().zip(&labels).filter(|(f, l)| (classifier.probability(f) > 0.5) == **l).count();
        right as f64 / labels.len() as f64
    }

    #[test]
    fn boosting_learns_an_interaction_that_no_single_feature_shows() {
        let (features, labels) = rows(4000, 1);
        let weights = vec![1.0; labels.len()];
        let boosted = Boosting::default().train(&table(&features), &labels, &weights, 7);
        // No classifier can do better than nine tenths.
        assert!(accuracy(&boosted, 2) > 0.86, "{}", accuracy(&boosted, 2));
        assert!(boosted.is_sound());
    }

    #[test]
    fn the_same_seed_gives_the_same_trees_on_any_number_of_threads() {
        let (features, labels) = rows(500, 3);
        let weights = vec![1.0; labels.len()];
        let train = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
            pool.install(|| Boosting { trees: 8, ..Boosting::default() }.train(&table(&features), &labels, &weights, 5))
        };
        assert_eq!(train(1), train(4));
    }

    #[test]
    fn a_boosted_probability_is_calibrated_where_labels_are_pure_chance() {
        let features = vec![vec![0.0; 6]; 1000];
        let labels: Vec<bool> = (0..1000).map(|i| i % 5 == 0).collect();
        let boosted = Boosting::default().train(&table(&features), &labels, &vec![1.0; 1000], 0);
        assert!((boosted.probability(&features[0]) - 0.2).abs() < 1e-3);
    }

    #[test]
    fn one_class_only_is_learnt_as_such() {
        let (features, _) = rows(50, 4);
        let boosted = Boosting::default().train(&table(&features), &[true; 50], &[1.0; 50], 0);
        assert!(boosted.probability(&features[0]) > 0.95, "{}", boosted.probability(&features[0]));
    }
}
