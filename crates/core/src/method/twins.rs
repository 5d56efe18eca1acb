//! Twins ([method 4]): views that show the same from nearly one place, as photographs taken twice,
//! bursts and brackets do.
//!
//! Two maps of one place are wrong together, and no depth follows from comparing their pictures. So
//! the sharpest of such views takes part for all of them, and the others are set aside: neither key
//! views nor partners.
//!
//! ```text
//! distance ≤ 0.01 · depth     each shows ≥ 90 % of the other's points     ratio of GSDs ≤ √2
//! ```
//!
//! Distance and depth are in scene units; the depth is the smaller of the two views', each the
//! lower quartile of the depths of its sparse points.
//!
//! ```
//! use viewrank_core::base::progress::NoWatcher;
//! use viewrank_core::method::confidence::NoPictures;
//! use viewrank_core::method::twins::{self, Excluded, Twin};
//! use viewrank_core::model::arrays::{Intrinsics, SceneArrays};
//! use viewrank_core::model::scene::{Scene, ViewIndex};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! // Three views of a wall at a depth of 10, from x = 0, 0.02 and 1.
//! let params = vec![100.0, 100.0, 80.0, 60.0];
//! let pose = |x: f64| [1., 0., 0., -x, 0., 1., 0., 0., 0., 0., 1., 0.];
//! let scene = Scene::from_arrays(&SceneArrays {
//!     cameras: vec![Intrinsics { model: "PINHOLE".into(), width: 160, height: 120, params }],
//!     names: ["a", "b", "c"].map(String::from).to_vec(),
//!     camera: vec![0; 3],
//!     cam_from_world: [0.0, 0.02, 1.0].map(pose).to_vec(),
//!     points: (0..35).map(|i| [f64::from(i % 7 - 3), f64::from(i / 7 - 2), 10.0]).collect(),
//!     // The first observes every second point, the others observe all.
//!     observations: (0..105).map(|i| [i / 3, i % 3]).filter(|o| o[1] > 0 || o[0] % 2 == 0).collect(),
//!     pixels: Vec::new(),
//! })?;
//! let (points, none) = (scene.view_points(), Excluded::default());
//! let twins = twins::twins(&scene, &points, none, &NoPictures, 1.0, &NoWatcher)?;
//! assert_eq!(twins, [Twin { view: ViewIndex(0), sharper: ViewIndex(1) }]);
//! # Ok(())
//! # }
//! ```
//!
//! [method 4]: https://github.com/viewrank/viewrank/blob/main/docs/method.md#4-partners

use std::{
    cmp::Ordering,
    collections::{BTreeSet, HashMap},
};

use rayon::prelude::*;

use super::confidence::{Pictures, SPACING};
use crate::{
    base::progress::{Cancelled, Watcher},
    model::scene::{PointIndex, Scene, ViewIndex, ViewPoints},
};

/// Largest distance of twins over the depth of what they show: half a degree, a tenth of what
/// partners need.
const MOST_BASELINE: f64 = 0.01;
/// Share of the points of each that the other shows, at least.
const LEAST_OVERLAP: f64 = 0.9;
/// Largest ratio of their ground sampling distances: beyond, the finer view shows more.
const MOST_SCALE: f64 = std::f64::consts::SQRT_2;
/// Observed points of a view that are looked at.
const SAMPLES: usize = 128;
/// Powers of two by which the depths of twins may differ: lenses of a thousandfold focal length.
const MOST_OCTAVES: i32 = 10;
/// Pairs of views that are looked at: of more views in one place, the first around each.
const MOST_PAIRS: usize = 1 << 25;
/// Views around one that are looked at, however many there are.
const LEAST_NEAR: usize = 1000;
/// Largest exponent of the edge of a cube, beyond that of any number.
const MOST_EXPONENT: f64 = 1100.0;

/// A view that is set aside.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Twin {
    pub view: ViewIndex,
    /// The view that takes part for it, or is kept for tests.
    pub sharper: ViewIndex,
}

/// Views that are no key views and no partners anyway, each list ascending.
#[derive(Clone, Copy, Default)]
pub struct Excluded<'a> {
    /// They take no part.
    pub without_image: &'a [ViewIndex],
    /// All others from the place of one are set aside: training on them would be training on the
    /// test.
    pub tests: &'a [ViewIndex],
}

