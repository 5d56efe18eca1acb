//! The fulfilment table transposed: by triangle instead of by cluster.

use bytemuck::{Pod, Zeroable};
use rayon::prelude::*;

use super::FulfilmentTable;
use crate::base::column::{self, Column, ColumnBuilder, DiskError, Storage};

/// The clusters of a list that fulfil each triangle; CSR by triangle.
pub struct ByTriangle {
    /// Start of each triangle's row, and the end of the last: triangles + 1 entries.
    offsets: Vec<usize>,
    entries: Column<Entry>,
    /// Number of clusters in the list.
    clusters: usize,
}

/// f of a triangle for one cluster.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Entry {
    /// Index of the cluster in the list.
    pub place: u32,
    pub f: f32,
}

/// Rows to transpose.
pub struct Rows<'a, 'r> {
    /// Returns the triangles of a cluster and their f.
    pub row: &'a (dyn Fn(u32) -> (&'r [u32], &'r [f32]) + Sync),
    /// Lets the operating system drop the pages of the rows.
    pub release: &'a dyn Fn(),
    pub clusters: &'a [u32],
}

impl Rows<'_, '_> {
    /// Returns the start of each triangle's entries, and the end of the last.
    fn offsets(&self, triangles: usize) -> Vec<usize> {
        let mut offsets = vec![0; triangles + 1];
        for (place, &cluster) in self.clusters.iter().enumerate() {
            let (row, _) = (self.row)(cluster);
            row.iter().for_each(|&t| offsets[t as usize + 1] += 1);
            if place.is_multiple_of(column::READ_AT_ONCE) {
                (self.release)();
            }
        }
        (0..triangles).for_each(|t| offsets[t + 1] += offsets[t]);
        offsets
    }

    /// Returns the entries of consecutive triangles with these offsets.
    fn entries(&self, offsets: &[usize], first: u32) -> Vec<Entry> {
        let count = offsets[offsets.len() - 1] - offsets[0];
        let mut entries = vec![Entry::zeroed(); count];
        let mut parts = Part::all(&mut entries, offsets, first);
        let batches = self.clusters.chunks(column::READ_AT_ONCE);
        for (start, some) in (0..).step_by(column::READ_AT_ONCE).zip(batches) {
            parts.par_iter_mut().for_each(|part| {
                (start..)
                    .zip(some)
                    .for_each(|(place, &cluster)| part.add(place, (self.row)(cluster)));
            });
            (self.release)();
        }
        entries
    }
}

/// Consecutive triangles whose entries one thread sorts.
struct Part<'a> {
    first: u32,
    /// Place of the next entry of each triangle.
    next: Vec<usize>,
    entries: &'a mut [Entry],
}

impl<'a> Part<'a> {
    /// Splits entries with these offsets.
    fn all(entries: &'a mut [Entry], offsets: &[usize], first: u32) -> Vec<Self> {
        let triangles = offsets.len() - 1;
        let (mut parts, mut rest) = (Vec::new(), entries);
        for from in (0..triangles).step_by(TRIANGLES_AT_ONCE) {
            let end = (from + TRIANGLES_AT_ONCE).min(triangles);
            let starts = offsets[from..end].iter();
            let (own, others) = rest.split_at_mut(offsets[end] - offsets[from]);
            parts.push(Part {
                first: first + from as u32,
                next: starts.map(|start| start - offsets[from]).collect(),
                entries: own,
            });
            rest = others;
        }
        parts
    }

    fn add(&mut self, place: u32, (triangles, values): (&[u32], &[f32])) {
        let rows = [self.first, self.first + self.next.len() as u32];
        // Rows ascend, so that a part finds its entries without a look at those of others.
        let [from, end] = rows.map(|bound| triangles.partition_point(|&t| t < bound));
        for (&t, &f) in triangles[from..end].iter().zip(&values[from..end]) {
            let next = &mut self.next[(t - self.first) as usize];
            self.entries[*next] = Entry { place, f };
            *next += 1;
        }
    }
}

/// Entries sorted at a time; bounds the memory of the transposition beside its result.
const ENTRIES_AT_ONCE: usize = 1 << 22;
/// Triangles whose entries a thread sorts.
const TRIANGLES_AT_ONCE: usize = if cfg!(test) { 3 } else { 1 << 13 };

impl ByTriangle {
    /// Transposes the rows of `clusters`, with the table's storage.
    pub fn new(
        table: &FulfilmentTable,
        clusters: &[u32],
        triangles: usize,
    ) -> Result<Self, DiskError> {
        let rows = Rows {
            row: &|cluster| table.row(cluster as usize),
            release: &|| table.release(),
            clusters,
        };
        Self::of_rows(&rows, table.triangles.storage(), triangles)
    }

    /// As [`Self::new`], for rows from several tables.
    pub fn of_rows(rows: &Rows, storage: Storage, triangles: usize) -> Result<Self, DiskError> {
        let offsets = rows.offsets(triangles);
        let mut entries = ColumnBuilder::new(storage)?;
        entries.reserve(offsets[triangles]);
        let mut from = 0;
        while from < triangles {
            // At least one triangle, even if its entries exceed the batch.
            let room = offsets[from] + ENTRIES_AT_ONCE;
            let end =
                (offsets.partition_point(|&offset| offset <= room) - 1).clamp(from + 1, triangles);
            entries.extend(&rows.entries(&offsets[from..=end], from as u32))?;
            from = end;
        }
        Ok(Self {
            offsets,
            entries: entries.finish()?,
            clusters: rows.clusters.len(),
        })
    }

    /// Returns the entries of a triangle, in the order of the list.
    pub fn row(&self, triangle: u32) -> &[Entry] {
        &self.entries[self.offsets[triangle as usize]..self.offsets[triangle as usize + 1]]
    }

    /// Lets the operating system drop pages of a table on disk; they are read again when needed.
    pub fn release(&self) {
        self.entries.release();
    }

    /// Returns, for each of the first `end` clusters of the list, the sum of min(its f, f) over the
    /// triangles.
    pub fn given_by_each(&self, triangles: &[u32], values: &[f32], end: usize) -> Vec<f64> {
        let mut given = vec![0.0; end];
        for (&t, &own) in triangles.iter().zip(values) {
            // Entries ascend by place, because clusters are added in the order of the list.
            for entry in self
                .row(t)
                .iter()
                .take_while(|entry| (entry.place as usize) < end)
            {
                given[entry.place as usize] += f64::from(entry.f.min(own));
            }
        }
        given
    }

    /// Returns the largest such sum that a single cluster of the list reaches.
    pub fn most_by_one(&self, triangles: &[u32], values: &[f32]) -> f64 {
        self.given_by_each(triangles, values, self.clusters)
            .into_iter()
            .fold(0.0, f64::max)
    }
}
