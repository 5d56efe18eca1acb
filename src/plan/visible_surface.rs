//! Builds the surface and finds what each view sees of it, unless an earlier plan has kept both.

use super::{
    Memory, PlanError, Timings,
    kept::{self, Inputs, KeptSurface, Slotted},
    mesh,
};
use crate::{
    base::{
        large_pages,
        progress::{Stage, Watcher},
    },
    config::{Settings, TargetMode},
    method::{
        surface::{self, Surface, SurfaceError, SurfaceStats, WantedGsd},
        target::GSD_MARGIN,
        visibility::{self, Visibility},
    },
    model::scene::{Scene, ViewPoints},
};

/// The surface, reduced to triangles that at least one view sees, with its visibility.
pub struct VisibleSurface {
    pub surface: Surface,
    pub stats: SurfaceStats,
    pub visibility: Visibility,
    /// Wanted ground sampling distance, scene units per pixel.
    pub gsd: f64,
}

impl VisibleSurface {
    /// Returns the surface of an earlier plan, else builds it.
    pub fn kept_or_new(
        from: (&Scene, &ViewPoints),
        settings: &Settings,
        inputs: &Inputs,
        watcher: &dyn Watcher,
        timings: &mut Timings,
        memory: &mut Memory,
    ) -> Result<Slotted<Self>, PlanError> {
        let gsd = settings.target.gsd.ok_or(PlanError::NoScale)?;
        let (slot, found) = timings.time(Stage::Surface, || {
            let file = inputs.surface(settings, memory);
            kept::read(file, |facts, bytes| {
                KeptSurface::unpack(facts, bytes, from.0.views.len())
            })
        });
        match found {
            Some(KeptSurface {
                surface,
                stats,
                visibility,
            }) => {
                memory.with_visibility(&surface, &visibility);
                Ok((
                    slot,
                    Self {
                        surface,
                        stats,
                        visibility,
                        gsd,
                    },
                ))
            }
            None => Ok((
                slot,
                Self::new(from, gsd, settings, watcher, timings, memory)?,
            )),
        }
    }

    fn new(
        (scene, points): (&Scene, &ViewPoints),
        gsd: f64,
        settings: &Settings,
        watcher: &dyn Watcher,
        timings: &mut Timings,
        memory: &mut Memory,
    ) -> Result<Self, PlanError> {
        let most = memory.most_triangles();
        let (surface, stats) = timings.time(Stage::Surface, || {
            let wanted = match settings.target.mode {
                TargetMode::Best => {
                    WantedGsd::finest(scene, gsd, GSD_MARGIN / settings.image_scale())
                }
                _ => WantedGsd::uniform(gsd),
            };
            let mesh = settings
                .surface
                .mesh
                .as_deref()
                .map(mesh::read)
                .transpose()?;
            surface::build(scene, &wanted, &settings.surface, mesh, most, watcher)
                .map_err(|error| memory.too_fine(error))
        })?;
        large_pages::return_freed_memory();
        let keep = memory.before_visibility(scene, &surface, &settings.visibility)?;
        let edge_length = settings.surface.edge_factor * gsd;
        timings.time(Stage::Visibility, || {
            let visibility = visibility::estimate(
                scene,
                points,
                &surface,
                &settings.visibility,
                edge_length,
                keep,
                watcher,
            )?;
            let seen = visibility.seen_triangles(surface.triangles.len());
            if !seen.contains(&true) {
                return Err(SurfaceError::Empty.into());
            }
            Ok(Self {
                surface: surface.keep(&seen),
                stats,
                visibility: visibility.keep(&seen)?,
                gsd,
            })
        })
    }
}
