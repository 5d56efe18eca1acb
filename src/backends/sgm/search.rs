//! What `integrations/sgm` searches of a pair: its rule (`rectify.py`), computed from the same sparse points.
//!
//! It brings a pair onto a canvas on which the dominant plane of the shared points does not move, and searches the disparities that the points around
//! have there. Where they need more than it can search, it takes the window with most of them; what lies in front of or behind that stays unmatched,
//! such as the hall around a statue. A pair whose window would have too few is refused.

use std::{cmp::Reverse, ops::Range};

use nalgebra::{Matrix3, Point3, Vector2, Vector3};

use crate::{
    method::partners::PairGeometry,
    model::{
        cluster::Reach,
        scene::{PointIndex, Scene, ViewIndex, ViewPoints},
    },
};

/// Sparse points without which neither the plane nor the search range is known.
const MIN_SHARED: usize = 8;
/// Searched disparities, as a share of the image's longer side.
const MAX_DISPARITIES: f64 = 0.4;
/// Share of the sparse points that the searched disparities must hold.
const MIN_HELD: f64 = 0.7;
/// Added to both ends of the search range: share of it, and pixels.
const RANGE_MARGIN: f64 = 0.1;
const RANGE_PIXELS: f64 = 5.0;
/// Share of the key view that the partner must show.
const MIN_OVERLAP: f64 = 0.03;
/// Places of the longer side, and disparities of the search range, at which the matcher looks for what both show.
const OVERLAP_GRID: (f64, u32) = (64.0, 5);
/// An epipole farther away than this times its height is put there.
const FAR: f64 = 1e6;
/// Disparities are searched in groups.
const GROUP: f64 = 16.0;

/// Returns the points of the scene whose disparity is searched; nothing where these are too few of the pair's points, or the pictures hardly overlap.
pub fn reach(pair: &PairGeometry, points: &ViewPoints, image_scale: f64) -> Reach {
    let [key, partner] = [pair.key, pair.partner].map(|view| Reduced::new(pair.scene, view, image_scale));
    let position = |point: &PointIndex| pair.scene.points[point.index()];
    let shared: Vec<Point3<f64>> = pair.shared.iter().map(position).collect();
    let Some(parallax) = Parallax::new(&key, &partner, &shared) else { return Reach::Nothing };
    let (of_key, of_partner) = (points.observed_by(pair.key), points.observed_by(pair.partner));
    let others = of_partner.iter().filter(|point| of_key.binary_search(point).is_err());
    let around = of_key.iter().chain(others).map(position);
    let searched =
        parallax.searched(&key, &partner, around).filter(|searched| parallax.overlap(&key, &partner, searched));
    let Some(Range { start, end }) = searched else { return Reach::Nothing };
    let searched = start..start + GROUP * ((end - start) / GROUP).ceil();
    Reach::Part(Box::new(move |point| {
        let (pixel, depth) = key.project(point);
        depth > 0.0 && searched.contains(&parallax.disparity(pixel, 1.0 / depth))
    }))
}

/// A view as it is matched: reduced, the centre of the first pixel at (0, 0).
struct Reduced {
    size: Vector2<f64>,
    intrinsics: Matrix3<f64>,
    rotation: Matrix3<f64>,
    translation: Vector3<f64>,
}

impl Reduced {
    fn new(scene: &Scene, view: ViewIndex, image_scale: f64) -> Self {
        let (camera, pose) = (scene.camera_of(view), &scene.view(view).cam_from_world);
        let full = Vector2::new(f64::from(camera.width), f64::from(camera.height));
        let size = full.map(|side| (side * image_scale).round_ties_even().max(1.0));
        let (focal, centre) = camera.pinhole_part();
        let reduced = size.component_div(&full);
        let (focal, centre) = (focal.component_mul(&reduced), centre.coords.component_mul(&reduced));
        Self {
            size,
            intrinsics: Matrix3::new(focal.x, 0.0, centre.x - 0.5, 0.0, focal.y, centre.y - 0.5, 0.0, 0.0, 1.0),
            rotation: *pose.rotation.matrix(),
            translation: pose.translation,
        }
    }

