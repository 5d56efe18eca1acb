//! Links between views that are weak or suspicious: a model in parts, far fewer shared points than the overlap promises, shared points on
//! one side of the overlap only.

use rayon::prelude::*;

use super::{Finding, Severity, ViewFinding, Visit, counted};
use crate::{
    base::connected::components,
    method::partners::neighbours,
    model::scene::{PointIndex, ViewIndex},
};

/// Shared points that hold two views together.
const HOLDING: usize = 15;
/// Points of a view that are looked at.
const SAMPLE: usize = 400;
/// Neighbours by position that are looked at.
const NEAREST: usize = 6;
/// Points in the overlap below which nothing is said.
const ENOUGH: usize = 80;
/// Largest angle between the rays at which any matcher finds its features again, as a cosine (25 degrees).
const SIMILAR: f64 = 0.906;
/// Largest ratio of distances.
const SAME_SCALE: f64 = 1.4;
/// Less than this share of the points in the overlap is far too little.
const FAR_TOO_FEW: f64 = 0.01;
/// A side has its points where this share is shared, and none below the one above.
const PRESENT: f64 = 0.2;

pub fn findings(visit: &Visit) -> Vec<Finding> {
    let views: Vec<ViewIndex> = visit.scene.view_indices().collect();
    let judged: Vec<(ViewIndex, Vec<Overlap>)> = views.par_iter().map(|&view| overlaps(visit, view)).collect();
    let mut findings: Vec<Finding> = parts(visit).into_iter().collect();
    let of = |wrong: &dyn Fn(&Overlap) -> bool| -> Vec<ViewFinding> {
        let most = |(_, found): &&(ViewIndex, Vec<Overlap>)| {
            let bad = found.iter().filter(|overlap| wrong(overlap)).count();
            bad > 0 && 2 * bad > found.len()
        };
        let words = |(view, found): &(ViewIndex, Vec<Overlap>)| {
            let of = found.iter().find(|overlap| wrong(overlap)).map(|o| o.words(visit)).unwrap_or_default();
            visit.of(*view, of)
        };
        judged.iter().filter(most).map(words).collect()
    };
    let few = of(&Overlap::far_too_few);
    if !few.is_empty() {
        let views = counted(few.len(), "view");
        let what = format!(
            "{views} with far fewer shared points than the overlap with the neighbours: perhaps in a wrong place"
        );
        let cure = "look at them in the model; match them again with their neighbours, or take them out (colmap image_deleter)";
        findings.push(Finding::new(Severity::Warning, "far-too-few-shared-points", what, cure).of_views(few));
    }
    let aside = of(&Overlap::one_sided);
    if !aside.is_empty() {
        let views = counted(aside.len(), "view");
        let what = format!(
            "{views} with points shared with most neighbours on one side of the overlap only: the model may be bent there"
        );
        let cure = "look at the model there; bundle adjustment with more matches or ground control straightens it";
        findings.push(Finding::new(Severity::Warning, "one-sided-links", what, cure).of_views(aside));
    }
    findings
}

/// What two views have in common by geometry and by the tracks.
struct Overlap {
    other: ViewIndex,
    /// Points of the one in sight of the other, in the left and right third of them, and those of them that both observe.
    seen: [usize; 2],
    shared: [usize; 2],
}

impl Overlap {
    fn far_too_few(&self) -> bool {
        let seen: usize = self.seen.iter().sum();
        (self.shared.iter().sum::<usize>() as f64) < FAR_TOO_FEW * seen as f64
    }

    fn one_sided(&self) -> bool {
        let share = [0, 1].map(|side| self.shared[side] as f64 / self.seen[side].max(1) as f64);
        self.seen.iter().all(|&n| n >= ENOUGH / 4)
            && share[0].max(share[1]) >= PRESENT
            && share[0].min(share[1]) < FAR_TOO_FEW
    }

    fn words(&self, visit: &Visit) -> String {
        let (shared, seen) = (self.shared.iter().sum::<usize>(), self.seen.iter().sum::<usize>());
        format!("{shared} of {seen} points that {} should see too", visit.scene.name(self.other))
    }
}

