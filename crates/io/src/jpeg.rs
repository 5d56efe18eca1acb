//! Bounds on the parts of a JPEG: each takes its decoders time, whatever few bytes it has.

use std::ops::RangeInclusive;

use jpeg_decoder::{CodingProcess, Decoder};
use viewrank_core::base::pixels::most_decoded_bytes;

/// Limit on the scans, each of which may visit all pixels in a few hundred bytes; programs write
/// about ten.
const MOST_SCANS: usize = 100;
/// Limit on the segments, of which a decoder may look through all earlier ones for each. Profiles,
/// thermal images and the like take one for each 64 KiB.
const MOST_SEGMENTS: usize = 4096;
/// Bytes of a Huffman table without a code (ITU T.81, B.2.4.2); a segment may have many tables,
/// each of which is expanded.
const TABLE_BYTES: usize = 17;

const RESTARTS: RangeInclusive<u8> = 0xd0..=0xd7;
const END_OF_IMAGE: u8 = 0xd9;
const START_OF_SCAN: u8 = 0xda;
const HUFFMAN_TABLES: u8 = 0xc4;

/// A JPEG that costs more than its pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CostlyJpeg {
    #[error("a JPEG of more than {MOST_SCANS} scans")]
    Scans,
    #[error("a JPEG of more than {MOST_SEGMENTS} segments: save it without its metadata")]
    Segments,
    #[error("a JPEG in several scans that takes too much memory: save it as a baseline JPEG")]
    Coefficients,
}

/// Refuses a JPEG that is costly to decode, also by the size of an image in several scans: decoders
/// keep the coefficients of all its blocks, at any scale and for grey alone.
pub fn refuse_costly(bytes: &[u8]) -> Result<(), CostlyJpeg> {
    let scans = scans(bytes)?;
    let mut decoder = Decoder::new(bytes);
    // What it cannot read the other decoder refuses, or reads in one scan.
    let (Ok(()), Some(info)) = (decoder.read_info(), decoder.info()) else {
        return Ok(());
    };
    let coefficients =
        u64::from(info.width) * u64::from(info.height) * info.pixel_format.pixel_bytes() as u64;
    let is_kept = info.coding_process == CodingProcess::DctProgressive || scans > 1;
    // Of 16 bits each.
    if is_kept && 2 * coefficients > most_decoded_bytes(bytes.len() as u64) {
        Err(CostlyJpeg::Coefficients)
    } else {
        Ok(())
    }
}

/// Counts the scans up to the end of the image. What follows the image (the film of a motion photo,
/// say) does not count; scan data has no marker but restarts (ITU T.81, B.1.1.5).
///
/// # Errors
/// If there are too many scans, or segments.
pub fn scans(bytes: &[u8]) -> Result<usize, CostlyJpeg> {
    let (mut at, mut scans, mut segments) = (2, 0, 0);
    while let Some(next) = bytes
        .get(at..)
        .and_then(|rest| rest.windows(2).position(|pair| is_marker(pair[0], pair[1])))
    {
        let marker = bytes[at + next + 1];
        at += next + 2;
        match marker {
            END_OF_IMAGE => break,
            // Before all scans it is as long as it says, or an error.
            _ if RESTARTS.contains(&marker) && scans > 0 => {}
            _ => {
                scans += usize::from(marker == START_OF_SCAN);
                let Some(length) = bytes.get(at..at + 2) else {
                    break;
                };
                // A length counts its own two bytes; one below 2 is damaged.
                let length = usize::from(u16::from_be_bytes([length[0], length[1]])).max(2);
                at += length;
                segments += 1;
                if marker == HUFFMAN_TABLES {
                    segments += length / TABLE_BYTES;
                }
            }
        }
        if scans > MOST_SCANS {
            return Err(CostlyJpeg::Scans);
        }
        if segments > MOST_SEGMENTS {
            return Err(CostlyJpeg::Segments);
        }
    }
    Ok(scans)
}

/// A stuffed byte or a fill byte is no marker.
fn is_marker(first: u8, second: u8) -> bool {
    first == 0xff && second != 0 && second != 0xff
}
