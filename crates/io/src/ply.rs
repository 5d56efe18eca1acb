//! PLY meshes (Turk, "The PLY Polygon File Format", 1994): reads ASCII and both binary byte orders,
//! writes binary little-endian.
//!
//! The reader requires an element `vertex` with `x`, `y`, `z` and an element `face` with a list
//! `vertex_indices` or `vertex_index`. It skips other elements and properties, and splits polygons
//! into triangle fans. Every count is checked against the remaining bytes.

use std::path::Path;

use nalgebra::Point3;
use viewrank_core::model::mesh::Mesh;

use crate::{
    formats::HIDDEN,
    input::{self, FileKind},
    mistaken,
};

/// Error in a PLY file, with its position.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PlyError {
    #[error("line {line}: {what}")]
    Header { line: usize, what: String },
    #[error("byte {byte}: {what}")]
    Body { byte: usize, what: String },
}

impl PlyError {
    /// The error without anything from the file.
    pub fn hidden(mut self) -> Self {
        let (Self::Header { what, .. } | Self::Body { what, .. }) = &mut self;
        *what = HIDDEN.into();
        self
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Encoding {
    Ascii,
    Little,
    Big,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn parse(word: &str) -> Option<Self> {
        // The names of 1994, and those with sizes of later programs.
        Some(match word {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }
}

#[derive(Debug)]
struct Property {
    name: String,
    value: Scalar,
    /// Type of the count of a list; `None` for a scalar.
    count: Option<Scalar>,
}

#[derive(Debug)]
struct Element {
    name: String,
    count: u64,
    properties: Vec<Property>,
}

struct Header {
    encoding: Encoding,
    elements: Vec<Element>,
    /// Offset of the body, bytes.
    body: usize,
}

impl Header {
    fn body_of<'a>(&self, bytes: &'a [u8]) -> Body<'a> {
        Body {
            bytes,
            at: self.body,
            encoding: self.encoding,
        }
    }
}

/// Reads a mesh; vertices and triangles keep the order of the file.
pub fn read(bytes: &[u8]) -> Result<Mesh, PlyError> {
    read_at_most(bytes, usize::MAX).map(Option::unwrap_or_default)
}

/// Reads a mesh; `None` if it has more than `most` triangles, which a few bytes of a polygon each
/// make.
pub fn read_at_most(bytes: &[u8], most: usize) -> Result<Option<Mesh>, PlyError> {
    let header = read_header(bytes)?;
    let mut body = header.body_of(bytes);
    let mut mesh = Mesh::default();
    for element in &header.elements {
        body.check_room(element)?;
        match element.name.as_str() {
            "vertex" => read_vertices(&mut body, element, &mut mesh.vertices)?,
            "face" => {
                if !read_faces(&mut body, element, &mut mesh.triangles, most)? {
                    return Ok(None);
                }
            }
            _ => body.skip_element(element)?,
        }
    }
    // Only now: the faces of a file may come before its vertices.
    let count = mesh.vertices.len() as u64;
    match mesh
        .triangles
        .iter()
        .flatten()
        .find(|&&v| u64::from(v) >= count)
    {
        Some(v) => Err(body.error(format!(
            "a face refers to vertex {v}, but there are {count}"
        ))),
        None => Ok(Some(mesh)),
    }
}

/// Most items of a list of a vertex: more views than anybody fuses.
const MOST_ITEMS: usize = 1 << 20;

/// Reads the vertices of a cloud, each with the items of its list `property` (none if the element
/// has no such list); calls `take` for each, in the order of the file.
pub fn read_with_lists(
    bytes: &[u8],
    property: &str,
    mut take: impl FnMut(Point3<f64>, &[u32]),
) -> Result<(), PlyError> {
    let header = read_header(bytes)?;
    let mut body = header.body_of(bytes);
    let Some(element) = header.elements.iter().find(|of| of.name == "vertex") else {
        return Ok(());
    };
    for before in header.elements.iter().take_while(|of| of.name != "vertex") {
        body.check_room(before)?;
        body.skip_element(before)?;
    }
    body.check_room(element)?;
    let axes = ["x", "y", "z"];
    let mut items = Vec::new();
    for _ in 0..element.count {
        let mut point = [f64::NAN; 3];
        items.clear();
        for of in &element.properties {
            let axis = axes.iter().position(|axis| *axis == of.name);
            match (of.count, axis) {
                (None, Some(axis)) => point[axis] = body.number(of.value)?,
                (Some(count), _) if of.name == property => {
                    let length = body.list_length(count)?;
                    if length > MOST_ITEMS {
                        return Err(body.error(format!("a list of {length} {property}")));
                    }
                    for _ in 0..length {
                        items.push(body.number(of.value)? as u32);
                    }
                }
                _ => body.skip(of)?,
            }
        }
        take(point.into(), &items);
    }
    Ok(())
}

/// Bytes within which a header ends.
const LONGEST_HEADER: u64 = 1 << 16;

/// Numbers of vertices and faces by the header of a file; `None` if that cannot be read.
pub fn counts(path: &Path) -> Option<[u64; 2]> {
    let start = input::read_start(path, FileKind::Sparse, LONGEST_HEADER).ok()?;
    let header = read_header(&start).ok()?;
    Some(["vertex", "face"].map(|name| {
        let mut elements = header.elements.iter();
        let named = elements.find(|element| element.name == name);
        named.map_or(0, |element| element.count)
    }))
}

fn read_header(bytes: &[u8]) -> Result<Header, PlyError> {
    let mut at = 0;
    let mut line = 0;
    let mut encoding = None;
    let mut elements: Vec<Element> = Vec::new();
    loop {
        line += 1;
        let fail = |what: &str| PlyError::Header {
            line,
            what: what.into(),
        };
        if let Some(mistaken) = mistaken::by_start(bytes).filter(|_| line == 1) {
            return Err(fail(&format!("the file is {}", mistaken.what)));
        }
        let text = header_line(&bytes[at..]).map_err(fail)?;
        at += text.len() + 1;
        let words: Vec<&str> = text.split_whitespace().collect();
        match words[..] {
            ["ply"] if line == 1 => {}
            _ if line == 1 => return Err(fail("the file does not begin with \"ply\"")),
            ["format", name, _] => {
                encoding = Some(parse_encoding(name).ok_or_else(|| fail("unknown format"))?)
            }
            ["comment" | "obj_info", ..] | [] => {}
            ["element", name, count] => {
                elements.push(Element::declared(name, count).map_err(fail)?);
            }
            ["property", ..] => add_property(&mut elements, &words).map_err(fail)?,
            ["end_header"] => {
                let encoding = encoding.ok_or_else(|| fail("the header has no \"format\" line"))?;
                return Ok(Header {
                    encoding,
                    elements,
                    body: at,
                });
            }
            _ => return Err(fail(&format!("unknown header line \"{text}\""))),
        }
    }
}

/// The next line, without its end; else what is wrong with it.
fn header_line(rest: &[u8]) -> Result<&str, &'static str> {
    // Gigabytes of another format may have no line end.
    let end = rest.iter().take(4096).position(|&b| b == b'\n');
    let end = end.ok_or("the header does not end")?;
    std::str::from_utf8(&rest[..end]).map_err(|_| "the header is not text; is this a PLY file?")
}

impl Element {
    fn declared(name: &str, count: &str) -> Result<Self, &'static str> {
        let count = count.parse();
        Ok(Self {
            name: name.into(),
            count: count.map_err(|_| "the element count is not a number")?,
            properties: Vec::new(),
        })
    }
}