/// Finds the views to set aside, ascending. With pictures the sharpest view of a place remains,
/// without them that which observes most points; ties go to the first.
pub fn twins(
    scene: &Scene,
    points: &ViewPoints,
    excluded: Excluded,
    pictures: &dyn Pictures,
    image_scale: f64,
    watcher: &dyn Watcher,
) -> Result<Vec<Twin>, Cancelled> {
    let placed = placed(scene, points, excluded.without_image);
    let criteria = Criteria {
        scene,
        points,
        tests: excluded.tests,
        pictures,
        // That at which it is matched, not half of it.
        scale: SPACING * image_scale,
    };
    let best_first = criteria.ranked(&placed, watcher)?;
    let mut aside = set_aside(scene, &best_first, watcher)?;
    // Of two views kept for tests, neither is set aside for the other.
    aside.retain(|twin| !criteria.is_test(twin.view));
    Ok(aside)
}

/// What decides which view of a place remains.
struct Criteria<'a> {
    scene: &'a Scene,
    points: &'a ViewPoints,
    tests: &'a [ViewIndex],
    pictures: &'a dyn Pictures,
    /// Size at which pictures are read.
    scale: f64,
}

impl Criteria<'_> {
    /// Returns the views that have a twin, best first. Only their pictures are read.
    fn ranked<'p>(
        &self,
        placed: &'p [Placed],
        watcher: &dyn Watcher,
    ) -> Result<Vec<Ranked<'p>>, Cancelled> {
        let mut grid = Grid::default();
        placed.iter().for_each(|placed| grid.add(placed));
        let rank = |i: usize| {
            watcher.check()?;
            let own = &placed[i];
            let mut others = grid.near(own).into_iter().filter(|&other| other != i);
            let has_twin = others.any(|other| are_twins(self.scene, own, &placed[other]));
            watcher.check()?;
            Ok(has_twin.then(|| self.rank(own)))
        };
        let ranked = (0..placed.len()).into_par_iter().map(rank);
        let ranked = ranked.collect::<Result<Vec<Option<Ranked>>, Cancelled>>()?;
        let mut ranked: Vec<Ranked> = ranked.into_iter().flatten().collect();
        ranked.sort_by(Ranked::best_first);
        Ok(ranked)
    }

    fn rank<'p>(&self, placed: &'p Placed) -> Ranked<'p> {
        let picture = self.pictures.grey(self.scene, placed.view, self.scale);
        let picture = picture.ok().flatten();
        Ranked {
            placed,
            is_test: self.is_test(placed.view),
            detail: picture.map_or(0.0, |(grey, _)| grey.detail()[0]),
            points: self.points.observed_by(placed.view).len(),
        }
    }

    fn is_test(&self, view: ViewIndex) -> bool {
        self.tests.binary_search(&view).is_ok()
    }
}

/// A view that has a twin, by the criteria.
struct Ranked<'a> {
    placed: &'a Placed,
    is_test: bool,
    /// Energy of the finest band of its picture; 0 without one.
    detail: f64,
    /// Number of points that it observes.
    points: usize,
}

impl Ranked<'_> {
    fn best_first(&self, other: &Self) -> Ordering {
        let tests = other.is_test.cmp(&self.is_test);
        let better = other.detail.total_cmp(&self.detail);
        let better = better.then(other.points.cmp(&self.points));
        tests
            .then(better)
            .then(self.placed.view.cmp(&other.placed.view))
    }
}

/// Goes through the views, best first: each is set aside if a better one that remains is its twin.
/// Pairs are not listed: there may be as many as the square of the views.
fn set_aside(
    scene: &Scene,
    best_first: &[Ranked],
    watcher: &dyn Watcher,
) -> Result<Vec<Twin>, Cancelled> {
    let (mut remain, mut aside): (Vec<&Placed>, _) = (Vec::new(), Vec::new());
    let mut grid = Grid::default();
    for Ranked { placed, .. } in best_first {
        watcher.check()?;
        // Only those that remain: a slow walk keeps a view at every hundredth of the depth.
        let mut near = grid.near(placed).into_iter().map(|other| remain[other]);
        match near.find(|other| are_twins(scene, placed, other)) {
            Some(better) => aside.push(Twin {
                view: placed.view,
                sharper: better.view,
            }),
            None => {
                remain.push(placed);
                grid.add(placed);
            }
        }
    }
    aside.sort_unstable();
    Ok(aside)
}

/// A view with the depth of what it shows.
struct Placed {
    view: ViewIndex,
    centre: [f64; 3],
    /// Lower quartile: what is near moves most.
    depth: f64,
    sample: Vec<PointIndex>,
}

