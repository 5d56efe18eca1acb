//! Software depth buffer of pinhole faces: the frontmost triangle and its inverse depth in each
//! pixel.

use std::ops::Range;

use nalgebra::{Matrix3, Point2, Point3, Vector2, Vector3};

use crate::{
    base::vector::{Kernel, vectorised},
    model::camera::{Camera, CameraModel},
};

/// Margin around the image, pixels, so that triangles across its border are sampled too.
const MARGIN: f64 = 8.0;
/// Angle from the axis beyond which the faces of a cube replace a single plane.
const WIDE: f64 = 60.0;
/// Largest number of pixels along a side, as a multiple of the requested number, whatever the
/// camera's parameters.
const MOST_SIDES: f64 = 4.0;
/// Rays per side of the grid that measures a camera's field of view.
const FIELD_SAMPLES: u32 = 33;

/// A pinhole camera that covers all or part of a camera's field of view.
#[derive(Clone, Debug)]
pub struct Face {
    pub face_from_camera: Matrix3<f64>,
    /// Pixels per unit of x/z and y/z.
    focal: Vector2<f64>,
    /// Principal point, pixels.
    axis: Vector2<f64>,
    width: usize,
    height: usize,
    /// Unit normals of the four sides of the frustum, pointing inwards.
    sides: [Vector3<f64>; 4],
}

/// Returns the bounds in x/z and y/z of the rays of a field of view; `None` without rays.
fn extent(rays: &[Vector3<f64>], missing: bool) -> Option<(Vector2<f64>, Vector2<f64>)> {
    let tangents = rays.iter().map(|r| Vector2::new(r.x / r.z, r.y / r.z));
    let bounds = tangents.map(|tangent| (tangent, tangent));
    let (low, high) = bounds.reduce(|a, b| (a.0.inf(&b.0), a.1.sup(&b.1)))?;
    // The border of the field is between a ray that exists and a neighbour that does not.
    let spare = if missing {
        (high - low) * (1.5 / f64::from(FIELD_SAMPLES - 1))
    } else {
        Vector2::zeros()
    };
    Some((low - spare, high + spare))
}

impl Face {
    /// Returns one face with the camera's pinhole part, its long side about `long_side` pixels;
    /// faces of a cube for a wide field of view; no face if no pixel has a ray.
    pub fn covering(camera: &Camera, long_side: u32) -> Vec<Self> {
        let focal = camera.mean_focal_length() * f64::from(long_side)
            / f64::from(camera.width.max(camera.height));
        // Extent in x/z or y/z.
        let within = |field: f64| focal.min(MOST_SIDES * f64::from(long_side) / field);
        let cube = |sides: &[[[i8; 3]; 3]]| {
            let side = |&[r, d, f]: &[[i8; 3]; 3]| Self::cube(within(2.0), r, d, f);
            sides.iter().map(side).collect()
        };
        if camera.model() == CameraModel::Equirectangular {
            return cube(&CUBE);
        }
        let (rays, missing) = field(camera);
        // A plane grows with the tangent of the angle, without bound towards 90°.
        if rays.iter().any(|r| r.z < WIDE.to_radians().cos()) {
            return cube(&CUBE[..5]);
        }
        let Some((low, high)) = extent(&rays, missing) else {
            return Vec::new();
        };
        vec![Self::window(
            within((high - low).max()),
            Matrix3::identity(),
            low,
            high,
        )]
    }

    /// Returns a face with exactly the pixels of some rows of a pinhole camera's image, resized to
    /// `width` x `height`.
    pub fn pinhole(camera: &Camera, [width, height]: [u32; 2], rows: Range<u32>) -> Self {
        let scale = Vector2::new(
            f64::from(width) / f64::from(camera.width),
            f64::from(height) / f64::from(camera.height),
        );
        let (focal, axis) = camera.pinhole_part();
        let (focal, axis) = (
            focal.component_mul(&scale),
            axis.coords.component_mul(&scale) - Vector2::new(0.0, f64::from(rows.start)),
        );
        Self::new(Matrix3::identity(), focal, axis, width as usize, rows.len())
    }

