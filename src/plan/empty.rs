//! Rejects a plan that chooses no cluster, with the reason and a remedy.

use std::{cmp::Reverse, collections::BTreeMap};

use super::Plan;
use crate::{
    base::error::{Advice, Hint},
    model::reason::Reason,
};

/// The plan chooses no cluster.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum EmptyPlan {
    /// No view cluster fulfils anything; `reason` holds for `of` of `views` views, more than any
    /// other.
    #[error("no view cluster fulfils anything; most common reason ({of} of {views} views): {}", reason.describe())]
    Fulfilled {
        reason: Reason,
        of: usize,
        views: usize,
        cure: Option<Advice>,
    },
    /// The model has fewer images than must show each place.
    #[error("the model has {views} images, and each place must be seen by {cameras}")]
    FewImages { views: usize, cameras: u32 },
    /// The limits of the cut exclude every ranked cluster.
    #[error("the limits exclude all {ranked} view clusters: {limits}")]
    Allowed { ranked: usize, limits: String },
}

impl EmptyPlan {
    /// Checks whether the plan chooses nothing; `None` if it chooses at least one cluster.
    pub fn detect(plan: &Plan) -> Option<Self> {
        let ranked = plan.decision.ranking.order.len();
        match plan.decision.cut.clusters {
            0 if ranked == 0 => Some(Self::nothing_fulfilled(plan)),
            0 => Some(Self::Allowed {
                ranked,
                limits: limits(plan),
            }),
            _ => None,
        }
    }

    fn nothing_fulfilled(plan: &Plan) -> Self {
        let views = plan.decision.views.len();
        let cameras = plan.stages.settings.coverage.min_cameras;
        // Before the reasons of views, none of which says that there are too few.
        if views < cameras as usize {
            return Self::FewImages { views, cameras };
        }
        let mut counts = BTreeMap::new();
        plan.decision
            .views
            .iter()
            .filter_map(|(_, reason)| *reason)
            .for_each(|r| *counts.entry(r).or_insert(0usize) += 1);
        let most = counts
            .into_iter()
            .max_by_key(|&(reason, count)| (count, Reverse(reason)));
        let (reason, of) = most.unwrap_or((Reason::Hidden, 0));
        let cure = match reason {
            Reason::NoImage => Some(no_images(plan)),
            _ => too_few_partners(plan),
        };
        Self::Fulfilled {
            reason,
            of,
            views,
            cure,
        }
    }
}

/// Returns a remedy for missing, unreadable or rejected images.
fn no_images(plan: &Plan) -> Advice {
    if plan.stages.agreement.rejected.is_empty() {
        Advice::text("copy these images again (")
            .run("doctor")
            .and(")")
    } else {
        Advice::text("replace the images that the warnings name, or plan without pictures: ")
            .set_to("confidence.source", "geometric")
    }
}

/// Returns a remedy if k is too small for `coverage.min_cameras` or for the backend's matches.
fn too_few_partners(plan: &Plan) -> Option<Advice> {
    let k = plan.stages.settings.partners.k;
    let cameras = plan.stages.settings.coverage.min_cameras;
    let matches = plan.stages.rule.confidence.min_matches();
    if k < cameras.saturating_sub(1) {
        let wanted =
            format!(" or more: coverage.min_cameras wants each place seen by {cameras} cameras");
        Some(
            Advice::text("use ")
                .set_to("partners.k", (cameras - 1).to_string())
                .and(wanted),
        )
    } else if k < matches {
        let backend = plan.stages.backend;
        let wanted = format!(" or more: {backend} needs {matches} matches that agree");
        Some(
            Advice::text("use ")
                .set_to("partners.k", matches.to_string())
                .and(wanted),
        )
    } else {
        None
    }
}

/// The limits of the cut that are set, as "budget 5, time 60".
fn limits(plan: &Plan) -> String {
    let cut = &plan.stages.settings.cut;
    let set = [
        cut.budget.map(|budget| format!("budget {budget}")),
        cut.time.map(|time| format!("time {time}")),
        cut.points.map(|points| format!("points {points}")),
    ];
    set.into_iter().flatten().collect::<Vec<_>>().join(", ")
}

impl Hint for EmptyPlan {
    fn hint(&self) -> Option<Advice> {
        Some(match self {
            Self::Fulfilled {
                cure: Some(cure), ..
            } => cure.clone(),
            Self::Fulfilled {
                reason: Reason::OutsideRegion,
                ..
            } => Advice::text("choose a region that the images show, such as ")
                .set_to("region", "auto"),
            Self::Fulfilled { .. } => Advice::text("run ")
                .run("doctor")
                .and("; check the masks and ")
                .set("confidence.source")
                .and(", too"),
            Self::FewImages { .. } => {
                "add photographs of the same places from other positions to the model".into()
            }
            Self::Allowed { .. } => "raise the limit".into(),
        })
    }
}
