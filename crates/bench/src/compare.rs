//! The same key views with the partners of other rules: the clusters to match, and the results once
//! matched (method 8).

use std::{error::Error, path::Path};

use serde::Serialize;
use viewrank::{
    NoWatcher, Plan,
    config::PartnerSettings,
    evaluate::{
        EvaluationInput, MeasuredClusters, Quality, QualityRow, clusters, curve::ReachCurve, orders,
    },
};
use viewrank_core::{
    base::column::TableError,
    method::{confidence::Confidence, partners},
    model::{cluster::ViewCluster, scene::ViewIndex},
};
use walkdir::WalkDir;

use crate::rules::RULES;

/// View clusters that one rule chose, in the order in which they are to be computed.
pub struct RuleClusters {
    pub rule: String,
    pub clusters: Vec<ViewCluster>,
}

/// Returns each rule's clusters of k partners for the key views of the plan: `ours` and `ours-nocp`
/// in their own order, the others in the order of `maxpts`.
pub fn choices(plan: &Plan, k: u32) -> Result<Vec<RuleClusters>, TableError> {
    let model = plan.stages.model();
    let mut certain = model;
    certain.rule.confidence = Confidence::None;
    let settings = PartnerSettings {
        k,
        ..plan.stages.settings.partners.clone()
    };
    let mut choices = Vec::new();
    let mut add = |rule: &str, clusters: &[ViewCluster], order: &[u32]| {
        choices.push(RuleClusters {
            rule: rule.into(),
            clusters: order
                .iter()
                .map(|&c| clusters[c as usize].clone())
                .collect(),
        });
    };
    for (rule, model) in [("ours", &model), ("ours-nocp", &certain)] {
        let (clusters, table) = partners::choose(
            model,
            &plan.stages.candidates,
            &settings,
            plan.stages.settings.seed,
            &NoWatcher,
        )?;
        let order = orders::greedy(&table, &plan.stages.objective, &NoWatcher)?;
        add(rule, &clusters, &order);
    }
    let keys: Vec<ViewIndex> = plan.stages.clusters.iter().map(|c| c.key).collect();
    for rule in RULES {
        let clusters = rule.clusters(&plan.stages.scene, &keys, k as usize);
        let order = orders::max_points(&plan.stages.scene, &clusters);
        add(rule.name, &clusters, &order);
    }
    Ok(choices)
}

impl RuleClusters {
    /// Returns the contents of the choice's `clusters.txt`.
    pub fn text(&self, plan: &Plan) -> String {
        clusters::write(&self.clusters, &plan.stages.scene)
    }
}

/// Results of one matched choice, compared with the others.
#[derive(Clone, Debug, Serialize)]
pub struct Comparison {
    pub name: String,
    pub clusters: usize,
    pub pairs: usize,
    /// Quality over the reference pixels of all key views that any of the choices has.
    pub quality: QualityRow,
    /// f_o of all clusters.
    pub predicted: f64,
    pub real: f64,
    /// Measured curve of the choice in its own order.
    pub curve: ReachCurve,
    /// Measured curve in the greedy order on the measured fulfilment.
    pub optimum: ReachCurve,
}

/// Compares the choices in a folder and those below it: each has a `clusters.txt` with the depth
/// maps of its clusters beside it.
pub fn in_folders(
    plan: &Plan,
    folder: &Path,
    reference: Option<&Path>,
) -> Result<Vec<Comparison>, Box<dyn Error>> {
    let mut runs = Vec::new();
    // Sorted, so that the table has the same order on every disk.
    for entry in WalkDir::new(folder).sort_by_file_name() {
        let entry = entry?;
        let Some(choice) = entry
            .path()
            .parent()
            .filter(|_| entry.file_name() == "clusters.txt")
        else {
            continue;
        };
        let clusters = clusters::read(entry.path(), &plan.stages.scene)?;
        let input = EvaluationInput::new(&plan.stages, &clusters, choice, reference);
        let name = choice.strip_prefix(folder).unwrap_or(choice);
        runs.push((
            name.to_string_lossy().into_owned(),
            MeasuredClusters::new(&input, &NoWatcher)?,
        ));
    }
    if runs.is_empty() {
        return Err(format!("no clusters.txt in {} or its folders", folder.display()).into());
    }
    Ok(compare(plan, &runs)?)
}

/// Compares the measured runs of several choices, each with its name.
fn compare(
    plan: &Plan,
    runs: &[(String, MeasuredClusters)],
) -> Result<Vec<Comparison>, TableError> {
    let objective = &plan.stages.objective;
    // A view without partners has no map: all pixels of its reference count as missing.
    let mut reference = vec![0; plan.stages.scene.views.len()];
    for (_, run) in runs {
        for (cluster, quality) in run.clusters.iter().zip(&run.quality) {
            reference[cluster.key.index()] = reference[cluster.key.index()].max(quality.reference);
        }
    }
    let one = |(name, run): &(String, MeasuredClusters)| {
        let predicted = ReachCurve::new(&run.predicted, objective, &run.clusters, &run.order);
        let curve = run.real_curve(objective, &run.order);
        let best = orders::greedy(&run.real, objective, &NoWatcher)?;
        let quality = Quality {
            reference: reference.iter().sum(),
            ..run.pooled()
        };
        Ok(Comparison {
            name: name.clone(),
            clusters: run.clusters.len(),
            pairs: curve.pairs.last().copied().unwrap_or(0),
            quality: QualityRow::new(&quality, run.has_reference),
            predicted: predicted.total(),
            real: curve.total(),
            curve,
            optimum: run.real_curve(objective, &best),
        })
    };
    runs.iter().map(one).collect()
}

/// The results as text, a line for each choice.
pub fn table(compared: &[Comparison]) -> String {
    let mut lines = vec![format!(
        "{:17} {:>9} {:>7} {:>13} {:>9} {:>9} {:>10}",
        "clusters of", "key views", "pairs", "completeness", "outliers", "RMSE", "real f_o"
    )];
    for row in compared {
        let [outliers, rmse] = row.quality.errors();
        lines.push(format!(
            "{:17} {:9} {:7} {:11.2} % {outliers:>9} {rmse:>9} {:10.4}",
            row.name,
            row.clusters,
            row.pairs,
            100.0 * row.quality.completeness,
            row.real
        ));
    }
    lines.join("\n") + "\n"
}
