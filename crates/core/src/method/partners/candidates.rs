//! The candidates of each key view, and why other views that share points with it are rejected.

use std::{
    cmp::Reverse,
    collections::BTreeMap,
    iter,
    ops::Range,
    sync::{Mutex, OnceLock},
};

use rayon::ScopeFifo;

use super::pair::PairGeometry;
use crate::{
    base::{
        progress::{Cancelled, Watcher},
        rows::Offsets,
    },
    method::partners::PartnerSettings,
    model::{
        cluster::Gate,
        reason::Reason,
        scene::{PointIndex, Scene, ViewIndex, ViewPoints},
    },
};

/// Number of views that share points with one but were refused before it had enough candidates, by
/// the reason.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Refusals {
    pub rotation_only: u32,
    pub not_matchable: u32,
}

impl Refusals {
    fn add(&mut self, reason: Reason) {
        match reason {
            Reason::RotationOnly => self.rotation_only += 1,
            _ => self.not_matchable += 1,
        }
    }

    /// Returns the reason of each refusal.
    pub fn reasons(self) -> impl Iterator<Item = Reason> {
        let all = |reason, number| iter::repeat_n(reason, number as usize);
        all(Reason::RotationOnly, self.rotation_only)
            .chain(all(Reason::NotMatchable, self.not_matchable))
    }
}

/// The candidates of every view, best first, CSR by view; only pairs that the backend can match.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Candidates {
    pub offsets: Offsets,
    pub views: Vec<ViewIndex>,
    /// By view: number of its last candidates that are beyond the backend's gate, taken because
    /// there are not enough others.
    pub beyond: Vec<usize>,
    /// By view. Not which pairs: where nothing can be matched, these are many times as many as the
    /// candidates.
    pub refusals: Vec<Refusals>,
}

impl Candidates {
    pub fn candidates_of(&self, view: ViewIndex) -> &[ViewIndex] {
        &self.views[self.offsets.row(view.index())]
    }

    /// Returns the candidates that are beyond the backend's gate.
    pub fn beyond_gate(&self, view: ViewIndex) -> &[ViewIndex] {
        let candidates = self.candidates_of(view);
        &candidates[candidates.len() - self.beyond[view.index()]..]
    }
}

/// The pairs that a backend can match.
pub struct Limits<'a> {
    /// Limits beyond which matching usually fails (method 7.1).
    pub gate: &'a Gate,
    /// Returns, for a key view, which pairs cannot be matched at all: the program refuses them, or
    /// an image is missing.
    pub refusals_of: &'a (dyn Fn(ViewIndex) -> Refuses<'a> + Sync),
}

/// True for pairs of a key view that cannot be matched at all.
pub type Refuses<'a> = Box<dyn Fn(&PairGeometry) -> bool + 'a>;

impl<'a> Limits<'a> {
    /// Limits with this gate, for a program that refuses no pair.
    pub fn gate(gate: &'a Gate) -> Self {
        Self {
            gate,
            refusals_of: &|_| Box::new(|_| false),
        }
    }
}

/// The search for each view's n views with the most shared points that have a baseline and that the
/// backend can match, ties by name. If fewer than k remain, the best connected views beyond the
/// gate follow, unless the program refuses them.
pub struct CandidateSearch<'a, 'limits> {
    scene: &'a Scene,
    points: &'a ViewPoints,
    settings: &'a PartnerSettings,
    limits: &'a Limits<'limits>,
    watcher: &'a dyn Watcher,
    /// By view, unset until its job is done.
    rows: Vec<OnceLock<CandidateRow>>,
    /// Buffers of finished jobs, to be reused: each is as long as the scene has views.
    resting: Mutex<Vec<Neighbours>>,
}

impl<'a, 'limits> CandidateSearch<'a, 'limits> {
    pub fn new(
        scene: &'a Scene,
        points: &'a ViewPoints,
        settings: &'a PartnerSettings,
        limits: &'a Limits<'limits>,
        watcher: &'a dyn Watcher,
    ) -> Self {
        let rows = scene.views.iter().map(|_| OnceLock::new()).collect();
        Self {
            scene,
            points,
            settings,
            limits,
            watcher,
            rows,
            resting: Mutex::default(),
        }
    }

