//! Plans for programs that use the images themselves, as Gaussian splatting does.

use std::{collections::BTreeSet, fs, path::Path};

use serde_json::Value;

use super::valley::{copy, fixture, printed, project, viewrank};

/// Plans, and returns what was printed on stdout.
fn plan(project: &Path, options: &[&str]) -> String {
    printed(&[&["plan", project.to_str().unwrap()], options].concat())
}

/// Exit code and stderr of a call that must fail.
fn failure(arguments: &[&str]) -> (i32, String) {
    let output = viewrank(arguments);
    assert!(output.stdout.is_empty(), "errors go to stderr");
    let said = String::from_utf8(output.stderr).unwrap();
    (output.status.code().unwrap(), said)
}

fn manifest(project: &Path) -> Value {
    serde_json::from_slice(&fs::read(project.join("viewrank/manifest.json")).unwrap()).unwrap()
}

/// Numbers of a field of all clusters, best first.
fn numbers(manifest: &Value, field: &str) -> Vec<f64> {
    let clusters = manifest["clusters"].as_array().unwrap();
    let number = |cluster: &Value| cluster[field].as_f64().unwrap();
    clusters.iter().map(number).collect()
}

fn lines(path: &Path) -> Vec<String> {
    let text = fs::read_to_string(path).unwrap();
    text.lines().map(String::from).collect()
}

#[test]
fn images_for_splats_are_ranked_by_what_they_draw_and_not_by_maps() {
    let folder = project();
    let (folder, maps) = (folder.path(), folder.path().join("maps"));
    plan(folder, &["--backend", "openmvs"]);
    let by_maps = manifest(folder);
    let text = plan(folder, &["--backend", "splat"]);
    let by_images = manifest(folder);
    assert!(
        text.contains(" images:") && text.contains("of what all 28 draw."),
        "{text}"
    );
    assert!(
        !text.contains("depth map") && !text.contains("likely"),
        "{text}"
    );
    let keys = |manifest: &Value| -> Vec<String> {
        let clusters = manifest["clusters"].as_array().unwrap();
        let key = |cluster: &Value| cluster["key"].as_str().unwrap().to_owned();
        clusters.iter().map(key).collect()
    };
    // The cache of the plan for maps is not taken for that for images, or back.
    assert_ne!(keys(&by_maps), keys(&by_images));
    plan(folder, &["--backend", "openmvs"]);
    assert_eq!(keys(&manifest(folder)), keys(&by_maps));
    plan(folder, &["--backend", "images"]);
    assert_eq!(keys(&manifest(folder)), keys(&by_images));
    let svg = fs::read_to_string(folder.join("viewrank/curve.svg")).unwrap();
    assert!(
        svg.contains(" of 28 images: ") && !svg.contains("depth maps"),
        "{svg}"
    );
    let cut = &by_images["cut"];
    assert_eq!(cut["share_band"]["low"], cut["share_band"]["high"]);
    fs::create_dir(&maps).unwrap();
    let finished = [
        "plan",
        folder.to_str().unwrap(),
        "--backend",
        "splat",
        "--finished",
        maps.to_str().unwrap(),
    ];
    let (code, said) = failure(&finished);
    assert!(
        code != 0 && said.contains("no depth maps to keep"),
        "{code}: {said}"
    );
}

#[test]
fn all_numbers_of_a_plan_for_images_are_of_what_they_draw() {
    let folder = project();
    let folder = folder.path();
    plan(folder, &["--backend", "splat", "--budget", "7"]);
    let written = manifest(folder);
    let [gains, fulfilment, shares] = ["gain", "fulfilment", "share"].map(|f| numbers(&written, f));
    let all = fulfilment.last().unwrap();
    let mut sum = 0.0;
    for ((gain, reached), share) in gains.iter().zip(&fulfilment).zip(&shares) {
        sum += gain;
        assert!((sum - reached).abs() < 1e-12 && (reached / all - share).abs() < 1e-12);
    }
    assert!(
        gains.is_sorted_by(|a, b| a >= b),
        "what counts is submodular"
    );
    let cut = &written["cut"];
    assert_eq!(
        (&cut["fulfilment"], &cut["kept"]),
        (&fulfilment[6].into(), &fulfilment[6].into())
    );
    assert_eq!(
        (&cut["reachable"], &cut["fulfilment_bound"]),
        (&(*all).into(), &(*all).into())
    );
    // Nothing is matched.
    assert!(
        ["work", "area"]
            .iter()
            .all(|f| numbers(&written, f).iter().all(|&x| x == 0.0))
    );
    let forecast = written["forecast"].as_object().unwrap();
    for (name, number) in forecast {
        let images = match name.as_str() {
            "maps" => 7.0,
            "all_maps" => 28.0,
            _ => 0.0,
        };
        assert_eq!(number.as_f64(), Some(images), "{name}");
    }
    assert_eq!(cut["pairs"], 0);
    let key_with_reason = |view: &&Value| view["status"] == "key" && !view["reason"].is_null();
    assert!(
        !written["views"]
            .as_array()
            .unwrap()
            .iter()
            .any(|view| key_with_reason(&view))
    );
    // Later commands read it.
    printed(&["export", folder.to_str().unwrap(), "--budget", "3"]);
    assert_eq!(
        lines(&folder.join("viewrank/splat/train_list.txt")).len(),
        3
    );
    printed(&["status", folder.to_str().unwrap()]);
    printed(&["report", folder.to_str().unwrap()]);
}

