//! The table of which maps take part in which cells of a fused cloud.

use std::{
    collections::HashSet,
    path::{Path, PathBuf},
};

use crate::base::{
    error::{Advice, Hint},
    input::{self, FileKind},
    printable::printable,
};

/// Most rows of a table, and most maps of all rows together: several times those of a table of a
/// thousand maps.
const MOST_ROWS: usize = 1 << 21;
const MOST_ENTRIES: usize = 1 << 25;

/// Which maps take part in which cells.
///
/// As a file: the names of the maps, separated by tabs; then for each row the number of cells, the
/// number of those that are sure, and the maps as a hexadecimal number, whose lowest bit is the
/// first map.
#[derive(Clone, Debug, PartialEq)]
pub struct Incidence {
    /// Names of the key views of the maps.
    names: Vec<String>,
    /// For each row, the maps that take part, ascending.
    maps_of: Lists,
    /// For each row, the number of cells, and of those that are sure.
    cells: Vec<[u32; 2]>,
    /// Maps that must take part in a cell: the fusion keeps no point of fewer (m, method 5.2).
    support: u32,
    /// For each map, the rows in which it takes part, ascending.
    rows_of: Lists,
}

/// Lists of numbers in two arrays.
#[derive(Clone, Debug, Default, PartialEq)]
struct Lists {
    numbers: Vec<u32>,
    /// Where each list ends.
    ends: Vec<usize>,
}

impl Lists {
    fn of(&self, list: u32) -> &[u32] {
        let list = list as usize;
        let start = list.checked_sub(1).map_or(0, |before| self.ends[before]);
        &self.numbers[start..self.ends[list]]
    }

    fn iter(&self) -> impl Iterator<Item = &[u32]> {
        (0..self.ends.len() as u32).map(|list| self.of(list))
    }

    /// Returns for each number below `count` the lists that have it, ascending.
    fn turned(&self, count: usize) -> Self {
        let mut next = vec![0_usize; count];
        for &number in &self.numbers {
            next[number as usize] += 1;
        }
        let ends = next.iter_mut().scan(0, |sum, count| {
            let start = *sum;
            *sum += std::mem::replace(count, start);
            Some(*sum)
        });
        let ends = ends.collect();
        let mut lists = vec![0; self.numbers.len()];
        for (list, numbers) in (0..).zip(self.iter()) {
            for &number in numbers {
                let place = &mut next[number as usize];
                lists[*place] = list;
                *place += 1;
            }
        }
        Self {
            numbers: lists,
            ends,
        }
    }
}

/// Cells in which the same maps take part.
#[derive(Clone, Debug, PartialEq)]
pub struct Row {
    /// Indices of the maps, ascending.
    pub maps: Vec<u32>,
    /// Number of cells.
    pub cells: u32,
    /// Number of cells with a point on which three maps agree.
    pub agreeing: u32,
}

/// Which cells count: their place among the numbers of a row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CountedCells {
    /// All cells of the cloud that a user sees.
    All,
    /// Those where three maps agree.
    Agreeing,
}

impl CountedCells {
    pub const BOTH: [Self; 2] = [Self::All, Self::Agreeing];

    fn of(self, cells: [u32; 2]) -> u32 {
        cells[self as usize]
    }
}

/// Error in a table of cells.
#[derive(Debug, thiserror::Error)]
pub enum IncidenceError {
    #[error("cannot read {}: {source}", path.display())]
    Io {
        path: PathBuf,
        source: std::io::Error,
    },
    #[error("{}: line {line}: {what}", path.display())]
    Line {
        path: PathBuf,
        line: usize,
        what: &'static str,
    },
    #[error("{}: none of its maps is of a key view of the plan", .0.display())]
    Foreign(PathBuf),
}

impl Hint for IncidenceError {
    fn hint(&self) -> Option<Advice> {
        Some("give the cells.tsv that an evaluation of this project wrote".into())
    }

    fn path(&self) -> Option<&Path> {
        match self {
            Self::Io { path, .. } | Self::Line { path, .. } | Self::Foreign(path) => Some(path),
        }
    }
}

