//! `search` (method 4, beyond the paper): from the best drawn combination and from greedy addition, exchange partners one by one
//! while the sum grows.

use super::{
    block::{Block, PartnerSet},
    sampled::Combination,
};

/// Passes over all partners after which the search stops; two or three are usual.
const MOST_PASSES: usize = 10;
/// A sum grows when it grows by more than its rounding.
const GROWTH: f64 = 1e-7;

/// The better of `start` (with its sum) and greedy addition, improved by exchanges.
pub fn search(block: &Block, k: usize, start: (Combination, f64)) -> Combination {
    let greedy = greedy(block, k);
    let (mut members, mut sum) = if greedy.1 > start.1 { greedy } else { start };
    for _ in 0..MOST_PASSES {
        let mut grown = false;
        for place in 0..members.len() {
            let mut others = members.clone();
            let leaving = others.remove(place);
            let (joining, with) = best_addition(block, &block.set_of(&others), &members).unwrap_or((leaving, sum));
            if with > sum * (1.0 + GROWTH) {
                members[place] = joining;
                (sum, grown) = (with, true);
            }
        }
        if !grown {
            break;
        }
    }
    members
}

/// Adds the candidate that adds most, k times; the most connected one where none adds anything yet.
fn greedy(block: &Block, k: usize) -> (Combination, f64) {
    let (mut set, mut members, mut sum) = (block.empty_set(), Combination::new(), 0.0);
    for _ in 0..k {
        let Some((joining, with)) = best_addition(block, &set, &members) else { break };
        block.add(&mut set, joining);
        members.push(joining);
        sum = with;
    }
    (members, sum)
}

/// The candidate outside `members` that makes the sum of the set largest, ties by the most connected; and that sum.
fn best_addition(block: &Block, set: &PartnerSet, members: &[u8]) -> Option<(u8, f64)> {
    let outside = (0..block.candidates() as u8).filter(|c| !members.contains(c));
    let sums = outside.map(|c| (c, block.sum_with(set, c)));
    sums.reduce(|best, next| if next.1 > best.1 { next } else { best })
}

/// Puts the partner first whose loss would cost most, ties by the most connected.
pub fn best_first(block: &Block, mut members: Combination) -> Combination {
    members.sort_unstable();
    let without = |member: u8| {
        let mut others = members.clone();
        others.retain(|&m| m != member);
        match others.pop() {
            Some(last) => block.sum_with(&block.set_of(&others), last),
            None => 0.0,
        }
    };
    let mut order: Vec<(f64, u8)> = members.iter().map(|&member| (without(member), member)).collect();
    order.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    order.into_iter().map(|(_, member)| member).collect()
}
