use proptest::prelude::*;

use super::*;
use crate::base::progress::NoWatcher;

const TRIANGLES: u32 = 12;

/// Triangles that all count the same.
fn even(triangles: u32, support: u32) -> Objective {
    Objective::weighing(vec![1.0; triangles as usize], support)
}

/// Ranks clusters at full size behind finished ones.
fn rank_after(
    table: &FulfilmentTable,
    finished: &[(u32, MapScale)],
    objective: &Objective,
) -> Ranking {
    Ranker::new(&Maps::full_size(table), objective)
        .unwrap()
        .rank(finished, 0.0, &NoWatcher)
        .unwrap()
}

fn rank(table: &FulfilmentTable, objective: &Objective) -> Ranking {
    super::rank(table, objective, &NoWatcher).unwrap()
}

/// f_o of the whole ranking.
fn total(ranking: &Ranking) -> f64 {
    ranking.fulfilment.last().copied().unwrap_or(0.0)
}

/// f of the chosen rows at a triangle, descending, with zeros behind.
fn descending(
    rows: &[Vec<(u32, f32)>],
    chosen: &[usize],
    triangle: u32,
    support: usize,
) -> Vec<f64> {
    let mut f: Vec<f64> = chosen
        .iter()
        .flat_map(|&c| &rows[c])
        .filter(|r| r.0 == triangle)
        .map(|r| f64::from(r.1))
        .collect();
    f.resize(f.len() + support, 0.0);
    f.sort_by(|a, b| b.total_cmp(a));
    f
}

/// f_o by its definition.
fn fulfilment(rows: &[Vec<(u32, f32)>], chosen: &[usize], support: usize) -> f64 {
    let of_triangle = |t: u32| {
        let f = descending(rows, chosen, t, support);
        let others = &f[..support - 1];
        match others.len() {
            0 => f[0],
            n => {
                (f[support - 1] + SINGLE_MAP_CREDIT * others.iter().sum::<f64>() / n as f64)
                    / (1.0 + SINGLE_MAP_CREDIT)
            }
        }
    };
    (0..TRIANGLES).map(of_triangle).sum::<f64>() / f64::from(TRIANGLES)
}

/// The largest f_o of any clusters of each number, from 0.
fn optima(rows: &[Vec<(u32, f32)>], support: usize) -> Vec<f64> {
    let mut optima = vec![0f64; rows.len() + 1];
    for set in 0u32..1 << rows.len() {
        let members: Vec<usize> = (0..rows.len()).filter(|c| set >> c & 1 == 1).collect();
        optima[members.len()] = optima[members.len()].max(fulfilment(rows, &members, support));
    }
    optima
}

/// Greedy with every gain added up afresh.
fn plain_greedy(table: &FulfilmentTable, objective: &Objective) -> Vec<(u32, i64)> {
    let (mut reached, nothing) = (Reached::new(objective), Reached::new(objective));
    let mut left: Vec<u32> = (0..table.clusters() as u32).collect();
    let mut order = Vec::new();
    loop {
        let of = |c: u32, reached: &Reached| reached.whole_gain(table.row(c as usize));
        let rank = |c: u32| (of(c, &reached), of(c, &nothing), std::cmp::Reverse(c));
        let Some(best) = left
            .iter()
            .copied()
            .max_by_key(|&c| rank(c))
            .filter(|&c| of(c, &reached) > 0)
        else {
            return order;
        };
        order.push((best, of(best, &reached)));
        reached.take(table.row(best as usize));
        left.retain(|&c| c != best);
    }
}

fn rows() -> impl Strategy<Value = Vec<Vec<(u32, f32)>>> {
    // Few distinct values, so that ties are common.
    let row = proptest::collection::btree_map(
        0..TRIANGLES,
        (1u8..8).prop_map(|v| f32::from(v) / 8.0),
        0..10,
    );
    proptest::collection::vec(row.prop_map(|r| r.into_iter().collect()), 0..9)
}

