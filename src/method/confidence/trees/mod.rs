//! Binary classification by decision trees on quantised features: a random forest (Breiman 2001) and gradient
//! boosting (Friedman 2001) with the same trees.
//!
//! Features are quantised once to at most [`BINS`] bins, so that a split is found from histograms. A row has a gradient g and a
//! weight h; a node's value is Σg / (Σh + λ) and a split gains what it adds to (Σg)² / (Σh + λ). With g = weight · label that is the
//! forest's Gini criterion, with the derivatives of the logistic loss it is boosting. The same rows, seed and settings give
//! the same trees for any number of threads.

mod table;

use serde::{Deserialize, Serialize};

pub use table::{BINS, Binning, Table};

/// A tree in arrays; node 0 is the root.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Tree {
    /// Feature that a node splits by; unused in leaves.
    pub feature: Vec<u16>,
    /// Rows with at most this bin go left.
    pub bin: Vec<u8>,
    /// Index of the left child, the right one is next to it; 0: a leaf.
    pub child: Vec<u32>,
    /// Value of a leaf: a probability in a forest, log odds in boosting.
    pub value: Vec<f32>,
}

impl Tree {
    /// Returns the value of the leaf for a row of bins.
    pub fn value(&self, bins: &[u8]) -> f32 {
        let mut node = 0;
        while self.child[node] != 0 {
            let right = bins[usize::from(self.feature[node])] > self.bin[node];
            node = self.child[node] as usize + usize::from(right);
        }
        self.value[node]
    }

    /// Returns whether this is a valid tree over `features` features; for trees read from a file.
    pub fn is_sound(&self, features: usize) -> bool {
        let nodes = self.child.len();
        let lengths = [self.feature.len(), self.bin.len(), self.value.len()];
        let sound = |n: usize| {
            let child = self.child[n] as usize;
            child == 0 || child > n && child + 1 < nodes && usize::from(self.feature[n]) < features
        };
        nodes > 0 && lengths == [nodes; 3] && (0..nodes).all(sound) && self.value.iter().all(|v| v.is_finite())
    }

    pub fn leaf(&mut self, value: f32) -> usize {
        self.feature.push(0);
        self.bin.push(0);
        self.child.push(0);
        self.value.push(value);
        self.child.len() - 1
    }
}

/// Meaning of the trees' values.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Ensemble {
    /// Their mean is a probability.
    Forest,
    /// Their sum is log odds.
    Boosted,
}

/// A trained classifier.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Classifier {
    pub ensemble: Ensemble,
    pub binning: Binning,
    /// Log odds before the first tree of a boosted ensemble.
    pub start: f32,
    pub trees: Vec<Tree>,
}

impl Classifier {
    /// Returns the probability of the positive class for a row of features.
    pub fn probability(&self, features: &[f32]) -> f32 {
        let mut bins = vec![0; self.binning.features()];
        self.binning.quantise(features, &mut bins);
        self.probability_of_bins(&bins)
    }

    /// As [`Self::probability`], for a quantised row.
    pub fn probability_of_bins(&self, bins: &[u8]) -> f32 {
        let sum: f32 = self.trees.iter().map(|tree| tree.value(bins)).sum();
        match self.ensemble {
            Ensemble::Forest => sum / self.trees.len().max(1) as f32,
            Ensemble::Boosted => logistic(self.start + sum),
        }
    }

    /// Returns the log odds after each tree of a boosted ensemble.
    pub fn odds_by_tree(&self, features: &[f32]) -> impl Iterator<Item = f32> {
        let mut bins = vec![0; self.binning.features()];
        self.binning.quantise(features, &mut bins);
        self.trees.iter().scan(self.start, move |odds, tree| {
            *odds += tree.value(&bins);
            Some(*odds)
        })
    }

    /// Returns whether the classifier is valid; for classifiers read from a file.
    pub fn is_sound(&self) -> bool {
        let features = self.binning.features();
        self.binning.is_sound() && self.start.is_finite() && self.trees.iter().all(|tree| tree.is_sound(features))
    }
}

/// Converts log odds to a probability.
pub(crate) fn logistic(odds: f32) -> f32 {
    1.0 / (1.0 + (-odds).exp())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn broken_trees_are_not_sound() {
        let looping = Tree { feature: vec![0, 0], bin: vec![0, 0], child: vec![0, 1], value: vec![0.0, 0.0] };
        let outside = Tree { feature: vec![9], bin: vec![0], child: vec![1], value: vec![0.0] };
        assert!(!looping.is_sound(6) && !outside.is_sound(6) && !Tree::default().is_sound(6));
    }
}
