//! Files of regions: GeoJSON polygons (RFC 7946), closed PLY meshes, or the six numbers of a box.
//! The contents tell them apart.
//!
//! The reader of GeoJSON takes the polygons of features, collections and bare geometries, with
//! their holes and parts but without heights; the properties `weight` and `gsd`; and the member
//! `crs` of the 2008 specification, which QGIS still writes, if it is WGS 84 or null. It ignores
//! everything else.

use std::{fmt, io, ops::RangeInclusive, path::Path};

use serde::{
    Deserialize, Deserializer,
    de::{self, Error, IgnoredAny, SeqAccess, Visitor},
};
use serde_json::value::RawValue;
use viewrank_core::{
    method::region::{Area, Areas, Coordinates, Polygon},
    model::mesh::Mesh,
};

use crate::{
    input::{self, FileKind},
    mistaken::{self, Mistaken},
    ply::{self, PlyError},
};

/// Largest magnitude of a coordinate; no survey has larger ones, and their products stay finite.
const LARGEST: f64 = 1e12;
/// Range of weights: 0 leaves an area out, larger numbers would drown all others.
const WEIGHTS: RangeInclusive<f64> = 0.0..=1e6;
/// Range of wanted resolutions, scene units per pixel, which are kept as f32.
const GSDS: RangeInclusive<f64> = 1e-30..=1e30;

/// Contents of the file of a region.
#[derive(Clone, Debug, PartialEq)]
pub enum RegionFile {
    Areas(Areas),
    /// In the frame of the model; not checked to be closed.
    Mesh(Mesh),
    /// Two opposite corners in the frame of the model.
    Box([f64; 6]),
}

