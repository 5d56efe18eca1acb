//! Ranks images that a program uses themselves, as Gaussian splatting does (method 5.10).
//!
//! Such a program draws new pictures from the chosen images. So all photographs, chosen or not, are
//! to be drawn well: each of their places by images that show it from about the same direction, the
//! better the more there are. What counts is submodular, and so gains are evaluated lazily.

use std::{cmp::Reverse, collections::BinaryHeap, sync::LazyLock};

use nalgebra::Vector3;
use rayon::prelude::*;

use crate::{
    base::{
        progress::{Cancelled, Stage, Watcher},
        rows::Offsets,
    },
    method::{
        confidence::Sharpness,
        visibility::{Visibility, projected_area},
    },
    model::{
        scene::{Scene, ViewIndex},
        surface::Surface,
    },
};

/// Angle between two rays to a place, radians, at which an image helps to draw the other 1/e as
/// much.
const FALL: f32 = 60.0 / 180.0 * std::f32::consts::PI;
/// Part of a place that an image from the same direction draws by itself.
const ALONE: f32 = 0.7;
/// Power of an image's sharpness in what it draws.
const SHARPNESS: f64 = 0.25;
/// Pairs of views of one triangle that are compared, over all triangles; of more, every second,
/// third, ... triangle counts.
const MOST_PAIRS: u64 = 1 << 24;
/// Gains that are computed at a time.
const AT_ONCE: usize = 16;

/// What views show of the places in each other.
pub struct Redrawing {
    /// Entries of each place.
    by_place: Offsets,
    entries: Vec<Entry>,
    /// Index into `entries` of what each view shows.
    of_view: Vec<Vec<u32>>,
}

/// A place in a view.
#[derive(Clone, Copy, Default)]
struct Entry {
    place: u32,
    /// From the camera to the place.
    ray: Vector3<f32>,
    /// Its part of all photographs, as far as no chosen image draws it.
    left: f32,
    sharpness: f32,
}

/// An order of views.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RedrawnOrder {
    /// Views, best first; those that show nothing are left out.
    pub views: Vec<ViewIndex>,
    /// Part of what is to be drawn that the first i + 1 views draw, 0 to 1.
    pub drawn: Vec<f64>,
}

impl RedrawnOrder {
    fn push(&mut self, best: Candidate) {
        let before = self.drawn.last().copied().unwrap_or(0.0);
        self.views.push(best.view);
        self.drawn.push(before + best.gain);
    }
}

/// Returns the views whose gains are computed anew: they only fall, those of before are bounds, and
/// the next ones are likely needed, too.
fn stale(best: Candidate, heap: &mut BinaryHeap<Candidate>, chosen: usize) -> Vec<ViewIndex> {
    let mut stale = vec![best.view];
    while stale.len() < AT_ONCE && heap.peek().is_some_and(|next| next.chosen < chosen) {
        stale.extend(heap.pop().map(|next| next.view));
    }
    stale
}

impl Redrawing {
    /// Memory of ranking, bytes: what each of `rows` views of a triangle shows, twice while
    /// it is sorted by place, and where the places begin.
    pub fn bytes(rows: u64, triangles: u64) -> u64 {
        let of_entry = 2 * size_of::<Entry>() + size_of::<u32>();
        let of_triangle = 3 * size_of::<usize>() + size_of::<u32>();
        // Each place has at least as many pairs as views.
        of_entry as u64 * rows.min(MOST_PAIRS) + of_triangle as u64 * triangles
    }

    /// Takes the images of these views, ascending, for the photographs.
    pub fn new(site: &Site, views: &[ViewIndex], watcher: &dyn Watcher) -> Result<Self, Cancelled> {
        let visibility = site.visibility;
        let step = site.step(views);
        let row = |view: ViewIndex| {
            watcher.check()?;
            Ok(match views.binary_search(&view) {
                Ok(_) => site.shown(view, step),
                Err(_) => Vec::new(),
            })
        };
        let rows = visibility.views().into_par_iter().map(row);
        let rows = rows.collect::<Result<Vec<_>, Cancelled>>()?;
        visibility.triangles.release();
        Ok(Self::of_rows(rows, site.surface.triangles.len()))
    }

