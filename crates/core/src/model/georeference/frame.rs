//! Estimates which way is up in a model; upright frames for terrain surfaces and for maps.

use nalgebra::{Matrix3, Point3, Vector3};

use crate::{
    base::vector::{Kernel, vectorised},
    model::scene::Scene,
};

/// Largest ratio of the two smaller standard deviations at which the points are flat, so their
/// plane's normal is up.
const FLAT_RATIO: f64 = 0.3;
/// Least length of the mean viewing direction at which all views count as looking the same way.
const ONE_DIRECTION: f64 = 0.8;
/// Cosine of the angle to the longest axis of the points, from which on the views look along the
/// scene rather than at it.
const ALONG: f64 = 0.7;
/// Cosine of the angle between the mean image top and the world's third axis, above which that axis
/// is up in the images.
const UPRIGHT: f64 = 0.9;

/// Directions in which the extreme point of a hull is taken; also the largest number of its
/// corners.
const HULL_DIRECTIONS: u32 = 32;
/// Directions of the inner polygon, which excludes most points before the hull is computed.
const FEW_DIRECTIONS: u32 = 8;
/// Step through the points from which the inner polygon is made.
const SAMPLE_STEP: usize = 8;
/// Twice the area between a point and a side of that polygon, over the square of its largest
/// coordinate, that counts as inside.
const INSIDE: f64 = 1e-9;
/// Points that are compared with the sides at once.
const LANES: usize = 64;
/// Cosine of the angle within which the third axis of the model counts as up.
const NEARLY_UP: f64 = 0.98;

/// A right-handed frame with the third axis up and the origin among the points.
pub struct UprightFrame {
    origin: Point3<f64>,
    axes: [Vector3<f64>; 3],
}

impl UprightFrame {
    /// Makes a frame whose up is `up`, if given; otherwise the first that applies of:
    ///
    /// 1. flat points: the normal of their plane, towards the cameras;
    /// 2. images whose mean top is near the world's third axis: that mean;
    /// 3. all views looking at the scene in one direction, such as a nadir flight of one heading,
    ///    whose image tops are not up: the opposite direction;
    /// 4. the mean top of the images;
    /// 5. as for flat points.
    pub fn new(points: &[Point3<f64>], scene: &Scene, up: Option<[f64; 3]>) -> Self {
        let (origin, spread) = plane_fit(points);
        let up = up
            .and_then(|u| Vector3::from(u).try_normalize(0.0))
            .unwrap_or_else(|| fitted_up(scene, origin, &spread));
        let first = up.cross(&Vector3::ith(up.iamin(), 1.0)).normalize();
        Self {
            origin,
            axes: [first, up.cross(&first), up],
        }
    }

    /// Up, a unit vector in world coordinates.
    pub fn up(&self) -> Vector3<f64> {
        self.axes[2]
    }

    /// Origin: the mean of the points, world coordinates.
    pub fn origin(&self) -> Point3<f64> {
        self.origin
    }

    /// Converts a point from world to frame coordinates, scene units.
    pub fn local(&self, point: &Point3<f64>) -> [f64; 3] {
        self.axes.map(|axis| axis.dot(&(point - self.origin)))
    }

    /// Converts a point from frame to world coordinates, scene units.
    pub fn world(&self, local: [f64; 3]) -> Point3<f64> {
        self.origin + self.axes[0] * local[0] + self.axes[1] * local[1] + self.axes[2] * local[2]
    }
}

/// Standard deviation along each principal direction of points about their mean, with the
/// direction; ascending.
type Spread = [(f64, Vector3<f64>); 3];

fn plane_fit(points: &[Point3<f64>]) -> (Point3<f64>, Spread) {
    let n = points.len().max(1) as f64;
    // Relative to one of them: sums of earth-centred or UTM coordinates would lose digits.
    let anchor = points.first().map_or(Vector3::zeros(), |p| p.coords);
    let mean = anchor
        + points
            .iter()
            .map(|p| p.coords - anchor)
            .sum::<Vector3<f64>>()
            / n;
    let covariance: Matrix3<f64> = points
        .iter()
        .map(|p| (p.coords - mean) * (p.coords - mean).transpose())
        .sum();
    let eigen = (covariance / n).symmetric_eigen();
    let mut spread: Spread = std::array::from_fn(|i| {
        (
            eigen.eigenvalues[i].max(0.0).sqrt(),
            eigen.eigenvectors.column(i).into_owned(),
        )
    });
    spread.sort_by(|a, b| a.0.total_cmp(&b.0));
    (Point3::from(mean), spread)
}

