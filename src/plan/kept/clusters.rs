//! The view clusters and their fulfilment.

use crate::{
    base::{
        column::Storage,
        packed::{Packed, Packer, Unpacker},
    },
    method::{fulfilment::FulfilmentTable, visibility::Visibility},
    model::{cluster::ViewCluster, scene::ViewIndex},
    plan::Stages,
};

/// Clusters, their fulfilment, and that at half the size.
pub type KeptClusters = (Vec<ViewCluster>, FulfilmentTable, Option<FulfilmentTable>);

pub(super) fn pack(stages: &Stages) -> Option<Packed> {
    let Stages { clusters, fulfilment, half, visibility, .. } = stages;
    if visibility.triangles.storage() == Storage::Disk {
        return None;
    }
    let partners = || clusters.iter().flat_map(|cluster| &cluster.partners);
    let mut packer = Packer::default();
    packer.list(&clusters.iter().map(|cluster| cluster.key.0).collect::<Vec<_>>());
    packer.list(&clusters.iter().map(|cluster| cluster.partners.len() as u32).collect::<Vec<_>>());
    packer.list(&partners().map(|partner| partner.0).collect::<Vec<_>>());
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
        fulfilled.next().is_none().then_some(())?;
    }
    packer.list(&bits);
    packer.column(&table.values);
    Some(())
}

/// Unpacks clusters with this visibility; `has_half`: with fulfilment at half the size.
pub fn unpack(bytes: &[u8], visibility: &Visibility, has_half: bool) -> Option<KeptClusters> {
    let mut lists = Unpacker::new(bytes);
    let (keys, lengths, partners) = (lists.list::<u32>()?, lists.list::<u32>()?, lists.list::<u32>()?);
    let views = visibility.offsets.rows();
    let are_views = |list: &[u32]| list.iter().all(|&view| (view as usize) < views);
    let ascend = keys.is_sorted_by(|a, b| a < b);
    if !ascend || !are_views(&keys) || !are_views(&partners) || lengths.len() != keys.len() {
        return None;
    }
    let (mut rest, mut clusters) = (&partners[..], Vec::with_capacity(keys.len()));
    for (key, length) in keys.into_iter().zip(lengths) {
        let (own, others) = rest.split_at_checked(length as usize)?;
        clusters.push(ViewCluster { key: ViewIndex(key), partners: own.iter().copied().map(ViewIndex).collect() });
        rest = others;
    }
    let full = unpack_table(&mut lists, &clusters, visibility)?;
    let half = match has_half {
        true => Some(unpack_table(&mut lists, &clusters, visibility)?),
        false => None,
    };
    (rest.is_empty() && lists.is_at_end()).then_some((clusters, full, half))
}

fn unpack_table(lists: &mut Unpacker, clusters: &[ViewCluster], visibility: &Visibility) -> Option<FulfilmentTable> {
    let (mut bits, values) = (lists.bytes()?, lists.list::<f32>()?);
    let (mut offsets, mut triangles) = (vec![0], Vec::with_capacity(values.len()));
    for cluster in clusters {
        let seen = visibility.triangles_seen_by(cluster.key);
        let (own, rest) = bits.split_at_checked(seen.len().div_ceil(8))?;
        let fulfilled = seen.iter().enumerate().filter(|(place, _)| own[place / 8] >> (place % 8) & 1 == 1);
        triangles.extend(fulfilled.map(|(_, triangle)| *triangle));
        offsets.push(triangles.len());
        bits = rest;
    }
    let fits = bits.is_empty() && triangles.len() == values.len() && values.iter().all(|&f| f > 0.0 && f <= 1.0);
    fits.then(|| FulfilmentTable { offsets, triangles: triangles.into(), values: values.into() })
}
