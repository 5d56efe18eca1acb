//! Method 5.5: finds why a view is not chosen, a key view has few partners, or a triangle stays
//! unfulfilled.

use std::borrow::Cow;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::Tables;
use crate::{
    base::column::{self, DiskError},
    method::{
        fulfilment::{self, ByTriangle, Fulfilment, FulfilmentTable, Model},
        partners::Candidates,
        region::Region,
        twins::Twin,
    },
    model::{cluster::ViewCluster, reason::Reason, scene::ViewIndex},
};

/// Role of a registered view in the plan.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "lowercase")]
pub enum ViewStatus {
    /// Gets a depth map.
    Key,
    /// Gets no depth map, but one or more key views are matched against it.
    Partner,
    /// Takes no part.
    Unused,
}

/// A triangle is unfulfilled below this fulfilment.
const FULFILLED: f64 = 0.1;
/// Clusters whose factors are all in memory at a time.
const CLUSTERS_AT_ONCE: usize = 64;
/// A view is a duplicate where one chosen cluster gives at least this share of its fulfilment.
const DUPLICATE: f64 = 0.9;

/// Inputs of the reasons.
pub struct Reasons<'a> {
    model: &'a Model<'a>,
    /// Number of views that see each triangle.
    viewers: &'a [u32],
    candidates: &'a Candidates,
    without_image: &'a [ViewIndex],
    kept_for_tests: &'a [ViewIndex],
    twins: &'a [Twin],
    clusters: &'a [ViewCluster],
    fulfilment: &'a FulfilmentTable,
    region: Option<&'a Region>,
}

impl<'a> Reasons<'a> {
    /// `model`: of the same tables.
    pub fn of(tables: &'a Tables, model: &'a Model<'a>) -> Self {
        Self {
            model,
            viewers: &tables.shown.views,
            candidates: &tables.candidates,
            without_image: &tables.without_image,
            kept_for_tests: &tables.kept_for_tests,
            twins: &tables.twins,
            clusters: &tables.clusters,
            fulfilment: &tables.fulfilment,
            region: tables.region.as_ref(),
        }
    }

    /// Status of each view; with a reason if it is not a key view, or has fewer than k partners.
    pub fn views(
        &self,
        chosen: &[u32],
        k: u32,
    ) -> Result<Vec<(ViewStatus, Option<Reason>)>, DiskError> {
        let status = self.status(chosen);
        let by_triangle =
            ByTriangle::new(self.fulfilment, chosen, self.model.surface.triangles.len())?;
        let reason = |&view: &ViewIndex| match (status[view.index()], self.cluster_of(view)) {
            (ViewStatus::Key, Some(cluster)) => self.few_partners(cluster, k),
            (_, Some(cluster)) => Some(self.not_taken(cluster, &by_triangle)),
            (_, None) => Some(self.no_cluster(view)),
        };
        let all: Vec<ViewIndex> = self.model.scene.view_indices().collect();
        let reasons = column::read_by_parts(&all, reason, || {
            by_triangle.release();
            self.fulfilment.release();
            self.model.release();
        });
        Ok(status.into_iter().zip(reasons).collect())
    }

    /// Returns the role of each view in these clusters: a key view is one even where others have it
    /// for a partner.
    fn status(&self, chosen: &[u32]) -> Vec<ViewStatus> {
        let mut status = vec![ViewStatus::Unused; self.model.scene.views.len()];
        let clusters = || chosen.iter().map(|&c| &self.clusters[c as usize]);
        let partners = clusters().flat_map(|cluster| &cluster.partners);
        partners.for_each(|view| status[view.index()] = ViewStatus::Partner);
        clusters().for_each(|cluster| status[cluster.key.index()] = ViewStatus::Key);
        status
    }

    /// Returns the cluster of a view that can be a key view.
    fn cluster_of(&self, view: ViewIndex) -> Option<usize> {
        let clusters = self.clusters;
        clusters
            .binary_search_by_key(&view, |cluster| cluster.key)
            .ok()
    }

    fn few_partners(&self, cluster: usize, k: u32) -> Option<Reason> {
        let ViewCluster { key, partners } = &self.clusters[cluster];
        // A model of few views has no k others.
        let possible = (k as usize).min(self.model.scene.views.len() - 1);
        (partners.len() < possible).then(|| self.main_refusal(*key))
    }

    /// The most frequent reason why pairs of the view were refused.
    fn main_refusal(&self, view: ViewIndex) -> Reason {
        let rejected = self
            .candidates
            .candidates_of(view)
            .iter()
            .filter(|v| self.model.agreement.rejected.contains(v));
        let refused = self.candidates.refusals[view.index()].reasons();
        most_frequent(refused.chain(rejected.map(|_| Reason::NotMatchable)))
            .unwrap_or(Reason::NoSharedPoints)
    }

    fn is_set_aside(&self, view: ViewIndex) -> bool {
        let place = self.twins.binary_search_by_key(&view, |twin| twin.view);
        place.is_ok()
    }

