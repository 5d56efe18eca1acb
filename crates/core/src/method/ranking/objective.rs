//! The objective (methods 5.1, 5.2 and 5.7): weights of triangles, and the worth of the depth maps
//! that see them.

use crate::{
    method::{ranking::TriangleWeight, region::Region, visibility::Shown},
    model::surface::Surface,
};

/// Worth of a single map at a triangle where the backend's fusion needs several (e of method 5.2).
/// With 0.1, plans have maps that no other map confirms; between 0.25 and 0.7, the fused area
/// hardly changes.
pub const SINGLE_MAP_CREDIT: f64 = 0.5;

/// The function to maximise: `f_o(S)` = sum over triangles of `w_t (f_m + e mean(f_1 ... f_{m-1}))
/// / (1 + e)`, where f_i is the i-th largest f of the clusters S at the triangle. For m = 1 this is
/// the paper's maximum.
#[derive(Clone, Debug, PartialEq)]
pub struct Objective {
    /// w_t of each triangle; they add up to 1.
    pub weights: Vec<f64>,
    /// Number of maps that must agree on a point (m), at least 1.
    pub support: u32,
    /// Share of the surface's weight that is inside the region, before its factors; 1 without a
    /// region.
    pub inside: f64,
}

impl Objective {
    /// Weights the triangles by the given rule, times the factors of the region. `support`: m; 0
    /// counts as 1.
    pub fn new(
        surface: &Surface,
        shown: &Shown,
        weight: TriangleWeight,
        region: Option<&Region>,
        support: u32,
    ) -> Self {
        let triangles = 0..surface.triangles.len();
        let raw: Vec<f64> = match weight {
            // Here the far walls of a room, cut into many triangles, outweigh the bust in it.
            TriangleWeight::Count => triangles.map(|_| 1.0).collect(),
            TriangleWeight::Area => return Self::by_area(surface, region, support),
            TriangleWeight::Pixels => triangles.map(|t| shown.mean_pixels(t)).collect(),
        };
        Self::inside(raw, region, support)
    }

    /// Weights the triangles by area, times the factors of the region.
    pub fn by_area(surface: &Surface, region: Option<&Region>, support: u32) -> Self {
        let areas = (0..surface.triangles.len() as u32)
            .map(|t| surface.area(t))
            .collect();
        Self::inside(areas, region, support)
    }

    fn inside(mut raw: Vec<f64>, region: Option<&Region>, support: u32) -> Self {
        let Some(region) = region else {
            return Self::weighing(raw, support);
        };
        let all: f64 = raw.iter().sum();
        let inside: f64 = raw
            .iter()
            .zip(&region.covered)
            .map(|(w, &covered)| w * f64::from(covered))
            .sum();
        raw.iter_mut()
            .zip(&region.factors)
            .for_each(|(w, &factor)| *w *= f64::from(factor));
        Self {
            inside: if all > 0.0 { inside / all } else { 0.0 },
            ..Self::weighing(raw, support)
        }
    }

    /// Normalises non-negative weights.
    pub fn weighing(raw: Vec<f64>, support: u32) -> Self {
        let sum: f64 = raw.iter().sum();
        let weights = raw
            .into_iter()
            .map(|w| if sum > 0.0 { w / sum } else { 0.0 })
            .collect();
        Self {
            weights,
            support: support.max(1),
            inside: 1.0,
        }
    }

    /// Returns the worth of a triangle's m largest f, 0 to 1; `largest` ascends.
    pub(super) fn worth(largest: impl ExactSizeIterator<Item = f32>) -> f64 {
        let others = largest.len() - 1;
        let mut largest = largest.map(f64::from);
        let Some(agreed) = largest.next() else {
            return 0.0;
        };
        match others {
            0 => agreed,
            n => {
                // Without the credit, no first map would gain anything, and the order would be
                // arbitrary.
                (agreed + SINGLE_MAP_CREDIT * largest.sum::<f64>() / n as f64)
                    / (1.0 + SINGLE_MAP_CREDIT)
            }
        }
    }

    /// Returns the guarantee of the greedy order: its minimum share of the best set's f_o, 1 -
    /// exp(-g), where the gains of single clusters add up to at least g times the gain of all of
    /// them together (method 5.2; Das, Kempe 2011).
    ///
    /// Proof of g = 2x / (1 + x), x = e / (m - 1), at one triangle whose m largest f are l_1 <= ...
    /// <= l_m: let r(z) be the number of them below z. If the m-th largest rises from l_1 to z, at
    /// least r(z) added clusters reach z, so the rise is at most the sum over the added f of the
    /// integral of 1 / r(z) from l_1 to f. The sum of the m largest rises by at most the sum of the
    /// f - l_1. A cluster alone adds (1 - x) (min(f, l_2) - l_1) + x (f - l_1), over 1 + e, and its
    /// part of the bound is (1 - x) times that integral + x (f - l_1), over 1 + e. Beyond l_2, r is
    /// at least 2, so the ratio is at least x / ((1 - x) / 2 + x) = g.
    pub fn guarantee(&self) -> f64 {
        let credit = match self.support {
            1 => 1.0,
            m => SINGLE_MAP_CREDIT / f64::from(m - 1),
        };
        1.0 - (-2.0 * credit / (1.0 + credit)).exp()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::method::region::{Outline, RegionKind};

    #[test]
    fn what_is_inside_a_region_is_its_share_of_the_weight_whatever_its_factors() {
        let region = Region {
            kind: RegionKind::Box,
            factors: vec![2.0, 1.0, 0.0],
            covered: vec![1.0, 0.5, 0.0],
            gsd: Vec::new(),
            bounds: [0.0; 6],
            outline: Outline::Hull(Vec::new()),
        };
        let objective = Objective::inside(vec![1.0, 3.0, 4.0], Some(&region), 1);
        assert_eq!(
            (objective.inside, &objective.weights[..]),
            (2.5 / 8.0, &[0.4, 0.6, 0.0][..])
        );
        assert_eq!(
            Objective::inside(vec![0.0; 3], Some(&region), 1).inside,
            0.0
        );
    }
}
