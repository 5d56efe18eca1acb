//! Undistorts one image: decodes, looks up each pixel, resizes, encodes.

use std::{io::Cursor, path::Path};

use image::{
    DynamicImage, ExtendedColorType, ImageDecoder, ImageEncoder, ImageFormat,
    codecs::{jpeg::JpegEncoder, png::PngEncoder, tiff::TiffEncoder},
};
use nalgebra::Point2;
use rayon::prelude::*;

use super::camera::at_size_of;
use crate::{
    base::pixels::{PixelBound, TooManyPixels},
    io::{
        image::{FilterType, resized},
        jpeg::CostlyJpeg,
        picture::Checked,
    },
    model::camera::{Camera, CameraError},
};

/// JPEG quality without visible artefacts: they would be matched, too.
const JPEG_QUALITY: u8 = 100;

/// An error of undistorting an image.
#[derive(Debug, thiserror::Error)]
pub enum UndistortImageError {
    #[error("{0}")]
    Broken(#[from] image::ImageError),
    #[error(transparent)]
    Large(#[from] TooManyPixels),
    #[error(transparent)]
    Costly(#[from] CostlyJpeg),
    #[error("it is {}x{} pixels, its camera {}x{}", found[0], found[1], camera[0], camera[1])]
    Size { found: [u32; 2], camera: [u32; 2] },
    #[error("only .jpg, .png and .tif images can be written")]
    Format,
    #[error(transparent)]
    Camera(#[from] CameraError),
}

/// Returns the file of the undistorted image, in the format given by the ending of `name`. Grey
/// stays grey, all else becomes 8-bit RGB; EXIF and colour profile are kept if the format supports
/// them.
pub fn undistort(
    bytes: &[u8],
    name: &str,
    source: &Camera,
    target: &Camera,
) -> Result<Vec<u8>, UndistortImageError> {
    let format =
        ImageFormat::from_path(Path::new(name)).map_err(|_| UndistortImageError::Format)?;
    let picture = Checked::new(bytes)?;
    let found = picture.size()?;
    if found != [source.width, source.height] {
        return Err(UndistortImageError::Size {
            found,
            camera: [source.width, source.height],
        });
    }
    let mut decoder = picture.open::<UndistortImageError>(PixelBound::LARGEST)?;
    // Before the pixels, whose decoding consumes the decoder.
    let (exif, profile) = (
        decoder.exif_metadata().ok().flatten(),
        decoder.icc_profile().ok().flatten(),
    );
    let picture = Raster::from(DynamicImage::from_decoder(decoder)?);
    picture
        .warped(source, &at_size_of(target, source)?)
        .resized(target)
        .encoded(format, exif, profile)
}

/// 8 bits per channel, row-major.
struct Raster {
    width: u32,
    height: u32,
    /// Number of channels: 1 or 3.
    channels: usize,
    values: Vec<u8>,
}

impl From<DynamicImage> for Raster {
    fn from(image: DynamicImage) -> Self {
        let (width, height) = (image.width(), image.height());
        let grey = !image.color().has_color();
        let values = if grey {
            image.into_luma8().into_raw()
        } else {
            image.into_rgb8().into_raw()
        };
        Self {
            width,
            height,
            channels: if grey { 1 } else { 3 },
            values,
        }
    }
}

impl Raster {
    /// Resamples the image for `target`, a pinhole camera of the same size; pixels that `source`
    /// does not cover are black.
    fn warped(&self, source: &Camera, target: &Camera) -> Self {
        let (focal, centre) = target.pinhole_part();
        let row_length = self.width as usize * self.channels;
        let mut values = vec![0; self.values.len()];
        values
            .par_chunks_exact_mut(row_length)
            .enumerate()
            .for_each(|(y, row)| {
                let y = (y as f64 + 0.5 - centre.y) / focal.y;
                for (x, pixel) in row.chunks_exact_mut(self.channels).enumerate() {
                    let x = (x as f64 + 0.5 - centre.x) / focal.x;
                    if let Some(at) = source.project(&[x, y, 1.0].into()) {
                        self.interpolate(at, pixel);
                    }
                }
            });
        Self { values, ..*self }
    }

    /// Interpolates bilinearly between four pixel centres; leaves `pixel` unchanged if one of them
    /// is outside.
    fn interpolate(&self, at: Point2<f64>, pixel: &mut [u8]) {
        let (x, y) = (at.x - 0.5, at.y - 0.5);
        let (left, top) = (x.floor(), y.floor());
        let inside = left >= 0.0
            && top >= 0.0
            && left + 1.0 < f64::from(self.width)
            && top + 1.0 < f64::from(self.height);
        if !inside {
            return;
        }
        let (u, v) = (x - left, y - top);
        let first = (top as usize * self.width as usize + left as usize) * self.channels;
        let below = first + self.width as usize * self.channels;
        for (c, value) in pixel.iter_mut().enumerate() {
            let at = |i: usize| f64::from(self.values[i + c]);
            let upper = at(first) * (1.0 - u) + at(first + self.channels) * u;
            let lower = at(below) * (1.0 - u) + at(below + self.channels) * u;
            *value = (upper * (1.0 - v) + lower * v).round() as u8;
        }
    }

    /// Resizes to the size of the camera: bilinear, with a filter as wide as the reduction.
    fn resized(self, camera: &Camera) -> Self {
        if (self.width, self.height) == (camera.width, camera.height) {
            return self;
        }
        let (from, to) = ([self.width, self.height], [camera.width, camera.height]);
        Self {
            width: camera.width,
            height: camera.height,
            channels: self.channels,
            values: resized(self.values, from, to, self.channels, FilterType::Bilinear),
        }
    }

    fn encoded(
        &self,
        format: ImageFormat,
        exif: Option<Vec<u8>>,
        profile: Option<Vec<u8>>,
    ) -> Result<Vec<u8>, UndistortImageError> {
        let mut file = Cursor::new(Vec::new());
        match format {
            ImageFormat::Jpeg => self.encode(
                JpegEncoder::new_with_quality(&mut file, JPEG_QUALITY),
                exif,
                profile,
            )?,
            ImageFormat::Png => self.encode(PngEncoder::new(&mut file), exif, profile)?,
            ImageFormat::Tiff => self.encode(TiffEncoder::new(&mut file), exif, profile)?,
            _ => return Err(UndistortImageError::Format),
        }
        Ok(file.into_inner())
    }

    fn encode(
        &self,
        mut encoder: impl ImageEncoder,
        exif: Option<Vec<u8>>,
        profile: Option<Vec<u8>>,
    ) -> image::ImageResult<()> {
        // A format that cannot hold them does without.
        exif.map(|exif| encoder.set_exif_metadata(exif));
        profile.map(|profile| encoder.set_icc_profile(profile));
        let colour = if self.channels == 1 {
            ExtendedColorType::L8
        } else {
            ExtendedColorType::Rgb8
        };
        encoder.write_image(&self.values, self.width, self.height, colour)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        apps::undistort::{UndistortOptions, camera::undistorted},
        model::camera::CameraModel,
    };

    /// A ramp of grey along x of the undistorted image, as a lens with distortion shows it.
    fn ramp(source: &Camera) -> Raster {
        let grey = |i: u32| {
            let pixel = Point2::new(
                f64::from(i % source.width) + 0.5,
                f64::from(i / source.width) + 0.5,
            );
            let ray = source.ray(&pixel).unwrap();
            (128.0 + 100.0 * ray.x / ray.z).round().clamp(0.0, 255.0) as u8
        };
        let values = (0..source.width * source.height).map(grey).collect();
        Raster {
            width: source.width,
            height: source.height,
            channels: 1,
            values,
        }
    }

    #[test]
    fn a_straight_ramp_becomes_straight() {
        let source = Camera::new(
            1,
            CameraModel::Radial,
            320,
            240,
            vec![250.0, 165.0, 117.0, -0.2, 0.05],
        )
        .unwrap();
        let target = undistorted(&source, &UndistortOptions::default()).unwrap();
        let picture = ramp(&source)
            .warped(&source, &at_size_of(&target, &source).unwrap())
            .resized(&target);
        assert_eq!(
            (picture.width, picture.height),
            (target.width, target.height)
        );
        let (focal, centre) = target.pinhole_part();
        for (i, value) in (0..).zip(&picture.values) {
            let x = (f64::from(i % target.width) + 0.5 - centre.x) / focal.x;
            assert!(
                (f64::from(*value) - (128.0 + 100.0 * x)).abs() < 1.5,
                "pixel {i}: {value}"
            );
        }
    }

    #[test]
    fn formats_keep_pixels_and_metadata() {
        let camera =
            Camera::new(1, CameraModel::Pinhole, 32, 16, vec![30.0, 30.0, 16.0, 8.0]).unwrap();
        let picture = ramp(&camera);
        let exif = b"II*\0\x08\0\0\0\0\0\0\0\0\0".to_vec();
        for (name, format) in [
            ("a.png", ImageFormat::Png),
            ("a.tif", ImageFormat::Tiff),
            ("a.JPG", ImageFormat::Jpeg),
        ] {
            let file = picture.encoded(format, Some(exif.clone()), None).unwrap();
            let half = undistorted(
                &camera,
                &UndistortOptions {
                    max_image_size: Some(16),
                    ..UndistortOptions::default()
                },
            )
            .unwrap();
            let small = undistort(&file, name, &camera, &half).unwrap();
            assert_eq!(image::guess_format(&small).unwrap(), format);
            let small = image::load_from_memory(&small).unwrap();
            assert_eq!((small.width(), small.height()), (16, 8));
            assert!(!small.color().has_color());
        }
        let kept = picture
            .encoded(ImageFormat::Jpeg, Some(exif.clone()), None)
            .unwrap();
        assert!(kept.windows(exif.len()).any(|w| w == exif));
    }

    #[test]
    fn another_size_than_the_camera_s_is_an_error() {
        let camera =
            Camera::new(1, CameraModel::Pinhole, 32, 16, vec![30.0, 30.0, 16.0, 8.0]).unwrap();
        let other =
            Camera::new(1, CameraModel::Pinhole, 31, 16, vec![30.0, 30.0, 16.0, 8.0]).unwrap();
        let file = ramp(&camera).encoded(ImageFormat::Png, None, None).unwrap();
        let error = undistort(&file, "a.png", &other, &other)
            .unwrap_err()
            .to_string();
        assert!(
            error.contains("32x16") && error.contains("31x16"),
            "{error}"
        );
        assert!(matches!(
            undistort(&file, "a.webp", &camera, &camera),
            Err(UndistortImageError::Format)
        ));
        assert!(undistort(&file[..60], "a.png", &camera, &camera).is_err());
    }
}
