//! What `integrations/sgm` searches of a pair: its rule (`rectify.py`), computed from the same
//! sparse points.
//!
//! It brings a pair onto a canvas on which the dominant plane of the shared points does not move,
//! and searches the disparities that the points around have there. Where they need more than it can
//! search, it takes the window with most of them; what lies in front of or behind that stays
//! unmatched, such as the hall around a statue. A pair whose window would have too few is refused.

use std::{cell::OnceCell, cmp::Reverse, ops::Range};

use nalgebra::{Matrix3, Point3, Vector2, Vector3};

use crate::{
    base::vector::{Kernel, vectorised},
    method::partners::PairGeometry,
    model::{
        cluster::Reach,
        scene::{PointIndex, Scene, ViewIndex, ViewPoints},
    },
    plan::ReachOfPair,
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
/// Places of the longer side, and disparities of the search range, at which the matcher looks for
/// what both show.
const OVERLAP_GRID: (f64, u32) = (64.0, 5);
/// Size of the sample of points that decides clear cases.
const SAMPLE: usize = 96;
/// Least number of sampled points in both images for a clear case.
const MIN_SAMPLED: usize = 32;
/// An epipole farther away than this times its height is put there.
const FAR: f64 = 1e6;
/// Disparities are searched in groups.
const GROUP: f64 = 16.0;

/// Returns what is searched of the pairs of a key view: the points of the scene whose disparity is
/// searched; nothing where these are too few of the pair's points, or the pictures hardly overlap.
pub fn reach<'a>(
    scene: &'a Scene,
    points: &'a ViewPoints,
    key: ViewIndex,
    image_scale: f64,
) -> Box<dyn ReachOfPair + 'a> {
    let (view, observed) = (
        Reduced::new(scene, key, image_scale),
        points.observed_by(key),
    );
    let sample = SeenPoints::new(&view, scene, sampled(observed));
    Box::new(KeyView {
        scene,
        points,
        image_scale,
        key: view,
        observed,
        sample,
        all: OnceCell::new(),
    })
}

/// A key view with the points that it observes.
struct KeyView<'a> {
    scene: &'a Scene,
    points: &'a ViewPoints,
    image_scale: f64,
    key: Reduced,
    observed: &'a [PointIndex],
    sample: SeenPoints,
    /// Computed for the first pair that the sample does not decide.
    all: OnceCell<SeenPoints>,
}

impl ReachOfPair for KeyView<'_> {
    fn reach(&self, pair: &PairGeometry) -> Reach {
        let Some((parallax, Range { start, end })) = self.searched(pair) else {
            return Reach::Nothing;
        };
        // The matcher fills the last group up.
        let searched = start..start + GROUP * ((end - start) / GROUP).ceil();
        let key = self.key.clone();
        Reach::Part(Box::new(move |point| {
            let seen = key.project((*point).into());
            seen[2] > 0.0 && searched.contains(&parallax.disparity(seen))
        }))
    }

    fn refuses(&self, pair: &PairGeometry) -> bool {
        !self.clearly_matches(pair) && self.searched(pair).is_none()
    }
}

impl KeyView<'_> {
    /// Returns the disparities that are searched of a pair; `None` if it is refused.
    fn searched(&self, pair: &PairGeometry) -> Option<(Parallax, Range<f64>)> {
        let partner = Reduced::new(self.scene, pair.partner, self.image_scale);
        let others = without(self.points.observed_by(pair.partner), pair.shared);
        let position = |point: &PointIndex| self.scene.points[point.index()];
        let parallax = Parallax::new(&self.key, &partner, pair.shared.iter().map(position))?;
        let seen = self
            .all
            .get_or_init(|| SeenPoints::new(&self.key, self.scene, self.observed.iter()));
        let mut disparities =
            parallax.disparities(&self.key, &partner, seen, others.iter().map(position));
        let searched = searched(&mut disparities, &self.key)?;
        parallax
            .overlaps(&self.key, &partner, &searched, MIN_OVERLAP)
            .then_some((parallax, searched))
    }

    /// Returns whether a sample of the points shows that the pair is accepted with room to spare:
    /// half the search range suffices, and the images overlap by twice the minimum. If less than 70
    /// % of all points fit in the window, 32 random ones do with a probability of 0.7^32, 1 in
    /// 100,000.
    fn clearly_matches(&self, pair: &PairGeometry) -> bool {
        let partner = Reduced::new(self.scene, pair.partner, self.image_scale);
        let position = |point: &PointIndex| self.scene.points[point.index()];
        let Some(parallax) = Parallax::new(&self.key, &partner, sampled(pair.shared).map(position))
        else {
            return false;
        };
        let observed = sampled(self.points.observed_by(pair.partner));
        let others: Vec<_> = observed
            .filter(|point| pair.shared.binary_search(point).is_err())
            .map(position)
            .collect();
        let disparities =
            parallax.disparities(&self.key, &partner, &self.sample, others.into_iter());
        let (low, high) = disparities
            .iter()
            .fold((f64::MAX, f64::MIN), |(low, high), &d| {
                (low.min(d), high.max(d))
            });
        let needed = with_margin(low, high);
        disparities.len() >= MIN_SAMPLED
            && needed.end - needed.start <= 0.5 * most_disparities(&self.key)
            && parallax.overlaps(&self.key, &partner, &needed, 2.0 * MIN_OVERLAP)
    }
}

