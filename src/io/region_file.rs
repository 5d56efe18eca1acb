//! Files of regions: GeoJSON polygons (RFC 7946), closed PLY meshes, or the six numbers of a box. The contents tell them apart.
//!
//! The reader of GeoJSON takes the polygons of features, collections and bare geometries, with their holes and parts but without heights; the
//! properties `weight` and `gsd`; and the member `crs` of the 2008 specification, which QGIS still writes, if it is WGS 84 or null. It ignores
//! everything else.

use std::{io, path::Path};

use serde_json::{Map, Value};

use super::ply::{self, Mesh, PlyError};
use crate::base::input::{self, FileKind};

/// Largest magnitude of a coordinate; no survey has larger ones, and their products stay finite.
const LARGEST: f64 = 1e12;
/// Range of weights: 0 leaves an area out, larger numbers would drown all others.
const WEIGHTS: std::ops::RangeInclusive<f64> = 0.0..=1e6;
/// Range of wanted resolutions, scene units per pixel, which are kept as f32.
const GSDS: std::ops::RangeInclusive<f64> = 1e-30..=1e30;

/// Contents of the file of a region.
#[derive(Clone, Debug, PartialEq)]
pub enum RegionFile {
    Areas(Areas),
    /// In the frame of the model; not checked to be closed.
    Mesh(Mesh),
    /// Two opposite corners in the frame of the model.
    Box([f64; 6]),
}

/// Polygons on a map, in the order of the file: where some overlap, the last one holds.
#[derive(Clone, Debug, PartialEq)]
pub struct Areas {
    pub coordinates: Coordinates,
    pub areas: Vec<Area>,
}

/// Coordinate system of a GeoJSON file.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Coordinates {
    /// The file doesn't say: longitude and latitude, unless the model has no georeference.
    Unsaid,
    /// `crs` names WGS 84: longitude and latitude, degrees.
    Geodetic,
    /// `crs` is null: scene units along the first two `axes` (unit vectors, world coordinates), without them those of the map.
    Model { axes: Option<[[f64; 3]; 3]> },
}

/// Polygons of a feature and their properties.
#[derive(Clone, Debug, PartialEq)]
pub struct Area {
    pub polygons: Vec<Polygon>,
    /// Factor on the weight of what is inside, at least 0.
    pub weight: f64,
    /// Wanted ground sampling distance inside, scene units per pixel.
    pub gsd: Option<f64>,
}

/// Rings of a polygon, the outer one first, then its holes; the first position may be repeated at the end.
pub type Polygon = Vec<Vec<[f64; 2]>>;