/// Errors of a region's file.
#[derive(Debug, thiserror::Error)]
pub enum RegionFault {
    #[error(transparent)]
    Read(#[from] io::Error),
    #[error("it is neither GeoJSON nor PLY nor six numbers")]
    Unknown,
    #[error("it is {}", .0.what)]
    Mistaken(Mistaken),
    #[error(transparent)]
    Json(#[from] serde_json::Error),
    #[error("{0}")]
    Collection(String),
    #[error("more than {MOST_TRIANGLES} triangles: simplify the mesh")]
    Triangles,
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
    let start = bytes
        .iter()
        .position(|b| !b.is_ascii_whitespace())
        .unwrap_or(0);
    match &bytes[start..] {
        [b'{', ..] => Ok(RegionFile::Areas(areas(serde_json::from_slice(bytes)?)?)),
        [b'p', b'l', b'y', b'\n' | b'\r', ..] => {
            let mesh = ply::read_at_most(&bytes[start..], MOST_TRIANGLES)?;
            mesh.map(RegionFile::Mesh).ok_or(RegionFault::Triangles)
        }
        text if text.len() < 4096 => {
            let numbers = std::str::from_utf8(text).ok().and_then(parse_box);
            numbers.map(RegionFile::Box).ok_or(RegionFault::Unknown)
        }
        _ => Err(RegionFault::Unknown),
    }
    .map_err(|fault| {
        match (
            fault,
            other_map(bytes).or_else(|| mistaken::by_start(bytes)),
        ) {
            (RegionFault::Unknown, Some(mistaken)) => RegionFault::Mistaken(mistaken),
            (fault, _) => fault,
        }
    })
}

/// A map in another format, by its first bytes, with the command of GDAL that converts it.
fn other_map(bytes: &[u8]) -> Option<Mistaken> {
    let head = &bytes[..bytes.len().min(1024)];
    let has = |word: &[u8]| head.windows(word.len()).any(|window| window == word);
    let (what, cure) = if has(b"<kml") {
        (
            "KML",
            "convert it: ogr2ogr -f GeoJSON region.geojson FILE.kml",
        )
    } else if head.starts_with(b"PK\x03\x04") && has(b".kml") {
        (
            "KMZ",
            "convert it: ogr2ogr -f GeoJSON region.geojson FILE.kmz",
        )
    } else if head.starts_with(b"\0\0\x27\x0a") {
        (
            "a shapefile",
            "convert it: ogr2ogr -f GeoJSON -t_srs EPSG:4326 region.geojson FILE.shp",
        )
    } else if head.starts_with(b"SQLite format 3\0") {
        (
            "a GeoPackage",
            "convert it: ogr2ogr -f GeoJSON -t_srs EPSG:4326 region.geojson FILE.gpkg",
        )
    } else {
        return None;
    };
    Some(Mistaken { what, cure })
}

/// Reads six finite numbers, separated by commas or blanks; `None` where there are others.
pub fn parse_box(text: &str) -> Option<[f64; 6]> {
    let words = text
        .split(|c: char| c == ',' || c.is_whitespace())
        .filter(|word| !word.is_empty());
    let numbers: Vec<f64> = words.map(str::parse).collect::<Result<_, _>>().ok()?;
    numbers
        .try_into()
        .ok()
        .filter(|numbers: &[f64; 6]| numbers.iter().all(|x| x.abs() <= LARGEST))
}

/// Most positions of all polygons, and most triangles of a mesh: with their index and outline, a
/// plan takes about 600 and 300 bytes for each.
const MOST_POSITIONS: usize = 1_000_000;
const MOST_TRIANGLES: usize = 1_000_000;

/// An object of GeoJSON: a collection, a feature or a geometry. Nothing is kept of members that are
/// not read.
#[derive(Deserialize)]
struct Node {
    #[serde(rename = "type")]
    kind: Option<String>,
    features: Option<Nodes>,
    geometry: Option<Box<Node>>,
    geometries: Option<Nodes>,
    coordinates: Option<Nested>,
    properties: Option<Properties>,
    #[serde(default, deserialize_with = "even_if_null")]
    crs: Option<Option<Crs>>,
    /// Read only where `crs` is null: elsewhere it is anybody's.
    axes: Option<Box<RawValue>>,
}

#[derive(Deserialize)]
struct Properties {
    weight: Option<f64>,
    gsd: Option<f64>,
}

#[derive(Deserialize)]
struct Crs {
    #[serde(default)]
    properties: CrsProperties,
}

#[derive(Default, Deserialize)]
struct CrsProperties {
    #[serde(default)]
    name: String,
}

/// Tells null from a member that is missing.
fn even_if_null<'de, D: Deserializer<'de>>(
    deserializer: D,
) -> Result<Option<Option<Crs>>, D::Error> {
    Deserialize::deserialize(deserializer).map(Some)
}

/// A list of features or geometries, of which those without a polygon are left out.
struct Nodes(Vec<Area>);

impl<'de> Deserialize<'de> for Nodes {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct List;
        impl<'de> Visitor<'de> for List {
            type Value = Nodes;
            fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
                f.write_str("a list of features or geometries")
            }
            fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Nodes, A::Error> {
                let (mut areas, mut positions) = (Vec::new(), 0);
                let mut number = 0;
                while let Some(node) = list.next_element::<Node>()? {
                    number += 1;
                    let fault =
                        |what| A::Error::custom(format!("number {number} of the list: {what}"));
                    let area = area(node)
                        .map_err(fault)?
                        .filter(|area| !area.polygons.is_empty());
                    positions += area.iter().map(positions_of).sum::<usize>();
                    check_positions(positions).map_err(fault)?;
                    areas.extend(area);
                }
                Ok(Nodes(areas))
            }
        }
        deserializer.deserialize_seq(List)
    }
}

/// Coordinates: positions in lists of lists.
enum Nested {
    Number(f64),
    Position([f64; 2]),
    List(Vec<Nested>),
}

impl<'de> Deserialize<'de> for Nested {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(NestedVisitor)
    }
}

struct NestedVisitor;

impl<'de> Visitor<'de> for NestedVisitor {
    type Value = Nested;

    fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("a position or a list of positions")
    }

    fn visit_f64<E: de::Error>(self, number: f64) -> Result<Nested, E> {
        Ok(Nested::Number(number))
    }

    fn visit_u64<E: de::Error>(self, number: u64) -> Result<Nested, E> {
        Ok(Nested::Number(number as f64))
    }

    fn visit_i64<E: de::Error>(self, number: i64) -> Result<Nested, E> {
        Ok(Nested::Number(number as f64))
    }

    /// Refuses coordinates that fit no polygon before more of them are read.
    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Nested, A::Error> {
        let mut members = Vec::new();
        while let Some(member) = list.next_element::<Nested>()? {
            match (member, members.first()) {
                (Nested::Number(x), None) => {
                    let y = list
                        .next_element()?
                        .ok_or_else(|| A::Error::custom("one number is not a position"))?;
                    while list.next_element::<IgnoredAny>()?.is_some() {}
                    let is_wrong = [x, y].iter().any(|x: &f64| x.abs() > LARGEST);
                    let wrong = || A::Error::custom(format!("{x}, {y} is not a position"));
                    return if is_wrong {
                        Err(wrong())
                    } else {
                        Ok(Nested::Position([x, y]))
                    };
                }
                (Nested::Number(_), Some(_)) => {
                    return Err(A::Error::custom("a number among positions"));
                }
                (Nested::List(inner), _) if inner.is_empty() => {
                    return Err(A::Error::custom("a polygon has no ring"));
                }
                (member, _) => members.push(member),
            }
        }
        match members.first() {
            Some(Nested::Position(_)) if members.len() < 3 => {
                Err(A::Error::custom(few(members.len())))
            }
            _ => Ok(Nested::List(members)),
        }
    }
}

fn few(positions: usize) -> String {
    format!("a ring of {positions} different positions encloses no area")
}

fn check_positions(positions: usize) -> Result<(), String> {
    if positions <= MOST_POSITIONS {
        return Ok(());
    }
    Err(format!(
        "more than {MOST_POSITIONS} positions: simplify the polygons"
    ))
}

fn positions_of(area: &Area) -> usize {
    area.polygons.iter().flatten().map(Vec::len).sum()
}

fn areas(mut node: Node) -> Result<Areas, RegionFault> {
    let (crs, axes) = (node.crs.take(), node.axes.take());
    let areas = if node.kind.as_deref() == Some("FeatureCollection") {
        node.features
            .ok_or_else(|| {
                RegionFault::Collection("the collection has no list \"features\"".into())
            })?
            .0
    } else {
        area(node)
            .map_err(RegionFault::Collection)?
            .into_iter()
            .collect()
    };
    if areas.iter().all(|area| area.polygons.is_empty()) {
        return Err(RegionFault::Collection("it has no polygon".into()));
    }
    check_positions(areas.iter().map(positions_of).sum()).map_err(RegionFault::Collection)?;
    Ok(Areas {
        coordinates: coordinates(crs, axes.as_deref()).map_err(RegionFault::Collection)?,
        areas,
    })
}

/// The area of a feature or a bare geometry; `None` for a feature without a geometry.
fn area(node: Node) -> Result<Option<Area>, String> {
    let (geometry, properties) = match node.kind.as_deref() {
        Some("Feature") => (node.geometry.map(|geometry| *geometry), node.properties),
        _ => (Some(node), None),
    };
    let Some(geometry) = geometry else {
        return Ok(None);
    };
    let within = |name: &str, number: Option<f64>, range: RangeInclusive<f64>| match number {
        Some(number) if !range.contains(&number) => Err(format!(
            "{name} is {number}, not a number from {} to {:e}",
            range.start(),
            range.end()
        )),
        number => Ok(number),
    };
    let (weight, gsd) = properties.map_or((None, None), |properties| {
        (properties.weight, properties.gsd)
    });
    Ok(Some(Area {
        polygons: polygons(geometry)?,
        weight: within("weight", weight, WEIGHTS)?.unwrap_or(1.0),
        gsd: within("gsd", gsd, GSDS)?,
    }))
}

fn polygons(geometry: Node) -> Result<Vec<Polygon>, String> {
    let coordinates = || "the geometry has no list \"coordinates\"";
    match geometry.kind.as_deref() {
        Some("Polygon") => Ok(vec![polygon(
            geometry.coordinates.ok_or_else(coordinates)?,
        )?]),
        Some("MultiPolygon") => members(geometry.coordinates.ok_or_else(coordinates)?)?
            .map(polygon)
            .collect(),
        Some("GeometryCollection") => {
            let parts = geometry
                .geometries
                .ok_or("the geometry has no list \"geometries\"")?;
            Ok(parts.0.into_iter().flat_map(|part| part.polygons).collect())
        }
        Some(kind) => Err(format!("a {kind} encloses no area")),
        None => Err("it has no \"type\"".into()),
    }
}

