//! Forecasts the memory of each stage before it runs, and keeps it within a limit.
//!
//! A surface with more points than the limit permits is built in tiles, one after the other; tables of visibility, confidence and fulfilment that
//! don't fit are kept on disk ([`Storage`]), without effect on the result. The rest, the scene and the data of each triangle, must fit in memory:
//! otherwise planning fails before they are built. The figures per point were measured with `viewrank plan` on `boruszyn` and
//! `caliterra` (800 and 760 bytes), the others are sizes of tables and of the threads' buffers.

use serde::Serialize;

use super::PlanError;
use crate::{
    base::{
        column::{self, Storage},
        progress::Watcher,
    },
    config::{Bytes, ConfidenceSource, Settings, VisibilitySettings},
    method::{
        confidence::{MOST_PIXELS, SampleRoom},
        fulfilment::{BATCH, FulfilmentTable, block::Block},
        geometry::Geometry,
        ranking::PRICES,
        surface::{
            Surface, SurfaceError,
            refine::{MAX_TRIANGLES, RefineError, TRIANGLE_BYTES},
        },
        visibility::{self, Visibility},
    },
    model::scene::Scene,
};

/// The stage whose limit error has its own hint, since later stages are not yet forecast.
pub(super) const SURFACE: &str = "surface";
/// The stage that needs less memory without pictures.
pub(super) const PICTURES: &str = "comparison of pictures";
/// The stage that needs less memory with smaller masks.
pub(super) const MASKS: &str = "reading of masks";
const MODEL: &str = "model with its surface";
/// Bytes per pixel of the id buffer that each thread draws into.
const BUFFER_PIXEL: u64 = 8;
/// Bytes of the program and of small data.
const BASE: u64 = 100 << 20;
/// Bytes of the surface at its peak (cells, rays and the cut), per sparse point.
const SURFACE_PER_POINT: u64 = 1000;
/// Bytes of the finished surface, per sparse point: a vertex and two triangles.
const MESH_PER_POINT: u64 = 48;
/// Ratio of a tile's points including its margin to its own points, for a tile of the least size.
const OVERLAP: u64 = 2;
/// Least number of points per tile: smaller tiles are mostly margin, with almost four times the points for a tile of 10,000 (survey of 300 views).
const LEAST_TILE: u64 = 60_000;
/// Bytes of the scene per point and per observation, including the table of each view's points.
const SCENE_PER_POINT: u64 = 43;
const SCENE_PER_OBSERVATION: u64 = 24;
/// Bytes per row of the visibility table; of that and the confidence of views by themselves; of these and fulfilment.
const VISIBILITY_ROW: u64 = 4;
const UNARY_ROW: u64 = 9;
const TABLES_ROW: u64 = 17;
/// Bytes more per row where maps may have half the size: f of the half size, before and after it is blended.
const HALF_ROW: u64 = 16;
/// Bytes per row of f of the clusters that are evaluated at once.
const VALUES_ROW: u64 = 4;
/// Bytes per row of fulfilment sorted by triangle, for the ranking.
const BY_TRIANGLE_ROW: u64 = 8;
/// Bytes per row of visibility while pictures are compared; the result has one byte per candidate.
const SAMPLES_ROW: u64 = 196;
/// Bytes of these samples that are kept in memory: beyond that, the system's cache of the file is as fast while memory is free.
const MOST_SAMPLES: u64 = 1 << 30;
/// Bytes per pixel of a picture while it is decoded, its file included: a progressive JPEG or a PNG with 16 bits a channel.
const PICTURE_PIXEL: u64 = 8;
/// Views per thread that are sampled per batch, so that threads rarely wait for the last of them.
const VIEWS_PER_THREAD: u64 = 16;
/// Bytes per triangle for confidence and reasons: what is shown of it, its nearest points, its factors and its f so far.
const PER_TRIANGLE: u64 = 116;
/// Bytes per triangle and thread: its row in the current view.
const ROW_INDEX: u64 = 4;
/// Bytes per sparse point while contradictions and nearest points are computed; and per point and thread, whether it is observed.
const PER_POINT: u64 = 5;
const OBSERVED: u64 = 1;
/// Bytes per row of fulfilment for its belief, updated by failures of other maps, and for the new f at both sizes.
const BELIEF_ROW: u64 = 40;
/// Samples of views and triangles from which the rows of visibility are estimated.
const SAMPLED_VIEWS: usize = 32;
const SAMPLED_TRIANGLES: usize = 20_000;

