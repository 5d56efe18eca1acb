//! The candidate partners, and the pairs that were refused.

use std::collections::HashSet;

use crate::{
    base::{
        packed::{Packed, Packer, Unpacker},
        rows::Offsets,
    },
    method::partners::{Candidates, Refusals},
    model::scene::ViewIndex,
};

pub(super) fn pack(candidates: &Candidates) -> Packed {
    let mut packer = Packer::default();
    pack_rows(&mut packer, &candidates.offsets, candidates.views.iter());
    packer.each(candidates.beyond.iter().map(|&beyond| beyond as u32));
    let refusals = candidates.refusals.iter();
    packer.each(refusals.flat_map(|of| [of.rotation_only, of.not_matchable]));
    packer.finish()
}

fn pack_rows<'a>(
    packer: &mut Packer,
    offsets: &Offsets,
    views: impl Iterator<Item = &'a ViewIndex>,
) {
    packer.each((0..offsets.rows()).map(|row| offsets.row(row).len() as u32));
    packer.each(views.map(|view| view.0));
}

/// Unpacks candidates. `count`: number of views of the scene.
pub fn unpack(bytes: &[u8], count: usize) -> Option<Candidates> {
    let mut lists = Unpacker::new(bytes);
    let (offsets, views) = unpack_rows(&mut lists, count)?;
    let beyond: Vec<usize> = lists
        .list::<u32>()?
        .into_iter()
        .map(|beyond| beyond as usize)
        .collect();
    let refusals = lists.list::<u32>()?;
    let (refusals, rest) = refusals.as_chunks::<2>();
    let fits = beyond.len() == count
        && are_others_once(&offsets, &views)
        && (0..count).all(|view| beyond[view] <= offsets.row(view).len())
        && (refusals.len(), rest) == (count, &[])
        && refusals.iter().flatten().all(|&n| (n as usize) < count)
        && lists.is_at_end();
    let refusals = refusals.iter();
    let refusals = refusals.map(|&[rotation_only, not_matchable]| Refusals {
        rotation_only,
        not_matchable,
    });
    fits.then(|| Candidates {
        offsets,
        views,
        beyond,
        refusals: refusals.collect(),
    })
}

/// Returns true if no row has its own view, or another one twice.
fn are_others_once(offsets: &Offsets, views: &[ViewIndex]) -> bool {
    let is_valid = |row: usize| {
        let mut known = HashSet::from([row]);
        views[offsets.row(row)]
            .iter()
            .all(|view| known.insert(view.index()))
    };
    (0..offsets.rows()).all(is_valid)
}

fn unpack_rows(lists: &mut Unpacker, count: usize) -> Option<(Offsets, Vec<ViewIndex>)> {
    let (lengths, views) = (lists.list::<u32>()?, lists.list::<u32>()?);
    let offsets = Offsets::from_lengths(lengths.iter().map(|&length| length as usize));
    let fits = lengths.len() == count && offsets.entries() == views.len();
    let fits = fits && views.iter().all(|&view| (view as usize) < count);
    fits.then(|| (offsets, views.into_iter().map(ViewIndex).collect()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::cached::bytes;

    /// Returns whether a cache is accepted in which the first of three views has these partners,
    /// and this number of views is refused.
    fn is_believed(partners: &[u32], refused: u32) -> bool {
        let mut packer = Packer::default();
        packer.list(&[partners.len() as u32, 0, 0]);
        packer.list(partners);
        packer.list(&[0_u32; 3]);
        packer.list(&[0, refused, 0, 0, 0, 0]);
        unpack(&bytes(&packer.finish()), 3).is_some()
    }

    #[test]
    fn a_view_is_once_a_partner_of_others() {
        for views in [&[][..], &[1], &[2, 1]] {
            assert!(is_believed(views, 2), "{views:?}");
        }
        for views in [&[1, 1][..], &[0], &[2, 0], &[1, 2, 1], &[3]] {
            assert!(!is_believed(views, 2), "{views:?}");
        }
        assert!(!is_believed(&[], 3));
    }
}
