//! The fulfilment table transposed: by triangle instead of by cluster.

use bytemuck::{Pod, Zeroable};
use rayon::prelude::*;

use super::FulfilmentTable;
use crate::base::column::{self, Column, ColumnBuilder, DiskError, Storage};

/// The clusters of a list that fulfil each triangle; CSR by triangle.
pub(crate) struct ByTriangle {
    /// Start of each triangle's row, and the end of the last: triangles + 1 entries.
    offsets: Vec<usize>,
    entries: Column<Entry>,
    /// Number of clusters in the list.
    clusters: usize,
}

/// f of a triangle for one cluster.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct Entry {
    /// Index of the cluster in the list.
    pub place: u32,
    pub f: f32,
}

/// Entries sorted at a time; bounds the memory of the transposition beside its result.
const ENTRIES_AT_ONCE: usize = 1 << 22;
/// Triangles whose entries a thread sorts at a time.
const TRIANGLES_AT_ONCE: usize = 1 << 14;

impl ByTriangle {
    /// Transposes the rows of `clusters`, with the table's storage.
    pub(crate) fn new(table: &FulfilmentTable, clusters: &[u32], triangles: usize) -> Result<Self, DiskError> {
        let row = |cluster| table.row(cluster as usize);
        Self::of_rows(&row, &|| table.release(), table.triangles.storage(), clusters, triangles)
    }

    /// As [`Self::new`], for rows from several tables; `release` lets the operating system drop their pages.
    pub(crate) fn of_rows<'r>(
        row: &(dyn Fn(u32) -> (&'r [u32], &'r [f32]) + Sync),
        release: &dyn Fn(),
        storage: Storage,
        clusters: &[u32],
        triangles: usize,
    ) -> Result<Self, DiskError> {
        let mut offsets = vec![0; triangles + 1];
        for (place, &cluster) in clusters.iter().enumerate() {
            row(cluster).0.iter().for_each(|&t| offsets[t as usize + 1] += 1);
            if place.is_multiple_of(column::READ_AT_ONCE) {
                release();
            }
        }
        (0..triangles).for_each(|t| offsets[t + 1] += offsets[t]);
        let mut entries = ColumnBuilder::new(storage)?;
        entries.reserve(offsets[triangles]);
        let mut from = 0;
        while from < triangles {
            // At least one triangle, even if its entries exceed the batch.
            let room = offsets[from] + ENTRIES_AT_ONCE;
            let end = (offsets.partition_point(|&offset| offset <= room) - 1).clamp(from + 1, triangles);
            entries.extend(&Self::entries(row, clusters, &offsets[from..=end], from as u32))?;
            release();
            from = end;
        }
        Ok(Self { offsets, entries: entries.finish()?, clusters: clusters.len() })
    }

    /// Returns the entries of consecutive triangles with these offsets.
    fn entries<'r>(
        row: &(dyn Fn(u32) -> (&'r [u32], &'r [f32]) + Sync),
        clusters: &[u32],
        offsets: &[usize],
        first: u32,
    ) -> Vec<Entry> {
        let triangles = offsets.len() - 1;
        let mut entries = vec![Entry::zeroed(); offsets[triangles] - offsets[0]];
        let (mut parts, mut rest) = (Vec::new(), &mut entries[..]);
        for from in (0..triangles).step_by(TRIANGLES_AT_ONCE) {
            let end = (from + TRIANGLES_AT_ONCE).min(triangles);
            let part;
            (part, rest) = rest.split_at_mut(offsets[end] - offsets[from]);
            parts.push((first + from as u32, &offsets[from..=end], part));
        }
        parts.into_par_iter().for_each(|(first, offsets, entries)| {
            let (start, triangles) = (offsets[0], offsets.len() - 1);
            let mut next: Vec<usize> = offsets[..triangles].iter().map(|offset| offset - start).collect();
            for (place, &cluster) in clusters.iter().enumerate() {
                let (of_cluster, values) = row(cluster);
                let rows = [first, first + triangles as u32].map(|bound| of_cluster.partition_point(|&t| t < bound));
                let rows = rows[0]..rows[1];
                for (&t, &f) in of_cluster[rows.clone()].iter().zip(&values[rows]) {
                    let next = &mut next[(t - first) as usize];
                    entries[*next] = Entry { place: place as u32, f };
                    *next += 1;
                }
            }
        });
        entries
    }

    /// Returns the entries of a triangle, in the order of the list.
    pub(crate) fn row(&self, triangle: u32) -> &[Entry] {
        &self.entries[self.offsets[triangle as usize]..self.offsets[triangle as usize + 1]]
    }

    /// Lets the operating system drop pages of a table on disk; they are read again when needed.
    pub(crate) fn release(&self) {
        self.entries.release();
    }

    /// Returns, for each of the first `end` clusters of the list, the sum of min(its f, f) over the triangles.
    pub(crate) fn given_by_each(&self, triangles: &[u32], values: &[f32], end: usize) -> Vec<f64> {
        let mut given = vec![0.0; end];
        for (&t, &own) in triangles.iter().zip(values) {
            for entry in self.row(t).iter().take_while(|entry| (entry.place as usize) < end) {
                given[entry.place as usize] += f64::from(entry.f.min(own));
            }
        }
        given
    }

    /// Returns the largest such sum that a single cluster of the list reaches.
    pub(crate) fn most_by_one(&self, triangles: &[u32], values: &[f32]) -> f64 {
        self.given_by_each(triangles, values, self.clusters).into_iter().fold(0.0, f64::max)
    }
}
