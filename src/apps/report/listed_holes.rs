//! The holes that the page lists, and the images that would fill them.

use serde::Serialize;

use super::{
    contents::ReportError,
    flight::{self, BareGround, Flight, Site, bare_ground},
    holes::{Hole, Holes},
};
use crate::{
    base::progress::Watcher,
    model::{
        georeference::{Georeference, MapFrame},
        reason::Reason,
    },
    plan::Plan,
};

/// Parts of the scene that no cluster can reconstruct, and the images to take of them.
pub(super) struct ListedHoles {
    /// Bare ground of the region, then the largest holes of the surface.
    pub holes: Vec<HoleData>,
    pub flight: Flight,
    /// Waypoints for the holes of the surface, which come first.
    pub for_holes: usize,
    /// As [`Flight::cautions`], and [`Flight::remarks`].
    pub cautions: Vec<String>,
    pub remarks: String,
}

impl ListedHoles {
    pub fn new(
        plan: &Plan,
        holes: &Holes,
        frame: &MapFrame,
        watcher: &dyn Watcher,
    ) -> Result<Self, ReportError> {
        let needed = plan.stages.settings.coverage.min_cameras;
        let place = &plan.stages.place;
        // Where no depth maps are made, a place that no cluster reconstructs lacks nothing.
        let of_surface = if plan.stages.makes_maps {
            &holes.largest[..]
        } else {
            &[]
        };
        let mut flight = flight::flight(plan, of_surface, watcher)?;
        let mut listed: Vec<HoleData> = of_surface
            .iter()
            .map(|hole| HoleData::new(hole, frame, place, needed))
            .collect();
        let for_holes = flight.waypoints.len();
        let site = Site::of_plan(&plan.stages);
        let ground = plan.stages.ground.as_ref();
        let bare =
            ground.and_then(|ground| bare_ground(&site, ground, frame, needed, &flight.waypoints));
        if let Some(bare) = bare {
            listed.insert(0, HoleData::of_ground(&bare, frame, place, needed));
            flight = flight.with_ground_first(&bare);
        }
        Ok(Self {
            holes: listed,
            for_holes,
            cautions: flight.cautions(plan.stages.metres),
            remarks: flight.remarks(flight::purpose(&plan.stages), plan.stages.metres),
            flight,
        })
    }

    /// The files for the flight, and the outlines of ground that no image shows.
    pub fn files(&self, plan: &Plan, frame: &MapFrame) -> Vec<(&'static str, String)> {
        let (place, metres) = (&plan.stages.place, plan.stages.metres);
        let ground = plan.stages.ground.as_ref();
        let missed = ground.and_then(|ground| {
            flight::missed(ground, frame, place, metres, &flight::purpose(&plan.stages))
        });
        let missing: Vec<String> = self.holes.iter().map(|hole| hole.missing.clone()).collect();
        let files = flight::files(&self.flight, &missing, frame, place, metres, &self.remarks);
        files.into_iter().chain(missed).collect()
    }
}

#[derive(Serialize)]
pub(super) struct HoleData {
    area: f64,
    triangles: usize,
    reason: usize,
    missing: String,
    advice: &'static str,
    centre: [f64; 3],
    /// Latitude and longitude, degrees, if the scene is georeferenced.
    place: Option<[f64; 2]>,
}

impl HoleData {
    fn new(hole: &Hole, frame: &MapFrame, place: &Georeference, needed: u32) -> Self {
        let Hole {
            area,
            triangles,
            reason,
            centre,
            ..
        } = hole;
        let place = place.geodetic(centre).map(|at| [at.latitude, at.longitude]);
        Self {
            area: *area,
            triangles: *triangles,
            reason: Reason::number(Some(*reason)).into(),
            missing: hole.missing(needed),
            advice: hole.advice(needed),
            centre: frame.local(centre),
            place,
        }
    }

    fn of_ground(bare: &BareGround, frame: &MapFrame, place: &Georeference, needed: u32) -> Self {
        let at = place.geodetic(&bare.centre);
        Self {
            area: bare.area,
            triangles: 0,
            reason: Reason::number(Some(Reason::TooFewCameras)).into(),
            missing: bare.missing(needed),
            advice: "images of it, with more overlap",
            centre: frame.local(&bare.centre),
            place: at.map(|at| [at.latitude, at.longitude]),
        }
    }
}