/// Adds a property, from the words of its line, to the last element.
fn add_property(elements: &mut [Element], words: &[&str]) -> Result<(), &'static str> {
    let property = parse_property(words).ok_or("unknown property")?;
    let element = elements.last_mut().ok_or("a property before any element")?;
    element.properties.push(property);
    Ok(())
}

fn parse_encoding(name: &str) -> Option<Encoding> {
    match name {
        "ascii" => Some(Encoding::Ascii),
        "binary_little_endian" => Some(Encoding::Little),
        "binary_big_endian" => Some(Encoding::Big),
        _ => None,
    }
}

fn parse_property(words: &[&str]) -> Option<Property> {
    match *words {
        [_, "list", count, value, name] => {
            let count = Scalar::parse(count).filter(|c| !matches!(c, Scalar::F32 | Scalar::F64))?;
            Some(Property {
                name: name.into(),
                value: Scalar::parse(value)?,
                count: Some(count),
            })
        }
        [_, value, name] => Some(Property {
            name: name.into(),
            value: Scalar::parse(value)?,
            count: None,
        }),
        _ => None,
    }
}

/// The body of a file, read value by value.
struct Body<'a> {
    bytes: &'a [u8],
    at: usize,
    encoding: Encoding,
}

impl Body<'_> {
    fn error(&self, what: impl Into<String>) -> PlyError {
        PlyError::Body {
            byte: self.at,
            what: what.into(),
        }
    }

    /// Checks that the element can fit in the remaining bytes, so a false count neither reserves
    /// memory nor loops.
    fn check_room(&self, element: &Element) -> Result<(), PlyError> {
        let smallest = |p: &Property| match self.encoding {
            // A digit and its separator.
            Encoding::Ascii => 2,
            _ => p.count.unwrap_or(p.value).size(),
        };
        let each = element
            .properties
            .iter()
            .map(smallest)
            .sum::<usize>()
            // An element without properties has no bytes, but a loop over it is to end soon.
            .max(1) as u64;
        // The last line of an ASCII file may have no line end.
        let left = (self.bytes.len() - self.at) as u64 + 1;
        match element.count.checked_mul(each) {
            Some(needed) if needed <= left => Ok(()),
            _ => Err(self.error(format!(
                "{} x {} do not fit into the file; is it truncated?",
                element.count, element.name
            ))),
        }
    }

    /// Reads the next number; integers up to 2^32 are exact.
    fn number(&mut self, scalar: Scalar) -> Result<f64, PlyError> {
        if self.encoding == Encoding::Ascii {
            return self.word();
        }
        let end = self.at + scalar.size();
        let Some(raw) = self.bytes.get(self.at..end) else {
            return Err(self.error("the file ends too early"));
        };
        let mut le = [0u8; 8];
        le[..raw.len()].copy_from_slice(raw);
        if self.encoding == Encoding::Big {
            le[..raw.len()].reverse();
        }
        self.at = end;
        let bits = u64::from_le_bytes(le);
        Ok(match scalar {
            Scalar::I8 => f64::from(bits as i8),
            Scalar::U8 => f64::from(bits as u8),
            Scalar::I16 => f64::from(bits as i16),
            Scalar::U16 => f64::from(bits as u16),
            Scalar::I32 => f64::from(bits as i32),
            Scalar::U32 => f64::from(bits as u32),
            Scalar::F32 => f64::from(f32::from_bits(bits as u32)),
            Scalar::F64 => f64::from_bits(bits),
        })
    }

    fn word(&mut self) -> Result<f64, PlyError> {
        let rest = &self.bytes[self.at..];
        let start = rest
            .iter()
            .position(|b| !b.is_ascii_whitespace())
            .ok_or_else(|| self.error("the file ends too early"))?;
        let length = rest[start..]
            .iter()
            .position(u8::is_ascii_whitespace)
            .unwrap_or(rest.len() - start);
        let word = std::str::from_utf8(&rest[start..start + length])
            .ok()
            .and_then(|w| w.parse().ok());
        let value = word.ok_or_else(|| PlyError::Body {
            byte: self.at + start,
            what: "not a number".into(),
        })?;
        self.at += start + length;
        Ok(value)
    }

    /// Reads the length of a list with items of at least one byte each.
    fn list_length(&mut self, count: Scalar) -> Result<usize, PlyError> {
        let length = self.number(count)?;
        let left = (self.bytes.len() - self.at) as f64;
        if length >= 0.0 && length <= left && length.fract() == 0.0 {
            Ok(length as usize)
        } else {
            Err(self.error(format!(
                "a list of {length} items does not fit into the file"
            )))
        }
    }

    fn skip_element(&mut self, element: &Element) -> Result<(), PlyError> {
        (0..element.count)
            .try_for_each(|_| element.properties.iter().try_for_each(|p| self.skip(p)))
    }

    fn skip(&mut self, property: &Property) -> Result<(), PlyError> {
        let length = property
            .count
            .map_or(Ok(1), |count| self.list_length(count))?;
        (0..length).try_for_each(|_| self.number(property.value).map(|_| ()))
    }
}

