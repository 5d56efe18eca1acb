//! Triangles that finished depth maps don't reach, with reasons (method 8).

use std::collections::BTreeMap;

use super::run::MeasuredClusters;
use crate::{
    io::ply::{self, FaceField},
    method::fulfilment::{self, Model},
};

/// Minimum measured fulfilment of a triangle that counts as well done.
const ENOUGH: f32 = 0.5;

/// Reason that a triangle is not well done.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Missing {
    /// No key view with a depth map sees it.
    NoView,
    /// No key view that sees it was matched with enough partners that see it too.
    TooFewPartners,
    /// The images are too coarse there.
    TooCoarse,
    /// The geometry of the matched views is too weak there.
    TooInaccurate,
    /// Too few pixels were measured right.
    MatchingFailed,
}

const ALL: [Missing; 5] = [
    Missing::NoView,
    Missing::TooFewPartners,
    Missing::TooCoarse,
    Missing::TooInaccurate,
    Missing::MatchingFailed,
];

impl Missing {
    /// Describes the reason.
    pub fn describe(self) -> &'static str {
        match self {
            Self::NoView => "no view: no key view with a depth map sees it",
            Self::TooFewPartners => "too few partners that see it were matched",
            Self::TooCoarse => "too coarse",
            Self::TooInaccurate => "too inaccurate: weak geometry",
            Self::MatchingFailed => "matching failed",
        }
    }

    fn colour(self) -> [u8; 3] {
        match self {
            Self::NoView => [120, 120, 120],
            Self::TooFewPartners => [120, 80, 160],
            Self::TooCoarse => [60, 110, 190],
            Self::TooInaccurate => [235, 160, 50],
            Self::MatchingFailed => [200, 60, 50],
        }
    }

    /// Returns its number in the field `missing`, where 0 means well done.
    fn number(self) -> u8 {
        self as u8 + 1
    }
}

/// Measured fulfilment of the surface.
#[derive(Clone, Debug)]
pub struct MeasuredSurface {
    /// Best measured fulfilment of each triangle.
    pub fulfilment: Vec<f32>,
    /// Reason for each triangle; `None` if it is at least half fulfilled.
    pub missing: Vec<Option<Missing>>,
}

impl MeasuredSurface {
    pub fn new(model: &Model, run: &MeasuredClusters) -> Self {
        let triangles = model.surface.triangles.len();
        let mut best = vec![Best::default(); triangles];
        for (c, cluster) in run.matched.iter().enumerate() {
            model
                .visibility
                .triangles_seen_by(cluster.key)
                .iter()
                .for_each(|&t| best[t as usize].seen = true);
            let (seen, values) = run.attainable.row(c);
            let (real_seen, real) = run.real.row(c);
            for (&t, &attainable) in seen.iter().zip(values) {
                let real = real_seen.binary_search(&t).map_or(0.0, |i| real[i]);
                best[t as usize].offer(c, attainable, real);
            }
        }
        let missing = best
            .iter()
            .enumerate()
            .map(|(t, best)| best.missing(model, run, t as u32))
            .collect();
        Self {
            fulfilment: best.iter().map(|b| b.real).collect(),
            missing,
        }
    }

    /// Returns the number of triangles for each reason; well-done triangles and those that don't
    /// count are left out.
    pub fn counts(&self, counts: impl Fn(usize) -> bool) -> BTreeMap<Missing, usize> {
        let inside = self
            .missing
            .iter()
            .enumerate()
            .filter(|(t, _)| counts(*t))
            .map(|(_, missing)| missing);
        let mut counts: BTreeMap<Missing, usize> = ALL.iter().map(|&m| (m, 0)).collect();
        inside
            .flatten()
            .for_each(|&m| *counts.entry(m).or_default() += 1);
        counts
    }

    /// Returns the surface as PLY with `quality` (measured fulfilment), `missing` (number of the
    /// reason) and colours: white to green where it is well done, by reason elsewhere.
    pub fn ply(&self, model: &Model) -> Vec<u8> {
        let numbers: Vec<u8> = self
            .missing
            .iter()
            .map(|m| m.map_or(0, Missing::number))
            .collect();
        // Below one half the reason has the colour, so the scale begins there.
        let done = |f: f32| {
            [200.0, 225.0, 205.0]
                .map(|c: f32| (c - (c - 90.0) * (2.0 * f - 1.0).clamp(0.0, 1.0)) as u8)
        };
        let colour = |(m, &f): (&Option<Missing>, &f32)| m.map_or_else(|| done(f), Missing::colour);
        let colours: Vec<[u8; 3]> = self
            .missing
            .iter()
            .zip(&self.fulfilment)
            .map(colour)
            .collect();
        let fields = [
            FaceField::Colour(&colours),
            FaceField::Float("quality", &self.fulfilment),
            FaceField::Byte("missing", &numbers),
        ];
        let mut comments = vec![
            "quality: real fulfilment".to_string(),
            "missing 0: well done".to_string(),
        ];
        comments.extend(
            ALL.iter()
                .map(|m| format!("missing {}: {}", m.number(), m.describe())),
        );
        ply::write(
            &model.surface.vertices,
            &model.surface.triangles,
            &fields,
            &comments,
        )
    }
}

/// Best results of the clusters for a triangle.
#[derive(Clone, Copy, Default)]
struct Best {
    seen: bool,
    /// The cluster with the largest measured fulfilment, ties by attainable fulfilment; `None` if
    /// f_cov is 0 in all.
    cluster: Option<usize>,
    attainable: f32,
    real: f32,
}

impl Best {
    fn offer(&mut self, cluster: usize, attainable: f32, real: f32) {
        if self.cluster.is_none() || (real, attainable) > (self.real, self.attainable) {
            *self = Self {
                seen: true,
                cluster: Some(cluster),
                attainable,
                real,
            };
        }
    }

    fn missing(&self, model: &Model, run: &MeasuredClusters, triangle: u32) -> Option<Missing> {
        if self.real >= ENOUGH {
            return None;
        }
        let Some(cluster) = self.cluster else {
            return Some(if self.seen {
                Missing::TooFewPartners
            } else {
                Missing::NoView
            });
        };
        let cluster = &run.matched[cluster];
        let f = fulfilment::value(model, cluster.key, &cluster.partners, triangle);
        // Tables hold only f > 0, so this divides by no 0.
        let confidence = f64::from(self.real / self.attainable);
        Some(if confidence <= f.resolution.min(f.uncertainty) {
            Missing::MatchingFailed
        } else if f.resolution <= f.uncertainty {
            Missing::TooCoarse
        } else {
            Missing::TooInaccurate
        })
    }
}
