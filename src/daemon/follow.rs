//! Follows the backend: measures the fulfilment of the finished depth maps, and detects when the
//! target is reached.

use std::{
    fs,
    path::{Path, PathBuf},
    time::SystemTime,
};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{
    maps::{MapFiles, map_files_inside},
    phase::Phase,
    state::Outcome,
};
use crate::apps::replan;
use crate::base::advice::on_command_line;
use crate::{
    apps::{
        evaluate::{MeasuredClusters, MeasuredProgress, curve::ReachCurve},
        replan::{EarlierPlan, MapFolder, ReplanError, replan},
    },
    base::{bounded, error::Hint, input::FileKind, progress::Watcher},
    io::{
        depthmaps::{self, DepthMapError, DepthMapFile},
        output::{self, Disk, OutputError},
        project::Project,
    },
    method::ranking,
    model::{cluster::MapScale, scene::ViewIndex},
    plan::{Decision, OutdatedMap, Plan},
    show::manifest,
};

const PROGRESS: &str = "progress.json";
/// Path of the progress file, relative to the project.
const PROGRESS_FILE: &str = "viewrank/progress.json";
/// A gap longer than this multiple of the median time between two maps is a pause, not time of
/// matching.
const PAUSE: f64 = 3.0;

/// `viewrank/progress.json`: progress of the backend, for queues and people. `viewrank watch`
/// writes it after each measurement.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Progress {
    /// Version of this format.
    pub version: u32,
    /// The share has reached the target. Queues may stop then; `integrations/sgm` does.
    pub target_reached: bool,
    /// Number of key views with a depth map that counts.
    pub done: usize,
    /// Number of key views up to the plan's cut, plus those beyond it that already have a depth
    /// map.
    pub clusters: usize,
    /// Estimated share of the result of all clusters: weight that fusion keeps of all finished
    /// depth maps, measured, over what it is expected to keep of all (`kept` over `reachable`), 0
    /// to 1; null where they are only counted (`note` says why).
    pub share: Option<f64>,
    /// True if only what is inside a region counts.
    pub has_region: bool,
    /// Target of `share`, 0 to 1.
    pub target: f64,
    /// Weight that fusion keeps of the finished depth maps, over that of the whole surface, 0 to 1
    /// (method 5.2); null where they are only counted. Every depth on the surface counts as right.
    pub kept: Option<f64>,
    /// The same expected of all view clusters: real where finished, else predicted, with failures
    /// remembered.
    pub reachable: f64,
    /// Number of further depth maps along the list until the target is expected to be reached; null
    /// where the list is too short.
    pub clusters_to_target: Option<usize>,
    /// Seconds per matching pair, from the modification times of the depth maps; null before the
    /// second map.
    pub seconds_per_pair: Option<f64>,
    /// Seconds until the target is expected to be reached; null where unknown.
    pub seconds_to_target: Option<f64>,
    /// Seconds to the end of the list; null where unknown.
    pub seconds_left: Option<f64>,
    /// Key views with a finished depth map that counts, in the order of the plan.
    #[serde(deserialize_with = "bounded::list::<_, _, 1_000_000>")]
    pub finished: Vec<String>,
    /// Finished depth maps that no longer fit the model; they don't count.
    #[serde(deserialize_with = "bounded::list::<_, _, 1_000_000>")]
    pub outdated: Vec<OutdatedMap>,
    /// Reason why something was not measured; null where everything was.
    pub note: Option<String>,
    /// The command for a reached target (`on_target`) has been started. Its exit status is in the
    /// log.
    pub announced: bool,
}

impl Progress {
    /// Clears `target_reached` before a new plan is written, so that no queue stops for the target
    /// of the old one.
    pub(super) fn clear_target_reached(root: &Path, disk: &Disk) -> Result<(), OutputError> {
        match Self::read(root).filter(|progress| progress.target_reached) {
            Some(progress) => Self {
                target_reached: false,
                ..progress
            }
            .write(root, disk),
            None => Ok(()),
        }
    }

