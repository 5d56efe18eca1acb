//! Decodes pictures at reduced size (method 7.4): JPEG at a fraction of its size, PNG and TIFF completely, then reduced.
//!
//! Pixels keep their position in the file: EXIF orientation is never applied, because poses and observations refer to the file.

use std::{
    io::{BufReader, Cursor},
    path::Path,
};

use crate::{
    base::input::{self, FileKind},
    io::project::Unread,
};
use fast_image_resize::{FilterType, PixelType, ResizeAlg, ResizeOptions, Resizer, images::Image as Pixels};
use image::{ColorType, DynamicImage, ImageDecoder, ImageFormat, ImageReader, Limits};
use jpeg_decoder::PixelFormat;
use zune_jpeg::{
    JpegDecoder,
    zune_core::{bytestream::ZCursor, colorspace::ColorSpace, options::DecoderOptions},
};

/// Minimum number of pixels of a reduced picture, unless the file has fewer.
const LEAST_PIXELS: f64 = 750_000.0;
/// Minimum side relative to the file's.
const LEAST_SCALE: f64 = 0.25;
/// Memory limit for decoding, bytes; a 16-bit RGB image of 150 megapixels has 900 MB.
const MOST_BYTES: usize = 1 << 30;
/// Limit on the pixels of a JPEG; decoding a progressive one takes up to six bytes each.
pub const MOST_PIXELS: u64 = 1 << 28;

/// A reduced picture: RGB, 8 bit, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct Image {
    pub width: u32,
    pub height: u32,
    /// 3 x width x height bytes.
    pub rgb: Vec<u8>,
    /// Width and height of the file's image.
    pub full: [u32; 2],
}