impl Incidence {
    pub fn new(names: Vec<String>, rows: Vec<Row>, support: u32) -> Self {
        let cells = rows.iter().map(|row| [row.cells, row.agreeing]).collect();
        let mut maps_of = Lists::default();
        for row in rows {
            maps_of.numbers.extend(row.maps);
            maps_of.ends.push(maps_of.numbers.len());
        }
        Self::of_lists(names, maps_of, cells, support)
    }

    fn of_lists(names: Vec<String>, maps_of: Lists, cells: Vec<[u32; 2]>, support: u32) -> Self {
        Self {
            rows_of: maps_of.turned(names.len()),
            names,
            maps_of,
            cells,
            support,
        }
    }

    pub(super) fn support(&self) -> u32 {
        self.support
    }

    pub fn names(&self) -> &[String] {
        &self.names
    }

    /// Number of rows.
    pub(super) fn rows(&self) -> u32 {
        self.cells.len() as u32
    }

    /// Returns the maps that take part in the cells of a row, ascending.
    pub(super) fn maps_of(&self, row: u32) -> &[u32] {
        self.maps_of.of(row)
    }

    /// Returns the number of cells of a row that count.
    pub(super) fn cells(&self, row: u32, counted: CountedCells) -> u32 {
        counted.of(self.cells[row as usize])
    }

    /// Number of maps of all rows together.
    pub(super) fn entries(&self) -> usize {
        self.maps_of.numbers.len()
    }

    /// Returns the rows in which a map takes part.
    pub(super) fn rows_of(&self, map: u32) -> &[u32] {
        self.rows_of.of(map)
    }

    /// Number of cells that count.
    pub fn total(&self, counted: CountedCells) -> f64 {
        (0..self.rows())
            .map(|row| f64::from(self.cells(row, counted)))
            .sum()
    }

    /// Returns the maps that take part anywhere; a program may have rejected all of a map.
    pub fn usable(&self) -> Vec<u32> {
        (0..self.names.len() as u32)
            .filter(|&map| !self.rows_of(map).is_empty())
            .collect()
    }

    /// Returns the share of the cells that the first i maps of an order cover, for i = 0, 1, ...:
    /// of all cells, and of those where three maps agree.
    pub fn curves(&self, order: &[u32]) -> [Vec<f64>; 2] {
        let mut is_left = vec![true; self.names.len()];
        let mut taken = vec![0; self.cells.len()];
        let mut added = vec![[0_u64; 2]; order.len() + 1];
        for (added, &map) in added[1..].iter_mut().zip(order) {
            if !std::mem::take(&mut is_left[map as usize]) {
                continue;
            }
            // Its rows ascend, so that memory is read in order.
            for &row in self.rows_of(map) {
                taken[row as usize] += 1;
                if taken[row as usize] == self.support {
                    let cells = self.cells[row as usize];
                    (0..2).for_each(|i| added[i] += u64::from(cells[i]));
                }
            }
        }
        CountedCells::BOTH.map(|counted| {
            let total = self.total(counted).max(1.0);
            let sums = added.iter().scan(0, |covered, added| {
                *covered += added[counted as usize];
                Some(*covered as f64 / total)
            });
            sums.collect()
        })
    }

    /// Returns the share of the cells that these maps cover.
    pub fn covered(&self, maps: &[u32], counted: CountedCells) -> f64 {
        let mut is_chosen = vec![false; self.names.len()];
        maps.iter().for_each(|&map| is_chosen[map as usize] = true);
        let is_covered = |&row: &u32| {
            // Most rows have many maps, of which the first few are enough.
            let maps = self.maps_of(row).iter();
            let chosen = maps.filter(|&&map| is_chosen[map as usize]);
            chosen.take(self.support as usize).count() == self.support as usize
        };
        let covered = (0..self.rows()).filter(is_covered);
        let cells = covered.map(|row| f64::from(self.cells(row, counted)));
        cells.sum::<f64>() / self.total(counted).max(1.0)
    }