    /// Sorts what each view shows by place; all together weigh 1.
    fn of_rows(rows: Vec<Vec<Entry>>, places: usize) -> Self {
        let all = || rows.iter().flatten();
        let whole: f64 = all().map(|entry| f64::from(entry.left)).sum();
        let mut lengths = vec![0; places];
        all().for_each(|entry| lengths[entry.place as usize] += 1);
        let by_place = Offsets::from_lengths(lengths);
        let mut next: Vec<usize> = (0..places).map(|place| by_place.row(place).start).collect();
        let mut entries = vec![Entry::default(); by_place.entries()];
        let mut take = |mut entry: Entry| {
            entry.left = (f64::from(entry.left) / whole) as f32;
            let next = &mut next[entry.place as usize];
            let at = *next;
            *next += 1;
            entries[at] = entry;
            at as u32
        };
        let of_row = |row: Vec<Entry>| row.into_iter().map(&mut take).collect();
        let of_view = rows.into_iter().map(of_row).collect();
        Self {
            by_place,
            entries,
            of_view,
        }
    }

    /// Ranks the views, each by what it adds to those before it. Ties go to the first.
    pub fn rank(mut self, watcher: &dyn Watcher) -> Result<RedrawnOrder, Cancelled> {
        let views: Vec<ViewIndex> = (0..self.of_view.len() as u32).map(ViewIndex).collect();
        let mut heap: BinaryHeap<Candidate> = self.candidates(&views, 0, watcher)?.into();
        let mut order = RedrawnOrder::default();
        let progress = |done| watcher.progress(Stage::Ranking, done as u64, views.len() as u64);
        progress(0);
        while let Some(best) = heap.pop() {
            let chosen = order.views.len();
            if best.chosen < chosen {
                let stale = stale(best, &mut heap, chosen);
                heap.extend(self.candidates(&stale, chosen, watcher)?);
                continue;
            }
            if best.gain <= 0.0 {
                break;
            }
            self.take(best.view);
            order.push(best);
            progress(chosen + 1);
        }
        progress(views.len());
        Ok(order)
    }

    fn candidates(
        &self,
        views: &[ViewIndex],
        chosen: usize,
        watcher: &dyn Watcher,
    ) -> Result<Vec<Candidate>, Cancelled> {
        let candidate = |&view: &ViewIndex| {
            watcher.check()?;
            Ok(Candidate {
                gain: self.gain(view),
                view,
                chosen,
            })
        };
        views.par_iter().map(candidate).collect()
    }

    /// Part of all photographs that the view would draw of what is left.
    fn gain(&self, view: ViewIndex) -> f64 {
        let shown = self.of_view[view.index()].iter();
        let gains = shown.map(|&entry| {
            let own = &self.entries[entry as usize];
            // Its own photograph is among them, which it does not draw whole either.
            let others = &self.entries[self.by_place.row(own.place as usize)];
            let gains = others.iter().map(|other| other.left * own.draws(other));
            // f32 is precise enough for the few views of a place, not for the sum of many places.
            f64::from(gains.sum::<f32>())
        });
        gains.sum()
    }

    fn take(&mut self, view: ViewIndex) {
        for &entry in &self.of_view[view.index()] {
            let own = self.entries[entry as usize];
            for other in &mut self.entries[self.by_place.row(own.place as usize)] {
                // Gains that fall more slowly with each further image were no better: they lose
                // more in `room` or `lego` than they win elsewhere.
                other.left *= 1.0 - own.draws(other);
            }
        }
    }
}

/// Steps of [`DRAWN`].
const STEPS: usize = 1 << 12;

/// What an image draws of a place in another, by the sine of half the angle between their rays.
static DRAWN: LazyLock<Vec<f32>> = LazyLock::new(|| {
    let angle = |step| 2.0 * (step as f32 / STEPS as f32).asin();
    (0..=STEPS)
        .map(|step| ALONE * (-angle(step) / FALL).exp())
        .collect()
});

