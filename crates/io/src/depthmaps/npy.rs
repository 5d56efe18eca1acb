//! NumPy's `.npy`: a two-dimensional array, rows x columns, float32 or float64, C order; the format
//! of `integrations/sgm`.

use npyz::{DType, NpyFile, Order, TypeChar};
use viewrank_core::base::pixels::PixelBound;

use super::{DepthMap, DepthMapFormat, Parsed, pixels};

/// Largest header that is parsed, bytes. That of a two-dimensional array has about 120; a longer
/// one could be nested without bounds.
const LONGEST_HEADER: u32 = 512;

pub(super) fn parse(bytes: &[u8], bound: PixelBound) -> Parsed<DepthMap> {
    let bad = |what: &str| (0, what.to_string());
    if header_length(bytes).ok_or_else(|| bad("not a NumPy file"))? > LONGEST_HEADER {
        return Err((
            8,
            format!("the header is longer than {LONGEST_HEADER} bytes"),
        ));
    }
    let file = NpyFile::new(bytes).map_err(|e| (0, format!("not a NumPy file: {e}")))?;
    let &[rows, columns] = file.shape() else {
        return Err(bad("expected two dimensions, rows and columns"));
    };
    let (Ok(height), Ok(width)) = (u32::try_from(rows), u32::try_from(columns)) else {
        return Err(bad("more than 4294967295 rows or columns"));
    };
    if file.order() != Order::C {
        return Err(bad(
            "Fortran order; convert it with np.ascontiguousarray before saving",
        ));
    }
    let DType::Plain(kind) = file.dtype() else {
        return Err(bad("a structured type, expected float32 or float64"));
    };
    let size = kind.size_field();
    if kind.type_char() != TypeChar::Float || !(size == 4 || size == 8) {
        return Err(bad("expected float32 or float64"));
    }
    let pixels = pixels(width, height, bound)?;
    if (pixels as u64).saturating_mul(size) > bytes.len() as u64 {
        return Err((
            0,
            format!(
                "{width} x {height} values do not fit in {} bytes",
                bytes.len()
            ),
        ));
    }
    let depth = if size == 4 {
        file.into_vec::<f32>()
    } else {
        file.into_vec::<f64>()
            .map(|values| values.into_iter().map(|z| z as f32).collect())
    };
    let depth = depth.map_err(|e| (0, e.to_string()))?;
    Ok(DepthMap {
        format: DepthMapFormat::Npy,
        width,
        height,
        depth,
        ids: Vec::new(),
    })
}

/// Length of the header text, bytes; the length field has two bytes in version 1, four in later
/// versions. `None` if this isn't a NumPy file.
fn header_length(bytes: &[u8]) -> Option<u32> {
    let preamble = bytes.get(..12).filter(|b| b.starts_with(b"\x93NUMPY"))?;
    let low = u32::from(u16::from_le_bytes([preamble[8], preamble[9]]));
    let high = u32::from(u16::from_le_bytes([preamble[10], preamble[11]]));
    Some(if preamble[6] == 1 {
        low
    } else {
        low | high << 16
    })
}
