//! f_o of a growing set of clusters.

use super::{Maps, Objective};
use crate::base::column;

/// f_o is counted in integer multiples of 1 / `UNIT`. Integer sums are exact: gains can be updated
/// by differences, and the result depends neither on the order of additions nor on the number of
/// threads.
const UNIT: f64 = (1u64 << 60) as f64;

/// Amount of f_o, or of the weight that fusion is expected to keep.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct FixedPoint(pub(super) i64);

impl FixedPoint {
    pub(super) fn new(weight: f64, worth: f64) -> Self {
        // Rounds numbers that are not negative, to within 1, without a call.
        Self((weight * worth * UNIT + 0.5) as i64)
    }

    pub(super) fn value(self) -> f64 {
        self.0 as f64 / UNIT
    }
}

/// The m largest f of each triangle over the chosen clusters, and f_o.
#[derive(Clone)]
pub struct Reached<'a> {
    pub(super) objective: &'a Objective,
    /// m values per triangle, ascending.
    largest: Vec<f32>,
    fulfilment: i64,
    kept: i64,
}

impl<'a> Reached<'a> {
    pub fn new(objective: &'a Objective) -> Self {
        let largest = vec![0.0; objective.support as usize * objective.weights.len()];
        Self {
            objective,
            largest,
            fulfilment: 0,
            kept: 0,
        }
    }

    /// Returns what all clusters at full size reach.
    pub fn by_all(maps: &Maps, objective: &'a Objective) -> Self {
        let mut reached = Self::new(objective);
        for cluster in 0..maps.clusters() {
            reached.take(maps.row(cluster));
            if (cluster as usize).is_multiple_of(column::READ_AT_ONCE) {
                maps.release();
            }
        }
        reached
    }

    /// f_o of the chosen clusters.
    pub fn fulfilment(&self) -> f64 {
        FixedPoint(self.fulfilment).value()
    }

    /// Weight that fusion is expected to keep of them: the sum of `w_t f_m`, 0 to 1 (method 5.2).
    pub fn kept_weight(&self) -> f64 {
        FixedPoint(self.kept).value()
    }

    /// Returns the m largest f of a triangle, ascending.
    pub(super) fn largest(&self, triangle: u32) -> &[f32] {
        let m = self.objective.support as usize;
        &self.largest[triangle as usize * m..][..m]
    }

    /// Returns the m-th largest f of a triangle: m maps agree on it.
    pub fn agreed(&self, triangle: u32) -> f32 {
        self.largest(triangle)[0]
    }

    /// Returns the largest f of a triangle.
    pub fn best(&self, triangle: u32) -> f32 {
        self.largest(triangle).last().copied().unwrap_or(0.0)
    }

    /// Returns the worth of the chosen clusters at a triangle, 0 to 1.
    pub fn worth(&self, triangle: u32) -> f32 {
        Objective::worth(self.largest(triangle).iter().copied()) as f32
    }

    /// Returns the gain of f_o by a cluster with these triangles and f.
    pub fn gain(&self, row: (&[u32], &[f32])) -> f64 {
        FixedPoint(self.whole_gain(row)).value()
    }

    pub(super) fn whole_gain(&self, (triangles, values): (&[u32], &[f32])) -> i64 {
        let one = |(&t, &f): (&u32, &f32)| self.gain_at(t, self.largest(t), f);
        triangles.iter().zip(values).map(one).sum()
    }

    /// Returns the gain of one more f at a triangle with these largest ones.
    #[inline]
    pub(super) fn gain_at(&self, triangle: u32, largest: &[f32], f: f32) -> i64 {
        self.gains_at(triangle, largest)(f)
    }

    /// Returns [`Self::gain_at`] as a function of f.
    #[inline]
    pub(super) fn gains_at<'l>(
        &self,
        triangle: u32,
        largest: &'l [f32],
    ) -> impl Fn(f32) -> i64 + use<'l> {
        let weight = self.objective.weights[triangle as usize];
        // Outside the closure, which is called for every map that sees the triangle.
        let before = FixedPoint::new(weight, Objective::worth(largest.iter().copied())).0;
        move |f| {
            if f <= largest[0] {
                0
            } else {
                FixedPoint::new(weight, with(largest, f)).0 - before
            }
        }
    }

    pub fn take(&mut self, (triangles, values): (&[u32], &[f32])) {
        triangles
            .iter()
            .zip(values)
            .for_each(|(&t, &f)| self.take_at(t, f));
    }

    pub fn take_at(&mut self, triangle: u32, f: f32) {
        let largest = self.largest(triangle);
        let place = largest.partition_point(|&l| l < f);
        if place == 0 {
            return;
        }
        let (gain, agreed, m) = (
            self.gain_at(triangle, largest, f),
            largest[0],
            largest.len(),
        );
        self.fulfilment += gain;
        let largest = &mut self.largest[triangle as usize * m..][..m];
        largest.copy_within(1..place, 0);
        largest[place - 1] = f;
        // f_m itself, without a threshold: with one of 0.3, plans promise 6 to 25 points more than
        // clouds of OpenMVS cover.
        let weight = self.objective.weights[triangle as usize];
        // The difference of rounded values, not a rounded difference: the sum stays that of the
        // triangles, whatever the order in which clusters came.
        self.kept += FixedPoint::new(weight, f64::from(largest[0])).0
            - FixedPoint::new(weight, f64::from(agreed)).0;
    }
}

/// Returns [`Objective::worth`] after adding f, which exceeds the smallest of the largest ones.
#[inline]
fn with(largest: &[f32], f: f32) -> f64 {
    match *largest {
        // Without allocation where m is 1 or 2, as for all backends but one.
        [_] => f64::from(f),
        [_, first] => Objective::worth([f.min(first), f.max(first)].into_iter()),
        _ => {
            let mut largest = largest.to_vec();
            let place = largest.partition_point(|&l| l < f);
            largest.copy_within(1..place, 0);
            largest[place - 1] = f;
            Objective::worth(largest.into_iter())
        }
    }
}
