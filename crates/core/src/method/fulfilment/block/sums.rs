//! Loops over a block: f summed over the judging triangles for many sets of partners (f32), and f
//! of every triangle (f64).

use super::{super::lanes::LANES, Block, Judges};
use crate::base::vector::Kernel;

pub(super) struct Sums<'b, 'a> {
    pub(super) block: &'b Block<'a>,
    pub(super) sets: &'b [Vec<usize>],
    pub(super) judges: Judges,
}

impl Kernel for Sums<'_, '_> {
    type Output = Vec<f64>;

    #[inline(always)]
    fn run(self) -> Vec<f64> {
        let mut sums = vec![[0.0; LANES]; self.sets.len()];
        for group in self.judges.iter() {
            let key = &self.block.keys[group];
            for (set, sum) in self.sets.iter().zip(&mut sums) {
                add(
                    sum,
                    self.block
                        .together(set, group)
                        .value::<f32>(key, &self.block.weights),
                );
            }
        }
        sums.iter().map(|lanes| lanes.iter().sum()).collect()
    }
}

pub(super) struct SumsWith<'b, 'a> {
    pub(super) block: &'b Block<'a>,
    pub(super) base: &'b [usize],
    pub(super) added: &'b [usize],
    pub(super) judges: Judges,
}

impl Kernel for SumsWith<'_, '_> {
    type Output = Vec<f64>;

    #[inline(always)]
    fn run(self) -> Vec<f64> {
        let mut sums = vec![[0.0; LANES]; self.added.len()];
        for group in self.judges.iter() {
            let key = &self.block.keys[group];
            // Once for all that are added, so that each costs one addition, whatever k is.
            let base = self.block.together(self.base, group);
            for (&partner, sum) in self.added.iter().zip(&mut sums) {
                let with = base.with(&self.block.columns[partner][group]);
                add(sum, with.value::<f32>(key, &self.block.weights));
            }
        }
        sums.iter().map(|lanes| lanes.iter().sum()).collect()
    }
}

#[inline(always)]
fn add(sum: &mut [f64; LANES], values: [f32; LANES]) {
    for (sum, value) in sum.iter_mut().zip(values) {
        *sum += f64::from(value);
    }
}

pub(super) struct Values<'b, 'a> {
    pub(super) block: &'b Block<'a>,
    pub(super) set: &'b [usize],
}

impl Kernel for Values<'_, '_> {
    type Output = Vec<[f32; LANES]>;

    #[inline(always)]
    fn run(self) -> Vec<[f32; LANES]> {
        let mut values = Vec::with_capacity(self.block.len());
        for group in 0..self.block.len() {
            let together = self.block.together(self.set, group);
            values.push(
                together
                    .value::<f64>(&self.block.keys[group], &self.block.weights)
                    .map(|f| f as f32),
            );
        }
        values
    }
}
