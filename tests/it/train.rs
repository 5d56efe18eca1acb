//! `viewrank train`: settings of the confidence from made-up depth maps of the fixture, which have
//! a depth where pictures agree.

use std::{fs, path::PathBuf};

use serde_json::Value;
use tempfile::TempDir;
use viewrank::{Plan, Settings};
use viewrank_core::{
    base::progress::NoWatcher,
    method::{
        confidence::PairAgreement,
        visibility::{NOTHING, front},
    },
};
use viewrank_io::{npy, project::Project};

use super::valley::{self, printed, viewrank};

/// Size of the depth maps.
const WIDTH: u32 = 200;
const HEIGHT: u32 = 150;
/// Agreement (method 7.4) from which this matcher matches; 1 + 254 times the correlation.
const MATCHES: u8 = 150;

/// The fixture with depth maps in `sgm`, planned for that backend: a depth where the pictures of at
/// least two partners agree.
fn project() -> TempDir {
    let folder = valley::project();
    printed(&[
        "plan",
        folder.path().to_str().unwrap(),
        "--backend",
        "sgm",
        "--quiet",
    ]);
    let project = Project::open(folder.path(), None).unwrap();
    let settings = Settings {
        backends: vec!["sgm".into()],
        ..Settings::default()
    };
    let plan = viewrank::plan(&project, &settings, &NoWatcher).unwrap();
    fs::create_dir(folder.path().join("sgm")).unwrap();
    for cluster in 0..plan.stages.clusters.len() {
        let depths = matched(&plan, cluster);
        let name = plan.stages.scene.name(plan.stages.clusters[cluster].key);
        let array = npy::write(&[HEIGHT as usize, WIDTH as usize], depths);
        fs::write(folder.path().join(format!("sgm/{name}.npy")), array).unwrap();
    }
    folder
}

/// The depth map of a cluster; all that counts of a depth here is whether there is one.
fn matched(plan: &Plan, cluster: usize) -> Vec<f32> {
    let stages = &plan.stages;
    let cluster = &stages.clusters[cluster];
    let seen = stages.visibility.triangles_seen_by(cluster.key);
    let mut agreeing = vec![0; seen.len()];
    for &partner in &cluster.partners {
        let PairAgreement::Compared(values) = stages.agreement.of_pair(cluster.key, partner) else {
            panic!()
        };
        values
            .iter()
            .zip(&mut agreeing)
            .for_each(|(&value, count)| *count += i32::from(value >= MATCHES));
    }
    let depth = |&triangle: &u32| match seen.binary_search(&triangle) {
        Ok(row) if triangle != NOTHING && agreeing[row] >= 2 => 10.0,
        _ => 0.0,
    };
    front(
        &stages.scene,
        &stages.surface,
        cluster.key,
        [WIDTH, HEIGHT],
        0..HEIGHT,
    )
    .iter()
    .map(depth)
    .collect()
}

#[test]
fn what_was_learnt_is_a_settings_file_that_predicts_better() {
    let project = project();
    let root = project.path().to_str().unwrap();
    let out: PathBuf = project.path().join("learnt.toml");
    let train = [
        "train",
        root,
        "--depth-maps",
        "sgm",
        "--format",
        "json",
        "--out",
        out.to_str().unwrap(),
    ];
    let fitted: Value = serde_json::from_str(&printed(&train)).unwrap();
    let numbers = &fitted["numbers"];
    let number = |name: &str| numbers[name].as_f64().unwrap();
    assert_eq!(numbers["min_matches"], 2);
    assert!(number("agree") > 0.9 && number("differ") < 0.2, "{numbers}");
    let score = |of: &str, name: &str| fitted[of][name].as_f64().unwrap();
    assert!(
        score("after", "auc") > 0.9 && score("after", "brier") < score("before", "brier"),
        "{fitted}"
    );
    assert!(
        score("after", "calibration_error") < score("before", "calibration_error"),
        "{fitted}"
    );
    assert!(fitted["triangles"].as_u64().unwrap() > 1000);

    fs::copy(&out, project.path().join("viewrank.toml")).unwrap();
    printed(&["plan", root, "--quiet"]);
    let manifest = fs::read(project.path().join("viewrank/manifest.json")).unwrap();
    let manifest: Value = serde_json::from_slice(&manifest).unwrap();
    assert_eq!(
        manifest["settings"]["confidence"]["differ"],
        numbers["differ"]
    );
    assert_eq!(
        viewrank(&train).status.code(),
        Some(1),
        "the file is the user's now"
    );
}

#[test]
fn training_is_the_same_on_any_number_of_threads() {
    let project = project();
    let train = |threads| {
        printed(&[
            "train",
            project.path().to_str().unwrap(),
            "--depth-maps",
            "sgm",
            "--format",
            "json",
            "--threads",
            threads,
        ])
    };
    assert_eq!(train("1"), train("3"));
}

#[test]
fn a_stale_plan_and_missing_pictures_teach_nothing() {
    let project = project();
    let refused = || {
        let output = viewrank(&[
            "train",
            project.path().to_str().unwrap(),
            "--depth-maps",
            "sgm",
        ]);
        assert_eq!(output.status.code(), Some(1));
        String::from_utf8(output.stderr).unwrap()
    };
    fs::remove_dir_all(project.path().join("images")).unwrap();
    assert!(refused().contains("has changed since it was made"));
    // Without a plan, the settings of the project count, and the partners are unknown.
    fs::remove_dir_all(project.path().join("viewrank")).unwrap();
    assert!(refused().contains("hint"));
}

#[cfg(unix)]
#[test]
fn maps_are_read_through_no_link_that_leads_out_of_the_project() {
    let project = project();
    let outside = tempfile::tempdir().unwrap();
    let maps = outside.path().join("maps");
    fs::rename(project.path().join("sgm"), &maps).unwrap();
    std::os::unix::fs::symlink(&maps, project.path().join("sgm")).unwrap();
    let train = |named| {
        viewrank(&[
            "train",
            project.path().to_str().unwrap(),
            "--depth-maps",
            named,
        ])
    };
    for (named, why) in [("sgm", "no depth maps"), ("sgm/depth_maps", "leads out of")] {
        let said = String::from_utf8(train(named).stderr).unwrap();
        assert!(said.contains(why), "{named}: {said}");
    }
    // Named by the user.
    assert_eq!(train(maps.to_str().unwrap()).status.code(), Some(0));
}
