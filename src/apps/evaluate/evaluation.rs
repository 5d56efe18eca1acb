//! The results of an evaluation, as they are written to `evaluation.json` and shown on the page.

use std::collections::BTreeMap;

use serde::Serialize;

use super::{
    baselines::{self, Order},
    clouds::CloudComparison,
    curve::{ReachCurve, SHARES},
    measure::Quality,
    missing::{MeasuredSurface, Missing},
    run::MeasuredClusters,
    so_far::MeasuredProgress,
};
use crate::{
    base::{column::TableError, progress::Watcher},
    method::{fulfilment::Model, ranking::Objective},
    model::scene::ViewIndex,
};

/// Everything that finished depth maps say about the view clusters that they were made for.
#[derive(Clone, Debug, Serialize)]
pub struct Evaluation {
    /// Version of this format.
    pub version: u32,
    /// Were the depths held against a reference? If not, every depth on the surface counts as right.
    pub reference: bool,
    /// Maps that must show a triangle (m, method 5.2).
    pub support: u32,
    /// Share of the weight of the whole surface that is inside the region of the plan, 0 to 1; fulfilment and shares are those inside.
    pub inside: f64,
    /// Triangles that count.
    pub triangles: usize,
    /// All depth maps together, per pixel.
    pub quality: QualityRow,
    /// f_o of all clusters together.
    pub predicted: f64,
    pub real: f64,
    /// Share of what all clusters of the plan are expected to give that these maps reach, as in `status` and `report`.
    pub reached: MeasuredProgress,
    /// Weight that fusion keeps of all clusters with a map, 0 to 1: what the shares below are of.
    pub kept: KeptWeight,
    /// Along the order of the clusters; entry i is after i clusters.
    pub curve: EvaluationCurves,
    /// The curve read at predicted shares of 10, 20, ... 90 %.
    pub gap: Vec<Gap>,
    /// Triangles that are not well done, by reason.
    pub missing: BTreeMap<Missing, usize>,
    /// In the order of the clusters.
    pub key_views: Vec<KeyView>,
    /// Key views whose depth map isn't there; they take no part in anything above.
    pub without_map: Vec<String>,
    /// Key views whose depth map was made with other partners than planned.
    pub other_partners: Vec<String>,
    /// The fused cloud against that of a full run, if both are given.
    pub clouds: Option<CloudComparison>,
    /// The same clusters in other orders; empty unless asked for.
    pub orders: Vec<Order>,
}

#[derive(Clone, Copy, Debug, Serialize)]
pub struct QualityRow {
    /// Right pixels over the reference's.
    pub completeness: f64,
    /// Wrong pixels over those that have both depths; null without a reference.
    pub outliers: Option<f64>,
    /// Over the correct pixels, scene units; null without a reference.
    pub rmse: Option<f64>,
    /// Pixels with a depth.
    pub measured: u64,
    /// Pixels with a reference depth.
    pub reference: u64,
}

impl QualityRow {
    /// `has_reference`: were the depths held against others?
    pub fn new(q: &Quality, has_reference: bool) -> Self {
        Self {
            completeness: q.completeness(),
            outliers: (has_reference && q.both > 0).then(|| q.outliers()),
            rmse: (has_reference && q.right > 0).then(|| q.rmse()),
            measured: q.measured,
            reference: q.reference,
        }
    }

    /// Outliers and RMSE as they are printed; a dash where they were not measured.
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
    /// Weight that fusion keeps, as a share of that of all clusters together.
    pub predicted: Vec<f64>,
    pub real: Vec<f64>,
    /// Real f_o.
    pub fulfilment: Vec<f64>,
    pub pairs: Vec<usize>,
}

/// Prediction against reality where the prediction says that a share is reached.
#[derive(Clone, Debug, Serialize)]
pub struct Gap {
    pub share: f64,
    pub clusters: usize,
    pub pairs: usize,
    pub predicted: f64,
    pub real: f64,
}

#[derive(Clone, Debug, Serialize)]
pub struct KeyView {
    pub name: String,
    pub partners: Vec<String>,
    /// Those of them that the backend really matched.
    pub matched: Vec<String>,
    pub quality: QualityRow,
    /// Sums of f over the triangles that it sees, in triangles.
    pub predicted: f64,
    pub real: f64,
}

/// Inputs of an evaluation beside the measured clusters.
pub struct EvaluationOptions<'a> {
    pub objective: &'a Objective,
    pub so_far: MeasuredProgress,
    pub clouds: Option<CloudComparison>,
    /// True: compares with other orders.
    pub baselines: bool,
}

