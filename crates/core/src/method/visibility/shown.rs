//! Number of views, pixels and finest GSD of each triangle.

use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};

use nalgebra::{Point3, Vector2};

use super::Visibility;
use crate::{
    base::column,
    model::{
        camera::{Camera, CameraModel},
        scene::{Scene, ViewIndex},
        surface::Surface,
    },
};

/// Pixels are added as integer multiples of 1 / `PARTS`: the sum does not depend on the order in
/// which threads add them.
const PARTS: f64 = 65_536.0;

/// By triangle, over the views that see it; pixels are those of the model's images.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Shown {
    /// Number of views.
    pub views: Vec<u32>,
    /// Pixels of all of them together.
    pub pixels: Vec<f64>,
    /// Finest GSD, scene units per pixel; infinite without a view. Views with a GSD that is not
    /// positive don't count: the centroid of a large triangle may be behind a camera that sees a
    /// corner of it.
    pub finest_gsd: Vec<f32>,
}

/// What is known of a triangle while threads look at the views.
struct ShownSum {
    views: AtomicU32,
    pixels: AtomicU64,
    /// Bits of the finest GSD: those of positive floats are ordered like the floats, and a minimum
    /// does not depend on the order of threads.
    finest: AtomicU32,
}

impl Default for ShownSum {
    fn default() -> Self {
        Self {
            views: AtomicU32::new(0),
            pixels: AtomicU64::new(0),
            finest: AtomicU32::new(f32::INFINITY.to_bits()),
        }
    }
}

impl ShownSum {
    fn add(&self, area: f64, gsd: f32) {
        // With this limit, the sum over 280,000 views fits into 64 bits.
        let parts = (area.min(Shown::MOST_PIXELS) * PARTS) as u64;
        self.views.fetch_add(1, Ordering::Relaxed);
        self.pixels.fetch_add(parts, Ordering::Relaxed);
        if gsd > 0.0 {
            self.finest.fetch_min(gsd.to_bits(), Ordering::Relaxed);
        }
    }
}

impl Shown {
    /// Pixels of a triangle in one view that are counted at most.
    pub const MOST_PIXELS: f64 = 1e9;

    pub fn new(scene: &Scene, surface: &Surface, visibility: &Visibility) -> Self {
        let sums: Vec<ShownSum> = surface
            .triangles
            .iter()
            .map(|_| ShownSum::default())
            .collect();
        let look = |&view: &ViewIndex| {
            let (camera, pose) = (scene.camera_of(view), &scene.view(view).cam_from_world);
            for &t in visibility.triangles_seen_by(view) {
                let corners = surface.corners(t).map(|x| pose.camera_from_world(&x));
                let area = projected_area(camera, &corners);
                sums[t as usize].add(area, gsd_at(scene, surface, view, t) as f32);
            }
        };
        column::read_by_parts(&visibility.views(), look, || visibility.triangles.release());
        let mut shown = Self::default();
        sums.into_iter().for_each(|sum| shown.push(sum));
        shown
    }

    fn push(&mut self, sum: ShownSum) {
        self.views.push(sum.views.into_inner());
        self.pixels.push(sum.pixels.into_inner() as f64 / PARTS);
        self.finest_gsd
            .push(f32::from_bits(sum.finest.into_inner()));
    }

    /// Returns the mean pixels over the views that see a triangle; 0 if no view does.
    ///
    /// A sum would favour the middle of a flight, where most views overlap.
    pub fn mean_pixels(&self, triangle: usize) -> f64 {
        self.pixels[triangle] / f64::from(self.views[triangle].max(1))
    }
}

/// Returns scene units per pixel of the model's image at a triangle's centroid, across the viewing
/// direction: its depth over the mean focal length.
pub fn gsd_at(scene: &Scene, surface: &Surface, view: ViewIndex, triangle: u32) -> f64 {
    let camera = scene.camera_of(view);
    let centroid = scene
        .view(view)
        .cam_from_world
        .camera_from_world(&surface.centroid(triangle));
    camera.depth(&centroid) / camera.mean_focal_length()
}

/// Returns the area of the projected triangle, square pixels of the model's image; corners in
/// camera coordinates. If one does not project, the projection is linearised at the centroid.
pub fn projected_area(camera: &Camera, corners: &[Point3<f64>; 3]) -> f64 {
    let pixels = corners.each_ref().map(|p| camera.project(p));
    let edges = match pixels {
        [Some(a), Some(b), Some(c)] => [b - a, c - a].map(|edge| unwrapped(camera, edge)),
        _ => {
            let [a, b, c] = corners.each_ref().map(|p| p.coords);
            let Some((_, jacobian)) = camera.project_with_jacobian(&((a + b + c) / 3.0).into())
            else {
                return 0.0;
            };
            [jacobian * (b - a), jacobian * (c - a)]
        }
    };
    0.5 * edges[0].perp(&edges[1]).abs()
}

/// Unwraps an edge that crosses the seam of an equirectangular image.
fn unwrapped(camera: &Camera, edge: Vector2<f64>) -> Vector2<f64> {
    if camera.model() != CameraModel::Equirectangular {
        return edge;
    }
    let around = camera.pinhole_part().0.x * std::f64::consts::TAU;
    Vector2::new(edge.x - around * (edge.x / around).round(), edge.y)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 80 px around, an edge of 4 px over the seam.
    #[test]
    fn a_triangle_on_the_seam_of_a_panorama_has_the_pixels_of_one_elsewhere() {
        let camera =
            Camera::new(1, CameraModel::Equirectangular, 80, 40, vec![80.0, 40.0]).unwrap();
        let at = |degrees: f64, y: f64| {
            let angle = degrees.to_radians();
            Point3::new(10.0 * angle.sin(), y, 10.0 * angle.cos())
        };
        let across = |middle: f64| {
            projected_area(
                &camera,
                &[
                    at(middle - 9.0, 0.0),
                    at(middle + 9.0, 0.0),
                    at(middle, 1.0),
                ],
            )
        };
        assert!(
            across(0.0) > 1.0 && (across(180.0) - across(0.0)).abs() < 1e-9,
            "{} {}",
            across(180.0),
            across(0.0)
        );
    }
}
