//! What finished depth maps really reach, beside what was predicted.

use std::path::{Path, PathBuf};

use serde::Serialize;

use super::{bytes, history::in_255ths, shown::Shown};
use crate::{
    depthmaps,
    evaluate::{EvaluateError, Reached, Run, Task, curve::Curve, orders},
    partners::ViewCluster,
    plan::Plan,
    progress::Watcher,
    project::Project,
    ranking,
};

/// Where finished depth maps are, and what is right.
#[derive(Clone, Debug, Default)]
pub struct Finished {
    /// Unset: where the backends write theirs.
    pub depth_maps: Option<PathBuf>,
    /// Exact or better depth maps; without them every depth on the surface counts as right.
    pub reference: Option<PathBuf>,
}

/// The measured depth maps on the page.
#[derive(Serialize)]
pub struct Real {
    folder: String,
    reference: bool,
    maps: usize,
    /// Rank (from 1) of each finished cluster.
    ranks: Vec<usize>,
    /// Real fulfilment up to that cluster, over what all clusters together were predicted to reach.
    share: Vec<f64>,
    /// Real fulfilment of each shown triangle, in 255ths.
    triangles: String,
}

impl Real {
    /// `None` where there are no depth maps of this plan.
    pub fn new(
        plan: &Plan,
        project: &Project,
        shown: &Shown,
        finished: &Finished,
        watcher: &dyn Watcher,
    ) -> Result<Option<Self>, EvaluateError> {
        let clusters = in_order(plan);
        let measure = |folder: &Path| Run::new(&task(plan, &clusters, folder, finished), watcher);
        if let Some(folder) = &finished.depth_maps {
            return measure(folder).map(|run| Some(Self::of(plan, shown, &run, &clusters, folder)));
        }
        for folder in depthmaps::folders(&project.root) {
            match measure(&folder) {
                Ok(run) => return Ok(Some(Self::of(plan, shown, &run, &clusters, &folder))),
                Err(EvaluateError::Cancelled(cancelled)) => return Err(cancelled.into()),
                // Nobody asked for this folder: it may hold the maps of another plan, or be half written.
                Err(_) => {}
            }
        }
        Ok(None)
    }

    fn of(plan: &Plan, shown: &Shown, run: &Run, clusters: &[ViewCluster], folder: &Path) -> Self {
        let model = plan.model();
        let weights = ranking::weights(&plan.surface, plan.settings.ranking.weight);
        let support = plan.settings.ranking.support.unwrap_or(1);
        let curve = Curve::new(&run.real, &weights, support, &run.clusters, &run.order);
        let rank = |&c: &u32| 1 + clusters.iter().take_while(|of| of.key != run.clusters[c as usize].key).count();
        let reached = Reached::new(&model, run);
        let shades: Vec<u8> = shown.original.iter().map(|&t| in_255ths(reached.fulfilment[t as usize])).collect();
        Self {
            folder: folder.display().to_string(),
            reference: run.has_reference,
            maps: run.clusters.len(),
            ranks: run.order.iter().map(rank).collect(),
            share: (1..curve.fulfilment.len()).map(|i| curve.share(i, plan.ranking.total())).collect(),
            triangles: bytes(&shades),
        }
    }
}

/// All clusters, those without predicted gain last.
fn in_order(plan: &Plan) -> Vec<ViewCluster> {
    let order = orders::completed(plan.ranking.order.clone(), plan.clusters.len());
    order.iter().map(|&c| plan.clusters[c as usize].clone()).collect()
}

fn task<'a>(plan: &'a Plan, clusters: &'a [ViewCluster], depth_maps: &'a Path, finished: &'a Finished) -> Task<'a> {
    let model = plan.model();
    let accuracy = model.target.accuracy_over_gsd * plan.settings.target.gsd.unwrap_or(1.0);
    Task { model, clusters, depth_maps, reference: finished.reference.as_deref(), accuracy }
}