/// Returns [`SAMPLE`] points at even steps through the list, or all of a shorter list.
fn sampled(points: &[PointIndex]) -> impl Iterator<Item = &PointIndex> {
    let count = points.len().min(SAMPLE);
    (0..count).map(move |i| &points[i * points.len() / count])
}

/// Returns the points of a list that are not in a part of it; both ascend.
fn without(all: &[PointIndex], part: &[PointIndex]) -> Vec<PointIndex> {
    let (mut rest, mut kept, mut next) = (vec![PointIndex(0); all.len()], 0, 0);
    for &point in all {
        // Without a branch for each point, which would often be mispredicted.
        let is_next = part.get(next) == Some(&point);
        rest[kept] = point;
        kept += usize::from(!is_next);
        next += usize::from(is_next);
    }
    rest.truncate(kept);
    rest
}

/// A view as it is matched: reduced, the centre of the first pixel at (0, 0).
#[derive(Clone)]
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
        // Python's `round` takes a tie to the even number.
        let size = full.map(|side| (side * image_scale).round_ties_even().max(1.0));
        let (focal, centre) = camera.pinhole_part();
        let reduced = size.component_div(&full);
        let (focal, centre) = (
            focal.component_mul(&reduced),
            centre.coords.component_mul(&reduced),
        );
        Self {
            size,
            intrinsics: Matrix3::new(
                focal.x,
                0.0,
                centre.x - 0.5,
                0.0,
                focal.y,
                centre.y - 0.5,
                0.0,
                0.0,
                1.0,
            ),
            rotation: *pose.rotation.matrix(),
            translation: pose.translation,
        }
    }

    /// Homogeneous pixel: x and y times depth, and depth; spelt out, as all below that is called in
    /// loops, for vector instructions.
    #[inline(always)]
    fn homogeneous(&self, [x, y, z]: [f64; 3]) -> [f64; 3] {
        let (r, t, k) = (&self.rotation, &self.translation, &self.intrinsics);
        let [a, b, depth] = [0, 1, 2].map(|i| r[(i, 0)] * x + r[(i, 1)] * y + r[(i, 2)] * z + t[i]);
        [
            k[(0, 0)] * a + k[(0, 2)] * depth,
            k[(1, 1)] * b + k[(1, 2)] * depth,
            depth,
        ]
    }

    /// Pixel x, pixel y and inverse depth.
    #[inline(always)]
    fn project(&self, place: [f64; 3]) -> [f64; 3] {
        let [u, v, depth] = self.homogeneous(place);
        let inverse = 1.0 / depth;
        [u * inverse, v * inverse, inverse]
    }

    /// Returns whether a homogeneous pixel is in front of the view and in its image.
    #[inline(always)]
    fn shows(&self, [u, v, depth]: [f64; 3]) -> bool {
        let inside = |at: f64, size: f64| (at > -0.5 * depth) & (at < (size - 0.5) * depth);
        // `&` and not `&&`: branches would keep the loops from becoming vector instructions.
        (depth > 0.0) & inside(u, self.size.x) & inside(v, self.size.y)
    }
}

/// Points in the image of a key view: their positions, and pixel x, pixel y and inverse depth.
#[derive(Default)]
struct SeenPoints {
    places: [Vec<f64>; 3],
    seen: [Vec<f64>; 3],
}

