//! Formats, damage and bounds of pictures and masks.

use std::io::Cursor;

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
        let (column, row) = (
            (x * f64::from(image.width)) as usize,
            (y * f64::from(image.height)) as usize,
        );
        let pixel = &image.rgb[3 * (row * image.width as usize + column)..][..3];
        for (value, wanted) in pixel.iter().zip([200.0 * x, 200.0 * y, 40.0]) {
            assert!(
                (f64::from(*value) - wanted).abs() < 6.0,
                "{pixel:?} at {x} {y}"
            );
        }
    }
}

#[test]
fn an_error_is_short_whatever_the_decoder_says() {
    let said = std::io::Error::other("8, ".repeat(60_000));
    let error = ImageError::Other(image::ImageError::IoError(said));
    assert!(error.to_string().len() < 2000);
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
        let image =
            Image::decode(&encoded(image, format), PixelBound::LARGEST, drawn_size).unwrap();
        assert_eq!(
            (image.width, image.height, image.full),
            (1000, 750, [1600, 1200])
        );
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
    // APP1 with a TIFF header and one entry: orientation (0x0112), short, 1 value, 6 (turn by 90
    // degrees).
    let exif =
        b"\xff\xe1\0\x22Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"
            .to_vec();
    let turned = [&plain[..2], &exif[..], &plain[2..]].concat();
    assert_eq!(
        Image::decode(&turned, PixelBound::LARGEST, drawn_size).unwrap(),
        Image::decode(&plain, PixelBound::LARGEST, drawn_size).unwrap()
    );
}

/// Made by another program (fixtures/pictures).
#[test]
fn kinds_of_files_that_readers_trip_over_show_the_same_picture() {
    let folder = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../..")).join("fixtures/pictures");
    let whole = |full| full;
    let grey = |name: &str| {
        Image::decode_grey(
            &std::fs::read(folder.join(name)).unwrap(),
            PixelBound::LARGEST,
            whole,
        )
    };
    let (baseline, full) = grey("baseline.jpg").unwrap();
    assert_eq!(full, [48, 32]);
    for name in [
        "progressive.jpg",
        "grey.jpg",
        "rotated_by_exif.jpg",
        "cmyk.jpg",
        "grey_16_bit.png",
        "palette.png",
    ] {
        let (other, full) = grey(name).unwrap();
        assert_eq!(full, [48, 32], "{name}");
        let off = baseline
            .pixels
            .iter()
            .zip(&other.pixels)
            .map(|(a, b)| u32::from(a.abs_diff(*b)));
        assert!(off.sum::<u32>() < 8 * 48 * 32, "{name}");
    }
    for name in [
        "baseline.jpg",
        "progressive.jpg",
        "rotated_by_exif.jpg",
        "cmyk.jpg",
    ] {
        assert_is_ramp(&Image::read(&folder.join(name), PixelBound::LARGEST, whole).unwrap());
    }
    // Neither decoder accepts half a picture.
    let cut = std::fs::read(folder.join("truncated.jpg")).unwrap();
    assert!(
        Image::decode(&cut, PixelBound::LARGEST, whole).is_err()
            && Image::decode_grey(&cut, PixelBound::LARGEST, whole).is_err()
    );
}

#[test]
fn a_mask_forbids_black_pixels_alone() {
    let dark = GrayImage::from_fn(40, 20, |x, _| image::Luma([u8::from(x >= 20)]));
    let mask = mask(
        &encoded(&dark.into(), ImageFormat::Png),
        PixelBound::LARGEST,
    )
    .unwrap();
    let shares: Vec<f32> = (0..4).map(|column| mask.share([4, 2], column, 1)).collect();
    assert_eq!(shares, [0.0, 0.0, 1.0, 1.0]);
    assert_eq!(mask.share([1, 1], 0, 0), 0.5);
    // A grid that is finer than the mask.
    assert_eq!(mask.share([100, 100], 99, 99), 1.0);
}

