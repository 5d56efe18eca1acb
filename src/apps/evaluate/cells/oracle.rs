//! The best choice of maps, known only afterwards.

use std::cmp::Reverse;

use super::incidence::{CountedCells, Incidence};

/// A cell that is covered, in the unit of the credits: sums of integers are exact, so that gains can
/// be kept up to date.
const WHOLE: u64 = 15;
/// Credits for a cell with all but one of the maps that it needs: no single one is best everywhere.
const CREDITS: [u64; 2] = [WHOLE / 5, WHOLE / 3];

/// Bound on the exchanges of single maps: their number times the entries of the table.
const MOST_STEPS: usize = 1_000_000_000;
/// Bound on the rows that they change.
const MOST_ROWS: usize = 8_000_000;

/// Returns greedy orders by the real cells, one for each credit.
pub fn orders(table: &Incidence, counted: CountedCells) -> Vec<Vec<u32>> {
    CREDITS
        .iter()
        .map(|&credit| greedy(table, counted, credit))
        .collect()
}

/// The map next that adds most cells; ties by index.
fn greedy(table: &Incidence, counted: CountedCells, credit: u64) -> Vec<u32> {
    let support = table.support();
    let added = |taken: u32| match support.checked_sub(taken + 1) {
        Some(0) if taken == 0 => WHOLE,
        Some(0) => WHOLE - credit,
        Some(1) => credit,
        _ => 0,
    };
    let mut choice = Choice::new(table, counted, added);
    let (mut left, mut order) = (table.usable(), Vec::new());
    while let Some(map) = choice.best(&left) {
        left.retain(|&other| other != map);
        choice.set(map, true);
        order.push(map);
    }
    order
}

/// Returns the largest share found for this number of maps: single maps of the greedy choices are
/// exchanged until no exchange helps.
pub fn best_of(
    table: &Incidence,
    counted: CountedCells,
    orders: &[Vec<u32>],
    number: usize,
) -> f64 {
    let choices = orders.iter().map(|order| &order[..number.min(order.len())]);
    let covered = choices.map(|choice| exchanged(table, counted, choice.to_vec()));
    covered.fold(0.0, f64::max)
}

fn exchanged(table: &Incidence, counted: CountedCells, mut chosen: Vec<u32>) -> f64 {
    let usable = table.usable();
    let entries: usize = usable.iter().map(|&map| table.rows_of(map).len()).sum();
    let support = table.support();
    let mut choice = Choice::new(table, counted, |taken| u64::from(taken + 1 == support));
    chosen.iter().for_each(|&map| choice.set(map, true));
    let (mut place, mut unchanged) = (0, 0);
    // A map is taken away and another added.
    let rows = 2 * entries / usable.len().max(1);
    let mut left = (MOST_STEPS / entries.max(1)).min(MOST_ROWS / rows.max(1));
    while unchanged < chosen.len() && left > 0 {
        left -= 1;
        let out = chosen[place];
        choice.set(out, false);
        let best = choice.best(&usable).unwrap_or(out);
        let is_better = choice.gains[best as usize] > choice.gains[out as usize];
        chosen[place] = if is_better { best } else { out };
        choice.set(chosen[place], true);
        unchanged = if is_better { 0 } else { unchanged + 1 };
        place = (place + 1) % chosen.len();
    }
    table.covered(&chosen, counted)
}

/// Chosen maps, and what each other map would add to them. Few rows change with a map, so the gains
/// are kept up to date instead of being summed anew.
struct Choice<'a, F> {
    table: &'a Incidence,
    counted: CountedCells,
    /// Gain from one more map in a cell that this number of chosen maps show.
    added: F,
    has: Vec<bool>,
    /// For each row, the number of chosen maps.
    taken: Vec<u32>,
    /// For each map, in the unit of `added`.
    gains: Vec<u64>,
}

impl<'a, F: Fn(u32) -> u64> Choice<'a, F> {
    /// Starts without any map.
    fn new(table: &'a Incidence, counted: CountedCells, added: F) -> Self {
        let of_row = |&row: &u32| added(0) * u64::from(table.cells(row, counted));
        let gain = |map: u32| table.rows_of(map).iter().map(of_row).sum();
        Self {
            has: vec![false; table.names().len()],
            taken: vec![0; table.rows() as usize],
            gains: (0..table.names().len() as u32).map(gain).collect(),
            table,
            counted,
            added,
        }
    }

    /// Adds a map, or takes it away.
    fn set(&mut self, map: u32, is_chosen: bool) {
        self.has[map as usize] = is_chosen;
        for &row in self.table.rows_of(map) {
            let taken = &mut self.taken[row as usize];
            let before = (self.added)(*taken);
            *taken = if is_chosen { *taken + 1 } else { *taken - 1 };
            let now = (self.added)(*taken);
            if now != before {
                let cells = u64::from(self.table.cells(row, self.counted));
                let gains = &mut self.gains;
                self.table.maps_of(row).iter().for_each(|&map| {
                    let gain = &mut gains[map as usize];
                    *gain = *gain + now * cells - before * cells;
                });
            }
        }
    }

    /// Returns the one of these maps that adds most, of those that are not chosen; ties by index.
    fn best(&self, maps: &[u32]) -> Option<u32> {
        let others = maps.iter().copied();
        let others = others.filter(|&map| !self.has[map as usize]);
        others.max_by_key(|&map| (self.gains[map as usize], Reverse(map)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::apps::evaluate::cells::incidence::Row;

    #[test]
    fn an_exchange_finds_what_greedy_misses() {
        // The pair 0, 1 gives most at once; 2, 3 and 4 give more together.
        let rows = [
            (vec![0, 1], 5),
            (vec![2, 3], 4),
            (vec![3, 4], 4),
            (vec![2, 4], 4),
        ];
        let row = |(maps, cells): (Vec<u32>, u32)| Row {
            maps,
            cells,
            agreeing: cells,
        };
        let names = (0..5).map(|name| name.to_string()).collect();
        let table = Incidence::new(names, rows.map(row).into(), 2);
        let orders = orders(&table, CountedCells::All);
        assert_eq!(best_of(&table, CountedCells::All, &orders, 3), 12.0 / 17.0);
        assert_eq!(best_of(&table, CountedCells::All, &orders, 0), 0.0);
    }
}
