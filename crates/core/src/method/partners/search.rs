//! Beyond the paper: greedy addition and exchange, proposed on a subset of the triangles and
//! accepted on all of them.

use std::cmp::Ordering;

use crate::method::fulfilment::block::{Block, Judges, LANES};

/// Minimum number of judging triangles; with fewer, all triangles of the view judge.
const ENOUGH_TO_JUDGE: usize = 512;
/// From twice this number on, only a sample of them judges: proposals are decided on all triangles
/// anyway.
const PLENTY_TO_JUDGE: usize = 1024;
/// Exchanges tried on all triangles before the search gives up.
const TRIES: usize = 3;

/// A set of partners, with f of each triangle.
pub struct PartnerChoice {
    pub partners: Vec<usize>,
    /// f, in the order of the key view's rows.
    pub values: Vec<f32>,
    pub sum: f64,
}

impl PartnerChoice {
    pub fn new(block: &mut Block, partners: Vec<usize>) -> Self {
        let values = block.values(&partners);
        let sum = values.iter().map(|&f| f64::from(f)).sum();
        Self {
            partners,
            values,
            sum,
        }
    }
}

/// Returns the best set that greedy addition and exchange find from the better of `start` and the
/// greedy set. Its sum over all triangles is never below that of `start`.
pub fn search(block: &mut Block, start: Vec<usize>, n: usize) -> PartnerChoice {
    let k = start.len();
    let judges = judges(block);
    let greedy = greedy(block, n, k, judges);
    let mut best = PartnerChoice::new(block, start);
    if sorted(&greedy) != sorted(&best.partners) {
        let other = PartnerChoice::new(block, greedy);
        if other.sum > best.sum {
            best = other;
        }
    }
    // Terminates, since the sum on all triangles grows with each exchange.
    while let Some(better) = exchange(block, &best, n, judges) {
        best = better;
    }
    best
}

/// Returns the triangles that the search is judged by.
pub fn judges(block: &Block) -> Judges {
    let groups = if block.first() * LANES < ENOUGH_TO_JUDGE {
        block.len()
    } else {
        block.first()
    };
    Judges {
        groups,
        step: (groups * LANES / PLENTY_TO_JUDGE).max(1),
    }
}

/// Adds partners one by one, each time the one with the largest gain, ties by shared points.
pub fn greedy(block: &mut Block, n: usize, k: usize, judges: Judges) -> Vec<usize> {
    let mut chosen = Vec::with_capacity(k);
    while chosen.len() < k {
        let left: Vec<usize> = (0..n).filter(|p| !chosen.contains(p)).collect();
        let sums = block.sums_with(&chosen, &left, judges);
        let best = (0..left.len()).fold(0, |best, i| if sums[i] > sums[best] { i } else { best });
        let Some(&partner) = left.get(best) else {
            break;
        };
        chosen.push(partner);
    }
    chosen
}

/// Returns the best exchange of one partner by the judging triangles that also gains on all
/// triangles.
fn exchange(
    block: &mut Block,
    best: &PartnerChoice,
    n: usize,
    judges: Judges,
) -> Option<PartnerChoice> {
    let mut exchanges = exchanges(block, &best.partners, n, judges);
    exchanges.sort_by(Exchange::best_first);
    exchanges.into_iter().take(TRIES).find_map(|exchange| {
        let mut partners = best.partners.clone();
        partners[exchange.place] = exchange.candidate;
        let other = PartnerChoice::new(block, partners);
        (other.sum > best.sum).then_some(other)
    })
}

/// Another candidate in place of a partner.
struct Exchange {
    /// Place of the partner in the set.
    place: usize,
    candidate: usize,
    /// Sum of f over the judging triangles after it.
    sum: f64,
}

impl Exchange {
    fn best_first(&self, other: &Self) -> Ordering {
        let by_sum = other.sum.total_cmp(&self.sum);
        by_sum.then((self.place, self.candidate).cmp(&(other.place, other.candidate)))
    }
}

/// Returns the exchanges of one partner that gain on the judging triangles.
fn exchanges(block: &mut Block, partners: &[usize], n: usize, judges: Judges) -> Vec<Exchange> {
    let now = block.sums(&[partners.to_vec()], judges)[0];
    let left: Vec<usize> = (0..n).filter(|p| !partners.contains(p)).collect();
    let mut exchanges = Vec::new();
    for place in 0..partners.len() {
        let rest = [&partners[..place], &partners[place + 1..]].concat();
        let sums = block.sums_with(&rest, &left, judges);
        let gaining = sums.into_iter().zip(&left).filter(|(sum, _)| *sum > now);
        exchanges.extend(gaining.map(|(sum, &candidate)| Exchange {
            place,
            candidate,
            sum,
        }));
    }
    exchanges
}

/// Sorts the partners so that each adds most to those before it.
pub fn best_first(block: &mut Block, mut partners: Vec<usize>) -> Vec<usize> {
    // Candidates are numbered by shared points, so that ties go to the best connected.
    partners.sort_unstable();
    let judges = judges(block);
    let mut ordered = Vec::with_capacity(partners.len());
    while !partners.is_empty() {
        let sums = block.sums_with(&ordered, &partners, judges);
        let best =
            (0..partners.len()).fold(0, |best, i| if sums[i] > sums[best] { i } else { best });
        ordered.push(partners.remove(best));
    }
    ordered
}

fn sorted(partners: &[usize]) -> Vec<usize> {
    let mut sorted = partners.to_vec();
    sorted.sort_unstable();
    sorted
}
