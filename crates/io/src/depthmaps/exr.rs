//! AliceVision's `ID_depthMap.exr`: OpenEXR with one channel of float or half in scan lines,
//! uncompressed or deflated (AliceVision: `zips`); distances from the camera's centre, -1 for none.
//! See "OpenEXR File Layout".

use half::f16;
use miniz_oxide::inflate::decompress_to_vec_zlib_with_limit;
use viewrank_core::base::{
    large_pages,
    pixels::{PixelBound, most_decoded_bytes},
};

use super::{Parsed, Plane, pixels, u32_at};

/// Magic number, version 2 without flags (scan lines, one part), which may allow names of 255
/// characters.
const MAGIC: u32 = 20_000_630;
const LONG_NAMES: u32 = 0x400;

/// What the header says.
#[derive(Default)]
struct Header {
    /// First and last column and row: x, y, x, y.
    window: Option<[i32; 4]>,
    compression: Option<u8>,
    /// Bytes of a sample: 2 (half) or 4 (float).
    sample: Option<usize>,
    /// Offset of the table of chunks.
    end: usize,
}

pub(super) fn parse(bytes: &[u8], bound: PixelBound) -> Parsed<Plane> {
    if u32_at(bytes, 0)? != MAGIC {
        return Err((0, "not an OpenEXR file".into()));
    }
    if u32_at(bytes, 4)? & !LONG_NAMES != 2 {
        return Err((4, "expected OpenEXR 2, one part, in scan lines".into()));
    }
    let header = header(bytes)?;
    let image = ScanLines::new(&header)?;
    let ScanLines { width, height, .. } = image;
    let pixels = pixels(width, height, bound)?;
    if (size_of::<f32>() * pixels) as u64 > most_decoded_bytes(bytes.len() as u64) {
        let file = bytes.len();
        return Err((
            8,
            format!("{width} x {height} pixels in a file of {file} bytes"),
        ));
    }
    // The memory is touched when a chunk is inflated, and there may be none.
    let mut depth =
        large_pages::try_zeroed::<f32>(pixels).map_err(|error| (8, error.to_string()))?;
    for chunk in 0..height.div_ceil(image.rows_of_chunk) as usize {
        let (low, high) = (
            u32_at(bytes, header.end + 8 * chunk)?,
            u32_at(bytes, header.end + 8 * chunk + 4)?,
        );
        let at = usize::try_from(u64::from(low) | u64::from(high) << 32)
            .map_err(|e| (header.end, e.to_string()))?;
        image.read_chunk(bytes, at, &mut depth)?;
    }
    Ok(([width, height], depth))
}

/// How the lines of the image are stored.
struct ScanLines {
    /// The first row, as chunks count.
    top: i32,
    width: u32,
    height: u32,
    /// Bytes of a sample.
    sample: usize,
    rows_of_chunk: u32,
}

impl ScanLines {
    fn new(header: &Header) -> Parsed<Self> {
        let window = header.window.ok_or_else(|| lacks("dataWindow"))?;
        let [width, height] = size(window)?;
        let sample = header.sample.ok_or_else(|| lacks("channels"))?;
        // The format's numbers of no compression, ZIPS (row by row) and ZIP (16 rows).
        let rows_of_chunk = match header.compression.ok_or_else(|| lacks("compression"))? {
            0 | 2 => 1,
            3 => 16,
            other => {
                let what = format!("compression {other}, expected none, zips or zip");
                return Err((8, what));
            }
        };
        Ok(Self {
            top: window[1],
            width,
            height,
            sample,
            rows_of_chunk,
        })
    }

    /// Reads the chunk at an offset of the file: its first row, its length, and its samples.
    fn read_chunk(&self, bytes: &[u8], at: usize, depth: &mut [f32]) -> Parsed<()> {
        let (width, height, sample) = (self.width as usize, self.height, self.sample);
        // Rows are signed: the window may begin at a negative one.
        let row = i64::from(u32_at(bytes, at)? as i32) - i64::from(self.top);
        let rows = i64::from(height) - row;
        if row < 0 || rows < 1 {
            return Err((at, format!("a line outside the map of {height} lines")));
        }
        // The last chunk may have fewer rows.
        let length = width * sample * rows.min(self.rows_of_chunk.into()) as usize;
        let start = at.saturating_add(8);
        let stored = u32_at(bytes, at.saturating_add(4))? as usize;
        let stored = bytes
            .get(start..start.saturating_add(stored))
            .ok_or_else(|| (bytes.len(), "unexpected end of file".to_string()))?;
        let values = unpacked(stored, length).map_err(|what| (at, what))?;
        let values = values.chunks_exact(sample);
        for (z, value) in depth[row as usize * width..].iter_mut().zip(values) {
            *z = if sample == 4 {
                f32::from_le_bytes([value[0], value[1], value[2], value[3]])
            } else {
                f16::from_le_bytes([value[0], value[1]]).to_f32()
            };
        }
        Ok(())
    }
}

