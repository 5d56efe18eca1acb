//! Files of regions: GeoJSON polygons (RFC 7946), closed PLY meshes, or the six numbers of a box.
//! The contents tell them apart.

mod geojson;

use std::{io, path::Path};

use viewrank_core::{method::region::Areas, model::mesh::Mesh};

use crate::{
    formats::HIDDEN,
    input::{self, FileKind},
    mistaken::{self, Mistaken},
    ply::{self, PlyError},
};

/// Largest magnitude of a coordinate; no survey has larger ones, and their products stay finite.
const LARGEST: f64 = 1e12;
/// Most triangles of a mesh: with their index and outline, a plan takes about 300 bytes for each.
const MOST_TRIANGLES: usize = 1_000_000;

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
    #[error("{0}")]
    Json(String),
    /// JSON with a value that is not GeoJSON's.
    #[error("{0}")]
    Value(String),
    #[error("{0}")]
    Collection(String),
    /// A ring of polygons, with the place.
    #[error("a ring crosses itself near {}, {}", .0[0], .0[1])]
    Crossing([f64; 2]),
    #[error("more than {MOST_TRIANGLES} triangles: simplify the mesh")]
    Triangles,
    #[error(transparent)]
    Ply(#[from] PlyError),
    #[error("{HIDDEN}")]
    Hidden,
}

impl RegionFault {
    /// The fault without anything from the file.
    pub fn hidden(self) -> Self {
        match self {
            Self::Read(_) | Self::Unknown | Self::Mistaken(_) | Self::Triangles => self,
            _ => Self::Hidden,
        }
    }
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
    contents(bytes, &bytes[start..]).map_err(|fault| {
        let other = other_map(bytes).or_else(|| mistaken::by_start(bytes));
        match (fault, other) {
            (RegionFault::Unknown, Some(mistaken)) => RegionFault::Mistaken(mistaken),
            (fault, _) => fault,
        }
    })
}

/// `text`: the bytes without blanks at the start, which count in the positions of faults.
fn contents(bytes: &[u8], text: &[u8]) -> Result<RegionFile, RegionFault> {
    match text {
        [b'{', ..] => geojson::read(bytes).map(RegionFile::Areas),
        [b'p', b'l', b'y', b'\n' | b'\r', ..] => {
            let mesh = ply::read_at_most(text, MOST_TRIANGLES)?;
            mesh.map(RegionFile::Mesh).ok_or(RegionFault::Triangles)
        }
        // Six numbers are short: a large file of another kind is not parsed for them.
        _ if text.len() < 4096 => {
            let numbers = std::str::from_utf8(text).ok().and_then(parse_box);
            numbers.map(RegionFile::Box).ok_or(RegionFault::Unknown)
        }
        _ => Err(RegionFault::Unknown),
    }
}

/// A map in another format, by its first bytes, with the command of GDAL that converts it.
fn other_map(bytes: &[u8]) -> Option<Mistaken> {
    let head = &bytes[..bytes.len().min(1024)];
    let has = |word: &str| {
        head.windows(word.len())
            .any(|window| window == word.as_bytes())
    };
    let starts = |start: &[u8]| head.trim_ascii_start().starts_with(start);
    let section = |line_end: &str| has(&["0", "SECTION", ""].join(line_end));
    let geometry = ["POLYGON", "MULTIPOLYGON", "SRID=", "polygon", "Polygon"];
    let kinds = [
        (has("<kml"), "KML", AS_GEOJSON),
        (starts(b"PK\x03\x04") && has(".kml"), "KMZ", AS_GEOJSON),
        (has("<gpx"), "GPX", LINES),
        (has("opengis.net/gml"), "GML", IN_WGS84),
        (starts(b"\0\0\x27\x0a"), "a shapefile", IN_WGS84),
        (starts(b"SQLite format 3\0"), "a GeoPackage", IN_WGS84),
        (starts(b"fgb\x03"), "FlatGeobuf", IN_WGS84),
        (
            starts(b"!table") || starts(b"Version "),
            "a MapInfo file",
            IN_WGS84,
        ),
        (section("\n") || section("\r\n"), "DXF", DRAWING),
        (
            geometry.iter().any(|word| starts(word.as_bytes())),
            "WKT",
            TEXT,
        ),
        (is_table(head), "a table of numbers", TABLE),
    ];
    let of_kind = kinds.into_iter().find(|(is_so, ..)| *is_so);
    of_kind.map(|(_, what, cure)| Mistaken { what, cure })
}

