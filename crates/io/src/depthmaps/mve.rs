//! MVE's `.mvei`: `\x89MVE_IMAGE\n`, then i32 width, height, channels, type (9: float32), then the
//! values, row-major. dmrecon writes distances from the camera's centre.

use std::path::Path;

use viewrank_core::base::pixels::PixelBound;

use super::{DepthMapError, Parsed, Plane, floats, u32_at, whole_size_by};

const SIGNATURE: &[u8] = b"\x89MVE_IMAGE\n";
const FLOAT: u32 = 9;
/// Bytes before the values.
const HEAD: usize = SIGNATURE.len() + 16;

/// Width and height of a depth map that is all there.
///
/// # Errors
/// [`DepthMapError::Format`] for another image, or one of another length than its head says.
pub fn whole_size(path: &Path) -> Result<[u32; 2], DepthMapError> {
    let head = |start: &[u8]| head(start).map(|size| (size, HEAD));
    whole_size_by(path, HEAD as u64, 1, head)
}

pub(super) fn parse(bytes: &[u8], bound: PixelBound) -> Parsed<Plane> {
    floats(bytes, HEAD, head(bytes)?, bound)
}

/// Returns width and height.
fn head(bytes: &[u8]) -> Parsed<[u32; 2]> {
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
    Ok([width, height])
}
