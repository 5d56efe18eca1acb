//! Method 7.4: do the pictures agree on the surface? Asked before anything is matched, and nothing is learnt.
//!
//! Each view samples its picture at fixed places of every triangle that it sees. Where the samples of two views correlate, a backend will find the match
//! too; where they don't (no texture, leaves, gloss, a wrong surface), it won't.

mod grey;
mod stacks;

use std::sync::atomic::{AtomicU64, Ordering};

pub use self::grey::Grey;
pub(super) use self::stacks::SPACING;
use self::stacks::{STACK, Spacing, correlation, stacks};
use super::{image::ImageError, pictures::Pictures};
use crate::{
    base::{
        column::{Column, Storage, TableError},
        progress::{Stage, Watcher},
    },
    method::geometry::Geometry,
    model::scene::ViewIndex,
};

/// How a correlation becomes a chance (method 7.4); first guesses that held on nine scenes.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Photometric {
    /// Chance of a match where the pictures agree.
    pub p0: f64,
    /// Correlation from which they do.
    pub full: f64,
}

/// Least share of `p0`, where the pictures don't agree at all: matchers look elsewhere along the ray.
const LEAST: f64 = 0.02;

impl Default for Photometric {
    fn default() -> Self {
        Self { p0: 0.95, full: 0.8 }
    }
}

impl Photometric {
    /// p_i of a pair at a triangle, 0 to 1: `p0 clip(correlation / full, 0.02, 1)`; 0 where the two pictures don't show a patch of it.
    pub fn chance(&self, agreement: u8) -> f64 {
        match correlated(agreement) {
            Some(correlation) => self.p0 * (correlation / self.full).clamp(LEAST, 1.0),
            None => 0.0,
        }
    }
}

/// Steps of a correlation from 0 to 1.
const STEPS: f32 = 254.0;

/// 0: not seen by both; else 1 + the correlation in [`STEPS`], 0 if it is negative.
fn packed(correlation: Option<f32>) -> u8 {
    correlation.map_or(0, |correlation| 1 + (correlation.clamp(0.0, 1.0) * STEPS).round() as u8)
}

fn correlated(agreement: u8) -> Option<f64> {
    agreement.checked_sub(1).map(|steps| f64::from(steps) / f64::from(STEPS))
}

/// How well the pictures of pairs of views agree on each triangle that the key view sees.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Agreement {
    /// By key view: where its values begin, and its rows of visibility.
    keys: Vec<(usize, usize)>,
    /// Partners of each key view, in the order of their values: CSR by view.
    pub offsets: Vec<usize>,
    pub partners: Vec<ViewIndex>,
    /// By key view, by partner, by row of the key view: 0 where the pictures do not both show a patch, else 1 + 254 times the correlation.
    pub values: Column<u8>,
}

/// Of pictures that were not compared.
pub static NO_AGREEMENT: std::sync::LazyLock<Agreement> = std::sync::LazyLock::new(Agreement::default);

