//! Candidate depth maps: each cluster at full size and, if requested, at half size (method 5.8).

use crate::{base::column::Storage, method::fulfilment::FulfilmentTable, model::cluster::MapScale};

/// Depth maps by index: those of all clusters at full size, then, if requested, those of all
/// clusters at half size.
#[derive(Clone, Copy, Debug)]
pub struct Maps<'a> {
    full: &'a FulfilmentTable,
    half: Option<Half<'a>>,
}

#[derive(Clone, Copy, Debug)]
struct Half<'a> {
    table: &'a FulfilmentTable,
    /// Work of each cluster's map at full and at half size, in any unit.
    work: &'a [[f64; 2]],
}

impl<'a> Maps<'a> {
    /// Builds candidates of full size, all of equal work.
    pub fn full_size(full: &'a FulfilmentTable) -> Self {
        Self { full, half: None }
    }

    /// Builds candidates of both sizes. `work`: that of each cluster's map at full and at half
    /// size, in any unit, above 0.
    pub fn two_sizes(
        full: &'a FulfilmentTable,
        half: &'a FulfilmentTable,
        work: &'a [[f64; 2]],
    ) -> Self {
        Self {
            full,
            half: Some(Half { table: half, work }),
        }
    }

    /// Returns true if the maps of a cluster differ by size.
    pub fn has_half(&self) -> bool {
        self.half.is_some()
    }

    pub(super) fn clusters(&self) -> u32 {
        self.full.clusters() as u32
    }

    pub(super) fn len(&self) -> u32 {
        self.clusters() * if self.has_half() { 2 } else { 1 }
    }

    pub(super) fn cluster(&self, map: u32) -> u32 {
        map.checked_sub(self.clusters()).unwrap_or(map)
    }

    pub(super) fn scale(&self, map: u32) -> MapScale {
        if map < self.clusters() {
            MapScale::Full
        } else {
            MapScale::Half
        }
    }

    pub(super) fn index(&self, cluster: u32, scale: MapScale) -> u32 {
        match scale {
            MapScale::Half if self.has_half() => cluster + self.clusters(),
            _ => cluster,
        }
    }

    /// Returns the triangles of a map with their f.
    pub(super) fn row(&self, map: u32) -> (&'a [u32], &'a [f32]) {
        match self.half {
            Some(half) if map >= self.clusters() => half.table.row(self.cluster(map) as usize),
            _ => self.full.row(map as usize),
        }
    }

    /// Returns the row of a cluster at a size; at full size if there are no half-size maps.
    pub fn row_at(&self, cluster: u32, scale: MapScale) -> (&'a [u32], &'a [f32]) {
        match (self.half, scale) {
            (Some(half), MapScale::Half) => half.table.row(cluster as usize),
            _ => self.full.row(cluster as usize),
        }
    }

    /// Returns the cost of a map, in the ranking and in the bound.
    pub(super) fn work(&self, map: u32) -> f64 {
        let size = usize::from(map >= self.clusters());
        self.half
            .map_or(1.0, |half| half.work[self.cluster(map) as usize][size])
    }

    /// Returns the storage (memory or disk) of tables derived from these.
    pub(super) fn storage(&self) -> Storage {
        self.full.triangles.storage()
    }

    /// Lets the operating system drop pages of tables on disk; they are read again when needed.
    pub fn release(&self) {
        self.full.release();
        if let Some(half) = self.half {
            half.table.release();
        }
    }
}
