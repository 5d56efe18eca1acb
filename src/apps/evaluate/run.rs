//! A folder of finished depth maps of some view clusters, measured.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    sync::atomic::{AtomicU64, Ordering},
};

use super::{
    cells::{FusedCloudError, IncidenceError},
    curve::ReachCurve,
    matched::{self, MatcherReportError, Report},
    measure::{MapMeasurement, Quality, measure},
};
use crate::{
    backends::{KnownMaps, known_maps},
    base::{
        column::TableError,
        error::{Advice, Hint},
        progress::{Cancelled, Stage, Watcher},
    },
    decision::FinishedPart,
    io::{
        depthmaps::{self, DepthMapError, DepthMapFile, DepthMapSet},
        ply,
    },
    method::{
        confidence::Confidence,
        fulfilment::{self, FulfilmentTable, Model},
        pilot::{Part, Places},
        ranking::{Attempt, Objective},
    },
    model::{
        cluster::{MapScale, ViewCluster},
        scene::ViewIndex,
    },
    plan::Stages,
};

/// Finished view clusters with their measured results. All tables have one row per cluster.
#[derive(Clone, Debug)]
pub struct MeasuredClusters {
    /// The clusters with a depth map, sorted by key view.
    pub clusters: Vec<ViewCluster>,
    /// Size of each depth map.
    pub scales: Vec<MapScale>,
    /// Key views whose map is left out, because it has neither the planned size nor half of it.
    /// Only where the size matters.
    pub other_sizes: Vec<ViewIndex>,
    /// The order in which they were to be computed, indices into `clusters`.
    pub order: Vec<u32>,
    /// The same clusters with the partners that were really matched.
    pub matched: Vec<ViewCluster>,
    pub quality: Vec<Quality>,
    /// Places of the pilot on which each map agrees with it, ascending.
    pub places: Vec<Vec<Part>>,
    /// Fulfilment predicted by the plan's model.
    pub predicted: FulfilmentTable,
    /// Fulfilment predicted with f_conf = 1.
    pub nocp: FulfilmentTable,
    /// Measured fulfilment (method 8).
    pub real: FulfilmentTable,
    /// Fulfilment by the partners that were really matched, with f_conf = 1: the value of `real` if
    /// every pixel were right.
    pub attainable: FulfilmentTable,
    /// Predicted and measured shares at each triangle that the key view sees, for
    /// [`ranking::Beliefs`](crate::method::ranking::Beliefs).
    pub attempts: Vec<Vec<Attempt>>,
    /// True if the maps were compared with references.
    pub has_reference: bool,
    /// Key views without a depth map.
    pub without_map: Vec<ViewIndex>,
    /// Key views whose depth map was made with other partners than the clusters have.
    pub other_partners: Vec<ViewIndex>,
    /// Files that look like depth maps but belong to no view.
    pub strangers: Vec<PathBuf>,
    /// Depth maps that cannot be read and are left out, in sentences.
    pub unreadable: Vec<String>,
}

/// Depth maps to measure, and their reference.
pub struct EvaluationInput<'a> {
    pub model: Model<'a>,
    /// The clusters, in the order in which they were to be computed.
    pub clusters: &'a [ViewCluster],
    pub depth_maps: &'a Path,
    /// Returns whether a map was made for the plan; of two maps of a view, one that was is
    /// measured.
    pub known: KnownMaps,
    /// Number of clusters that the plan counts as finished: of the others, only known maps are
    /// measured. `None`: all maps are.
    pub of_plan: Option<usize>,
    pub reference: Option<&'a Path>,
    /// a_d for pixels that show no triangle, scene units.
    pub accuracy: f64,
    /// Places of the plan's pilot.
    pub places: Option<&'a Places>,
    /// `ranking.half_worth` if the backend can match key views at half the size; `None` if the size
    /// of a map does not matter.
    pub half_worth: Option<f64>,
}