    /// Reads the last progress of a project; `None` where there is none or it is unreadable.
    pub fn read(root: &Path) -> Option<Self> {
        serde_json::from_slice(&output::read_own(root, PROGRESS_FILE, FileKind::Record).ok()?).ok()
    }

    /// Returns whether no depth map was found that is one of the plan.
    pub(super) fn is_of_no_maps(&self) -> bool {
        self.finished.is_empty() && self.outdated.is_empty() && self.note.is_none()
    }

    /// Keeps `announced` from the last progress if the target is the same and still reached.
    pub(super) fn keep_announced(&mut self, root: &Path) {
        let same_target = |p: &Self| p.announced && p.target == self.target;
        self.announced = self.target_reached && Self::read(root).as_ref().is_some_and(same_target);
    }

    /// The phase of a project at this progress.
    pub fn phase(self) -> Phase {
        let Self {
            done,
            clusters,
            share,
            has_region,
            note,
            ..
        } = self;
        match share.filter(|_| self.target_reached) {
            Some(share) => Phase::Reached {
                // The state of the project knows the backend, and fills it in.
                backend: String::new(),
                done,
                clusters,
                share,
                has_region,
                note,
            },
            None => Phase::Partial {
                backend: String::new(),
                done,
                clusters,
                share,
                unmeasured: 0,
                has_region,
                note,
            },
        }
    }

    /// Converts to the outcome of a job, with a further note.
    pub(super) fn outcome(mut self, further: Option<String>) -> Outcome {
        let outdated = outdated_note(&self.outdated, PROGRESS);
        let notes = [further, self.note.take(), outdated].into_iter().flatten();
        let notes: Vec<String> = notes.collect();
        self.note = (!notes.is_empty()).then(|| notes.join("; "));
        Outcome::Followed(self.phase())
    }

    /// Writes the progress of a project.
    ///
    /// # Errors
    /// Those of [`output::replace`].
    pub fn write(&self, root: &Path, disk: &Disk) -> Result<(), OutputError> {
        let text = serde_json::to_string_pretty(self).unwrap_or_default() + "\n";
        output::replace(&progress_file(root), text.as_bytes(), disk)
    }

    /// Removes the progress of a project, if any.
    pub fn remove(root: &Path, disk: &Disk) -> Result<(), OutputError> {
        output::remove(&progress_file(root), disk)
    }
}

/// Returns a note about outdated depth maps, which `file` lists; `None` where there are none.
pub(super) fn outdated_note(outdated: &[OutdatedMap], file: &str) -> Option<String> {
    let n = outdated.len();
    (n > 0).then(|| format!("{n} finished depth maps no longer fit the model (outdated in {file})"))
}

/// Path of the progress file of a project.
pub fn progress_file(root: &Path) -> PathBuf {
    root.join(PROGRESS_FILE)
}

/// Returns the last measurement if the target was reached.
pub fn reached(root: &Path) -> Option<Progress> {
    let progress = Progress::read(root).filter(|progress| progress.target_reached)?;
    (!is_of_earlier_plan(root)).then_some(progress)
}

/// Returns whether the project was planned again after its depth maps were last measured.
pub fn is_of_earlier_plan(project: &Path) -> bool {
    let written =
        [progress_file(project), project.join(manifest::FILE)].map(|file| modified(&file));
    matches!(written, [Some(measured), Some(planned)] if measured < planned)
}

pub fn modified(file: &Path) -> Option<SystemTime> {
    file.metadata().ok()?.modified().ok()
}

/// Measures those of the present depth maps that are known to be made for the plan, and writes
/// `progress.json`; [`Outcome::Abandoned`] without any.
pub fn follow(
    root: &Path,
    known: &(dyn Fn(&Path) -> bool + Sync),
    watcher: &dyn Watcher,
) -> Outcome {
    follow_now(root, known, watcher).unwrap_or_else(|ended| ended)
}