proptest! {
    #[test]
    fn gains_kept_up_to_date_are_fresh_gains(rows in rows(), support in 1u32..4) {
        let (table, objective) = (FulfilmentTable::new(&rows), even(TRIANGLES, support));
        let ranking = rank(&table, &objective);
        let plain = plain_greedy(&table, &objective);
        prop_assert_eq!(&ranking.order, &plain.iter().map(|p| p.0).collect::<Vec<_>>());
        prop_assert_eq!(&ranking.gains, &plain.iter().map(|p| FixedPoint(p.1).value()).collect::<Vec<_>>());
        let chosen: Vec<usize> = ranking.order.iter().map(|&c| c as usize).collect();
        for n in 1..=chosen.len() {
            let m = support as usize;
            prop_assert!((ranking.fulfilment[n - 1] - fulfilment(&rows, &chosen[..n], m)).abs() < 1e-12);
            let kept: f64 = (0..TRIANGLES).map(|t| descending(&rows, &chosen[..n], t, m)[m - 1]).sum();
            prop_assert!((ranking.kept[n - 1] - kept / f64::from(TRIANGLES)).abs() < 1e-12);
        }
        let all: Vec<usize> = (0..rows.len()).collect();
        prop_assert!((total(&ranking) - fulfilment(&rows, &all, support as usize)).abs() < 1e-12);
    }

    #[test]
    fn what_is_finished_comes_first_and_the_rest_is_greedy_behind_it(rows in rows(), support in 1u32..4) {
        let (table, objective) = (FulfilmentTable::new(&rows), even(TRIANGLES, support));
        let whole = rank(&table, &objective);
        for length in 0..=whole.order.len() {
            let finished: Vec<_> = whole.maps().take(length).collect();
            let again = rank_after(&table, &finished, &objective);
            prop_assert_eq!(&again, &whole);
        }
        let last: Vec<u32> = (0..rows.len() as u32).rev().take(2).collect();
        let finished: Vec<_> = last.iter().map(|&c| (c, MapScale::Full)).collect();
        let after = rank_after(&table, &finished, &objective);
        prop_assert_eq!(&after.order[..last.len()], &last[..]);
        prop_assert!((total(&after) - total(&whole)).abs() < 1e-12);
    }

    #[test]
    fn greedy_keeps_its_guarantee(rows in rows(), support in 1u32..4) {
        let objective = even(TRIANGLES, support);
        let ranking = rank(&FulfilmentTable::new(&rows), &objective);
        for (n, optimum) in optima(&rows, support as usize).into_iter().enumerate().skip(1).take(ranking.order.len()) {
            prop_assert!(ranking.fulfilment[n - 1] >= objective.guarantee() * optimum - 1e-12);
        }
    }

    #[test]
    fn no_set_of_clusters_exceeds_the_bound(rows in rows(), support in 1u32..4) {
        let (table, objective) = (FulfilmentTable::new(&rows), even(TRIANGLES, support));
        let ranking = rank(&table, &objective);
        for (n, optimum) in optima(&rows, support as usize).into_iter().enumerate() {
            prop_assert!(most_of_any(n, &Maps::full_size(&table), &objective, &ranking) >= optimum - 1e-12);
        }
    }
}

#[test]
fn where_fusion_wants_two_maps_the_second_is_worth_more_than_a_first_elsewhere() {
    // Clusters 0 and 1 see the first triangle, 2 the second, less well.
    let rows = [vec![(0, 0.8f32)], vec![(0, 0.8)], vec![(1, 0.7)]];
    let order = |support| rank(&FulfilmentTable::new(&rows), &even(2, support)).order;
    assert_eq!(order(1), [0, 2]);
    assert_eq!(order(2), [0, 1, 2]);
}

#[test]
fn a_map_alone_is_not_kept() {
    let rows = [vec![(0, 0.8f32)], vec![(1, 0.8)], vec![(0, 0.8)]];
    let ranking = rank(&FulfilmentTable::new(&rows), &even(2, 2));
    assert_eq!(ranking.order, [0, 2, 1]);
    assert!(
        ranking
            .kept
            .iter()
            .zip([0.0, 0.4, 0.4])
            .all(|(kept, expected)| (kept - expected).abs() < 1e-6)
    );
    assert_eq!([0, 1, 2, 3].map(|n| ranking.share(n)), [0.0, 0.0, 1.0, 1.0]);
}

#[test]
fn the_prefix_for_a_share_is_the_shortest() {
    let ranking = Ranking {
        kept: vec![0.5, 0.75, 0.75, 1.0],
        reachable: 1.0,
        ..Ranking::default()
    };
    assert_eq!(
        [0.4, 0.5, 0.6, 0.75, 0.8, 1.0].map(|s| ranking.length_for_share(s)),
        [1, 1, 2, 2, 4, 4]
    );
    assert_eq!(Ranking::default().length_for_share(0.9), 0);
    assert_eq!(Ranking::default().share(3), 0.0);
    assert_eq!(
        [0, 1, 2, 4, 9].map(|n| ranking.share(n)),
        [0.0, 0.5, 0.75, 1.0, 1.0]
    );
}

#[test]
fn where_nothing_is_kept_all_are_taken() {
    let rows = [vec![(0, 0.2f32)], vec![(1, 0.1)]];
    let ranking = rank(&FulfilmentTable::new(&rows), &even(2, 2));
    assert_eq!(
        (
            ranking.reachable,
            ranking.share(2),
            ranking.length_for_share(0.5)
        ),
        (0.0, 0.0, 2)
    );
}

