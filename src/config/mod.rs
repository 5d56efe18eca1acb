//! `viewrank.toml`: every setting of the method with its unit, range and default, and where each
//! value came from.
//!
//! The structs are the one definition: defaults, the file's grammar, the checks, `viewrank config`,
//! the manifest's `settings` and the JSON Schema all come from them. `None` means "chosen from the
//! data or by the backend"; the manifest says what was chosen. `catalogue.rs` reads the definition
//! as a list of keys, `layers.rs` puts the files and the command line over the defaults,
//! `base/amounts.rs` of the core has the values that people write as "5%" or "2h".

mod catalogue;
mod dispatch;
mod layers;
mod region;

use std::path::{Path, PathBuf};

use schemars::JsonSchema;
use serde::{Deserialize, Deserializer, Serialize, de::Error};

use crate::base::paths::{absolute, is_outside};
pub use crate::{
    base::amounts::{Amount, AmountError, Budget, Bytes, Count, Share, TimeSpan},
    decision::{CutSettings, ForecastSettings},
};
pub use catalogue::{Key, keys};
pub use dispatch::DispatchSettings;
pub use layers::{
    BackendLookup, CommandLineSettings, ConfigError, Configuration, Files, SettingLocation, Source,
    TypedSetting, UnknownBackend, user_file,
};
pub use region::{RegionChoice, RegionChoiceError};

pub use crate::method::{
    confidence::{ConfidenceSettings, ConfidenceSource},
    fulfilment::{CoverageSettings, FulfilmentSettings},
    partners::{GateSettings, PartnerMethod, PartnerSettings},
    ranking::{RankingSettings, TriangleWeight},
    surface::{SurfaceChoice, SurfaceSettings},
    target::{TargetMode, TargetSettings},
    visibility::VisibilitySettings,
};
use crate::model::scene::Units;

/// All settings in force, nested as in `viewrank.toml`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// "metric" if a scene unit is a metre. Unset: "relative", of unknown length.
    pub units: Option<Units>,
    /// Size of the matched images over the model's images. A higher value matches at finer
    /// resolution. Unset: the backend's default.
    #[schemars(range(max = 16), extend("unit" = "matched px per model px", "exclusiveMinimum" = 0))]
    pub image_scale: Option<f64>,
    /// Seed of all random choices.
    pub seed: u64,
    /// Memory limit of planning ("8G"): larger surfaces are built in tiles, larger tables kept on
    /// disk, the rest refused. Unset: no limit.
    pub max_memory: Option<Bytes>,
    /// Backends to write files for; the plan is made for the first. Empty: the one that the project
    /// is set up for, else OpenMVS or a COLMAP with CUDA if installed, else "sgm".
    pub backends: Vec<String>,
    /// Shell command that `viewrank watch` runs once when a project's depth maps reach its target.
    /// In the user's own file only.
    #[schemars(extend("userOnly" = true))]
    pub on_target: Option<String>,
    /// Part of the scene that the plan is for (method 5.7): a file of GeoJSON polygons or a closed
    /// PLY mesh, a box "x0,y0,z0,x1,y1,z1" in the frame of the model, or "auto", the box with the
    /// most pixels per area. Nothing outside counts. Unset: the whole surface.
    pub region: Option<RegionChoice>,
    /// Folder to which the image names of the model are relative. Unset: where the images are
    /// found.
    pub images: Option<PathBuf>,
    /// Keeps every n-th view by name, from the first, apart for tests: of programs that use the
    /// images themselves, such as "splat" (method 5.10). 0: none. Unset: those that the model
    /// names, if any.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[serde(deserialize_with = "some_views")]
    #[schemars(extend("unit" = "views"))]
    pub test_every: Option<u32>,
    pub target: TargetSettings,
    pub coverage: CoverageSettings,
    pub fulfilment: FulfilmentSettings,
    pub surface: SurfaceSettings,
    pub visibility: VisibilitySettings,
    pub partners: PartnerSettings,
    pub confidence: ConfidenceSettings,
    pub pilot: PilotSettings,
    pub ranking: RankingSettings,
    pub cut: CutSettings,
    pub forecast: ForecastSettings,
    pub dispatch: DispatchSettings,
    pub frame: FrameSettings,
    /// Mesh and region as the user, or the file of the watched folder, has named them, not a
    /// project's file or its plan.
    #[serde(skip)]
    pub named: Vec<PathBuf>,
    /// Those that were typed, now or for the plan that this one goes on from.
    #[serde(skip)]
    pub typed: Vec<TypedSetting>,
}

