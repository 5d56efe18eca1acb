//! The ranking, with what follows from it wherever it is cut: kept for the next plan, which may
//! differ in its cut alone.

use super::{Tables, border::border, reasons::Reasons};
use crate::{
    method::ranking::{self, Ranking},
    model::reason::Reason,
};

/// A ranking of the clusters, and what is the same wherever it is cut.
#[derive(Clone, Debug)]
pub struct UncutRanking {
    pub ranking: Ranking,
    /// See [`super::Decision::area_shares`].
    pub area_shares: Vec<f64>,
    /// See [`super::Decision::triangle_reasons`].
    pub triangle_reasons: Vec<Option<Reason>>,
    /// See [`super::Decision::border`].
    pub border: Vec<bool>,
    /// See [`super::Decision::pixels`].
    pub pixels: Vec<f64>,
}

impl UncutRanking {
    /// Computes all but the pixels, which only the clusters up to the cut need. `makes_maps`: see
    /// [`super::Options::makes_maps`].
    pub fn new(tables: &Tables, ranking: Ranking, makes_maps: bool) -> Self {
        let by_area = || {
            let area = tables.counted_by_area();
            ranking::shares_by(&area, &ranking, &tables.counted().kept.1)
        };
        // The shares take the clusters in their order, on one thread.
        let (area_shares, (triangle_reasons, border)) = rayon::join(
            || {
                if makes_maps {
                    by_area()
                } else {
                    vec![0.0; ranking.order.len()]
                }
            },
            || {
                let border = || {
                    border(
                        &tables.surface,
                        &tables.shown.views,
                        &tables.objective.weights,
                    )
                };
                rayon::join(|| Reasons::of(tables, &tables.model()).triangles(), border)
            },
        );
        Self {
            ranking,
            area_shares,
            triangle_reasons,
            border,
            pixels: Vec::new(),
        }
    }
}
