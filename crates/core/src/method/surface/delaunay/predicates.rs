//! Exact signs of determinants of grid coordinates.
//!
//! Differences of coordinates are below 2^30 (exact in f64), 2 x 2 minors and squared lengths below
//! 2^62 (exact in i64), 3 x 3 minors below 2^93 (exact in i128). f64 decides if the determinant
//! exceeds its error bound, integers otherwise; the determinant of the sphere, below 2^157, is the
//! only one that does not fit a built-in type.

use super::grid::Site;
use std::cmp::Ordering;

/// Bound of the rounding error of [`orient`] in f64: 2 x 2 minors below 2^61 are off by at most
/// 2^9; that times 2^30, and the rounding of three products below 2^91 and of their sums, stays
/// below 2^43.
const ORIENT_ERROR: f64 = (1u64 << 43) as f64;

/// Square of the relative error bound of [`in_sphere`]: with u = 2^-53 and M the largest distance
/// to the query, 2 x 2 minors are off by 2 u M², 3 x 3 minors by 14 u M³, the four products by 18 u
/// M⁵ each and their sum by 80 u M⁵; the bound is 128 u. The root of the sum of the squared
/// distances stands for M.
const IN_SPHERE_ERROR_SQUARED: f64 = 1.0 / (1u128 << 92) as f64;

type Vector = [f64; 3];

#[inline(always)]
pub(super) fn difference(a: &Site, b: &Site) -> Vector {
    [
        f64::from(a.x - b.x),
        f64::from(a.y - b.y),
        f64::from(a.z - b.z),
    ]
}

#[inline(always)]
fn integer_difference(a: &Site, b: &Site) -> [i64; 3] {
    [
        i64::from(a.x - b.x),
        i64::from(a.y - b.y),
        i64::from(a.z - b.z),
    ]
}

#[inline(always)]
pub(super) fn cross(a: &[i64; 3], b: &[i64; 3]) -> [i64; 3] {
    [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
}

#[inline(always)]
pub(super) fn wide_dot(a: &[i64; 3], b: &[i64; 3]) -> i128 {
    i128::from(a[0]) * i128::from(b[0])
        + i128::from(a[1]) * i128::from(b[1])
        + i128::from(a[2]) * i128::from(b[2])
}

#[inline(always)]
fn sign(value: i128) -> i32 {
    value.signum() as i32
}

/// Returns the sign of det(b − a, c − a, d − a): positive if d is on the side of the normal of the
/// counter-clockwise triangle abc.
#[inline(always)]
pub(super) fn orient(a: &Site, b: &Site, c: &Site, d: &Site) -> i32 {
    let [ax, ay, az] = difference(a, d);
    let [bx, by, bz] = difference(b, d);
    let [cx, cy, cz] = difference(c, d);
    let det = ax * (cy * bz - by * cz) + ay * (bx * cz - cx * bz) + az * (cx * by - bx * cy);
    if det > ORIENT_ERROR {
        1
    } else if det < -ORIENT_ERROR {
        -1
    } else {
        orient_exact(a, b, c, d)
    }
}

#[cold]
#[inline(never)]
fn orient_exact(a: &Site, b: &Site, c: &Site, d: &Site) -> i32 {
    let (b, c, d) = (
        integer_difference(b, a),
        integer_difference(c, a),
        integer_difference(d, a),
    );
    sign(wide_dot(&d, &cross(&b, &c)))
}

/// Returns whether p is inside the circumsphere of the positively oriented cell. Ties are broken by
/// raising the squared norms of the points by infinitesimals that grow with lexicographic order:
/// the answers for all cells are consistent and independent of the order of insertion (Devillers,
/// Teillaud 2003).
#[inline(always)]
pub(super) fn in_sphere(cell: [&Site; 4], p: &Site) -> bool {
    let [a, b, c, d] = cell;
    let [ax, ay, az] = difference(a, p);
    let [bx, by, bz] = difference(b, p);
    let [cx, cy, cz] = difference(c, p);
    let [dx, dy, dz] = difference(d, p);
    let ab = ax * by - bx * ay;
    let bc = bx * cy - cx * by;
    let cd = cx * dy - dx * cy;
    let da = dx * ay - ax * dy;
    let ac = ax * cy - cx * ay;
    let bd = bx * dy - dx * by;
    let abc = az * bc - bz * ac + cz * ab;
    let bcd = bz * cd - cz * bd + dz * bc;
    let cda = cz * da + dz * ac + az * cd;
    let dab = dz * ab + az * bd + bz * da;
    let a2 = ax * ax + ay * ay + az * az;
    let b2 = bx * bx + by * by + bz * bz;
    let c2 = cx * cx + cy * cy + cz * cz;
    let d2 = dx * dx + dy * dy + dz * dz;
    let det = (a2 * bcd - b2 * cda) + (c2 * dab - d2 * abc);
    let reach = (a2 + b2) + (c2 + d2);
    if det * det > IN_SPHERE_ERROR_SQUARED * (reach * reach) * (reach * reach) * reach {
        det > 0.0
    } else {
        in_sphere_exact(cell, p)
    }
}

#[cold]
#[inline(never)]
fn in_sphere_exact(cell: [&Site; 4], p: &Site) -> bool {
    let [a, b, c, d] = cell.map(|v| integer_difference(v, p));
    let (ab, cd) = (cross(&a, &b), cross(&c, &d));
    let minors = [
        wide_dot(&b, &cd),
        -wide_dot(&a, &cd),
        wide_dot(&d, &ab),
        -wide_dot(&c, &ab),
    ];
    let squares = [a, b, c, d].map(|v| i128::from(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]));
    match sign_of_dot(&squares, &minors) {
        0 => in_perturbed_sphere(cell, p),
        sign => sign > 0,
    }
}

/// Returns the sign of Σ a b for 0 ≤ a < 2^62 and |b| < 2^93: with b = high · 2^64 + low, both sums
/// fit.
fn sign_of_dot(a: &[i128; 4], b: &[i128; 4]) -> i32 {
    const LOW: i128 = u64::MAX as i128;
    let (mut high, mut low) = (0, 0);
    for (a, b) in a.iter().zip(b) {
        let lower = a * (b & LOW);
        high += a * (b >> 64) + (lower >> 64);
        low += lower & LOW;
    }
    match sign(high + (low >> 64)) {
        0 => sign(low & LOW),
        sign => sign,
    }
}

/// Cospherical case: the point with the largest rank decides. Raising p moves it out of the sphere;
/// raising a vertex lifts the sphere over p if p's barycentric coordinate for that vertex is
/// positive, and lowers it if negative.
fn in_perturbed_sphere(cell: [&Site; 4], p: &Site) -> bool {
    let mut by_rank: [usize; 4] = [0, 1, 2, 3];
    by_rank.sort_unstable_by(|&i, &j| rank(cell[j], cell[i]));
    for i in by_rank {
        if rank(cell[i], p) == Ordering::Less {
            return false;
        }
        let mut replaced = cell;
        replaced[i] = p;
        let [a, b, c, d] = replaced;
        match orient(a, b, c, d) {
            0 => {}
            sign => return sign > 0,
        }
    }
    // Unreachable: the four barycentric coordinates add up to 1.
    false
}

fn rank(a: &Site, b: &Site) -> Ordering {
    a.coordinates().cmp(&b.coordinates())
}

/// Returns whether three sites are collinear.
pub(super) fn collinear(a: &Site, b: &Site, c: &Site) -> bool {
    cross(&integer_difference(b, a), &integer_difference(c, a)) == [0; 3]
}
