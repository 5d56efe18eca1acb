//! Which views can't get enough matching partners, and why; views that stand at one position.

use std::collections::BTreeMap;

use rayon::prelude::*;

use super::{Finding, Severity, Visit};
use crate::{
    backends::Obstacle,
    partners::{PairGeometry, neighbours},
    plan::Reason,
    scene::ViewIndex,
};

/// More than half of the shared points without a triangulation angle: the two views stand at one position (method 4).
const STILL: f64 = 0.5;
/// Share of the views without partners from which on it is more than the usual few.
const FEW: f64 = 0.05;
const MOST: f64 = 0.5;

/// Why a pair cannot be matched.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Refused {
    NoBaseline,
    Limit(Obstacle),
    OwnRule,
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
            Self::OwnRule => "the backend's own rule",
        }
    }
}

/// What the other views are to one.
struct Looked {
    view: ViewIndex,
    partners: usize,
    refused: BTreeMap<Refused, usize>,
    /// Views at the same position.
    still: Vec<ViewIndex>,
}

pub fn findings(visit: &Visit) -> Vec<Finding> {
    let views: Vec<ViewIndex> = visit.scene.view_indices().collect();
    let looked: Vec<Looked> = views.par_iter().map(|&view| look(visit, view)).collect();
    too_few(visit, &looked).into_iter().chain(one_position(visit, &looked)).collect()
}

fn look(visit: &Visit, view: ViewIndex) -> Looked {
    let around = neighbours(visit.scene, visit.points, view);
    let pairs: Vec<PairGeometry> =
        around.iter().map(|(other, shared)| PairGeometry::new(visit.scene, view, *other, shared)).collect();
    let (still, moving): (Vec<_>, Vec<_>) = pairs.into_iter().partition(|pair| pair.still_share > STILL);
    let verdicts = visit.backend.refusals(&moving);
    let mut looked = Looked {
        view,
        partners: verdicts.iter().filter(|verdict| verdict.is_none()).count(),
        refused: BTreeMap::new(),
        still: still.iter().map(|pair| pair.partner).collect(),
    };
    let gate = visit.backend.planning().gate;
    let refused = moving.iter().zip(&verdicts).filter(|(_, verdict)| verdict.is_some());
    let reasons = refused.map(|(pair, _)| gate.obstacle(pair).map_or(Refused::OwnRule, Refused::Limit));
    for reason in reasons.chain(still.iter().map(|_| Refused::NoBaseline)) {
        *looked.refused.entry(reason).or_default() += 1;
    }
    looked
}

impl Looked {
    fn words(&self) -> String {
        if self.partners == 0 && self.refused.is_empty() {
            return Reason::NoSharedPoints.words().into();
        }
        let mut refused: Vec<(&Refused, &usize)> = self.refused.iter().collect();
        refused.sort_by_key(|(reason, count)| (std::cmp::Reverse(**count), **reason));
        let refused: Vec<String> =
            refused.iter().map(|(reason, count)| format!("{count} {}", reason.words())).collect();
        match refused.is_empty() {
            true => format!("{} partners, no other view shares points with it", self.partners),
            false => format!("{} partners; refused: {}", self.partners, refused.join(", ")),
        }
    }
}

/// Two findings: views that can be no key view at all, and key views with fewer than k partners.
fn too_few(visit: &Visit, looked: &[Looked]) -> Vec<Finding> {
    let least = visit.settings.coverage.min_cameras.saturating_sub(1).max(1) as usize;
    let wanted = visit.settings.partners.k as usize;
    let of = |few: &dyn Fn(usize) -> bool| -> Vec<(String, String)> {
        looked.iter().filter(|l| few(l.partners)).map(|l| (visit.name(l.view), l.words())).collect()
    };
    let none = of(&|partners| partners < least);
    let few = of(&|partners| (least..wanted).contains(&partners));
    let share = none.len() as f64 / looked.len().max(1) as f64;
    let severity = if share >= MOST {
        Severity::Error
    } else if share >= FEW {
        Severity::Warning
    } else {
        Severity::Note
    };
    let backend = visit.backend.name();
    let mut findings = Vec::new();
    if !none.is_empty() {
        let what = format!(
            "{} of {} views have fewer than {least} partners that {backend} can match, so that nothing is fulfilled with them as key views",
            none.len(),
            looked.len()
        );
        let cure = "match these images with more others in structure from motion; where there is no baseline, photograph from other places";
        findings.push(Finding::new(severity, "too-few-partners", what, cure).of_views(none));
    }
    if !few.is_empty() {
        let what = format!("{} views have fewer than the {wanted} partners that are wanted", few.len());
        let cure = format!("they get those that there are; -k {least} asks for no more");
        findings.push(Finding::new(Severity::Note, "fewer-partners-than-k", what, cure).of_views(few));
    }
    findings
}

/// Groups of views that share points but no baseline.
fn one_position(visit: &Visit, looked: &[Looked]) -> Option<Finding> {
    let mut group: Vec<u32> = (0..looked.len() as u32).collect();
    fn root(group: &mut [u32], mut of: u32) -> u32 {
        while group[of as usize] != of {
            group[of as usize] = group[group[of as usize] as usize];
            of = group[of as usize];
        }
        of
    }
    for (view, other) in looked.iter().flat_map(|l| l.still.iter().map(|s| (l.view.0, s.0))) {
        let (a, b) = (root(&mut group, view), root(&mut group, other));
        group[a.max(b) as usize] = a.min(b);
    }
    let mut members: BTreeMap<u32, Vec<ViewIndex>> = BTreeMap::new();
    for looked in looked {
        let of = root(&mut group, looked.view.0);
        members.entry(of).or_default().push(looked.view);
    }
    let groups: Vec<&Vec<ViewIndex>> = members.values().filter(|views| views.len() > 1).collect();
    let standing: usize = groups.iter().map(|views| views.len()).sum();
    let with = |views: &[ViewIndex]| format!("with {}", visit.scene.name(views[0]));
    let views: Vec<(String, String)> =
        groups.iter().flat_map(|views| views[1..].iter().map(|&v| (visit.name(v), with(views)))).collect();
    let many = standing as f64 >= MOST * looked.len() as f64;
    let severity = if many { Severity::Error } else { Severity::Warning };
    (!groups.is_empty()).then(|| {
        let what =
            format!("{standing} views stand at {} positions: between such views there is no depth", groups.len());
        let cure = "nothing to type: they are no partners of each other; photograph from different places";
        Finding::new(severity, "one-position", what, cure).of_views(views)
    })
}
