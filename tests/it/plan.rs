//! The program as its users meet it: `viewrank plan` on whole projects.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

use serde_json::Value;

use super::valley::{copy, printed, printed_by_geometry, project, viewrank};

/// Plans, and returns what was printed on stdout.
fn plan(project: &Path, options: &[&str]) -> String {
    printed_by_geometry(&[&["plan", project.to_str().unwrap()], options].concat())
}

/// As [`plan`], which compares no pictures, with these.
fn plan_with_pictures(project: &Path, options: &[&str]) -> String {
    printed(&[&["plan", project.to_str().unwrap()], options].concat())
}

/// Exit code and stderr of a call that must fail.
fn failure(arguments: &[&str]) -> (i32, String) {
    let output = viewrank(arguments);
    assert!(output.stdout.is_empty(), "errors go to stderr");
    (
        output.status.code().unwrap(),
        String::from_utf8(output.stderr).unwrap(),
    )
}

fn manifest(project: &Path) -> Value {
    serde_json::from_slice(&fs::read(project.join("viewrank/manifest.json")).unwrap()).unwrap()
}

/// Path and contents of every file below a folder.
fn files(root: &Path) -> BTreeMap<String, Vec<u8>> {
    let entries = walkdir::WalkDir::new(root)
        .into_iter()
        .map(|entry| entry.unwrap());
    let files = entries.filter(|entry| entry.file_type().is_file());
    files
        .map(|entry| {
            let path = entry
                .path()
                .strip_prefix(root)
                .unwrap()
                .to_str()
                .unwrap()
                .to_owned();
            (path, fs::read(entry.path()).unwrap())
        })
        .collect()
}

fn lines(path: PathBuf) -> Vec<String> {
    fs::read_to_string(path)
        .unwrap()
        .lines()
        .map(String::from)
        .collect()
}

fn names(list: &Value) -> Vec<&str> {
    list.as_array()
        .unwrap()
        .iter()
        .map(|name| name.as_str().unwrap())
        .collect()
}

#[test]
fn the_files_of_a_plan_say_the_same() {
    let project = project();
    plan_with_pictures(project.path(), &["--backend", "sgm"]);
    let (manifest, folder) = (manifest(project.path()), project.path().join("viewrank"));
    let clusters = manifest["clusters"].as_array().unwrap();
    let chosen = manifest["cut"]["clusters"].as_u64().unwrap() as usize;
    assert!(
        0 < chosen && chosen < clusters.len(),
        "{chosen} of {}",
        clusters.len()
    );

    let expected: Vec<String> = clusters[..chosen]
        .iter()
        .map(|c| {
            [vec![c["key"].as_str().unwrap()], names(&c["partners"])]
                .concat()
                .join("\t")
        })
        .collect();
    assert_eq!(lines(folder.join("clusters.txt")), expected);
    let keys: Vec<&str> = clusters[..chosen]
        .iter()
        .map(|c| c["key"].as_str().unwrap())
        .collect();
    assert_eq!(lines(folder.join("baseImages.txt")), keys);
    assert_eq!(
        lines(folder.join("pairs.txt")).len() as u64,
        manifest["cut"]["pairs"].as_u64().unwrap()
    );
    assert_eq!(lines(folder.join("manifest.csv")).len(), clusters.len() + 1);
    assert!(folder.join("curve.svg").is_file() && folder.join("surface.ply").is_file());
    assert!(folder.join("timings.json").is_file());

    let views = manifest["views"].as_array().unwrap();
    let all: Vec<&str> = views
        .iter()
        .map(|view| view["name"].as_str().unwrap())
        .collect();
    assert!(all.is_sorted() && all.len() == 28);
    let of_status = |status: &str| views.iter().filter(|view| view["status"] == status).count();
    assert_eq!(of_status("key"), chosen);
    assert_eq!(
        of_status("key") + of_status("partner") + of_status("unused"),
        all.len()
    );
    assert!(
        views
            .iter()
            .all(|view| view["status"] == "key" || view["reason"].is_string())
    );

    let mut fulfilment = 0.0;
    for (i, cluster) in clusters.iter().enumerate() {
        fulfilment += cluster["gain"].as_f64().unwrap();
        assert_eq!(cluster["rank"].as_u64().unwrap() as usize, i + 1);
        assert!((cluster["fulfilment"].as_f64().unwrap() - fulfilment).abs() < 1e-9);
    }
    let target = 0.9;
    let share = |i: usize| clusters[i]["share"].as_f64().unwrap();
    assert!(share(chosen - 1) >= target && (chosen == 1 || share(chosen - 2) < target));
}