fn lacks(what: &str) -> (usize, String) {
    (8, format!("the header has no {what}"))
}

/// Width and height of a window.
fn size([left, top, right, bottom]: [i32; 4]) -> Parsed<[u32; 2]> {
    let side = |from: i32, to: i32| u32::try_from(i64::from(to) - i64::from(from) + 1);
    match (side(left, right), side(top, bottom)) {
        (Ok(width @ 1..), Ok(height @ 1..)) => Ok([width, height]),
        _ => Err((8, "the map has no pixels".into())),
    }
}

/// Reads the attributes: name, type (each ends with 0), length, value; an empty name ends the list.
fn header(bytes: &[u8]) -> Parsed<Header> {
    let (mut found, mut at) = (Header::default(), 8);
    loop {
        let name = word(bytes, &mut at)?;
        if name.is_empty() {
            found.end = at;
            return Ok(found);
        }
        word(bytes, &mut at)?;
        let length = u32_at(bytes, at)? as usize;
        let value = bytes.get(at + 4..(at + 4).saturating_add(length));
        let value = value.ok_or_else(|| {
            (
                bytes.len(),
                "unexpected end of file in the header".to_string(),
            )
        })?;
        match name {
            b"channels" => found.sample = Some(sample(value).map_err(|(_, what)| (at, what))?),
            b"compression" => found.compression = value.first().copied(),
            b"dataWindow" => {
                let side = |i: usize| {
                    u32_at(value, 4 * i)
                        .map(|side| side as i32)
                        .map_err(|(_, what)| (at, what))
                };
                found.window = Some([side(0)?, side(1)?, side(2)?, side(3)?]);
            }
            _ => {}
        }
        at += 4 + length;
    }
}

/// Size of a sample: the list has name, type (1: half, 2: float) and 12 bytes more of each channel,
/// and an empty name at the end.
fn sample(channels: &[u8]) -> Parsed<usize> {
    let mut at = 0;
    word(channels, &mut at)?;
    let kind = u32_at(channels, at)?;
    at = (at + 16).min(channels.len());
    if !word(channels, &mut at)?.is_empty() {
        return Err((0, "several channels, expected one".into()));
    }
    match kind {
        1 => Ok(2),
        2 => Ok(4),
        _ => Err((0, format!("samples of type {kind}, expected half or float"))),
    }
}

/// The bytes up to a 0; `at` moves behind that.
fn word<'a>(bytes: &'a [u8], at: &mut usize) -> Parsed<&'a [u8]> {
    let rest = &bytes[(*at).min(bytes.len())..];
    // Names have at most 255 characters.
    let end = rest.iter().take(256).position(|&b| b == 0);
    let end = end.ok_or_else(|| (*at, "expected a name in the header".to_string()))?;
    *at += end + 1;
    Ok(&rest[..end])
}

/// The samples of a chunk: stored as they are where packing would not shrink them, else deflated,
/// as differences of neighbours, after all even bytes were put before all odd ones.
fn unpacked(stored: &[u8], length: usize) -> Result<Vec<u8>, String> {
    if stored.len() == length {
        return Ok(stored.to_vec());
    }
    let mut bytes =
        decompress_to_vec_zlib_with_limit(stored, length).map_err(|error| error.to_string())?;
    if bytes.len() != length {
        return Err(format!(
            "{} bytes of samples, expected {length}",
            bytes.len()
        ));
    }
    // OpenEXR's predictor: differences of neighbours, plus 128.
    for i in 1..length {
        bytes[i] = bytes[i].wrapping_add(bytes[i - 1]).wrapping_sub(128);
    }
    let (even, odd) = bytes.split_at(length.div_ceil(2));
    Ok((0..length)
        .map(|i| if i % 2 == 0 { even[i / 2] } else { odd[i / 2] })
        .collect())
}