fn members(list: Nested) -> Result<impl Iterator<Item = Nested>, String> {
    match list {
        Nested::List(members) => Ok(members.into_iter()),
        Nested::Position([x, y]) => Err(format!(
            "the position {x}, {y} where a list of positions belongs"
        )),
        Nested::Number(x) => Err(format!("the number {x} where a list of positions belongs")),
    }
}

fn polygon(rings: Nested) -> Result<Polygon, String> {
    let rings: Polygon = members(rings)?.map(ring).collect::<Result<_, _>>()?;
    if rings.is_empty() {
        Err("a polygon has no ring".into())
    } else {
        Ok(rings)
    }
}

fn ring(ring: Nested) -> Result<Vec<[f64; 2]>, String> {
    let position = |member| match member {
        Nested::Position(position) => Ok(position),
        _ => Err("a ring is not a list of positions".to_string()),
    };
    let positions: Vec<[f64; 2]> = members(ring)?.map(position).collect::<Result<_, _>>()?;
    let changes = positions
        .windows(2)
        .filter(|pair| pair[0] != pair[1])
        .count();
    let is_closed = changes > 0 && positions.first() == positions.last();
    match (changes + 1).min(positions.len()) - usize::from(is_closed) {
        3.. => Ok(positions),
        distinct => Err(few(distinct)),
    }
}