    /// Pixel and depth.
    fn project(&self, point: &Point3<f64>) -> (Vector2<f64>, f64) {
        let there = self.intrinsics * (self.rotation * point.coords + self.translation);
        (there.xy() / there.z, there.z)
    }

    /// Pixel and depth of a point in front of the view and in its image.
    fn shows(&self, point: &Point3<f64>) -> Option<(Vector2<f64>, f64)> {
        let (pixel, depth) = self.project(point);
        (depth > 0.0 && self.holds(&pixel)).then_some((pixel, depth))
    }

    fn holds(&self, pixel: &Vector2<f64>) -> bool {
        (0..2).all(|axis| pixel[axis] > -0.5 && pixel[axis] < self.size[axis] - 0.5)
    }
}

/// Maps inverse depths of a pair to disparities.
struct Parallax {
    /// Inverse depth of the dominant plane at pixel (u, v): plane . (u, v, 1).
    plane: Vector3<f64>,
    epipole: Vector2<f64>,
    gain: f64,
    /// Pixel of the key view to pixel of the partner, through the plane.
    homography: Matrix3<f64>,
}

impl Parallax {
    fn new(key: &Reduced, partner: &Reduced, shared: &[Point3<f64>]) -> Option<Self> {
        let in_front = shared.iter().filter(|point| partner.project(point).1 > 0.0);
        let samples: Vec<(Vector2<f64>, f64)> =
            in_front.map(|point| key.project(point)).filter(|(_, z)| *z > 0.0).map(|(p, z)| (p, 1.0 / z)).collect();
        if samples.len() < MIN_SHARED {
            return None;
        }
        let rotation = partner.rotation * key.rotation.transpose();
        let translation = partner.translation - rotation * key.translation;
        let centre = -rotation.transpose() * translation;
        let level = Vector3::new(0.0, 0.0, median(samples.iter().map(|s| s.1).collect()));
        let bend = |plane: &Vector3<f64>| 1.0 - plane.dot(&(key.intrinsics * centre));
        let planes = [dominant_plane(&samples)?, level];
        let plane = planes.into_iter().find(|plane| bend(plane) > 0.1).filter(|_| centre.norm() > 0.0)?;
        let e = -key.intrinsics * centre;
        let height = e.z.abs().max(e.xy().norm() / FAR).copysign(e.z);
        let by_plane = rotation + translation * (plane.transpose() * key.intrinsics);
        let homography = partner.intrinsics * by_plane * key.intrinsics.try_inverse()?;
        Some(Self { plane, epipole: e.xy() / height, gain: height / bend(&plane), homography })
    }

    fn disparity(&self, pixel: Vector2<f64>, inverse: f64) -> f64 {
        let radius = (pixel - self.epipole).norm();
        let off = self.gain * (inverse - self.plane.dot(&pixel.push(1.0)));
        radius * off / (1.0 + off)
    }

    /// Returns the disparities that the matcher is to search, pixels: those of the points that both images show, with a margin, or the window that it
    /// can search with most of them; `None` if these are too few.
    fn searched(
        &self,
        key: &Reduced,
        partner: &Reduced,
        around: impl Iterator<Item = Point3<f64>>,
    ) -> Option<Range<f64>> {
        let in_both = around.filter(|point| partner.shows(point).is_some());
        let mut disparities: Vec<f64> =
            in_both.filter_map(|point| key.shows(&point)).map(|(pixel, z)| self.disparity(pixel, 1.0 / z)).collect();
        disparities.sort_unstable_by(f64::total_cmp);
        if disparities.len() < MIN_SHARED {
            return None;
        }
        let [low, high] = [0.5, 99.5].map(|percent| percentile(&disparities, percent));
        let margin = RANGE_MARGIN * (high - low) + RANGE_PIXELS;
        let (low, high) = ((low - margin).floor(), (high + margin).ceil());
        let room = GROUP * (MAX_DISPARITIES * key.size.max() / GROUP).round_ties_even();
        if high - low <= room {
            return Some(low..high);
        }
        let held = |(i, d): (usize, &f64)| {
            disparities.partition_point(|x| *x <= d + room - 2.0 * RANGE_PIXELS).saturating_sub(i)
        };
        // Of several windows with as many points the matcher takes the first.
        let (most, first) =
            disparities.iter().enumerate().map(|at| (held(at), at.0)).max_by_key(|&(held, i)| (held, Reverse(i)))?;
        let low = disparities[first].floor() - RANGE_PIXELS;
        (most > 0 && most as f64 >= MIN_HELD * disparities.len() as f64).then_some(low..low + room)
    }

