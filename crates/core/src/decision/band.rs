//! Method 5.2: expected deviation of measured values from their forecasts.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::Tables;
use crate::method::ranking::{Ranking, Reached};

/// Half width of the band of the reachable weight, over the sum of `w f (1 - f)`, which is 0 if
/// each f is certain. With this factor, the measured value was within the band on all data sets
/// that the rule was made from (method 5.2).
const SPREAD: f64 = 1.25;
/// Minimum and maximum distance of the share from either end of its band.
const SHARE: (f64, f64) = (0.08, 0.15);
/// The same where no pictures are compared, and the distances of the band's ends below and above
/// the forecast of the reachable weight: the largest errors of `geometric` on the same data sets,
/// rounded up.
const UNSEEN_SHARE: f64 = 0.35;
const UNSEEN: (f64, f64) = (0.55, 0.05);

/// Range in which the measured value is expected, 0 to 1.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Band {
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

impl Default for Band {
    fn default() -> Self {
        Self {
            low: 0.0,
            high: 1.0,
        }
    }
}

impl fmt::Display for Band {
    /// Formats it in per cent, rounded outwards, as "81 to 99 %".
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(
            f,
            "{:.0} to {:.0} %",
            (100.0 * self.low).floor(),
            (100.0 * self.high).ceil()
        )
    }
}

impl Band {
    pub fn exactly(value: f64) -> Self {
        Self::around(value, 0.0, 0.0)
    }

    fn around(value: f64, below: f64, above: f64) -> Self {
        Self {
            low: (value - below).max(0.0),
            high: (value + above).min(1.0),
        }
    }

    /// Returns the band of the weight that fusion keeps of all clusters.
    pub fn of_reachable(tables: &Tables, ranking: &Ranking) -> Self {
        if tables.agreement.is_empty() {
            return Self::around(ranking.reachable, UNSEEN.0, UNSEEN.1);
        }
        let maps = tables.maps();
        let reached = Reached::by_all(&maps, &tables.objective);
        maps.release();
        let doubt = |(t, weight): (u32, &f64)| {
            let f = f64::from(reached.agreed(t));
            weight * f * (1.0 - f)
        };
        let spread = SPREAD * (0..).zip(&tables.objective.weights).map(doubt).sum::<f64>();
        Self::around(ranking.reachable, spread, spread)
    }

    /// Returns the band of the share at the cut, which widens with the uncertainty of what all
    /// clusters give.
    pub fn of_share(tables: &Tables, share: f64, reachable: f64, of_reachable: &Self) -> Self {
        let half = if tables.agreement.is_empty() {
            UNSEEN_SHARE
        } else if reachable > 0.0 {
            // A quarter of the whole width is half of the distance to either end.
            (0.25 * (of_reachable.high - of_reachable.low) / reachable).clamp(SHARE.0, SHARE.1)
        } else {
            SHARE.1
        };
        Self::around(share, half, half)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_band_is_not_written_narrower_than_it_is() {
        assert_eq!(
            Band {
                low: 0.8155,
                high: 0.991
            }
            .to_string(),
            "81 to 100 %"
        );
    }
}
