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
    decision::Tables,
    io::project::Project,
    method::{fulfilment, ranking::Ranking},
    model::{cluster::ViewCluster, scene::ViewIndex},
    show::manifest::{RecordedPlan, WrittenPlanError, warnings_with},
};

/// Repeats the plan of the project's `viewrank/manifest.json`, by prediction alone (finished depth
/// maps are ignored).
pub fn repeat(root: &Path, watcher: &dyn Watcher) -> Result<(Project, Plan), RepeatError> {
    let (project, plan, _) = predicted(root, watcher)?;
    Ok((project, plan))
}

/// Repeats the plan with the ranking, the cut and the warnings of `viewrank/manifest.json`. If that
/// plan was ranked around finished depth maps, gains, shares and reasons of views come from the
/// manifest, measured where finished; fulfilment by triangle is predicted. The third is the plan's
/// exports, as the manifest records them.
pub fn as_written(
    root: &Path,
    watcher: &dyn Watcher,
) -> Result<(Project, Plan, Vec<ExportRecord>), RepeatError> {
    let (project, plan, recorded) = predicted(root, watcher)?;
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
    let order: Vec<ViewIndex> = ranked.iter().map(|cluster| cluster.key).collect();
    let written = ranked.into_iter().map(|c| (c.key, c.partners));
    let partners: BTreeMap<_, _> = stages
        .clusters
        .iter()
        .map(|c| (c.key, c.partners.clone()))
        .chain(written)
        .collect();
    let clusters: Vec<_> = partners
        .into_iter()
        .map(|(key, partners)| ViewCluster { key, partners })
        .collect();
    let fulfilment = fulfilment::table(&stages.model(), &clusters, watcher)?;
    let half = match &stages.half {
        Some(_) => {
            let worth = stages.settings.ranking.half_worth;
            Some(fulfilment::half_size(
                &stages.model(),
                &clusters,
                &fulfilment,
                worth,
                watcher,
            )?)
        }
        None => None,
    };
    let work = stages.work_of(&clusters);
    let pilot = stages
        .pilot
        .as_ref()
        .map(|pilot| pilot.of_clusters(&clusters, (&fulfilment, half.as_ref()), &|_| None));
    let stages = Stages {
        tables: Tables {
            pilot,
            clusters,
            fulfilment,
            half,
            work,
            ..stages.tables
        },
        known_ranking: None,
        ..stages
    };
    let place = |key: &ViewIndex| {
        stages
            .clusters
            .binary_search_by_key(key, |cluster| cluster.key)
            .ok()
    };
    let ranking = Ranking {
        order: order.iter().filter_map(place).map(|c| c as u32).collect(),
        scales: recorded
            .clusters
            .iter()
            .map(|cluster| cluster.scale)
            .collect(),
        gains: recorded
            .clusters
            .iter()
            .map(|cluster| cluster.gain)
            .collect(),
        fulfilment: recorded
            .clusters
            .iter()
            .map(|cluster| cluster.fulfilment)
            .collect(),
        kept: recorded
            .clusters
            .iter()
            .map(|cluster| cluster.share * recorded.cut.reachable)
            .collect(),
        reachable: recorded.cut.reachable,
    };
    let finished = FinishedMaps {
        outdated: recorded.outdated.clone(),
        ..FinishedMaps::default()
    };
    let cut = Cut {
        clusters: recorded.cut.clusters.min(ranking.order.len()),
        ..recorded.cut
    };
    let mut decision = decide_as(
        &stages,
        recorded.finished(),
        UncutRanking::new(&stages, ranking),
        cut,
    )?;
    for written in &recorded.views {
        if let Some(view) = stages.scene.find(&written.name) {
            decision.views[view.index()] = (written.status, written.reason);
        }
    }
    Ok(Plan::of(stages, decision, finished, timings))
}

fn predicted(
    root: &Path,
    watcher: &dyn Watcher,
) -> Result<(Project, Plan, RecordedPlan), RepeatError> {
    let (project, recorded) = RecordedPlan::open(root)?;
    let mut settings = recorded.settings.clone();
    if settings.backends.is_empty() {
        settings.backends.push(recorded.backend.clone());
    }
    if recorded.own_size {
        settings.image_scale = None;
    }
    // Checked before the long computation, even though this reads the model twice.
    recorded.check_input(
        &project,
        &project.read_scene().map_err(WrittenPlanError::from)?,
    )?;
    let plan = planning::plan(&project, &settings, watcher)?;
    project
        .refuse_changed_model()
        .map_err(WrittenPlanError::from)?;
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
