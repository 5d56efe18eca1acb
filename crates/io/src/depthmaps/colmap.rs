//! COLMAP's `NAME.geometric.bin`: ASCII `W&H&C&`, then W x H x C little-endian float32, plane by
//! plane, row-major.

use std::{fs, path::Path};

use viewrank_core::base::pixels::PixelBound;

use super::{DepthMapError, Parsed, Plane, floats};
use crate::input::{self, FileKind};

/// Bytes within which a head ends: three numbers of ten digits.
const LONGEST_HEAD: u64 = 33;

/// Width and height of a map that is all there, also of one of normals (3 `channels`).
///
/// # Errors
/// [`DepthMapError::Format`] for a map of other channels, or of another length than its head says.
pub fn whole_size(path: &Path, channels: u32) -> Result<[u32; 2], DepthMapError> {
    let start = input::read_start(path, FileKind::Picture, LONGEST_HEAD);
    let start = start.map_err(DepthMapError::io(path))?;
    let there = fs::metadata(path).map_err(DepthMapError::io(path))?.len();
    let (size, at) = head(&start, channels).map_err(DepthMapError::format(path))?;
    let [width, height] = size;
    let values = u64::from(width) * u64::from(height);
    let needed = values.saturating_mul(4 * u64::from(channels));
    let needed = needed.saturating_add(at as u64);
    if values > 0 && there == needed {
        return Ok(size);
    }
    let what = format!("{width} x {height} pixels need {needed} bytes, {there} are there");
    Err(DepthMapError::format(path)((at, what)))
}

pub(super) fn parse(bytes: &[u8], bound: PixelBound) -> Parsed<Plane> {
    let (size, at) = head(bytes, 1)?;
    floats(bytes, at, size, bound)
}

/// Returns width and height, and the offset of the floats.
fn head(bytes: &[u8], channels: u32) -> Parsed<([u32; 2], usize)> {
    let (width, at) = number(bytes, 0)?;
    let (height, at) = number(bytes, at)?;
    let (found, at) = number(bytes, at)?;
    if found != channels {
        let what = format!("{found} channels, expected {channels} (a normal map has 3)");
        return Err((0, what));
    }
    Ok(([width, height], at))
}

/// Parses decimal digits up to `&`; returns the number and the offset after the `&`.
fn number(bytes: &[u8], start: usize) -> Parsed<(u32, usize)> {
    let at = |at: usize| (at, "expected `WIDTH&HEIGHT&CHANNELS&`".to_string());
    let bad = || at(start);
    let rest = bytes.get(start..).unwrap_or_default();
    let length = rest.iter().take(11).position(|&b| b == b'&');
    let is_cut = rest.len() < 11 && rest.iter().all(u8::is_ascii_digit);
    let length = length.ok_or_else(|| at(if is_cut { bytes.len() } else { start }))?;
    let digits = std::str::from_utf8(&rest[..length]).map_err(|_| bad())?;
    Ok((digits.parse().map_err(|_| bad())?, start + length + 1))
}
