//! The surface divided into small patches of neighbouring triangles, so that each view processes
//! only those in its field.

use std::ops::Range;

use nalgebra::Point3;

use crate::model::surface::Surface;

/// Triangles per patch: few enough to cull tightly, enough to make culling cheap.
const PATCH_TRIANGLES: usize = 128;

/// Neighbouring triangles, with their own copies of the vertices.
#[derive(Clone, Debug)]
pub struct Patch {
    /// Bounding sphere: centre and radius.
    pub centre: Point3<f64>,
    pub radius: f64,
    vertices: Range<usize>,
    triangles: Range<usize>,
}

impl Patch {
    /// Range of its triangles.
    pub fn len(&self) -> usize {
        self.triangles.len()
    }
}

/// All patches of a surface; each triangle is in one.
pub struct Patches {
    pub patches: Vec<Patch>,
    vertices: Vec<Point3<f64>>,
    /// Corners, as indices into the patch's vertices.
    corners: Vec<[u16; 3]>,
    /// Indices of the triangles in the surface.
    triangles: Vec<u32>,
}

impl Patches {
    pub fn new(surface: &Surface) -> Self {
        let triangles = spatial_order(surface);
        let mut all = Self {
            patches: Vec::with_capacity(triangles.len().div_ceil(PATCH_TRIANGLES)),
            vertices: Vec::new(),
            corners: Vec::with_capacity(triangles.len()),
            triangles: Vec::new(),
        };
        for chunk in triangles.chunks(PATCH_TRIANGLES) {
            all.add(surface, chunk);
        }
        all.triangles = triangles;
        all
    }

    /// Number of triangles of all patches.
    pub fn triangle_count(&self) -> usize {
        self.triangles.len()
    }

    pub fn vertices(&self, patch: &Patch) -> &[Point3<f64>] {
        &self.vertices[patch.vertices.clone()]
    }

    /// Returns each triangle of the patch: its index in the surface, and its corners.
    pub fn triangles(&self, patch: &Patch) -> impl Iterator<Item = (u32, [usize; 3])> {
        let rows = patch.triangles.clone();
        let corners = self.corners[rows.clone()]
            .iter()
            .map(|c| c.map(usize::from));
        self.triangles[rows].iter().copied().zip(corners)
    }

    /// Returns the indices of the patch's triangles in the surface.
    pub fn triangle_indices(&self, patch: &Patch) -> &[u32] {
        &self.triangles[patch.triangles.clone()]
    }

    fn add(&mut self, surface: &Surface, chunk: &[u32]) {
        let used = vertices_of(surface, chunk);
        // Fits u16: at most 384 vertices, three per triangle.
        let local = |v: u32| used.partition_point(|&u| u < v) as u16;
        let corners = chunk
            .iter()
            .map(|&t| surface.triangles[t as usize].map(local));
        let (first_vertex, first_triangle) = (self.vertices.len(), self.corners.len());
        self.corners.extend(corners);
        self.vertices
            // Copied, so that a view reads the vertices of a patch in one piece.
            .extend(used.iter().map(|&v| surface.vertices[v as usize]));
        let own = &self.vertices[first_vertex..];
        let (low, high) = bounds(own.iter());
        let centre = nalgebra::center(&low, &high);
        self.patches.push(Patch {
            centre,
            radius: own.iter().map(|v| (v - centre).norm()).fold(0.0, f64::max),
            vertices: first_vertex..self.vertices.len(),
            triangles: first_triangle..self.corners.len(),
        });
    }
}

/// Returns the vertices of some triangles, ascending.
fn vertices_of(surface: &Surface, triangles: &[u32]) -> Vec<u32> {
    let corners = triangles
        .iter()
        .flat_map(|&t| surface.triangles[t as usize]);
    let mut vertices: Vec<u32> = corners.collect();
    vertices.sort_unstable();
    vertices.dedup();
    vertices
}

/// Sorts the triangles along a Morton curve through their first corners.
fn spatial_order(surface: &Surface) -> Vec<u32> {
    let (low, high) = bounds(surface.vertices.iter());
    let longest = (high - low).max().max(f64::MIN_POSITIVE);
    let cell =
        |v: &Point3<f64>| (v - low).map(|d| (d / longest * f64::from((1u32 << 21) - 1)) as u64);
    let code = |t: &[u32; 3]| {
        let cell = cell(&surface.vertices[t[0] as usize]);
        spread(cell.x) | spread(cell.y) << 1 | spread(cell.z) << 2
    };
    let mut keyed: Vec<(u64, u32)> = surface
        .triangles
        .iter()
        .zip(0..)
        .map(|(t, i)| (code(t), i))
        .collect();
    keyed.sort_unstable();
    keyed.into_iter().map(|(_, t)| t).collect()
}

/// Spreads the lowest 21 bits, each followed by two zeros.
fn spread(x: u64) -> u64 {
    let x = (x | x << 32) & 0x001f_0000_0000_ffff;
    let x = (x | x << 16) & 0x001f_0000_ff00_00ff;
    let x = (x | x << 8) & 0x100f_00f0_0f00_f00f;
    let x = (x | x << 4) & 0x10c3_0c30_c30c_30c3;
    (x | x << 2) & 0x1249_2492_4924_9249
}

fn bounds<'a>(points: impl Iterator<Item = &'a Point3<f64>>) -> (Point3<f64>, Point3<f64>) {
    let none = (
        Point3::from([f64::INFINITY; 3]),
        Point3::from([f64::NEG_INFINITY; 3]),
    );
    points.fold(none, |(low, high), p| (low.inf(p), high.sup(p)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::surface::SurfaceKind;

    #[test]
    fn patches_hold_every_triangle_once() {
        let n = 40;
        let vertices = (0..n * n)
            .map(|i| Point3::new((i % n) as f64, (i / n) as f64, ((i * 7) % 5) as f64))
            .collect();
        let quad = |i: usize| (i / (n - 1) * n + i % (n - 1)) as u32;
        let triangles: Vec<[u32; 3]> = (0..(n - 1) * (n - 1))
            .map(quad)
            .flat_map(|a| [[a, a + 1, a + 41], [a, a + 41, a + 40]])
            .collect();
        let surface = Surface {
            kind: SurfaceKind::Mesh,
            vertices,
            triangles,
        };
        let patches = Patches::new(&surface);
        let mut seen = vec![0; surface.triangles.len()];
        for patch in &patches.patches {
            let vertices = patches.vertices(patch);
            assert!(
                vertices
                    .iter()
                    .all(|v| (v - patch.centre).norm() <= patch.radius)
            );
            for (t, corners) in patches.triangles(patch) {
                assert_eq!(corners.map(|c| vertices[c]), surface.corners(t));
                seen[t as usize] += 1;
            }
        }
        assert!(seen.iter().all(|&s| s == 1));
    }
}
