//! Methods 5.3 and 5.6: forecasts the cost of the chosen clusters and of all clusters.

use std::ops::Range;

use rayon::prelude::*;
use serde::Serialize;

use super::{ForecastSettings, Options, Tables};
use crate::{
    base::column,
    method::{
        fulfilment::{
            Model,
            block::{Block, BlockSlots},
        },
        ranking::Ranking,
        visibility,
    },
    model::cluster::{MapScale, ViewCluster},
};

/// The backend's work for the plan, with its duration where the times per map or pair are set. A
/// program that uses the images themselves matches nothing: only `maps` and `all_maps` count, the
/// images.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Forecast {
    /// Depth maps of the chosen clusters.
    pub maps: usize,
    /// Those of them at half the size.
    pub maps_at_half: usize,
    /// Their (key view, partner) pairs.
    pub pairs: usize,
    /// Their work over that of all maps at full size, 0 to 1.
    pub work: f64,
    /// Pixels that these maps will measure, before fusion.
    pub points: u64,
    /// Seconds of matching, without finished maps; absent where `forecast.seconds_per_pair` and
    /// `.seconds_per_map` are unset.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub seconds: Option<f64>,
    /// Depth maps if every view that can be a key view gets one.
    pub all_maps: usize,
    /// Their pairs.
    pub all_pairs: usize,
    /// Seconds of matching for all of them, without finished maps.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub all_seconds: Option<f64>,
}

impl Forecast {
    /// Speed-up of the chosen clusters over all, both without finished maps, when planning takes
    /// `planning` seconds (method 5.6).
    pub fn speed_up(&self, planning: f64) -> Option<f64> {
        Some(self.all_seconds? / (self.seconds? + planning))
    }

    /// Seconds per depth map at full size above which planning, `planning` seconds long, saves
    /// time; `None` if the plan takes all of their work.
    pub fn break_even(&self, planning: f64) -> Option<f64> {
        let saved = match self.maps_at_half {
            0 => self.all_maps.saturating_sub(self.maps) as f64,
            _ => (1.0 - self.work) * self.all_maps as f64,
        };
        (saved > 0.0).then(|| planning / saved)
    }
}

/// Computes the cost of a cluster by its rank (from 0).
pub struct Cost<'a> {
    pub tables: &'a Tables,
    pub model: Model<'a>,
    pub ranking: &'a Ranking,
    /// Pixels that the maps of the first clusters will measure at full size, as far as they are
    /// known.
    pub pixels: &'a [f64],
    /// Number of clusters at the start of the ranking that are done and take no more time.
    pub finished: usize,
    pub options: &'a Options<'a>,
}

impl<'a> Cost<'a> {
    pub fn new(
        tables: &'a Tables,
        options: &'a Options<'a>,
        ranking: &'a Ranking,
        pixels: &'a [f64],
        finished: usize,
    ) -> Self {
        Self {
            tables,
            model: tables.model(),
            ranking,
            pixels,
            finished,
            options,
        }
    }

    fn cluster(&self, rank: usize) -> &ViewCluster {
        &self.tables.clusters[self.ranking.order[rank] as usize]
    }

    /// Number of pairs that the first `clusters` clusters match.
    pub fn pairs(&self, clusters: usize) -> usize {
        (0..clusters).map(|rank| self.pairs_of(rank)).sum()
    }

    /// Number of pairs that a cluster matches.
    pub fn pairs_of(&self, rank: usize) -> usize {
        if self.options.makes_maps {
            self.cluster(rank).partners.len()
        } else {
            0
        }
    }

    /// Seconds of matching; 0 for a finished cluster, `None` where the times are unset or nothing
    /// is matched.
    pub fn seconds(&self, rank: usize) -> Option<f64> {
        if !self.options.makes_maps {
            return None;
        }
        let (cluster, scale) = (self.ranking.order[rank] as usize, self.ranking.scales[rank]);
        let [full, half] = self.tables.work[cluster];
        // The times that are set are those of full size.
        let size = if scale == MapScale::Half {
            half / full
        } else {
            1.0
        };
        let one = self
            .seconds_of(1, self.cluster(rank).partners.len())
            .map(|seconds| seconds * size);
        if rank < self.finished {
            one.map(|_| 0.0)
        } else {
            one
        }
    }

    fn seconds_of(&self, maps: usize, pairs: usize) -> Option<f64> {
        let ForecastSettings {
            seconds_per_map,
            seconds_per_pair,
            ..
        } = *self.options.forecast;
        let seconds = seconds_per_map.unwrap_or(0.0) * maps as f64
            + seconds_per_pair.unwrap_or(0.0) * pairs as f64;
        self.options.forecast.knows_times().then_some(seconds)
    }

