//! `views.geojson`: positions and footprints of the views, for QGIS and other GIS programs (RFC
//! 7946); `views_local.json` without a place on earth.

use nalgebra::Point3;
use rayon::prelude::*;
use serde_json::{Value, json};

use super::footprints;
use crate::{
    base::{decimals::to_decimals, printable::json_escaped},
    method::region::Outline,
    model::{
        georeference::{Georeference, MapFrame},
        scene::ViewIndex,
    },
    plan::Plan,
};

/// Returns the name of the file; local coordinates get another name because GIS programs read every
/// `.geojson` as WGS 84.
pub fn views_file(place: &Georeference) -> &'static str {
    if *place == Georeference::Local {
        "views_local.json"
    } else {
        "views.geojson"
    }
}

/// GeoJSON text with two features per view: a point at the camera, and a polygon around the surface
/// that it sees; and the region. Coordinates are longitude and latitude if the model is
/// georeferenced; otherwise they are the model's own, rotated so that the third axis is up, as
/// `crs: null`, `frame` and `axes` state (a position is `axes` times a point of the model).
pub fn views_geojson(plan: &Plan, place: &Georeference) -> String {
    let frame = MapFrame::new(&plan.stages.scene, plan.stages.settings.surface.up);
    let local = *place == Georeference::Local;
    let position = |point: &Point3<f64>| match place.geodetic(point) {
        Some(at) => [
            // A billionth of a degree is a tenth of a millimetre.
            to_decimals(at.longitude, 9),
            to_decimals(at.latitude, 9),
            to_decimals(at.height, 4),
        ],
        None => frame.direction(&point.coords).map(|x| to_decimals(x, 6)),
    };
    let ranked = plan.ranked().map(|cluster| cluster.key);
    let rank = plan.stages.scene.places_of(ranked);
    let footprints = footprints(&plan.stages.surface, &plan.stages.visibility, &frame);
    let features = |view: ViewIndex| {
        let properties = |what: &str| properties(plan, view, rank[view.index()], what);
        let centre = plan.stages.scene.view(view).cam_from_world.centre();
        let point = json!({ "type": "Point", "coordinates": position(&centre) });
        let mut features = vec![feature(point, properties("camera"))];
        let corners: Vec<_> = footprints[view.index()].iter().map(&position).collect();
        if corners.len() >= 3 {
            let area = if local {
                polygon(corners)
            } else {
                polygon_on_the_earth(corners)
            };
            features.push(feature(area, properties("footprint")));
        }
        features
    };
    let views: Vec<ViewIndex> = plan.stages.scene.view_indices().collect();
    let features: Vec<Value> = views.into_par_iter().flat_map_iter(features).collect();
    let mut collection = json!({ "type": "FeatureCollection", "frame": place.describe() });
    if local {
        collection["note"] = json!(
            "local coordinates, not WGS 84: in QGIS, set a custom or engineering CRS for this layer"
        );
        collection["crs"] = Value::Null;
        collection["axes"] = json!(frame.axes.map(|axis| [axis.x, axis.y, axis.z]));
    }
    let region = plan.stages.region.as_ref().map(|region| {
        json!({
            "type": "Feature",
            "geometry": region_geometry(&region.outline, &frame, position),
            "properties": { "what": "region", "kind": region.kind },
        })
    });
    collection["features"] = features.into_iter().chain(region).collect();
    json_escaped(&collection.to_string()) + "\n"
}

/// Returns the region on the map as it was given, or the hull of its corners.
fn region_geometry(
    outline: &Outline,
    frame: &MapFrame,
    position: impl Fn(&Point3<f64>) -> [f64; 3],
) -> Value {
    let polygons = match outline {
        Outline::Geodetic(polygons) => json!(polygons),
        Outline::Polygons(polygons) => {
            let polygon = |rings: &Vec<Vec<Point3<f64>>>| {
                json!(
                    rings
                        .iter()
                        .map(|ring| ring.iter().map(&position).collect::<Vec<_>>())
                        .collect::<Vec<_>>()
                )
            };
            polygons.iter().map(polygon).collect()
        }
        Outline::Hull(points) => match frame.hull(points) {
            corners if corners.len() < 3 => json!([]),
            corners => json!([[closed(corners.iter().map(position).collect())]]),
        },
    };
    json!({ "type": "MultiPolygon", "coordinates": polygons })
}

fn closed(mut ring: Vec<[f64; 3]>) -> Vec<[f64; 3]> {
    // RFC 7946 ends a ring with its first position.
    ring.push(ring[0]);
    ring
}

fn polygon(corners: Vec<[f64; 3]>) -> Value {
    json!({ "type": "Polygon", "coordinates": [closed(corners)] })
}

