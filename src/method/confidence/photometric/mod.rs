//! Method 7.4: do the pictures agree on the surface? Asked before anything is matched, and nothing is learnt.
//!
//! Each view samples its picture at fixed places of every triangle that it sees. Where the samples of two views correlate, a backend will find the match
//! too; where they don't (no texture, leaves, gloss, a wrong surface), it won't.

mod cache;
mod compare;
mod grey;
mod stacks;

use std::sync::Arc;

pub(super) use self::stacks::SPACING;
pub use self::{cache::AGREEMENT_CACHE, grey::Grey};
use self::{
    cache::{Cache, Cached},
    compare::{compared, samples},
};
use super::pictures::{Pictures, picture_warnings};
use crate::{
    base::{
        column::{Column, TableError},
        progress::Watcher,
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
    /// By view: whether its picture was compared.
    compared: Vec<bool>,
    /// By key view, by partner, by row of the key view: 0 where the pictures do not both show a patch, else 1 + 254 times the correlation.
    pub values: Arc<Column<u8>>,
    /// Pictures that cannot be used, in words.
    pub warnings: Vec<String>,
    /// The first bytes of [`AGREEMENT_CACHE`], which the values follow; `None` where that file holds this table, or a picture has no time of change.
    pub cache_head: Option<Vec<u8>>,
}

/// What is known of the pictures of a pair.
pub enum PairAgreement<'a> {
    /// A value for each row of the key view.
    Compared(&'a [u8]),
    /// The backend is not expected to match the pair, which was not compared: only clusters made elsewhere have such pairs.
    NoCandidate,
    /// One of the two has no usable picture.
    NoPicture,
}

/// The table of a plan that compares no pictures.
#[cfg(test)]
pub static NO_AGREEMENT: std::sync::LazyLock<Agreement> = std::sync::LazyLock::new(Agreement::default);

impl Agreement {
    /// Compares the picture of each view with those of its partners, or reads what an earlier plan found in the same pictures on the same surface.
    /// Views without a usable picture have no values. `most_samples`: bytes of samples that memory may hold; more are kept on disk.
    pub fn new<'p>(
        geometry: &Geometry,
        pictures: &Pictures,
        partners_of: impl Fn(ViewIndex) -> &'p [ViewIndex] + Sync,
        most_samples: u64,
        watcher: &dyn Watcher,
    ) -> Result<Self, TableError> {
        let cache = Cache::new(geometry, pictures, &partners_of);
        if let Some(cache) = &cache
            && let Some(Cached { without, warnings, values }) = cache.read(geometry, &partners_of)?
        {
            let layout = Self::laid_out(geometry, &partners_of, &without);
            return Ok(Self { values: Arc::new(values), warnings, ..layout });
        }
        let (samples, troubles) = samples(geometry, pictures, most_samples, watcher)?;
        let without: Vec<bool> = troubles.iter().map(|t| t.is_some() || !pictures.have_images()).collect();
        let mut table = Self::laid_out(geometry, &partners_of, &without);
        let compare = |places: &mut Vec<u32>, key: ViewIndex| {
            watcher.check()?;
            places.resize(geometry.surface.triangles.len(), u32::MAX);
            Ok(compared(geometry, &samples, key, table.partners_of(key), places))
        };
        table.values = Arc::new(geometry.visibility.column(Vec::new, compare)?);
        table.warnings = picture_warnings(geometry.scene, &troubles);
        table.cache_head = cache.map(|cache| cache.head(&without, &table.warnings, &table.values));
        Ok(table)
    }

    /// The table without its values; `without`: by view, whether there is no usable picture.
    fn laid_out<'p>(geometry: &Geometry, partners_of: impl Fn(ViewIndex) -> &'p [ViewIndex], without: &[bool]) -> Self {
        let has_picture = |view: &ViewIndex| !without[view.index()];
        let compared = without.iter().map(|without| !without).collect();
        let mut table = Self { offsets: vec![0], compared, ..Self::default() };
        let mut start = 0;
        for key in geometry.scene.view_indices() {
            let rows = geometry.visibility.triangles_seen_by(key).len();
            table.keys.push((start, rows));
            if has_picture(&key) {
                let before = table.partners.len();
                table.partners.extend(partners_of(key).iter().copied().filter(has_picture));
                start += rows * (table.partners.len() - before);
            }
            table.offsets.push(table.partners.len());
        }
        table
    }

    /// Number of values.
    fn len(&self) -> usize {
        let last = self.keys.len().checked_sub(1).map(|last| ViewIndex(last as u32));
        last.map_or(0, |last| self.keys[last.index()].0 + self.keys[last.index()].1 * self.partners_of(last).len())
    }

    fn partners_of(&self, key: ViewIndex) -> &[ViewIndex] {
        match self.offsets.get(key.index()..key.index() + 2) {
            Some(bounds) => &self.partners[bounds[0]..bounds[1]],
            None => &[],
        }
    }

    /// The agreement of a pair on each triangle that the key view sees, in the order of its rows.
    pub fn of_pair(&self, key: ViewIndex, partner: ViewIndex) -> PairAgreement<'_> {
        let is_compared = |view: ViewIndex| self.compared.get(view.index()).is_some_and(|&compared| compared);
        if !is_compared(key) || !is_compared(partner) {
            return PairAgreement::NoPicture;
        }
        match self.partners_of(key).iter().position(|&p| p == partner) {
            Some(place) => {
                let (start, rows) = self.keys[key.index()];
                PairAgreement::Compared(&self.values[start + place * rows..][..rows])
            }
            None => PairAgreement::NoCandidate,
        }
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
