//! Decodes pictures at reduced size (method 7.4): JPEG at a fraction of its size, PNG and TIFF
//! completely, then reduced.
//!
//! Pixels keep their position in the file: EXIF orientation is never applied, because poses and
//! observations refer to the file.

mod resize;

use std::{
    io::{BufRead, BufReader},
    path::Path,
};

use crate::{
    input::{self, FileKind},
    jpeg::CostlyJpeg,
    mistaken,
    picture::{self, Checked},
    project::Unread,
};
use image::{
    ColorType, DynamicImage, ImageDecoder, ImageFormat,
    error::{ImageFormatHint, UnsupportedErrorKind},
};
use jpeg_decoder::PixelFormat;
use viewrank_core::{
    base::{
        error::shortened,
        pixels::{PixelBound, TooManyPixels, most_decoded_bytes},
    },
    method::confidence::Mask,
};
use zune_jpeg::{
    JpegDecoder,
    zune_core::{bytestream::ZCursor, colorspace::ColorSpace, options::DecoderOptions},
};

pub use self::resize::{FilterType, resized};

/// Minimum number of pixels of a reduced picture, unless the file has fewer.
const LEAST_PIXELS: f64 = 750_000.0;
/// Minimum side relative to the file's.
const LEAST_SCALE: f64 = 0.25;
/// Averages the pixels that a larger one covers.
const BY_AREA: FilterType = FilterType::Box;

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
    #[error("{}", shortened(&undecoded(.0)))]
    Other(#[from] image::ImageError),
    #[error(transparent)]
    Large(#[from] TooManyPixels),
    #[error(transparent)]
    Costly(#[from] CostlyJpeg),
    #[error("{width} x {height} pixels, the camera has {} x {}", camera[0], camera[1])]
    Shape {
        width: u32,
        height: u32,
        camera: [u32; 2],
    },
    #[error("{0}")]
    Unread(#[from] Unread),
    #[error("its mask: {0}")]
    Mask(Box<ImageError>),
}

/// Says why an image is not decoded: its format, or a fault.
fn undecoded(error: &image::ImageError) -> String {
    match error {
        image::ImageError::Unsupported(unsupported) => match unsupported.kind() {
            UnsupportedErrorKind::Format(ImageFormatHint::Exact(format)) => {
                format!("{format:?}, but viewrank decodes only JPEG, PNG and TIFF")
            }
            _ => error.to_string(),
        },
        _ => format!("broken image: {error}"),
    }
}

/// Says what is not an image at all.
fn unknown(bytes: &[u8]) -> ImageError {
    mistaken::by_start(bytes).map_or(ImageError::Unknown, |mistaken| {
        Unread::Broken(mistaken.what).into()
    })
}

impl ImageError {
    /// Returns true if no program can match the image: it is damaged, or its aspect ratio differs
    /// from its camera's. False for formats that other programs may read.
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
    /// Reads an image file and reduces it to the size that `wanted` returns for its width and
    /// height.
    pub fn read(
        path: &Path,
        bound: PixelBound,
        wanted: impl Fn([u32; 2]) -> [u32; 2],
    ) -> Result<Self, ImageError> {
        Self::decode(&input::read(path, FileKind::Picture)?, bound, wanted)
    }

    /// Decodes an image and reduces it to the size that `wanted` returns for its width and height.
    pub fn decode(
        bytes: &[u8],
        bound: PixelBound,
        wanted: impl Fn([u32; 2]) -> [u32; 2],
    ) -> Result<Self, ImageError> {
        let bound = bound.of_photograph(bytes.len() as u64);
        let picture = Checked::new(bytes)?;
        let _turn = picture.turn();
        if picture::format(bytes).ok_or_else(|| unknown(bytes))? == ImageFormat::Jpeg {
            let image = jpeg(picture, bound, &wanted)?;
            let [width, height] = wanted(image.full);
            return Ok(image.shrunk(width, height));
        }
        let image = open(picture, bound)?;
        let full = [image.width(), image.height()];
        let to = wanted(full);
        // Grey levels become colours when they are few.
        let rgb = if image.color().has_color() {
            reduced(image.into_rgb8().into_raw(), full, to, 3)
        } else {
            let grey = reduced(image.into_luma8().into_raw(), full, to, 1);
            grey.into_iter().flat_map(|level| [level; 3]).collect()
        };
        let [width, height] = to;
        Ok(Self {
            width,
            height,
            rgb,
            full,
        })
    }

    /// Decodes an image to grey levels, reduced to the size that `wanted` returns for its width and
    /// height; also returns its full size.
    pub fn decode_grey(
        bytes: &[u8],
        bound: PixelBound,
        wanted: impl Fn([u32; 2]) -> [u32; 2],
    ) -> Result<(GreyImage, [u32; 2]), ImageError> {
        let bound = bound.of_photograph(bytes.len() as u64);
        let picture = Checked::new(bytes)?;
        let _turn = picture.turn();
        let (pixels, full) = match picture::format(bytes).ok_or_else(|| unknown(bytes))? {
            ImageFormat::Jpeg => jpeg_grey(picture, bound)?,
            _ => {
                let image = open(picture, bound)?.into_luma8();
                let full = [image.width(), image.height()];
                (image.into_raw(), full)
            }
        };
        let [width, height] = wanted(full);
        let pixels = resized(pixels, full, [width, height], 1, BY_AREA);
        Ok((
            GreyImage {
                width,
                height,
                pixels,
            },
            full,
        ))
    }

    /// Reduces by area averaging; unchanged if it has that size already.
    fn shrunk(self, width: u32, height: u32) -> Self {
        let from = [self.width, self.height];
        Self {
            width,
            height,
            rgb: reduced(self.rgb, from, [width, height], 3),
            full: self.full,
        }
    }
}

/// Reduces values by area averaging; unchanged if they have that size already.
fn reduced(values: Vec<u8>, from: [u32; 2], to: [u32; 2], channels: usize) -> Vec<u8> {
    if from == to {
        values
    } else {
        resized(values, from, to, channels, BY_AREA)
    }
}

/// Grey levels, row by row.
pub struct GreyImage {
    pub width: u32,
    pub height: u32,
    pub pixels: Vec<u8>,
}

/// Decodes to grey levels, with the slower decoder if the faster one fails.
fn jpeg_grey(picture: Checked, bound: PixelBound) -> Result<(Vec<u8>, [u32; 2]), ImageError> {
    if let Some(stored) = stored_luma(picture.bytes(), bound) {
        return Ok(stored);
    }
    let Image { rgb, full, .. } = jpeg(picture, bound, &|full| full)?;
    // JFIF's weights of red, green and blue, in 256ths.
    let luma = |p: &[u8]| {
        ((77 * u32::from(p[0]) + 150 * u32::from(p[1]) + 29 * u32::from(p[2]) + 128) >> 8) as u8
    };
    Ok((rgb.chunks_exact(3).map(luma).collect(), full))
}

/// Decodes luma alone, which saves the colour conversion; `None` if the file doesn't store it, is
/// too large, or cannot be decoded.
fn stored_luma(bytes: &[u8], bound: PixelBound) -> Option<(Vec<u8>, [u32; 2])> {
    // By default the decoder refuses sides above 16,384 pixels; here `bound` decides.
    let options = DecoderOptions::default()
        .jpeg_set_out_colorspace(ColorSpace::Luma)
        .set_max_width(65_535)
        .set_max_height(65_535);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), options);
    decoder.decode_headers().ok()?;
    let full = decoder
        .dimensions()
        .map(|(width, height)| [width, height].map(|side| side as u32))?;
    let is_stored = matches!(
        decoder.input_colorspace(),
        Some(ColorSpace::YCbCr | ColorSpace::Luma)
    );
    if !is_stored || bound.admit(full[0], full[1]).is_err() {
        return None;
    }
    Some((decoder.decode().ok()?, full))
}

/// Returns the size at which a picture is drawn: three quarters of a megapixel or a quarter of the
/// side, whichever is larger.
pub fn drawn_size(full: [u32; 2]) -> [u32; 2] {
    let pixels = f64::from(full[0]) * f64::from(full[1]);
    let scale = (LEAST_PIXELS / pixels).sqrt().clamp(LEAST_SCALE, 1.0);
    // The short side of a narrow picture must not become 0.
    full.map(|side| ((f64::from(side) * scale).round() as u32).max(1))
}

/// Decodes at the smallest of 1/8, 1/4, 1/2 and 1 that is not below the wanted size.
fn jpeg(
    picture: Checked,
    bound: PixelBound,
    wanted: &impl Fn([u32; 2]) -> [u32; 2],
) -> Result<Image, ImageError> {
    let bytes = picture.bytes();
    let mut decoder = jpeg_decoder::Decoder::new(bytes);
    decoder.set_max_decoding_buffer_size(most_decoded_bytes(bytes.len() as u64) as usize);
    decoder.read_info()?;
    let full = decoder
        .info()
        .map_or([1, 1], |info| [info.width, info.height].map(u32::from));
    bound.admit(full[0], full[1])?;
    // The sides of a JPEG are 16-bit numbers.
    let [width, height] = wanted(full).map(|side| side as u16);
    let (width, height) = decoder.scale(width, height)?;
    let data = decoder.decode()?;
    let format = decoder.info().map(|info| info.pixel_format);
    Ok(Image {
        width: width.into(),
        height: height.into(),
        rgb: rgb(format.unwrap_or(PixelFormat::RGB24), data),
        full,
    })
}

/// The pixels of a decoded JPEG as RGB.
fn rgb(format: PixelFormat, data: Vec<u8>) -> Vec<u8> {
    match format {
        PixelFormat::RGB24 => data,
        PixelFormat::L8 => data.iter().flat_map(|&v| [v; 3]).collect(),
        PixelFormat::L16 => data
            .chunks_exact(2)
            .flat_map(|v| [(u16::from_ne_bytes([v[0], v[1]]) >> 8) as u8; 3])
            .collect(),
        // CMYK; the decoder has already inverted it where necessary.
        PixelFormat::CMYK32 => data
            .chunks_exact(4)
            .flat_map(|v| [0, 1, 2].map(|c| product(255 - v[c], 255 - v[3])))
            .collect(),
    }
}

/// Multiplies two shares in 255ths.
fn product(a: u8, b: u8) -> u8 {
    (u16::from(a) * u16::from(b) / 255) as u8
}

fn open(picture: Checked, bound: PixelBound) -> Result<DynamicImage, ImageError> {
    let decoder = picture.open::<ImageError>(bound)?;
    Ok(DynamicImage::from_decoder(decoder)?)
}

/// Decodes a mask: black pixels must not be used.
pub fn mask(bytes: &[u8], bound: PixelBound) -> Result<Mask, ImageError> {
    let picture = Checked::new(bytes)?;
    picture::format(bytes).ok_or_else(|| unknown(bytes))?;
    let _turn = picture.turn();
    let image = open(picture, bound)?;
    let (width, height) = (image.width(), image.height());
    let usable = match image {
        DynamicImage::ImageLuma8(pixels) => pixels.iter().map(|&grey| grey > 0).collect(),
        // Without a copy: a mask may be large.
        DynamicImage::ImageLuma16(pixels) => pixels.iter().map(|&grey| grey > 0).collect(),
        DynamicImage::ImageLumaA8(pixels) => pixels.pixels().map(|pixel| pixel.0[0] > 0).collect(),
        DynamicImage::ImageLumaA16(pixels) => pixels.pixels().map(|pixel| pixel.0[0] > 0).collect(),
        // 16 bits, so that the darkest grey is not rounded to black.
        other => other.into_luma16().iter().map(|&grey| grey > 0).collect(),
    };
    Mask::new(width, height, usable).ok_or(ImageError::Unknown)
}

/// Returns about how many bytes of memory reading a mask takes at its peak, by its header;
/// `None` if it cannot be read.
pub fn mask_reading_bytes(path: &Path, bound: PixelBound) -> Option<u64> {
    let mut file = BufReader::new(input::open(path).ok()?);
    let length = file.get_ref().metadata().ok()?.len();
    let is_jpeg = picture::format(file.fill_buf().ok()?) == Some(ImageFormat::Jpeg);
    let decoder = picture::header(file).ok()?;
    let decoded =
        Some(decoder.total_bytes()).filter(|&bytes| bytes <= most_decoded_bytes(length))?;
    let (width, height) = decoder.dimensions();
    let pixels = bound.admit(width, height).ok()? as u64;
    let of_pixel = match decoder.color_type() {
        ColorType::L8 | ColorType::L16 | ColorType::La8 | ColorType::La16 => 1,
        _ => 2,
    };
    // A progressive JPEG keeps its coefficients, of two bytes each.
    let coefficients = if is_jpeg { 2 * decoded } else { 0 };
    Some(length + decoded + coefficients + of_pixel * pixels)
}

#[cfg(test)]
mod tests;
