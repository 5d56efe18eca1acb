//! Rows of visibility, real and expected.

use rayon::prelude::*;

use crate::{
    base::column,
    method::visibility::Visibility,
    model::{
        scene::{Scene, ViewIndex},
        surface::Surface,
    },
};

/// Samples of views and triangles from which the rows of visibility are estimated.
const SAMPLED_VIEWS: usize = 32;
const SAMPLED_TRIANGLES: usize = 20_000;
/// Triangles on which all views are judged, and views that are then sampled like those above, for
/// the one that sees most.
const FEW_TRIANGLES: usize = 256;
const WIDEST_VIEWS: usize = 8;

/// Rows of visibility.
#[derive(Clone, Copy, Debug)]
pub struct Rows {
    pub all: u64,
    /// Rows of the view with the most.
    pub most: u64,
    pub views: u64,
}

impl Rows {
    pub fn of(scene: &Scene, visibility: &Visibility) -> Self {
        let most = scene
            .view_indices()
            .map(|view| visibility.rows(view).len())
            .max()
            .unwrap_or_default();
        Self {
            all: visibility.triangles.len() as u64,
            most: most as u64,
            views: scene.views.len() as u64,
        }
    }

    /// Rows that are read between two releases of a table on disk.
    pub fn at_once(self) -> u64 {
        (self.all * self.views.min(column::READ_AT_ONCE as u64)).div_ceil(self.views.max(1))
    }

    /// Estimates the rows of visibility without occlusion, on samples. The view that sees most is
    /// looked for among all, on a smaller sample: one overview may see as much as hundreds of
    /// others.
    pub fn expected(scene: &Scene, surface: &Surface) -> Self {
        let (views, triangles) = (scene.views.len(), surface.triangles.len());
        let share_shown = |view, of_triangles| share_shown(scene, surface, view, of_triangles);
        let all_views: Vec<ViewIndex> = scene.view_indices().collect();
        let spread: Vec<ViewIndex> = all_views
            .iter()
            .copied()
            .step_by(views.div_ceil(SAMPLED_VIEWS).max(1))
            .collect();
        let shares: Vec<f64> = spread
            .par_iter()
            .map(|&view| share_shown(view, SAMPLED_TRIANGLES))
            .collect();
        let mean = shares.iter().sum::<f64>() / shares.len().max(1) as f64;
        let mut widest: Vec<_> = all_views
            .par_iter()
            .map(|&view| (share_shown(view, FEW_TRIANGLES), view))
            .collect();
        widest.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        widest.truncate(WIDEST_VIEWS);
        let of_widest = widest
            .into_par_iter()
            .map(|(_, view)| share_shown(view, SAMPLED_TRIANGLES));
        let most = of_widest.chain(shares).reduce(|| 0.0, f64::max);
        let rows = |share: f64| (share * triangles as f64).ceil() as u64;
        Self {
            all: rows(mean * views as f64),
            most: rows(most),
            views: views as u64,
        }
    }
}

/// Returns the share of triangles that face a view and have their centroid in its image, of about
/// `sampled` ones.
fn share_shown(scene: &Scene, surface: &Surface, view: ViewIndex, sampled: usize) -> f64 {
    let (camera, pose) = (scene.camera_of(view), &scene.view(view).cam_from_world);
    let centre = pose.centre();
    let is_shown = |&t: &u32| {
        let centroid = surface.centroid(t);
        surface.area_normal(t).dot(&(centre - centroid)) > 0.0
            && camera
                .project(&pose.camera_from_world(&centroid))
                .is_some_and(|pixel| camera.contains(&pixel))
    };
    let triangles = surface.triangles.len();
    let sample = (0..triangles as u32).step_by(triangles.div_ceil(sampled).max(1));
    let count = sample.len();
    sample.filter(is_shown).count() as f64 / count.max(1) as f64
}
