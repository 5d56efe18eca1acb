//! Undistorted models and the images that they were made from are told apart, and the advice where
//! something is missing can be followed.

use super::{images::renamed, *};

/// The model of a camera with lens distortion.
pub fn distorted() -> ColmapModel<'static> {
    let mut model = ColmapModel::from_scene(&scene());
    let params = vec![85.0, 50.0, 37.5, 0.001];
    model.cameras[0] = Camera::new(1, CameraModel::SimpleRadial, 100, 75, params).unwrap();
    model
}

/// The model in other poses.
fn moved() -> ColmapModel<'static> {
    let mut model = ColmapModel::from_scene(&scene());
    model.images[0].cam_from_world.translation[0] += 1.0;
    model
}

/// A workspace of undistorted images.
pub fn workspace<'a>(folder: &'a Folder, place: &str, model: &ColmapModel) -> &'a Folder {
    folder
        .colmap(&format!("{place}/sparse"), model)
        .pictures(&scene(), |name| format!("{place}/images/{name}"))
        .write(&format!("{place}/stereo/fusion.cfg"), "")
}

/// The command that plan says is next.
fn next(stdout: &str) -> String {
    let line = stdout.lines().find(|line| line.starts_with("Next: "));
    line.unwrap_or_else(|| panic!("{stdout}"))[6..].into()
}

#[test]
fn a_workspace_is_not_planned_with_the_images_it_was_made_from() {
    let folder = Folder::new();
    folder
        .colmap("sparse/0", &distorted())
        .pictures(&scene(), |name| format!("images/{name}"))
        .colmap("dense/sparse", &ColmapModel::from_scene(&scene()))
        .write("dense/stereo/fusion.cfg", "");
    let (code, stdout, stderr) = folder.plan(&["--backend", "openmvs"]);
    assert_eq!(code, 1, "{stderr}");
    assert!(!stderr.contains("planning"), "{stderr}");
    assert!(stderr.contains("viewrank undistort"), "{stderr}");
    assert!(next(&stdout).starts_with("viewrank undistort"), "{stdout}");

    let dense = Project::open(&folder.at("dense"), None).unwrap();
    assert!(dense.images.is_none());
    let said = dense.read_scene().unwrap().warnings;
    assert!(
        said.iter()
            .any(|said| said.text.contains("distorted model")),
        "{said:?}"
    );
    // Named by the user, they are meant.
    let named = dense.with_images(Some(&folder.at("images")));
    assert!(named.originals.is_none() && named.read_scene().is_ok());
    let root = folder.path().to_str().unwrap();
    assert!(viewrank(&["undistort", root]).status.success());
    let (code, _, stderr) = folder.plan(&["--backend", "openmvs"]);
    assert_eq!(code, 0, "{stderr}");
}

#[test]
fn a_model_of_gaussian_splatting_is_not_planned_with_its_input() {
    let folder = Folder::new();
    folder
        .colmap("sparse/0", &ColmapModel::from_scene(&scene()))
        .pictures(&scene(), |name| format!("input/{name}"));
    // Pictures without distortion may be kept there, too.
    assert!(folder.open().images.unwrap().ends_with("input"));
    folder.colmap("distorted/sparse/0", &distorted());
    let (code, stdout, stderr) = folder.plan(&["--backend", "openmvs"]);
    assert_eq!(code, 1, "{stderr}");
    assert!(stderr.contains("input"), "{stderr}");
    assert!(next(&stdout).contains("undistorted images"), "{stdout}");
    folder.pictures(&scene(), |name| format!("images/{name}"));
    assert!(folder.open().images.unwrap().ends_with("images"));
}

#[test]
fn a_workspace_without_its_images_is_made_anew_and_planned() {
    let folder = Folder::new();
    folder
        .colmap("sparse/0", &distorted())
        .pictures(&scene(), |name| format!("images/{name}"));
    // As automatic_reconstructor left it, without the images, which are large.
    workspace(&folder, "dense/0", &ColmapModel::from_scene(&scene()));
    std::fs::remove_dir_all(folder.at("dense/0/images")).unwrap();
    let root = folder.path().to_str().unwrap();
    let (_, _, stderr) = folder.plan(&["--backend", "openmvs"]);
    assert!(stderr.contains("viewrank undistort"), "{stderr}");
    let undistorted = viewrank(&["undistort", root]);
    assert!(undistorted.status.success(), "{undistorted:?}");
    let (code, _, stderr) = folder.plan(&["--backend", "openmvs"]);
    assert_eq!(code, 0, "{stderr}");
}

