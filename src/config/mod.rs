//! `viewrank.toml`: every setting of the method with its unit, range and default, and where each value came from.
//!
//! The structs are the one definition: defaults, the file's grammar, the checks, `viewrank config`, the manifest's `settings` and
//! the JSON Schema all come from them. `None` means "chosen from the data or by the backend"; the manifest says what was chosen.
//! `catalogue.rs` reads the definition as a list of keys, `layers.rs` puts the files and the command line over the defaults,
//! `amounts.rs` has the values that people write as "5%" or "2h".

mod amounts;
mod catalogue;
mod layers;

use std::path::PathBuf;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

pub use amounts::{Amount, AmountError, Budget, Bytes, Count, Duration, Share};
pub use catalogue::{Key, keys};
pub use layers::{
    CONFIDENCE_WORDS, ConfigError, Configuration, Files, NameOf, Place, Source, Typed, UnknownBackend, user_file,
};

use crate::model::scene::Units;

/// All settings in force, nested as in `viewrank.toml`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Is a scene unit a metre? Unset: "relative", its length is not known.
    pub units: Option<Units>,
    /// Size of the matched images over the model's images.
    #[schemars(range(max = 16), extend("unit" = "matched px per model px", "exclusiveMinimum" = 0))]
    pub image_scale: f64,
    /// Seed of all random choices.
    pub seed: u64,
    /// Memory that planning may take ("8G"): what needs more is built in tiles, kept on disk, or refused. Unset: no limit.
    pub max_memory: Option<Bytes>,
    /// Backends to write files for; the plan is made for the first. Empty: the one that the project is set up for, else "sure".
    pub backends: Vec<String>,
    /// What `viewrank watch` has the shell run once when a project's target is reached by its depth maps. In the user's own file only.
    #[schemars(extend("userOnly" = true))]
    pub on_target: Option<String>,
    pub target: TargetSettings,
    pub coverage: CoverageSettings,
    pub fulfilment: FulfilmentSettings,
    pub surface: SurfaceSettings,
    pub visibility: VisibilitySettings,
    pub partners: PartnerSettings,
    pub confidence: ConfidenceSettings,
    pub ranking: RankingSettings,
    pub cut: CutSettings,
    pub forecast: ForecastSettings,
    pub dispatch: DispatchSettings,
    pub frame: FrameSettings,
}

impl Settings {
    /// Those that a plan follows from; the others have their defaults.
    pub fn of_plan(&self) -> Self {
        Self { dispatch: DispatchSettings::default(), on_target: None, ..self.clone() }
    }
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            units: None,
            image_scale: 1.0,
            seed: 0,
            max_memory: None,
            backends: Vec::new(),
            target: TargetSettings::default(),
            coverage: CoverageSettings::default(),
            fulfilment: FulfilmentSettings::default(),
            surface: SurfaceSettings::default(),
            visibility: VisibilitySettings::default(),
            partners: PartnerSettings::default(),
            confidence: ConfidenceSettings::default(),
            ranking: RankingSettings::default(),
            cut: CutSettings::default(),
            forecast: ForecastSettings::default(),
            dispatch: DispatchSettings::default(),
            on_target: None,
            frame: FrameSettings::default(),
        }
    }
}

/// What is wanted on the surface.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct TargetSettings {
    /// Wanted ground sampling distance g_d. Unset: 1.25 x the model's median.
    #[schemars(extend("unit" = "length/px", "exclusiveMinimum" = 0))]
    pub gsd: Option<f64>,
    /// Wanted accuracy a_d: standard deviation of a point. Unset: as `gsd`.
    #[schemars(extend("unit" = "length", "exclusiveMinimum" = 0))]
    pub accuracy: Option<f64>,
    /// One target for all ("absolute") or the best that any view has at the place ("best", method 3.6).
    pub mode: TargetMode,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum TargetMode {
    /// `best` where no `gsd` is given, else `absolute`.
    #[default]
    Auto,
    Absolute,
    Best,
}

