//! How far an order can be from the best set of its length.

use super::{Objective, Reached, SINGLE_MAP_CREDIT};
use crate::{base::column, method::fulfilment::FulfilmentTable};

/// Rounds in which prices are improved; the bound hardly falls further.
const ROUNDS: usize = 20;
/// Rounds without a lower bound after which the steps are halved.
const PATIENCE: usize = 3;

/// An upper bound on f_o of any `length` clusters; never below what the best of them reach.
///
/// Any prices at the triangles give one (method 5.2). They start from what the first clusters of `order` reach, and rise where the clusters
/// that gain most at these prices are more than are needed, and fall where they are fewer.
pub fn most_of_any(length: usize, table: &FulfilmentTable, objective: &Objective, order: &[u32]) -> f64 {
    let clusters: Vec<u32> = (0..table.clusters() as u32).collect();
    let mut reached = Reached::new(objective);
    let (first, others) = order.split_at(length.min(order.len()));
    first.iter().for_each(|&c| reached.take(table.row(c as usize)));
    let least: Vec<f32> = (0..objective.weights.len() as u32).map(|t| reached.largest(t)[0]).collect();
    let goal = reached.fulfilment();
    others.iter().for_each(|&c| reached.take(table.row(c as usize)));
    let mut bound = reached.fulfilment();
    drop(reached);
    let mut dual = Dual::new(objective, least);
    let (mut step, mut in_vain) = (1.0, 0);
    for _ in 0..ROUNDS {
        let gains = column::read_by_parts(&clusters, |&c| dual.gain(table.row(c as usize)), || table.release());
        let mut best = clusters.clone();
        best.sort_by(|&a, &b| gains[b as usize].total_cmp(&gains[a as usize]));
        best.truncate(length);
        let most = dual.paid() + best.iter().map(|&c| gains[c as usize]).sum::<f64>();
        in_vain = if most < bound { 0 } else { in_vain + 1 };
        bound = bound.min(most);
        if in_vain == PATIENCE {
            (step, in_vain) = (0.5 * step, 0);
        }
        dual.improve(best.iter().map(|&c| table.row(c as usize)), step * (most - goal));
    }
    table.release();
    bound
}

/// Prices at each triangle: of each of its m largest f, and of the m-th.
///
/// The m largest f add up to no more than m p and the sum of max(f - p, 0) over all f, and the m-th is no more than p and an m-th of that sum,
/// whatever p is.
struct Dual<'a> {
    objective: &'a Objective,
    prices: [Vec<f32>; 2],
    /// Weight in f_o of a unit of f above the two prices.
    shares: [f64; 2],
}

impl<'a> Dual<'a> {
    fn new(objective: &'a Objective, start: Vec<f32>) -> Self {
        let (m, e) = (f64::from(objective.support), SINGLE_MAP_CREDIT);
        let each = e / (m - 1.0);
        match objective.support {
            1 => Self { objective, prices: [start, Vec::new()], shares: [1.0, 0.0] },
            _ => Self {
                objective,
                prices: [start.clone(), start],
                shares: [each / (1.0 + e), (1.0 - each) / (m * (1.0 + e))],
            },
        }
    }

    fn in_force(&self) -> impl Iterator<Item = (&Vec<f32>, f64)> {
        self.prices.iter().zip(self.shares).filter(|(_, share)| *share > 0.0)
    }

    /// What m clusters with these f would pay at each triangle.
    fn paid(&self) -> f64 {
        let m = f64::from(self.objective.support);
        let of = |(prices, share): (&Vec<f32>, f64)| {
            let paid: f64 = prices.iter().zip(&self.objective.weights).map(|(&price, w)| w * f64::from(price)).sum();
            m * share * paid
        };
        self.in_force().map(of).sum()
    }

    /// What a cluster has above the prices.
    fn gain(&self, (triangles, values): (&[u32], &[f32])) -> f64 {
        let of = |(prices, share): (&Vec<f32>, f64)| {
            let above = |(&t, &f): (&u32, &f32)| {
                // In 64 bits, where the difference is exact: rounded down, the bound would be none.
                self.objective.weights[t as usize] * (f64::from(f) - f64::from(prices[t as usize])).max(0.0)
            };
            share * triangles.iter().zip(values).map(above).sum::<f64>()
        };
        self.in_force().map(of).sum()
    }

    /// Moves the prices against the subgradient of the bound, per weight: m less the number of `best` clusters above the price. `gap`: what the
    /// bound is to fall by.
    fn improve<'t>(&mut self, best: impl Iterator<Item = (&'t [u32], &'t [f32])>, gap: f64) {
        let weights = &self.objective.weights;
        let mut slopes = self.prices.each_ref().map(|prices| vec![self.objective.support as i32; prices.len()]);
        for (triangles, values) in best {
            for (slopes, prices) in slopes.iter_mut().zip(&self.prices).filter(|(_, prices)| !prices.is_empty()) {
                for (&t, &f) in triangles.iter().zip(values) {
                    slopes[t as usize] -= i32::from(f > prices[t as usize]);
                }
            }
        }
        let square = |(slopes, share): (&Vec<i32>, f64)| -> f64 {
            slopes.iter().zip(weights).map(|(&slope, w)| w * (share * f64::from(slope)).powi(2)).sum()
        };
        let squares: f64 = slopes.iter().zip(self.shares).map(square).sum();
        if !(squares > 0.0 && gap > 0.0) {
            return;
        }
        for ((prices, slopes), share) in self.prices.iter_mut().zip(&slopes).zip(self.shares) {
            for (price, &slope) in prices.iter_mut().zip(slopes) {
                let down = gap / squares * share * f64::from(slope);
                *price = (f64::from(*price) - down).clamp(0.0, 1.0) as f32;
            }
        }
    }
}
