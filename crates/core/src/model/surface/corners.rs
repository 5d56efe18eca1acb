//! Corner table of a triangle mesh: pairs of corners that face each other across an edge
//! (Rossignac's corner operations).
//!
//! Corner `c = 3 t + i` is at vertex `triangles[t][i]` and faces the edge from `next(c)` to
//! `prev(c)` in the direction of its triangle. Two corners face each other if their triangles share
//! that edge in opposite directions; [`BORDER`] if there is none.

use nalgebra::Vector3;

use super::Surface;

/// Marks an edge without a triangle on the other side.
pub const BORDER: u32 = u32::MAX;

#[inline]
pub fn next(corner: u32) -> u32 {
    if corner % 3 == 2 {
        corner - 2
    } else {
        corner + 1
    }
}

#[inline]
pub fn prev(corner: u32) -> u32 {
    if corner.is_multiple_of(3) {
        corner + 2
    } else {
        corner - 1
    }
}

#[inline]
pub fn vertex(triangles: &[[u32; 3]], corner: u32) -> u32 {
    triangles[corner as usize / 3][corner as usize % 3]
}

/// Returns the next corner at the same vertex, counter-clockwise seen from outside; `None` at a
/// border.
#[inline]
pub fn swing(opposite: &[u32], corner: u32) -> Option<u32> {
    let across = opposite[next(corner) as usize];
    (across != BORDER).then(|| next(across))
}

/// Returns the next corner at the same vertex, clockwise seen from outside; `None` at a border.
#[inline]
pub fn unswing(opposite: &[u32], corner: u32) -> Option<u32> {
    let across = opposite[prev(corner) as usize];
    (across != BORDER).then(|| prev(across))
}

/// Returns the facing corner of each corner. At an edge of more than two triangles, those that
/// enclose the same inside are paired; corners without a partner of opposite direction become a
/// border. Triangles must have three different vertices.
pub fn opposites(surface: &Surface) -> Vec<u32> {
    pair_edges(surface).0
}

/// Also returns, for each edge of more than two triangles, the corners that face it.
fn pair_edges(surface: &Surface) -> (Vec<u32>, Vec<Vec<u32>>) {
    let triangles = &surface.triangles;
    let mut opposite = vec![BORDER; 3 * triangles.len()];
    let (offsets, mut corners) = corners_by_smaller_end(surface.vertices.len(), triangles);
    let (mut edge, mut crowded): (Vec<u32>, Vec<Vec<u32>>) = (Vec::new(), Vec::new());
    for ends in offsets.windows(2) {
        let bucket = &mut corners[ends[0] as usize..ends[1] as usize];
        bucket.sort_unstable();
        for facing in bucket.chunk_by(|a, b| a.0 == b.0) {
            edge.clear();
            edge.extend(facing.iter().map(|corner| corner.1));
            pair_edge(surface, &edge, &mut opposite);
            if edge.len() > 2 {
                crowded.push(edge.clone());
            }
        }
    }
    (opposite, crowded)
}

/// Groups all corners by the smaller vertex of the edge that they face (CSR), each with the larger
/// one.
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

/// Returns whether the triangle runs along the facing edge from its smaller to its larger vertex.
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

/// Pairs at an edge of more than two triangles: about the edge from its smaller to its larger
/// vertex, the inside is clockwise of a forward triangle, which therefore pairs with the backward
/// triangle that precedes it.
fn pair_crowded_edge(surface: &Surface, edge: &[u32], opposite: &mut [u32]) {
    let triangles = &surface.triangles;
    let around = around_edge(surface, edge);
    for i in 0..around.len() {
        let (before, after) = (around[i], around[(i + 1) % around.len()]);
        if is_forward(triangles, after) && !is_forward(triangles, before) {
            opposite[before as usize] = after;
            opposite[after as usize] = before;
        }
    }
}

/// Sorts the corners that face an edge by their angle about it.
fn around_edge(surface: &Surface, edge: &[u32]) -> Vec<u32> {
    let triangles = &surface.triangles;
    let at = |v: u32| surface.vertices[v as usize];
    let from = at(smaller_end(triangles, edge[0]));
    let frame = axis_frame(at(larger_end(triangles, edge[0])) - from);
    let angle = |c: u32| {
        let towards = at(vertex(triangles, c)) - from;
        towards.dot(&frame[1]).atan2(towards.dot(&frame[0]))
    };
    let mut around: Vec<(f64, u32)> = edge.iter().map(|&c| (angle(c), c)).collect();
    around.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    around.into_iter().map(|(_, corner)| corner).collect()
}

