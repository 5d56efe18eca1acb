//! The best choice of maps, known only afterwards.

use std::cmp::Reverse;

use super::incidence::{CountedCells, Incidence};

/// A cell that is covered, in the unit of the credits: sums of integers are exact, so that gains
/// can be kept up to date.
const WHOLE: u64 = 15;
/// Credits for a cell with all but one of the maps that it needs: no single one is best everywhere.
const CREDITS: [u64; 2] = [WHOLE / 5, WHOLE / 3];

/// Bound on the rows and maps that a greedy order looks at, some times the entries of a table of a
/// thousand maps. Those left are ordered by what they would add then.
const MOST_GREEDY: usize = 1 << 26;
/// Bound on those that the exchanges of single maps look at, for each choice.
const MOST_EXCHANGED: usize = 1 << 24;
/// Maps whose largest gain is kept.
const BLOCK: usize = 256;

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
        // The map before has been credited with this part of the cell.
        Some(0) => WHOLE - credit,
        Some(1) => credit,
        _ => 0,
    };
    let mut choice = Choice::new(table, counted, added, &[]);
    let mut order = Vec::new();
    while choice.work < MOST_GREEDY
        && let Some(map) = choice.best()
    {
        choice.set(map, true);
        order.push(map);
    }
    let mut left = table.usable();
    left.retain(|&map| !choice.has[map as usize]);
    // The sort is stable: ties stay by index.
    left.sort_by_key(|&map| Reverse(choice.gains[map as usize]));
    order.extend(left);
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
    // The sums to begin with would alone be more work than is allowed.
    if table.entries() >= MOST_EXCHANGED {
        return table.covered(&chosen, counted);
    }
    let support = table.support();
    let added = |taken| u64::from(taken + 1 == support);
    let mut choice = Choice::new(table, counted, added, &chosen);
    let (mut place, mut unchanged) = (0, 0);
    // A map is taken away and another added.
    while unchanged < chosen.len() && choice.work < MOST_EXCHANGED {
        let out = chosen[place];
        choice.set(out, false);
        let best = choice.best().unwrap_or(out);
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
    /// Chosen maps, and those that are in no cell.
    has: Vec<bool>,
    /// For each row, the number of chosen maps.
    taken: Vec<u32>,
    /// For each map, in the unit of `added`.
    gains: Vec<u64>,
    blocks: Vec<Block>,
    /// Number of rows and maps looked at.
    work: usize,
}

/// Some maps in a row.
#[derive(Clone, Copy)]
struct Block {
    /// No gain of those not chosen is larger; `None` if all are chosen.
    bound: Option<u64>,
    /// False if a gain may have become smaller.
    is_exact: bool,
}

impl Block {
    const UNKNOWN: Self = Self {
        bound: Some(u64::MAX),
        is_exact: false,
    };
}

impl<'a, F: Fn(u32) -> u64> Choice<'a, F> {
    fn new(table: &'a Incidence, counted: CountedCells, added: F, chosen: &[u32]) -> Self {
        let maps = 0..table.names().len() as u32;
        let mut has = vec![false; maps.len()];
        chosen.iter().for_each(|&map| has[map as usize] = true);
        let is_chosen = |map: &&u32| has[**map as usize];
        let mut gains = vec![0; maps.len()];
        let taken = (0..table.rows()).map(|row| {
            let maps = table.maps_of(row);
            let taken = maps.iter().filter(is_chosen).count() as u32;
            let gain = added(taken) * u64::from(table.cells(row, counted));
            if gain > 0 {
                maps.iter().for_each(|&map| gains[map as usize] += gain);
            }
            taken
        });
        let taken = taken.collect();
        maps.filter(|&map| table.rows_of(map).is_empty())
            .for_each(|map| has[map as usize] = true);
        Self {
            blocks: vec![Block::UNKNOWN; has.len().div_ceil(BLOCK)],
            table,
            counted,
            added,
            has,
            taken,
            gains,
            work: table.entries(),
        }
    }

    /// Adds a map, or takes it away.
    fn set(&mut self, map: u32, is_chosen: bool) {
        self.has[map as usize] = is_chosen;
        self.blocks[map as usize / BLOCK] = Block::UNKNOWN;
        let table = self.table;
        for &row in table.rows_of(map) {
            self.work += 1;
            let taken = &mut self.taken[row as usize];
            let before = (self.added)(*taken);
            *taken = if is_chosen { *taken + 1 } else { *taken - 1 };
            let now = (self.added)(*taken);
            let cells = u64::from(table.cells(row, self.counted));
            // Blocks are written, not read: those of a row are often one.
            if now > before {
                for &map in self.changed(row) {
                    self.gains[map as usize] += (now - before) * cells;
                    self.blocks[map as usize / BLOCK] = Block::UNKNOWN;
                }
            } else if now < before {
                for &map in self.changed(row) {
                    self.gains[map as usize] -= (before - now) * cells;
                    self.blocks[map as usize / BLOCK].is_exact = false;
                }
            }
        }
    }