#[test]
fn the_same_bytes_on_one_thread_and_on_sixteen() {
    let (one, sixteen) = (project(), project());
    plan_with_pictures(one.path(), &["--threads", "1"]);
    plan_with_pictures(sixteen.path(), &["--threads", "16"]);
    let without_times = |root: &Path| {
        let mut files = files(root);
        // What follows from pictures is kept with the times of these copies.
        let times = [
            "timings.json",
            "agreement.table",
            "pilot.table",
            "twins.table",
            "clusters.table",
            "ranking.table",
        ];
        files.retain(|path, _| {
            !times.iter().any(|name| path.ends_with(name)) && !path.starts_with("viewrank/.sets")
        });
        files
    };
    let (one, sixteen) = (without_times(one.path()), without_times(sixteen.path()));
    assert_eq!(
        one.keys().collect::<Vec<_>>(),
        sixteen.keys().collect::<Vec<_>>()
    );
    for (path, bytes) in &one {
        assert!(sixteen[path] == *bytes, "{path} differs");
    }
}

#[test]
fn a_report_has_the_same_bytes_each_time() {
    let project = project();
    let page = |threads: &str| {
        _ = fs::remove_dir_all(project.path().join("viewrank"));
        plan_with_pictures(project.path(), &["--report", "--threads", threads]);
        fs::read(project.path().join("viewrank/report.html")).unwrap()
    };
    assert!(page("1") == page("3"));
}

#[test]
fn a_dry_run_writes_nothing_and_says_the_same() {
    let project = project();
    let before = files(project.path());
    let dry: Value =
        serde_json::from_str(&plan(project.path(), &["--dry-run", "--format", "json"])).unwrap();
    assert_eq!(files(project.path()), before);
    let wet: Value = serde_json::from_str(&plan(project.path(), &["--format", "json"])).unwrap();
    assert_eq!(dry["cut"], wet["cut"]);
    assert_eq!(dry["files"], wet["files"]);
    for file in names(&wet["files"]) {
        assert!(project.path().join(file).exists(), "{file}");
    }
    assert!((wet["written"] == true) && (dry["written"] == false));
}

#[test]
fn the_summary_fits_a_terminal_and_names_the_next_command() {
    let project = project();
    let summary = plan(project.path(), &[]);
    let long = summary.lines().filter(|line| {
        line.chars().count() > 80 && !line.contains(project.path().to_str().unwrap())
    });
    assert_eq!(long.collect::<Vec<_>>(), Vec::<&str>::new());
    assert!(summary.contains("<- the plan stops here"));
    assert!(summary.contains("\nNext: viewrank "), "{summary}");
    assert!(
        !summary.contains(" m per pixel"),
        "nobody said that the model is metric"
    );
}

#[test]
fn quiet_is_quiet() {
    let project = project();
    let output = viewrank(&["plan", project.path().to_str().unwrap(), "--quiet"]);
    assert!(output.status.success() && output.stdout.is_empty());
    assert_eq!(String::from_utf8(output.stderr).unwrap(), "");
}

