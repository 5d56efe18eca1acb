//! The ground of a region that no photograph shows finely enough, or a single one, as polygons for
//! a map.

use serde_json::{Value, json};

use super::{
    files::collection,
    outlines::{Place, areas},
};
use crate::{
    base::decimals::to_decimals,
    method::region::{Ground, GroundCell},
    model::georeference::{Geodetic, Georeference, MapFrame},
    plan::area_in_words,
    show::pictures::views_file,
};

/// Fewest cells of an area that is drawn in the file.
const LEAST_CELLS: usize = 4;

/// Cells of the ground that are joined, each shown by the same number of photographs.
pub struct MissedArea {
    /// 0 or 1.
    pub photographs: u32,
    cells: usize,
    /// Closed rings on the map, scene units: the outline, then holes in it.
    pub rings: Vec<Vec<[f64; 2]>>,
}

/// Returns the areas that no photograph shows, then those that a single one does, of both the
/// largest first.
pub fn missed_areas(ground: &Ground) -> Vec<MissedArea> {
    let shown_by = |photographs: u32| {
        let areas = joined(ground, move |cell| cell.views == photographs);
        areas.into_iter().map(move |(cells, rings)| MissedArea {
            photographs,
            cells,
            rings,
        })
    };
    [0, 1].into_iter().flat_map(shown_by).collect()
}

/// Returns the rings around the ground that several photographs show and that has no surface.
pub fn unbuilt_ground(ground: &Ground) -> Vec<Vec<[f64; 2]>> {
    let areas = joined(ground, |cell| cell.views > 1 && !cell.has_surface);
    areas.into_iter().flat_map(|(_, rings)| rings).collect()
}

/// Joins cells to areas, the largest first: their numbers, and their rings on the map.
fn joined(
    ground: &Ground,
    belongs: impl Fn(&GroundCell) -> bool,
) -> Vec<(usize, Vec<Vec<[f64; 2]>>)> {
    let Some(origin) = ground.cells.first().map(|cell| cell.place) else {
        return Vec::new();
    };
    // Positions are multiples of the side, up to rounding.
    let number = |at: [f64; 2]| -> Place {
        [0, 1].map(|axis| ((at[axis] - origin[axis]) / ground.side).round() as i32)
    };
    let on_map = |corner: &Place| {
        [0, 1].map(|axis| origin[axis] + (f64::from(corner[axis]) - 0.5) * ground.side)
    };
    let cells = ground.cells.iter().filter(|cell| belongs(cell));
    let areas = areas(cells.map(|cell| number(cell.place))).into_iter();
    let rings = |rings: Vec<Vec<Place>>| -> Vec<Vec<[f64; 2]>> {
        let ring = |ring: &Vec<Place>| ring.iter().map(on_map).collect();
        rings.iter().map(ring).collect()
    };
    areas.map(|area| (area.cells, rings(area.rings))).collect()
}

/// Name and text of the file, GeoJSON below the plan's folder: a feature for each area that is no
/// sliver, and what all measure together. `None` without any. `metres`: in a scene unit, if known;
/// `purpose`: what the plan is for.
pub fn missed(
    ground: &Ground,
    frame: &MapFrame,
    place: &Georeference,
    metres: Option<f64>,
    purpose: &str,
) -> Option<(&'static str, String)> {
    let is_local = views_file(place) != "views.geojson";
    let (unit, scale) = match metres {
        Some(metres) => ("area_m2", metres),
        None => ("area_units2", 1.0),
    };
    let feature = |missed: MissedArea| {
        let ring = |ring: &Vec<[f64; 2]>| -> Vec<[f64; 2]> {
            let positions = ring.iter().map(|at| position(ground, *at, frame, place));
            positions.collect()
        };
        let rings: Vec<Vec<[f64; 2]>> = missed.rings.iter().map(ring).collect();
        let area = missed.cells as f64 * (ground.side * scale).powi(2);
        json!({
            "type": "Feature",
            "geometry": { "type": "Polygon", "coordinates": rings },
            "properties": { "photographs": missed.photographs, unit: to_decimals(area, 3) },
        })
    };
    let mut areas = missed_areas(ground);
    let note = format!("{purpose} {}", in_all(&areas, ground.side, metres));
    // After the note, which says how much is left out here.
    areas.retain(|area| area.cells >= LEAST_CELLS);
    let features: Vec<Value> = areas.into_iter().map(feature).collect();
    let name = if is_local {
        "flight/missed_local.json"
    } else {
        "flight/missed.geojson"
    };
    (!features.is_empty()).then(|| (name, collection(features, &note, is_local)))
}

/// Says how much ground is missed, and how much of it the file leaves out. `side`: of a cell, scene
/// units.
fn in_all(areas: &[MissedArea], side: f64, metres: Option<f64>) -> String {
    let total = |counts: &dyn Fn(&&MissedArea) -> bool| -> f64 {
        let cells: usize = areas.iter().filter(counts).map(|area| area.cells).sum();
        cells as f64 * side * side
    };
    let [unseen, once] = [0, 1].map(|shown| total(&|area| area.photographs == shown));
    let slivers = match total(&|area| area.cells < LEAST_CELLS) {
        0.0 => String::new(),
        area => format!(
            "; slivers that are not drawn: {}",
            area_in_words(area, metres)
        ),
    };
    format!(
        "Ground that no photograph shows finely enough: {}; that a single one shows: {}{slivers}.",
        area_in_words(unseen, metres),
        area_in_words(once, metres)
    )
}

/// Longitude and latitude of a place on the ground, or x and y on the map.
fn position(ground: &Ground, at: [f64; 2], frame: &MapFrame, place: &Georeference) -> [f64; 2] {
    let world = ground.plane.at(at);
    match place.geodetic(&world) {
        Some(Geodetic {
            longitude,
            latitude,
            ..
        }) => [to_decimals(longitude, 9), to_decimals(latitude, 9)],
        None => {
            let [x, y, _] = frame.direction(&world.coords);
            [to_decimals(x, 6), to_decimals(y, 6)]
        }
    }
}
