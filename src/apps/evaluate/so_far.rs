//! The single definition of the share reached, with its denominator (method 8).

use std::collections::BTreeMap;

use serde::Serialize;

use super::run::MeasuredClusters;
use crate::{
    decision::CountedPlaces,
    method::ranking::{Beliefs, Objective, Reached},
    model::{cluster::MapScale, scene::ViewIndex},
    plan::Stages,
};

/// Measured weight that fusion keeps of the finished depth maps, over the weight that it is
/// expected to keep of all.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct MeasuredProgress {
    /// Weight that fusion keeps of the finished maps, 0 to 1.
    pub kept: f64,
    /// Weight that fusion keeps of all clusters of the plan at full size, 0 to 1: measured if
    /// finished, else as the pilot shows it (method 5.9) or predicted in the light of failures
    /// (5.4).
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

    /// Computes the progress by the places of the pilot: measured where a map is finished. What the
    /// others add is what the pilot shows, as far as the finished maps bear it out.
    fn by_places(stages: &Stages, pilot: &CountedPlaces, run: &MeasuredClusters) -> Self {
        let objective = pilot.measured();
        let (mut kept, mut shown) = (Reached::new(&objective), Reached::new(&objective));
        let chance = (0..objective.weights.len() as u32).map(|item| pilot.chance(item));
        let mut record = PlaceRecord::new(&objective, chance.collect());
        for (finished, cluster) in run.clusters.iter().enumerate() {
            let size = run.scales[finished];
            let real = run.real.row(finished);
            let row = pilot.kept_row(&run.places[finished], size, real);
            let measured: (Vec<u32>, Vec<f32>) = row.into_iter().unzip();
            kept.take((&measured.0, &measured.1));
            let of_size = match size {
                MapScale::Full => Some(&pilot.kept.table),
                MapScale::Half => pilot.kept.half.as_ref(),
            };
            let expected = planned(stages, cluster.key).zip(of_size);
            let expected = expected.map_or(&[][..], |(c, table)| table.row(c).0);
            let surely_kept = pilot.surely_kept(&run.places[finished], real.0);
            record.add(expected, &surely_kept);
        }
        for (c, cluster) in stages.clusters.iter().enumerate() {
            let row = pilot.kept.table.row(c);
            shown.take(row);
            // A map at half the size may still be made at full size, which is what all would have.
            if !matches!(run.finished(cluster.key), Some((MapScale::Full, _))) {
                row.0
                    .iter()
                    .for_each(|&place| record.further[place as usize] += 1);
            }
        }
        record.progress(&kept, &shown)
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

/// Returns the index of this key view's cluster in the plan, if it has one.
fn planned(stages: &Stages, key: ViewIndex) -> Option<usize> {
    let clusters = &stages.clusters;
    clusters
        .binary_search_by_key(&key, |cluster| cluster.key)
        .ok()
}

/// For each place and triangle, the number of finished maps in which the pilot expects it, how many
/// of these keep it, and in how many of the maps to come the pilot expects it.
///
/// Maps keep a place with a probability that differs from place to place: a white wall fails in
/// every map, a blurred edge in some. The probability is taken as beta distributed over the places;
/// mean and spread come from the finished maps, and their results at a place update it there (a
/// beta-binomial model). What a single map of the pilot shows has a distribution of its own: most
/// of it is chance.
struct PlaceRecord<'a> {
    objective: &'a Objective,
    /// Probability that fusion keeps anything there, before any map is finished.
    chance: Vec<f64>,
    maps: u32,
    /// Finished maps of which the pilot shows it, those of them that kept it, and all that did.
    tried: Vec<u32>,
    kept: Vec<u32>,
    taking_part: Vec<u32>,
    /// Maps to come of which the pilot shows it.
    further: Vec<u32>,
}

/// Numbers of trials that the mean counts as at each place, of which the likeliest is taken.
const TRIALS: [f64; 7] = [0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0];

impl<'a> PlaceRecord<'a> {
    fn new(objective: &'a Objective, chance: Vec<f64>) -> Self {
        let none = vec![0; objective.weights.len()];
        Self {
            objective,
            chance,
            maps: 0,
            tried: none.clone(),
            kept: none.clone(),
            taking_part: none.clone(),
            further: none,
        }
    }

    /// Adds a finished map: what the pilot shows of it, and what it kept, both ascending.
    fn add(&mut self, shown: &[u32], kept: &[u32]) {
        self.maps += 1;
        kept.iter()
            .for_each(|&place| self.taking_part[place as usize] += 1);
        for &place in shown {
            self.tried[place as usize] += 1;
            self.kept[place as usize] += u32::from(kept.binary_search(&place).is_ok());
        }
    }

    fn progress(&self, kept: &Reached, shown: &Reached) -> MeasuredProgress {
        let mut chances = self.chance.clone();
        chances.sort_by(f64::total_cmp);
        chances.dedup();
        let distributions: Vec<_> = chances.iter().map(|&of| self.distribution(of)).collect();
        let (mut so_far, mut all) = (0.0, 0.0);
        for place in 0..self.objective.weights.len() {
            let weight = self.objective.weights[place];
            let measured = f64::from(kept.agreed(place as u32));
            // Finished maps may keep more of a place than the pilot shows.
            let left = (f64::from(shown.agreed(place as u32)) - measured).max(0.0);
            so_far += weight * measured;
            all += weight * measured;
            // Both are copies of one number, so equality is exact.
            let own = chances.iter().position(|of| *of == self.chance[place]);
            if let Some(own) = own.filter(|_| left > 0.0) {
                all += weight * left * self.completed(place, distributions[own]);
            }
        }
        MeasuredProgress {
            kept: so_far,
            reachable: all,
            share: (all > 0.0).then(|| so_far / all),
        }
    }