#[test]
fn settings_of_the_project_and_the_command_line_are_in_force() {
    let project = project();
    fs::write(
        project.path().join("viewrank.toml"),
        "units = \"metric\"\npartners.k = 3\n[target]\ngsd = 0.05\n",
    )
    .unwrap();
    let summary = plan(project.path(), &["-k", "2", "--budget", "4"]);
    assert!(summary.contains("0.0500 m per pixel"), "{summary}");
    let manifest = manifest(project.path());
    assert_eq!(manifest["units"], "metric");
    assert_eq!(manifest["settings"]["partners"]["k"], 2);
    assert_eq!(manifest["settings"]["target"]["gsd"], 0.05);
    assert_eq!(manifest["settings"]["target"]["mode"], "absolute");
    assert_eq!(manifest["cut"]["clusters"], 4);
    assert!(
        manifest["clusters"]
            .as_array()
            .unwrap()
            .iter()
            .all(|c| names(&c["partners"]).len() <= 2)
    );
}

#[test]
fn a_length_that_others_do_not_share_is_said() {
    let project = project();
    let root = project.path().to_str().unwrap();
    let warned = |arguments: &[&str]| {
        let output = viewrank(arguments);
        assert!(output.status.success());
        String::from_utf8(output.stderr).unwrap()
    };
    let many = warned(&["plan", root, "--backend", "pairs", "--budget", "1000"]);
    assert!(many.contains("more than the 28 depth maps"), "{many}");
    let other = warned(&["export", root, "--budget", "3"]);
    assert!(
        other.contains("the plan stops at 28 view clusters") && other.contains("--budget 3"),
        "{other}"
    );
    let elsewhere = project.path().join("elsewhere");
    let own = ["export", root];
    let out = [
        &own[..],
        &["--budget", "3", "--out", elsewhere.to_str().unwrap()],
    ]
    .concat();
    for quiet in [&own[..], &out] {
        assert!(!warned(quiet).contains("stops at"));
    }
}

#[test]
fn budgets_and_targets_cut_where_they_say() {
    let project = project();
    // Whose cache the dry runs use, which keep none.
    plan(project.path(), &["--quiet"]);
    let cut_and_limit = |options: &[&str]| {
        let summary: Value = serde_json::from_str(&plan(
            project.path(),
            &[options, &["--dry-run", "--format", "json"]].concat(),
        ))
        .unwrap();
        (
            summary["cut"]["clusters"].as_u64().unwrap(),
            summary["cut"]["limit"].clone(),
        )
    };
    let cut = |options: &[&str]| cut_and_limit(options).0;
    assert_eq!(cut(&["--budget", "3"]), 3);
    // 10 % of 28 views, and no fewer.
    assert_eq!(cut(&["--budget", "10%"]), 3);
    assert_eq!(
        cut_and_limit(&["--budget", "2", "--target", "100%"]),
        (2, "budget".into())
    );
    assert_eq!(
        cut_and_limit(&["--budget", "20", "--target", "60%"]).1,
        "target"
    );
    assert_eq!(
        cut_and_limit(&["--points", "500k", "--budget", "20"]).1,
        "points"
    );
    assert_eq!(
        cut_and_limit(&["--budget", "1000"]),
        (28, Value::Null),
        "nothing is left out"
    );
    assert!(cut(&["--target", "50%"]) < cut(&["--target", "95%"]));
    let (code, stderr) = failure(&[
        "plan",
        project.path().to_str().unwrap(),
        "--time",
        "2h",
        "-q",
    ]);
    assert_eq!(code, 2);
    assert!(
        stderr.contains("the time limit") && stderr.contains("hint: time one depth map"),
        "{stderr}"
    );
    fs::write(
        project.path().join("viewrank.toml"),
        "[forecast]\nseconds_per_map = 10\nseconds_per_pair = 2\n",
    )
    .unwrap();
    let of_a_minute = ["--time", "1min", "-k", "5", "--target", "100%"];
    assert_eq!(cut_and_limit(&of_a_minute), (3, "time".into()));
    assert!(plan(project.path(), &of_a_minute).contains("  <- the plan stops here (--time)\n"));
}