    /// Starts a job for each view: short ones, so that a thread soon helps again with what others
    /// share.
    pub fn start<'jobs>(&'jobs self, jobs: &ScopeFifo<'jobs>) {
        self.scene
            .view_indices()
            // First in, first out: they wait until nothing of the surface is left to share, which
            // saves 10 % of the time of a plan (1,200 views, two threads).
            .for_each(|key| jobs.spawn_fifo(move |_| self.find(key)));
    }

    fn find(&self, key: ViewIndex) {
        // The row stays unset, which `finish` reports.
        if self.watcher.cancelled() {
            return;
        }
        let rested = self
            .resting
            .lock()
            .ok()
            .and_then(|mut resting| resting.pop());
        let mut neighbours = rested.unwrap_or_else(|| Neighbours::new(self.scene));
        neighbours.collect(self.scene, self.points, key);
        let row = select(self.scene, &neighbours, key, self.settings, self.limits);
        self.rows[key.index()].set(row).ok();
        self.resting
            .lock()
            .map(|mut resting| resting.push(neighbours))
            .ok();
    }

    /// Returns the candidates, when all jobs are done.
    pub fn finish(self) -> Result<Candidates, Cancelled> {
        let mut table = Candidates::default();
        for row in self.rows {
            let row = row.into_inner().ok_or(Cancelled)?;
            table.offsets.push(row.views.len());
            table.views.extend(row.views);
            table.beyond.push(row.beyond);
            table.refusals.push(row.refusals);
        }
        Ok(table)
    }
}

/// Finds the candidates of each view.
pub fn candidates(
    scene: &Scene,
    points: &ViewPoints,
    settings: &PartnerSettings,
    limits: &Limits,
    watcher: &dyn Watcher,
) -> Result<Candidates, Cancelled> {
    let search = CandidateSearch::new(scene, points, settings, limits, watcher);
    rayon::scope_fifo(|jobs| search.start(jobs));
    search.finish()
}

/// Returns the views that share points with one, with those points; most shared points first, ties
/// by name.
pub fn neighbours(
    scene: &Scene,
    points: &ViewPoints,
    view: ViewIndex,
) -> Vec<(ViewIndex, Vec<PointIndex>)> {
    // Without an array of all views: a caller may ask for the neighbours of each.
    let mut shared: BTreeMap<ViewIndex, Vec<PointIndex>> = BTreeMap::new();
    for_each_shared(scene, points, view, |point, other| {
        shared.entry(other).or_default().push(point);
    });
    let mut neighbours: Vec<_> = shared.into_iter().collect();
    // Stable, so that ties stay in the order of the map's keys, which is that of names.
    neighbours.sort_by_key(|(_, points)| Reverse(points.len()));
    neighbours
}

/// Observations of a track among which pairs are looked for. Only a camera that stands still sees a
/// point in more images, and they would take the square of their number.
const LONGEST_TRACK: usize = 512;

/// Returns the views of a track that may be partners of one of them: those next to it by name, if
/// there are many.
fn beside(track: &[ViewIndex], view: ViewIndex) -> &[ViewIndex] {
    let Some(last_start) = track.len().checked_sub(LONGEST_TRACK) else {
        return track;
    };
    let at = track.partition_point(|other| *other < view);
    let start = at.saturating_sub(LONGEST_TRACK / 2).min(last_start);
    &track[start..start + LONGEST_TRACK]
}

/// Calls `act` with each point that a view shares, and each view with which it does.
fn for_each_shared(
    scene: &Scene,
    points: &ViewPoints,
    key: ViewIndex,
    mut act: impl FnMut(PointIndex, ViewIndex),
) {
    for &point in points.observed_by(key) {
        // A view that observes the point twice occurs twice in a row.
        let mut last = key;
        for &view in beside(scene.track_views(point), key) {
            if view != key && view != last {
                act(point, view);
            }
            last = view;
        }
    }
}

/// The candidates of one view.
#[derive(Debug, Default)]
struct CandidateRow {
    views: Vec<ViewIndex>,
    /// Number of views at the end that are beyond the gate.
    beyond: usize,
    refusals: Refusals,
}

/// Returns why a pair is refused whatever the program's own rule.
fn refusal(pair: &PairGeometry, limits: &Limits) -> Option<Reason> {
    if pair.has_no_baseline() {
        Some(Reason::RotationOnly)
    } else {
        limits.gate.refusal(pair)
    }
}

