//! Names in tables for spreadsheets. Lists that programs read have names as they are: those of
//! exports, and the tables of cells that an evaluation keeps.

use crate::base::printable::printable;

/// Beginnings of formulas, in full width too.
const FORMULAS: [char; 8] = ['=', '+', '-', '@', '＝', '＋', '－', '＠'];
/// Characters that begin a cell in a table of some language or program.
const SEPARATORS: [char; 3] = [',', ';', '|'];

/// Writes a name, [printable], so that no spreadsheet takes it, or a part of it, for a formula: an
/// apostrophe before each character that would begin one, and before an apostrophe in such a place,
/// at the start and after a separator. Without the apostrophes in these places, a cell is the
/// printable name again.
pub fn cell(name: &str) -> String {
    let mut begins = true;
    printable(name).chars().fold(String::new(), |mut cell, c| {
        if begins && (c == '\'' || FORMULAS.contains(&c)) {
            cell.push('\'');
        }
        begins = may_begin_after(c, begins);
        cell.push(c);
        cell
    })
}

/// Returns whether a cell may begin after this character of a name, where it may or may not before
/// it: some programs leave out blanks.
fn may_begin_after(c: char, begins: bool) -> bool {
    SEPARATORS.contains(&c) || begins && c == ' '
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// The name of a [`cell`].
    fn name(cell: &str) -> String {
        let (mut name, mut begins) = (String::new(), true);
        let mut rest = cell.chars();
        while let Some(c) = rest.next() {
            let Some(c) = (if begins && c == '\'' {
                rest.next()
            } else {
                Some(c)
            }) else {
                break;
            };
            begins = may_begin_after(c, begins);
            name.push(c);
        }
        name
    }

    #[test]
    fn what_begins_a_formula_follows_an_apostrophe() {
        for (name, expected) in [
            ("IMG-1=2.jpg", "IMG-1=2.jpg"),
            ("=1+2.jpg", "'=1+2.jpg"),
            ("\t=1", r"\t=1"),
            ("  =1; +2", "  '=1; '+2"),
            ("a\x1b]0;=1\x07", r"a\u{1b}]0;'=1\u{7}"),
            ("a;=1,-2", "a;'=1,'-2"),
            ("'a'", "''a'"),
            ("＠a", "'＠a"),
        ] {
            assert_eq!(cell(name), expected);
        }
    }

    proptest! {
        #[test]
        fn a_name_comes_back_from_its_cell(original in "[-=+@',;|\t\r\n\x1b\u{9b}a＝ ]{0,12}") {
            prop_assert_eq!(name(&cell(&original)), printable(&original));
        }
    }
}
