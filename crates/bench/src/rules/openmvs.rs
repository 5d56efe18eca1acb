//! OpenMVS 2.3 (`Scene::SelectNeighborViews`, `FilterNeighborViews` with the defaults of
//! DensifyPointCloud).
//!
//! Score = the larger of the covered area and 0.01, times the sum over shared points of
//! `max(w_angle, 0.1) w_scale`; w_angle is a Gaussian around 12 degrees of standard deviation 0.38
//! x 12 degrees below and 0.7 x 12 above; w_scale by r, the view's scale at the point over the
//! other's: (1.6/r)^2 above 1.6, 1 from 1 to 1.6, r^2 below 1. Views with an area below 0.05, a
//! mean r outside 0.2 to 3.2 or a mean angle outside 3 to 65 degrees are removed, the worst score
//! first, as long as more than 9 are left.

use super::Neighbourhood;
use viewrank_core::model::scene::{PointIndex, ViewIndex};

const OPTIMAL_ANGLE: f64 = 12.0;
/// Cells per side of the grid that measures the covered area.
const CELLS: f64 = 16.0;
/// A point counts as often as the other view observes it.
const MIN_SHARED: f64 = 3.0;
/// The filter leaves at least max(4, 12 * 3/4).
const FILTER_DOWN_TO: usize = 9;
const MAX_VIEWS: usize = 12;

pub(super) struct Neighbour {
    pub view: ViewIndex,
    score: f64,
    area: f64,
    /// Means over the shared points; the angle in degrees.
    scale: f64,
    angle: f64,
}

pub(super) fn choose(hood: &Neighbourhood, k: usize) -> Vec<ViewIndex> {
    let mut neighbours = neighbours(hood);
    for i in (0..neighbours.len()).rev() {
        let n = &neighbours[i];
        let good =
            n.area >= 0.05 && (0.2..3.2).contains(&n.scale) && (3.0..65.0).contains(&n.angle);
        if !good && neighbours.len() > FILTER_DOWN_TO {
            neighbours.remove(i);
        }
    }
    neighbours
        .into_iter()
        .take(k.min(MAX_VIEWS))
        .map(|n| n.view)
        .collect()
}

/// Returns the neighbours before the filter, best first.
pub(super) fn neighbours(hood: &Neighbourhood) -> Vec<Neighbour> {
    let mut neighbours: Vec<Neighbour> = hood
        .others
        .iter()
        .filter_map(|(v, points)| score(hood, *v, points))
        .collect();
    neighbours.sort_by(|a, b| b.score.total_cmp(&a.score).then(a.view.cmp(&b.view)));
    neighbours
}

fn score(hood: &Neighbourhood, view: ViewIndex, points: &[PointIndex]) -> Option<Neighbour> {
    let (mut count, mut sum, mut scales, mut angles) = (0.0, 0.0, 0.0, 0.0);
    for &p in points {
        let times = hood.observations(p, view) as f64;
        let angle = hood.angle(p, hood.key, view).to_degrees();
        let scale = hood.footprint(p, view) / hood.footprint(p, hood.key);
        sum += times * angle_weight(angle).max(0.1) * scale_weight(scale);
        scales += times * scale;
        angles += times * angle;
        count += times;
    }
    let area = covered_area(hood, view, points).filter(|_| count >= MIN_SHARED)?;
    Some(Neighbour {
        view,
        score: sum * area.max(0.01),
        area,
        scale: scales / count,
        angle: angles / count,
    })
}

fn angle_weight(degrees: f64) -> f64 {
    let sigma = OPTIMAL_ANGLE * if degrees < OPTIMAL_ANGLE { 0.38 } else { 0.7 };
    (-(degrees - OPTIMAL_ANGLE).powi(2) / (2.0 * sigma * sigma)).exp()
}

fn scale_weight(ratio: f64) -> f64 {
    if ratio > 1.6 {
        (1.6 / ratio).powi(2)
    } else {
        ratio.min(1.0).powi(2)
    }
}

/// Returns the share of the cells of the key view's image that hold a shared point projecting into
/// both images; `None` without such a point.
fn covered_area(hood: &Neighbourhood, view: ViewIndex, points: &[PointIndex]) -> Option<f64> {
    let camera = hood.scene.camera_of(hood.key);
    let mut cells = [false; (CELLS * CELLS) as usize];
    for &p in points {
        if let (Some([x, y]), Some(_)) = (project(hood, hood.key, p), project(hood, view, p)) {
            let cell = |x: f64, size: u32| (x / f64::from(size) * CELLS) as usize;
            cells[cell(y, camera.height) * CELLS as usize + cell(x, camera.width)] = true;
        }
    }
    let covered = cells.iter().filter(|&&c| c).count();
    (covered > 0).then(|| covered as f64 / (CELLS * CELLS))
}

/// Returns the point's position in the image in OpenMVS's pixels (the centre of the first is 0, 0);
/// `None` outside.
fn project(hood: &Neighbourhood, view: ViewIndex, point: PointIndex) -> Option<[f64; 2]> {
    let camera = hood.scene.camera_of(view);
    let pixel = camera.project(
        &hood
            .scene
            .view(view)
            .cam_from_world
            .camera_from_world(&hood.point(point)),
    )?;
    let [x, y] = [pixel.x - 0.5, pixel.y - 0.5];
    let inside =
        x >= 0.0 && y >= 0.0 && x < f64::from(camera.width) && y < f64::from(camera.height);
    inside.then_some([x, y])
}
