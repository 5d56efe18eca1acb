//! Footprints of the views on a map.

use nalgebra::Point3;

use crate::{
    base::{bits, column},
    method::visibility::Visibility,
    model::{georeference::MapFrame, scene::ViewIndex, surface::Surface},
};

/// Footprint of each view: the convex hull, seen from above, of the surface that the view sees, as
/// surface points in world coordinates, counter-clockwise, not closed. Empty if the view sees
/// nothing.
pub fn footprints(
    surface: &Surface,
    visibility: &Visibility,
    frame: &MapFrame,
) -> Vec<Vec<Point3<f64>>> {
    let of_view = |&view: &ViewIndex| footprint(surface, visibility, view, frame);
    column::read_by_parts(&visibility.views(), of_view, || {
        visibility.triangles.release()
    })
}

fn footprint(
    surface: &Surface,
    visibility: &Visibility,
    view: ViewIndex,
    frame: &MapFrame,
) -> Vec<Point3<f64>> {
    // A bit per vertex: its triangles are neighbours in the table, but their corners come in no
    // order.
    let mut seen = vec![0u64; surface.vertices.len().div_ceil(64)];
    for &t in visibility.triangles_seen_by(view) {
        surface.triangles[t as usize]
            .iter()
            .for_each(|&v| seen[v as usize / 64] |= 1 << (v % 64));
    }
    let points: Vec<Point3<f64>> = bits::take(&mut seen, 0)
        .into_iter()
        .map(|v| surface.vertices[v as usize])
        .collect();
    frame.hull(&points)
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::{
        base::progress::NoWatcher,
        config::VisibilitySettings,
        method::{synthetic::Town, visibility},
    };

    #[test]
    fn the_footprint_of_a_nadir_view_is_the_image_on_the_ground() {
        let town = Town {
            relief: 0.0,
            boxes: 0,
            tilt: None,
            edge: 0.5,
            ..Town::default()
        };
        let (scene, surface) = (town.scene(), town.surface());
        let settings = VisibilitySettings::default();
        let seen = visibility::estimate(
            &scene,
            &scene.view_points(),
            &surface,
            &settings,
            0.5,
            crate::base::column::Storage::Memory,
            &NoWatcher,
        )
        .unwrap();
        let frame = MapFrame::new(&scene, None);
        assert_eq!(frame.axes, [Vector3::x(), Vector3::y(), Vector3::z()]);
        let middle = ViewIndex(12);
        let (centre, corners) = (
            scene.view(middle).cam_from_world.centre(),
            footprint(&surface, &seen, middle, &frame),
        );
        let half = [500.0, 375.0].map(|px| px / 850.0 * centre.z);
        for (axis, half) in half.into_iter().enumerate() {
            let along = corners.iter().map(|c| c[axis] - centre[axis]);
            let (low, high) = along.fold((f64::MAX, f64::MIN), |(l, h), x| (l.min(x), h.max(x)));
            assert!(
                (low + half).abs() < 0.75 && (high - half).abs() < 0.75,
                "{low} {high}, {half} expected"
            );
        }
        let turn = |i: usize| {
            let [a, b, c] = [0, 1, 2].map(|k| corners[(i + k) % corners.len()]);
            (b - a).cross(&(c - b)).z
        };
        assert!(
            (0..corners.len()).all(|i| turn(i) > -1e-9),
            "counter-clockwise and convex: {corners:?}"
        );
    }
}
