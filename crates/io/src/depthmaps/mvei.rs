//! MVE's `.mvei`: `\x89MVE_IMAGE\n`, then i32 width, height, channels, type (9: float32), then the
//! values, row-major. dmrecon writes distances from the camera's centre.

use viewrank_core::base::pixels::PixelBound;

use super::{Parsed, Plane, floats, u32_at};

const SIGNATURE: &[u8] = b"\x89MVE_IMAGE\n";
const FLOAT: u32 = 9;

pub(super) fn parse(bytes: &[u8], bound: PixelBound) -> Parsed<Plane> {
    if !bytes.starts_with(SIGNATURE) {
        return Err((0, "not an image of MVE, expected `\\x89MVE_IMAGE`".into()));
    }
    let at = |field: usize| u32_at(bytes, SIGNATURE.len() + 4 * field);
    let (width, height, channels, kind) = (at(0)?, at(1)?, at(2)?, at(3)?);
    if channels != 1 || kind != FLOAT {
        let what = format!(
            "{channels} channels of type {kind}, expected 1 channel of type {FLOAT} (float)"
        );
        return Err((SIGNATURE.len() + 8, what));
    }
    floats(bytes, SIGNATURE.len() + 16, [width, height], bound)
}
