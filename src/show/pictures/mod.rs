//! Pictures of a plan: the curve, the surface with the state of each triangle, the views on a map, and confidence next to the image
//! that it was predicted from.

mod confidence;
mod curve;
mod geojson;
mod map;
mod surface;

pub use confidence::confidence_picture;
pub use curve::{Curve, curve_svg};
pub use geojson::views_geojson;
pub use map::footprints;
pub use surface::{RAMP, REASON_NUMBERS, follow, reason_number, surface_ply};