#[test]
fn any_number_of_partners() {
    let project = project();
    for k in [1, 2, 11] {
        // One match is enough for OpenMVS.
        plan(
            project.path(),
            &["-k", &k.to_string(), "--backend", "openmvs"],
        );
        let manifest = manifest(project.path());
        let clusters = manifest["clusters"].as_array().unwrap();
        let most = clusters
            .iter()
            .map(|cluster| cluster["partners"].as_array().unwrap().len())
            .max();
        let warned = manifest["warnings"]
            .as_array()
            .unwrap()
            .iter()
            .any(|w| w.as_str().unwrap().starts_with("with k = 1 "));
        assert_eq!(
            (most, warned),
            (Some(k), k == 1),
            "{:?}",
            manifest["warnings"]
        );
        let cameras = manifest["settings"]["coverage"]["min_cameras"]
            .as_u64()
            .unwrap();
        assert_eq!(
            cameras,
            if k == 1 { 2 } else { 3 },
            "no more than a view cluster has"
        );
    }
}

#[test]
fn a_dense_workspace_gets_its_lists_and_keeps_the_originals() {
    let project = project();
    let root = project.path();
    for file in ["cameras.bin", "images.bin", "points3D.bin"] {
        fs::rename(
            root.join("sparse/0").join(file),
            root.join("sparse").join(file),
        )
        .unwrap();
    }
    fs::remove_dir(root.join("sparse/0")).unwrap();
    fs::create_dir(root.join("stereo")).unwrap();
    fs::write(
        root.join("stereo/patch-match.cfg"),
        "grid_031.jpg\n__auto__, 20\n",
    )
    .unwrap();
    plan(root, &[]);
    let manifest = manifest(root);
    assert_eq!(manifest["backend"], "colmap");
    let list = fs::read_to_string(root.join("stereo/patch-match.cfg")).unwrap();
    let keys: Vec<&str> = list
        .lines()
        .filter(|line| !line.starts_with('#'))
        .step_by(2)
        .collect();
    assert_eq!(
        keys.len() as u64,
        manifest["cut"]["clusters"].as_u64().unwrap()
    );
    assert!(root.join("stereo/fusion.cfg").is_file());
    let original = fs::read_to_string(root.join("stereo/patch-match.cfg.before-viewrank")).unwrap();
    assert_eq!(original, "grid_031.jpg\n__auto__, 20\n");
}

#[test]
fn wrong_usage_is_2_and_failure_is_1_each_with_a_hint() {
    let project = project();
    let root = project.path().to_str().unwrap();
    for (arguments, code, words) in [
        (vec!["plan"], 2, "--help"),
        (vec!["plan", root, "--buget", "1"], 2, "--budget"),
        (vec!["plan", root, "--gsd", "-1"], 2, "must be above 0"),
        (vec!["plan", root, "-k", "0"], 2, "hint: "),
        (vec!["plan", root, "--target", "1"], 2, "write 1% or 100%"),
        (
            vec!["plan", root, "--target", "101%"],
            2,
            "up to 100% such as 80% or 0.8\n",
        ),
        (vec!["plan", root, "--backend", "sgmm"], 2, "hint: "),
        (vec!["plan", root, "--model", "7"], 2, "hint: "),
        (
            vec!["plan", root, "--confidence", "geomtric"],
            2,
            "'geometric'",
        ),
        (vec!["plan", root, "--up", "0,1"], 2, "three numbers"),
        (vec!["plan", "/nowhere/at/all"], 1, "hint: "),
    ] {
        let (found, stderr) = failure(&arguments);
        assert_eq!(found, code, "{arguments:?}: {stderr}");
        assert!(
            stderr.starts_with("error: ") && stderr.contains(words),
            "{arguments:?}: {stderr}"
        );
    }
    fs::write(project.path().join("viewrank.toml"), "[target]\ngds = 1\n").unwrap();
    let (code, stderr) = failure(&["plan", root]);
    assert_eq!(code, 2);
    assert!(
        stderr.contains(
            "viewrank.toml:2: unknown setting target.gds\nhint: did you mean target.gsd?"
        ),
        "{stderr}"
    );
}

