//! OpenMVS's `depthNNNN.dmap`, little-endian: header, image path, ids (key view first, then the
//! partners used), K R C, depth plane. The planes after it (normals, confidence, views) are
//! ignored.
//!
//! Two kinds, told apart by their first two letters: `DR` (v2.0 to v2.4.0) has depths of f32, `D2`
//! (develop since 2026) halves of depth / 2^exponent, and 4 bytes more in its header. OpenMVS reads
//! maps of its own kind only.

use std::path::Path;

use half::f16;
use nom::{
    IResult, Parser,
    bytes::complete::take,
    combinator::verify,
    error::ErrorKind,
    multi::{length_data, many},
    number::complete::{le_f32, le_u16, le_u32},
};
use viewrank_core::base::pixels::PixelBound;

use super::{DepthMapError, DepthMapFormat, Parsed, Plane, check_kind, floats, plane};
use crate::input::{self, FileKind};

mod whole;

pub use whole::WholeMap;

/// Bytes within which a header ends: its longest path and most ids.
const LONGEST_HEADER: u64 = 1 << 17;
/// Letters, type, exponent, width and height of the image.
const BEFORE_THE_SIZE: usize = 12;
/// Value of a confidence of 255 in `D2`, f32.
const CONFIDENCE: usize = 4;
/// K, R and C in f64.
const MATRICES: usize = (9 + 9 + 3) * 8;
/// Largest plausible number of ids; OpenMVS uses 12 partners by default.
const MOST_IDS: u32 = 4096;
/// Bits of the type: a depth plane; all planes of `DR`.
const HAS_DEPTH: u8 = 1;
const PLANES_OF_DR: u8 = 0b1111;

/// Kind of a map.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    /// `DR`: depths are f32.
    Floats,
    /// `D2`: depths are halves, to be multiplied by two to the power of `exponent`.
    Halves { exponent: i8 },
}

impl Kind {
    fn of(bytes: &[u8]) -> Option<Self> {
        match bytes {
            [b'D', b'R', ..] => Some(Self::Floats),
            [b'D', b'2', rest @ ..] => Some(Self::Halves {
                exponent: rest.get(1).map_or(0, |byte| byte.cast_signed()),
            }),
            _ => None,
        }
    }
}

/// Describes a map of a kind that this program does not know: other letters, or other planes than
/// those that `DR` ever had. More bits of the type of `D2` are flags, such as that of confidences
/// that were adjusted.
pub(super) fn newer(bytes: &[u8]) -> Option<String> {
    // Zeros are damage, not the letters of another kind.
    let letters = bytes.get(..2).filter(|letters| *letters != [0, 0])?;
    let planes = bytes.get(2).copied().unwrap_or(HAS_DEPTH);
    match Kind::of(bytes) {
        None => Some(format!("a depth map of kind `{}`", letters.escape_ascii())),
        Some(Kind::Floats) if planes & !PLANES_OF_DR != 0 => {
            Some(format!("a depth map of kind `DR` and type {planes}"))
        }
        Some(_) => None,
    }
}

/// `ids`: takes those of the key view and its partners.
pub(super) fn parse(bytes: &[u8], bound: PixelBound, ids: &mut Vec<u32>) -> Parsed<Plane> {
    let header = header(bytes)?;
    let size = [header.width, header.height];
    *ids = header.ids;
    match header.kind {
        Kind::Floats => floats(bytes, header.length, size, bound),
        Kind::Halves { exponent } => {
            let unit = 2f64.powi(exponent.into());
            let depths = plane::<2>(bytes, header.length, size, bound)?
                .map(|half| (f16::from_le_bytes(half).to_f64() * unit) as f32);
            Ok((size, depths.collect()))
        }
    }
}

/// Everything before the depth plane.
pub(super) struct Header {
    kind: Kind,
    /// Bits of the planes that follow.
    planes: u8,
    pub width: u32,
    pub height: u32,
    /// Least and greatest depth that was searched, scene units.
    range: [f32; 2],
    /// Path of the image, relative to the map's folder.
    pub image: String,
    pub ids: Vec<u32>,
    /// Offset of the depth plane, bytes.
    pub length: usize,
}

/// Reads the header of a map.
pub(super) fn read_header(path: &Path) -> Result<Header, DepthMapError> {
    let bytes = input::read_start(path, FileKind::Picture, LONGEST_HEADER)
        .map_err(DepthMapError::io(path))?;
    check_kind(path, DepthMapFormat::OpenMvs, &bytes)?;
    header(&bytes).map_err(DepthMapError::of_bytes(path, &bytes))
}

pub(super) fn header(bytes: &[u8]) -> Parsed<Header> {
    let kind = Kind::of(bytes).ok_or((0, "not a .dmap file, expected `DR` or `D2`".to_string()))?;
    if bytes.get(2).is_some_and(|planes| planes & HAS_DEPTH == 0) {
        return Err((2, "the file has no depth plane".into()));
    }
    let (rest, fields) = fields(kind, bytes).map_err(|error| {
        // All but an implausible number of views is an early end.
        let left = match error {
            nom::Err::Error(error) if error.code == ErrorKind::Verify => error.input.len(),
            _ => 0,
        };
        let what = format!("the header ends too early, or names more than {MOST_IDS} views");
        (bytes.len() - left, what)
    })?;
    let (size, range, image, ids) = fields;
    Ok(Header {
        kind,
        planes: bytes[2],
        width: size.0,
        height: size.1,
        range: range.into(),
        image: String::from_utf8_lossy(image).into_owned(),
        ids,
        length: bytes.len() - rest.len(),
    })
}

/// Width and height, range of depths, path of the image, and ids.
type Fields<'a> = ((u32, u32), (f32, f32), &'a [u8], Vec<u32>);

fn fields(kind: Kind, bytes: &[u8]) -> IResult<&[u8], Fields<'_>> {
    let behind_the_range = match kind {
        Kind::Floats => 0,
        Kind::Halves { .. } => CONFIDENCE,
    };
    let is_plausible = |count: &u32| *count <= MOST_IDS;
    let (rest, (_, size, range, _, image, count)) = (
        take(BEFORE_THE_SIZE),
        (le_u32, le_u32),
        (le_f32, le_f32),
        take(behind_the_range),
        length_data(le_u16),
        verify(le_u32, is_plausible),
    )
        .parse(bytes)?;
    let (rest, (ids, _)) = (many(count as usize, le_u32), take(MATRICES)).parse(rest)?;
    Ok((rest, (size, range, image, ids)))
}