fn follow_now(
    root: &Path,
    known: &(dyn Fn(&Path) -> bool + Sync),
    watcher: &dyn Watcher,
) -> Result<Outcome, Outcome> {
    let within = [root.to_path_buf()];
    let disk = Disk::REAL.within(&within);
    // A killed run may have stopped between two files of the plan that is read next.
    output::recover(root, &disk).map_err(failed)?;
    let files = map_files_inside(root).map_err(failed)?;
    if files.is_empty() {
        return Ok(Outcome::Abandoned);
    }
    let (project, plan) = replan::repeat(root, watcher).map_err(failed)?;
    let Some(folder) = own_folder(&project, plan.stages.backend, &files) else {
        return Ok(Outcome::Abandoned);
    };
    let earlier = EarlierPlan::read(&project).map_err(failed)?;
    let following = FollowJob {
        plan,
        earlier: &earlier,
        maps: MapFolder {
            folder: &folder,
            ready: &|map| files.contains_key(map),
            known,
        },
        replan: false,
    };
    let mut progress = following.measure(watcher).map_err(failed)?.1;
    if progress.finished.is_empty() {
        return Ok(Outcome::Abandoned);
    }
    progress.keep_announced(root);
    progress.write(root, &disk).map_err(failed)?;
    Ok(progress.outcome(None))
}

pub(super) fn failed(error: impl Hint) -> Outcome {
    Outcome::Failed {
        reason: error.to_string(),
        hint: error.hint().as_ref().map(on_command_line),
    }
}

/// Returns the folder of the program's depth maps, if it holds some of these. Maps of other
/// programs do not count for its plan.
pub(super) fn own_folder(project: &Project, backend: &str, files: &MapFiles) -> Option<PathBuf> {
    let folder = project.folder_of_maps(backend)?;
    files
        .keys()
        .any(|file| file.starts_with(&folder))
        .then_some(folder)
}

/// A plan and the present depth maps.
pub(super) struct FollowJob<'a> {
    /// The plan by prediction alone.
    pub plan: Plan,
    pub earlier: &'a EarlierPlan,
    pub maps: MapFolder<'a>,
    /// Rank the rest of the list again.
    pub replan: bool,
}

impl FollowJob<'_> {
    /// Returns the plan around the finished depth maps, and its progress.
    pub fn measure(self, watcher: &dyn Watcher) -> Result<(Plan, Progress), ReplanError> {
        if let Some(counted) = self.count_undistorted()? {
            return Ok((self.plan, counted));
        }
        let in_scene = |key| self.plan.stages.scene.find(key);
        let written = self
            .earlier
            .maps()
            .filter_map(|(key, scale)| Some((in_scene(key)?, scale)));
        let written: Vec<(ViewIndex, MapScale)> = written.collect();
        let list: Vec<ViewIndex> = self.earlier.list().filter_map(in_scene).collect();
        let wanted = self.plan.stages.settings.cut.target;
        let target = wanted.map_or(self.plan.decision.cut.share, |share| share.0);
        let (plan, measured) = replan(self.plan, self.earlier, &self.maps, watcher)?;
        let (order, cut) = if self.replan {
            let order = plan.decision.ranking.maps().collect();
            (order, plan.decision.cut.clusters)
        } else {
            // The backend works along the written list, however the rest would be ranked today.
            (listed(&plan, &written), with_finished(&plan, &list))
        };
        let measured = measured.as_ref();
        let so_far = measured.map(|measured| measured.progress);
        let forecast = TargetForecast::new(&plan, &order, cut, target, so_far.unwrap_or_default());
        let seconds_per_pair =
            measured.and_then(|of| seconds_per_pair(&plan, &of.run, self.maps.folder));
        let progress = forecast.progress(&plan, seconds_per_pair);
        Ok((plan, progress))
    }

    /// Counts the depth maps where they belong to undistorted images and the model's images are
    /// distorted: pixels of such a map don't correspond to pixels of the view. `None` where they
    /// can be measured.
    fn count_undistorted(&self) -> Result<Option<Progress>, DepthMapError> {
        let Plan {
            stages,
            decision: Decision { cut, ranking, .. },
            ..
        } = &self.plan;
        let (scene, settings) = (&stages.scene, &stages.settings);
        let maps = depthmaps::list_preferring(self.maps.folder, scene, self.maps.known)?.maps;
        let counts = |map: &&DepthMapFile| {
            let key = scene.name(map.view);
            self.maps.counts(key, &map.path, self.earlier)
        };
        let ready: Vec<_> = maps.iter().filter(counts).collect();
        let of_undistorted = ready.iter().filter(|map| !map.format.takes_distorted());
        let Some(distorted) = of_undistorted
            .map(|map| scene.camera_of(map.view))
            .find(|camera| !camera.is_pinhole())
        else {
            return Ok(None);
        };
        let has_map = |key: &&str| ready.iter().any(|map| scene.name(map.view) == *key);
        let listed: Vec<&str> = self.earlier.list().collect();
        let finished: Vec<String> = listed
            .iter()
            .copied()
            .filter(has_map)
            .map(Into::into)
            .collect();
        let model = distorted.model().name();
        Ok(Some(Progress {
            version: 1,
            done: finished.len(),
            clusters: listed.len(),
            has_region: settings.region.is_some(),
            target: settings.cut.target.map_or(cut.share, |share| share.0),
            reachable: ranking.reachable,
            finished,
            note: Some(format!(
                "counted, not measured: the maps belong to undistorted images, but the model has {model} cameras"
            )),
            ..Progress::default()
        }))
    }
}

