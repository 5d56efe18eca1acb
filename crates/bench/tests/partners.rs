//! The program as the documents use it.

use std::{fs, path::Path, process::Command};

#[test]
fn each_rule_has_clusters_of_the_plans_key_views() {
    let folder = tempfile::tempdir().unwrap();
    let project = folder.path().join("valley");
    let fixture = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fixtures/valley/sparse/0");
    let model = project.join("sparse/0");
    fs::create_dir_all(&model).unwrap();
    for file in ["cameras.bin", "images.bin", "points3D.bin"] {
        fs::copy(fixture.join(file), model.join(file)).unwrap();
    }
    let opened = viewrank::Project::open(&project, None).unwrap();
    let plan = viewrank::plan(
        &opened,
        &viewrank::Settings::default(),
        &viewrank::NoWatcher,
    );
    let plan = plan.unwrap();
    let files = viewrank::files::files(&plan, &opened).unwrap();
    viewrank::output::write_all(&files.sets, &viewrank::output::Disk::REAL).unwrap();

    let out = folder.path().join("rules");
    let done = Command::new(env!("CARGO_BIN_EXE_viewrank-bench"))
        .arg("partners")
        .args([&project, &out])
        .args(["-k", "2"])
        .output()
        .unwrap();
    assert!(done.status.success(), "{done:?}");
    let rules = fs::read_dir(out.join("k2")).unwrap();
    let mut names: Vec<String> = rules
        .map(|rule| rule.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    assert_eq!(
        names,
        [
            "colmap",
            "goesele",
            "maxcon",
            "mindist",
            "mvsnet",
            "openmvs",
            "ours",
            "ours-nocp",
            "random",
            "shen"
        ]
    );
    for name in names {
        let clusters = fs::read_to_string(out.join("k2").join(&name).join("clusters.txt")).unwrap();
        assert!(clusters.lines().count() > 10, "{name}");
        for line in clusters.lines() {
            let views: Vec<&str> = line.split('\t').collect();
            assert!((2..=3).contains(&views.len()), "{name}: {line}");
            assert!(plan.stages.scene.find(views[0]).is_some(), "{name}: {line}");
        }
    }
}
