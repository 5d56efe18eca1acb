//! An existing plan once more, with all its tables: same input and settings, same plan.

use std::{collections::BTreeMap, path::Path};

use super::{Cut, Finished, Plan, PlanError, plan};
use crate::{
    column::TableError,
    error::Hint,
    fulfilment,
    manifest::{Recorded, WrittenPlanError, warnings_with},
    partners::ViewCluster,
    progress::Watcher,
    project::Project,
    ranking::Ranking,
    scene::ViewIndex,
};

/// Plans again what `viewrank/manifest.json` of the project says, by the prediction alone (finished depth maps are not looked at).
pub fn again(root: &Path, watcher: &dyn Watcher) -> Result<(Project, Plan), AgainError> {
    let (project, plan, _) = predicted(root, watcher)?;
    Ok((project, plan))
}

/// The plan of `viewrank/manifest.json` with the ranking, the cut and the warnings that stand there. Of a plan around finished depth maps gains, shares
/// and reasons of views are those of the manifest, which are real where finished; fulfilment by triangle is predicted.
pub fn as_written(root: &Path, watcher: &dyn Watcher) -> Result<(Project, Plan), AgainError> {
    let (project, mut plan, recorded) = predicted(root, watcher)?;
    if recorded.finished() > 0 {
        take_ranking(&mut plan, &recorded, watcher)?;
    }
    plan.warnings = warnings_with(&recorded.warnings, &recorded.exports, &[]);
    Ok((project, plan))
}

fn take_ranking(plan: &mut Plan, recorded: &Recorded, watcher: &dyn Watcher) -> Result<(), AgainError> {
    let ranked = recorded.ranked(&plan.scene)?;
    let order: Vec<ViewIndex> = ranked.iter().map(|cluster| cluster.key).collect();
    let written = ranked.into_iter().map(|c| (c.key, c.partners));
    let partners: BTreeMap<_, _> = plan.clusters.drain(..).map(|c| (c.key, c.partners)).chain(written).collect();
    plan.clusters = partners.into_iter().map(|(key, partners)| ViewCluster { key, partners }).collect();
    plan.fulfilment = fulfilment::table(&plan.model(), &plan.clusters, watcher)?;
    let place = |key: &ViewIndex| plan.clusters.binary_search_by_key(key, |cluster| cluster.key).ok();
    plan.ranking = Ranking {
        order: order.iter().filter_map(place).map(|c| c as u32).collect(),
        gains: recorded.clusters.iter().map(|cluster| cluster.gain).collect(),
        fulfilment: recorded.clusters.iter().map(|cluster| cluster.fulfilment).collect(),
    };
    plan.finished =
        Finished { clusters: recorded.finished(), outdated: recorded.outdated.clone(), ..Finished::default() };
    plan.cut_at(Cut { clusters: recorded.cut.clusters.min(plan.ranking.order.len()), ..recorded.cut })?;
    for written in &recorded.views {
        if let Some(view) = plan.scene.find(&written.name) {
            plan.views[view.at()] = (written.status, written.reason);
        }
    }
    Ok(())
}

fn predicted(root: &Path, watcher: &dyn Watcher) -> Result<(Project, Plan, Recorded), AgainError> {
    let (project, recorded) = Recorded::open(root)?;
    let mut settings = recorded.settings.clone();
    if settings.backends.is_empty() {
        settings.backends.push(recorded.backend.clone());
    }
    // Before the long work, though the model is read twice for it.
    recorded.check_input(&project, &project.read_scene().map_err(WrittenPlanError::from)?)?;
    let plan = plan(&project, &settings, watcher)?;
    recorded.check_ranking(&plan)?;
    Ok((project, plan, recorded))
}

/// Why there is no plan to go on with.
#[derive(Debug, thiserror::Error)]
pub enum AgainError {
    #[error(transparent)]
    Written(#[from] WrittenPlanError),
    #[error(transparent)]
    Plan(#[from] PlanError),
    #[error(transparent)]
    Table(#[from] TableError),
}

impl Hint for AgainError {
    fn hint(&self) -> Option<String> {
        match self {
            Self::Written(error) => error.hint(),
            Self::Plan(error) => error.hint(),
            Self::Table(error) => error.hint(),
        }
    }
}
