//! Chooses among the candidate poses: next comes the view cluster that fills the most per image
//! still to be taken.

use rayon::prelude::*;

use super::{
    super::holes::Hole,
    Flight, Waypoint,
    candidates::{Candidate, STEP_DEG},
};
use crate::{
    base::{column::Storage, progress::Watcher},
    method::{
        confidence::{Agreement, Unary},
        fulfilment::{self, Model},
        ranking::{Objective, Reached},
        visibility::{self, Visibility, VisibilityError},
    },
    model::{
        cluster::ViewCluster,
        georeference::MapFrame,
        scene::{Scene, View, ViewIndex},
    },
    plan::Plan,
};

/// The choice ends when a further image fills less than this share of what can be filled.
const LEAST: f64 = 0.01;
/// The choice ends once this share of what can be filled has been filled: further images fill
/// little each (docs/benchmarks.md, "A second flight").
const ENOUGH: f64 = 0.8;
/// Largest number of partners of a candidate among the other candidates.
const NEAREST: usize = 4;
/// Largest number of partners of a candidate among the existing images.
const TAKEN: usize = 3;

/// The existing views with an image that see a hole, then the candidates, as a scene without
/// points.
struct Extended {
    scene: Scene,
    /// Number of existing views in it.
    taken: usize,
    visibility: Visibility,
}

impl Extended {
    fn new(
        plan: &Plan,
        holes: &[Hole],
        candidates: &[Candidate],
        watcher: &dyn Watcher,
    ) -> Result<Self, VisibilityError> {
        let stages = &plan.stages;
        let has_image = |v: &ViewIndex| stages.without_image.binary_search(v).is_err();
        // Only the deepest triangle stands for a hole: each view here costs a visibility of its
        // own.
        let sees = |v: &ViewIndex| {
            holes
                .iter()
                .any(|hole| stages.visibility.row(*v, hole.deepest).is_some())
        };
        let taken = stages
            .scene
            .view_indices()
            .filter(has_image)
            .filter(sees)
            .map(|v| stages.scene.view(v).clone());
        let mut views: Vec<View> = taken.collect();
        let taken = views.len();
        views.extend(candidates.iter().enumerate().map(|(i, candidate)| View {
            name: format!("candidate {i}"),
            image_id: 0,
            file_position: 0,
            camera: candidate.camera,
            cam_from_world: candidate.pose,
        }));
        let scene = Scene {
            cameras: stages.scene.cameras.clone(),
            views,
            track_offsets: vec![0],
            ..Scene::default()
        };
        let gsd = stages.settings.target.gsd.unwrap_or(1.0);
        let visibility = visibility::estimate(
            &scene,
            &scene.view_points(),
            &stages.surface,
            &stages.settings.visibility,
            stages.settings.surface.edge_factor * gsd,
            Storage::Memory,
            watcher,
        )?;
        Ok(Self {
            scene,
            taken,
            visibility,
        })
    }

    fn is_candidate(&self, view: ViewIndex) -> bool {
        view.index() >= self.taken
    }

    /// Returns the views among `among` whose rays to the target of a candidate, the view `key`, are
    /// about a step from its own, the best first.
    fn partners(
        &self,
        key: usize,
        candidate: &Candidate,
        among: std::ops::Range<usize>,
        most: usize,
    ) -> Vec<ViewIndex> {
        let own = candidate.centre - candidate.target;
        let ray = |view: usize| self.scene.views[view].cam_from_world.centre() - candidate.target;
        let angle = |view: usize| ray(view).angle(&own).to_degrees();
        let fits = |&view: &usize| {
            view != key
                && (4.0..=3.0 * STEP_DEG).contains(&angle(view))
                && (0.6..1.7).contains(&(ray(view).norm() / own.norm()))
        };
        let mut views: Vec<usize> = among.filter(fits).collect();
        let off = |view: &usize| (angle(*view) - STEP_DEG).abs();
        views.sort_by(|a, b| off(a).total_cmp(&off(b)).then(a.cmp(b)));
        let best = views.into_iter().take(most);
        best.map(|view| ViewIndex(view as u32)).collect()
    }
}

pub fn choose(
    plan: &Plan,
    holes: &[Hole],
    candidates: &[Candidate],
    frame: &MapFrame,
    watcher: &dyn Watcher,
) -> Result<Flight, VisibilityError> {
    let stages = &plan.stages;
    let extended = Extended::new(plan, holes, candidates, watcher)?;
    let mut raw = vec![0.0; stages.surface.triangles.len()];
    let members = holes.iter().flat_map(|hole| &hole.members);
    members.for_each(|&t| raw[t as usize] = stages.objective.weights[t as usize]);
    let objective = Objective::weighing(raw, stages.objective.support);
    let (unary, agreement) = (Unary::certain(), Agreement::default());
    let model = Model {
        scene: &extended.scene,
        visibility: &extended.visibility,
        unary: &unary,
        agreement: &agreement,
        ..stages.model()
    };
    let clusters = clusters(&extended, candidates, stages.settings.partners.k as usize);
    let table = fulfilment::table(&model, &clusters, watcher)?;
    let mut reached = Reached::new(&objective);
    // Of all clusters, also beyond the cut: what a longer cut gives needs no new image.
    (0..stages.clusters.len()).for_each(|c| reached.take(stages.fulfilment.row(c)));
    let flown = greedy(&extended, &clusters, &table, reached.clone());
    flown.taken.iter().for_each(|&c| reached.take(table.row(c)));
    let waypoint = |(order, &i): (usize, &usize)| Waypoint {
        rank: order + 1,
        centre: candidates[i].centre,
        direction: candidates[i].direction,
        hole: candidates[i].hole,
        height: (candidates[i].centre - candidates[i].target).dot(&frame.axes[2]),
        distance: (candidates[i].centre - candidates[i].target).norm(),
        overlap: overlap(plan, &extended, extended.taken + i, &flown.used),
    };
    let of_hole = |hole: &Hole| share_filled(hole, &objective, &reached);
    Ok(Flight {
        of_holes: holes.iter().map(of_hole).collect(),
        waypoints: flown.images.par_iter().enumerate().map(waypoint).collect(),
        more: 0,
        spacing: None,
    })
}

