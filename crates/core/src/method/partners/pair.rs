//! Relative geometry of two views.

use nalgebra::{Point3, Vector3};

use crate::model::scene::{PointIndex, Scene, ViewIndex};

/// Relative geometry of two views: the input of a backend's decision whether it can match them
/// (method 7.1).
#[derive(Clone, Copy)]
pub struct PairGeometry<'a> {
    pub scene: &'a Scene,
    pub key: ViewIndex,
    pub partner: ViewIndex,
    /// Sparse points that both views observe, ascending, without duplicates.
    pub shared: &'a [PointIndex],
    /// Median triangulation angle at the shared points, degrees.
    pub angle_deg: f64,
    /// Share of the shared points with an angle below 0.5 degrees.
    pub still_share: f64,
    /// Median over the shared points of the partner's scale relative to the key view's, octaves;
    /// positive: the partner is finer.
    pub scale_octaves: f64,
    /// True if the line through the two centres meets one of the images.
    pub epipole_inside: bool,
}

/// Triangulation angle, degrees, below which two views count as not moving relative to a point.
const STILL_DEG: f64 = 0.5;
/// Share of the shared points with such an angle above which two views have no baseline.
const STILL_SHARE: f64 = 0.5;

impl<'a> PairGeometry<'a> {
    /// `shared`: the points that both views observe; at least one.
    pub fn new(
        scene: &'a Scene,
        key: ViewIndex,
        partner: ViewIndex,
        shared: &'a [PointIndex],
    ) -> Self {
        let views = [key, partner];
        let centres = views.map(|v| scene.view(v).cam_from_world.centre());
        let focal = views.map(|v| scene.camera_of(v).mean_focal_length());
        let (mut cosines, mut ratios): (Vec<f64>, Vec<f64>) = shared
            .iter()
            .map(|p| angle_and_scale(&centres, &scene.points[p.index()]))
            .unzip();
        let still_share = still_share(&cosines);
        let octaves = |ratio: f64| 0.5 * ratio.log2() + (focal[1] / focal[0]).log2();
        Self {
            scene,
            key,
            partner,
            shared,
            // Medians of cosines and squared ratios, so that acos and log2 are computed for one or
            // two points.
            angle_deg: median_of(&mut cosines, angle_deg),
            still_share,
            scale_octaves: median_of(&mut ratios, octaves),
            epipole_inside: epipole_is_inside(scene, views, &centres),
        }
    }

    /// Returns whether the two views are at the same position (method 4).
    pub fn has_no_baseline(&self) -> bool {
        self.still_share > STILL_SHARE
    }
}

/// Returns the cosine of the angle between the rays from a point to two centres, and the ratio of
/// their squared lengths.
fn angle_and_scale(centres: &[Point3<f64>; 2], point: &Point3<f64>) -> (f64, f64) {
    let [a, b] = centres.map(|centre| centre - point);
    let (a2, b2) = (a.norm_squared(), b.norm_squared());
    (a.dot(&b) / (a2 * b2).sqrt(), a2 / b2)
}

fn angle_deg(cosine: f64) -> f64 {
    cosine.clamp(-1.0, 1.0).acos().to_degrees()
}

/// Returns the share of the points relative to which the views do not move.
fn still_share(cosines: &[f64]) -> f64 {
    // By cosines, so that points need no acos.
    let still = STILL_DEG.to_radians().cos();
    cosines.iter().filter(|&&c| c > still).count() as f64 / cosines.len() as f64
}

fn epipole_is_inside(scene: &Scene, [a, b]: [ViewIndex; 2], centres: &[Point3<f64>; 2]) -> bool {
    meets_image(scene, a, &centres[1]) || meets_image(scene, b, &centres[0])
}

/// Returns the median of the monotone function `f` over the values; 0 if it is NaN.
fn median_of(values: &mut [f64], f: impl Fn(f64) -> f64) -> f64 {
    let middle = values.len() / 2;
    let (below, &mut upper, _) = values.select_nth_unstable_by(middle, f64::total_cmp);
    let lower = below.iter().copied().max_by(f64::total_cmp);
    let median = match lower {
        Some(lower) if values.len().is_multiple_of(2) => 0.5 * (f(lower) + f(upper)),
        _ => f(upper),
    };
    if median.is_nan() { 0.0 } else { median }
}