impl TargetMode {
    /// What `auto` means where a ground sampling distance is given, or not.
    pub fn in_force(self, gsd_is_given: bool) -> Self {
        match self {
            Self::Auto if gsd_is_given => Self::Absolute,
            Self::Auto => Self::Best,
            chosen => chosen,
        }
    }
}

/// Method 3.1.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct CoverageSettings {
    /// Cameras that must see a triangle, the key view included (x). With k = 1: 2.
    #[schemars(range(min = 2), extend("unit" = "cameras"))]
    pub min_cameras: u32,
}

impl Default for CoverageSettings {
    fn default() -> Self {
        Self { min_cameras: 3 }
    }
}

/// Method 3.2 to 3.5.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct FulfilmentSettings {
    /// Weight of resolution against uncertainty, 0 to 1 (alpha).
    #[schemars(range(min = 0, max = 1))]
    pub alpha: f64,
    /// Standard deviation of a match, pixels of the matched image (sigma_px).
    #[schemars(extend("unit" = "px", "exclusiveMinimum" = 0))]
    pub sigma_px: f64,
}

impl Default for FulfilmentSettings {
    fn default() -> Self {
        Self { alpha: 0.5, sigma_px: 0.5 }
    }
}

/// Which surface is built.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum SurfaceChoice {
    #[default]
    Auto,
    #[serde(rename = "3d")]
    Carved,
    Terrain,
}

/// Method 1.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct SurfaceSettings {
    /// Carved from the 3D Delaunay triangulation of the points ("3d"), or 2.5D for nadir flights ("terrain").
    pub kind: SurfaceChoice,
    /// Simplification: 95 % of the edges above `edge_factor` x g_d (r).
    #[schemars(extend("unit" = "g_d", "exclusiveMinimum" = 0))]
    pub edge_factor: f64,
    /// Refinement: every edge below `max_edge_factor` x g_d (e).
    #[schemars(extend("unit" = "g_d", "exclusiveMinimum" = 0))]
    pub max_edge_factor: f64,
    /// Weight of one ray in the cut (alpha_vis).
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub ray_weight: f64,
    /// Soft visibility: sigma over the median depth uncertainty of the points.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub sigma_factor: f64,
    /// Distance behind a point, in sigma, at which the inside begins (k).
    #[schemars(extend("unit" = "sigma", "exclusiveMinimum" = 0))]
    pub behind_sigma: f64,
    /// Weight of the facets' quality in the cut (lambda).
    #[schemars(range(min = 0))]
    pub quality_weight: f64,
    /// Most rays per point that the cut uses; the angular extremes are kept.
    #[schemars(range(min = 1), extend("unit" = "rays"))]
    pub rays_per_point: u32,
    /// A PLY file in the frame of the model that is taken instead of a surface from the points.
    pub mesh: Option<PathBuf>,
    /// Take the mesh as it is, neither simplified nor refined.
    pub mesh_as_is: bool,
    /// Up direction of the terrain surface, world coordinates. Unset: from the cameras and the points.
    pub up: Option<[f64; 3]>,
    /// Most points of a tile; a surface of more is built in overlapping tiles. Unset: as `max_memory` wants it, else all in one.
    #[schemars(range(min = 1), extend("unit" = "points"))]
    pub tile_points: Option<u32>,
}

impl Default for SurfaceSettings {
    fn default() -> Self {
        Self {
            kind: SurfaceChoice::Auto,
            edge_factor: 20.0,
            max_edge_factor: 100.0,
            ray_weight: 1.0,
            sigma_factor: 1.0,
            behind_sigma: 3.0,
            quality_weight: 0.5,
            rays_per_point: 4,
            mesh: None,
            mesh_as_is: false,
            up: None,
            tile_points: None,
        }
    }
}