/// Returns two unit vectors that form a right-handed frame with the axis.
fn axis_frame(axis: Vector3<f64>) -> [Vector3<f64>; 2] {
    let axis = axis.try_normalize(0.0).unwrap_or(Vector3::z());
    // The least aligned axis: with another one the product could vanish.
    let first = axis.cross(&Vector3::ith(axis.iamin(), 1.0)).normalize();
    [first, axis.cross(&first)]
}

/// Splits vertices so that each fan of triangles has one of its own, and removes unused vertices:
/// an oriented manifold with borders. The first fan, by its smallest corner, keeps the position of
/// the vertex. Triangles must have three different vertices, and no two triangles the same three.
pub fn split_fans(surface: Surface) -> Surface {
    let (mut opposite, crowded) = pair_edges(&surface);
    let Surface {
        kind,
        vertices,
        mut triangles,
    } = surface;
    let (mut owner, mut first) = fans(&opposite);
    if open_doubled_edges(&crowded, &owner, &mut opposite) {
        (owner, first) = fans(&opposite);
    }
    let fan_vertex: Vec<u32> = first.into_iter().map(|c| vertex(&triangles, c)).collect();
    // Existing vertices come first, so that a mesh without double fans keeps its order.
    let mut order: Vec<u32> = (0..fan_vertex.len() as u32).collect();
    order.sort_by_key(|&f| fan_vertex[f as usize]);
    let mut place = vec![0u32; order.len()];
    for (i, &f) in (0..).zip(&order) {
        place[f as usize] = i;
    }
    for (c, fan) in owner.iter().enumerate() {
        triangles[c / 3][c % 3] = place[*fan as usize];
    }
    let position = |&fan: &u32| vertices[fan_vertex[fan as usize] as usize];
    Surface {
        kind,
        vertices: order.iter().map(position).collect(),
        triangles,
    }
}

/// Where sheets touch along an edge and are connected around both its ends, splitting fans would
/// leave the edge with several triangles of one direction. Unpairs such edges, which opens their
/// fans; then no fan has two borders of one direction, and triangles adjacent around both ends are
/// paired by their vertices. Returns whether there were any.
fn open_doubled_edges(crowded: &[Vec<u32>], owner: &[u32], opposite: &mut [u32]) -> bool {
    let directed = |&c: &u32| (owner[next(c) as usize], owner[prev(c) as usize]);
    let mut has_opened = false;
    for edge in crowded {
        let mut ends: Vec<(u32, u32)> = edge.iter().map(directed).collect();
        ends.sort_unstable();
        if ends.windows(2).any(|pair| pair[0] == pair[1]) {
            edge.iter().for_each(|&c| opposite[c as usize] = BORDER);
            has_opened = true;
        }
    }
    has_opened
}