/// Forecast bytes at the peak of each stage, including everything already in memory; 0 where a stage has not begun.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Memory {
    pub read: u64,
    pub surface: u64,
    pub visibility: u64,
    /// Masks and comparison of pictures; 0 if none had to be read.
    pub confidence: u64,
    /// Partners, fulfilment and ranking.
    pub partners: u64,
    /// Tables on disk; 0 if they fit in memory.
    pub disk: u64,
    #[serde(skip)]
    basis: Basis,
}

/// Limits, and what the forecast is made from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Basis {
    limit: Option<Bytes>,
    /// Bytes beyond which planning fails ([`Watcher::most_memory`]).
    most: Option<u64>,
    /// Bytes of tables for each row of visibility.
    row: u64,
    /// And of samples of its picture, until pairs are compared.
    samples_row: u64,
    /// Candidates whose columns a thread holds while it chooses partners.
    candidates: u64,
    /// Threads that choose partners at once.
    choosers: u64,
    /// Bytes for the largest picture alone; 0 if none is compared.
    picture: u64,
    /// Bytes per triangle while clusters are ranked at several prices at once.
    ranked: u64,
    /// Bytes held while clusters are ranked, besides what the ranking itself takes.
    tables: u64,
}

impl Basis {
    fn new(scene: &Scene, settings: &Settings, pixels: u64, most: Option<u64>) -> Self {
        let compared = settings.confidence.source == ConfidenceSource::Photometric;
        let (views, threads) = (scene.views.len() as u64, rayon::current_num_threads() as u64);
        let where_true = |is_true, bytes| if is_true { bytes } else { 0 };
        let has_half = settings.ranking.has_half();
        let candidates = u64::from(settings.partners.candidates).min(views.saturating_sub(1));
        let support = u64::from(settings.ranking.support.unwrap_or_default());
        Self {
            limit: settings.max_memory,
            most,
            row: TABLES_ROW + where_true(compared, candidates) + where_true(has_half, HALF_ROW),
            samples_row: where_true(compared, SAMPLES_ROW),
            candidates,
            choosers: threads.min(views).min(BATCH as u64),
            picture: where_true(compared, PICTURE_PIXEL * pixels.min(MOST_PIXELS)),
            ranked: where_true(has_half, threads.min(u64::from(PRICES) + 1) * size_of::<f32>() as u64 * support),
            tables: 0,
        }
    }

    /// Returns whether this is within the limit.
    fn fits(&self, need: u64) -> bool {
        self.limit.is_none_or(|Bytes(limit)| need <= limit)
    }

    /// Bytes of samples of pictures that memory may hold; more are kept on disk.
    fn most_samples(&self) -> u64 {
        self.limit.map_or(MOST_SAMPLES, |Bytes(limit)| MOST_SAMPLES.min(limit / 8))
    }

    /// Returns the memory of tables at the peak: while pictures are compared, partners are chosen, or clusters are ranked.
    fn in_memory(&self, rows: Rows, triangles: u64) -> u64 {
        let samples = self.most_samples().min(self.samples_row * rows.all);
        let ranking = BY_TRIANGLE_ROW * rows.all + self.ranked * triangles;
        self.row * rows.all + samples.max(self.blocks(rows)).max(ranking)
    }

    /// Returns the same for tables on disk, of which only new rows are in memory.
    fn batches(&self, rows: Rows, triangles: u64) -> u64 {
        let at_once = rows.at_once();
        (self.row * at_once).max(self.blocks(rows) + VALUES_ROW * at_once).max(self.ranked * triangles)
    }

    /// Returns the memory of all threads while partners are chosen.
    fn blocks(&self, rows: Rows) -> u64 {
        self.choosers * Block::bytes(rows.most, self.candidates)
    }
}

/// Rows of visibility.
#[derive(Clone, Copy)]
struct Rows {
    all: u64,
    /// Rows of the view with the most.
    most: u64,
    views: u64,
}