impl Agreement {
    /// Samples the pictures and compares those of each view with those of its partners. Views without a picture have no values; the second value says
    /// why by view. `most_samples`: bytes of samples that memory may hold; more are kept on disk.
    pub fn new<'p>(
        geometry: &Geometry,
        pictures: &Pictures,
        partners_of: impl Fn(ViewIndex) -> &'p [ViewIndex] + Sync,
        most_samples: u64,
        watcher: &dyn Watcher,
    ) -> Result<(Self, Vec<Option<ImageError>>), TableError> {
        let Geometry { scene, visibility, .. } = *geometry;
        let spacing = Spacing::new(geometry);
        let (done, total) = (AtomicU64::new(0), scene.views.len() as u64);
        watcher.progress(Stage::Confidence, 0, total);
        let troubles = std::sync::Mutex::new(Vec::new());
        let of_view = |_: &mut (), view: ViewIndex| {
            watcher.check()?;
            let sampled = pictures
                .grey(scene, view, geometry.image_scale)
                .map(|picture| picture.map(|(grey, mask)| stacks(geometry, &spacing, view, &grey, mask.as_ref())));
            let sampled = sampled.unwrap_or_else(|trouble| {
                troubles.lock().map(|mut troubles| troubles.push((view, trouble))).ok();
                None
            });
            watcher.progress(Stage::Confidence, 1 + done.fetch_add(1, Ordering::Relaxed), total);
            Ok(sampled.unwrap_or_else(|| vec![stacks::NOT_SEEN; visibility.triangles_seen_by(view).len() * STACK]))
        };
        let keep = match visibility.triangles.len() as u64 * STACK as u64 > most_samples {
            true => Storage::Disk,
            false => visibility.triangles.kept(),
        };
        let samples: Column<i8> = visibility.column_kept(keep, || (), of_view)?;
        let mut without: Vec<Option<ImageError>> = scene.view_indices().map(|_| None).collect();
        for (view, trouble) in troubles.into_inner().unwrap_or_default() {
            without[view.index()] = Some(trouble);
        }
        let has_picture = |view: &ViewIndex| pictures.have_images() && without[view.index()].is_none();
        let mut table = Self { offsets: vec![0], ..Self::default() };
        let mut start = 0;
        for key in scene.view_indices() {
            let rows = visibility.triangles_seen_by(key).len();
            table.keys.push((start, rows));
            if has_picture(&key) {
                let partners = partners_of(key).iter().copied().filter(has_picture);
                let before = table.partners.len();
                table.partners.extend(partners);
                start += rows * (table.partners.len() - before);
            }
            table.offsets.push(table.partners.len());
        }
        let compare = |places: &mut Vec<u32>, key: ViewIndex| {
            watcher.check()?;
            places.resize(geometry.surface.triangles.len(), u32::MAX);
            Ok(compared(geometry, &samples, key, table.partners_of(key), places))
        };
        table.values = visibility.column(Vec::new, compare)?;
        Ok((table, without))
    }

    fn partners_of(&self, key: ViewIndex) -> &[ViewIndex] {
        match self.offsets.get(key.index()..key.index() + 2) {
            Some(bounds) => &self.partners[bounds[0]..bounds[1]],
            None => &[],
        }
    }

    /// The agreement of a pair on each triangle that the key view sees, in the order of its rows; `None` where it is not known.
    pub fn of_pair(&self, key: ViewIndex, partner: ViewIndex) -> Option<&[u8]> {
        let place = self.partners_of(key).iter().position(|&p| p == partner)?;
        let (start, rows) = self.keys[key.index()];
        Some(&self.values[start + place * rows..][..rows])
    }

    pub fn is_empty(&self) -> bool {
        self.partners.is_empty()
    }

    /// Gives back memory that can be read again.
    pub fn release(&self) {
        self.values.release();
    }

    /// Bytes that it holds of this process's memory.
    pub fn bytes(&self) -> usize {
        self.values.bytes() + 4 * self.partners.len()
    }
}

/// Agreement of the key view with each partner, by partner, by row of the key view.
fn compared(
    geometry: &Geometry,
    samples: &Column<i8>,
    key: ViewIndex,
    partners: &[ViewIndex],
    places: &mut [u32],
) -> Vec<u8> {
    let visibility = geometry.visibility;
    let (own, seen) = (visibility.rows(key), visibility.triangles_seen_by(key));
    seen.iter().enumerate().for_each(|(row, &t)| places[t as usize] = row as u32);
    let mut values = vec![0; partners.len() * seen.len()];
    for (partner, values) in partners.iter().zip(values.chunks_exact_mut(seen.len().max(1))) {
        for (row, &t) in visibility.rows(*partner).zip(visibility.triangles_seen_by(*partner)) {
            let place = places[t as usize];
            if place != u32::MAX {
                let [a, b] = [own.start + place as usize, row].map(|row| &samples[row * STACK..][..STACK]);
                values[place as usize] = packed(correlation(a, b));
            }
        }
    }
    seen.iter().for_each(|&t| places[t as usize] = u32::MAX);
    values
}
