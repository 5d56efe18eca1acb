//! GPS positions and the orientation in the EXIF data of images: JPEG (CIPA DC-008, APP1) and TIFF.

use std::{io::Read, path::Path};

use viewrank_core::model::georeference::Geodetic;

use crate::input;

/// Bytes of an image that are searched; EXIF data is at the beginning of a JPEG file, and at most
/// 64 KiB long.
const SEARCHED: u64 = 256 << 10;
/// Largest number of entries of a directory that is read.
const MOST_ENTRIES: usize = 512;

// Tags of CIPA DC-008: of the first directory (IFD0), then of the GPS directory.
const ORIENTATION: u16 = 0x0112;
const GPS_DIRECTORY: u16 = 0x8825;
const LATITUDE_REF: u16 = 1;
const LATITUDE: u16 = 2;
const LONGITUDE_REF: u16 = 3;
const LONGITUDE: u16 = 4;
const ALTITUDE_REF: u16 = 5;
const ALTITUDE: u16 = 6;

/// The position at which the image was taken, its height above sea level; `None` if it has none or
/// cannot be read.
pub fn position(image: &Path) -> Option<Geodetic> {
    Tiff::new(tiff_of(&start(image)?)?)?.position()
}

/// Returns whether the image is to be shown turned by 90° to either side (orientations 5 to 8);
/// false if it doesn't say so or cannot be read.
pub fn is_shown_turned(image: &Path) -> bool {
    let orientation = || Tiff::new(tiff_of(&start(image)?)?)?.orientation();
    orientation().is_some_and(|orientation| (5..=8).contains(&orientation))
}

/// The beginning of an image, which has its EXIF data.
fn start(image: &Path) -> Option<Vec<u8>> {
    let mut bytes = Vec::new();
    let file = input::open(image).ok()?;
    file.take(SEARCHED).read_to_end(&mut bytes).ok()?;
    Some(bytes)
}

fn tiff_of(bytes: &[u8]) -> Option<&[u8]> {
    if bytes.starts_with(&[0xff, 0xd8]) {
        exif_of_jpeg(bytes)
    } else {
        Some(bytes)
    }
}

/// Finds the TIFF structure in the segments of a JPEG file.
fn exif_of_jpeg(bytes: &[u8]) -> Option<&[u8]> {
    let mut rest = bytes.get(2..)?;
    loop {
        let [0xff, kind, high, low, ..] = *rest else {
            return None;
        };
        let length = usize::from(u16::from_be_bytes([high, low]));
        let segment = rest.get(4..2 + length)?;
        match (kind, segment.strip_prefix(b"Exif\0\0")) {
            (0xe1, Some(tiff)) => return Some(tiff),
            // The scan: everything about the image is before it.
            (0xda, _) => return None,
            _ => rest = rest.get(2 + length..)?,
        }
    }
}

/// A TIFF structure, whose offsets count from its beginning.
struct Tiff<'a> {
    bytes: &'a [u8],
    is_big_endian: bool,
}

/// A directory entry: tag, number of values, and where they are.
struct Entry {
    tag: u16,
    count: u32,
    place: usize,
}

impl<'a> Tiff<'a> {
    fn new(bytes: &'a [u8]) -> Option<Self> {
        let is_big_endian = match bytes.get(..2)? {
            b"MM" => true,
            b"II" => false,
            _ => return None,
        };
        Some(Self {
            bytes,
            is_big_endian,
        })
    }

    fn u16(&self, at: usize) -> Option<u16> {
        self.big_endian(at).map(u16::from_be_bytes)
    }

    fn u32(&self, at: usize) -> Option<u32> {
        self.big_endian(at).map(u32::from_be_bytes)
    }

    /// The bytes of a number, the largest first.
    fn big_endian<const N: usize>(&self, at: usize) -> Option<[u8; N]> {
        let mut bytes: [u8; N] = self.bytes.get(at..at.checked_add(N)?)?.try_into().ok()?;
        if !self.is_big_endian {
            bytes.reverse();
        }
        Some(bytes)
    }

    fn directory(&self, at: usize) -> Option<Vec<Entry>> {
        let count = usize::from(self.u16(at)?).min(MOST_ENTRIES);
        let entry = |i: usize| {
            let at = at + 2 + 12 * i;
            Some(Entry {
                tag: self.u16(at)?,
                count: self.u32(at + 4)?,
                place: at + 8,
            })
        };
        (0..count).map(entry).collect()
    }

    fn main(&self) -> Option<Vec<Entry>> {
        self.directory(self.u32(4)? as usize)
    }

    fn orientation(&self) -> Option<u16> {
        let main = self.main()?;
        let orientation = main.iter().find(|entry| entry.tag == ORIENTATION)?;
        self.u16(orientation.place)
    }

