//! Where one must fly again: regions of the surface that no view can fill.

use std::cmp::Reverse;

use nalgebra::{Point3, Vector3};

use crate::{
    connected::components,
    plan::{Plan, Reason},
    surface::corners::{BORDER, opposites},
};

/// A connected region of triangles that no cluster fulfils to a tenth.
#[derive(Clone, Debug, PartialEq)]
pub struct Hole {
    /// Square scene units.
    pub area: f64,
    pub triangles: usize,
    /// What fails on most of its area.
    pub reason: Reason,
    /// Mean of its triangles by area, world coordinates.
    pub centre: Point3<f64>,
}

/// What fills such a hole.
pub fn help(reason: Reason) -> &'static str {
    match reason {
        Reason::TooCoarse => "images from nearer, or with a longer lens",
        Reason::TooInaccurate | Reason::RotationOnly => "images from places farther apart",
        Reason::NotMatchable => "images that look at it less slantingly, and from directions and distances more alike",
        _ => "more images that see it, with more overlap",
    }
}

/// The `most` largest holes, largest first, and the area of all.
pub fn holes(plan: &Plan, most: usize) -> (Vec<Hole>, f64) {
    let mut holes = regions(plan).into_iter().map(|region| hole(plan, &region)).collect::<Vec<_>>();
    let all = holes.iter().map(|hole| hole.area).sum();
    holes.sort_by(|a, b| b.area.total_cmp(&a.area));
    holes.truncate(most);
    (holes, all)
}

/// Triangles with a reason, those with a common edge together; in the order of their first triangles.
fn regions(plan: &Plan) -> Vec<Vec<u32>> {
    let opposite = opposites(&plan.surface);
    let reasons = plan.triangle_reasons.iter().zip(0u32..);
    let open: Vec<u32> = reasons.filter_map(|(reason, t)| reason.map(|_| t)).collect();
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
    let anchor = plan.surface.centroid(region[0]);
    for &t in region {
        let own = plan.surface.area(t);
        area += own;
        moment += (plan.surface.centroid(t) - anchor) * own;
        plan.triangle_reasons[t as usize].iter().for_each(|r| *by_reason.entry(*r).or_insert(0.0) += own);
    }
    let most = by_reason.into_iter().max_by(|a, b| a.1.total_cmp(&b.1).then(Reverse(a.0).cmp(&Reverse(b.0))));
    Hole {
        area,
        triangles: region.len(),
        reason: most.map_or(Reason::NotMatchable, |(reason, _)| reason),
        centre: if area > 0.0 { anchor + moment / area } else { anchor },
    }
}
