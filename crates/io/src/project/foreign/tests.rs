//! Projects of other programs, written by hand.

use std::fs;

use viewrank_core::{base::error::Hint, model::camera::CameraModel};

use crate::project::Project;

fn folder(files: &[(&str, &str)]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    for (name, text) in files {
        let path = folder.path().join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    }
    image::GrayImage::new(200, 100)
        .save(folder.path().join("a.png"))
        .unwrap();
    folder
}

#[test]
fn a_bundle_of_realitycapture_has_paths_of_windows_in_its_list() {
    let bundle = "# Bundle file v0.3\n1 1\n100 0 0\n1 0 0\n0 1 0\n0 0 1\n0 0 -5\n1 2 3\n10 20 30\n1 0 0 -20 10\n";
    let folder = folder(&[
        ("bundle.out", bundle),
        ("imagelist.lst", "C:\\photos\\a.png\r\n"),
    ]);
    let scene = Project::open(folder.path(), None)
        .unwrap()
        .read_scene()
        .unwrap();
    assert_eq!(
        (scene.views[0].name.as_str(), scene.track_pixels[0]),
        ("a.png", [80.0, 40.0])
    );
}

#[test]
fn of_a_folder_full_of_models_the_first_are_looked_at() {
    let folder = tempfile::tempdir().unwrap();
    for n in 0..200 {
        let empty = "<document version=\"2.0.0\"><chunk/></document>";
        fs::write(folder.path().join(format!("{n:03}.xml")), empty).unwrap();
        fs::write(folder.path().join(format!("{n:03}.nvm")), "NVM_V3\n").unwrap();
    }
    let listed = super::listed(folder.path());
    let first = |model: &crate::project::ModelLocation| {
        let name = model.path.file_stem().unwrap().to_str().unwrap();
        name.parse::<usize>().unwrap() < super::MOST_MODELS
    };
    assert_eq!(listed.len(), 2 * super::MOST_MODELS);
    assert!(listed.iter().all(first));
}

