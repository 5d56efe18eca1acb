//! Offsets of a table in compressed sparse row (CSR) form.

use std::ops::Range;

/// CSR offsets: 0, then the end of each row in the table's flat arrays.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Offsets(Vec<usize>);

impl Default for Offsets {
    /// No rows.
    fn default() -> Self {
        Self(vec![0])
    }
}

impl Offsets {
    /// Rows with these numbers of entries.
    pub fn from_lengths(lengths: impl IntoIterator<Item = usize>) -> Self {
        let mut offsets = Self::default();
        lengths.into_iter().for_each(|length| offsets.push(length));
        offsets
    }

    /// Sorts entries into rows: `all` gives the row and the value of each, the same twice. Within a
    /// row, they keep their order.
    pub fn sorted<T: Copy + Default, I: Iterator<Item = (usize, T)>>(
        rows: usize,
        all: impl Fn() -> I,
    ) -> (Self, Vec<T>) {
        let mut lengths = vec![0; rows];
        all().for_each(|(row, _)| lengths[row] += 1);
        let offsets = Self::from_lengths(lengths);
        let (mut next, mut entries) = (offsets.0.clone(), vec![T::default(); offsets.entries()]);
        for (row, value) in all() {
            entries[next[row]] = value;
            next[row] += 1;
        }
        (offsets, entries)
    }

    /// Adds a row.
    pub fn push(&mut self, length: usize) {
        self.0.push(self.entries() + length);
    }

    /// Entries of a row; panics if there is no such row.
    pub fn row(&self, row: usize) -> Range<usize> {
        self.0[row]..self.0[row + 1]
    }

    /// Number of rows.
    pub fn rows(&self) -> usize {
        self.0.len() - 1
    }

    /// Number of entries of all rows.
    pub fn entries(&self) -> usize {
        self.0[self.0.len() - 1]
    }

    /// Splits a flat array of the table into its rows, for threads that fill them; panics if its
    /// length is not [`Self::entries`].
    pub fn split_mut<'a, T>(&self, mut entries: &'a mut [T]) -> Vec<&'a mut [T]> {
        assert_eq!(entries.len(), self.entries());
        let split = |row| {
            let (own, rest) = std::mem::take(&mut entries).split_at_mut(self.row(row).len());
            entries = rest;
            own
        };
        (0..self.rows()).map(split).collect()
    }

    /// The rows + 1 offsets, as files store them.
    pub fn as_slice(&self) -> &[usize] {
        &self.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_follow_each_other_without_gaps() {
        let mut offsets = Offsets::from_lengths([2, 0]);
        offsets.push(3);
        assert_eq!(
            (0..offsets.rows())
                .map(|row| offsets.row(row))
                .collect::<Vec<_>>(),
            [0..2, 2..2, 2..5]
        );
        assert_eq!(
            (offsets.entries(), offsets.as_slice()),
            (5, &[0, 2, 2, 5][..])
        );
        assert_eq!(
            offsets.split_mut(&mut [4, 5, 6, 7, 8]),
            [&[4, 5][..], &[], &[6, 7, 8]]
        );
    }

    #[test]
    fn an_empty_table_has_one_offset() {
        assert_eq!(
            (Offsets::default().rows(), Offsets::default().as_slice()),
            (0, &[0][..])
        );
    }
}
