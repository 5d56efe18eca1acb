//! Consistency checks of a manifest: people and other programs edit it, and contradictions would
//! reach a backend unnoticed.

use std::collections::BTreeSet;

use super::written::{ClusterEntry, RecordedPlan};
use crate::{backends, base::error::Hint};

/// Tolerance for sums of gains, which other programs round differently.
const ROUNDING: f64 = 1e-6;

/// Returns the first contradiction, with the field that has it.
pub(super) fn check(manifest: &RecordedPlan) -> Result<(), String> {
    let known = |backend: &str| {
        let hint = |e: &crate::config::UnknownBackend| {
            e.hint().map_or(String::new(), |hint| format!(" ({hint})"))
        };
        backends::by_name(backend)
            .map(drop)
            .map_err(|error| format!("{error}{}", hint(&error)))
    };
    known(&manifest.backend).map_err(|what| format!("backend: {what}"))?;
    let matches_pairs =
        backends::by_name(&manifest.backend).is_ok_and(|backend| backend.makes_maps());
    for (i, export) in manifest.exports.iter().enumerate() {
        known(&export.backend).map_err(|what| format!("exports[{i}].backend: {what}"))?;
    }
    manifest
        .settings
        .check()
        .map_err(|what| format!("settings.{what}"))?;
    let names = names(manifest)?;
    check_cut(manifest, matches_pairs)?;
    check_clusters(manifest, &names)
}

/// The names of the views, each once.
fn names(manifest: &RecordedPlan) -> Result<BTreeSet<&str>, String> {
    let mut names = BTreeSet::new();
    for (i, view) in manifest.views.iter().enumerate() {
        if !names.insert(view.name.as_str()) {
            return Err(format!(
                "views[{i}].name: an earlier view is {}, too",
                view.name
            ));
        }
    }
    Ok(names)
}

/// Checks ranks, key views and the rise of the curve.
fn check_clusters(manifest: &RecordedPlan, names: &BTreeSet<&str>) -> Result<(), String> {
    let mut keys = BTreeSet::new();
    let mut previous = Previous {
        fulfilment: 0.0,
        share: 0.0,
        // Finished clusters come first, so the first one may be finished.
        finished: true,
    };
    for (i, cluster) in manifest.clusters.iter().enumerate() {
        let fault = |what: String| format!("clusters[{i}].{what}");
        if cluster.rank != i as i64 + 1 {
            return Err(fault(format!(
                "rank: {} instead of {}",
                cluster.rank,
                i + 1
            )));
        }
        if !keys.insert(cluster.key.as_str()) {
            return Err(fault(format!(
                "key: an earlier cluster has the key view {}, too",
                cluster.key
            )));
        }
        check_views(cluster, names)
            .and_then(|()| previous.check(cluster))
            .map_err(fault)?;
        previous = Previous {
            fulfilment: cluster.fulfilment,
            share: cluster.share,
            finished: cluster.finished,
        };
    }
    Ok(())
}

/// `matches_pairs`: false for a program that uses the images themselves.
fn check_cut(manifest: &RecordedPlan, matches_pairs: bool) -> Result<(), String> {
    let (cut, all) = (&manifest.cut, manifest.clusters.len());
    if cut.clusters > all {
        return Err(format!(
            "cut.clusters: {}, but the ranking has {all}",
            cut.clusters
        ));
    }
    let pairs: usize = manifest.clusters[..cut.clusters]
        .iter()
        .map(|cluster| cluster.partners.len())
        .sum();
    if !matches_pairs && cut.pairs > 0 {
        // The shares of such a plan are those of depth maps, too.
        return Err(format!(
            "cut.pairs: {}, but {} matches none; another version of viewrank ranked for it",
            cut.pairs, manifest.backend
        ));
    }
    if matches_pairs && cut.pairs != pairs {
        return Err(format!(
            "cut.pairs: {}, but its clusters have {pairs}",
            cut.pairs
        ));
    }
    let shares = [
        ("share", cut.share),
        ("kept", cut.kept),
        ("reachable", cut.reachable),
        ("fulfilment", cut.fulfilment),
        ("fulfilment_bound", cut.fulfilment_bound),
    ];
    shares.into_iter().try_for_each(|(name, value)| {
        check_share(value).map_err(|what| format!("cut.{name}: {what}"))
    })
}

/// Checks that key and partners are views of the model, each at most once.
fn check_views(cluster: &ClusterEntry, names: &BTreeSet<&str>) -> Result<(), String> {
    let mut seen = BTreeSet::from([cluster.key.as_str()]);
    if !names.contains(cluster.key.as_str()) {
        return Err(format!("key: no view is {}", cluster.key));
    }
    for partner in cluster.partners.iter() {
        if !names.contains(partner) {
            return Err(format!("partners: no view is {partner}"));
        }
        if partner == cluster.key {
            return Err(format!(
                "partners: the key view {partner} is its own partner"
            ));
        }
        if !seen.insert(partner) {
            return Err(format!("partners: {partner} is in the list twice"));
        }
    }
    Ok(())
}

/// Numbers of the previous cluster in the ranking.
struct Previous {
    fulfilment: f64,
    share: f64,
    finished: bool,
}

impl Previous {
    fn check(&self, cluster: &ClusterEntry) -> Result<(), String> {
        let ClusterEntry {
            gain,
            fulfilment,
            share,
            finished,
            ..
        } = cluster;
        for (name, value) in [("gain", gain), ("fulfilment", fulfilment), ("share", share)] {
            check_share(*value).map_err(|what| format!("{name}: {what}"))?;
        }
        if (self.fulfilment + gain - fulfilment).abs() > ROUNDING {
            return Err(format!(
                "fulfilment: {fulfilment}, but {} of the cluster before and the gain add up to {}",
                self.fulfilment,
                self.fulfilment + gain
            ));
        }
        if *share < self.share - ROUNDING {
            return Err(format!(
                "share: {share} is less than {} of the cluster before",
                self.share
            ));
        }
        if *finished && !self.finished {
            return Err("finished: true, but the cluster before is not finished".into());
        }
        Ok(())
    }
}

fn check_share(value: f64) -> Result<(), String> {
    let is_share = (-ROUNDING..=1.0 + ROUNDING).contains(&value);
    if is_share {
        Ok(())
    } else {
        Err(format!("{value} is not within 0 to 1"))
    }
}
