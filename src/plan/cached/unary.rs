//! The confidence of views by themselves.

use rayon::prelude::*;

use crate::{
    base::{
        column::Storage,
        packed::{Packed, Packer, Unpacker},
    },
    method::confidence::{AROUND, Unary},
};

/// Packs the columns, and the warnings as facts.
pub(super) fn pack(unary: &Unary, warnings: &[String]) -> Option<(Vec<String>, Packed)> {
    let (observed, around, allowed) = unary.columns();
    if [observed.storage(), allowed.storage()].contains(&Storage::Disk) {
        return None;
    }
    let mut packer = Packer::default();
    packer.list(&[around]);
    packer.column(observed);
    packer.column(allowed);
    Some((warnings.to_vec(), packer.finish()))
}

/// Unpacks the columns. `rows`: number of rows of the visibility table.
pub fn unpack(bytes: &[u8], rows: usize) -> Option<Unary> {
    let mut lists = Unpacker::new(bytes);
    let (around, observed, allowed) = (
        lists.list::<u8>()?,
        lists.list::<u8>()?,
        lists.list::<f32>()?,
    );
    let &[around] = &around[..] else { return None };
    let fits = |length: usize| length == 0 || length == rows;
    let are_numbers = (1..=AROUND).contains(&around.into())
        && observed.par_iter().all(|&number| number <= around);
    let are_shares = allowed.par_iter().all(|share| (0.0..=1.0).contains(share));
    let is_whole = lists.is_at_end() && fits(observed.len()) && fits(allowed.len());
    (is_whole && are_numbers && are_shares)
        .then(|| Unary::of_points(observed.into(), around).within(allowed.into()))
}
