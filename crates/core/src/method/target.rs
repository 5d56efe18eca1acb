//! Wanted resolution and accuracy of each triangle (3.6 of [method 3]).
//!
//! One target for all triangles (`absolute`), or at each what the nearest views can give (`best`):
//!
//! ```text
//! g_d(t) = 1.25 · finest GSD of the views that see t          a_d(t) = g_d(t) · a_d / g_d
//! ```
//!
//! g_d is in scene units per pixel of the matched image, a_d, a standard deviation, in scene units.
//!
//! ```
//! use viewrank_core::method::{
//!     target::{Target, TargetMode, TargetSettings},
//!     visibility::Shown,
//! };
//!
//! // Of two triangles, no view sees the second.
//! let (views, pixels) = (vec![3, 0], vec![600.0, 0.0]);
//! let shown = Shown { views, pixels, finest_gsd: vec![0.25, f32::INFINITY] };
//! let target = Target::new(&shown, &TargetSettings::default(), 0.5, 1.0);
//! assert_eq!(target.mode, TargetMode::Best);
//! assert_eq!(target.gsd, [0.3125, 0.5]);
//!
//! let settings = TargetSettings { accuracy: Some(0.2), ..TargetSettings::default() };
//! let target = Target::new(&shown, &settings, 0.5, 1.0);
//! assert_eq!((target.mode, &target.gsd[..]), (TargetMode::Absolute, &[0.5, 0.5][..]));
//! assert!((target.accuracy(0) - 0.2).abs() < 1e-6);
//! ```
//!
//! [method 3]: https://github.com/viewrank/viewrank/blob/main/docs/method.md#3-fulfilment-of-a-triangle-by-a-cluster

use serde::{Deserialize, Serialize};

use crate::method::{region::Region, visibility::Shown};

/// Ratio of the wanted GSD to the available one, where the wanted one is derived from the data.
pub const GSD_MARGIN: f64 = 1.25;

/// Target quality on the surface.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct TargetSettings {
    /// Wanted ground sampling distance g_d. A higher value asks for less detail. Unset: 1.25 x the
    /// model's median.
    #[cfg_attr(feature = "schema", schemars(extend("unit" = "length/px", "exclusiveMinimum" = 0)))]
    pub gsd: Option<f64>,
    /// Wanted accuracy a_d: standard deviation of a point. A higher value accepts less exact
    /// points. Unset: as `gsd`.
    #[cfg_attr(feature = "schema", schemars(extend("unit" = "length", "exclusiveMinimum" = 0)))]
    pub accuracy: Option<f64>,
    /// One target for all ("absolute") or the best that any view has at the place ("best", method
    /// 3.6).
    pub mode: TargetMode,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "lowercase")]
pub enum TargetMode {
    /// `absolute` if `gsd` or `accuracy` is set, else `best`.
    #[default]
    Auto,
    Absolute,
    Best,
}

impl TargetSettings {
    /// Resolves `auto`: absolute if `gsd` or `accuracy` is set.
    pub fn mode_in_force(&self) -> TargetMode {
        match self.mode {
            TargetMode::Auto if self.gsd.or(self.accuracy).is_some() => TargetMode::Absolute,
            // One g_d for a scene that is 50 m deep here and 500 m there would call everything far
            // away a failure.
            TargetMode::Auto => TargetMode::Best,
            chosen => chosen,
        }
    }
}

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
    /// `gsd`: g_d of the whole scene (what the user typed, else [`GSD_MARGIN`] times the median of
    /// the model); it also holds for triangles that no view sees.
    ///
    /// In mode `Best`, `g_d(t)` is [`GSD_MARGIN`] times the finest of the views that see t, the GSD
    /// of a view at t being the depth of the centroid over the mean focal length (the distance
    /// where a camera has no depth: equirectangular), in pixels of the matched image.
    pub fn new(shown: &Shown, settings: &TargetSettings, gsd: f64, image_scale: f64) -> Self {
        let mode = settings.mode_in_force();
        let accuracy_over_gsd = settings.accuracy.map_or(1.0, |accuracy| accuracy / gsd);
        let wanted = |&finest: &f32| {
            // The margin leaves room for views from a little farther away.
            let wanted = (GSD_MARGIN * f64::from(finest) / image_scale) as f32;
            if mode == TargetMode::Best && wanted.is_finite() && wanted > 0.0 {
                wanted
            } else {
                gsd as f32
            }
        };
        Self {
            mode,
            gsd: shown.finest_gsd.iter().map(wanted).collect(),
            accuracy_over_gsd,
        }
    }

    /// Replaces g_d where the areas of a region set their own (method 5.7).
    pub fn with_wishes(mut self, region: &Region) -> Self {
        let wishes = self
            .gsd
            .iter_mut()
            .zip(&region.gsd)
            .filter(|(_, wanted)| wanted.is_finite());
        wishes.for_each(|(gsd, &wanted)| *gsd = wanted);
        self
    }

    /// Returns the wanted accuracy a_d of a triangle, scene units.
    pub fn accuracy(&self, triangle: u32) -> f64 {
        f64::from(self.gsd[triangle as usize]) * self.accuracy_over_gsd
    }
}
