//! Method 5.3: location of the surface that a cut gives up.

use serde::{Deserialize, Serialize};

use super::{Tables, UncutRanking};
use crate::{
    method::ranking::{Maps, Reached},
    model::cluster::MapScale,
};

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
    pub fn new(tables: &Tables, ranked: &UncutRanking, clusters: usize) -> Self {
        let counted = tables.counted();
        let (objective, maps) = counted.kept;
        let weights = &objective.weights;
        let chosen = || ranked.ranking.maps();
        let mut reached = Reached::new(objective);
        take(&mut reached, &maps, chosen().take(clusters));
        let at_cut = AtCut::of_items(&reached, weights.len());
        if maps.has_half() {
            // With two sizes, the reference is all clusters at full size, whatever size they are
            // ranked at.
            reached = Reached::by_all(&maps, objective)
        } else {
            take(&mut reached, &maps, chosen().skip(clusters));
        }
        maps.release();
        let mut given_up = Self::default();
        for (item, at_cut) in (0..).zip(&at_cut) {
            let is_border = ranked.border[counted.triangle(item) as usize];
            let weight = weights[item as usize];
            given_up.add(weight, reached.agreed(item), at_cut, is_border);
        }
        given_up
    }

    /// Adds an item on which all clusters agree to `all`.
    fn add(&mut self, weight: f64, all: f32, at_cut: &AtCut, is_border: bool) {
        let lost = (all - at_cut.agreed).max(0.0);
        let side = if is_border {
            &mut self.border
        } else {
            &mut self.inside
        };
        *side += weight * f64::from(lost);
        self.single_map += weight * f64::from(lost.min(at_cut.best - at_cut.agreed));
    }
}

fn take(reached: &mut Reached, maps: &Maps, chosen: impl Iterator<Item = (u32, MapScale)>) {
    chosen.for_each(|(cluster, scale)| reached.take(maps.row_at(cluster, scale)));
}

/// f of an item in the clusters up to the cut.
struct AtCut {
    /// f on which as many maps agree as fusion requires.
    agreed: f32,
    best: f32,
}

impl AtCut {
    fn of_items(reached: &Reached, items: usize) -> Vec<Self> {
        let of_item = |item| Self {
            agreed: reached.agreed(item),
            best: reached.best(item),
        };
        (0..items as u32).map(of_item).collect()
    }
}
