//! Builds the surface and finds what each view sees of it, unless an earlier plan has kept both.

use super::{
    Memory, PlanError, Timings,
    cached::{self, CachedSurface, Filed},
    inputs::Inputs,
    mesh,
};
use crate::{
    base::{
        large_pages,
        progress::{Stage, Watcher},
    },
    config::TargetMode,
    method::{
        surface::{self, SurfaceError, SurfaceStats, WantedGsd},
        target::GSD_MARGIN,
        visibility::{self, Visibility},
    },
    model::surface::Surface,
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
    pub fn cached_or_new(
        inputs: &Inputs,
        watcher: &dyn Watcher,
        timings: &mut Timings,
        memory: &mut Memory,
    ) -> Result<Filed<Self>, PlanError> {
        let settings = &inputs.settings;
        let gsd = settings.target.gsd.ok_or(PlanError::NoScale)?;
        let Filed { file, result } = timings.time(Stage::Surface, || {
            let file = inputs.fingerprints.surface(settings, memory);
            cached::read(file, |facts, bytes| {
                CachedSurface::unpack(facts, bytes, inputs.scene.views.len())
            })
        });
        let result = match result {
            Some(CachedSurface {
                surface,
                stats,
                visibility,
            }) => {
                memory.with_visibility(&surface, &visibility);
                Self {
                    surface,
                    stats,
                    visibility,
                    gsd,
                }
            }
            None => Self::new(inputs, gsd, watcher, timings, memory)?,
        };
        Ok(Filed { file, result })
    }

    fn new(
        inputs: &Inputs,
        gsd: f64,
        watcher: &dyn Watcher,
        timings: &mut Timings,
        memory: &mut Memory,
    ) -> Result<Self, PlanError> {
        let Inputs {
            scene,
            points,
            settings,
            ..
        } = inputs;
        let most = memory.most_triangles();
        let (surface, stats) = timings.time(Stage::Surface, || {
            let wanted = match settings.target.mode {
                // Here g_d differs from place to place, and edges follow it (method 1.5).
                TargetMode::Best => {
                    WantedGsd::finest(scene, gsd, GSD_MARGIN / settings.image_scale())
                }
                _ => WantedGsd::uniform(gsd),
            };
            let mesh = settings.surface.mesh.as_deref().map(|path| {
                let buffer_px = settings.visibility.buffer_px;
                let mesh = mesh::read(path)?;
                let mesh = visibility::keep_parts_in_field(scene, mesh, buffer_px, watcher);
                mesh.map_err(PlanError::from)
            });
            let mesh = mesh.transpose()?;
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
