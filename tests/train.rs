//! `viewrank train` and what its models do to a plan, on made-up depth maps of the fixture: those of its surface, with holes.

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Output},
};

use serde_json::Value;
use tempfile::TempDir;
use viewrank::internals::{
    backends,
    camera::Camera,
    config::Settings,
    plan::Plan,
    progress::NoWatcher,
    project::Project,
    scene::ViewIndex,
    tables,
    visibility::{NOTHING, front},
};

fn fixture() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/valley")
}

fn viewrank(arguments: &[&str]) -> Output {
    let nowhere = Path::new(env!("CARGO_TARGET_TMPDIR"));
    Command::new(env!("CARGO_BIN_EXE_viewrank")).args(arguments).env("XDG_CONFIG_HOME", nowhere).output().unwrap()
}

fn done(arguments: &[&str]) -> String {
    let output = viewrank(arguments);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

/// Exit code and stderr of a call that must fail.
fn failure(arguments: &[&str]) -> (i32, String) {
    let output = viewrank(arguments);
    (output.status.code().unwrap(), String::from_utf8(output.stderr).unwrap())
}

/// Depth of the surface at the centres of a reduced picture's pixels; none where it is seen at more than 45 degrees.
fn depth_map(plan: &Plan, view: ViewIndex, width: u32, height: u32) -> Vec<f32> {
    let scene = &plan.stages.scene;
    let (camera, pose): (&Camera, _) = (scene.camera_of(view), &scene.view(view).cam_from_world);
    let triangles = front(scene, &plan.stages.surface, view, width, height);
    let depth = |(at, &triangle): (usize, &u32)| {
        if triangle == NOTHING {
            return 0.0;
        }
        let (column, row) = (at % width as usize, at / width as usize);
        let share = |i: usize, n: u32, side: u32| (i as f64 + 0.5) / f64::from(n) * f64::from(side);
        let pixel = [share(column, width, camera.width), share(row, height, camera.height)].into();
        let ray = camera.ray(&pixel).unwrap();
        let normal = pose.rotation * plan.stages.surface.area_normal(triangle).normalize();
        let corner = pose.camera_from_world(&plan.stages.surface.corners(triangle)[0]);
        if -normal.dot(&ray) < 0.71 {
            return 0.0;
        }
        (normal.dot(&corner.coords) / normal.dot(&ray) * ray.z) as f32
    };
    triangles.iter().enumerate().map(depth).collect()
}

/// The fixture with depth maps in `sgm`, planned for that backend.
fn project() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    for part in ["sparse", "images"] {
        for entry in walkdir::WalkDir::new(fixture().join(part)) {
            let entry = entry.unwrap();
            let target = folder.path().join(entry.path().strip_prefix(fixture()).unwrap());
            if entry.file_type().is_dir() {
                fs::create_dir_all(target).unwrap();
            } else {
                fs::copy(entry.path(), target).unwrap();
            }
        }
    }
    done(&["plan", folder.path().to_str().unwrap(), "--backend", "sgm", "--confidence", "geometric", "--quiet"]);
    let project = Project::open(folder.path(), None).unwrap();
    let settings = Settings { backends: vec!["sgm".into()], ..Settings::default() };
    let plan = backends::plan(&project, &settings, &NoWatcher).unwrap();
    fs::create_dir(folder.path().join("sgm")).unwrap();
    for cluster in &plan.stages.clusters {
        let (width, height) = (200, 150);
        let array = tables::array(&[height, width], depth_map(&plan, cluster.key, width as u32, height as u32));
        fs::write(folder.path().join(format!("sgm/{}.npy", plan.stages.scene.name(cluster.key))), array).unwrap();
    }
    folder
}

fn train(project: &Path, model: &Path, threads: &str) -> Value {
    let [project, model] = [project, model].map(|path| path.to_str().unwrap());
    let options = ["--depth-maps", "sgm", "--out", model, "--threads", threads, "--quiet", "--format", "json"];
    serde_json::from_str(&done(&[&["train", project], &options[..]].concat())).unwrap()
}