#[test]
fn coordinates_that_no_utm_zone_has_are_warned_of() {
    let folder = project();
    for (offset, warned) in [("[0.0, 0.0]", true), ("[500000.0, 5500000.0]", false)] {
        fs::write(
            folder.path().join("viewrank.toml"),
            format!("[frame]\nutm = \"34N\"\noffset = {offset}\n"),
        )
        .unwrap();
        plan(folder.path(), &["--quiet"]);
        assert_eq!(
            manifest(folder.path())["warnings"]
                .to_string()
                .contains("outside every zone"),
            warned
        );
    }
}

/// What was planned before stays, whatever is asked for next.
#[test]
fn a_plan_of_nothing_takes_no_plans_place() {
    let folder = project();
    let root = folder.path().to_str().unwrap();
    plan(folder.path(), &["--confidence", "none", "-k", "2"]);
    fs::write(
        folder.path().join("viewrank.toml"),
        "[coverage]\nmin_cameras = 6\n",
    )
    .unwrap();
    let before = files(folder.path());
    for (options, said) in [
        (&["--points", "1"][..], "points 1"),
        (&["--target", "50%", "--points", "2"], "exclude all "),
        (
            &["--confidence", "none", "-k", "2"],
            "use -k 5 or more: coverage.min_cameras wants each place seen by 6 cameras",
        ),
        (
            &["--backend", "sgm", "--confidence", "geometric", "-k", "1"],
            "hint: use -k 2 or more: sgm needs 2 matches that agree",
        ),
    ] {
        let (code, stderr) = failure(&[&["plan", root], options].concat());
        assert!(
            code == 1 && stderr.contains(said) && stderr.contains("hint: "),
            "{stderr}"
        );
        assert_eq!(before, files(folder.path()));
    }
}

#[test]
fn a_folder_holds_the_plan_of_one_sub_model() {
    let folder = project();
    let root = folder.path().to_str().unwrap();
    copy(
        &folder.path().join("sparse/0"),
        &folder.path().join("sparse/1"),
    );
    let named = plan(folder.path(), &["--model", "0"]);
    assert!(!named.contains("sub-models"));
    let before = files(folder.path());
    let (code, stderr) = failure(&["plan", root, "--model", "1"]);
    let own = format!("viewrank plan {root}/sparse/1");
    assert!(
        code == 1 && stderr.contains("is the plan of sub-model 0") && stderr.contains(&own),
        "{stderr}"
    );
    assert_eq!(before, files(folder.path()));
    plan(&folder.path().join("sparse/1"), &[]);
    assert_eq!(
        manifest(&folder.path().join("sparse/1"))["clusters"],
        manifest(folder.path())["clusters"]
    );
    plan(folder.path(), &["-k", "3"]);
    fs::remove_file(folder.path().join("viewrank/manifest.json")).unwrap();
    plan(folder.path(), &["--model", "1"]);
    assert_eq!(manifest(folder.path())["input"]["model"], "sparse/1");
}

#[test]
fn a_model_without_views_is_a_clear_error() {
    let empty = concat!(env!("CARGO_MANIFEST_DIR"), "/fixtures/formats/empty/bin");
    let (code, stderr) = failure(&["plan", empty, "--dry-run"]);
    assert_eq!(code, 1);
    assert!(stderr.contains("hint: "), "{stderr}");
}

#[test]
fn the_manual_and_the_completions_know_every_option() {
    let manual = String::from_utf8(viewrank(&["man", "plan"]).stdout).unwrap();
    let completions = String::from_utf8(viewrank(&["completions", "bash"]).stdout).unwrap();
    for option in [
        "budget",
        "target",
        "gsd",
        "accuracy",
        "partners",
        "confidence",
        "surface",
        "mesh",
        "backend",
        "dry-run",
    ] {
        assert!(manual.contains(&option.replace('-', "\\-")), "{option}");
        assert!(completions.contains(&format!("--{option}")), "{option}");
    }
}

