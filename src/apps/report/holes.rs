//! Regions of the surface that no cluster fulfils and that need new images.

use std::{cmp::Reverse, collections::BTreeMap};

use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

use super::subject::Subject;
use crate::{
    base::{connected::components, median::upper_median},
    model::{
        georeference::MapFrame,
        reason::Reason,
        scene::{PointIndex, Scene, ViewIndex},
        surface::corners::{BORDER, opposites},
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
    /// Centroid of the triangle deepest inside the hole, world coordinates; always on the hole,
    /// unlike the mean of a ring.
    pub centre: Point3<f64>,
    /// The triangle there.
    pub deepest: u32,
    /// Its triangles, ascending.
    pub members: Vec<u32>,
    /// Views of the deepest triangle.
    pub seen: Seen,
}

/// The views that see a place.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Seen {
    pub views: usize,
    /// Ground sampling distance of the closest view over the wanted one; infinite without a view.
    pub gsd_ratio: f64,
    /// Largest angle between the rays of two of the views, degrees.
    pub angle_deg: f64,
    /// Least angle between a ray and the normal, degrees.
    pub incidence_deg: f64,
}

/// Rays of views farther apart than this measure depth well enough, degrees.
const WIDE_DEG: f64 = 5.0;
/// Places seen more obliquely than this can rarely be matched, degrees.
const OBLIQUE_DEG: f64 = 60.0;

impl Hole {
    /// Returns a description of what is missing. `needed`: minimum number of cameras that see a
    /// place, key view included.
    pub fn missing(&self, needed: u32) -> String {
        let Seen {
            views,
            gsd_ratio,
            angle_deg,
            incidence_deg,
        } = self.seen;
        let count = |n: usize| format!("{n} view{}", if n == 1 { "" } else { "s" });
        match self.reason {
            _ if views < needed as usize => {
                format!("too few views: {} of the {needed} needed", count(views))
            }
            Reason::TooCoarse if gsd_ratio >= 1.05 => {
                format!(
                    "too coarse: the closest view is {:.0} % too far away",
                    100.0 * (gsd_ratio - 1.0)
                )
            }
            Reason::TooCoarse => "too coarse: the closest views see it too obliquely".into(),
            _ if angle_deg < WIDE_DEG => {
                format!(
                    "angle: its {} are within {angle_deg:.0}° of each other",
                    count(views)
                )
            }
            _ if incidence_deg > OBLIQUE_DEG => {
                format!(
                    "angle: seen no steeper than {:.0}° to the surface",
                    90.0 - incidence_deg
                )
            }
            Reason::TooFewCameras => {
                format!(
                    "too few views together: {} see it, from too different places",
                    count(views)
                )
            }
            _ => format!(
                "matching fails: {} see it, and no pair of them is expected to match",
                count(views)
            ),
        }
    }

    /// Returns advice on the new images that would fill it. `needed`: minimum number of cameras
    /// that see a place, key view included.
    pub fn advice(&self, needed: u32) -> &'static str {
        let Seen {
            views,
            angle_deg,
            incidence_deg,
            ..
        } = self.seen;
        match self.reason {
            _ if views < needed as usize => "more images of it, with more overlap",
            Reason::TooCoarse => "closer images, or a longer lens",
            _ if angle_deg < WIDE_DEG => "images taken farther apart",
            _ if incidence_deg > OBLIQUE_DEG => "images that face it",
            _ => "images 10 to 20° apart, from the same distance, facing it",
        }
    }
}

/// All holes of a plan.
#[derive(Clone, Debug, PartialEq)]
pub struct Holes {
    /// The largest of those near the cameras, largest first.
    pub largest: Vec<Hole>,
    /// Area of all holes, square scene units.
    pub area: f64,
    /// Area of the background: holes farther than [`FAR`] usual distances from every camera; square
    /// scene units.
    pub far_area: f64,
    /// Median distance of the sparse points from the nearest of their views, scene units; 0 without
    /// points.
    pub usual_distance: f64,
}