/// Returns the views with an image that show something.
fn placed(scene: &Scene, points: &ViewPoints, without_image: &[ViewIndex]) -> Vec<Placed> {
    let views: Vec<ViewIndex> = scene.view_indices().collect();
    let placed = views.par_iter().filter_map(|&view| {
        let has_image = without_image.binary_search(&view).is_err();
        has_image
            .then(|| Placed::new(scene, points, view))
            .flatten()
    });
    placed.collect()
}

/// Views by place. Each is in a cube whose edge is at least its largest distance to a twin, a power
/// of two.
#[derive(Default)]
struct Grid {
    /// By exponent and position.
    cubes: HashMap<(i32, [i64; 3]), Vec<usize>>,
    exponents: BTreeSet<i32>,
    views: usize,
}

impl Grid {
    /// Adds a view, which gets the next number.
    fn add(&mut self, placed: &Placed) {
        let exponent = placed.exponent();
        let cube = (exponent, placed.position(exponent));
        self.cubes.entry(cube).or_default().push(self.views);
        self.exponents.insert(exponent);
        self.views += 1;
    }

    /// Returns the numbers of the views that are near enough to be twins of one, ascending; of
    /// very many, the first.
    fn near(&self, placed: &Placed) -> Vec<usize> {
        let most = (MOST_PAIRS / self.views.max(1)).max(LEAST_NEAR);
        let exponent = placed.exponent();
        let exponents = exponent - MOST_OCTAVES..=exponent + MOST_OCTAVES;
        let cubes = self.exponents.range(exponents).flat_map(|&exponent| {
            let middle = placed.position(exponent);
            let offsets = (0..27).map(|i| [i % 3 - 1, i / 3 % 3 - 1, i / 9 - 1]);
            let position = move |offset: [i64; 3]| {
                [0, 1, 2].map(|axis| middle[axis].saturating_add(offset[axis]))
            };
            offsets.filter_map(move |offset| self.cubes.get(&(exponent, position(offset))))
        });
        let mut near: Vec<usize> = cubes
            .flat_map(|of_cube| of_cube.iter().take(most))
            .copied()
            .collect();
        near.sort_unstable();
        // Saturated positions name a cube more than once.
        near.dedup();
        near.truncate(most);
        near
    }
}

impl Placed {
    fn new(scene: &Scene, points: &ViewPoints, view: ViewIndex) -> Option<Self> {
        let observed = points.observed_by(view);
        let step = observed.len().div_ceil(SAMPLES).max(1);
        let sample: Vec<PointIndex> = observed.iter().copied().step_by(step).collect();
        let (pose, camera) = (&scene.view(view).cam_from_world, scene.camera_of(view));
        let depth = |point: &PointIndex| {
            camera.depth(&pose.camera_from_world(&scene.points[point.index()]))
        };
        let mut depths: Vec<f64> = sample.iter().map(depth).filter(|&z| z > 0.0).collect();
        depths.sort_by(f64::total_cmp);
        Some(Self {
            view,
            centre: pose.centre().coords.data.0[0],
            depth: *depths.get(depths.len() / 4)?,
            sample,
        })
    }

    /// Exponent of the edge of its cube in a [`Grid`].
    fn exponent(&self) -> i32 {
        let exponent = (MOST_BASELINE * self.depth).log2().floor();
        exponent.clamp(-MOST_EXPONENT, MOST_EXPONENT) as i32 + 1
    }

    /// Position in cubes of an edge.
    fn position(&self, exponent: i32) -> [i64; 3] {
        let edge = f64::from(exponent).exp2();
        self.centre.map(|x| (x / edge).floor() as i64)
    }

    fn gsd(&self, scene: &Scene) -> f64 {
        self.depth / scene.camera_of(self.view).mean_focal_length()
    }
}

fn are_twins(scene: &Scene, a: &Placed, b: &Placed) -> bool {
    let baseline = (0..3).map(|axis| (a.centre[axis] - b.centre[axis]).powi(2));
    let baseline = baseline.sum::<f64>().sqrt();
    let scale = (a.gsd(scene) / b.gsd(scene)).ln().abs();
    baseline <= MOST_BASELINE * a.depth.min(b.depth)
        && scale <= MOST_SCALE.ln()
        && shows_points_of(scene, a.view, b)
        && shows_points_of(scene, b.view, a)
}

