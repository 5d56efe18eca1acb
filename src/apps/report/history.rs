//! Growth of the fulfilment of each drawn triangle along the ranking, so that the page can show any
//! cut.

use super::shown::DrawnSurface;
use crate::{base::rows::Offsets, method::ranking::Reached, plan::Plan, show::pictures};

/// Clusters per triangle that are counted one by one; the page says "5 or more" beyond.
pub const COUNTED: usize = 5;
/// Stands in for the rank of a missing cluster.
const NEVER: u32 = u32::MAX;
/// f above which a triangle is drawn as shown.
const LIKELY: f32 = 0.5;

/// CSR by drawn triangle. Ranks are 1-based.
#[derive(Default)]
pub struct History {
    pub offsets: Offsets,
    /// Rank of each cluster that increases the fulfilment of the triangle.
    pub ranks: Vec<u32>,
    /// Share of the triangle's reachable fulfilment from that rank on, in 255ths.
    pub shares: Vec<u8>,
    /// Ranks of the first [`COUNTED`] clusters that fulfil the triangle at all.
    pub first: Vec<u32>,
    /// Rank from which one map is more likely than not to show the triangle, and rank from which as
    /// many maps as fusion needs are.
    pub alone: Vec<u32>,
    pub kept: Vec<u32>,
    /// Fulfilment by all clusters together, in 255ths.
    pub reachable: Vec<u8>,
}

impl History {
    pub fn new(plan: &Plan, drawn: &DrawnSurface) -> Self {
        // Of each triangle among those drawn.
        let mut place = vec![u32::MAX; plan.stages.surface.triangles.len()];
        (0..)
            .zip(&drawn.original)
            .for_each(|(i, &t)| place[t as usize] = i);
        let mut steps: Vec<Vec<(u32, f32)>> = vec![Vec::new(); drawn.original.len()];
        let mut first: Vec<Vec<u32>> = vec![Vec::with_capacity(COUNTED); drawn.original.len()];
        pictures::for_each_step(plan, |rank, triangle, fulfilment| {
            let place = place[triangle as usize] as usize;
            let rank = rank as u32 + 1;
            let (Some(of), Some(counted)) = (steps.get_mut(place), first.get_mut(place)) else {
                return;
            };
            if counted.len() < COUNTED {
                counted.push(rank);
            }
            if of.last().is_none_or(|&(_, before)| fulfilment > before) {
                of.push((rank, fulfilment));
            }
        });
        let (alone, kept) = confirmed(plan, &place, drawn.original.len());
        let mut history = Self {
            alone,
            kept,
            ..Self::default()
        };
        for (steps, mut counted) in steps.into_iter().zip(first) {
            counted.resize(COUNTED, NEVER);
            history.first.extend(counted);
            history.push(&steps);
        }
        history
    }

    /// Adds a triangle; drops steps that round to the same 255th as the step before.
    fn push(&mut self, steps: &[(u32, f32)]) {
        let reachable = steps.last().map_or(0.0, |&(_, f)| f);
        let (mut before, start) = (0, self.ranks.len());
        for &(rank, fulfilment) in steps {
            let share = in_255ths(fulfilment / reachable);
            if share > before {
                self.ranks.push(rank);
                self.shares.push(share);
                before = share;
            }
        }
        self.reachable.push(in_255ths(reachable));
        self.offsets.push(self.ranks.len() - start);
    }
}

/// Returns the ranks from which one map, and as many maps as fusion needs, are more likely than not
/// to show each of the `drawn` triangles. `place`: where each triangle of the plan is among them.
fn confirmed(plan: &Plan, place: &[u32], drawn: usize) -> (Vec<u32>, Vec<u32>) {
    let mut reached = Reached::new(&plan.stages.objective);
    let (mut alone, mut kept) = (vec![NEVER; drawn], vec![NEVER; drawn]);
    let maps = plan.stages.maps();
    for (rank, (cluster, scale)) in (1..NEVER).zip(plan.decision.ranking.maps()) {
        let row = maps.row_at(cluster, scale);
        reached.take(row);
        for &t in row.0 {
            let Some(place) = Some(place[t as usize] as usize).filter(|&place| place < drawn)
            else {
                continue;
            };
            if reached.best(t) > LIKELY {
                alone[place] = alone[place].min(rank);
            }
            if reached.agreed(t) > LIKELY {
                kept[place] = kept[place].min(rank);
            }
        }
    }
    maps.release();
    (alone, kept)
}

/// Quantises a number from 0 to 1 to a byte.
pub fn in_255ths(share: f32) -> u8 {
    (share.clamp(0.0, 1.0) * 255.0).round() as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_end_at_the_whole_and_grow() {
        let mut history = History::default();
        history.push(&[(1, 0.2), (4, 0.2004), (70_000, 0.4)]);
        history.push(&[]);
        assert_eq!(
            history.ranks,
            [1, 70_000],
            "a step of less than a 255th is left out"
        );
        assert_eq!(history.shares, [128, 255]);
        assert_eq!(
            (history.offsets, history.reachable),
            (Offsets::from_lengths([2, 0]), vec![102, 0])
        );
    }
}