#[test]
fn a_distorted_model_of_gaussian_splatting_has_its_input() {
    let folder = Folder::new();
    folder
        .colmap("gs/distorted/sparse/0", &distorted())
        .pictures(&scene(), |name| format!("gs/images/{name}"))
        .pictures(&scene(), |name| format!("gs/input/{name}"));
    for project in ["gs", "gs/distorted"] {
        let project = Project::open(&folder.at(project), None).unwrap();
        assert_eq!(project.images.unwrap().to_path_buf(), folder.at("gs/input"));
    }
    folder.colmap("gs/sparse/0", &ColmapModel::from_scene(&scene()));
    let project = Project::open(&folder.at("gs"), None).unwrap();
    assert!(project.images.unwrap().ends_with("gs/images"));
    let project = Project::open(&folder.at("gs"), Some("distorted/sparse/0")).unwrap();
    assert!(project.images.unwrap().ends_with("gs/input"));
}

#[test]
fn the_folder_of_colmap_in_a_project_of_nerfstudio_stands_for_it() {
    let folder = Folder::new();
    folder
        .colmap("ns/colmap/sparse/0", &ColmapModel::from_scene(&scene()))
        .pictures(&scene(), |name| format!("ns/images/{name}"));
    let colmap = folder.at("ns/colmap");
    let plan = viewrank(&["plan", colmap.to_str().unwrap(), "--backend", "openmvs"]);
    assert!(
        plan.status.success(),
        "{}",
        String::from_utf8_lossy(&plan.stderr)
    );
    assert!(folder.at("ns/viewrank/manifest.json").is_file());
}

#[test]
fn without_images_the_advice_is_to_give_them_before_they_are_undistorted() {
    let folder = Folder::new();
    folder.colmap("sparse/0", &distorted());
    for options in [
        &["--backend", "openmvs"][..],
        &["--backend", "openmvs", "--dry-run"],
    ] {
        let (code, stdout, stderr) = folder.plan(options);
        assert_eq!(code, 1, "{stderr}");
        assert!(stderr.contains("put the images into"), "{stderr}");
        assert!(next(&stdout).starts_with("put the images into"), "{stdout}");
    }
    folder.pictures(&scene(), |name| format!("images/{name}"));
    let (_, stdout, stderr) = folder.plan(&["--backend", "openmvs", "--dry-run"]);
    assert!(stderr.contains("viewrank undistort"), "{stderr}");
    assert!(next(&stdout).starts_with("viewrank undistort"), "{stdout}");
}

#[test]
fn a_workspace_of_other_poses_is_named_and_not_advised() {
    let folder = Folder::new();
    folder
        .colmap("sparse/0", &distorted())
        .pictures(&scene(), |name| format!("images/{name}"));
    workspace(&folder, "dense/0", &moved());
    let root = folder.path().to_str().unwrap();
    let (code, stdout, stderr) = folder.plan(&["--backend", "openmvs"]);
    assert_eq!(code, 1, "{stderr}");
    assert!(stderr.contains("other poses"), "{stderr}");
    assert!(!stderr.contains("plan and export"), "{stderr}");
    assert!(next(&stdout).starts_with("viewrank undistort"), "{stdout}");
    let (_, stdout, _) = said(&viewrank(&["doctor", root]));
    let words: Vec<&str> = stdout.split_whitespace().collect();
    assert!(words.join(" ").contains("in other poses"), "{stdout}");

    assert!(viewrank(&["undistort", root]).status.success());
    let (code, _, stderr) = folder.plan(&["--backend", "openmvs"]);
    assert_eq!(code, 0, "{stderr}");
    assert!(folder.at("dense/viewrank/manifest.json").is_file());
}