    /// True if the partner shows enough of the key view's picture at one of the searched disparities.
    fn overlap(&self, key: &Reduced, partner: &Reduced, searched: &Range<f64>) -> bool {
        let step = key.size.max() / OVERLAP_GRID.0;
        let [columns, rows] = [key.size.x, key.size.y].map(|side| ((side + 0.5) / step).ceil() as usize);
        let enough = (MIN_OVERLAP * (columns * rows) as f64).ceil() as usize;
        let (range, parts) = (searched.end - searched.start, f64::from(OVERLAP_GRID.1 - 1));
        let shown = |place: &usize| {
            let pixel = Vector2::new((place % columns) as f64, (place / columns) as f64) * step;
            let offset = pixel.add_scalar(-0.5) - self.epipole;
            let radius = offset.norm();
            (0..OVERLAP_GRID.1).any(|part| {
                let disparity = searched.start + range * f64::from(part) / parts;
                let carried = self.epipole + offset * ((radius - disparity) / radius.max(1e-9));
                let there = self.homography * carried.push(1.0);
                radius > disparity && there.z > 0.0 && partner.holds(&(there.xy() / there.z))
            })
        };
        // Spread over the picture, so that most pairs are decided after a few places.
        let places = (0..columns).flat_map(|first| (first..columns * rows).step_by(columns));
        places.filter(shown).take(enough).count() == enough
    }
}

/// Robust fit of inverse depth = plane . (u, v, 1): least squares, reweighted (Cauchy), slightly damped towards a level plane.
fn dominant_plane(samples: &[(Vector2<f64>, f64)]) -> Option<Vector3<f64>> {
    let count = samples.len() as f64;
    let centre = samples.iter().map(|s| s.0).sum::<Vector2<f64>>() / count;
    let variance = samples.iter().map(|s| (s.0 - centre).map(|x| x * x)).sum::<Vector2<f64>>() / count;
    let spread = variance.map(|v| v.sqrt() + 1e-9);
    let rows: Vec<Vector3<f64>> = samples.iter().map(|s| (s.0 - centre).component_div(&spread).push(1.0)).collect();
    let damping = Matrix3::from_diagonal(&(Vector3::new(0.0025, 0.0025, 0.0) * count));
    let (mut weights, mut fit) = (vec![1.0; samples.len()], Vector3::zeros());
    for _ in 0..20 {
        let weighted = || rows.iter().zip(samples).zip(&weights);
        let normal = weighted().map(|((row, _), w)| row * row.transpose() * *w).sum::<Matrix3<f64>>() + damping;
        let right = weighted().map(|((row, s), w)| row * (w * s.1)).sum::<Vector3<f64>>();
        fit = normal.lu().solve(&right)?;
        let residuals: Vec<f64> = rows.iter().zip(samples).map(|(row, s)| (row.dot(&fit) - s.1).abs()).collect();
        let scale = 1.5 * median(residuals.clone()) + 1e-12;
        weights = residuals.iter().map(|r| 1.0 / (1.0 + (r / scale).powi(2))).collect();
    }
    let slopes = fit.xy().component_div(&spread);
    Some(slopes.push(fit.z - slopes.dot(&centre)))
}

/// [`percentile`] 50 without sorting.
fn median(mut values: Vec<f64>) -> f64 {
    let middle = (values.len() - 1) / 2;
    let is_between = values.len().is_multiple_of(2);
    let (_, below, above) = values.select_nth_unstable_by(middle, f64::total_cmp);
    let next = above.iter().copied().min_by(f64::total_cmp).filter(|_| is_between).unwrap_or(*below);
    *below + 0.5 * (next - *below)
}

/// Quantile of ascending values, linear between them.
fn percentile(sorted: &[f64], percent: f64) -> f64 {
    let place = percent / 100.0 * (sorted.len() - 1) as f64;
    let (below, above) = (sorted[place.floor() as usize], sorted[place.ceil() as usize]);
    below + place.fract() * (above - below)
}