impl SeenPoints {
    fn new<'p>(key: &Reduced, scene: &Scene, points: impl Iterator<Item = &'p PointIndex>) -> Self {
        let mut all = Self::default();
        let places = points.map(|point| <[f64; 3]>::from(scene.points[point.index()]));
        for place in places.filter(|&place| key.shows(key.homogeneous(place))) {
            let seen = key.project(place);
            (0..3).for_each(|axis| {
                all.places[axis].push(place[axis]);
                all.seen[axis].push(seen[axis]);
            });
        }
        all
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
    fn new(
        key: &Reduced,
        partner: &Reduced,
        shared: impl Iterator<Item = Point3<f64>>,
    ) -> Option<Self> {
        let is_in_front = |&point: &[f64; 3]| {
            [key, partner]
                .iter()
                .all(|view| view.homogeneous(point)[2] > 0.0)
        };
        let seen = shared
            .map(<[f64; 3]>::from)
            .filter(is_in_front)
            .map(|point| key.project(point));
        let samples: Vec<(Vector2<f64>, f64)> = seen
            .map(|[u, v, inverse]| (Vector2::new(u, v), inverse))
            .collect();
        // Fewer points are in front of both views than the matcher needs.
        if samples.len() < MIN_SHARED {
            return None;
        }
        let rotation = partner.rotation * key.rotation.transpose();
        let translation = partner.translation - rotation * key.translation;
        let centre = -rotation.transpose() * translation;
        let level = Vector3::new(
            0.0,
            0.0,
            quantile(&mut samples.iter().map(|s| s.1).collect::<Vec<_>>(), 50.0),
        );
        let bend = |plane: &Vector3<f64>| 1.0 - plane.dot(&(key.intrinsics * centre));
        let planes = [dominant_plane(&samples)?, level];
        let plane = planes
            .into_iter()
            // The partner must be well in front of the plane, or the homography degenerates.
            .find(|plane| bend(plane) > 0.1)
            .filter(|_| centre.norm() > 0.0)?;
        let e = -key.intrinsics * centre;
        // A motion across the line of sight would put the epipole at infinity. As far away as this
        // the error is below 0.001 px per pixel of disparity.
        let height = e.z.abs().max(e.xy().norm() / FAR).copysign(e.z);
        // A plus, not Hartley and Zisserman's minus: on this plane n . X = 1, so R X + t is (R + t
        // nᵀ) X.
        let by_plane = rotation + translation * (plane.transpose() * key.intrinsics);
        let homography = partner.intrinsics * by_plane * key.intrinsics.try_inverse()?;
        Some(Self {
            plane,
            epipole: e.xy() / height,
            gain: height / bend(&plane),
            homography,
        })
    }

    /// Returns the disparity at pixel x, pixel y and inverse depth of the key view.
    #[inline(always)]
    fn disparity(&self, [u, v, inverse]: [f64; 3]) -> f64 {
        let (x, y) = (u - self.epipole.x, v - self.epipole.y);
        let radius = (x * x + y * y).sqrt();
        let off = self.gain * (inverse - (self.plane.x * u + self.plane.y * v + self.plane.z));
        // By |p - E| = (1 + off) |q - E| of rectify.py, for the distances from the epipole.
        radius * off / (1.0 + off)
    }

    /// Returns the disparities of the points that both images show, pixels. `seen`, `others`:
    /// points that the key view observes, and that only the partner does.
    fn disparities(
        &self,
        key: &Reduced,
        partner: &Reduced,
        seen: &SeenPoints,
        others: impl ExactSizeIterator<Item = Point3<f64>>,
    ) -> Vec<f64> {
        vectorised(Disparities {
            parallax: self,
            key,
            partner,
            seen,
            others,
        })
    }

    /// Returns whether the partner shows at least this share of the key view's picture at one of
    /// the searched disparities.
    fn overlaps(
        &self,
        key: &Reduced,
        partner: &Reduced,
        searched: &Range<f64>,
        share: f64,
    ) -> bool {
        let step = key.size.max() / OVERLAP_GRID.0;
        let [columns, rows] =
            // As many as `np.arange(-0.5, side, step)` has.
            [key.size.x, key.size.y].map(|side| ((side + 0.5) / step).ceil() as usize);
        let enough = (share * (columns * rows) as f64).ceil() as usize;
        let (range, parts) = (searched.end - searched.start, f64::from(OVERLAP_GRID.1 - 1));
        let shown = |place: &usize| {
            let pixel = Vector2::new((place % columns) as f64, (place / columns) as f64) * step;
            let offset = pixel.add_scalar(-0.5) - self.epipole;
            let radius = offset.norm();
            (0..OVERLAP_GRID.1).any(|part| {
                let disparity = searched.start + range * f64::from(part) / parts;
                // A place of the grid may be the epipole itself.
                let carried = self.epipole + offset * ((radius - disparity) / radius.max(1e-9));
                let there = self.homography * carried.push(1.0);
                radius > disparity && partner.shows(there.into())
            })
        };
        (0..columns * rows).filter(shown).take(enough).count() == enough
    }
}

