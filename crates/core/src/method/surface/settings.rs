//! Options of the surface.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

/// Kind of surface to build.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "lowercase")]
pub enum SurfaceChoice {
    #[default]
    Auto,
    #[serde(rename = "3d")]
    Carved,
    Terrain,
}

/// Method 1.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct SurfaceSettings {
    /// Carved from the 3D Delaunay triangulation of the points ("3d"), or 2.5D for nadir flights
    /// ("terrain").
    pub kind: SurfaceChoice,
    /// Simplification: 95 % of the edges above `edge_factor` x g_d (r). A higher value gives larger
    /// triangles and a faster plan.
    #[cfg_attr(feature = "schema", schemars(extend("unit" = "g_d", "exclusiveMinimum" = 0)))]
    pub edge_factor: f64,
    /// Refinement: every edge below `max_edge_factor` x g_d (e). A higher value allows longer
    /// edges.
    #[cfg_attr(feature = "schema", schemars(extend("unit" = "g_d", "exclusiveMinimum" = 0)))]
    pub max_edge_factor: f64,
    /// Weight of one ray in the cut (alpha_vis). A higher value follows the rays more closely and
    /// smooths less.
    #[cfg_attr(feature = "schema", schemars(extend("exclusiveMinimum" = 0)))]
    pub ray_weight: f64,
    /// Soft visibility: sigma over the median depth uncertainty of the points. A higher value
    /// tolerates noisier points and loses fine detail.
    #[cfg_attr(feature = "schema", schemars(extend("exclusiveMinimum" = 0)))]
    pub sigma_factor: f64,
    /// Distance behind a point, in sigma, at which the inside begins (k). A higher value loses more
    /// thin parts.
    #[cfg_attr(feature = "schema", schemars(extend("unit" = "sigma", "exclusiveMinimum" = 0)))]
    pub behind_sigma: f64,
    /// Weight of the facets' quality in the cut (lambda). A higher value gives a smoother surface.
    #[cfg_attr(feature = "schema", schemars(range(min = 0)))]
    pub quality_weight: f64,
    /// Largest number of rays per point in the cut; the angular extremes are kept. A higher value
    /// takes longer.
    #[cfg_attr(feature = "schema", schemars(range(min = 1), extend("unit" = "rays")))]
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
    #[cfg_attr(feature = "schema", schemars(range(min = 1), extend("unit" = "points")))]
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
            // With 5, the value of Labatut et al., a quarter of the surface of `valley` is lost;
            // from 0.05 to 1.5 it is the same.
            quality_weight: 0.5,
            // With 2 to 8, the surface of `valley` is the same.
            rays_per_point: 4,
            mesh: None,
            mesh_as_is: false,
            up: None,
            tile_points: None,
        }
    }
}
