//! Results of the stages, kept in the project for its next plan: one that changes only the cut or
//! the budget computes at most what a longer cut asks of further clusters; one for another region,
//! or around finished depth maps, ranks again.
//!
//! Each stage has a file in `viewrank/cache` ([`crate::io::cache`]) with the fingerprint of all
//! that the stage reads: the sparse model by content, settings, the results of earlier stages, and
//! the program itself. Tables that were too large for memory are not cached.

pub(super) mod agreement;
pub(super) mod candidates;
pub(super) mod clusters;
mod fingerprints;
pub(super) mod pilot;
pub(super) mod ranking;
pub(super) mod shown;
mod surface;
pub(super) mod twins;
pub(super) mod unary;

use serde::{Serialize, de::DeserializeOwned};

pub(super) use self::{fingerprints::Fingerprints, surface::CachedSurface};
use super::Plan;
use crate::{
    base::{input::FileKind, packed::Packed},
    io::{cache::CacheFile, output::FileSet},
};

/// Returns packed lists in one piece, as they are read.
#[cfg(test)]
fn bytes(packed: &Packed) -> Vec<u8> {
    packed
        .iter()
        .flat_map(|part| part.as_bytes())
        .copied()
        .collect()
}

/// The files of the stages.
#[derive(Clone, Debug)]
pub struct Cached {
    pub(super) twins: ResultFile,
    pub(super) surface: ResultFile,
    pub(super) shown: ResultFile,
    pub(super) candidates: ResultFile,
    pub(super) unary: ResultFile,
    /// `None` if no pictures were compared.
    pub(super) agreement: Option<ResultFile>,
    pub(super) clusters: ResultFile,
    /// `None` without a pilot.
    pub(super) pilot: Option<ResultFile>,
    pub(super) ranking: ResultFile,
    /// The files of [`Plan::unwritten`], if made before the predictions were replaced.
    pub(super) made: Option<Vec<FileSet>>,
}

/// The file of a stage.
#[derive(Clone, Debug)]
pub(super) struct ResultFile {
    pub file: CacheFile,
    /// True if the file holds the result of this plan.
    pub is_kept: bool,
}

/// A result, with the file that it is cached in.
pub(super) struct Filed<T> {
    pub file: ResultFile,
    pub result: T,
}

impl<T> Filed<T> {
    pub fn into_parts(self) -> (ResultFile, T) {
        (self.file, self.result)
    }
}

impl<T> Filed<Option<T>> {
    /// Returns what the file holds, else computes it.
    pub fn or_compute<E>(self, compute: impl FnOnce() -> Result<T, E>) -> Result<Filed<T>, E> {
        let Self { file, result } = self;
        let result = match result {
            Some(known) => known,
            None => compute()?,
        };
        Ok(Filed { file, result })
    }
}

impl<T> std::ops::Deref for Filed<T> {
    type Target = T;

    fn deref(&self) -> &T {
        &self.result
    }
}

impl ResultFile {
    /// Returns the file's set, unless it is there already.
    fn set<F: Serialize>(&self, pack: impl FnOnce() -> Option<(F, Packed)>) -> Option<FileSet> {
        if self.is_kept {
            return None;
        }
        let length = |packed: &Packed| {
            packed
                .iter()
                .map(|part| part.as_bytes().len() as u64)
                .sum::<u64>()
        };
        let packed = self
            .file
            .inputs()
            .and_then(|_| pack())
            // Longer contents would be written, then refused whenever they are read.
            .filter(|(_, packed)| length(packed) <= FileKind::State.limit());
        Some(match packed {
            Some((facts, packed)) => self.file.file(&facts, packed),
            None => self.file.no_file(),
        })
    }
}

/// Reads what the file holds, if it is of the same inputs and `unpack` makes sense of it.
pub(super) fn read<F: Serialize + DeserializeOwned, T>(
    file: CacheFile,
    unpack: impl FnOnce(F, &[u8]) -> Option<T>,
) -> Filed<Option<T>> {
    let found = file.read().and_then(|(facts, bytes)| unpack(facts, &bytes));
    Filed {
        file: ResultFile {
            file,
            is_kept: found.is_some(),
        },
        result: found,
    }
}

impl Plan {
    /// Makes the files of [`Self::unwritten`] now: what finished depth maps show replaces
    /// predictions, but the next plan begins with these.
    pub fn keep_predictions(&mut self) {
        self.stages.cached.made = Some(self.unwritten());
    }

    /// Returns the results of stages that the project does not keep yet.
    pub fn unwritten(&self) -> Vec<FileSet> {
        let (stages, cached) = (&self.stages, &self.stages.cached);
        if let Some(made) = &cached.made {
            return made.clone();
        }
        // What a longer cut has asked for is kept as well.
        let known = stages
            .known_ranking
            .as_ref()
            .map_or(0, |known| known.pixels.len());
        // Those of the compared pictures come last and are kept with them.
        let own = stages.picture_warnings.len() - stages.agreement.warnings.len();
        let mask_warnings = &stages.picture_warnings[..own];
        let ranking = ResultFile {
            is_kept: cached.ranking.is_kept && self.decision.pixels.len() <= known,
            ..cached.ranking.clone()
        };
        [
            cached.twins.set(|| Some(((), twins::pack(&stages.twins)))),
            cached
                .surface
                .set(|| surface::pack(&stages.surface, &stages.surface_stats, &stages.visibility)),
            cached.shown.set(|| Some(((), shown::pack(&stages.shown)))),
            cached
                .candidates
                .set(|| Some(((), candidates::pack(&stages.candidates)))),
            cached
                .unary
                .set(|| unary::pack(&stages.unary, mask_warnings)),
            cached
                .clusters
                .set(|| Some(((), clusters::pack(&stages.tables)?))),
            cached.pilot.as_ref().and_then(|file| {
                let pilot = stages.pilot.as_ref();
                file.set(|| Some(((), pilot::pack(&pilot?.places))))
            }),
            ranking.set(|| Some(((), ranking::pack(&self.decision)))),
        ]
        .into_iter()
        .flatten()
        .chain(
            cached
                .agreement
                .as_ref()
                .and_then(|file| agreement::set(file, &stages.agreement)),
        )
        .collect()
    }
}