/// Returns a range of disparities with the margin that the matcher adds.
fn with_margin(low: f64, high: f64) -> Range<f64> {
    let margin = RANGE_MARGIN * (high - low) + RANGE_PIXELS;
    (low - margin).floor()..(high + margin).ceil()
}

/// Returns the number of disparities that the matcher can search.
fn most_disparities(key: &Reduced) -> f64 {
    GROUP * (MAX_DISPARITIES * key.size.max() / GROUP).round_ties_even()
}

/// Returns the disparities that the matcher is to search: those of the points, with a margin, or
/// the window that it can search with most of them; `None` if these are too few. The disparities
/// change places.
fn searched(disparities: &mut [f64], key: &Reduced) -> Option<Range<f64>> {
    if disparities.len() < MIN_SHARED {
        return None;
    }
    let [low, high] = [0.5, 99.5].map(|percent| quantile(disparities, percent));
    let (needed, room) = (with_margin(low, high), most_disparities(key));
    if needed.end - needed.start <= room {
        return Some(needed);
    }
    disparities.sort_unstable_by(f64::total_cmp);
    let held = |(i, d): (usize, &f64)| {
        disparities
            .partition_point(|x| *x <= d + room - 2.0 * RANGE_PIXELS)
            // In an image of a few pixels, the margins alone are wider than the room.
            .saturating_sub(i)
    };
    // Of several windows with as many points the matcher takes the first.
    let (most, first) = disparities
        .iter()
        .enumerate()
        .map(|at| (held(at), at.0))
        .max_by_key(|&(held, i)| (held, Reverse(i)))?;
    let low = disparities[first].floor() - RANGE_PIXELS;
    (most > 0 && most as f64 >= MIN_HELD * disparities.len() as f64).then_some(low..low + room)
}

/// Computes the disparities of the points that both images show.
struct Disparities<'a, I> {
    parallax: &'a Parallax,
    key: &'a Reduced,
    partner: &'a Reduced,
    seen: &'a SeenPoints,
    others: I,
}

/// Points that are projected at once.
const LANES: usize = 64;

impl<I: ExactSizeIterator<Item = Point3<f64>>> Kernel for Disparities<'_, I> {
    type Output = Vec<f64>;

    #[inline(always)]
    fn run(mut self) -> Vec<f64> {
        let [x, y, z] = &self.seen.places;
        let [u, v, inverse] = &self.seen.seen;
        let mut all = Vec::with_capacity(x.len() + self.others.len());
        let (mut disparities, mut shown) = ([0.0; LANES], [false; LANES]);
        for start in (0..x.len()).step_by(LANES) {
            let count = LANES.min(x.len() - start);
            let [x, y, z, u, v, inverse] =
                [x, y, z, u, v, inverse].map(|list| &list[start..start + count]);
            for lane in 0..count {
                shown[lane] = self
                    .partner
                    .shows(self.partner.homogeneous([x[lane], y[lane], z[lane]]));
                disparities[lane] = self.parallax.disparity([u[lane], v[lane], inverse[lane]]);
            }
            let both = disparities[..count].iter().zip(&shown);
            all.extend(both.filter_map(|(disparity, shown)| shown.then_some(*disparity)));
        }
        let mut places = [[0.0; LANES]; 3];
        while self.others.len() > 0 {
            let count = LANES.min(self.others.len());
            for (lane, point) in self.others.by_ref().take(LANES).enumerate() {
                (0..3).for_each(|axis| places[axis][lane] = point[axis]);
            }
            // All lanes, also those left over from the last round: loops of a fixed length
            // vectorise.
            for lane in 0..LANES {
                let place = [places[0][lane], places[1][lane], places[2][lane]];
                shown[lane] = self.key.shows(self.key.homogeneous(place))
                    & self.partner.shows(self.partner.homogeneous(place));
                disparities[lane] = self.parallax.disparity(self.key.project(place));
            }
            let both = disparities[..count].iter().zip(&shown);
            all.extend(both.filter_map(|(disparity, shown)| shown.then_some(*disparity)));
        }
        all
    }
}

