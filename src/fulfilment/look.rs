//! How a view looks at a triangle: all that sections 3.2 to 3.4 need of one (view, triangle).

use nalgebra::{Matrix2x3, Point2, Point3, Vector3};

use super::{Information, Model};
use crate::scene::ViewIndex;

/// What one view contributes to the fulfilment of one triangle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Look {
    /// J ᵀJ / σ_px² · a_d², J by world coordinates in matched pixels.
    pub information: Information,
    /// Unit vector from the triangle's centroid to the camera centre.
    pub direction: Vector3<f64>,
    /// From the centroid to the camera centre, scene units.
    pub distance: f64,
    /// Cosine of the angle between the normal and `direction`; at least 0.
    pub cos_incidence: f64,
    /// Unary confidence.
    pub unary: f64,
}

/// The parts of a look that belong to the view alone, so that many triangles share them.
pub struct Eye<'a> {
    model: &'a Model<'a>,
    view: ViewIndex,
    centre: Point3<f64>,
}

impl<'a> Eye<'a> {
    pub fn new(model: &'a Model<'a>, view: ViewIndex) -> Self {
        Self { model, view, centre: model.scene.view(view).cam_from_world.centre() }
    }

    /// The look at a triangle, which is row `row` of the visibility table; `None` where the camera does not project its centroid.
    pub fn look(&self, triangle: u32, row: usize) -> Option<Look> {
        let model = self.model;
        let centroid = model.surface.centroid(triangle);
        let jacobian = self.jacobian(&centroid)?;
        let accuracy = model.target.accuracy(triangle);
        let scale = model.rule.image_scale * accuracy / model.rule.sigma_px;
        let to_camera = self.centre - centroid;
        let distance = to_camera.norm();
        let direction = to_camera / distance;
        let normal = model.surface.area_normal(triangle);
        let cos_incidence = (normal.dot(&direction) / normal.norm()).max(0.0);
        let information = Information::of(&jacobian, scale * scale);
        Some(Look { information, direction, distance, cos_incidence, unary: f64::from(model.unary.at(row)) })
    }

    /// f_res: the area that the triangle's three corners span in the image over its area in space, against the wanted density.
    pub fn resolution(&self, triangle: u32) -> f64 {
        let model = self.model;
        let corners = model.surface.corners(triangle).map(|corner| self.project(&corner));
        let [Some(a), Some(b), Some(c)] = corners else { return 0.0 };
        let pixels = 0.5 * ((b - a).perp(&(c - a))).abs() * model.rule.image_scale * model.rule.image_scale;
        let density = pixels / model.surface.area(triangle);
        let gsd = f64::from(model.target.gsd[triangle as usize]);
        let resolution = density * gsd * gsd;
        if resolution.is_finite() { resolution.min(1.0) } else { 0.0 }
    }

    fn project(&self, x: &Point3<f64>) -> Option<Point2<f64>> {
        let view = self.model.scene.view(self.view);
        self.model.scene.camera_of(self.view).project(&view.cam_from_world.camera_from_world(x))
    }

    /// Pixels of the model's image by world coordinates.
    fn jacobian(&self, x: &Point3<f64>) -> Option<Matrix2x3<f64>> {
        let pose = &self.model.scene.view(self.view).cam_from_world;
        let camera = self.model.scene.camera_of(self.view);
        let (_, by_camera) = camera.project_with_jacobian(&pose.camera_from_world(x))?;
        Some(by_camera * pose.rotation.matrix())
    }
}
