//! Judged orders as a table of text.

use super::judge::{CellOrders, CellsEvaluation, NEEDED, TENTHS, at};

impl CellsEvaluation {
    /// Returns the orders as lines: the shares that their first maps cover, the way of ours, and
    /// the maps that each needs.
    pub fn lines(&self) -> Vec<String> {
        let both = [&self.all, &self.agreeing];
        let numbers = TENTHS.map(|tenth| at(tenth, self.maps).to_string());
        let cells = both.map(|kind| kind.cells);
        let mut lines = vec![
            format!("cells of {}", self.source.words()),
            format!(
                "  {:.0} cells of all {} maps, {:.0} where three maps agree",
                cells[0], self.maps, cells[1]
            ),
            String::new(),
            format!(
                "share of the cells that the first {} maps cover, %",
                numbers.join(", ")
            ),
            format!("{:14}{:>28}{:>28}", "", "all cells", "three maps agree"),
        ];
        for i in 0..both[0].orders.len() {
            let shares = both.map(|kind| kind.orders[i].covered.map(percent).concat());
            let name = both[0].orders[i].name;
            lines.push(format!("{name:14}{:>28}{:>28}", shares[0], shares[1]));
        }
        let way = both.map(|kind| kind.ours().way.map(way).concat());
        lines.push(format!("{:14}{:>28}{:>28}", "way of ours", way[0], way[1]));
        lines.push("  (0: every n-th, 1: the oracle, known only afterwards)".into());
        let shares = NEEDED.map(|share| format!("{:.0}", 100.0 * share));
        lines.extend([
            String::new(),
            format!("maps for {} % of the cells", shares.join(", ")),
        ]);
        for i in 0..both[0].orders.len() {
            let needed = both.map(|kind| needed(kind, i));
            let name = both[0].orders[i].name;
            lines.push(format!("{name:14}{:>28}{:>28}", needed[0], needed[1]));
        }
        lines
    }
}

fn percent(share: f64) -> String {
    format!("{:6.1}", 100.0 * share)
}

fn way(way: Option<f64>) -> String {
    way.map_or("     –".into(), |way| format!("{way:6.2}"))
}

fn needed(kind: &CellOrders, order: usize) -> String {
    let needed = kind.orders[order].needed;
    needed.map(|maps| format!("{maps:6}")).concat()
}
