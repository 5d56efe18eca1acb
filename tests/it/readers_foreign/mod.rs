//! Models of programs other than COLMAP: exports of a scene that also exists as a COLMAP model, and
//! files of the programs.

mod sure;

use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
};

use nalgebra::{Matrix3, Point3};
use viewrank_core::model::{
    camera::CameraModel,
    scene::{PointIndex, Scene, ViewIndex},
};
use viewrank_io::{
    formats::{Problem, alicevision, bundler, nvm, openmvg, openmvs, opensfm},
    project::{ModelFormat, Project, ProjectKind},
};

/// Small models that are our own.
fn formats() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/formats")
}

/// Files that come with other programs, under licences of their own: `benches/sets.py formats`
/// fetches them.
fn of_programs() -> PathBuf {
    let default = || Path::new(env!("CARGO_MANIFEST_DIR")).join("target/data");
    std::env::var_os("VIEWRANK_DATA")
        .map_or_else(default, PathBuf::from)
        .join("formats/others")
}

fn bytes(path: impl AsRef<Path>) -> Vec<u8> {
    std::fs::read(path).unwrap()
}

fn read(path: impl AsRef<Path>) -> Scene {
    let path = path.as_ref();
    let scene = Project::open(path, None).and_then(|project| project.read_scene());
    scene.unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

fn counts(scene: &Scene) -> [usize; 3] {
    [scene.views.len(), scene.points.len(), scene.observations()]
}

/// Poses, points and tracks are those of the base model, up to what the format keeps. Exporters
/// renumber points, and one observation per image is all that some formats hold.
fn assert_is_base(scene: &Scene, base: &Scene, pixels: f64, shift: [f64; 2]) {
    assert_eq!(scene.views.len(), base.views.len());
    for (a, b) in scene.views.iter().zip(&base.views) {
        assert_eq!(a.name, b.name);
        let (a, b) = (a.cam_from_world, b.cam_from_world);
        assert!((a.rotation.matrix() - b.rotation.matrix()).norm() < 1e-9);
        assert!(
            (a.centre() - b.centre()).norm() < 1e-7,
            "{} {}",
            a.centre(),
            b.centre()
        );
    }
    assert_eq!(scene.points.len(), base.points.len());
    let nearest = |x: &Point3<f64>| {
        let distance = |p: &usize| (base.points[*p] - x).norm();
        (0..base.points.len())
            .min_by(|a, b| distance(a).total_cmp(&distance(b)))
            .unwrap()
    };
    for (p, x) in scene.points.iter().enumerate() {
        let of_base = nearest(x);
        assert!((base.points[of_base] - x).norm() < 1e-4, "{x}");
        let track = |scene: &Scene, p: usize| -> Vec<(ViewIndex, [f64; 2])> {
            scene
                .track(PointIndex(p as u32))
                .map(|o| (scene.track_views[o], scene.track_pixels[o]))
                .collect()
        };
        let (a, b) = (track(scene, p), track(base, of_base));
        let views =
            |track: &[(ViewIndex, [f64; 2])]| track.iter().map(|o| o.0).collect::<BTreeSet<_>>();
        assert_eq!(views(&a), views(&b));
        for (view, a) in a {
            let off = |b: &[f64; 2]| (a[0] - b[0] - shift[0]).hypot(a[1] - b[1] - shift[1]);
            assert!(
                b.iter().any(|(v, b)| *v == view && off(b) < pixels),
                "{a:?} {b:?}"
            );
        }
    }
}

/// The distance between the projections of the points by two scenes with the same views, at most.
fn projections_apart(a: &Scene, b: &Scene) -> f64 {
    let mut apart = 0.0f64;
    for v in a.view_indices() {
        for x in &b.points {
            let project = |s: &Scene| {
                s.camera_of(v)
                    .project(&s.view(v).cam_from_world.camera_from_world(x))
            };
            if let Some((a, b)) = project(a).zip(project(b)) {
                apart = apart.max((a - b).norm());
            }
        }
    }
    apart
}

#[test]
fn bundler_export_is_the_same_scene() {
    let formats = formats();
    let (exports, base) = (
        formats.join("base_colmap38_exports"),
        read(formats.join("base_colmap38_bin")),
    );
    let (bundle, list) = (
        bytes(exports.join("model.bundle.out")),
        bytes(exports.join("model.list.txt")),
    );
    let scene = bundler::read(&bundle, &list, &|_| Some((1000, 750)))
        .unwrap()
        .scene()
        .unwrap();
    // Pixels and points are printed with six digits.
    assert_is_base(&scene, &base, 1e-3, [0.0; 2]);
    assert!(projections_apart(&scene, &base) < 1e-6);
    assert!(
        (scene.mean_reprojection_error().unwrap() - base.mean_reprojection_error().unwrap()).abs()
            < 1e-4
    );
    assert_eq!(scene.colours.len(), base.colours.len());
}

#[test]
fn nvm_export_is_the_same_scene() {
    let formats = formats();
    let (exports, base) = (
        formats.join("base_colmap38_exports"),
        read(formats.join("base_colmap38_bin")),
    );
    let nvm = nvm::read(&bytes(exports.join("model.nvm")), &|_| Some((1000, 750))).unwrap();
    let scene = nvm.scene().unwrap();
    // Pixels and points are printed with six digits.
    assert_is_base(&scene, &base, 1e-3, [0.0; 2]);
    assert!(projections_apart(&scene, &base) < 1e-6);
}

#[test]
fn openmvg_export_is_the_same_scene() {
    let formats = formats();
    let (path, base) = (
        formats.join("openmvg/sfm_data.json"),
        read(formats.join("base_colmap38_bin")),
    );
    let scene = openmvg::read(&bytes(path)).unwrap().scene().unwrap();
    // The script that wrote it left pixels as in COLMAP, where OpenMVG has integer centres: all is
    // half a pixel off.
    assert_is_base(&scene, &base, 1e-9, [0.5; 2]);
    assert!((projections_apart(&scene, &base) - 0.5f64.hypot(0.5)).abs() < 1e-9);
    assert!(
        (scene.mean_reprojection_error().unwrap() - base.mean_reprojection_error().unwrap()).abs()
            < 1e-9
    );
}

#[test]
fn folders_are_read_without_images() {
    let base = read(formats().join("base_colmap38_bin"));
    let bundler = tempfile::tempdir().unwrap();
    for (export, name) in [
        ("model.bundle.out", "bundle.out"),
        ("model.list.txt", "list.txt"),
    ] {
        std::fs::copy(
            formats().join("base_colmap38_exports").join(export),
            bundler.path().join(name),
        )
        .unwrap();
    }
    let openmvg = formats().join("openmvg");
    for (folder, format) in [
        (bundler.path(), ModelFormat::Bundler),
        (&openmvg, ModelFormat::OpenMvg),
    ] {
        let project = Project::open(folder, None).unwrap();
        assert_eq!(project.model.format, format);
        let scene = project.read_scene().unwrap();
        assert_eq!(counts(&scene), counts(&base), "{format:?}");
        assert!(scene.mean_reprojection_error().unwrap() < 3.0, "{format:?}");
    }
}

#[test]
#[ignore = "needs VIEWRANK_DATA: formats"]
fn files_of_the_programs_are_read_without_images() {
    let open = |folder: &str| Project::open(&of_programs().join(folder), None).unwrap();
    for (folder, format, expected) in [
        ("bundler_kermit", ModelFormat::Bundler, [9, 634, 2039]),
        ("opensfm_berlin", ModelFormat::OpenSfm, [3, 1430, 3219]),
        ("alicevision/small.sfm", ModelFormat::AliceVision, [0, 0, 0]),
        (
            "alicevision/scene_v1.2.8_cut.sfm",
            ModelFormat::AliceVision,
            [54, 300, 0],
        ),
    ] {
        let project = open(folder);
        assert_eq!(project.model.format, format, "{folder}");
        let scene = project
            .read_scene()
            .unwrap_or_else(|error| panic!("{folder}: {error}"));
        let found = counts(&scene);
        // Not every row of tracks.csv belongs to a point of the reconstruction.
        if folder == "opensfm_berlin" {
            assert!(
                found[..2] == expected[..2] && found[2] > 2860 && found[2] <= expected[2],
                "{found:?}"
            );
        } else {
            assert_eq!(found, expected, "{folder}");
        }
        if let Some(error) = scene.mean_reprojection_error() {
            assert!(error < 3.0, "{folder}: {error} px");
        }
    }
    assert_eq!(
        open("bundler_kermit")
            .read_scene()
            .unwrap()
            .unregistered
            .len(),
        2
    );
    assert_eq!(
        open("alicevision/small.sfm")
            .read_scene()
            .unwrap()
            .unregistered
            .len(),
        30
    );
    assert_eq!(open("openmvs").kind, ProjectKind::OpenMvs);
    let scene = open("openmvs").read_scene().unwrap();
    assert!(
        counts(&scene).iter().all(|&n| n > 0),
        "{:?}",
        counts(&scene)
    );
    assert!(scene.mean_reprojection_error().unwrap() < 1e-9);
}

/// A dense workspace in the folder of another program's model was made from that model, and has
/// images of its own.
#[test]
fn a_dense_workspace_does_not_hide_the_model_that_it_was_made_from() {
    let formats = formats();
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    std::fs::create_dir_all(root.join("dense/sparse")).unwrap();
    ["images", "dense/images"]
        .iter()
        .for_each(|images| std::fs::create_dir(root.join(images)).unwrap());
    for name in ["cameras.bin", "images.bin", "points3D.bin"] {
        std::fs::copy(
            formats.join("base_colmap38_bin").join(name),
            root.join("dense/sparse").join(name),
        )
        .unwrap();
    }
    let dense = Project::open(root, None).unwrap();
    assert_eq!(
        (dense.model.format, dense.images.unwrap().to_path_buf()),
        (ModelFormat::ColmapBinary, root.join("dense/images"))
    );
    std::fs::copy(
        formats.join("openmvg/sfm_data.json"),
        root.join("sfm_data.json"),
    )
    .unwrap();
    let foreign = Project::open(root, None).unwrap();
    assert_eq!(
        (foreign.model.format, foreign.images.unwrap().to_path_buf()),
        (ModelFormat::OpenMvg, root.join("images"))
    );
    let of_dense = Project::open(&root.join("dense"), None).unwrap();
    assert_eq!(
        (
            of_dense.model.format,
            of_dense.images.unwrap().to_path_buf()
        ),
        (ModelFormat::ColmapBinary, root.join("dense/images"))
    );
}

#[test]
#[ignore = "needs VIEWRANK_DATA: formats"]
fn alicevision_motions_of_one_pose_are_shared() {
    let scene = read(of_programs().join("alicevision/scene_v1.2.8_cut.sfm"));
    let centre = |v: usize| scene.views[v].cam_from_world.centre();
    let distinct = (0..54)
        .filter(|&v| (0..v).all(|w| (centre(v) - centre(w)).norm() > 1e-9))
        .count();
    assert_eq!(distinct, 27);
    assert!(
        (centre(scene.find("view_0").unwrap().index()) - Point3::new(-1.0, -1.0, -1.0)).norm()
            < 1e-9
    );
}

#[test]
fn alicevision_numbers_come_with_and_without_quotes() {
    let sfm = |version: &str, intrinsic: &str| {
        let text = format!(
            r#"{{"version": {version}, "views": [{{"viewId": "7", "poseId": 3, "intrinsicId": "1", "path": "/data/set/a.jpg"}},
               {{"viewId": "8", "intrinsicId": "1", "path": "/data/b.jpg"}}],
               "intrinsics": [{{"intrinsicId": "1", "width": "1000", "height": 500, "serialNumber": "", {intrinsic}}}],
               "poses": [{{"poseId": "3", "pose": {{"transform": {{"rotation": ["0","1","0","-1","0","0","0","0","1"],
               "center": [1, 2, "3"]}}}}}}], "structure": [{{"landmarkId": "4", "color": ["1","2","3"], "X": ["0","0","5"],
               "observations": [{{"observationId": "7", "featureId": "0", "x": ["10", "20"]}}]}}]}}"#
        );
        alicevision::read(text.as_bytes()).unwrap()
    };
    let old = sfm(
        r#"["1","0","0"]"#,
        r#""type": "radial3", "pxFocalLength": "900", "principalPoint": ["490", "260"],
        "distortionParams": ["0.1", "0.2", "0.3"]"#,
    );
    let camera = &old.model.cameras[0];
    assert_eq!(camera.model(), CameraModel::FullOpenCv);
    assert_eq!(
        camera.params(),
        [
            900.0, 900.0, 490.5, 260.5, 0.1, 0.2, 0.0, 0.0, 0.3, 0.0, 0.0, 0.0
        ]
    );
    let new = sfm(
        r#"[1, 2, 11]"#,
        r#""type": "pinhole", "distortionType": "none", "undistortionType": "none", "sensorWidth": "20",
        "focalLength": "18", "pixelRatio": "2", "principalPoint": ["-10", "10"], "distortionParams": """#,
    );
    assert_eq!(new.model.cameras[0].params(), [450.0, 900.0, 490.5, 260.5]);
    let scene = new.scene().unwrap();
    assert_eq!(
        (scene.name(ViewIndex(0)), &scene.unregistered[0]),
        ("set/a.jpg", &"b.jpg".to_string())
    );
    assert_eq!(new.image_folder.as_deref(), Some("/data/"));
    // Columns first.
    let rotation = Matrix3::new(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0);
    assert!((scene.views[0].cam_from_world.rotation.matrix() - rotation).norm() < 1e-12);
    assert!((scene.views[0].cam_from_world.centre() - Point3::new(1.0, 2.0, 3.0)).norm() < 1e-12);
    assert_eq!(scene.track_pixels, [[10.5, 20.5]]);
}

#[test]
fn opensfm_pixels_are_normalised_by_the_larger_side() {
    let reconstruction =
        br#"[{"cameras": {"c": {"projection_type": "brown", "width": 400, "height": 200, "focal_x": 0.5,
        "focal_y": 0.6, "c_x": 0.01, "c_y": -0.02, "k1": 0.1, "k2": 0.2, "k3": 0.3, "p1": 0.4, "p2": 0.5}},
        "shots": {"a.jpg": {"rotation": [0, 0, 1.5707963267948966], "translation": [1, 2, 3], "camera": "c"}},
        "points": {"17": {"coordinates": [0, 0, 1], "color": [1, 2, 300]}}}]"#;
    let tracks =
        b"OPENSFM_TRACKS_VERSION_v2\na.jpg\t17\t3\t0.25\t-0.125\t0.001\t1\t2\t3\t-1\t-1\r\nother.jpg\t17\t3\t0\t0\n";
    let scene = opensfm::read(reconstruction, Some(tracks))
        .unwrap()
        .scene()
        .unwrap();
    let camera = &scene.cameras[0];
    assert_eq!(
        camera.params(),
        [
            200.0, 240.0, 204.0, 92.0, 0.1, 0.2, 0.4, 0.5, 0.3, 0.0, 0.0, 0.0
        ]
    );
    assert_eq!(
        (&scene.track_pixels[..], &scene.point_ids[..]),
        (&[[300.0, 50.0]][..], &[17][..])
    );
    assert_eq!(scene.colours, [[1, 2, 255]]);
    let x_cam = scene.views[0]
        .cam_from_world
        .camera_from_world(&Point3::new(1.0, 0.0, 0.0));
    assert!((x_cam - Point3::new(1.0, 3.0, 3.0)).norm() < 1e-12);
    let fault = opensfm::read(reconstruction, Some(b"a.jpg\t17\t3\tx\t0\n")).unwrap_err();
    assert!(
        matches!(fault.problem, Problem::Syntax { .. }) && fault.file == "tracks",
        "{fault}"
    );
}

#[test]
fn bundler_f_zero() {
    let camera = "0 0 0\n0 0 0\n0 0 0\n0 0 0\n0 0 0\n";
    let real = "100 0.1 0.2\n1 0 0\n0 1 0\n0 0 1\n0 0 -5\n";
    let bundle =
        format!("# Bundle file v0.3\n2 1\n{camera}{real}1 2 3\n10 20 30\n2 0 0 1 1 1 0 -20 10\n");
    let foreign = bundler::read(bundle.as_bytes(), b"./a b.jpg 0 123.4\nc.jpg\n", &|_| {
        Some((200, 100))
    })
    .unwrap();
    let scene = foreign.scene().unwrap();
    assert_eq!(scene.unregistered, ["a b.jpg"]);
    assert_eq!(counts(&scene), [1, 1, 1]);
    // y up and z backward.
    assert_eq!(scene.track_pixels, [[80.0, 40.0]]);
    let x_cam = scene.views[0]
        .cam_from_world
        .camera_from_world(&Point3::new(1.0, 2.0, 0.0));
    assert!(
        (x_cam - Point3::new(1.0, -2.0, 5.0)).norm() < 1e-12,
        "{x_cam}"
    );
    let guessed = bundler::read(bundle.as_bytes(), b"a.jpg\nc.jpg\n", &|_| None).unwrap();
    assert_eq!(
        (guessed.model.cameras[0].width, guessed.model.warnings.len()),
        (40, 1)
    );
}

/// `bundle.rd.out` belongs to the undistorted images that `list.rd.txt` names, `bundle.out` to the
/// distorted ones of `list.txt`.
#[test]
fn bundler_rd_out_undistorted() {
    let bundle = |k1: f64| {
        format!(
            "# Bundle file v0.3\n1 1\n100 {k1} 0\n1 0 0\n0 1 0\n0 0 1\n0 0 -5\n1 2 3\n10 20 30\n1 0 0 -20 10\n"
        )
    };
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    std::fs::write(at("bundle.rd.out"), bundle(0.0)).unwrap();
    std::fs::write(at("list.txt"), "a.jpg\n").unwrap();
    std::fs::write(at("list.rd.txt"), "a.rd.jpg\n").unwrap();
    let undistorted = read(folder.path());
    assert_eq!(
        (
            undistorted.name(ViewIndex(0)),
            undistorted.cameras[0].model()
        ),
        ("a.rd.jpg", CameraModel::Pinhole)
    );
    std::fs::write(at("bundle.out"), bundle(0.1)).unwrap();
    let (both, rd) = (read(folder.path()), read(at("bundle.rd.out")));
    assert_eq!(
        (both.name(ViewIndex(0)), both.cameras[0].params()[3]),
        ("a.jpg", 0.1),
        "each with its own list"
    );
    assert_eq!(
        (rd.name(ViewIndex(0)), rd.cameras[0].model()),
        ("a.rd.jpg", CameraModel::Pinhole)
    );
}

/// OpenMVG's own file has integer pixel centres; its export to COLMAP leaves out the half pixel,
/// ours is there.
#[test]
fn openmvg_colmap_half_pixel() {
    let formats = formats();
    let sfm: serde_json::Value =
        serde_json::from_slice(&bytes(formats.join("openmvg/sfm_data.json"))).unwrap();
    let observation = &sfm["structure"][0]["value"]["observations"][0]["value"]["x"];
    let measured = [0, 1].map(|i: usize| observation[i].as_f64().unwrap());
    let scene = openmvg::read(&bytes(formats.join("openmvg/sfm_data.json")))
        .unwrap()
        .scene()
        .unwrap();
    assert!(
        scene.track_pixels.contains(&measured.map(|c| c + 0.5))
            && !scene.track_pixels.contains(&measured)
    );
    let centre = sfm["intrinsics"][0]["value"]["ptr_wrapper"]["data"]["principal_point"][0]
        .as_f64()
        .unwrap();
    assert_eq!(scene.cameras[0].pinhole_part().1.x, centre + 0.5);
}

/// The centre of the first pixel of an image is (0.5 - w/2, 0.5 - h/2) / max(w, h) in OpenSfM's
/// tracks and (0.5, 0.5) in ours; its export to COLMAP writes (0, 0).
#[test]
fn opensfm_colmap_half_pixel() {
    let reconstruction =
        br#"[{"cameras": {"c": {"projection_type": "perspective", "width": 400, "height": 200, "focal": 0.5}},
        "shots": {"a.jpg": {"rotation": [0, 0, 0], "translation": [0, 0, 0], "camera": "c"}},
        "points": {"17": {"coordinates": [0, 0, 1], "color": [1, 2, 3]}}}]"#;
    let tracks = format!(
        "a.jpg\t17\t3\t{}\t{}\t0.001\t1\t2\t3\n",
        (0.5 - 200.0) / 400.0,
        (0.5 - 100.0) / 400.0
    );
    let scene = opensfm::read(reconstruction, Some(tracks.as_bytes()))
        .unwrap()
        .scene()
        .unwrap();
    assert!(
        (scene.track_pixels[0][0] - 0.5).abs() < 1e-12
            && (scene.track_pixels[0][1] - 0.5).abs() < 1e-12
    );
    let (_, centre) = scene.cameras[0].pinhole_part();
    assert_eq!((centre.x, centre.y), (200.0, 100.0));
}

#[test]
fn nvm_blank_in_name() {
    let text = "NVM_V3\n\n2\nflight 1/a b.jpg 100 1 0 0 0 1 2 3 0 0\nc.jpg 100 1 0 0 0 0 0 0 0 0\n\n0\n\n0\n";
    let scene = nvm::read(text.as_bytes(), &|_| Some((200, 100)))
        .unwrap()
        .scene()
        .unwrap();
    assert_eq!(
        scene
            .views
            .iter()
            .map(|v| v.name.as_str())
            .collect::<Vec<_>>(),
        ["c.jpg", "flight 1/a b.jpg"]
    );
    assert!((scene.views[1].cam_from_world.centre() - Point3::new(1.0, 2.0, 3.0)).norm() < 1e-12);
}

/// Two measurements of a point in one image are two observations by one view, not by two.
#[test]
fn nvm_repeated_observation() {
    let text = "NVM_V3\n\n2\na.jpg 100 1 0 0 0 1 2 3 0 0\nc.jpg 100 1 0 0 0 0 0 0 0 0\n\n1\n\
                0 0 9 1 2 3 3 0 0 10 5 0 1 12 6 1 0 30 20\n\n0\n";
    let scene = nvm::read(text.as_bytes(), &|_| Some((200, 100)))
        .unwrap()
        .scene()
        .unwrap();
    let mut views = scene.track_views(PointIndex(0)).to_vec();
    assert_eq!(
        (views.len(), &scene.track_pixels[..2]),
        (3, &[[10.0, 5.0], [12.0, 6.0]][..])
    );
    views.dedup();
    assert_eq!(views.len(), 2);
    assert_eq!(
        scene.view_points().observed_by(ViewIndex(0)),
        [PointIndex(0)]
    );
}

#[test]
fn nvm_measurements_from_the_centre() {
    let nvm = |x: f64| {
        let camera = "a b.jpg\t100 1 0 0 0 1 2 3 0.01 0\n";
        let text = format!(
            "NVM_V3 \n\n2\n{camera}c.jpg 100 1 0 0 0 0 0 0 0 0\n\n1\n0 0 9 1 2 3 2 0 0 {x} 5 1 0 30 20\n\n0\n"
        );
        nvm::read(text.as_bytes(), &|_| Some((200, 100)))
            .unwrap()
            .scene()
            .unwrap()
    };
    assert_eq!(nvm(10.0).track_pixels, [[10.0, 5.0], [30.0, 20.0]]);
    assert_eq!(nvm(-10.0).track_pixels, [[90.0, 55.0], [130.0, 70.0]]);
    let view = &nvm(10.0).views[0];
    assert_eq!(view.name, "a b.jpg");
    assert!((view.cam_from_world.centre() - Point3::new(1.0, 2.0, 3.0)).norm() < 1e-12);
    assert_eq!(nvm(10.0).cameras[0].params()[3], -0.01);
}

#[test]
fn openmvs_scene_of_a_scene_is_the_scene() {
    let pose = |c: [f64; 3]| openmvs::PlatformPose {
        r: [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0],
        c,
    };
    let image = |name: &str, id, pose| openmvs::Image {
        name: name.into(),
        mask: Vec::new(),
        platform: 0,
        camera: 0,
        pose,
        id,
        depths: [0.0; 3],
        view_scores: Vec::new(),
    };
    let camera = |width, height, k| openmvs::Camera {
        width,
        height,
        k,
        r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        ..openmvs::Camera::default()
    };
    let views = [0, 1, 2]
        .map(|image| openmvs::VertexView {
            image,
            confidence: 1.0,
        })
        .to_vec();
    let scene = |camera| openmvs::Mvs {
        platforms: vec![openmvs::Platform {
            name: Vec::new(),
            cameras: vec![camera],
            poses: vec![pose([1.0, 2.0, 0.0]), pose([0.0, 0.0, 0.5])],
        }],
        images: vec![
            image("b.jpg", 5, 1),
            image("none.jpg", 6, openmvs::NO_POSE),
            image("a.jpg", 9, 0),
        ],
        vertices: vec![openmvs::Vertex {
            x: [0.5, 0.25, 4.0],
            views: views.clone(),
        }],
        colours: vec![[1, 2, 3]],
        ..openmvs::Mvs::default()
    };
    let mvs = scene(camera(
        400,
        300,
        [200.0, 0.0, 199.5, 0.0, 210.0, 149.5, 0.0, 0.0, 1.0],
    ));
    let read = openmvs::Mvs::read(&mvs.write())
        .unwrap()
        .model(&|_| None)
        .unwrap()
        .scene()
        .unwrap();
    assert_eq!(
        (read.name(ViewIndex(0)), read.views[0].image_id),
        ("a.jpg", 9)
    );
    assert_eq!(read.unregistered, ["none.jpg"]);
    assert_eq!(read.cameras[0].params(), [200.0, 210.0, 200.0, 150.0]);
    assert_eq!(read.colours, [[3, 2, 1]]);
    // x_cam = R (X - C) = (1.75, -0.5, 4)
    let expected = [200.0 * 1.75 / 4.0 + 200.0, 210.0 * -0.5 / 4.0 + 150.0];
    assert!(
        (read.track_pixels[0][0] - expected[0]).hypot(read.track_pixels[0][1] - expected[1]) < 1e-9
    );
    // Intrinsics in units of the larger side.
    let normalised = scene(camera(0, 0, [0.5, 0.0, 0.5, 0.0, 0.5, 0.25, 0.0, 0.0, 1.0]));
    let with_size = normalised.model(&|_| Some((400, 300))).unwrap();
    assert_eq!(
        with_size.model.cameras[0].params(),
        [200.0, 200.0, 200.5, 100.5]
    );
    assert!(normalised.model(&|_| None).is_err());
}

/// ODM's `opensfm/undistorted/reconstruction.json` says "perspective" with k1 = k2 = 0.
#[test]
fn cameras_without_distortion_are_pinholes() {
    let of = |k1: f64| {
        let camera = format!(
            r#"{{"projection_type": "perspective", "width": 400, "height": 300, "focal": 0.9, "k1": {k1}, "k2": 0.0}}"#
        );
        let shot = r#"{"rotation": [0, 0, 0], "translation": [0, 0, 0], "camera": "c"}"#;
        let text = format!(
            r#"[{{"cameras": {{"c": {camera}}}, "shots": {{"a.tif": {shot}}}, "points": {{}}}}]"#
        );
        opensfm::read(text.as_bytes(), None).unwrap().model.cameras[0].clone()
    };
    assert_eq!(
        (of(0.0).model(), of(0.0).params()),
        (CameraModel::Pinhole, &[360.0, 360.0, 200.0, 150.0][..])
    );
    assert_eq!(of(-0.1).model(), CameraModel::Radial);
}
