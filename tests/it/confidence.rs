//! Pictures and masks as they matter to a plan: `viewrank plan --confidence photometric`.

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use serde_json::Value;
use viewrank::Settings;
use viewrank_core::base::progress::NoWatcher;
use viewrank_io::{npy, project::Project};

use super::valley::{printed, project, viewrank as program};

/// Plans with pictures and returns the manifest.
fn plan(project: &Path, options: &[&str]) -> Value {
    let confidence = if options.contains(&"--confidence") {
        &[][..]
    } else {
        &["--confidence", "photometric"]
    };
    printed(
        &[
            &["plan", project.to_str().unwrap(), "--quiet"],
            options,
            confidence,
        ]
        .concat(),
    );
    serde_json::from_slice(&fs::read(project.join("viewrank/manifest.json")).unwrap()).unwrap()
}

fn images(project: &Path) -> Vec<PathBuf> {
    let mut images: Vec<_> = fs::read_dir(project.join("images"))
        .unwrap()
        .map(|e| e.unwrap().path())
        .collect();
    images.sort();
    images
}

/// The share of each visible (view, triangle) that masks allow.
fn allowed(project: &Path, options: &[&str]) -> Vec<(u32, f32)> {
    let tables = project.join("tables");
    plan(
        project,
        &[options, &["--dump-tables", tables.to_str().unwrap()]].concat(),
    );
    let read = |name: &str| fs::read(tables.join(name)).unwrap();
    let (visible, allowed) = (read("visible.npy"), read("allowed.npy"));
    let views: Vec<u32> = npy::read(&visible).unwrap().values().unwrap();
    let values: Vec<f32> = npy::read(&allowed).unwrap().values().unwrap();
    views
        .chunks_exact(2)
        .map(|row| row[0])
        .zip(values)
        .collect()
}

fn warnings(manifest: &Value) -> String {
    manifest["warnings"].to_string()
}

#[test]
fn auto_compares_the_pictures_where_there_are_any() {
    let project = project();
    let source = |manifest: &Value| {
        manifest["settings"]["confidence"]["source"]
            .as_str()
            .unwrap()
            .to_owned()
    };
    let auto = |backend| {
        plan(
            project.path(),
            &["--confidence", "auto", "--backend", backend],
        )
    };
    assert_eq!(source(&auto("sgm")), "photometric");
    assert_eq!(source(&auto("sure")), "photometric");
    fs::remove_dir_all(project.path().join("images")).unwrap();
    let without = program(&[
        "plan",
        project.path().to_str().unwrap(),
        "--confidence",
        "auto",
        "--backend",
        "sgm",
        "--quiet",
    ]);
    assert_eq!(
        without.status.code(),
        Some(1),
        "planned, but not exported: the matcher needs the images"
    );
    let manifest = fs::read(project.path().join("viewrank/manifest.json")).unwrap();
    assert_eq!(
        source(&serde_json::from_slice(&manifest).unwrap()),
        "geometric"
    );
}

#[test]
fn views_without_a_picture_are_judged_by_their_geometry() {
    let project = project();
    let all = images(project.path());
    fs::remove_file(&all[0]).unwrap();
    fs::write(&all[1], "no image").unwrap();
    let manifest = plan(
        project.path(),
        &["--confidence", "photometric", "--threads", "1"],
    );
    let named =
        |image: &Path| warnings(&manifest).contains(image.file_name().unwrap().to_str().unwrap());
    assert!(named(&all[0]) && named(&all[1]) && !named(&all[2]));
    assert!(
        warnings(&manifest).contains("images missing from"),
        "once, with its name"
    );
    assert!(warnings(&manifest).contains("(not an image)"));
    assert!(manifest["cut"]["reachable"].as_f64().unwrap() > 0.5);
    assert!(
        plan(
            project.path(),
            &["--confidence", "photometric", "--threads", "2"]
        ) == manifest,
        "on two threads"
    );
}

