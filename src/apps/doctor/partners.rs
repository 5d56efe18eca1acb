//! Views with too few matching partners, and why; groups of views at one position.

use std::collections::BTreeMap;

use rayon::prelude::*;

use super::{FEW, Finding, Inputs, MOST, Severity, ViewFinding, counted};
use crate::{
    base::connected::components,
    method::partners::{PairGeometry, PairLimit, neighbours},
    model::{
        cluster::Gate,
        reason::Reason,
        scene::{PointIndex, Scene, ViewIndex, ViewPoints},
    },
};

/// Share of the sparse points seen only by views without partners, at and above which the loss
/// exceeds the usual border of a block.
const LOST: f64 = 0.01;

/// Reason that a pair cannot be matched.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Refusal {
    NoBaseline,
    NoImage,
    Limit(PairLimit),
}

impl Refusal {
    fn describe(self) -> &'static str {
        match self {
            Self::NoBaseline => "no baseline",
            Self::NoImage => "without a usable image",
            Self::Limit(PairLimit::FewSharedPoints) => "too few shared points",
            Self::Limit(PairLimit::SmallAngle) => "angle too small",
            Self::Limit(PairLimit::LargeAngle) => "angle too large",
            Self::Limit(PairLimit::Scale) => "scale too different",
            Self::Limit(PairLimit::Epipole) => "motion along the line of sight",
        }
    }
}

/// Partners of a view, and the reasons for which its other pairs were refused.
struct PartnerCount {
    view: ViewIndex,
    partners: usize,
    refused: BTreeMap<Refusal, usize>,
    /// Views at the same position.
    same_position: Vec<ViewIndex>,
}

pub fn findings(inputs: &Inputs) -> Vec<Finding> {
    let views: Vec<ViewIndex> = inputs.scene.view_indices().collect();
    let gate = inputs
        .backend
        .planning
        .gate
        .with(&inputs.settings.partners.gate);
    let without_image = inputs.images.unusable(views.len());
    let count = |&view: &ViewIndex| {
        count_partners(inputs.scene, inputs.points, &without_image, &gate, view)
    };
    let counts: Vec<PartnerCount> = views.par_iter().map(count).collect();
    let with_image = |count: &&PartnerCount| without_image.binary_search(&count.view).is_err();
    let position = one_position(inputs, &counts, counts.iter().filter(with_image).count());
    // Missing and unreadable images are findings of their own.
    let counts: Vec<&PartnerCount> = counts.iter().filter(with_image).collect();
    let few = [too_few(inputs, &counts), fewer_than_wanted(inputs, &counts)];
    few.into_iter().flatten().chain(position).collect()
}

/// Returns the minimum number of partners with which a key view can fulfil anything.
fn least(inputs: &Inputs) -> usize {
    let settings = &inputs.settings;
    settings
        .coverage
        .min_cameras
        .saturating_sub(1)
        // At most k: if that is too few for min_cameras, the plan itself says so.
        .clamp(1, settings.partners.k.max(1)) as usize
}

/// Describes how many of the views that share points with this one the backend can match, and why
/// it refuses the others. `without_image`: views without a usable image, ascending.
pub fn partners_in_words(
    scene: &Scene,
    points: &ViewPoints,
    without_image: &[ViewIndex],
    gate: &Gate,
    view: ViewIndex,
) -> String {
    count_partners(scene, points, without_image, gate, view).describe()
}

fn count_partners(
    scene: &Scene,
    points: &ViewPoints,
    without_image: &[ViewIndex],
    gate: &Gate,
    view: ViewIndex,
) -> PartnerCount {
    let has_image = |view: &ViewIndex| without_image.binary_search(view).is_err();
    let mut count = PartnerCount {
        view,
        partners: 0,
        refused: BTreeMap::new(),
        same_position: Vec::new(),
    };
    for (other, shared) in neighbours(scene, points, view) {
        let pair = PairGeometry::new(scene, view, other, &shared);
        let is_shown = has_image(&view) && has_image(&other);
        // Before the gate, whose least angle would refuse the pair for a lesser reason.
        let refusal = if pair.has_no_baseline() {
            count.same_position.extend(is_shown.then_some(other));
            Some(Refusal::NoBaseline)
        } else {
            gate.broken_limit(&pair)
                .map(Refusal::Limit)
                .or((!is_shown).then_some(Refusal::NoImage))
        };
        match refusal {
            Some(refusal) => *count.refused.entry(refusal).or_default() += 1,
            None => count.partners += 1,
        }
    }
    count
}

impl PartnerCount {
    fn describe(&self) -> String {
        if self.partners == 0 && self.refused.is_empty() {
            return Reason::NoSharedPoints.describe().into();
        }
        let mut refused: Vec<(&Refusal, &usize)> = self.refused.iter().collect();
        refused.sort_by_key(|(reason, count)| (std::cmp::Reverse(**count), **reason));
        let refused: Vec<String> = refused
            .iter()
            .map(|(reason, count)| format!("{count} {}", reason.describe()))
            .collect();
        if refused.is_empty() {
            format!(
                "{}, no other view shares points with it",
                counted(self.partners, "partner")
            )
        } else {
            format!(
                "{}; refused: {}",
                counted(self.partners, "partner"),
                refused.join(", ")
            )
        }
    }
}