impl MeasuredClusters {
    pub fn new(task: &EvaluationInput, watcher: &dyn Watcher) -> Result<Self, EvaluateError> {
        let scene = task.model.scene;
        let maps = task.maps()?;
        let references = task
            .reference
            .map(|folder| depthmaps::find(folder, scene)?.into_complete())
            .transpose()?;
        let report = matched::read_report(task.depth_maps, scene)?;
        let (found, without_map) = task.found(&maps)?;
        let tried = task.measure_all(&found, references.as_ref(), watcher)?;
        let (mut clusters, mut ranks, mut measured) = (Vec::new(), Vec::new(), Vec::new());
        let (mut broken, mut other_sizes) = (Vec::new(), Vec::new());
        let mixes_sizes = task.half_worth.is_some();
        for (FoundMap { cluster, rank, .. }, tried) in found.into_iter().zip(tried) {
            match tried {
                Ok(of_map) if !of_map.size.counts(mixes_sizes) => other_sizes.push(cluster.key),
                Ok(of_map) => {
                    clusters.push(cluster.clone());
                    ranks.push(rank);
                    measured.push(of_map);
                }
                Err(error) => broken.push(error),
            }
        }
        // One map that can be measured is enough to go on: the others are named.
        if clusters.is_empty() {
            return Err(match broken.into_iter().next() {
                Some(error) => error.into(),
                None => EvaluateError::OtherSizes {
                    path: task.depth_maps.into(),
                    image_scale: task.model.rule.image_scale,
                },
            });
        }
        let mut order: Vec<u32> = (0..clusters.len() as u32).collect();
        order.sort_by_key(|&c| ranks[c as usize]);
        let unreadable = maps.unreadable.iter().map(|(_, error)| error.to_string());
        let unreadable = unreadable
            .chain(broken.iter().map(DepthMapError::to_string))
            .collect();
        let run = task.tables(clusters, order, &measured, &report, watcher)?;
        Ok(Self {
            without_map,
            strangers: maps.unassigned,
            unreadable,
            other_sizes,
            ..run
        })
    }

    /// Returns the quality of all clusters together.
    pub fn pooled(&self) -> Quality {
        let mut all = Quality::default();
        self.quality.iter().for_each(|q| all.add(q));
        all
    }

    /// Returns the fulfilment of a finished cluster at full size: as measured, and where its map
    /// has half the size at least what is believed of a map at full size.
    pub fn at_full_size(
        &self,
        cluster: usize,
        (triangles, believed): (&[u32], &[f32]),
    ) -> (Vec<u32>, Vec<f32>) {
        let (own, measured) = self.real.row(cluster);
        if self.scales[cluster] == MapScale::Full {
            return (own.to_vec(), measured.to_vec());
        }
        // Each row may have triangles that the other one lacks.
        let mut row: BTreeMap<u32, f32> = triangles
            .iter()
            .copied()
            .zip(believed.iter().copied())
            .collect();
        for (&t, &f) in own.iter().zip(measured) {
            let held = row.entry(t).or_default();
            *held = held.max(f);
        }
        row.into_iter().unzip()
    }

    /// Returns what is measured of a view's map.
    pub fn finished(&self, view: ViewIndex) -> Option<FinishedPart<'_>> {
        let place = self
            .clusters
            .binary_search_by_key(&view, |cluster| cluster.key)
            .ok()?;
        Some((self.scales[place], &self.places[place]))
    }

    /// Returns the measured curve of an order of the clusters.
    pub fn real_curve(&self, objective: &Objective, order: &[u32]) -> ReachCurve {
        ReachCurve::new(&self.real, objective, &self.clusters, order)
    }
}

impl<'a> EvaluationInput<'a> {
    /// Takes the depth maps of clusters of a plan; without a reference, every depth on the surface
    /// counts as right.
    pub fn new(
        stages: &'a Stages,
        clusters: &'a [ViewCluster],
        depth_maps: &'a Path,
        reference: Option<&'a Path>,
    ) -> Self {
        let model = stages.model();
        let accuracy =
            model.target.accuracy_over_gsd * stages.settings.target.gsd.unwrap_or(f64::INFINITY);
        Self {
            model,
            clusters,
            depth_maps,
            known: known_maps(stages.backend, depth_maps),
            of_plan: None,
            reference,
            accuracy,
            places: stages.pilot.as_ref().map(|pilot| &*pilot.places),
            half_worth: stages
                .mixes_sizes
                .then_some(stages.settings.ranking.half_worth),
        }
    }
}