/// An image that cannot be decoded or doesn't fit its camera.
#[derive(Debug, thiserror::Error)]
pub enum ImageError {
    #[error("{0}")]
    Io(#[from] std::io::Error),
    #[error("no JPEG, PNG or TIFF image")]
    Unknown,
    #[error("broken JPEG: {0}")]
    Jpeg(#[from] jpeg_decoder::Error),
    #[error("broken image: {0}")]
    Other(#[from] image::ImageError),
    #[error("{width} x {height} pixels are too many")]
    Large { width: u32, height: u32 },
    #[error("{width} x {height} pixels, the camera has {} x {}", camera[0], camera[1])]
    Shape { width: u32, height: u32, camera: [u32; 2] },
    #[error("{0}")]
    Unread(#[from] Unread),
    #[error("its mask: {0}")]
    Mask(Box<ImageError>),
}

impl ImageError {
    /// Returns true if no program can match the image: it is damaged, or its aspect ratio differs from its camera's. False for formats that other
    /// programs may read.
    pub fn is_unusable(&self) -> bool {
        matches!(
            self,
            Self::Shape { .. }
                | Self::Jpeg(jpeg_decoder::Error::Format(_) | jpeg_decoder::Error::Io(_))
                | Self::Other(image::ImageError::Decoding(_) | image::ImageError::IoError(_))
        )
    }
}

impl Image {
    /// Reads an image file and reduces it to the size that `wanted` returns for its width and height.
    pub fn read(path: &Path, wanted: impl Fn([u32; 2]) -> [u32; 2]) -> Result<Self, ImageError> {
        Self::decode(&input::read(path, FileKind::Picture)?, wanted)
    }

    /// Decodes an image and reduces it to the size that `wanted` returns for its width and height.
    pub fn decode(bytes: &[u8], wanted: impl Fn([u32; 2]) -> [u32; 2]) -> Result<Self, ImageError> {
        let image = match image::guess_format(bytes).map_err(|_| ImageError::Unknown)? {
            ImageFormat::Jpeg => jpeg(bytes, &wanted)?,
            _ => whole(bytes)?,
        };
        let [width, height] = wanted(image.full);
        Ok(image.shrunk(width, height))
    }

    /// Decodes an image to grey levels, reduced to the size that `wanted` returns for its width and height; also returns its full size.
    pub fn decode_grey(
        bytes: &[u8],
        wanted: impl Fn([u32; 2]) -> [u32; 2],
    ) -> Result<(GreyImage, [u32; 2]), ImageError> {
        let (pixels, full) = match image::guess_format(bytes).map_err(|_| ImageError::Unknown)? {
            ImageFormat::Jpeg => jpeg_grey(bytes)?,
            _ => {
                let image = open(bytes)?.into_luma8();
                let full = [image.width(), image.height()];
                (image.into_raw(), full)
            }
        };
        let [width, height] = wanted(full);
        let sized = "a byte a pixel, and the kind of pixels is the same";
        let from = Pixels::from_vec_u8(full[0], full[1], pixels, PixelType::U8).expect(sized);
        let mut to = Pixels::new(width, height, PixelType::U8);
        let by_areas = ResizeOptions::new().resize_alg(ResizeAlg::Convolution(FilterType::Box));
        Resizer::new().resize(&from, &mut to, &by_areas).expect(sized);
        Ok((GreyImage { width, height, pixels: to.into_vec() }, full))
    }

    /// Reduces by area averaging; unchanged if it has that size already.
    fn shrunk(self, width: u32, height: u32) -> Self {
        if (self.width, self.height) == (width, height) {
            return self;
        }
        let sized = "three bytes a pixel, and the kind of pixels is the same";
        let from = Pixels::from_vec_u8(self.width, self.height, self.rgb, PixelType::U8x3).expect(sized);
        let mut to = Pixels::new(width, height, PixelType::U8x3);
        let by_areas = ResizeOptions::new().resize_alg(ResizeAlg::Convolution(FilterType::Box));
        Resizer::new().resize(&from, &mut to, &by_areas).expect(sized);
        Self { width, height, rgb: to.into_vec(), full: self.full }
    }
}

/// Grey levels, row by row.
pub struct GreyImage {
    pub width: u32,
    pub height: u32,
    pub pixels: Vec<u8>,
}

/// Decodes to grey levels, with the slower decoder if the faster one fails.
fn jpeg_grey(bytes: &[u8]) -> Result<(Vec<u8>, [u32; 2]), ImageError> {
    if let Some(stored) = stored_luma(bytes) {
        return Ok(stored);
    }
    let Image { rgb, full, .. } = jpeg(bytes, &|full| full)?;
    let luma = |p: &[u8]| ((77 * u32::from(p[0]) + 150 * u32::from(p[1]) + 29 * u32::from(p[2]) + 128) >> 8) as u8;
    Ok((rgb.chunks_exact(3).map(luma).collect(), full))
}

/// Decodes luma alone, which saves the colour conversion; `None` if the file doesn't store it, is too large, or cannot be decoded.
fn stored_luma(bytes: &[u8]) -> Option<(Vec<u8>, [u32; 2])> {
    let options = DecoderOptions::default()
        .jpeg_set_out_colorspace(ColorSpace::Luma)
        .set_max_width(65_535)
        .set_max_height(65_535);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), options);
    decoder.decode_headers().ok()?;
    let full = decoder.dimensions().map(|(width, height)| [width, height].map(|side| side as u32))?;
    let is_stored = matches!(decoder.input_colorspace(), Some(ColorSpace::YCbCr | ColorSpace::Luma));
    if !is_stored || u64::from(full[0]) * u64::from(full[1]) > MOST_PIXELS {
        return None;
    }
    Some((decoder.decode().ok()?, full))
}

/// Returns the size at which a picture is drawn: three quarters of a megapixel or a quarter of the side, whichever is larger.
pub fn drawn_size(full: [u32; 2]) -> [u32; 2] {
    let pixels = f64::from(full[0]) * f64::from(full[1]);
    let scale = (LEAST_PIXELS / pixels).sqrt().clamp(LEAST_SCALE, 1.0);
    full.map(|side| ((f64::from(side) * scale).round() as u32).max(1))
}

/// Decodes at the smallest of 1/8, 1/4, 1/2 and 1 that is not below the wanted size.
fn jpeg(bytes: &[u8], wanted: &impl Fn([u32; 2]) -> [u32; 2]) -> Result<Image, ImageError> {
    let mut decoder = jpeg_decoder::Decoder::new(bytes);
    decoder.set_max_decoding_buffer_size(MOST_BYTES);
    decoder.read_info()?;
    let full = decoder.info().map_or([1, 1], |info| [info.width, info.height].map(u32::from));
    if u64::from(full[0]) * u64::from(full[1]) > MOST_PIXELS {
        return Err(ImageError::Large { width: full[0], height: full[1] });
    }
    // The sides of a JPEG are 16-bit numbers.
    let [width, height] = wanted(full).map(|side| side as u16);
    let (width, height) = decoder.scale(width, height)?;
    let data = decoder.decode()?;
    let format = decoder.info().map_or(PixelFormat::RGB24, |info| info.pixel_format);
    let rgb = match format {
        PixelFormat::RGB24 => data,
        PixelFormat::L8 => data.iter().flat_map(|&v| [v; 3]).collect(),
        PixelFormat::L16 => {
            data.chunks_exact(2).flat_map(|v| [(u16::from_ne_bytes([v[0], v[1]]) >> 8) as u8; 3]).collect()
        }
        // CMYK; the decoder has already inverted it where necessary.
        PixelFormat::CMYK32 => {
            data.chunks_exact(4).flat_map(|v| [0, 1, 2].map(|c| product(255 - v[c], 255 - v[3]))).collect()
        }
    };
    Ok(Image { width: width.into(), height: height.into(), rgb, full })
}

/// Multiplies two shares in 255ths.
fn product(a: u8, b: u8) -> u8 {
    (u16::from(a) * u16::from(b) / 255) as u8
}

fn whole(bytes: &[u8]) -> Result<Image, ImageError> {
    let pixels = open(bytes)?.into_rgb8();
    let (width, height) = pixels.dimensions();
    Ok(Image { width, height, rgb: pixels.into_raw(), full: [width, height] })
}

fn open(bytes: &[u8]) -> Result<DynamicImage, ImageError> {
    let mut limits = Limits::default();
    limits.max_alloc = Some(MOST_BYTES as u64);
    let mut reader = ImageReader::new(Cursor::new(bytes)).with_guessed_format()?;
    reader.limits(limits);
    Ok(reader.decode()?)
}

/// Mask of an image by COLMAP's convention: black pixels must not be used.
#[derive(Clone, Debug, PartialEq)]
pub struct Mask {
    pub width: u32,
    pub height: u32,
    usable: Vec<bool>,
}

impl Mask {
    /// Decodes a mask.
    pub fn decode(bytes: &[u8]) -> Result<Self, ImageError> {
        let image = open(bytes)?;
        let (width, height) = (image.width(), image.height());
        let usable = match image {
            DynamicImage::ImageLuma8(pixels) => pixels.iter().map(|&grey| grey > 0).collect(),
            // 16 bits, so that the darkest grey is not rounded to black.
            other => other.into_luma16().iter().map(|&grey| grey > 0).collect(),
        };
        Ok(Self { width, height, usable })
    }

    /// Returns about how many bytes of memory reading a mask takes at its peak, by its header; `None` if it cannot be read.
    pub fn reading_bytes(path: &Path) -> Option<u64> {
        let file = BufReader::new(input::open(path).ok()?);
        let length = file.get_ref().metadata().ok()?.len();
        let decoder = ImageReader::new(file).with_guessed_format().ok()?.into_decoder().ok()?;
        let decoded = Some(decoder.total_bytes()).filter(|&bytes| bytes <= MOST_BYTES as u64)?;
        let (width, height) = decoder.dimensions();
        let of_pixel = if matches!(decoder.color_type(), ColorType::L8 | ColorType::L16) { 1 } else { 2 };
        Some(length + decoded + of_pixel * u64::from(width) * u64::from(height))
    }

    /// Returns whether the pixel at a position, given as shares of width and height, may be used.
    pub fn allows(&self, x: f64, y: f64) -> bool {
        let [column, row] = [(x, self.width), (y, self.height)]
            .map(|(share, side)| ((share * f64::from(side)).max(0.0) as usize).min(side as usize - 1));
        self.usable[row * self.width as usize + column]
    }

    /// Returns the share of usable pixels in a cell of a grid that covers the image.
    pub fn share(&self, grid: [u32; 2], column: u32, row: u32) -> f32 {
        let (columns, rows) = (span(self.width, grid[0], column), span(self.height, grid[1], row));
        let pixels = columns.len() * rows.len();
        let usable = rows.map(|y| {
            let line = &self.usable[y * self.width as usize..][columns.clone()];
            line.iter().filter(|u| **u).count()
        });
        usable.sum::<usize>() as f32 / pixels as f32
    }
}

/// Returns the pixels of a cell along one side, at least one: `cells` cells cover `length` pixels.
pub fn span(length: u32, cells: u32, cell: u32) -> std::ops::Range<usize> {
    let at = |i: u32| (u64::from(i) * u64::from(length) / u64::from(cells)) as usize;
    let from = at(cell).min(length as usize - 1);
    from..at(cell + 1).max(from + 1)
}

#[cfg(test)]
mod tests {
    use image::{GrayImage, ImageBuffer, Rgb, RgbImage};
    use proptest::prelude::*;

    use super::*;

    /// Red grows to the right, green downwards.
    fn ramp(width: u32, height: u32) -> DynamicImage {
        let at = |x: u32, y: u32| Rgb([(x * 200 / width) as u8, (y * 200 / height) as u8, 40]);
        RgbImage::from_fn(width, height, at).into()
    }

    fn encoded(image: &DynamicImage, format: ImageFormat) -> Vec<u8> {
        let mut bytes = Cursor::new(Vec::new());
        image.write_to(&mut bytes, format).unwrap();
        bytes.into_inner()
    }

    /// Returns whether the picture shows the ramp, within JPEG's loss.
    fn assert_is_ramp(image: &Image) {
        for (y, x) in [(0.1, 0.9), (0.5, 0.5), (0.9, 0.2)] {
            let (column, row) = ((x * f64::from(image.width)) as usize, (y * f64::from(image.height)) as usize);
            let pixel = &image.rgb[3 * (row * image.width as usize + column)..][..3];
            for (value, wanted) in pixel.iter().zip([200.0 * x, 200.0 * y, 40.0]) {
                assert!((f64::from(*value) - wanted).abs() < 6.0, "{pixel:?} at {x} {y}");
            }
        }
    }

    #[test]
    fn all_formats_show_the_same_picture() {
        let ramp = ramp(1600, 1200);
        let deep: DynamicImage = DynamicImage::ImageRgb16(ramp.to_rgb16());
        for (image, format) in [
            (&ramp, ImageFormat::Jpeg),
            (&ramp, ImageFormat::Png),
            (&ramp, ImageFormat::Tiff),
            (&deep, ImageFormat::Tiff),
        ] {
            let image = Image::decode(&encoded(image, format), drawn_size).unwrap();
            assert_eq!((image.width, image.height, image.full), (1000, 750, [1600, 1200]));
            assert_is_ramp(&image);
        }
    }

    #[test]
    fn large_images_keep_a_quarter_of_their_side_and_small_ones_all() {
        assert_eq!(drawn_size([8000, 6000]), [2000, 1500]);
        assert_eq!(drawn_size([4000, 3000]), [1000, 750]);
        assert_eq!(drawn_size([640, 480]), [640, 480]);
        assert_eq!(drawn_size([100_000, 1]), [100_000, 1]);
    }

    #[test]
    fn the_orientation_of_exif_is_not_applied() {
        let plain = encoded(&ramp(64, 32), ImageFormat::Jpeg);
        // APP1 with a TIFF header and one entry: orientation (0x0112), short, 1 value, 6 (turn by 90 degrees).
        let exif = b"\xff\xe1\0\x22Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0".to_vec();
        let turned = [&plain[..2], &exif[..], &plain[2..]].concat();
        assert_eq!(Image::decode(&turned, drawn_size).unwrap(), Image::decode(&plain, drawn_size).unwrap());
    }

    /// Made by another program (fixtures/pictures).
    #[test]
    fn kinds_of_files_that_readers_trip_over_show_the_same_picture() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/pictures");
        let whole = |full| full;
        let grey = |name: &str| Image::decode_grey(&std::fs::read(folder.join(name)).unwrap(), whole);
        let (baseline, full) = grey("baseline.jpg").unwrap();
        assert_eq!(full, [48, 32]);
        for name in ["progressive.jpg", "grey.jpg", "rotated_by_exif.jpg", "cmyk.jpg", "grey_16_bit.png", "palette.png"]
        {
            let (other, full) = grey(name).unwrap();
            assert_eq!(full, [48, 32], "{name}");
            let off = baseline.pixels.iter().zip(&other.pixels).map(|(a, b)| u32::from(a.abs_diff(*b)));
            assert!(off.sum::<u32>() < 8 * 48 * 32, "{name}");
        }
        for name in ["baseline.jpg", "progressive.jpg", "rotated_by_exif.jpg", "cmyk.jpg"] {
            assert_is_ramp(&Image::read(&folder.join(name), whole).unwrap());
        }
        // Half a picture is none, by either decoder.
        let cut = std::fs::read(folder.join("truncated.jpg")).unwrap();
        assert!(Image::decode(&cut, whole).is_err() && Image::decode_grey(&cut, whole).is_err());
    }

    #[test]
    fn a_mask_forbids_black_pixels_alone() {
        let dark = GrayImage::from_fn(40, 20, |x, _| image::Luma([u8::from(x >= 20)]));
        let mask = Mask::decode(&encoded(&dark.into(), ImageFormat::Png)).unwrap();
        let shares: Vec<f32> = (0..4).map(|column| mask.share([4, 2], column, 1)).collect();
        assert_eq!(shares, [0.0, 0.0, 1.0, 1.0]);
        assert_eq!(mask.share([1, 1], 0, 0), 0.5);
        // A grid that is finer than the mask.
        assert_eq!(mask.share([100, 100], 99, 99), 1.0);
    }

    /// A grey TIFF of this width and height (TIFF 6.0, section 4), without its pixels.
    fn tiff_header(side: u32) -> Vec<u8> {
        const SHORT: u16 = 3;
        const LONG: u16 = 4;
        let entries = [
            (256, LONG, side),
            (257, LONG, side),
            (258, SHORT, 8),
            (259, SHORT, 1),
            (262, SHORT, 1),
            (273, LONG, 8),
            (277, SHORT, 1),
            (278, LONG, side),
            (279, LONG, 1),
        ];
        let mut bytes = b"II*\0\x08\0\0\0".to_vec();
        bytes.extend((entries.len() as u16).to_le_bytes());
        for (tag, kind, value) in entries {
            bytes.extend([u16::to_le_bytes(tag), kind.to_le_bytes(), [1, 0], [0, 0]].concat());
            bytes.extend(u32::to_le_bytes(value));
        }
        bytes.extend([0; 4]);
        bytes
    }

    #[test]
    fn memory_for_a_mask_depends_on_its_channels() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("mask.png");
        let bytes_per_pixel = |image: DynamicImage| {
            image.save(&path).unwrap();
            let (bytes, file) = (Mask::reading_bytes(&path).unwrap(), path.metadata().unwrap().len());
            (bytes - file) / u64::from(image.width() * image.height())
        };
        assert_eq!(bytes_per_pixel(DynamicImage::new_luma8(40, 30)), 2);
        assert_eq!(bytes_per_pixel(DynamicImage::new_luma16(40, 30)), 3);
        assert_eq!(bytes_per_pixel(DynamicImage::new_rgba8(40, 30)), 6);
        std::fs::write(&path, "no image").unwrap();
        assert_eq!(Mask::reading_bytes(&path), None);
        std::fs::write(&path, tiff_header(10_000)).unwrap();
        assert!(Mask::reading_bytes(&path).unwrap() > 200_000_000);
        std::fs::write(&path, tiff_header(60_000)).unwrap();
        assert_eq!(Mask::reading_bytes(&path), None, "too large to be decoded");
    }

