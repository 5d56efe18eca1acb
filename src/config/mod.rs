//! `viewrank.toml`: every setting of the method with its unit, range and default, and where each
//! value came from.
//!
//! The structs are the one definition: defaults, the file's grammar, the checks, `viewrank config`,
//! the manifest's `settings` and the JSON Schema all come from them. `None` means "chosen from the
//! data or by the backend"; the manifest says what was chosen. `catalogue.rs` reads the definition
//! as a list of keys, `layers.rs` puts the files and the command line over the defaults,
//! `amounts.rs` has the values that people write as "5%" or "2h".

mod amounts;
mod catalogue;
mod dispatch;
mod layers;
mod region;

use std::{fmt, path::PathBuf};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

pub use amounts::{Amount, AmountError, Budget, Bytes, Count, Share, TimeSpan};
pub use catalogue::{Key, keys};
pub use dispatch::DispatchSettings;
pub use layers::{
    BackendLookup, CommandLineSettings, ConfigError, Configuration, Files, SettingLocation, Source,
    UnknownBackend, user_file,
};
pub use region::{RegionChoice, RegionChoiceError};

use crate::model::{cluster::MapScale, scene::Units};

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
    /// Returns the files besides the model that a plan reads: the mesh and the region.
    pub fn files_of_plan(&self) -> Vec<PathBuf> {
        self.surface
            .mesh
            .iter()
            .cloned()
            .chain(self.region.as_ref().and_then(RegionChoice::file))
            .collect()
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

/// Target quality on the surface.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct TargetSettings {
    /// Wanted ground sampling distance g_d. A higher value asks for less detail. Unset: 1.25 x the
    /// model's median.
    #[schemars(extend("unit" = "length/px", "exclusiveMinimum" = 0))]
    pub gsd: Option<f64>,
    /// Wanted accuracy a_d: standard deviation of a point. A higher value accepts less exact
    /// points. Unset: as `gsd`.
    #[schemars(extend("unit" = "length", "exclusiveMinimum" = 0))]
    pub accuracy: Option<f64>,
    /// One target for all ("absolute") or the best that any view has at the place ("best", method
    /// 3.6).
    pub mode: TargetMode,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum TargetMode {
    /// `absolute` if `gsd` or `accuracy` is set, else `best`.
    #[default]
    Auto,
    Absolute,
    Best,
}

impl TargetMode {
    /// Resolves `auto`; `target_is_given`: `gsd` or `accuracy` is set.
    pub fn in_force(self, target_is_given: bool) -> Self {
        match self {
            Self::Auto if target_is_given => Self::Absolute,
            Self::Auto => Self::Best,
            chosen => chosen,
        }
    }
}

/// Method 3.1.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct CoverageSettings {
    /// Cameras that must see a triangle, the key view included (x). A higher value demands more
    /// overlap. With k = 1: 2.
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
    /// Weight of resolution against uncertainty, 0 to 1 (alpha). A higher value counts resolution
    /// more.
    #[schemars(range(min = 0, max = 1))]
    pub alpha: f64,
    /// Standard deviation of a match, pixels of the matched image (sigma_px). A higher value
    /// predicts less accurate points.
    #[schemars(extend("unit" = "px", "exclusiveMinimum" = 0))]
    pub sigma_px: f64,
}

impl Default for FulfilmentSettings {
    fn default() -> Self {
        Self {
            alpha: 0.5,
            sigma_px: 0.5,
        }
    }
}

