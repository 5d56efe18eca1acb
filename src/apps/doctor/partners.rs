//! Which views can't get enough matching partners, and why; views that stand at one position.

use std::collections::BTreeMap;

use rayon::prelude::*;

use super::{FEW, Finding, Severity, ViewFinding, Visit, counted};
use crate::{
    backends::Backend,
    base::connected::components,
    method::partners::{Obstacle, PairGeometry, neighbours},
    model::{
        reason::Reason,
        scene::{PointIndex, Scene, ViewIndex, ViewPoints},
    },
};

/// Share of the sparse points that only views without partners see, from which on their loss is no longer the usual border of a
/// block.
const LOST: f64 = 0.01;
/// From this share on, of either, there is next to nothing to plan.
const MOST: f64 = 0.5;

/// Why a pair cannot be matched.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Refused {
    NoBaseline,
    Limit(Obstacle),
}

impl Refused {
    fn words(self) -> &'static str {
        match self {
            Self::NoBaseline => "no baseline",
            Self::Limit(Obstacle::FewSharedPoints) => "too few shared points",
            Self::Limit(Obstacle::SmallAngle) => "angle too small",
            Self::Limit(Obstacle::LargeAngle) => "angle too large",
            Self::Limit(Obstacle::Scale) => "scale too different",
            Self::Limit(Obstacle::Epipole) => "flying along the line of sight",
        }
    }
}

/// What the other views are to one.
struct PartnerCheck {
    view: ViewIndex,
    partners: usize,
    refused: BTreeMap<Refused, usize>,
    /// Views at the same position.
    still: Vec<ViewIndex>,
}

pub fn findings(visit: &Visit) -> Vec<Finding> {
    let views: Vec<ViewIndex> = visit.scene.view_indices().collect();
    let checks: Vec<PartnerCheck> =
        views.par_iter().map(|&view| check_partners(visit.scene, visit.points, visit.backend, view)).collect();
    let fewer = [too_few(visit, &checks), fewer_than_wanted(visit, &checks)];
    fewer.into_iter().flatten().chain(one_position(visit, &checks)).collect()
}

/// Partners below which nothing is fulfilled with a view as key view.
fn least(visit: &Visit) -> usize {
    let settings = &visit.settings;
    settings.coverage.min_cameras.saturating_sub(1).clamp(1, settings.partners.k.max(1)) as usize
}

/// How many of the views that share points with this one the backend can match with it, and why the others not.
pub fn partners_in_words(scene: &Scene, points: &ViewPoints, backend: &dyn Backend, view: ViewIndex) -> String {
    check_partners(scene, points, backend, view).words()
}

fn check_partners(scene: &Scene, points: &ViewPoints, backend: &dyn Backend, view: ViewIndex) -> PartnerCheck {
    let around = neighbours(scene, points, view);
    let pairs: Vec<PairGeometry> =
        around.iter().map(|(other, shared)| PairGeometry::new(scene, view, *other, shared)).collect();
    let (still, moving): (Vec<_>, Vec<_>) = pairs.into_iter().partition(PairGeometry::has_no_baseline);
    let gate = backend.planning().gate;
    let obstacles: Vec<Obstacle> = moving.iter().filter_map(|pair| gate.obstacle(pair)).collect();
    let mut check = PartnerCheck {
        view,
        partners: moving.len() - obstacles.len(),
        refused: BTreeMap::new(),
        still: still.iter().map(|pair| pair.partner).collect(),
    };
    for reason in obstacles.into_iter().map(Refused::Limit).chain(still.iter().map(|_| Refused::NoBaseline)) {
        *check.refused.entry(reason).or_default() += 1;
    }
    check
}

impl PartnerCheck {
    fn words(&self) -> String {
        if self.partners == 0 && self.refused.is_empty() {
            return Reason::NoSharedPoints.words().into();
        }
        let mut refused: Vec<(&Refused, &usize)> = self.refused.iter().collect();
        refused.sort_by_key(|(reason, count)| (std::cmp::Reverse(**count), **reason));
        let refused: Vec<String> =
            refused.iter().map(|(reason, count)| format!("{count} {}", reason.words())).collect();
        match refused.is_empty() {
            true => format!("{}, no other view shares points with it", counted(self.partners, "partner")),
            false => format!("{}; refused: {}", counted(self.partners, "partner"), refused.join(", ")),
        }
    }
}

