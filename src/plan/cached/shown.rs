//! Number of views, pixels and finest GSD of each triangle.

use rayon::prelude::*;

use crate::{
    base::packed::{Packed, Packer, Unpacker},
    method::visibility::Shown,
};

pub(super) fn pack(shown: &Shown) -> Packed {
    let mut packer = Packer::default();
    packer.list(&shown.views);
    packer.list(&shown.pixels);
    packer.list(&shown.finest_gsd);
    packer.finish()
}

/// Unpacks the figures of the triangles. `views`: number of views of the scene; `triangles`: of its
/// surface.
pub fn unpack(bytes: &[u8], views: usize, triangles: usize) -> Option<Shown> {
    let mut lists = Unpacker::new(bytes);
    let shown = Shown {
        views: lists.list()?,
        pixels: lists.list()?,
        finest_gsd: lists.list()?,
    };
    let lengths = [
        shown.views.len(),
        shown.pixels.len(),
        shown.finest_gsd.len(),
    ];
    let fits = lists.is_at_end() && lengths.iter().all(|&length| length == triangles);
    let most = Shown::MOST_PIXELS * views as f64;
    let is_possible = shown
        .views
        .par_iter()
        .all(|&number| number as usize <= views)
        && shown
            .pixels
            .par_iter()
            .all(|pixels| (0.0..=most).contains(pixels))
        && shown.finest_gsd.par_iter().all(|&gsd| gsd > 0.0);
    (fits && is_possible).then_some(shown)
}
