//! The ranking without finished depth maps, with what follows from it.

use crate::{
    base::packed::{Packed, Packer, Unpacker},
    method::ranking::Ranking,
    model::{cluster::MapScale, reason::Reason},
    plan::{Decision, UncutRanking},
};

pub(super) fn pack(decision: &Decision) -> Packed {
    let Decision {
        ranking,
        area_shares,
        triangle_reasons,
        border,
        pixels,
        ..
    } = decision;
    let mut packer = Packer::default();
    packer.list(&ranking.order);
    packer.list(
        &ranking
            .scales
            .iter()
            .map(|&scale| u8::from(scale == MapScale::Half))
            .collect::<Vec<_>>(),
    );
    packer.list(&ranking.gains);
    packer.list(&ranking.fulfilment);
    packer.list(&ranking.kept);
    packer.list(&[ranking.reachable]);
    packer.list(area_shares);
    packer.list(
        &triangle_reasons
            .iter()
            .map(|&reason| Reason::number(reason))
            .collect::<Vec<_>>(),
    );
    packer.list(
        &border
            .iter()
            .map(|&is_border| u8::from(is_border))
            .collect::<Vec<_>>(),
    );
    packer.list(pixels);
    packer.finish()
}

/// Unpacks a ranking of that many clusters, for a surface of that many triangles.
pub fn unpack(bytes: &[u8], clusters: usize, triangles: usize) -> Option<UncutRanking> {
    let mut lists = Unpacker::new(bytes);
    let order = lists.list::<u32>()?;
    let scales = lists
        .bytes()?
        .iter()
        .map(|&half| {
            if half == 0 {
                MapScale::Full
            } else {
                MapScale::Half
            }
        })
        .collect();
    let (gains, fulfilment, kept) = (
        lists.list::<f64>()?,
        lists.list::<f64>()?,
        lists.list::<f64>()?,
    );
    let [reachable] = lists.list::<f64>()?.try_into().ok()?;
    let ranking = Ranking {
        order,
        scales,
        gains,
        fulfilment,
        kept,
        reachable,
    };
    let area_shares = lists.list::<f64>()?;
    let triangle_reasons: Vec<_> = lists
        .bytes()?
        .iter()
        .map(|&number| Reason::from_number(number))
        .collect::<Option<_>>()?;
    let border: Vec<bool> = lists
        .bytes()?
        .iter()
        .map(|&is_border| is_border != 0)
        .collect();
    let pixels = lists.list::<f64>()?;
    let mut is_left = vec![true; clusters];
    let takes = |&cluster: &u32| {
        is_left
            .get_mut(cluster as usize)
            .is_some_and(std::mem::take)
    };
    let is_ranking = ranking.order.iter().all(takes) && lists.is_at_end();
    let ranks = ranking.order.len();
    let lengths = [
        &ranking.gains,
        &ranking.fulfilment,
        &ranking.kept,
        &area_shares,
    ]
    .map(Vec::len);
    let fits = ranking.scales.len() == ranks && lengths == [ranks; 4] && pixels.len() <= ranks;
    let fits = fits && triangle_reasons.len() == triangles && border.len() == triangles;
    let numbers = [
        &ranking.gains,
        &ranking.fulfilment,
        &ranking.kept,
        &area_shares,
        &pixels,
    ]
    .into_iter()
    .flatten();
    let are_numbers = numbers
        .chain([&ranking.reachable])
        .all(|number| number.is_finite());
    (is_ranking && fits && are_numbers).then_some(UncutRanking {
        ranking,
        area_shares,
        triangle_reasons,
        border,
        pixels,
    })
}
