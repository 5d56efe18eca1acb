//! Method 3.6: what is wanted of each triangle.

use crate::{
    config::{TargetMode, TargetSettings},
    scene::Scene,
    surface::Surface,
    visibility::Visibility,
};

/// How much coarser than the best view the wanted resolution is, when the target comes from the data.
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
    ///
    /// With `best`, g_d of a triangle is [`GSD_MARGIN`] times the finest ground sampling distance of the views that see it: depth over
    /// mean focal length in matched pixels. Where no view sees a triangle, that of the scene stands.
    pub fn new(
        scene: &Scene,
        surface: &Surface,
        visibility: &Visibility,
        settings: &TargetSettings,
        gsd: f64,
        image_scale: f64,
    ) -> Self {
        let accuracy_over_gsd = settings.accuracy.unwrap_or(gsd) / gsd;
        let best = match settings.mode {
            TargetMode::Auto => settings.gsd.is_none(),
            mode => mode == TargetMode::Best,
        };
        if !best {
            let gsd = vec![gsd as f32; surface.triangles.len()];
            return Self { mode: TargetMode::Absolute, gsd, accuracy_over_gsd };
        }
        let mut finest = vec![f32::INFINITY; surface.triangles.len()];
        for view in scene.view_indices() {
            let pose = &scene.view(view).cam_from_world;
            let focal = scene.camera_of(view).mean_focal_length() * image_scale;
            for &t in visibility.of(view) {
                let depth = pose.camera_from_world(&surface.centroid(t)).z.abs();
                let finest = &mut finest[t as usize];
                *finest = finest.min((GSD_MARGIN * depth / focal) as f32);
            }
        }
        finest.iter_mut().filter(|g| !(g.is_finite() && **g > 0.0)).for_each(|g| *g = gsd as f32);
        Self { mode: TargetMode::Best, gsd: finest, accuracy_over_gsd }
    }

    /// a_d of a triangle, scene units.
    pub fn accuracy(&self, triangle: u32) -> f64 {
        f64::from(self.gsd[triangle as usize]) * self.accuracy_over_gsd
    }
}
