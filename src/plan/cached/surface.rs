//! The surface with its visibility.

use nalgebra::Point3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::{
    base::{
        column::{Column, Storage},
        packed::{Packed, Packer, Unpacker, count_gaps, push_gaps, read_gaps},
        rows::Offsets,
    },
    method::{surface::SurfaceStats, visibility::Visibility},
    model::surface::{Surface, SurfaceKind},
};

/// The small results.
#[derive(Serialize, Deserialize)]
pub struct Facts {
    kind: SurfaceKind,
    stats: SurfaceStats,
    contradictions: u64,
}

/// The triangles that views see, and what was found on the way.
pub struct CachedSurface {
    pub surface: Surface,
    pub stats: SurfaceStats,
    pub visibility: Visibility,
}

pub(super) fn pack(
    surface: &Surface,
    stats: &SurfaceStats,
    visibility: &Visibility,
) -> Option<(Facts, Packed)> {
    if visibility.triangles.storage() == Storage::Disk {
        return None;
    }
    // A row ascends, so most gaps take one byte where an index takes four.
    let gaps = |view| {
        let mut bytes = Vec::new();
        push_gaps(visibility.triangles_seen_by(view), &mut bytes);
        bytes
    };
    let rows: Vec<Vec<u8>> = visibility.views().into_par_iter().map(gaps).collect();
    let mut packer = Packer::default();
    packer.each(
        surface
            .vertices
            .iter()
            .flat_map(|vertex| vertex.coords.data.0[0]),
    );
    packer.list(surface.triangles.as_flattened());
    packer.each(rows.iter().map(|row| row.len() as u32));
    packer.list(&rows.concat());
    let contradictions = visibility.contradictions;
    let facts = Facts {
        kind: surface.kind,
        stats: stats.clone(),
        contradictions,
    };
    Some((facts, packer.finish()))
}

impl CachedSurface {
    /// Unpacks surface and visibility. `views`: number of views of the scene.
    pub fn unpack(facts: Facts, bytes: &[u8], views: usize) -> Option<Self> {
        let mut lists = Unpacker::new(bytes);
        let (coordinates, corners) = (lists.list::<f64>()?, lists.list::<u32>()?);
        let (lengths, gaps) = (lists.list::<u32>()?, lists.bytes()?);
        let (vertices, rest) = coordinates.as_chunks::<3>();
        let (triangles, others) = corners.as_chunks::<3>();
        let fits =
            lists.is_at_end() && rest.is_empty() && others.is_empty() && lengths.len() == views;
        // A surface that no view sees is an error where it is built, never a result.
        if !fits || triangles.is_empty() || !coordinates.iter().all(|x| x.is_finite()) {
            return None;
        }
        corners
            .iter()
            .all(|&corner| (corner as usize) < vertices.len())
            .then_some(())?;
        let (offsets, seen) = rows(&lengths, gaps, triangles.len() as u32)?;
        Some(Self {
            surface: Surface {
                kind: facts.kind,
                vertices: vertices.iter().copied().map(Point3::from).collect(),
                triangles: triangles.to_vec(),
            },
            stats: facts.stats,
            visibility: Visibility {
                offsets,
                triangles: seen,
                contradictions: facts.contradictions,
            },
        })
    }
}

/// Reads the rows of visibility from their lengths in bytes and their gaps.
fn rows(lengths: &[u32], mut gaps: &[u8], triangles: u32) -> Option<(Offsets, Column<u32>)> {
    let mut packed = Vec::with_capacity(lengths.len());
    for &length in lengths {
        let (row, rest) = gaps.split_at_checked(length as usize)?;
        packed.push(row);
        gaps = rest;
    }
    if !gaps.is_empty() {
        return None;
    }
    let offsets = Offsets::from_lengths(
        packed
            .par_iter()
            .map(|row| count_gaps(row))
            .collect::<Vec<_>>(),
    );
    let mut all = vec![0; offsets.entries()];
    let rows = packed.into_par_iter().zip(offsets.split_mut(&mut all));
    rows.map(|(row, seen)| read_gaps(row, triangles, seen))
        .collect::<Option<()>>()?;
    Some((offsets, all.into()))
}
