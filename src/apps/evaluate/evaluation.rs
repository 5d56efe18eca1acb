//! The results of an evaluation, as written to `evaluation.json` and shown on the page.

use std::collections::BTreeMap;

use serde::Serialize;

use super::{
    baselines::{self, Order},
    cells::{CellSource, CellsEvaluation, Incidence},
    clouds::CloudComparison,
    curve::{ReachCurve, SHARES, first_at},
    half_size::HalfSize,
    measure::Quality,
    missing::{MeasuredSurface, Missing},
    run::MeasuredClusters,
    so_far::MeasuredProgress,
};
use crate::{
    base::{column::TableError, progress::Watcher},
    decision::CountedPlaces,
    method::{
        fulfilment::{FulfilmentTable, Model},
        ranking::Objective,
    },
    model::{
        cluster::ViewCluster,
        scene::{Scene, ViewIndex},
    },
    show::share::area_of_all,
};

/// Everything that finished depth maps say about the view clusters that they were made for.
#[derive(Clone, Debug, Serialize)]
pub struct Evaluation {
    /// Version of this format.
    pub version: u32,
    /// True if the depths were compared with a reference; otherwise every depth on the surface
    /// counts as right.
    pub reference: bool,
    /// Number of depth maps that must show a triangle (m, method 5.2).
    pub support: u32,
    /// Share of the weight of the whole surface that is inside the region of the plan, 0 to 1;
    /// fulfilment and shares are those inside.
    pub inside: f64,
    /// Number of triangles with weight.
    pub triangles: usize,
    /// Quality of all depth maps together, per pixel.
    pub quality: QualityRow,
    /// f_o of all clusters together.
    pub predicted: f64,
    pub real: f64,
    /// Share that these maps reach of the result expected from all clusters of the plan, as in
    /// `status` and `report`.
    pub reached: MeasuredProgress,
    /// Depth maps that the project can have.
    pub all_maps: usize,
    /// Weight that fusion keeps of all clusters with a map, 0 to 1, by the fulfilment of each
    /// triangle (method 5.2).
    pub kept: KeptWeight,
    /// Orders judged by the cells of the cloud that all these maps give.
    pub cells: CellsEvaluation,
    /// Curves along the order of the clusters; entry i is the result after i clusters.
    pub curve: EvaluationCurves,
    /// Points of the curve at predicted shares of 10, 20, ... 90 %.
    pub gap: Vec<Gap>,
    /// Triangles that are not well done, by reason.
    pub missing: BTreeMap<Missing, usize>,
    /// Results by key view, in the order of the clusters.
    pub key_views: Vec<KeyView>,
    /// Key views without a depth map; they are excluded from everything above.
    pub without_map: Vec<String>,
    /// Key views whose depth map has neither the planned size nor half of it; they are excluded
    /// from everything above.
    pub other_sizes: Vec<String>,
    /// Key views whose depth map was made with other partners than planned.
    pub other_partners: Vec<String>,
    /// Comparison of the fused cloud with that of a full run, if both are given.
    pub clouds: Option<CloudComparison>,
    /// The same clusters at half the size, if such depth maps are given.
    pub half_size: Option<HalfSize>,
    /// Orders compared by the fulfilment of each triangle, as in the paper; empty unless asked for.
    pub orders: Vec<Order>,
}

#[derive(Clone, Copy, Debug, Serialize)]
pub struct QualityRow {
    /// Number of right pixels over the number of reference pixels.
    pub completeness: f64,
    /// Number of wrong pixels over the number of pixels with both depths; null without a reference.
    pub outliers: Option<f64>,
    /// Root mean square error of the right pixels, scene units; null without a reference.
    pub rmse: Option<f64>,
    /// Pixels with a depth.
    pub measured: u64,
    /// Pixels with a reference depth.
    pub reference: u64,
}

impl QualityRow {
    /// Computes the row. `has_reference`: true if the depths were compared with reference depths.
    pub fn new(q: &Quality, has_reference: bool) -> Self {
        Self {
            completeness: q.completeness(),
            outliers: (has_reference && q.both > 0).then(|| q.outliers()),
            rmse: (has_reference && q.right > 0).then(|| q.rmse()),
            measured: q.measured,
            reference: q.reference,
        }
    }

    /// Returns outliers and RMSE formatted for output; a dash stands for a value that was not
    /// measured.
    pub fn errors(&self) -> [String; 2] {
        let outliers = self.outliers.map(|share| format!("{:.2} %", 100.0 * share));
        let rmse = self.rmse.map(|rmse| format!("{rmse:.4}"));
        [outliers, rmse].map(|text| text.unwrap_or_else(|| "–".into()))
    }
}

#[derive(Clone, Copy, Debug, Serialize)]
pub struct KeptWeight {
    pub predicted: f64,
    pub real: f64,
}

