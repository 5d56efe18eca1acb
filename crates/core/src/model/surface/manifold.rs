//! Validator for tests of a surface: checks for an oriented manifold with borders.

use std::collections::{HashMap, HashSet};

use super::Surface;

/// Global properties of a manifold.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Topology {
    /// Vertices - edges + triangles: 2 for a sphere, 1 for a disc, 0 for a torus or a ring.
    pub euler: i64,
    pub border_edges: usize,
    /// Number of connected components.
    pub components: usize,
}

/// The reason why a surface is not an oriented manifold with borders.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ManifoldError {
    #[error("triangle {triangle} names vertex {vertex} of {vertices}")]
    NoSuchVertex {
        triangle: usize,
        vertex: u32,
        vertices: usize,
    },
    #[error("triangle {0} repeats a vertex")]
    Degenerate(usize),
    #[error("the edge from vertex {0} to {1} has two triangles in the same direction")]
    CrowdedEdge(u32, u32),
    #[error("the triangles about vertex {0} are not one fan")]
    SeveralFans(u32),
    #[error("vertex {0} is not finite or has no triangle")]
    StrayVertex(u32),
}

/// Checks that each directed edge has at most one triangle, that the triangles around each vertex
/// form one fan, and that each vertex is finite and used. Deliberately simple and slow: hash tables
/// of edges.
pub fn check_manifold(surface: &Surface) -> Result<Topology, ManifoldError> {
    let mut edges: HashMap<(u32, u32), usize> = HashMap::new();
    let mut links: Vec<Vec<(u32, u32)>> = vec![Vec::new(); surface.vertices.len()];
    for (t, &[a, b, c]) in surface.triangles.iter().enumerate() {
        check_triangle(surface, t)?;
        for [from, to, apex] in [[a, b, c], [b, c, a], [c, a, b]] {
            if edges.insert((from, to), t).is_some() {
                return Err(ManifoldError::CrowdedEdge(from, to));
            }
            links[apex as usize].push((from, to));
        }
    }
    for (v, link) in links.iter().enumerate() {
        check_vertex(surface, v, link)?;
    }
    Ok(topology(surface, &edges))
}

/// Checks that a vertex is finite and has one fan. `link`: the edges opposite to it.
fn check_vertex(surface: &Surface, v: usize, link: &[(u32, u32)]) -> Result<(), ManifoldError> {
    if link.is_empty() || !surface.vertices[v].coords.iter().all(|x| x.is_finite()) {
        return Err(ManifoldError::StrayVertex(v as u32));
    }
    if !is_one_chain(link) {
        return Err(ManifoldError::SeveralFans(v as u32));
    }
    Ok(())
}

/// Checks that the corners of a triangle exist and differ.
fn check_triangle(surface: &Surface, triangle: usize) -> Result<(), ManifoldError> {
    let (vertices, [a, b, c]) = (surface.vertices.len(), surface.triangles[triangle]);
    if let Some(vertex) = [a, b, c].into_iter().find(|&v| v as usize >= vertices) {
        return Err(ManifoldError::NoSuchVertex {
            triangle,
            vertex,
            vertices,
        });
    }
    if a == b || b == c || c == a {
        return Err(ManifoldError::Degenerate(triangle));
    }
    Ok(())
}

/// `edges`: the triangle of each directed edge.
fn topology(surface: &Surface, edges: &HashMap<(u32, u32), usize>) -> Topology {
    let border_edges = edges
        .keys()
        .filter(|&&(a, b)| !edges.contains_key(&(b, a)))
        .count();
    let undirected = (edges.len() + border_edges) / 2;
    let (vertices, triangles) = (surface.vertices.len(), surface.triangles.len());
    Topology {
        euler: vertices as i64 - undirected as i64 + triangles as i64,
        border_edges,
        components: component_count(triangles, edges),
    }
}

/// Returns whether the directed edges form a single open or closed chain.
fn is_one_chain(link: &[(u32, u32)]) -> bool {
    let next: HashMap<u32, u32> = link.iter().copied().collect();
    let ends: HashSet<u32> = link.iter().map(|e| e.1).collect();
    let mut starts = link.iter().map(|e| e.0).filter(|v| !ends.contains(v));
    let start = starts.next().unwrap_or(link[0].0);
    let (mut at, mut steps) = (start, 0);
    while let Some(&to) = next.get(&at) {
        (at, steps) = (to, steps + 1);
        if at == start || steps > link.len() {
            break;
        }
    }
    steps == link.len() && starts.next().is_none()
}

fn component_count(triangles: usize, edges: &HashMap<(u32, u32), usize>) -> usize {
    let mut parent: Vec<usize> = (0..triangles).collect();
    fn root(parent: &mut [usize], mut t: usize) -> usize {
        while parent[t] != t {
            parent[t] = parent[parent[t]];
            t = parent[t];
        }
        t
    }
    let mut count = triangles;
    for (&(a, b), &t) in edges {
        if let Some(&other) = edges.get(&(b, a)) {
            let (x, y) = (root(&mut parent, t), root(&mut parent, other));
            if x != y {
                parent[x] = y;
                count -= 1;
            }
        }
    }
    count
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::surface::shapes;

    #[test]
    fn known_shapes_have_their_topology() {
        let of = |surface: &Surface| check_manifold(surface).unwrap();
        assert_eq!(
            of(&shapes::sphere(2)),
            Topology {
                euler: 2,
                border_edges: 0,
                components: 1
            }
        );
        assert_eq!(
            of(&shapes::torus(8)),
            Topology {
                euler: 0,
                border_edges: 0,
                components: 1
            }
        );
        assert_eq!(
            of(&shapes::terrain(3, |_, _| 0.0)),
            Topology {
                euler: 1,
                border_edges: 12,
                components: 1
            }
        );
    }

    #[test]
    fn what_is_not_a_manifold_is_named() {
        let mut twice = shapes::sphere(0);
        twice.triangles.push([0, 1, 2]);
        assert_eq!(
            check_manifold(&twice),
            Err(ManifoldError::CrowdedEdge(0, 1))
        );
        let mut bow = shapes::terrain(2, |_, _| 0.0);
        bow.triangles = vec![bow.triangles[0], bow.triangles[6]];
        bow.vertices.truncate(9);
        assert!(check_manifold(&bow).is_err());
        let mut stray = shapes::sphere(0);
        stray.vertices.push(stray.vertices[0]);
        assert_eq!(check_manifold(&stray), Err(ManifoldError::StrayVertex(6)));
        let mut beyond = shapes::sphere(0);
        beyond.triangles[7] = [0, 4, 6];
        assert_eq!(
            check_manifold(&beyond),
            Err(ManifoldError::NoSuchVertex {
                triangle: 7,
                vertex: 6,
                vertices: 6
            })
        );
    }
}