/// Standard deviations of points along their three principal directions, scene units, ascending.
pub fn spread(points: &[Point3<f64>]) -> [f64; 3] {
    plane_fit(points).1.map(|(deviation, _)| deviation)
}

fn fitted_up(scene: &Scene, origin: Point3<f64>, spread: &Spread) -> Vector3<f64> {
    let [(thickness, normal), (width, _), (_, longest)] = *spread;
    if thickness > FLAT_RATIO * width
        && let Some(down) = down_in_images(scene, &longest)
    {
        return -down;
    }
    let towards: Vector3<f64> = scene
        .views
        .iter()
        .map(|v| v.cam_from_world.centre() - origin)
        .sum();
    if normal.dot(&towards) < 0.0 {
        -normal
    } else {
        normal
    }
}

/// Returns the direction down on which the views agree: that of gravity where they are upright, or
/// that of a camera that looks at the ground.
fn down_in_images(scene: &Scene, longest: &Vector3<f64>) -> Option<Vector3<f64>> {
    let count = scene.views.len() as f64;
    // Camera axes: 1 points down in the image, 2 forward.
    let mean_axis = |axis: usize| -> Vector3<f64> {
        scene
            .views
            .iter()
            .map(|v| v.cam_from_world.rotation.matrix().row(axis).transpose())
            .sum()
    };
    // Images turned all ways, whose tops cancel each other, say nothing of up.
    let below_images = mean_axis(1).try_normalize(0.5 * count);
    let ahead = mean_axis(2).try_normalize(ONE_DIRECTION * count);
    let upon = ahead.filter(|ahead| ahead.dot(longest).abs() < ALONG);
    // A façade photographed from one side, in a model whose third axis is up: its views agree on a
    // direction, too.
    let upright = below_images.filter(|down| -down.z > UPRIGHT);
    upright.or(upon).or(below_images)
}

/// A right-handed frame for maps seen from above, with the model's second axis pointing up the
/// sheet.
#[derive(Clone, Copy, Debug)]
pub struct MapFrame {
    /// Mean of the points, world coordinates.
    pub origin: Point3<f64>,
    /// Unit vectors in world coordinates: right, up the sheet, towards the reader (up in the
    /// model).
    pub axes: [Vector3<f64>; 3],
}

impl MapFrame {
    /// Makes a frame whose up is that of a terrain surface (method 1.7), or the model's third axis
    /// if that is within 11° of it.
    pub fn new(scene: &Scene, up: Option<[f64; 3]>) -> Self {
        let frame = UprightFrame::new(&scene.points, scene, up);
        let up = if frame.up().z > NEARLY_UP {
            Vector3::z()
        } else {
            frame.up()
        };
        let forward = if up.y.abs() > NEARLY_UP {
            Vector3::z()
        } else {
            Vector3::y()
        };
        let right = forward.cross(&up).normalize();
        Self {
            origin: frame.origin(),
            axes: [right, up.cross(&right), up],
        }
    }

    /// Converts a point from world to frame coordinates, scene units.
    pub fn local(&self, point: &Point3<f64>) -> [f64; 3] {
        self.direction(&(point - self.origin))
    }

    /// Convex hull of points seen from above, in at most as many corners as there are
    /// `HULL_DIRECTIONS`: world coordinates, counter-clockwise, not closed.
    pub fn hull(&self, points: &[Point3<f64>]) -> Vec<Point3<f64>> {
        let flat: Vec<[f64; 2]> = points
            .iter()
            .map(|point| self.local(point))
            .map(|[x, y, _]| [x, y])
            .collect();
        // Most points are well inside the polygon of a sample.
        let sample: Vec<usize> = (0..flat.len()).step_by(SAMPLE_STEP).collect();
        let few = extremes(&flat, &sample, FEW_DIRECTIONS);
        let outer = vectorised(Outer {
            flat: &flat,
            sides: &sides(&flat, &few),
        });
        extremes(&flat, &outer, HULL_DIRECTIONS)
            .into_iter()
            .map(|v| points[v])
            .collect()
    }

    /// Converts a direction from world to frame coordinates.
    pub fn direction(&self, direction: &Vector3<f64>) -> [f64; 3] {
        self.axes.map(|axis| axis.dot(direction))
    }
}