impl CandidateRow {
    /// Adds partners with which matching usually fails, up to k in all: such a partner is better
    /// than none.
    fn fill_beyond_gate<'p>(&mut self, pairs: impl Iterator<Item = &'p PairGeometry<'p>>, k: u32) {
        let within = self.views.len();
        let lacking = (k as usize).saturating_sub(within);
        self.views
            .extend(pairs.take(lacking).map(|pair| pair.partner));
        self.beyond = self.views.len() - within;
        // They were counted as refused by the gate.
        self.refusals.not_matchable -= self.beyond as u32;
    }
}

fn select(
    scene: &Scene,
    neighbours: &Neighbours,
    key: ViewIndex,
    settings: &PartnerSettings,
    limits: &Limits,
) -> CandidateRow {
    let (mut selected, mut unlikely) = (CandidateRow::default(), Vec::new());
    let refuses = (limits.refusals_of)(key);
    for (partner, shared) in neighbours.pairs() {
        let pair = PairGeometry::new(scene, key, partner, shared);
        match refusal(&pair, limits) {
            Some(reason) => {
                selected.refusals.add(reason);
                // Without a baseline there is no depth to match, so that such a partner is no
                // better than none.
                unlikely.extend((reason == Reason::NotMatchable).then_some(pair));
            }
            None if selected.views.len() == settings.candidates as usize => break,
            None if refuses(&pair) => selected.refusals.add(Reason::NotMatchable),
            None => selected.views.push(partner),
        }
    }
    // Lazily: the program's rule looks at all points of a pair, and few partners are lacking, if
    // any.
    selected.fill_beyond_gate(unlikely.iter().filter(|pair| !refuses(pair)), settings.k);
    selected
}

/// The views that share points with a key view, with those points; one per running job, reused.
struct Neighbours {
    /// Pairs of a shared point and another view that observes it, by point.
    shared: Vec<(PointIndex, ViewIndex)>,
    /// Most shared points first, ties by name.
    views: Vec<ViewIndex>,
    /// Range in `points` of each of `views`.
    ranges: Vec<Range<usize>>,
    points: Vec<PointIndex>,
    /// By view: the number of shared points while counting, then the position of the next one.
    counts: Vec<usize>,
}

impl Neighbours {
    fn new(scene: &Scene) -> Self {
        let counts = vec![0; scene.views.len()];
        Self {
            shared: Vec::new(),
            views: Vec::new(),
            ranges: Vec::new(),
            points: Vec::new(),
            counts,
        }
    }

    fn pairs(&self) -> impl Iterator<Item = (ViewIndex, &[PointIndex])> {
        self.views
            .iter()
            .zip(&self.ranges)
            .map(|(&v, range)| (v, &self.points[range.clone()]))
    }

    fn collect(&mut self, scene: &Scene, points: &ViewPoints, key: ViewIndex) {
        self.count(scene, points, key);
        self.views
            .sort_unstable_by_key(|v| (Reverse(self.counts[v.index()]), *v));
        let mut end = 0;
        self.ranges.clear();
        for view in &self.views {
            let count = std::mem::replace(&mut self.counts[view.index()], end);
            self.ranges.push(end..end + count);
            end += count;
        }
        self.points.resize(end, PointIndex(0));
        for &(point, view) in &self.shared {
            self.points[self.counts[view.index()]] = point;
            self.counts[view.index()] += 1;
        }
        // Only those that were counted: the array is as long as the scene has views.
        self.views.iter().for_each(|v| self.counts[v.index()] = 0);
    }

