//! Method 3.6 on the way to a surface: which resolution is wanted where, before any visibility is known.

use nalgebra::Point3;
use rayon::prelude::*;
use rstar::{RTree, primitives::GeomWithData};

use super::points::usable_points;
use crate::model::scene::{PointIndex, Scene};

/// At most about this many sparse points say what is wanted around them: it changes slowly over a surface.
const MOST_POINTS: usize = 50_000;
/// The wanted resolution nowhere differs from the scene's by a larger factor. A single wild point close to a camera would ask for anything.
const MOST_OFF: f64 = 32.0;

/// The ground sampling distance that is wanted at each place, scene units per pixel of the matched image; the lengths of edges are multiples of it.
pub struct WantedGsd {
    everywhere: f64,
    points: Option<RTree<GeomWithData<[f64; 3], f64>>>,
}

impl WantedGsd {
    /// The same at each place.
    pub fn uniform(gsd: f64) -> Self {
        Self { everywhere: gsd, points: None }
    }

    /// That of the nearest sparse point: `margin` times the finest of the views that observe it. `gsd`: the scene's.
    pub fn finest(scene: &Scene, gsd: f64, margin: f64) -> Self {
        let points = usable_points(scene);
        let finest = |&point: &PointIndex| {
            let place = scene.points[point.index()];
            let of_view = |&view| {
                let camera = scene.camera_of(view);
                camera.depth(&scene.view(view).cam_from_world.camera_from_world(&place)) / camera.mean_focal_length()
            };
            let finest = scene.track_views(point).iter().map(of_view).fold(f64::INFINITY, f64::min);
            let wanted = (margin * finest).clamp(gsd / MOST_OFF, gsd * MOST_OFF);
            (!wanted.is_nan()).then(|| GeomWithData::new(place.into(), wanted))
        };
        let sample: Vec<_> = points.iter().step_by(points.len().div_ceil(MOST_POINTS).max(1)).collect();
        let known: Vec<_> = sample.into_par_iter().filter_map(finest).collect();
        Self { everywhere: gsd, points: (!known.is_empty()).then(|| RTree::bulk_load(known)) }
    }

    /// The scene's.
    pub fn everywhere(&self) -> f64 {
        self.everywhere
    }

    /// At each of the places, times `factor`.
    pub fn lengths(&self, places: &[Point3<f64>], factor: f64) -> Vec<f64> {
        let Some(points) = &self.points else { return vec![factor * self.everywhere; places.len()] };
        let wanted = |place: &Point3<f64>| points.nearest_neighbor((*place).into()).map_or(self.everywhere, |p| p.data);
        places.par_iter().map(|place| factor * wanted(place)).collect()
    }
}
