//! Half-size maps at full size instead, where a ranking of two sizes is not enough (method 5.8).

use super::{Maps, Objective, Ranking, Reached};
use crate::{base::column, model::cluster::MapScale};

/// Replaces half-size maps of a ranking by those at full size, in the order of gain over additional work, as long as `takes` agrees. `finished`:
/// number of maps at the start of the ranking that are done and stay as they are. `takes`: called with the rank of a map and the weight that fusion
/// keeps so far.
///
/// Returns the maps at their sizes, in the order of the ranking; `None` if none is replaced.
pub fn enlarge(
    ranking: &Ranking,
    finished: usize,
    maps: &Maps,
    objective: &Objective,
    mut takes: impl FnMut(usize, f64) -> bool,
) -> Option<Vec<(u32, MapScale)>> {
    let mut chosen: Vec<(u32, MapScale)> = ranking.maps().collect();
    let mut reached = Reached::new(objective);
    chosen.iter().for_each(|&(cluster, scale)| reached.take(maps.row_at(cluster, scale)));
    let ranks: Vec<usize> = (finished..chosen.len()).filter(|&rank| chosen[rank].1 == MapScale::Half).collect();
    let gain = |reached: &Reached, rank: usize| reached.gain_of_enlarging(maps, ranking.order[rank]);
    let gains = column::read_by_parts(&ranks, |&rank| gain(&reached, rank), || maps.release());
    let mut left: Vec<(usize, i64)> = ranks.into_iter().zip(gains).collect();
    let before = reached.fulfilment();
    while let Some(place) = best(&left, ranking, maps) {
        let (rank, known) = left[place];
        // Where one map is enough, gains only fall: one that is up to date and still the largest is the largest of all.
        let now = gain(&reached, rank);
        if now != known {
            left[place].1 = now;
            continue;
        }
        if !takes(rank, reached.kept_weight()) {
            break;
        }
        left.swap_remove(place);
        reached.enlarge(maps, chosen[rank].0);
        chosen[rank].1 = MapScale::Full;
    }
    maps.release();
    (reached.fulfilment() > before).then_some(chosen)
}

/// Returns the place of the map with the largest known gain over additional work; `None` if none gains. Ties go to the first of the ranking.
fn best(left: &[(usize, i64)], ranking: &Ranking, maps: &Maps) -> Option<usize> {
    let extra = |rank: usize| i128::from(maps.extra_work(ranking.order[rank]));
    let better = |&a: &usize, &b: &usize| {
        let ((rank_a, gain_a), (rank_b, gain_b)) = (left[a], left[b]);
        let [of_a, of_b] = [i128::from(gain_a) * extra(rank_b), i128::from(gain_b) * extra(rank_a)];
        of_a.cmp(&of_b).then(rank_b.cmp(&rank_a))
    };
    (0..left.len()).max_by(better).filter(|&place| left[place].1 > 0)
}

impl Reached<'_> {
    /// Returns the gain of f_o by a cluster's map at full size in place of the one at half size.
    fn gain_of_enlarging(&self, maps: &Maps, cluster: u32) -> i64 {
        let mut raised = Vec::with_capacity(self.objective.support as usize);
        let mut gain = 0;
        for (t, old, new) in raises(maps, cluster) {
            raise(self.largest(t), old, new, &mut raised);
            gain += self.change(t, &raised)[0];
        }
        gain
    }

    /// Replaces a cluster's map at half size by the one at full size.
    fn enlarge(&mut self, maps: &Maps, cluster: u32) {
        let mut raised = Vec::with_capacity(self.objective.support as usize);
        for (t, old, new) in raises(maps, cluster) {
            raise(self.largest(t), old, new, &mut raised);
            self.replace(t, &raised);
        }
    }
}

/// The triangles of a cluster with f at half and at full size, where the latter is larger.
fn raises(maps: &Maps, cluster: u32) -> impl Iterator<Item = (u32, f32, f32)> {
    let (halved, values) = maps.row_at(cluster, MapScale::Half);
    let (triangles, full) = maps.row_at(cluster, MapScale::Full);
    let mut half = halved.iter().zip(values).peekable();
    let at_both = triangles.iter().zip(full).map(move |(&t, &new)| {
        while half.next_if(|(other, _)| **other < t).is_some() {}
        (t, half.next_if(|(other, _)| **other == t).map_or(0.0, |(_, &old)| old), new)
    });
    at_both.filter(|(_, old, new)| new > old)
}

/// Writes the m largest f, ascending, after one of the f has risen from `old` to `new`.
fn raise(largest: &[f32], old: f32, new: f32, raised: &mut Vec<f32>) {
    raised.clear();
    raised.extend_from_slice(largest);
    // An f below the m largest ones is none of them.
    let from = if old < largest[0] { 0 } else { largest.partition_point(|&l| l < old) };
    let to = largest.partition_point(|&l| l < new);
    if to > from {
        raised.copy_within(from + 1..to, from);
        raised[to - 1] = new;
    }
}