impl Evaluation {
    /// Outliers and RMSE in words that follow the completeness.
    pub fn errors(&self) -> String {
        let [outliers, rmse] = self.quality.errors();
        let unit = if self.quality.rmse.is_some() { " units" } else { "" };
        format!(", outliers {outliers}, RMSE {rmse}{unit}")
    }

    /// The fewest depth maps of the order that really give 95 and 90 % of what all give, in a sentence.
    pub fn enough_in_words(&self) -> String {
        let maps = self.key_views.len();
        let enough =
            |share: f64| self.curve.real.iter().position(|&real| real >= share - 1e-9).filter(|_| self.kept.real > 0.0);
        match [0.95, 0.9].map(enough) {
            [Some(most), Some(nearly)] if most < maps => format!(
                "You could have stopped after {most} of these {maps} depth maps, which give 95 % of what all of them give; {nearly} give 90 %."
            ),
            [Some(_), Some(nearly)] if nearly < maps => {
                format!("All {maps} depth maps were needed for 95 % of what they give; {nearly} give 90 %.")
            }
            [Some(_), _] => format!("All {maps} depth maps were needed."),
            _ => "These depth maps give nothing that fusion keeps.".into(),
        }
    }

    /// The share that is reached, with what it is of.
    pub fn reached_in_words(&self) -> String {
        let share = self.reached.share.map_or("–".into(), |share| format!("{:.1} %", 100.0 * share));
        format!("{share} of what all depth maps of the plan are expected to give")
    }

    pub fn new(
        model: &Model,
        run: &MeasuredClusters,
        reached: &MeasuredSurface,
        measure: &EvaluationOptions,
        watcher: &dyn Watcher,
    ) -> Result<Self, TableError> {
        let EvaluationOptions { objective, baselines, so_far, .. } = *measure;
        let predicted = ReachCurve::new(&run.predicted, objective, &run.clusters, &run.order);
        let real = run.real_curve(objective, &run.order);
        let names = |views: &[ViewIndex]| views.iter().map(|&v| model.scene.name(v).to_string()).collect();
        let orders = match baselines {
            true => baselines::compare(run, model, objective, watcher)?,
            false => Vec::new(),
        };
        Ok(Self {
            version: 1,
            reference: run.has_reference,
            support: objective.support,
            inside: objective.inside,
            triangles: objective.weights.iter().filter(|&&weight| weight > 0.0).count(),
            quality: QualityRow::new(&run.pooled(), run.has_reference),
            reached: so_far,
            predicted: predicted.total(),
            real: real.total(),
            kept: KeptWeight { predicted: predicted.total_kept(), real: real.total_kept() },
            gap: gaps(&predicted, &real),
            curve: EvaluationCurves {
                predicted: shares(&predicted),
                real: shares(&real),
                fulfilment: real.fulfilment,
                pairs: real.pairs,
            },
            missing: reached.counts(|t| objective.weights[t] > 0.0),
            key_views: run.order.iter().map(|&c| key_view(model, run, c as usize)).collect(),
            without_map: names(&run.without_map),
            other_partners: names(&run.other_partners),
            clouds: measure.clouds.clone(),
            orders,
        })
    }
}

fn shares(curve: &ReachCurve) -> Vec<f64> {
    (0..curve.kept.len()).map(|i| curve.share(i, curve.total_kept())).collect()
}

fn gaps(predicted: &ReachCurve, real: &ReachCurve) -> Vec<Gap> {
    let gap = |share: f64| {
        let clusters = predicted.clusters_for(share * predicted.total_kept())?;
        Some(Gap {
            share,
            clusters,
            pairs: predicted.pairs[clusters],
            predicted: predicted.share(clusters, predicted.total_kept()),
            real: real.share(clusters, real.total_kept()),
        })
    };
    SHARES.iter().filter_map(|&share| gap(share)).collect()
}

fn key_view(model: &Model, run: &MeasuredClusters, cluster: usize) -> KeyView {
    let names = |views: &[ViewIndex]| views.iter().map(|&v| model.scene.name(v).to_string()).collect();
    let sum = |values: &[f32]| values.iter().map(|&f| f64::from(f)).sum();
    KeyView {
        name: model.scene.name(run.clusters[cluster].key).into(),
        partners: names(&run.clusters[cluster].partners),
        matched: names(&run.matched[cluster].partners),
        quality: QualityRow::new(&run.quality[cluster], run.has_reference),
        predicted: sum(run.predicted.row(cluster).1),
        real: sum(run.real.row(cluster).1),
    }
}
