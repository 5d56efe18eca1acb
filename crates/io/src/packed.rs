//! Lists of numbers as bytes, one after the other, for files that only this program reads.
//!
//! The bytes may be damaged or forged: the length of each list is checked before memory is
//! allocated.

use std::{fmt::Debug, sync::Arc};

use bytemuck::Pod;
use rayon::prelude::*;
use viewrank_core::base::{
    column::{Column, Rows},
    large_pages,
};

/// Packed lists, in parts one after the other.
pub type Packed = Vec<Arc<dyn Rows>>;

/// Lists that are written one after the other.
#[derive(Default)]
pub struct Packer {
    parts: Packed,
    /// Bytes after the last part.
    bytes: Vec<u8>,
}

impl Packer {
    /// Appends a list: its length, then its numbers as they are in memory.
    pub fn list<T: Pod>(&mut self, numbers: &[T]) {
        self.bytes
            .extend_from_slice(&(numbers.len() as u64).to_le_bytes());
        self.bytes.extend_from_slice(bytemuck::cast_slice(numbers));
    }

    /// Appends a list of numbers that are made one by one.
    pub fn each<T: Pod>(&mut self, numbers: impl Iterator<Item = T>) {
        self.list(&Vec::from_iter(numbers));
    }

    /// Appends a column as [`Self::list`] does, without a copy.
    pub fn column<T: Pod + Debug + Send + Sync>(&mut self, column: &Column<T>) {
        self.bytes
            .extend_from_slice(&(column.len() as u64).to_le_bytes());
        self.end_part();
        self.parts.push(Arc::new(column.clone()));
    }

    fn end_part(&mut self) {
        self.parts
            .push(Arc::new(Column::from(std::mem::take(&mut self.bytes))));
    }

    pub fn finish(mut self) -> Packed {
        self.end_part();
        self.parts
    }
}

/// Lists that are read in the order in which they were written.
pub struct Unpacker<'a>(&'a [u8]);

impl<'a> Unpacker<'a> {
    pub fn new(bytes: &'a [u8]) -> Self {
        Self(bytes)
    }

    /// Returns the next list; `None` at the end or where the bytes are cut off.
    pub fn list<T: Pod + Send>(&mut self) -> Option<Vec<T>> {
        const PART: usize = if cfg!(test) { 5 } else { 1 << 20 };
        let bytes = self.bytes_of(size_of::<T>())?;
        // A copy, since a list may begin at a byte that is not aligned for its numbers.
        let mut list = large_pages::zeroed(bytes.len() / size_of::<T>());
        let parts = bytemuck::cast_slice_mut(&mut list)
            .par_chunks_mut(PART)
            .zip(bytes.par_chunks(PART));
        parts.for_each(|(to, from)| to.copy_from_slice(from));
        Some(list)
    }

    /// Returns the next list of bytes where it is.
    pub fn bytes(&mut self) -> Option<&'a [u8]> {
        self.bytes_of(1)
    }

    fn bytes_of(&mut self, size: usize) -> Option<&'a [u8]> {
        let (length, rest) = self.0.split_first_chunk()?;
        let length = usize::try_from(u64::from_le_bytes(*length))
            .ok()?
            .checked_mul(size)?;
        let (list, rest) = rest.split_at_checked(length)?;
        self.0 = rest;
        Some(list)
    }

    pub fn is_at_end(&self) -> bool {
        self.0.is_empty()
    }
}

/// Appends ascending numbers as gaps of 1 to 5 bytes each, 7 bits per byte, the lowest first.
pub fn push_gaps(ascending: &[u32], bytes: &mut Vec<u8>) {
    let mut next = 0;
    for &number in ascending {
        let mut gap = number - next;
        while gap >= 0x80 {
            bytes.push(gap as u8 | 0x80);
            gap >>= 7;
        }
        bytes.push(gap as u8);
        next = number + 1;
    }
}

/// Returns how many numbers [`push_gaps`] wrote.
pub fn count_gaps(bytes: &[u8]) -> usize {
    bytes.iter().filter(|&&byte| byte < 0x80).count()
}

