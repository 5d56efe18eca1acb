//! Plans around finished depth maps (method 5.4). Finished clusters come first, with their measured
//! fulfilment; the rest is ranked again after them, with failures taken into account ([`Beliefs`]).
//!
//! The depth maps were made for an earlier plan, possibly of an earlier model: those that still fit
//! ([`movement`]) are kept, the others are reported and ignored.

mod movement;
mod repeat;

use std::{
    collections::{BTreeMap, BTreeSet},
    io,
    path::Path,
};

use self::movement::{MovedView, movement};
pub use self::repeat::{RepeatError, as_written, repeat};
use crate::{
    apps::evaluate::{
        EvaluateError, EvaluationInput, MapSize, MeasuredClusters, MeasuredProgress,
        other_sizes_in_words,
    },
    base::{
        bounded::Names,
        error::{Advice, Hint},
        input,
        progress::{Cancelled, Watcher},
    },
    decision::FinishedClusters,
    io::{
        depthmaps::{self, DepthMap, DepthMapError, DepthMapFile, DepthMapSet},
        json::place_and_fault,
        project::Project,
    },
    method::{
        fulfilment::{FulfilmentTable, FulfilmentTableBuilder},
        ranking::Beliefs,
    },
    model::{
        cluster::{MapScale, ViewCluster},
        scene::ViewIndex,
    },
    plan::{FinishedMaps, OutdatedMap, Plan, PlanError, PlannedView, PlannedViews, Stages, decide},
    show::manifest::{self, RecordedPlan, WrittenPlanError},
};

/// The plan that finished depth maps were made for.
#[derive(Debug)]
pub struct EarlierPlan {
    /// Name of the backend that it was made for.
    pub backend: String,
    /// Key view, partners and size, by name, best first.
    clusters: Vec<(String, Names, MapScale)>,
    /// Key views whose depth maps it counts as finished.
    finished: BTreeSet<String>,
    cut: usize,
    outdated: Vec<OutdatedMap>,
    views: PlannedViews,
}

impl EarlierPlan {
    /// Reads `viewrank/manifest.json` and `planned_views.json` of the project, whether or not the
    /// model has changed since.
    pub fn read(project: &Project) -> Result<Self, WrittenPlanError> {
        let recorded = RecordedPlan::read(project)?;
        let path = project.output_folder().join("planned_views.json");
        let bytes = manifest::read_own(project, "viewrank/planned_views.json")?;
        let views = serde_json::from_slice(&bytes).map_err(|error| WrittenPlanError::Manifest {
            path,
            what: place_and_fault(&error, &bytes),
        })?;
        let finished = recorded.clusters.iter().filter(|c| c.finished);
        let finished = finished.map(|c| c.key.clone()).collect();
        let clusters = recorded
            .clusters
            .into_iter()
            .map(|c| (c.key, c.partners, c.scale))
            .collect();
        Ok(Self {
            backend: recorded.backend,
            clusters,
            finished,
            cut: recorded.cut.clusters,
            outdated: recorded.outdated,
            views,
        })
    }

    /// Returns the names of the key views up to the cut, best first.
    pub fn list(&self) -> impl Iterator<Item = &str> {
        self.keys().take(self.cut)
    }

    /// Returns the names of all key views, best first.
    pub fn keys(&self) -> impl Iterator<Item = &str> {
        self.clusters.iter().map(|(key, ..)| key.as_str())
    }

    /// Returns the names of the key views with the sizes of their maps, best first.
    pub fn maps(&self) -> impl Iterator<Item = (&str, MapScale)> {
        self.clusters
            .iter()
            .map(|(key, _, scale)| (key.as_str(), *scale))
    }

    /// Returns the earlier finding on an outdated depth map that is still the same file.
    fn outdated(&self, key: &str, hash: &str) -> Option<OutdatedMap> {
        let same = self
            .views
            .outdated_files
            .get(key)
            .is_some_and(|known| known == hash);
        self.outdated
            .iter()
            .find(|outdated| same && outdated.key == key)
            .cloned()
    }