impl Entry {
    /// Returns the part of the same place in another view that this one draws.
    fn draws(&self, other: &Self) -> f32 {
        // The chord of the two rays is exact where they are near each other, as their cosine is
        // not.
        let half_chord = 0.5 * (self.ray - other.ray).norm();
        let step = (half_chord * STEPS as f32 + 0.5) as usize;
        self.sharpness * DRAWN[step.min(STEPS)]
    }
}

/// What the photographs show: the triangles are the places.
pub struct Site<'a> {
    pub scene: &'a Scene,
    pub surface: &'a Surface,
    pub visibility: &'a Visibility,
    /// Weights of triangles inside a region.
    pub factors: Option<&'a [f32]>,
    pub sharpness: &'a Sharpness,
}

impl Site<'_> {
    fn factor(&self, triangle: u32) -> f32 {
        self.factors
            .map_or(1.0, |factors| factors[triangle as usize])
    }

    /// Returns every how many triangles one counts, with these views.
    fn step(&self, views: &[ViewIndex]) -> u32 {
        let left_out: Vec<ViewIndex> = self
            .scene
            .view_indices()
            .filter(|view| views.binary_search(view).is_err())
            .collect();
        let triangles = self.surface.triangles.len();
        let seen = self.visibility.views_of_triangles(triangles, &left_out);
        let seen = (0..).zip(&seen).filter(|(t, _)| self.factor(*t) > 0.0);
        let pairs: u64 = seen.map(|(_, &views)| u64::from(views).pow(2)).sum();
        pairs.div_ceil(MOST_PAIRS).max(1) as u32
    }

    /// Returns what a view shows, each place with its part of the photograph.
    fn shown(&self, view: ViewIndex, step: u32) -> Vec<Entry> {
        let centre = self.scene.view(view).cam_from_world.centre();
        let sharpness = self.sharpness.of(view).powf(SHARPNESS) as f32;
        let mut whole = 0.0;
        let mut entries = Vec::new();
        let seen = self.visibility.triangles_seen_by(view).iter();
        for &place in seen.filter(|&triangle| triangle % step == 0) {
            let area = self.area(view, place);
            // Before the region's factor: a photograph that shows little of the region has little
            // to be drawn.
            whole += area;
            let left = area * f64::from(self.factor(place));
            let ray = (self.surface.centroid(place) - centre).normalize();
            // A camera at the centroid has no direction to it.
            if left > 0.0 && ray.iter().all(|x| x.is_finite()) {
                entries.push(Entry {
                    place,
                    ray: ray.cast(),
                    left: left as f32,
                    sharpness,
                });
            }
        }
        for entry in &mut entries {
            entry.left /= whole as f32;
        }
        // All views' entries are held at once.
        entries.shrink_to_fit();
        entries
    }

    /// Returns the area of a triangle in a photograph, pixels.
    fn area(&self, view: ViewIndex, triangle: u32) -> f64 {
        let pose = &self.scene.view(view).cam_from_world;
        let corners = self.surface.corners(triangle);
        projected_area(
            self.scene.camera_of(view),
            &corners.map(|corner| pose.camera_from_world(&corner)),
        )
    }
}

/// A view with its gain over the first `chosen` views.
#[derive(Clone, Copy)]
struct Candidate {
    gain: f64,
    view: ViewIndex,
    chosen: usize,
}

impl Candidate {
    fn key(&self) -> (f64, Reverse<u32>) {
        (self.gain, Reverse(self.view.0))
    }
}

impl Ord for Candidate {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        let ((gain, view), (other_gain, other_view)) = (self.key(), other.key());
        gain.total_cmp(&other_gain).then(view.cmp(&other_view))
    }
}

impl PartialOrd for Candidate {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Candidate {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Candidate {}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::base::progress::NoWatcher;

    fn entry(place: u32, degrees: f32, left: f32) -> Entry {
        let angle = degrees.to_radians();
        Entry {
            place,
            ray: Vector3::new(angle.sin(), 0.0, angle.cos()),
            left,
            sharpness: 1.0,
        }
    }

