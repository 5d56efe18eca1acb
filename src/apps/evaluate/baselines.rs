//! Orders of the same clusters side by side (method 8).

use serde::Serialize;

use super::{
    cells::order_in_words,
    curve::{ReachCurve, SHARES},
    orders,
    run::MeasuredClusters,
};
use crate::{
    base::{column::TableError, progress::Watcher},
    method::{
        fulfilment::Model,
        ranking::{Beliefs, Objective},
    },
};

/// Key views and pairs that an order needs to reach a share of the weight that fusion really keeps
/// of all clusters together.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RequiredWork {
    pub share: f64,
    pub clusters: f64,
    pub pairs: f64,
}

/// An order of the clusters, with its name and results.
#[derive(Clone, Debug, Serialize)]
pub struct Order {
    pub name: &'static str,
    /// Work needed for 10, 20, ... 90 %; for `random`, the mean over its seeds.
    pub needed: Vec<RequiredWork>,
    /// Standard deviation, over the seeds, of the number of key views needed; empty except for
    /// `random`.
    pub spread: Vec<f64>,
    /// Weight of the triangles that fusion really keeps after i clusters, i = 0, 1, ...; for
    /// `random`, the mean over its seeds.
    pub kept: Vec<f64>,
    /// Number of pairs after i clusters; for `random`, the mean over its seeds.
    pub pairs: Vec<f64>,
}

/// Returns the orders that are compared, each with its name: ours first. `all`: also those that
/// look at finished maps while others are computed.
pub fn named(
    run: &MeasuredClusters,
    model: &Model,
    objective: &Objective,
    all: bool,
    watcher: &dyn Watcher,
) -> Result<Vec<(&'static str, Vec<u32>)>, TableError> {
    let mut named = vec![
        ("ours", run.order.clone()),
        ("nocp", orders::greedy(&run.nocp, objective, watcher)?),
    ];
    if all {
        let beliefs = Beliefs::new(model.scene, model.surface, &run.clusters, &run.predicted);
        let updated = orders::real_update(&run.predicted, &run.real, objective);
        named.push(("realupdate", updated));
        named.push(("replan", orders::replan(beliefs, run, objective)));
    }
    named.push(("maxpts", orders::max_points(model.scene, &run.clusters)));
    let farthest = orders::farthest_view(model.scene, &run.clusters);
    named.push(("farthest view", farthest));
    Ok(named)
}

/// Compares orders of the clusters by the fulfilment of each triangle, as the paper does; the
/// optimum comes last.
pub fn compare(
    run: &MeasuredClusters,
    model: &Model,
    objective: &Objective,
    watcher: &dyn Watcher,
) -> Result<Vec<Order>, TableError> {
    let clusters = run.clusters.len();
    let total = run.real_curve(objective, &run.order).total_kept();
    let one = |name, order: &[u32]| Order::new(name, &[run.real_curve(objective, order)], total);
    let random: Vec<ReachCurve> = (0..orders::RANDOM_SEEDS)
        .map(|seed| run.real_curve(objective, &orders::random(clusters, seed)))
        .collect();
    let named = named(run, model, objective, true, watcher)?;
    let mut compared: Vec<Order> = named.iter().map(|(name, order)| one(name, order)).collect();
    compared.push(Order::new(
        "every n-th",
        &[every_nth(run, objective)],
        total,
    ));
    compared.push(Order::new("random", &random, total));
    let optimum = orders::greedy(&run.real, objective, watcher)?;
    compared.push(one("optimum", &optimum));
    Ok(compared)
}

/// Returns the key views or pairs needed as text, with the names of the orders that need as many;
/// equal rows are one row.
pub fn rows(orders: &[Order], pairs: bool) -> Vec<(Vec<&'static str>, Vec<String>)> {
    let mut rows: Vec<(Vec<&str>, Vec<String>)> = Vec::new();
    for order in orders {
        // A mean over seeds need not be a whole number.
        let digits = usize::from(!order.spread.is_empty());
        let cell = |needed: &RequiredWork| {
            format!(
                "{:.digits$}",
                if pairs { needed.pairs } else { needed.clusters }
            )
        };
        let cells: Vec<String> = order.needed.iter().map(cell).collect();
        match rows.iter_mut().find(|(_, other)| *other == cells) {
            Some((names, _)) => names.push(order_in_words(order.name)),
            None => rows.push((vec![order_in_words(order.name)], cells)),
        }
    }
    rows
}

impl Order {
    /// Summarises the curve of an order, or the curves of several seeds.
    fn new(name: &'static str, curves: &[ReachCurve], total: f64) -> Self {
        let count = curves.len() as f64;
        let last = |values: &ReachCurve| values.kept.len() - 1;
        let clusters_for =
            |c: &ReachCurve, share: f64| c.clusters_for(share * total).unwrap_or(last(c));
        let mean =
            |value: &dyn Fn(&ReachCurve) -> f64| curves.iter().map(value).sum::<f64>() / count;
        let needed = SHARES.map(|share| RequiredWork {
            share,
            clusters: mean(&|c| clusters_for(c, share) as f64),
            pairs: mean(&|c| c.pairs[clusters_for(c, share)] as f64),
        });
        let deviation = |needed: &RequiredWork| {
            let squares =
                mean(&|c| (clusters_for(c, needed.share) as f64 - needed.clusters).powi(2));
            squares.sqrt()
        };
        let spread = if curves.len() > 1 {
            needed.iter().map(deviation).collect()
        } else {
            Vec::new()
        };
        let entries = 0..curves[0].kept.len();
        Self {
            name,
            spread,
            kept: entries.clone().map(|i| mean(&|c| c.kept[i])).collect(),
            pairs: entries.map(|i| mean(&|c| c.pairs[i] as f64)).collect(),
            needed: needed.to_vec(),
        }
    }
}

/// Returns the curve of evenly spread clusters: entry i has a choice of i clusters of its own.
/// Where it keeps less than a smaller choice, the larger value is carried on.
fn every_nth(run: &MeasuredClusters, objective: &Objective) -> ReachCurve {
    let mut curve = ReachCurve::start();
    for count in 1..=run.clusters.len() {
        let taken = run.real_curve(objective, &orders::every_nth(run.clusters.len(), count));
        let (kept, before) = (taken.total_kept(), curve.total_kept());
        curve.fulfilment.push(taken.total().max(curve.total()));
        curve.kept.push(kept.max(before));
        curve.pairs.push(if kept > before {
            taken.pairs[count]
        } else {
            curve.pairs[count - 1]
        });
    }
    curve
}