    /// Returns the view as it was when the depth map of `key` was made.
    fn then(&self, key: &str, view: &str) -> Option<&PlannedView> {
        // A map that was kept when the model changed still fits the poses from before.
        match self.views.made_with.get(key) {
            Some(views) => views.get(view),
            None => self.views.views.get(view),
        }
    }
}

/// Location of the finished depth maps.
pub struct MapFolder<'a> {
    pub folder: &'a Path,
    /// Returns whether the file is completely written.
    pub ready: &'a (dyn Fn(&Path) -> bool + Sync),
    /// Returns whether the map was made for the earlier plan. One that this counts as finished is
    /// taken anyhow.
    pub known: &'a (dyn Fn(&Path) -> bool + Sync),
}

impl MapFolder<'_> {
    /// Returns whether the depth map of a key view counts for the earlier plan.
    pub fn counts(&self, key: &str, map: &Path, earlier: &EarlierPlan) -> bool {
        (self.ready)(map) && ((self.known)(map) || earlier.finished.contains(key))
    }
}

/// Ranks the plan again around the finished depth maps of an earlier plan; unchanged if there are
/// none.
///
/// Finished clusters keep the partners of the earlier plan. Also returns what was measured; `None`:
/// none of the maps could be.
pub fn replan(
    plan: Plan,
    earlier: &EarlierPlan,
    maps: &MapFolder,
    watcher: &dyn Watcher,
) -> Result<(Plan, Option<Measured>), ReplanError> {
    if !plan.stages.makes_maps {
        return Err(ReplanError::NoMaps(plan.stages.backend));
    }
    let (mut clusters, mut finished) = (Vec::new(), FinishedMaps::default());
    let mut other_sizes = Vec::new();
    for found in look(&plan, earlier, maps, watcher)? {
        match found {
            MapVerdict::Fits { cluster, made_with } => {
                if let Some(made_with) = made_with {
                    finished
                        .made_with
                        .insert(plan.stages.scene.name(cluster.key).into(), made_with);
                }
                clusters.push(cluster);
            }
            MapVerdict::Outdated { outdated, hash } => {
                finished.outdated_files.insert(outdated.key.clone(), hash);
                finished.outdated.push(outdated);
            }
            MapVerdict::OtherSize(view) => other_sizes.push(view),
            MapVerdict::Unreadable(why) => finished.unreadable.push(why),
        }
    }
    let other_sizes = other_sizes_in_words(&plan.stages, &other_sizes);
    // First, since only the first few are shown, and this one is about many maps.
    finished.unreadable.splice(0..0, other_sizes);
    finished.outdated.sort_by(|a, b| a.key.cmp(&b.key));
    let run = match clusters.as_slice() {
        [] => None,
        clusters => Some(measure(&plan, clusters, maps.folder, watcher)?),
    };
    let measured = run.map(|run| Measured {
        progress: MeasuredProgress::new(&plan.stages, &run),
        run,
    });
    Ok((
        rank_around(plan, finished, measured.as_ref(), watcher)?,
        measured,
    ))
}

/// Finished maps, and what they reach of what all would.
pub struct Measured {
    pub run: MeasuredClusters,
    pub progress: MeasuredProgress,
}

fn measure(
    plan: &Plan,
    clusters: &[ViewCluster],
    folder: &Path,
    watcher: &dyn Watcher,
) -> Result<MeasuredClusters, EvaluateError> {
    MeasuredClusters::new(
        &EvaluationInput::new(&plan.stages, clusters, folder, None),
        watcher,
    )
}

/// Replaces the clusters of finished key views and ranks all again.
fn rank_around(
    mut plan: Plan,
    finished: FinishedMaps,
    measured: Option<&Measured>,
    watcher: &dyn Watcher,
) -> Result<Plan, PlanError> {
    if measured.is_some() {
        plan.keep_predictions();
    }
    let Plan {
        mut timings,
        stages,
        ..
    } = plan;
    let (stages, order) = match measured {
        Some(measured) => with_finished(stages, &measured.run, watcher)?,
        None => (stages, Vec::new()),
    };
    let clusters = FinishedClusters {
        order: &order,
        share: measured.and_then(|measured| measured.progress.share),
    };
    let decision = decide(&stages, &clusters, &mut timings, watcher)?;
    Ok(Plan::of(stages, decision, finished, timings))
}

