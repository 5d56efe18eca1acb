//! The Rust side of `benches/delaunay.py`: triangulates a file of little-endian f64 triples.
//! Prints dimension, vertices, finite cells, all cells, seconds.

use nalgebra::Point3;
use std::time::Instant;
use viewrank::progress::Unwatched;
use viewrank::surface::delaunay::Delaunay;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    // `cargo bench` adds options of its own.
    let Some(path) = std::env::args().skip(1).find(|argument| !argument.starts_with("--")) else {
        eprintln!("usage: delaunay POINTS; benches/delaunay.py makes the points and compares with CGAL");
        return Ok(());
    };
    let coordinates: Vec<f64> = bytemuck::pod_collect_to_vec(&std::fs::read(path)?);
    let points: Vec<Point3<f64>> = coordinates.chunks_exact(3).map(|p| Point3::new(p[0], p[1], p[2])).collect();
    drop(coordinates);
    let start = Instant::now();
    let delaunay = Delaunay::triangulate(&points, &Unwatched)?;
    let seconds = start.elapsed().as_secs_f64();
    let all = delaunay.cells.len() as u32;
    let finite = (0..all).filter(|&cell| !delaunay.is_infinite(cell)).count();
    let dimension = delaunay.dimension as usize;
    println!("{dimension} {} {finite} {all} {seconds:.3}", delaunay.vertex_count());
    Ok(())
}