#[test]
fn a_workspace_of_somebody_else_is_not_mixed_with_viewrank_s() {
    let folder = Folder::new();
    folder
        .colmap("sparse/0", &distorted())
        .pictures(&scene(), |name| format!("images/{name}"));
    workspace(&folder, "dense", &moved());
    let root = folder.path().to_str().unwrap();
    let model = fs::read(folder.at("dense/sparse/images.bin")).unwrap();
    let (_, stdout, _) = folder.plan(&["--backend", "openmvs"]);
    let undistorted = folder.at("undistorted").display().to_string();
    assert!(next(&stdout).contains(&undistorted), "{stdout}");
    let dense = folder.at("dense").display().to_string();
    let (code, _, stderr) = said(&viewrank(&["undistort", root, "--out", &dense]));
    assert_eq!(code, 1);
    assert!(
        stderr.contains("its model is not viewrank's") && stderr.contains("--out"),
        "{stderr}"
    );
    assert!(viewrank(&["undistort", root]).status.success());
    let (code, _, stderr) = folder.plan(&["--backend", "openmvs"]);
    assert_eq!(code, 0, "{stderr}");
    assert!(folder.at("undistorted/viewrank/manifest.json").is_file());
    assert_eq!(
        fs::read(folder.at("dense/sparse/images.bin")).unwrap(),
        model
    );
}

#[test]
fn a_workspace_of_another_usual_name_is_found() {
    let folder = Folder::new();
    folder
        .colmap("sparse/0", &distorted())
        .pictures(&scene(), |name| format!("images/{name}"));
    workspace(&folder, "undistorted", &ColmapModel::from_scene(&scene()));
    let (code, _, stderr) = folder.plan(&["--backend", "openmvs"]);
    assert_eq!(code, 0, "{stderr}");
    assert!(folder.at("undistorted/viewrank/manifest.json").is_file());
}

#[test]
fn undistorting_a_model_without_points_says_what_to_do_before_a_plan() {
    let folder = Folder::new();
    let mut model = distorted();
    model.points.clear();
    for image in &mut model.images {
        image.points2d = Default::default();
    }
    folder
        .colmap("sparse/0", &model)
        .pictures(&scene(), |name| format!("images/{name}"));
    let (code, stdout, stderr) = said(&viewrank(&["undistort", folder.path().to_str().unwrap()]));
    assert_eq!(code, 0, "{stderr}");
    assert!(
        next(&stdout).starts_with("copy them as a PLY cloud"),
        "{stdout}"
    );
    folder.cloud("dense/sparse/points.ply", &scene());
    let dense = folder.at("dense");
    let (code, _, stderr) = said(&viewrank(&[
        "plan",
        dense.to_str().unwrap(),
        "--backend",
        "openmvs",
    ]));
    assert_eq!(code, 0, "{stderr}");
}

/// A model of OpenSfM; the names end on `added`, as those of undistorted images do.
fn opensfm(scene: &Scene, k1: f64, added: &str) -> String {
    let shot = |view: &viewrank_core::model::scene::View| {
        let pose = &view.cam_from_world;
        let [rotation, translation] = [pose.rotation.scaled_axis(), pose.translation];
        serde_json::json!({
            "camera": "c", "rotation": rotation.as_slice(), "translation": translation.as_slice(),
        })
    };
    let shots: serde_json::Map<_, _> = scene
        .views
        .iter()
        .map(|view| (format!("{}{added}", view.name), shot(view)))
        .collect();
    let points: serde_json::Map<_, _> = (0..)
        .zip(&scene.points)
        .map(|(n, x): (u32, _)| {
            (
                n.to_string(),
                serde_json::json!({"coordinates": [x.x, x.y, x.z]}),
            )
        })
        .collect();
    let camera = serde_json::json!({
        "projection_type": "perspective", "width": 100, "height": 75, "focal": 0.85, "k1": k1, "k2": 0.0,
    });
    serde_json::json!([{ "cameras": {"c": camera}, "shots": shots, "points": points }]).to_string()
}

