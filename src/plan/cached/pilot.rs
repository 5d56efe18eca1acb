//! The places that pilot maps show.

use nalgebra::Point3;

use crate::{
    base::{
        packed::{Packed, Packer, Unpacker},
        rows::Offsets,
    },
    method::pilot::{Agreement, Part, Places},
    model::{cluster::ViewCluster, scene::ViewIndex},
};

pub(super) fn pack(places: &Places) -> Packed {
    let mut packer = Packer::default();
    packer.each(places.views.iter().map(|view| view.0));
    packer.each(places.parts.iter().map(|part| part.len() as u32));
    let parts = || places.parts.iter().flatten();
    packer.each(parts().map(|part| part.place));
    packer.each(parts().map(|part| part.density));
    packer.each(parts().map(|part| part.kept));
    packer.each(
        places
            .centres
            .iter()
            .flat_map(|centre| centre.coords.data.0[0]),
    );
    packer.list(&places.sizes);
    packer.list(&places.measured_area);
    packer.each(places.agreement.iter().map(|&maps| maps as u8));
    packer.finish()
}

fn of_byte(maps: u8) -> Option<Agreement> {
    let known = [Agreement::Single, Agreement::Two, Agreement::More];
    known.into_iter().find(|agreement| *agreement as u8 == maps)
}

/// Unpacks the places of these clusters.
pub fn unpack(bytes: &[u8], clusters: &[ViewCluster]) -> Option<Places> {
    let mut lists = Unpacker::new(bytes);
    let (views, lengths, parts) = (
        lists.list::<u32>()?,
        lists.list::<u32>()?,
        lists.list::<u32>()?,
    );
    let (densities, kept) = (lists.list::<f32>()?, lists.list::<f32>()?);
    let centres = lists.list::<f64>()?;
    let (sizes, measured_area) = (lists.list::<f32>()?, lists.list::<f32>()?);
    let agreement = lists.list::<u8>()?;
    let number = sizes.len();
    let offsets = Offsets::from_lengths(lengths.iter().map(|&length| length as usize));
    let is_whole = lists.is_at_end()
        && lengths.len() == views.len()
        && offsets.entries() == parts.len()
        && densities.len() == parts.len()
        && kept.len() == parts.len()
        && centres.len() == 3 * number
        && measured_area.len() == number
        && agreement.len() == number;
    let of_clusters = clusters
        .iter()
        .map(|cluster| cluster.key.0)
        .eq(views.iter().copied());
    let is_possible = centres.iter().all(|x| x.is_finite())
        && kept.iter().all(|part| (0.0..=1.0).contains(part))
        && [&sizes, &measured_area, &densities]
            .iter()
            .all(|list| list.iter().all(|&size| size.is_finite() && size > 0.0));
    if !(is_whole && of_clusters && is_possible) {
        return None;
    }
    let part = |view: usize| {
        let row = offsets.row(view);
        // Where a row ascends, its last place bounds all.
        let ascends = parts[row.clone()].is_sorted_by(|a, b| a < b);
        let last = parts[row.clone()].last();
        let fits = last.is_none_or(|&last| (last as usize) < number);
        let part = |at: usize| Part {
            place: parts[at],
            density: densities[at],
            kept: kept[at],
        };
        (ascends && fits).then(|| row.map(part).collect::<Vec<Part>>())
    };
    Some(Places {
        parts: (0..views.len()).map(part).collect::<Option<_>>()?,
        views: views.into_iter().map(ViewIndex).collect(),
        centres: centres.chunks_exact(3).map(Point3::from_slice).collect(),
        sizes,
        measured_area,
        agreement: agreement.into_iter().map(of_byte).collect::<Option<_>>()?,
    })
}