#[test]
fn a_wanted_resolution_in_another_unit_is_warned_of_and_all_partners_that_are_asked_for_are_candidates()
 {
    let project = project();
    plan(project.path(), &["--gsd", "2", "--quiet"]);
    assert!(
        manifest(project.path())["warnings"]
            .to_string()
            .contains("times coarser than the images' own")
    );
    plan(
        project.path(),
        &[
            "-k",
            "24",
            "--budget",
            "3",
            "--confidence",
            "none",
            "--quiet",
        ],
    );
    let manifest = manifest(project.path());
    assert_eq!(manifest["settings"]["partners"]["candidates"], 24);
}

#[test]
fn each_key_view_has_one_of_two_sizes_and_budgets_count_work() {
    let folder = project();
    let options = [
        "--backend",
        "sgm",
        "-k",
        "3",
        "--scales",
        "1,0.5",
        "--target",
        "100%",
    ];
    let text = plan_with_pictures(
        folder.path(),
        &[&options[..], &["--budget", "30%"]].concat(),
    );
    assert!(
        text.contains(" at full and ") && text.contains(" at half size, "),
        "{text}"
    );
    let wide = manifest(folder.path());
    let clusters = wide["clusters"].as_array().unwrap();
    let chosen = wide["cut"]["clusters"].as_u64().unwrap() as usize;
    let keys: std::collections::BTreeSet<&str> = clusters
        .iter()
        .map(|c| c["key"].as_str().unwrap())
        .collect();
    assert_eq!(keys.len(), clusters.len(), "no view is matched twice");
    assert!(
        [1.0, 0.5]
            .iter()
            .all(|scale| clusters[..chosen].iter().any(|c| c["scale"] == *scale))
    );
    let work: Vec<f64> = clusters
        .iter()
        .map(|c| c["work"].as_f64().unwrap())
        .collect();
    assert!(work[chosen - 1] <= 0.3 && work[chosen] > 0.3, "{work:?}");
    assert_eq!(wide["forecast"]["work"].as_f64().unwrap(), work[chosen - 1]);
    let half = clusters[..chosen].iter().filter(|c| c["scale"] == 0.5);
    assert_eq!(wide["forecast"]["maps_at_half"], half.clone().count());
    let sizes = fs::read_to_string(folder.path().join("viewrank/sizes.txt")).unwrap();
    let expected: String = half
        .map(|c| format!("{}\t0.5\n", c["key"].as_str().unwrap()))
        .collect();
    assert_eq!(sizes, expected);

    let exported = viewrank(&[
        "export",
        folder.path().to_str().unwrap(),
        "--backend",
        "sgm",
        "--budget",
        "30%",
    ]);
    assert!(exported.status.success());
    let record = fs::read(folder.path().join("viewrank/sgm/export.json")).unwrap();
    let record: Value = serde_json::from_slice(&record).unwrap();
    assert_eq!(
        record["clusters"].as_array().unwrap().len(),
        chosen,
        "export counts work, too"
    );
}

#[test]
fn two_sizes_are_never_worse_than_one() {
    let folder = project();
    let planned = |options: &[&str]| {
        plan_with_pictures(
            folder.path(),
            &[&["--backend", "sgm", "-k", "3"], options].concat(),
        );
        let manifest = manifest(folder.path());
        let number = |part: &str, name: &str| manifest[part][name].as_f64().unwrap();
        [
            number("cut", "fulfilment"),
            number("cut", "share"),
            number("forecast", "work"),
        ]
    };
    let mut before = 0.0;
    for maps in ["8", "22"] {
        let one = planned(&["--target", "100%", "--budget", maps]);
        let budget = format!("{:.6}%", 100.0 * one[2] + 1e-6);
        let two = planned(&["--target", "100%", "--budget", &budget, "--scales", "1,0.5"]);
        assert!(
            two[1] >= one[1] && two[2] <= one[2] + 1e-6,
            "{maps}: {two:?} {one:?}"
        );
        assert!(two[1] > before, "{maps}: {two:?}");
        before = two[1];
    }
    let [two, one] = [&["--scales", "1,0.5"][..], &[]]
        .map(|sizes| planned(&[&["--target", "90%"], sizes].concat()));
    assert!(two[1].min(one[1]) >= 0.9);
    assert!(two[2] <= one[2], "{two:?} {one:?}");
    assert_eq!(planned(&["--scales", "1,0.5", "--target", "100%"])[1], 1.0);
}

