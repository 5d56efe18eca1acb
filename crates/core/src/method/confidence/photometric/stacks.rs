//! Normalised samples of triangles in a picture: the dot product of two views' samples is their
//! correlation.

use std::sync::atomic::{AtomicI64, AtomicU32, Ordering};

use nalgebra::{Point2, Point3, Vector2, Vector3};

use super::{super::mask::Mask, grey::Grey};
use crate::{
    base::column,
    method::{geometry::Geometry, visibility::gsd_at},
    model::{camera::Camera, scene::ViewIndex},
};

/// Samples along a side of a patch.
const SIDE: usize = 7;
const PATCH: usize = SIDE * SIDE;
/// Barycentric coordinates of the centres of a triangle's patches. One patch of 11 x 11 samples
/// predicts worse, sixteen of 7 x 7 hardly better.
const CENTRES: [[f64; 3]; 4] = [
    [1.0 / 3.0, 1.0 / 3.0, 1.0 / 3.0],
    [2.0 / 3.0, 1.0 / 6.0, 1.0 / 6.0],
    [1.0 / 6.0, 2.0 / 3.0, 1.0 / 6.0],
    [1.0 / 6.0, 1.0 / 6.0, 2.0 / 3.0],
];
/// Number of samples of a triangle in a view.
pub const STACK: usize = CENTRES.len() * PATCH;
/// Value of all samples of a patch that the picture does not show.
pub const NOT_SEEN: i8 = i8::MIN;
/// Fixed-point value of 1.
const ONE: f32 = 127.0;
/// Distance between samples, wanted pixels: predicts as well as 1, from a picture of half the side.
pub const SPACING: f64 = 2.0;
/// Standard deviation of image noise, grey levels: patches with less contrast have little
/// correlation.
const NOISE: f32 = 2.0;

/// Distance between samples on each triangle, scene units: [`SPACING`] pixels of the matched images
/// in the (geometric) mean of the views that see it.
pub(super) struct Spacing(Vec<f32>);

impl Spacing {
    pub(super) fn new(geometry: &Geometry) -> Self {
        let Geometry {
            scene,
            surface,
            visibility,
            image_scale,
            ..
        } = *geometry;
        let means: Vec<MeanGsd> = surface
            .triangles
            .iter()
            .map(|_| MeanGsd::default())
            .collect();
        let add = |&view: &ViewIndex| {
            for &t in visibility.triangles_seen_by(view) {
                means[t as usize].add(gsd_at(scene, surface, view, t));
            }
        };
        column::read_by_parts(&visibility.views(), add, || visibility.triangles.release());
        let spacing = |mean: MeanGsd| (SPACING * mean.value() / image_scale) as f32;
        Self(means.into_iter().map(spacing).collect())
    }
}

/// Geometric mean of the GSDs of several views, which threads add.
#[derive(Default)]
struct MeanGsd {
    /// Sum of the fixed-point logarithms: it does not depend on the order in which threads add
    /// them.
    sum: AtomicI64,
    views: AtomicU32,
}

impl MeanGsd {
    const PARTS: f64 = (1u64 << 32) as f64;

    fn add(&self, gsd: f64) {
        let octaves = gsd.max(f64::MIN_POSITIVE).log2();
        self.sum
            .fetch_add((octaves * Self::PARTS) as i64, Ordering::Relaxed);
        self.views.fetch_add(1, Ordering::Relaxed);
    }

    fn value(self) -> f64 {
        let views = f64::from(self.views.into_inner().max(1));
        (self.sum.into_inner() as f64 / Self::PARTS / views).exp2()
    }
}

/// Returns [`STACK`] samples for each triangle that the view sees, in the order of its rows.
pub(super) fn stacks(
    geometry: &Geometry,
    spacing: &Spacing,
    view: ViewIndex,
    grey: &Grey,
    mask: Option<&Mask>,
) -> Vec<i8> {
    let seen = geometry.visibility.triangles_seen_by(view);
    let mut stacks = vec![NOT_SEEN; seen.len() * STACK];
    let sampler = Sampler::new(geometry, view, grey, mask);
    for (&t, stack) in seen.iter().zip(stacks.chunks_exact_mut(STACK)) {
        sampler.sample(t, f64::from(spacing.0[t as usize]), stack);
    }
    stacks
}