/// Errors of a region's file.
#[derive(Debug, thiserror::Error)]
pub enum RegionFault {
    #[error(transparent)]
    Read(#[from] io::Error),
    #[error("it is neither GeoJSON nor PLY nor six numbers")]
    Unknown,
    #[error(transparent)]
    Json(#[from] serde_json::Error),
    #[error("feature {number}: {what}")]
    Feature { number: usize, what: String },
    #[error("{0}")]
    Collection(String),
    #[error(transparent)]
    Ply(#[from] PlyError),
}

/// Reads a file of a region.
pub fn read(path: &Path) -> Result<RegionFile, RegionFault> {
    parse(&input::read(path, FileKind::Region)?)
}

/// Parses the contents of such a file.
pub fn parse(bytes: &[u8]) -> Result<RegionFile, RegionFault> {
    // Editors on Windows put a byte order mark before text.
    let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
    let start = bytes.iter().position(|b| !b.is_ascii_whitespace()).unwrap_or(0);
    match &bytes[start..] {
        [b'{', ..] => Ok(RegionFile::Areas(areas(&serde_json::from_slice(bytes)?)?)),
        [b'p', b'l', b'y', b'\n' | b'\r', ..] => Ok(RegionFile::Mesh(ply::read(&bytes[start..])?)),
        text if text.len() < 4096 => {
            let numbers = std::str::from_utf8(text).ok().and_then(parse_box);
            numbers.map(RegionFile::Box).ok_or(RegionFault::Unknown)
        }
        _ => Err(RegionFault::Unknown),
    }
}

/// Reads six finite numbers, separated by commas or blanks; `None` where there are others.
pub fn parse_box(text: &str) -> Option<[f64; 6]> {
    let words = text.split(|c: char| c == ',' || c.is_whitespace()).filter(|word| !word.is_empty());
    let numbers: Vec<f64> = words.map(str::parse).collect::<Result<_, _>>().ok()?;
    numbers.try_into().ok().filter(|numbers: &[f64; 6]| numbers.iter().all(|x| x.abs() <= LARGEST))
}

fn areas(json: &Value) -> Result<Areas, RegionFault> {
    let mut areas = Vec::new();
    for (number, feature) in (1..).zip(features(json)?) {
        let area = area(feature).map_err(|what| RegionFault::Feature { number, what })?;
        areas.extend(area.filter(|area| !area.polygons.is_empty()));
    }
    match areas.is_empty() {
        true => Err(RegionFault::Collection("it has no polygon".into())),
        false => Ok(Areas { coordinates: coordinates(json).map_err(RegionFault::Collection)?, areas }),
    }
}

/// The features of a collection; a feature or a geometry alone is one.
fn features(json: &Value) -> Result<Vec<&Value>, RegionFault> {
    if json["type"] != "FeatureCollection" {
        return Ok(vec![json]);
    }
    match &json["features"] {
        Value::Array(features) => Ok(features.iter().collect()),
        _ => Err(RegionFault::Collection("the collection has no list \"features\"".into())),
    }
}

/// The area of a feature; `None` for a feature without a geometry.
fn area(feature: &Value) -> Result<Option<Area>, String> {
    let empty = Map::new();
    let (geometry, properties) = match feature["type"].as_str() {
        Some("Feature") => (&feature["geometry"], feature["properties"].as_object().unwrap_or(&empty)),
        _ => (feature, &empty),
    };
    if geometry.is_null() {
        return Ok(None);
    }
    let mut polygons = Vec::new();
    collect(geometry, &mut polygons)?;
    let weight = number(properties, "weight", WEIGHTS)?.unwrap_or(1.0);
    Ok(Some(Area { polygons, weight, gsd: number(properties, "gsd", GSDS)? }))
}

/// A property that is a number; GIS programs write null where a field is empty.
fn number(
    properties: &Map<String, Value>,
    name: &str,
    range: std::ops::RangeInclusive<f64>,
) -> Result<Option<f64>, String> {
    match properties.get(name) {
        None | Some(Value::Null) => Ok(None),
        Some(value) => match value.as_f64().filter(|number| range.contains(number)) {
            Some(number) => Ok(Some(number)),
            None => Err(format!("{name} is {value}, not a number from {} to {:e}", range.start(), range.end())),
        },
    }
}

/// Appends the polygons of a geometry.
fn collect(geometry: &Value, polygons: &mut Vec<Polygon>) -> Result<(), String> {
    let list =
        |member: &str| geometry[member].as_array().ok_or_else(|| format!("the geometry has no list \"{member}\""));
    match geometry["type"].as_str() {
        Some("Polygon") => polygons.push(polygon(list("coordinates")?)?),
        Some("MultiPolygon") => {
            for part in list("coordinates")? {
                polygons.push(polygon(part.as_array().ok_or("a polygon is not a list of rings")?)?);
            }
        }
        Some("GeometryCollection") => {
            for part in list("geometries")? {
                collect(part, polygons)?;
            }
        }
        Some(kind) => return Err(format!("a {kind} encloses no area")),
        None => return Err("it has no \"type\"".into()),
    }
    Ok(())
}

fn polygon(rings: &[Value]) -> Result<Polygon, String> {
    if rings.is_empty() {
        return Err("a polygon has no ring".into());
    }
    rings.iter().map(ring).collect()
}

fn ring(ring: &Value) -> Result<Vec<[f64; 2]>, String> {
    let positions = ring.as_array().ok_or("a ring is not a list of positions")?;
    let positions: Vec<[f64; 2]> = positions.iter().map(position).collect::<Result<_, _>>()?;
    let mut distinct = positions.clone();
    distinct.dedup();
    let is_closed = distinct.len() > 1 && distinct.first() == distinct.last();
    match distinct.len() - usize::from(is_closed) {
        3.. => Ok(positions),
        few => Err(format!("a ring of {few} different positions encloses no area")),
    }
}

fn position(position: &Value) -> Result<[f64; 2], String> {
    let wrong = || format!("{position} is not a position");
    let numbers = position.as_array().filter(|numbers| numbers.len() >= 2).ok_or_else(wrong)?;
    let at = |i: usize| numbers[i].as_f64().filter(|x| x.abs() <= LARGEST).ok_or_else(wrong);
    Ok([at(0)?, at(1)?])
}

fn coordinates(json: &Value) -> Result<Coordinates, String> {
    let Some(crs) = json.get("crs") else { return Ok(Coordinates::Unsaid) };
    if crs.is_null() {
        let axes = match json.get("axes") {
            None => None,
            Some(axes) => Some(serde_json::from_value(axes.clone()).map_err(|_| "axes are not three vectors")?),
        };
        return Ok(Coordinates::Model { axes });
    }
    let name = crs["properties"]["name"].as_str().unwrap_or_default();
    let is_geodetic = ["CRS84", "CRS84h", "4326", "4979"].iter().any(|end| name.ends_with(end));
    match is_geodetic {
        true => Ok(Coordinates::Geodetic),
        false => Err(format!("its coordinates are in {crs}, not in WGS 84")),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn areas_of(json: &Value) -> Areas {
        match parse(json.to_string().as_bytes()) {
            Ok(RegionFile::Areas(areas)) => areas,
            other => panic!("{other:?}"),
        }
    }

    fn square(size: f64) -> Value {
        json!([[0.0, 0.0], [size, 0.0], [size, size, 7.0], [0.0, size], [0.0, 0.0]])
    }

    #[test]
    fn polygons_keep_their_holes_parts_and_wishes() {
        let geojson = json!({ "type": "FeatureCollection", "features": [
            { "type": "Feature", "properties": { "weight": 2, "gsd": 0.01, "name": "court" },
              "geometry": { "type": "Polygon", "coordinates": [square(4.0), square(1.0)] } },
            { "type": "Feature", "properties": null, "geometry": null },
            { "type": "Feature", "properties": { "weight": null },
              "geometry": { "type": "MultiPolygon", "coordinates": [[square(1.0)], [square(2.0)]] } },
        ]});
        let Areas { coordinates, areas } = areas_of(&geojson);
        assert_eq!(coordinates, Coordinates::Unsaid);
        let shape = |area: &Area| area.polygons.iter().map(Vec::len).collect::<Vec<_>>();
        assert_eq!(areas.iter().map(shape).collect::<Vec<_>>(), [vec![2], vec![1, 1]]);
        assert_eq!(areas.iter().map(|a| (a.weight, a.gsd)).collect::<Vec<_>>(), [(2.0, Some(0.01)), (1.0, None)]);
        assert_eq!(areas[0].polygons[0][0][2], [4.0, 4.0]);
        let bare = areas_of(&json!({ "type": "GeometryCollection", "geometries": [
            { "type": "Polygon", "coordinates": [square(1.0)] }, { "type": "Polygon", "coordinates": [square(2.0)] }
        ]}));
        assert_eq!(shape(&bare.areas[0]), [1, 1]);
    }

    #[test]
    fn coordinates_are_of_the_model_or_wgs_84() {
        let with = |crs: Value| json!({ "type": "Polygon", "coordinates": [square(1.0)], "crs": crs });
        assert_eq!(areas_of(&with(Value::Null)).coordinates, Coordinates::Model { axes: None });
        let named = |name: &str| with(json!({ "type": "name", "properties": { "name": name } }));
        assert_eq!(areas_of(&named("urn:ogc:def:crs:OGC:1.3:CRS84")).coordinates, Coordinates::Geodetic);
        let utm = parse(named("urn:ogc:def:crs:EPSG::32633").to_string().as_bytes());
        assert!(matches!(utm, Err(RegionFault::Collection(_))), "{utm:?}");
    }

    #[test]
    fn a_box_and_a_mesh_are_told_by_their_contents() {
        assert_eq!(parse(b" 0 0 0\n1 2 3\n").unwrap(), RegionFile::Box([0.0, 0.0, 0.0, 1.0, 2.0, 3.0]));
        let ply = ply::write(&[Default::default(); 3], &[[0, 1, 2]], &[], &[]);
        assert!(matches!(parse(&ply), Ok(RegionFile::Mesh(mesh)) if mesh.triangles == [[0, 1, 2]]));
    }

    #[test]
    fn what_is_no_region_is_refused() {
        let feature = |geometry: Value, properties: Value| {
            json!({ "type": "Feature", "geometry": geometry, "properties": properties }).to_string()
        };
        let good = || json!({ "type": "Polygon", "coordinates": [square(1.0)] });
        for text in [
            feature(good(), json!({ "weight": -1 })),
            feature(good(), json!({ "weight": "2" })),
            feature(good(), json!({ "gsd": 0 })),
            feature(json!({ "type": "LineString", "coordinates": [[0, 0], [1, 1]] }), Value::Null),
            feature(json!({ "type": "Polygon", "coordinates": [[[0, 0], [1, 1], [0, 0]]] }), Value::Null),
            feature(json!({ "type": "Polygon", "coordinates": [[]] }), Value::Null),
            feature(json!({ "type": "Polygon", "coordinates": [[[0, 0], [1, "x"], [1, 1]]] }), Value::Null),
            feature(json!({ "type": "Polygon", "coordinates": [[[0, 0], [1e300, 0], [1, 1]]] }), Value::Null),
            feature(json!({ "type": "Polygon" }), Value::Null),
            feature(Value::Null, Value::Null),
            json!({ "type": "FeatureCollection" }).to_string(),
            json!({ "type": "FeatureCollection", "features": [3, "x"] }).to_string(),
            "{\"type\": \"Polygon\", \"coordinates\": [[[0, 0], [NaN, 0], [1, 1]]]}".into(),
            "{".into(),
            format!("{{\"type\": \"Polygon\", \"coordinates\": {}", "[".repeat(100_000)),
            "1 2 3 4 5 nan".into(),
            String::new(),
            "\u{0}".repeat(10_000),
        ] {
            assert!(parse(text.as_bytes()).is_err(), "{}", &text[..text.len().min(200)]);
        }
    }
}
