//! Orders of the maps, judged by the cells that their first maps cover.

use std::collections::HashMap;

use serde::Serialize;

use super::{
    CellSource, every_nth,
    incidence::{CountedCells, Incidence},
    oracle,
};
use crate::{
    apps::evaluate::{curve::first_at, orders},
    model::{cluster::ViewCluster, scene::Scene},
};

/// Shares of the maps at which orders are compared.
pub const TENTHS: [f64; 4] = [0.1, 0.2, 0.3, 0.5];
/// Shares of the cells for which maps are counted.
pub const NEEDED: [f64; 4] = [0.5, 0.7, 0.8, 0.9];
/// Starts of evenly spread choices, in parts of the step between two.
const OFFSETS: [f64; 2] = [0.0, 0.5];
/// Number of random orders.
const RANDOM_SEEDS: u64 = 10;

/// Orders compared by the part of the fused cloud that their first maps give.
#[derive(Clone, Debug, Serialize)]
pub struct CellsEvaluation {
    pub source: CellSource,
    /// Number of maps that take part in any cell.
    pub maps: usize,
    /// Cells of the cloud of all maps.
    pub all: CellOrders,
    /// Those of them where three maps agree.
    pub agreeing: CellOrders,
}

/// Orders compared by one kind of cells.
#[derive(Clone, Debug, Serialize)]
pub struct CellOrders {
    /// Number of cells of the table.
    pub cells: f64,
    /// Ours first, the oracle last.
    pub orders: Vec<JudgedOrder>,
}

/// An order of the maps, with the cells that its first maps cover.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct JudgedOrder {
    pub name: &'static str,
    /// Share of the cells that the first i maps cover, i = 0, 1, ...; for choices of several
    /// starts or seeds their mean.
    pub curve: Vec<f64>,
    /// The same at 10, 20, 30 and 50 % of the maps.
    pub covered: [f64; 4],
    /// Position at these between every n-th (0) and the oracle (1); null where both are equal.
    pub way: [Option<f64>; 4],
    /// Maps for 50, 70, 80 and 90 % of the cells.
    pub needed: [usize; 4],
}

