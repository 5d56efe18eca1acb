//! Choices of maps that are evenly spread over their names, of each number of maps.
//!
//! They are not nested, so that each would need a look at all cells. All are looked at together: a
//! set of choices is a row of bits.

use super::incidence::{CountedCells, Incidence};

/// Most choices that are looked at; shares of others are interpolated.
const MOST_CHOICES: usize = 1 << 11;
/// Bound on the words of bits that are looked at: of a table of very many entries, fewer choices
/// are looked at.
const MOST_WORK: usize = 1 << 29;
/// Words for the cells of a row, in those for one of its maps.
const SUM: usize = 48;
const BITS: usize = u64::BITS as usize;

/// Returns the shares of the cells that choices of 0, 1, ... of these maps cover, of all cells and
/// of those where three maps agree; a larger choice may cover less. `offset`: start, in parts of
/// the step between two.
pub fn shares(table: &Incidence, by_name: &[u32], offset: f64) -> [Vec<f64>; 2] {
    let numbers = numbers(by_name.len(), most_choices(table));
    let choices = Choices::new(table.names().len(), by_name, &numbers, offset);
    let covered = choices.covered(table);
    CountedCells::BOTH.map(|counted| {
        let total = table.total(counted).max(1.0);
        let share = |number: usize| {
            let next = numbers.partition_point(|&other| other < number);
            let last = next.saturating_sub(1);
            let step = (numbers[next] - numbers[last]).max(1);
            let part = (number - numbers[last]) as f64 / step as f64;
            let [from, to] = [last, next].map(|choice| covered[counted as usize][choice] as f64);
            (from + part * (to - from)) / total
        };
        (0..=by_name.len()).map(share).collect()
    })
}

/// The largest number of choices for which the work is bounded, at least those of one word.
fn most_choices(table: &Incidence) -> usize {
    let digits = digits(table.support()) + 1;
    let of_word = table.entries() * digits + SUM * table.rows() as usize;
    let words = MOST_WORK / of_word.max(1);
    // The choice of no map is one more.
    words.saturating_mul(BITS).clamp(BITS, MOST_CHOICES) - 1
}

/// Binary digits of the numbers below this.
fn digits(support: u32) -> usize {
    support.max(1).next_power_of_two().trailing_zeros() as usize
}

/// Numbers of maps from 0 on, evenly spread where there are more than `most`.
fn numbers(maps: usize, most: usize) -> Vec<usize> {
    let steps = maps.min(most).max(1);
    let mut numbers: Vec<usize> = (0..=steps).map(|step| step * maps / steps).collect();
    numbers.dedup();
    numbers
}

/// Choices of maps.
struct Choices {
    choices: usize,
    /// Words of a set of choices.
    words: usize,
    /// For each map, the choices that have it.
    with_map: Vec<u64>,
}

impl Choices {
    fn new(maps: usize, by_name: &[u32], numbers: &[usize], offset: f64) -> Self {
        let words = numbers.len().div_ceil(BITS);
        let mut with_map = vec![0; maps * words];
        for (choice, &number) in numbers.iter().enumerate() {
            // Infinite for the choice of no map, which takes no step.
            let step = by_name.len() as f64 / number as f64;
            for i in 0..number {
                let map = by_name[((i as f64 + offset) * step) as usize] as usize;
                with_map[map * words + choice / BITS] |= 1 << (choice % BITS);
            }
        }
        Self {
            choices: numbers.len(),
            words,
            with_map,
        }
    }

    /// Returns the number of cells that each choice covers: of all, and where three maps agree.
    fn covered(&self, table: &Incidence) -> [Vec<u64>; 2] {
        let mut sums = [Sums::new(self.words), Sums::new(self.words)];
        let mut with = WithMaps::new(table.support(), self.words);
        for row in 0..table.rows() {
            let of_map = |&map: &u32| &self.with_map[map as usize * self.words..][..self.words];
            let enough = with.enough_of(table.maps_of(row).iter().map(of_map));
            for (sums, counted) in sums.iter_mut().zip(CountedCells::BOTH) {
                sums.add(enough, table.cells(row, counted));
            }
        }
        sums.map(|sums| (0..self.choices).map(|choice| sums.of(choice)).collect())
    }
}

/// Counts for each choice its maps of a row. Each binary digit is a set of choices; counts start so
/// that enough of the maps carry beyond the last digit.
struct WithMaps {
    /// From the lowest on.
    digits: Vec<Vec<u64>>,
    start: usize,
    carry: Vec<u64>,
    enough: Vec<u64>,
}

impl WithMaps {
    fn new(support: u32, words: usize) -> Self {
        let digits = digits(support);
        Self {
            digits: vec![vec![0; words]; digits],
            start: (1 << digits) - support.max(1) as usize,
            carry: vec![0; words],
            enough: vec![0; words],
        }
    }

