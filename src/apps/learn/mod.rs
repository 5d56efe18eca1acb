//! Fits the photometric confidence (method 7.4) to finished depth maps: how often a backend matches
//! where the pictures agree, where they don't, and how many matches it needs.
//!
//! The label is "the map has a depth there", which needs no reference and means the same for every
//! backend.

mod fit;
mod score;

use std::sync::atomic::{AtomicU64, Ordering};

use self::fit::{Outcomes, fit};
pub use self::score::Scores;
use super::evaluate::measure;
use crate::{
    base::{
        error::{Advice, Hint},
        progress::{Cancelled, Stage, Watcher},
    },
    io::depthmaps::{self, DepthMapError, DepthMapFile},
    method::{
        confidence::{PairAgreement, Photometric},
        fulfilment::Model,
    },
    model::{cluster::ViewCluster, scene::ViewIndex},
};

/// About the most triangles of a project that are learnt from, evenly spread over its maps.
const MOST_TRIANGLES: usize = 40_000;
/// Pixels from which a triangle has full weight: those of one triangle succeed and fail together.
const FULL_WEIGHT: f32 = 8.0;

/// A planned project with finished depth maps.
pub struct Lesson<'a> {
    pub model: Model<'a>,
    /// Clusters with the partners that the maps were matched with.
    pub clusters: Vec<ViewCluster>,
    pub maps: Vec<DepthMapFile>,
}

/// Numbers of a backend's confidence.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Numbers {
    /// Minimum number of successful matches for a pixel (method 3.4), 1 to 3.
    pub min_matches: u32,
    #[serde(flatten)]
    pub photometric: Photometric,
}

/// Numbers fitted to depth maps.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Fitted {
    pub numbers: Numbers,
    pub depth_maps: usize,
    /// Triangles of view clusters that were learnt from.
    pub triangles: usize,
    /// How well the numbers before the training predict them.
    pub before: Scores,
    /// The same for numbers that were fitted without the scene (of a single one: without the half
    /// of the maps, by name) that they predict.
    pub after: Scores,
}

/// Fits the numbers to the maps of the lessons; the same result for any number of threads.
///
/// # Errors
/// A depth map that cannot be read; no triangle whose pictures were compared.
pub fn train(
    lessons: &[Lesson],
    before: Numbers,
    watcher: &dyn Watcher,
) -> Result<Fitted, TrainError> {
    let by_map: Vec<Vec<Outcomes>> = lessons
        .iter()
        .map(|lesson| lesson.outcomes(watcher))
        .collect::<Result<_, _>>()?;
    let outcomes: Vec<Outcomes> = by_map.iter().map(|maps| Outcomes::joined(maps)).collect();
    let parts: Vec<Outcomes> = match &by_map[..] {
        // Halves of a single scene, so that no map is both fitted to and predicted.
        [maps] => [&maps[..maps.len() / 2], &maps[maps.len() / 2..]]
            .map(Outcomes::joined)
            .into(),
        _ => outcomes.clone(),
    };
    if outcomes.iter().all(Outcomes::is_empty) {
        return Err(TrainError::NothingCompared);
    }
    let unseen = |left_out: usize| {
        let others: Vec<&Outcomes> = parts
            .iter()
            .enumerate()
            .filter(|(i, _)| *i != left_out)
            .map(|(_, o)| o)
            .collect();
        parts[left_out].predicted(&fit(&others))
    };
    let after = (0..parts.len()).flat_map(unseen).collect();
    let all: Vec<&Outcomes> = outcomes.iter().collect();
    Ok(Fitted {
        numbers: fit(&all),
        depth_maps: lessons.iter().map(|lesson| lesson.maps.len()).sum(),
        triangles: outcomes.iter().map(Outcomes::len).sum(),
        before: Scores::new(outcomes.iter().flat_map(|o| o.predicted(&before)).collect()),
        after: Scores::new(after),
    })
}

impl Lesson<'_> {
    /// Measures each map, in the order of the views' names.
    fn outcomes(&self, watcher: &dyn Watcher) -> Result<Vec<Outcomes>, TrainError> {
        let (done, total) = (AtomicU64::new(0), self.maps.len() as u64);
        let of_map = |map: &DepthMapFile| {
            watcher.check()?;
            watcher.progress(
                Stage::Train,
                1 + done.fetch_add(1, Ordering::Relaxed),
                total,
            );
            let cluster = self.clusters.iter().find(|cluster| cluster.key == map.view);
            let cluster = cluster
                .ok_or_else(|| TrainError::NoCluster(self.model.scene.name(map.view).into()))?;
            Ok(self
                .outcomes_of(map, cluster)?
                .thinned(MOST_TRIANGLES.div_ceil(self.maps.len())))
        };
        let mut maps: Vec<&DepthMapFile> = self.maps.iter().collect();
        maps.sort_by_key(|map| self.model.scene.name(map.view));
        depthmaps::in_parallel(
            &maps,
            |map| Some(map.view),
            self.model.scene,
            |map| of_map(map),
        )
    }

    /// The triangles of a map that enough cameras see, if all their pictures were compared.
    fn outcomes_of(
        &self,
        file: &DepthMapFile,
        cluster: &ViewCluster,
    ) -> Result<Outcomes, TrainError> {
        let model = &self.model;
        let map = depthmaps::read_of_view(file, model.scene)?;
        // Any accuracy will do: without a reference none counts.
        let measured = measure(model, cluster.key, map, None, 0.0, None);
        let agreement: Option<Vec<(ViewIndex, &[u8])>> = cluster
            .partners
            .iter()
            .map(|&partner| self.compared(cluster.key, partner))
            .collect();
        let mut outcomes = Outcomes::default();
        for (row, &triangle) in model
            .visibility
            .triangles_seen_by(cluster.key)
            .iter()
            .enumerate()
        {
            let sees = |partner: ViewIndex| model.visibility.row(partner, triangle).is_some();
            let pairs = agreement
                .iter()
                .flatten()
                .filter(|(partner, _)| sees(*partner));
            let pairs: Vec<u8> = pairs
                .map(|(_, values)| values.get(row).copied().unwrap_or(0))
                .collect();
            if 1 + pairs.len() >= model.rule.min_cameras as usize {
                let weight = (measured.pixels[row] as f32 / FULL_WEIGHT).min(1.0);
                outcomes.push(&pairs, measured.shares[row], weight);
            }
        }
        Ok(outcomes)
    }

    /// The agreement of a pair by row of the key view, empty for pairs that the backend is not
    /// expected to match; `None` without pictures.
    fn compared(&self, key: ViewIndex, partner: ViewIndex) -> Option<(ViewIndex, &[u8])> {
        match self.model.agreement.of_pair(key, partner) {
            PairAgreement::Compared(values) => Some((partner, values)),
            PairAgreement::NoCandidate => Some((partner, &[])),
            PairAgreement::NoPicture => None,
        }
    }
}

/// A training that fails.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
    #[error(transparent)]
    Map(#[from] DepthMapError),
    #[error("the partners that {0} was matched with are unknown")]
    NoCluster(String),
    #[error("no depth map has a triangle whose pictures were compared")]
    NothingCompared,
}

impl Hint for TrainError {
    fn hint(&self) -> Option<Advice> {
        match self {
            Self::Cancelled(_) => None,
            Self::Map(error) => error.hint(),
            Self::NoCluster(_) => {
                Some("plan the project again, or keep the matcher's report beside its maps".into())
            }
            Self::NothingCompared => {
                let name = Advice::text("name the images with ").set("images");
                Some(name.and(", and finish some depth maps first"))
            }
        }
    }
}
