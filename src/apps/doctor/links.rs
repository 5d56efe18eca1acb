//! Weak or suspicious links between views: a model in several parts, far fewer shared points than
//! the overlap suggests, shared points on only one side of the overlap.

use rayon::prelude::*;

use super::{Finding, Inputs, Severity, ViewFinding, counted};
use crate::{
    base::connected::components,
    method::partners::neighbours,
    model::scene::{PointIndex, ViewIndex},
};

/// Shared points that link two views.
const LINK: usize = 15;
/// Points sampled per view.
const SAMPLE: usize = 400;
/// Nearest neighbours examined per view.
const NEAREST: usize = 6;
/// Minimum number of points needed to judge an overlap.
const ENOUGH: usize = 80;
/// Cosine of the largest angle between rays at which feature matchers are reliable (25 degrees).
const SIMILAR: f64 = 0.906;
/// Largest ratio of the distances of two views from a point.
const SAME_SCALE: f64 = 1.4;
/// Below this share of the points in the overlap, far too few are shared.
const FAR_TOO_FEW: f64 = 0.01;
/// A side of the overlap is linked from this share on, and unlinked below `FAR_TOO_FEW`.
const PRESENT: f64 = 0.2;

pub fn findings(inputs: &Inputs) -> Vec<Finding> {
    let views: Vec<ViewIndex> = inputs.scene.view_indices().collect();
    let judged: Vec<(ViewIndex, Vec<Overlap>)> = views
        .par_iter()
        .map(|&view| overlaps(inputs, view))
        .collect();
    let mut findings: Vec<Finding> = parts(inputs).into_iter().collect();
    let views_where = |wrong: fn(&Overlap) -> bool| -> Vec<ViewFinding> {
        let mostly = |(_, found): &&(ViewIndex, Vec<Overlap>)| {
            let bad = found.iter().filter(|overlap| wrong(overlap)).count();
            // Of most neighbours: a single one may itself be the view in a wrong place.
            bad > 0 && 2 * bad > found.len()
        };
        let words = |(view, found): &(ViewIndex, Vec<Overlap>)| {
            let example = found
                .iter()
                .find(|overlap| wrong(overlap))
                .map(|o| o.describe(inputs))
                .unwrap_or_default();
            inputs.view_finding(*view, example)
        };
        judged.iter().filter(mostly).map(words).collect()
    };
    for (id, wrong, what, cure) in [
        (
            "far-too-few-shared-points",
            Overlap::far_too_few as fn(&Overlap) -> bool,
            "with far fewer shared points than the overlap suggests; the poses may be wrong",
            "inspect them in the model; match them again with their neighbours, or remove them (colmap image_deleter)",
        ),
        (
            "one-sided-links",
            Overlap::one_sided,
            "sharing points with most neighbours on one side of the overlap only; the model may be bent there",
            "inspect the model there; straighten it by bundle adjustment with more matches or ground control",
        ),
    ] {
        let views = views_where(wrong);
        if !views.is_empty() {
            let what = format!("{} {what}", counted(views.len(), "view"));
            findings.push(Finding::new(Severity::Warning, id, what, cure).of_views(views));
        }
    }
    findings
}

/// Overlap of two views by geometry and by tracks.
struct Overlap {
    other: ViewIndex,
    /// Points of the first view within sight of the other, in the left and the right third of them.
    seen: [usize; 2],
    /// The part of `seen` that both views observe.
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

    fn describe(&self, inputs: &Inputs) -> String {
        let (shared, seen) = (
            self.shared.iter().sum::<usize>(),
            self.seen.iter().sum::<usize>(),
        );
        format!(
            "{shared} of {seen} points that {} should also see",
            inputs.scene.name(self.other)
        )
    }
}