impl CellsEvaluation {
    /// Judges these orders of key views, each with its name, ours first, and every n-th, random and
    /// the oracle.
    pub fn new(
        table: &Incidence,
        source: CellSource,
        scene: &Scene,
        clusters: &[(&'static str, Vec<&ViewCluster>)],
    ) -> Self {
        let usable = table.usable();
        let named = usable
            .iter()
            .map(|&map| (&*table.names()[map as usize], map));
        let of_name: HashMap<&str, u32> = named.collect();
        let map = |cluster: &&ViewCluster| of_name.get(scene.name(cluster.key)).copied();
        let of_names = clusters.iter().map(|(name, clusters)| {
            let order: Vec<u32> = clusters.iter().filter_map(map).collect();
            (*name, table.curves(&order))
        });
        let mut curves: Vec<(&str, [Vec<f64>; 2])> = of_names.collect();
        curves.push(("every n-th", every_nth(table, &usable)));
        curves.push(("random", random(table, &usable)));
        let [all, agreeing] = CountedCells::BOTH.map(|counted| {
            let of_kind = |(name, kinds): &(&'static str, [Vec<f64>; 2])| {
                (*name, kinds[counted as usize].clone())
            };
            CellOrders::new(table, counted, curves.iter().map(of_kind).collect())
        });
        Self {
            source,
            maps: usable.len(),
            all,
            agreeing,
        }
    }

    /// The two kinds of cells, each with its name.
    pub fn kinds(&self) -> [(&'static str, &CellOrders); 2] {
        [
            ("all cells", &self.all),
            ("cells where three maps agree", &self.agreeing),
        ]
    }
}

impl CellOrders {
    /// Judges these curves, of which every n-th is the last but one, and the oracle.
    fn new(
        table: &Incidence,
        counted: CountedCells,
        mut curves: Vec<(&'static str, Vec<f64>)>,
    ) -> Self {
        let usable = table.usable();
        let spread = curves.len() - 2;
        let best = oracle::orders(table, counted);
        let of = |order: &Vec<u32>| {
            let [all, agreeing] = table.curves(order);
            if counted == CountedCells::All {
                all
            } else {
                agreeing
            }
        };
        let greedy: Vec<Vec<f64>> = best.iter().map(of).collect();
        let mut oracle = highest(&greedy);
        // Only at the numbers that are compared, since each takes a search of its own.
        for number in TENTHS.map(|tenth| at(tenth, usable.len())) {
            let found = oracle::best_of(table, counted, &best, number);
            if let Some(covered) = oracle.get_mut(number) {
                *covered = covered.max(found);
            }
        }
        curves.push(("oracle", oracle));
        let at_tenths = |curve: &[f64]| {
            TENTHS.map(|tenth| {
                curve
                    .get(at(tenth, usable.len()))
                    .or(curve.last())
                    .copied()
                    .unwrap_or(0.0)
            })
        };
        let (first, last) = (
            at_tenths(&curves[spread].1),
            at_tenths(&curves[curves.len() - 1].1),
        );
        let judged = |(name, curve): (&'static str, Vec<f64>)| {
            let covered = at_tenths(&curve);
            let way = [0, 1, 2, 3].map(|i| {
                let whole = last[i] - first[i];
                (whole > 0.0).then(|| (covered[i] - first[i]) / whole)
            });
            let needed = NEEDED.map(|share| first_at(&curve, share).unwrap_or(usable.len()));
            JudgedOrder {
                name,
                curve,
                covered,
                way,
                needed,
            }
        };
        Self {
            cells: table.total(counted),
            orders: curves.into_iter().map(judged).collect(),
        }
    }

    pub fn ours(&self) -> &JudgedOrder {
        &self.orders[0]
    }
}

/// The curves of choices that are evenly spread over the names of the maps.
fn every_nth(table: &Incidence, usable: &[u32]) -> [Vec<f64>; 2] {
    let mut by_name = usable.to_vec();
    by_name.sort_by_key(|&map| &table.names()[map as usize]);
    mean(OFFSETS.map(|offset| every_nth::shares(table, &by_name, offset)))
}

/// The curves of random orders.
fn random(table: &Incidence, usable: &[u32]) -> [Vec<f64>; 2] {
    let curves = (0..RANDOM_SEEDS).map(|seed| {
        let order = orders::random(usable.len(), seed).into_iter();
        table.curves(&order.map(|i| usable[i as usize]).collect::<Vec<_>>())
    });
    mean(curves)
}

/// Number of maps at a share of them; fusion needs two.
pub(super) fn at(tenth: f64, maps: usize) -> usize {
    ((tenth * maps as f64).round() as usize).max(2).min(maps)
}

/// The means of both kinds of curves.
fn mean(curves: impl IntoIterator<Item = [Vec<f64>; 2]>) -> [Vec<f64>; 2] {
    let (mut number, mut sums) = (0.0, [Vec::new(), Vec::new()]);
    for curves in curves {
        number += 1.0;
        for (sums, curve) in sums.iter_mut().zip(curves) {
            sums.resize(curve.len(), 0.0);
            sums.iter_mut()
                .zip(curve)
                .for_each(|(sum, share)| *sum += share);
        }
    }
    sums.map(|sums: Vec<f64>| sums.into_iter().map(|sum| sum / number).collect())
}

fn highest(curves: &[Vec<f64>]) -> Vec<f64> {
    let best = |i: usize| curves.iter().map(|curve| curve[i]).fold(0.0, f64::max);
    (0..curves[0].len()).map(best).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::apps::evaluate::cells::incidence::Row;

    #[test]
    fn ours_is_between_every_nth_and_the_oracle() {
        // Pairs of maps that agree only with each other, the first of them in ten times the cells.
        let row = |pair: u32| Row {
            maps: vec![pair, pair + 5],
            cells: if pair == 0 { 10 } else { 1 },
            agreeing: 0,
        };
        let names = (0..10).map(|name| name.to_string()).collect();
        let table = Incidence::new(names, (0..5).map(row).collect(), 2);
        let usable = table.usable();
        let ours = table.curves(&[1, 6, 0, 5, 2, 7, 3, 8, 4, 9]);
        let curves = [
            ("ours", ours),
            ("every n-th", every_nth(&table, &usable)),
            ("random", random(&table, &usable)),
        ];
        let curves = curves.map(|(name, [all, _])| (name, all)).to_vec();
        let judged = CellOrders::new(&table, CountedCells::All, curves);
        let [ours, spread, .., oracle] = &judged.orders[..] else {
            unreachable!()
        };
        assert_eq!(
            ours.covered,
            [1.0 / 14.0, 1.0 / 14.0, 1.0 / 14.0, 12.0 / 14.0 - 1.0 / 14.0]
        );
        assert_eq!(oracle.covered[1], 10.0 / 14.0);
        assert_eq!((spread.way[1], oracle.way[1]), (Some(0.0), Some(1.0)));
        assert_eq!((ours.needed[0], oracle.needed[0]), (4, 2));
    }
}
