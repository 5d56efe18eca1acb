//! Pictures of a plan: the curve, and the surface with what is known of each triangle.

mod curve;
mod surface;

pub use curve::{Curve, curve_svg};
pub use surface::{TriangleState, surface_ply, triangle_states};