/// A grey TIFF of this width and height (TIFF 6.0, section 4), without its pixels.
fn tiff_header(side: u32, compression: u32) -> Vec<u8> {
    const SHORT: u16 = 3;
    const LONG: u16 = 4;
    let entries = [
        (256, LONG, side),
        (257, LONG, side),
        (258, SHORT, 8),
        (259, SHORT, compression),
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
fn a_tiff_of_jpegs_is_refused_and_nothing_else_is_wrong_with_it() {
    for compression in [6, 7] {
        let bytes = tiff_header(40, compression);
        let errors = [
            Image::decode(&bytes, PixelBound::LARGEST, drawn_size).unwrap_err(),
            mask(&bytes, PixelBound::LARGEST).unwrap_err(),
        ];
        for error in errors {
            assert!(
                matches!(error, ImageError::Other(image::ImageError::Unsupported(_))),
                "{error}"
            );
            assert!(!error.is_unusable());
        }
    }
}

#[test]
fn coefficients_of_a_jpeg_count_at_any_scale() {
    let jpeg = |process: u8, [width, height]: [u16; 2]| {
        let sides = [height.to_be_bytes(), width.to_be_bytes()].concat();
        let parts: [&[u8]; 6] = [
            &[0xff, 0xd8, 0xff, process, 0, 17, 8],
            &sides,
            &[3, 1, 0x11, 0, 2, 0x11, 0, 3, 0x11, 0],
            &[0xff, 0xda, 0, 12, 3, 1, 0, 2, 0, 3, 0],
            &[0, 0, 0],
            &[0xff, 0xd9],
        ];
        parts.concat()
    };
    let (sequential, progressive) = (0xc0, 0xc2);
    let is_refused = |bytes: &[u8]| {
        let grey = Image::decode_grey(bytes, PixelBound::LARGEST, |_| [60, 45]).err();
        let drawn = Image::decode(bytes, PixelBound::LARGEST, |_| [60, 45]).err();
        [grey, drawn]
            .map(|error| matches!(error, Some(ImageError::Costly(CostlyJpeg::Coefficients))))
    };
    assert_eq!(is_refused(&jpeg(progressive, [18_900, 14_175])), [true; 2]);
    for (process, sides) in [(progressive, [600, 450]), (sequential, [18_900, 14_175])] {
        assert_eq!(is_refused(&jpeg(process, sides)), [false; 2]);
    }
}

#[test]
fn memory_for_a_mask_depends_on_its_channels() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("mask.png");
    let bytes_per_pixel = |image: DynamicImage| {
        image.save(&path).unwrap();
        let (bytes, file) = (
            mask_reading_bytes(&path, PixelBound::LARGEST).unwrap(),
            path.metadata().unwrap().len(),
        );
        (bytes - file) / u64::from(image.width() * image.height())
    };
    assert_eq!(bytes_per_pixel(DynamicImage::new_luma8(40, 30)), 2);
    assert_eq!(bytes_per_pixel(DynamicImage::new_luma16(40, 30)), 3);
    assert_eq!(bytes_per_pixel(DynamicImage::new_luma_a16(40, 30)), 5);
    assert_eq!(bytes_per_pixel(DynamicImage::new_rgba8(40, 30)), 6);
    std::fs::write(&path, "no image").unwrap();
    assert_eq!(mask_reading_bytes(&path, PixelBound::LARGEST), None);
    std::fs::write(&path, tiff_header(10_000, 1)).unwrap();
    assert!(mask_reading_bytes(&path, PixelBound::LARGEST).unwrap() > 200_000_000);
    std::fs::write(&path, tiff_header(60_000, 1)).unwrap();
    assert_eq!(
        mask_reading_bytes(&path, PixelBound::LARGEST),
        None,
        "too large to be decoded"
    );
}

#[test]
fn what_is_no_image_is_called_so() {
    assert!(matches!(
        Image::decode(b"not an image at all", PixelBound::LARGEST, drawn_size),
        Err(ImageError::Unknown)
    ));
    let cut = &encoded(&ramp(64, 64), ImageFormat::Jpeg)[..300];
    assert!(matches!(
        Image::decode(cut, PixelBound::LARGEST, drawn_size),
        Err(ImageError::Jpeg(_))
    ));
    let cut = &encoded(&ramp(64, 64), ImageFormat::Png)[..300];
    assert!(matches!(
        Image::decode(cut, PixelBound::LARGEST, drawn_size),
        Err(ImageError::Other(_))
    ));
}

#[test]
fn what_others_may_read_is_not_unusable() {
    let is_unusable = |bytes: &[u8]| {
        Image::decode_grey(bytes, PixelBound::LARGEST, |full| full)
            .err()
            .unwrap()
            .is_unusable()
    };
    for format in [ImageFormat::Jpeg, ImageFormat::Png, ImageFormat::Tiff] {
        let bytes = encoded(&ramp(64, 64), format);
        assert!(is_unusable(&bytes[..bytes.len().min(300)]), "{format:?}");
    }
    assert!(!is_unusable(b"no image"));
    assert!(!is_unusable(&tiff_header(60_000, 1)), "too large");
    // The compression (259, one 16-bit number) of a TIFF that no decoder here knows.
    let mut other = tiff_header(64, 1);
    let compression = other
        .windows(4)
        .position(|bytes| bytes == [3, 1, 3, 0])
        .unwrap();
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
            let _ = Image::decode(&bytes, PixelBound::LARGEST, drawn_size);
            bytes.truncate(keep);
            let _ = Image::decode(&bytes, PixelBound::LARGEST, drawn_size);
        }
    }
}