#[test]
fn images_that_opensfm_has_undistorted_are_planned() {
    let folder = Folder::new();
    let scene = scene();
    folder
        .write("opensfm/reconstruction.json", opensfm(&scene, -0.03, ""))
        .pictures(&scene, |name| format!("images/{name}"))
        .write(
            "opensfm/undistorted/reconstruction.json",
            opensfm(&scene, 0.0, ".tif"),
        )
        .pictures(&scene, |name| {
            format!("opensfm/undistorted/images/{name}.tif")
        });
    let (code, stdout, stderr) = folder.plan(&["--backend", "odm"]);
    assert_eq!(code, 0, "{stdout}{stderr}");
    assert!(stderr.contains("opensfm/undistorted"), "{stderr}");
    assert!(
        folder
            .at("opensfm/undistorted/viewrank/odm/run.sh")
            .is_file()
    );
    // Only of the same poses.
    let mut moved = scene.clone();
    moved.views[0].cam_from_world.translation.x += 1.0;
    folder.write(
        "opensfm/undistorted/reconstruction.json",
        opensfm(&moved, 0.0, ".tif"),
    );
    let (code, stdout, stderr) = folder.plan(&["--backend", "odm"]);
    assert_eq!(code, 1, "{stdout}{stderr}");
}

#[test]
fn images_that_opensfm_has_undistorted_are_enough_for_a_run() {
    let folder = Folder::new();
    let scene = scene();
    folder
        .write("opensfm/reconstruction.json", opensfm(&scene, -0.03, ""))
        .write(
            "opensfm/undistorted/reconstruction.json",
            opensfm(&scene, 0.0, ".tif"),
        )
        .pictures(&scene, |name| {
            format!("opensfm/undistorted/images/{name}.tif")
        });
    let root = folder.path().to_str().unwrap();
    // A program that makes no depth map.
    let program = env!("CARGO_BIN_EXE_viewrank");
    let options = [
        "--backend",
        "openmvs",
        "--program",
        program,
        "--budget",
        "1",
    ];
    let (code, _, stderr) = said(&viewrank(&[&["run", root][..], &options].concat()));
    assert_eq!(code, 1, "{stderr}");
    assert!(stderr.contains("made no depth map"), "{stderr}");
    let planned = folder.at("opensfm/undistorted/viewrank/manifest.json");
    assert!(planned.is_file(), "{stderr}");
}

#[test]
fn a_workspace_that_is_passed_over_for_another_is_named() {
    let folder = Folder::new();
    folder
        .colmap("sparse/0", &distorted())
        .pictures(&scene(), |name| format!("images/{name}"));
    let undistorted = ColmapModel::from_scene(&scene());
    workspace(&folder, "dense", &undistorted);
    workspace(&folder, "dense/1", &undistorted);
    let warnings = folder.read().warnings;
    let said = warnings
        .iter()
        .find(|said| said.text.contains("workspaces of undistorted images"));
    let said = &said.unwrap_or_else(|| panic!("{warnings:?}")).text;
    let place = |name: &str| folder.at(name).display().to_string();
    let [used, other] = ["dense", "dense/1"].map(place);
    assert!(
        said.contains(&format!("{used} is used, not {other}")),
        "{said}"
    );
    // Where the plan is in the workspace, too.
    for backend in ["openmvs", "colmap", "sgm"] {
        let (_, _, stderr) = folder.plan(&["--backend", backend]);
        let said = format!("{used} is used, not {other}");
        assert!(stderr.contains(&said), "{backend}: {stderr}");
    }
    // Both are there, and the one of the model's name comes first.
    workspace(&folder, "dense/0", &undistorted);
    let project = folder.open();
    assert_eq!(project.dense_workspace, Some(folder.at("dense/0")));
}