/// Returns the candidates farthest in evenly spaced directions, counter-clockwise, each once.
fn extremes(flat: &[[f64; 2]], candidates: &[usize], directions: u32) -> Vec<usize> {
    let mut corners: Vec<usize> = (0..directions)
        .filter_map(|i| {
            let angle = f64::from(i) * std::f64::consts::TAU / f64::from(directions);
            farthest(flat, candidates, angle)
        })
        .collect();
    corners.dedup();
    if corners.len() > 1 && corners.first() == corners.last() {
        corners.pop();
    }
    corners
}

/// Returns the candidate farthest in the direction of an angle.
fn farthest(flat: &[[f64; 2]], candidates: &[usize], angle: f64) -> Option<usize> {
    let (sin, cos) = angle.sin_cos();
    let along = |v: usize| flat[v][0] * cos + flat[v][1] * sin;
    let most = candidates
        .iter()
        .map(|&v| along(v))
        .fold(f64::NEG_INFINITY, f64::max);
    // Ties go to the point farthest ahead counter-clockwise, so that no corner is on the edge
    // between two others.
    let ahead = |v: usize| flat[v][1] * cos - flat[v][0] * sin;
    let ties = candidates.iter().copied().filter(|&v| along(v) == most);
    ties.max_by(|&a, &b| ahead(a).total_cmp(&ahead(b)))
}

/// Returns the sides of a convex polygon as (a, b, c): where `a x + b y > c`, a point is inside by
/// more than rounding, and no corner of the hull. Empty for fewer than three corners.
fn sides(flat: &[[f64; 2]], polygon: &[usize]) -> Vec<[f64; 3]> {
    if polygon.len() < 3 {
        return Vec::new();
    }
    let largest = polygon
        .iter()
        .flat_map(|&v| flat[v])
        .map(f64::abs)
        .fold(0.0, f64::max);
    let next = polygon.iter().cycle().skip(1);
    let side = |(&a, &b): (&usize, &usize)| {
        let ([ax, ay], [bx, by]) = (flat[a], flat[b]);
        let (x, y) = (ay - by, bx - ax);
        [x, y, x * ax + y * ay + INSIDE * largest * largest]
    };
    polygon.iter().zip(next).map(side).collect()
}

/// Finds the points that are not inside all sides.
struct Outer<'a> {
    flat: &'a [[f64; 2]],
    sides: &'a [[f64; 3]],
}

impl Kernel for Outer<'_> {
    type Output = Vec<usize>;

    #[inline(always)]
    fn run(self) -> Vec<usize> {
        let (mut outer, mut inside) = (Vec::new(), [false; LANES]);
        for (part, first) in self.flat.chunks(LANES).zip((0..).step_by(LANES)) {
            inside.fill(!self.sides.is_empty());
            for [a, b, c] in self.sides {
                inside
                    .iter_mut()
                    .zip(part)
                    .for_each(|(inside, [x, y])| *inside &= a * x + b * y > *c);
            }
            outer.extend(
                (0..part.len())
                    .filter(|&lane| !inside[lane])
                    .map(|lane| first + lane),
            );
        }
        outer
    }
}

#[cfg(test)]
mod tests {
    use proptest::{collection::vec, prelude::*};

    use super::*;

    proptest! {
        #[test]
        fn no_corner_of_a_hull_is_inside_the_polygon_of_a_few(places in vec((-9i8..9, -9i8..9, 0u8..4), 0..400), turn in 0.0..6.3f64) {
            let (sin, cos) = f64::sin_cos(turn);
            let axes = [Vector3::new(cos, sin, 0.0), Vector3::new(-sin, cos, 0.0), Vector3::z()];
            let frame = MapFrame { origin: Point3::new(4e5, 5e6, 0.0), axes };
            let points: Vec<Point3<f64>> = places
                .iter()
                .map(|&(x, y, z)| frame.origin + Vector3::new(f64::from(x), f64::from(y), f64::from(z)))
                .collect();
            let flat: Vec<[f64; 2]> = points.iter().map(|p| frame.local(p)).map(|[x, y, _]| [x, y]).collect();
            let all: Vec<usize> = (0..points.len()).collect();
            let expected: Vec<_> = extremes(&flat, &all, HULL_DIRECTIONS).into_iter().map(|v| points[v]).collect();
            prop_assert_eq!(frame.hull(&points), expected);
        }
    }
}