    /// Collects the shared points, and the views in the order in which they occur.
    fn count(&mut self, scene: &Scene, points: &ViewPoints, key: ViewIndex) {
        self.shared.clear();
        self.views.clear();
        for_each_shared(scene, points, key, |point, view| {
            self.shared.push((point, view));
            self.counts[view.index()] += 1;
            if self.counts[view.index()] == 1 {
                self.views.push(view);
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;
    use crate::{base::progress::NoWatcher, method::synthetic::Town};

    fn scene() -> Scene {
        Town {
            points: 300,
            ..Town::default()
        }
        .scene()
    }

    fn select_all(scene: &Scene, n: u32, gate: &Gate) -> Candidates {
        let settings = PartnerSettings {
            candidates: n,
            ..Default::default()
        };
        candidates(
            scene,
            &scene.view_points(),
            &settings,
            &Limits::gate(gate),
            &NoWatcher,
        )
        .unwrap()
    }

    fn shared(scene: &Scene, a: ViewIndex, b: ViewIndex) -> usize {
        let points = scene.view_points();
        let other: HashSet<_> = points.observed_by(b).iter().collect();
        points
            .observed_by(a)
            .iter()
            .filter(|p| other.contains(p))
            .count()
    }

    #[test]
    fn candidates_are_the_most_connected_ties_by_name() {
        let scene = scene();
        let table = select_all(&scene, 22, &Gate::OPEN);
        for key in scene.view_indices().step_by(5) {
            let mut all: Vec<_> = scene
                .view_indices()
                .filter(|&v| v != key)
                .map(|v| (shared(&scene, key, v), v))
                .collect();
            all.retain(|s| s.0 > 0);
            all.sort_by_key(|s| (Reverse(s.0), s.1));
            let expected: Vec<_> = all.iter().take(22).map(|s| s.1).collect();
            assert_eq!(table.candidates_of(key), expected);
        }
    }

    #[test]
    fn refused_pairs_make_room_for_others_and_stand_in_where_there_are_none() {
        let scene = scene();
        let gate = Gate {
            max_angle_deg: 12.0,
            ..Gate::OPEN
        };
        let (all, table) = (
            select_all(&scene, 60, &Gate::OPEN),
            select_all(&scene, 5, &gate),
        );
        let points = scene.view_points();
        for key in scene.view_indices() {
            let around = neighbours(&scene, &points, key);
            let angle = |partner| {
                let (_, shared) = around.iter().find(|(view, _)| *view == partner).unwrap();
                PairGeometry::new(&scene, key, partner, shared).angle_deg
            };
            let (narrow, wide): (Vec<_>, Vec<_>) = all
                .candidates_of(key)
                .iter()
                .copied()
                .partition(|&v| angle(v) <= 12.0);
            let expected: Vec<ViewIndex> = narrow.iter().chain(&wide).copied().take(5).collect();
            assert_eq!(table.candidates_of(key), expected);
            assert_eq!(table.beyond_gate(key), &expected[narrow.len().min(5)..]);
            // Those before the last candidate within the gate, without those that stand in.
            let shared_most = all.candidates_of(key).iter();
            let refused = match narrow.get(5) {
                Some(next) => shared_most.take_while(|view| *view != next).count() - 5,
                None => wide.len() - table.beyond_gate(key).len(),
            };
            let reasons: Vec<Reason> = table.refusals[key.index()].reasons().collect();
            assert_eq!(reasons, vec![Reason::NotMatchable; refused]);
        }
        assert!(table.refusals.iter().any(|of| of.not_matchable > 0));
    }

    #[test]
    fn views_at_one_position_are_no_candidates() {
        let mut scene = scene();
        scene.views[1].cam_from_world = scene.views[0].cam_from_world;
        let table = select_all(&scene, 60, &Gate::OPEN);
        assert!(!table.candidates_of(ViewIndex(0)).contains(&ViewIndex(1)));
        assert_eq!(table.refusals[0].rotation_only, 1);
    }

    #[test]
    fn a_view_of_a_long_track_has_its_neighbours_by_name_for_partners() {
        let views = 5 * LONGEST_TRACK as u32;
        let track: Vec<ViewIndex> = (0..views).map(ViewIndex).collect();
        for view in [0, 1, 700, views - 1] {
            let near = beside(&track, ViewIndex(view));
            assert!(near.len() == LONGEST_TRACK && near.contains(&ViewIndex(view)));
            let farthest = near.iter().map(|other| other.0.abs_diff(view)).max();
            assert!(farthest <= Some(LONGEST_TRACK as u32));
        }
        assert_eq!(
            beside(&track[..LONGEST_TRACK], ViewIndex(9)).len(),
            LONGEST_TRACK
        );
    }

    #[test]
    fn a_point_that_a_view_observes_twice_is_shared_once() {
        let scene = scene();
        let twice = |views: &[ViewIndex]| views.iter().flat_map(|&v| [v, v]).collect();
        let doubled = Scene {
            track_offsets: scene
                .track_offsets
                .iter()
                .map(|offset| 2 * offset)
                .collect(),
            track_views: twice(&scene.track_views),
            track_pixels: scene.track_pixels.iter().flat_map(|&p| [p, p]).collect(),
            ..scene.clone()
        };
        let of = |scene: &Scene| neighbours(scene, &scene.view_points(), ViewIndex(6));
        assert_eq!(of(&doubled), of(&scene));
    }
}