/// Holes with less than this share of the area of all holes near the cameras are not listed.
const LEAST_SHARE: f64 = 0.005;
/// Places farther from every camera than this multiple of the usual distance (sparse point to the
/// nearest view observing it) are background.
pub const FAR: f64 = 4.0;

/// Finds the holes of a plan, of one with a region those inside, and lists at most the `most`
/// largest near the cameras.
pub fn holes(plan: &Plan, most: usize) -> Holes {
    let open: Vec<u32> = plan.unfulfilled().collect();
    let usual = usual_distance(&plan.stages.scene);
    let limit = usual.map_or(f64::INFINITY, |usual| FAR * usual);
    let is_near = |&t: &u32| {
        let place = plan.stages.surface.centroid(t);
        plan.stages
            .scene
            .views
            .iter()
            .any(|view| (view.cam_from_world.centre() - place).norm() <= limit)
    };
    let (near, far): (Vec<u32>, Vec<u32>) = open.into_par_iter().partition(is_near);
    let frame = MapFrame::new(&plan.stages.scene, plan.stages.settings.surface.up);
    let subject = Subject::new(plan, &frame);
    let area = |triangles: &[u32]| triangles.iter().map(|&t| plan.area_inside(t)).sum::<f64>();
    let in_subject = |t: &u32| {
        subject
            .as_ref()
            .is_none_or(|subject| subject.contains(&plan.stages.surface.centroid(*t)))
    };
    let inside: Vec<u32> = near.iter().copied().filter(in_subject).collect();
    let mut largest: Vec<Hole> = regions(plan, &inside)
        .into_iter()
        .map(|region| hole(plan, region))
        .collect();
    largest.sort_by(|a, b| b.area.total_cmp(&a.area));
    largest.truncate(most);
    // Only of those that may be listed, since each looks through all views.
    largest
        .par_iter_mut()
        .for_each(|hole| hole.seen = seen(plan, hole.deepest));
    let (near_area, far_area) = (area(&near), area(&far));
    let least = LEAST_SHARE * area(&inside);
    let worth_it = largest.partition_point(|hole| hole.area >= least);
    largest.truncate(worth_it);
    Holes {
        largest,
        area: near_area + far_area,
        far_area,
        usual_distance: usual.unwrap_or_default(),
    }
}

/// Returns the median distance of the sparse points from the nearest of their views.
fn usual_distance(scene: &Scene) -> Option<f64> {
    let nearest = |p: u32| {
        let views = scene.track_views[scene.track(PointIndex(p))].iter();
        let distance = |view: &ViewIndex| {
            (scene.views[view.index()].cam_from_world.centre() - scene.points[p as usize]).norm()
        };
        views.map(distance).min_by(f64::total_cmp)
    };
    upper_median((0..scene.points.len() as u32).filter_map(nearest))
}

/// Returns the connected components of the open triangles by shared edges, ordered by their first
/// triangle. `open` must be sorted.
fn regions(plan: &Plan, open: &[u32]) -> Vec<Vec<u32>> {
    let opposite = opposites(&plan.stages.surface);
    let beside = |i: u32| {
        let corners = opposite[3 * open[i as usize] as usize..][..3]
            .iter()
            .filter(|&&corner| corner != BORDER);
        corners
            .filter_map(|corner| open.binary_search(&(corner / 3)).ok())
            .map(|place| place as u32)
    };
    let regions = components(open.len(), beside).into_iter();
    regions
        .map(|region| region.into_iter().map(|i| open[i as usize]).collect())
        .collect()
}