/// Method 2.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct VisibilitySettings {
    /// Largest angle between a triangle's normal and the direction to the camera, degrees.
    #[schemars(range(max = 90), extend("unit" = "degrees", "exclusiveMinimum" = 0))]
    pub max_incidence_deg: f64,
    /// Share of the samples of a triangle that must be free.
    #[schemars(range(min = 0, max = 1))]
    pub min_free_share: f64,
    /// Tolerance in front of a triangle, in units of `surface.edge_factor` x g_d.
    #[schemars(range(min = 0), extend("unit" = "edge_factor x g_d"))]
    pub tolerance_edges: f64,
    /// Tolerance in front of a triangle, share of the depth; the larger of the two counts.
    #[schemars(range(min = 0), extend("unit" = "of the depth"))]
    pub tolerance_depth: f64,
    /// Long side of the id buffer, pixels.
    #[schemars(range(min = 16, max = 4096), extend("unit" = "px"))]
    pub buffer_px: u32,
}

impl Default for VisibilitySettings {
    fn default() -> Self {
        Self {
            max_incidence_deg: 85.0,
            min_free_share: 0.5,
            tolerance_edges: 0.1,
            tolerance_depth: 0.005,
            buffer_px: 700,
        }
    }
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum PartnerMethod {
    /// The paper's drawn combinations.
    Sampled,
    /// Exchange from the best of `sampled` and greedy addition.
    #[default]
    Search,
}

/// Method 4.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct PartnerSettings {
    /// Partners per key view (k).
    #[schemars(range(min = 1), extend("unit" = "partners"))]
    pub k: u32,
    /// Candidates per key view, by shared points (n).
    #[schemars(range(min = 1), extend("unit" = "views"))]
    pub candidates: u32,
    /// Combinations drawn (y).
    #[schemars(range(min = 1, max = 100_000), extend("unit" = "combinations"))]
    pub draws: u32,
    /// One of so many triangles judges the draws (z).
    #[schemars(range(min = 1), extend("unit" = "triangles"))]
    pub triangle_fraction: u32,
    /// How partners are chosen: the paper's drawn combinations, or search from the best of them on.
    pub method: PartnerMethod,
}

impl Default for PartnerSettings {
    fn default() -> Self {
        Self { k: 5, candidates: 22, draws: 100, triangle_fraction: 10, method: PartnerMethod::Search }
    }
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum ConfidenceForm {
    /// Probability of each pair (method 7.2 and the trained constellation).
    #[default]
    Pair,
    /// Mean of the two unary confidences (method 3.4).
    Paper,
}

/// Method 7. Unset numbers are the backend's; in a manifest those that what predicts success does not heed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ConfidenceSettings {
    /// What predicts success: "photometric" (do the pictures agree on the surface?), "geometric" (angles and scales; needs no image), "none", "proxy",
    /// "shipped", "project" or a model file. "auto": the project's own model, else photometric where there are images, else geometric.
    pub source: String,
    /// The chance of each pair, or the paper's mean of the two unary confidences.
    pub form: ConfidenceForm,
    /// Chance of a match in the best constellation.
    #[schemars(range(max = 1), extend("exclusiveMinimum" = 0))]
    pub p0: Option<f64>,
    /// Power of the cosine of incidence (gamma).
    #[schemars(range(min = 0))]
    pub cosine_power: Option<f64>,
    /// Standard deviation of the scale ratio, octaves (s); 0: scale does no harm.
    #[schemars(range(min = 0), extend("unit" = "octaves"))]
    pub scale_octaves: Option<f64>,
    /// Triangulation angle from which a match is as good as any, degrees (a); 0: none.
    #[schemars(range(min = 0, max = 180), extend("unit" = "degrees"))]
    pub full_angle: Option<f64>,
    /// Matches that must succeed for a pixel, 1 to 3.
    #[schemars(range(min = 1, max = 3), extend("unit" = "matches"))]
    pub min_matches: Option<u32>,
}

impl Default for ConfidenceSettings {
    fn default() -> Self {
        Self {
            source: "auto".into(),
            form: ConfidenceForm::Pair,
            p0: None,
            cosine_power: None,
            scale_octaves: None,
            full_angle: None,
            min_matches: None,
        }
    }
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum TriangleWeight {
    /// Pixels: the mean over the views that see it.
    #[default]
    Pixels,
    /// Its area.
    Area,
    /// The same as every other, as in the paper.
    Count,
}

/// Method 5.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct RankingSettings {
    /// Depth maps that must see a triangle (m, method 5.2). Unset: the backend's.
    #[schemars(range(min = 1, max = 100), extend("unit" = "depth maps"))]
    pub support: Option<u32>,
    /// What a triangle of the surface counts in the plan: by default its pixels, so that the plan is for what the photographs show most of.
    pub weight: TriangleWeight,
    /// A finished depth map stays in the plan of a changed model while what it shows moved by no more than this in any image of its
    /// cluster.
    #[schemars(range(min = 0), extend("unit" = "px"))]
    pub keep_px: f64,
}