/// Kind of surface to build.
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
    /// Carved from the 3D Delaunay triangulation of the points ("3d"), or 2.5D for nadir flights
    /// ("terrain").
    pub kind: SurfaceChoice,
    /// Simplification: 95 % of the edges above `edge_factor` x g_d (r). A higher value gives larger
    /// triangles and a faster plan.
    #[schemars(extend("unit" = "g_d", "exclusiveMinimum" = 0))]
    pub edge_factor: f64,
    /// Refinement: every edge below `max_edge_factor` x g_d (e). A higher value allows longer
    /// edges.
    #[schemars(extend("unit" = "g_d", "exclusiveMinimum" = 0))]
    pub max_edge_factor: f64,
    /// Weight of one ray in the cut (alpha_vis). A higher value follows the rays more closely and
    /// smooths less.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub ray_weight: f64,
    /// Soft visibility: sigma over the median depth uncertainty of the points. A higher value
    /// tolerates noisier points and loses fine detail.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub sigma_factor: f64,
    /// Distance behind a point, in sigma, at which the inside begins (k). A higher value loses more
    /// thin parts.
    #[schemars(extend("unit" = "sigma", "exclusiveMinimum" = 0))]
    pub behind_sigma: f64,
    /// Weight of the facets' quality in the cut (lambda). A higher value gives a smoother surface.
    #[schemars(range(min = 0))]
    pub quality_weight: f64,
    /// Largest number of rays per point in the cut; the angular extremes are kept. A higher value
    /// takes longer.
    #[schemars(range(min = 1), extend("unit" = "rays"))]
    pub rays_per_point: u32,
    /// PLY file, in the frame of the model, to use instead of a surface from the points.
    pub mesh: Option<PathBuf>,
    /// Use the mesh as it is, neither simplified nor refined.
    pub mesh_as_is: bool,
    /// Up direction of the terrain surface, world coordinates. Unset: from the cameras and the
    /// points.
    pub up: Option<[f64; 3]>,
    /// Largest number of points of a tile; a surface with more points is built in overlapping
    /// tiles. A higher value needs more memory. Unset: as `max_memory` requires, else one tile.
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
    /// Largest angle between a triangle's normal and the direction to the camera, degrees. A higher
    /// value admits more oblique views.
    #[schemars(range(max = 90), extend("unit" = "degrees", "exclusiveMinimum" = 0))]
    pub max_incidence_deg: f64,
    /// Share of a triangle's samples that must be unoccluded. A higher value counts fewer views as
    /// seeing it.
    #[schemars(range(min = 0, max = 1))]
    pub min_free_share: f64,
    /// Tolerance in front of a triangle, in units of `surface.edge_factor` x g_d. A higher value
    /// counts fewer triangles as occluded.
    #[schemars(range(min = 0), extend("unit" = "edge_factor x g_d"))]
    pub tolerance_edges: f64,
    /// Tolerance in front of a triangle, share of the depth; the larger of the two counts. A higher
    /// value counts fewer triangles as occluded.
    #[schemars(range(min = 0), extend("unit" = "of the depth"))]
    pub tolerance_depth: f64,
    /// Long side of the id buffer, pixels. A higher value resolves smaller occlusions and takes
    /// longer.
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
    /// The paper's random combinations.
    Sampled,
    /// Local search by exchange, from the better of `sampled` and greedy addition.
    #[default]
    Search,
}

/// Method 4.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct PartnerSettings {
    /// Partners per key view (k). A higher value matches more pairs per depth map.
    #[schemars(range(min = 1), extend("unit" = "partners"))]
    pub k: u32,
    /// Candidates per key view, by shared points (n). A higher value offers more choice and takes
    /// longer.
    #[schemars(range(min = 1), extend("unit" = "views"))]
    pub candidates: u32,
    /// Random combinations per key view (y). A higher value takes longer.
    #[schemars(range(min = 1, max = 100_000), extend("unit" = "combinations"))]
    pub draws: u32,
    /// Every z-th triangle rates the combinations (z). A higher value is faster and less exact.
    #[schemars(range(min = 1), extend("unit" = "triangles"))]
    pub triangle_fraction: u32,
    /// Choice of partners: the paper's random combinations ("sampled"), or local search that starts
    /// from the best of them ("search").
    pub method: PartnerMethod,
    pub gate: GateSettings,
}

