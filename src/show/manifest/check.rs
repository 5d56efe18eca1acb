//! Is a manifest one that viewrank could have written? People and other programs edit it, and what contradicts itself would be handed
//! to a backend without a word.

use std::collections::BTreeSet;

use super::written::{ClusterEntry, Recorded};
use crate::{backends, base::error::Hint};

/// Sums of gains are rounded differently by other programs.
const ROUNDING: f64 = 1e-6;

/// The first fault, with the cluster that has it.
pub(super) fn check(manifest: &Recorded) -> Result<(), String> {
    let known = |backend: &str| {
        let hint = |e: &crate::config::UnknownBackend| e.hint().map_or(String::new(), |hint| format!(" ({hint})"));
        backends::by_name(backend).map(drop).map_err(|error| format!("{error}{}", hint(&error)))
    };
    known(&manifest.backend)?;
    manifest.exports.iter().try_for_each(|export| known(&export.backend))?;
    let names: BTreeSet<&str> = manifest.views.iter().map(|view| view.name.as_str()).collect();
    if names.len() < manifest.views.len() {
        return Err("a view is listed twice".into());
    }
    check_cut(manifest)?;
    let mut keys = BTreeSet::new();
    let mut before = Before { fulfilment: 0.0, share: 0.0, finished: true };
    for (i, cluster) in manifest.clusters.iter().enumerate() {
        let fault = |what: String| format!("cluster {} ({}): {what}", i + 1, cluster.key);
        if cluster.rank != i as i64 + 1 {
            return Err(fault(format!("its rank is {}", cluster.rank)));
        }
        if !keys.insert(cluster.key.as_str()) {
            return Err(fault("it is a key view of an earlier cluster already".into()));
        }
        check_views(cluster, &names).and_then(|()| before.check(cluster)).map_err(fault)?;
        before = Before { fulfilment: cluster.fulfilment, share: cluster.share, finished: cluster.finished };
    }
    Ok(())
}

fn check_cut(manifest: &Recorded) -> Result<(), String> {
    let (cut, all) = (&manifest.cut, manifest.clusters.len());
    if cut.clusters > all {
        return Err(format!("the cut takes {} of {all} clusters", cut.clusters));
    }
    let pairs: usize = manifest.clusters[..cut.clusters].iter().map(|cluster| cluster.partners.len()).sum();
    if cut.pairs != pairs {
        return Err(format!("the cut counts {} pairs, its clusters have {pairs}", cut.pairs));
    }
    let shares = [("share", cut.share), ("fulfilment", cut.fulfilment)];
    let outside = shares.into_iter().find(|(_, value)| !is_share(*value));
    outside.map_or(Ok(()), |(name, value)| Err(format!("the cut has a {name} of {value}, not from 0 to 1")))
}

/// Are key and partners views of the model, each once?
fn check_views(cluster: &ClusterEntry, names: &BTreeSet<&str>) -> Result<(), String> {
    let mut seen = BTreeSet::from([cluster.key.as_str()]);
    if !names.contains(cluster.key.as_str()) {
        return Err("no view is called so".into());
    }
    for partner in &cluster.partners {
        if !names.contains(partner.as_str()) {
            return Err(format!("no view is called {partner}, as a partner is"));
        }
        if *partner == cluster.key {
            return Err("it is its own partner".into());
        }
        if !seen.insert(partner) {
            return Err(format!("{partner} is a partner twice"));
        }
    }
    Ok(())
}

/// What the cluster before says.
struct Before {
    fulfilment: f64,
    share: f64,
    finished: bool,
}

impl Before {
    fn check(&self, cluster: &ClusterEntry) -> Result<(), String> {
        let ClusterEntry { gain, fulfilment, share, finished, .. } = cluster;
        for (name, value) in [("gain", gain), ("fulfilment", fulfilment), ("share", share)] {
            if !is_share(*value) {
                return Err(format!("its {name} is {value}, not from 0 to 1"));
            }
        }
        if (self.fulfilment + gain - fulfilment).abs() > ROUNDING {
            return Err(format!(
                "its fulfilment is {fulfilment}, but {} before it and its gain give {}",
                self.fulfilment,
                self.fulfilment + gain
            ));
        }
        if *share < self.share - ROUNDING {
            return Err(format!("its share is {share}, less than {} before it", self.share));
        }
        if *finished && !self.finished {
            return Err("it is finished and comes behind one that isn't".into());
        }
        Ok(())
    }
}

fn is_share(value: f64) -> bool {
    (-ROUNDING..=1.0 + ROUNDING).contains(&value)
}