    fn gps(&self) -> Option<Vec<Entry>> {
        let main = self.main()?;
        let gps = main.iter().find(|entry| entry.tag == GPS_DIRECTORY)?;
        self.directory(self.u32(gps.place)? as usize)
    }

    fn position(&self) -> Option<Geodetic> {
        let gps = self.gps()?;
        let find = |tag| gps.iter().find(|entry| entry.tag == tag);
        // The side of zero on which a value is.
        let signed = |value: f64, tag, negative: u8| {
            let side = find(tag).and_then(|entry| self.bytes.get(entry.place));
            if side == Some(&negative) {
                -value
            } else {
                value
            }
        };
        let latitude = signed(self.degrees(find(LATITUDE)?)?, LATITUDE_REF, b'S');
        let longitude = signed(self.degrees(find(LONGITUDE)?)?, LONGITUDE_REF, b'W');
        let height = find(ALTITUDE)
            .and_then(|entry| self.rational(self.u32(entry.place)? as usize))
            .unwrap_or(0.0);
        let height = signed(height, ALTITUDE_REF, 1);
        let position = Geodetic {
            longitude,
            latitude,
            height,
        };
        is_possible(&position).then_some(position)
    }

    /// Degrees, minutes and seconds.
    fn degrees(&self, entry: &Entry) -> Option<f64> {
        if entry.count != 3 {
            return None;
        }
        let at = self.u32(entry.place)? as usize;
        let part = |i: usize| self.rational(at.checked_add(8 * i)?);
        Some(part(0)? + part(1)? / 60.0 + part(2).unwrap_or(0.0) / 3600.0)
    }

    fn rational(&self, at: usize) -> Option<f64> {
        let value = f64::from(self.u32(at)?) / f64::from(self.u32(at.checked_add(4)?)?);
        value.is_finite().then_some(value)
    }
}

/// Cameras without a fix write zeros.
fn is_possible(position: &Geodetic) -> bool {
    let (latitude, longitude) = (position.latitude, position.longitude);
    latitude.abs() <= 90.0
        && longitude.abs() <= 180.0
        && (latitude, longitude) != (0.0, 0.0)
        && position.height.is_finite()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A JPEG file that holds nothing but a position, 52.5 N, 13.25 W, 30 m below sea level.
    fn jpeg() -> Vec<u8> {
        let mut tiff = b"MM\0*\0\0\0\x08".to_vec();
        let entry = |tag: u16, kind: u16, count: u32, value: [u8; 4]| {
            [
                &tag.to_be_bytes()[..],
                &kind.to_be_bytes(),
                &count.to_be_bytes(),
                &value,
            ]
            .concat()
        };
        let at = |offset: u32| offset.to_be_bytes();
        tiff.extend([&[0, 1][..], &entry(GPS_DIRECTORY, 4, 1, at(26)), &[0; 4]].concat());
        tiff.extend([0, 6]);
        tiff.extend(entry(LATITUDE_REF, 2, 2, *b"N\0\0\0"));
        tiff.extend(entry(LATITUDE, 5, 3, at(104)));
        tiff.extend(entry(LONGITUDE_REF, 2, 2, *b"W\0\0\0"));
        tiff.extend(entry(LONGITUDE, 5, 3, at(128)));
        tiff.extend(entry(ALTITUDE_REF, 1, 1, [1, 0, 0, 0]));
        tiff.extend(entry(ALTITUDE, 5, 1, at(152)));
        tiff.extend([0; 4]);
        for (number, divisor) in [
            (52u32, 1u32),
            (30, 1),
            (0, 1),
            (13, 1),
            (1500, 100),
            (0, 1),
            (60, 2),
        ] {
            tiff.extend([number.to_be_bytes(), divisor.to_be_bytes()].concat());
        }
        let segment = [b"Exif\0\0", &tiff[..]].concat();
        let length = (segment.len() as u16 + 2).to_be_bytes();
        [
            &[0xff, 0xd8, 0xff, 0xe0, 0, 4, 7, 7, 0xff, 0xe1][..],
            &length,
            &segment,
            &[0xff, 0xda, 0, 2],
        ]
        .concat()
    }

    #[test]
    fn a_position_is_read_from_a_jpeg_file() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), jpeg()).unwrap();
        let expected = Geodetic {
            longitude: -13.25,
            latitude: 52.5,
            height: -30.0,
        };
        assert_eq!(position(file.path()), Some(expected));
    }

    #[test]
    fn damaged_positions_are_none() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let whole = jpeg();
        for length in 0..whole.len() - 4 {
            std::fs::write(file.path(), &whole[..length]).unwrap();
            assert_eq!(position(file.path()), None, "{length} bytes");
        }
        for at in 0..whole.len() {
            let mut damaged = whole.clone();
            damaged[at] = 0xff;
            std::fs::write(file.path(), damaged).unwrap();
            _ = position(file.path());
        }
    }
}