    #[test]
    fn what_is_no_image_is_called_so() {
        assert!(matches!(Image::decode(b"not an image at all", drawn_size), Err(ImageError::Unknown)));
        let cut = &encoded(&ramp(64, 64), ImageFormat::Jpeg)[..300];
        assert!(matches!(Image::decode(cut, drawn_size), Err(ImageError::Jpeg(_))));
        let cut = &encoded(&ramp(64, 64), ImageFormat::Png)[..300];
        assert!(matches!(Image::decode(cut, drawn_size), Err(ImageError::Other(_))));
    }

    #[test]
    fn what_others_may_read_is_not_unusable() {
        let is_unusable = |bytes: &[u8]| Image::decode_grey(bytes, |full| full).err().unwrap().is_unusable();
        for format in [ImageFormat::Jpeg, ImageFormat::Png, ImageFormat::Tiff] {
            let bytes = encoded(&ramp(64, 64), format);
            assert!(is_unusable(&bytes[..bytes.len().min(300)]), "{format:?}");
        }
        assert!(!is_unusable(b"no image"));
        assert!(!is_unusable(&tiff_header(60_000)), "too large");
        // The compression (259, one 16-bit number) of a TIFF that no decoder here knows.
        let mut other = tiff_header(64);
        let compression = other.windows(4).position(|bytes| bytes == [3, 1, 3, 0]).unwrap();
        other[compression + 8] = 200;
        assert!(!is_unusable(&other));
    }

