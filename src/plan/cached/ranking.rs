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
    packer.each(
        ranking
            .scales
            .iter()
            .map(|&scale| u8::from(scale == MapScale::Half)),
    );
    packer.list(&ranking.gains);
    packer.list(&ranking.fulfilment);
    packer.list(&ranking.kept);
    packer.list(&[ranking.reachable]);
    packer.list(area_shares);
    packer.each(
        triangle_reasons
            .iter()
            .map(|&reason| Reason::number(reason)),
    );
    packer.each(border.iter().map(|&is_border| u8::from(is_border)));
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
        && is_possible(&known);
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
        // Pixels are counted only up to the longest cut that any plan has asked for.
        && known.pixels.len() <= ranks
        && [known.triangle_reasons.len(), known.border.len()] == [triangles; 2]
}

/// Rounding of sums of gains.
const ROUNDING: f64 = 1e-6;

/// Returns true if a plan with these numbers can be read again: shares, in sums that rise.
fn is_possible(known: &UncutRanking) -> bool {
    let ranking = &known.ranking;
    let is_share = |share: &f64| (-ROUNDING..=1.0 + ROUNDING).contains(share);
    let mut sum = 0.0;
    let mut adds_up = |(gain, fulfilment): (&f64, &f64)| {
        let expected = std::mem::replace(&mut sum, *fulfilment) + gain;
        is_share(gain) && (expected - fulfilment).abs() <= ROUNDING
    };
    let least = -ROUNDING * ranking.reachable;
    is_share(&ranking.reachable)
        && ranking
            .gains
            .iter()
            .zip(&ranking.fulfilment)
            .all(&mut adds_up)
        && ranking.fulfilment.iter().all(is_share)
        && ranking
            .kept
            .windows(2)
            .all(|pair| pair[1] - pair[0] >= least)
        && ranking
            .kept
            .iter()
            .all(|&kept| (least..=ranking.reachable - least).contains(&kept))
        && known.area_shares.iter().all(is_share)
        && known
            .pixels
            .iter()
            .all(|pixels| (0.0..f64::INFINITY).contains(pixels))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::cached::bytes;

    /// Returns whether a cached ranking of two clusters and one triangle is accepted.
    fn is_believed(gains: [f64; 2], fulfilment: [f64; 2], kept: [f64; 2], reachable: f64) -> bool {
        let mut packer = Packer::default();
        packer.list(&[1_u32, 0]);
        packer.list(&[0_u8, 0]);
        for list in [gains, fulfilment, kept] {
            packer.list(&list);
        }
        packer.list(&[reachable]);
        packer.list(&[0.5, 0.25]);
        packer.list(&[Reason::number(None)]);
        packer.list(&[0_u8]);
        packer.list(&[90.0]);
        unpack(&bytes(&packer.finish()), 2, 1).is_some()
    }

    #[test]
    fn impossible_rankings_are_not_believed() {
        let (gains, fulfilment, kept) = ([0.5, 0.25], [0.5, 0.75], [0.25, 0.5]);
        assert!(is_believed(gains, fulfilment, kept, 0.5));
        for reachable in [-1.0, 0.4, 1.5, f64::NAN, f64::INFINITY, 1e-300] {
            assert!(
                !is_believed(gains, fulfilment, kept, reachable),
                "{reachable}"
            );
        }
        assert!(!is_believed([0.5, 0.5], fulfilment, kept, 0.5));
        assert!(!is_believed([0.5, 0.75], [0.5, 1.25], kept, 0.5));
        assert!(!is_believed([0.5, -2.5], [0.5, -2.0], kept, 0.5));
        assert!(!is_believed(gains, fulfilment, [0.5, 0.25], 0.5));
        assert!(!is_believed(gains, fulfilment, [-1.0, 0.25], 0.5));
    }
}
