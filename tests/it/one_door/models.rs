//! Of several models the richest is taken, and the others are named.

use viewrank_io::project::{ModelContents, ModelFormat};

use super::*;

fn model() -> ColmapModel<'static> {
    ColmapModel::from_scene(&scene())
}

/// Writes the model with its first images only.
fn part(folder: &Folder, place: &str, images: usize) {
    let model = model();
    let use_of = |image: &ColmapImage| match number(&image.name) {
        number if number < images => ImageUse::Counting,
        _ => ImageUse::Removed,
    };
    let kept = model.reduced(use_of, 1);
    folder.colmap(place, &kept.unwrap());
}

fn number(name: &str) -> usize {
    name.strip_prefix("view_")
        .unwrap()
        .strip_suffix(".png")
        .unwrap()
        .parse()
        .unwrap()
}

fn without_tracks() -> ColmapModel<'static> {
    let mut model = model();
    model
        .points
        .iter_mut()
        .for_each(|point| point.track = Default::default());
    model
        .images
        .iter_mut()
        .for_each(|image| image.points2d = Default::default());
    model
}

/// Path of the model that is taken, and what is said of the others.
fn taken(folder: &Folder) -> (String, String) {
    let project = folder.open();
    let warnings = project.read_scene().unwrap().warnings;
    let kinds = [WarningKind::OtherModels, WarningKind::OtherParts];
    let others = warnings
        .iter()
        .find(|warning| kinds.contains(&warning.kind));
    (
        project.model_path(),
        others.map_or(String::new(), |warning| warning.text.clone()),
    )
}

#[test]
fn a_model_that_is_a_pointer_is_not_passed_over() {
    let pointer = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n";
    for file in ["images", "points3D"] {
        let folder = Folder::new();
        folder.pictures(&scene(), |name| format!("images/{name}"));
        folder.colmap("sparse/0", &model());
        part(&folder, "sparse/1", 5);
        folder.write(&format!("sparse/0/{file}.bin"), pointer);
        let (code, _, stderr) = folder.plan(&[]);
        assert_eq!(code, 1, "{stderr}");
        let file = format!("sparse/0/{file}.bin is a Git LFS pointer");
        assert!(stderr.contains(&file), "{stderr}");
        assert!(stderr.contains("to plan without it: --model 1"), "{stderr}");
        let (code, _, stderr) = folder.plan(&["--model", "1"]);
        assert_eq!(code, 0, "{stderr}");
    }
}

#[test]
fn the_models_that_instant_ngp_is_made_from_come_before_its_own() {
    let folder = Folder::new();
    folder
        .colmap_text("colmap_text", &model())
        .write("transforms.json", transforms(&scene()))
        .pictures(&scene(), |name| format!("images/{name}"));
    assert_eq!(taken(&folder).0, "colmap_text");
    folder.colmap("colmap_sparse/0", &model());
    part(&folder, "colmap_text", 5);
    for file in ["cameras", "images", "points3D"] {
        fs::remove_file(folder.at(&format!("colmap_text/{file}.txt"))).unwrap();
    }
    let (model, others) = taken(&folder);
    assert_eq!(model, "colmap_sparse/0");
    assert!(others.contains("colmap_text (5 images)"), "{others}");
}

#[test]
fn a_model_that_is_passed_over_is_planned_by_itself() {
    let folder = Folder::new();
    folder.pictures(&scene(), |name| format!("images/{name}"));
    folder.colmap("sparse/0", &model());
    part(&folder, "sparse/1", 5);
    let (_, _, stderr) = folder.plan(&[]);
    let other = folder.at("sparse/1");
    let command = format!("viewrank plan {}", other.display());
    assert!(stderr.contains(&command), "{stderr}");
    let (code, _, stderr) = said(&viewrank(&["plan", other.to_str().unwrap()]));
    assert_eq!(code, 0, "{stderr}");
}