    /// Returns the maps of a row whose gains change.
    fn changed(&mut self, row: u32) -> &'a [u32] {
        let maps = self.table.maps_of(row);
        self.work += maps.len();
        maps
    }

    /// Returns the map that adds most, of those that are not chosen; ties by index.
    fn best(&mut self) -> Option<u32> {
        self.work += self.blocks.len();
        let (mut most, mut found) = (None, 0);
        for (place, block) in self.blocks.iter_mut().enumerate() {
            if block.bound > most && !block.is_exact {
                self.work += BLOCK;
                let maps = place * BLOCK..self.gains.len().min((place + 1) * BLOCK);
                let others = maps.filter(|&map| !self.has[map]);
                block.bound = others.map(|map| self.gains[map]).max();
                block.is_exact = true;
            }
            if block.bound > most {
                (most, found) = (block.bound, place);
            }
        }
        let mut maps = found * BLOCK..self.gains.len();
        let is_best = |&map: &usize| !self.has[map] && Some(self.gains[map]) == most;
        maps.find(is_best).map(|map| map as u32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::apps::evaluate::{cells::incidence::Row, orders::random};

    /// The table of random rows of several blocks of maps.
    fn table() -> Incidence {
        let row = |seed: u32| {
            let mut maps = random(3 * BLOCK - 9, seed.into());
            maps.truncate(2 + seed as usize % 7);
            maps.sort_unstable();
            Row {
                maps,
                cells: seed % 5,
                agreeing: 0,
            }
        };
        let names = (0..3 * BLOCK).map(|name| name.to_string()).collect();
        Incidence::new(names, (0..900).map(row).collect(), 2)
    }

    #[test]
    fn the_best_map_is_the_first_of_those_that_add_most() {
        let table = table();
        let added = |taken: u32| [5, 10, 0][taken.min(2) as usize];
        let mut choice = Choice::new(&table, CountedCells::All, added, &[]);
        let (usable, mut order) = (table.usable(), Vec::new());
        for turn in 0..usable.len() {
            let others = usable.iter().filter(|map| !choice.has[**map as usize]);
            let best = others.max_by_key(|map| (choice.gains[**map as usize], Reverse(**map)));
            let found = choice.best();
            assert_eq!(found.as_ref(), best, "{turn}");
            choice.set(found.unwrap(), true);
            order.extend(found);
            // Gains become larger again, too.
            choice.set(order[turn / 2], false);
            choice.set(order[turn / 2], true);
            let anew = Choice::new(&table, CountedCells::All, added, &order);
            assert_eq!((&choice.gains, &choice.taken), (&anew.gains, &anew.taken));
        }
        assert_eq!(choice.best(), None);
    }

    #[test]
    fn very_many_maps_are_ordered_without_a_look_at_each_pair_of_them() {
        let maps = 60_000;
        let row = |map: u32| Row {
            maps: vec![map, map + 1],
            cells: 1 + map % 7,
            agreeing: 0,
        };
        let names = (0..maps).map(|name| name.to_string()).collect();
        let table = Incidence::new(names, (0..maps - 1).map(row).collect(), 2);
        let added = |taken: u32| [5, 10, 0][taken.min(2) as usize];
        let mut choice = Choice::new(&table, CountedCells::All, added, &[]);
        while let Some(map) = choice.best() {
            choice.set(map, true);
        }
        let pairs = (maps as usize).pow(2) / 2;
        assert!(choice.work < pairs / 20, "{}", choice.work);
    }

    #[test]
    fn all_maps_are_ordered_where_the_work_is_bounded() {
        // Each map is in all rows, so that no order is looked at to its end.
        let row = |_| Row {
            maps: (0..4000).collect(),
            cells: 1,
            agreeing: 1,
        };
        let names = (0..4000).map(|name| name.to_string()).collect();
        let table = Incidence::new(names, (0..4400).map(row).collect(), 60);
        assert!(table.entries() >= MOST_EXCHANGED);
        let order = greedy(&table, CountedCells::All, CREDITS[0]);
        let mut sorted = order.clone();
        sorted.sort_unstable();
        assert_eq!(sorted, table.usable());
        assert_eq!(best_of(&table, CountedCells::All, &[order], 60), 1.0);
    }

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
