//! The measure of a result (method 8): the share of the fused cloud of all depth maps that the
//! chosen ones give, counted in cells of twice the wanted GSD of the place.
//!
//! [`Incidence`] says which maps take part in which cells; it is made once from a fused cloud
//! ([`fused`]) or, where the cloud does not say which maps made its points, from the maps
//! themselves ([`agreement`]). From then on it judges any order within seconds ([`judge`]).

mod agreement;
mod cloud_cells;
mod every_nth;
mod frustum;
mod fused;
mod gsd;
mod incidence;
mod judge;
mod oracle;
mod words;

use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
};

use serde::Serialize;

pub use fused::FusedCloudError;
pub use incidence::{CountedCells, Incidence, IncidenceError};
pub use judge::{CellOrders, CellsEvaluation, JudgedOrder, NEEDED, TENTHS};
pub use words::order_in_words;

use self::{cloud_cells::CloudCells, gsd::PlaceGsd};
use super::{
    orders,
    run::{EvaluateError, MeasuredClusters},
};
use crate::{
    backends,
    base::{progress::Watcher, rows::Offsets},
    io::depthmaps,
    method::{confidence::Confidence, fulfilment},
    model::{cluster::ViewCluster, scene::ViewIndex},
    plan::{Plan, Stages},
};

/// Points of a fused cloud in a fixed order, some at a time: positions, and for each the maps that
/// agree on it, as indices into the list of maps that the source was made for.
trait FusedPoints {
    fn for_each_part(&self, take: &mut TakePart) -> Result<(), EvaluateError>;
}

/// Receives the points; an error ends them.
type TakePart<'a> = dyn FnMut(&CloudPart) -> Result<(), EvaluateError> + 'a;

/// Some points of a fused cloud.
#[derive(Clone, Debug, Default)]
struct CloudPart {
    points: Vec<nalgebra::Point3<f64>>,
    /// Each point's entries in `maps`.
    offsets: Offsets,
    maps: Vec<u32>,
}

impl CloudPart {
    fn push(&mut self, point: nalgebra::Point3<f64>, maps: impl IntoIterator<Item = u32>) {
        self.points.push(point);
        self.maps.extend(maps);
        self.offsets.push(self.maps.len() - self.offsets.entries());
    }

    /// Returns the points, each with its maps.
    fn iter(&self) -> impl Iterator<Item = (&nalgebra::Point3<f64>, &[u32])> {
        let maps = |point| &self.maps[self.offsets.row(point)];
        (0..)
            .zip(&self.points)
            .map(move |(i, point)| (point, maps(i)))
    }

    fn bytes(&self) -> usize {
        let of_point = size_of::<nalgebra::Point3<f64>>() + size_of::<usize>();
        of_point * self.points.len() + size_of::<u32>() * self.maps.len()
    }

    fn shrink_to_fit(&mut self) {
        self.points.shrink_to_fit();
        self.maps.shrink_to_fit();
    }

    fn clear(&mut self) {
        self.points.clear();
        self.offsets = Offsets::default();
        self.maps.clear();
    }
}

/// Where the cells come from.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum CellSource {
    /// The fused cloud in this file, with the maps that made each point.
    Cloud(PathBuf),
    /// A model of the fusion: depths of two maps agree within one per cent.
    Maps,
    /// An earlier table.
    Table(PathBuf),
}

impl CellSource {
    /// Describes the source.
    pub fn describe(&self) -> String {
        match self {
            Self::Cloud(path) => format!("the fused cloud {}", path.display()),
            Self::Maps => "the points on which these maps agree within 1 %".into(),
            Self::Table(path) => format!("the table {}", path.display()),
        }
    }
}

/// Makes the table of finished depth maps: from `cloud` if it is given, else from a fused cloud
/// beside the maps that is newer than all of them and names the maps of its points, else from
/// the maps.
pub fn incidence(
    stages: &Stages,
    run: &MeasuredClusters,
    depth_maps: &Path,
    cloud: Option<&Path>,
    watcher: &dyn Watcher,
) -> Result<(Incidence, CellSource), EvaluateError> {
    // In the order of the run, by which its curves are read from the table.
    let views: Vec<ViewIndex> = run
        .order
        .iter()
        .map(|&c| run.clusters[c as usize].key)
        .collect();
    let known = backends::known_maps(stages.backend, depth_maps);
    let maps = depthmaps::list_preferring(depth_maps, &stages.scene, &known)?;
    let gsd = PlaceGsd::new(stages);
    let support = stages.objective.support;
    let names = || views.iter().map(|&view| stages.scene.name(view).to_owned());
    if let Some((path, points)) = fused::find(&stages.scene, &views, &maps, support, cloud)? {
        let cells = CloudCells::of(&points, &gsd, stages, watcher)?;
        let table = cells.incidence(&points, names().collect(), support, watcher)?;
        return Ok((table, CellSource::Cloud(path)));
    }
    let points = agreement::ThinnedMaps::new(&stages.scene, &views, &maps, support, watcher)?;
    let cells = CloudCells::of(&points, &gsd, stages, watcher)?;
    let table = cells.incidence(&points, names().collect(), support, watcher)?;
    Ok((table, CellSource::Maps))
}

/// Judges the order of a plan by a table of an earlier evaluation.
pub fn judge_plan(
    plan: &Plan,
    table: &Path,
    watcher: &dyn Watcher,
) -> Result<CellsEvaluation, EvaluateError> {
    let stages = &plan.stages;
    let incidence = Incidence::read(table, stages.objective.support, stages.scene.views.len())?;
    let known: BTreeSet<&str> = incidence.names().iter().map(String::as_str).collect();
    let is_known = |cluster: &ViewCluster| known.contains(stages.scene.name(cluster.key));
    // Maps that were not there when the table was made cannot be judged by it.
    let ours: Vec<&ViewCluster> = orders::of_plan(plan).filter(|c| is_known(c)).collect();
    if ours.is_empty() {
        return Err(IncidenceError::Foreign(table.into()).into());
    }
    let clusters: Vec<ViewCluster> = stages
        .clusters
        .iter()
        .filter(|cluster| is_known(cluster))
        .cloned()
        .collect();
    let mut certain = stages.model();
    certain.rule.confidence = Confidence::None;
    let nocp = fulfilment::table(&certain, &clusters, watcher)?;
    let others = [
        ("nocp", orders::greedy(&nocp, &stages.objective, watcher)?),
        ("maxpts", orders::max_points(&stages.scene, &clusters)),
        (
            "farthest view",
            orders::farthest_view(&stages.scene, &clusters),
        ),
    ];
    let others =
        others.map(|(name, order)| (name, order.iter().map(|&c| &clusters[c as usize]).collect()));
    let named: Vec<_> = std::iter::once(("ours", ours)).chain(others).collect();
    let source = CellSource::Table(table.into());
    Ok(CellsEvaluation::new(
        &incidence,
        source,
        &stages.scene,
        &named,
    ))
}