    /// Reads a table. `support`: maps that fusion wants. `views`: number of views of the scene,
    /// which are at least as many as the maps.
    pub fn read(path: &Path, support: u32, views: usize) -> Result<Self, IncidenceError> {
        let text =
            input::read_text(path, FileKind::State).map_err(|source| IncidenceError::Io {
                path: path.into(),
                source,
            })?;
        Self::parse(&text, support, views).map_err(|(line, what)| IncidenceError::Line {
            path: path.into(),
            line,
            what,
        })
    }

    fn parse(text: &str, support: u32, views: usize) -> Result<Self, (usize, &'static str)> {
        let mut lines = text.lines();
        let head = lines
            .next()
            .ok_or((1, "the names of the maps are missing"))?;
        // Counted before any is copied: a line of tabs alone would become gigabytes of names.
        if head.split('\t').take(views + 1).count() > views {
            return Err((1, "more maps than views of the model"));
        }
        let names: Vec<String> = head.split('\t').map(unescaped).collect();
        if names.iter().collect::<HashSet<_>>().len() < names.len() {
            return Err((1, "a map twice"));
        }
        let (mut maps_of, mut all_cells, mut sum) = (Lists::default(), Vec::new(), 0_u32);
        for (line, text) in (2..).zip(lines) {
            let fault = |what| (line, what);
            if all_cells.len() == MOST_ROWS {
                return Err(fault("too many rows"));
            }
            let cells = read_row(text, names.len(), &mut maps_of.numbers).map_err(fault)?;
            sum = sum.checked_add(cells[0]).ok_or((line, "too many cells"))?;
            maps_of.ends.push(maps_of.numbers.len());
            all_cells.push(cells);
        }
        Ok(Self::of_lists(names, maps_of, all_cells, support))
    }

    /// Returns the table as text.
    pub fn text(&self) -> String {
        let names: Vec<String> = self.names.iter().map(|name| escaped(name)).collect();
        let mut text = names.join("\t") + "\n";
        for (maps, [cells, agreeing]) in self.maps_of.iter().zip(&self.cells) {
            let mut digits = vec![0u8; self.names.len().div_ceil(4).max(1)];
            for &map in maps {
                digits[map as usize / 4] |= 1 << (map % 4);
            }
            let digits = digits.iter().rev().skip_while(|digit| **digit == 0);
            let hex: String = digits.map(|digit| format!("{digit:x}")).collect();
            let hex = if hex.is_empty() { "0" } else { &hex };
            text += &format!("{cells}\t{agreeing}\t{hex}\n");
        }
        text
    }
}

/// Reads a row: appends its maps to `taking_part`, and returns its numbers of cells. `maps`: number
/// of all maps.
fn read_row(text: &str, maps: usize, taking_part: &mut Vec<u32>) -> Result<[u32; 2], &'static str> {
    let mut words = text.split('\t');
    let mut count = || words.next().and_then(|word| word.parse().ok());
    let (Some(cells), Some(agreeing)) = (count(), count()) else {
        return Err("two numbers of cells are expected");
    };
    let hex = words.next().ok_or("the maps are missing")?;
    // Before any digit is read: somebody else's number may have millions.
    if hex.len() > maps.div_ceil(4).max(1) {
        return Err("more maps than names");
    }
    let start = taking_part.len();
    for (place, digit) in (0..).zip(hex.bytes().rev()) {
        let mut digit = char::from(digit)
            .to_digit(16)
            .ok_or("the maps are not a hexadecimal number")?;
        while digit > 0 {
            taking_part.push(4 * place + digit.trailing_zeros());
            digit &= digit - 1;
        }
    }
    match taking_part[start..].last() {
        Some(&last) if last as usize >= maps => Err("more maps than names"),
        _ if taking_part.len() > MOST_ENTRIES => Err("too many maps in all rows"),
        _ if agreeing > cells => Err("more sure cells than cells"),
        _ => Ok([cells, agreeing]),
    }
}

