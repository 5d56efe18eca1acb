//! Pictures of a plan: the curve, the surface with the state of each triangle, the views on a map,
//! and confidence next to the image that it was predicted from.

mod confidence;
mod curve;
mod expected;
mod geojson;
mod map;
mod overview;
pub mod plot;
mod surface;

pub use confidence::{confidence_picture, in_colour};
pub use curve::{FulfilmentCurve, SHARE_LABEL, curve_svg};
pub use expected::expected_success;
pub use geojson::{views_file, views_geojson};
pub use map::footprints;
pub use overview::map_svg;
pub use surface::{RAMP, TriangleState, for_each_step, surface_ply, triangle_states};