/// Robust fit of inverse depth = plane . (u, v, 1): least squares, reweighted (Cauchy), slightly
/// damped towards a level plane.
fn dominant_plane(samples: &[(Vector2<f64>, f64)]) -> Option<Vector3<f64>> {
    let count = samples.len() as f64;
    let centre = samples.iter().map(|s| s.0).sum::<Vector2<f64>>() / count;
    let variance = samples
        .iter()
        .map(|s| (s.0 - centre).map(|x| x * x))
        .sum::<Vector2<f64>>()
        / count;
    // Points in one column or row have no spread.
    let spread = variance.map(|v| v.sqrt() + 1e-9);
    let rows = Rows {
        x: samples
            .iter()
            .map(|s| (s.0.x - centre.x) / spread.x)
            .collect(),
        y: samples
            .iter()
            .map(|s| (s.0.y - centre.y) / spread.y)
            .collect(),
        z: samples.iter().map(|s| s.1).collect(),
    };
    let damping = Matrix3::from_diagonal(&(Vector3::new(0.0025, 0.0025, 0.0) * count));
    let (mut weights, mut fit) = (vec![1.0; samples.len()], Vector3::zeros());
    // As many rounds as the matcher takes: another plane would refuse other pairs.
    for _ in 0..20 {
        let (normal, right) = rows.normal_equations(&weights);
        fit = (normal + damping).lu().solve(&right)?;
        vectorised(Residuals {
            rows: &rows,
            fit: fit.into(),
            residuals: &mut weights,
        });
        // A copy, since the quantile moves the values and each belongs to its row. The small number
        // is for points that are all in one plane.
        let scale = 1.5 * quantile(&mut weights.clone(), 50.0) + 1e-12;
        vectorised(Weights {
            residuals: &mut weights,
            scale,
        });
    }
    let slopes = fit.xy().component_div(&spread);
    Some(slopes.push(fit.z - slopes.dot(&centre)))
}

/// Rows (x, y, 1) of a linear fit, and their right sides z.
struct Rows {
    x: Vec<f64>,
    y: Vec<f64>,
    z: Vec<f64>,
}

impl Rows {
    /// Returns the sums of row . rowᵀ w and of row w z.
    fn normal_equations(&self, weights: &[f64]) -> (Matrix3<f64>, Vector3<f64>) {
        let [
            mut xx,
            mut xy,
            mut yy,
            mut x1,
            mut y1,
            mut one,
            mut xz,
            mut yz,
            mut z1,
        ] = [0.0; 9];
        for (((x, y), z), w) in self.x.iter().zip(&self.y).zip(&self.z).zip(weights) {
            let wz = w * z;
            xx += x * x * w;
            xy += x * y * w;
            yy += y * y * w;
            x1 += x * w;
            y1 += y * w;
            one += w;
            xz += x * wz;
            yz += y * wz;
            z1 += wz;
        }
        (
            Matrix3::new(xx, xy, x1, xy, yy, y1, x1, y1, one),
            Vector3::new(xz, yz, z1),
        )
    }
}

/// Computes the absolute residuals of a fit.
struct Residuals<'a> {
    rows: &'a Rows,
    fit: [f64; 3],
    residuals: &'a mut [f64],
}

impl Kernel for Residuals<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let (Rows { x, y, z }, [a, b, c]) = (self.rows, self.fit);
        for (((residual, x), y), z) in self.residuals.iter_mut().zip(x).zip(y).zip(z) {
            *residual = (x * a + y * b + c - z).abs();
        }
    }
}

/// Turns residuals into weights.
struct Weights<'a> {
    residuals: &'a mut [f64],
    scale: f64,
}

impl Kernel for Weights<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        for residual in self.residuals {
            let off = *residual / self.scale;
            *residual = 1.0 / (1.0 + off * off);
        }
    }
}

/// Quantile, linear between two values; the values change places.
fn quantile(values: &mut [f64], percent: f64) -> f64 {
    // As numpy's `percentile`, which the matcher calls.
    let place = percent / 100.0 * (values.len() - 1) as f64;
    let (_, &mut below, rest) =
        values.select_nth_unstable_by(place.floor() as usize, f64::total_cmp);
    let above = rest
        .iter()
        .copied()
        .min_by(f64::total_cmp)
        .filter(|_| place.fract() > 0.0)
        .unwrap_or(below);
    below + place.fract() * (above - below)
}

#[cfg(test)]
mod tests {
    use rand_core::{Rng, SeedableRng};
    use rand_pcg::Pcg64;

