//! Footprints of the views on a map.

use nalgebra::Point3;

use crate::{
    base::column,
    method::{surface::Surface, visibility::Visibility},
    model::{georeference::MapFrame, scene::ViewIndex},
};

/// Directions in which the extreme point of a footprint is taken; also the largest number of its corners.
const DIRECTIONS: u32 = 32;

/// Footprint of each view: the convex hull, seen from above, of the surface that the view sees, as surface points in world coordinates,
/// counter-clockwise, not closed. Empty if the view sees nothing.
pub fn footprints(surface: &Surface, visibility: &Visibility, frame: &MapFrame) -> Vec<Vec<Point3<f64>>> {
    let of_view = |&view: &ViewIndex| footprint(surface, visibility, view, frame);
    column::read_by_parts(&visibility.views(), of_view, || visibility.triangles.release())
}

fn footprint(surface: &Surface, visibility: &Visibility, view: ViewIndex, frame: &MapFrame) -> Vec<Point3<f64>> {
    let mut vertices: Vec<u32> =
        visibility.triangles_seen_by(view).iter().flat_map(|&t| surface.triangles[t as usize]).collect();
    vertices.sort_unstable();
    vertices.dedup();
    let points: Vec<Point3<f64>> = vertices.into_iter().map(|v| surface.vertices[v as usize]).collect();
    hull(&points, frame)
}

/// Convex hull of points seen from above, in at most as many corners as there are [`DIRECTIONS`]: world coordinates, counter-clockwise, not
/// closed.
pub(super) fn hull(points: &[Point3<f64>], frame: &MapFrame) -> Vec<Point3<f64>> {
    let flat: Vec<[f64; 3]> = points.iter().map(|point| frame.local(point)).collect();
    let farthest = |i: u32| {
        let (sin, cos) = (f64::from(i) * std::f64::consts::TAU / f64::from(DIRECTIONS)).sin_cos();
        let along = |v: &usize| flat[*v][0] * cos + flat[*v][1] * sin;
        // Ties go to the point farthest ahead counter-clockwise, so that no corner is on the edge between two others.
        let ahead = |v: &usize| flat[*v][1] * cos - flat[*v][0] * sin;
        (0..flat.len()).max_by(|a, b| along(a).total_cmp(&along(b)).then(ahead(a).total_cmp(&ahead(b))))
    };
    let mut corners: Vec<usize> = (0..DIRECTIONS).filter_map(farthest).collect();
    corners.dedup();
    if corners.len() > 1 && corners.first() == corners.last() {
        corners.pop();
    }
    corners.into_iter().map(|i| points[i]).collect()
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::{
        base::progress::Unwatched,
        config::VisibilitySettings,
        method::{synthetic::Town, visibility},
        model::camera::{Camera, CameraModel},
    };

    #[test]
    fn the_footprint_of_a_nadir_view_is_the_image_on_the_ground() {
        let camera = Camera::new(1, CameraModel::Pinhole, 1000, 750, vec![850.0, 850.0, 500.0, 375.0]).unwrap();
        let town = Town { relief: 0.0, boxes: 0, tilt: None, edge: 0.5, ..Town::new(camera) };
        let (scene, surface) = (town.scene(), town.surface());
        let settings = VisibilitySettings::default();
        let seen = visibility::estimate(
            &scene,
            &scene.view_points(),
            &surface,
            &settings,
            0.5,
            crate::base::column::Storage::Memory,
            &Unwatched,
        )
        .unwrap();
        let frame = MapFrame::new(&scene, None);
        assert_eq!(frame.axes, [Vector3::x(), Vector3::y(), Vector3::z()]);
        let middle = ViewIndex(12);
        let (centre, corners) =
            (scene.view(middle).cam_from_world.centre(), footprint(&surface, &seen, middle, &frame));
        let half = [500.0, 375.0].map(|px| px / 850.0 * centre.z);
        for (axis, half) in half.into_iter().enumerate() {
            let along = corners.iter().map(|c| c[axis] - centre[axis]);
            let (low, high) = along.fold((f64::MAX, f64::MIN), |(l, h), x| (l.min(x), h.max(x)));
            assert!((low + half).abs() < 0.75 && (high - half).abs() < 0.75, "{low} {high}, {half} expected");
        }
        let turn = |i: usize| {
            let [a, b, c] = [0, 1, 2].map(|k| corners[(i + k) % corners.len()]);
            (b - a).cross(&(c - b)).z
        };
        assert!((0..corners.len()).all(|i| turn(i) > -1e-9), "counter-clockwise and convex: {corners:?}");
    }
}
