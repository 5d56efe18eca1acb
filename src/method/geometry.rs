//! What is known of a scene before anything is said of confidence: which view sees which triangle, and what is wanted there.

use super::{surface::Surface, target::Target, visibility::Visibility};
use crate::model::scene::Scene;

/// The scene with its surface, what each view sees of it, and what is wanted of each triangle.
#[derive(Clone, Copy)]
pub struct Geometry<'a> {
    pub scene: &'a Scene,
    pub surface: &'a Surface,
    pub visibility: &'a Visibility,
    pub target: &'a Target,
    /// Size of the matched images over the model's images.
    pub image_scale: f64,
}
