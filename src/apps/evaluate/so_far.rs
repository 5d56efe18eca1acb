//! The single definition of the share reached, with its denominator (method 8).

use serde::Serialize;

use super::run::MeasuredClusters;
use crate::{
    decision::CountedPlaces,
    method::{
        pilot::Part,
        ranking::{Beliefs, Reached},
    },
    model::{cluster::MapScale, scene::ViewIndex},
    plan::Stages,
};

/// Maps that the pilot's word counts as much as, at each place.
const PRIOR_MAPS: f32 = 0.3;

/// Measured weight that fusion keeps of the finished depth maps, over the weight that it is
/// expected to keep of all.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct MeasuredProgress {
    /// Weight that fusion keeps of the finished maps, 0 to 1.
    pub kept: f64,
    /// Weight that fusion keeps of all clusters of the plan at full size, 0 to 1: measured if
    /// finished, else as the pilot shows it (method 5.9) or predicted in the light of failures (5.4).
    pub reachable: f64,
    /// `kept` over `reachable`; null where nothing can be kept.
    pub share: Option<f64>,
}

impl MeasuredProgress {
    /// Computes the progress. `stages`: those of the plan that the run's clusters belong to.
    pub fn new(stages: &Stages, run: &MeasuredClusters) -> Self {
        if let Some(pilot) = &stages.pilot {
            return Self::by_places(stages, pilot, run);
        }
        let mut beliefs = Beliefs::new(
            &stages.scene,
            &stages.surface,
            &stages.clusters,
            &stages.fulfilment,
        );
        let finished = run.clusters.iter().zip(&run.attempts);
        finished.for_each(|(cluster, attempts)| beliefs.learn(cluster.key, attempts));
        let (mut so_far, mut all) = (
            Reached::new(&stages.objective),
            Reached::new(&stages.objective),
        );
        for (finished, cluster) in run.clusters.iter().enumerate() {
            so_far.take(run.real.row(finished));
            // At full size, also where the map has half of it.
            let (triangles, believed) = planned(stages, cluster.key)
                .map(|c| beliefs.row(c))
                .unwrap_or_default();
            let (triangles, values) = run.at_full_size(finished, (triangles, &believed));
            all.take((&triangles, &values));
        }
        for (c, cluster) in stages.clusters.iter().enumerate() {
            if run.finished(cluster.key).is_none() {
                let (triangles, believed) = beliefs.row(c);
                all.take((triangles, &believed));
            }
        }
        Self::of(&so_far, &all)
    }

    /// Computes the progress by the places of the pilot: measured where a map is finished, else as
    /// the pilot shows them.
    fn by_places(stages: &Stages, pilot: &CountedPlaces, run: &MeasuredClusters) -> Self {
        let mut all = Reached::new(&pilot.kept.objective);
        let mut kept = Reached::new(&pilot.kept.objective);
        let mut beliefs = PlaceBeliefs::new(pilot.kept.objective.weights.len());
        for (finished, cluster) in run.clusters.iter().enumerate() {
            let size = run.scales[finished];
            let real = run.real.row(finished);
            let row = |places: &[Part], size| -> (Vec<u32>, Vec<f32>) {
                pilot.kept_row(places, size, real).into_iter().unzip()
            };
            let measured = row(&run.places[finished], size);
            kept.take((&measured.0, &measured.1));
            let shown = match size {
                MapScale::Full => Some(&pilot.kept.table),
                MapScale::Half => pilot.kept.half.as_ref(),
            };
            if let Some((c, shown)) = planned(stages, cluster.key).zip(shown) {
                beliefs.learn(shown.row(c), (&measured.0, &measured.1));
            }
            // At full size a map at half the size would give what the pilot shows.
            let at_full = match size {
                MapScale::Full => measured,
                MapScale::Half => row(pilot.places.of_view(cluster.key), MapScale::Full),
            };
            all.take((&at_full.0, &at_full.1));
        }
        for (c, cluster) in stages.clusters.iter().enumerate() {
            if run.finished(cluster.key).is_none() {
                let (places, values) = pilot.kept.table.row(c);
                all.take((places, &beliefs.believed(places, values)));
            }
        }
        Self::of(&kept, &all)
    }

    fn of(so_far: &Reached, all: &Reached) -> Self {
        let (kept, reachable) = (so_far.kept_weight(), all.kept_weight());
        Self {
            kept,
            reachable,
            share: (reachable > 0.0).then(|| kept / reachable),
        }
    }
}

/// Returns the plan's cluster with this key view; `None` if there is none.
fn planned(stages: &Stages, key: ViewIndex) -> Option<usize> {
    let clusters = &stages.clusters;
    clusters
        .binary_search_by_key(&key, |cluster| cluster.key)
        .ok()
}

/// Expectation of further maps by place, in the light of the finished ones: where these gave less
/// than the pilot had shown, others will, too.
struct PlaceBeliefs {
    /// Sums over the finished maps, by place.
    predicted: Vec<f32>,
    measured: Vec<f32>,
}

impl PlaceBeliefs {
    fn new(places: usize) -> Self {
        Self {
            predicted: vec![0.0; places],
            measured: vec![0.0; places],
        }
    }

    /// Learns from a finished map: rows of places and of what fusion keeps there.
    fn learn(&mut self, predicted: (&[u32], &[f32]), measured: (&[u32], &[f32])) {
        let add = |sums: &mut [f32], (places, values): (&[u32], &[f32])| {
            let values = places.iter().zip(values);
            values.for_each(|(&place, &value)| sums[place as usize] += value);
        };
        add(&mut self.predicted, predicted);
        add(&mut self.measured, measured);
    }

    /// Returns what is left of the predicted values of a map at these places.
    fn believed(&self, places: &[u32], values: &[f32]) -> Vec<f32> {
        let share = |place: u32| {
            let [measured, predicted] =
                [&self.measured, &self.predicted].map(|sums| sums[place as usize] + PRIOR_MAPS);
            (measured / predicted).min(1.0)
        };
        let believed = |(&place, &value): (&u32, &f32)| value * share(place);
        places.iter().zip(values).map(believed).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_where_maps_failed_count_less_for_others() {
        let mut beliefs = PlaceBeliefs::new(3);
        let believed = |beliefs: &PlaceBeliefs| beliefs.believed(&[0, 1, 2], &[0.5; 3]);
        assert_eq!(believed(&beliefs), [0.5; 3]);
        for _ in 0..3 {
            beliefs.learn((&[0, 1], &[0.5, 0.5]), (&[0], &[0.9]));
        }
        let [better, failed, unseen] = believed(&beliefs)[..] else {
            panic!("three places")
        };
        // More than was shown makes no place better than the pilot says.
        assert_eq!([better, unseen], [0.5, 0.5]);
        assert!((failed - 0.5 * PRIOR_MAPS / (PRIOR_MAPS + 1.5)).abs() < 1e-6);
    }
}