    fn no_cluster(&self, view: ViewIndex) -> Reason {
        // Reasons that hold whatever the view sees come first.
        if self.without_image.binary_search(&view).is_ok() {
            Reason::NoImage
        } else if self.kept_for_tests.binary_search(&view).is_ok() {
            Reason::KeptForTests
        } else if self.is_set_aside(view) {
            Reason::TwinOfSharperView
        } else if self.model.visibility.triangles_seen_by(view).is_empty() {
            Reason::Hidden
        } else {
            self.main_refusal(view)
        }
    }

    /// Returns the reason why a view with partners is not a key view.
    fn not_taken(&self, cluster: usize, chosen: &ByTriangle) -> Reason {
        let ViewCluster { key, partners } = &self.clusters[cluster];
        let (triangles, values) = self.fulfilment.row(cluster);
        if triangles.is_empty() {
            let failures = self.model.visibility.triangles_seen_by(*key).iter();
            let failures =
                failures.map(|&t| failure(&fulfilment::value(self.model, *key, partners, t)));
            return most_frequent(failures).unwrap_or(Reason::Hidden);
        }
        let (triangles, values) = self.inside(triangles, values);
        let own: f64 = values.iter().map(|&f| f64::from(f)).sum();
        if triangles.is_empty() {
            Reason::OutsideRegion
        } else if chosen.most_by_one(&triangles, &values) >= DUPLICATE * own {
            Reason::DuplicateOfBetterView
        } else {
            Reason::NoGainLeft
        }
    }

    /// The part of a row of the table that is inside the region.
    fn inside<'r>(
        &self,
        triangles: &'r [u32],
        values: &'r [f32],
    ) -> (Cow<'r, [u32]>, Cow<'r, [f32]>) {
        let Some(region) = self.region else {
            return (triangles.into(), values.into());
        };
        let inside = triangles
            .iter()
            .zip(values)
            .filter(|(t, _)| region.is_inside(**t));
        let (triangles, values): (Vec<u32>, Vec<f32>) = inside.unzip();
        (triangles.into(), values.into())
    }

    /// Per triangle, why no cluster fulfils it to 0.1; `None` where one does.
    pub fn triangles(&self) -> Vec<Option<Reason>> {
        let triangles = self.model.surface.triangles.len();
        let mut best = vec![0f32; triangles];
        for (&t, &f) in self
            .fulfilment
            .triangles
            .by_parts()
            .zip(self.fulfilment.values.by_parts())
        {
            best[t as usize] = best[t as usize].max(f);
        }
        let is_fulfilled = |t: usize| f64::from(best[t]) >= FULFILLED;
        let has_few_cameras = |t: usize| self.viewers[t] < self.model.rule.min_cameras;
        // Factors of f are not in the table and slow to compute: only where they give the reason.
        let nearest = self.nearest_to_success(|t| !is_fulfilled(t) && !has_few_cameras(t));
        let reason = |t: usize| match nearest[t] {
            _ if is_fulfilled(t) => None,
            _ if has_few_cameras(t) => Some(Reason::TooFewCameras),
            Some(fulfilment) => Some(failure(&fulfilment)),
            None => Some(Reason::NotMatchable),
        };
        (0..triangles).map(reason).collect()
    }

    /// For each triangle that passes `is_asked`, the factors of the cluster that comes nearest to
    /// fulfilling it; ties go to the first cluster.
    fn nearest_to_success(
        &self,
        is_asked: impl Fn(usize) -> bool + Sync,
    ) -> Vec<Option<Fulfilment>> {
        let of_cluster = |cluster: &ViewCluster| self.factors(cluster, &is_asked);
        let nearness = |f: &Fulfilment| (f.coverage, f.value, f.confidence);
        let mut nearest: Vec<Option<Fulfilment>> = vec![None; self.model.surface.triangles.len()];
        for clusters in self.clusters.chunks(CLUSTERS_AT_ONCE) {
            let found: Vec<Vec<(u32, Fulfilment)>> = clusters.par_iter().map(of_cluster).collect();
            // In the order of the clusters, so that ties go to the first on any number of threads.
            for (t, fulfilment) in found.into_iter().flatten() {
                let held = &mut nearest[t as usize];
                if held
                    .as_ref()
                    .is_none_or(|held| nearness(&fulfilment) > nearness(held))
                {
                    *held = Some(fulfilment);
                }
            }
            self.model.release();
        }
        nearest
    }

    /// Returns the factors of a cluster on the triangles that pass `is_asked`.
    fn factors(
        &self,
        ViewCluster { key, partners }: &ViewCluster,
        is_asked: impl Fn(usize) -> bool,
    ) -> Vec<(u32, Fulfilment)> {
        let seen = self.model.visibility.triangles_seen_by(*key).iter();
        seen.filter(|&&t| is_asked(t as usize))
            .map(|&t| (t, fulfilment::value(self.model, *key, partners, t)))
            .collect()
    }
}

