//! Recomputes an existing plan with all its tables: same input and settings, same plan.

use std::{collections::BTreeMap, path::Path};

use crate::plan::{Cut, FinishedMaps, Plan, PlanError, Stages, UncutRanking, decide_as};
use crate::{apps::planning, backends::ExportRecord};
use crate::{
    base::{
        column::TableError,
        error::{Advice, Hint},
        progress::Watcher,
    },
    io::project::Project,
    method::{fulfilment, ranking::Ranking},
    model::cluster::{RankedCluster, ViewCluster},
    show::manifest::{RecordedPlan, WrittenPlanError, warnings_with},
};

/// Repeats the plan of the folder's own `viewrank/manifest.json`, by prediction alone (finished
/// depth maps are ignored).
pub fn repeat(root: &Path, watcher: &dyn Watcher) -> Result<(Project, Plan), RepeatError> {
    let (project, plan, _) = predicted(RecordedPlan::open_here(root)?, watcher)?;
    Ok((project, plan))
}

/// Repeats the plan with the ranking, the cut and the warnings of `viewrank/manifest.json`. If that
/// plan was ranked around finished depth maps, gains, shares and reasons of views come from the
/// manifest, measured where finished; fulfilment by triangle is predicted. The third is the plan's
/// exports, as the manifest records them, without commands and clusters.
pub fn as_written(
    root: &Path,
    watcher: &dyn Watcher,
) -> Result<(Project, Plan, Vec<ExportRecord>), RepeatError> {
    let (project, plan, recorded) = predicted(RecordedPlan::open(root)?, watcher)?;
    let plan = if recorded.finished() > 0 {
        with_ranking(plan, &recorded, watcher)?
    } else {
        plan
    };
    let warnings = warnings_with(&recorded.warnings, &recorded.exports, &[]);
    Ok((project, Plan { warnings, ..plan }, recorded.exports))
}

fn with_ranking(
    mut plan: Plan,
    recorded: &RecordedPlan,
    watcher: &dyn Watcher,
) -> Result<Plan, RepeatError> {
    plan.keep_predictions();
    let Plan {
        stages, timings, ..
    } = plan;
    let ranked = recorded.ranked(&stages.scene)?;
    let stages = with_ranked_clusters(stages, &ranked, watcher)?;
    let ranking = recorded_ranking(recorded, &ranked, &stages.clusters);
    let cut = Cut {
        clusters: recorded.cut.clusters.min(ranking.order.len()),
        ..recorded.cut
    };
    let ranking = UncutRanking::new(&stages, ranking, stages.makes_maps);
    let mut decision = decide_as(&stages, recorded.finished(), ranking, cut)?;
    for written in &recorded.views {
        if let Some(view) = stages.scene.find(&written.name) {
            decision.views[view.index()] = (written.status, written.reason);
        }
    }
    let finished = FinishedMaps {
        outdated: recorded.outdated.clone(),
        ..FinishedMaps::default()
    };
    Ok(Plan::of(stages, decision, finished, timings))
}

/// Returns the stages with the ranked clusters, and their own of the other key views.
fn with_ranked_clusters(
    stages: Stages,
    ranked: &[RankedCluster],
    watcher: &dyn Watcher,
) -> Result<Stages, RepeatError> {
    let own = stages.clusters.iter().map(|c| (c.key, &c.partners));
    let written = ranked.iter().map(|c| (c.key, &c.partners));
    // By key view: clusters are looked up by binary search.
    let partners: BTreeMap<_, _> = own.chain(written).collect();
    let clusters: Vec<_> = partners
        .into_iter()
        .map(|(key, partners)| ViewCluster {
            key,
            partners: partners.clone(),
        })
        .collect();
    let (model, worth) = (stages.model(), stages.settings.ranking.half_worth);
    let full = fulfilment::table(&model, &clusters, watcher)?;
    let half = match &stages.half {
        Some(_) => Some(fulfilment::half_size(
            &model, &clusters, &full, worth, watcher,
        )?),
        None => None,
    };
    Ok(stages.with_clusters(clusters, full, half, &|_| None))
}

/// Returns the ranking as recorded, of these clusters.
fn recorded_ranking(
    recorded: &RecordedPlan,
    ranked: &[RankedCluster],
    clusters: &[ViewCluster],
) -> Ranking {
    let place = |ranked: &RankedCluster| {
        let place = clusters.binary_search_by_key(&ranked.key, |cluster| cluster.key);
        place.ok().map(|c| c as u32)
    };
    let (written, reachable) = (&recorded.clusters, recorded.cut.reachable);
    Ranking {
        order: ranked.iter().filter_map(place).collect(),
        scales: written.iter().map(|c| c.scale).collect(),
        gains: written.iter().map(|c| c.gain).collect(),
        fulfilment: written.iter().map(|c| c.fulfilment).collect(),
        kept: written.iter().map(|c| c.share * reachable).collect(),
        reachable,
    }
}

fn predicted(
    (project, recorded): (Project, RecordedPlan),
    watcher: &dyn Watcher,
) -> Result<(Project, Plan, RecordedPlan), RepeatError> {
    let mut settings = recorded.settings.clone();
    if settings.backends.is_empty() {
        // The default depends on what is installed, which may have changed since.
        settings.backends.push(recorded.backend.clone());
    }
    if recorded.own_size {
        // The plan records the size in force; unset, it is the backend's own again.
        settings.image_scale = None;
    }
    // Checked before the long computation, even though this reads the model twice.
    recorded.check_input(
        &project,
        &project.read_scene().map_err(WrittenPlanError::from)?,
    )?;
    let plan = planning::plan(&project, &settings, watcher)?;
    // The model may have been replaced while it was planned.
    project
        .refuse_changed_model()
        .map_err(WrittenPlanError::from)?;
    // Another version may rank otherwise, and must not be shown as the plan in the folder.
    recorded.check_ranking(&plan)?;
    Ok((project, plan, recorded))
}

/// An error of repeating a plan.
#[derive(Debug, thiserror::Error)]
pub enum RepeatError {
    #[error(transparent)]
    Written(#[from] WrittenPlanError),
    #[error(transparent)]
    Plan(#[from] PlanError),
    #[error(transparent)]
    Table(#[from] TableError),
}

impl Hint for RepeatError {
    fn hint(&self) -> Option<Advice> {
        match self {
            Self::Written(error) => error.hint(),
            Self::Plan(error) => error.hint(),
            Self::Table(error) => error.hint(),
        }
    }

    fn path(&self) -> Option<&Path> {
        match self {
            Self::Written(error) => error.path(),
            Self::Plan(error) => error.path(),
            Self::Table(error) => error.path(),
        }
    }
}
