//! Seconds and peak memory of each step of the surface.
//!
//!     cargo bench --bench surface -- PROJECT... [--openmvs FOLDER]
//!
//! With `--openmvs`, the folder of OpenMVS's programs (v2.3.0): `InterfaceCOLMAP` and
//! `ReconstructMesh` run on the same model in a temporary folder, without cleaning and with every
//! point (`-d 0`), and the ratio of the raw surfaces' wall time is printed.

use std::{
    path::{Path, PathBuf},
    process::Command,
    time::Instant,
};

use viewrank::config::SurfaceSettings;
use viewrank_core::{
    base::progress::NoWatcher,
    method::{
        surface::{
            WantedGsd, carve, clean, cut::minimum_cut, delaunay::Delaunay, points, refine, simplify,
        },
        target::GSD_MARGIN,
    },
};
use viewrank_io::project::Project;

type Fallible<T> = Result<T, Box<dyn std::error::Error>>;

fn main() -> Fallible<()> {
    let mut arguments = std::env::args().skip(1).filter(|a| a != "--bench");
    let (mut projects, mut openmvs) = (Vec::new(), None);
    while let Some(argument) = arguments.next() {
        match argument.as_str() {
            "--openmvs" => openmvs = arguments.next().map(PathBuf::from),
            _ => projects.push(PathBuf::from(argument)),
        }
    }
    for project in &projects {
        println!("{}", project.display());
        let ours = time_surface(project)?;
        if let Some(programs) = &openmvs {
            let theirs = time_openmvs(programs, project)?;
            println!(
                "  ReconstructMesh {theirs:.2} s, raw surface {ours:.2} s: {:.1} times faster",
                theirs / ours
            );
        }
    }
    Ok(())
}

/// Prints the time of each step and returns the sum of those up to the raw surface.
fn time_surface(project: &Path) -> Fallible<f64> {
    let settings = SurfaceSettings::default();
    let mut clock = Clock {
        last: Instant::now(),
        last_cpu: cpu_seconds(),
        total: 0.0,
    };
    let scene = Project::open(project, None)?.read_scene()?;
    clock.step("read");
    clock.total = 0.0;
    let gsd = GSD_MARGIN * scene.median_gsd().ok_or("the model has no points")?;
    let usable = points::usable_points(&scene);
    let positions: Vec<_> = usable.iter().map(|p| scene.points[p.index()]).collect();
    clock.step("points");
    let delaunay = Delaunay::triangulate(&positions, &NoWatcher)?;
    clock.step(&format!("delaunay, {} cells", delaunay.cells.len()));
    let rays = carve::Rays::choose(&scene, &delaunay, &usable, settings.rays_per_point as usize);
    clock.step(&format!("rays, {}", rays.count()));
    let capacities = carve::capacities(&delaunay, &rays, &settings, &NoWatcher)?;
    clock.step("votes");
    let outside = minimum_cut(&delaunay.cells, capacities, &NoWatcher)?.outside;
    clock.step("cut");
    let raw = carve::surface(&delaunay, &rays, &outside);
    drop((delaunay, rays, outside));
    clock.step(&format!("facets, {}", raw.surface.triangles.len()));
    let total = clock.total;
    let surface = clean::clean(&raw.surface, &raw.seen);
    clock.step("clean");
    let wanted = WantedGsd::finest(&scene, gsd, GSD_MARGIN);
    let shortest = wanted.lengths(&surface.vertices, settings.edge_factor, &NoWatcher)?;
    let surface = simplify::simplify(surface, shortest, &NoWatcher)?;
    clock.step(&format!("simplify, {}", surface.triangles.len()));
    let longest = wanted.lengths(&surface.vertices, settings.max_edge_factor, &NoWatcher)?;
    let surface = refine::refine(surface, longest, refine::MAX_TRIANGLES, &NoWatcher)?;
    clock.step(&format!("refine, {}", surface.triangles.len()));
    println!(
        "  raw surface {total:.2} s, whole surface {:.2} s",
        clock.total
    );
    Ok(total)
}

