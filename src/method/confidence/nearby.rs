//! Evidence of the sparse points around a triangle: a view that observes them was matched there before (method 7.2).

use nalgebra::Point3;
use rayon::prelude::*;

use super::unary::{AROUND, Unary};
use crate::{
    base::{
        column::{Column, TableError},
        progress::{Cancelled, Watcher},
    },
    method::{surface::Surface, visibility::Visibility},
    model::scene::{Scene, ViewIndex, ViewPoints},
};

/// Weights each row of the visibility table 0.5 to 1 by the share of the sparse points nearest to the triangle that the view observes.
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
            nearest.copy_from_slice(&tree.nearest(&surface.centroid(t as u32)));
        };
        points.par_chunks_exact_mut(around.max(1)).enumerate().for_each(of_triangle);
        Ok(Self { around, points })
    }

    /// Returns the nearest points, nearest first.
    fn points_near(&self, triangle: u32) -> &[u32] {
        &self.points[self.around * triangle as usize..][..self.around]
    }

    /// Returns, for each row of the visibility table, the number of the nearest points that the view observes.
    fn observed(
        &self,
        scene: &Scene,
        points: &ViewPoints,
        visibility: &Visibility,
        watcher: &dyn Watcher,
    ) -> Result<Column<u8>, TableError> {
        let of_view = |observed: &mut Vec<bool>, view: ViewIndex| {
            watcher.check()?;
            points.observed_by(view).iter().for_each(|p| observed[p.index()] = true);
            let of_triangle = |&t: &u32| self.points_near(t).iter().filter(|&&p| observed[p as usize]).count() as u8;
            let row: Vec<u8> = visibility.triangles_seen_by(view).iter().map(of_triangle).collect();
            points.observed_by(view).iter().for_each(|p| observed[p.index()] = false);
            Ok(row)
        };
        visibility.column(|| vec![false; scene.points.len()], of_view)
    }
}

/// An implicit k-d tree: the median of each range of `order` splits it, down to leaves of [`AROUND`] points.
struct KdTree<'a> {
    points: &'a [Point3<f64>],
    order: Vec<u32>,
    /// Axis along which the point at the same index of `order` splits its range.
    axes: Vec<u8>,
}

impl<'a> KdTree<'a> {
    fn new(points: &'a [Point3<f64>]) -> Self {
        let mut order: Vec<u32> = (0..points.len() as u32).collect();
        let mut axes = vec![0; points.len()];
        part(points, &mut order, &mut axes);
        Self { points, order, axes }
    }

    /// Returns the nearest points, nearest first, ties by index.
    fn nearest(&self, to: &Point3<f64>) -> Vec<u32> {
        let mut found = Vec::with_capacity(AROUND + 1);
        self.look(to, 0, self.order.len(), &mut found);
        found.into_iter().map(|(_, point)| point).collect()
    }

    fn look(&self, to: &Point3<f64>, from: usize, end: usize, found: &mut Vec<(f64, u32)>) {
        if end - from <= AROUND {
            self.order[from..end].iter().for_each(|&p| self.offer(to, p, found));
            return;
        }
        let middle = from + (end - from) / 2;
        let (point, axis) = (self.order[middle], self.axes[middle] as usize);
        let ahead = to[axis] - self.points[point as usize][axis];
        let (near, far) =
            if ahead < 0.0 { ([from, middle], [middle + 1, end]) } else { ([middle + 1, end], [from, middle]) };
        self.look(to, near[0], near[1], found);
        self.offer(to, point, found);
        if found.len() < AROUND || found.last().is_some_and(|worst| ahead * ahead <= worst.0) {
            self.look(to, far[0], far[1], found);
        }
    }

    fn offer(&self, to: &Point3<f64>, point: u32, found: &mut Vec<(f64, u32)>) {
        let entry = ((self.points[point as usize] - to).norm_squared(), point);
        let place = found.partition_point(|other| other.0.total_cmp(&entry.0).then(other.1.cmp(&entry.1)).is_lt());
        if place < AROUND {
            found.insert(place, entry);
            found.truncate(AROUND);
        }
    }
}

/// Sorts a range so that its median splits it along its longest axis.
fn part(points: &[Point3<f64>], order: &mut [u32], axes: &mut [u8]) {
    if order.len() <= AROUND {
        return;
    }
    let length = |axis: usize| {
        let along = order.iter().map(|&p| points[p as usize][axis]);
        along.clone().fold(f64::NEG_INFINITY, f64::max) - along.fold(f64::INFINITY, f64::min)
    };
    let lengths = [0, 1, 2].map(length);
    let axis = (0..3).fold(0, |longest, axis| if lengths[axis] > lengths[longest] { axis } else { longest });
    let middle = order.len() / 2;
    let along = |p: &u32| points[*p as usize][axis];
    order.select_nth_unstable_by(middle, |a, b| along(a).total_cmp(&along(b)).then(a.cmp(b)));
    axes[middle] = axis as u8;
    let (before, after) = order.split_at_mut(middle);
    let (axes_before, axes_after) = axes.split_at_mut(middle);
    rayon::join(|| part(points, before, axes_before), || part(points, &mut after[1..], &mut axes_after[1..]));
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::{
        base::progress::NoWatcher,
        method::synthetic::Town,
        model::camera::{Camera, CameraModel},
    };

    fn by_sorting(points: &[Point3<f64>], to: &Point3<f64>) -> Vec<u32> {
        let mut all: Vec<u32> = (0..points.len() as u32).collect();
        let far = |p: &u32| (points[*p as usize] - to).norm_squared();
        all.sort_by(|a, b| far(a).total_cmp(&far(b)).then(a.cmp(b)));
        all.truncate(AROUND);
        all
    }

    proptest! {
        #[test]
        fn the_nearest_are_those_that_sorting_finds(
            // Integers, so that points coincide and distances tie.
            points in proptest::collection::vec(proptest::array::uniform3(-4i8..5), 0..200),
            to in proptest::array::uniform3(-6i8..7),
        ) {
            let point = |x: [i8; 3]| Point3::from(x.map(f64::from));
            let (points, to): (Vec<_>, _) = (points.into_iter().map(point).collect(), point(to));
            prop_assert_eq!(KdTree::new(&points).nearest(&to), by_sorting(&points, &to));
        }
    }

    #[test]
    fn confidence_is_the_share_of_observed_points_by_its_definition() {
        let camera = Camera::new(1, CameraModel::Pinhole, 1000, 750, vec![850.0, 850.0, 500.0, 375.0]).unwrap();
        let town = Town { edge: 3.0, points: 400, ..Town::new(camera) };
        let (mut scene, surface) = (town.scene(), town.surface());
        // View 0 observes nothing.
        let (mut views, mut offsets) = (Vec::new(), vec![0]);
        for point in 0..scene.points.len() {
            let track = &scene.track_views[scene.track_offsets[point]..scene.track_offsets[point + 1]];
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
                let known = around.iter().filter(|&&p| points.observed_by(view).iter().any(|o| o.0 == p)).count();
                assert_eq!(unary.confidence(row), 0.5 + known as f32 / 16.0);
                assert!(view.0 != 0 || unary.confidence(row) == 0.5);
                row += 1;
            }
        }
        assert!(row > 0 && unary.columns().0.len() == row && (0..row).any(|row| unary.confidence(row) > 0.9));
    }
}
