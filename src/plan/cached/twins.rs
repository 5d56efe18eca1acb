//! The views that are set aside for a sharper one from the same place.

use crate::{
    base::packed::{Packed, Packer, Unpacker},
    method::twins::Twin,
    model::scene::ViewIndex,
};

pub(super) fn pack(twins: &[Twin]) -> Packed {
    let mut packer = Packer::default();
    packer.each(twins.iter().map(|twin| twin.view.0));
    packer.each(twins.iter().map(|twin| twin.sharper.0));
    packer.finish()
}

/// Unpacks twins. `count`: number of views of the scene.
pub fn unpack(bytes: &[u8], count: usize) -> Option<Vec<Twin>> {
    let mut lists = Unpacker::new(bytes);
    let (views, sharper) = (lists.list::<u32>()?, lists.list::<u32>()?);
    let ascends = views.is_sorted_by(|a, b| a < b);
    let fits = |&view: &u32| (view as usize) < count;
    let is_whole = lists.is_at_end()
        && views.len() == sharper.len()
        && ascends
        && views.iter().chain(&sharper).all(fits);
    let twin = |(view, sharper)| Twin {
        view: ViewIndex(view),
        sharper: ViewIndex(sharper),
    };
    is_whole.then(|| views.into_iter().zip(sharper).map(twin).collect())
}