#[derive(Clone, Debug, Serialize)]
pub struct EvaluationCurves {
    /// Weight that fusion is expected to keep, as a share of that of all clusters together.
    pub predicted: Vec<f64>,
    /// Share of the cells of the cloud of all these maps.
    pub real: Vec<f64>,
    /// The same of the cells where three maps agree.
    pub agreeing: Vec<f64>,
    /// Real f_o, as the paper has it.
    pub fulfilment: Vec<f64>,
    pub pairs: Vec<usize>,
}

/// Predicted and measured results at the point where the prediction reaches a given share.
#[derive(Clone, Debug, Serialize)]
pub struct Gap {
    pub share: f64,
    pub clusters: usize,
    pub pairs: usize,
    pub predicted: f64,
    /// Share of the cells of the cloud of all these maps.
    pub real: f64,
    /// The same of the cells where three maps agree.
    pub agreeing: f64,
}

#[derive(Clone, Debug, Serialize)]
pub struct KeyView {
    pub name: String,
    /// Size of the depth map: 1 for the planned one, or 0.5.
    pub scale: f64,
    pub partners: Vec<String>,
    /// The partners that the backend really matched.
    pub matched: Vec<String>,
    pub quality: QualityRow,
    /// Sum of the predicted f over the triangles that it sees, in triangles.
    pub predicted: f64,
    pub real: f64,
}

/// Inputs of an evaluation besides the measured clusters.
pub struct EvaluationOptions<'a> {
    pub objective: &'a Objective,
    /// Places of the plan's pilot.
    pub pilot: Option<&'a CountedPlaces>,
    /// Which maps take part in which cells of their cloud.
    pub cells: (Incidence, CellSource),
    pub so_far: MeasuredProgress,
    /// Depth maps that the project can have.
    pub all_maps: usize,
    pub clouds: Option<CloudComparison>,
    /// Depth maps of the same clusters at half the size.
    pub half: Option<&'a MeasuredClusters>,
    /// True: compares with other orders.
    pub baselines: bool,
}

impl Evaluation {
    /// Returns outliers and RMSE as text to append to the completeness.
    pub fn errors(&self) -> String {
        let [outliers, rmse] = self.quality.errors();
        let unit = if self.quality.rmse.is_some() {
            " units"
        } else {
            ""
        };
        format!(", outliers {outliers}, RMSE {rmse}{unit}")
    }

    /// Returns a sentence with the smallest numbers of first depth maps that really give 95 and 90
    /// % of the total.
    pub fn enough_in_words(&self) -> String {
        let maps = self.key_views.len();
        let enough =
            |share: f64| first_at(&self.curve.real, share).filter(|_| self.cells.all.cells > 0.0);
        let enough = [0.95, 0.9].map(enough);
        let give = if enough[1] == Some(1) {
            "gives"
        } else {
            "give"
        };
        match enough {
            [Some(most), Some(nearly)] if most < maps => format!(
                "Of the area that these {maps} depth maps cover, the first {most} give 95 %, {nearly} {give} 90 %."
            ),
            [Some(_), Some(nearly)] if nearly < maps => {
                format!(
                    "All {maps} depth maps are needed for 95 % of the area that they cover; {nearly} {give} 90 %."
                )
            }
            [Some(_), _] => format!("All {maps} depth maps are needed for what they cover."),
            _ => "These depth maps give no point that fusion keeps.".into(),
        }
    }

    /// Number of depth maps at half the size.
    pub fn at_half_size(&self) -> usize {
        self.key_views
            .iter()
            .filter(|view| view.scale < 1.0)
            .count()
    }

    /// Returns the share reached, in words that say what it refers to and how it is known.
    pub fn reached_in_words(&self) -> String {
        let share = self.reached.share;
        let share = share.map_or("–".into(), |share| format!("{:.1} %", 100.0 * share));
        format!("{share} {}", self.of_all())
    }

    /// The denominator of the share reached.
    pub fn of_all(&self) -> String {
        let area = area_of_all(Some(self.all_maps), self.inside < 1.0);
        format!("of {area}, estimated")
    }

