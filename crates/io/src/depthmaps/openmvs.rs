//! OpenMVS's `depthNNNN.dmap`: header, image path, ids (key view first, then the partners used), K
//! R C, depth plane. The planes after it (normals, confidence, views) are ignored.

use viewrank_core::base::pixels::PixelBound;

use super::{DepthMap, DepthMapFormat, Parsed, floats, u32_at};

/// Fixed part of the header: magic, type, image and depth size, depth range.
const FIXED: usize = 28;
/// K, R and C in f64.
const MATRICES: usize = (9 + 9 + 3) * 8;
/// Largest plausible number of ids; OpenMVS uses 12 partners by default.
const MOST_IDS: u32 = 4096;

pub(super) fn parse(bytes: &[u8], bound: PixelBound) -> Parsed<DepthMap> {
    let header = header(bytes)?;
    Ok(DepthMap {
        format: DepthMapFormat::OpenMvs,
        width: header.width,
        height: header.height,
        depth: floats(bytes, header.length, (header.width, header.height), bound)?,
        ids: header.ids,
    })
}

/// Everything before the depth plane.
pub(super) struct Header {
    pub width: u32,
    pub height: u32,
    /// Path of the image, relative to the map's folder.
    pub image: String,
    pub ids: Vec<u32>,
    /// Offset of the depth plane, bytes.
    pub length: usize,
}

pub(super) fn header(bytes: &[u8]) -> Parsed<Header> {
    if bytes.len() < FIXED + 2 || &bytes[..2] != b"DR" {
        return Err((0, "not a .dmap file, expected `DR`".into()));
    }
    if bytes[2] & 1 == 0 {
        return Err((2, "the file has no depth plane".into()));
    }
    let (width, height) = (u32_at(bytes, 12)?, u32_at(bytes, 16)?);
    let name_length = usize::from(u16::from_le_bytes([bytes[FIXED], bytes[FIXED + 1]]));
    let name_end = FIXED + 2 + name_length;
    let name = bytes.get(FIXED + 2..name_end).ok_or_else(|| {
        (
            FIXED,
            "unexpected end of file in the image path".to_string(),
        )
    })?;
    let count = u32_at(bytes, name_end)?;
    if count > MOST_IDS {
        return Err((
            name_end,
            format!("{count} ids of views, at most {MOST_IDS} are plausible"),
        ));
    }
    let ids = (0..count as usize)
        .map(|i| u32_at(bytes, name_end + 4 + 4 * i))
        .collect::<Parsed<Vec<u32>>>()?;
    let length = name_end + 4 + 4 * ids.len() + MATRICES;
    Ok(Header {
        width,
        height,
        image: String::from_utf8_lossy(name).into_owned(),
        ids,
        length,
    })
}