#[test]
fn images_that_a_list_of_a_trainer_names_are_kept_for_tests() {
    for lists in [
        &[("sparse/0/test.txt", "view_2.png\nview_7.png\n")][..],
        &[(
            "test_list.txt",
            "images/VIEW_7.PNG\r\n./view_2\r\nother.png\r\n",
        )],
        &[(
            "transforms.json",
            r#"{"frames":[],"test_filenames":["images/view_2.png","view_7.jpg"]}"#,
        )],
        &[
            ("sparse/0/test.txt", "another.png\n"),
            ("test_list.txt", "view_2.png\nview_7.png\nview_4.png\n"),
            ("train_list.txt", "view_3.png\nview_4.png\n"),
        ],
    ] {
        let folder = Folder::new();
        folder.colmap("sparse/0", &model());
        for (list, names) in lists {
            folder.write(list, names);
        }
        folder.pictures(&scene(), |name| format!("images/{name}"));
        let (code, _, stderr) = folder.plan(&["--backend", "splat", "--budget", "9"]);
        assert_eq!(code, 0, "{stderr}");
        let written =
            |name| fs::read_to_string(folder.at(&format!("viewrank/splat/{name}"))).unwrap();
        let trained = written("train_list.txt");
        assert_eq!(written("test_list.txt"), "view_2.png\nview_7.png\n");
        assert!(
            !trained.contains("view_2") && !trained.contains("view_7"),
            "{trained}"
        );
    }
    // Of all images none would be left.
    let folder = Folder::new();
    let all: String = (0..9).map(|n| format!("view_{n}.png\n")).collect();
    folder
        .colmap("sparse/0", &model())
        .write("test_list.txt", all);
    let scene = folder.read();
    assert_eq!(scene.tests, []);
    assert!(
        scene.warnings[0].text.contains("names all images"),
        "{:?}",
        scene.warnings
    );
    folder.write("test_list.txt", "view_2.png\nanother.png\n");
    let scene = folder.read();
    assert_eq!(scene.tests.len(), 1);
    assert!(
        scene.warnings[0].text.contains("names another.png"),
        "{:?}",
        scene.warnings
    );
}

#[cfg(unix)]
#[test]
fn a_model_of_links_to_nothing_is_to_be_fetched() {
    let folder = Folder::new();
    fs::create_dir_all(folder.at("sparse/0")).unwrap();
    for file in ["cameras", "images", "points3D"] {
        let link = folder.at(&format!("sparse/0/{file}.bin"));
        std::os::unix::fs::symlink("../../.git/annex/objects/x", link).unwrap();
    }
    folder.pictures(&scene(), |name| format!("images/{name}"));
    let (code, _, stderr) = folder.plan(&[]);
    assert_eq!(code, 1);
    assert!(
        stderr.contains("cameras.bin is a link to a file that is not there"),
        "{stderr}"
    );
}

#[test]
fn a_plan_of_an_export_for_splats_keeps_none_of_its_training_images_apart() {
    let folder = Folder::new();
    folder.colmap("sparse/0", &model());
    folder.pictures(&scene(), |name| format!("images/{name}"));
    let (code, _, stderr) = folder.plan(&["--backend", "splat", "--budget", "6"]);
    assert_eq!(code, 0, "{stderr}");
    let export = Project::open(&folder.at("viewrank/splat"), None).unwrap();
    assert_eq!(export.read_scene().unwrap().tests, []);
}

#[test]
fn a_pointer_that_is_never_taken_is_no_error() {
    let folder = Folder::new();
    let pointer = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n";
    folder
        .colmap("sparse/0", &model())
        .write("transforms.json", pointer);
    assert_eq!(taken(&folder).0, "sparse/0");
}

#[test]
fn tracks_come_before_more_images_without() {
    let folder = Folder::new();
    folder.colmap("sparse/0", &without_tracks());
    part(&folder, "sparse/1", 6);
    let (model, others) = taken(&folder);
    assert_eq!(model, "sparse/1");
    assert!(others.contains("0 (9 images)"), "{others}");
    assert_eq!(folder.open().model.contents, ModelContents::Tracks);
}

#[test]
fn the_folders_of_other_programs_are_searched() {
    for place in [
        "colmap/sparse/0",
        "distorted/sparse/0",
        "colmap",
        "output/sfm",
        "work/sparse",
    ] {
        let folder = Folder::new();
        folder
            .colmap(place, &model())
            .pictures(&scene(), |name| format!("input/{name}"));
        assert_eq!(taken(&folder).0, place);
        let images = folder.open().images.unwrap();
        assert_eq!(images.to_path_buf(), folder.at("input"), "{place}");
    }
}

