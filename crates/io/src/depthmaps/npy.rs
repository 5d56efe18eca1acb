//! NumPy's `.npy`: a two-dimensional array, rows x columns, float32 or float64, C order; the format
//! of `integrations/sgm`.

use viewrank_core::base::pixels::PixelBound;

use super::{Parsed, Plane, pixels};
use crate::npy;

pub(super) fn parse(bytes: &[u8], bound: PixelBound) -> Parsed<Plane> {
    let array = npy::read(bytes)?;
    let &[rows, columns] = &array.shape[..] else {
        return Err((0, "expected two dimensions, rows and columns".into()));
    };
    let (Ok(height), Ok(width)) = (u32::try_from(rows), u32::try_from(columns)) else {
        return Err((0, "more than 4294967295 rows or columns".into()));
    };
    pixels(width, height, bound)?;
    let depth = match array.dtype {
        "f8" => array
            .values::<f64>()?
            .into_iter()
            .map(|z| z as f32)
            .collect(),
        "f4" => array.values::<f32>()?,
        other => {
            let what = format!("values of type {other}, expected f4 or f8 (float32, float64)");
            return Err((0, what));
        }
    };
    Ok(([width, height], depth))
}
