//! The ranking without finished depth maps.

use crate::{
    base::packed::{Packed, Packer, Unpacker},
    method::ranking::Ranking,
    model::cluster::MapScale,
};

pub(super) fn pack(ranking: &Ranking) -> Packed {
    let mut packer = Packer::default();
    packer.list(&ranking.order);
    packer.list(&ranking.scales.iter().map(|&scale| u8::from(scale == MapScale::Half)).collect::<Vec<_>>());
    packer.list(&ranking.gains);
    packer.list(&ranking.fulfilment);
    packer.list(&ranking.kept);
    packer.list(&[ranking.reachable]);
    packer.finish()
}

/// Unpacks a ranking. `clusters`: number of clusters that are ranked.
pub fn unpack(bytes: &[u8], clusters: usize) -> Option<Ranking> {
    let mut lists = Unpacker::new(bytes);
    let order = lists.list::<u32>()?;
    let scales = lists.bytes()?.iter().map(|&half| if half == 0 { MapScale::Full } else { MapScale::Half }).collect();
    let (gains, fulfilment, kept) = (lists.list::<f64>()?, lists.list::<f64>()?, lists.list::<f64>()?);
    let [reachable] = lists.list::<f64>()?.try_into().ok()?;
    let mut is_left = vec![true; clusters];
    let takes = |&cluster: &u32| is_left.get_mut(cluster as usize).is_some_and(std::mem::take);
    let is_ranking = order.iter().all(takes) && lists.is_at_end();
    let ranking = Ranking { order, scales, gains, fulfilment, kept, reachable };
    let lengths = [ranking.scales.len(), ranking.gains.len(), ranking.fulfilment.len(), ranking.kept.len()];
    (is_ranking && lengths.iter().all(|&length| length == ranking.order.len())).then_some(ranking)
}