    fn ranked(rows: &[Vec<Entry>], places: usize) -> RedrawnOrder {
        let redrawing = Redrawing::of_rows(rows.to_vec(), places);
        redrawing.rank(&NoWatcher).unwrap()
    }

    /// Part of all photographs that these views draw.
    fn all_drawn(rows: &[Vec<Entry>], chosen: &[ViewIndex]) -> f64 {
        let in_view =
            |view: &ViewIndex, place| rows[view.index()].iter().find(|own| own.place == place);
        let draws = |other: &Entry| {
            let missed = |view: &ViewIndex| {
                in_view(view, other.place).map_or(1.0, |own| 1.0 - own.draws(other))
            };
            1.0 - chosen.iter().map(missed).product::<f32>()
        };
        let all = || rows.iter().flatten();
        let drawn: f32 = all().map(|other| other.left * draws(other)).sum();
        f64::from(drawn / all().map(|other| other.left).sum::<f32>())
    }

    proptest! {
        #[test]
        fn each_image_adds_most_to_those_before(
            shown in prop::collection::vec(prop::collection::btree_map(0..4u32, (0.0..180f32, 0.1..1f32), 1..4), 1..8)
        ) {
            let row = |places: &std::collections::BTreeMap<u32, (f32, f32)>| -> Vec<Entry> {
                places.iter().map(|(&place, &(degrees, left))| entry(place, degrees, left)).collect()
            };
            let rows: Vec<Vec<Entry>> = shown.iter().map(row).collect();
            let order = ranked(&rows, 4);
            prop_assert_eq!(order.views.len(), rows.len());
            for (i, &part) in order.drawn.iter().enumerate() {
                prop_assert!((part - all_drawn(&rows, &order.views[..=i])).abs() < 1e-5);
                for other in &order.views[i + 1..] {
                    let instead = [&order.views[..i], &[*other]].concat();
                    prop_assert!(all_drawn(&rows, &instead) <= part + 1e-5);
                }
            }
        }
    }

    #[test]
    fn the_memory_of_ranking_is_that_of_all_lists() {
        let rows: Vec<Vec<Entry>> = (0..50)
            .map(|view| {
                (0..40)
                    .map(|place| entry(place, view as f32, 1.0))
                    .collect()
            })
            .collect();
        let before = rows.iter().map(|row| size_of_val(&row[..])).sum::<usize>();
        let sorted = Redrawing::of_rows(rows, 40);
        let after = size_of_val(&sorted.entries[..]);
        let of_views = sorted.of_view.iter().map(|row| size_of_val(&row[..]));
        let lists = (before + after + of_views.sum::<usize>()) as u64;
        let forecast = Redrawing::bytes(2000, 40);
        assert!(
            forecast >= lists && forecast - lists < 40 * 40,
            "{forecast} {lists}"
        );
        let most = Redrawing::bytes(MOST_PAIRS, 0);
        assert_eq!(
            Redrawing::bytes(u64::MAX, 0),
            most,
            "only some places count"
        );
    }

    #[test]
    fn both_sides_of_a_place_come_before_more_of_one() {
        let angles = [0.0, 1.0, 2.0, 3.0, 4.0, 170.0, 171.0, 172.0];
        let rows: Vec<_> = angles.map(|angle| vec![entry(0, angle, 1.0)]).into();
        let order = ranked(&rows, 1).views;
        assert_eq!(
            order[..2],
            [ViewIndex(2), ViewIndex(6)],
            "the middle of each"
        );
    }

    #[test]
    fn a_blurred_image_of_the_same_comes_later() {
        let mut rows = vec![vec![entry(0, 0.0, 1.0)], vec![entry(0, 0.0, 1.0)]];
        rows[0][0].sharpness = 0.8;
        assert_eq!(ranked(&rows, 1).views, [ViewIndex(1), ViewIndex(0)]);
        assert_eq!(
            ranked(&[Vec::new(), rows[1].clone()], 1).views,
            [ViewIndex(1)]
        );
    }
}
