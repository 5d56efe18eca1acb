//! `sampled` (method 4, the paper to the letter): the best of y drawn combinations of k candidates.

use std::collections::BTreeSet;

use rand_core::{Rng, SeedableRng};
use rand_pcg::Pcg64;

use super::block::{Block, PartnerSet};

/// A set of candidates, by their numbers, ascending.
pub type Combination = Vec<u8>;

/// The combinations to judge: all if there are at most `draws`; else all of the q most connected candidates, q the largest with at
/// most a quarter of `draws` of them, and the rest at random without repetition. Candidates are numbered most connected first.
pub fn combinations(candidates: usize, k: usize, draws: usize, seed: u64, view: &str) -> Vec<Combination> {
    if binomial(candidates, k) <= draws as u64 {
        return all_of(candidates, k);
    }
    let q = (k..=candidates).take_while(|&q| 4 * binomial(q, k) <= draws as u64).last();
    let mut drawn = q.map_or_else(Vec::new, |q| all_of(q, k));
    let mut known: BTreeSet<Combination> = drawn.iter().cloned().collect();
    let mut random = generator(seed, view);
    while drawn.len() < draws {
        let combination = draw(&mut random, candidates, k);
        if known.insert(combination.clone()) {
            drawn.push(combination);
        }
    }
    drawn
}

/// The generator of a view's draws: PCG 64 seeded by the settings' seed and the view's name, so that no view's draws depend on another's.
fn generator(seed: u64, view: &str) -> Pcg64 {
    let mut hasher = blake3::Hasher::new();
    hasher.update(&seed.to_le_bytes()).update(view.as_bytes());
    Pcg64::from_seed(*hasher.finalize().as_bytes())
}

/// k of n, each combination equally likely (Floyd's method).
fn draw(random: &mut Pcg64, n: usize, k: usize) -> Combination {
    let mut chosen = BTreeSet::new();
    for i in n - k..n {
        let j = ((u64::from(random.next_u32()) * (i as u64 + 1)) >> 32) as u8;
        if !chosen.insert(j) {
            chosen.insert(i as u8);
        }
    }
    chosen.into_iter().collect()
}

/// All combinations of k of the first n, in lexicographic order.
fn all_of(n: usize, k: usize) -> Vec<Combination> {
    let mut combination: Combination = (0..k as u8).collect();
    let mut all = vec![combination.clone()];
    while let Some(i) = (0..k).rev().find(|&i| usize::from(combination[i]) < n - k + i) {
        combination[i] += 1;
        for j in i + 1..k {
            combination[j] = combination[j - 1] + 1;
        }
        all.push(combination.clone());
    }
    all
}

/// n over k, saturating.
fn binomial(n: usize, k: usize) -> u64 {
    if k > n {
        return 0;
    }
    (0..k.min(n - k) as u64).fold(1u64, |b, i| b.saturating_mul(n as u64 - i) / (i + 1))
}

/// The combination with the largest sum, and the sum; ties by the first drawn. Judged in lexicographic order, so that
/// combinations share the sums of their common beginnings.
pub fn best(block: &Block, combinations: &[Combination]) -> Option<(Combination, f64)> {
    let mut order: Vec<usize> = (0..combinations.len()).collect();
    order.sort_by_key(|&i| &combinations[i]);
    let mut prefixes: Vec<(u8, PartnerSet)> = Vec::new();
    let mut best: Option<(usize, f64)> = None;
    for i in order {
        let (&last, beginning) = combinations[i].split_last()?;
        let common = prefixes.iter().zip(beginning).take_while(|(prefix, member)| prefix.0 == **member).count();
        prefixes.truncate(common);
        for &member in &beginning[common..] {
            let mut set = prefixes.last().map_or_else(|| block.empty_set(), |(_, set)| set.clone());
            block.add(&mut set, member);
            prefixes.push((member, set));
        }
        let sum = match prefixes.last() {
            Some((_, set)) => block.sum_with(set, last),
            None => block.sum_with(&block.empty_set(), last),
        };
        if best.is_none_or(|(b, most)| sum > most || sum == most && i < b) {
            best = Some((i, sum));
        }
    }
    best.map(|(i, sum)| (combinations[i].clone(), sum))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn few_combinations_are_taken_whole() {
        let all = combinations(6, 3, 100, 0, "a");
        assert_eq!(all.len(), 20);
        assert!(all.windows(2).all(|w| w[0] < w[1]));
    }

    #[test]
    fn the_most_connected_come_first_and_nothing_is_drawn_twice() {
        let drawn = combinations(22, 5, 100, 0, "a");
        // C(6, 5) = 6 and C(7, 5) = 21 fit a quarter of 100, C(8, 5) = 56 does not.
        assert_eq!(drawn[..21], all_of(7, 5)[..]);
        let distinct: BTreeSet<_> = drawn.iter().collect();
        assert_eq!((drawn.len(), distinct.len()), (100, 100));
        assert!(drawn.iter().all(|c| c.len() == 5 && c.windows(2).all(|w| w[0] < w[1]) && c[4] < 22));
    }

    #[test]
    fn one_view_s_draws_depend_on_its_name_and_the_seed_only() {
        assert_eq!(combinations(22, 5, 100, 3, "a"), combinations(22, 5, 100, 3, "a"));
        assert_ne!(combinations(22, 5, 100, 3, "a"), combinations(22, 5, 100, 3, "b"));
        assert_ne!(combinations(22, 5, 100, 3, "a"), combinations(22, 5, 100, 4, "a"));
    }

    #[test]
    fn every_candidate_is_drawn_about_equally_often() {
        let mut random = generator(1, "x");
        let mut counts = [0; 22];
        (0..22_000).for_each(|_| draw(&mut random, 22, 5).iter().for_each(|&c| counts[usize::from(c)] += 1));
        // 5000 expected, standard deviation 62.
        assert!(counts.iter().all(|&n| (4700..5300).contains(&n)), "{counts:?}");
    }
}