fn read_vertices(
    body: &mut Body,
    element: &Element,
    vertices: &mut Vec<Point3<f64>>,
) -> Result<(), PlyError> {
    let axis = |name: &str| {
        element
            .properties
            .iter()
            .position(|p| p.name == name && p.count.is_none())
    };
    let [Some(x), Some(y), Some(z)] = ["x", "y", "z"].map(axis) else {
        return Err(body.error("the element vertex has no x, y and z"));
    };
    // `check_room` has compared the count with the file.
    vertices.reserve(element.count as usize);
    for _ in 0..element.count {
        let start = body.at;
        let mut point = Point3::origin();
        for (i, property) in element.properties.iter().enumerate() {
            match [x, y, z].iter().position(|&a| a == i) {
                Some(axis) => point[axis] = body.number(property.value)?,
                None => body.skip(property)?,
            }
        }
        if !point.coords.iter().all(|v| v.is_finite()) {
            return Err(PlyError::Body {
                byte: start,
                what: format!("vertex {} is not finite", vertices.len()),
            });
        }
        vertices.push(point);
    }
    Ok(())
}

/// False if there are more than `most` triangles.
fn read_faces(
    body: &mut Body,
    element: &Element,
    triangles: &mut Vec<[u32; 3]>,
    most: usize,
) -> Result<bool, PlyError> {
    let is_indices = |p: &Property| {
        p.count.is_some() && matches!(p.name.as_str(), "vertex_indices" | "vertex_index")
    };
    let Some(indices) = element.properties.iter().position(is_indices) else {
        return Err(body.error("the element face has no list vertex_indices"));
    };
    let mut polygon: Vec<u32> = Vec::new();
    for _ in 0..element.count {
        for (i, property) in element.properties.iter().enumerate() {
            match property.count {
                Some(count) if i == indices => {
                    read_polygon(body, count, property.value, &mut polygon)?
                }
                _ => body.skip(property)?,
            }
        }
        // Before they are made: a polygon has few bytes for each of its triangles.
        if triangles.len() + polygon.len().saturating_sub(2) > most {
            return Ok(false);
        }
        triangles.extend((2..polygon.len()).map(|i| [polygon[0], polygon[i - 1], polygon[i]]));
    }
    Ok(true)
}