const AS_GEOJSON: &str = "convert it: ogr2ogr -f GeoJSON region.geojson FILE";
const IN_WGS84: &str = "convert it: ogr2ogr -f GeoJSON -t_srs EPSG:4326 region.geojson FILE";
const LINES: &str = "it has points and lines: draw the polygon in a GIS and save it as GeoJSON";
const DRAWING: &str = "open it in a GIS and save its polygon as GeoJSON, in WGS 84, or in the model's units with \"crs\": null";
const TEXT: &str = "put the polygon into a GeoJSON file: a GIS loads WKT and saves GeoJSON";
const TABLE: &str = "write the corners as a GeoJSON polygon: {\"type\": \"Polygon\", \"coordinates\": [[[x, y], [x, y], ...]]}";

/// Returns whether the second line, which no heading is, has two or more numbers and nothing else.
fn is_table(head: &[u8]) -> bool {
    let text = String::from_utf8_lossy(head);
    let Some(line) = text.lines().nth(1) else {
        return false;
    };
    let words = || {
        let words = line.split([',', ';', ' ', '\t']);
        words.filter(|word| !word.is_empty())
    };
    words().count() >= 2 && words().all(|word| word.parse::<f64>().is_ok())
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

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use viewrank_core::method::region::{Area, Coordinates};

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
    fn a_wrong_wish_is_quoted_with_what_is_allowed() {
        let with = |properties: Value| {
            let geometry = json!({ "type": "Polygon", "coordinates": [square(1.0)] });
            let list =
                json!([{ "type": "Feature", "properties": properties, "geometry": geometry }]);
            let file = json!({ "type": "FeatureCollection", "features": list });
            parse(file.to_string().as_bytes()).unwrap_err().to_string()
        };
        for (properties, quoted) in [
            (json!({ "weight": "high" }), "weight is \"high\""),
            (json!({ "weight": -1 }), "weight is -1"),
            (json!({ "gsd": "2cm" }), "gsd is \"2cm\""),
            (json!({ "gsd": "2cm" }), "0.02 for 2 cm"),
        ] {
            let fault = with(properties);
            assert!(
                fault.contains("number 1 of the list") && fault.contains(quoted),
                "{fault}"
            );
        }
    }

    #[test]
    fn a_ring_that_crosses_itself_is_refused_with_the_place() {
        let ring = |ring: Value| {
            let polygon = json!({ "type": "Polygon", "coordinates": [ring] });
            parse(polygon.to_string().as_bytes())
        };
        let bow_tie = ring(json!([[0, 0], [4, 2], [4, 0], [0, 2], [0, 0]])).unwrap_err();
        assert!(bow_tie.to_string().contains("near 2, 1"), "{bow_tie}");
        // Open, closed, with a repeated corner, with a corner on another edge, with a cut to a hole
        // whose sides are rounded otherwise.
        for sound in [
            json!([[0, 0], [4, 0], [4, 2], [0, 2]]),
            json!([[0, 0], [4, 0], [4, 0], [4, 2], [0, 2], [0, 0]]),
            json!([[0, 0], [4, 0], [4, 2], [2, 0], [0, 2], [0, 0]]),
            json!([
                [0, 0],
                [4, 0],
                [4, 4],
                [2, 2],
                [3, 2],
                [3, 3],
                [3, 2.001],
                [2, 1.999],
                [0, 4]
            ]),
        ] {
            assert!(ring(sound.clone()).is_ok(), "{sound}");
        }
    }

    #[test]
    fn lists_deeper_than_a_multipolygon_are_refused_at_the_first() {
        let deep = format!("{}[0,0],[1,0],[1,1]{}", "[".repeat(9), "]".repeat(9));
        let text = format!(r#"{{"type":"MultiPolygon","coordinates":[{deep},not read"#);
        let fault = parse(text.as_bytes()).unwrap_err().to_string();
        assert!(fault.contains("deeper"), "{fault}");
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
            (
                b"<gml:FeatureCollection xmlns:gml=\"http://www.opengis.net/gml\">",
                "GML",
            ),
            (b"fgb\x03fgb\x00", "FlatGeobuf"),
            (b"Version 300\nCharset \"Neutral\"\n", "a MapInfo file"),
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
    fn what_only_a_person_can_convert_is_named_with_what_to_do() {
        for (file, name, advice) in [
            ("<?xml version='1.0'?>\n<gpx creator='x'>", "GPX", "draw"),
            ("  0\r\nSECTION\r\n  2\r\nHEADER\r\n", "DXF", "GIS"),
            ("POLYGON ((13 52, 14 52, 14 53, 13 52))\n", "WKT", "GIS"),
            (
                "x,y\n13.1,52.1\n13.2,52.1\n13.2,52.2\n",
                "a table of numbers",
                "corners",
            ),
            (
                "13.1\t52.1\n13.2\t52.1\n13.2\t52.2\n13.1\t52.2\n",
                "a table of numbers",
                "corners",
            ),
        ] {
            let fault = parse(file.as_bytes()).unwrap_err();
            assert!(
                matches!(fault, RegionFault::Mistaken(Mistaken { what, cure })
                    if what == name && cure.contains(advice)),
                "{file}: {fault}"
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
