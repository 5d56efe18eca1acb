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
    let scale = |&is_half: &u8| match is_half {
        0 => MapScale::Full,
        _ => MapScale::Half,
    };
    let mut ranking = Ranking {
        order: lists.list()?,
        scales: lists.bytes()?.iter().map(scale).collect(),
        gains: lists.list()?,
        fulfilment: lists.list()?,
        kept: lists.list()?,
        reachable: 0.0,
    };
    [ranking.reachable] = lists.list()?.try_into().ok()?;
    let known = UncutRanking {
        ranking,
        area_shares: lists.list()?,
        triangle_reasons: lists
            .bytes()?
            .iter()
            .map(|&number| Reason::from_number(number))
            .collect::<Option<_>>()?,
        border: lists.bytes()?.iter().map(|&border| border != 0).collect(),
        pixels: lists.list()?,
    };
    let is_valid = lists.is_at_end()
        && is_order_of(clusters, &known.ranking.order)
        && fits(&known, triangles)
        && are_numbers(&known);
    is_valid.then_some(known)
}

/// Returns true if the order has valid clusters only, each at most once.
fn is_order_of(clusters: usize, order: &[u32]) -> bool {
    let mut is_left = vec![true; clusters];
    let mut takes = |&cluster: &u32| {
        is_left
            .get_mut(cluster as usize)
            .is_some_and(std::mem::take)
    };
    order.iter().all(&mut takes)
}

fn fits(known: &UncutRanking, triangles: usize) -> bool {
    let ranking = &known.ranking;
    let ranks = ranking.order.len();
    let lengths = [
        ranking.scales.len(),
        ranking.gains.len(),
        ranking.fulfilment.len(),
        ranking.kept.len(),
        known.area_shares.len(),
    ];
    lengths == [ranks; 5]
        && known.pixels.len() <= ranks
        && [known.triangle_reasons.len(), known.border.len()] == [triangles; 2]
}

fn are_numbers(known: &UncutRanking) -> bool {
    let ranking = &known.ranking;
    let lists = [
        &ranking.gains,
        &ranking.fulfilment,
        &ranking.kept,
        &known.area_shares,
        &known.pixels,
    ];
    let numbers = lists.into_iter().flatten().chain([&ranking.reachable]);
    numbers.copied().all(f64::is_finite)
}
