//! Follows the backend: counts the depth maps that appear, measures what they really reach, and says when it is enough.

use std::{
    fs,
    path::{Path, PathBuf},
    time::{SystemTime, UNIX_EPOCH},
};

use serde::Serialize;
use walkdir::WalkDir;

use super::{discover::OUTPUT_FOLDER, state::Outcome};
use crate::{
    depthmaps,
    error::Hint,
    evaluate::{Run, Task, curve::Curve},
    output::{self, Disk},
    partners::ViewCluster,
    plan::{self, Plan},
    progress::Watcher,
    ranking,
};

/// What is said of the progress, for queues: `integrations/sgm` ends when `target_reached` is true.
const PROGRESS: &str = "progress.json";

/// How the depth maps of a project look from outside.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MapsStamp {
    files: u64,
    bytes: u64,
    newest_ns: u128,
}

impl MapsStamp {
    /// Counts what looks like a depth map.
    pub fn of(project: &Path) -> Self {
        let mut stamp = Self::default();
        for folder in depthmaps::folders(project) {
            let entries = WalkDir::new(folder).into_iter().filter_map(Result::ok);
            for entry in entries.filter(|e| depthmaps::looks_like_one(e.path())) {
                let Ok(metadata) = entry.metadata() else { continue };
                let age = metadata.modified().ok().and_then(|at| at.duration_since(UNIX_EPOCH).ok());
                stamp.files += 1;
                stamp.bytes += metadata.len();
                stamp.newest_ns = stamp.newest_ns.max(age.map_or(0, |age| age.as_nanos()));
            }
        }
        stamp
    }

    pub fn is_empty(&self) -> bool {
        self.files == 0
    }
}

/// `viewrank/progress.json`.
#[derive(Clone, Debug, PartialEq, Serialize)]
struct Progress {
    version: u32,
    /// Key views of the plan, up to its cut, that have a depth map.
    done: usize,
    /// Key views up to the cut.
    clusters: usize,
    /// Real fulfilment over what all clusters together reach by prediction.
    share: f64,
    /// The share that is wanted.
    target: f64,
    target_reached: bool,
    /// Seconds a matching pair took, by the times of the maps; null before the second map.
    seconds_per_pair: Option<f64>,
    /// Forecast seconds to the end of the list.
    seconds_left: Option<f64>,
}

/// Where the progress of a project is said.
pub fn progress_file(root: &Path) -> PathBuf {
    root.join(OUTPUT_FOLDER).join(PROGRESS)
}

/// Was the target reached when the depth maps were last measured?
pub fn target_reached(root: &Path) -> bool {
    let text = fs::read(progress_file(root)).unwrap_or_default();
    serde_json::from_slice::<serde_json::Value>(&text).is_ok_and(|progress| progress["target_reached"] == true)
}

/// Measures the finished depth maps of a planned project and writes its `progress.json`.
pub fn follow(root: &Path, watcher: &dyn Watcher) -> Outcome {
    match measure(root, watcher) {
        Ok(Some(progress)) => write(root, &progress),
        Ok(None) | Err(None) => Outcome::Abandoned,
        Err(Some(failed)) => failed,
    }
}

fn write(root: &Path, progress: &Progress) -> Outcome {
    let text = serde_json::to_string_pretty(progress).unwrap_or_default() + "\n";
    match output::replace(&progress_file(root), text.as_bytes(), &Disk::REAL) {
        Ok(()) => {
            let Progress { done, clusters, share, target_reached, .. } = *progress;
            Outcome::Followed { done, clusters, share, reached: target_reached }
        }
        Err(error) => failure(error),
    }
}

fn failure(error: impl Hint) -> Outcome {
    Outcome::Failed { reason: error.to_string(), hint: error.hint() }
}

/// `None` where no map belongs to a key view of the plan.
fn measure(root: &Path, watcher: &dyn Watcher) -> Result<Option<Progress>, Option<Outcome>> {
    let (_, plan) = plan::again(root, watcher).map_err(|error| Some(failure(error)))?;
    let chosen: Vec<ViewCluster> = plan.chosen().cloned().collect();
    let model = plan.model();
    let accuracy = model.target.accuracy_over_gsd * plan.settings.target.gsd.unwrap_or(1.0);
    for folder in depthmaps::folders(root) {
        if watcher.cancelled() {
            return Err(None);
        }
        let task = Task { model, clusters: &chosen, depth_maps: &folder, reference: None, accuracy };
        // A folder without maps of this plan, or with one that is being written: the next one, or the next time.
        let Ok(run) = Run::new(&task, watcher) else { continue };
        if !run.clusters.is_empty() {
            return Ok(Some(progress(&plan, &chosen, &run, &folder)));
        }
    }
    Ok(None)
}

fn progress(plan: &Plan, chosen: &[ViewCluster], run: &Run, folder: &Path) -> Progress {
    let weights = ranking::weights(&plan.surface, plan.settings.ranking.weight);
    let support = plan.settings.ranking.support.unwrap_or(1);
    let real = Curve::new(&run.real, &weights, support, &run.clusters, &run.order).total();
    let share = if plan.ranking.total() > 0.0 { real / plan.ranking.total() } else { 0.0 };
    let target = plan.settings.cut.target.map_or(plan.cut.share, |share| share.0);
    let pairs = |clusters: &[ViewCluster]| clusters.iter().map(|c| c.partners.len()).sum::<usize>();
    let seconds_per_pair = seconds_per_pair(plan, run, folder);
    let left = pairs(chosen).saturating_sub(pairs(&run.clusters));
    Progress {
        version: 1,
        done: run.clusters.len(),
        clusters: chosen.len(),
        share,
        target,
        target_reached: share >= target,
        seconds_per_pair,
        seconds_left: seconds_per_pair.map(|seconds| seconds * left as f64),
    }
}

/// The time between the first and the last map, over the pairs of all but the first.
fn seconds_per_pair(plan: &Plan, run: &Run, folder: &Path) -> Option<f64> {
    let maps = depthmaps::find(folder, &plan.scene).ok()?.maps;
    let time = |path: &Path| fs::metadata(path).and_then(|m| m.modified()).ok();
    let mut times: Vec<(SystemTime, usize)> = Vec::new();
    for cluster in &run.clusters {
        let map = maps.iter().find(|map| map.view == cluster.key)?;
        times.push((time(&map.path)?, cluster.partners.len()));
    }
    times.sort_unstable();
    let (first, rest) = times.split_first()?;
    let pairs: usize = rest.iter().map(|(_, pairs)| pairs).sum();
    let span = rest.last()?.0.duration_since(first.0).ok()?;
    (pairs > 0).then(|| span.as_secs_f64() / pairs as f64)
}