/// A cluster with its depth map.
struct FoundMap<'a> {
    cluster: &'a ViewCluster,
    file: &'a DepthMapFile,
    /// In the order of the clusters.
    rank: u32,
}

fn map_of(set: &DepthMapSet, view: ViewIndex) -> Option<&DepthMapFile> {
    set.maps.iter().find(|map| map.view == view)
}

impl EvaluationInput<'_> {
    fn maps(&self) -> Result<DepthMapSet, DepthMapError> {
        let listed = depthmaps::list_preferring(self.depth_maps, self.model.scene, &self.known);
        listed?.not_empty(self.depth_maps)
    }

    /// Returns the clusters that have a map, sorted by key view, and the key views without one.
    fn found<'a>(
        &'a self,
        maps: &'a DepthMapSet,
    ) -> Result<(Vec<FoundMap<'a>>, Vec<ViewIndex>), EvaluateError> {
        let (mut found, mut without_map) = (Vec::new(), Vec::new());
        for (rank, cluster) in (0..).zip(self.clusters) {
            match map_of(maps, cluster.key).filter(|file| self.counts(rank, file)) {
                Some(file) => found.push(FoundMap {
                    cluster,
                    file,
                    rank,
                }),
                None => without_map.push(cluster.key),
            }
        }
        if found.is_empty() {
            return Err(EvaluateError::NoClusters(self.depth_maps.into()));
        }
        // Results are looked up by key view in a binary search.
        found.sort_by_key(|map| map.cluster.key);
        Ok((found, without_map))
    }

    fn counts(&self, rank: u32, file: &DepthMapFile) -> bool {
        let is_finished = |finished| (rank as usize) < finished;
        self.of_plan.is_none_or(is_finished) || (self.known)(&file.path)
    }

    /// Measures the maps; an inner error is of a map that cannot be read.
    fn measure_all(
        &self,
        found: &[FoundMap],
        references: Option<&DepthMapSet>,
        watcher: &dyn Watcher,
    ) -> Result<Vec<Result<MapMeasurement, DepthMapError>>, EvaluateError> {
        let (done, all) = (AtomicU64::new(0), found.len() as u64);
        watcher.progress(Stage::Evaluate, 0, all);
        depthmaps::in_parallel(
            found,
            |map| Some(map.cluster.key),
            self.model.scene,
            |FoundMap { cluster, file, .. }| {
                watcher.check()?;
                let reference = references.map(|set| map_of(set, cluster.key));
                let measured = self.measure(cluster.key, file, reference)?;
                let done = 1 + done.fetch_add(1, Ordering::Relaxed);
                watcher.progress(Stage::Evaluate, done, all);
                Ok(measured)
            },
        )
    }

    /// Measures a depth map. `reference` is `Some(None)` if there are references but none for this
    /// view: no pixel of the map is then right. The inner error is a map that cannot be read,
    /// perhaps because it is still being written.
    fn measure(
        &self,
        key: ViewIndex,
        map: &DepthMapFile,
        reference: Option<Option<&DepthMapFile>>,
    ) -> Result<Result<MapMeasurement, DepthMapError>, EvaluateError> {
        let scene = self.model.scene;
        let map = match depthmaps::read_of_view(map, scene) {
            Ok(map) => map,
            // A fault of the whole model, which must not pass for one unreadable file.
            Err(error @ DepthMapError::Distorted { .. }) => return Err(error.into()),
            Err(error) => return Ok(Err(error)),
        };
        let reference = match reference {
            None => None,
            Some(Some(file)) => Some(depthmaps::read_of_view(file, scene)?),
            Some(None) => Some(map.without_depths()),
        };
        Ok(Ok(measure(
            &self.model,
            key,
            map,
            reference.as_ref(),
            self.accuracy,
            self.places,
        )))
    }

    fn tables(
        &self,
        clusters: Vec<ViewCluster>,
        order: Vec<u32>,
        measured: &[MapMeasurement],
        report: &Report,
        watcher: &dyn Watcher,
    ) -> Result<MeasuredClusters, EvaluateError> {
        let scene = self.model.scene;
        let matched = clusters.iter().zip(measured);
        let matched: Vec<ViewCluster> = matched
            .map(|(c, m)| matched::really_matched(c, report, &m.ids, scene))
            .collect();
        let mut certain = self.model;
        certain.rule.confidence = Confidence::None;
        // Where a program has one size, a map of any size counts as what was planned.
        let scales = if self.half_worth.is_some() {
            measured.iter().map(|m| m.size.scale).collect()
        } else {
            vec![MapScale::Full; measured.len()]
        };
        let table = |model: &Model, clusters: &[ViewCluster]| {
            table_at(
                model,
                clusters,
                &scales,
                self.half_worth.unwrap_or_default(),
                watcher,
            )
        };
        let attainable = table(&certain, &matched)?;
        let predicted = table(&self.model, &clusters)?;
        let nocp = table(&certain, &clusters)?;
        Ok(MeasuredClusters {
            has_reference: self.reference.is_some(),
            other_partners: with_other_partners(&clusters, report),
            quality: measured.iter().map(|m| m.quality).collect(),
            places: measured.iter().map(|m| m.places.clone()).collect(),
            attempts: (0..clusters.len())
                .map(|c| self.attempts(c, &clusters, &predicted, &nocp, measured))
                .collect(),
            predicted,
            nocp,
            real: self.real(&matched, &attainable, measured),
            attainable,
            matched,
            clusters,
            scales,
            order,
            without_map: Vec::new(),
            other_sizes: Vec::new(),
            strangers: Vec::new(),
            unreadable: Vec::new(),
        })
    }

    /// Returns the measured fulfilment: the attainable one times the measured share.
    fn real(
        &self,
        clusters: &[ViewCluster],
        attainable: &FulfilmentTable,
        measured: &[MapMeasurement],
    ) -> FulfilmentTable {
        let of_cluster = |(c, cluster): (usize, &ViewCluster)| -> Vec<(u32, f32)> {
            let seen = self.model.visibility.triangles_seen_by(cluster.key);
            let share = |t| {
                seen.binary_search(&t)
                    .map_or(0.0, |row| measured[c].shares[row])
            };
            let (triangles, values) = attainable.row(c);
            let real = triangles
                .iter()
                .zip(values)
                .map(|(&t, &f)| (t, f * share(t)));
            // As in all tables, a triangle without f has no entry.
            real.filter(|(_, f)| *f > 0.0).collect()
        };
        FulfilmentTable::new(clusters.iter().enumerate().map(of_cluster))
    }

    /// Returns the attempts at the triangles that the cluster was predicted to fulfil. The promise
    /// is f_conf: the prediction with it over that without it.
    fn attempts(
        &self,
        cluster: usize,
        clusters: &[ViewCluster],
        predicted: &FulfilmentTable,
        nocp: &FulfilmentTable,
        measured: &[MapMeasurement],
    ) -> Vec<Attempt> {
        let seen = self
            .model
            .visibility
            .triangles_seen_by(clusters[cluster].key);
        let (certain_triangles, certain) = nocp.row(cluster);
        let (triangles, values) = predicted.row(cluster);
        let attempt = |(&t, &f): (&u32, &f32)| {
            let row = seen.binary_search(&t).ok()?;
            let without = certain[certain_triangles.binary_search(&t).ok()?];
            let measured = &measured[cluster];
            Some(Attempt::new(
                t,
                measured.pixels[row],
                // Rounding may put a sure triangle above 1.
                (f / without).min(1.0),
                measured.shares[row],
            ))
        };
        triangles.iter().zip(values).filter_map(attempt).collect()
    }
}