#[test]
fn a_limit_that_is_missed_leaves_what_fits_and_a_list_that_is_too_short_says_so() {
    let folder = project();
    let options = ["--backend", "openmvs", "--scales", "1,0.5", "--quiet"];
    plan(
        folder.path(),
        &[&options[..], &["--budget", "2%", "--target", "90%"]].concat(),
    );
    let tight = manifest(folder.path());
    assert!(
        tight["cut"]["clusters"].as_u64().unwrap() > 0
            && tight["cut"]["share"].as_f64().unwrap() < 0.9
    );
    plan(
        folder.path(),
        &[&options[..], &["--target", "60%"]].concat(),
    );
    let last = manifest(folder.path())["clusters"]
        .as_array()
        .unwrap()
        .last()
        .unwrap()["share"]
        .as_f64()
        .unwrap();
    assert!(last < 0.999, "{last}");
    let exported = viewrank(&[
        "export",
        folder.path().to_str().unwrap(),
        "--target",
        "100%",
    ]);
    let said = String::from_utf8_lossy(&exported.stderr);
    assert!(
        exported.status.success() && said.contains("plan again with --target 100%"),
        "{said}"
    );
}

#[test]
fn a_backend_that_matches_all_at_one_size_says_so() {
    let folder = project();
    plan(
        folder.path(),
        &["--backend", "alicevision", "--scales", "1,0.5"],
    );
    let manifest = manifest(folder.path());
    assert_eq!(
        manifest["settings"]["ranking"]["scales"],
        serde_json::json!([1.0])
    );
    assert!(
        manifest["clusters"]
            .as_array()
            .unwrap()
            .iter()
            .all(|c| c["scale"] == 1.0)
    );
    let warnings = manifest["warnings"].as_array().unwrap();
    assert!(
        warnings.iter().any(|w| w
            .as_str()
            .unwrap()
            .contains("alicevision matches all key views at one size")),
        "{warnings:?}"
    );
    let [error] = [viewrank(&[
        "plan",
        folder.path().to_str().unwrap(),
        "--scales",
        "1,0.25",
    ])];
    assert_eq!(error.status.code(), Some(2));
}

#[test]
fn a_plan_without_a_backend_is_for_those_of_the_plan_before() {
    let folder = project();
    let root = folder.path().to_str().unwrap();
    let planned = |options: &[&str]| -> (String, String) {
        let said = printed(&[&["plan", root, "--confidence", "geometric"], options].concat());
        let written = fs::read(folder.path().join("viewrank/manifest.json")).unwrap();
        let written: Value = serde_json::from_slice(&written).unwrap();
        (said, written["backend"].as_str().unwrap().to_owned())
    };
    planned(&["--backend", "pairs,mve"]);
    let (said, backend) = planned(&["--budget", "3"]);
    assert_eq!(backend, "pairs");
    assert!(said.contains("as planned before; --backend"), "{said}");
    assert!(folder.path().join("viewrank/mve").is_dir());
    // A name on the command line or in the settings counts for more.
    assert_eq!(planned(&["--backend", "sgm"]).1, "sgm");
    fs::write(
        folder.path().join("viewrank.toml"),
        "backends = [\"mve\"]\n",
    )
    .unwrap();
    let (said, backend) = planned(&[]);
    assert_eq!(backend, "mve");
    assert!(!said.contains("as planned before"), "{said}");
}
