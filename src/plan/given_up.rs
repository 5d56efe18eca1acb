//! Method 5.3: where the part of the surface is that a cut gives up.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{Stages, border::border};
use crate::method::ranking::{Ranking, Reached};

/// Weights, over that of the whole surface, of triangles that fusion would keep of all clusters and does not keep of those up to the cut, 0 to 1.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct GivenUp {
    /// At the border: within a tenth of the site's width from its outline, and seen by few views.
    pub border: f64,
    /// Elsewhere.
    pub inside: f64,
    /// The part of both that one planned map shows well enough but no other confirms, where fusion wants several.
    pub single_map: f64,
}

impl GivenUp {
    pub(super) fn new(stages: &Stages, ranking: &Ranking, clusters: usize) -> Self {
        let (objective, maps) = (&stages.objective, stages.maps());
        let triangles = 0..objective.weights.len() as u32;
        let mut reached = Reached::new(objective);
        ranking.maps().take(clusters).for_each(|(cluster, scale)| reached.take(maps.row_at(cluster, scale)));
        let at_cut: Vec<(bool, bool)> =
            triangles.clone().map(|t| (reached.is_kept(t), reached.is_of_one_map(t))).collect();
        ranking.maps().skip(clusters).for_each(|(cluster, scale)| reached.take(maps.row_at(cluster, scale)));
        maps.release();
        let border = border(&stages.surface, &stages.visibility, &objective.weights);
        let mut given_up = Self::default();
        for t in triangles.filter(|&t| reached.is_kept(t) && !at_cut[t as usize].0) {
            let (at, weight) = (t as usize, objective.weights[t as usize]);
            *if border[at] { &mut given_up.border } else { &mut given_up.inside } += weight;
            if at_cut[at].1 {
                given_up.single_map += weight;
            }
        }
        given_up
    }
}
