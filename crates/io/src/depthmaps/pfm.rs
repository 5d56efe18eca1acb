//! Portable float map: `Pf`, width and height, scale (negative: little-endian), then rows from
//! bottom to top.

use viewrank_core::base::pixels::PixelBound;

use super::{Parsed, Plane, floats};

pub(super) fn parse(bytes: &[u8], bound: PixelBound) -> Parsed<Plane> {
    let (magic, at) = word(bytes, 0)?;
    if magic != "Pf" {
        return Err((0, "expected `Pf` (one channel)".into()));
    }
    let (width, at) = number::<u32>(bytes, at)?;
    let (height, at) = number::<u32>(bytes, at)?;
    let (scale, at) = number::<f32>(bytes, at)?;
    let (size, mut depth) = floats(bytes, at, [width, height], bound)?;
    if scale > 0.0 {
        depth
            .iter_mut()
            .for_each(|z| *z = f32::from_bits(z.to_bits().swap_bytes()));
    }
    let rows = depth.chunks_exact(width as usize).rev();
    Ok((size, rows.flatten().copied().collect()))
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
    let early = if rest.len() < 40 { bytes.len() } else { start };
    let end = end.ok_or_else(|| (early, "expected the header of a PFM file".to_string()))?;
    let text = std::str::from_utf8(&rest[..end])
        .map_err(|_| (start, "the header isn't text".to_string()))?;
    Ok((text, start + end + 1))
}
