//! Geometry of a scene, before confidence: visibility of the triangles and their wanted resolution.

use super::{target::Target, visibility::Visibility};
use crate::model::{scene::Scene, surface::Surface};

/// Scene with its surface, its visibility table and the wanted resolution of each triangle.
#[derive(Clone, Copy)]
pub struct Geometry<'a> {
    pub scene: &'a Scene,
    pub surface: &'a Surface,
    pub visibility: &'a Visibility,
    pub target: &'a Target,
    /// Size of the matched images relative to the model's images.
    pub image_scale: f64,
}