impl Default for PartnerSettings {
    fn default() -> Self {
        Self {
            k: 5,
            candidates: 22,
            draws: 100,
            triangle_fraction: 10,
            method: PartnerMethod::Search,
            gate: GateSettings::default(),
        }
    }
}

/// Method 7.1: pairs beyond these limits are partners only where others are missing. Unset numbers
/// are the backend's.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct GateSettings {
    /// Least number of sparse points that both views observe. A higher value refuses weakly
    /// connected pairs. Unset: the backend's.
    #[schemars(range(min = 1), extend("unit" = "points"))]
    pub min_shared_points: Option<u32>,
    /// Least median triangulation angle at the shared points, degrees. A higher value refuses short
    /// baselines. Unset: the backend's.
    #[schemars(range(min = 0, max = 180), extend("unit" = "degrees"))]
    pub min_angle: Option<f64>,
    /// Largest median triangulation angle, degrees. A higher value admits wider baselines. Unset:
    /// the backend's.
    #[schemars(range(min = 0, max = 180), extend("unit" = "degrees"))]
    pub max_angle: Option<f64>,
    /// Largest median ratio of the two images' scales, octaves. A higher value admits pairs of
    /// different scale. Unset: the backend's.
    #[schemars(range(min = 0), extend("unit" = "octaves"))]
    pub max_scale_octaves: Option<f64>,
    /// True if the centre of one camera may project into the image of the other. Unset: the
    /// backend's.
    pub epipole_inside: Option<bool>,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum ConfidenceSource {
    /// `photometric` where there are images, else `geometric`.
    #[default]
    Auto,
    /// Agreement of the pictures on the surface (method 7.4).
    Photometric,
    /// Angles and scales of the pair, and the sparse points around; needs no image (method 7.2).
    Geometric,
    /// Every match succeeds: the paper's NoCP.
    None,
}

impl fmt::Display for ConfidenceSource {
    /// As in the settings.
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            Self::Auto => "auto",
            Self::Photometric => "photometric",
            Self::Geometric => "geometric",
            Self::None => "none",
        })
    }
}

impl ConfidenceSource {
    /// Resolves `auto`.
    pub fn in_force(self, has_images: bool) -> Self {
        match self {
            Self::Auto if has_images => Self::Photometric,
            Self::Auto => Self::Geometric,
            source => source,
        }
    }
}

/// Method 7. Unset numbers are the backend's; in a manifest, numbers that the source of confidence
/// does not use are unset.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ConfidenceSettings {
    /// What predicts success.
    pub source: ConfidenceSource,
    /// Probability of a match in the best constellation. A higher value expects more matches to
    /// succeed.
    #[schemars(range(max = 1), extend("exclusiveMinimum" = 0))]
    pub p0: Option<f64>,
    /// Power of the cosine of incidence (gamma). A higher value penalises oblique views more.
    #[schemars(range(min = 0))]
    pub cosine_power: Option<f64>,
    /// Standard deviation of the scale ratio, octaves (s). A higher value tolerates larger
    /// differences of scale; 0: scale is ignored.
    #[schemars(range(min = 0), extend("unit" = "octaves"))]
    pub scale_octaves: Option<f64>,
    /// Triangulation angle from which a match has full confidence, degrees (a). A higher value
    /// penalises short baselines more; 0: no penalty.
    #[schemars(range(min = 0, max = 180), extend("unit" = "degrees"))]
    pub full_angle: Option<f64>,
    /// Chance of a match where the two pictures agree on the surface. A higher value expects more
    /// of each pair.
    #[schemars(range(max = 1), extend("exclusiveMinimum" = 0))]
    pub agree: Option<f64>,
    /// Chance of a match where they don't. A higher value trusts the pictures less; at most
    /// `agree`.
    #[schemars(range(min = 0, max = 1))]
    pub differ: Option<f64>,
    /// Correlation of the two pictures from which they count as in full agreement. A higher value
    /// asks for more alike pictures.
    #[schemars(range(max = 1), extend("exclusiveMinimum" = 0))]
    pub full_agreement: Option<f64>,
    /// Matches that must succeed for a pixel, 1 to 3. A higher value is stricter.
    #[schemars(range(min = 1, max = 3), extend("unit" = "matches"))]
    pub min_matches: Option<u32>,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum TriangleWeight {
    /// Its number of pixels, averaged over the views that see it.
    #[default]
    Pixels,
    /// Its area.
    Area,
    /// Equal for all triangles, as in the paper.
    Count,
}