    /// Work of each map in the ranking over that of all clusters at full size, finished or not.
    pub fn works(&self) -> impl Iterator<Item = f64> {
        let share_of = self.tables.shares_of_work();
        let maps = self.ranking.order.iter().zip(&self.ranking.scales);
        maps.map(move |(&cluster, &scale)| share_of(cluster, scale))
    }

    /// Pixels that the depth map will measure.
    pub fn points(&self, rank: usize, slots: &mut BlockSlots) -> f64 {
        let known = self
            .options
            .forecast
            .points_per_map
            .or(self.pixels.get(rank).copied());
        self.of_size(
            rank,
            known.unwrap_or_else(|| expected_pixels(&self.model, self.cluster(rank), slots)),
        )
    }

    /// Number of the first `clusters` maps that are made at half the size.
    fn maps_at_half(&self, clusters: usize) -> usize {
        self.ranking.scales[..clusters]
            .iter()
            .filter(|&&scale| scale == MapScale::Half)
            .count()
    }

    fn of_size(&self, rank: usize, at_full_size: f64) -> f64 {
        self.ranking.scales[rank].factor().powi(2) * at_full_size
    }
}

pub fn forecast(cost: &Cost, clusters: usize) -> Forecast {
    let clusters_of_all = &cost.tables.clusters;
    if !cost.options.makes_maps {
        return Forecast {
            maps: clusters,
            all_maps: clusters_of_all.len(),
            ..Forecast::default()
        };
    }
    let pairs = cost.pairs(clusters);
    let all_pairs = clusters_of_all
        .iter()
        .map(|cluster| cluster.partners.len())
        .sum();
    let points = points(cost, clusters);
    Forecast {
        maps: clusters,
        pairs,
        points: points.iter().sum::<f64>().round() as u64,
        seconds: (0..clusters).map(|rank| cost.seconds(rank)).sum(),
        work: cost.works().take(clusters).sum(),
        maps_at_half: cost.maps_at_half(clusters),
        all_maps: clusters_of_all.len(),
        all_pairs,
        all_seconds: cost.seconds_of(
            clusters_of_all.len() - cost.finished,
            all_pairs - cost.pairs(cost.finished),
        ),
    }
}

/// Pixels that the depth map of each of the first `clusters` clusters will measure.
pub fn points(cost: &Cost, clusters: usize) -> Vec<f64> {
    if !cost.options.makes_maps {
        return vec![0.0; clusters];
    }
    let at_full_size = match cost.options.forecast.points_per_map {
        Some(points) => vec![points; clusters],
        None => {
            let known = &cost.pixels[..clusters.min(cost.pixels.len())];
            [known, &full_size_pixels(cost, known.len()..clusters)].concat()
        }
    };
    at_full_size
        .into_iter()
        .enumerate()
        .map(|(rank, points)| cost.of_size(rank, points))
        .collect()
}

/// Pixels that the depth maps of these ranks are expected to measure at full size.
pub fn full_size_pixels(cost: &Cost, ranks: Range<usize>) -> Vec<f64> {
    let slots = || BlockSlots::new(&cost.model);
    let mut pixels = Vec::with_capacity(ranks.len());
    for batch in Vec::from_iter(ranks).chunks(column::READ_AT_ONCE) {
        let of_rank = |slots: &mut BlockSlots, &rank: &usize| {
            expected_pixels(&cost.model, cost.cluster(rank), slots)
        };
        pixels.par_extend(batch.par_iter().map_init(slots, of_rank));
        cost.model.release();
    }
    pixels
}

/// Sums, over the covered triangles, the pixels of the matched image times the chance that they are
/// measured.
fn expected_pixels(model: &Model, cluster: &ViewCluster, slots: &mut BlockSlots) -> f64 {
    let (pose, camera) = (
        &model.scene.view(cluster.key).cam_from_world,
        model.scene.camera_of(cluster.key),
    );
    let partners: Vec<usize> = (0..cluster.partners.len()).collect();
    let chances =
        // Nothing is chosen here, so that no triangle need judge.
        Block::new(model, cluster.key, &cluster.partners, |_| false, slots).chances(&partners);
    let pixels = |(&triangle, chance): (&u32, f32)| {
        let corners = model
            .surface
            .corners(triangle)
            .map(|corner| pose.camera_from_world(&corner));
        if chance > 0.0 {
            f64::from(chance) * visibility::projected_area(camera, &corners)
        } else {
            0.0
        }
    };
    let reduced = model.rule.image_scale.powi(2);
    reduced
        * model
            .visibility
            .triangles_seen_by(cluster.key)
            .iter()
            .zip(chances)
            .map(pixels)
            .sum::<f64>()
}