struct Sampler<'a> {
    geometry: &'a Geometry<'a>,
    view: ViewIndex,
    grey: &'a Grey,
    mask: Option<&'a Mask>,
    /// Pixels of the picture per pixel of the model's image, along each side.
    reduced: [f64; 2],
}

impl<'a> Sampler<'a> {
    fn new(
        geometry: &'a Geometry<'a>,
        view: ViewIndex,
        grey: &'a Grey,
        mask: Option<&'a Mask>,
    ) -> Self {
        let (camera, [width, height]) = (geometry.scene.camera_of(view), grey.size());
        let reduced = [
            width as f64 / f64::from(camera.width),
            height as f64 / f64::from(camera.height),
        ];
        Self {
            geometry,
            view,
            grey,
            mask,
            reduced,
        }
    }

    fn sample(&self, triangle: u32, spacing: f64, stack: &mut [i8]) {
        let surface = self.geometry.surface;
        let corners = surface.corners(triangle);
        // Axes of the triangle, not of a view, so that the samples of all views are of the same
        // places.
        let edge = (corners[1] - corners[0]).normalize();
        let across = surface.area_normal(triangle).normalize().cross(&edge);
        for (shares, patch) in CENTRES.iter().zip(stack.chunks_exact_mut(PATCH)) {
            let centre = corners
                .iter()
                .zip(shares)
                .map(|(corner, share)| corner.coords * *share)
                .sum::<Vector3<f64>>();
            let samples = self.patch(&centre.into(), edge * spacing, across * spacing);
            if let Some(samples) = samples {
                normalise(&samples, patch);
            }
        }
    }

    /// Samples a patch with these steps. The projection is linearised at the centre, which is
    /// accurate over a dozen pixels.
    fn patch(
        &self,
        centre: &Point3<f64>,
        right: Vector3<f64>,
        down: Vector3<f64>,
    ) -> Option<[[f32; SIDE]; SIDE]> {
        let scene = self.geometry.scene;
        let camera = scene.camera_of(self.view);
        let pose = &scene.view(self.view).cam_from_world;
        let there = pose.camera_from_world(centre);
        let (pixel, jacobian) = camera.project_with_jacobian(&there)?;
        if self.is_masked(camera, &pixel) {
            return None;
        }
        let step = |v: Vector3<f64>| self.in_picture(jacobian * (pose.rotation.matrix() * v));
        // Distance between samples at perpendicular incidence, pixels of the picture; a finer
        // picture is reduced first.
        let apart =
            right.norm() * camera.mean_focal_length() * self.reduced[0] / camera.depth(&there);
        let level = (apart.log2().round().max(0.0) as usize).min(self.grey.levels() - 1);
        let centre = self.in_picture(pixel.coords);
        self.grey.sample(level, centre, step(right), step(down))
    }

    fn is_masked(&self, camera: &Camera, pixel: &Point2<f64>) -> bool {
        let (width, height) = (f64::from(camera.width), f64::from(camera.height));
        self.mask
            .is_some_and(|mask| !mask.allows(pixel.x / width, pixel.y / height))
    }

    /// Converts pixels of the model's image.
    fn in_picture(&self, pixels: Vector2<f64>) -> [f32; 2] {
        [pixels.x * self.reduced[0], pixels.y * self.reduced[1]].map(|x| x as f32)
    }
}

/// Subtracts the mean and divides by the norm, noise included.
fn normalise(samples: &[[f32; SIDE]; SIDE], patch: &mut [i8]) {
    let samples = samples.as_flattened();
    let mean = samples.iter().sum::<f32>() / PATCH as f32;
    let norm =
        samples.iter().map(|s| (s - mean).powi(2)).sum::<f32>() + NOISE * NOISE * PATCH as f32;
    let factor = ONE / norm.sqrt();
    for (sample, number) in samples.iter().zip(patch) {
        *number = ((sample - mean) * factor).round() as i8;
    }
}