#[test]
fn the_doctor_knows_the_same_images_under_the_names_of_another_program() {
    let folder = Folder::new();
    folder
        .colmap("colmap/sparse/0", &model())
        .pictures(&scene(), |name| format!("images/{name}"));
    let advice = || {
        let (_, said, _) = said(&viewrank(&["doctor", folder.path().to_str().unwrap()]));
        said.split_whitespace().collect::<Vec<_>>().join(" ")
    };
    let frames = |name: &dyn Fn(&str) -> String| -> String {
        let pose = "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]";
        let scene = scene();
        let frame = |view: &viewrank_core::model::scene::View| {
            let path = name(&view.name);
            format!(r#"{{"file_path":"{path}","transform_matrix":{pose}}}"#)
        };
        let frames: Vec<String> = scene.views.iter().map(frame).collect();
        let camera = r#""w":200,"h":150,"fl_x":190,"fl_y":190,"cx":100,"cy":75"#;
        format!("{{{camera},\"frames\":[{}]}}", frames.join(","))
    };
    folder.write(
        "transforms.json",
        frames(&|name| format!("./images/{name}")),
    );
    let same = advice();
    assert!(
        same.contains("not transforms.json") && same.contains("no action needed"),
        "{same}"
    );
    folder.write("transforms.json", frames(&|name| format!("images/x{name}")));
    assert!(advice().contains("match images between them again in COLMAP"));
}

#[test]
fn models_in_binary_are_named_in_the_folders_of_their_programs() {
    let said = |place: &str| {
        let folder = Folder::new();
        // OpenMVG's list of images, which has no poses.
        let list = r#"{"sfm_data_version":"0.3","views":[],"intrinsics":[],"extrinsics":[]}"#;
        folder.write(place, "").write("matches/sfm_data.json", list);
        Project::open(folder.path(), None).unwrap_err().to_string()
    };
    assert!(said("MeshroomCache/StructureFromMotion/1a2b/sfm.abc").contains("Alembic"));
    assert!(said("reconstruction/sfm_data.bin").contains("OpenMVG's binary"));
}

#[test]
fn the_model_of_undistorted_images_comes_before_the_distorted_one_beside_it() {
    let folder = Folder::new();
    folder
        .colmap("sparse/0", &model())
        .colmap("distorted/sparse/0", &model());
    let (model, others) = taken(&folder);
    assert_eq!(model, "sparse/0");
    assert!(others.contains("distorted/sparse/0 (9 images)"), "{others}");
    // Names that two models have are told apart by the folders above.
    let other = Project::open(folder.path(), Some("distorted/sparse/0")).unwrap();
    assert_eq!(other.model_path(), "distorted/sparse/0");
    assert!(other.as_argument().ends_with("--model distorted/sparse/0"));
}

#[test]
fn a_model_of_another_program_counts_where_it_has_tracks_and_colmaps_has_none() {
    let folder = Folder::new();
    folder
        .write(
            "transforms.json",
            r#"{"w":100,"h":75,"fl_x":85,"frames":[]}"#,
        )
        .colmap("colmap/sparse/0", &model());
    let (model, others) = taken(&folder);
    assert_eq!(model, "colmap/sparse/0");
    assert!(others.contains("transforms.json"), "{others}");
    let poor = Folder::new();
    poor.colmap("sparse/0", &without_tracks())
        .write("model.nvm", nvm(&[9]));
    assert_eq!(poor.open().model.format, ModelFormat::Nvm);
}

#[test]
fn of_projects_in_folders_of_their_own_none_is_taken() {
    let folder = Folder::new();
    folder
        .colmap("east/sparse/0", &model())
        .colmap("west/sparse/0", &model());
    let (code, _, stderr) = folder.plan(&[]);
    assert_eq!(code, 1);
    assert!(
        stderr.contains("several folders") && stderr.contains("east"),
        "{stderr}"
    );
    folder.pictures(&scene(), |name| format!("images/{name}"));
    let (_, _, stderr) = folder.plan(&[]);
    let images = format!("--images {}", folder.at("images").display());
    assert!(stderr.contains(&images), "{stderr}");
}

/// Models of VisualSFM with so many cameras each.
fn nvm(models: &[usize]) -> String {
    let mut text = String::from("NVM_V3\n\n");
    for cameras in models {
        text += &format!("{cameras}\n");
        for n in 0..*cameras {
            text += &format!("view_{n}.png 85 1 0 0 0 {n} 0 0 0 0\n");
        }
        text += "1\n0 0 9 1 2 3 2 0 0 1 2 1 0 1 2\n";
    }
    text + "0\n"
}

/// The views of a scene as nerfstudio's, which look along -z with y up.
fn transforms(scene: &Scene) -> String {
    let frame = |view: &viewrank_core::model::scene::View| {
        let pose = &view.cam_from_world;
        let (turned, centre) = (pose.rotation.inverse(), pose.centre());
        let row = |i: usize| {
            let m = turned.matrix();
            let (x, y, z) = (m[(i, 0)], -m[(i, 1)], -m[(i, 2)]);
            format!("[{x},{y},{z},{}]", centre[i])
        };
        let rows = [0, 1, 2].map(row).join(",");
        let name = &view.name;
        format!(r#"{{"file_path":"images/{name}","transform_matrix":[{rows},[0,0,0,1]]}}"#)
    };
    let frames: Vec<String> = scene.views.iter().map(frame).collect();
    let frames = frames.join(",");
    format!(r#"{{"w":100,"h":75,"fl_x":85,"frames":[{frames}]}}"#)
}

#[test]
fn a_model_of_any_program_is_planned_in_a_watched_folder() {
    let folder = Folder::new();
    folder
        .write("site/transforms.json", transforms(&scene()))
        .cloud("site/points3d.ply", &scene())
        .pictures(&scene(), |name| format!("site/images/{name}"))
        .write(
            "site/viewrank.toml",
            "confidence.source = 'geometric'\nbackends = ['openmvs']\n",
        );
    let root = folder.path().to_str().unwrap();
    let (code, _, stderr) = said(&viewrank(&["watch", root, "--once"]));
    assert_eq!(code, 0, "{stderr}");
    let status = fs::read_to_string(folder.at("viewrank/status.json")).unwrap();
    let status: serde_json::Value = serde_json::from_str(&status).unwrap();
    assert_eq!(status["projects"][0]["project"], "site", "{status}");
    assert!(folder.at("site/viewrank/manifest.json").is_file());
}

#[test]
fn of_several_models_in_a_file_the_largest_is_read() {
    let folder = Folder::new();
    folder.write("model.nvm", nvm(&[2, 6, 3]));
    assert_eq!(folder.read().views.len(), 6);
    let (_, others) = taken(&folder);
    assert!(
        others.contains("model 1 (2 images), model 3 (3 images)"),
        "{others}"
    );
}

#[test]
fn the_largest_component_of_a_block_is_read() {
    let photo = |n: usize, component: &str| {
        let diagonal = |i: usize| f64::from(u8::from(i.is_multiple_of(4)));
        let rotation: String = (0..9)
            .map(|i| format!("<M_{0}{1}>{2}</M_{0}{1}>", i / 3, i % 3, diagonal(i)))
            .collect();
        format!(
            "<Photo><Id>{n}</Id><ImagePath>view_{n}.png</ImagePath><Component>{component}</Component><Pose><Rotation>{rotation}</Rotation>\
             <Center><x>{n}</x><y>0</y><z>0</z></Center></Pose></Photo>"
        )
    };
    let photos: String = [(0, "1"), (1, "2"), (2, "2"), (3, "2"), (4, "1")]
        .map(|(n, component)| photo(n, component))
        .concat();
    let measured =
        |n: usize| format!("<Measurement><PhotoId>{n}</PhotoId><x>50</x><y>30</y></Measurement>");
    let folder = Folder::new();
    folder.write(
        "block.xml",
        format!(
            "<BlocksExchange version=\"3.2\"><Block><Name>b</Name><Photogroups><Photogroup><ImageDimensions><Width>100</Width><Height>75</Height>\
             </ImageDimensions><FocalLengthPixels>85</FocalLengthPixels>{photos}</Photogroup></Photogroups><TiePoints><TiePoint><Position><x>2</x>\
             <y>0</y><z>9</z></Position>{}{}{}</TiePoint></TiePoints></Block></BlocksExchange>",
            measured(0),
            measured(2),
            measured(3)
        ),
    );
    let scene = folder.read();
    assert_eq!(names(&scene), ["view_1.png", "view_2.png", "view_3.png"]);
    assert_eq!(scene.observations(), 2);
    assert!(taken(&folder).1.contains("component 1 (2 images)"));
}

/// Cameras of Metashape: label, attributes, and the x of the centre or, without, no transform.
fn metashape(sensors: &str, cameras: &[(&str, &str, Option<f64>)]) -> String {
    let camera = |(n, (label, attributes, x)): (usize, &(&str, &str, Option<f64>))| {
        let transform = x.map_or(String::new(), |x| {
            format!("<transform>0 -1 0 {x} 1 0 0 0 0 0 1 0 0 0 0 1</transform>")
        });
        format!("<camera id=\"{n}\" label=\"{label}\" {attributes}>{transform}</camera>")
    };
    let cameras: String = cameras.iter().enumerate().map(camera).collect();
    format!(
        "<document version=\"2.0.0\"><chunk label=\"a\"><sensors>{sensors}</sensors><cameras>{cameras}</cameras></chunk></document>"
    )
}

fn sensor(id: u32, more: &str) -> String {
    format!(
        "<sensor id=\"{id}\" label=\"cam{id}\" type=\"frame\"><resolution width=\"100\" height=\"75\"/><calibration><f>85</f></calibration>{more}</sensor>"
    )
}

#[test]
fn slaves_of_a_rig_are_where_their_master_has_them() {
    let folder = Folder::new();
    let slave = "<rotation>0 0 1 0 1 0 -1 0 0</rotation><location>0.5 0 2</location>";
    let sensors = sensor(0, "") + &sensor(1, slave);
    // The slave comes before its master here.
    let cameras = [
        ("second", "sensor_id=\"1\" master_id=\"1\"", None),
        ("first", "sensor_id=\"0\"", Some(10.0)),
    ];
    folder
        .write("cameras.xml", metashape(&sensors, &cameras))
        .cloud("points.ply", &at(&[[10.0, 0.0, 9.0], [15.0, 0.5, 2.0]]));
    let scene = folder.read();
    assert_eq!(names(&scene), ["first", "second"]);
    let [first, second] = [0, 1].map(|view| scene.views[view].cam_from_world);
    // x of the master points along the world's y, its z along the world's.
    let centre = second.centre();
    assert!(
        (centre - nalgebra::Point3::new(10.0, 0.5, 2.0)).norm() < 1e-9,
        "{centre}"
    );
    assert!((first.viewing_direction() - nalgebra::Vector3::z()).norm() < 1e-9);
    // The slave looks along the master's x.
    assert!((second.viewing_direction() - nalgebra::Vector3::y()).norm() < 1e-9);
}

/// A scene of points alone.
fn at(points: &[[f64; 3]]) -> Scene {
    Scene {
        points: points.iter().map(|p| (*p).into()).collect(),
        ..Scene::default()
    }
}

#[test]
fn disabled_cameras_and_lesser_components_are_left_out() {
    let folder = Folder::new();
    let cameras = [
        ("a", "sensor_id=\"0\" component_id=\"4\"", Some(0.0)),
        (
            "b",
            "sensor_id=\"0\" component_id=\"4\" enabled=\"false\"",
            Some(1.0),
        ),
        (
            "c",
            "sensor_id=\"0\" component_id=\"4\" enabled=\"true\"",
            Some(2.0),
        ),
        ("d", "sensor_id=\"0\" component_id=\"5\"", Some(3.0)),
        ("e", "sensor_id=\"0\"", None),
    ];
    folder
        .write("cameras.xml", metashape(&sensor(0, ""), &cameras))
        .cloud("points.ply", &at(&[[1.0, 0.0, 9.0]]));
    let scene = folder.read();
    assert_eq!(names(&scene), ["a", "c"]);
    assert_eq!(scene.unregistered, ["e"]);
    let text: Vec<&str> = scene
        .warnings
        .iter()
        .map(|warning| &*warning.text)
        .collect();
    assert!(
        text.iter()
            .any(|text| text.contains("disabled camera b is")),
        "{text:?}"
    );
    assert!(
        text.iter()
            .any(|text| text.contains("component 5 (1 images)")),
        "{text:?}"
    );
}

#[test]
fn cameras_of_one_label_are_told_apart_by_their_folders() {
    let folder = Folder::new();
    let sensors = sensor(0, "") + &sensor(1, "");
    let cameras = [
        ("0001", "sensor_id=\"0\"", Some(0.0)),
        ("0001", "sensor_id=\"1\"", Some(1.0)),
    ];
    folder
        .write("cameras.xml", metashape(&sensors, &cameras))
        .cloud("points.ply", &at(&[[1.0, 0.0, 9.0]]));
    let one = scene();
    let one = Scene {
        views: one.views[..1].to_vec(),
        ..one
    };
    for camera in ["cam0", "cam1"] {
        folder.pictures(&one, |_| format!("images/{camera}/0001.png"));
    }
    assert_eq!(names(&folder.read()), ["cam0/0001.png", "cam1/0001.png"]);
}

#[test]
fn a_chunk_with_more_cameras_is_taken_before_the_first() {
    let folder = Folder::new();
    let one = metashape(&sensor(0, ""), &[("a", "sensor_id=\"0\"", Some(0.0))]);
    let two = metashape(
        &sensor(0, ""),
        &[
            ("b", "sensor_id=\"0\"", Some(0.0)),
            ("c", "sensor_id=\"0\"", Some(1.0)),
        ],
    );
    let joined = one.replace("</document>", "") + &two.replace("<document version=\"2.0.0\">", "");
    folder
        .write("cameras.xml", joined)
        .cloud("points.ply", &at(&[[1.0, 0.0, 9.0]]));
    assert_eq!(names(&folder.read()), ["b", "c"]);
    assert!(taken(&folder).1.contains("chunk a (1 images)"));
    let in_list = two.replace("<chunk ", "<chunks><chunk ");
    folder.write(
        "cameras.xml",
        in_list.replace("</chunk>", "</chunk></chunks>"),
    );
    assert_eq!(names(&folder.read()), ["b", "c"]);
}

#[test]
fn the_undistorted_workspace_is_planned_where_the_backend_needs_it() {
    let folder = Folder::new();
    let mut distorted = model();
    let params = vec![85.0, 50.0, 37.5, 0.001];
    distorted.cameras[0] = Camera::new(1, CameraModel::SimpleRadial, 100, 75, params).unwrap();
    folder
        .colmap("sparse/0", &distorted)
        .pictures(&scene(), |name| format!("images/{name}"))
        .colmap("dense/0/sparse", &model())
        .pictures(&scene(), |name| format!("dense/0/images/{name}"))
        .write("dense/0/stereo/fusion.cfg", "");
    let (code, stdout, stderr) = folder.plan(&["--backend", "openmvs"]);
    assert_eq!(code, 0, "{stderr}");
    assert!(stderr.contains("undistorted") && !stdout.contains("viewrank undistort"));
    assert!(folder.at("dense/0/viewrank/manifest.json").is_file());
    // Of a workspace with other poses, nothing is known.
    let mut moved = model();
    moved.images[0].cam_from_world.translation[0] += 1.0;
    folder.colmap("dense/0/sparse", &moved);
    let (code, ..) = folder.plan(&["--backend", "openmvs"]);
    assert_eq!(code, 1);
}

#[test]
fn an_enabled_chunk_is_taken_before_a_disabled_one() {
    let folder = Folder::new();
    let cameras = [
        ("a", "sensor_id=\"0\"", Some(0.0)),
        ("b", "sensor_id=\"0\"", Some(1.0)),
    ];
    let two = metashape(&sensor(0, ""), &cameras);
    let one = metashape(&sensor(0, ""), &[("c", "sensor_id=\"0\"", Some(2.0))]);
    let two = two.replace(
        "label=\"a\"><sensors",
        "label=\"old\" enabled=\"false\"><sensors",
    );
    let joined = two.replace("</document>", "") + &one.replace("<document version=\"2.0.0\">", "");
    folder
        .write("cameras.xml", joined)
        .cloud("points.ply", &at(&[[1.0, 0.0, 9.0]]));
    assert_eq!(names(&folder.read()), ["c"]);
    let others = taken(&folder).1;
    assert!(others.contains("disabled chunk old (2 images)"), "{others}");
}

#[test]
fn images_kept_for_tests_are_named_where_they_are_not_read() {
    let folder = Folder::new();
    let frames = r#"{"w":100,"h":75,"fl_x":85,"frames":[{"file_path":"a.png","transform_matrix":[[1,0,0,0],[0,1,0,0],[0,0,1,9]]}]}"#;
    folder
        .write("transforms_train.json", frames)
        .write("transforms_test.json", frames)
        .cloud("points.ply", &at(&[[0.0, 0.0, 0.0]]));
    let warnings = folder.read().warnings;
    assert!(
        warnings
            .iter()
            .any(|said| said.text.contains("transforms_test.json")),
        "{warnings:?}"
    );
}

#[test]
fn cameras_that_are_all_disabled_are_said_to_be() {
    let folder = Folder::new();
    let cameras = [
        ("a", "sensor_id=\"0\" enabled=\"false\"", Some(0.0)),
        ("b", "sensor_id=\"0\" enabled=\"false\"", Some(1.0)),
    ];
    folder
        .write("cameras.xml", metashape(&sensor(0, ""), &cameras))
        .cloud("points.ply", &at(&[[1.0, 0.0, 9.0]]));
    let root = folder.path().to_str().unwrap();
    let (_, plan, why) = folder.plan(&[]);
    let (_, doctor, _) = said(&viewrank(&["doctor", root]));
    for said in [plan + &why, doctor] {
        let said = said.split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(said.contains("2 disabled cameras"), "{said}");
        assert!(said.contains("enable the cameras in Metashape"), "{said}");
    }
}