impl Rows {
    fn of(scene: &Scene, visibility: &Visibility) -> Self {
        let most = scene.view_indices().map(|view| visibility.rows(view).len()).max().unwrap_or_default();
        Self { all: visibility.triangles.len() as u64, most: most as u64, views: scene.views.len() as u64 }
    }

    /// Rows that are read between two releases of a table on disk.
    fn at_once(self) -> u64 {
        (self.all * self.views.min(column::READ_AT_ONCE as u64)).div_ceil(self.views.max(1))
    }
}

impl Memory {
    /// Forecasts the surface; sets a tile size in the settings if it is too large. `pixels`: of the largest picture that can be read.
    pub(super) fn before_surface(
        scene: &Scene,
        settings: &mut Settings,
        pixels: u64,
        watcher: &dyn Watcher,
    ) -> Result<Self, PlanError> {
        let points = scene.points.len() as u64;
        let held = BASE + SCENE_PER_POINT * points + SCENE_PER_OBSERVATION * scene.observations() as u64;
        let basis = Basis::new(scene, settings, pixels, watcher.most_memory());
        let mut memory = Self { read: held, basis, ..Self::default() };
        let finished = held + MESH_PER_POINT * points;
        if let (None, None, Some(limit)) = (&settings.surface.mesh, settings.surface.tile_points, basis.limit)
            && held + SURFACE_PER_POINT * points > limit.0
        {
            let tile = limit.0.saturating_sub(finished) / SURFACE_PER_POINT / OVERLAP;
            settings.surface.tile_points = Some(u32::try_from(tile.max(LEAST_TILE)).unwrap_or(u32::MAX));
        }
        let at_once = match (&settings.surface.mesh, settings.surface.tile_points) {
            (Some(_), _) => 0,
            (None, Some(tile)) => points.min(OVERLAP * u64::from(tile)),
            (None, None) => points,
        };
        memory.surface = (held + SURFACE_PER_POINT * at_once).max(finished);
        memory.check_limit(SURFACE, memory.surface)?;
        Ok(memory)
    }

    /// Maximum number of triangles while the surface is refined.
    pub(super) fn most_triangles(&self) -> u64 {
        let Basis { limit, most, .. } = self.basis;
        let least = limit.map(|Bytes(limit)| limit).into_iter().chain(most).min();
        least.map_or(MAX_TRIANGLES, |limit| self.triangles_within(limit))
    }

    fn triangles_within(&self, limit: u64) -> u64 {
        MAX_TRIANGLES.min(limit.saturating_sub(self.read) / TRIANGLE_BYTES)
    }

    /// Returns the error of a surface that was not refined for want of memory: how much it needs, if more could be allowed.
    pub(super) fn too_fine(&self, error: SurfaceError) -> PlanError {
        match error {
            SurfaceError::Refine(RefineError::TooFine { triangles, .. }) if triangles <= MAX_TRIANGLES as f64 => {
                let need = self.read + triangles.ceil() as u64 * TRIANGLE_BYTES;
                self.check_limit(SURFACE, need).err().unwrap_or(error.into())
            }
            error => error.into(),
        }
    }

    /// Returns what decides, under a limit, whether the surface can be built and where its tables are kept.
    pub(super) fn inputs(&self) -> impl Serialize {
        let Basis { limit, row, samples_row, candidates, ranked, .. } = self.basis;
        let threads = rayon::current_num_threads();
        limit.map(|limit| (limit, self.triangles_within(limit.0), row, samples_row, candidates, ranked, threads))
    }

    pub(super) fn before_visibility(
        &mut self,
        scene: &Scene,
        surface: &Surface,
        settings: &VisibilitySettings,
    ) -> Result<Storage, PlanError> {
        let (threads, points) = (rayon::current_num_threads() as u64, scene.points.len() as u64);
        let threads = threads.min(scene.views.len() as u64);
        let triangles = surface.triangles.len() as u64;
        let buffer = visibility::picture_pixels(scene, settings) * BUFFER_PIXEL + ROW_INDEX * triangles;
        let rows = expected_rows(scene, surface);
        let drawing = self.read + 2 * bytes(surface) + PER_POINT * points + threads * buffer;
        let held = self.read + bytes(surface) + self.outside_tables(points, triangles);
        let basis = &self.basis;
        if basis.fits(drawing + VISIBILITY_ROW * rows.all) && basis.fits(held + basis.in_memory(rows, triangles)) {
            self.visibility = drawing + VISIBILITY_ROW * rows.all;
            // The rest is forecast from the real rows, which occlusion makes fewer.
            self.check_limit(MODEL, self.visibility)?;
            return Ok(Storage::Memory);
        }
        self.visibility = drawing + VISIBILITY_ROW * rows.at_once();
        self.partners = held + basis.batches(rows, triangles);
        self.disk = (basis.row + basis.samples_row.max(BY_TRIANGLE_ROW)) * rows.all;
        self.check_limit(MODEL, self.visibility.max(self.partners))?;
        Ok(Storage::Disk)
    }

