//! A plan that chooses nothing is no plan: why, and what to do about it.

use std::{cmp::Reverse, collections::BTreeMap};

use super::Plan;
use crate::{base::error::Hint, model::reason::Reason};

/// Why nothing is chosen.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Nothing {
    /// No view cluster fulfils anything.
    #[error("no view cluster fulfils anything, most often ({of} of {views} views) because {}", reason.words())]
    Fulfilled { reason: Reason, of: usize, views: usize, cure: Option<String> },
    #[error("what was asked for allows none of {ranked} view clusters: {limits}")]
    Allowed { ranked: usize, limits: String },
}

impl Nothing {
    /// `None`: something is chosen.
    pub fn of(plan: &Plan) -> Option<Self> {
        let ranked = plan.decision.ranking.order.len();
        match plan.decision.cut.clusters {
            0 if ranked == 0 => Some(Self::nothing_fulfilled(plan)),
            0 => Some(Self::Allowed { ranked, limits: limits(plan) }),
            _ => None,
        }
    }

    fn nothing_fulfilled(plan: &Plan) -> Self {
        let mut counts = BTreeMap::new();
        plan.decision
            .views
            .iter()
            .filter_map(|(_, reason)| *reason)
            .for_each(|r| *counts.entry(r).or_insert(0usize) += 1);
        let most = counts.into_iter().max_by_key(|&(reason, count)| (count, Reverse(reason)));
        let (reason, of) = most.unwrap_or((Reason::Hidden, 0));
        Self::Fulfilled { reason, of, views: plan.decision.views.len(), cure: too_few_partners(plan) }
    }
}

/// k too small for what is asked of a cluster.
fn too_few_partners(plan: &Plan) -> Option<String> {
    let k = plan.stages.settings.partners.k;
    let cameras = plan.stages.settings.coverage.min_cameras;
    let matches = plan.stages.confidence.min_matches();
    if k < cameras.saturating_sub(1) {
        Some(format!("{cameras} cameras must see a place (coverage.min_cameras), so take -k {} at least", cameras - 1))
    } else if k < matches {
        Some(format!("{} needs {matches} matches that agree, so take -k {matches} at least", plan.stages.backend))
    } else {
        None
    }
}

/// The limits of the cut, as they are set.
fn limits(plan: &Plan) -> String {
    let cut = &plan.stages.settings.cut;
    let set = [
        cut.budget.map(|budget| format!("budget {budget}")),
        cut.time.map(|time| format!("time {time}")),
        cut.points.map(|points| format!("points {points}")),
    ];
    set.into_iter().flatten().collect::<Vec<_>>().join(", ")
}

impl Hint for Nothing {
    fn hint(&self) -> Option<String> {
        Some(match self {
            Self::Fulfilled { cure: Some(cure), .. } => cure.clone(),
            Self::Fulfilled { .. } => {
                "viewrank doctor says what is wrong with the project; masks and --confidence count too".into()
            }
            Self::Allowed { .. } => "allow more".into(),
        })
    }
}