fn read_polygon(
    body: &mut Body,
    count: Scalar,
    value: Scalar,
    polygon: &mut Vec<u32>,
) -> Result<(), PlyError> {
    polygon.clear();
    for _ in 0..body.list_length(count)? {
        let index = body.number(value)?;
        if !(index >= 0.0 && index < f64::from(u32::MAX) && index.fract() == 0.0) {
            return Err(body.error(format!("{index} is not a vertex index")));
        }
        polygon.push(index as u32);
    }
    Ok(())
}

/// A number or colour per triangle, for viewers.
pub enum FaceField<'a> {
    Float(&'a str, &'a [f32]),
    Byte(&'a str, &'a [u8]),
    /// `red`, `green`, `blue`.
    Colour(&'a [[u8; 3]]),
}

impl FaceField<'_> {
    /// Converts the field to a scalar per vertex for CloudCompare, which ignores scalars of faces:
    /// its name, and at each vertex the mean of the adjacent triangles (floats) or their maximum
    /// (bytes). `None` for colours.
    fn at_vertices(&self, vertices: usize, triangles: &[[u32; 3]]) -> Option<(String, Vec<f32>)> {
        let mut values = vec![0f32; vertices];
        let corners = || {
            triangles
                .iter()
                .enumerate()
                .flat_map(|(t, vertices)| vertices.map(|v| (t, v as usize)))
        };
        let name = match self {
            Self::Float(name, of_faces) => {
                let mut counts = vec![0f32; values.len()];
                for (t, v) in corners() {
                    values[v] += of_faces[t];
                    counts[v] += 1.0;
                }
                values
                    .iter_mut()
                    .zip(counts)
                    .for_each(|(value, count)| *value /= count.max(1.0));
                name
            }
            Self::Byte(name, of_faces) => {
                corners().for_each(|(t, v)| values[v] = values[v].max(of_faces[t].into()));
                name
            }
            Self::Colour(_) => return None,
        };
        Some((format!("scalar_{name}"), values))
    }
}