/// Returns the stages with the measured fulfilment of the finished clusters and corrected
/// predictions for the others; and the indices of the finished clusters, in their order, with the
/// sizes of their maps.
fn with_finished(
    stages: Stages,
    run: &MeasuredClusters,
    watcher: &dyn Watcher,
) -> Result<(Stages, Vec<(u32, MapScale)>), PlanError> {
    stages.memory.before_beliefs(&stages.fulfilment)?;
    // By key view: clusters are looked up by binary search.
    let mut rows: BTreeMap<ViewIndex, Rows> = BTreeMap::new();
    for (c, cluster) in stages.clusters.iter().enumerate() {
        rows.entry(cluster.key).or_default().planned = Some(c);
    }
    for (c, cluster) in run.clusters.iter().enumerate() {
        rows.entry(cluster.key).or_default().finished = Some(c);
    }
    let cluster = |rows: &Rows| match (rows.finished, rows.planned) {
        (Some(c), _) => Some(run.clusters[c].clone()),
        (None, planned) => planned.map(|c| stages.clusters[c].clone()),
    };
    let clusters: Vec<ViewCluster> = rows.values().filter_map(cluster).collect();
    let rows_of: Vec<Rows> = rows.values().copied().collect();
    let believed = |table, size| believed(&stages, table, size, run, &rows_of, watcher);
    let fulfilment = believed(&stages.fulfilment, MapScale::Full)?;
    let half = match &stages.half {
        Some(half) => Some(believed(half, MapScale::Half)?),
        // A plan for one size may still find maps of half the size that an earlier plan asked for.
        None if run.scales.contains(&MapScale::Half) => {
            let nothing = FulfilmentTable::new(stages.clusters.iter().map(|_| []));
            Some(believed(&nothing, MapScale::Half)?)
        }
        None => None,
    };
    let places: BTreeMap<ViewIndex, u32> = rows.keys().copied().zip(0..).collect();
    let map = |&c: &u32| {
        (
            places[&run.clusters[c as usize].key],
            run.scales[c as usize],
        )
    };
    let order = run.order.iter().map(map).collect();
    let stages = stages.with_clusters(clusters, fulfilment, half, &|view| run.finished(view));
    Ok((stages, order))
}

/// Indices of a key view's cluster in the run and in the plan.
#[derive(Clone, Copy, Default)]
struct Rows {
    finished: Option<usize>,
    planned: Option<usize>,
}

/// Returns the table of a size, with the measured rows of the clusters that are finished at it and
/// the predictions of the others, corrected by what was measured.
fn believed(
    stages: &Stages,
    predicted: &FulfilmentTable,
    size: MapScale,
    run: &MeasuredClusters,
    rows: &[Rows],
    watcher: &dyn Watcher,
) -> Result<FulfilmentTable, PlanError> {
    let mut beliefs = Beliefs::new(&stages.scene, &stages.surface, &stages.clusters, predicted);
    for (cluster, attempts) in run.clusters.iter().zip(&run.attempts) {
        watcher.check()?;
        beliefs.learn(cluster.key, attempts);
    }
    let mut table = FulfilmentTableBuilder::like(&stages.visibility)?;
    for &Rows { finished, planned } in rows {
        match (finished, planned) {
            // A map whose key view has no cluster in this plan counts at both sizes: no prediction
            // exists for the other.
            (Some(c), planned) if run.scales[c] == size || planned.is_none() => {
                let (triangles, values) = run.real.row(c);
                table.push(triangles, values)?;
            }
            (Some(finished), Some(c)) if size == MapScale::Full => {
                let (triangles, values) = beliefs.row(c);
                let (triangles, values) = run.at_full_size(finished, (triangles, &values));
                table.push(&triangles, &values)?;
            }
            (_, planned) => {
                let (triangles, values) = planned.map(|c| beliefs.row(c)).unwrap_or_default();
                table.push(triangles, &values)?;
            }
        }
    }
    Ok(table.finish()?)
}

