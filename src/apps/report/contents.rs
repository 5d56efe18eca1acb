//! Contents of the page.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

use nalgebra::Point3;
use rayon::prelude::*;
use serde::Serialize;

use super::{
    bytes,
    flight::{self, Flight},
    history::History,
    holes::{FAR, holes},
    listed_holes::{HoleData, ListedHoles},
    ranking::RankingData,
    real::{DepthMapFolders, Real},
    shown::DrawnSurface,
    subject::Subject,
    thumbnails::{MOST, expected, thumbnails},
};
use crate::{
    apps::{doctor::partners_in_words, evaluate::EvaluateError},
    backends::ExportRecord,
    base::{
        column::{DiskError, TableError},
        error::{Advice, Hint},
        progress::{Cancelled, Watcher},
        rows::Offsets,
    },
    config::ForecastSettings,
    io::project::Project,
    method::{region::Ground, visibility::VisibilityError},
    model::{cluster::Gate, georeference::MapFrame, reason::Reason, scene::ViewIndex},
    plan::{Band, Cut, GivenUp, Plan},
    show::{
        manifest::RegionSummary,
        pictures::{RAMP, footprints},
    },
};

/// Largest number of holes that are listed.
const HOLES: usize = 20;

/// Everything on the page, as its script reads it. Points are in the map frame: x to the right, y
/// up the sheet, z up, scene units. Views are indices in the order of names; ranks are 1-based;
/// arrays are little-endian in base64.
#[derive(Serialize)]
pub struct Contents {
    title: String,
    tool: &'static str,
    backend: &'static str,
    /// False for a program that uses the images themselves.
    makes_maps: bool,
    /// Metres in a scene unit; null if unknown.
    metres: Option<f64>,
    /// Direction of north on the map, x to the right and y up; null if unknown.
    north: Option<[f64; 2]>,
    gsd: f64,
    /// Partners wanted per key view, k.
    wanted_partners: u32,
    points: usize,
    triangles: usize,
    area: f64,
    cut: usize,
    /// Clusters at the start of the ranking whose depth maps were finished when it was made; their
    /// gains and shares are measured.
    finished: usize,
    limits: Limits,
    /// Warnings of the manifest, and which depth maps cannot be shown.
    warnings: Vec<String>,
    /// Parts of the plan that the exports do not honour. The user cannot change them.
    notes: Vec<String>,
    unregistered: Vec<String>,
    /// Number of images that are neither taken nor left out.
    kept_for_tests: usize,
    /// Colours of the surface at shares of 0, 1/2 and 1 of what all clusters give.
    ramp: [[u8; 3]; 3],
    reasons: Vec<&'static str>,
    forecast: ForecastSettings,
    clusters_total: usize,
    pairs_total: usize,
    views: ViewData,
    ranking: RankingData,
    surface: SurfaceData,
    /// Opposite corners of a box around what counts, which the map shows first.
    subject: Option<Corners>,
    /// Region of interest; null: the whole surface.
    region: Option<RegionData>,
    holes: Vec<HoleData>,
    /// Images to take that would fill them.
    flight: FlightData,
    /// The same as files below the plan's folder.
    #[serde(skip)]
    pub flight_files: Vec<(&'static str, String)>,
    /// Warnings about the planned images.
    #[serde(skip)]
    pub cautions: Vec<String>,
    /// Area of all holes, square scene units.
    holes_area: f64,
    /// Area of the holes farther than `far` usual distances from every camera, square scene units.
    far_area: f64,
    far: f64,
    /// Median distance of the sparse points from the nearest of their views, scene units.
    usual_distance: f64,
    real: Option<Real>,
    thumbnails: BTreeMap<u32, String>,
    /// Where the depth maps of the first chosen key views are expected to succeed, as thumbnails.
    expected: BTreeMap<u32, String>,
    /// Largest number of thumbnails; with more views, only the first of the ranking have one.
    most_thumbnails: usize,
}

#[derive(Serialize)]
struct Corners {
    low: [f64; 3],
    high: [f64; 3],
}

impl Corners {
    /// A box around the subject, and on the map also around the region and the images to take.
    fn shown_first(plan: &Plan, flight: &Flight, frame: &MapFrame) -> Option<Self> {
        let Subject {
            mut low, mut high, ..
        } = Subject::new(plan, frame)?;
        let rings = plan.stages.ground.iter().flat_map(|ground| &ground.rings);
        let planned = flight.waypoints.iter();
        let planned = planned.map(|waypoint| frame.local(&waypoint.centre));
        let corners = rings.flatten().copied();
        for place in corners.chain(planned.map(|[x, y, _]| [x, y])) {
            for axis in 0..2 {
                low[axis] = low[axis].min(place[axis]);
                high[axis] = high[axis].max(place[axis]);
            }
        }
        Some(Self { low, high })
    }
}

/// Returns the direction of north on the map, at the first camera.
fn north(plan: &Plan, frame: &MapFrame) -> Option<[f64; 2]> {
    let here = plan.stages.scene.views.first()?.cam_from_world.centre();
    let from = plan.stages.place.geodetic(&here)?;
    // How far north a unit along each axis of the map leads.
    let northing = |axis: usize| {
        let to = plan.stages.place.geodetic(&(here + frame.axes[axis]))?;
        Some(from.offset_to(to)[1])
    };
    let [x, y] = [northing(0)?, northing(1)?];
    let length = x.hypot(y);
    (length > 0.0).then(|| [x / length, y / length])
}

/// Rings on the map at the height of the ground: f32, 3 per corner.
fn on_ground(frame: &MapFrame, ground: &Ground, rings: &[Vec<[f64; 2]>]) -> Vec<String> {
    let ring = |ring: &Vec<[f64; 2]>| {
        let corners: Vec<Point3<f64>> = ring.iter().map(|at| ground.plane.at(*at)).collect();
        bytes(&in_frame(frame, corners.iter()))
    };
    rings.iter().map(ring).collect()
}

#[derive(Serialize)]
struct ViewData {
    names: Vec<String>,
    /// f32, 3 per view.
    centres: String,
    /// Viewing directions, f32, 3 per view.
    directions: String,
    /// Corners of the footprints, f32, 3 per corner; CSR by view with u32 offsets.
    footprints: String,
    footprint_offsets: String,
    /// Rank, u32; 0: not in the ranking.
    rank: String,
    /// Number of the reason + 1, u8; 0 without a reason.
    reason: String,
    /// CSR by view: best substitutes so far. Ranks (u32) of the earlier clusters that give a larger
    /// share of what this view could give than any cluster before them, and these shares, f32.
    likest_offsets: String,
    likest: String,
    likest_shares: String,
    /// Number of triangles that the view sees, u32.
    seen: String,
    /// For views that lack partners: how many they have, and why other views are refused.
    partners: BTreeMap<u32, String>,
}

#[derive(Serialize)]
struct SurfaceData {
    /// f32, 3 per vertex.
    vertices: String,
    /// u32, 3 per triangle.
    triangles: String,
    offsets: String,
    ranks: String,
    shares: String,
    first: String,
    /// Rank (u16) from which one map likely shows the triangle, and from which fusion likely keeps
    /// it.
    alone: String,
    kept: String,
    reachable: String,
    /// Weight per area, u8: 255 is the largest, 0 none, one step is 1/40 octave.
    weights: String,
    /// Number of the reason + 1, u8; 0 if some cluster fulfils the triangle.
    reason: String,
    /// True if the surface is drawn with fewer triangles than in the plan.
    coarser: bool,
}

/// The region of the plan. Shares on the page, holes and `area` are those inside.
#[derive(Serialize)]
struct RegionData {
    words: String,
    /// The last line of them says that a part was missed.
    is_incomplete: bool,
    /// 1 where a drawn triangle counts, u8.
    inside: String,
    /// Border on the drawn surface: u32, 2 vertices per edge.
    border: String,
    /// Rings on the map: f32, 3 per corner.
    outline: Vec<String>,
    /// Rings, likewise, around the ground that no photograph shows finely enough, that a single one
    /// does, and that more show but where no sparse points make a surface.
    unseen: Vec<String>,
    seen_once: Vec<String>,
    unbuilt: Vec<String>,
    /// Some of what is `unseen` is in photographs that are too coarse.
    too_coarse: bool,
}

impl RegionData {
    fn new(
        plan: &Plan,
        summary: &RegionSummary,
        surface: &DrawnSurface,
        frame: &MapFrame,
    ) -> Option<Self> {
        let stages = &plan.stages;
        let region = stages.region.as_ref()?;
        let inside = surface.original.iter().map(|&t| region.is_inside(t));
        let ground = stages.ground.as_ref();
        let missed = ground.map(flight::missed_areas).unwrap_or_default();
        let rings = |rings: &[Vec<[f64; 2]>]| {
            ground.map_or_else(Vec::new, |ground| on_ground(frame, ground, rings))
        };
        let shown_by = |photographs: u32| {
            let areas = missed.iter().filter(|a| a.photographs == photographs);
            areas.flat_map(|area| rings(&area.rings)).collect()
        };
        let unbuilt = ground.map(flight::unbuilt_ground).unwrap_or_default();
        Some(Self {
            words: summary.describe(stages.metres),
            is_incomplete: summary.ground.is_some_and(|ground| ground.is_incomplete()),
            inside: list(inside.map(u8::from)),
            border: bytes(surface.border(|t| region.is_inside(t)).as_flattened()),
            outline: rings(ground.map_or(&[], |ground| &ground.rings)),
            unseen: shown_by(0),
            seen_once: shown_by(1),
            unbuilt: rings(&unbuilt),
            too_coarse: ground
                .is_some_and(|ground| ground.cells.iter().any(|cell| cell.too_coarse)),
        })
    }
}

impl Contents {
    /// `exports`: those of the plan.
    pub fn new(
        plan: &Plan,
        project: &Project,
        exports: &[ExportRecord],
        folders: &DepthMapFolders,
        watcher: &dyn Watcher,
    ) -> Result<Self, ReportError> {
        let frame = MapFrame::new(&plan.stages.scene, plan.stages.settings.surface.up);
        let surface = DrawnSurface::new(&plan.stages.surface);
        let (real, left_out) = Real::new(plan, project, &surface, folders, watcher)?;
        let images = project.images.as_ref();
        let thumbnails = images.map(|images| thumbnails(plan, images, watcher));
        let holes = holes(plan, HOLES);
        let missing = ListedHoles::new(plan, &holes, &frame, watcher)?;
        let summary = RegionSummary::from_plan(plan);
        let region = summary.and_then(|summary| RegionData::new(plan, &summary, &surface, &frame));
        let warnings = warnings_beside(region.as_ref(), plan);
        Ok(Self {
            title: project.name(),
            tool: concat!("viewrank ", env!("CARGO_PKG_VERSION")),
            backend: plan.stages.backend,
            makes_maps: plan.stages.makes_maps,
            metres: plan.stages.metres,
            north: north(plan, &frame),
            gsd: plan.stages.settings.target.gsd.unwrap_or_default(),
            wanted_partners: plan.stages.settings.partners.k,
            points: plan.stages.scene.points.len(),
            triangles: plan.stages.surface.triangles.len(),
            area: plan.whole_area_inside(),
            cut: plan.decision.cut.clusters,
            finished: plan.decision.finished,
            limits: Limits::new(&plan.decision.cut),
            warnings: warnings.chain(left_out).collect(),
            notes: exports.iter().flat_map(not_honoured).collect(),
            unregistered: plan.stages.scene.unregistered.clone(),
            kept_for_tests: plan.stages.kept_for_tests.len(),
            reasons: Reason::NUMBERED.iter().map(|r| r.describe()).collect(),
            forecast: plan.stages.settings.forecast.clone(),
            clusters_total: plan.decision.forecast.all_maps,
            pairs_total: plan.decision.forecast.all_pairs,
            views: ViewData::new(plan, &frame)?,
            ranking: RankingData::new(plan),
            region,
            surface: SurfaceData::new(plan, &surface, &frame),
            subject: Corners::shown_first(plan, &missing.flight, &frame),
            flight_files: missing.files(plan, &frame),
            flight: FlightData::new(&missing.flight, missing.for_holes, missing.remarks, &frame),
            cautions: missing.cautions,
            holes: missing.holes,
            holes_area: holes.area,
            far_area: holes.far_area,
            far: FAR,
            usual_distance: holes.usual_distance,
            real,
            thumbnails: thumbnails.transpose()?.unwrap_or_default(),
            expected: expected(plan, watcher)?,
            most_thumbnails: MOST,
            ramp: RAMP,
        })
    }
}

/// Returns the warnings of a plan, but for what the page says of the region anyway.
fn warnings_beside<'a>(
    region: Option<&'a RegionData>,
    plan: &'a Plan,
) -> impl Iterator<Item = String> + 'a {
    let is_said = move |warning: &str| region.is_some_and(|region| region.words.contains(warning));
    let warnings = plan.warnings.iter();
    warnings.filter(move |warning| !is_said(warning)).cloned()
}