/// Returns the fan of each corner, and the smallest corner of each fan.
fn fans(opposite: &[u32]) -> (Vec<u32>, Vec<u32>) {
    let mut owner = vec![BORDER; opposite.len()];
    let mut first: Vec<u32> = Vec::new();
    for c in 0..owner.len() as u32 {
        if owner[c as usize] == BORDER {
            claim_fan(opposite, c, first.len() as u32, &mut owner);
            first.push(c);
        }
    }
    (owner, first)
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
    use nalgebra::Point3;

    use super::*;
    use crate::model::surface::{SurfaceKind, manifold::check_manifold, shapes};

    fn surface(vertices: &[[f64; 3]], triangles: &[[u32; 3]]) -> Surface {
        Surface {
            kind: SurfaceKind::Mesh,
            vertices: vertices
                .iter()
                .map(|&[x, y, z]| Point3::new(x, y, z))
                .collect(),
            triangles: triangles.to_vec(),
        }
    }

    /// Two tetrahedra that touch along one edge; each keeps its own closed surface.
    #[test]
    fn solids_that_touch_along_an_edge_come_apart() {
        let points = [
            [0., 0., 0.],
            [0., 0., 1.],
            [1., -0.5, 0.5],
            [1., 0.5, 0.5],
            [-1., -0.5, 0.5],
            [-1., 0.5, 0.5],
        ];
        let tetrahedron =
            |a: u32, b: u32, c: u32, d: u32| [[a, c, b], [a, b, d], [b, c, d], [a, d, c]];
        let mut triangles = tetrahedron(0, 1, 2, 3).to_vec();
        triangles.extend(tetrahedron(0, 1, 5, 4));
        let mesh = surface(&points, &triangles);
        let opposite = opposites(&mesh);
        assert!(opposite.iter().all(|&c| c != BORDER));
        assert!(
            opposite
                .iter()
                .enumerate()
                .all(|(a, &b)| (a < 12) == (b < 12)),
            "a pair joins the two solids"
        );
        let apart = split_fans(mesh);
        assert_eq!(apart.vertices.len(), 8);
        assert_eq!(
            check_manifold(&apart).map(|t| (t.euler, t.components)),
            Ok((4, 2))
        );
    }

    /// The outside of a set of unit cubes, two triangles a face.
    fn boundary(cubes: &[[i32; 3]]) -> Surface {
        let mut places: Vec<[i32; 3]> = Vec::new();
        let mut triangles = Vec::new();
        for cube in cubes {
            for (axis, side) in [0, 1, 2]
                .into_iter()
                .flat_map(|axis| [(axis, 0), (axis, 1)])
            {
                let mut beside = *cube;
                beside[axis] += 2 * side - 1;
                if cubes.contains(&beside) {
                    continue;
                }
                let mut face = [[0, 0], [1, 0], [1, 1], [0, 1]].map(|[u, v]| {
                    let mut corner = *cube;
                    corner[axis] += side;
                    corner[(axis + 1) % 3] += u;
                    corner[(axis + 2) % 3] += v;
                    places.iter().position(|p| *p == corner).unwrap_or_else(|| {
                        places.push(corner);
                        places.len() - 1
                    }) as u32
                });
                if side == 0 {
                    face.reverse();
                }
                triangles.extend([[face[0], face[1], face[2]], [face[0], face[2], face[3]]]);
            }
        }
        surface(
            &places.iter().map(|p| p.map(f64::from)).collect::<Vec<_>>(),
            &triangles,
        )
    }

    /// A block without two cubes of its middle layer that touch along a vertical edge: around both
    /// ends of the edge, all four faces are connected through the layers below and above.
    #[test]
    fn sheets_that_touch_along_an_edge_and_hang_together_at_its_ends_come_apart() {
        let floor = |z: i32| [[0, 0, z], [1, 0, z], [0, 1, z], [1, 1, z]];
        let all = [floor(0), floor(1), floor(2)].concat();
        let cubes: Vec<[i32; 3]> = all
            .into_iter()
            .filter(|c| ![[1, 0, 1], [0, 1, 1]].contains(c))
            .collect();
        let block = boundary(&cubes);
        let apart = split_fans(block.clone());
        assert!(apart.vertices.len() > block.vertices.len());
        assert_eq!(
            check_manifold(&apart).map(|t| (t.border_edges, t.components)),
            Ok((0, 1))
        );
        assert_eq!(shapes::volume(&apart), 10.0);
    }

    proptest::proptest! {
        /// Random cubes touch along edges and at corners in every possible way; the result is a
        /// closed manifold of the same triangles.
        #[test]
        fn whatever_cubes_leave_is_a_manifold(cells in proptest::collection::vec(proptest::bool::ANY, 27)) {
            let places = (0..27).map(|i| [i % 3, i / 3 % 3, i / 9]);
            let cubes: Vec<[i32; 3]> = places.zip(cells).filter_map(|(place, is_in)| is_in.then_some(place)).collect();
            let block = boundary(&cubes);
            let apart = split_fans(block.clone());
            let found = check_manifold(&apart);
            proptest::prop_assert!(found.is_ok(), "{found:?}");
            let corners = |s: &Surface| (0..s.triangles.len() as u32).map(|t| s.corners(t)).collect::<Vec<_>>();
            proptest::prop_assert_eq!(corners(&apart), corners(&block));
        }
    }

    #[test]
    fn triangles_of_the_same_direction_do_not_pair() {
        let mesh = surface(
            &[[0., 0., 0.], [1., 0., 0.], [0., 1., 0.], [0., -1., 0.]],
            &[[0, 1, 2], [0, 1, 3]],
        );
        assert!(opposites(&mesh).iter().all(|&c| c == BORDER));
        assert_eq!(split_fans(mesh).vertices.len(), 6);
    }
}