/// Verdict on a depth map of a cluster of the earlier plan.
enum MapVerdict {
    /// `made_with`: the earlier views, if any has moved since.
    Fits {
        cluster: ViewCluster,
        made_with: Option<BTreeMap<String, PlannedView>>,
    },
    Outdated {
        outdated: OutdatedMap,
        hash: String,
    },
    OtherSize(ViewIndex),
    Unreadable(String),
}

/// Checks the finished clusters of the earlier plan, in its order, and lists unreadable maps.
fn look(
    plan: &Plan,
    earlier: &EarlierPlan,
    maps: &MapFolder,
    watcher: &dyn Watcher,
) -> Result<Vec<MapVerdict>, ReplanError> {
    let DepthMapSet {
        maps: files,
        unreadable,
        ..
    } = depthmaps::list_preferring(maps.folder, &plan.stages.scene, maps.known)?;
    // A map that is still being written looks damaged, too.
    let ready = unreadable
        .into_iter()
        .filter(|(path, _)| (maps.ready)(path));
    let unreadable = ready.map(|(_, error)| MapVerdict::Unreadable(error.to_string()));
    let file_of: BTreeMap<&str, &DepthMapFile> = files
        .iter()
        .map(|file| (plan.stages.scene.name(file.view), file))
        .collect();
    let view = |(key, ..): &(String, Names, MapScale)| plan.stages.scene.find(key);
    let check = |(key, partners, _): &(String, Names, MapScale)| {
        watcher.check()?;
        let file = file_of
            .get(key.as_str())
            .filter(|file| maps.counts(key, &file.path, earlier));
        Ok(file.map(|file| {
            MapCheck {
                plan,
                earlier,
                key,
                partners,
                file,
            }
            .found()
        }))
    };
    let found: Vec<Option<MapVerdict>> = depthmaps::in_parallel::<_, _, Cancelled>(
        &earlier.clusters,
        view,
        &plan.stages.scene,
        check,
    )?;
    Ok(found
        .into_iter()
        .flatten()
        .chain(outdated_beyond(earlier, &file_of))
        .chain(unreadable)
        .collect())
}

/// Outdated maps of views without partners in the earlier plan: earlier findings on them still
/// hold.
fn outdated_beyond(
    earlier: &EarlierPlan,
    file_of: &BTreeMap<&str, &DepthMapFile>,
) -> Vec<MapVerdict> {
    let keys: BTreeSet<&str> = earlier.keys().collect();
    let beyond = earlier
        .outdated
        .iter()
        .filter(|outdated| !keys.contains(outdated.key.as_str()));
    let verdict = |OutdatedMap { key, .. }: &OutdatedMap| {
        let hash = hash(file_of.get(key.as_str())?).ok()?;
        Some(MapVerdict::Outdated {
            outdated: earlier.outdated(key, &hash)?,
            hash,
        })
    };
    beyond.filter_map(verdict).collect()
}

/// Hash of the files that hold the depths of a map.
fn hash(map: &DepthMapFile) -> io::Result<String> {
    let mut hasher = blake3::Hasher::new();
    for file in depthmaps::files_with_depths(map) {
        hasher.update(&input::read(&file, input::FileKind::Picture)?);
    }
    Ok(hasher.finalize().to_string())
}

/// A depth map with the cluster that it was made for.
struct MapCheck<'a> {
    plan: &'a Plan,
    earlier: &'a EarlierPlan,
    key: &'a String,
    partners: &'a Names,
    file: &'a DepthMapFile,
}

