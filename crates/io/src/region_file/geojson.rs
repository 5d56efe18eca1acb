//! Reads GeoJSON (RFC 7946): the polygons of features, collections and bare geometries, with their
//! holes and parts but without heights; the properties `weight` and `gsd`; and the member `crs` of
//! the 2008 specification, which QGIS still writes, if it is WGS 84 or null. Everything else is
//! ignored.

use std::{borrow::Cow, fmt, ops::RangeInclusive};

use serde::{
    Deserialize, Deserializer,
    de::{self, Error, IgnoredAny, SeqAccess, Visitor},
};
use serde_json::value::RawValue;
use viewrank_core::{
    base::{decimals::to_decimals, error::shortened},
    method::region::{Area, Areas, Coordinates, Polygon},
};

use super::{LARGEST, RegionFault};
use crate::json;

/// Range of weights: 0 leaves an area out, larger numbers would drown all others.
const WEIGHTS: RangeInclusive<f64> = 0.0..=1e6;
/// Range of wanted resolutions, scene units per pixel, which are kept as f32.
const GSDS: RangeInclusive<f64> = 1e-30..=1e30;
/// Most positions of all polygons: with their index and outline, a plan takes about 600 bytes for
/// each.
const MOST_POSITIONS: usize = 1_000_000;

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
    // As text, which errors quote where it is no number.
    weight: Option<Box<RawValue>>,
    gsd: Option<Box<RawValue>>,
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
        deserializer.deserialize_seq(ListOfNodes)
    }
}

struct ListOfNodes;

impl<'de> Visitor<'de> for ListOfNodes {
    type Value = Nodes;

    fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("a list of features or geometries")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Nodes, A::Error> {
        let (mut areas, mut positions) = (Vec::new(), 0);
        let mut number = 0;
        while let Some(node) = list.next_element::<Node>()? {
            number += 1;
            let fault = |what| A::Error::custom(format!("number {number} of the list: {what}"));
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

/// Lists around the positions of a MultiPolygon.
const DEEPEST: usize = 3;

impl Nested {
    /// Number of lists around the first position.
    fn depth(&self) -> usize {
        match self {
            Self::List(members) => 1 + members.first().map_or(0, Self::depth),
            _ => 0,
        }
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
                (Nested::Number(x), None) => return position(x, list),
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
            Some(member) if member.depth() == DEEPEST => Err(A::Error::custom(
                "lists deeper than those of a MultiPolygon",
            )),
            _ => Ok(Nested::List(members)),
        }
    }
}

/// Reads the rest of a position, of which only the first two numbers count.
fn position<'de, A: SeqAccess<'de>>(x: f64, mut list: A) -> Result<Nested, A::Error> {
    let y: f64 = list
        .next_element()?
        .ok_or_else(|| A::Error::custom("one number is not a position"))?;
    while list.next_element::<IgnoredAny>()?.is_some() {}
    if [x, y].iter().any(|x| x.abs() > LARGEST) {
        return Err(A::Error::custom(format!("{x}, {y} is not a position")));
    }
    Ok(Nested::Position([x, y]))
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

/// Reads the areas of a file.
pub(super) fn read(bytes: &[u8]) -> Result<Areas, RegionFault> {
    let node = serde_json::from_slice(bytes);
    areas(node.map_err(|error| {
        let what = json::place_and_fault(&error, bytes);
        if error.is_data() {
            RegionFault::Value(what)
        } else {
            RegionFault::Json(what)
        }
    })?)
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
    // The geometry of a file without a list has not been counted yet.
    check_positions(areas.iter().map(positions_of).sum()).map_err(RegionFault::Collection)?;
    check_rings(&areas)?;
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
    let (weight, gsd) = properties.map_or((None, None), |properties| {
        (properties.weight, properties.gsd)
    });
    let weight = number(weight.as_deref(), WEIGHTS).map_err(|text| {
        format!("weight is {text}, not a number from 0 (leaves it out) to 1e6; 1 is usual")
    })?;
    let gsd = number(gsd.as_deref(), GSDS).map_err(|text| {
        format!("gsd is {text}, not a number of model units per pixel, above 0 (where metres are known: 0.02 for 2 cm)")
    })?;
    Ok(Some(Area {
        polygons: polygons(geometry)?,
        weight: weight.unwrap_or(1.0),
        gsd,
    }))
}

/// The number of a property; its text if it is none, or out of range.
fn number(raw: Option<&RawValue>, range: RangeInclusive<f64>) -> Result<Option<f64>, Cow<'_, str>> {
    // GIS programs write null where a field is empty, which is no value here.
    let Some(raw) = raw else { return Ok(None) };
    match serde_json::from_str(raw.get()) {
        Ok(number) if range.contains(&number) => Ok(Some(number)),
        _ => Err(shortened(raw.get())),
    }
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
        Some(kind) => Err(format!("a {kind} encloses no area: make it a Polygon")),
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
        3.. => {}
        distinct => return Err(few(distinct)),
    }
    Ok(positions)
}

/// Most pairs of edges of a file that are looked at for a crossing: all of rings with a few
/// thousand corners, as somebody may draw them.
const MOST_PAIRS: usize = 20_000_000;
/// How far the ends of two edges that cross lie beyond each other, over the size of their ring:
/// rounded corners cross by less, as at the two sides of a cut that leads to a hole.
const LEAST_BEYOND: f64 = 1e-3;

/// Refuses rings that cross themselves: corners in the wrong order enclose other ground than was
/// meant.
fn check_rings(areas: &[Area]) -> Result<(), RegionFault> {
    let mut pairs = MOST_PAIRS;
    let rings = areas.iter().flat_map(|area| area.polygons.iter().flatten());
    let place = rings.filter_map(|ring| crossing(ring, &mut pairs)).next();
    // Seven decimals of a degree are a centimetre.
    match place.map(|place| place.map(|x| to_decimals(x, 7))) {
        Some(place) => Err(RegionFault::Crossing(place)),
        None => Ok(()),
    }
}

/// The place of a crossing of two edges of a ring; edges that only touch are none. `pairs`: those
/// that may still be looked at.
fn crossing(ring: &[[f64; 2]], pairs: &mut usize) -> Option<[f64; 2]> {
    let span = |axis: usize| {
        let range = ring.iter().map(|corner| corner[axis]);
        range.clone().fold(f64::MIN, f64::max) - range.fold(f64::MAX, f64::min)
    };
    let beyond = LEAST_BEYOND * span(0).hypot(span(1));
    // Along the longer axis, fewer edges lie beside each other.
    let axis = usize::from(span(1) > span(0));
    let edge = |i: usize| {
        let (a, b) = (ring[i], ring[(i + 1) % ring.len()]);
        (a[axis].min(b[axis]), a[axis].max(b[axis]), (a, b))
    };
    let mut edges: Vec<_> = (0..ring.len()).map(edge).collect();
    edges.sort_by(|a, b| a.0.total_cmp(&b.0));
    for (n, (_, end, one)) in edges.iter().enumerate() {
        for (_, _, other) in edges[n + 1..].iter().take_while(|other| other.0 <= *end) {
            // Files with more edges were made by a program, and pass unchecked.
            *pairs = pairs.checked_sub(1)?;
            let place = intersection(*one, *other, beyond);
            if place.is_some() {
                return place;
            }
        }
    }
    None
}

type Segment = ([f64; 2], [f64; 2]);

/// The place where each of two segments goes through the other, its ends further than `beyond` from
/// the line of that one.
fn intersection((a, b): Segment, (c, d): Segment, beyond: f64) -> Option<[f64; 2]> {
    // Distance of a point from a line, positive on its left.
    let from = |p: [f64; 2], q: [f64; 2], x: [f64; 2]| {
        let (along, to) = ([q[0] - p[0], q[1] - p[1]], [x[0] - p[0], x[1] - p[1]]);
        (along[0] * to[1] - along[1] * to[0]) / along[0].hypot(along[1])
    };
    // An edge of length 0 gives NaN, for which both comparisons are false.
    let is_beyond = |one: f64, other: f64| one.min(other) < -beyond && one.max(other) > beyond;
    let (of_a, of_b) = (from(c, d, a), from(c, d, b));
    let is_crossed = is_beyond(of_a, of_b) && is_beyond(from(a, b, c), from(a, b, d));
    let t = of_a / (of_a - of_b);
    is_crossed.then(|| [0, 1].map(|axis| a[axis] + t * (b[axis] - a[axis])))
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
    // Two of these have heights, which are not read.
    let is_geodetic = ["CRS84", "CRS84h", "4326", "4979"]
        .iter()
        .any(|end| name.ends_with(end));
    if is_geodetic {
        Ok(Coordinates::Geodetic)
    } else {
        Err(format!("its coordinates are in {name:?}, not in WGS 84"))
    }
}