#[test]
fn a_model_learns_what_fails_and_plans_with_it() {
    let project = project();
    let root = project.path().to_str().unwrap();
    let [one, four] = ["one.model", "four.model"].map(|name| project.path().join(name));
    let figures = train(project.path(), &one, "1");
    assert!(figures["auc"].as_f64().unwrap() > 0.9, "{figures}");
    assert!(figures["calibration_error"].as_f64().unwrap() < 0.1, "{figures}");
    train(project.path(), &four, "4");
    assert!(fs::read(&one).unwrap() == fs::read(&four).unwrap(), "threads change the model");

    let manifest = |options: &[&str]| -> Value {
        done(&[&["plan", root, "--backend", "sgm", "--quiet"], options].concat());
        serde_json::from_slice(&fs::read(project.path().join("viewrank/manifest.json")).unwrap()).unwrap()
    };
    let by_file = manifest(&["--confidence", one.to_str().unwrap(), "--threads", "1"]);
    assert_eq!(by_file["confidence_model"]["backend"], "sgm");
    assert_eq!(by_file["confidence_model"]["trained_on"][0]["views"], 28);
    assert!(by_file["confidence_model"]["distance"].as_f64().unwrap() < 1.5);
    // The project's own model is what auto takes.
    fs::rename(&one, project.path().join("viewrank/confidence.model")).unwrap();
    let by_itself = manifest(&["--threads", "4"]);
    assert_eq!(by_itself["settings"]["confidence"]["source"], "project");
    assert_eq!(by_itself["clusters"], by_file["clusters"]);
    let paper = fs::write(project.path().join("viewrank.toml"), "[confidence]\nform = \"paper\"\n");
    assert!(paper.is_ok() && manifest(&[])["clusters"] != by_file["clusters"]);
}

#[test]
fn broken_and_newer_models_are_refused_with_a_hint() {
    let project = tempfile::tempdir().unwrap();
    let model = project.path().join("a.model");
    let fixture = fixture();
    let plan = |text: &str| {
        fs::write(&model, text).unwrap();
        failure(&["plan", fixture.to_str().unwrap(), "--confidence", model.to_str().unwrap(), "--dry-run", "--quiet"])
    };
    for (text, message, hint) in [
        ("not a model", "a.model: not a model", "train the model again"),
        ("{\"format\": \"else\", \"version\": 1}", "it says that it is a \"else\"", "train the model again"),
        ("{\"format\": \"viewrank confidence model\", \"version\": 99}", "a model of version 99", "or a newer one"),
        ("{\"format\": \"viewrank confidence model\", \"version\": 2}", "missing field", "train the model again"),
    ] {
        let (code, stderr) = plan(text);
        assert_eq!(code, 1);
        assert!(stderr.contains(message) && stderr.contains(hint), "{stderr}");
    }
    let (code, stderr) = failure(&["plan", fixture.to_str().unwrap(), "--confidence", "nowhere.model", "--dry-run"]);
    assert!(code == 2 && stderr.contains("none, geometric, photometric, proxy, shipped, auto"), "{stderr}");
}

#[test]
fn nothing_to_learn_from_is_a_clear_error() {
    let out = tempfile::tempdir().unwrap();
    let model = out.path().join("m");
    let (code, stderr) =
        failure(&["train", fixture().to_str().unwrap(), "--depth-maps", "sgm", "--out", model.to_str().unwrap()]);
    assert!(code == 1 && stderr.contains("hint:") && !model.exists(), "{stderr}");
    fs::write(&model, "a photograph").unwrap();
    let (code, stderr) =
        failure(&["train", fixture().to_str().unwrap(), "--depth-maps", "sgm", "--out", model.to_str().unwrap()]);
    assert!(code == 1 && stderr.contains("a file is in the way"), "{stderr}");
    assert_eq!(fs::read_to_string(&model).unwrap(), "a photograph");
}

#[test]
fn predict_writes_a_picture_and_the_numbers() {
    let out = tempfile::tempdir().unwrap();
    let image = walkdir::WalkDir::new(fixture().join("images")).sort_by_file_name().into_iter();
    let image = image.filter_map(Result::ok).find(|e| e.file_type().is_file()).unwrap().into_path();
    done(&["predict", image.to_str().unwrap(), "--out", out.path().to_str().unwrap(), "--confidence", "proxy"]);
    let name = image.file_name().unwrap().to_str().unwrap();
    let array = fs::read(out.path().join(format!("{name}.npy"))).unwrap();
    let values: Vec<f32> = npyz::NpyFile::new(&array[..]).unwrap().into_vec().unwrap();
    assert!(values.iter().all(|v| (0.0..=1.0).contains(v)) && values.iter().any(|&v| v > 0.9));
    assert!(image::open(out.path().join(format!("{name}.png"))).is_ok());
    let (code, stderr) = failure(&["predict", "nowhere.jpg", "--out", out.path().to_str().unwrap()]);
    assert!(code == 1 && stderr.contains("nowhere.jpg"), "{stderr}");
}
