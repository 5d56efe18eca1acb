//! The paper's selection: a number of combinations of candidates, judged on a subset of the
//! triangles.

use std::collections::HashSet;

use rand_core::{Rng, SeedableRng};
use rand_pcg::Pcg64;

use crate::{
    method::fulfilment::block::{Block, Judges},
    model::scene::{Scene, ViewIndex},
};

/// Draws T_z: a fixed random `1 / fraction` of all triangles, rounded up, by PCG64 from the seed.
pub fn judging_triangles(triangles: usize, fraction: u32, seed: u64) -> Vec<bool> {
    let mut random = Pcg64::seed_from_u64(seed);
    let mut wanted = triangles.div_ceil(fraction.max(1) as usize);
    let mut chosen = vec![false; triangles];
    // Selection sampling: every subset of this size is equally likely (Knuth, TAOCP 2, 3.4.2, S).
    for (i, chosen) in chosen.iter_mut().enumerate() {
        if below(&mut random, triangles - i) < wanted {
            *chosen = true;
            wanted -= 1;
        }
    }
    chosen
}

/// Draws the combinations of `k` of `n` candidates that are judged for a view, in drawing order;
/// candidates within a combination ascend.
///
/// All combinations if there are at most `draws`. Otherwise all of the q best connected candidates,
/// q the largest with C(q, k) at most `draws` / 4, and the rest at random from all n, without
/// repetition. PCG64 is seeded by the first 32 bytes of BLAKE3(seed as 8 bytes little-endian, name
/// of the view), so that the draws of a view are independent of the other views.
pub fn combinations(
    scene: &Scene,
    key: ViewIndex,
    n: usize,
    k: usize,
    draws: usize,
    seed: u64,
) -> Vec<Vec<usize>> {
    if count(n, k) <= draws as u128 {
        return all_combinations(n, k);
    }
    let quarter = draws as u128 / 4;
    let q = (k..n)
        .take_while(|&q| count(q, k) <= quarter)
        .last()
        .unwrap_or(0);
    let mut drawn = if q == 0 {
        Vec::new()
    } else {
        all_combinations(q, k)
    };
    let mut known: HashSet<Vec<usize>> = drawn.iter().cloned().collect();
    let mut random = generator(seed, scene.name(key));
    // Terminates, since there are more combinations than draws.
    while drawn.len() < draws {
        let combination = draw(&mut random, n, k);
        if known.insert(combination.clone()) {
            drawn.push(combination);
        }
    }
    drawn
}

/// Returns the combination with the largest sum over the judging triangles; ties go to the first
/// drawn.
pub fn best(block: &mut Block, combinations: &[Vec<usize>]) -> Vec<usize> {
    let sums = block.sums(
        combinations,
        Judges {
            groups: block.first(),
            step: 1,
        },
    );
    let first_best = sums
        .iter()
        .enumerate()
        .fold(0, |best, (i, sum)| if *sum > sums[best] { i } else { best });
    combinations.get(first_best).cloned().unwrap_or_default()
}

fn generator(seed: u64, name: &str) -> Pcg64 {
    let mut hash = blake3::Hasher::new();
    hash.update(&seed.to_le_bytes()).update(name.as_bytes());
    Pcg64::from_seed(*hash.finalize().as_bytes())
}

/// Returns a number below `bound`, uniformly distributed up to 2^-64.
fn below(random: &mut Pcg64, bound: usize) -> usize {
    ((u128::from(random.next_u64()) * bound as u128) >> 64) as usize
}

/// Draws k different numbers below n, ascending, every set equally likely (Floyd).
fn draw(random: &mut Pcg64, n: usize, k: usize) -> Vec<usize> {
    let mut chosen = Vec::with_capacity(k);
    for last in n - k..n {
        let number = below(random, last + 1);
        chosen.push(if chosen.contains(&number) {
            last
        } else {
            number
        });
    }
    chosen.sort_unstable();
    chosen
}