/// Returns the overlaps of a view with its nearest neighbours of similar direction and scale.
fn overlaps(inputs: &Inputs, view: ViewIndex) -> (ViewIndex, Vec<Overlap>) {
    let all = inputs.points.observed_by(view);
    let sample: Vec<PointIndex> = all
        .iter()
        .step_by(all.len().div_ceil(SAMPLE).max(1))
        .copied()
        .collect();
    // A model may have any number of views without points.
    if sample.len() < ENOUGH {
        return (view, Vec::new());
    }
    let scene = inputs.scene;
    let centre = scene.view(view).cam_from_world.centre();
    // A view without points shares none with any other; its neighbours are not to blame.
    let mut others: Vec<(f64, ViewIndex)> = scene
        .view_indices()
        .filter(|&v| v != view && !inputs.points.observed_by(v).is_empty())
        .map(|v| {
            (
                (scene.view(v).cam_from_world.centre() - centre).norm_squared(),
                v,
            )
        })
        .collect();
    let nearer =
        |a: &(f64, ViewIndex), b: &(f64, ViewIndex)| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1));
    if others.len() > NEAREST {
        // Linear, where a full sort for each of n views would take n² log n.
        others.select_nth_unstable_by(NEAREST, nearer);
        others.truncate(NEAREST);
    }
    others.sort_by(nearer);
    let found = others
        .iter()
        .filter_map(|&(_, other)| overlap(inputs, view, other, &sample))
        .collect();
    (view, found)
}

fn overlap(
    inputs: &Inputs,
    view: ViewIndex,
    other: ViewIndex,
    sample: &[PointIndex],
) -> Option<Overlap> {
    let scene = inputs.scene;
    let [own, their] = [view, other].map(|v| &scene.view(v).cam_from_world);
    let [from, to] = [own.centre(), their.centre()];
    let upright = own.viewing_direction().dot(&their.viewing_direction()) > SIMILAR;
    let same_side = |p: &&PointIndex| {
        let point = &scene.points[p.index()];
        let (a, b) = (from - point, to - point);
        let (near, far) = (a.norm().min(b.norm()), a.norm().max(b.norm()));
        let pixel = scene
            .camera_of(other)
            .project(&their.camera_from_world(point));
        a.dot(&b) > SIMILAR * near * far
            && far < SAME_SCALE * near
            && pixel.is_some_and(|pixel| scene.camera_of(other).contains(&pixel))
    };
    let mut seen: Vec<(f64, bool)> = sample
        .iter()
        .filter(same_side)
        .map(|&p| {
            (
                own.camera_from_world(&scene.points[p.index()]),
                scene.track_views(p).contains(&other),
            )
        })
        .map(|(x, shared)| (x.x / x.z, shared))
        .collect();
    if !upright || seen.len() < ENOUGH {
        return None;
    }
    seen.sort_by(|a, b| a.0.total_cmp(&b.0));
    let third = seen.len() / 3;
    let (left, right) = (&seen[..third], &seen[seen.len() - third..]);
    let shared = [left, right].map(|side| side.iter().filter(|(_, shared)| *shared).count());
    Some(Overlap {
        other,
        seen: [left.len(), right.len()],
        shared,
    })
}

/// Reports a model of several connected components.
fn parts(inputs: &Inputs) -> Option<Finding> {
    let linked = |view: u32| {
        let around = neighbours(inputs.scene, inputs.points, ViewIndex(view)).into_iter();
        around
            .filter(|(_, shared)| shared.len() >= LINK)
            .map(|(other, _)| other.0)
    };
    let mut components = components(inputs.scene.views.len(), linked);
    // The largest part counts as the model, and the views of the others are named.
    components.sort_by_key(|members| (std::cmp::Reverse(members.len()), members[0]));
    // Single views are already reported as having too few partners.
    let parts: Vec<&Vec<u32>> = components
        .iter()
        .filter(|members| members.len() > 1)
        .collect();
    (parts.len() > 1).then(|| {
        let sizes: Vec<String> = parts.iter().take(5).map(|members| members.len().to_string()).collect();
        let what = format!(
            "the model has {} parts of {} views, linked by fewer than {LINK} shared points: their relative position is uncertain",
            parts.len(),
            sizes.join(", ")
        );
        let cure = "match images between the parts again, or plan each part separately";
        let others = parts[1..].iter().flat_map(|members| members.iter().map(|&view| ViewIndex(view)));
        Finding::new(Severity::Warning, "model-in-parts", what, cure).of_views(inputs.named(others))
    })
}
