use nalgebra::Point3;
use std::time::Instant;
use viewrank::progress::Unwatched;
use viewrank::surface::cut::*;
use viewrank::surface::delaunay::*;
fn cpu() -> f64 {
    unsafe {
        let mut t: libc::timespec = std::mem::zeroed();
        libc::clock_gettime(libc::CLOCK_PROCESS_CPUTIME_ID, &mut t);
        t.tv_sec as f64 + t.tv_nsec as f64 * 1e-9
    }
}
fn main() {
    let path = std::env::args().nth(1).unwrap();
    let limit: usize = std::env::args().nth(2).map_or(1000, |v| v.parse().unwrap());
    let mut t = cpu();
    let mut lap = |what: &str| {
        let n = cpu();
        println!("{what:20} {:.2}", n - t);
        t = n;
    };
    let scene = viewrank::project::Project::open(std::path::Path::new(&path), None).unwrap().read_scene().unwrap();
    lap("read");
    let d = Delaunay::triangulate(&scene.points, &Unwatched).unwrap();
    println!("{} vertices {} cells", d.vertex_count(), d.cells.len());
    lap("delaunay");
    let mut capacities = vec![Capacities::default(); d.cells.len()];
    let unit = 1024.0;
    let sigma: f64 = 0.05;
    let centres: Vec<Point3<f64>> = scene.views.iter().map(|v| v.cam_from_world.centre()).collect();
    let mut point_of_vertex = vec![u32::MAX; d.vertex_count()];
    for (p, &v) in d.vertex_of_point.iter().enumerate() {
        point_of_vertex[v as usize] = p as u32;
    }
    let (mut rays, mut steps) = (0u64, 0u64);
    let start = Instant::now();
    for v in 0..d.vertex_count() as u32 {
        let views = scene.track_views(viewrank::scene::PointIndex(point_of_vertex[v as usize]));
        let p = d.position(v);
        let mut ray: Option<Ray> = None;
        let mut behind: Option<Ray> = None;
        for &view in views.iter().take(limit) {
            let c = centres[view.at()];
            match &mut ray {
                None => ray = Some(d.ray(v, &c)),
                Some(r) => r.aim(&c),
            }
            let r = ray.as_mut().unwrap();
            rays += 1;
            let length = (c - p).norm();
            for crossing in r.by_ref() {
                steps += 1;
                let back = d.neighbour(crossing.facet);
                let dist = crossing.t * length;
                let w = if dist > 4.0 * sigma {
                    unit as u32
                } else {
                    (unit * (1.0 - (-dist * dist / (2.0 * sigma * sigma)).exp())) as u32
                };
                capacities[back.cell() as usize].facets[back.index()] += w;
            }
            capacities[r.cell() as usize].source += unit as u32;
            let q = p + (p - c) * (3.0 * sigma / length);
            match &mut behind {
                None => behind = Some(d.ray(v, &q)),
                Some(r) => r.aim(&q),
            }
            let r = behind.as_mut().unwrap();
            for _ in r.by_ref() {}
            capacities[r.cell() as usize].sink += unit as u32;
        }
    }
    println!(
        "{rays} rays {steps} steps {:.1} per ray, wall {:.2}",
        steps as f64 / rays as f64,
        start.elapsed().as_secs_f64()
    );
    lap("rays");
    for c in &mut capacities {
        for f in &mut c.facets {
            *f += (0.5 * unit) as u32;
        }
    }
    let cut = minimum_cut(&d.cells, &capacities, &Unwatched).unwrap();
    println!("flow {} outside {}", cut.flow, cut.outside.iter().filter(|&&o| o).count());
    lap("cut");
}
