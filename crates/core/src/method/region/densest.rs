//! `auto`: the box around the part of the surface with the most pixels per area.
//!
//! The density of a triangle is the number of its pixels in all views divided by its area: high for
//! a subject that the cameras surround, low for the background and the border of a flight.
//! Triangles in descending order of density are cut where their share of the pixels, m, exceeds
//! their share of the area, a, most significantly (largest `m ln(m / a) + (1 - m) ln((1 - m) / (1 -
//! a))`, the statistic of Kulldorff's scan, 1997). Triangles down to a quarter of the density at
//! the cut are included. The box holds all but the outermost pixels of these along each axis, plus
//! a margin.

use rayon::prelude::*;

use crate::model::surface::Surface;

/// Minimum density of an included triangle, relative to the sparsest triangle of the core: half the
/// resolution.
const SURROUNDINGS: f64 = 0.25;
/// Share of the pixels that the box excludes at each of its six sides; enough to drop a single
/// stray triangle.
const STRAY: f64 = 0.005;
/// Margin at each side, relative to the length of that side.
const MARGIN: f64 = 0.05;

/// Returns the corners of the box, world coordinates; `None` if no view shows any area. `pixels`:
/// number per triangle, over all views.
pub fn densest(surface: &Surface, pixels: &[f64]) -> Option<[f64; 6]> {
    let mut core = with_surroundings(surface, pixels)?;
    let mut corners = [0.0; 6];
    for axis in 0..3 {
        let [low, high] = range_along(axis, surface, &mut core, pixels);
        let margin = MARGIN * (high - low);
        (corners[axis], corners[axis + 3]) = (low - margin, high + margin);
    }
    Some(corners)
}

/// Returns the triangles of the core and those around it, densest first.
fn with_surroundings(surface: &Surface, pixels: &[f64]) -> Option<Vec<u32>> {
    let triangles = 0..surface.triangles.len() as u32;
    let areas: Vec<f64> = triangles.clone().map(|t| surface.area(t)).collect();
    let density = |t: u32| pixels[t as usize] / areas[t as usize];
    let mut order: Vec<u32> = triangles
        .filter(|&t| areas[t as usize] > 0.0 && density(t) > 0.0)
        .collect();
    // Ties by number: the threads of an unstable sort must not decide them.
    order.par_sort_unstable_by(|&a, &b| density(b).total_cmp(&density(a)).then(a.cmp(&b)));
    let least = SURROUNDINGS * density(*order.get(core(&order, pixels, &areas)?)?);
    order.truncate(order.partition_point(|&t| density(t) >= least));
    Some(order)
}

/// Returns the range of some triangles along an axis, without strays; sorts them along it.
fn range_along(axis: usize, surface: &Surface, list: &mut [u32], pixels: &[f64]) -> [f64; 2] {
    let places: Vec<f64> = (0..surface.triangles.len() as u32)
        .into_par_iter()
        .map(|t| surface.centroid(t)[axis])
        .collect();
    let place = |t: u32| places[t as usize];
    list.par_sort_unstable_by(|&a, &b| place(a).total_cmp(&place(b)).then(a.cmp(&b)));
    within(list, pixels).map(place)
}

/// Returns the position in `order` of the sparsest triangle of the core.
fn core(order: &[u32], pixels: &[f64], areas: &[f64]) -> Option<usize> {
    let sum = |of: &[f64]| order.iter().map(|&t| of[t as usize]).sum::<f64>();
    let [all_pixels, all_area] = [sum(pixels), sum(areas)];
    let (mut best, mut m, mut a) = ((0.0, order.len().checked_sub(1)?), 0.0, 0.0);
    for (i, &t) in order.iter().enumerate() {
        m += pixels[t as usize] / all_pixels;
        a += areas[t as usize] / all_area;
        let contrast = m * (m / a).ln() + (1.0 - m) * ((1.0 - m) / (1.0 - a)).ln();
        // NaN at the end, where both shares are 1.
        if m < 1.0 && a < 1.0 && contrast > best.0 {
            best = (contrast, i);
        }
    }
    Some(best.1)
}

/// Returns the first and the last triangle along the list that are not strays.
fn within(list: &[u32], pixels: &[f64]) -> [u32; 2] {
    let stray = STRAY * list.iter().map(|&t| pixels[t as usize]).sum::<f64>();
    let first = |list: &mut dyn Iterator<Item = &u32>| {
        let mut sum = 0.0;
        list.copied().find(|&t| {
            sum += pixels[t as usize];
            sum > stray
        })
    };
    let ends = [first(&mut list.iter()), first(&mut list.iter().rev())];
    ends.map(|end| end.unwrap_or(list[0]))
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;

    use super::*;
    use crate::model::surface::SurfaceKind;

    /// Squares of this side along a grid of n x n on the ground, each of two triangles.
    fn ground(n: u32, side: f64) -> Surface {
        let vertices = (0..(n + 1) * (n + 1)).map(|i| {
            Point3::new(
                f64::from(i % (n + 1)) * side,
                f64::from(i / (n + 1)) * side,
                0.0,
            )
        });
        let square = |i: u32| {
            let a = i / n * (n + 1) + i % n;
            [[a, a + 1, a + n + 2], [a, a + n + 2, a + n + 1]]
        };
        Surface {
            kind: SurfaceKind::Mesh,
            vertices: vertices.collect(),
            triangles: (0..n * n).flat_map(square).collect(),
        }
    }

    #[test]
    fn a_subject_is_taken_and_stray_triangles_are_not() {
        let surface = ground(60, 1.0);
        let subject = |p: Point3<f64>| (20.0..30.0).contains(&p.x) && (35.0..40.0).contains(&p.y);
        let mut pixels: Vec<f64> = (0..7200)
            .map(|t| {
                if subject(surface.centroid(t)) {
                    400.0
                } else {
                    4.0
                }
            })
            .collect();
        pixels[0] = 150.0;
        let [x0, y0, _, x1, y1, _] = densest(&surface, &pixels).unwrap();
        assert!(
            (19.0..=20.4).contains(&x0) && (29.6..=31.0).contains(&x1),
            "{x0} {x1}"
        );
        assert!(
            (34.0..=35.4).contains(&y0) && (39.6..=41.0).contains(&y1),
            "{y0} {y1}"
        );
    }

    #[test]
    fn where_all_is_shown_alike_all_is_taken() {
        let surface = ground(40, 0.5);
        let [x0, y0, _, x1, y1, _] = densest(&surface, &[3.0; 3200]).unwrap();
        assert!(
            x0 < 0.3 && y0 < 0.3 && x1 > 19.7 && y1 > 19.7,
            "{x0} {y0} {x1} {y1}"
        );
        assert_eq!(densest(&surface, &[0.0; 3200]), None);
    }
}