/// Returns the mean correlation of the patches that both pictures show, -1 to 1; `None` without
/// such a patch.
pub(super) fn correlation(a: &[i8], b: &[i8]) -> Option<f32> {
    let (mut sum, mut patches) = (0i32, 0);
    for (a, b) in a.chunks_exact(PATCH).zip(b.chunks_exact(PATCH)) {
        // Normalised samples are at least -127.
        if a[0] != NOT_SEEN && b[0] != NOT_SEEN {
            sum += a
                .iter()
                .zip(b)
                .map(|(&a, &b)| i32::from(i16::from(a) * i16::from(b)))
                .sum::<i32>();
            patches += 1;
        }
    }
    (patches > 0).then(|| sum as f32 / (ONE * ONE * patches as f32))
}

#[cfg(test)]
mod tests {
    use super::{super::tests::town, *};

    /// Smaller images have larger pixels.
    #[test]
    fn samples_are_as_far_apart_as_the_pixels_of_the_matched_image() {
        let town = town();
        let [full, half] = [1.0, 0.5].map(|scale| Spacing::new(&town.geometry(scale)).0);
        let triangle = town.visibility.triangles_seen_by(ViewIndex(12))[0];
        // Forty metres up, 850 px of focal length.
        let expected = SPACING * 40.0 / 850.0;
        let found = f64::from(full[triangle as usize]);
        assert!(
            (0.7..1.5).contains(&(found / expected)),
            "{found} {expected}"
        );
        assert!(
            full.iter()
                .zip(&half)
                .all(|(full, half)| (half / full - 2.0).abs() < 1e-6)
        );
    }

    /// A chessboard of single pixels is grey where samples are several pixels apart.
    #[test]
    fn a_picture_that_is_finer_than_the_samples_is_reduced_first() {
        let town = town();
        let geometry = town.geometry(1.0);
        let board = (0..750)
            .flat_map(|y| (0..1000).map(move |x| if (x + y) % 2 == 0 { 0 } else { 255 }))
            .collect();
        let (grey, view) = (Grey::new(1000, 750, board), ViewIndex(12));
        let contrast = |pixels: f32| {
            let spacing = Spacing(vec![pixels * 40.0 / 850.0; town.surface.triangles.len()]);
            let stacks = stacks(&geometry, &spacing, view, &grey, None);
            let shown = stacks.iter().filter(|&&sample| sample != NOT_SEEN);
            f64::from(
                shown
                    .clone()
                    .map(|sample| sample.unsigned_abs())
                    .map(u32::from)
                    .sum::<u32>(),
            ) / shown.count() as f64
        };
        let [fine, coarse] = [1.0, 4.0].map(contrast);
        assert!(fine > 10.0 && coarse < 1.0, "{fine} {coarse}");
    }

    fn stack(grey: impl Fn(usize, usize) -> f32) -> Vec<i8> {
        let samples = std::array::from_fn(|i| std::array::from_fn(|j| grey(i, j)));
        let mut patch = vec![0; PATCH];
        normalise(&samples, &mut patch);
        patch
    }

    fn texture(i: usize, j: usize) -> f32 {
        100.0 + 60.0 * ((i * 37 + j * 101 + i * j * 17) % 23) as f32 / 23.0
    }

    #[test]
    fn exposure_changes_no_correlation() {
        let (a, b) = (stack(texture), stack(|i, j| 20.0 + 0.5 * texture(i, j)));
        assert!(correlation(&a, &a).unwrap() > 0.97);
        assert!(correlation(&a, &b).unwrap() > 0.95);
        assert!(correlation(&a, &stack(|i, j| 255.0 - texture(i, j))).unwrap() < -0.95);
    }

    #[test]
    fn a_patch_without_contrast_correlates_with_nothing() {
        let faint = stack(|i, j| 128.0 + 0.005 * texture(i, j));
        assert!(correlation(&faint, &stack(texture)).unwrap().abs() < 0.1);
    }

    #[test]
    fn patches_that_one_picture_does_not_show_are_left_out() {
        let (seen, hidden) = (stack(texture), vec![NOT_SEEN; PATCH]);
        assert_eq!(correlation(&seen, &hidden), None);
        let (both, one) = (
            [seen.clone(), seen.clone()].concat(),
            [seen.clone(), hidden].concat(),
        );
        assert_eq!(correlation(&both, &one), correlation(&seen, &seen));
        assert_eq!(correlation(&one, &both), correlation(&seen, &seen));
        assert_eq!(
            correlation(&both, &both),
            correlation(&seen, &seen),
            "the mean of the patches"
        );
    }
}
