//! The ranking as a curve: share and cost of each prefix.

use super::{Decision, Options, Tables};

/// The first `clusters` clusters of the ranking together.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CurvePoint {
    /// Number of clusters, from 1.
    pub clusters: usize,
    /// Their (key view, partner) pairs; 0, as are points, for a program that makes no depth maps.
    pub pairs: usize,
    /// Weight that fusion keeps of them over that of all clusters, 0 to 1.
    pub share: f64,
    /// Weight that fusion keeps of them, over that of the whole surface, 0 to 1.
    pub kept: f64,
    /// Their fulfilment f_o, 0 to 1.
    pub fulfilment: f64,
    /// Pixels that their depth maps will measure, before fusion.
    pub points: f64,
    /// Seconds of matching, without finished maps; `None` where `forecast.seconds_per_pair` and
    /// `.seconds_per_map` are unset.
    pub seconds: Option<f64>,
}

impl Decision {
    /// Returns the curve of the whole ranking, a point per cluster.
    pub fn curve(&self, tables: &Tables, options: &Options) -> Vec<CurvePoint> {
        let ranking = &self.ranking;
        let points = self.points_by_rank(tables, options);
        let cost = self.cost(tables, options);
        let start = CurvePoint {
            seconds: options.forecast.knows_times().then_some(0.0),
            ..CurvePoint::default()
        };
        let next = |sum: &mut CurvePoint, rank: usize| {
            let seconds = sum.seconds.zip(cost.seconds(rank));
            *sum = CurvePoint {
                clusters: rank + 1,
                pairs: sum.pairs + cost.pairs_of(rank),
                share: ranking.share(rank + 1),
                kept: ranking.kept[rank],
                fulfilment: ranking.fulfilment[rank],
                points: sum.points + points[rank],
                seconds: seconds.map(|(sum, one)| sum + one),
            };
            Some(*sum)
        };
        (0..ranking.order.len()).scan(start, next).collect()
    }
}
