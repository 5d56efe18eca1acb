//! Measured fulfilment of finished depth maps, to compare with the prediction.

use std::path::{Path, PathBuf};

use serde::Serialize;

use super::{ReportError, bytes, history::in_255ths, shown::DrawnSurface};
use crate::{
    apps::evaluate::{
        EvaluateError, EvaluationInput, MeasuredClusters, MeasuredProgress, MeasuredSurface,
        curve::ReachCurve, orders, other_sizes_in_words,
    },
    base::{advice::on_command_line, error::Advice, progress::Watcher},
    io::{
        depthmaps::{self, DepthMapError},
        project::Project,
    },
    method::fulfilment::FulfilmentTable,
    model::cluster::ViewCluster,
    plan::Plan,
};

/// Folders of finished depth maps and of their reference.
#[derive(Clone, Debug, Default)]
pub struct DepthMapFolders {
    /// Unset: the folders that the backends write to.
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
    /// Measured weight kept by fusion up to that cluster, over what it is expected to keep of all
    /// clusters (method 8).
    share: Vec<f64>,
    /// Measured fulfilment of each drawn triangle, in 255ths.
    triangles: String,
}

impl Real {
    /// Measures the depth maps of this plan, `None` if there are none; also warnings about what is
    /// left out or not as planned.
    pub fn new(
        plan: &Plan,
        project: &Project,
        drawn: &DrawnSurface,
        asked: &DepthMapFolders,
        watcher: &dyn Watcher,
    ) -> Result<(Option<Self>, Vec<String>), ReportError> {
        if let Some(reference) = &asked.reference {
            depthmaps::find(reference, &plan.stages.scene).map_err(EvaluateError::from)?;
        }
        let clusters: Vec<_> = orders::of_plan(plan).cloned().collect();
        let of_project = asked.depth_maps.is_none();
        // Where none is named, the maps that the status counts.
        let own = || own_folder_of_maps(plan, project).filter(|folder| folder.is_dir());
        let mut left_out = Vec::new();
        if let Some(folder) = &asked.depth_maps.clone().or_else(own) {
            let task = EvaluationInput {
                of_plan: of_project.then_some(plan.decision.finished),
                ..task(plan, &clusters, folder, asked)
            };
            match MeasuredClusters::new(&task, watcher) {
                Ok(run) => {
                    left_out.extend(other_sizes_in_words(&plan.stages, &run.other_sizes));
                    left_out.extend(
                        run.unreadable
                            .iter()
                            .map(|why| format!("left out of the measured fulfilment: {why}")),
                    );
                    left_out.extend(run.other_partners.first().map(|&first| {
                        let (count, name) = (run.other_partners.len(), plan.stages.scene.name(first));
                        format!("{count} depth maps were made with other partners than planned; the first is {name}")
                    }));
                    left_out.extend(of_project.then(|| others_of(plan, project)).flatten());
                    return Ok((
                        Some(Self::of(plan, drawn, &run, &clusters, folder)),
                        left_out,
                    ));
                }
                Err(EvaluateError::Cancelled(cancelled)) => return Err(cancelled.into()),
                Err(error) if !of_project => return Err(error.into()),
                // A folder found by viewrank may hold the maps of another plan.
                Err(
                    EvaluateError::NoClusters(_) | EvaluateError::DepthMap(DepthMapError::None(_)),
                ) => {}
                Err(error) => left_out.push(format!(
                    "cannot show the depth maps in {}: {error}",
                    folder.display()
                )),
            }
        }
        match &asked.reference {
            Some(reference) => Err(ReportError::NothingToCompare(reference.clone())),
            None => {
                left_out.extend(others_of(plan, project));
                Ok((None, left_out))
            }
        }
    }

    fn of(
        plan: &Plan,
        drawn: &DrawnSurface,
        run: &MeasuredClusters,
        clusters: &[ViewCluster],
        folder: &Path,
    ) -> Self {
        let model = plan.stages.model();
        let curve = counted(plan, run);
        let so_far = MeasuredProgress::new(&plan.stages, run);
        let rank = |&c: &u32| {
            1 + clusters
                .iter()
                .take_while(|of| of.key != run.clusters[c as usize].key)
                .count()
        };
        let reached = MeasuredSurface::new(&model, run);
        let shades: Vec<u8> = drawn
            .original
            .iter()
            .map(|&t| in_255ths(reached.fulfilment[t as usize]))
            .collect();
        Self {
            folder: folder.display().to_string(),
            reference: run.has_reference,
            maps: run.clusters.len(),
            ranks: run.order.iter().map(rank).collect(),
            share: (1..curve.kept.len())
                .map(|i| curve.share(i, so_far.reachable))
                .collect(),
            triangles: bytes(&shades),
        }
    }
}

/// Returns the measured curve of what the plan's shares count.
fn counted(plan: &Plan, run: &MeasuredClusters) -> ReachCurve {
    let Some(pilot) = &plan.stages.pilot else {
        return run.real_curve(&plan.stages.objective, &run.order);
    };
    let row = |c: usize| pilot.kept_row(&run.places[c], run.scales[c], run.real.row(c));
    let measured = FulfilmentTable::new((0..run.clusters.len()).map(row));
    ReachCurve::new(&measured, &pilot.measured(), &run.clusters, &run.order)
}

/// Folder in which the plan's program writes its depth maps; `None` where links lead out of the
/// project.
pub fn own_folder_of_maps(plan: &Plan, project: &Project) -> Option<PathBuf> {
    project.folder_of_maps(plan.stages.backend)
}

/// Warns of depth maps of the plan's views that another program has made.
fn others_of(plan: &Plan, project: &Project) -> Option<String> {
    let own = own_folder_of_maps(plan, project);
    let folders = depthmaps::folders(&project.home);
    let mut others = folders
        .iter()
        .filter(|folder| Some(*folder) != own.as_ref());
    let other = others.find(|folder| depthmaps::find(folder, &plan.stages.scene).is_ok())?;
    let what = format!(
        "the depth maps in {} are of another program than the plan, and do not count; ",
        other.display()
    );
    let shown = Advice::text(what).set("depth-maps").and(" shows them");
    Some(on_command_line(&shown))
}

fn task<'a>(
    plan: &'a Plan,
    clusters: &'a [ViewCluster],
    depth_maps: &'a Path,
    asked: &'a DepthMapFolders,
) -> EvaluationInput<'a> {
    EvaluationInput::new(
        &plan.stages,
        clusters,
        depth_maps,
        asked.reference.as_deref(),
    )
}
