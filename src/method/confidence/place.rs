//! Features of a triangle in a view, for the trained confidence: prediction of the picture, surrounding sparse points, position in the
//! image, and viewing geometry.

use rayon::prelude::*;

use super::{curves::PLACE, nearby::Nearest};
use crate::{
    base::{
        column::{Column, TableError},
        progress::Watcher,
    },
    method::geometry::Geometry,
    model::scene::{PointIndex, Scene, ViewIndex, ViewPoints},
};

/// Features of the rows of a visibility table, each a triangle in a view that sees it.
pub struct PlaceFeatures<'a> {
    geometry: Geometry<'a>,
    /// By row: share of the sparse points nearest to the triangle that the view observes.
    observed: Column<f32>,
    /// By triangle.
    ground: Vec<Ground>,
}

/// Statistics of the sparse points nearest to a triangle; NaN without points.
struct Ground {
    /// log2 of their mean distance from its centroid, relative to the wanted GSD.
    spacing: f32,
    /// log2 of (their largest distance from its plane relative to the wanted GSD, plus 1).
    roughness: f32,
    /// Mean log2 of their track lengths.
    track_length: f32,
    /// Mean reprojection error, pixels of the model's images.
    error: f32,
}

impl<'a> PlaceFeatures<'a> {
    pub fn new(geometry: Geometry<'a>, points: &ViewPoints, watcher: &dyn Watcher) -> Result<Self, TableError> {
        let nearest = Nearest::new(geometry.scene, geometry.surface, watcher)?;
        let all = (0..geometry.scene.points.len() as u32).into_par_iter();
        let tracks: Vec<[f32; 2]> = all.map(|p| length_and_error(geometry.scene, PointIndex(p))).collect();
        watcher.check()?;
        let triangles = (0..geometry.surface.triangles.len() as u32).into_par_iter();
        Ok(Self {
            observed: nearest.observed(geometry.scene, points, geometry.visibility, |share| share, watcher)?,
            ground: triangles.map(|triangle| Ground::new(&geometry, &nearest, &tracks, triangle)).collect(),
            geometry,
        })
    }

    /// Lets the operating system drop pages of a table on disk; they are read again when needed.
    pub fn release(&self) {
        self.observed.release();
    }

    /// Returns: log odds of the picture's prediction (NaN: no picture), distance to the border relative to half the shorter side, cosine of incidence,
    /// log2 of the view's ground sampling distance relative to the wanted one; and of the sparse points nearest to the triangle, the share that
    /// the view observes, their spacing, roughness, track length and reprojection error.
    pub fn numbers(&self, view: ViewIndex, row: usize, promise: f32) -> [f32; PLACE.len()] {
        let geometry = &self.geometry;
        let triangle = geometry.visibility.triangles[row];
        let (camera, pose) = (geometry.scene.camera_of(view), &geometry.scene.view(view).cam_from_world);
        let centroid = geometry.surface.centroid(triangle);
        let x_cam = pose.camera_from_world(&centroid);
        let Some((pixel, jacobian)) = camera.project_with_jacobian(&x_cam) else { return [f32::NAN; PLACE.len()] };
        let (width, height) = (f64::from(camera.width), f64::from(camera.height));
        let border = pixel.x.min(width - pixel.x).min(pixel.y).min(height - pixel.y) / (0.5 * width.min(height));
        let (normal, ray) = (geometry.surface.area_normal(triangle), pose.centre() - centroid);
        let cosine = normal.dot(&ray) / (normal.norm() * ray.norm());
        // The two singular values of the Jacobian are about f / z each.
        let gsd = std::f64::consts::SQRT_2 / (jacobian.norm() * geometry.image_scale);
        let wanted = f64::from(geometry.target.gsd[triangle as usize]);
        let Ground { spacing, roughness, track_length, error } = self.ground[triangle as usize];
        let observed = self.observed[row];
        let seen = [border, cosine, (gsd / wanted).log2()].map(|n| n as f32);
        [odds_of(promise), seen[0], seen[1], seen[2], observed, spacing, roughness, track_length, error]
    }
}

impl Ground {
    fn new(geometry: &Geometry, nearest: &Nearest, tracks: &[[f32; 2]], triangle: u32) -> Self {
        let gsd = f64::from(geometry.target.gsd[triangle as usize]);
        let [spacing, roughness] = nearest.spacing_and_roughness(geometry.scene, geometry.surface, triangle);
        let around = nearest.points_near(triangle);
        let mean = |i: usize| around.iter().map(|&p| tracks[p as usize][i]).sum::<f32>() / around.len() as f32;
        Self {
            spacing: (spacing / gsd).log2() as f32,
            roughness: (roughness / gsd + 1.0).log2() as f32,
            track_length: mean(0),
            error: mean(1),
        }
    }
}

/// Returns log2 of a point's track length, and its mean reprojection error, px.
fn length_and_error(scene: &Scene, point: PointIndex) -> [f32; 2] {
    let track = scene.track(point);
    let length = track.len() as f32;
    let errors = track.map(|observation| scene.reprojection_error(point, observation).unwrap_or(0.0) as f32);
    [length.log2(), errors.sum::<f32>() / length]
}

/// Returns the log odds of a probability, clamped to 0.005 to 0.995; NaN stays.
pub fn odds_of(probability: f32) -> f32 {
    let p = probability.clamp(0.005, 0.995);
    (p / (1.0 - p)).ln()
}