/// Returns C(n, k), saturating.
fn count(n: usize, k: usize) -> u128 {
    let Some(others) = n.checked_sub(k) else {
        return 0;
    };
    // Exact: the product of i + 1 successive numbers is divisible by (i + 1)!.
    let next = |count: u128, i: usize| Some(count.checked_mul((n - i) as u128)? / (i as u128 + 1));
    (0..k.min(others)).try_fold(1, next).unwrap_or(u128::MAX)
}

/// Lists the combinations in lexicographic order.
fn all_combinations(n: usize, k: usize) -> Vec<Vec<usize>> {
    let mut all = vec![(0..k).collect::<Vec<usize>>()];
    while let Some(next) = all.last().and_then(|last| {
        let i = (0..k).rfind(|&i| last[i] < n - k + i)?;
        let mut next = last.clone();
        next[i] += 1;
        (i + 1..k).for_each(|j| next[j] = next[j - 1] + 1);
        Some(next)
    }) {
        all.push(next);
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::method::synthetic::Town;

    fn scene() -> Scene {
        Town {
            points: 1,
            ..Town::default()
        }
        .scene()
    }

    #[test]
    fn few_combinations_are_all_taken() {
        let scene = scene();
        let all = combinations(&scene, ViewIndex(0), 6, 3, 20, 0);
        assert_eq!(all.len(), 20);
        assert_eq!(
            (all[0].as_slice(), all[1].as_slice(), all[19].as_slice()),
            (&[0, 1, 2][..], &[0, 1, 3][..], &[3, 4, 5][..])
        );
        assert_eq!(
            combinations(&scene, ViewIndex(0), 3, 3, 100, 0),
            [[0, 1, 2]]
        );
    }

    #[test]
    fn many_are_the_most_connected_and_random_ones() {
        let scene = scene();
        // C(6, 5) = 6, C(7, 5) = 21, C(8, 5) = 56: q is 7 for a quarter of 100.
        let drawn = combinations(&scene, ViewIndex(0), 22, 5, 100, 0);
        assert_eq!(drawn.len(), 100);
        assert_eq!(drawn[..21], all_combinations(7, 5));
        let distinct: HashSet<_> = drawn.iter().collect();
        assert_eq!(distinct.len(), 100);
        assert!(
            drawn
                .iter()
                .all(|c| c.windows(2).all(|w| w[0] < w[1]) && c[4] < 22)
        );
        assert!((0..22).all(|v| drawn[21..].iter().any(|c| c.contains(&v))));
        assert_eq!(drawn, combinations(&scene, ViewIndex(0), 22, 5, 100, 0));
        assert_ne!(
            drawn[21..],
            combinations(&scene, ViewIndex(1), 22, 5, 100, 0)[21..]
        );
        assert_ne!(
            drawn[21..],
            combinations(&scene, ViewIndex(0), 22, 5, 100, 1)[21..]
        );
        // A quarter of 120 is still below C(8, 5).
        assert_ne!(
            combinations(&scene, ViewIndex(0), 22, 5, 120, 0)[..56],
            all_combinations(8, 5)
        );
        // Not even C(k, k) = 1 is at most a quarter of three.
        assert_eq!(combinations(&scene, ViewIndex(0), 22, 11, 3, 0).len(), 3);
    }

    #[test]
    fn counts_are_binomial() {
        assert_eq!(
            (count(22, 5), count(22, 11), count(5, 0), count(3, 5)),
            (26334, 705432, 1, 0)
        );
        assert_eq!(all_combinations(8, 3).len() as u128, count(8, 3));
        assert_eq!((count(210, 205), count(205, 205)), (count(210, 5), 1));
        assert!((130..400).all(|n| count(n, n / 2) > 1 << 100));
    }

    #[test]
    fn a_fixed_part_of_the_triangles_judges() {
        let chosen = judging_triangles(1234, 10, 5);
        assert_eq!(chosen.iter().filter(|c| **c).count(), 124);
        assert_eq!(chosen, judging_triangles(1234, 10, 5));
        assert_ne!(chosen, judging_triangles(1234, 10, 6));
        assert!(judging_triangles(7, 1, 0).iter().all(|c| *c));
    }
}
