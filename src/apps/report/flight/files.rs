//! The images to take as files: GeoJSON, KML and CSV where the model has a place on earth, else PLY
//! and local JSON.

use std::fmt::Write;

use serde_json::{Value, json};

use super::{Flight, Waypoint};
use crate::{
    base::{
        decimals::to_decimals,
        printable::{in_markup, json_escaped},
    },
    model::georeference::{Georeference, MapFrame},
    show::pictures::views_file,
};

/// File names below the plan's folder, with their text; none without waypoints. `missing`: what
/// each hole lacks; `metres`: in a scene unit, if known; `remarks`: see [`Flight::remarks`].
pub fn files(
    flight: &Flight,
    missing: &[String],
    frame: &MapFrame,
    place: &Georeference,
    metres: Option<f64>,
    remarks: &str,
) -> Vec<(&'static str, String)> {
    if flight.waypoints.is_empty() {
        return Vec::new();
    }
    let is_local = views_file(place) != "views.geojson";
    let all: Vec<Described> = flight
        .waypoints
        .iter()
        .map(|w| Described::new(w, missing, frame, place, metres.unwrap_or(1.0)))
        .collect();
    if is_local {
        vec![
            ("flight/waypoints_local.json", geojson(&all, remarks, true)),
            ("flight/waypoints.ply", ply(flight, remarks)),
        ]
    } else {
        vec![
            ("flight/waypoints.geojson", geojson(&all, remarks, false)),
            ("flight/waypoints.kml", kml(&all, remarks)),
            ("flight/waypoints.csv", csv(&all)),
        ]
    }
}

/// Slope of a viewing direction from the vertical below which its heading means nothing: the
/// vertical of the map is not quite that of the place.
const LEVEL: f64 = 0.02;

/// A waypoint in the coordinates of its file.
struct Described<'a> {
    waypoint: &'a Waypoint,
    /// Longitude, latitude and height above the ellipsoid; or x to the right, y up the map and z
    /// up, scene units.
    position: [f64; 3],
    /// Clockwise from north, or from the map's up, degrees, to a tenth.
    heading: f64,
    /// Above the horizon, degrees; -90 straight down.
    pitch: f64,
    /// Above the surface, and from what it looks at: metres where these are known.
    height: f64,
    distance: f64,
    missing: &'a str,
}

impl<'a> Described<'a> {
    fn new(
        waypoint: &'a Waypoint,
        missing: &'a [String],
        frame: &MapFrame,
        place: &Georeference,
        per_unit: f64,
    ) -> Self {
        let ahead = waypoint.centre + waypoint.direction * waypoint.distance;
        let (position, [east, north, up]) =
            match (place.geodetic(&waypoint.centre), place.geodetic(&ahead)) {
                (Some(from), Some(to)) => (
                    [from.longitude, from.latitude, from.height],
                    from.offset_to(to),
                ),
                // As in `views_local.json`: the axes of the map, but the origin of the model.
                _ => (
                    frame.direction(&waypoint.centre.coords),
                    frame.direction(&waypoint.direction),
                ),
            };
        let heading = if east.hypot(north) > LEVEL * up.abs() {
            east.atan2(north)
        } else {
            // Straight down: the top of the image is up the map.
            up_the_map(waypoint, frame, place)
        };
        // Rounded first: a hair west of north is 0, not 360.
        let heading = to_decimals(heading.to_degrees(), 1).rem_euclid(360.0) + 0.0;
        Self {
            waypoint,
            position,
            heading,
            pitch: up.atan2(east.hypot(north)).to_degrees(),
            height: per_unit * waypoint.height,
            distance: per_unit * waypoint.distance,
            missing: &missing[waypoint.hole],
        }
    }

    fn properties(&self, number: usize) -> Value {
        json!({
            "name": format!("{number}"), "rank": self.waypoint.rank, "hole": self.waypoint.hole + 1, "missing": self.missing,
            "heading_deg": self.heading, "gimbal_pitch_deg": to_decimals(self.pitch, 1),
            "height_above_surface": to_decimals(self.height, 3), "distance": to_decimals(self.distance, 3),
            "overlap": to_decimals(self.waypoint.overlap, 2),
        })
    }
}

/// Bearing of the map's up at an image, radians clockwise from north.
fn up_the_map(waypoint: &Waypoint, frame: &MapFrame, place: &Georeference) -> f64 {
    let ahead = waypoint.centre + frame.axes[1] * waypoint.distance;
    match (place.geodetic(&waypoint.centre), place.geodetic(&ahead)) {
        (Some(from), Some(to)) => {
            let [east, north, _] = from.offset_to(to);
            east.atan2(north)
        }
        _ => 0.0,
    }
}

fn geojson(all: &[Described], remarks: &str, local: bool) -> String {
    let feature = |(i, w): (usize, &Described)| json!({ "type": "Feature", "geometry": { "type": "Point", "coordinates": coordinates(w, local) }, "properties": w.properties(i + 1) });
    collection(
        all.iter().enumerate().map(feature).collect(),
        remarks,
        local,
    )
}