/// Default of `ranking.half_worth`, chosen by clouds that OpenMVS fused (method 5.8).
const HALF_WORTH: f64 = 0.8;

/// Method 5.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct RankingSettings {
    /// Depth maps that must see a triangle (m, method 5.2). A higher value asks for more overlap.
    /// Unset: the backend's.
    #[schemars(range(min = 1, max = 100), extend("unit" = "depth maps"))]
    pub support: Option<u32>,
    /// Weight of a triangle in the plan: "pixels" favours surfaces that the photographs show in
    /// detail, "area" large surfaces, "count" none.
    pub weight: TriangleWeight,
    /// Largest shift, in any image of its cluster, up to which a finished depth map stays in the
    /// plan of a changed model. A higher value keeps more maps.
    #[schemars(range(min = 0), extend("unit" = "px"))]
    pub keep_px: f64,
    /// Sizes at which a depth map may be matched, over `image_scale`: [1], or [1, 0.5] to match
    /// each key view at the one with which the plan gives most for its work. For backends that can
    /// match key views at different sizes.
    #[schemars(length(min = 1, max = 2))]
    pub scales: Vec<MapScale>,
    /// Part of the loss of a half-size depth map, in resolution and accuracy, that does not count:
    /// 0 plans by what it fulfils, 1 by what it covers. A higher value plans more coarse maps.
    #[schemars(range(min = 0, max = 1))]
    pub half_worth: f64,
}

impl RankingSettings {
    /// Returns true if depth maps may be matched at half the size.
    pub fn has_half(&self) -> bool {
        self.scales.contains(&MapScale::Half)
    }
}

impl Default for RankingSettings {
    fn default() -> Self {
        Self {
            support: None,
            weight: TriangleWeight::default(),
            keep_px: 1.0,
            scales: vec![MapScale::Full],
            half_worth: HALF_WORTH,
        }
    }
}

/// Method 5.3; the first limit reached ends the plan. All unset: a target of 90 %.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct CutSettings {
    /// Clusters ("40"), or a share of the registered views ("5%").
    pub budget: Option<Budget>,
    /// Share of what all clusters together reach ("80%").
    pub target: Option<Share>,
    /// Forecast time of matching ("2h", "90min", "1d6h").
    pub time: Option<TimeSpan>,
    /// Forecast points of all depth maps ("50M").
    pub points: Option<Count>,
}

impl CutSettings {
    /// Number of limits that are set.
    pub fn limits(&self) -> usize {
        [
            self.budget.is_some(),
            self.target.is_some(),
            self.time.is_some(),
            self.points.is_some(),
        ]
        .into_iter()
        .filter(|is_set| *is_set)
        .count()
    }
}

/// Inputs to the forecast of time and points; unset where unknown.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ForecastSettings {
    /// Seconds of matching per (key view, partner) pair.
    #[schemars(range(min = 0), extend("unit" = "s"))]
    pub seconds_per_pair: Option<f64>,
    /// Seconds of matching per depth map, in addition to its pairs.
    #[schemars(range(min = 0), extend("unit" = "s"))]
    pub seconds_per_map: Option<f64>,
    /// Points of a depth map before fusion. Unset: the predicted number of measured pixels.
    #[schemars(extend("unit" = "points", "exclusiveMinimum" = 0))]
    pub points_per_map: Option<f64>,
}

impl ForecastSettings {
    /// Returns whether matching times can be forecast.
    pub fn knows_times(&self) -> bool {
        self.seconds_per_map.is_some() || self.seconds_per_pair.is_some()
    }
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