/// Serialises a surface as binary little-endian PLY. `fields` have one value per triangle and are
/// written for the triangles and, except colours, for the vertices: MeshLab shows colours and the
/// field `quality` of triangles, CloudCompare every `scalar_` field of vertices. Vertices are
/// `float` if rounding moves none by more than a thousandth of the mean edge length, otherwise
/// `double`. Each comment becomes one line.
pub fn write(
    vertices: &[Point3<f64>],
    triangles: &[[u32; 3]],
    fields: &[FaceField],
    comments: &[String],
) -> Vec<u8> {
    let double = !fits_float(vertices, triangles);
    let scalars: Vec<(String, Vec<f32>)> = fields
        .iter()
        .filter_map(|field| field.at_vertices(vertices.len(), triangles))
        .collect();
    let mut out = write_header(
        [vertices.len(), triangles.len()],
        fields,
        &scalars,
        comments,
        double,
    )
    .into_bytes();
    for (v, vertex) in vertices.iter().enumerate() {
        for &x in &vertex.coords {
            if double {
                out.extend(x.to_le_bytes())
            } else {
                out.extend((x as f32).to_le_bytes())
            }
        }
        scalars
            .iter()
            .for_each(|(_, values)| out.extend(values[v].to_le_bytes()));
    }
    for (t, corners) in triangles.iter().enumerate() {
        out.push(3);
        corners.iter().for_each(|v| out.extend(v.to_le_bytes()));
        for field in fields {
            match field {
                FaceField::Float(_, values) => out.extend(values[t].to_le_bytes()),
                FaceField::Byte(_, values) => out.push(values[t]),
                FaceField::Colour(values) => out.extend(values[t]),
            }
        }
    }
    out
}

fn write_header(
    [vertices, triangles]: [usize; 2],
    fields: &[FaceField],
    scalars: &[(String, Vec<f32>)],
    comments: &[String],
    double: bool,
) -> String {
    let mut header = String::from("ply\nformat binary_little_endian 1.0\n");
    // A line break in the name of a region could add lines to the header.
    comments
        .iter()
        .for_each(|c| header += &format!("comment {}\n", c.replace(['\n', '\r'], " ")));
    let scalar = if double { "double" } else { "float" };
    header += &format!("element vertex {}\n", vertices);
    ["x", "y", "z"]
        .iter()
        .for_each(|axis| header += &format!("property {scalar} {axis}\n"));
    scalars
        .iter()
        .for_each(|(name, _)| header += &format!("property float {name}\n"));
    header += &format!(
        "element face {}\nproperty list uchar uint vertex_indices\n",
        triangles
    );
    for field in fields {
        header += &match field {
            FaceField::Float(name, _) => format!("property float {name}\n"),
            FaceField::Byte(name, _) => format!("property uchar {name}\n"),
            FaceField::Colour(_) => {
                "property uchar red\nproperty uchar green\nproperty uchar blue\n".into()
            }
        };
    }
    header + "end_header\n"
}