/// The reason that belongs to the smallest factor.
fn failure(fulfilment: &Fulfilment) -> Reason {
    let Fulfilment {
        coverage,
        resolution,
        uncertainty,
        confidence,
        ..
    } = *fulfilment;
    if coverage == 0.0 {
        Reason::TooFewCameras
    } else if confidence <= resolution.min(uncertainty) {
        Reason::NotMatchable
    } else if resolution <= uncertainty {
        Reason::TooCoarse
    } else {
        Reason::TooInaccurate
    }
}

/// The most frequent reason; ties go to the first in the order of [`Reason`].
fn most_frequent(reasons: impl Iterator<Item = Reason>) -> Option<Reason> {
    let mut counts = std::collections::BTreeMap::new();
    reasons.for_each(|reason| *counts.entry(reason).or_insert(0u32) += 1);
    counts
        .into_iter()
        .max_by_key(|&(reason, count)| (count, std::cmp::Reverse(reason)))
        .map(|(reason, _)| reason)
}

/// For each cluster, the clusters ranked before it that give more of its own fulfilment than all
/// before them, by rank: the last one within a cut is the best substitute there.
pub fn best_substitutes(
    table: &FulfilmentTable,
    order: &[u32],
    triangles: usize,
) -> Result<Vec<Vec<Substitute>>, DiskError> {
    let by_triangle = ByTriangle::new(table, order, triangles)?;
    let mut end = vec![order.len(); table.clusters()];
    order
        .iter()
        .enumerate()
        .for_each(|(rank, &cluster)| end[cluster as usize] = rank);
    let of_cluster = |cluster: usize| {
        let (triangles, values) = table.row(cluster);
        let own: f64 = values.iter().map(|&f| f64::from(f)).sum();
        ever_better(
            &by_triangle.given_by_each(triangles, values, end[cluster]),
            own,
        )
    };
    Ok((0..table.clusters())
        .into_par_iter()
        .map(of_cluster)
        .collect())
}

/// Returns the ranks that give more than all before them, of a cluster's `own` fulfilment. `given`:
/// what each rank gives of it.
fn ever_better(given: &[f64], own: f64) -> Vec<Substitute> {
    let mut substitutes = Vec::new();
    let mut most = 0.0;
    for (rank, &given) in given.iter().enumerate() {
        if given > most {
            most = given;
            substitutes.push(Substitute {
                rank,
                share: given / own,
            });
        }
    }
    substitutes
}

/// A cluster ranked before another one, whose fulfilment it partly gives as well.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Substitute {
    /// From 0.
    pub rank: usize,
    /// Share of the other's fulfilment that this one also gives, 0 to 1.
    pub share: f64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_triangle_fails_by_its_smallest_factor() {
        let of = |coverage, resolution, uncertainty, confidence| {
            failure(&Fulfilment {
                coverage,
                resolution,
                uncertainty,
                confidence,
                value: 0.0,
            })
        };
        assert_eq!(of(0.0, 1.0, 1.0, 1.0), Reason::TooFewCameras);
        assert_eq!(of(1.0, 0.1, 0.5, 0.9), Reason::TooCoarse);
        assert_eq!(of(1.0, 0.5, 0.1, 0.9), Reason::TooInaccurate);
        assert_eq!(of(1.0, 0.5, 0.5, 0.0), Reason::NotMatchable);
    }

    #[test]
    fn the_most_frequent_reason_and_the_first_of_equals() {
        use Reason::{Hidden, NotMatchable, RotationOnly};
        assert_eq!(
            most_frequent([Hidden, NotMatchable, Hidden].into_iter()),
            Some(Hidden)
        );
        assert_eq!(
            most_frequent([NotMatchable, RotationOnly].into_iter()),
            Some(RotationOnly)
        );
        assert_eq!(most_frequent([].into_iter()), None);
    }

    #[test]
    fn one_chosen_cluster_makes_a_duplicate() {
        // Clusters 0 and 1 share the triangles of cluster 2; neither covers all of them.
        let table = FulfilmentTable::new([
            [(0, 0.5), (1, 0.5)],
            [(1, 0.9), (2, 0.2)],
            [(1, 0.6), (2, 0.6)],
        ]);
        let chosen = ByTriangle::new(&table, &[0, 1], 3).unwrap();
        let (triangles, values) = table.row(2);
        assert!((chosen.most_by_one(triangles, values) - 0.8).abs() < 1e-6);
        let substitutes = super::best_substitutes(&table, &[0, 1, 2], 3).unwrap();
        let ranks = |of: usize| substitutes[of].iter().map(|l| l.rank).collect::<Vec<_>>();
        assert_eq!(
            [ranks(0), ranks(1), ranks(2)],
            [vec![], vec![0], vec![0, 1]]
        );
        assert!(
            (substitutes[2][0].share - 0.5 / 1.2).abs() < 1e-6
                && (substitutes[2][1].share - 0.8 / 1.2).abs() < 1e-6
        );
    }
}