fn shows_points_of(scene: &Scene, view: ViewIndex, other: &Placed) -> bool {
    let (pose, camera) = (&scene.view(view).cam_from_world, scene.camera_of(view));
    let is_shown = |point: &&PointIndex| {
        let x_cam = pose.camera_from_world(&scene.points[point.index()]);
        let pixel = camera.project(&x_cam);
        pixel.is_some_and(|pixel| camera.contains(&pixel))
    };
    // Most views beside each other are no twins, which a few points show.
    let may_lack = (1.0 - LEAST_OVERLAP) * other.sample.len() as f64;
    let mut lacking = other.sample.iter().filter(|point| !is_shown(point));
    lacking.nth(may_lack as usize).is_none()
}

#[cfg(test)]
mod tests {
    use nalgebra::{Point3, Rotation3, Vector3};

    use super::*;
    use crate::{
        base::progress::NoWatcher,
        method::confidence::{Grey, Mask, PictureError},
        model::{
            camera::{Camera, CameraModel},
            scene::{CameraIndex, Pose, View},
        },
    };

    /// Checkerboards whose contrast is the view's entry; none without entries.
    struct Boards(Vec<u8>);

    impl Pictures for Boards {
        fn have_images(&self) -> bool {
            !self.0.is_empty()
        }

        fn grey(
            &self,
            _: &Scene,
            view: ViewIndex,
            _: f64,
        ) -> Result<Option<(Grey, Option<Mask>)>, PictureError> {
            let of_contrast = |&contrast: &u8| {
                let level = |i: usize| contrast * ((i % 64 + i / 64) % 2) as u8;
                (Grey::new(64, 64, (0..64 * 64).map(level).collect()), None)
            };
            Ok(self.0.get(view.index()).map(of_contrast))
        }

        fn mask(&self, _: &Scene, _: ViewIndex) -> Result<Option<Mask>, PictureError> {
            Ok(None)
        }
    }

    /// Views at these x, with the given focal lengths, of a wall at z = 10 whose points all
    /// observe.
    fn scene(views: &[(f64, f64)]) -> Scene {
        let camera = |&(_, focal): &(f64, f64)| {
            let params = vec![focal, focal, 80.0, 60.0];
            Camera::new(1, CameraModel::Pinhole, 160, 120, params).unwrap()
        };
        let view = |(i, &(x, _)): (usize, &(f64, f64))| View {
            name: format!("{i}"),
            image_id: i as u32,
            file_position: i as u32,
            camera: CameraIndex(i as u32),
            cam_from_world: Pose {
                rotation: Rotation3::identity(),
                translation: Vector3::new(-x, 0.0, 0.0),
            },
        };
        let at = |i: u32| Point3::new(f64::from(i % 10) - 4.5, f64::from(i / 10) - 3.0, 10.0);
        let points: Vec<_> = (0..70).map(at).collect();
        let track = || (0..views.len() as u32).map(ViewIndex);
        Scene {
            cameras: views.iter().map(camera).collect(),
            views: views.iter().enumerate().map(view).collect(),
            track_offsets: (0..=points.len())
                .map(|point| views.len() * point)
                .collect(),
            track_views: points.iter().flat_map(|_| track()).collect(),
            points,
            ..Scene::default()
        }
    }

    fn found(scene: &Scene, contrasts: &[u8], without_image: &[u32]) -> Vec<(u32, u32)> {
        found_with_tests(scene, contrasts, (without_image, &[]))
    }

    fn found_with_tests(
        scene: &Scene,
        contrasts: &[u8],
        (without_image, tests): (&[u32], &[u32]),
    ) -> Vec<(u32, u32)> {
        let views =
            |views: &[u32]| -> Vec<ViewIndex> { views.iter().copied().map(ViewIndex).collect() };
        let (without, tests) = (views(without_image), views(tests));
        let boards = Boards(contrasts.to_vec());
        let points = scene.view_points();
        let excluded = Excluded {
            without_image: &without,
            tests: &tests,
        };
        let twins = twins(scene, &points, excluded, &boards, 1.0, &NoWatcher).unwrap();
        twins
            .iter()
            .map(|twin| (twin.view.0, twin.sharper.0))
            .collect()
    }

    #[test]
    fn the_sharpest_view_of_a_place_takes_part_for_all() {
        let scene = scene(&[(0.0, 100.0), (1.0, 100.0), (0.02, 100.0), (0.05, 100.0)]);
        assert_eq!(found(&scene, &[50, 9, 80, 60], &[]), [(0, 2), (3, 2)]);
        // Equal pictures, or none: the first.
        assert_eq!(found(&scene, &[50; 4], &[]), [(2, 0), (3, 0)]);
        assert_eq!(found(&scene, &[], &[]), [(2, 0), (3, 0)]);
        // A view whose image is missing takes no part for others.
        assert_eq!(found(&scene, &[50, 9, 80, 60], &[2]), [(0, 3)]);
    }