    fn cube(focal: f64, right: [i8; 3], down: [i8; 3], forward: [i8; 3]) -> Self {
        let row = |r: [i8; 3]| Vector3::from(r.map(f64::from)).transpose();
        let one = Vector2::new(1.0, 1.0);
        Self::window(
            focal,
            Matrix3::from_rows(&[row(right), row(down), row(forward)]),
            -one,
            one,
        )
    }

    /// `low` and `high`: bounds of the field, in x/z and y/z.
    fn window(
        focal: f64,
        face_from_camera: Matrix3<f64>,
        low: Vector2<f64>,
        high: Vector2<f64>,
    ) -> Self {
        let axis = Vector2::from_element(MARGIN) - low * focal;
        let size = (high - low) * focal + Vector2::from_element(2.0 * MARGIN);
        let (width, height) = (size.x.ceil() as usize, size.y.ceil() as usize);
        Self::new(
            face_from_camera,
            Vector2::from_element(focal),
            axis,
            width,
            height,
        )
    }

    fn new(
        face_from_camera: Matrix3<f64>,
        focal: Vector2<f64>,
        axis: Vector2<f64>,
        width: usize,
        height: usize,
    ) -> Self {
        let low = -axis.component_div(&focal);
        let high = (Vector2::new(width as f64, height as f64) - axis).component_div(&focal);
        let sides = [
            Vector3::new(1.0, 0.0, -low.x),
            Vector3::new(-1.0, 0.0, high.x),
            Vector3::new(0.0, 1.0, -low.y),
            Vector3::new(0.0, -1.0, high.y),
        ];
        Self {
            face_from_camera,
            focal,
            axis,
            width,
            height,
            sides: sides.map(|n| n.normalize()),
        }
    }

    pub fn pixels(&self) -> u64 {
        (self.width * self.height) as u64
    }

    /// Returns whether a sphere (centre in camera coordinates) may intersect the field.
    pub fn meets(&self, centre: &Point3<f64>, radius: f64) -> bool {
        let centre = self.face_from_camera * centre.coords;
        centre.z > -radius && self.sides.iter().all(|n| n.dot(&centre) >= -radius)
    }

    /// Projects a point in face coordinates to a pixel.
    fn pixel(&self, p: &Vector3<f64>) -> Point2<f64> {
        Point2::from(p.xy().component_mul(&self.focal) / p.z + self.axis)
    }

    /// Projects a point in camera coordinates.
    pub fn project(&self, point: &Point3<f64>) -> FacePoint {
        self.projected(self.face_from_camera * point.coords)
    }

    fn projected(&self, place: Vector3<f64>) -> FacePoint {
        FacePoint {
            place,
            screen: self.pixel(&place).coords.push(place.z.recip()),
        }
    }
}

/// A point in face coordinates, with its projection.
#[derive(Clone, Copy, Debug)]
pub struct FacePoint {
    /// Face coordinates.
    place: Vector3<f64>,
    /// Pixel x, pixel y and inverse depth; meaningful only in front of the face.
    screen: Vector3<f64>,
}