    pub fn new(
        model: &Model,
        run: &MeasuredClusters,
        reached: &MeasuredSurface,
        measure: &EvaluationOptions,
        watcher: &dyn Watcher,
    ) -> Result<Self, TableError> {
        let objective = measure.objective;
        let cells = measure.judged_cells(model, run, watcher)?;
        // The maps of the table are in the run's order.
        let order: Vec<u32> = (0..run.order.len() as u32).collect();
        let [all, agreeing] = measure.cells.0.curves(&order);
        let by_triangle = ReachCurve::new(&run.predicted, objective, &run.clusters, &run.order);
        // Like the shares of the plan: by the places of the pilot, where it has one.
        let predicted = match measure.pilot {
            Some(pilot) => curve_by_places(run, pilot),
            None => by_triangle.clone(),
        };
        let real = run.real_curve(objective, &run.order);
        let orders = measure
            .baselines
            .then(|| baselines::compare(run, model, objective, watcher));
        let names = |views: &[ViewIndex]| names_of(model.scene, views);
        let weighs = |t: usize| objective.weights[t] > 0.0;
        Ok(Self {
            version: 1,
            reference: run.has_reference,
            support: objective.support,
            inside: objective.inside,
            triangles: (0..objective.weights.len()).filter(|&t| weighs(t)).count(),
            quality: QualityRow::new(&run.pooled(), run.has_reference),
            reached: measure.so_far,
            all_maps: measure.all_maps,
            predicted: by_triangle.total(),
            real: real.total(),
            kept: KeptWeight {
                predicted: by_triangle.total_kept(),
                real: real.total_kept(),
            },
            half_size: measure
                .half
                .map(|half| HalfSize::new(half, &real, objective)),
            gap: gaps(&predicted, &all, &agreeing),
            cells,
            curve: EvaluationCurves {
                predicted: shares(&predicted),
                real: all,
                agreeing,
                fulfilment: real.fulfilment,
                pairs: real.pairs,
            },
            missing: reached.counts(weighs),
            key_views: key_views(model, run),
            without_map: names(&run.without_map),
            other_sizes: names(&run.other_sizes),
            other_partners: names(&run.other_partners),
            clouds: measure.clouds.clone(),
            orders: orders.transpose()?.unwrap_or_default(),
        })
    }
}

fn names_of(scene: &Scene, views: &[ViewIndex]) -> Vec<String> {
    views.iter().map(|&v| scene.name(v).to_string()).collect()
}

impl EvaluationOptions<'_> {
    /// Judges the order of the run, and the baselines, by the cells.
    fn judged_cells(
        &self,
        model: &Model,
        run: &MeasuredClusters,
        watcher: &dyn Watcher,
    ) -> Result<CellsEvaluation, TableError> {
        let (table, source) = &self.cells;
        let named = baselines::named(run, model, self.objective, self.baselines, watcher)?;
        let clusters_of = |(name, order): (&'static str, Vec<u32>)| {
            let clusters = order.iter().map(|&c| &run.clusters[c as usize]);
            (name, clusters.collect::<Vec<_>>())
        };
        let named: Vec<_> = named.into_iter().map(clusters_of).collect();
        Ok(CellsEvaluation::new(
            table,
            source.clone(),
            model.scene,
            &named,
        ))
    }
}

/// Returns the predicted curve of the run, where the ranking counts the places of a pilot.
fn curve_by_places(run: &MeasuredClusters, pilot: &CountedPlaces) -> ReachCurve {
    let row = |(c, cluster): (usize, &ViewCluster)| {
        let places = pilot.places.of_view(cluster.key);
        pilot.kept_row(places, run.scales[c], run.predicted.row(c))
    };
    let counted = FulfilmentTable::new(run.clusters.iter().enumerate().map(row));
    ReachCurve::new(&counted, &pilot.kept.objective, &run.clusters, &run.order)
}

fn shares(curve: &ReachCurve) -> Vec<f64> {
    (0..curve.kept.len())
        .map(|i| curve.share(i, curve.total_kept()))
        .collect()
}

fn gaps(predicted: &ReachCurve, real: &[f64], agreeing: &[f64]) -> Vec<Gap> {
    let gap = |share: f64| {
        let clusters = predicted.clusters_for(share * predicted.total_kept())?;
        Some(Gap {
            share,
            clusters,
            pairs: predicted.pairs[clusters],
            predicted: predicted.share(clusters, predicted.total_kept()),
            real: real[clusters],
            agreeing: agreeing[clusters],
        })
    };
    SHARES.iter().filter_map(|&share| gap(share)).collect()
}

/// The key views in the order of the run.
fn key_views(model: &Model, run: &MeasuredClusters) -> Vec<KeyView> {
    let clusters = run.order.iter();
    clusters
        .map(|&c| key_view(model, run, c as usize))
        .collect()
}

fn key_view(model: &Model, run: &MeasuredClusters, cluster: usize) -> KeyView {
    let names = |views: &[ViewIndex]| names_of(model.scene, views);
    let sum = |values: &[f32]| values.iter().map(|&f| f64::from(f)).sum();
    KeyView {
        name: model.scene.name(run.clusters[cluster].key).into(),
        scale: run.scales[cluster].factor(),
        partners: names(&run.clusters[cluster].partners),
        matched: names(&run.matched[cluster].partners),
        quality: QualityRow::new(&run.quality[cluster], run.has_reference),
        predicted: sum(run.predicted.row(cluster).1),
        real: sum(run.real.row(cluster).1),
    }
}