/// Returns the fulfilment table of clusters whose maps have these sizes.
fn table_at(
    model: &Model,
    clusters: &[ViewCluster],
    scales: &[MapScale],
    half_worth: f64,
    watcher: &dyn Watcher,
) -> Result<FulfilmentTable, TableError> {
    let full = fulfilment::table(model, clusters, watcher)?;
    if !scales.contains(&MapScale::Half) {
        return Ok(full);
    }
    let half = fulfilment::half_size(model, clusters, &full, half_worth, watcher)?;
    let row = |(cluster, &scale): (usize, &MapScale)| -> Vec<(u32, f32)> {
        let (triangles, values) = if scale == MapScale::Half {
            half.row(cluster)
        } else {
            full.row(cluster)
        };
        triangles
            .iter()
            .copied()
            .zip(values.iter().copied())
            .collect()
    };
    Ok(FulfilmentTable::new(scales.iter().enumerate().map(row)))
}

/// Key views whose maps were made with other partners than planned, as far as the matcher says.
fn with_other_partners(clusters: &[ViewCluster], report: &Report) -> Vec<ViewIndex> {
    let is_other = |c: &&ViewCluster| {
        let tried = report.get(&c.key).map(|r| sorted(&r.tried));
        tried.is_some_and(|tried| tried != sorted(&c.partners))
    };
    clusters.iter().filter(is_other).map(|c| c.key).collect()
}