/// Right, down and forward axes of the faces of a cube, in camera coordinates; the backward face is
/// last.
#[rustfmt::skip]
const CUBE: [[[i8; 3]; 3]; 6] = [
    [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    [[0, 0, -1], [0, 1, 0], [1, 0, 0]],
    [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
    [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    [[-1, 0, 0], [0, 1, 0], [0, 0, -1]],
];

/// Returns the rays through a grid of pixels up to the border, and whether some pixels have none.
fn field(camera: &Camera) -> (Vec<Vector3<f64>>, bool) {
    let last = f64::from(FIELD_SAMPLES - 1);
    let at = |i: u32, size: u32| f64::from(i) / last * f64::from(size);
    let pixels = (0..FIELD_SAMPLES * FIELD_SAMPLES).map(|i| {
        Point2::new(
            at(i % FIELD_SAMPLES, camera.width),
            at(i / FIELD_SAMPLES, camera.height),
        )
    });
    let rays: Vec<_> = pixels
        .filter_map(|p| camera.ray(&p))
        .map(|r| r.into_inner())
        .collect();
    let missing = rays.len() < (FIELD_SAMPLES * FIELD_SAMPLES) as usize;
    (rays, missing)
}

/// Depth by which something may be in front of a triangle without hiding it; the larger of the two.
#[derive(Clone, Copy, Debug)]
pub struct Tolerance {
    /// Scene units.
    pub length: f64,
    /// Share of the depth.
    pub depth_share: f64,
}

impl Tolerance {
    /// Returns whether `front` is in front of `own` by more than the tolerance; both are inverse
    /// depths.
    pub fn hides(&self, front: f64, own: f64) -> bool {
        // In depths: own - front > max(length, share * own), multiplied by both inverse depths.
        front - own > front * (self.length * own).max(self.depth_share)
    }
}

/// Spans collected per pass.
const MOST_SPANS: usize = 2048;

/// The frontmost triangle in each pixel of a face.
#[derive(Default)]
pub struct Buffer {
    /// Inverse depth (f32) in the upper half, triangle in the lower half: the larger number is in
    /// front, and equal depths are decided by the triangle, whatever the drawing order. 0: empty.
    pixels: Vec<u64>,
    /// Spans that are not yet in `pixels`: at most [`MOST_SPANS`] and those of a triangle.
    spans: Vec<Span>,
}

impl Buffer {
    pub fn clear(&mut self, face: &Face) {
        self.pixels.clear();
        self.pixels.resize(face.width * face.height, 0);
    }

    /// Draws triangles, given by their numbers and corners, clipped at depth `near`; adds to
    /// `covered` the number of pixels that each covers.
    pub fn draw<'p>(
        &mut self,
        face: &Face,
        near: f64,
        triangles: impl Iterator<Item = (u32, [&'p FacePoint; 3])>,
        covered: &mut [u32],
    ) {
        // In two passes: a span's length is then ready before the inner loop branches on it, and
        // mispredictions cost little.
        for ((triangle, corners), covered) in triangles.zip(covered) {
            for_each_span(face, triangle, corners, near, |span| {
                *covered += span.pixels();
                self.spans.push(span);
            });
            if self.spans.len() >= MOST_SPANS {
                self.put_spans();
            }
        }
        self.put_spans();
    }

    fn put_spans(&mut self) {
        vectorised(Frontmost {
            spans: &self.spans,
            pixels: &mut self.pixels,
        });
        self.spans.clear();
    }

    /// Returns the frontmost triangle in each pixel, row by row; `nothing` for empty pixels.
    #[inline(always)]
    pub fn triangles(&self, nothing: u32) -> impl Iterator<Item = u32> {
        self.pixels
            .iter()
            .map(move |&code| if code == 0 { nothing } else { code as u32 })
    }

    /// Counts the pixels covered by the triangle (camera coordinates) in which nothing is in front
    /// of it by more than the tolerance.
    pub fn free(
        &self,
        face: &Face,
        corners: &[Point3<f64>; 3],
        near: f64,
        tolerance: Tolerance,
    ) -> u32 {
        let [a, b, c] = corners.each_ref().map(|corner| face.project(corner));
        let mut free = 0;
        for_each_span(face, 0, [&a, &b, &c], near, |span| {
            for column in span.first..span.end {
                let front = inverse_depth(self.pixels[span.row + column as usize]);
                free +=
                    u32::from(!tolerance.hides(front.into(), span.inverse_depth(column).into()));
            }
        });
        free
    }

    /// Returns triangle and inverse depth in the pixel of a point in camera coordinates, and the
    /// point's own inverse depth; `None` outside the face and for empty pixels.
    pub fn sample(&self, face: &Face, point: &Point3<f64>, near: f64) -> Option<(u32, f64, f64)> {
        let p = face.face_from_camera * point.coords;
        let pixel = (p.z > near).then(|| face.pixel(&p))?;
        let inside = pixel.x >= 0.0
            && pixel.y >= 0.0
            && pixel.x < face.width as f64
            && pixel.y < face.height as f64;
        let code = inside.then(|| self.pixels[pixel.y as usize * face.width + pixel.x as usize])?;
        (code != 0).then(|| (code as u32, inverse_depth(code).into(), p.z.recip()))
    }

    /// Returns triangle and inverse depth (0: empty) of the four pixels around a point in camera
    /// coordinates, and the point's own inverse depth; `None` if the point is not on the face.
    pub fn around(
        &self,
        face: &Face,
        point: &Point3<f64>,
        near: f64,
    ) -> Option<([(u32, f64); 4], f64)> {
        let p = face.face_from_camera * point.coords;
        let corner = (p.z > near).then(|| face.pixel(&p) - Vector2::from_element(0.5))?;
        let inside = corner.x >= 0.0
            && corner.y >= 0.0
            && corner.x < (face.width - 1) as f64
            && corner.y < (face.height - 1) as f64;
        let first = inside.then(|| corner.y as usize * face.width + corner.x as usize)?;
        let codes =
            [first, first + 1, first + face.width, first + face.width + 1].map(|i| self.pixels[i]);
        Some((
            codes.map(|code| (code as u32, inverse_depth(code).into())),
            p.z.recip(),
        ))
    }
}

/// Puts spans into the pixels where they are in front.
struct Frontmost<'a> {
    spans: &'a [Span],
    pixels: &'a mut [u64],
}

impl Kernel for Frontmost<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        for span in self.spans {
            for column in span.first..span.end {
                let pixel = &mut self.pixels[span.row + column as usize];
                *pixel = (*pixel).max(
                    u64::from(span.inverse_depth(column).to_bits()) << 32
                        | u64::from(span.triangle),
                );
            }
        }
    }
}

fn inverse_depth(code: u64) -> f32 {
    f32::from_bits((code >> 32) as u32)
}

/// Pixels of a row whose centres a triangle covers. Columns are 32-bit numbers with a sign:
/// conversions from and to others take several instructions each.
#[derive(Clone, Copy, Debug)]
struct Span {
    /// Index of the first pixel of the row.
    row: usize,
    triangle: u32,
    /// First covered column, and one past the last; `end <= first` if the row is empty.
    first: i32,
    end: i32,
    /// Inverse depth of the triangle's plane at column 0, and its change per column.
    start: f64,
    by_x: f64,
    /// Inverse depths of the triangle's corners: least and largest.
    least: f32,
    most: f32,
}

impl Span {
    #[inline(always)]
    fn pixels(&self) -> u32 {
        (self.end - self.first).max(0) as u32
    }

    /// Slivers extrapolate badly, so it is clamped to the range of the corners.
    #[inline(always)]
    fn inverse_depth(&self, column: i32) -> f32 {
        least(
            most(
                (self.start + self.by_x * f64::from(column)) as f32,
                self.least,
            ),
            self.most,
        )
    }
}

/// Calls `visit` with the pixels of each row that a triangle, given by its number and corners,
/// covers.
#[inline(always)]
fn for_each_span(
    face: &Face,
    triangle: u32,
    [a, b, c]: [&FacePoint; 3],
    near: f64,
    mut visit: impl FnMut(Span),
) {
    match [a, b, c].iter().filter(|p| p.place.z > near).count() {
        3 => fill(face, triangle, [a.screen, b.screen, c.screen], &mut visit),
        0 => {}
        _ => {
            let (polygon, n) = clip([a.place, b.place, c.place], near);
            let screen = polygon.map(|p| face.projected(p).screen);
            for i in 2..n {
                fill(
                    face,
                    triangle,
                    [screen[0], screen[i - 1], screen[i]],
                    &mut visit,
                );
            }
        }
    }
}

/// Clips a triangle at depth `near`; returns a polygon of three or four corners.
fn clip(triangle: [Vector3<f64>; 3], near: f64) -> ([Vector3<f64>; 4], usize) {
    let mut polygon = [Vector3::new(0.0, 0.0, near); 4];
    let mut n = 0;
    for i in 0..3 {
        let (a, b) = (triangle[i], triangle[(i + 1) % 3]);
        if a.z > near {
            polygon[n] = a;
            n += 1;
        }
        if (a.z > near) != (b.z > near) {
            polygon[n] = a + (b - a) * ((near - a.z) / (b.z - a.z));
            // Rounding may have left it nearer.
            polygon[n].z = near;
            n += 1;
        }
    }
    (polygon, n)
}

/// Rasterises a triangle whose corners are given as pixel x, y and inverse depth, row by row.
#[inline(always)]
fn fill(face: &Face, triangle: u32, corners: [Vector3<f64>; 3], visit: &mut impl FnMut(Span)) {
    let [a, b, c] = corners;
    let area = (b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x);
    let (low_y, high_y) = (least(least(a.y, b.y), c.y), most(most(a.y, b.y), c.y));
    // Negated, so that NaN is left out, too.
    if !(area != 0.0 && high_y >= 0.5 && low_y < face.height as f64) {
        return;
    }
    let plane = DepthPlane::new(corners, area);
    // Whichever way it faces: surface hides from behind, too.
    let [d, e, f] = if area > 0.0 { [a, b, c] } else { [c, b, a] };
    let sides = [Side::new(&d, &e), Side::new(&e, &f), Side::new(&f, &d)];
    for row in first_centre(low_y, face.height)..end_centre(high_y, face.height) {
        let y = f64::from(row) + 0.5;
        let (mut left, mut right) = (f64::NEG_INFINITY, f64::INFINITY);
        for side in &sides {
            let along = side.slope * (y - side.y);
            left = most(side.left + along, left);
            right = least(side.right + along, right);
        }
        visit(Span {
            row: row as usize * face.width,
            triangle,
            first: first_centre(left, face.width),
            end: end_centre(right, face.width),
            start: plane.start(y),
            by_x: plane.by_x,
            least: plane.least,
            most: plane.most,
        });
    }
}

/// Inverse depth of a triangle, which is linear in the image.
struct DepthPlane {
    /// A corner: pixel x, y and inverse depth.
    at: Vector3<f64>,
    by_x: f64,
    by_y: f64,
    /// Of the corners.
    least: f32,
    most: f32,
}

impl DepthPlane {
    /// `area`: twice that of the triangle in the image.
    #[inline(always)]
    fn new([a, b, c]: [Vector3<f64>; 3], area: f64) -> Self {
        Self {
            at: a,
            by_x: ((b.z - a.z) * (c.y - a.y) - (c.z - a.z) * (b.y - a.y)) / area,
            by_y: ((c.z - a.z) * (b.x - a.x) - (b.z - a.z) * (c.x - a.x)) / area,
            least: least(least(a.z, b.z), c.z) as f32,
            most: most(most(a.z, b.z), c.z) as f32,
        }
    }

    /// Returns the inverse depth at the first pixel of a row.
    #[inline(always)]
    fn start(&self, y: f64) -> f64 {
        let at = &self.at;
        at.z + self.by_y * (y - at.y) + self.by_x * (0.5 - at.x)
    }
}

/// The line through an edge, as a bound of the triangle's rows.
struct Side {
    y: f64,
    /// Change of x per row; 0 if the edge is level.
    slope: f64,
    /// x at `y` where the edge bounds rows on that side, else infinitely far outside.
    left: f64,
    right: f64,
}

impl Side {
    /// The triangle is where (to - from) x (p - from) is not negative.
    #[inline(always)]
    fn new(from: &Vector3<f64>, to: &Vector3<f64>) -> Self {
        let rise = to.y - from.y;
        Self {
            y: from.y,
            slope: if rise == 0.0 {
                0.0
            } else {
                (to.x - from.x) / rise
            },
            left: if rise < 0.0 {
                from.x
            } else {
                f64::NEG_INFINITY
            },
            right: if rise > 0.0 { from.x } else { f64::INFINITY },
        }
    }
}

/// Returns the smaller number, `b` if either is not a number: a single instruction, which
/// [`f64::min`] is not.
#[inline(always)]
fn least<T: PartialOrd>(a: T, b: T) -> T {
    if a < b { a } else { b }
}

/// Returns the larger number, `b` if either is not a number.
#[inline(always)]
fn most<T: PartialOrd>(a: T, b: T) -> T {
    if a > b { a } else { b }
}

/// Returns the first pixel whose centre is not below `x`, at most `size`.
#[inline(always)]
fn first_centre(x: f64, size: usize) -> i32 {
    let x = (x - 0.5).max(0.0).min(size as f64);
    let down = x as i32;
    // `ceil` of a number that is not negative, without a call.
    down + i32::from(f64::from(down) < x)
}

/// Returns the pixel after the last whose centre is not above `x`, at most `size`.
#[inline(always)]
fn end_centre(x: f64, size: usize) -> i32 {
    (x + 0.5).max(0.0).min(size as f64) as i32
}