#[test]
fn a_gain_of_zero_ends_the_order() {
    let rows = [
        vec![(0, 0.5f32), (1, 0.5)],
        vec![(0, 0.5)],
        vec![(1, 0.25)],
        vec![],
    ];
    let ranking = rank(&FulfilmentTable::new(&rows), &even(2, 1));
    assert_eq!(ranking.order, [0]);
}

/// A table of fulfilment, row by row: elements and f.
type Rows = Vec<Vec<(u32, f32)>>;

/// Clusters with f at full and at half size, and the work of each map.
fn two_sizes() -> impl Strategy<Value = (Rows, Rows, Vec<[f64; 2]>)> {
    let work = (1u8..4)
        .prop_map(f64::from)
        .prop_map(|full| [full, 0.25 * full + 0.25]);
    (rows(), proptest::collection::vec(work, 9)).prop_map(|(full, work)| {
        let half = full
            .iter()
            .map(|row| row.iter().map(|&(t, f)| (t, 0.5 * f)).collect())
            .collect();
        let work = work[..full.len()].to_vec();
        (full, half, work)
    })
}

/// The map with the largest gain less the price of its work, with every gain added up afresh;
/// `None` where none gains.
fn best_afresh(
    maps: &Maps,
    taken: &[(u32, MapScale)],
    objective: &Objective,
    price: f64,
) -> Option<(u32, MapScale)> {
    let (mut reached, nothing) = (Reached::new(objective), Reached::new(objective));
    taken
        .iter()
        .for_each(|&(cluster, scale)| reached.take(maps.row_at(cluster, scale)));
    let cost = |map: u32| FixedPoint::new(price, maps.work(map)).0;
    let gain = |reached: &Reached, map: u32| reached.whole_gain(maps.row(map));
    let left = (0..maps.len()).filter(|&map| {
        taken
            .iter()
            .all(|&(cluster, _)| cluster != maps.cluster(map))
    });
    let key = |&map: &u32| {
        (
            gain(&reached, map) - cost(map),
            gain(&nothing, map) - cost(map),
            Reverse(map),
        )
    };
    let best = left
        .filter(|&map| gain(&reached, map) > 0)
        .max_by_key(key)?;
    Some((maps.cluster(best), maps.scale(best)))
}

proptest! {
    #[test]
    fn of_two_sizes_the_one_that_gains_most_over_the_price_of_its_work_is_taken(
        (full, half, work) in two_sizes(), support in 1u32..3
    ) {
        let (full, half, objective) = (FulfilmentTable::new(&full), FulfilmentTable::new(&half), even(TRIANGLES, support));
        let maps = Maps::two_sizes(&full, &half, &work);
        let ranker = Ranker::new(&maps, &objective).unwrap();
        let prices = ranker.prices();
        for &price in prices.iter().step_by(5) {
            let order: Vec<_> = ranker.rank(&[], price, &NoWatcher).unwrap().maps().collect();
            for length in 0..=order.len() {
                prop_assert_eq!(order.get(length).copied(), best_afresh(&maps, &order[..length], &objective, price));
            }
        }
        // Without a price, size counts for nothing.
        let [free, one_size] = [ranker.rank(&[], prices[0], &NoWatcher).unwrap(), rank(&full, &objective)];
        prop_assert_eq!(free.maps().collect::<Vec<_>>(), one_size.maps().collect::<Vec<_>>());
        prop_assert_eq!((free.kept, free.fulfilment), (one_size.kept, one_size.fulfilment));
    }

    #[test]
    fn no_maps_of_two_sizes_exceed_the_bound_for_their_work(
        (full, half, work) in two_sizes(), support in 1u32..3, price in 0usize..20
    ) {
        prop_assume!(full.len() <= 6);
        let objective = even(TRIANGLES, support);
        let tables = [FulfilmentTable::new(&full), FulfilmentTable::new(&half)];
        let maps = Maps::two_sizes(&tables[0], &tables[1], &work);
        let ranker = Ranker::new(&maps, &objective).unwrap();
        let ranking = ranker.rank(&[], ranker.prices()[price], &NoWatcher).unwrap();
        let bounds: Vec<f64> =
            (0..=ranking.order.len()).map(|n| most_of_any(n, &maps, &objective, &ranking)).collect();
        let spent: Vec<f64> = (0..=ranking.order.len())
            .map(|n| ranking.maps().take(n).map(|(c, s)| work[c as usize][usize::from(s == MapScale::Half)]).sum())
            .collect();
        // Each cluster is left out, at full size or at half.
        for choice in 0..3usize.pow(full.len() as u32) {
            let sizes = (0..full.len()).map(|c| choice / 3usize.pow(c as u32) % 3);
            let (mut reached, mut cost) = (Reached::new(&objective), 0.0);
            for (cluster, size) in sizes.enumerate().filter(|&(_, size)| size < 2) {
                let map = cluster as u32 + if size == 1 { maps.clusters() } else { 0 };
                reached.take(maps.row(map));
                cost += work[cluster][size];
            }
            for (bound, spent) in bounds.iter().zip(&spent).filter(|(_, spent)| cost <= **spent) {
                prop_assert!(*bound >= reached.fulfilment() - 1e-9, "{bound} for {spent}, {} for {cost}", reached.fulfilment());
            }
        }
    }
}