/// Returns whether the line from the view's centre through a point meets its image, in front of or
/// behind the camera.
fn meets_image(scene: &Scene, view: ViewIndex, point: &Point3<f64>) -> bool {
    let camera = scene.camera_of(view);
    let direction = scene
        .view(view)
        .cam_from_world
        .camera_from_world(point)
        .coords;
    let inside = |d: Vector3<f64>| {
        camera
            .project(&d.into())
            .is_some_and(|pixel| camera.contains(&pixel))
    };
    inside(direction) || inside(-direction)
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;
    use crate::method::synthetic::Town;

    fn scene() -> Scene {
        Town {
            points: 300,
            ..Town::default()
        }
        .scene()
    }

    #[test]
    fn geometry_of_a_pair_is_antisymmetric() {
        let scene = scene();
        let (a, b) = (ViewIndex(6), ViewIndex(32));
        let other: HashSet<_> = scene.view_points().observed_by(b).iter().copied().collect();
        let both: Vec<_> = scene
            .view_points()
            .observed_by(a)
            .iter()
            .copied()
            .filter(|p| other.contains(p))
            .collect();
        let (ab, ba) = (
            PairGeometry::new(&scene, a, b, &both),
            PairGeometry::new(&scene, b, a, &both),
        );
        assert!(
            (ab.angle_deg - ba.angle_deg).abs() < 1e-9
                && (ab.scale_octaves + ba.scale_octaves).abs() < 1e-9
        );
        assert!(ab.angle_deg > 1.0 && ab.still_share == 0.0);
        assert_eq!(ab.epipole_inside, ba.epipole_inside);
    }

    /// Flying straight ahead with the camera forward: the epipole is the middle of both images.
    #[test]
    fn forward_motion_has_its_epipole_inside() {
        let mut scene = scene();
        let ahead = scene.views[0].cam_from_world.viewing_direction() * 2.0;
        let rotation = scene.views[0].cam_from_world.rotation;
        scene.views[1].cam_from_world = scene.views[0].cam_from_world;
        scene.views[1].cam_from_world.translation -= rotation * ahead;
        let points = [PointIndex(0)];
        assert!(PairGeometry::new(&scene, ViewIndex(0), ViewIndex(1), &points).epipole_inside);
        let aside = Vector3::new(2.0, 0.0, 0.0);
        scene.views[1].cam_from_world.translation =
            scene.views[0].cam_from_world.translation - aside;
        assert!(!PairGeometry::new(&scene, ViewIndex(0), ViewIndex(1), &points).epipole_inside);
    }

    /// One of the two images is enough, and so is the line behind its camera.
    #[test]
    fn a_view_that_looks_along_the_baseline_has_the_epipole_inside() {
        let mut scene = scene();
        let centre = scene.views[0].cam_from_world.centre() + Vector3::new(2.0, 0.0, 0.0);
        for towards in [-Vector3::x(), Vector3::x()] {
            let rotation = nalgebra::Rotation3::rotation_between(&towards, &Vector3::z()).unwrap();
            let pose = &mut scene.views[1].cam_from_world;
            (pose.rotation, pose.translation) = (rotation, -(rotation * centre.coords));
            for [key, partner] in [[0, 1], [1, 0]].map(|pair| pair.map(ViewIndex)) {
                assert!(
                    PairGeometry::new(&scene, key, partner, &[PointIndex(0)]).epipole_inside,
                    "{towards} {key:?}"
                );
            }
        }
    }

    #[test]
    fn a_partner_at_half_the_distance_is_an_octave_finer() {
        let mut scene = scene();
        let (pose, point) = (scene.views[0].cam_from_world, scene.points[0]);
        let nearer = nalgebra::center(&pose.centre(), &point);
        scene.views[1].cam_from_world = pose;
        scene.views[1].cam_from_world.translation = -(pose.rotation * nearer.coords);
        let of = |key, partner| {
            PairGeometry::new(&scene, ViewIndex(key), ViewIndex(partner), &[PointIndex(0)])
        };
        assert!(
            (of(0, 1).scale_octaves - 1.0).abs() < 1e-9
                && (of(1, 0).scale_octaves + 1.0).abs() < 1e-9
        );
    }

    #[test]
    fn views_have_no_baseline_where_most_points_stand_still() {
        let scene = scene();
        let pair = PairGeometry::new(&scene, ViewIndex(6), ViewIndex(32), &[PointIndex(0)]);
        let has_none = |still_share| {
            PairGeometry {
                still_share,
                ..pair
            }
            .has_no_baseline()
        };
        assert!(!has_none(0.5) && has_none(0.6));
    }

    #[test]
    fn the_median_of_an_even_number_is_between_the_middle_two() {
        assert_eq!(median_of(&mut [4.0, 1.0, 3.0, 2.0], |x| 10.0 * x), 25.0);
        assert_eq!(median_of(&mut [4.0, 1.0, 3.0], |x| -x), -3.0);
        assert_eq!(median_of(&mut [f64::NAN], |x| x), 0.0);
    }
}
