//! Evidence of the sparse points around a triangle: a view that observes them was matched there
//! before (method 7.2).

use rayon::prelude::*;

use super::unary::{AROUND, Unary};
use crate::{
    base::{
        column::{Column, READ_AT_ONCE, TableError},
        kd_tree::KdTree,
        progress::{Cancelled, Watcher},
    },
    method::visibility::Visibility,
    model::{
        scene::{Scene, ViewIndex, ViewPoints},
        surface::Surface,
    },
};

/// Weights each row of the visibility table 0.5 to 1 by the share of the sparse points nearest to
/// the triangle that the view observes.
pub fn nearby(
    scene: &Scene,
    points: &ViewPoints,
    surface: &Surface,
    visibility: &Visibility,
    watcher: &dyn Watcher,
) -> Result<Unary, TableError> {
    if scene.points.is_empty() {
        return Ok(Unary::certain());
    }
    let nearest = Nearest::new(scene, surface, watcher)?;
    let observed = nearest.observed(scene, points, visibility, watcher)?;
    Ok(Unary::of_points(observed, nearest.around as u8))
}

/// The sparse points nearest to the centroid of each triangle, the same number for each.
struct Nearest {
    around: usize,
    points: Vec<u32>,
}

impl Nearest {
    fn new(scene: &Scene, surface: &Surface, watcher: &dyn Watcher) -> Result<Self, Cancelled> {
        let tree = KdTree::new(&scene.points);
        watcher.check()?;
        let around = AROUND.min(scene.points.len());
        let mut points = vec![0; around * surface.triangles.len()];
        let of_triangle = |(t, nearest): (usize, &mut [u32])| {
            let found: [u32; AROUND] = tree.nearest(&surface.centroid(t as u32));
            nearest.copy_from_slice(&found[..around]);
        };
        points
            .par_chunks_exact_mut(around.max(1))
            .enumerate()
            .for_each(of_triangle);
        Ok(Self { around, points })
    }

    /// Returns the nearest points, nearest first.
    fn points_near(&self, triangle: u32) -> &[u32] {
        &self.points[self.around * triangle as usize..][..self.around]
    }

    /// Returns, for each row of the visibility table, the number of the nearest points that the
    /// view observes.
    fn observed(
        &self,
        scene: &Scene,
        points: &ViewPoints,
        visibility: &Visibility,
        watcher: &dyn Watcher,
    ) -> Result<Column<u8>, TableError> {
        let of_view = |observed: &mut Vec<bool>, view: ViewIndex| {
            watcher.check()?;
            points
                .observed_by(view)
                .iter()
                .for_each(|p| observed[p.index()] = true);
            let of_triangle = |&t: &u32| {
                self.points_near(t)
                    .iter()
                    .filter(|&&p| observed[p as usize])
                    .count() as u8
            };
            let row: Vec<u8> = visibility
                .triangles_seen_by(view)
                .iter()
                .map(of_triangle)
                .collect();
            points
                .observed_by(view)
                .iter()
                // Only those that were set: the array is as long as the scene has points.
                .for_each(|p| observed[p.index()] = false);
            Ok(row)
        };
        visibility.column(READ_AT_ONCE, || vec![false; scene.points.len()], of_view)
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;

    use super::*;
    use crate::{base::progress::NoWatcher, method::synthetic::Town};

    fn by_sorting(points: &[Point3<f64>], to: &Point3<f64>) -> Vec<u32> {
        let mut all: Vec<u32> = (0..points.len() as u32).collect();
        let far = |p: &u32| (points[*p as usize] - to).norm_squared();
        all.sort_by(|a, b| far(a).total_cmp(&far(b)).then(a.cmp(b)));
        all.truncate(AROUND);
        all
    }

    #[test]
    fn confidence_is_the_share_of_observed_points_by_its_definition() {
        let town = Town {
            edge: 3.0,
            points: 400,
            ..Town::default()
        };
        let (mut scene, surface) = (town.scene(), town.surface());
        // View 0 observes nothing.
        let (mut views, mut offsets) = (Vec::new(), vec![0]);
        for point in 0..scene.points.len() {
            let track =
                &scene.track_views[scene.track_offsets[point]..scene.track_offsets[point + 1]];
            views.extend(track.iter().filter(|v| v.0 != 0));
            offsets.push(views.len());
        }
        (scene.track_views, scene.track_offsets) = (views, offsets);
        let points = scene.view_points();
        let visibility = crate::method::visibility::estimate(
            &scene,
            &points,
            &surface,
            &Default::default(),
            3.0,
            crate::base::column::Storage::Memory,
            &NoWatcher,
        )
        .unwrap();
        let unary = nearby(&scene, &points, &surface, &visibility, &NoWatcher).unwrap();
        let mut row = 0;
        for view in scene.view_indices() {
            for &t in visibility.triangles_seen_by(view) {
                let around = by_sorting(&scene.points, &surface.centroid(t));
                let known = around
                    .iter()
                    .filter(|&&p| points.observed_by(view).iter().any(|o| o.0 == p))
                    .count();
                assert_eq!(unary.at(row).observed, 0.5 + known as f32 / 16.0);
                assert!(view.0 != 0 || unary.at(row).observed == 0.5);
                row += 1;
            }
        }
        assert!(
            row > 0
                && unary.columns().0.len() == row
                && (0..row).any(|row| unary.at(row).observed > 0.9)
        );
    }
}