/// Reports views that can be key views only with partners beyond the gate, if at all; the severity
/// depends on their share, and on the share of points that no other view sees.
fn too_few(inputs: &Inputs, counts: &[&PartnerCount]) -> Option<Finding> {
    let least = least(inputs);
    let few: Vec<&PartnerCount> = counts
        .iter()
        .copied()
        .filter(|count| count.partners < least)
        .collect();
    let lost = lost_share(inputs, counts);
    let share = few.len() as f64 / counts.len().max(1) as f64;
    let severity = if share.max(lost) >= MOST {
        Severity::Error
    } else if lost >= LOST || share >= FEW {
        Severity::Warning
    } else {
        Severity::Note
    };
    let loss = if lost > 0.0 {
        format!(
            "{:.1} % of the sparse points are seen by no other {}",
            100.0 * lost,
            noun(inputs, counts, 1)
        )
    } else {
        "other views see all their points".into()
    };
    let cure = match severity {
        Severity::Note => "no action needed; other views cover for them",
        _ if lack_images(&few) => IMAGES_FIRST,
        _ => {
            "match these images with more others in structure from motion; without a baseline, take photographs from other positions"
        }
    };
    (!few.is_empty()).then(|| {
        let what = format!(
            "{} of {} {} have fewer than {least} partners within the limits of {} (partners.gate); {loss}",
            few.len(),
            counts.len(),
            noun(inputs, counts, counts.len()),
            inputs.backend.name
        );
        Finding::new(severity, "too-few-partners", what, cure).of_views(describe(inputs, few))
    })
}

/// Returns the share of the sparse points seen by these views that only those with too few partners
/// see.
fn lost_share(inputs: &Inputs, counts: &[&PartnerCount]) -> f64 {
    let (least, mut can_be_key) = (least(inputs), vec![None; inputs.scene.views.len()]);
    counts
        .iter()
        .for_each(|count| can_be_key[count.view.index()] = Some(count.partners >= least));
    let tracks =
        (0..inputs.scene.points.len() as u32).map(|p| inputs.scene.track_views(PointIndex(p)));
    // The surface leaves out points that a single view observes (method 1.1).
    let sound = tracks.filter(|views| views.len() > 1);
    let is_kept: Vec<bool> = sound
        .filter_map(|views| views.iter().filter_map(|v| can_be_key[v.index()]).max())
        .collect();
    is_kept.iter().filter(|kept| !**kept).count() as f64 / is_kept.len().max(1) as f64
}

/// Cure where images are what partners lack.
const IMAGES_FIRST: &str = "replace the images that are missing or cannot be used";

fn lack_images(few: &[&PartnerCount]) -> bool {
    few.iter()
        .any(|count| count.refused.contains_key(&Refusal::NoImage))
}

/// Returns the noun for this number of the views that were judged.
fn noun(inputs: &Inputs, counts: &[&PartnerCount], number: usize) -> String {
    let image = if counts.len() < inputs.scene.views.len() {
        " with a usable image"
    } else {
        ""
    };
    format!("view{}{image}", if number == 1 { "" } else { "s" })
}

/// Reports key views with fewer than k partners.
fn fewer_than_wanted(inputs: &Inputs, counts: &[&PartnerCount]) -> Option<Finding> {
    let (least, wanted) = (least(inputs), inputs.settings.partners.k as usize);
    let is_few = |count: &&PartnerCount| (least..wanted).contains(&count.partners);
    let few: Vec<&PartnerCount> = counts.iter().copied().filter(is_few).collect();
    (!few.is_empty()).then(|| {
        let what = format!(
            "{} with fewer than {wanted} partners (partners.k)",
            counted(few.len(), "view")
        );
        let cure = if lack_images(&few) {
            IMAGES_FIRST
        } else {
            "no action needed; they are planned with the partners they have"
        };
        Finding::new(Severity::Note, "fewer-partners-than-k", what, cure)
            .of_views(describe(inputs, few))
    })
}

fn describe(inputs: &Inputs, counts: Vec<&PartnerCount>) -> Vec<ViewFinding> {
    counts
        .into_iter()
        .map(|count| inputs.view_finding(count.view, count.describe()))
        .collect()
}

/// Reports groups of views that share points but no baseline; normal in rigs and panoramas where
/// each view has partners elsewhere.
///
/// `judged`: number of views with a usable image.
fn one_position(inputs: &Inputs, counts: &[PartnerCount], judged: usize) -> Option<Finding> {
    let same_position = |view: u32| {
        counts[view as usize]
            .same_position
            .iter()
            .map(|other| other.0)
    };
    let groups = components(counts.len(), same_position)
        .into_iter()
        .filter(|group| group.len() > 1);
    let groups: Vec<Vec<ViewIndex>> = groups
        .map(|group| group.into_iter().map(ViewIndex).collect())
        .collect();
    let grouped: usize = groups.iter().map(|views| views.len()).sum();
    let with = |views: &[ViewIndex]| format!("with {}", inputs.scene.name(views[0]));
    let views = groups
        .iter()
        .flat_map(|views| {
            views[1..]
                .iter()
                .map(|&v| inputs.view_finding(v, with(views)))
        })
        .collect();
    let alone = groups
        .iter()
        .flat_map(|views| views.iter())
        .filter(|v| counts[v.index()].partners < least(inputs))
        .count();
    let (severity, cure) = match alone {
        0 => (
            Severity::Note,
            "no action needed; each has partners elsewhere",
        ),
        n if n as f64 >= MOST * judged as f64 => {
            (Severity::Error, "take photographs from different positions")
        }
        _ => (
            Severity::Warning,
            "take photographs from different positions; some of these views have no other partners",
        ),
    };
    (!groups.is_empty()).then(|| {
        let (grouped, positions) = (counted(grouped, "view"), counted(groups.len(), "position"));
        let what =
            format!("{grouped} at {positions}: views at one position give each other no depth");
        Finding::new(severity, "one-position", what, cure).of_views(views)
    })
}
