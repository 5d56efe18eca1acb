//! The view clusters and their fulfilment.

use rayon::prelude::*;

use crate::{
    base::{
        column::Storage,
        packed::{Packed, Packer, Unpacker},
        rows::Offsets,
    },
    decision::{Predicted, Tables},
    method::{fulfilment::FulfilmentTable, visibility::Visibility},
    model::{cluster::ViewCluster, scene::ViewIndex},
};

/// Clusters with their fulfilment.
pub struct CachedClusters {
    pub clusters: Vec<ViewCluster>,
    pub fulfilment: FulfilmentTable,
    /// That at half the size; `None` where all maps have full size.
    pub half: Option<FulfilmentTable>,
}

impl CachedClusters {
    pub fn predicted(&self) -> Predicted<'_> {
        (&self.fulfilment, self.half.as_ref())
    }
}

pub(super) fn pack(tables: &Tables) -> Option<Packed> {
    let Tables {
        clusters,
        fulfilment,
        half,
        visibility,
        ..
    } = tables;
    // These tables did not fit into memory; packed copies beside them would not either.
    if visibility.triangles.storage() == Storage::Disk {
        return None;
    }
    let partners = || clusters.iter().flat_map(|cluster| &cluster.partners);
    let mut packer = Packer::default();
    packer.each(clusters.iter().map(|cluster| cluster.key.0));
    packer.each(clusters.iter().map(|cluster| cluster.partners.len() as u32));
    packer.each(partners().map(|partner| partner.0));
    for table in std::iter::once(fulfilment).chain(half) {
        pack_table(&mut packer, table, clusters, visibility)?;
    }
    Some(packer.finish())
}

/// Packs a bit for each triangle that a key view sees, and the values of those that are fulfilled.
fn pack_table(
    packer: &mut Packer,
    table: &FulfilmentTable,
    clusters: &[ViewCluster],
    visibility: &Visibility,
) -> Option<()> {
    // A bit for each triangle seen is smaller than four bytes for each fulfilled one.
    let mut bits = Vec::new();
    for (i, cluster) in clusters.iter().enumerate() {
        let seen = visibility.triangles_seen_by(cluster.key);
        let mut fulfilled = table.row(i).0.iter().peekable();
        let start = bits.len();
        bits.resize(start + seen.len().div_ceil(8), 0u8);
        for (place, triangle) in seen.iter().enumerate() {
            if fulfilled.next_if_eq(&triangle).is_some() {
                bits[start + place / 8] |= 1 << (place % 8);
            }
        }
        // A triangle that the key view does not see has no bit, so such a table is not cached.
        fulfilled.next().is_none().then_some(())?;
    }
    packer.list(&bits);
    packer.column(&table.values);
    Some(())
}

/// Unpacks clusters with this visibility; `has_half`: with fulfilment at half the size.
pub fn unpack(bytes: &[u8], visibility: &Visibility, has_half: bool) -> Option<CachedClusters> {
    let mut lists = Unpacker::new(bytes);
    let (keys, lengths, partners) = (
        lists.list::<u32>()?,
        lists.list::<u32>()?,
        lists.list::<u32>()?,
    );
    let views = visibility.offsets.rows();
    let are_views = |list: &[u32]| list.iter().all(|&view| (view as usize) < views);
    // Clusters are looked up by key view in a binary search.
    let ascend = keys.is_sorted_by(|a, b| a < b);
    if !ascend || !are_views(&keys) || !are_views(&partners) || lengths.len() != keys.len() {
        return None;
    }
    let (mut rest, mut clusters) = (&partners[..], Vec::with_capacity(keys.len()));
    for (key, length) in keys.into_iter().zip(lengths) {
        let (own, others) = rest.split_at_checked(length as usize)?;
        clusters.push(ViewCluster {
            key: ViewIndex(key),
            partners: own.iter().copied().map(ViewIndex).collect(),
        });
        rest = others;
    }
    let fulfilment = unpack_table(&mut lists, &clusters, visibility)?;
    let half = if has_half {
        Some(unpack_table(&mut lists, &clusters, visibility)?)
    } else {
        None
    };
    (rest.is_empty() && lists.is_at_end()).then_some(CachedClusters {
        clusters,
        fulfilment,
        half,
    })
}

fn unpack_table(
    lists: &mut Unpacker,
    clusters: &[ViewCluster],
    visibility: &Visibility,
) -> Option<FulfilmentTable> {
    let (mut bits, values) = (lists.bytes()?, lists.list::<f32>()?);
    let mut rows = Vec::with_capacity(clusters.len());
    for cluster in clusters {
        let seen = visibility.triangles_seen_by(cluster.key);
        let (own, rest) = bits.split_at_checked(seen.len().div_ceil(8))?;
        rows.push((seen, own));
        bits = rest;
    }
    let lengths = rows
        .par_iter()
        .map(|(_, bits)| bits.iter().map(|byte| byte.count_ones() as usize).sum());
    let offsets = Offsets::from_lengths(lengths.collect::<Vec<usize>>());
    let are_values = values.par_iter().all(|&f| f > 0.0 && f <= 1.0);
    if !bits.is_empty() || offsets.entries() != values.len() || !are_values {
        return None;
    }
    let mut triangles = vec![0; values.len()];
    let fill = |((seen, bits), into): ((&[u32], &[u8]), &mut [u32])| {
        let fulfilled = seen
            .iter()
            .enumerate()
            .filter(|(place, _)| bits[place / 8] >> (place % 8) & 1 == 1);
        let filled = into
            .iter_mut()
            .zip(fulfilled)
            .map(|(into, (_, triangle))| *into = *triangle)
            .count();
        // Bits beyond the last triangle count in `lengths` but fill nothing: the file is damaged.
        (filled == into.len()).then_some(())
    };
    rows.into_par_iter()
        .zip(offsets.split_mut(&mut triangles))
        .map(fill)
        .collect::<Option<()>>()?;
    Some(FulfilmentTable {
        offsets: offsets.as_slice().to_vec(),
        triangles: triangles.into(),
        values: values.into(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A key view that sees two triangles, of which `bits` are fulfilled, with `values`.
    fn unpacked(bits: u8, values: &[f32]) -> Option<FulfilmentTable> {
        let (offsets, triangles) = (Offsets::from_lengths([2]), vec![3, 5].into());
        let visibility = Visibility {
            offsets,
            triangles,
            contradictions: 0,
        };
        let clusters = [ViewCluster {
            key: ViewIndex(0),
            partners: Vec::new(),
        }];
        let mut packer = Packer::default();
        packer.list(&[bits]);
        packer.list(values);
        let bytes: Vec<u8> = packer
            .finish()
            .iter()
            .flat_map(|part| part.as_bytes().to_vec())
            .collect();
        unpack_table(&mut Unpacker::new(&bytes), &clusters, &visibility)
    }

    #[test]
    fn bits_are_those_of_the_triangles_with_values() {
        let table = unpacked(0b10, &[0.5]).unwrap();
        assert_eq!(table.row(0), (&[5][..], &[0.5][..]));
        let wrong: [(u8, &[f32]); 5] = [
            (0b11, &[0.5]),
            (0b01, &[0.5, 0.5]),
            (0b110, &[0.5, 0.5]),
            (0b100, &[0.5]),
            (0b01, &[1.5]),
        ];
        for (bits, values) in wrong {
            assert!(unpacked(bits, values).is_none(), "{bits:b} {values:?}");
        }
    }
}