fn coordinates(crs: Option<Option<Crs>>, axes: Option<&RawValue>) -> Result<Coordinates, String> {
    let crs = match crs {
        None => return Ok(Coordinates::Unsaid),
        Some(None) => {
            let axes = axes
                .map(|axes| serde_json::from_str(axes.get()))
                .transpose();
            return Ok(Coordinates::Model {
                axes: axes.map_err(|error| format!("axes: {error}"))?,
            });
        }
        Some(Some(crs)) => crs,
    };
    let name = crs.properties.name;
    let is_geodetic = ["CRS84", "CRS84h", "4326", "4979"]
        .iter()
        .any(|end| name.ends_with(end));
    if is_geodetic {
        Ok(Coordinates::Geodetic)
    } else {
        Err(format!("its coordinates are in {name:?}, not in WGS 84"))
    }
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    fn areas_of(json: &Value) -> Areas {
        match parse(json.to_string().as_bytes()) {
            Ok(RegionFile::Areas(areas)) => areas,
            other => panic!("{other:?}"),
        }
    }

    fn square(size: f64) -> Value {
        json!([
            [0.0, 0.0],
            [size, 0.0],
            [size, size, 7.0],
            [0.0, size],
            [0.0, 0.0]
        ])
    }

    #[test]
    fn a_polygon_of_more_triangles_than_a_plan_takes_is_refused() {
        let file = |corners: usize| {
            let header = "ply\nformat binary_little_endian 1.0\nelement face 1\n\
                          property list uint uchar vertex_indices\nend_header\n";
            let count = (corners as u32).to_le_bytes();
            [header.as_bytes(), &count, &vec![0; corners]].concat()
        };
        let too_many = parse(&file(MOST_TRIANGLES + 3));
        assert!(matches!(too_many, Err(RegionFault::Triangles)));
        // It has no vertices, which is said only when all is read.
        let just_so = parse(&file(MOST_TRIANGLES + 2));
        assert!(matches!(just_so, Err(RegionFault::Ply(_))));
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
        assert_eq!(
            areas.iter().map(shape).collect::<Vec<_>>(),
            [vec![2], vec![1, 1]]
        );
        assert_eq!(
            areas.iter().map(|a| (a.weight, a.gsd)).collect::<Vec<_>>(),
            [(2.0, Some(0.01)), (1.0, None)]
        );
        assert_eq!(areas[0].polygons[0][0][2], [4.0, 4.0]);
        let bare = areas_of(&json!({ "type": "GeometryCollection", "geometries": [
            { "type": "Polygon", "coordinates": [square(1.0)] }, { "type": "Polygon", "coordinates": [square(2.0)] }
        ]}));
        assert_eq!(shape(&bare.areas[0]), [1, 1]);
    }

    #[test]
    fn coordinates_are_of_the_model_or_wgs_84() {
        let with =
            |crs: Value| json!({ "type": "Polygon", "coordinates": [square(1.0)], "crs": crs });
        assert_eq!(
            areas_of(&with(Value::Null)).coordinates,
            Coordinates::Model { axes: None }
        );
        let named = |name: &str| with(json!({ "type": "name", "properties": { "name": name } }));
        assert_eq!(
            areas_of(&named("urn:ogc:def:crs:OGC:1.3:CRS84")).coordinates,
            Coordinates::Geodetic
        );
        let utm = parse(named("urn:ogc:def:crs:EPSG::32633").to_string().as_bytes());
        assert!(matches!(utm, Err(RegionFault::Collection(_))), "{utm:?}");
    }

    #[test]
    fn a_box_and_a_mesh_are_told_by_their_contents() {
        assert_eq!(
            parse(b" 0 0 0\n1 2 3\n").unwrap(),
            RegionFile::Box([0.0, 0.0, 0.0, 1.0, 2.0, 3.0])
        );
        let ply = ply::write(&[Default::default(); 3], &[[0, 1, 2]], &[], &[]);
        assert!(matches!(parse(&ply), Ok(RegionFile::Mesh(mesh)) if mesh.triangles == [[0, 1, 2]]));
    }

    #[test]
    fn maps_in_other_formats_are_named_with_their_conversion() {
        for (start, name) in [
            (&b"<?xml version=\"1.0\"?>\n<kml xmlns=\"\">"[..], "KML"),
            (b"PK\x03\x04\x14\0\0\0\x08\0doc.kml", "KMZ"),
            (b"\0\0\x27\x0a\0\0\0\0", "a shapefile"),
            (b"SQLite format 3\0", "a GeoPackage"),
        ] {
            let file = [start, &[0; 5000]].concat();
            assert!(
                matches!(parse(&file), Err(RegionFault::Mistaken(Mistaken { what, cure }))
                    if what == name && cure.contains("ogr2ogr")),
                "{name}"
            );
        }
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
            feature(
                json!({ "type": "LineString", "coordinates": [[0, 0], [1, 1]] }),
                Value::Null,
            ),
            feature(
                json!({ "type": "Polygon", "coordinates": [[[0, 0], [1, 1], [0, 0]]] }),
                Value::Null,
            ),
            feature(
                json!({ "type": "Polygon", "coordinates": [[]] }),
                Value::Null,
            ),
            feature(
                json!({ "type": "Polygon", "coordinates": [[[0, 0], [1, "x"], [1, 1]]] }),
                Value::Null,
            ),
            feature(
                json!({ "type": "Polygon", "coordinates": [[[0, 0], [1e300, 0], [1, 1]]] }),
                Value::Null,
            ),
            feature(json!({ "type": "Polygon" }), Value::Null),
            feature(Value::Null, Value::Null),
            json!({ "type": "FeatureCollection" }).to_string(),
            json!({ "type": "FeatureCollection", "features": [3, "x"] }).to_string(),
            "{\"type\": \"Polygon\", \"coordinates\": [[[0, 0], [NaN, 0], [1, 1]]]}".into(),
            "{".into(),
            json!({ "type": "Polygon", "coordinates": [[[0], [1], [2]]] }).to_string(),
            json!({ "type": "Polygon", "coordinates": [[[0, 0], 1, [1, 1]]] }).to_string(),
            json!({ "type": "MultiPolygon", "coordinates": [[], []] }).to_string(),
            format!(
                "{{\"type\": \"Polygon\", \"coordinates\": {}",
                "[".repeat(100_000)
            ),
            "1 2 3 4 5 nan".into(),
            String::new(),
            "\u{0}".repeat(10_000),
        ] {
            assert!(
                parse(text.as_bytes()).is_err(),
                "{}",
                &text[..text.len().min(200)]
            );
        }
    }
}
