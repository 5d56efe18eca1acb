//! Photographs that were taken twice.

use std::{fs, path::Path, process::Command};

use serde_json::Value;
use viewrank_core::model::scene::{Scene, ViewIndex};
use viewrank_io::{
    formats::{colmap::ColmapModel, colmap_bin},
    project::Project,
};

/// Copies a scene, each view twice: the copy's name begins with `again_`.
fn doubled(scene: &Scene) -> Scene {
    let views = scene.views.len() as u32;
    let copies = scene.views.iter().map(|view| {
        let mut copy = view.clone();
        copy.name = format!("again_{}", view.name);
        copy.image_id += 1000;
        copy
    });
    let mut doubled = Scene {
        views: scene.views.iter().cloned().chain(copies).collect(),
        track_offsets: scene.track_offsets.iter().map(|o| 2 * o).collect(),
        ..scene.clone()
    };
    let twice = |v: &ViewIndex| [*v, ViewIndex(v.0 + views)];
    doubled.track_views = scene.track_views.iter().flat_map(twice).collect();
    let pixels = scene.track_pixels.iter();
    doubled.track_pixels = pixels.flat_map(|&pixel| [pixel; 2]).collect();
    doubled
}

/// Makes a project of the fixture; with `copy`, which makes the second image, each photograph is
/// there twice.
fn project(copy: Option<fn(&Path, &Path)>) -> tempfile::TempDir {
    let fixture = Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/valley");
    let scene = Project::open(&fixture, None).unwrap();
    let scene = scene.read_scene().unwrap();
    let project = tempfile::tempdir().unwrap();
    let [images, sparse] = ["images", "sparse/0"].map(|folder| project.path().join(folder));
    fs::create_dir_all(&images).unwrap();
    fs::create_dir_all(&sparse).unwrap();
    for view in &scene.views {
        let from = fixture.join("images").join(&view.name);
        fs::copy(&from, images.join(&view.name)).unwrap();
        if let Some(copy) = copy {
            copy(&from, &images.join(format!("again_{}", view.name)));
        }
    }
    let scene = copy.map_or(scene.clone(), |_| doubled(&scene));
    for (name, bytes) in colmap_bin::write(&ColmapModel::from_scene(&scene)) {
        fs::write(sparse.join(name), bytes).unwrap();
    }
    project
}

fn manifest(project: &Path) -> Value {
    let mut command = Command::new(env!("CARGO_BIN_EXE_viewrank"));
    let done = command
        .args(["plan", "--backend", "openmvs", "--quiet"])
        .arg(project)
        .env("XDG_CONFIG_HOME", env!("CARGO_TARGET_TMPDIR"))
        .output()
        .unwrap();
    assert!(
        done.status.success(),
        "{}",
        String::from_utf8_lossy(&done.stderr)
    );
    let text = fs::read(project.join("viewrank/manifest.json")).unwrap();
    serde_json::from_slice(&text).unwrap()
}

/// Names of the key views and partners of the plan's clusters.
fn taken(manifest: &Value) -> Vec<String> {
    let clusters = manifest["clusters"].as_array().unwrap().iter();
    let names = clusters.flat_map(|cluster| {
        let partners = cluster["partners"].as_array().unwrap().iter();
        partners
            .chain([&cluster["key"]])
            .cloned()
            .collect::<Vec<_>>()
    });
    names
        .map(|name| name.as_str().unwrap().to_owned())
        .collect()
}

#[test]
fn a_photograph_that_is_there_twice_counts_once() {
    let once = manifest(project(None).path());
    let twice = manifest(project(Some(|from, to| _ = fs::copy(from, to).unwrap())).path());
    let clusters = |manifest: &Value| manifest["clusters"].as_array().unwrap().len();
    assert_eq!(clusters(&twice), clusters(&once));
    // Of equal pictures the first by name: no original takes part beside its copy.
    assert!(taken(&twice).iter().all(|name| name.starts_with("again_")));
}

#[test]
fn the_sharp_picture_takes_part_for_its_blurred_twin() {
    let project = project(Some(|from, to| {
        let image = image::open(from).unwrap();
        image.blur(2.0).to_rgb8().save(to).unwrap();
    }));
    let manifest = manifest(project.path());
    assert!(
        taken(&manifest)
            .iter()
            .all(|name| !name.starts_with("again_"))
    );
    let views = manifest["views"].as_array().unwrap();
    let aside = views
        .iter()
        .filter(|view| view["reason"] == "twin_of_sharper_view");
    let aside: Vec<_> = aside.map(|view| view["name"].as_str().unwrap()).collect();
    assert_eq!(aside.len(), views.len() / 2);
    assert!(aside.iter().all(|name| name.starts_with("again_")));
    let warnings = manifest["warnings"].to_string();
    assert!(warnings.contains("blurred"), "{warnings}");
}