/// The overlaps of a view with its nearest neighbours of similar direction and scale.
fn overlaps(visit: &Visit, view: ViewIndex) -> (ViewIndex, Vec<Overlap>) {
    let scene = visit.scene;
    let centre = scene.view(view).cam_from_world.centre();
    let mut others: Vec<(f64, ViewIndex)> = scene
        .view_indices()
        .filter(|&v| v != view && !visit.points.observed_by(v).is_empty())
        .map(|v| ((scene.view(v).cam_from_world.centre() - centre).norm_squared(), v))
        .collect();
    let nearer = |a: &(f64, ViewIndex), b: &(f64, ViewIndex)| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1));
    if others.len() > NEAREST {
        others.select_nth_unstable_by(NEAREST, nearer);
        others.truncate(NEAREST);
    }
    others.sort_by(nearer);
    let all = visit.points.observed_by(view);
    let sample: Vec<PointIndex> = all.iter().step_by(all.len().div_ceil(SAMPLE).max(1)).copied().collect();
    let found = others.iter().filter_map(|&(_, other)| overlap(visit, view, other, &sample)).collect();
    (view, found)
}

fn overlap(visit: &Visit, view: ViewIndex, other: ViewIndex, sample: &[PointIndex]) -> Option<Overlap> {
    let scene = visit.scene;
    let [own, their] = [view, other].map(|v| &scene.view(v).cam_from_world);
    let [from, to] = [own.centre(), their.centre()];
    let upright = own.viewing_direction().dot(&their.viewing_direction()) > SIMILAR;
    let same_side = |p: &&PointIndex| {
        let point = &scene.points[p.index()];
        let (a, b) = (from - point, to - point);
        let (near, far) = (a.norm().min(b.norm()), a.norm().max(b.norm()));
        let pixel = scene.camera_of(other).project(&their.camera_from_world(point));
        a.dot(&b) > SIMILAR * near * far
            && far < SAME_SCALE * near
            && pixel.is_some_and(|pixel| scene.camera_of(other).contains(&pixel))
    };
    let mut seen: Vec<(f64, bool)> = sample
        .iter()
        .filter(same_side)
        .map(|&p| (own.camera_from_world(&scene.points[p.index()]), scene.track_views(p).contains(&other)))
        .map(|(x, shared)| (x.x / x.z, shared))
        .collect();
    if !upright || seen.len() < ENOUGH {
        return None;
    }
    seen.sort_by(|a, b| a.0.total_cmp(&b.0));
    let third = seen.len() / 3;
    let (left, right) = (&seen[..third], &seen[seen.len() - third..]);
    let shared = [left, right].map(|side| side.iter().filter(|(_, shared)| *shared).count());
    Some(Overlap { other, seen: [left.len(), right.len()], shared })
}

/// Does the model hold together?
fn parts(visit: &Visit) -> Option<Finding> {
    let beside = |view: u32| {
        let around = neighbours(visit.scene, visit.points, ViewIndex(view)).into_iter();
        around.filter(|(_, shared)| shared.len() >= HOLDING).map(|(other, _)| other.0)
    };
    let mut sizes = components(visit.scene.views.len(), beside);
    sizes.sort_by_key(|members| (std::cmp::Reverse(members.len()), members[0]));
    // Single views have too few partners, which is said elsewhere.
    let whole: Vec<&Vec<u32>> = sizes.iter().filter(|members| members.len() > 1).collect();
    (whole.len() > 1).then(|| {
        let list: Vec<String> = whole.iter().take(5).map(|members| members.len().to_string()).collect();
        let what = format!(
            "the model falls into {} parts of {} views that share fewer than {HOLDING} points: how they lie to each other is not known well",
            whole.len(),
            list.join(", ")
        );
        let cure = "match the images between the parts again, or plan them apart";
        let others = whole[1..].iter().flat_map(|members| members.iter().map(|&view| ViewIndex(view)));
        Finding::new(Severity::Warning, "model-in-parts", what, cure).of_views(visit.named(others))
    })
}
