//! Portable float map: `Pf`, width and height, scale (negative: little-endian), then rows from
//! bottom to top.

use std::path::Path;

use viewrank_core::base::pixels::PixelBound;

use super::{DepthMapError, Parsed, Plane, floats, whole_size_by};
use crate::input::{self, FileKind};

/// Length of the longest header that programs write, bytes.
const LONGEST_HEAD: u64 = 128;

/// Width and height of a map that is all there.
///
/// # Errors
/// [`DepthMapError::Format`] for another image, or one of another length than its header says.
pub fn whole_size(path: &Path) -> Result<[u32; 2], DepthMapError> {
    let head = |start: &[u8]| head(start).map(|(size, _, at)| (size, at));
    whole_size_by(path, LONGEST_HEAD, 1, head)
}

/// Returns a map with the nearest pixel at each place of an image of another size, as a file.
///
/// # Errors
/// As the readers of depth maps.
pub fn resized(
    path: &Path,
    bound: PixelBound,
    [width, height]: [u32; 2],
) -> Result<Vec<u8>, DepthMapError> {
    let bytes = input::read_start(path, FileKind::Picture, bound.file_bytes());
    let bytes = bytes.map_err(DepthMapError::io(path))?;
    let ([w, h], values) = parse(&bytes, bound).map_err(DepthMapError::of_bytes(path, &bytes))?;
    let nearest = |at: u32, side: u32, of: u32| {
        // In u64: the product of two sides may leave u32.
        let at = u64::from(at) * u64::from(of) / u64::from(side);
        at.min(u64::from(of) - 1) as usize
    };
    let mut file = format!("Pf\n{width} {height}\n-1.0\n").into_bytes();
    // PFM stores the bottom row first.
    for y in (0..height).rev() {
        let row = &values[nearest(y, height, h) * w as usize..][..w as usize];
        let row = (0..width).map(|x| row[nearest(x, width, w)]);
        file.extend(row.flat_map(f32::to_le_bytes));
    }
    Ok(file)
}

pub(super) fn parse(bytes: &[u8], bound: PixelBound) -> Parsed<Plane> {
    let (size, scale, at) = head(bytes)?;
    let ([width, _], mut depth) = floats(bytes, at, size, bound)?;
    if scale > 0.0 {
        depth
            .iter_mut()
            .for_each(|z| *z = f32::from_bits(z.to_bits().swap_bytes()));
    }
    let rows = depth.chunks_exact(width as usize).rev();
    Ok((size, rows.flatten().copied().collect()))
}

/// Returns width and height, the scale, and the offset of the floats.
fn head(bytes: &[u8]) -> Parsed<([u32; 2], f32, usize)> {
    let (magic, at) = word(bytes, 0)?;
    if magic != "Pf" {
        return Err((0, "expected `Pf` (one channel)".into()));
    }
    let (width, at) = number(bytes, at)?;
    let (height, at) = number(bytes, at)?;
    let (scale, at) = number(bytes, at)?;
    Ok(([width, height], scale, at))
}

fn number<T: std::str::FromStr>(bytes: &[u8], start: usize) -> Parsed<(T, usize)> {
    let (text, next) = word(bytes, start)?;
    let value = text
        .parse()
        .map_err(|_| (start, format!("`{text}` isn't a number")))?;
    Ok((value, next))
}

/// The next word, up to a white-space byte, and the offset after that byte.
fn word(bytes: &[u8], start: usize) -> Parsed<(&str, usize)> {
    let rest = &bytes[start.min(bytes.len())..];
    let end = rest.iter().take(40).position(u8::is_ascii_whitespace);
    // A fault at the end of the file lets one that is still being written count as unfinished.
    let early = if rest.len() < 40 { bytes.len() } else { start };
    let end = end.ok_or_else(|| (early, "expected the header of a PFM file".to_string()))?;
    let text = std::str::from_utf8(&rest[..end])
        .map_err(|_| (start, "the header isn't text".to_string()))?;
    Ok((text, start + end + 1))
}
