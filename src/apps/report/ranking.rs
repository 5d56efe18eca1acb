//! The ranking as arrays of the page.

use serde::Serialize;

use super::{bytes, contents::offset_bytes};
use crate::{
    base::rows::Offsets,
    model::{cluster::MapScale, scene::ViewIndex},
    plan::Plan,
};

/// One element per rank, unless noted.
#[derive(Serialize)]
pub struct RankingData {
    /// u32.
    keys: String,
    /// u32, CSR by rank.
    partners: String,
    partner_offsets: String,
    /// f64 each.
    gains: String,
    shares: String,
    points: String,
    /// Null where all depth maps have one size.
    sizes: Option<SizeData>,
}

/// Depth maps of two sizes.
#[derive(Serialize)]
struct SizeData {
    /// f64: work of the depth map, over that of the same at full size; below 1 at half the size.
    of_full: String,
    /// f64: work up to here, over that of all depth maps at full size.
    work: String,
}

impl RankingData {
    pub fn new(plan: &Plan) -> Self {
        let numbers = |views: Vec<ViewIndex>| bytes(&views.iter().map(|v| v.0).collect::<Vec<_>>());
        let shares: Vec<f64> = plan.ranked().map(|cluster| cluster.share).collect();
        Self {
            keys: numbers(plan.ranked().map(|cluster| cluster.key).collect()),
            partner_offsets: offset_bytes(&Offsets::from_lengths(
                plan.ranked().map(|cluster| cluster.partners.len()),
            )),
            partners: numbers(plan.ranked().flat_map(|cluster| cluster.partners).collect()),
            gains: bytes(&plan.decision.ranking.gains),
            shares: bytes(&shares),
            points: bytes(&plan.points_by_rank()),
            sizes: SizeData::new(plan),
        }
    }
}

impl SizeData {
    fn new(plan: &Plan) -> Option<Self> {
        let ranking = &plan.decision.ranking;
        ranking.scales.contains(&MapScale::Half).then(|| {
            let (mut of_full, mut work, mut sum) = (Vec::new(), Vec::new(), 0.0);
            let share_of = plan.stages.shares_of_work();
            for (&cluster, &scale) in ranking.order.iter().zip(&ranking.scales) {
                let own = share_of(cluster, scale);
                of_full.push(own / share_of(cluster, MapScale::Full));
                sum += own;
                work.push(sum);
            }
            Self {
                of_full: bytes(&of_full),
                work: bytes(&work),
            }
        })
    }
}
