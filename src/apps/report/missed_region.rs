//! A region without any surface: nothing can be planned there but the images to take.

use super::flight::{self, Flight, Site, bare_ground};
use crate::{
    backends::planned_for,
    config::Settings,
    io::project::Project,
    model::georeference::MapFrame,
    plan::{self, GroundSummary, ground_without_surface, length_in_words, wanted_gsd},
};

/// Photographic coverage of a region without surface, and the images to take of it.
pub struct MissedRegion {
    summary: GroundSummary,
    metres: Option<f64>,
    pub waypoints: usize,
    /// As [`Flight::cautions`].
    pub cautions: Vec<String>,
    /// Names below a folder `flight`, with their text.
    pub files: Vec<(&'static str, String)>,
}

impl MissedRegion {
    /// Counts on a plane through the sparse points; `None` where that cannot be done.
    pub fn find(project: &Project, settings: &Settings) -> Option<Self> {
        let scene = project.read_scene().ok()?;
        let matcher = planned_for(project, settings).ok()?;
        let scale = settings.image_scale;
        let settings = &Settings {
            image_scale: scale.or_else(|| Some(matcher.image_scale(&scene))),
            ..settings.clone()
        };
        let place = plan::georeference(project, &scene, &settings.frame);
        let metres = plan::metres(settings.units, &place);
        let faults = project.image_faults(&scene);
        let without_image = faults.without_image(scene.views.len());
        let ground = ground_without_surface(&scene, &place, settings, &without_image).ok()??;

        let (frame, needed) = (
            MapFrame::new(&scene, settings.surface.up),
            settings.coverage.min_cameras,
        );
        let site = Site {
            scene: &scene,
            image_scale: settings.image_scale(),
            surface: &[],
        };
        let bare = bare_ground(&site, &ground, &frame, needed, &[]);
        let flight = bare.as_ref().map_or_else(Flight::default, |bare| {
            Flight::default().with_ground_first(bare)
        });
        let in_words = |gsd| format!("{} per pixel", length_in_words(gsd, metres));
        let wanted = wanted_gsd(&scene, settings).map_or_else(String::new, in_words);
        let purpose = flight::purpose_of(settings, &wanted, in_words);
        let missing: Vec<String> = bare.iter().map(|bare| bare.missing(needed)).collect();
        let remarks = flight.remarks(purpose.clone(), metres);
        let images = flight::files(&flight, &missing, &frame, &place, metres, &remarks);
        let missed = flight::missed(&ground, &frame, &place, metres, &purpose);
        Some(Self {
            // A surface was looked for: its share of the region is 0, not unknown.
            summary: GroundSummary::new(&ground, true, needed),
            metres,
            waypoints: flight.waypoints.len(),
            cautions: flight.cautions(metres),
            files: images.into_iter().chain(missed).collect(),
        })
    }

    /// Says how large it is, and how much of it has surface and photographs.
    pub fn headline(&self) -> String {
        let Self {
            summary, metres, ..
        } = self;
        let covered = summary.covered("The region", *metres);
        format!("{covered} {}", summary.missed(*metres))
    }
}
