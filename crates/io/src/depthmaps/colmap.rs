//! COLMAP's `NAME.geometric.bin`: ASCII `W&H&C&`, then W x H x C little-endian float32, plane by
//! plane, row-major.

use std::path::Path;

use viewrank_core::base::pixels::PixelBound;

use super::{DepthMapError, Parsed, Plane, floats, whole_size_by};

/// Bytes within which a head ends: three numbers of ten digits.
const LONGEST_HEAD: u64 = 33;

/// Width and height of a map that is all there, also of one of normals (3 `channels`).
///
/// # Errors
/// [`DepthMapError::Format`] for a map of other channels, or of another length than its head says.
pub fn whole_size(path: &Path, channels: u32) -> Result<[u32; 2], DepthMapError> {
    whole_size_by(path, LONGEST_HEAD, channels, |start| head(start, channels))
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
    // Ten digits and the `&`.
    let length = rest.iter().take(11).position(|&b| b == b'&');
    // With its fault at the end, a file that is still being written counts as unfinished, not as
    // damaged.
    let is_cut = rest.len() < 11 && rest.iter().all(u8::is_ascii_digit);
    let length = length.ok_or_else(|| at(if is_cut { bytes.len() } else { start }))?;
    let digits = std::str::from_utf8(&rest[..length]).map_err(|_| bad())?;
    Ok((digits.parse().map_err(|_| bad())?, start + length + 1))
}