/// Returns the polygon in longitude and latitude, cut at the 180th meridian if it crosses it, as
/// RFC 7946 (3.1.9) requires.
fn polygon_on_the_earth(mut corners: Vec<[f64; 3]>) -> Value {
    // Unwraps longitudes from the first corner, so that none jumps by 360 degrees.
    for i in 1..corners.len() {
        corners[i][0] -= 360.0 * ((corners[i][0] - corners[i - 1][0]) / 360.0).round();
    }
    let beyond = |meridian: f64| corners.iter().any(|c| (c[0] - meridian) * meridian > 0.0);
    let Some(meridian) = [-180.0, 180.0]
        .into_iter()
        .find(|&meridian| beyond(meridian))
    else {
        return polygon(corners);
    };
    let inside = part(&corners, meridian, -meridian.signum());
    let mut outside = part(&corners, meridian, meridian.signum());
    outside
        .iter_mut()
        .for_each(|corner| corner[0] = to_decimals(corner[0] - 2.0 * meridian, 9));
    json!({ "type": "MultiPolygon", "coordinates": [[closed(inside)], [closed(outside)]] })
}

/// Clips the convex ring to one side of the meridian: 1 for east, -1 for west (Sutherland and
/// Hodgman 1974).
fn part(ring: &[[f64; 3]], meridian: f64, side: f64) -> Vec<[f64; 3]> {
    let mut part = Vec::new();
    for (from, to) in ring.iter().zip(ring.iter().cycle().skip(1)) {
        let [before, after] = [from, to].map(|corner| side * (corner[0] - meridian));
        if before >= 0.0 {
            part.push(*from);
        }
        if before * after < 0.0 {
            let t = before / (before - after);
            part.push([
                meridian,
                to_decimals(from[1] + t * (to[1] - from[1]), 9),
                to_decimals(from[2] + t * (to[2] - from[2]), 4),
            ]);
        }
    }
    part
}

fn feature(geometry: Value, properties: Value) -> Value {
    json!({ "type": "Feature", "geometry": geometry, "properties": properties })
}

/// `rank` is 0-based; ranks in the file are 1-based, as in all files.
fn properties(plan: &Plan, view: ViewIndex, rank: Option<usize>, what: &str) -> Value {
    let (status, reason) = plan.decision.views[view.index()];
    json!({
        "name": plan.stages.scene.name(view),
        "what": what,
        "status": status,
        "rank": rank.map(|rank| rank + 1),
        "gain": rank.map(|rank| plan.decision.ranking.gains[rank]),
        "share": rank.map(|rank| plan.decision.ranking.share(rank + 1)),
        "reason": reason,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rings(geometry: &Value) -> Vec<Vec<[f64; 3]>> {
        let of_polygon =
            |rings: &Value| serde_json::from_value::<Vec<Vec<[f64; 3]>>>(rings.clone()).unwrap();
        match geometry["type"].as_str().unwrap() {
            "Polygon" => of_polygon(&geometry["coordinates"]),
            _ => geometry["coordinates"]
                .as_array()
                .unwrap()
                .iter()
                .flat_map(of_polygon)
                .collect(),
        }
    }

    /// Returns twice the area, positive if counter-clockwise, and the smallest and the largest
    /// longitude.
    fn measured(ring: &[[f64; 3]]) -> (f64, f64, f64) {
        assert_eq!(ring.first(), ring.last());
        let area = ring
            .windows(2)
            .map(|w| w[0][0] * w[1][1] - w[1][0] * w[0][1])
            .sum();
        let longitudes = || ring.iter().map(|corner| corner[0]);
        (
            area,
            longitudes().fold(f64::MAX, f64::min),
            longitudes().fold(f64::MIN, f64::max),
        )
    }

    #[test]
    fn a_polygon_over_the_180th_meridian_is_cut_there() {
        let square = |west: f64, east: f64| {
            vec![
                [west, -1.0, 0.0],
                [east, -1.0, 0.0],
                [east, 1.0, 8.0],
                [west, 1.0, 8.0],
            ]
        };
        for (corners, meridian) in [
            (square(179.0, -178.0), 180.0),
            (square(-178.0, 179.0), -180.0),
        ] {
            let whole = polygon_on_the_earth(corners);
            let parts = rings(&whole);
            assert_eq!(
                (whole["type"].as_str(), parts.len()),
                (Some("MultiPolygon"), 2),
                "{meridian}"
            );
            let mut spans: Vec<_> = parts.iter().map(|ring| measured(ring)).collect();
            spans.sort_by(|a, b| a.1.total_cmp(&b.1));
            let order = if meridian > 0.0 { 1.0 } else { -1.0 };
            // The second square is the first one seen the other way round, so that its corners run
            // clockwise.
            let spans: Vec<_> = spans
                .into_iter()
                .map(|(area, west, east)| (order * area, west, east))
                .collect();
            assert_eq!(
                spans,
                [(8.0, -180.0, -178.0), (4.0, 179.0, 180.0)],
                "{whole}"
            );
        }
        let plain = polygon_on_the_earth(square(10.0, 12.0));
        assert_eq!(
            (plain["type"].as_str(), measured(&rings(&plain)[0])),
            (Some("Polygon"), (8.0, 10.0, 12.0))
        );
        let touching = polygon_on_the_earth(square(179.0, 180.0));
        assert_eq!(touching["type"], "Polygon");
    }
}
