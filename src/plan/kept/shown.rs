//! What the views show of each triangle.

use crate::{
    base::packed::{Packer, Unpacker},
    method::visibility::Shown,
};

pub(super) fn pack(shown: &Shown) -> Vec<u8> {
    let mut packer = Packer::default();
    packer.list(&shown.views);
    packer.list(&shown.pixels);
    packer.list(&shown.finest_gsd);
    packer.finish()
}

/// Unpacks what is shown of so many triangles.
pub fn unpack(bytes: &[u8], triangles: usize) -> Option<Shown> {
    let mut lists = Unpacker::new(bytes);
    let shown = Shown { views: lists.list()?, pixels: lists.list()?, finest_gsd: lists.list()? };
    let lengths = [shown.views.len(), shown.pixels.len(), shown.finest_gsd.len()];
    let fits = lists.is_at_end() && lengths.iter().all(|&length| length == triangles);
    (fits && shown.pixels.iter().all(|pixels| pixels.is_finite() && *pixels >= 0.0)).then_some(shown)
}