    /// Takes visibility that an earlier plan has kept: nothing is drawn.
    pub(super) fn with_visibility(&mut self, surface: &Surface, visibility: &Visibility) {
        self.visibility = self.read + bytes(surface) + VISIBILITY_ROW * visibility.triangles.len() as u64;
    }

    /// Forecasts partners and fulfilment from the real number of rows.
    pub(super) fn before_partners(
        &mut self,
        scene: &Scene,
        surface: &Surface,
        visibility: &Visibility,
    ) -> Result<(), PlanError> {
        let (points, triangles) = (scene.points.len() as u64, surface.triangles.len() as u64);
        let rows = Rows::of(scene, visibility);
        let held = self.read + bytes(surface) + self.outside_tables(points, triangles);
        let basis = &mut self.basis;
        (basis.tables, self.partners) = match visibility.triangles.storage() {
            Storage::Memory => (held + basis.row * rows.all, held + basis.in_memory(rows, triangles)),
            Storage::Disk => (held, held + basis.batches(rows, triangles)),
        };
        self.check_limit("fulfilment table", self.partners)
    }

    /// Forecasts the reading of masks; returns the number of views whose masks are read at once, at least 1. `of_mask`: bytes for the largest one.
    pub(super) fn before_masks(&mut self, geometry: &Geometry, of_mask: u64) -> Result<usize, PlanError> {
        let views = geometry.scene.views.len() as u64;
        let threads = (rayon::current_num_threads() as u64).min(views);
        let held = self.held_by_unary(geometry);
        let need = |views: u64| held + views * of_mask;
        let views_at_once = (1..=threads).rev().find(|&views| self.basis.fits(need(views))).unwrap_or(1);
        self.confidence = self.confidence.max(need(views_at_once));
        self.check_limit(MASKS, need(views_at_once))?;
        Ok(if views_at_once == threads { column::READ_AT_ONCE } else { views_at_once as usize })
    }

    /// Forecasts the sampling of pictures, of fewer views at once if need be.
    pub(super) fn before_pictures(&mut self, geometry: &Geometry) -> Result<SampleRoom, PlanError> {
        let Geometry { scene, visibility, .. } = *geometry;
        let (threads, rows) = (rayon::current_num_threads() as u64, visibility.triangles.len() as u64);
        let of_view = (UNARY_ROW + SAMPLES_ROW) * Rows::of(scene, visibility).most;
        let (tables_keep, samples) = (visibility.triangles.storage(), SAMPLES_ROW * rows);
        let keep = if samples <= self.basis.most_samples() { tables_keep } else { Storage::Disk };
        let held = self.held_by_unary(geometry) + if keep == Storage::Memory { samples } else { 0 };
        // Each thread's allocator also holds back about what its last view took.
        let need = |views: u64| held + (views + views.min(threads)) * of_view + views.min(threads) * self.basis.picture;
        let most = (MOST_SAMPLES / of_view.max(1)).clamp(threads, VIEWS_PER_THREAD * threads);
        let most = most.min(column::READ_AT_ONCE as u64).min(scene.views.len() as u64);
        let views_at_once = (1..=most).rev().find(|&views| self.basis.fits(need(views))).unwrap_or(1);
        let sampling = need(views_at_once);
        self.confidence = self.confidence.max(sampling);
        self.check_limit(PICTURES, sampling)?;
        if (tables_keep, keep) == (Storage::Memory, Storage::Disk) {
            self.disk = samples;
        }
        Ok(SampleRoom { keep, views_at_once: views_at_once as usize })
    }

