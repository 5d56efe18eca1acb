//! COLMAP's `NAME.geometric.bin`: ASCII `W&H&C&`, then W x H x C little-endian float32, plane by
//! plane, row-major.

use viewrank_core::base::pixels::PixelBound;

use super::{Parsed, Plane, floats};

pub(super) fn parse(bytes: &[u8], bound: PixelBound) -> Parsed<Plane> {
    let (width, at) = number(bytes, 0)?;
    let (height, at) = number(bytes, at)?;
    let (channels, at) = number(bytes, at)?;
    if channels != 1 {
        return Err((
            0,
            format!("{channels} channels, expected 1 (is this a normal map?)"),
        ));
    }
    floats(bytes, at, [width, height], bound)
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
