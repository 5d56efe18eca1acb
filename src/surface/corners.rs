//! The corner table of a triangle mesh: which corner faces which across an edge (Rossignac's corner operations).
//!
//! Corner `c = 3 t + i` stands at vertex `triangles[t][i]` and faces the edge from `next(c)` to `prev(c)` in the direction of its
//! triangle. Two corners face each other when their triangles share that edge with opposite directions; [`BORDER`] where none does.

use nalgebra::{Point3, Vector3};

use super::Surface;

/// No triangle on the other side of the edge.
pub const BORDER: u32 = u32::MAX;

#[inline]
pub fn next(corner: u32) -> u32 {
    if corner % 3 == 2 { corner - 2 } else { corner + 1 }
}

#[inline]
pub fn prev(corner: u32) -> u32 {
    if corner.is_multiple_of(3) { corner + 2 } else { corner - 1 }
}

#[inline]
pub fn vertex(triangles: &[[u32; 3]], corner: u32) -> u32 {
    triangles[corner as usize / 3][corner as usize % 3]
}

/// The next corner at the same vertex, counter-clockwise seen from outside; `None` at a border.
#[inline]
pub fn swing(opposite: &[u32], corner: u32) -> Option<u32> {
    let across = opposite[next(corner) as usize];
    (across != BORDER).then(|| next(across))
}

/// The next corner at the same vertex, clockwise seen from outside; `None` at a border.
#[inline]
pub fn unswing(opposite: &[u32], corner: u32) -> Option<u32> {
    let across = opposite[prev(corner) as usize];
    (across != BORDER).then(|| prev(across))
}

/// The facing corner of each corner. At an edge of more than two triangles those pair that enclose the same inside; what finds
/// no partner of opposite direction becomes a border. Triangles must have three different vertices.
pub fn opposites(surface: &Surface) -> Vec<u32> {
    let triangles = &surface.triangles;
    let mut opposite = vec![BORDER; 3 * triangles.len()];
    let (offsets, mut corners) = corners_by_smaller_end(surface.vertices.len(), triangles);
    let mut edge: Vec<u32> = Vec::new();
    for ends in offsets.windows(2) {
        let bucket = &mut corners[ends[0] as usize..ends[1] as usize];
        bucket.sort_unstable();
        for facing in bucket.chunk_by(|a, b| a.0 == b.0) {
            edge.clear();
            edge.extend(facing.iter().map(|corner| corner.1));
            pair_edge(surface, &edge, &mut opposite);
        }
    }
    opposite
}

/// All corners grouped by the smaller vertex of the edge that they face (CSR), each behind the larger one.
fn corners_by_smaller_end(vertices: usize, triangles: &[[u32; 3]]) -> (Vec<u32>, Vec<(u32, u32)>) {
    let corner_count = 3 * triangles.len() as u32;
    let mut offsets = vec![0u32; vertices + 1];
    for c in 0..corner_count {
        offsets[smaller_end(triangles, c) as usize + 1] += 1;
    }
    for v in 0..vertices {
        offsets[v + 1] += offsets[v];
    }
    let mut fill = offsets.clone();
    let mut corners = vec![(0u32, 0u32); corner_count as usize];
    for c in 0..corner_count {
        let slot = &mut fill[smaller_end(triangles, c) as usize];
        corners[*slot as usize] = (larger_end(triangles, c), c);
        *slot += 1;
    }
    (offsets, corners)
}

fn smaller_end(triangles: &[[u32; 3]], corner: u32) -> u32 {
    vertex(triangles, next(corner)).min(vertex(triangles, prev(corner)))
}

fn larger_end(triangles: &[[u32; 3]], corner: u32) -> u32 {
    vertex(triangles, next(corner)).max(vertex(triangles, prev(corner)))
}

/// Does the triangle run along the facing edge from its smaller to its larger vertex?
fn is_forward(triangles: &[[u32; 3]], corner: u32) -> bool {
    vertex(triangles, next(corner)) < vertex(triangles, prev(corner))
}

/// Pairs the corners that face one edge.
fn pair_edge(surface: &Surface, edge: &[u32], opposite: &mut [u32]) {
    match *edge {
        [_] => {}
        [a, b] => {
            if is_forward(&surface.triangles, a) != is_forward(&surface.triangles, b) {
                opposite[a as usize] = b;
                opposite[b as usize] = a;
            }
        }
        _ => pair_crowded_edge(surface, edge, opposite),
    }
}