/// Bounds and bands of the plan (method 5.2).
#[derive(Serialize)]
struct Limits {
    /// Weight that fusion keeps of all clusters, 0 to 1.
    reachable: f64,
    /// f_o at the plan's cut, 0 to 1.
    fulfilment: f64,
    /// Upper bound on f_o of any choice with the same number of clusters.
    fulfilment_bound: f64,
    /// Bands in which the measured values are expected.
    share_band: Band,
    reachable_band: Band,
    /// Part that the plan's cut gives up.
    given_up: GivenUp,
    pairs_beyond_gate: usize,
}

impl Limits {
    fn new(cut: &Cut) -> Self {
        let Cut {
            reachable,
            reachable_band,
            share_band,
            fulfilment,
            fulfilment_bound,
            given_up,
            pairs_beyond_gate,
            ..
        } = *cut;
        Self {
            reachable,
            reachable_band,
            share_band,
            fulfilment,
            fulfilment_bound,
            given_up,
            pairs_beyond_gate,
        }
    }
}

fn not_honoured(export: &ExportRecord) -> impl Iterator<Item = String> {
    export
        .not_honoured
        .iter()
        .map(|what| format!("{}: not honoured: {what}", export.backend))
}

/// Returns the weight per area of each drawn triangle: 255 for the largest, one less per 1/40
/// octave below it; 0 without weight.
fn weights(plan: &Plan, surface: &DrawnSurface) -> Vec<u8> {
    let density = |&t: &u32| {
        plan.stages.objective.weights[t as usize]
            / plan.stages.surface.area(t).max(f64::MIN_POSITIVE)
    };
    let densities: Vec<f64> = surface.original.iter().map(density).collect();
    let most = densities.iter().copied().fold(0.0, f64::max);
    let shade = |&d: &f64| {
        if d > 0.0 {
            // At least 1: 0 is for triangles that do not count.
            (255.0 + 40.0 * (d / most).log2()).clamp(1.0, 255.0).round() as u8
        } else {
            0
        }
    };
    densities.iter().map(shade).collect()
}