#[test]
fn a_second_plan_compares_no_pictures() {
    let project = project();
    let photometric = ["--confidence", "photometric", "--backend", "sgm"];
    plan(project.path(), &photometric);
    let settings = "backends = ['sgm']\nconfidence.source = 'photometric'";
    let settings: Settings = toml::from_str(settings).unwrap();
    let opened = Project::open(project.path(), None).unwrap();
    let second = viewrank::plan(&opened, &settings, &NoWatcher).unwrap();
    let new: Vec<String> = second.unwritten().into_iter().map(|set| set.name).collect();
    assert_eq!(new, [""; 0], "no stage has anything new");
    changed_images_are_read(project.path(), &photometric[..2]);
}

fn changed_images_are_read(project: &Path, options: &[&str]) {
    for image in images(project) {
        fs::write(&image, "no image").unwrap();
    }
    let manifest = plan(project, options);
    assert!(
        warnings(&manifest).contains("no JPEG, PNG or TIFF"),
        "{}",
        warnings(&manifest)
    );
    assert!(
        warnings(&manifest).contains("25 more like these"),
        "{}",
        warnings(&manifest)
    );
}

/// Programs that repair or rotate pictures keep their length and time at will.
#[cfg(unix)]
#[test]
fn an_image_overwritten_with_its_old_length_and_time_is_read_again() {
    let project = project();
    let first = plan(project.path(), &[]);
    for image in images(project.path()) {
        let mut bytes = fs::read(&image).unwrap();
        let (head, end) = (bytes.len() / 4, bytes.len() - 2);
        bytes[head..end].fill(0);
        let time = fs::metadata(&image).unwrap().modified().unwrap();
        fs::write(&image, bytes).unwrap();
        fs::OpenOptions::new()
            .write(true)
            .open(&image)
            .unwrap()
            .set_modified(time)
            .unwrap();
    }
    let second = plan(project.path(), &[]);
    assert_ne!(second["clusters"], first["clusters"]);
    assert_ne!(
        second["input"]["fingerprint"],
        first["input"]["fingerprint"]
    );
}

#[test]
fn a_damaged_cache_is_made_again() {
    let project = project();
    let plan = |threads| plan(project.path(), &["--threads", threads]);
    let first = plan("1");
    let cache = project.path().join("viewrank/cache/agreement.table");
    let good = fs::read(&cache).unwrap();
    let mut changed = good.clone();
    changed[good.len() * 3 / 4] ^= 1;
    for damaged in [&good[..good.len() / 2], &changed] {
        fs::write(&cache, damaged).unwrap();
        assert_eq!(plan("4"), first);
        assert_eq!(fs::read(&cache).unwrap(), good);
    }
}

#[test]
fn other_candidates_are_compared_anew() {
    let project = project();
    let photometric = |k| plan(project.path(), &["--confidence", "photometric", "-k", k]);
    let (few, many) = (photometric("2"), photometric("8"));
    fs::remove_dir_all(project.path().join("viewrank")).unwrap();
    assert!(
        photometric("8")["clusters"] == many["clusters"] && few["clusters"] != many["clusters"]
    );
}

#[test]
fn a_dry_run_keeps_no_cache() {
    let project = project();
    let output = program(&[
        "plan",
        project.path().to_str().unwrap(),
        "--confidence",
        "photometric",
        "--dry-run",
    ]);
    assert!(output.status.success());
    assert!(!project.path().join("viewrank").exists());
}

#[test]
fn what_a_mask_forbids_has_no_confidence() {
    let project = project();
    let image = &images(project.path())[3];
    let name = image.file_name().unwrap().to_str().unwrap();
    let [width, height] = image::image_dimensions(image).map(|(w, h)| [w, h]).unwrap();
    fs::create_dir(project.path().join("masks")).unwrap();
    let unused = &*format!(
        "no image has a mask in {}",
        project.path().join("masks").display()
    );
    for confidence in ["geometric", "geometric", "photometric"] {
        assert!(warnings(&plan(project.path(), &["--confidence", confidence])).contains(unused));
    }
    let mask = image::GrayImage::from_pixel(width, height, image::Luma([0]));
    mask.save(project.path().join(format!("masks/{name}.png")))
        .unwrap();
    let allowed = allowed(project.path(), &["--confidence", "geometric"]);
    assert!(
        allowed
            .iter()
            .all(|&(view, m)| m == if view == 3 { 0.0 } else { 1.0 })
    );
    // Nothing of the masked view can be matched, and nothing agrees with its picture: it can fulfil
    // nothing.
    let gains = |manifest: &Value| {
        let clusters = manifest["clusters"].as_array().unwrap().clone();
        clusters
            .iter()
            .filter(|cluster| cluster["key"] == name)
            .count()
    };
    for confidence in ["geometric", "photometric"] {
        let masked = plan(project.path(), &["--confidence", confidence]);
        assert_eq!(gains(&masked), 0, "{confidence}");
        assert!(!warnings(&masked).contains(unused));
    }
    fs::remove_dir_all(project.path().join("masks")).unwrap();
    assert_eq!(gains(&plan(project.path(), &[])), 1);
}

