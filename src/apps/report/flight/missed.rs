//! The ground of a region that no photograph shows, or a single one, as polygons for a map.

use serde_json::{Value, json};

use super::files::{collection, rounded};
use crate::{
    method::region::{Ground, GroundCell},
    model::georeference::{Geodetic, Georeference, MapFrame},
    show::pictures::views_file,
};

/// Name and text of the file, GeoJSON below the plan's folder; `None` where nothing was missed.
pub fn missed(
    ground: &Ground,
    frame: &MapFrame,
    place: &Georeference,
) -> Option<(&'static str, String)> {
    let is_local = views_file(place) != "views.geojson";
    let feature = |photographs: u32| {
        let polygon =
            |ring: &Ring| json!([ring.map(|corner| position(ground, corner, frame, place))]);
        let polygons: Vec<Value> = strips(ground, photographs).iter().map(polygon).collect();
        (!polygons.is_empty()).then(|| {
            json!({
                "type": "Feature",
                "geometry": { "type": "MultiPolygon", "coordinates": polygons },
                "properties": { "photographs": photographs },
            })
        })
    };
    let features: Vec<Value> = [0, 1].into_iter().filter_map(feature).collect();
    let name = if is_local {
        "flight/missed_local.json"
    } else {
        "flight/missed.geojson"
    };
    (!features.is_empty()).then(|| (name, collection(features, is_local)))
}

/// A closed ring on the map, counterclockwise.
type Ring = [[f64; 2]; 5];

/// Joins neighbouring cells of a row that this number of photographs show to rectangles.
fn strips(ground: &Ground, photographs: u32) -> Vec<Ring> {
    let side = ground.side;
    let mut strips: Vec<(GroundCell, GroundCell)> = Vec::new();
    for cell in ground.cells.iter().filter(|c| c.views == photographs) {
        // Positions are multiples of the side, up to rounding.
        let follows = |last: &GroundCell| {
            let [right, up] = [0, 1].map(|axis| cell.place[axis] - last.place[axis]);
            (right - side).abs() < 0.1 * side && up.abs() < 0.1 * side
        };
        match strips.last_mut() {
            Some((_, last)) if follows(last) => *last = *cell,
            _ => strips.push((*cell, *cell)),
        }
    }
    let half = 0.5 * side;
    let ring = |(first, last): (GroundCell, GroundCell)| {
        let ([left, low], [right, high]) = (
            first.place.map(|at| at - half),
            last.place.map(|at| at + half),
        );
        [
            [left, low],
            [right, low],
            [right, high],
            [left, high],
            [left, low],
        ]
    };
    strips.into_iter().map(ring).collect()
}

/// Longitude and latitude of a place on the ground, or x and y on the map.
fn position(ground: &Ground, at: [f64; 2], frame: &MapFrame, place: &Georeference) -> [f64; 2] {
    let world = ground.plane.at(at);
    match place.geodetic(&world) {
        Some(Geodetic {
            longitude,
            latitude,
            ..
        }) => [rounded(longitude, 9), rounded(latitude, 9)],
        None => {
            let [x, y, _] = frame.direction(&world.coords);
            [rounded(x, 6), rounded(y, 6)]
        }
    }
}
