//! Method 5.3: cuts the ranking.

use serde::{Deserialize, Serialize};

use super::{Band, CutSettings, DecisionError, GivenUp, forecast::Cost};
use crate::{base::amounts::Budget, method::fulfilment::block::BlockSlots};

/// Default target: a share of what all clusters together reach.
pub const DEFAULT_TARGET: f64 = 0.9;

/// A limit of the settings (`[cut]`).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "lowercase")]
pub enum CutLimit {
    Budget,
    Target,
    Time,
    Points,
}

/// Part of the ranking to compute.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Cut {
    /// Number of clusters to compute, from the start of the ranking.
    pub clusters: usize,
    /// The limit that ends it there, the target before others; null if none does: all clusters, or
    /// more are finished than the limits allow. Plans of viewrank 0.1 lack it.
    #[serde(default)]
    pub limit: Option<CutLimit>,
    /// Their (key view, partner) pairs; 0 for a program that matches none.
    pub pairs: usize,
    /// Weight that fusion keeps of them over that of all clusters (`kept` over `reachable`), 0 to
    /// 1.
    pub share: f64,
    /// Band in which the measured share is expected.
    #[serde(default)]
    pub share_band: Band,
    /// Weight that fusion keeps of them, over that of the whole surface, 0 to 1. For a
    /// program that uses the images themselves: the part of all photographs that they draw (method
    /// 5.10).
    #[serde(default)]
    pub kept: f64,
    /// The same for all clusters: the share of the target that these photographs can reach.
    #[serde(default)]
    pub reachable: f64,
    /// Band in which the measured value of that is expected.
    #[serde(default)]
    pub reachable_band: Band,
    /// Their fulfilment f_o, 0 to 1; for a program that uses the images themselves, `kept`.
    pub fulfilment: f64,
    /// Proven upper bound on f_o of any choice with this number of clusters; with a choice of
    /// sizes, of this work. For a program that uses the images themselves: `reachable`.
    #[serde(default)]
    pub fulfilment_bound: f64,
    /// Pairs that are beyond the gate of the backend.
    #[serde(default)]
    pub pairs_beyond_gate: usize,
    /// What the cut leaves out; nothing where no depth maps are made.
    #[serde(default)]
    pub given_up: GivenUp,
}

impl Cut {
    /// Returns by how much no other choice of this number of clusters has a higher fulfilment, as
    /// the bound proves: "more than 4 %".
    pub fn more_of_others(&self) -> String {
        let better = 100.0 * (self.fulfilment_bound / self.fulfilment - 1.0).max(0.0);
        if better < 0.5 {
            "even 0.5 %".into()
        } else {
            format!("more than {better:.0} %")
        }
    }
}

/// Cuts at the shortest prefix that the settings allow, but not before the end of the finished
/// clusters.
pub fn cut(settings: &CutSettings, cost: &Cost) -> Result<Cut, DecisionError> {
    let ranking = cost.ranking;
    let End { clusters, limit } = match end(settings, cost)? {
        end if end.clusters < cost.finished => End::after(cost.finished),
        end => end,
    };
    let up_to_cut = |values: &[f64]| clusters.checked_sub(1).map_or(0.0, |last| values[last]);
    Ok(Cut {
        clusters,
        limit,
        pairs: cost.pairs(clusters),
        share: ranking.share(clusters),
        kept: up_to_cut(&ranking.kept),
        reachable: ranking.reachable,
        fulfilment: up_to_cut(&ranking.fulfilment),
        ..Cut::default()
    })
}

/// Where limits end the ranking.
struct End {
    clusters: usize,
    limit: Option<CutLimit>,
}

impl End {
    fn after(clusters: usize) -> Self {
        Self {
            clusters,
            limit: None,
        }
    }

    /// Returns this end, or that by another limit if it comes before.
    fn or_sooner(self, clusters: usize, limit: CutLimit) -> Self {
        if clusters < self.clusters {
            Self {
                clusters,
                limit: Some(limit),
            }
        } else {
            self
        }
    }
}

/// Returns the end of the shortest prefix that the settings allow.
fn end(settings: &CutSettings, cost: &Cost) -> Result<End, DecisionError> {
    let mut end = End::after(cost.ranking.order.len());
    // The target first: a plan that reaches it is not cut short by another limit at the same
    // length.
    if let Some(target) = settings.target {
        end = end.or_sooner(cost.ranking.length_for_share(target.0), CutLimit::Target);
    }
    if let Some(budget) = settings.budget {
        let length = length_for_budget(budget, cost, end.clusters)?;
        end = end.or_sooner(length, CutLimit::Budget);
    }
    if let Some(time) = settings.time {
        let seconds = |rank| cost.seconds(rank).ok_or(DecisionError::NoTimes);
        let length = longest_within(end.clusters, time.0, seconds)?;
        end = end.or_sooner(length, CutLimit::Time);
    }
    if let Some(points) = settings.points {
        let length = length_for_points(points.0, cost, end.clusters)?;
        end = end.or_sooner(length, CutLimit::Points);
    }
    Ok(end)
}

/// Returns the number of clusters that a budget allows, of `most`.
fn length_for_budget(budget: Budget, cost: &Cost, most: usize) -> Result<usize, DecisionError> {
    match budget {
        // If maps differ in work, a share of the views is a share of the work.
        Budget::Views(share) if cost.options.has_half => {
            let works: Vec<f64> = cost.works().collect();
            longest_within(most, share.0, |rank| Ok(works[rank]))
        }
        // Of all views, some of which may lack an image or partners; of images, those that can be
        // chosen.
        budget if cost.options.makes_maps => Ok(budget.clusters(cost.model.scene.views.len())),
        budget => Ok(budget.clusters(cost.tables.clusters.len())),
    }
}

/// Returns the number of clusters, of `most`, whose maps measure no more than these points.
fn length_for_points(points: f64, cost: &Cost, most: usize) -> Result<usize, DecisionError> {
    let mut slots = BlockSlots::new(&cost.model);
    longest_within(most, points, |rank| Ok(cost.points(rank, &mut slots)))
}

/// Returns the length of the longest prefix of at most `most` clusters whose costs add up to no
/// more than `limit`.
fn longest_within(
    most: usize,
    limit: f64,
    mut cost: impl FnMut(usize) -> Result<f64, DecisionError>,
) -> Result<usize, DecisionError> {
    let mut sum = 0.0;
    for rank in 0..most {
        sum += cost(rank)?;
        if sum > limit {
            return Ok(rank);
        }
    }
    Ok(most)
}