/// The model with names as some programs write them.
fn with_names(mut model: ColmapModel<'static>) -> ColmapModel<'static> {
    for image in &mut model.images {
        image.name = format!("./{}", image.name).into();
    }
    model
}

#[test]
fn a_workspace_of_plain_names_is_that_of_a_model_with_others() {
    let folder = Folder::new();
    folder
        .colmap("sparse/0", &with_names(distorted()))
        .pictures(&scene(), |name| format!("images/{name}"));
    let root = folder.path().to_str().unwrap();
    let undistorted = viewrank(&["undistort", root]);
    assert!(undistorted.status.success(), "{undistorted:?}");
    for backend in ["openmvs", "colmap"] {
        let (code, _, stderr) = folder.plan(&["--backend", backend]);
        assert_eq!(code, 0, "{stderr}");
        assert!(folder.at("dense/viewrank/manifest.json").is_file());
    }
    assert!(names(&folder.read()).contains(&"view_0.png"));

    // As COLMAP undistorts it, with the names as they were.
    let folder = Folder::new();
    folder
        .colmap("sparse/0", &with_names(distorted()))
        .pictures(&scene(), |name| format!("images/{name}"));
    workspace(
        &folder,
        "dense",
        &with_names(ColmapModel::from_scene(&scene())),
    );
    let (code, _, stderr) = folder.plan(&["--backend", "colmap"]);
    assert_eq!(code, 0, "{stderr}");
    assert!(names(&folder.read()).contains(&"view_0.png"));
    let list = fs::read_to_string(folder.at("dense/stereo/patch-match.cfg")).unwrap();
    assert!(list.contains("./view_0.png"), "{list}");
}

#[test]
fn a_workspace_with_names_that_are_no_plain_paths_can_be_exported() {
    let taken = [
        ("./view_#.png", true),
        (".//view_#.png", true),
        ("may/.//view_#.png", true),
        (r"may\view_#.png", true),
        ("may/../view_#.png", false),
        ("../images/view_#.png", false),
    ];
    for (pattern, colmap_takes_it) in taken {
        let folder = Folder::new();
        let name = |n: usize| pattern.replace('#', &n.to_string());
        workspace(&folder, ".", &renamed(name));
        folder
            .pictures(&scene(), |name| format!("images/may/{name}"))
            .write("stereo/depth_maps/notes.txt", "");
        let project = folder.open();
        let read = project.read_scene().unwrap();
        assert_eq!(project.image_faults(&read).missing, [], "{pattern}");
        for backend in ["openmvs", "sgm", "splat", "pairs", "mvsnet"] {
            let (code, _, stderr) = folder.plan(&["--backend", backend]);
            assert_eq!(code, 0, "{pattern} for {backend}: {stderr}");
        }
        let (code, _, stderr) = folder.plan(&["--backend", "colmap"]);
        let list = fs::read_to_string(folder.at("stereo/patch-match.cfg"));
        if colmap_takes_it {
            let list = list.unwrap_or_else(|_| panic!("{pattern}: {stderr}"));
            let lines = list.lines().filter(|line| !line.starts_with('#'));
            let mut listed = lines.flat_map(|line| line.split(", ")).peekable();
            let names: Vec<String> = (0..9).map(name).collect();
            assert!(listed.peek().is_some(), "{pattern}: {list}");
            assert!(
                listed.all(|listed| names.iter().any(|name| name == listed)),
                "{list}"
            );
        } else {
            assert!(code == 1 && stderr.contains("--out"), "{pattern}: {stderr}");
        }
    }
}

#[test]
fn the_workspace_beside_a_model_further_below_is_found() {
    let folder = Folder::new();
    folder
        .colmap("scene/sparse/0", &distorted())
        .pictures(&scene(), |name| format!("scene/images/{name}"));
    workspace(&folder, "scene/dense", &ColmapModel::from_scene(&scene()));
    let project = folder.open();
    assert_eq!(project.dense_workspace, Some(folder.at("scene/dense")));
    assert!(
        project.other_models.is_empty(),
        "{:?}",
        project.other_models
    );
    for backend in ["openmvs", "sgm"] {
        let (code, _, stderr) = folder.plan(&["--backend", backend]);
        assert_eq!(code, 0, "{stderr}");
        assert!(
            folder.at("scene/dense/viewrank/manifest.json").is_file(),
            "{stderr}"
        );
    }
    // A model that is in a workspace alone is still one.
    let folder = Folder::new();
    workspace(&folder, "scene/dense", &ColmapModel::from_scene(&scene()));
    assert_eq!(folder.read().views.len(), 9);
}
