//! The candidates of each key view, and why the other views that share points with it are none.

use std::cmp::Reverse;

use nalgebra::Point3;
use rayon::prelude::*;

use crate::{
    backends::Backend,
    config::PartnerSettings,
    plan::Reason,
    progress::{Cancelled, Watcher},
    scene::{PointIndex, Scene, ViewIndex, ViewPoints},
};

/// How two views stand to each other: what a backend needs to say whether it can match them (method 7.1).
#[derive(Clone, Copy)]
pub struct PairGeometry<'a> {
    pub scene: &'a Scene,
    pub key: ViewIndex,
    pub partner: ViewIndex,
    /// Sparse points that both observe, ascending, each once.
    pub shared: &'a [PointIndex],
    /// Median triangulation angle at the shared points, degrees.
    pub angle_deg: f64,
    /// Share of the shared points with an angle below 0.5 degrees.
    pub still_share: f64,
    /// Median over the shared points of the partner's scale over the key view's, octaves; positive: the partner is finer.
    pub scale_octaves: f64,
    /// Does the line through the two centres meet one of the images?
    pub epipole_inside: bool,
}

/// A pair of views with shared points that is no candidate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Refusal {
    pub partner: ViewIndex,
    pub reason: Reason,
}

/// The candidates of every view, best first, CSR by view; only pairs that the backend can match.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Candidates {
    /// Views + 1 entries.
    pub offsets: Vec<usize>,
    pub views: Vec<ViewIndex>,
    /// Views + 1 entries.
    pub refusal_offsets: Vec<usize>,
    /// Pairs with shared points that were refused, most shared points first, CSR by view.
    pub refusals: Vec<Refusal>,
}

impl Candidates {
    pub fn of(&self, view: ViewIndex) -> &[ViewIndex] {
        &self.views[self.offsets[view.at()]..self.offsets[view.at() + 1]]
    }

    /// Why other views that share points with this one are no candidates.
    pub fn refused(&self, view: ViewIndex) -> &[Refusal] {
        &self.refusals[self.refusal_offsets[view.at()]..self.refusal_offsets[view.at() + 1]]
    }
}

/// Neighbours that are looked at together; in most scenes the candidates are among the first.
const NEIGHBOURS_AT_ONCE: usize = 64;
/// Below this angle two views see a point from the same place, degrees.
const STILL_DEG: f64 = 0.5;

/// The n views with the most shared points of those that have a baseline and that the backend can match, ties by name.
pub fn candidates(
    scene: &Scene,
    points: &ViewPoints,
    settings: &PartnerSettings,
    backend: &dyn Backend,
    watcher: &dyn Watcher,
) -> Result<Candidates, Cancelled> {
    let of_view = |view: u32| {
        watcher.check()?;
        Ok(Neighbourhood::new(scene, points, ViewIndex(view)).candidates(settings.candidates as usize, backend))
    };
    let views: Vec<(Vec<ViewIndex>, Vec<Refusal>)> =
        (0..scene.views.len() as u32).into_par_iter().map(of_view).collect::<Result<_, _>>()?;
    let mut all = Candidates { offsets: vec![0], refusal_offsets: vec![0], ..Default::default() };
    for (candidates, refusals) in views {
        all.views.extend(candidates);
        all.refusals.extend(refusals);
        all.offsets.push(all.views.len());
        all.refusal_offsets.push(all.refusals.len());
    }
    Ok(all)
}

/// The views that share points with a key view, most shared points first, ties by name.
struct Neighbourhood<'a> {
    scene: &'a Scene,
    key: ViewIndex,
    neighbours: Vec<(ViewIndex, Vec<PointIndex>)>,
}

impl<'a> Neighbourhood<'a> {
    fn new(scene: &'a Scene, points: &ViewPoints, key: ViewIndex) -> Self {
        let mut pairs: Vec<(ViewIndex, PointIndex)> = Vec::new();
        for &p in points.of(key) {
            pairs.extend(scene.track_views(p).iter().filter(|v| **v != key).map(|&v| (v, p)));
        }
        pairs.sort_unstable();
        pairs.dedup();
        let mut neighbours: Vec<(ViewIndex, Vec<PointIndex>)> =
            pairs.chunk_by(|a, b| a.0 == b.0).map(|of| (of[0].0, of.iter().map(|pair| pair.1).collect())).collect();
        neighbours.sort_by_key(|(view, shared)| (Reverse(shared.len()), *view));
        Self { scene, key, neighbours }
    }

    /// The first `count` that can be matched, and why those before them can't.
    fn candidates(&self, count: usize, backend: &dyn Backend) -> (Vec<ViewIndex>, Vec<Refusal>) {
        let (mut candidates, mut refusals) = (Vec::new(), Vec::new());
        for neighbours in self.neighbours.chunks(NEIGHBOURS_AT_ONCE) {
            let pairs: Vec<PairGeometry> =
                neighbours.iter().map(|(partner, shared)| self.pair(*partner, shared)).collect();
            for (pair, refusal) in pairs.iter().zip(backend.refusals(&pairs)) {
                if candidates.len() == count {
                    return (candidates, refusals);
                }
                let still = (pair.still_share > 0.5).then_some(Reason::RotationOnly);
                match still.or(refusal) {
                    None => candidates.push(pair.partner),
                    Some(reason) => refusals.push(Refusal { partner: pair.partner, reason }),
                }
            }
        }
        (candidates, refusals)
    }

    fn pair<'b>(&'b self, partner: ViewIndex, shared: &'b [PointIndex]) -> PairGeometry<'b> {
        let centres = [self.key, partner].map(|v| self.scene.view(v).cam_from_world.centre());
        let focals = [self.key, partner].map(|v| self.scene.camera_of(v).mean_focal_length());
        let (mut angles, mut octaves) = (Vec::with_capacity(shared.len()), Vec::with_capacity(shared.len()));
        for &p in shared {
            let [to_key, to_partner] = centres.map(|centre| centre - self.scene.points[p.at()]);
            angles.push(to_key.angle(&to_partner).to_degrees());
            octaves.push((focals[1] * to_key.norm() / (focals[0] * to_partner.norm())).log2());
        }
        let still = angles.iter().filter(|angle| **angle < STILL_DEG).count();
        PairGeometry {
            scene: self.scene,
            key: self.key,
            partner,
            shared,
            angle_deg: median(&mut angles),
            still_share: still as f64 / shared.len().max(1) as f64,
            scale_octaves: median(&mut octaves),
            epipole_inside: self.sees(self.key, &centres[1]) || self.sees(partner, &centres[0]),
        }
    }

    /// Does the line through the view's centre and this point meet its image?
    fn sees(&self, view: ViewIndex, centre: &Point3<f64>) -> bool {
        let camera = self.scene.camera_of(view);
        let ahead = self.scene.view(view).cam_from_world.camera_from_world(centre);
        let meets = |x: &Point3<f64>| camera.project(x).is_some_and(|pixel| camera.contains(&pixel));
        meets(&ahead) || meets(&-ahead)
    }
}

/// The upper median; 0 of nothing. NaN, which no reader lets pass, would count as the largest.
fn median(values: &mut [f64]) -> f64 {
    let middle = values.len() / 2;
    if values.is_empty() { 0.0 } else { *values.select_nth_unstable_by(middle, f64::total_cmp).1 }
}