    /// Returns the choices that are in enough of these sets.
    fn enough_of<'a>(&mut self, sets: impl Iterator<Item = &'a [u64]>) -> &[u64] {
        for (place, digit) in self.digits.iter_mut().enumerate() {
            let is_set = self.start >> place & 1 == 1;
            digit.fill(if is_set { u64::MAX } else { 0 });
        }
        self.enough.fill(0);
        // Choices of many maps soon have enough of them: the words up to here have not.
        let mut open = self.enough.len();
        for set in sets {
            let carry = &mut self.carry[..open];
            carry.copy_from_slice(&set[..open]);
            for digit in &mut self.digits {
                for (digit, carry) in digit.iter_mut().zip(&mut *carry) {
                    (*digit, *carry) = (*digit ^ *carry, *digit & *carry);
                }
            }
            for (enough, carry) in self.enough.iter_mut().zip(carry) {
                *enough |= *carry;
            }
            while open > 0 && self.enough[open - 1] == u64::MAX {
                open -= 1;
            }
            if open == 0 {
                break;
            }
        }
        &self.enough
    }
}

/// A sum for each choice. Each binary digit is a set of choices, so that few operations add to many
/// sums.
struct Sums {
    /// For each word of choices, the digits from the lowest on.
    digits: Vec<[u64; BITS]>,
}

impl Sums {
    fn new(words: usize) -> Self {
        Self {
            digits: vec![[0; BITS]; words],
        }
    }

    /// Adds a number to the sums of these choices.
    fn add(&mut self, choices: &[u64], number: u32) {
        let words = self.digits.iter_mut().zip(choices);
        for (digits, &choices) in words.filter(|(_, choices)| **choices != 0) {
            let mut number = number;
            while number > 0 {
                let mut carry = choices;
                for digit in &mut digits[number.trailing_zeros() as usize..] {
                    (*digit, carry) = (*digit ^ carry, *digit & carry);
                    if carry == 0 {
                        break;
                    }
                }
                number &= number - 1;
            }
        }
    }

    fn of(&self, choice: usize) -> u64 {
        let digits = self.digits[choice / BITS].iter().zip(0..);
        let digit = |(digit, place): (&u64, u32)| (digit >> (choice % BITS) & 1) << place;
        digits.map(digit).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::apps::evaluate::{cells::incidence::Row, orders::shuffle};

    /// A table of random rows, of 150 maps.
    fn table(support: u32) -> Incidence {
        let row = |seed: u32| {
            let mut maps: Vec<u32> = (0..150).collect();
            shuffle(&mut maps, u64::from(seed));
            maps.truncate(seed as usize % 40);
            maps.sort_unstable();
            let (cells, agreeing) = (1 + seed * seed, seed / 2);
            Row {
                maps,
                cells,
                agreeing,
            }
        };
        let names = (0..150).map(|map| format!("{map:03}")).collect();
        Incidence::new(names, (0..200).map(row).collect(), support)
    }

    #[test]
    fn all_choices_together_cover_what_each_covers() {
        let by_name: Vec<u32> = (0..149).collect();
        for (support, offset) in [(1, 0.0), (2, 0.5), (3, 0.0), (4, 0.5), (5, 0.0)] {
            let table = table(support);
            let shares = shares(&table, &by_name, offset);
            for (shares, counted) in shares.iter().zip(CountedCells::BOTH) {
                let share = |number: usize| {
                    let step = 149.0 / number as f64;
                    let place = |i: usize| ((i as f64 + offset) * step) as u32;
                    table.covered(&(0..number).map(place).collect::<Vec<_>>(), counted)
                };
                let each: Vec<f64> = (0..=149).map(share).collect();
                assert_eq!(*shares, each);
            }
        }
        assert_eq!(shares(&table(2), &[], 0.0), [[0.0]; 2]);
    }

    #[test]
    fn of_a_table_of_very_many_entries_fewer_choices_are_looked_at() {
        assert_eq!(most_choices(&table(2)), MOST_CHOICES - 1);
        let row = |_| Row {
            maps: (0..150).collect(),
            cells: 1,
            agreeing: 0,
        };
        let names = (0..150).map(|map| format!("{map:03}")).collect();
        let table = Incidence::new(names, (0..20_000).map(row).collect(), 100);
        let choices = most_choices(&table);
        assert!((BITS - 1..MOST_CHOICES - 1).contains(&choices), "{choices}");
    }

    #[test]
    fn of_many_numbers_some_are_looked_at() {
        assert_eq!(numbers(3, 9), [0, 1, 2, 3]);
        assert_eq!(numbers(10, 4), [0, 2, 5, 7, 10]);
        assert_eq!(numbers(0, 4), [0]);
    }
}