/// CSR offsets as the page reads them: u32 in base64.
pub(super) fn offset_bytes(offsets: &Offsets) -> String {
    bytes(
        &offsets
            .as_slice()
            .iter()
            .map(|&offset| offset as u32)
            .collect::<Vec<_>>(),
    )
}

fn list<T: bytemuck::NoUninit>(values: impl Iterator<Item = T>) -> String {
    bytes(&values.collect::<Vec<T>>())
}

fn in_frame<'a>(frame: &MapFrame, points: impl Iterator<Item = &'a Point3<f64>>) -> Vec<f32> {
    points
        // From the middle of the points: as f32, a northing of UTM has steps of half a metre.
        .flat_map(|point| frame.local(point))
        .map(|x| x as f32)
        .collect()
}

impl ViewData {
    fn new(plan: &Plan, frame: &MapFrame) -> Result<Self, DiskError> {
        let stages = &plan.stages;
        let views = || stages.scene.views.iter();
        let centres: Vec<Point3<f64>> = views().map(|v| v.cam_from_world.centre()).collect();
        let directions =
            views().flat_map(|v| frame.direction(&v.cam_from_world.viewing_direction()));
        let footprints = footprints(&stages.surface, &stages.visibility, frame);
        let mut rank = vec![0u32; stages.scene.views.len()];
        plan.ranked()
            .enumerate()
            .for_each(|(i, cluster)| rank[cluster.key.index()] = i as u32 + 1);
        let reasons = plan.decision.views.iter().map(|&(_, reason)| reason);
        let mut substitutes = vec![Vec::new(); rank.len()];
        stages
            .clusters
            .iter()
            .zip(plan.best_substitutes()?)
            .for_each(|(cluster, found)| substitutes[cluster.key.index()] = found);
        let likest = || substitutes.iter().flatten();
        let seen = |view| stages.visibility.triangles_seen_by(view).len() as u32;
        Ok(Self {
            names: views().map(|view| view.name.clone()).collect(),
            centres: bytes(&in_frame(frame, centres.iter())),
            directions: list(directions.map(|x| x as f32)),
            footprints: bytes(&in_frame(frame, footprints.iter().flatten())),
            footprint_offsets: offset_bytes(&Offsets::from_lengths(
                footprints.iter().map(Vec::len),
            )),
            rank: bytes(&rank),
            reason: list(reasons.map(Reason::number)),
            likest_offsets: offset_bytes(&Offsets::from_lengths(substitutes.iter().map(Vec::len))),
            likest: list(likest().map(|l| l.rank as u32 + 1)),
            likest_shares: list(likest().map(|l| l.share as f32)),
            seen: list(stages.scene.view_indices().map(seen)),
            partners: partners(plan),
        })
    }
}