/// Returns the share of a hole that fusion keeps, by weight.
fn share_filled(hole: &Hole, objective: &Objective, reached: &Reached) -> f64 {
    let weight = |t: u32| objective.weights[t as usize];
    let all: f64 = hole.members.iter().map(|&t| weight(t)).sum();
    let kept = |&t: &u32| weight(t) * f64::from(reached.agreed(t));
    let kept: f64 = hole.members.iter().map(kept).sum();
    if all > 0.0 { kept / all } else { 0.0 }
}

/// Returns the clusters of each candidate with other candidates, with existing images, and with
/// both; and of existing images with candidates.
fn clusters(extended: &Extended, candidates: &[Candidate], k: usize) -> Vec<ViewCluster> {
    let most = k.max(2);
    let of_candidate = |i: usize| {
        let (key, own) = (extended.taken + i, &candidates[i]);
        let all = extended.scene.views.len();
        let new = extended.partners(key, own, extended.taken..all, NEAREST.min(most));
        let taken = extended.partners(key, own, 0..extended.taken, TAKEN.min(most));
        let key = ViewIndex(key as u32);
        let mixed: Vec<ViewIndex> = taken.iter().chain(&new).copied().take(most).collect();
        // Fewer new images may give more for each.
        let few: Vec<ViewIndex> = new.iter().copied().take(2).collect();
        let mut found: Vec<ViewCluster> = [new.clone(), taken.clone(), mixed, few]
            .map(|partners| ViewCluster { key, partners })
            .to_vec();
        // The new images may give an existing one a depth map.
        found.extend(taken.iter().map(|&old| {
            let with_key = std::iter::once(key).chain(new.iter().copied());
            let partners = with_key.take(most).collect();
            ViewCluster { key: old, partners }
        }));
        found
    };
    let all: Vec<Vec<ViewCluster>> = (0..candidates.len())
        .into_par_iter()
        .map(of_candidate)
        .collect();
    all.into_iter()
        .flatten()
        .filter(|cluster| cluster.partners.len() >= 2)
        .collect()
}

struct Flown {
    /// Clusters in the order of choice.
    taken: Vec<usize>,
    /// Candidates in the order of choice.
    images: Vec<usize>,
    /// By view of the extended scene: true if it takes part.
    used: Vec<bool>,
}

/// Takes the cluster with the largest gain per new image until little is left to gain; clusters
/// that need no new image cost almost nothing.
fn greedy(
    extended: &Extended,
    clusters: &[ViewCluster],
    table: &fulfilment::FulfilmentTable,
    mut reached: Reached,
) -> Flown {
    let mut whole = reached.clone();
    (0..clusters.len()).for_each(|c| whole.take(table.row(c)));
    let (start, possible) = (reached.fulfilment(), whole.fulfilment());
    let mut flown = Flown {
        taken: Vec::new(),
        images: Vec::new(),
        used: vec![false; extended.scene.views.len()],
    };
    while reached.fulfilment() - start < ENOUGH * (possible - start) {
        let cost = |cluster: &ViewCluster| {
            cluster
                .views()
                .filter(|v| extended.is_candidate(*v) && !flown.used[v.index()])
                .count()
        };
        let value = |(c, cluster): (usize, &ViewCluster)| {
            let (gain, images) = (reached.gain(table.row(c)), cost(cluster));
            // Not by 0: without new images, too, the larger gain comes first.
            (gain / (images as f64).max(0.01), gain, images, c)
        };
        let best = clusters
            .par_iter()
            .enumerate()
            .map(value)
            // Ties go to the first cluster: `max_by` alone returns the last of equals.
            .max_by(|a, b| a.0.total_cmp(&b.0).then(b.3.cmp(&a.3)));
        let Some((_, gain, images, cluster)) = best else {
            break;
        };
        if gain < LEAST * (possible - start) * (images as f64).max(0.01) {
            break;
        }
        reached.take(table.row(cluster));
        flown.taken.push(cluster);
        for view in clusters[cluster].views() {
            if extended.is_candidate(view) && !flown.used[view.index()] {
                flown.images.push(view.index() - extended.taken);
            }
            flown.used[view.index()] = true;
        }
    }
    flown
}

/// Returns the largest share of the area seen by the view that a single other view, planned or
/// existing, sees too.
fn overlap(plan: &Plan, extended: &Extended, view: usize, used: &[bool]) -> f64 {
    let area = |triangles: &mut dyn Iterator<Item = u32>| {
        triangles.map(|t| plan.stages.surface.area(t)).sum::<f64>()
    };
    let own = extended
        .visibility
        .triangles_seen_by(ViewIndex(view as u32));
    let all = area(&mut own.iter().copied());
    let with = |other: usize| {
        let other = extended
            .visibility
            .triangles_seen_by(ViewIndex(other as u32));
        area(
            &mut own
                .iter()
                .copied()
                .filter(|t| other.binary_search(t).is_ok()),
        )
    };
    let others = (0..used.len()).filter(|&v| v != view && (v < extended.taken || used[v]));
    if all > 0.0 {
        others.map(with).fold(0.0, f64::max) / all
    } else {
        0.0
    }
}
