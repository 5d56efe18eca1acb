//! Camera of an undistorted image, by the rules of COLMAP's `image_undistorter`
//! (image/undistortion.cc).

use nalgebra::Point2;

use super::UndistortOptions;
use crate::model::camera::{Camera, CameraError, CameraModel};

/// Returns the PINHOLE camera of the undistorted images of `camera`: the same focal lengths, and a
/// size at which the content along the borders of the distorted image (or of the region of
/// interest) is at the borders of the undistorted one.
pub fn undistorted(camera: &Camera, options: &UndistortOptions) -> Result<Camera, CameraError> {
    let region = CropBox::new(camera, options.roi);
    let (focal, centre) = camera.pinhole_part();
    let mut pinhole = Pinhole {
        size: [region.right - region.left, region.bottom - region.top].map(f64::from),
        focal: [focal.x, focal.y],
        centre: [
            centre.x - f64::from(region.left),
            centre.y - f64::from(region.top),
        ],
    };
    // As in COLMAP, a pinhole camera keeps its size.
    if !camera.is_pinhole() || options.roi != UndistortOptions::WHOLE {
        pinhole.fit(&region.borders(camera, &pinhole), options);
    }
    let longest = pinhole.size[0].max(pinhole.size[1]);
    if let Some(most) = options
        .max_image_size
        .map(f64::from)
        .filter(|most| *most < longest)
    {
        pinhole.rescale(pinhole.size.map(|n| (most / longest * n).round().max(1.0)));
    }
    pinhole.camera(camera.id)
}

/// Returns the undistorted camera at the size of the distorted image: pixels are looked up at this
/// size, then resized.
pub fn at_size_of(camera: &Camera, source: &Camera) -> Result<Camera, CameraError> {
    let (focal, centre) = camera.pinhole_part();
    let size = [camera.width, camera.height].map(f64::from);
    let mut pinhole = Pinhole {
        size,
        focal: focal.into(),
        centre: [centre.x, centre.y],
    };
    pinhole.rescale([source.width, source.height].map(f64::from));
    pinhole.camera(camera.id)
}

/// Region of interest in the distorted image, pixels.
struct CropBox {
    left: u32,
    right: u32,
    top: u32,
    bottom: u32,
}

impl CropBox {
    /// `roi`: left, top, right, bottom, as shares of the sides.
    fn new(camera: &Camera, roi: [f64; 4]) -> Self {
        let at = |share: f64, side: u32| (share * f64::from(side)).round() as u32;
        let left = at(roi[0], camera.width).min(camera.width - 1);
        let top = at(roi[1], camera.height).min(camera.height - 1);
        let right = at(roi[2], camera.width).clamp(left + 1, camera.width);
        let bottom = at(roi[3], camera.height).clamp(top + 1, camera.height);
        Self {
            left,
            right,
            top,
            bottom,
        }
    }

    /// Projects the borders of the distorted image: for x, then y, the range of the near and of the
    /// far border.
    fn borders(&self, camera: &Camera, pinhole: &Pinhole) -> [[Range; 2]; 2] {
        let (width, height) = (f64::from(camera.width), f64::from(camera.height));
        let along = |axis: usize, from: u32, to: u32, pixel: &dyn Fn(f64) -> [f64; 2]| {
            (from..to)
                .filter_map(|i| pinhole.seen(camera, pixel(f64::from(i) + 0.5)))
                .map(|p| p[axis])
                .collect()
        };
        [
            // COLMAP takes the borders of the image, not of the region, along the region's sides.
            [0.5, width - 0.5].map(|x| along(0, self.top, self.bottom, &|y| [x, y])),
            [0.5, height - 0.5].map(|y| along(1, self.left, self.right, &|x| [x, y])),
        ]
    }
}

/// The smallest and the largest coordinate.
struct Range {
    least: f64,
    greatest: f64,
}

impl FromIterator<f64> for Range {
    fn from_iter<I: IntoIterator<Item = f64>>(values: I) -> Self {
        let none = Self {
            least: f64::INFINITY,
            greatest: f64::NEG_INFINITY,
        };
        values.into_iter().fold(none, |r, v| Self {
            least: r.least.min(v),
            greatest: r.greatest.max(v),
        })
    }
}

/// A pinhole camera under construction; x, y each.
struct Pinhole {
    size: [f64; 2],
    focal: [f64; 2],
    centre: [f64; 2],
}

impl Pinhole {
    /// Maps a pixel of the distorted camera to this camera; `None` sideways and behind.
    fn seen(&self, camera: &Camera, pixel: [f64; 2]) -> Option<[f64; 2]> {
        let ray = camera.ray(&Point2::from(pixel))?;
        let seen = [0, 1].map(|i| self.focal[i] * ray[i] / ray.z + self.centre[i]);
        (ray.z > 0.0).then_some(seen)
    }

