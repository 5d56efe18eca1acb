//! Opens image files with bounds: on pixels before any is decoded, and on what a header may hold.

use std::{
    io::{self, BufRead, Cursor, Read, Seek, SeekFrom},
    sync::{Mutex, MutexGuard, PoisonError},
};

use image::{
    ImageDecoder, ImageFormat, ImageReader, ImageResult, Limits,
    error::{ImageError, UnsupportedError, UnsupportedErrorKind},
};
use tiff::{
    TiffResult,
    decoder::Decoder,
    tags::{CompressionMethod, Tag},
};
use viewrank_core::base::pixels::{PixelBound, TooManyPixels, most_decoded_bytes};

use crate::jpeg::{self, CostlyJpeg, refuse_costly};

/// Limit on colour profile and other metadata, bytes: they may be deflated.
const METADATA_BYTES: u64 = 32 << 20;
/// Bytes in which the size of a JPEG is searched; its decoder reads a file whole.
const JPEG_HEADER_BYTES: u64 = 16 << 20;

/// Says what to do with a TIFF of JPEGs.
pub const TIFF_OF_JPEGS: &str = "JPEG compression: convert it to a JPEG, a PNG or another TIFF";

/// Pictures of up to so many decoded bytes, and of so many for each byte of their files, are
/// decoded beside each other: photographs hardly shrink so much.
const BESIDE: u64 = 64 << 20;
const BESIDE_PER_BYTE: u64 = 32;

/// First bytes of a TIFF for files of any length, which have a mark of their own.
const BIG_TIFF: [&[u8]; 2] = [b"II+\0", b"MM\0+"];

/// The format of an image by its first bytes.
pub fn format(bytes: &[u8]) -> Option<ImageFormat> {
    if BIG_TIFF.iter().any(|start| bytes.starts_with(start)) {
        return Some(ImageFormat::Tiff);
    }
    image::guess_format(bytes).ok()
}

/// Most strips or tiles of a TIFF: tiles of 16 by 16 pixels of a picture of 200 megapixels. Its
/// decoder holds 50 bytes for each before it looks at any.
const MOST_STRIPS: u64 = 1 << 20;
/// Tags of TIFF 6.0 whose lists have an entry for each strip or tile.
const OF_STRIPS: [u16; 4] = [273, 279, 324, 325];

/// Most tags that are looked at, which are in ascending order.
const MOST_TAGS: u64 = 1 << 12;

/// Refuses a TIFF that takes much memory before any pixel is decoded.
pub fn refuse_many_strips(file: &mut (impl Read + Seek)) -> io::Result<()> {
    if strips(file)? > MOST_STRIPS {
        return Err(io::Error::other("a TIFF of millions of strips or tiles"));
    }
    Ok(())
}

/// The number of strips or tiles of the first picture in a TIFF, without reading their places.
fn strips(file: &mut (impl Read + Seek)) -> io::Result<u64> {
    let mut head = [0; 16];
    file.rewind()?;
    file.read_exact(&mut head)?;
    let number = |bytes: &[u8]| {
        let big_endian = bytes
            .iter()
            .fold(0, |sum, &byte| sum << 8 | u64::from(byte));
        let swapped = bytes.iter().rev();
        let little_endian = swapped.fold(0, |sum, &byte| sum << 8 | u64::from(byte));
        if head[0] == b'M' {
            big_endian
        } else {
            little_endian
        }
    };
    // 42 in a TIFF, 43 in a BigTIFF.
    let is_big = number(&head[2..4]) == 43;
    let (start, of_count, of_entry) = if is_big {
        (number(&head[8..16]), 8, 20)
    } else {
        (number(&head[4..8]), 2, 12)
    };
    file.seek(SeekFrom::Start(start))?;
    let mut count = vec![0; of_count];
    file.read_exact(&mut count)?;
    let mut most = 0;
    for _ in 0..number(&count).min(MOST_TAGS) {
        let mut entry = vec![0; of_entry];
        file.read_exact(&mut entry)?;
        if OF_STRIPS.contains(&(number(&entry[..2]) as u16)) {
            let length = if is_big { &entry[4..12] } else { &entry[4..8] };
            most = number(length).max(most);
        }
    }
    Ok(most)
}

fn reader<R: BufRead + Seek>(mut file: R) -> io::Result<ImageReader<R>> {
    if format(file.fill_buf()?) != Some(ImageFormat::Tiff) {
        return ImageReader::new(file).with_guessed_format();
    }
    refuse_many_strips(&mut file)?;
    file.rewind()?;
    Ok(ImageReader::with_format(file, ImageFormat::Tiff))
}

/// The bytes of a picture, of whose parts none is costly.
#[derive(Clone, Copy)]
pub struct Checked<'a>(&'a [u8]);

impl<'a> Checked<'a> {
    pub fn new(bytes: &'a [u8]) -> Result<Self, CostlyJpeg> {
        if format(bytes) == Some(ImageFormat::Jpeg) {
            refuse_costly(bytes)?;
        }
        Ok(Self(bytes))
    }