/// Views that can be no key view. How bad that is shows in what is lost with them: points that no other view sees.
fn too_few(visit: &Visit, checks: &[PartnerCheck]) -> Option<Finding> {
    let least = least(visit);
    let none: Vec<&PartnerCheck> = checks.iter().filter(|check| check.partners < least).collect();
    let lost = lost_share(visit, &none);
    let share = none.len() as f64 / checks.len().max(1) as f64;
    let severity = if share.max(lost) >= MOST {
        Severity::Error
    } else if lost >= LOST || share >= FEW {
        Severity::Warning
    } else {
        Severity::Note
    };
    let and = match lost > 0.0 {
        true => format!("{:.1} % of the sparse points are seen by no others", 100.0 * lost),
        false => "what points they have, others see too".into(),
    };
    let cure = match severity {
        Severity::Note => "nothing: they get no depth map, and others fill their places",
        _ => {
            "match these images with more others in structure from motion; where there is no baseline, photograph from other places"
        }
    };
    (!none.is_empty()).then(|| {
        let what = format!(
            "{} of {} with fewer than {least} partners that {} can match: these can be no key views; {and}",
            none.len(),
            counted(checks.len(), "view"),
            visit.backend.name()
        );
        Finding::new(severity, "too-few-partners", what, cure).of_views(words(visit, none))
    })
}

/// Share of the sparse points that only these views see.
fn lost_share(visit: &Visit, none: &[&PartnerCheck]) -> f64 {
    let mut without = vec![false; visit.scene.views.len()];
    none.iter().for_each(|check| without[check.view.index()] = true);
    let tracks = || (0..visit.scene.points.len() as u32).map(|p| visit.scene.track_views(PointIndex(p)));
    // A point that one view alone observes is none of the surface (method 1.1).
    let sound = || tracks().filter(|views| views.len() > 1);
    sound().filter(|views| views.iter().all(|v| without[v.index()])).count() as f64 / sound().count().max(1) as f64
}

/// Key views with fewer than k partners.
fn fewer_than_wanted(visit: &Visit, checks: &[PartnerCheck]) -> Option<Finding> {
    let (least, wanted) = (least(visit), visit.settings.partners.k as usize);
    let few: Vec<&PartnerCheck> = checks.iter().filter(|check| (least..wanted).contains(&check.partners)).collect();
    (!few.is_empty()).then(|| {
        let what = format!("{} with fewer than the {wanted} partners that are wanted", counted(few.len(), "view"));
        let fewest = few.iter().map(|check| check.partners).min().unwrap_or(least);
        let cure =
            format!("nothing, they get those that there are; partners.k = {fewest} in viewrank.toml asks for no more");
        Finding::new(Severity::Note, "fewer-partners-than-k", what, cure).of_views(words(visit, few))
    })
}

fn words(visit: &Visit, checks: Vec<&PartnerCheck>) -> Vec<ViewFinding> {
    checks.into_iter().map(|check| visit.of(check.view, check.words())).collect()
}

/// Groups of views that share points but no baseline; as in rigs and panoramas that is as it should be where each has partners elsewhere.
fn one_position(visit: &Visit, checks: &[PartnerCheck]) -> Option<Finding> {
    let beside = |view: u32| checks[view as usize].still.iter().map(|other| other.0);
    let groups = components(checks.len(), beside).into_iter().filter(|group| group.len() > 1);
    let groups: Vec<Vec<ViewIndex>> = groups.map(|group| group.into_iter().map(ViewIndex).collect()).collect();
    let standing: usize = groups.iter().map(|views| views.len()).sum();
    let with = |views: &[ViewIndex]| format!("with {}", visit.scene.name(views[0]));
    let views = groups.iter().flat_map(|views| views[1..].iter().map(|&v| visit.of(v, with(views)))).collect();
    let alone =
        groups.iter().flat_map(|views| views.iter()).filter(|v| checks[v.index()].partners < least(visit)).count();
    let (severity, cure) = match alone {
        0 => (Severity::Note, "nothing: they are no partners of each other, and each has others"),
        n if n as f64 >= MOST * checks.len() as f64 => (Severity::Error, "photograph from different places"),
        _ => (
            Severity::Warning,
            "photograph from different places: they are no partners of each other, and some have no others",
        ),
    };
    (!groups.is_empty()).then(|| {
        let (standing, positions) = (counted(standing, "view"), counted(groups.len(), "position"));
        let what = format!("{standing} at {positions}: between views at one position there is no depth");
        Finding::new(severity, "one-position", what, cure).of_views(views)
    })
}