#[test]
fn shares_of_two_sizes_are_of_all_at_full_size() {
    let full = FulfilmentTable::new([vec![(0, 0.8f32)], vec![(1, 0.4)]]);
    let half = FulfilmentTable::new([vec![(0, 0.6f32)], vec![(1, 0.3)]]);
    // Half size is cheap, so both are taken at half size.
    let work = [[1.0, 0.1]; 2];
    let (maps, objective) = (Maps::two_sizes(&full, &half, &work), even(2, 1));
    let ranker = Ranker::new(&maps, &objective).unwrap();
    let ranking = ranker.rank(&[], 0.2, &NoWatcher).unwrap();
    assert_eq!(ranking.scales, [MapScale::Half; 2]);
    assert!((ranking.reachable - 0.6).abs() < 1e-6);
    assert!((ranking.share(2) - 0.75).abs() < 1e-6);
    let shares = shares_by(&Objective::weighing(vec![3.0, 1.0], 1), &ranking, &maps);
    assert!(
        (shares[0] - 0.6 * 3.0 / 2.8).abs() < 1e-6 && (shares[1] - 0.75).abs() < 1e-6,
        "{shares:?}"
    );
    let of_full = shares_by(
        &objective,
        &rank(&full, &objective),
        &Maps::full_size(&full),
    );
    assert!(
        (of_full[0] - 2.0 / 3.0).abs() < 1e-6 && of_full[1] == 1.0,
        "{of_full:?}"
    );
    assert!(shares_by(&even(2, 1), &Ranking::default(), &maps).is_empty());
}

#[test]
fn the_guarantee_is_the_textbooks_where_one_map_is_enough() {
    assert!((even(1, 1).guarantee() - (1.0 - (-1f64).exp())).abs() < 1e-12);
    let credit = SINGLE_MAP_CREDIT / 2.0;
    assert!(
        (even(1, 3).guarantee() - (1.0 - (-2.0 * credit / (1.0 + credit)).exp())).abs() < 1e-12
    );
}

/// The mean excess of the bound over the optimum, over 40 tables of numbers that look random.
#[test]
fn the_bound_is_near_the_optimum() {
    for (support, most) in [(1, 0.02), (2, 0.05), (3, 0.06)] {
        let (mut excess, mut bounds) = (0.0, 0);
        for seed in 0..40u32 {
            let f = |c: u32, t: u32| {
                f32::from(((seed * 31 + c * 17 + t * 29 + c * t * (seed + 3)) % 97 % 9) as u8) / 8.0
            };
            let row = |c: u32| {
                (0..TRIANGLES)
                    .map(|t| (t, f(c, t) - 0.5))
                    .filter(|entry| entry.1 > 0.0)
                    .collect()
            };
            let rows: Vec<Vec<(u32, f32)>> = (0..8).map(row).collect();
            let (table, objective) = (FulfilmentTable::new(&rows), even(TRIANGLES, support));
            let ranking = rank(&table, &objective);
            for (n, optimum) in optima(&rows, support as usize)
                .into_iter()
                .enumerate()
                .skip(1)
                .take(6)
            {
                excess += most_of_any(n, &Maps::full_size(&table), &objective, &ranking) - optimum;
                bounds += 1;
            }
        }
        let excess = excess / f64::from(bounds);
        assert!(excess < most, "support {support}: {excess}");
    }
}

#[test]
fn shares_are_corrected_by_what_the_first_clusters_gave() {
    let expected = Ranking {
        kept: vec![0.1, 0.2, 0.3, 0.4],
        reachable: 0.4,
        ..Ranking::default()
    };
    let mut measured = expected.clone();
    measured.correct(2, 0.8);
    let shares: Vec<f64> = (1..=4).map(|length| measured.share(length)).collect();
    for (share, wanted) in shares.iter().zip([0.4, 0.8, 0.9, 1.0]) {
        assert!((share - wanted).abs() < 1e-12, "{shares:?}");
    }
    // All of them: nothing is left to be expected.
    let mut whole = expected.clone();
    whole.correct(4, 0.9);
    assert_eq!(whole, expected);
}
