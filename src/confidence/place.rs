//! What is known of a triangle where a view sees it, in numbers, for the trained confidence: what its picture promises, which sparse points lie
//! around it there, where in the image it lies and how it is seen.

use super::curves::PLACE;
use crate::{
    fulfilment::Model,
    scene::{PointIndex, Scene, ViewIndex},
};

/// Cells along the longer side of an image in which sparse points are counted.
const CELLS: u32 = 32;

/// Sparse points around each cell of a view's image: sums over the cell and the eight around it.
#[derive(Clone, Debug)]
pub struct PointsAround {
    columns: usize,
    rows: usize,
    around: Vec<Sums>,
}

#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    points: f32,
    /// Of log2 of the track lengths.
    lengths: f32,
    /// Of the reprojection errors, pixels of the model's image.
    errors: f32,
}

impl Sums {
    fn plus(self, other: Self) -> Self {
        Self {
            points: self.points + other.points,
            lengths: self.lengths + other.lengths,
            errors: self.errors + other.errors,
        }
    }
}

/// Of each view.
pub fn points_around(scene: &Scene) -> Vec<PointsAround> {
    let empty = |view: ViewIndex| {
        let camera = scene.camera_of(view);
        let longer = camera.width.max(camera.height);
        let cells = |side: u32| (side * CELLS).div_ceil(longer).max(1) as usize;
        let (columns, rows) = (cells(camera.width), cells(camera.height));
        PointsAround { columns, rows, around: vec![Sums::default(); columns * rows] }
    };
    let mut views: Vec<PointsAround> = scene.view_indices().map(empty).collect();
    for p in 0..scene.points.len() {
        let point = PointIndex(p as u32);
        let lengths = (scene.track(point).len() as f32).log2();
        for observation in scene.track(point) {
            let view = scene.track_views[observation];
            let errors = scene.reprojection_error(point, observation).unwrap_or(0.0) as f32;
            let [x, y] = scene.track_pixels[observation];
            let cell = views[view.at()].cell(scene, view, x, y);
            let sums = &mut views[view.at()].around[cell];
            *sums = sums.plus(Sums { points: 1.0, lengths, errors });
        }
    }
    views.iter_mut().for_each(PointsAround::spread);
    views
}

impl PointsAround {
    fn cell(&self, scene: &Scene, view: ViewIndex, x: f64, y: f64) -> usize {
        let camera = scene.camera_of(view);
        let at = |position: f64, side: u32, cells: usize| {
            ((position / f64::from(side) * cells as f64) as usize).min(cells - 1)
        };
        at(y, camera.height, self.rows) * self.columns + at(x, camera.width, self.columns)
    }

    /// From sums over cells to sums around them.
    fn spread(&mut self) {
        let (width, height) = (self.columns, self.rows);
        let of = |cell: usize| {
            let (column, row) = (cell % width, cell / width);
            let columns = column.saturating_sub(1)..(column + 2).min(width);
            let rows = row.saturating_sub(1)..(row + 2).min(height);
            let cells = rows.flat_map(|r| columns.clone().map(move |c| r * width + c));
            cells.fold(Sums::default(), |sum, cell| sum.plus(self.around[cell]))
        };
        self.around = (0..width * height).map(of).collect();
    }
}

/// Log odds of what the picture promises (NaN: no picture), log2 of sparse points around plus 1, mean log2 of their track lengths, their mean
/// reprojection error (pixels; the latter two NaN without points), distance to the border over half of the shorter side, cosine of
/// incidence, log2 of the view's ground sampling distance over the wanted one.
pub fn numbers(
    model: &Model,
    around: &PointsAround,
    view: ViewIndex,
    triangle: u32,
    promise: f32,
) -> [f32; PLACE.len()] {
    let (camera, pose) = (model.scene.camera_of(view), &model.scene.view(view).cam_from_world);
    let centroid = model.surface.centroid(triangle);
    let x_cam = pose.camera_from_world(&centroid);
    let Some((pixel, jacobian)) = camera.project_with_jacobian(&x_cam) else { return [f32::NAN; PLACE.len()] };
    let sums = around.around[around.cell(model.scene, view, pixel.x, pixel.y)];
    let (width, height) = (f64::from(camera.width), f64::from(camera.height));
    let border = pixel.x.min(width - pixel.x).min(pixel.y).min(height - pixel.y) / (0.5 * width.min(height));
    let (normal, ray) = (model.surface.area_normal(triangle), pose.centre() - centroid);
    let cosine = normal.dot(&ray) / (normal.norm() * ray.norm());
    // The Jacobian's two singular values are about f / z each.
    let gsd = std::f64::consts::SQRT_2 / (jacobian.norm() * model.rule.image_scale);
    let wanted = f64::from(model.target.gsd[triangle as usize]);
    [
        odds_of(promise),
        (sums.points + 1.0).log2(),
        sums.lengths / sums.points,
        sums.errors / sums.points,
        border as f32,
        cosine as f32,
        (gsd / wanted).log2() as f32,
    ]
}

/// Log odds of a probability, finite; NaN stays.
pub fn odds_of(probability: f32) -> f32 {
    let p = probability.clamp(0.005, 0.995);
    (p / (1.0 - p)).ln()
}
