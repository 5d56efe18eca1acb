//! Judged orders as a table of text.

use super::judge::{CellOrders, CellsEvaluation, NEEDED, TENTHS, at};
use crate::base::decimals::to_decimals;

/// Names of the orders for users (method 8); the others are words already.
const NAMES: [(&str, &str); 5] = [
    ("ours", "viewrank"),
    ("nocp", "without prediction"),
    ("realupdate", "updated by results"),
    ("replan", "replanned"),
    ("maxpts", "most sparse points"),
];

/// Name of an order for users.
pub fn order_in_words(order: &'static str) -> &'static str {
    let known = NAMES.iter().find(|(name, _)| *name == order);
    known.map_or(order, |(_, words)| words)
}

impl CellsEvaluation {
    /// Returns the orders as lines: the shares that their first maps cover, the way of ours, and
    /// the maps that each needs.
    pub fn lines(&self) -> Vec<String> {
        let both = [&self.all, &self.agreeing];
        let numbers = TENTHS.map(|tenth| at(tenth, self.maps));
        // Of few maps, several tenths are the same number.
        let mut columns: Vec<usize> = (0..TENTHS.len()).collect();
        columns.dedup_by_key(|column| numbers[*column]);
        let of_columns = |values: [String; TENTHS.len()]| -> String {
            columns.iter().map(|&column| &*values[column]).collect()
        };
        let cells = both.map(|kind| kind.cells);
        let mut lines = vec![
            format!("cells of {}", self.source.describe()),
            format!(
                "  {:.0} cells of these {} maps, {:.0} where three maps agree",
                cells[0], self.maps, cells[1]
            ),
            String::new(),
            "share of the area (cells) that the first maps of an order cover, %".into(),
            row("", ["all cells".into(), "three maps agree".into()]),
        ];
        let head = of_columns(numbers.map(|number| format!("{number:6}")));
        lines.push(row("number of maps", [head.clone(), head]));
        for i in 0..both[0].orders.len() {
            let shares = both.map(|kind| of_columns(kind.orders[i].covered.map(percent)));
            lines.push(row(order_in_words(both[0].orders[i].name), shares));
        }
        let way = both.map(|kind| of_columns(kind.ours().way.map(way)));
        lines.push(row("viewrank's way", way));
        lines.push(
            "  way: from every n-th, 0, to the oracle, 1, the best order that these maps allow"
                .into(),
        );
        lines.extend([
            String::new(),
            "maps that an order takes for a share of the area (cells)".into(),
        ]);
        let head = NEEDED
            .map(|share| format!("{:>6}", format!("{:.0} %", 100.0 * share)))
            .concat();
        lines.push(row("share", [head.clone(), head]));
        for i in 0..both[0].orders.len() {
            let needed = both.map(|kind| needed(kind, i));
            lines.push(row(order_in_words(both[0].orders[i].name), needed));
        }
        lines
    }
}

/// A line with an order's name, and its numbers for all cells and for those where three maps agree.
fn row(name: &str, [all, agreeing]: [String; 2]) -> String {
    format!("{name:22}{all:>25}{agreeing:>27}")
}

fn percent(share: f64) -> String {
    format!("{:6.1}", 100.0 * share)
}

fn way(way: Option<f64>) -> String {
    way.map_or("     –".into(), |way| {
        format!("{:6.2}", to_decimals(way, 2))
    })
}

fn needed(kind: &CellOrders, order: usize) -> String {
    let needed = kind.orders[order].needed;
    needed.map(|maps| format!("{maps:6}")).concat()
}