impl Default for RankingSettings {
    fn default() -> Self {
        Self { support: None, weight: TriangleWeight::default(), keep_px: 1.0 }
    }
}

/// Method 5.3; the first that is reached cuts. All unset: a target of 90 %.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct CutSettings {
    /// Clusters ("40"), or a share of the registered views ("5%").
    pub budget: Option<Budget>,
    /// Share of what all clusters together reach ("80%").
    pub target: Option<Share>,
    /// Forecast time of matching ("2h", "90min", "1d6h").
    pub time: Option<Duration>,
    /// Forecast points of all depth maps ("50M").
    pub points: Option<Count>,
}

/// What the forecast of time and points is made from; unset where unknown.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ForecastSettings {
    /// Seconds of matching per (key view, partner) pair.
    #[schemars(range(min = 0), extend("unit" = "s"))]
    pub seconds_per_pair: Option<f64>,
    /// Seconds of matching per depth map beside its pairs.
    #[schemars(range(min = 0), extend("unit" = "s"))]
    pub seconds_per_map: Option<f64>,
    /// Points that a depth map has before fusion. Unset: the pixels that are expected to be measured.
    #[schemars(extend("unit" = "points", "exclusiveMinimum" = 0))]
    pub points_per_map: Option<f64>,
}

impl ForecastSettings {
    /// Is it known how long matching takes?
    pub fn knows_times(&self) -> bool {
        self.seconds_per_map.is_some() || self.seconds_per_pair.is_some()
    }
}

/// What `viewrank dispatch` asks of a queue for each view cluster. No part of a plan: manifests hold the defaults.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct DispatchSettings {
    /// Partition of the queue. Unset: the queue's default.
    pub partition: Option<String>,
    /// Account that the work is charged to.
    pub account: Option<String>,
    /// Quality of service.
    pub qos: Option<String>,
    /// Longest time that a depth map may take ("2h").
    pub time: Option<Duration>,
    /// Memory of a task ("8G").
    pub memory: Option<Bytes>,
    /// CPUs of a task, and threads of the backend.
    #[schemars(range(min = 1), extend("unit" = "CPUs"))]
    pub cpus: u32,
    /// GPUs of a task.
    #[schemars(range(min = 1), extend("unit" = "GPUs"))]
    pub gpus: Option<u32>,
    /// Tasks that may run at once. Unset: as many as the queue lets.
    #[schemars(range(min = 1), extend("unit" = "tasks"))]
    pub at_once: Option<u32>,
    /// Further options of `sbatch`. In the user's own file only.
    #[schemars(extend("userOnly" = true))]
    pub options: Vec<String>,
    /// Lines of sh that each task begins with, such as "module load colmap". In the user's own file only.
    #[schemars(extend("userOnly" = true))]
    pub setup: String,
}

impl Default for DispatchSettings {
    fn default() -> Self {
        Self {
            partition: None,
            account: None,
            qos: None,
            time: None,
            memory: None,
            cpus: 1,
            gpus: None,
            at_once: None,
            options: Vec::new(),
            setup: String::new(),
        }
    }
}

/// Where on the earth the model lies. Unset: as OpenSfM or OpenDroneMap say beside their models, or earth-centred coordinates are known by
/// their size; else it is not known.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct FrameSettings {
    /// Latitude, longitude (degrees) and height (metres, WGS 84) of the model's origin, where its axes are metres east, north and up.
    pub origin: Option<[f64; 3]>,
    /// Zone and hemisphere, as 33N, where the model's x and y are UTM coordinates.
    pub utm: Option<String>,
    /// Added to x and y to make them UTM coordinates.
    pub offset: Option<[f64; 2]>,
}
