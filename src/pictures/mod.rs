//! Pictures of a plan: the curve, and the surface with what is known of each triangle.

mod curve;
mod map;
mod surface;

pub use curve::{Curve, curve_svg};
pub use map::{MapFrame, footprint};
pub use surface::{REASON_NUMBERS, TriangleState, follow, surface_ply, triangle_states};