/// Number of key views on the list, plus finished ones beyond it.
fn with_finished(plan: &Plan, list: &[ViewIndex]) -> usize {
    let finished = &plan.decision.ranking.order[..plan.decision.finished];
    let is_finished = |key: &&ViewIndex| {
        finished
            .iter()
            .any(|&c| plan.stages.clusters[c as usize].key == **key)
    };
    finished.len() + list.len() - list.iter().filter(is_finished).count()
}

/// Orders the clusters: finished ones, the rest of the written list, the rest of the ranking.
fn listed(plan: &Plan, written: &[(ViewIndex, MapScale)]) -> Vec<(u32, MapScale)> {
    let mut order: Vec<_> = plan
        .decision
        .ranking
        .maps()
        .take(plan.decision.finished)
        .collect();
    let place = |key: &ViewIndex| {
        plan.stages
            .clusters
            // Clusters ascend by key view.
            .binary_search_by_key(key, |cluster| cluster.key)
            .ok()
    };
    let list = written
        .iter()
        .filter_map(|(key, scale)| Some((place(key)? as u32, *scale)));
    let mut taken = vec![false; plan.stages.clusters.len()];
    order.iter().for_each(|&(c, _)| taken[c as usize] = true);
    order.extend(
        list.chain(plan.decision.ranking.maps())
            .filter(|&(c, _)| !std::mem::replace(&mut taken[c as usize], true)),
    );
    order
}

/// Forecast along a list whose first clusters are finished.
struct TargetForecast {
    /// Length of the list, clusters.
    cut: usize,
    target: f64,
    so_far: MeasuredProgress,
    /// Numbers of clusters and pairs to the target.
    to_target: Option<(usize, usize)>,
    pairs_left: usize,
}

