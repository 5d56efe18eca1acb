//! Methods 5.1, 5.2 and 5.7: what a triangle counts, and what the depth maps that see it are worth.

use std::sync::atomic::{AtomicU64, Ordering};

use crate::{
    base::column,
    config::TriangleWeight,
    method::{
        fulfilment::projected_area, geometry::Geometry, region::Region, surface::Surface, visibility::Visibility,
    },
    model::scene::{Scene, ViewIndex},
};

/// What a map alone is worth at a triangle where the backend's fusion wants more (e of method 5.2). A tenth plans maps that no other map
/// confirms; from a quarter to seven tenths the fused area hardly differs.
pub const SINGLE_MAP_CREDIT: f64 = 0.5;

/// What is maximised: `f_o(S) = sum over the triangles of w_t (f_m + e mean(f_1 ... f_{m-1})) / (1 + e)`, f_i being the i-th largest f of the
/// clusters S at the triangle; for m = 1 the paper's maximum.
#[derive(Clone, Debug, PartialEq)]
pub struct Objective {
    /// w_t of each triangle; the sum is 1.
    pub weights: Vec<f64>,
    /// Maps that have to agree on a point (m), at least 1.
    pub support: u32,
    /// Share of the weight of the whole surface, before the factors of the region, that is inside it; 1 without a region.
    pub inside: f64,
}

impl Objective {
    /// Weighs the triangles as the setting says, times the factors of the region. `support`: m; 0 counts as 1.
    pub fn new(geometry: &Geometry, weight: TriangleWeight, region: Option<&Region>, support: u32) -> Self {
        let triangles = 0..geometry.surface.triangles.len() as u32;
        let raw: Vec<f64> = match weight {
            TriangleWeight::Count => triangles.map(|_| 1.0).collect(),
            TriangleWeight::Area => return Self::by_area(geometry.surface, region, support),
            TriangleWeight::Pixels => {
                SeenPixels::new(geometry.scene, geometry.surface, geometry.visibility).means().collect()
            }
        };
        Self::inside(raw, region, support)
    }

    /// Weighs the triangles by their areas, times the factors of the region.
    pub fn by_area(surface: &Surface, region: Option<&Region>, support: u32) -> Self {
        let areas = (0..surface.triangles.len() as u32).map(|t| surface.area(t)).collect();
        Self::inside(areas, region, support)
    }

    fn inside(mut raw: Vec<f64>, region: Option<&Region>, support: u32) -> Self {
        let Some(region) = region else { return Self::weighing(raw, support) };
        let all: f64 = raw.iter().sum();
        let inside: f64 = raw.iter().zip(&region.covered).map(|(w, &covered)| w * f64::from(covered)).sum();
        raw.iter_mut().zip(&region.factors).for_each(|(w, &factor)| *w *= f64::from(factor));
        Self { inside: if all > 0.0 { inside / all } else { 0.0 }, ..Self::weighing(raw, support) }
    }

    /// `raw`: weights of any sum, none negative.
    pub fn weighing(raw: Vec<f64>, support: u32) -> Self {
        let sum: f64 = raw.iter().sum();
        let weights = raw.into_iter().map(|w| if sum > 0.0 { w / sum } else { 0.0 }).collect();
        Self { weights, support: support.max(1), inside: 1.0 }
    }

    /// What a triangle's m largest f are worth, 0 to 1; `largest` ascending.
    pub(super) fn worth(largest: impl ExactSizeIterator<Item = f32>) -> f64 {
        let others = largest.len() - 1;
        let mut largest = largest.map(f64::from);
        let Some(agreed) = largest.next() else { return 0.0 };
        match others {
            0 => agreed,
            n => (agreed + SINGLE_MAP_CREDIT * largest.sum::<f64>() / n as f64) / (1.0 + SINGLE_MAP_CREDIT),
        }
    }

    /// The least share of the best set's f_o that the greedy order reaches, 1 - exp(-g): the sum of the gains of single clusters is at least g
    /// times the gain of all of them together (method 5.2 has the proof).
    pub fn guarantee(&self) -> f64 {
        let credit = match self.support {
            1 => 1.0,
            m => SINGLE_MAP_CREDIT / f64::from(m - 1),
        };
        1.0 - (-2.0 * credit / (1.0 + credit)).exp()
    }
}

/// Pixels of each triangle in the model's images, as far as the views see it.
pub struct SeenPixels(Vec<[AtomicU64; 2]>);

/// Pixels are added as whole numbers of these parts, whose sum does not depend on the order in which threads add them.
const PARTS: f64 = 65_536.0;

impl SeenPixels {
    pub fn new(scene: &Scene, surface: &Surface, visibility: &Visibility) -> Self {
        let seen: Vec<[AtomicU64; 2]> = surface.triangles.iter().map(|_| Default::default()).collect();
        let add = |&view: &ViewIndex| {
            let (camera, pose) = (scene.camera_of(view), &scene.view(view).cam_from_world);
            for &t in visibility.triangles_seen_by(view) {
                let pixels = projected_area(camera, &surface.corners(t).map(|corner| pose.camera_from_world(&corner)));
                let [sum, views] = &seen[t as usize];
                sum.fetch_add((pixels.min(1e9) * PARTS) as u64, Ordering::Relaxed);
                views.fetch_add(1, Ordering::Relaxed);
            }
        };
        column::read_by_parts(&visibility.views(), add, || visibility.triangles.release());
        Self(seen)
    }

    /// Sum over the views.
    pub fn sums(self) -> impl Iterator<Item = f64> {
        self.0.into_iter().map(|[sum, _]| sum.into_inner() as f64 / PARTS)
    }

    /// Mean over the views that see the triangle; 0 where none does.
    ///
    /// The mean and not the sum: the sum plans for the middle of a flight, where most views overlap.
    fn means(self) -> impl Iterator<Item = f64> {
        self.0.into_iter().map(|[sum, views]| sum.into_inner() as f64 / PARTS / views.into_inner().max(1) as f64)
    }
}