#[test]
fn nerfstudio_has_its_points_beside() {
    let frame = |name: &str, x: f64| {
        format!(
            r#"{{"file_path":"{name}","transform_matrix":[[1,0,0,{x}],[0,1,0,0],[0,0,1,9],[0,0,0,1]]}}"#
        )
    };
    let frames = format!(
        r#""frames":[{},{}]"#,
        frame("a.png", 0.0),
        frame("b.png", 1.0)
    );
    let json = format!(r#"{{"w":200,"h":100,"fl_x":90,"ply_file_path":"sparse_pc.ply",{frames}}}"#);
    let ply = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n0 0 0\n1 1 0\n";
    let folder = folder(&[("transforms.json", &json), ("sparse_pc.ply", ply)]);
    let scene = Project::open(folder.path(), None)
        .unwrap()
        .read_scene()
        .unwrap();
    assert_eq!(
        (
            scene.views.len(),
            scene.points.len(),
            scene.track_views.len()
        ),
        (2, 2, 4)
    );
    assert_eq!(scene.cameras[0].model(), CameraModel::Pinhole);
    // The first point lies before the first camera.
    assert_eq!(scene.track_pixels[0], [100.0, 50.0]);
}

const PLY: &str = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n";

/// Metashape's cameras with a transform to the world by 1000 along x, and a point.
fn metashape(point: &str) -> tempfile::TempDir {
    metashape_at("<translation>1000 0 0</translation>", point)
}

fn metashape_at(transform: &str, point: &str) -> tempfile::TempDir {
    let xml = r#"<document version="2.0.0"><chunk><sensors><sensor id="0" type="frame"><resolution width="200" height="100"/><calibration><f>90</f>
        </calibration></sensor></sensors><components><component id="0"><transform>TRANSFORM</transform></component>
        </components><cameras><camera id="0" label="a" sensor_id="0" component_id="0"><transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform>
        </camera></cameras></chunk></document>"#;
    folder(&[
        ("cameras.xml", &xml.replace("TRANSFORM", transform)),
        ("points.ply", &format!("{PLY}{point}\n")),
    ])
}

#[test]
fn a_georeferenced_chunk_of_metashape_is_on_earth_in_its_own_coordinates_too() {
    let on_the_equator = "<translation>6378137 0 0</translation><scale>2</scale>";
    let scene = |transform: &str| {
        let folder = metashape_at(transform, "0 0 9");
        let project = Project::open(&folder.path().join("cameras.xml"), None).unwrap();
        project.read_scene().unwrap()
    };
    let place = scene(on_the_equator).georeference.unwrap();
    assert_eq!(place.metres_per_unit(), Some(2.0));
    let at = place
        .geodetic(&nalgebra::Point3::new(50.0, 0.0, 0.0))
        .unwrap();
    assert!((at.height - 100.0).abs() < 1e-6, "{at:?}");
    assert_eq!(
        scene("<translation>1000 0 0</translation>").georeference,
        None
    );
}

#[test]
fn metashapes_points_may_be_those_of_the_world_or_of_the_chunk() {
    for (point, x) in [("1000 0 9", 1000.0), ("0 0 9", 0.0)] {
        let folder = metashape(point);
        let project = Project::open(&folder.path().join("cameras.xml"), None).unwrap();
        let scene = project.read_scene().unwrap();
        assert_eq!(
            (scene.views[0].name.as_str(), scene.observations()),
            ("a.png", 1)
        );
        assert_eq!(
            scene.views[0].cam_from_world.centre().x,
            x,
            "cameras are where the points are"
        );
    }
    let elsewhere = metashape("5000 5000 -9");
    let error = Project::open(elsewhere.path(), None)
        .and_then(|project| project.read_scene())
        .unwrap_err();
    assert!(
        error
            .hint()
            .unwrap()
            .to_string()
            .contains("same coordinate system"),
        "{error}"
    );
}

#[test]
fn a_scene_of_mve_has_its_images_in_views() {
    let bundle = "drews 1.0\n1 1\n0.5 0 0\n1 0 0\n0 1 0\n0 0 1\n0 0 5\n1 2 5\n10 20 30\n1 0 7 0\n";
    let folder = folder(&[
        ("synth_0.out", bundle),
        ("views/view_0000.mve/meta.ini", "[view]\nid = 0\nname = a\n"),
    ]);
    image::GrayImage::new(200, 100)
        .save(folder.path().join("views/view_0000.mve/undistorted.png"))
        .unwrap();
    let project = Project::open(folder.path(), None).unwrap();
    let scene = project.read_scene().unwrap();
    assert_eq!(scene.views[0].name, "view_0000.mve/undistorted.png");
    assert_eq!(scene.track_pixels[0], [110.0, 70.0]);
    assert!(project.images.unwrap().ends_with("views"));
}

#[test]
fn a_model_without_points_takes_those_of_a_ply_file() {
    let bundle = "# Bundle file v0.3\n1 0\n100 0 0\n1 0 0\n0 1 0\n0 0 1\n0 0 -5\n";
    let folder = folder(&[
        ("bundle.out", bundle),
        ("list.txt", "a.png\n"),
        ("cloud.ply", &format!("{PLY}0 0 0\n")),
    ]);
    let scene = Project::open(folder.path(), None)
        .unwrap()
        .read_scene()
        .unwrap();
    assert_eq!(
        (scene.points.len(), scene.track_pixels[0]),
        (1, [100.0, 50.0])
    );
}

#[test]
fn a_folder_of_micmac_has_its_images_and_points_above() {
    let orientation = "<ExportAPERO><OrientationConique><FileInterne>Ori-All/AutoCal.xml</FileInterne><Externe><Centre>0 0 -5</Centre>\
        <ParamRotation><CodageMatr><L1>1 0 0</L1><L2>0 1 0</L2><L3>0 0 1</L3></CodageMatr></ParamRotation></Externe></OrientationConique></ExportAPERO>";
    let calibration = "<ExportAPERO><CalibrationInternConique><PP>100 50</PP><F>90</F><SzIm>200 100</SzIm></CalibrationInternConique></ExportAPERO>";
    let folder = folder(&[
        ("Ori-All/Orientation-a.png.xml", orientation),
        ("Ori-All/AutoCal.xml", calibration),
        ("AperiCloud_All.ply", &format!("{PLY}0 0 0\n")),
    ]);
    for path in [folder.path().to_path_buf(), folder.path().join("Ori-All")] {
        let project = Project::open(&path, None).unwrap();
        let scene = project.read_scene().unwrap();
        assert_eq!(
            (scene.views[0].name.as_str(), scene.track_pixels[0]),
            ("a.png", [100.5, 50.5])
        );
        assert!(project.images.is_some());
    }
    let damaged = folder.path().join("Ori-All/AutoCal.xml");
    fs::write(&damaged, &calibration[..80]).unwrap();
    assert!(
        Project::open(folder.path(), None)
            .and_then(|project| project.read_scene())
            .is_err()
    );
}

#[test]
fn binary_models_name_their_converter() {
    for (name, converter) in [
        ("sfm_data.bin", "ConvertSfM_DataFormat"),
        ("sfm.abc", "convertSfMFormat"),
    ] {
        let folder = folder(&[(name, "x")]);
        for path in [folder.path().to_path_buf(), folder.path().join(name)] {
            let error = Project::open(&path, None).unwrap_err();
            assert!(
                error.hint().unwrap().to_string().contains(converter),
                "{error}"
            );
        }
    }
}