#[test]
fn a_project_without_images_is_planned_with_a_warning() {
    let project = project();
    fs::remove_dir_all(project.path().join("images")).unwrap();
    let manifest = plan(project.path(), &[]);
    assert!(
        warnings(&manifest).contains("no image folder"),
        "{}",
        warnings(&manifest)
    );
}

/// A device would be read without end, a pipe waited for.
#[cfg(unix)]
#[test]
fn what_is_no_file_is_neither_waited_for_nor_read_without_end() {
    let folder = project();
    let pipe = folder.path().join("pipe");
    let make_pipe =
        |path: &Path| assert!(Command::new("mkfifo").arg(path).status().unwrap().success());
    make_pipe(&pipe);
    let root = folder.path().to_str().unwrap();
    for file in ["/dev/zero", pipe.to_str().unwrap()] {
        let output = program(&["plan", root, "--quiet", "--mesh", file]);
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(
            !output.status.success() && message.contains("not a regular file"),
            "{file}: {message}"
        );
    }
    let [first, second, ..] = &images(folder.path())[..] else {
        panic!("no images")
    };
    fs::remove_file(first).unwrap();
    make_pipe(first);
    fs::remove_file(second).unwrap();
    std::os::unix::fs::symlink("/dev/zero", second).unwrap();
    let manifest = plan(folder.path(), &[]);
    let both = format!(
        "images that cannot be read: 2 of 28, e.g. {} (not a regular file)",
        first.file_name().unwrap().to_str().unwrap()
    );
    assert!(
        warnings(&manifest).contains(&both),
        "{}",
        warnings(&manifest)
    );

    // What is ours is refused where it is something else.
    for name in ["manifest.json", ".journal.json", ".lock"] {
        let own = folder.path().join("viewrank").join(name);
        let aside = folder.path().join("aside");
        let was_there = fs::rename(&own, &aside).is_ok();
        make_pipe(&own);
        let output = program(&["plan", root, "--quiet"]);
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(
            !output.status.success() && message.contains(name),
            "{name}: {message}"
        );
        fs::remove_file(&own).unwrap();
        if was_there {
            fs::rename(&aside, &own).unwrap();
        }
    }
    assert!(program(&["plan", root, "--quiet"]).status.success());
}

#[test]
fn predict_draws_the_key_views_of_a_plan() {
    let project = project();
    let manifest = plan(project.path(), &["--confidence", "photometric"]);
    let out = tempfile::tempdir().unwrap();
    let output = program(&[
        "predict",
        project.path().to_str().unwrap(),
        "--out",
        out.path().to_str().unwrap(),
    ]);
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    let chosen = manifest["cut"]["clusters"].as_u64().unwrap() as usize;
    let is_png = |path: PathBuf| path.extension().is_some_and(|extension| extension == "png");
    let pictures = fs::read_dir(out.path())
        .unwrap()
        .filter(|entry| is_png(entry.as_ref().unwrap().path()));
    assert_eq!(pictures.count(), chosen);
    let first = manifest["clusters"][0]["key"].as_str().unwrap();
    let array = fs::read(out.path().join(format!("{first}.npy"))).unwrap();
    let values: Vec<f32> = npy::read(&array).unwrap().values().unwrap();
    let known = || values.iter().filter(|v| !v.is_nan());
    assert!(
        known().all(|v| (0.0..=1.0).contains(v))
            && known().any(|&v| v > 0.9)
            && known().any(|&v| v < 0.5)
    );
    assert!(known().count() > values.len() / 2);
}
