//! Method 3.6: what is wanted of each triangle.

use crate::{
    config::{TargetMode, TargetSettings},
    scene::Scene,
    surface::Surface,
    visibility::Visibility,
};

/// How much finer than the wanted one the best view is, when the target comes from the data.
pub const GSD_MARGIN: f64 = 1.25;

/// Wanted ground sampling distance and accuracy of each triangle.
#[derive(Clone, Debug, PartialEq)]
pub struct Target {
    /// `Absolute` or `Best`.
    pub mode: TargetMode,
    /// g_d of each triangle, scene units per pixel of the matched image.
    pub gsd: Vec<f32>,
    /// a_d over g_d, the same for all triangles.
    pub accuracy_over_gsd: f64,
}

impl Target {
    /// `gsd`: g_d of the whole scene (what the user typed, else [`GSD_MARGIN`] times the median of the model).
    pub fn new(
        scene: &Scene,
        surface: &Surface,
        visibility: &Visibility,
        settings: &TargetSettings,
        gsd: f64,
        image_scale: f64,
    ) -> Self {
        let _ = (scene, visibility, image_scale);
        let accuracy = settings.accuracy.unwrap_or(gsd);
        Self {
            mode: TargetMode::Absolute,
            gsd: vec![gsd as f32; surface.triangles.len()],
            accuracy_over_gsd: accuracy / gsd,
        }
    }
}