impl MapCheck<'_> {
    fn found(&self) -> MapVerdict {
        let map = match depthmaps::read_of_view(self.file, &self.plan.stages.scene) {
            Ok(map) => map,
            Err(error) => return MapVerdict::Unreadable(error.to_string()),
        };
        if !self.counts(&map) {
            return MapVerdict::OtherSize(self.file.view);
        }
        let hash = match hash(self.file) {
            Ok(hash) => hash,
            Err(error) => return MapVerdict::Unreadable(format!("{}: {error}", self.path())),
        };
        // The earlier plan has recorded the new poses: compared with these, the map would seem to
        // fit.
        if let Some(outdated) = self.earlier.outdated(self.key, &hash) {
            return MapVerdict::Outdated { outdated, hash };
        }
        match self.moved(&map) {
            Ok((moved_px, view)) if moved_px > self.plan.stages.settings.ranking.keep_px => {
                MapVerdict::Outdated {
                    outdated: self.outdated(view, Some(moved_px)),
                    hash,
                }
            }
            Ok(_) => self.fits(),
            Err(view) => MapVerdict::Outdated {
                outdated: self.outdated(view, None),
                hash,
            },
        }
    }

    /// Returns whether the map has a planned size: the backend cannot fuse another with the others,
    /// and makes it again.
    fn counts(&self, map: &DepthMap) -> bool {
        let stages = &self.plan.stages;
        MapSize::new(&stages.model(), self.file.view, map).counts(stages.mixes_sizes)
    }

    fn path(&self) -> String {
        self.file.path.display().to_string()
    }

    fn views(&self) -> impl Iterator<Item = &str> {
        std::iter::once(self.key.as_str()).chain(self.partners.iter())
    }

    fn outdated(&self, view: &str, moved_px: Option<f64>) -> OutdatedMap {
        OutdatedMap {
            key: self.key.clone(),
            view: view.into(),
            moved_px,
        }
    }

    /// Returns the largest movement of any view of the cluster, with that view; `Err`: a view that
    /// is gone or has no record.
    fn moved(&self, map: &DepthMap) -> Result<(f64, &str), &str> {
        let place = |name| self.place(name).ok_or(name);
        let key = place(self.key.as_str())?;
        let mut farthest = (0.0, self.key.as_str());
        for name in self.partners.iter() {
            let moved = movement(map, &key, &place(name)?);
            if moved > farthest.0 {
                farthest = (moved, name);
            }
        }
        Ok(farthest)
    }

    fn place(&self, name: &str) -> Option<MovedView> {
        MovedView::new(
            self.earlier.then(self.key, name)?,
            &self.plan.stages.scene,
            self.plan.stages.scene.find(name)?,
        )
    }

    fn fits(&self) -> MapVerdict {
        let scene = &self.plan.stages.scene;
        let then = |name: &str| Some((name.to_owned(), self.earlier.then(self.key, name)?.clone()));
        let made_with: BTreeMap<String, PlannedView> = self.views().filter_map(then).collect();
        let now = |name: &str| scene.find(name).map(|view| PlannedView::new(scene, view));
        let stayed = made_with
            .iter()
            .all(|(name, then)| now(name).as_ref() == Some(then));
        let partners = self
            .partners
            .iter()
            .filter_map(|name| scene.find(name))
            .collect();
        MapVerdict::Fits {
            cluster: ViewCluster {
                key: self.file.view,
                partners,
            },
            made_with: (!stayed).then_some(made_with),
        }
    }
}

/// An error of ranking a plan around finished depth maps.
#[derive(Debug, thiserror::Error)]
pub enum ReplanError {
    #[error(transparent)]
    Written(#[from] WrittenPlanError),
    #[error(transparent)]
    DepthMaps(#[from] DepthMapError),
    #[error(transparent)]
    Measure(#[from] EvaluateError),
    #[error(transparent)]
    Plan(#[from] PlanError),
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
    #[error("{0} takes the images themselves: there are no depth maps to keep")]
    NoMaps(&'static str),
}

impl Hint for ReplanError {
    fn hint(&self) -> Option<Advice> {
        match self {
            Self::Written(error) => error.hint(),
            Self::DepthMaps(error) => error.hint(),
            Self::Measure(error) => error.hint(),
            Self::Plan(error) => error.hint(),
            Self::Cancelled(_) => None,
            Self::NoMaps(_) => Some("plan again without finished depth maps".into()),
        }
    }
}
