//! Forecasts the memory of each stage before it runs, and keeps it within a limit.
//!
//! A surface with more points than the limit permits is built in tiles, one after the other; tables
//! of visibility, confidence and fulfilment that don't fit are kept on disk ([`Storage`]), without
//! effect on the result. The rest, the scene and the data of each triangle, must fit in memory:
//! otherwise planning fails before they are built. The figures per point were measured with
//! `viewrank plan` on `boruszyn` and `caliterra` (800 and 760 bytes), the others are sizes of
//! tables and of the threads' buffers.

mod basis;
mod rows;
#[cfg(test)]
mod tests;

use serde::Serialize;

use self::{
    basis::{
        BY_TRIANGLE_ROW, Basis, MOST_SAMPLES, SAMPLES_ROW, UNARY_ROW, VALUES_ROW, VISIBILITY_ROW,
    },
    rows::Rows,
};
use super::PlanError;
use crate::{
    base::{
        column::{self, Storage},
        progress::Watcher,
    },
    config::{Bytes, Settings, VisibilitySettings},
    method::{
        confidence::SampleRoom,
        fulfilment::FulfilmentTable,
        geometry::Geometry,
        surface::{
            SurfaceError,
            refine::{MAX_TRIANGLES, RefineError, TRIANGLE_BYTES},
        },
        visibility::{self, Visibility},
    },
    model::{scene::Scene, surface::Surface},
};

/// The stage whose limit error has its own hint, since later stages are not yet forecast.
pub(super) const SURFACE: &str = "surface";
/// The stage that needs less memory without pictures.
pub(super) const PICTURES: &str = "comparison of pictures";
/// The stage that needs none without pictures.
pub(super) const PILOT: &str = "pilot";
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
/// Least number of points per tile: smaller tiles are mostly margin, with almost four times the
/// points for a tile of 10,000 (survey of 300 views).
const LEAST_TILE: u64 = 60_000;
/// Bytes of the scene per point and per observation, including the table of each view's points.
const SCENE_PER_POINT: u64 = 43;
const SCENE_PER_OBSERVATION: u64 = 24;
/// Views per thread that are sampled per batch, so that threads rarely wait for the last of them.
const VIEWS_PER_THREAD: u64 = 16;
/// Bytes per triangle for confidence and reasons: what is shown of it, its nearest points, its
/// factors and its f so far.
const PER_TRIANGLE: u64 = 116;
/// Bytes per triangle and thread: its row in the current view.
const ROW_INDEX: u64 = 4;
/// Bytes per sparse point while contradictions and nearest points are computed; and per point and
/// thread, whether it is observed.
const PER_POINT: u64 = 5;
const OBSERVED: u64 = 1;
/// Bytes per row of fulfilment for its belief, updated by failures of other maps, and for the new f
/// at both sizes.
const BELIEF_ROW: u64 = 40;

/// Forecast bytes at the peak of each stage, including everything already in memory; 0 where a
/// stage has not begun.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Memory {
    pub read: u64,
    pub surface: u64,
    pub visibility: u64,
    /// Masks and comparison of pictures; 0 if none had to be read.
    pub confidence: u64,
    /// Partners, fulfilment and ranking.
    pub partners: u64,
    /// Thumbnails with their maps, then the places; 0 if none are matched.
    pub pilot: u64,
    /// Tables on disk; 0 if they fit in memory.
    pub disk: u64,
    #[serde(skip)]
    basis: Basis,
    /// Bytes held while clusters are ranked, besides what the ranking itself takes.
    #[serde(skip)]
    tables: u64,
}