    pub fn bytes(self) -> &'a [u8] {
        self.0
    }

    fn decoder(self) -> ImageResult<impl ImageDecoder + 'a> {
        decoder(reader(Cursor::new(self.0))?)
    }

    /// Width and height by the header.
    pub fn size(self) -> ImageResult<[u32; 2]> {
        let (width, height) = self.decoder()?.dimensions();
        Ok([width, height])
    }

    /// Waits until no other picture that shrinks more than photographs do is being decoded: a few
    /// megabytes may hold planes of half a gigabyte each. The holder must not wait for other
    /// threads.
    pub fn turn(self) -> Option<MutexGuard<'static, ()>> {
        static TURN: Mutex<()> = Mutex::new(());
        let decoded = self.decoder().ok()?.total_bytes();
        let is_plane = decoded > BESIDE.max(BESIDE_PER_BYTE.saturating_mul(self.0.len() as u64));
        is_plane.then(|| TURN.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Opens an image of no more pixels than the bound, to be decoded.
    pub fn open<E>(self, bound: PixelBound) -> Result<impl ImageDecoder + 'a, E>
    where
        E: From<image::ImageError> + From<TooManyPixels>,
    {
        refuse_tiff_of_jpegs(self.0)?;
        let mut decoder = self.decoder()?;
        let (width, height) = decoder.dimensions();
        bound.admit(width, height)?;
        let mut limits = Limits::default();
        limits.max_alloc = Some(most_decoded_bytes(self.0.len() as u64));
        limits.reserve(decoder.total_bytes())?;
        decoder.set_limits(limits)?;
        // Decoders abort where there is no memory.
        let room = Vec::<u8>::new().try_reserve_exact(decoder.total_bytes() as usize);
        room.map_err(|error| image::ImageError::IoError(error.into()))?;
        Ok(decoder)
    }
}

/// Reads the header of an image, from its start.
pub fn header<'a>(file: impl BufRead + Seek + 'a) -> ImageResult<impl ImageDecoder + 'a> {
    let mut reader = reader(file)?;
    if reader.format() == Some(ImageFormat::Jpeg) {
        let mut file = reader.into_inner();
        let mut bytes = Vec::new();
        file.by_ref()
            .take(JPEG_HEADER_BYTES)
            .read_to_end(&mut bytes)?;
        // The decoder goes through the segments to find the header.
        jpeg::scans(&bytes).map_err(io::Error::other)?;
        file.rewind()?;
        reader = ImageReader::with_format(file, ImageFormat::Jpeg);
    }
    decoder(reader)
}

fn decoder<'a>(
    mut reader: ImageReader<impl BufRead + Seek + 'a>,
) -> ImageResult<impl ImageDecoder + 'a> {
    let mut limits = Limits::default();
    limits.max_alloc = Some(METADATA_BYTES);
    reader.limits(limits);
    reader.into_decoder()
}

/// Returns whether the strips or tiles of a TIFF are JPEGs, each of which may be larger than the
/// TIFF says.
pub fn is_tiff_of_jpegs(tiff: &mut Decoder<impl Read + Seek>) -> TiffResult<bool> {
    let method = tiff.find_tag_unsigned(Tag::Compression)?;
    Ok(method
        .map(CompressionMethod::from_u16_exhaustive)
        .is_some_and(|method| {
            matches!(
                method,
                CompressionMethod::JPEG | CompressionMethod::ModernJPEG
            )
        }))
}

/// Where the last strip or tile of a TIFF's first picture ends, bytes; `None` of what is no TIFF.
pub fn end_of_tiff(mut file: impl Read + Seek) -> Option<u64> {
    refuse_many_strips(&mut file).ok()?;
    file.rewind().ok()?;
    let mut tiff = Decoder::new(file).ok()?;
    let mut list = |tag| tiff.get_tag_u64_vec(tag).ok();
    let [offsets, lengths] = match list(Tag::StripOffsets) {
        Some(offsets) => [Some(offsets), list(Tag::StripByteCounts)],
        None => [list(Tag::TileOffsets), list(Tag::TileByteCounts)],
    };
    let ends = offsets?.into_iter().zip(lengths?);
    ends.map(|(offset, length)| offset.saturating_add(length))
        .max()
}

fn refuse_tiff_of_jpegs(bytes: &[u8]) -> ImageResult<()> {
    if format(bytes) != Some(ImageFormat::Tiff) {
        return Ok(());
    }
    refuse_many_strips(&mut Cursor::new(bytes)).map_err(ImageError::IoError)?;
    let tiff = Decoder::new(Cursor::new(bytes));
    if !tiff.is_ok_and(|mut tiff| is_tiff_of_jpegs(&mut tiff).unwrap_or(true)) {
        return Ok(());
    }
    let kind = UnsupportedErrorKind::GenericFeature(TIFF_OF_JPEGS.into());
    let error = UnsupportedError::from_format_and_kind(ImageFormat::Tiff.into(), kind);
    Err(ImageError::Unsupported(error))
}

/// Width and height by the header of an image; `None` if it isn't one.
pub fn size(file: impl BufRead + Seek) -> Option<[u32; 2]> {
    let reader = reader(file).ok()?;
    let is_jpeg = reader.format() == Some(ImageFormat::Jpeg);
    let file = reader.into_inner();
    let (width, height) = if is_jpeg {
        let mut head = Vec::new();
        file.take(JPEG_HEADER_BYTES).read_to_end(&mut head).ok()?;
        header(Cursor::new(head)).ok()?.dimensions()
    } else {
        header(file).ok()?.dimensions()
    };
    Some([width, height])
}