    #[test]
    fn all_from_the_place_of_a_test_are_set_aside_but_no_test() {
        let scene = scene(&[(0.0, 100.0), (1.0, 100.0), (0.02, 100.0), (0.05, 100.0)]);
        let aside = |tests: &[u32]| found_with_tests(&scene, &[50, 9, 80, 60], (&[], tests));
        assert_eq!(aside(&[0]), [(2, 0), (3, 0)]);
        assert_eq!(aside(&[0, 3]), [(2, 3)]);
        assert_eq!(aside(&[1]), [(0, 2), (3, 2)]);
    }

    #[test]
    fn a_slow_walk_keeps_a_view_at_every_hundredth_of_the_depth() {
        let steps: Vec<_> = (0..9).map(|i| (0.06 * f64::from(i), 100.0)).collect();
        let aside = found(&scene(&steps), &[], &[]);
        assert_eq!(aside, [(1, 0), (3, 2), (5, 4), (7, 6)]);
    }

    /// A view at a place that looks at something in this depth.
    fn placed(centre: [f64; 3], depth: f64) -> Placed {
        Placed {
            view: ViewIndex(0),
            centre,
            depth,
            sample: Vec::new(),
        }
    }

    #[test]
    fn near_views_are_all_within_the_distance_of_twins_and_few_others() {
        // Steps of these shares fill a cube evenly; depths from 2 to 30.
        let share = |n: usize, step: f64| (n as f64 * step).fract();
        let all: Vec<Placed> = (0..3000)
            .map(|n| {
                let centre =
                    [0.8191725, 0.6710436, 0.5497004].map(|step| 4.0 * share(n, step) - 2.0);
                placed(centre, 2.0 + 28.0 * share(n, 0.3819660))
            })
            .collect();
        let mut grid = Grid::default();
        all.iter().for_each(|view| grid.add(view));
        let mut found = 0;
        for own in &all {
            let near = grid.near(own);
            assert!(near.is_sorted() && near.len() < all.len() / 2);
            let is_near = |other: &&Placed| {
                let offset = [0, 1, 2].map(|axis| own.centre[axis] - other.centre[axis]);
                Vector3::from(offset).norm() <= MOST_BASELINE * own.depth.min(other.depth)
            };
            let number = |other: &Placed| all.iter().position(|one| std::ptr::eq(one, other));
            let expected: Vec<usize> = all.iter().filter(is_near).filter_map(number).collect();
            assert!(
                expected
                    .iter()
                    .all(|other| near.binary_search(other).is_ok())
            );
            found += expected.len();
        }
        assert!(found > all.len() + all.len() / 10);
    }

    #[test]
    fn a_street_along_any_axis_has_few_views_near_one() {
        for axis in 0..3 {
            let mut grid = Grid::default();
            let at = |n: i32| {
                let mut centre = [0.0; 3];
                centre[axis] = 0.1 * f64::from(n);
                placed(centre, 10.0)
            };
            (0..5000).for_each(|n| grid.add(&at(n)));
            assert!(grid.near(&at(2500)).len() < 10);
        }
    }

    #[test]
    fn of_very_many_views_at_one_place_the_first_are_looked_at() {
        let still = placed([1.0, 2.0, 3.0], 10.0);
        for (views, looked_at) in [(5000, 5000), (12_000, MOST_PAIRS / 12_000)] {
            let mut grid = Grid::default();
            (0..views).for_each(|_| grid.add(&still));
            assert_eq!(grid.near(&still), (0..looked_at).collect::<Vec<_>>());
        }
    }

    #[test]
    fn views_of_any_depth_have_a_cube() {
        for depth in [f64::INFINITY, f64::MAX, f64::MIN_POSITIVE, 5e-324, 1.0] {
            let mut grid = Grid::default();
            let own = placed([1.0, 2.0, 3.0], depth);
            grid.add(&own);
            assert_eq!(grid.near(&own), [0], "{depth}");
        }
    }

    #[test]
    fn views_with_another_field_of_view_or_scale_are_no_twins() {
        // The tele lens shows less of the wall, and shows it finer.
        assert_eq!(found(&scene(&[(0.0, 100.0), (0.0, 180.0)]), &[], &[]), []);
        assert_eq!(found(&scene(&[(0.0, 100.0), (0.2, 100.0)]), &[], &[]), []);
    }
}