#[test]
fn pictures_and_masks_of_more_pixels_than_the_bound_are_refused() {
    let (exact, less) = (PixelBound::new(64 * 48), PixelBound::new(64 * 48 - 1));
    let is_large = |error: ImageError| {
        matches!(
            error,
            ImageError::Large(TooManyPixels {
                width: 64,
                height: 48,
                ..
            })
        )
    };
    for format in [ImageFormat::Jpeg, ImageFormat::Png, ImageFormat::Tiff] {
        let bytes = encoded(&ramp(64, 48), format);
        assert!(
            Image::decode(&bytes, exact, drawn_size).is_ok(),
            "{format:?}"
        );
        assert!(
            Image::decode(&bytes, less, drawn_size).is_err_and(is_large),
            "{format:?}"
        );
        assert!(
            Image::decode_grey(&bytes, exact, |full| full).is_ok(),
            "{format:?}"
        );
        assert!(
            Image::decode_grey(&bytes, less, |full| full)
                .err()
                .is_some_and(is_large),
            "{format:?}"
        );
        assert!(mask(&bytes, exact).is_ok(), "{format:?}");
        assert!(mask(&bytes, less).is_err_and(is_large), "{format:?}");
    }
}

#[test]
fn a_jpeg_of_many_scans_is_refused() {
    let bytes = std::fs::read(
        Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../.."))
            .join("fixtures/pictures/progressive.jpg"),
    )
    .unwrap();
    // From the last mark of a scan to that of the image's end.
    let scan = bytes
        .windows(2)
        .rposition(|mark| mark == [0xff, 0xda])
        .unwrap()..bytes.len() - 2;
    let repeated = |times: usize| {
        [
            &bytes[..scan.end],
            &bytes[scan.clone()].repeat(times),
            &bytes[scan.end..],
        ]
        .concat()
    };
    let decode = |bytes: &[u8]| Image::decode_grey(bytes, PixelBound::LARGEST, |full| full).err();
    assert!(decode(&repeated(0)).is_none());
    assert!(matches!(
        decode(&repeated(200)),
        Some(ImageError::Costly(CostlyJpeg::Scans))
    ));
    let colour = Image::decode(&repeated(200), PixelBound::LARGEST, |full| full);
    assert!(matches!(colour, Err(ImageError::Costly(CostlyJpeg::Scans))));
}