#[test]
fn limits_of_depth_maps_mean_nothing_for_images_nor_tests_for_depth_maps() {
    let folder = project();
    let folder = folder.path().to_str().unwrap();
    for (options, key) in [
        (["--backend", "splat", "--points", "1M"], "cut.points"),
        (["--backend", "images", "--time", "2h"], "cut.time"),
        (["--backend", "openmvs", "--test-every", "8"], "test_every"),
    ] {
        let with = printed(
            &[
                &["plan", folder, "--dry-run", "--format", "json"],
                &options[..],
            ]
            .concat(),
        );
        let with: Value = serde_json::from_str(&with).unwrap();
        let warnings = with["warnings"].to_string();
        assert!(
            warnings.contains(&format!("{key} counts as not set")),
            "{options:?}: {warnings}"
        );
        let without = printed(&[
            "plan",
            folder,
            "--dry-run",
            "--format",
            "json",
            options[0],
            options[1],
        ]);
        let without: Value = serde_json::from_str(&without).unwrap();
        assert_eq!(with["cut"], without["cut"]);
    }
    for (every, word) in [("1", "must not be 1"), ("few", "whole number")] {
        let (code, said) = failure(&["plan", folder, "--backend", "splat", "--test-every", every]);
        assert!(
            code == 2 && said.contains(word) && said.contains("hint: "),
            "{said}"
        );
    }
}

/// Names of images, and of those that are kept for tests, by the rule that trainers use.
fn names_and_tests(folder: &Path, every: usize) -> (BTreeSet<String>, Vec<String>) {
    let entries = fs::read_dir(folder.join("images")).unwrap();
    let name = |entry: std::io::Result<fs::DirEntry>| entry.unwrap().file_name();
    let names: BTreeSet<String> = entries.map(|e| name(e).into_string().unwrap()).collect();
    let tests = names.iter().step_by(every).cloned().collect();
    (names, tests)
}

#[test]
fn test_images_are_neither_chosen_nor_drawn_and_every_export_knows_them() {
    let folder = project();
    let folder = folder.path();
    plan(folder, &["--backend", "splat", "--target", "100%"]);
    let with_all = manifest(folder);
    let said = plan(
        folder,
        &[
            "--backend",
            "splat",
            "--target",
            "100%",
            "--test-every",
            "5",
        ],
    );
    assert!(
        said.contains("6 images are kept apart for tests."),
        "{said}"
    );
    let written = manifest(folder);
    let (names, tests) = names_and_tests(folder, 5);
    let train = names.len() - tests.len();
    let clusters = written["clusters"].as_array().unwrap();
    let is_test = |name: &Value| tests.iter().any(|test| name == test);
    for cluster in clusters {
        let partners = cluster["partners"].as_array().unwrap();
        assert!(!is_test(&cluster["key"]) && !partners.iter().any(is_test));
    }
    assert_eq!(written["forecast"]["all_maps"], train);
    for view in written["views"].as_array().unwrap() {
        let is_kept = view["reason"] == "kept_for_tests";
        assert_eq!(is_kept, is_test(&view["name"]), "{view}");
    }
    // Not among the photographs: those that remain draw another part of themselves.
    assert_ne!(written["cut"]["reachable"], with_all["cut"]["reachable"]);
    // `plan` and `export` write the same, also with every image that is left.
    let list = |name: &str| lines(&folder.join("viewrank/splat").join(name));
    let by_plan = list("train_list.txt");
    assert_eq!(list("test_list.txt"), tests);
    let project = folder.to_str().unwrap();
    printed(&["export", project]);
    assert_eq!(
        (list("train_list.txt"), list("sparse/0/test.txt")),
        (by_plan, tests.clone())
    );
    printed(&[
        "export",
        project,
        "--backend",
        "splat,images",
        "--refs",
        "all",
    ]);
    let whole: BTreeSet<String> = list("train_list.txt").into_iter().collect();
    assert!(whole.len() == train && tests.iter().all(|test| !whole.contains(test)));
    let plain = lines(&folder.join("viewrank/images/images.txt"));
    assert_eq!(plain.into_iter().collect::<BTreeSet<_>>(), whole);
}