    /// Returns the memory of model, surface, and tables up to the confidence of views by themselves.
    fn held_by_unary(&self, geometry: &Geometry) -> u64 {
        let Geometry { scene, surface, visibility, .. } = *geometry;
        let tables = match visibility.triangles.storage() {
            Storage::Memory => UNARY_ROW * visibility.triangles.len() as u64,
            Storage::Disk => 0,
        };
        let outside = self.outside_tables(scene.points.len() as u64, surface.triangles.len() as u64);
        self.read + bytes(surface) + outside + tables
    }

    /// Returns the memory of points and triangles while partners are chosen.
    fn outside_tables(&self, points: u64, triangles: u64) -> u64 {
        let threads = rayon::current_num_threads() as u64;
        (PER_POINT + threads * OBSERVED) * points + (PER_TRIANGLE + threads * ROW_INDEX) * triangles
    }

    /// Checks the belief about each row of fulfilment, which a plan around finished depth maps keeps in memory.
    pub(crate) fn before_beliefs(&self, fulfilment: &FulfilmentTable) -> Result<(), PlanError> {
        self.check_limit("table of failures", self.basis.tables + BELIEF_ROW * fulfilment.triangles.len() as u64)
    }

    /// Returns an error if `need` exceeds a limit. The size of the largest picture is known before any stage, so the limit that the error advises allows
    /// for it.
    fn check_limit(&self, stage: &'static str, need: u64) -> Result<(), PlanError> {
        let Basis { limit, most, picture, .. } = self.basis;
        let with_picture = need.max(self.read + picture);
        match (limit, most) {
            (Some(Bytes(limit)), _) if need > limit => Err(PlanError::Memory { stage, need, limit, with_picture }),
            (_, Some(most)) if need > most => Err(PlanError::Refused { stage, need, most, with_picture }),
            _ => Ok(()),
        }
    }

    /// Maximum size of the tables on disk, formatted as "1.5G"; `None` if they fit in memory.
    pub fn on_disk(&self) -> Option<String> {
        (self.disk > 0).then(|| readable(self.disk))
    }

    /// Peak over all stages, bytes.
    pub fn peak(&self) -> u64 {
        self.read.max(self.surface).max(self.visibility).max(self.confidence).max(self.partners)
    }
}

fn bytes(surface: &Surface) -> u64 {
    (size_of_val(&*surface.vertices) + size_of_val(&*surface.triangles)) as u64
}

/// Estimates the rows of visibility without occlusion: triangles that face a view and have their centroid in its image, on a sample.
fn expected_rows(scene: &Scene, surface: &Surface) -> Rows {
    let (views, triangles) = (scene.views.len(), surface.triangles.len());
    let sampled_views = || scene.view_indices().step_by(views.div_ceil(SAMPLED_VIEWS).max(1));
    let sampled = || (0..triangles as u32).step_by(triangles.div_ceil(SAMPLED_TRIANGLES).max(1));
    let in_view = |view| {
        let (camera, pose) = (scene.camera_of(view), &scene.view(view).cam_from_world);
        let centre = pose.centre();
        let shown = |&t: &u32| {
            let centroid = surface.centroid(t);
            surface.area_normal(t).dot(&(centre - centroid)) > 0.0
                && camera.project(&pose.camera_from_world(&centroid)).is_some_and(|pixel| camera.contains(&pixel))
        };
        sampled().filter(shown).count()
    };
    let found: Vec<usize> = sampled_views().map(in_view).collect();
    let of_triangles = |found: usize| found as f64 * triangles as f64 / sampled().count().max(1) as f64;
    let all = of_triangles(found.iter().sum()) * views as f64 / found.len().max(1) as f64;
    let most = of_triangles(found.iter().copied().max().unwrap_or_default());
    Rows { all: all.ceil() as u64, most: most.ceil() as u64, views: views as u64 }
}

/// Formats a limit at least 5 % above the need, rounded up, as "120M" or "1.6G".
pub(super) fn enough(need: u64) -> String {
    let mebibytes = (need as f64 * 1.05 / f64::from(1 << 20)).ceil() as u64;
    let unit = 10u64.pow(mebibytes.max(10).ilog10() - 1);
    match mebibytes.next_multiple_of(unit) {
        small @ ..1024 => format!("{small}M"),
        large => format!("{:.1}G", (large as f64 / 1024.0 * 10.0).ceil() / 10.0),
    }
}

