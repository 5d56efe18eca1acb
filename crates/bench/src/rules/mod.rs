//! Other authors' rules for choosing the matching partners of a key view (method 8), each as
//! published: one file per family.
//!
//! All work on the sparse model alone. A rule looks at every view of the model unless its own text
//! says otherwise, knows nothing of what a backend can match, and may find fewer than k partners.

mod colmap;
mod goesele;
mod mvsnet;
mod nearest;
mod openmvs;
mod shen;
#[cfg(test)]
mod tests;

use nalgebra::Point3;
use rayon::prelude::*;

use viewrank_core::model::{
    cluster::ViewCluster,
    scene::{PointIndex, Scene, ViewIndex, ViewPoints},
};

/// A rule, as the folders of `viewrank-bench partners` are named.
pub struct SelectionRule {
    pub name: &'static str,
    choose: fn(&Neighbourhood, usize) -> Vec<ViewIndex>,
}

/// All rules, in the order in which tables list them.
pub const RULES: &[SelectionRule] = &[
    SelectionRule {
        name: "mindist",
        choose: nearest::closest,
    },
    SelectionRule {
        name: "maxcon",
        choose: nearest::most_connected,
    },
    SelectionRule {
        name: "random",
        choose: nearest::random,
    },
    SelectionRule {
        name: "goesele",
        choose: goesele::choose,
    },
    SelectionRule {
        name: "shen",
        choose: shen::choose,
    },
    SelectionRule {
        name: "colmap",
        choose: colmap::choose,
    },
    SelectionRule {
        name: "openmvs",
        choose: openmvs::choose,
    },
    SelectionRule {
        name: "mvsnet",
        choose: mvsnet::choose,
    },
];

impl SelectionRule {
    /// Returns clusters of at most k partners for each key view, best first; key views for which
    /// the rule finds none are left out.
    pub fn clusters(&self, scene: &Scene, keys: &[ViewIndex], k: usize) -> Vec<ViewCluster> {
        let points = scene.view_points();
        let cluster = |&key: &ViewIndex| ViewCluster {
            key,
            partners: (self.choose)(&Neighbourhood::new(scene, &points, key), k),
        };
        keys.par_iter()
            .map(cluster)
            .filter(|c| !c.partners.is_empty())
            .collect()
    }
}

/// A key view and the sparse points that it shares with other views.
struct Neighbourhood<'a> {
    scene: &'a Scene,
    points: &'a ViewPoints,
    key: ViewIndex,
    /// Views with shared points, ascending, each with those points, ascending.
    others: Vec<(ViewIndex, Vec<PointIndex>)>,
}

/// Returns the `k` views with the smallest scores, ties by name.
fn smallest(k: usize, scored: impl Iterator<Item = (f64, ViewIndex)>) -> Vec<ViewIndex> {
    let mut scored: Vec<_> = scored.collect();
    scored.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    scored.into_iter().map(|(_, view)| view).take(k).collect()
}

impl<'a> Neighbourhood<'a> {
    fn new(scene: &'a Scene, points: &'a ViewPoints, key: ViewIndex) -> Self {
        let mut shared = vec![Vec::new(); scene.views.len()];
        for &point in points.observed_by(key) {
            for &view in scene.track_views(point) {
                let list: &mut Vec<PointIndex> = &mut shared[view.index()];
                // A view may observe a point twice, one after the other in its track.
                if view != key && list.last() != Some(&point) {
                    list.push(point);
                }
            }
        }
        let others = scene
            .view_indices()
            .zip(shared)
            .filter(|(_, points)| !points.is_empty())
            .collect();
        Self {
            scene,
            points,
            key,
            others,
        }
    }

    fn centre(&self, view: ViewIndex) -> Point3<f64> {
        self.scene.view(view).cam_from_world.centre()
    }

    fn point(&self, point: PointIndex) -> Point3<f64> {
        self.scene.points[point.index()]
    }

    /// Returns the number of observations of the point in the view: a feature may be detected
    /// twice.
    fn observations(&self, point: PointIndex, view: ViewIndex) -> usize {
        self.scene
            .track_views(point)
            .iter()
            .filter(|&&v| v == view)
            .count()
    }

    /// Returns the angle at a point between the rays to two views, radians; 0 if a view is at the
    /// point.
    fn angle(&self, point: PointIndex, a: ViewIndex, b: ViewIndex) -> f64 {
        let x = self.point(point);
        (self.centre(a) - x).angle(&(self.centre(b) - x))
    }

    /// Returns the size of a pixel of the view at a point: depth over the mean focal length, scene
    /// units.
    fn footprint(&self, point: PointIndex, view: ViewIndex) -> f64 {
        let depth = self
            .scene
            .view(view)
            .cam_from_world
            .camera_from_world(&self.point(point))
            .z;
        depth / self.scene.camera_of(view).mean_focal_length()
    }

    /// Returns the k other views with the highest scores, ties by name; views without a score are
    /// left out.
    fn best(
        &self,
        k: usize,
        score: impl Fn(ViewIndex, &[PointIndex]) -> Option<f64>,
    ) -> Vec<ViewIndex> {
        let scored = self
            .others
            .iter()
            .filter_map(|(view, points)| Some((score(*view, points)?, *view)));
        let mut scored: Vec<(f64, ViewIndex)> = scored.collect();
        scored.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        scored.into_iter().map(|(_, view)| view).take(k).collect()
    }

    /// Returns up to k other views, chosen one by one: each time the one with the highest positive
    /// gain given those already taken, ties by name.
    fn greedy(
        &self,
        k: usize,
        gain: impl Fn(ViewIndex, &[PointIndex], &[ViewIndex]) -> f64,
    ) -> Vec<ViewIndex> {
        let mut taken: Vec<ViewIndex> = Vec::new();
        while taken.len() < k {
            let left = self.others.iter().filter(|(view, _)| !taken.contains(view));
            let gains = left.map(|(view, points)| (gain(*view, points, &taken), *view));
            match gains.reduce(|best, next| if next.0 > best.0 { next } else { best }) {
                Some((gain, view)) if gain > 0.0 => taken.push(view),
                _ => break,
            }
        }
        taken
    }
}