    /// Returns the probability that enough of the further maps keep a place.
    fn completed(&self, place: usize, [mean, trials]: [f64; 2]) -> f64 {
        let further = self.further[place];
        // Where enough maps took part, yet keep less than the pilot shows, it takes one more.
        let wanted = (self.objective.support)
            .saturating_sub(self.taking_part[place])
            .max(1);
        let kept = f64::from(self.kept[place]);
        let alpha = mean * trials + kept;
        let beta = (1.0 - mean) * trials + f64::from(self.tried[place]) - kept;
        at_least(wanted, further, alpha, beta)
    }

    /// Returns the mean probability of the places of this chance, and the number of trials that it
    /// counts as: those under which the record is likeliest.
    fn distribution(&self, chance: f64) -> [f64; 2] {
        let own = (0..self.chance.len()).filter(|&place| self.chance[place] == chance);
        let mut counts: BTreeMap<[u32; 2], f64> = BTreeMap::new();
        for place in own {
            let record = [self.kept[place], self.tried[place]];
            *counts.entry(record).or_default() += 1.0;
        }
        let sum = |of: usize| -> f64 { counts.iter().map(|(r, n)| f64::from(r[of]) * n).sum() };
        let (kept, tried) = (sum(0), sum(1));
        // As if half a map more had kept what it could, so that not all is lost if none has.
        let before = (0.5 * tried / f64::from(self.maps.max(1))).max(1.0);
        let mean = (kept + chance * before) / (tried + before);
        // A place tried once has the same likelihood whatever the number of trials.
        counts.retain(|[_, tried], _| *tried > 1);
        let likelihood = |trials: f64| -> f64 {
            let [alpha, beta] = [mean * trials, (1.0 - mean) * trials];
            let of_record = |(&[kept, tried], number): (&[u32; 2], &f64)| {
                let rising = |from: f64, count: u32| -> f64 {
                    (0..count).map(|i| (from + f64::from(i)).ln()).sum()
                };
                let log = rising(alpha, kept) + rising(beta, tried - kept) - rising(trials, tried);
                number * log
            };
            counts.iter().map(of_record).sum()
        };
        let rated = TRIALS.map(|trials| (likelihood(trials), trials));
        let best = rated.into_iter().max_by(|a, b| a.0.total_cmp(&b.0));
        [mean, best.map_or(1.0, |(_, trials)| trials)]
    }
}

/// Returns the probability of at least `wanted` successes among `number` trials whose common
/// probability has a beta distribution.
fn at_least(wanted: u32, number: u32, alpha: f64, beta: f64) -> f64 {
    if wanted > number {
        return 0.0;
    }
    // P(k) from k = 0 on; each follows from the one before.
    let (n, mut fewer) = (f64::from(number), 0.0);
    let mut of_k: f64 = (0..number)
        .map(|i| (beta + f64::from(i)) / (alpha + beta + f64::from(i)))
        .product();
    for k in 0..wanted {
        fewer += of_k;
        let k = f64::from(k);
        let next = (n - k) / (k + 1.0) * (alpha + k) / (beta + n - k - 1.0);
        of_k *= next;
    }
    (1.0 - fewer).clamp(0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn probabilities_are_those_of_counting() {
        // With a flat distribution every number of successes is as likely.
        for (wanted, number) in [(1, 1), (1, 4), (2, 4), (4, 4)] {
            let counted = f64::from(number + 1 - wanted) / f64::from(number + 1);
            assert!((at_least(wanted, number, 1.0, 1.0) - counted).abs() < 1e-12);
        }
        assert_eq!(at_least(2, 1, 5.0, 1.0), 0.0);
        // Nearly certain knowledge: independent trials.
        assert!((at_least(1, 3, 0.5e9, 0.5e9) - 0.875).abs() < 1e-6);
    }

    #[test]
    fn where_maps_failed_others_are_expected_to() {
        let objective = Objective::weighing(vec![1.0; 4], 1);
        let mut record = PlaceRecord::new(&objective, vec![1.0; 4]);
        for _ in 0..4 {
            record.add(&[0, 1, 2], &[0, 2]);
        }
        record.further = vec![2; 4];
        let of_all = record.distribution(1.0);
        let expected: Vec<f64> = (0..4).map(|p| record.completed(p, of_all)).collect();
        assert!(expected[0] > 0.9 && expected[1] < 0.3, "{expected:?}");
        assert!(expected[1] < expected[3] && expected[3] < expected[0]);
        // All alike: what failed once fails no more often than others.
        let mut alike = PlaceRecord::new(&objective, vec![1.0; 4]);
        for missing in 0..4u32 {
            let kept: Vec<u32> = (0..4).filter(|place| *place != missing).collect();
            alike.add(&[0, 1, 2, 3], &kept);
        }
        assert!(alike.distribution(1.0)[1] > 4.0);
    }

    #[test]
    fn maps_to_come_are_expected_to_keep_something_where_none_has() {
        let objective = Objective::weighing(vec![1.0; 2000], 1);
        let chance = [1.0, 0.25].iter().flat_map(|&of| vec![of; 1000]);
        let mut record = PlaceRecord::new(&objective, chance.collect());
        let all: Vec<u32> = (0..2000).collect();
        for _ in 0..3 {
            record.add(&all, &[]);
        }
        record.further = vec![3; 2000];
        let of_places = record.completed(0, record.distribution(1.0));
        let of_singles = record.completed(1000, record.distribution(0.25));
        assert!(of_places > 0.01, "{of_places}");
        assert!(of_singles < of_places && of_singles > 0.0, "{of_singles}");
    }
}