/// Formats bytes as "1.5G", "20M" or "300 bytes", rounded up: a need above a limit must not read the same.
pub(super) fn readable(bytes: u64) -> String {
    in_units(bytes, f64::ceil)
}

/// The same for a limit, rounded down.
pub(super) fn readable_limit(bytes: u64) -> String {
    in_units(bytes, f64::floor)
}

fn in_units(bytes: u64, round: impl Fn(f64) -> f64) -> String {
    match bytes as f64 / 1024f64.powi(3) {
        gibibytes if gibibytes >= 1.0 => format!("{:.1}G", round(10.0 * gibibytes) / 10.0),
        gibibytes if bytes >= 1 << 20 => format!("{:.0}M", round(1024.0 * gibibytes)),
        _ => format!("{bytes} bytes"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        base::progress::NoWatcher,
        config::TargetSettings,
        method::synthetic::{SeenTown, Town},
    };

    /// Views at once, and the forecast, for pictures of a megapixel.
    fn pictures(town: &SeenTown, limit: Option<u64>) -> Result<(SampleRoom, Memory), PlanError> {
        let mut settings = Settings { max_memory: limit.map(Bytes), ..Settings::default() };
        let mut memory = Memory::before_surface(&town.scene, &mut settings, 1_000_000, &NoWatcher)?;
        let room = memory.before_pictures(&town.geometry(1.0))?;
        Ok((room, memory))
    }

    fn town(keep: Storage) -> SeenTown {
        Town { edge: 1.0, ..Town::default() }.seen(&TargetSettings::default(), 0.05, keep)
    }

    #[test]
    fn a_limit_lets_fewer_pictures_be_sampled_at_once_but_not_none() {
        let town = town(Storage::Memory);
        let at_once = |limit| pictures(&town, Some(limit)).map(|(room, _)| room.views_at_once as u64);
        let (room, memory) = pictures(&town, None).unwrap();
        let (most, need) = (room.views_at_once as u64, memory.confidence);
        let wanted = VIEWS_PER_THREAD * rayon::current_num_threads() as u64;
        assert_eq!(most, wanted.min(column::READ_AT_ONCE as u64).min(town.scene.views.len() as u64));
        let samples = SAMPLES_ROW * town.visibility.triangles.len() as u64;
        // By bisection: the least limit that is enough for a single picture.
        let (mut too_little, mut enough) = (0, need + 8 * samples);
        while enough - too_little > 1 {
            let middle = (too_little + enough) / 2;
            if at_once(middle).is_ok() { enough = middle } else { too_little = middle }
        }
        assert_eq!(at_once(enough).unwrap(), 1);
        assert!(matches!(at_once(too_little), Err(PlanError::Memory { .. })));
        let more: Vec<u64> = (0..20).map(|step| at_once(enough + step * samples).unwrap()).collect();
        assert!(more.is_sorted() && more[19] == most, "{more:?}");
    }

    #[test]
    fn a_limit_lets_fewer_masks_be_read_at_once_but_not_none() {
        const OF_MASK: u64 = 5_000_000;
        let town = town(Storage::Memory);
        let masks = |limit: Option<u64>| {
            let mut settings = Settings { max_memory: limit.map(Bytes), ..Settings::default() };
            let mut memory = Memory::before_surface(&town.scene, &mut settings, 0, &NoWatcher)?;
            let views_at_once = memory.before_masks(&town.geometry(1.0), OF_MASK)?;
            Ok::<_, PlanError>((views_at_once, memory.confidence))
        };
        let pool = |threads| rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let (views_at_once, for_one) = pool(1).install(|| masks(None)).unwrap();
        assert_eq!(views_at_once, column::READ_AT_ONCE, "one thread");
        pool(4).install(|| {
            let (views_at_once, for_four) = masks(None).unwrap();
            assert_eq!(views_at_once, column::READ_AT_ONCE);
            assert!(for_four - for_one >= 3 * OF_MASK);
            assert_eq!(masks(Some(for_four)).unwrap(), (column::READ_AT_ONCE, for_four));
            assert_eq!(masks(Some(for_four - 1)).unwrap(), (3, for_four - OF_MASK));
            assert_eq!(masks(Some(for_four - 3 * OF_MASK)).unwrap(), (1, for_four - 3 * OF_MASK));
            assert!(matches!(masks(Some(for_four - 3 * OF_MASK - 1)), Err(PlanError::Memory { stage: MASKS, .. })));
        });
    }

    #[test]
    fn samples_take_memory_only_where_they_are_kept() {
        let [in_memory, on_disk] = [Storage::Memory, Storage::Disk].map(town);
        let samples = SAMPLES_ROW * in_memory.visibility.triangles.len() as u64;
        let (room, memory) = pictures(&in_memory, None).unwrap();
        assert_eq!((room.keep, memory.disk), (Storage::Memory, 0));
        // They follow the other tables.
        let (room, with_tables) = pictures(&on_disk, None).unwrap();
        assert_eq!(room.keep, Storage::Disk);
        assert!(memory.confidence - with_tables.confidence > samples);
        // They go to disk alone above an eighth of the limit.
        let (room, alone) = pictures(&in_memory, Some(8 * samples)).unwrap();
        assert_eq!((room.keep, alone.disk), (Storage::Memory, 0));
        let (room, alone) = pictures(&in_memory, Some(8 * samples - 1)).unwrap();
        assert_eq!((room.keep, alone.disk), (Storage::Disk, samples));
    }

    #[test]
    fn a_limit_that_is_too_small_for_the_surface_is_answered_with_one_for_the_largest_picture() {
        let town = town(Storage::Memory);
        let refused = |pixels, source| {
            let mut settings = Settings { max_memory: Some(Bytes(1)), ..Settings::default() };
            settings.confidence.source = source;
            match Memory::before_surface(&town.scene, &mut settings, pixels, &NoWatcher) {
                Err(PlanError::Memory { stage: SURFACE, need, with_picture, .. }) => [need, with_picture],
                other => panic!("{other:?}"),
            }
        };
        let small = refused(1000, ConfidenceSource::Photometric);
        assert_eq!(small[0], small[1]);
        let large = refused(100_000_000, ConfidenceSource::Photometric);
        assert!(large[0] == small[0] && large[1] > small[1] + 700_000_000, "{large:?}");
        assert_eq!(refused(100_000_000, ConfidenceSource::Geometric), small);
    }

    /// Permits a number of bytes.
    struct Permits(u64);

    impl Watcher for Permits {
        fn progress(&self, _: crate::base::progress::Stage, _: u64, _: u64) {}

        fn most_memory(&self) -> Option<u64> {
            Some(self.0)
        }
    }

    #[test]
    fn what_a_run_may_take_refuses_but_changes_nothing() {
        let SeenTown { scene, surface, visibility, .. } = town(Storage::Memory);
        // Partners take most with a small buffer, visibility with a large one.
        let peaks = [16, 4096].map(|buffer_px| {
            let original = Settings {
                visibility: VisibilitySettings { buffer_px, ..VisibilitySettings::default() },
                ..Settings::default()
            };
            let after_all = |most| {
                let mut settings = original.clone();
                let mut memory = Memory::before_surface(&scene, &mut settings, 0, &Permits(most))?;
                let keep = memory.before_visibility(&scene, &surface, &settings.visibility)?;
                memory.before_partners(&scene, &surface, &visibility)?;
                assert_eq!((settings, keep), (original.clone(), Storage::Memory));
                Ok(memory)
            };
            let peak = after_all(u64::MAX).unwrap().peak();
            let refused = after_all(peak - 1);
            assert!(matches!(refused, Err(PlanError::Refused { .. })), "{refused:?}");
            after_all(peak).unwrap()
        });
        assert!(peaks[0].peak() > peaks[0].visibility && peaks[1].peak() == peaks[1].visibility, "{peaks:?}");
    }

    #[test]
    fn a_limit_that_is_enough_is_easily_read() {
        let cases = [(100, "110M"), (112, "120M"), (195, "210M"), (970, "1.1G"), (2048, "2.2G"), (40_000, "41.1G")];
        cases.into_iter().for_each(|(need, limit)| assert_eq!(enough(need << 20), limit));
        assert!((1..5000u64).all(|mebibytes| enough(mebibytes << 20).parse::<Bytes>().unwrap().0 >= mebibytes << 20));
    }
}