fn hole(plan: &Plan, region: Vec<u32>) -> Hole {
    let mut by_reason = BTreeMap::new();
    let mut area = 0.0;
    for &t in &region {
        let own = plan.area_inside(t);
        area += own;
        plan.decision.triangle_reasons[t as usize]
            .iter()
            .for_each(|r| *by_reason.entry(*r).or_insert(0.0) += own);
    }
    let most = by_reason
        .into_iter()
        .max_by(|a, b| a.1.total_cmp(&b.1).then(Reverse(a.0).cmp(&Reverse(b.0))));
    let deepest = deepest(plan, &region);
    Hole {
        area,
        triangles: region.len(),
        reason: most.map_or(Reason::NotMatchable, |(reason, _)| reason),
        centre: plan.stages.surface.centroid(deepest),
        deepest,
        members: region,
        seen: Seen::default(),
    }
}

/// Returns the triangle of the region farthest from its rim: peels off rings of triangles and takes
/// the largest triangle of the last one.
fn deepest(plan: &Plan, region: &[u32]) -> u32 {
    let surface = &plan.stages.surface;
    let mut at: BTreeMap<[u32; 2], Vec<u32>> = BTreeMap::new();
    for (i, &t) in (0u32..).zip(region) {
        let [a, b, c] = surface.triangles[t as usize];
        [[a, b], [b, c], [c, a]]
            .into_iter()
            .for_each(|[a, b]| at.entry([a.min(b), a.max(b)]).or_default().push(i));
    }
    let mut neighbours = vec![Vec::new(); region.len()];
    at.values().filter(|both| both.len() == 2).for_each(|both| {
        neighbours[both[0] as usize].push(both[1]);
        neighbours[both[1] as usize].push(both[0]);
    });
    let mut layer: Vec<u32> = (0..region.len() as u32)
        .filter(|&i| neighbours[i as usize].len() < 3)
        .collect();
    let mut reached = vec![false; region.len()];
    layer.iter().for_each(|&i| reached[i as usize] = true);
    // A closed surface has no rim.
    let mut last = if layer.is_empty() {
        (0..region.len() as u32).collect()
    } else {
        layer.clone()
    };
    while !layer.is_empty() {
        last = std::mem::take(&mut layer);
        for &n in last.iter().flat_map(|&i| &neighbours[i as usize]) {
            if !std::mem::replace(&mut reached[n as usize], true) {
                layer.push(n);
            }
        }
    }
    let place = last.into_iter().map(|i| region[i as usize]);
    place
        .max_by(|&a, &b| surface.area(a).total_cmp(&surface.area(b)).then(b.cmp(&a)))
        .unwrap_or(region[0])
}

/// The views of a triangle: number, closeness, and directions.
fn seen(plan: &Plan, triangle: u32) -> Seen {
    let stages = &plan.stages;
    let place = stages.surface.centroid(triangle);
    let views = stages
        .scene
        .view_indices()
        .filter(|&v| stages.visibility.row(v, triangle).is_some());
    let views: Vec<ViewIndex> = views.collect();
    let to_camera = |&v: &ViewIndex| stages.scene.view(v).cam_from_world.centre() - place;
    let gsd = |v: &ViewIndex| to_camera(v).norm() / stages.scene.camera_of(*v).mean_focal_length();
    let wanted = stages.settings.target.gsd.unwrap_or(1.0) * stages.settings.image_scale();
    let rays: Vec<Vector3<f64>> = views.iter().map(|v| to_camera(v).normalize()).collect();
    let normal = stages
        .surface
        .area_normal(triangle)
        .try_normalize(0.0)
        .unwrap_or_else(Vector3::z);
    let angles = rays
        .iter()
        .enumerate()
        .flat_map(|(i, a)| rays[..i].iter().map(move |b| a.angle(b)));
    Seen {
        views: views.len(),
        gsd_ratio: views.iter().map(gsd).fold(f64::INFINITY, f64::min) / wanted,
        angle_deg: angles.fold(0.0, f64::max).to_degrees(),
        incidence_deg: rays
            .iter()
            .map(|ray| ray.angle(&normal))
            .fold(std::f64::consts::PI, f64::min)
            .to_degrees(),
    }
}