#[test]
fn a_jpeg_of_many_segments_is_refused_as_a_picture_and_as_a_mask() {
    let plain = encoded(&ramp(64, 48), ImageFormat::Jpeg);
    let with = |segments: &[u8]| [&plain[..2], segments, &plain[2..]].concat();
    let refusals = |bytes: &[u8]| {
        let picture = Image::decode(bytes, PixelBound::LARGEST, drawn_size).err();
        let grey = Image::decode_grey(bytes, PixelBound::LARGEST, |full| full).err();
        let mask = mask(bytes, PixelBound::LARGEST).err();
        let is_refused = |error| matches!(error, Some(ImageError::Costly(CostlyJpeg::Segments)));
        let has_no_size = picture::size(Cursor::new(bytes)).is_none();
        [
            is_refused(picture),
            is_refused(grey),
            is_refused(mask),
            has_no_size,
        ]
    };
    let application = b"\xff\xe5\0\x02";
    assert_eq!(refusals(&with(&application.repeat(4000))), [false; 4]);
    let many = application.repeat(5000);
    // A restart, which has a length to some decoders, and would hide what follows it from others.
    let restart = b"\xff\xd0\0\x06\xff\xe5\xff\xff";
    // Tables of no code.
    let tables = [&b"\xff\xc4\xff\xff"[..], &[0; 65_533]].concat();
    for segments in [
        many.clone(),
        [&restart[..], &many].concat(),
        tables.repeat(2),
    ] {
        assert_eq!(refusals(&with(&segments)), [true; 4]);
    }
}

#[test]
fn grey_becomes_rgb() {
    let grey: ImageBuffer<image::Luma<u8>, _> = GrayImage::from_pixel(30, 20, image::Luma([90]));
    let image = Image::decode(
        &encoded(&grey.into(), ImageFormat::Jpeg),
        PixelBound::LARGEST,
        drawn_size,
    )
    .unwrap();
    assert!(image.rgb.iter().all(|v| v.abs_diff(90) <= 1));
}

#[test]
fn a_tiff_with_the_mark_of_long_files_is_one() {
    let mut bytes = Cursor::new(Vec::new());
    let mut tiff = tiff::encoder::TiffEncoder::new_big(&mut bytes).unwrap();
    tiff.write_image::<tiff::encoder::colortype::Gray8>(4, 2, &[7; 8])
        .unwrap();
    let bytes = bytes.into_inner();
    let (grey, full) = Image::decode_grey(&bytes, PixelBound::LARGEST, |full| full).unwrap();
    assert_eq!((grey.pixels, full), (vec![7; 8], [4, 2]));
    assert_eq!(picture::size(Cursor::new(&bytes)), Some([4, 2]));
}

#[test]
fn a_tiff_of_millions_of_strips_is_refused_before_their_places_are_read() {
    let strips = 2_000_000u32;
    for first in [273u16, 324] {
        let tags = [
            (256, 3u16, 1, 1u32),
            (257, 3, 1, 60_000),
            (258, 3, 1, 8),
            (262, 3, 1, 1),
            (first, 4, strips, 200),
            (first + 1, 4, strips, 200),
        ];
        let mut bytes = b"II*\0\x08\0\0\0".to_vec();
        bytes.extend((tags.len() as u16).to_le_bytes());
        for (tag, kind, count, value) in tags {
            bytes.extend(tag.to_le_bytes());
            bytes.extend(kind.to_le_bytes());
            bytes.extend(count.to_le_bytes());
            bytes.extend(value.to_le_bytes());
        }
        bytes.resize(200 + 4 * strips as usize, 0);
        let refused = Image::decode_grey(&bytes, PixelBound::LARGEST, |full| full);
        let refused = refused.err().expect("too many strips").to_string();
        assert!(refused.contains("millions of strips"), "{refused}");
        assert_eq!(picture::size(Cursor::new(&bytes)), None);
        assert_eq!(picture::end_of_tiff(Cursor::new(&bytes)), None);
    }
}
