//! Wanted resolution and accuracy of each triangle (method 3.6).

use std::sync::atomic::{AtomicU32, Ordering};

use crate::{
    base::column,
    config::{TargetMode, TargetSettings},
    method::{region::Region, surface::Surface, visibility::Visibility},
    model::scene::{Scene, ViewIndex},
};

/// Ratio of the wanted GSD to the available one, where the wanted one is derived from the data.
pub const GSD_MARGIN: f64 = 1.25;

/// Wanted ground sampling distance and accuracy of each triangle.
#[derive(Clone, Debug, PartialEq)]
pub struct Target {
    /// `Absolute` or `Best`.
    pub mode: TargetMode,
    /// g_d of each triangle, scene units per pixel of the matched image.
    pub gsd: Vec<f32>,
    /// a_d over g_d, equal for all triangles.
    pub accuracy_over_gsd: f64,
}

impl Target {
    /// `gsd`: g_d of the whole scene (what the user typed, else [`GSD_MARGIN`] times the median of the model); it also holds for
    /// triangles that no view sees.
    ///
    /// In mode `Best`, `g_d(t)` is [`GSD_MARGIN`] times the finest of the views that see t, the GSD of a view at t being the depth of the
    /// centroid over the mean focal length (the distance where a camera has no depth: equirectangular), in pixels of the matched image.
    pub fn new(
        scene: &Scene,
        surface: &Surface,
        visibility: &Visibility,
        settings: &TargetSettings,
        gsd: f64,
        image_scale: f64,
    ) -> Self {
        let mode = settings.mode.in_force(settings.gsd.is_some());
        let accuracy_over_gsd = settings.accuracy.map_or(1.0, |accuracy| accuracy / gsd);
        let finest = match mode {
            TargetMode::Best => finest(scene, surface, visibility),
            _ => vec![f32::INFINITY; surface.triangles.len()],
        };
        let wanted = |finest: f32| {
            let wanted = (GSD_MARGIN * f64::from(finest) / image_scale) as f32;
            if wanted.is_finite() && wanted > 0.0 { wanted } else { gsd as f32 }
        };
        Self { mode, gsd: finest.into_iter().map(wanted).collect(), accuracy_over_gsd }
    }

    /// Replaces g_d where the areas of a region set their own (method 5.7).
    pub fn with_wishes(mut self, region: &Region) -> Self {
        let wishes = self.gsd.iter_mut().zip(&region.gsd).filter(|(_, wanted)| wanted.is_finite());
        wishes.for_each(|(gsd, &wanted)| *gsd = wanted);
        self
    }

    /// Returns the wanted accuracy a_d of a triangle, scene units.
    pub fn accuracy(&self, triangle: u32) -> f64 {
        f64::from(self.gsd[triangle as usize]) * self.accuracy_over_gsd
    }
}

/// Returns the finest GSD of each triangle over the views that see it, scene units per pixel of the model's image; infinite without such a view. Views
/// with a GSD that is not positive don't count: the centroid of a large triangle may be behind a camera that sees a corner of it.
fn finest(scene: &Scene, surface: &Surface, visibility: &Visibility) -> Vec<f32> {
    let finest: Vec<AtomicU32> = surface.triangles.iter().map(|_| AtomicU32::new(f32::INFINITY.to_bits())).collect();
    let look = |&view: &ViewIndex| {
        for &t in visibility.triangles_seen_by(view) {
            let gsd = gsd_at(scene, surface, view, t) as f32;
            if gsd > 0.0 {
                // Bits of positive floats are ordered like the floats, and a minimum does not depend on the order of threads.
                finest[t as usize].fetch_min(gsd.to_bits(), Ordering::Relaxed);
            }
        }
    };
    column::read_by_parts(&visibility.views(), look, || visibility.triangles.release());
    finest.into_iter().map(|bits| f32::from_bits(bits.into_inner())).collect()
}

/// Returns scene units per pixel of the model's image at a triangle's centroid, across the viewing direction.
pub(super) fn gsd_at(scene: &Scene, surface: &Surface, view: ViewIndex, triangle: u32) -> f64 {
    let camera = scene.camera_of(view);
    let centroid = scene.view(view).cam_from_world.camera_from_world(&surface.centroid(triangle));
    camera.depth(&centroid) / camera.mean_focal_length()
}
