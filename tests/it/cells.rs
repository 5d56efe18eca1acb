//! The order of a plan in the cells of a cloud that OpenMVS really fused (`benches/cells.py`), so
//! that a worse ranking is seen within seconds.

use std::{fs, path::Path, process::Command};

use serde_json::Value;

/// Runs the program on a project; returns what it printed.
fn viewrank(arguments: &[&str], project: &Path) -> Vec<u8> {
    let mut command = Command::new(env!("CARGO_BIN_EXE_viewrank"));
    command.arg(arguments[0]).arg(project).args(&arguments[1..]);
    let done = command
        .env("XDG_CONFIG_HOME", env!("CARGO_TARGET_TMPDIR"))
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&done.stderr);
    assert!(done.status.success(), "{said}");
    done.stdout
}

/// A plan for OpenMVS of the whole fixture.
fn planned() -> tempfile::TempDir {
    let fixture = Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/valley");
    let project = tempfile::tempdir().unwrap();
    for entry in walkdir::WalkDir::new(&fixture)
        .min_depth(1)
        .sort_by_file_name()
    {
        let entry = entry.unwrap();
        let target = project
            .path()
            .join(entry.path().strip_prefix(&fixture).unwrap());
        if entry.file_type().is_dir() {
            fs::create_dir(target).unwrap();
        } else {
            fs::copy(entry.path(), target).unwrap();
        }
    }
    let whole = ["--budget", "100%", "--target", "100%"];
    let plan = [&["plan", "--backend", "openmvs", "--quiet"][..], &whole].concat();
    viewrank(&plan, project.path());
    project
}

#[test]
fn the_first_maps_cover_more_of_a_real_cloud_than_evenly_spread_ones() {
    let table = Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/valley_cells.tsv");
    let project = planned();
    let table = table.to_str().unwrap();
    let judged = viewrank(
        &["evaluate", "--cells", table, "--format", "json"],
        project.path(),
    );
    let judged: Value = serde_json::from_slice(&judged).unwrap();
    let orders = judged["all"]["orders"].as_array().unwrap();
    let curve = |name: &str| -> Vec<f64> {
        let order = orders.iter().find(|order| order["name"] == name).unwrap();
        let curve = order["curve"].as_array().unwrap();
        curve.iter().map(|share| share.as_f64().unwrap()).collect()
    };
    let (ours, spread, oracle) = (curve("ours"), curve("every n-th"), curve("oracle"));
    assert_eq!(
        (ours.len(), ours[28]),
        (29, 1.0),
        "the table is of all maps"
    );
    assert!(
        ours.iter()
            .zip(&oracle)
            .all(|(ours, oracle)| ours <= oracle)
    );
    // Beyond two thirds of the maps both have nearly all.
    for number in 2..=ours.len() * 2 / 3 {
        let (ours, spread) = (ours[number], spread[number]);
        assert!(
            ours > spread,
            "{number} maps: {ours:.3}, evenly spread {spread:.3}"
        );
    }
}