/// Names may hold what separates them.
fn escaped(name: &str) -> String {
    printable(&name.replace('\\', r"\\"))
}

fn unescaped(name: &str) -> String {
    let mut plain = String::new();
    let mut rest = name;
    while let Some(at) = rest.find('\\') {
        plain += &rest[..at];
        rest = &rest[at..];
        let (c, length) = character(rest).unwrap_or(('\\', 1));
        plain.push(c);
        rest = &rest[length..];
    }
    plain + rest
}

/// Reads an escape at the start of a text; returns the character, and the length of the escape.
fn character(text: &str) -> Option<(char, usize)> {
    let short = [('\\', r"\\"), ('\t', r"\t"), ('\n', r"\n"), ('\r', r"\r")];
    let found = short
        .into_iter()
        .find(|(_, escape)| text.starts_with(escape));
    if let Some((c, escape)) = found {
        return Some((c, escape.len()));
    }
    let (digits, _) = text.strip_prefix(r"\u{")?.split_once('}')?;
    let c = u32::from_str_radix(digits, 16)
        .ok()
        .and_then(char::from_u32)?;
    Some((c, digits.len() + r"\u{}".len()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::printable::is_printable;

    fn table() -> Incidence {
        let row = |maps: &[u32], cells, agreeing| Row {
            maps: maps.to_vec(),
            cells,
            agreeing,
        };
        let rows = vec![
            row(&[0, 1], 4, 0),
            row(&[0, 1, 2], 5, 5),
            row(&[3, 5], 1, 0),
        ];
        Incidence::new(
            ["a", "b\t\\t", "c", "d", "e", "f"].map(String::from).into(),
            rows,
            2,
        )
    }

    #[test]
    fn a_table_is_read_as_it_was_written() {
        let text = table().text();
        assert_eq!(text.lines().nth(3), Some("1\t0\t28"));
        assert_eq!(Incidence::parse(&text, 2, 6), Ok(table()));
        for (damaged, line) in [
            ("", 1),
            ("a\tb\tc\td\te\tf\tg\n", 1),
            ("a\tb\ta\n", 1),
            ("a\n1\t0\t1\n1\t0\t00001", 3),
            ("a\n1\t0", 2),
            ("a\n1\t0\tg", 2),
            ("a\n1\t0\t2", 2),
            ("a\n1\t2\t1", 2),
            ("a\n4000000000\t0\t1\n4000000000\t0\t1", 3),
        ] {
            assert_eq!(
                Incidence::parse(damaged, 2, 6).unwrap_err().0,
                line,
                "{damaged:?}"
            );
        }
    }

    #[test]
    fn names_come_back_from_what_a_terminal_shows() {
        for name in [
            "a\\u{1b}",
            "a\x1b]0;x\x07\u{9b}2J",
            "\\",
            r"\u{",
            r"\u{x}\u{110000}",
            "\u{202e}é",
        ] {
            let shown = escaped(name);
            assert!(shown.chars().all(is_printable), "{shown}");
            assert_eq!(unescaped(&shown), name);
        }
    }

    #[test]
    fn a_cell_is_covered_by_as_many_of_its_maps_as_fusion_wants() {
        let table = table();
        assert_eq!(
            table.curves(&[2, 1, 0, 3]),
            [[0.0, 0.0, 0.5, 0.9, 0.9], [0.0, 0.0, 1.0, 1.0, 1.0]]
        );
        assert_eq!(table.curves(&[]), [[0.0]; 2]);
        assert_eq!(table.curves(&[2, 2, 1])[0], [0.0, 0.0, 0.0, 0.5]);
        let covered = |number: usize| table.covered(&[5, 3, 1, 0][..number], CountedCells::All);
        let [all, _] = table.curves(&[5, 3, 1, 0]);
        assert_eq!(all, [0, 1, 2, 3, 4].map(covered));
        assert_eq!(table.covered(&[0, 2], CountedCells::Agreeing), 1.0);
        assert_eq!(table.usable(), [0, 1, 2, 3, 5]);
    }
}
