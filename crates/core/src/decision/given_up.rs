//! Method 5.3: location of the surface that a cut gives up.

use serde::{Deserialize, Serialize};

use super::{Tables, UncutRanking};
use crate::method::ranking::Reached;

/// Weight, over that of the whole surface, that fusion is expected to keep of all clusters, less
/// that of the clusters up to the cut, 0 to 1.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct GivenUp {
    /// At the border: within a tenth of the site's width from its outline, and seen by few views.
    pub border: f64,
    /// Elsewhere.
    pub inside: f64,
    /// The part of both that only one planned map shows, while fusion requires several.
    pub single_map: f64,
}

impl GivenUp {
    pub fn new(
        tables: &Tables,
        UncutRanking {
            ranking, border, ..
        }: &UncutRanking,
        clusters: usize,
    ) -> Self {
        let counted = tables.counted();
        let (objective, maps) = counted.kept;
        let items = 0..objective.weights.len() as u32;
        let mut reached = Reached::new(objective);
        ranking
            .maps()
            .take(clusters)
            .for_each(|(cluster, scale)| reached.take(maps.row_at(cluster, scale)));
        let at_cut: Vec<(f32, f32)> = items
            .clone()
            .map(|t| (reached.agreed(t), reached.best(t)))
            .collect();
        if maps.has_half() {
            reached = Reached::by_all(&maps, objective)
        } else {
            ranking
                .maps()
                .skip(clusters)
                .for_each(|(cluster, scale)| reached.take(maps.row_at(cluster, scale)))
        }
        maps.release();
        let mut given_up = Self::default();
        for item in items {
            let (at, weight) = (item as usize, objective.weights[item as usize]);
            let (all, (agreed, best)) = (reached.agreed(item), at_cut[at]);
            let lost = (all - agreed).max(0.0);
            *if border[counted.triangle(item) as usize] {
                &mut given_up.border
            } else {
                &mut given_up.inside
            } += weight * f64::from(lost);
            given_up.single_map += weight * f64::from(lost.min(best - agreed));
        }
        given_up
    }
}