    /// Grows or shrinks the image, at constant focal lengths, between no blank pixels and no lost
    /// pixels.
    fn fit(&mut self, borders: &[[Range; 2]; 2], options: &UndistortOptions) {
        for (i, [near, far]) in borders.iter().enumerate() {
            let (size, centre) = (self.size[i], self.centre[i]);
            let rest = size - 0.5 - centre;
            let all_pixels = (centre / (centre - near.least)).min(rest / (far.greatest - centre));
            let no_blanks = (centre / (centre - near.greatest)).max(rest / (far.least - centre));
            let scale = 1.0
                / (all_pixels * options.blank_pixels + no_blanks * (1.0 - options.blank_pixels));
            // Not a number where a border is seen nowhere: a field of 180 degrees and more.
            let scale = if scale.is_nan() {
                options.max_scale
            } else {
                scale
            };
            self.size[i] = (scale.clamp(options.min_scale, options.max_scale) * size)
                .max(1.0)
                .floor();
            self.centre[i] *= self.size[i] / size;
        }
    }

    fn rescale(&mut self, size: [f64; 2]) {
        for (i, new) in size.into_iter().enumerate() {
            let scale = new / self.size[i];
            (self.size[i], self.focal[i], self.centre[i]) =
                (new, scale * self.focal[i], scale * self.centre[i]);
        }
    }

    fn camera(&self, id: u32) -> Result<Camera, CameraError> {
        let [width, height] = self.size.map(|n| n as u64);
        Camera::new(
            id,
            CameraModel::Pinhole,
            width,
            height,
            [self.focal, self.centre].concat(),
        )
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn barrel(k: f64) -> Camera {
        Camera::new(
            3,
            CameraModel::SimpleRadial,
            600,
            400,
            vec![500.0, 310.0, 190.0, k],
        )
        .unwrap()
    }

    /// Returns whether the distorted image covers this pixel of the undistorted one.
    fn covered(source: &Camera, camera: &Camera, pixel: [f64; 2]) -> bool {
        let ray = camera.ray(&pixel.into()).unwrap();
        source
            .project(&ray.into_inner().into())
            .is_some_and(|p| source.contains(&p))
    }

    proptest! {
        #[test]
        fn without_blank_pixels_every_pixel_shows_something(k in -0.25f64..0.25) {
            let camera = undistorted(&barrel(k), &UndistortOptions::default()).unwrap();
            let (w, h) = (f64::from(camera.width), f64::from(camera.height));
            for share in 0..=20 {
                let s = f64::from(share) / 20.0;
                for pixel in [[s * w, 1.0], [s * w, h - 1.0], [1.0, s * h], [w - 1.0, s * h]] {
                    let inside = [pixel[0].clamp(1.0, w - 1.0), pixel[1].clamp(1.0, h - 1.0)];
                    prop_assert!(covered(&barrel(k), &camera, inside), "{inside:?} of {w} x {h}");
                }
            }
        }

        #[test]
        fn with_all_blank_pixels_nothing_is_lost(k in -0.15f64..0.15) {
            let source = barrel(k);
            let camera = undistorted(&source, &UndistortOptions { blank_pixels: 1.0, ..UndistortOptions::default() }).unwrap();
            for share in 0..=20 {
                let s = f64::from(share) / 20.0;
                for pixel in [[s * 600.0, 2.0], [s * 600.0, 398.0], [2.0, s * 400.0], [598.0, s * 400.0]] {
                    let inside = [pixel[0].clamp(2.0, 598.0), pixel[1].clamp(2.0, 398.0)];
                    let seen = camera.project(&source.ray(&inside.into()).unwrap().into_inner().into()).unwrap();
                    prop_assert!(camera.contains(&seen), "{inside:?} at {seen}");
                }
            }
        }
    }

    #[test]
    fn a_pinhole_camera_stays_as_it_is() {
        let camera = Camera::new(
            7,
            CameraModel::SimplePinhole,
            600,
            400,
            vec![500.0, 310.0, 190.0],
        )
        .unwrap();
        let same = undistorted(&camera, &UndistortOptions::default()).unwrap();
        assert_eq!(same.params(), [500.0, 500.0, 310.0, 190.0]);
        assert_eq!((same.id, same.width, same.height), (7, 600, 400));
        let half = undistorted(
            &camera,
            &UndistortOptions {
                max_image_size: Some(300),
                ..UndistortOptions::default()
            },
        )
        .unwrap();
        assert_eq!(half.params(), [250.0, 250.0, 155.0, 95.0]);
        assert_eq!((half.width, half.height), (300, 200));
    }

    #[test]
    fn a_field_of_more_than_180_degrees_is_bounded() {
        let fisheye = Camera::new(
            1,
            CameraModel::Fisheye,
            600,
            600,
            vec![150.0, 150.0, 300.0, 300.0],
        )
        .unwrap();
        for blank_pixels in [0.0, 1.0] {
            let camera = undistorted(
                &fisheye,
                &UndistortOptions {
                    blank_pixels,
                    ..UndistortOptions::default()
                },
            )
            .unwrap();
            assert!(camera.width <= 1200 && camera.height <= 1200);
        }
    }
}