impl Memory {
    /// Forecasts the surface; sets a tile size in the settings if it is too large. `pixels`: of the
    /// largest picture that can be read. `makes_maps`: false if the images themselves are ranked.
    pub(super) fn before_surface(
        scene: &Scene,
        settings: &mut Settings,
        pixels: u64,
        makes_maps: bool,
        watcher: &dyn Watcher,
    ) -> Result<Self, PlanError> {
        let points = scene.points.len() as u64;
        let held =
            BASE + SCENE_PER_POINT * points + SCENE_PER_OBSERVATION * scene.observations() as u64;
        let basis = Basis::new(scene, settings, pixels, makes_maps, watcher.most_memory());
        let mut memory = Self {
            read: held,
            basis,
            ..Self::default()
        };
        let finished = held + MESH_PER_POINT * points;
        if let (None, None, Some(limit)) = (
            &settings.surface.mesh,
            settings.surface.tile_points,
            basis.limit,
        ) && held + SURFACE_PER_POINT * points > limit.0
        {
            // The finished surface stays in memory while tiles are built.
            let tile = limit.0.saturating_sub(finished) / SURFACE_PER_POINT / OVERLAP;
            settings.surface.tile_points =
                // If the limit is too low even for these tiles, the check below refuses it.
                Some(u32::try_from(tile.max(LEAST_TILE)).unwrap_or(u32::MAX));
        }
        let at_once = match (&settings.surface.mesh, settings.surface.tile_points) {
            // A given mesh takes no cells, rays and cut.
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
        let least = limit
            .map(|Bytes(limit)| limit)
            .into_iter()
            .chain(most)
            .min();
        least.map_or(MAX_TRIANGLES, |limit| self.triangles_within(limit))
    }

    fn triangles_within(&self, limit: u64) -> u64 {
        MAX_TRIANGLES.min(limit.saturating_sub(self.read) / TRIANGLE_BYTES)
    }

    /// Returns the error of a surface that was not refined for want of memory: how much it needs,
    /// if more could be allowed.
    pub(super) fn too_fine(&self, error: SurfaceError) -> PlanError {
        match error {
            SurfaceError::Refine(RefineError::TooFine { triangles, .. })
                if triangles <= MAX_TRIANGLES as f64 =>
            {
                let need = self.read + triangles.ceil() as u64 * TRIANGLE_BYTES;
                self.check_limit(SURFACE, need)
                    .err()
                    .unwrap_or(error.into())
            }
            error => error.into(),
        }
    }

    /// Returns what decides, under a limit, whether the surface can be built and where its tables
    /// are kept.
    pub(super) fn inputs(&self) -> impl Serialize {
        let Basis {
            limit,
            row,
            samples_row,
            candidates,
            ranked,
            redrawn,
            pilot,
            ..
        } = self.basis;
        let threads = rayon::current_num_threads();
        // Without a limit none of this decides, and a cached surface holds on any number of
        // threads.
        limit.map(|limit| {
            (
                limit,
                self.triangles_within(limit.0),
                row,
                samples_row,
                candidates,
                ranked,
                redrawn,
                pilot,
                threads,
            )
        })
    }

    pub(super) fn before_visibility(
        &mut self,
        scene: &Scene,
        surface: &Surface,
        settings: &VisibilitySettings,
    ) -> Result<Storage, PlanError> {
        let (threads, points) = (
            rayon::current_num_threads() as u64,
            scene.points.len() as u64,
        );
        let threads = threads.min(scene.views.len() as u64);
        let triangles = surface.triangles.len() as u64;
        let buffer =
            visibility::picture_pixels(scene, settings) * BUFFER_PIXEL + ROW_INDEX * triangles;
        let rows = Rows::expected(scene, surface);
        // Twice the surface: the triangles that are seen are copied out of it.
        let drawing = self.read + 2 * bytes(surface) + PER_POINT * points + threads * buffer;
        let held = self.outside_tables(scene, surface);
        let basis = &self.basis;
        if basis.fits(drawing + VISIBILITY_ROW * rows.all)
            // Later tables are stored as visibility is, so they have to fit as well.
            && basis.fits(held + basis.in_memory(rows, triangles))
            && basis.fits(held + basis.row * rows.all + basis.pilot)
        {
            self.visibility = drawing + VISIBILITY_ROW * rows.all;
            // The rest is forecast from the real rows, which occlusion makes fewer.
            self.check_limit(MODEL, self.visibility)?;
            return Ok(Storage::Memory);
        }
        self.visibility = drawing + VISIBILITY_ROW * rows.at_once();
        self.partners = held + basis.batches(rows, triangles);
        self.disk = (basis.row + basis.samples_row.max(BY_TRIANGLE_ROW)) * rows.all;
        let later = self.partners.max(held + basis.pilot);
        self.check_limit(MODEL, self.visibility.max(later))?;
        Ok(Storage::Disk)
    }

    /// Takes visibility that an earlier plan has kept: nothing is drawn.
    pub(super) fn with_visibility(&mut self, surface: &Surface, visibility: &Visibility) {
        self.visibility =
            self.read + bytes(surface) + VISIBILITY_ROW * visibility.triangles.len() as u64;
    }

    /// Forecasts partners and fulfilment from the real number of rows.
    pub(super) fn before_partners(
        &mut self,
        scene: &Scene,
        surface: &Surface,
        visibility: &Visibility,
    ) -> Result<(), PlanError> {
        let (rows, triangles) = (Rows::of(scene, visibility), surface.triangles.len() as u64);
        let (held, basis) = (self.outside_tables(scene, surface), &self.basis);
        (self.tables, self.partners) = match visibility.triangles.storage() {
            Storage::Memory => (
                held + basis.row * rows.all,
                held + basis.in_memory(rows, triangles),
            ),
            Storage::Disk => (held, held + basis.batches(rows, triangles)),
        };
        self.check_limit("fulfilment table", self.partners)
    }

    /// Forecasts the pilot: thumbnails and maps of all views, and the costs of the planes of one
    /// view per thread; then the places, with what the ranking makes of them.
    pub(super) fn before_pilot(&mut self) -> Result<(), PlanError> {
        self.pilot = self.tables + self.basis.pilot;
        self.check_limit(PILOT, self.pilot)
    }

    /// Forecasts the reading of masks; returns the number of views per batch, at least 1.
    /// `of_mask`: bytes for the largest one.
    pub(super) fn before_masks(
        &mut self,
        geometry: &Geometry,
        of_mask: u64,
    ) -> Result<usize, PlanError> {
        let rows = Rows::of(geometry.scene, geometry.visibility);
        let threads = (rayon::current_num_threads() as u64).min(rows.views);
        let held = self.held_by_unary(geometry) + VALUES_ROW * rows.at_once();
        let need = |views: u64| held + views * of_mask;
        let views_at_once = (1..=threads)
            .rev()
            .find(|&views| self.basis.fits(need(views)))
            .unwrap_or(1);
        self.confidence = self.confidence.max(need(views_at_once));
        self.check_limit(MASKS, need(views_at_once))?;
        // A thread reads one mask at a time: where all have room, larger batches take no more.
        Ok(if views_at_once == threads {
            column::READ_AT_ONCE
        } else {
            views_at_once as usize
        })
    }

    /// Forecasts the sampling of pictures, of fewer views at once if need be. `of_mask`: bytes for
    /// the largest mask; 0 without one.
    pub(super) fn before_pictures(
        &mut self,
        geometry: &Geometry,
        of_mask: u64,
    ) -> Result<SampleRoom, PlanError> {
        let Geometry {
            scene, visibility, ..
        } = *geometry;
        let (threads, rows) = (
            rayon::current_num_threads() as u64,
            visibility.triangles.len() as u64,
        );
        let of_view = (UNARY_ROW + SAMPLES_ROW) * Rows::of(scene, visibility).most;
        let (tables_keep, samples) = (visibility.triangles.storage(), SAMPLES_ROW * rows);
        let keep = if samples <= self.basis.most_samples() {
            tables_keep
        } else {
            Storage::Disk
        };
        let held = self.held_by_unary(geometry) + if keep == Storage::Memory { samples } else { 0 };
        // The picture is small when its mask is read.
        let picture = self.basis.picture.max(of_mask);
        // Each thread's allocator also holds back about what its last view took.
        let need = |views: u64| {
            held + (views + views.min(threads)) * of_view + views.min(threads) * picture
        };
        // Bounded by memory too, but at least a view for each thread.
        let most = (MOST_SAMPLES / of_view.max(1)).clamp(threads, VIEWS_PER_THREAD * threads);
        let most = most
            .min(column::READ_AT_ONCE as u64)
            .min(scene.views.len() as u64);
        // With --gsd 0.005 and a limit of 230M, `valley` takes 147 MB of memory this way, not 410.
        let views_at_once = (1..=most)
            .rev()
            .find(|&views| self.basis.fits(need(views)))
            .unwrap_or(1);
        let sampling = need(views_at_once);
        self.confidence = self.confidence.max(sampling);
        self.check_limit(PICTURES, sampling)?;
        if (tables_keep, keep) == (Storage::Memory, Storage::Disk) {
            self.disk = samples;
        }
        Ok(SampleRoom {
            keep,
            views_at_once: views_at_once as usize,
        })
    }

    /// Returns the memory of model, surface, and tables up to the confidence of views by
    /// themselves.
    fn held_by_unary(&self, geometry: &Geometry) -> u64 {
        let Geometry {
            scene,
            surface,
            visibility,
            ..
        } = *geometry;
        let tables = match visibility.triangles.storage() {
            Storage::Memory => UNARY_ROW * visibility.triangles.len() as u64,
            Storage::Disk => 0,
        };
        self.outside_tables(scene, surface) + tables
    }

    /// Returns the memory of model, surface, and their points and triangles while partners are
    /// chosen.
    fn outside_tables(&self, scene: &Scene, surface: &Surface) -> u64 {
        let threads = rayon::current_num_threads() as u64;
        let of_points = (PER_POINT + threads * OBSERVED) * scene.points.len() as u64;
        let of_triangles = (PER_TRIANGLE + threads * ROW_INDEX) * surface.triangles.len() as u64;
        self.read + bytes(surface) + of_points + of_triangles
    }

    /// Checks the belief about each row of fulfilment, which a plan around finished depth maps
    /// keeps in memory.
    pub(crate) fn before_beliefs(&self, fulfilment: &FulfilmentTable) -> Result<(), PlanError> {
        self.check_limit(
            "table of failures",
            self.tables + BELIEF_ROW * fulfilment.triangles.len() as u64,
        )
    }

    /// Returns an error if `need` exceeds a limit. The sizes of the largest picture and of the
    /// thumbnails are known before any stage, so the limit that the error advises allows for them.
    fn check_limit(&self, stage: &'static str, need: u64) -> Result<(), PlanError> {
        let Basis {
            limit,
            most,
            picture,
            pilot,
            ..
        } = self.basis;
        let with_pictures = need.max(self.read + picture.max(pilot));
        match (limit, most) {
            (Some(Bytes(limit)), _) if need > limit => Err(PlanError::Memory {
                stage,
                need,
                limit,
                with_pictures,
            }),
            (_, Some(most)) if need > most => Err(PlanError::Refused {
                stage,
                need,
                most,
                with_pictures,
            }),
            _ => Ok(()),
        }
    }

    /// Maximum size of the tables on disk, formatted as "1.5G"; `None` if they fit in memory.
    pub fn on_disk(&self) -> Option<String> {
        (self.disk > 0).then(|| readable(self.disk))
    }

    /// Peak over all stages, bytes.
    pub fn peak(&self) -> u64 {
        self.read
            .max(self.surface)
            .max(self.visibility)
            .max(self.confidence)
            .max(self.partners)
            .max(self.pilot)
    }
}

fn bytes(surface: &Surface) -> u64 {
    (size_of_val(&*surface.vertices) + size_of_val(&*surface.triangles)) as u64
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

/// Formats bytes as "1.5G", "20M" or "300 bytes", rounded up: a need above a limit must not read
/// the same.
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
        _ => format!("{bytes} byte{}", if bytes == 1 { "" } else { "s" }),
    }
}
