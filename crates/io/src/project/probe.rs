//! Checks that image files are complete, and reads their sizes.

use std::{
    fs::File,
    io::{self, BufRead, BufReader, Cursor, Read, Seek, SeekFrom},
    path::Path,
};

use image::{ImageDecoder, ImageFormat};
use viewrank_core::base::pixels::most_photographed_pixels;

use crate::{input, mistaken, picture};

/// Numbers of leading bytes of an image to parse for its header, before trying the whole file.
const HEADS: [u64; 2] = [1 << 16, 1 << 20];

/// Reason why the size of an image cannot be determined.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
pub enum Unread {
    #[error("no file")]
    Missing,
    #[error("{0}")]
    Broken(&'static str),
}

/// Reads the width and height of a complete image, judging by its name, header and end; `None` for
/// formats that cannot be checked.
pub fn probe(path: &Path) -> Result<Option<[u32; 2]>, Unread> {
    let (file, length) = open(path)?;
    if is_raw(path) {
        return Ok(None);
    }
    // The tail is then searched with a single read.
    let mut file = BufReader::with_capacity(TAIL as usize, file);
    let can_be_checked = ImageFormat::from_path(path).is_ok_and(|format| format.reading_enabled());
    match dimensions(&mut file, length) {
        None => match mistaken::of_file(path) {
            Some(mistaken) => Err(Unread::Broken(mistaken.what)),
            None if can_be_checked => Err(Unread::Broken("not an image")),
            None => Ok(None),
        },
        Some(_) if is_truncated(&mut file, length).unwrap_or(false) => {
            Err(Unread::Broken("truncated"))
        }
        Some([width, height])
            if u64::from(width) * u64::from(height) > most_photographed_pixels(length) =>
        {
            Err(Unread::Broken("of more pixels than its bytes can show"))
        }
        found => Ok(found),
    }
}

/// Extensions of the raw pictures of cameras, in lower case. Most are TIFFs of a small picture.
const RAW: [&str; 12] = [
    "3fr", "arw", "cr2", "cr3", "dng", "iiq", "nef", "orf", "pef", "raf", "rw2", "srw",
];

/// Returns whether a file is a raw picture of a camera by its name. Some programs read these,
/// viewrank does not.
pub fn is_raw(path: &Path) -> bool {
    let extension = path.extension().and_then(|extension| extension.to_str());
    extension.is_some_and(|extension| RAW.contains(&&*extension.to_ascii_lowercase()))
}

/// Opens a file that isn't empty; returns it and its length.
fn open(path: &Path) -> Result<(File, u64), Unread> {
    let found = path
        .metadata()
        .ok()
        .filter(|found| !found.is_dir())
        .ok_or(Unread::Missing)?;
    if !found.is_file() {
        return Err(Unread::Broken("not a regular file"));
    }
    if found.len() == 0 {
        return Err(Unread::Broken("empty"));
    }
    let file = input::open(path).map_err(|error| match error.kind() {
        io::ErrorKind::PermissionDenied => Unread::Broken("no permission to read it"),
        // It has holes, such as a stopped download leaves.
        io::ErrorKind::InvalidData => Unread::Broken("not completely copied"),
        _ => Unread::Broken("cannot be opened"),
    })?;
    Ok((file, found.len()))
}

/// Bytes at the end of an image file to search for the mark of its end, before searching the rest.
const TAIL: u64 = 1 << 16;
const START_OF_IMAGE: &[u8] = &[0xff, 0xd8];
const END_OF_IMAGE: &[u8] = &[0xff, 0xd9];
const START_OF_SCAN: u8 = 0xda;
const PNG_SIGNATURE: &[u8] = b"\x89PNG\r\n\x1a\n";
/// The last chunk of a PNG file (PNG specification, 11.2.5), without its checksum, which decoders
/// don't read.
const PNG_END: &[u8] = b"\0\0\0\0IEND";

/// Returns whether a JPEG or PNG file lacks the mark of its end, or a TIFF ends before its pixels;
/// other bytes may follow. JPEG's mark cannot occur by chance in scan data (ITU T.81, B.1.1.5), but
/// it can occur before the first scan, in an embedded thumbnail.
fn is_truncated(file: &mut BufReader<File>, length: u64) -> io::Result<bool> {
    file.rewind()?;
    let start = file.fill_buf()?;
    let (is_jpeg, is_png) = (
        start.starts_with(START_OF_IMAGE),
        start.starts_with(PNG_SIGNATURE),
    );
    if !is_jpeg && !is_png {
        file.rewind()?;
        return Ok(picture::end_of_tiff(file).is_some_and(|end| end > length));
    }
    let end = if is_jpeg { END_OF_IMAGE } else { PNG_END };
    if length > TAIL {
        file.seek(SeekFrom::Start(length - TAIL))?;
        if contains(file, end)? {
            return Ok(false);
        }
    }
    if is_jpeg {
        seek_first_scan(file)?
    } else {
        file.rewind()?
    }
    Ok(!contains(file, end)?)
}

/// Seeks to the data of the first scan or, without a scan, past the last complete segment.
fn seek_first_scan(file: &mut BufReader<File>) -> io::Result<()> {
    file.seek(SeekFrom::Start(2))?;
    loop {
        let mut segment = Vec::new();
        file.take(4).read_to_end(&mut segment)?;
        let [0xff, kind, high, low] = segment[..] else {
            return file.seek_relative(-(segment.len() as i64));
        };
        // The length counts its own two bytes.
        file.seek_relative(i64::from(u16::from_be_bytes([high, low])) - 2)?;
        if kind == START_OF_SCAN {
            return Ok(());
        }
    }
}

/// Returns whether the rest of the file contains these bytes.
fn contains(file: &mut impl BufRead, wanted: &[u8]) -> io::Result<bool> {
    // What was read last, after the end of what was read before.
    let mut searched = Vec::new();
    loop {
        let bytes = file.fill_buf()?;
        let read = bytes.len();
        searched.extend_from_slice(bytes);
        if searched
            .windows(wanted.len())
            .any(|window| window == wanted)
        {
            return Ok(true);
        }
        if read == 0 {
            return Ok(false);
        }
        file.consume(read);
        searched.drain(..(searched.len() + 1).saturating_sub(wanted.len()));
    }
}

/// Width and height from the header; reads as little of the file as possible.
fn dimensions(file: &mut BufReader<File>, length: u64) -> Option<[u32; 2]> {
    let mut from_head = |bytes: u64| {
        file.rewind().ok()?;
        let mut head = Vec::new();
        file.take(bytes).read_to_end(&mut head).ok()?;
        picture::size(Cursor::new(head))
    };
    let found = HEADS
        .into_iter()
        .filter(|bytes| *bytes < length)
        .find_map(&mut from_head);
    found.or_else(|| file.rewind().ok().and_then(|()| picture::size(file)))
}

/// Width and height of an image file, wherever they are in it.
pub(super) fn size_by_header(path: &Path) -> Option<(u32, u32)> {
    picture::size(BufReader::new(input::open(path).ok()?)).map(Into::into)
}

/// Width and height of an image file by its header, and whether it has colours; `None` if that is
/// not near its start.
pub(super) fn kind_by_header(path: &Path) -> Option<([u32; 2], bool)> {
    let (mut file, _) = open(path).ok()?;
    let of_head = |bytes: u64| {
        let mut head = Vec::new();
        file.rewind().ok()?;
        file.by_ref().take(bytes).read_to_end(&mut head).ok()?;
        let decoder = picture::header(Cursor::new(head)).ok()?;
        Some((
            decoder.dimensions().into(),
            decoder.color_type().has_color(),
        ))
    };
    HEADS.into_iter().find_map(of_head)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_are_found_wherever_they_are_read() {
        for text in ["ab", "xab", "xxab", "xxxab", "xxaab", "aab", "xxxxxabxx"] {
            for capacity in 1..5 {
                let mut file = BufReader::with_capacity(capacity, text.as_bytes());
                assert!(
                    contains(&mut file, b"ab").unwrap(),
                    "{text}, {capacity} at a time"
                );
            }
        }
        for text in ["", "a", "b", "axb", "xxba", "aaa"] {
            assert!(
                !contains(&mut BufReader::with_capacity(2, text.as_bytes()), b"ab").unwrap(),
                "{text}"
            );
        }
    }
}
