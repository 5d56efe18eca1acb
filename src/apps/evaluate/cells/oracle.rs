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

/// Returns greedy orders by the real cells, one for each credit.
pub fn orders(table: &Incidence, counted: CountedCells) -> Vec<Vec<u32>> {
    CREDITS
        .iter()
        .map(|&credit| greedy(table, counted, credit))
        .collect()
}

/// The map next that adds most cells; ties by index.
fn greedy(table: &Incidence, counted: CountedCells, credit: u64) -> Vec<u32> {
    let value = |taken: u32| match table.support().checked_sub(taken + 1) {
        Some(0) if taken == 0 => WHOLE,
        Some(0) => WHOLE - credit,
        Some(1) => credit,
        _ => 0,
    };
    let weight = |row: u32| counted.of(&table.rows()[row as usize]) as u64;
    let mut taken = vec![0; table.rows().len()];
    let gain = |map: u32| -> u64 {
        let rows = table.rows_of(map).iter();
        rows.map(|&row| value(0) * weight(row)).sum()
    };
    let mut gains: Vec<u64> = (0..table.names().len() as u32).map(gain).collect();
    let (mut left, mut order) = (table.usable(), Vec::new());
    while let Some(&map) = left
        .iter()
        .max_by_key(|&&map| (gains[map as usize], Reverse(map)))
    {
        left.retain(|&other| other != map);
        for &row in table.rows_of(map) {
            let before = value(taken[row as usize]) * weight(row);
            taken[row as usize] += 1;
            let now = value(taken[row as usize]) * weight(row);
            if now != before {
                let maps = table.rows()[row as usize].maps.iter();
                maps.for_each(|&map| gains[map as usize] = gains[map as usize] + now - before);
            }
        }
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

fn exchanged(table: &Incidence, counted: CountedCells, chosen: Vec<u32>) -> f64 {
    let usable = table.usable();
    let entries: usize = usable.iter().map(|&map| table.rows_of(map).len()).sum();
    let mut choice = Choice::new(table, counted, chosen);
    let (mut place, mut unchanged) = (0, 0);
    let mut left = MOST_STEPS / entries.max(1);
    while unchanged < choice.maps.len() && left > 0 {
        left -= 1;
        let out = choice.maps[place];
        choice.take_away(out);
        let own = choice.gains[out as usize];
        let others = usable.iter().copied();
        let others = others.filter(|&map| map == out || !choice.has[map as usize]);
        let gain = |map: &u32| (choice.gains[*map as usize], Reverse(*map));
        let best = others.max_by_key(gain).unwrap_or(out);
        let is_better = choice.gains[best as usize] > own;
        let enters = if is_better { best } else { out };
        choice.maps[place] = enters;
        choice.add(enters);
        unchanged = if is_better { 0 } else { unchanged + 1 };
        place = (place + 1) % choice.maps.len();
    }
    table.covered(&choice.maps, counted)
}

/// Chosen maps, with the cells that each map would add to them. Few rows change with a map, so that
/// what they add is kept up to date and not counted anew.
struct Choice<'a> {
    table: &'a Incidence,
    counted: CountedCells,
    maps: Vec<u32>,
    /// Which maps are chosen.
    has: Vec<bool>,
    /// For each row, the number of chosen maps.
    taken: Vec<u32>,
    /// For each map, the cells that have all but one of the maps that they need, and it.
    gains: Vec<u64>,
}

impl<'a> Choice<'a> {
    fn new(table: &'a Incidence, counted: CountedCells, maps: Vec<u32>) -> Self {
        let mut choice = Self {
            table,
            counted,
            maps: Vec::new(),
            has: vec![false; table.names().len()],
            taken: vec![0; table.rows().len()],
            gains: vec![0; table.names().len()],
        };
        if table.support() == 1 {
            (0..table.rows().len() as u32).for_each(|row| choice.give(row));
        }
        maps.iter().for_each(|&map| choice.add(map));
        choice.maps = maps;
        choice
    }

    fn add(&mut self, map: u32) {
        self.has[map as usize] = true;
        for &row in self.table.rows_of(map) {
            self.lacks_one(row, Self::withdraw);
            self.taken[row as usize] += 1;
            self.lacks_one(row, Self::give);
        }
    }

    fn take_away(&mut self, map: u32) {
        self.has[map as usize] = false;
        for &row in self.table.rows_of(map) {
            self.lacks_one(row, Self::withdraw);
            self.taken[row as usize] -= 1;
            self.lacks_one(row, Self::give);
        }
    }

    fn lacks_one(&mut self, row: u32, change: fn(&mut Self, u32)) {
        if self.taken[row as usize] + 1 == self.table.support() {
            change(self, row);
        }
    }

    /// Counts the row's cells as a gain of its maps.
    fn give(&mut self, row: u32) {
        let row = &self.table.rows()[row as usize];
        let cells = self.counted.of(row) as u64;
        row.maps
            .iter()
            .for_each(|&map| self.gains[map as usize] += cells);
    }

    fn withdraw(&mut self, row: u32) {
        let row = &self.table.rows()[row as usize];
        let cells = self.counted.of(row) as u64;
        row.maps
            .iter()
            .for_each(|&map| self.gains[map as usize] -= cells);
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
