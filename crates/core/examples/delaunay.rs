//! Triangulates points, for comparison with CGAL and Qhull (`benches/delaunay.py`,
//! `tests/python/test_delaunay.py`).
//!
//! `delaunay POINTS [CELLS]` reads little-endian f64 triples; prints dimension, vertices,
//! finite cells, all cells, seconds; writes the finite cells as little-endian u32 quadruples of
//! indices of points.

use std::time::Instant;

use nalgebra::Point3;
use viewrank_core::{base::progress::NoWatcher, method::surface::delaunay::Delaunay};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let Some(path) = arguments.next() else {
        return Err("usage: delaunay POINTS [CELLS]".into());
    };
    let coordinates: Vec<f64> = bytemuck::pod_collect_to_vec(&std::fs::read(path)?);
    let points: Vec<Point3<f64>> = coordinates
        .chunks_exact(3)
        .map(|p| Point3::new(p[0], p[1], p[2]))
        .collect();
    drop(coordinates);
    let start = Instant::now();
    let delaunay = Delaunay::triangulate(&points, &NoWatcher)?;
    let seconds = start.elapsed().as_secs_f64();
    let finite = (0..delaunay.cells.len() as u32).filter(|&cell| !delaunay.is_infinite(cell));
    let dimension = delaunay.dimension as usize;
    println!(
        "{dimension} {} {} {} {seconds:.3}",
        delaunay.vertex_count(),
        finite.clone().count(),
        delaunay.cells.len()
    );
    if let Some(path) = arguments.next() {
        let mut point_of_vertex = vec![0u32; delaunay.vertex_count()];
        for (point, &vertex) in delaunay.vertex_of_point.iter().enumerate() {
            point_of_vertex[vertex as usize] = point as u32;
        }
        let corners = finite.flat_map(|cell| delaunay.cells[cell as usize].vertices);
        let cells: Vec<u32> = corners
            .map(|vertex| point_of_vertex[vertex as usize])
            .collect();
        std::fs::write(path, bytemuck::cast_slice(&cells))?;
    }
    Ok(())
}