impl TargetForecast {
    fn new(
        plan: &Plan,
        order: &[(u32, MapScale)],
        cut: usize,
        target: f64,
        so_far: MeasuredProgress,
    ) -> Self {
        let counted = plan.stages.counted();
        let ((objective, maps), clusters) = (counted.kept, &plan.stages.clusters);
        let rows = order
            .iter()
            .map(|&(c, scale)| (maps.row_at(c, scale), clusters[c as usize].partners.len()));
        let curve = ReachCurve::of_rows(objective, rows);
        let (done, total) = (plan.decision.finished, plan.decision.ranking.reachable);
        // The list gives the missing part in the proportions in which it is expected to.
        let share = so_far.share.unwrap_or(0.0);
        let expected = curve.share(done, total);
        let wanted = ranking::as_part_of_rest(target.max(share), share, expected);
        let reached = curve
            .clusters_for(wanted * total)
            // A target that only maps beyond the list would reach is out of reach.
            .filter(|&n| n <= cut.max(done));
        let pairs = |n: usize| curve.pairs[n].saturating_sub(curve.pairs[done]);
        Self {
            cut,
            target,
            so_far,
            to_target: reached.map(|n| (n.saturating_sub(done), pairs(n))),
            pairs_left: pairs(cut.min(order.len())),
        }
    }

    fn progress(&self, plan: &Plan, seconds_per_pair: Option<f64>) -> Progress {
        let Plan {
            stages,
            decision,
            finished: maps,
            ..
        } = plan;
        let finished = decision.ranking.order[..decision.finished].iter();
        let name = |&c: &u32| {
            stages
                .scene
                .name(stages.clusters[c as usize].key)
                .to_owned()
        };
        let finished: Vec<String> = finished.map(name).collect();
        // Where only other limits are set, all maps of the list are wanted.
        let is_reached = match stages.settings.cut.target {
            Some(_) => self.so_far.share.is_some_and(|share| share >= self.target),
            None => finished.len() >= self.cut,
        };
        let seconds = |pairs: usize| seconds_per_pair.map(|seconds| seconds * pairs as f64);
        Progress {
            version: 1,
            target_reached: !finished.is_empty() && is_reached,
            done: finished.len(),
            clusters: self.cut,
            // Null would mean that the maps were counted and not measured.
            share: self.so_far.share.or(Some(0.0)),
            has_region: stages.settings.region.is_some(),
            target: self.target,
            kept: Some(self.so_far.kept),
            reachable: self.so_far.reachable,
            clusters_to_target: self.to_target.map(|(clusters, _)| clusters),
            seconds_per_pair,
            seconds_to_target: self.to_target.and_then(|(_, pairs)| seconds(pairs)),
            seconds_left: seconds(self.pairs_left),
            finished,
            outdated: maps.outdated.clone(),
            note: maps
                .unreadable
                .first()
                .map(|first| match maps.unreadable.len() {
                    1 => first.clone(),
                    n => format!("{first}, and {} more", n - 1),
                }),
            announced: false,
        }
    }
}

/// Computes the time between maps divided by their pairs, without pauses.
fn seconds_per_pair(plan: &Plan, run: &MeasuredClusters, folder: &Path) -> Option<f64> {
    let maps = depthmaps::find(folder, &plan.stages.scene).ok()?.maps;
    let time = |path: &Path| fs::metadata(path).and_then(|m| m.modified()).ok();
    let mut times: Vec<(SystemTime, usize)> = Vec::new();
    for cluster in &run.clusters {
        let map = maps.iter().find(|map| map.view == cluster.key)?;
        times.push((time(&map.path)?, cluster.partners.len()));
    }
    times.sort_unstable();
    // The time between two maps is that of the later one.
    let gap = |w: &[(SystemTime, usize)]| {
        Some((w[1].0.duration_since(w[0].0).ok()?.as_secs_f64(), w[1].1))
    };
    let mut gaps: Vec<(f64, usize)> = times.windows(2).filter_map(gap).collect();
    gaps.sort_by(|a, b| a.0.total_cmp(&b.0));
    let usual = gaps.get(gaps.len() / 2)?.0;
    gaps.retain(|(seconds, _)| usual == 0.0 || *seconds <= PAUSE * usual);
    let pairs: usize = gaps.iter().map(|(_, pairs)| pairs).sum();
    let seconds: f64 = gaps.iter().map(|(seconds, _)| seconds).sum();
    // Copies have the time of copying.
    (pairs > 0 && seconds > 0.0).then(|| seconds / pairs as f64)
}