/// Explains the refused pairs of each view whose reason is about its pairs.
fn partners(plan: &Plan) -> BTreeMap<u32, String> {
    let of_pairs = [
        Reason::NoSharedPoints,
        Reason::RotationOnly,
        Reason::NotMatchable,
    ];
    let lacks = |view: &ViewIndex| {
        plan.decision.views[view.index()]
            .1
            .is_some_and(|reason| of_pairs.contains(&reason))
    };
    // In a plan, all limits that some pair exceeds are set.
    let gate = Gate::OPEN.with(&plan.stages.settings.partners.gate);
    let points = plan.stages.scene.view_points();
    let views: Vec<ViewIndex> = plan.stages.scene.view_indices().filter(lacks).collect();
    let stages = &plan.stages;
    let words = |&view: &ViewIndex| {
        (
            view.0,
            partners_in_words(&stages.scene, &points, &stages.without_image, &gate, view),
        )
    };
    views.par_iter().map(words).collect()
}

impl SurfaceData {
    fn new(plan: &Plan, surface: &DrawnSurface, frame: &MapFrame) -> Self {
        let history = History::new(plan, surface);
        let reason = |&t: &u32| Reason::number(plan.decision.triangle_reasons[t as usize]);
        Self {
            vertices: bytes(&in_frame(frame, surface.vertices.iter())),
            triangles: bytes(&surface.triangles),
            offsets: offset_bytes(&history.offsets),
            ranks: bytes(&history.ranks),
            shares: bytes(&history.shares),
            first: bytes(&history.first),
            alone: bytes(&history.alone),
            kept: bytes(&history.kept),
            reachable: bytes(&history.reachable),
            weights: bytes(&weights(plan, surface)),
            reason: bytes(&surface.original.iter().map(reason).collect::<Vec<_>>()),
            coarser: surface.triangles.len() < plan.stages.surface.triangles.len(),
        }
    }
}

