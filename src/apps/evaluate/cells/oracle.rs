//! The best choice of maps, known only afterwards.

use std::cmp::Reverse;

use super::incidence::{CountedCells, Incidence};
use crate::apps::evaluate::orders::first_largest;

/// A cell that is covered, in the unit of the credits: sums of integers are exact, so that gains can
/// be kept up to date.
const WHOLE: u64 = 15;
/// Credits for a cell with all but one of the maps that it needs: no single one is best everywhere.
const CREDITS: [u64; 2] = [WHOLE / 5, WHOLE / 3];

/// Entries of the table that exchanges of single maps look at: a second or two.
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

fn exchanged(table: &Incidence, counted: CountedCells, mut chosen: Vec<u32>) -> f64 {
    let weight = |row: u32| counted.of(&table.rows()[row as usize]);
    let mut taken = vec![0u32; table.rows().len()];
    for &map in &chosen {
        table
            .rows_of(map)
            .iter()
            .for_each(|&row| taken[row as usize] += 1);
    }
    let usable = table.usable();
    let entries: usize = usable.iter().map(|&map| table.rows_of(map).len()).sum();
    let mut is_chosen = vec![false; table.names().len()];
    chosen
        .iter()
        .for_each(|&map| is_chosen[map as usize] = true);
    let (mut place, mut unchanged) = (0, 0);
    let mut left = MOST_STEPS / entries.max(1);
    while unchanged < chosen.len() && left > 0 {
        left -= 1;
        let out = chosen[place];
        let rows = table.rows_of(out);
        rows.iter().for_each(|&row| taken[row as usize] -= 1);
        // What each map adds to the choice without this one.
        let gain = |map: u32| -> f64 {
            let rows = table.rows_of(map).iter();
            rows.filter(|&&row| taken[row as usize] + 1 == table.support())
                .map(|&row| weight(row))
                .sum()
        };
        let own = gain(out);
        let others: Vec<u32> = usable
            .iter()
            .copied()
            .filter(|&map| map == out || !is_chosen[map as usize])
            .collect();
        let best = others[first_largest(others.iter().map(|&map| gain(map)))];
        let (enters, is_better) = if gain(best) > own {
            (best, true)
        } else {
            (out, false)
        };
        chosen[place] = enters;
        is_chosen[out as usize] = false;
        is_chosen[enters as usize] = true;
        table
            .rows_of(enters)
            .iter()
            .for_each(|&row| taken[row as usize] += 1);
        unchanged = if is_better { 0 } else { unchanged + 1 };
        place = (place + 1) % chosen.len();
    }
    table.covered(&chosen, counted)
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