/// Text of a GeoJSON file; `local`: in the coordinates of `views_local.json`.
pub(super) fn collection(features: Vec<Value>, remarks: &str, local: bool) -> String {
    let frame = local.then_some("Local coordinates as in views_local.json, not WGS 84.");
    let notes: Vec<&str> = frame.into_iter().chain([remarks]).collect();
    let mut collection =
        json!({ "type": "FeatureCollection", "note": notes.join(" "), "features": features });
    if local {
        // Says that the frame is unknown: without it, GeoJSON is in degrees.
        collection["crs"] = Value::Null;
    }
    json_escaped(&collection.to_string()) + "\n"
}

fn coordinates(waypoint: &Described, local: bool) -> [f64; 3] {
    // Nine decimals of a degree are a tenth of a millimetre.
    let digits = if local { [6, 6, 6] } else { [9, 9, 3] };
    [0, 1, 2].map(|i| to_decimals(waypoint.position[i], digits[i]))
}

fn kml(all: &[Described], remarks: &str) -> String {
    let mut text = format!(
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<kml xmlns=\"http://www.opengis.net/kml/2.2\"><Document><name>Images to take</name><description>{} Heights are above the ellipsoid.</description>\n",
        in_markup(remarks)
    );
    let position = |w: &Described| {
        let [longitude, latitude, height] = coordinates(w, false);
        format!("{longitude},{latitude},{height}")
    };
    for (i, w) in all.iter().enumerate() {
        let [longitude, latitude, height] = coordinates(w, false);
        // KML's tilt is 0 straight down.
        let _ = writeln!(
            text,
            "<Placemark><name>{}</name><description>hole {}: {}; heading {:.1}, pitch {:.1} degrees, {:.1} m above the surface</description>\
             <Camera><longitude>{longitude}</longitude><latitude>{latitude}</latitude><altitude>{height}</altitude><heading>{:.1}</heading>\
             <tilt>{:.1}</tilt><altitudeMode>absolute</altitudeMode></Camera>\
             <Point><altitudeMode>absolute</altitudeMode><coordinates>{}</coordinates></Point></Placemark>",
            i + 1,
            w.waypoint.hole + 1,
            w.missing,
            w.heading,
            w.pitch,
            w.height,
            w.heading,
            90.0 + w.pitch,
            position(w)
        );
    }
    let line: Vec<String> = all.iter().map(position).collect();
    let _ = writeln!(
        text,
        "<Placemark><name>route</name><LineString><altitudeMode>absolute</altitudeMode><coordinates>{}</coordinates></LineString></Placemark>",
        line.join(" ")
    );
    text + "</Document></kml>\n"
}

fn csv(all: &[Described]) -> String {
    let mut text = String::from(
        "number,longitude,latitude,height_above_ellipsoid_m,height_above_surface_m,heading_deg,gimbal_pitch_deg,overlap,hole,missing,rank\n",
    );
    for (i, w) in all.iter().enumerate() {
        let [longitude, latitude, height] = coordinates(w, false);
        // In quotes, because what is missing is said with commas.
        let _ = writeln!(
            text,
            "{},{longitude:.9},{latitude:.9},{height:.3},{:.2},{:.1},{:.1},{:.2},{},\"{}\",{}",
            i + 1,
            w.height,
            w.heading,
            w.pitch,
            w.waypoint.overlap,
            w.waypoint.hole + 1,
            w.missing,
            w.waypoint.rank
        );
    }
    text
}

/// A text in the letters that headers of PLY may have; the region's name may be in any.
fn ascii(text: &str) -> String {
    let letter = |c: char| if matches!(c, ' '..='~') { c } else { '?' };
    text.chars().map(letter).collect()
}

/// Camera centres in the coordinates of the model, their viewing directions as normals.
fn ply(flight: &Flight, remarks: &str) -> String {
    let mut text = format!(
        "ply\nformat ascii 1.0\ncomment images to take, coordinates of the model; normals: viewing directions\ncomment {}\nelement vertex {}\n",
        ascii(remarks),
        flight.waypoints.len()
    );
    for name in ["x", "y", "z", "nx", "ny", "nz"] {
        let _ = writeln!(text, "property double {name}");
    }
    text += "property int hole\nproperty int rank\nend_header\n";
    for w in &flight.waypoints {
        let (c, d) = (w.centre, w.direction);
        let _ = writeln!(
            text,
            "{:.6} {:.6} {:.6} {:.6} {:.6} {:.6} {} {}",
            c.x,
            c.y,
            c.z,
            d.x,
            d.y,
            d.z,
            w.hole + 1,
            w.rank
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_name_of_a_region_may_be_any() {
        let remarks = "region: <é>\n&.geojson";
        assert!(kml(&[], remarks).contains("region: &lt;é&gt;\\n&amp;.geojson"));
        let head = ply(&Flight::default(), remarks);
        assert!(head.is_ascii() && head.contains("comment region: <?>?&.geojson\nelement"));
    }
}