/// Images to take, in the order to fly them.
#[derive(Serialize)]
struct FlightData {
    /// f32, 3 per image.
    centres: String,
    /// Viewing directions, f32, 3 per image.
    directions: String,
    /// Hole of each, an index.
    holes: Vec<usize>,
    /// Ranges over the images of each hole are what its row shows: height above the surface, and
    /// overlap, 0 to 1.
    heights: Vec<f64>,
    overlaps: Vec<f64>,
    /// Number of them that are for holes of the surface, the first ones; the others are for ground
    /// without any.
    for_holes: usize,
    /// Part of the weight of each hole.
    of_holes: Vec<f64>,
    /// As [`Flight::remarks`].
    remarks: String,
}

impl FlightData {
    fn new(flight: &Flight, for_holes: usize, remarks: String, frame: &MapFrame) -> Self {
        let all = || flight.waypoints.iter();
        let directions: Vec<f32> = all()
            .flat_map(|w| frame.direction(&w.direction))
            .map(|x| x as f32)
            .collect();
        Self {
            centres: bytes(&in_frame(frame, all().map(|w| &w.centre))),
            directions: bytes(&directions),
            holes: all().map(|w| w.hole).collect(),
            heights: all().map(|w| w.height).collect(),
            overlaps: all().map(|w| w.overlap).collect(),
            for_holes,
            of_holes: flight.of_holes.clone(),
            remarks,
        }
    }
}

/// Errors of building the page.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    #[error(transparent)]
    DepthMaps(#[from] EvaluateError),
    #[error("cannot compare with the reference {}: no depth maps of this plan found", .0.display())]
    NothingToCompare(PathBuf),
    #[error(transparent)]
    Disk(#[from] DiskError),
    #[error(transparent)]
    Table(#[from] TableError),
    #[error(transparent)]
    Visibility(#[from] VisibilityError),
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
}

impl Hint for ReportError {
    fn hint(&self) -> Option<Advice> {
        match self {
            Self::DepthMaps(error) => error.hint(),
            Self::NothingToCompare(_) => {
                Some(Advice::text("name their folder with ").set("depth-maps"))
            }
            Self::Disk(error) => error.hint(),
            Self::Table(error) => error.hint(),
            Self::Visibility(error) => error.hint(),
            Self::Cancelled(error) => error.hint(),
        }
    }

    fn path(&self) -> Option<&Path> {
        match self {
            Self::DepthMaps(error) => error.path(),
            Self::NothingToCompare(path) => Some(path),
            Self::Disk(error) => error.path(),
            Self::Table(error) => error.path(),
            Self::Visibility(_) | Self::Cancelled(_) => None,
        }
    }
}
