//! An image next to the confidence predicted from it.

use std::io::Cursor;

use image::{ImageFormat, Rgb, RgbImage};

use crate::io::image::Image;

/// Colours of 0, 1/4, 1/2, 3/4 and 1, dark to light, distinguishable by the colour-blind (five
/// colours of matplotlib's viridis).
const COLOURS: [[f32; 3]; 5] = [
    [68.0, 1.0, 84.0],
    [59.0, 82.0, 139.0],
    [33.0, 145.0, 140.0],
    [94.0, 201.0, 98.0],
    [253.0, 231.0, 37.0],
];
/// Colour of pixels without a value.
const UNKNOWN: Rgb<u8> = Rgb([160; 3]);
/// Width of the legend, pixels, and of its bar.
const LEGEND: u32 = 60;
const BAR: u32 = 16;
/// Side of one dot of the legend's digits, pixels.
const DOT: u32 = 3;
/// Bitmaps of the digits, in rows of three dots.
const FIGURES: [(char, [u8; 5]); 4] = [
    ('0', [0b111, 0b101, 0b101, 0b101, 0b111]),
    ('1', [0b010, 0b110, 0b010, 0b010, 0b111]),
    ('5', [0b111, 0b100, 0b111, 0b001, 0b111]),
    ('.', [0b000, 0b000, 0b000, 0b000, 0b010]),
];

/// Returns a PNG: the image, to its right its confidence in colour at the same scale, then the
/// legend from 1 (top) to 0. `at`: the confidence at a pixel's column and row; grey if `None`.
pub fn confidence_picture(image: &Image, at: impl Fn(u32, u32) -> Option<f32>) -> Vec<u8> {
    // The digits of the legend need some height.
    let (width, height) = (image.width, image.height.max(40));
    let mut picture = RgbImage::from_pixel(2 * width + LEGEND, height, Rgb([255; 3]));
    for y in 0..image.height {
        for x in 0..width {
            let first = 3 * (y as usize * width as usize + x as usize);
            picture.put_pixel(
                x,
                y,
                Rgb([image.rgb[first], image.rgb[first + 1], image.rgb[first + 2]]),
            );
            picture.put_pixel(width + x, y, at(x, y).map_or(UNKNOWN, colour));
        }
    }
    legend(&mut picture, 2 * width, height);
    let mut bytes = Cursor::new(Vec::new());
    picture
        .write_to(&mut bytes, ImageFormat::Png)
        .expect("writing to memory does not fail");
    bytes.into_inner()
}

/// Returns the confidence alone in colour, 8-bit RGB, row-major; grey where it is `None`.
pub fn in_colour(values: &[Option<f32>]) -> Vec<u8> {
    values
        .iter()
        .flat_map(|value| value.map_or(UNKNOWN, colour).0)
        .collect()
}

fn colour(value: f32) -> Rgb<u8> {
    let position = value.clamp(0.0, 1.0) * (COLOURS.len() - 1) as f32;
    let first = (position as usize).min(COLOURS.len() - 2);
    let share = position - first as f32;
    Rgb([0, 1, 2]
        .map(|c| (COLOURS[first][c] * (1.0 - share) + COLOURS[first + 1][c] * share).round() as u8))
}

fn legend(picture: &mut RgbImage, left: u32, height: u32) {
    for y in 0..height {
        let value = 1.0 - y as f32 / (height - 1) as f32;
        (left + 4..left + 4 + BAR).for_each(|x| picture.put_pixel(x, y, colour(value)));
    }
    for (text, share) in [("1", 0.0), ("0.5", 0.5), ("0", 1.0)] {
        let top = (share * f64::from(height - 5 * DOT)) as u32;
        for (i, wanted) in text.chars().enumerate() {
            let dots = FIGURES
                .iter()
                .find(|(figure, _)| *figure == wanted)
                .map_or([0; 5], |f| f.1);
            figure(picture, left + 8 + BAR + i as u32 * 4 * DOT, top, &dots);
        }
    }
}

fn figure(picture: &mut RgbImage, left: u32, top: u32, dots: &[u8; 5]) {
    for y in 0..5 * DOT {
        for x in 0..3 * DOT {
            if dots[(y / DOT) as usize] >> (2 - x / DOT) & 1 == 1 && left + x < picture.width() {
                picture.put_pixel(left + x, top + y, Rgb([0; 3]));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shows_the_picture_the_map_and_the_legend() {
        let image = Image {
            width: 60,
            height: 50,
            rgb: vec![90; 3 * 60 * 50],
            full: [60, 50],
        };
        let halves = |x, y| (y < 40).then_some(if x < 30 { 0.0 } else { 1.0 });
        let picture = image::load_from_memory(&confidence_picture(&image, halves))
            .unwrap()
            .into_rgb8();
        assert_eq!(picture.dimensions(), (180, 50));
        let [low, high] = [COLOURS[0], COLOURS[4]].map(|c| Rgb(c.map(|v| v as u8)));
        assert_eq!(*picture.get_pixel(30, 20), Rgb([90; 3]));
        assert_eq!(
            (*picture.get_pixel(61, 20), *picture.get_pixel(118, 20)),
            (low, high)
        );
        assert_eq!(*picture.get_pixel(61, 45), UNKNOWN);
        assert_eq!(
            (*picture.get_pixel(126, 49), *picture.get_pixel(126, 0)),
            (low, high)
        );
    }
}