fn fits_float(vertices: &[Point3<f64>], triangles: &[[u32; 3]]) -> bool {
    let side = |t: &[u32; 3]| (vertices[t[1] as usize] - vertices[t[0] as usize]).norm();
    let mean_edge = triangles.iter().map(side).sum::<f64>() / triangles.len().max(1) as f64;
    let largest = vertices.iter().map(|v| v.coords.amax()).fold(0.0, f64::max);
    largest * f64::from(f32::EPSILON) < 1e-3 * mean_edge
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use viewrank_core::model::surface::shapes;

    const ASCII: &str = "ply\r\nformat ascii 1.0\r\ncomment made by hand\r\nelement vertex 4\r\nproperty float x\r\nproperty float y\r\n\
        property float z\r\nproperty uchar red\r\nelement face 1\r\nproperty list uchar int vertex_index\r\nproperty float q\r\n\
        element edge 1\r\nproperty int a\r\nend_header\r\n0 0 0 9\r\n1 0 0 9\r\n1 1 0 9\r\n0 1 5e-1 9\r\n4 0 1 2 3 0.25\r\n7\r\n";

    #[test]
    fn reads_polygons_and_skips_other_properties() {
        let surface = read(ASCII.as_bytes()).unwrap();
        assert_eq!(surface.triangles, [[0, 1, 2], [0, 2, 3]]);
        assert_eq!(surface.vertices[3], Point3::new(0.0, 1.0, 0.5));
    }

    #[test]
    fn reads_big_endian() {
        let mut bytes = b"ply\nformat binary_big_endian 1.0\nelement vertex 3\nproperty double x\nproperty double y\n\
            property short z\nelement face 1\nproperty list ushort uint vertex_indices\nend_header\n"
            .to_vec();
        for (x, y, z) in [(0.5f64, 1.0f64, -3i16), (2.0, 0.0, 4), (0.0, 0.0, 5)] {
            bytes.extend(x.to_be_bytes());
            bytes.extend(y.to_be_bytes());
            bytes.extend(z.to_be_bytes());
        }
        bytes.extend([0, 3, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 2]);
        let surface = read(&bytes).unwrap();
        assert_eq!(
            (surface.vertices[0], &surface.triangles[..]),
            (Point3::new(0.5, 1.0, -3.0), &[[0, 1, 2]][..])
        );
    }

    /// Vertices are floats near the origin and doubles at map coordinates; fields follow each face.
    #[test]
    fn written_meshes_round_trip() {
        for (offset, digits) in [(0.0, 1e-6), (5.8e6, 0.0)] {
            let mut surface = shapes::torus(9);
            surface.vertices.iter_mut().for_each(|v| v.x += offset);
            let count = surface.triangles.len();
            let (quality, reason) = (vec![0.5f32; count], vec![3u8; count]);
            let fields = [
                FaceField::Float("quality", &quality),
                FaceField::Byte("reason", &reason),
                FaceField::Colour(&vec![[1, 2, 3]; count]),
            ];
            let back = read(&write(
                &surface.vertices,
                &surface.triangles,
                &fields,
                &["a\nb".into()],
            ))
            .unwrap();
            assert_eq!(back.triangles, surface.triangles);
            let worst = surface
                .vertices
                .iter()
                .zip(&back.vertices)
                .map(|(a, b)| (a - b).norm())
                .fold(0.0, f64::max);
            assert!(worst <= digits, "{worst}");
        }
    }

    #[test]
    fn errors_have_a_position() {
        let replaced = |from: &str, to: &str| {
            read(ASCII.replace(from, to).as_bytes())
                .unwrap_err()
                .to_string()
        };
        assert_eq!(
            replaced("ply\r\n", "plyx\n"),
            "line 1: the file does not begin with \"ply\""
        );
        assert_eq!(replaced("ascii", "utf8"), "line 2: unknown format");
        assert!(
            replaced("vertex 4", "vertex 1152921504606846976").contains("do not fit into the file")
        );
        assert!(replaced("face 1", "face 99999999999999999999").starts_with("line 9"));
        assert!(replaced("4 0 1 2 3", "4 0 1 2 9").contains("refers to vertex 9, but there are 4"));
        assert!(replaced("4 0 1 2 3", "4 0 1 2 -3").contains("-3 is not a vertex index"));
        assert!(replaced("4 0 1 2 3", "1e9 0 1 2 3").contains("a list of 1000000000 items"));
        assert!(replaced("5e-1", "nan").contains("vertex 3 is not finite"));
        assert!(replaced("end_header", "").starts_with("line 15: unknown header line"));
    }

    proptest! {
        /// Reading a truncated or modified file returns a mesh or an error.
        #[test]
        fn no_damaged_file_causes_a_panic(cut in 0usize..700, at in 0usize..700, byte: u8, binary: bool) {
            let mut bytes = if binary { { let sphere = shapes::sphere(0); write(&sphere.vertices, &sphere.triangles, &[], &[]) } } else { ASCII.as_bytes().to_vec() };
            let position = at % bytes.len();
            bytes[position] = byte;
            bytes.truncate(bytes.len().saturating_sub(cut / 2));
            if let Ok(surface) = read(&bytes) {
                prop_assert!(surface.triangles.iter().flatten().all(|&v| (v as usize) < surface.vertices.len()));
            }
        }
    }
}