#[test]
fn test_images_of_the_model_are_kept_apart_unless_others_are_asked_for() {
    let folder = project();
    let options = ["--backend", "splat", "--target", "100%"];
    plan(
        folder.path(),
        &[&options[..], &["--test-every", "5"]].concat(),
    );
    let (_, tests) = names_and_tests(folder.path(), 5);
    let model = folder.path().join("viewrank/splat");
    fs::remove_dir_all(model.join("train")).unwrap();
    let moved = tempfile::tempdir().unwrap();
    // The links there lead to the project.
    copy(&fixture().join("images"), &moved.path().join("images"));
    let name = "transforms.json";
    fs::rename(model.join(name), moved.path().join(name)).unwrap();
    fs::create_dir_all(moved.path().join("sparse/0")).unwrap();
    let seeds = "sparse/0/points3D.ply";
    fs::rename(model.join(seeds), moved.path().join(seeds)).unwrap();
    let transforms = moved.path().join("transforms.json");
    let transforms = transforms.to_str().unwrap();
    let said = plan(Path::new(transforms), &options);
    assert!(said.contains("6 images are kept apart for tests, as the model says"));
    let list = |name: &str| lines(&moved.path().join("viewrank/splat").join(name));
    let below = |name: &String| format!("images/{name}");
    let kept: BTreeSet<String> = tests.iter().map(below).collect();
    assert!(list("test_list.txt").iter().all(|name| kept.contains(name)));
    assert!(
        !list("train_list.txt")
            .iter()
            .any(|name| kept.contains(name))
    );
    let said = plan(
        Path::new(transforms),
        &[&options[..], &["--test-every", "9"]].concat(),
    );
    assert!(
        said.contains("4 images are kept apart for tests."),
        "{said}"
    );
    let said = plan(
        Path::new(transforms),
        &[&options[..], &["--test-every", "0"]].concat(),
    );
    assert!(!said.contains("kept apart"), "{said}");
    assert!(
        list("train_list.txt")
            .iter()
            .any(|name| kept.contains(name))
    );
}

#[test]
fn without_images_the_next_step_is_to_put_them_there() {
    let folder = project();
    fs::remove_dir_all(folder.path().join("images")).unwrap();
    let planned = viewrank(&[
        "plan",
        folder.path().to_str().unwrap(),
        "--backend",
        "splat",
    ]);
    assert_eq!(planned.status.code(), Some(1));
    let said = String::from_utf8(planned.stdout).unwrap();
    assert!(said.contains("Next: put the images into"), "{said}");
}

#[test]
fn a_setting_keeps_test_images_too() {
    let folder = project();
    let folder = folder.path();
    fs::write(
        folder.join("viewrank.toml"),
        "test_every = 7\nbackends = [\"images\"]\n",
    )
    .unwrap();
    plan(folder, &["--target", "100%"]);
    let (names, tests) = names_and_tests(folder, 7);
    let listed = lines(&folder.join("viewrank/images/images.txt"));
    assert_eq!(listed.len(), names.len() - tests.len());
    assert!(tests.iter().all(|test| !listed.contains(test)));
}

#[test]
fn planned_tests_stay_tests_until_all_images_are_asked_for() {
    let folder = project();
    let kept = |options: &[&str]| {
        plan(folder.path(), options);
        manifest(folder.path())["settings"]["test_every"].clone()
    };
    assert_eq!(kept(&["--backend", "splat", "--test-every", "5"]), 5);
    assert_eq!(kept(&["--budget", "6"]), 5);
    assert_eq!(kept(&["--backend", "images"]), 5);
    assert_eq!(kept(&["--test-every", "0"]), 0);
    assert_eq!(kept(&["--budget", "7"]), Value::Null);
}

#[test]
fn a_share_of_depth_maps_is_no_share_of_images() {
    for (planned, other) in [("openmvs", "splat"), ("splat", "openmvs")] {
        let folder = project();
        let export = |backend, options: &[&str]| {
            let arguments = [
                "export",
                folder.path().to_str().unwrap(),
                "--backend",
                backend,
            ];
            viewrank(&[&arguments, options].concat())
        };
        plan(folder.path(), &["--backend", planned]);
        let refused = export(other, &["--target", "50%"]);
        let said = String::from_utf8(refused.stderr).unwrap();
        let advice = format!("--backend {other} --target 50%");
        assert!(
            refused.status.code() == Some(2) && said.contains(&advice),
            "{said}"
        );
        assert!(!folder.path().join("viewrank").join(other).exists());
        assert!(export(planned, &["--target", "50%"]).status.success());
    }
}

#[test]
fn a_plan_for_images_that_counts_pairs_is_another_versions() {
    let folder = project();
    plan(folder.path(), &["--backend", "splat"]);
    let mut old = manifest(folder.path());
    old["cut"]["pairs"] = 5.into();
    fs::write(
        folder.path().join("viewrank/manifest.json"),
        old.to_string(),
    )
    .unwrap();
    let (code, said) = failure(&["export", folder.path().to_str().unwrap(), "--budget", "3"]);
    assert!(
        code != 0 && said.contains("another version") && said.contains("viewrank plan"),
        "{said}"
    );
}

#[test]
fn images_that_are_not_there_are_ranked_by_geometry_and_listed() {
    let folder = project();
    let folder = folder.path();
    fs::remove_dir_all(folder.join("images")).unwrap();
    let said = plan(folder, &["--backend", "images", "--budget", "6"]);
    assert!(said.contains("There are no images"), "{said}");
    let exports = &manifest(folder)["exports"];
    assert_ne!(
        exports[0]["warnings"],
        Value::Array(Vec::new()),
        "{exports}"
    );
    assert_eq!(lines(&folder.join("viewrank/images/images.txt")).len(), 6);
}