struct Clock {
    last: Instant,
    last_cpu: f64,
    total: f64,
}

impl Clock {
    fn step(&mut self, name: &str) {
        let seconds = self.last.elapsed().as_secs_f64();
        self.total += seconds;
        println!(
            "  {seconds:7.2} s {:7.2} s CPU {:6} MB peak  {name}",
            cpu_seconds() - self.last_cpu,
            peak_memory_mb()
        );
        (self.last, self.last_cpu) = (Instant::now(), cpu_seconds());
    }
}

/// CPU time of all threads so far.
fn cpu_seconds() -> f64 {
    // SAFETY: a rusage is numbers alone, for which all zeros are valid.
    let mut usage: libc::rusage = unsafe { std::mem::zeroed() };
    // SAFETY: `usage` is a valid rusage for the call to fill.
    unsafe { libc::getrusage(libc::RUSAGE_SELF, &mut usage) };
    let seconds = |t: libc::timeval| t.tv_sec as f64 + 1e-6 * t.tv_usec as f64;
    seconds(usage.ru_utime) + seconds(usage.ru_stime)
}

/// Largest resident set so far; 0 where the system does not tell.
fn peak_memory_mb() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let peak = status
        .lines()
        .find_map(|l| l.strip_prefix("VmHWM:"))
        .and_then(|l| l.split_whitespace().next());
    peak.and_then(|kb| kb.parse::<u64>().ok()).unwrap_or(0) / 1024
}

/// OpenMVS reads the size of each image from its file: those of the project, or grey ones where it
/// has none.
fn link_images(project: &Path, folder: &Path) -> Fallible<()> {
    let images = std::path::absolute(project.join("images"))?;
    if images.is_dir() {
        return Ok(std::os::unix::fs::symlink(images, folder)?);
    }
    std::fs::create_dir_all(folder)?;
    let scene = Project::open(project, None)?.read_scene()?;
    for view in scene.view_indices() {
        let camera = scene.camera_of(view);
        let grey = folder.join(format!("{}x{}.jpg", camera.width, camera.height));
        if !grey.exists() {
            image::GrayImage::new(camera.width, camera.height).save(&grey)?;
        }
        std::fs::hard_link(grey, folder.join(scene.name(view)))?;
    }
    Ok(())
}

fn time_openmvs(programs: &Path, project: &Path) -> Fallible<f64> {
    let folder = std::env::temp_dir().join(format!("viewrank-bench-{}", std::process::id()));
    let model = [
        project.join("sparse/0"),
        project.join("sparse"),
        project.to_path_buf(),
    ];
    let model = model
        .iter()
        .find(|m| m.join("points3D.bin").exists())
        .ok_or("no binary COLMAP model")?;
    std::fs::create_dir_all(folder.join("in/sparse"))?;
    for file in ["cameras.bin", "images.bin", "points3D.bin"] {
        std::fs::copy(model.join(file), folder.join("in/sparse").join(file))?;
    }
    link_images(project, &folder.join("images"))?;
    let run = |program: &str, arguments: &[&str]| -> Fallible<f64> {
        let start = Instant::now();
        let output = Command::new(programs.join(program))
            .current_dir(&folder)
            .args(["-w", "."])
            .args(arguments)
            .output()?;
        let text = String::from_utf8_lossy(&output.stdout);
        if output.status.success() {
            Ok(start.elapsed().as_secs_f64())
        } else {
            Err(format!("{program}: {text}").into())
        }
    };
    run(
        "InterfaceCOLMAP",
        &["-i", "in", "-o", "scene.mvs", "--image-folder", "images/"],
    )?;
    let cleaning = [
        "--smooth",
        "0",
        "--remove-spurious",
        "0",
        "--close-holes",
        "0",
        "--remove-spikes",
        "0",
    ];
    let seconds = run(
        "ReconstructMesh",
        &[
            &["-i", "scene.mvs", "-o", "mesh.mvs", "-d", "0"][..],
            &cleaning,
        ]
        .concat(),
    );
    std::fs::remove_dir_all(&folder)?;
    seconds
}
