//! Wanted resolution in space (method 3.6), for building the surface, before visibility is known.

use nalgebra::Point3;
use rayon::prelude::*;

use super::points::usable_points;
use crate::{
    base::{
        kd_tree::KdTree,
        progress::{Cancelled, Watcher},
    },
    model::scene::{PointIndex, Scene},
};

/// Approximate maximum number of sparse points that sample the wanted resolution, which changes
/// slowly over a surface.
const MOST_POINTS: usize = 50_000;
/// Positions between two checks for cancellation; well under 50 ms.
const CHECK_INTERVAL: usize = 4096;
/// Largest factor between a local wanted resolution and that of the scene: a single outlier close
/// to a camera could demand any resolution.
const MOST_OFF: f64 = 32.0;

/// Wanted ground sampling distance as a function of position, scene units per pixel of the matched
/// image. Edge lengths are multiples of it.
pub struct WantedGsd {
    everywhere: f64,
    points: Option<KnownGsd>,
}

/// Wanted GSD at sparse points.
struct KnownGsd {
    points: KdTree,
    gsd: Vec<f64>,
}

impl WantedGsd {
    /// The same everywhere.
    pub fn uniform(gsd: f64) -> Self {
        Self {
            everywhere: gsd,
            points: None,
        }
    }

    /// Takes the GSD of the nearest sparse point: `margin` times the finest of the views that
    /// observe it. `gsd`: that of the scene.
    pub fn finest(scene: &Scene, gsd: f64, margin: f64) -> Self {
        // Local, so that triangles of a bust and of the wall behind cover about as many pixels:
        // 1,900 triangles take the place of 38,700 on `statue`, nearly all of them on the wall.
        let points = usable_points(scene);
        let wanted = |&point: &PointIndex| {
            let finest = margin * finest_gsd(scene, point);
            let wanted = finest.clamp(gsd / MOST_OFF, gsd * MOST_OFF);
            (!wanted.is_nan()).then_some((scene.points[point.index()], wanted))
        };
        let sample: Vec<_> = points
            .iter()
            .step_by(points.len().div_ceil(MOST_POINTS).max(1))
            .collect();
        let (places, known): (Vec<_>, Vec<_>) = sample.into_par_iter().filter_map(wanted).unzip();
        let points = (!known.is_empty()).then(|| KnownGsd {
            points: KdTree::new(&places),
            gsd: known,
        });
        Self {
            everywhere: gsd,
            points,
        }
    }

    /// Returns the GSD of the scene.
    pub fn everywhere(&self) -> f64 {
        self.everywhere
    }

    /// Returns the GSD at each position, times `factor`; outside of the points that of the nearest
    /// place in their box.
    pub fn lengths(
        &self,
        places: &[Point3<f64>],
        factor: f64,
        watcher: &dyn Watcher,
    ) -> Result<Vec<f64>, Cancelled> {
        let mut lengths = vec![factor * self.everywhere; places.len()];
        let Some(known) = &self.points else {
            return Ok(lengths);
        };
        let parts = lengths.par_chunks_mut(CHECK_INTERVAL);
        parts
            .zip(places.par_chunks(CHECK_INTERVAL))
            .try_for_each(|(lengths, places)| {
                watcher.check()?;
                for (length, place) in lengths.iter_mut().zip(places) {
                    let [nearest] = known.points.nearest(&known.points.in_bounds(place));
                    *length = factor * known.gsd[nearest as usize];
                }
                Ok(())
            })?;
        Ok(lengths)
    }
}

/// Returns the finest GSD of the views that observe a point.
fn finest_gsd(scene: &Scene, point: PointIndex) -> f64 {
    let place = scene.points[point.index()];
    let of_view = |&view| {
        let camera = scene.camera_of(view);
        camera.depth(&scene.view(view).cam_from_world.camera_from_world(&place))
            / camera.mean_focal_length()
    };
    let views = scene.track_views(point).iter();
    views.map(of_view).fold(f64::INFINITY, f64::min)
}
