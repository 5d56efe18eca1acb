//! Limits of memory, and what the forecast of tables is made from.

use super::rows::Rows;
use crate::{
    base::pixels::PixelBound,
    config::{Bytes, ConfidenceSource, Settings},
    method::{
        fulfilment::{BATCH, block::Block},
        pilot,
        ranking::{PRICES, Redrawing},
    },
    model::scene::Scene,
};

/// Bytes per row of the visibility table; of that and the confidence of views by themselves; of
/// these and fulfilment.
pub const VISIBILITY_ROW: u64 = 4;
pub const UNARY_ROW: u64 = 9;
const TABLES_ROW: u64 = 17;
/// Bytes more per row where maps may have half the size: f of the half size, before and after it is
/// blended.
const HALF_ROW: u64 = 16;
/// Bytes per row of f of the clusters that are evaluated at once.
pub const VALUES_ROW: u64 = 4;
/// Bytes per row of fulfilment sorted by triangle, for the ranking.
pub const BY_TRIANGLE_ROW: u64 = 8;
/// Bytes per row of visibility while pictures are compared; the result has one byte per candidate.
pub const SAMPLES_ROW: u64 = 196;
/// Bytes of these samples that are kept in memory: beyond that, the system's cache of the file is
/// as fast while memory is free.
pub const MOST_SAMPLES: u64 = 1 << 30;
/// Bytes per pixel of a picture while it is decoded, its file included: a progressive JPEG or a PNG
/// with 16 bits a channel.
const PICTURE_PIXEL: u64 = 8;

/// Limits, and what the forecast is made from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Basis {
    pub limit: Option<Bytes>,
    /// Bytes beyond which planning fails
    /// ([`most_memory`](crate::base::progress::Watcher::most_memory)).
    pub most: Option<u64>,
    /// Bytes of tables for each row of visibility.
    pub row: u64,
    /// And of samples of its picture, until pairs are compared.
    pub samples_row: u64,
    /// Candidates whose columns a thread holds while it chooses partners.
    pub candidates: u64,
    /// Threads that choose partners at once.
    choosers: u64,
    /// Bytes for the largest picture alone; 0 if none is compared.
    pub picture: u64,
    /// Bytes of the pilot besides the tables; 0 if no thumbnails are matched.
    pub pilot: u64,
    /// Bytes per triangle while clusters are ranked at several prices at once.
    pub ranked: u64,
    /// True if the images themselves are ranked, by what they draw (method 5.10).
    pub redrawn: bool,
}

impl Basis {
    /// `pixels`: of the largest picture; `most`: see the field. `makes_maps`: false if the images
    /// themselves are ranked.
    pub fn new(
        scene: &Scene,
        settings: &Settings,
        pixels: u64,
        makes_maps: bool,
        most: Option<u64>,
    ) -> Self {
        let compared = settings.confidence.source == ConfidenceSource::Photometric;
        let (views, threads) = (
            scene.views.len() as u64,
            rayon::current_num_threads() as u64,
        );
        let where_true = |is_true, bytes| if is_true { bytes } else { 0 };
        let has_half = settings.ranking.has_half();
        let candidates = u64::from(settings.partners.candidates).min(views.saturating_sub(1));
        let support = u64::from(settings.ranking.support.unwrap_or_default());
        let picture = where_true(compared, PICTURE_PIXEL * PixelBound::new(pixels).pixels());
        // Of all views, of one that is matched, and of the places afterwards.
        let [of_all, of_one, of_places] = pilot::bytes(scene);
        let has_pilot = makes_maps && (compared || settings.pilot.maps.is_some());
        Self {
            limit: settings.max_memory,
            most,
            row: TABLES_ROW + where_true(compared, candidates) + where_true(has_half, HALF_ROW),
            samples_row: where_true(compared, SAMPLES_ROW),
            candidates,
            // Clusters go in batches: threads beyond the clusters of a batch are idle.
            choosers: threads.min(views).min(BATCH as u64),
            picture,
            pilot: where_true(
                has_pilot,
                // Thumbnails are gone when places are found; a thread decodes or matches, not both.
                of_places.max(of_all + threads * of_one.max(picture)),
            ),
            redrawn: !makes_maps,
            // Each price that is tried at once holds the `support` largest f of every triangle.
            ranked: where_true(
                has_half,
                threads.min(u64::from(PRICES) + 1) * size_of::<f32>() as u64 * support,
            ),
        }
    }

    /// Returns whether this is within the limit.
    pub fn fits(&self, need: u64) -> bool {
        self.limit.is_none_or(|Bytes(limit)| need <= limit)
    }

    /// Bytes of samples of pictures that memory may hold; more are kept on disk.
    pub fn most_samples(&self) -> u64 {
        self.limit
            .map_or(MOST_SAMPLES, |Bytes(limit)| MOST_SAMPLES.min(limit / 8))
    }

    /// Returns the memory of tables at the peak: while pictures are compared, partners are chosen,
    /// or clusters are ranked.
    pub fn in_memory(&self, rows: Rows, triangles: u64) -> u64 {
        let samples = self.most_samples().min(self.samples_row * rows.all);
        let ranking = BY_TRIANGLE_ROW * rows.all + self.ranked * triangles;
        let ranking = ranking.max(self.redrawing(rows, triangles));
        self.row * rows.all + samples.max(self.blocks(rows)).max(ranking)
    }

    /// Returns the same for tables on disk, of which only new rows are in memory.
    pub fn batches(&self, rows: Rows, triangles: u64) -> u64 {
        let at_once = rows.at_once();
        (self.row * at_once)
            .max(self.blocks(rows) + VALUES_ROW * at_once)
            .max(self.ranked * triangles)
            .max(self.redrawing(rows, triangles))
    }

    /// Returns the memory of what images show, while they are ranked by what they draw.
    fn redrawing(&self, rows: Rows, triangles: u64) -> u64 {
        if self.redrawn {
            Redrawing::bytes(rows.all, triangles)
        } else {
            0
        }
    }

    /// Returns the memory of all threads while partners are chosen.
    fn blocks(&self, rows: Rows) -> u64 {
        self.choosers * Block::bytes(rows.most, self.candidates)
    }
}
