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

/// Consecutive triangles whose entries one thread sorts.
struct Part<'a> {
    first: u32,
    /// Place of the next entry of each triangle.
    next: Vec<usize>,
    entries: &'a mut [Entry],
}

impl Part<'_> {
    fn add(&mut self, place: u32, (triangles, values): (&[u32], &[f32])) {
        let rows = [self.first, self.first + self.next.len() as u32];
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
        let row = |cluster| table.row(cluster as usize);
        Self::of_rows(
            &row,
            &|| table.release(),
            table.triangles.storage(),
            clusters,
            triangles,
        )
    }

    /// As [`Self::new`], for rows from several tables; `release` lets the operating system drop
    /// their pages.
    pub fn of_rows<'r>(
        row: &(dyn Fn(u32) -> (&'r [u32], &'r [f32]) + Sync),
        release: &dyn Fn(),
        storage: Storage,
        clusters: &[u32],
        triangles: usize,
    ) -> Result<Self, DiskError> {
        let mut offsets = vec![0; triangles + 1];
        for (place, &cluster) in clusters.iter().enumerate() {
            row(cluster)
                .0
                .iter()
                .for_each(|&t| offsets[t as usize + 1] += 1);
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
            let end =
                (offsets.partition_point(|&offset| offset <= room) - 1).clamp(from + 1, triangles);
            entries.extend(&Self::entries(
                row,
                release,
                clusters,
                &offsets[from..=end],
                from as u32,
            ))?;
            from = end;
        }
        Ok(Self {
            offsets,
            entries: entries.finish()?,
            clusters: clusters.len(),
        })
    }

    /// Returns the entries of consecutive triangles with these offsets.
    fn entries<'r>(
        row: &(dyn Fn(u32) -> (&'r [u32], &'r [f32]) + Sync),
        release: &dyn Fn(),
        clusters: &[u32],
        offsets: &[usize],
        first: u32,
    ) -> Vec<Entry> {
        let triangles = offsets.len() - 1;
        let mut entries = vec![Entry::zeroed(); offsets[triangles] - offsets[0]];
        let (mut parts, mut rest) = (Vec::new(), &mut entries[..]);
        for from in (0..triangles).step_by(TRIANGLES_AT_ONCE) {
            let end = (from + TRIANGLES_AT_ONCE).min(triangles);
            let next = offsets[from..end]
                .iter()
                .map(|offset| offset - offsets[from])
                .collect();
            let (own, others) = rest.split_at_mut(offsets[end] - offsets[from]);
            parts.push(Part {
                first: first + from as u32,
                next,
                entries: own,
            });
            rest = others;
        }
        for (start, some) in (0..)
            .step_by(column::READ_AT_ONCE)
            .zip(clusters.chunks(column::READ_AT_ONCE))
        {
            parts.par_iter_mut().for_each(|part| {
                (start..)
                    .zip(some)
                    .for_each(|(place, &cluster)| part.add(place, row(cluster)));
            });
            release();
        }
        entries
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
