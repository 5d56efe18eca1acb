//! The ground of a region that no photograph shows, or a single one, as polygons for a map.

use serde_json::{Value, json};

use super::{
    files::collection,
    outlines::{Area, Place, areas},
};
use crate::{
    base::decimals::to_decimals,
    method::region::Ground,
    model::georeference::{Geodetic, Georeference, MapFrame},
    show::pictures::views_file,
};

/// Name and text of the file, GeoJSON below the plan's folder: a feature for each area, those that
/// no photograph shows and of these the largest first. `None` where nothing was missed. `metres`:
/// in a scene unit, if known.
pub fn missed(
    ground: &Ground,
    frame: &MapFrame,
    place: &Georeference,
    metres: Option<f64>,
) -> Option<(&'static str, String)> {
    let is_local = views_file(place) != "views.geojson";
    let origin = ground.cells.first()?.place;
    let position = |corner: &Place| {
        let at = [0, 1].map(|axis| origin[axis] + (f64::from(corner[axis]) - 0.5) * ground.side);
        position(ground, at, frame, place)
    };
    let (unit, scale) = match metres {
        Some(metres) => ("area_m2", metres),
        None => ("area_units2", 1.0),
    };
    let feature = |photographs: u32, Area { cells, rings }: Area| {
        let rings: Vec<Vec<[f64; 2]>> = rings
            .iter()
            .map(|ring| ring.iter().map(position).collect())
            .collect();
        let area = cells as f64 * (ground.side * scale).powi(2);
        json!({
            "type": "Feature",
            "geometry": { "type": "Polygon", "coordinates": rings },
            "properties": { "photographs": photographs, unit: to_decimals(area, 3) },
        })
    };
    let shown_by = |photographs: u32| {
        let cells = ground.cells.iter().filter(move |c| c.views == photographs);
        // Positions are multiples of the side, up to rounding.
        let number = |at: [f64; 2]| -> Place {
            [0, 1].map(|axis| ((at[axis] - origin[axis]) / ground.side).round() as i32)
        };
        areas(cells.map(|cell| number(cell.place)))
            .into_iter()
            .map(move |area| feature(photographs, area))
    };
    let features: Vec<Value> = [0, 1].into_iter().flat_map(shown_by).collect();
    let name = if is_local {
        "flight/missed_local.json"
    } else {
        "flight/missed.geojson"
    };
    (!features.is_empty()).then(|| (name, collection(features, is_local)))
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