fn sorted(views: &[ViewIndex]) -> Vec<ViewIndex> {
    let mut views = views.to_vec();
    views.sort_unstable();
    views
}

/// An error of measuring depth maps.
#[derive(Debug, thiserror::Error)]
pub enum EvaluateError {
    #[error(transparent)]
    DepthMap(#[from] DepthMapError),
    #[error(transparent)]
    Report(#[from] MatcherReportError),
    #[error("cannot read cloud {}: {source}", path.display())]
    CloudFile {
        path: PathBuf,
        source: std::io::Error,
    },
    #[error("cannot read cloud {}: {source}", path.display())]
    Cloud {
        path: PathBuf,
        source: ply::PlyError,
    },
    #[error("{of} of the {maps} depth maps in {} are not at half the size of the plan's", .path.display())]
    NotHalf {
        path: PathBuf,
        of: usize,
        maps: usize,
    },
    #[error("none of the depth maps in {} has the size that image_scale = {image_scale} gives, or half of it", path.display())]
    OtherSizes { path: PathBuf, image_scale: f64 },
    #[error("none of the view clusters has a depth map in {}", .0.display())]
    NoClusters(PathBuf),
    #[error(transparent)]
    Fused(#[from] FusedCloudError),
    #[error(transparent)]
    Incidence(#[from] IncidenceError),
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
    #[error(transparent)]
    Table(#[from] TableError),
}

impl Hint for EvaluateError {
    fn hint(&self) -> Option<Advice> {
        Some(match self {
            Self::DepthMap(error) => return error.hint(),
            Self::Report(error) => return error.hint(),
            Self::NoClusters(_) => {
                Advice::text("give the depth maps of this plan, or the clusters that they were made for with ").set("clusters")
            }
            Self::OtherSizes { .. } => "plan again with the image_scale that they were made with: it is a line of viewrank.toml in the project".into(),
            Self::NotHalf { .. } => "match the same clusters again at half the image size, into another folder".into(),
            Self::CloudFile { .. } | Self::Cloud { .. } => "give the fused cloud as a PLY file".into(),
            Self::Fused(error) => return error.hint(),
            Self::Incidence(error) => return error.hint(),
            Self::Cancelled(_) => return None,
            Self::Table(error) => return error.hint(),
        })
    }

    fn path(&self) -> Option<&Path> {
        match self {
            Self::DepthMap(error) => error.path(),
            Self::Report(error) => error.path(),
            Self::NoClusters(path)
            | Self::OtherSizes { path, .. }
            | Self::NotHalf { path, .. }
            | Self::CloudFile { path, .. }
            | Self::Cloud { path, .. } => Some(path),
            Self::Fused(error) => error.path(),
            Self::Incidence(error) => error.path(),
            Self::Cancelled(_) => None,
            Self::Table(error) => error.path(),
        }
    }
}
