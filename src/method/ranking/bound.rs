//! How far an order can be from the best set of its length.

use super::{Objective, Reached};
use crate::{base::column, method::fulfilment::FulfilmentTable};

/// Lengths, in parts of the one that is asked for, at which the bound is taken: what the order has reached there and the most that clusters
/// could add. Each is a bound; which is the lowest depends on how fast gains fall.
const AT: [f64; 6] = [0.0, 0.5, 1.0, 1.5, 2.0, 3.0];

/// An upper bound on f_o of any `length` clusters, from an order of all that gain; never below what the best of them reach.
///
/// With the first clusters S of the order taken, no set of `length` clusters reaches more than f_o(S) and the sum of the `length` largest
/// numbers that clusters add as one of many (method 5.2).
pub fn most_of_any(length: usize, table: &FulfilmentTable, objective: &Objective, order: &[u32]) -> f64 {
    let clusters: Vec<usize> = (0..table.clusters()).collect();
    let mut reached = Reached::new(objective);
    let (mut taken, mut least) = (0, f64::INFINITY);
    for part in AT {
        let end = ((part * length as f64).round() as usize).min(order.len());
        order[taken..end].iter().for_each(|&c| reached.take(table.row(c as usize)));
        taken = end;
        let most = |&c: &usize| reached.most_as_one_of_many(table.row(c));
        let mut most = column::read_by_parts(&clusters, most, || table.release());
        most.sort_unstable_by(|a, b| b.total_cmp(a));
        least = least.min(reached.fulfilment() + most.iter().take(length).sum::<f64>());
    }
    order[taken..].iter().for_each(|&c| reached.take(table.row(c as usize)));
    least.min(reached.fulfilment())
}
