//! Orders of the maps, judged by the cells that their first maps cover.

use std::collections::HashMap;

use serde::Serialize;

use super::{
    CellSource, every_nth,
    incidence::{CountedCells, Incidence},
    oracle,
};
use crate::{
    apps::evaluate::orders,
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
        let named = clusters
            .iter()
            .map(|(name, clusters)| (*name, clusters.iter().filter_map(map).collect::<Vec<u32>>()));
        let named: Vec<_> = named.collect();
        let orders = |counted| CellOrders::new(table, counted, &named);
        Self {
            source,
            maps: usable.len(),
            all: orders(CountedCells::All),
            agreeing: orders(CountedCells::Agreeing),
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
    fn new(table: &Incidence, counted: CountedCells, named: &[(&'static str, Vec<u32>)]) -> Self {
        let usable = table.usable();
        let of = |order: &Vec<u32>| table.curve(order, counted);
        let random: Vec<_> = (0..RANDOM_SEEDS)
            .map(|seed| orders::random(usable.len(), seed))
            .map(|order| of(&order.iter().map(|&i| usable[i as usize]).collect()))
            .collect();
        let mut by_name = usable.clone();
        by_name.sort_by_key(|&map| &table.names()[map as usize]);
        let spread = OFFSETS.map(|offset| every_nth::shares(table, counted, &by_name, offset));
        let best = oracle::orders(table, counted);
        let mut curves: Vec<(&str, Vec<f64>)> = named
            .iter()
            .map(|(name, order)| (*name, of(order)))
            .collect();
        curves.push(("every n-th", mean(&spread)));
        curves.push(("random", mean(&random)));
        let greedy: Vec<Vec<f64>> = best.iter().map(of).collect();
        let mut oracle = highest(&greedy);
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
            at_tenths(&curves[named.len()].1),
            at_tenths(&curves[curves.len() - 1].1),
        );
        let judged = |(name, curve): (&'static str, Vec<f64>)| {
            let covered = at_tenths(&curve);
            let way = [0, 1, 2, 3].map(|i| {
                let whole = last[i] - first[i];
                (whole > 0.0).then(|| (covered[i] - first[i]) / whole)
            });
            let needed = NEEDED.map(|share| least(&curve, share).unwrap_or(usable.len()));
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

/// Number of maps at a share of them; fusion needs two.
pub(super) fn at(tenth: f64, maps: usize) -> usize {
    ((tenth * maps as f64).round() as usize).max(2).min(maps)
}

/// Smallest number of first maps that cover a share.
fn least(curve: &[f64], share: f64) -> Option<usize> {
    curve.iter().position(|&covered| covered >= share - 1e-9)
}

fn mean(curves: &[Vec<f64>]) -> Vec<f64> {
    let sum = |i: usize| curves.iter().map(|curve| curve[i]).sum::<f64>();
    (0..curves[0].len())
        .map(|i| sum(i) / curves.len() as f64)
        .collect()
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
        let ours = vec![("ours", vec![1, 6, 0, 5, 2, 7, 3, 8, 4, 9])];
        let judged = CellOrders::new(&table, CountedCells::All, &ours);
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
