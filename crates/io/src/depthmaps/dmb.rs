//! The `.dmb` of ACMH, ACMM, ACMP, ACMMP and Gipuma: i32 type (1: float), height, width, channels,
//! then float32, row-major.

use viewrank_core::base::pixels::PixelBound;

use super::{Parsed, Plane, floats, u32_at};

pub(super) fn parse(bytes: &[u8], bound: PixelBound) -> Parsed<Plane> {
    let (kind, height, width, channels) = (
        u32_at(bytes, 0)?,
        u32_at(bytes, 4)?,
        u32_at(bytes, 8)?,
        u32_at(bytes, 12)?,
    );
    if kind != 1 || channels != 1 {
        return Err((
            0,
            format!("type {kind} with {channels} channels, expected type 1 with 1 channel"),
        ));
    }
    floats(bytes, 16, [width, height], bound)
}