    use super::*;
    use crate::{
        method::{partners::neighbours, synthetic::Town},
        model::camera::{Camera, CameraModel},
    };

    /// A town; each point on the line to the mean camera, at 1 / (1 + nearness) of its distance,
    /// observed by all views whose images it is in.
    fn moved(town: &Town, mut nearness: impl FnMut() -> f64) -> Scene {
        let mut scene = town.scene();
        let centres = scene
            .views
            .iter()
            .map(|view| view.cam_from_world.centre().coords);
        let middle = Point3::from(centres.sum::<Vector3<f64>>() / scene.views.len() as f64);
        (scene.track_offsets, scene.track_views) = (vec![0], Vec::new());
        for i in 0..scene.points.len() {
            scene.points[i] = middle + (scene.points[i] - middle) / (1.0 + nearness());
            let observes = |&view: &ViewIndex| {
                let (pose, camera) = (&scene.view(view).cam_from_world, scene.camera_of(view));
                let seen = camera.project(&pose.camera_from_world(&scene.points[i]));
                seen.is_some_and(|pixel| camera.contains(&pixel))
            };
            let observers: Vec<ViewIndex> = scene.view_indices().filter(observes).collect();
            scene.track_views.extend(observers);
            scene.track_offsets.push(scene.track_views.len());
        }
        scene.track_pixels = vec![[0.0; 2]; scene.track_views.len()];
        scene
    }

    /// Returns the numbers of pairs that are matched and refused; each has to be refused exactly
    /// where nothing of it is reached.
    fn matched_and_refused(scene: &Scene) -> [usize; 2] {
        let points = scene.view_points();
        let mut found = [0, 0];
        for key in scene.view_indices() {
            let rule = reach(scene, &points, key, 1.0);
            for (partner, shared) in neighbours(scene, &points, key) {
                let pair = PairGeometry::new(scene, key, partner, &shared);
                let refused = rule.refuses(&pair);
                assert_eq!(
                    refused,
                    rule.reach(&pair).is_nothing(),
                    "{key:?} with {partner:?}"
                );
                found[usize::from(refused)] += 1;
            }
        }
        found
    }

    #[test]
    fn pairs_are_refused_where_nothing_of_them_is_reached() {
        let mut random = Pcg64::seed_from_u64(1);
        let mut number = move || random.next_u64() as f64 / u64::MAX as f64;
        let many = |[matched, refused]: [usize; 2]| [matched > 100, refused > 100];
        assert_eq!(
            many(matched_and_refused(&Town::default().scene())),
            [true, false],
            "flat"
        );
        let scattered = moved(&Town::default(), || 3.0 * number());
        assert_eq!(
            many(matched_and_refused(&scattered)),
            [true, true],
            "at all depths"
        );
    }

    /// From 60 to 78 % of the points far away, the others near: around the 70 % that one window has
    /// to hold.
    #[test]
    fn pairs_at_two_depths_are_refused_where_neither_holds_enough() {
        let mut random = Pcg64::seed_from_u64(2);
        let mut number = move || random.next_u64() as f64 / u64::MAX as f64;
        let mut found = [0, 0];
        for far in [0.6, 0.66, 0.72, 0.78] {
            let scene = moved(&Town::default(), || if number() < far { 0.0 } else { 3.0 });
            let [matched, refused] = matched_and_refused(&scene);
            found = [found[0] + matched, found[1] + refused];
        }
        assert!(
            found.iter().all(|&pairs| pairs > 100),
            "matched and refused: {found:?}"
        );
    }

    #[test]
    fn few_points_and_small_images_are_refused_by_the_whole_rule() {
        let small = |side: u32| {
            let (width, height) = (f64::from(side), 0.75 * f64::from(side));
            let parameters = vec![0.85 * width, 0.85 * width, 0.5 * width, 0.5 * height];
            Town::new(
                Camera::new(
                    1,
                    CameraModel::Pinhole,
                    side.into(),
                    height as u64,
                    parameters,
                )
                .unwrap(),
            )
        };
        let [matched, refused] = matched_and_refused(
            &Town {
                points: 60,
                ..Town::default()
            }
            .scene(),
        );
        assert!(
            matched > 20 && refused > 20,
            "few points: {matched} and {refused}"
        );
        for side in [12, 40, 80] {
            let [matched, refused] = matched_and_refused(&small(side).scene());
            assert!(
                matched + refused > 100,
                "{side} pixels: {matched} and {refused}"
            );
        }
    }
}
