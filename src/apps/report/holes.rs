//! Regions of the surface that no cluster fulfils and that need new images.

use std::cmp::Reverse;

use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

use crate::{
    base::connected::components,
    method::surface::{
        corners::{BORDER, opposites},
        points::upper_median,
    },
    model::{
        reason::Reason,
        scene::{PointIndex, Scene, ViewIndex},
    },
    plan::Plan,
};

/// A connected region of triangles that no cluster fulfils to a tenth.
#[derive(Clone, Debug, PartialEq)]
pub struct Hole {
    /// Square scene units.
    pub area: f64,
    pub triangles: usize,
    /// The reason that applies to most of its area.
    pub reason: Reason,
    /// Area-weighted mean of its triangles' centroids, world coordinates.
    pub centre: Point3<f64>,
}

/// Advice on the images to take to fill a hole with this reason.
pub fn advice(reason: Reason) -> &'static str {
    match reason {
        Reason::TooCoarse => "closer images, or a longer lens",
        Reason::TooInaccurate | Reason::RotationOnly => "images taken farther apart",
        Reason::NotMatchable => "images at smaller angles of incidence, from more similar directions and distances",
        _ => "more images of it, with more overlap",
    }
}

/// All holes of a plan.
#[derive(Clone, Debug, PartialEq)]
pub struct Holes {
    /// The largest of those near the cameras, largest first.
    pub largest: Vec<Hole>,
    /// Area of all holes, square scene units.
    pub area: f64,
    /// Area of the background: holes farther than [`FAR`] usual distances from every camera; square scene units.
    pub far_area: f64,
    /// Median distance of the sparse points from the nearest of their views, scene units; 0 without points.
    pub usual_distance: f64,
}

/// Holes with less than this share of the area of all holes near the cameras are not listed.
const LEAST_SHARE: f64 = 0.005;
/// Places farther from every camera than this multiple of the usual distance (sparse point to the nearest view observing it) are background.
pub const FAR: f64 = 4.0;

/// Finds the holes of a plan, of one with a region those inside, and lists at most the `most` largest near the cameras.
pub fn holes(plan: &Plan, most: usize) -> Holes {
    let open: Vec<u32> = plan.unfulfilled().collect();
    let usual = usual_distance(&plan.stages.scene);
    let limit = usual.map_or(f64::INFINITY, |usual| FAR * usual);
    let is_near = |&t: &u32| {
        let place = plan.stages.surface.centroid(t);
        plan.stages.scene.views.iter().any(|view| (view.cam_from_world.centre() - place).norm() <= limit)
    };
    let (near, far): (Vec<u32>, Vec<u32>) = open.into_par_iter().partition(is_near);
    let area = |triangles: &[u32]| triangles.iter().map(|&t| plan.stages.surface.area(t)).sum::<f64>();
    let mut largest = regions(plan, &near).into_iter().map(|region| hole(plan, &region)).collect::<Vec<_>>();
    largest.sort_by(|a, b| b.area.total_cmp(&a.area));
    largest.truncate(most);
    let (near_area, far_area) = (area(&near), area(&far));
    let worth_it = largest.partition_point(|hole| hole.area >= LEAST_SHARE * near_area);
    largest.truncate(worth_it);
    Holes { largest, area: near_area + far_area, far_area, usual_distance: usual.unwrap_or_default() }
}

/// Median distance of the sparse points from the nearest of their views.
fn usual_distance(scene: &Scene) -> Option<f64> {
    let nearest = |p: u32| {
        let views = scene.track_views[scene.track(PointIndex(p))].iter();
        let distance =
            |view: &ViewIndex| (scene.views[view.index()].cam_from_world.centre() - scene.points[p as usize]).norm();
        views.map(distance).min_by(f64::total_cmp)
    };
    upper_median((0..scene.points.len() as u32).filter_map(nearest))
}

/// Connected components of the open triangles by shared edges, ordered by their first triangle. `open` is sorted.
fn regions(plan: &Plan, open: &[u32]) -> Vec<Vec<u32>> {
    let opposite = opposites(&plan.stages.surface);
    let beside = |i: u32| {
        let corners = opposite[3 * open[i as usize] as usize..][..3].iter().filter(|&&corner| corner != BORDER);
        corners.filter_map(|corner| open.binary_search(&(corner / 3)).ok()).map(|place| place as u32)
    };
    let regions = components(open.len(), beside).into_iter();
    regions.map(|region| region.into_iter().map(|i| open[i as usize]).collect()).collect()
}

fn hole(plan: &Plan, region: &[u32]) -> Hole {
    let mut by_reason = std::collections::BTreeMap::new();
    let (mut area, mut moment) = (0.0, Vector3::zeros());
    let anchor = plan.stages.surface.centroid(region[0]);
    for &t in region {
        let own = plan.stages.surface.area(t);
        area += own;
        moment += (plan.stages.surface.centroid(t) - anchor) * own;
        plan.decision.triangle_reasons[t as usize].iter().for_each(|r| *by_reason.entry(*r).or_insert(0.0) += own);
    }
    let most = by_reason.into_iter().max_by(|a, b| a.1.total_cmp(&b.1).then(Reverse(a.0).cmp(&Reverse(b.0))));
    Hole {
        area,
        triangles: region.len(),
        reason: most.map_or(Reason::NotMatchable, |(reason, _)| reason),
        centre: if area > 0.0 { anchor + moment / area } else { anchor },
    }
}
