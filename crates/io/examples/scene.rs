//! Dumps a sparse model as viewrank reads it, for comparison with other readers
//! (`tests/python/test_read.py`).
//!
//! `scene MODEL` prints the numbers of views, points and observations, and the reading time in
//! seconds. `scene MODEL DIR` writes view names (`views.json`), poses (`poses.npy`: rotation,
//! row-major, and translation), observations (`observations.npy`: view, point id) and pixels
//! (`pixels.npy`: measured x and y, projected x and y, NaN without a projection).

use std::{env, error::Error, fs, path::Path, time::Instant};

use viewrank_core::model::scene::{PointIndex, Scene};
use viewrank_io::{npy, project::Project};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = env::args().skip(1).collect();
    let Some(model) = arguments.first() else {
        return Err("usage: scene MODEL [DIR]".into());
    };
    let start = Instant::now();
    let scene = Project::open(Path::new(model), None)?.read_scene()?;
    let seconds = start.elapsed().as_secs_f64();
    println!(
        "{} {} {} {seconds}",
        scene.views.len(),
        scene.points.len(),
        scene.observations()
    );
    arguments
        .get(1)
        .map_or(Ok(()), |folder| write(&scene, Path::new(folder)))
}

fn write(scene: &Scene, folder: &Path) -> Result<(), Box<dyn Error>> {
    let names: Vec<&str> = scene.views.iter().map(|view| view.name.as_str()).collect();
    fs::write(folder.join("views.json"), serde_json::to_string(&names)?)?;
    let pose = |view: &viewrank_core::model::scene::View| {
        let pose = view.cam_from_world;
        let rotation = pose.rotation.matrix().transpose();
        rotation
            .iter()
            .chain(pose.translation.iter())
            .copied()
            .collect::<Vec<f64>>()
    };
    array(
        &folder.join("poses.npy"),
        12,
        scene.views.iter().flat_map(pose).collect(),
    )?;
    let (mut observations, mut pixels) = (Vec::new(), Vec::new());
    for p in 0..scene.points.len() {
        for observation in scene.track(PointIndex(p as u32)) {
            let view = scene.track_views[observation];
            observations.extend([u64::from(view.0), scene.point_ids[p]]);
            let in_camera = scene
                .view(view)
                .cam_from_world
                .camera_from_world(&scene.points[p]);
            let projected = scene.camera_of(view).project_beyond_field(&in_camera);
            pixels.extend(scene.track_pixels[observation]);
            pixels.extend(projected.map_or([f64::NAN; 2], |pixel| [pixel.x, pixel.y]));
        }
    }
    array(&folder.join("observations.npy"), 2, observations)?;
    array(&folder.join("pixels.npy"), 4, pixels)
}

fn array<T: npy::Value>(path: &Path, columns: usize, values: Vec<T>) -> Result<(), Box<dyn Error>> {
    let shape = [values.len() / columns, columns];
    Ok(fs::write(path, npy::write(&shape, values))?)
}
