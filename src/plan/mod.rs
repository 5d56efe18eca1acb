//! Decides which depth maps are worth computing: runs the stages of the method and ranks the view
//! clusters.
//!
//! [`Stages::run`] builds the surface, computes visibility, and chooses view clusters; [`decide`]
//! ranks them, cuts the ranking, forecasts its cost, and gives a reason for everything left out. A
//! [`Plan`] holds both results. This module writes no files.

mod cached;
mod decision;
mod empty;
mod error;
mod finished;
mod georeference;
mod inputs;
mod memory;
mod mesh;
mod pilot_maps;
mod region;
mod stages;
mod step;
mod steps;
mod timings;
mod visible_surface;
mod warnings;

pub use decision::{decide, decide_as};
pub use empty::EmptyPlan;
pub use error::PlanError;
pub use finished::{FinishedMaps, MOST_VIEWS, OutdatedMap, PlannedView, PlannedViews};
pub use georeference::{
    georeference, metres_per_unit, positions_in_images, unused_positions, unused_positions_of,
};
pub use inputs::metres;
pub use memory::Memory;
pub use mesh::MeshError;
pub use region::{
    GroundSummary, RegionFileError, area_in_words, ground_without_surface, photographed_ground,
    region_in_degrees, wanted_gsd,
};
pub use stages::Stages;
pub use timings::Timings;
pub use viewrank_core::decision::{
    Band, CurvePoint, Cut, CutLimit, Decision, Forecast, GivenUp, Matcher, PlanningNumbers,
    ReachOfPair, Substitute, UncutRanking, ViewStatus, WorkPerMap,
};
pub use warnings::{length_in_words, unlikely_gsd, warnings};

use std::path::Path;

use crate::{
    base::{
        column::DiskError,
        progress::{Stage, Watcher},
    },
    config::Settings,
    decision::{DecisionError, FinishedClusters},
    io::project::Project,
    model::{
        cluster::{RankedCluster, ViewCluster},
        scene::Scene,
    },
};

/// A ranking of view clusters with all intermediate results.
#[derive(Clone, Debug)]
pub struct Plan {
    pub stages: Stages,
    pub decision: Decision,
    /// Empty in a fresh plan.
    pub finished: FinishedMaps,
    pub warnings: Vec<String>,
    /// Differs from run to run, unlike everything else in the plan.
    pub timings: Timings,
}

impl Plan {
    /// Chooses the project's key views, their partners and their order for the MVS program that
    /// will match them.
    pub fn new(
        project: &Project,
        settings: &Settings,
        matcher: &Matcher,
        watcher: &dyn Watcher,
    ) -> Result<Self, PlanError> {
        let mut timings = Timings::start();
        // Checked before anything is read: the ranking would refuse it only after all the work.
        if settings.cut.time.is_some() && matcher.makes_maps && !settings.forecast.knows_times() {
            return Err(DecisionError::NoTimes.into());
        }
        watcher.progress(Stage::Read, 0, 1);
        let scene = timings.time(Stage::Read, || project.read_scene())?;
        watcher.progress(Stage::Read, 1, 1);
        watcher.check()?;
        Self::from_scene(project, scene, settings, matcher, timings, watcher)
    }

    /// Like [`Plan::new`], for a scene that is already read; `timings` continues its measurement.
    pub fn from_scene(
        project: &Project,
        scene: Scene,
        settings: &Settings,
        matcher: &Matcher,
        mut timings: Timings,
        watcher: &dyn Watcher,
    ) -> Result<Self, PlanError> {
        let stages = Stages::run(project, scene, settings, matcher, &mut timings, watcher);
        // A stranger's project may name any file of the user's: errors must not show its contents.
        let may_quote = |file: &Path| settings.may_quote(file, &project.named);
        let stages = stages.map_err(|error| error.quoting(may_quote))?;
        let decision = decide(&stages, &FinishedClusters::default(), &mut timings, watcher)?;
        timings.end();
        Ok(Self::of(stages, decision, FinishedMaps::default(), timings))
    }

    /// Puts a plan together, with its warnings.
    pub fn of(
        stages: Stages,
        decision: Decision,
        finished: FinishedMaps,
        timings: Timings,
    ) -> Self {
        let warnings = warnings(&stages, &decision, &finished);
        Self {
            stages,
            decision,
            finished,
            warnings,
            timings,
        }
    }

    /// The clusters to compute, best first.
    pub fn chosen(&self) -> impl ExactSizeIterator<Item = &ViewCluster> {
        self.decision.ranking.order[..self.decision.cut.clusters]
            .iter()
            .map(|&c| &self.stages.clusters[c as usize])
    }

    /// Triangles with weight that no cluster fulfils to a tenth; ascending.
    pub fn unfulfilled(&self) -> impl Iterator<Item = u32> {
        let inside = |t: &u32| {
            self.stages
                .region
                .as_ref()
                .is_none_or(|region| region.is_inside(*t))
        };
        let reasons = self.decision.triangle_reasons.iter().zip(0u32..);
        reasons
            .filter_map(|(reason, t)| reason.map(|_| t))
            .filter(inside)
    }

    /// Area of a triangle, of that of a region the part inside; square scene units.
    pub fn area_inside(&self, triangle: u32) -> f64 {
        let region = self.stages.region.as_ref();
        let inside = region.map_or(1.0, |region| f64::from(region.covered[triangle as usize]));
        inside * self.stages.surface.area(triangle)
    }

    /// Area of the surface, of that of a region the part inside; square scene units.
    pub fn whole_area_inside(&self) -> f64 {
        let all = 0..self.stages.surface.triangles.len() as u32;
        all.map(|t| self.area_inside(t)).sum()
    }

    /// Share of the surface, of that of a region inside it, that no cluster fulfils to a tenth.
    pub fn unfulfilled_share(&self) -> f64 {
        let whole = self.whole_area_inside();
        let missing: f64 = self.unfulfilled().map(|t| self.area_inside(t)).sum();
        if whole > 0.0 { missing / whole } else { 0.0 }
    }

    /// Pixels that the depth map of each cluster will measure, before fusion, in the order of the
    /// ranking.
    pub fn points_by_rank(&self) -> Vec<f64> {
        let options = decision::options(&self.stages);
        self.decision.points_by_rank(&self.stages.tables, &options)
    }

    /// Returns the curve of the whole ranking, a point per cluster.
    pub fn curve(&self) -> Vec<CurvePoint> {
        let options = decision::options(&self.stages);
        self.decision.curve(&self.stages.tables, &options)
    }

    /// For each cluster, the clusters ranked before it that give more of its own fulfilment than
    /// all before them, by rank: the last one within a cut is the best substitute there.
    pub fn best_substitutes(&self) -> Result<Vec<Vec<Substitute>>, DiskError> {
        self.decision.best_substitutes(&self.stages.tables)
    }

    /// The whole ranking, best first.
    pub fn ranked(&self) -> impl ExactSizeIterator<Item = RankedCluster> {
        let ranking = &self.decision.ranking;
        (0..ranking.order.len()).map(|i| {
            let ViewCluster { key, partners } =
                self.stages.clusters[ranking.order[i] as usize].clone();
            RankedCluster {
                key,
                partners,
                scale: ranking.scales[i],
                share: ranking.share(i + 1),
            }
        })
    }
}