    proptest! {
        #[test]
        fn no_damage_makes_reading_panic(at in 0usize..2000, byte: u8, keep in 0usize..2000) {
            for format in [ImageFormat::Jpeg, ImageFormat::Png, ImageFormat::Tiff] {
                let mut bytes = encoded(&ramp(24, 16), format);
                let at = at % bytes.len();
                bytes[at] = byte;
                let _ = Image::decode(&bytes, drawn_size);
                bytes.truncate(keep);
                let _ = Image::decode(&bytes, drawn_size);
            }
        }

        #[test]
        fn the_cells_of_a_side_share_its_pixels(length in 1u32..500, cells in 1u32..100) {
            prop_assume!(cells <= length);
            let mut next = 0;
            for cell in 0..cells {
                let span = span(length, cells, cell);
                prop_assert_eq!(span.start, next);
                next = span.end;
            }
            prop_assert_eq!(next, length as usize);
        }
    }

    #[test]
    fn grey_becomes_rgb() {
        let grey: ImageBuffer<image::Luma<u8>, _> = GrayImage::from_pixel(30, 20, image::Luma([90]));
        let image = Image::decode(&encoded(&grey.into(), ImageFormat::Jpeg), drawn_size).unwrap();
        assert!(image.rgb.iter().all(|v| v.abs_diff(90) <= 1));
    }
}
