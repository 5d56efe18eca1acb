//! Sparse models of all kinds against what other programs say of them.

use std::path::{Path, PathBuf};

use viewrank::{project::Project, scene::Scene};

/// The shared data sets, or `None` with a note where they are not to be had.
fn data() -> Option<PathBuf> {
    let there = std::env::var_os("VIEWRANK_DATA").map(PathBuf::from);
    let data = there.unwrap_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/data"));
    if !data.is_dir() {
        eprintln!("skipped: no data at {}", data.display());
        return None;
    }
    Some(data)
}

fn read(path: &Path) -> Scene {
    let scene = Project::open(path, None).and_then(|project| project.read_scene());
    scene.unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

#[test]
fn all_colmap_models_have_the_expected_counts() {
    let Some(formats) = data().map(|data| data.join("formats")) else { return };
    let expected = std::fs::read_to_string(formats.join("expected.json")).unwrap();
    let expected: serde_json::Map<String, serde_json::Value> = serde_json::from_str(&expected).unwrap();
    assert!(expected.len() > 50);
    for (folder, expected) in &expected {
        if expected["format"] == "txt" {
            continue;
        }
        let scene = read(&formats.join(folder));
        let count = |key: &str| expected[key].as_u64().unwrap() as usize;
        assert_eq!(scene.cameras.len(), count("cameras"), "{folder}");
        assert_eq!(scene.views.len(), count("registered"), "{folder}");
        assert_eq!(scene.points.len(), count("points3D"), "{folder}");
        assert_eq!(scene.observations(), count("observations"), "{folder}");
        assert_eq!(scene.warnings, Vec::<String>::new(), "{folder}");
        if let Some(error) = expected["error"].as_f64() {
            let found = scene.mean_reprojection_error().unwrap();
            assert!((found - error).abs() < 1e-5, "{folder}: {found} instead of {error}");
        }
    }
}
