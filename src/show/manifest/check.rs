//! Consistency checks of a manifest: people and other programs edit it, and contradictions would reach a backend unnoticed.

use std::collections::BTreeSet;

use super::written::{ClusterEntry, Recorded};
use crate::{backends, base::error::Hint};

/// Tolerance for sums of gains, which other programs round differently.
const ROUNDING: f64 = 1e-6;

/// Returns the first contradiction and the cluster that has it.
pub(super) fn check(manifest: &Recorded) -> Result<(), String> {
    let known = |backend: &str| {
        let hint = |e: &crate::config::UnknownBackend| e.hint().map_or(String::new(), |hint| format!(" ({hint})"));
        backends::by_name(backend).map(drop).map_err(|error| format!("{error}{}", hint(&error)))
    };
    known(&manifest.backend)?;
    manifest.exports.iter().try_for_each(|export| known(&export.backend))?;
    let names: BTreeSet<&str> = manifest.views.iter().map(|view| view.name.as_str()).collect();
    if names.len() < manifest.views.len() {
        return Err("the views list a name twice".into());
    }
    check_cut(manifest)?;
    let mut keys = BTreeSet::new();
    let mut previous = Previous { fulfilment: 0.0, share: 0.0, finished: true };
    for (i, cluster) in manifest.clusters.iter().enumerate() {
        let fault = |what: String| format!("cluster {} ({}): {what}", i + 1, cluster.key);
        if cluster.rank != i as i64 + 1 {
            return Err(fault(format!("its rank is {}", cluster.rank)));
        }
        if !keys.insert(cluster.key.as_str()) {
            return Err(fault("it is the key view of an earlier cluster".into()));
        }
        check_views(cluster, &names).and_then(|()| previous.check(cluster)).map_err(fault)?;
        previous = Previous { fulfilment: cluster.fulfilment, share: cluster.share, finished: cluster.finished };
    }
    Ok(())
}

fn check_cut(manifest: &Recorded) -> Result<(), String> {
    let (cut, all) = (&manifest.cut, manifest.clusters.len());
    if cut.clusters > all {
        return Err(format!("the cut has {} clusters, the ranking {all}", cut.clusters));
    }
    let pairs: usize = manifest.clusters[..cut.clusters].iter().map(|cluster| cluster.partners.len()).sum();
    if cut.pairs != pairs {
        return Err(format!("the cut has {} pairs, its clusters {pairs}", cut.pairs));
    }
    let shares = [("share", cut.share), ("fulfilment", cut.fulfilment)];
    let outside = shares.into_iter().find(|(_, value)| !is_share(*value));
    outside.map_or(Ok(()), |(name, value)| Err(format!("the {name} of the cut is {value}, not within 0 to 1")))
}

/// Checks that key and partners are views of the model, each at most once.
fn check_views(cluster: &ClusterEntry, names: &BTreeSet<&str>) -> Result<(), String> {
    let mut seen = BTreeSet::from([cluster.key.as_str()]);
    if !names.contains(cluster.key.as_str()) {
        return Err("no view has this name".into());
    }
    for partner in &cluster.partners {
        if !names.contains(partner.as_str()) {
            return Err(format!("no view has the name of its partner {partner}"));
        }
        if *partner == cluster.key {
            return Err("it is its own partner".into());
        }
        if !seen.insert(partner) {
            return Err(format!("it lists the partner {partner} twice"));
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
        let ClusterEntry { gain, fulfilment, share, finished, .. } = cluster;
        for (name, value) in [("gain", gain), ("fulfilment", fulfilment), ("share", share)] {
            if !is_share(*value) {
                return Err(format!("its {name} is {value}, not within 0 to 1"));
            }
        }
        if (self.fulfilment + gain - fulfilment).abs() > ROUNDING {
            return Err(format!(
                "its fulfilment is {fulfilment}, but {} of the cluster before and its gain add up to {}",
                self.fulfilment,
                self.fulfilment + gain
            ));
        }
        if *share < self.share - ROUNDING {
            return Err(format!("its share is {share}, less than {} of the cluster before", self.share));
        }
        if *finished && !self.finished {
            return Err("it is finished, but the cluster before is not".into());
        }
        Ok(())
    }
}

fn is_share(value: f64) -> bool {
    (-ROUNDING..=1.0 + ROUNDING).contains(&value)
}