/// Reads all numbers of [`push_gaps`]; `None` if one is not below `end`, the bytes are cut off, or
/// `numbers` does not have the length that [`count_gaps`] returns.
pub fn read_gaps(bytes: &[u8], end: u32, numbers: &mut [u32]) -> Option<()> {
    // In u64: a forged gap may lead beyond u32.
    let (mut numbers, mut next) = (numbers.iter_mut(), 0u64);
    let (mut gap, mut shift) = (0u64, 0);
    for &byte in bytes {
        gap |= u64::from(byte & 0x7f) << shift;
        if byte >= 0x80 {
            shift += 7;
            if shift > 28 {
                return None;
            }
            continue;
        }
        let number = next + gap;
        if number >= u64::from(end) {
            return None;
        }
        *numbers.next()? = number as u32;
        (next, gap, shift) = (number + 1, 0, 0);
    }
    (shift == 0 && numbers.next().is_none()).then_some(())
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use proptest::prelude::*;

    use super::*;

    fn all_gaps(bytes: &[u8], end: u32) -> Option<Vec<u32>> {
        let mut numbers = vec![0; count_gaps(bytes)];
        read_gaps(bytes, end, &mut numbers).map(|()| numbers)
    }

    proptest! {
        #[test]
        fn gaps_are_read_as_written(numbers in proptest::collection::btree_set(any::<u32>(), 0..200), near in 0u32..300) {
            let numbers: BTreeSet<u32> = numbers.into_iter().chain(near..near + 100).filter(|&n| n < u32::MAX).collect();
            let numbers = Vec::from_iter(numbers);
            let mut bytes = Vec::new();
            push_gaps(&numbers, &mut bytes);
            prop_assert_eq!(all_gaps(&bytes, u32::MAX), Some(numbers.clone()));
            prop_assert_eq!(all_gaps(&bytes, numbers[numbers.len() - 1]), None);
            prop_assert_eq!(read_gaps(&bytes, u32::MAX, &mut vec![0; numbers.len() + 1]), None);
            prop_assert_eq!(read_gaps(&bytes, u32::MAX, &mut vec![0; numbers.len() - 1]), None);
        }

        #[test]
        fn no_bytes_are_read_as_numbers_beyond_the_end(bytes in proptest::collection::vec(any::<u8>(), 0..40), end in 0u32..1000) {
            let numbers = all_gaps(&bytes, end).unwrap_or_default();
            prop_assert!(numbers.is_sorted() && numbers.iter().all(|&number| number < end));
        }

        #[test]
        fn no_bytes_are_read_as_lists_beyond_their_length(bytes in proptest::collection::vec(any::<u8>(), 0..40)) {
            let mut lists = Unpacker::new(&bytes);
            while let Some(list) = lists.list::<u64>() {
                prop_assert!(8 * list.len() < bytes.len());
            }
        }
    }

    #[test]
    fn lists_are_read_in_their_order() {
        let mut packer = Packer::default();
        packer.list(&[1.5f64, -2.0]);
        packer.list(&[7u8]);
        packer.list::<u32>(&[]);
        packer.column(&Column::from(vec![3.5f32]));
        packer.list(&[9u8]);
        let bytes = packer
            .finish()
            .iter()
            .flat_map(|part| part.as_bytes().to_vec())
            .collect::<Vec<_>>();
        let mut lists = Unpacker::new(&bytes);
        assert_eq!(lists.list::<f64>(), Some(vec![1.5, -2.0]));
        assert_eq!(lists.bytes(), Some(&[7][..]));
        assert!(!lists.is_at_end());
        assert_eq!(lists.list::<u32>(), Some(vec![]));
        assert_eq!(
            (lists.list::<f32>(), lists.bytes()),
            (Some(vec![3.5]), Some(&[9][..]))
        );
        assert!(lists.is_at_end() && lists.list::<u32>().is_none());
        // A length that no memory holds.
        assert!(Unpacker::new(&[255; 16]).list::<f64>().is_none());
    }
}
