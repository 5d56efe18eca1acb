//! The wanted GSD of a place, on the surface or off it.

use nalgebra::Point3;

use crate::{
    config::TargetMode,
    method::target::GSD_MARGIN,
    model::scene::{Scene, ViewIndex},
    plan::Stages,
};

/// Octaves by which a place may be finer or coarser than the median image: a factor of a thousand.
/// Depths beyond are no measurements, and each octave costs every point a look.
const MOST_OCTAVES: f64 = 10.0;

/// `g_d` at any place (method 3.6): that of the settings, or [`GSD_MARGIN`] times the finest GSD of
/// the views in whose image the place is. A cloud has points where the surface has no triangle.
pub struct PlaceGsd<'a> {
    scene: &'a Scene,
    views: Vec<ViewIndex>,
    /// For the whole scene; `None` if it depends on the place.
    fixed: Option<f64>,
    /// Wanted GSD over that of the model's image.
    margin: f64,
    /// That of the median image, as the exponent of a power of two; `None` without points.
    median: Option<f64>,
}

impl<'a> PlaceGsd<'a> {
    pub fn new(stages: &'a Stages) -> Self {
        let fixed = stages
            .settings
            .target
            .gsd
            .filter(|_| stages.target.mode == TargetMode::Absolute);
        let margin = GSD_MARGIN / stages.settings.image_scale();
        Self {
            scene: &stages.scene,
            views: stages.scene.view_indices().collect(),
            fixed,
            margin,
            median: stages.image_gsd.map(|gsd| (margin * gsd).log2()),
        }
    }

    /// Returns the power of two nearest to `g_d`, as its exponent; `None` for a place in no image,
    /// and for one a thousand times nearer or farther than the scene.
    ///
    /// Cells of few sizes: their edges must fit together where `g_d` changes.
    pub fn octave(&self, place: &Point3<f64>) -> Option<i16> {
        let (octave, median) = match self.fixed {
            // With one size for all cells there are no others to search, so no place is too far
            // from the images' own.
            Some(gsd) => (gsd.log2().round(), None),
            None => (self.finest(place)?.log2().round(), self.median),
        };
        let is_near = median.is_none_or(|median| (octave - median).abs() <= MOST_OCTAVES);
        (is_near && octave.is_finite()).then_some(octave as i16)
    }

    fn finest(&self, place: &Point3<f64>) -> Option<f64> {
        let mut finest = f64::INFINITY;
        for &view in &self.views {
            let camera = self.scene.camera_of(view);
            let pose = &self.scene.view(view).cam_from_world;
            let x = pose.camera_from_world(place);
            let gsd = camera.depth(&x) / camera.mean_focal_length();
            // Most are coarser than one found before, and need not be projected.
            let is_finer = gsd > 0.0 && gsd < finest;
            if is_finer && camera.project(&x).is_some_and(|at| camera.contains(&at)) {
                finest = gsd;
            }
        }
        finest.is_finite().then_some(self.margin * finest)
    }
}