/// An edge of more than two triangles: about the edge from its smaller to its larger vertex, the inside lies clockwise of a
/// forward triangle, so it pairs with the backward triangle that comes before it.
fn pair_crowded_edge(surface: &Surface, edge: &[u32], opposite: &mut [u32]) {
    let triangles = &surface.triangles;
    let from = surface.vertices[smaller_end(triangles, edge[0]) as usize];
    let to = surface.vertices[larger_end(triangles, edge[0]) as usize];
    let frame = axis_frame(to - from);
    let angle = |c: u32| {
        let towards: Vector3<f64> = surface.vertices[vertex(triangles, c) as usize] - Point3::from(from.coords);
        towards.dot(&frame[1]).atan2(towards.dot(&frame[0]))
    };
    let mut around: Vec<(f64, u32)> = edge.iter().map(|&c| (angle(c), c)).collect();
    around.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    for i in 0..around.len() {
        let (before, after) = (around[i].1, around[(i + 1) % around.len()].1);
        if is_forward(triangles, after) && !is_forward(triangles, before) {
            opposite[before as usize] = after;
            opposite[after as usize] = before;
        }
    }
}

/// Two unit vectors that make a right-handed frame with the axis.
fn axis_frame(axis: Vector3<f64>) -> [Vector3<f64>; 2] {
    let axis = axis.try_normalize(0.0).unwrap_or(Vector3::z());
    let first = axis.cross(&Vector3::ith(axis.iamin(), 1.0)).normalize();
    [first, axis.cross(&first)]
}

/// Gives each fan of triangles about a vertex a vertex of its own, and drops vertices that no triangle uses. The first fan, by
/// its smallest corner, comes where the vertex was.
pub fn split_fans(surface: Surface, opposite: &[u32]) -> Surface {
    let Surface { kind, vertices, mut triangles } = surface;
    let mut owner: Vec<u32> = vec![BORDER; 3 * triangles.len()];
    let mut fan_vertex: Vec<u32> = Vec::with_capacity(vertices.len());
    for c in 0..owner.len() as u32 {
        if owner[c as usize] == BORDER {
            claim_fan(opposite, c, fan_vertex.len() as u32, &mut owner);
            fan_vertex.push(vertex(&triangles, c));
        }
    }
    // Old order of vertices first, so that a mesh without double fans keeps the order that it came in.
    let mut order: Vec<u32> = (0..fan_vertex.len() as u32).collect();
    order.sort_by_key(|&f| fan_vertex[f as usize]);
    let mut place = vec![0u32; order.len()];
    order.iter().enumerate().for_each(|(i, &f)| place[f as usize] = i as u32);
    for (c, fan) in owner.iter().enumerate() {
        triangles[c / 3][c % 3] = place[*fan as usize];
    }
    let vertices = order.iter().map(|&f| vertices[fan_vertex[f as usize] as usize]).collect();
    Surface { kind, vertices, triangles }
}

fn claim_fan(opposite: &[u32], start: u32, fan: u32, owner: &mut [u32]) {
    let mut corner = start;
    loop {
        owner[corner as usize] = fan;
        match swing(opposite, corner) {
            Some(c) if c == start => return,
            Some(c) => corner = c,
            None => break,
        }
    }
    corner = start;
    while let Some(c) = unswing(opposite, corner) {
        owner[c as usize] = fan;
        corner = c;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::SurfaceKind;

    fn surface(vertices: &[[f64; 3]], triangles: &[[u32; 3]]) -> Surface {
        Surface {
            kind: SurfaceKind::Mesh,
            vertices: vertices.iter().map(|&[x, y, z]| Point3::new(x, y, z)).collect(),
            triangles: triangles.to_vec(),
        }
    }

    /// Two tetrahedra that touch along one edge: each keeps its own closed surface.
    #[test]
    fn solids_that_touch_along_an_edge_come_apart() {
        let points = [[0., 0., 0.], [0., 0., 1.], [1., -0.5, 0.5], [1., 0.5, 0.5], [-1., -0.5, 0.5], [-1., 0.5, 0.5]];
        let tetrahedron = |a: u32, b: u32, c: u32, d: u32| [[a, c, b], [a, b, d], [b, c, d], [a, d, c]];
        let mut triangles = tetrahedron(0, 1, 2, 3).to_vec();
        triangles.extend(tetrahedron(0, 1, 5, 4));
        let mesh = surface(&points, &triangles);
        let opposite = opposites(&mesh);
        assert!(opposite.iter().all(|&c| c != BORDER));
        assert!(opposite.iter().enumerate().all(|(a, &b)| (a < 12) == (b < 12)), "a pair joins the two solids");
        assert_eq!(split_fans(mesh, &opposite).vertices.len(), 8);
    }

    #[test]
    fn triangles_of_the_same_direction_do_not_pair() {
        let mesh = surface(&[[0., 0., 0.], [1., 0., 0.], [0., 1., 0.], [0., -1., 0.]], &[[0, 1, 2], [0, 1, 3]]);
        assert!(opposites(&mesh).iter().all(|&c| c == BORDER));
        assert_eq!(split_fans(mesh.clone(), &opposites(&mesh)).vertices.len(), 6);
    }
}
