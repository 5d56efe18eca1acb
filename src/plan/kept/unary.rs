//! The confidence of views by themselves.

use crate::{
    base::{
        column::Storage,
        packed::{Packer, Unpacker},
    },
    method::confidence::Unary,
    plan::Stages,
};

/// Values in the palette. Without masks there are nine.
const MOST_VALUES: usize = 256;

/// Packs the column, and the warnings as facts.
pub(super) fn pack(stages: &Stages) -> Option<(Vec<String>, Vec<u8>)> {
    let values = &stages.unary.values;
    if values.storage() == Storage::Disk {
        return None;
    }
    let mut packer = Packer::default();
    match with_palette(values) {
        Some((palette, places)) => {
            packer.list(&palette);
            packer.list(&places);
        }
        None => {
            packer.list::<f32>(&[]);
            packer.list(values);
        }
    }
    // Those of the compared pictures come last and are kept with them.
    let own = stages.picture_warnings.len() - stages.agreement.warnings.len();
    Some((stages.picture_warnings[..own].to_vec(), packer.finish()))
}

/// Returns the different values and the place of each row's among them; `None` if there are too many.
fn with_palette(values: &[f32]) -> Option<(Vec<f32>, Vec<u8>)> {
    let mut palette: Vec<f32> = Vec::new();
    let mut places = Vec::with_capacity(values.len());
    for value in values {
        let known = palette.iter().position(|known| known.to_bits() == value.to_bits());
        let place = known.unwrap_or(palette.len());
        if place == MOST_VALUES {
            return None;
        }
        if known.is_none() {
            palette.push(*value);
        }
        places.push(place as u8);
    }
    Some((palette, places))
}

/// Unpacks the column. `rows`: number of rows of the visibility table.
pub fn unpack(bytes: &[u8], rows: usize) -> Option<Unary> {
    let mut lists = Unpacker::new(bytes);
    let palette = lists.list::<f32>()?;
    let values: Vec<f32> = match palette.is_empty() {
        true => lists.list()?,
        false => lists.bytes()?.iter().map(|&place| palette.get(place as usize).copied()).collect::<Option<_>>()?,
    };
    let fits = lists.is_at_end() && (values.is_empty() || values.len() == rows);
    (fits && values.iter().all(|value| (0.0..=1.0).contains(value))).then(|| Unary { values: values.into() })
}