/// Reads the n of every n-th view, of which 1 would leave none.
fn some_views<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<u32>, D::Error> {
    match Option::deserialize(deserializer)? {
        Some(1) => Err(D::Error::custom("must not be 1: that is every view")),
        n => Ok(n),
    }
}

impl Settings {
    /// Returns whether errors may quote the mesh or the region: it is in the project, which may be
    /// a stranger's, or the user has named it, by no link of the project.
    pub fn may_quote(&self, file: &Path, project: &Path) -> bool {
        // A path below the project that ends outside of it goes through one of its links.
        let is_through_project = || {
            absolute(file)
                .ancestors()
                .any(|above| !is_outside(above, project))
        };
        let is_named = self.named.iter().any(|named| named == file);
        !is_outside(file, project) || is_named && !is_through_project()
    }

    /// Returns whether the pilot's maps, the mesh or the region are outside. `watch` takes no such
    /// settings from a record in the project, which may be a stranger's.
    pub fn leads_out(&self, project: &Path) -> bool {
        let files = self
            .files_of_plan()
            .into_iter()
            .chain(self.pilot.maps.clone());
        files.into_iter().any(|file| is_outside(&file, project))
    }

    /// Returns the file that the setting names.
    fn file(&self, key: &str) -> Option<PathBuf> {
        match key {
            "region" => self.region.as_ref()?.file(),
            "surface.mesh" => self.surface.mesh.clone(),
            _ => None,
        }
    }

    /// Returns the files besides the model that a plan reads: the mesh and the region.
    pub fn files_of_plan(&self) -> Vec<PathBuf> {
        let files = ["surface.mesh", "region"].map(|key| self.file(key));
        files.into_iter().flatten().collect()
    }

    /// Returns the settings that affect a plan; the others have their defaults.
    pub fn for_plan(&self) -> Self {
        Self {
            dispatch: DispatchSettings::default(),
            on_target: None,
            ..self.clone()
        }
    }

    /// Returns the size of the matched images over the model's; 1 where neither the user nor a
    /// backend has chosen it.
    pub fn image_scale(&self) -> f64 {
        self.image_scale.unwrap_or(1.0)
    }
}

/// The pilot (method 5.9): all views matched small, before any is ranked.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct PilotSettings {
    /// Folder of small depth maps of the backend, in place of viewrank's own. Unset: thumbnails are
    /// matched.
    pub maps: Option<PathBuf>,
}

/// Georeference of the model. Unset: from the files of OpenSfM or OpenDroneMap, or recognised from
/// the size of earth-centred coordinates, or fitted to the GPS positions in the images; else
/// unknown.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct FrameSettings {
    /// Latitude, longitude (degrees) and height (metres, WGS 84) of the model's origin, where its
    /// axes are metres east, north and up.
    pub origin: Option<[f64; 3]>,
    /// Zone and hemisphere, as 33N, where the model's x and y are UTM coordinates.
    pub utm: Option<String>,
    /// Added to x and y to make them UTM coordinates.
    pub offset: Option<[f64; 2]>,
    /// Place a model without another georeference by the GPS positions in its images (EXIF), where
    /// most of them agree.
    pub gps: bool,
}

impl Default for FrameSettings {
    fn default() -> Self {
        Self {
            origin: None,
            utm: None,
            offset: None,
            gps: true,
        }
    }
}
