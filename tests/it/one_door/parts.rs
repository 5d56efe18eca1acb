//! Models of which a program wrote a part are completed where that can be done, with a warning.

use super::*;

fn without_2d_points() -> ColmapModel<'static> {
    let mut model = ColmapModel::from_scene(&scene());
    model
        .images
        .iter_mut()
        .for_each(|image| image.points2d = Default::default());
    model
}

fn without_tracks(mut model: ColmapModel<'static>) -> ColmapModel<'static> {
    model
        .points
        .iter_mut()
        .for_each(|point| point.track = Default::default());
    model
}

fn without_points() -> ColmapModel<'static> {
    let mut model = without_2d_points();
    model.points.clear();
    model
}

/// Plans with images, which must succeed.
fn assert_planned(folder: &Folder) {
    folder.pictures(&scene(), |name| format!("images/{name}"));
    let (code, _, stderr) = folder.plan(&["--backend", "openmvs"]);
    assert_eq!(code, 0, "{stderr}");
}

#[test]
fn tracks_without_2d_points_are_placed_at_the_projections() {
    let folder = Folder::new();
    folder.colmap_text("sparse/0", &without_2d_points());
    let (read, whole) = (folder.read(), scene());
    assert_eq!(read.track_views, whole.track_views);
    let off = |(a, b): (&[f64; 2], &[f64; 2])| (a[0] - b[0]).hypot(a[1] - b[1]);
    let pixels = read.track_pixels.iter().zip(&whole.track_pixels);
    assert!(pixels.map(off).fold(0.0, f64::max) < 0.1);
    assert!(
        read.warnings[0].text.contains("9 of 9 images"),
        "{:?}",
        read.warnings
    );
    assert_planned(&folder);
}

#[test]
fn points_without_tracks_are_observed_where_they_project() {
    let folder = Folder::new();
    folder.colmap("sparse/0", &without_tracks(without_2d_points()));
    let (read, whole) = (folder.read(), scene());
    assert_eq!(read.points.len(), whole.points.len());
    assert!(read.observations() >= whole.observations());
    assert_eq!(kinds(&read), [WarningKind::Projected]);
    assert_planned(&folder);
}

#[test]
fn points_that_one_image_observes_are_observed_where_they_project() {
    let mut model = ColmapModel::from_scene(&scene());
    for point in &mut model.points {
        let first: Vec<_> = point.track.iter().take(1).copied().collect();
        point.track = first.into();
    }
    let folder = Folder::new();
    folder.colmap("sparse/0", &model);
    let read = folder.read();
    assert!(read.observations() > 3 * read.points.len());
    assert!(
        read.warnings
            .iter()
            .any(|warning| warning.text.contains("two images"))
    );
    assert_planned(&folder);
}

#[test]
fn tracks_are_made_of_the_images_lists_where_points_have_none() {
    let folder = Folder::new();
    folder.colmap(
        "sparse/0",
        &without_tracks(ColmapModel::from_scene(&scene())),
    );
    let (read, whole) = (folder.read(), scene());
    assert_eq!(
        (read.track_views, read.track_pixels),
        (whole.track_views, whole.track_pixels)
    );
    assert_eq!(read.warnings.len(), 1);
}

#[test]
fn a_cloud_beside_a_model_has_its_points() {
    let folder = Folder::new();
    folder
        .colmap("sparse/0", &without_points())
        .cloud("sparse/0/points3D.ply", &scene());
    let read = folder.read();
    assert_eq!(read.points.len(), scene().points.len());
    assert_planned(&folder);
    // Also where there is no file of points at all.
    fs::remove_file(folder.at("sparse/0/points3D.bin")).unwrap();
    assert_eq!(folder.read().observations(), read.observations());
    // A plan is of this cloud.
    let files = folder.open().model_files();
    assert!(
        files.iter().any(|file| file.ends_with("points3D.ply")),
        "{files:?}"
    );
}

#[test]
fn a_cloud_far_from_the_cameras_is_in_other_coordinates() {
    let mut far = scene();
    let pose = &far.views[0].cam_from_world;
    let ahead = pose.rotation.inverse() * nalgebra::Vector3::new(0.0, 0.0, 1e6);
    far.points.iter_mut().for_each(|point| *point += ahead);
    let folder = Folder::new();
    folder
        .colmap("sparse/0", &without_points())
        .cloud("sparse/0/cloud.ply", &far);
    let (code, _, stderr) = folder.plan(&[]);
    assert_eq!(code, 1);
    assert!(
        stderr.contains("different coordinates") && stderr.contains("EPSG:4978"),
        "{stderr}"
    );
}

#[test]
fn photographs_alone_need_structure_from_motion() {
    let folder = Folder::new();
    folder.pictures(&scene(), |name| format!("images/{name}"));
    let (code, _, stderr) = folder.plan(&[]);
    assert_eq!(code, 1);
    assert!(stderr.contains("only photographs"), "{stderr}");
}

#[test]
fn run_does_not_take_the_place_of_a_plan_for_images() {
    let folder = Folder::new();
    folder
        .colmap("sparse/0", &ColmapModel::from_scene(&scene()))
        .pictures(&scene(), |name| format!("images/{name}"));
    let (code, _, stderr) = folder.plan(&["--backend", "images", "--budget", "4"]);
    assert_eq!(code, 0, "{stderr}");
    assert!(!stderr.contains("no number of images"), "{stderr}");
    let manifest = std::fs::read(folder.at("viewrank/manifest.json")).unwrap();
    let (code, _, stderr) = said(&viewrank(&["run", folder.path().to_str().unwrap()]));
    assert_eq!(code, 2, "{stderr}");
    assert!(stderr.contains("chooses images for images"), "{stderr}");
    assert_eq!(
        std::fs::read(folder.at("viewrank/manifest.json")).unwrap(),
        manifest
    );
    let (_, _, stderr) = folder.plan(&["--backend", "images"]);
    assert!(stderr.contains("no number of images"), "{stderr}");
}

#[test]
fn a_model_without_points_is_refused_with_what_inspect_says() {
    let advice = |folder: &Folder, words: &str| {
        let path = folder.path().to_str().unwrap();
        let (code, inspected, _) = said(&viewrank(&["inspect", path]));
        assert!(code == 0 && inspected.contains(words), "{inspected}");
        for options in [&["--backend", "openmvs"][..], &["--gsd", "0.1"]] {
            let (code, _, stderr) = folder.plan(options);
            assert!(code == 1 && stderr.contains(words), "{stderr}");
            assert!(!stderr.contains("--gsd"), "{stderr}");
        }
        let (code, found, _) = said(&viewrank(&["doctor", path]));
        assert!(code == 4 && found.contains("no points"), "{found}");
    };
    let folder = Folder::new();
    folder.colmap("sparse/0", &without_points());
    advice(&folder, "point_triangulator");
    let frame = |n: usize| {
        format!(r#"{{"file_path":"{n}.png","transform_matrix":[[1,0,0,{n}],[0,1,0,0],[0,0,1,9]]}}"#)
    };
    let frames: Vec<String> = (0..3).map(frame).collect();
    let folder = Folder::new();
    folder.write(
        "transforms.json",
        format!(
            r#"{{"w":100,"h":75,"fl_x":85,"frames":[{}]}}"#,
            frames.join(",")
        ),
    );
    advice(&folder, "as PLY");
    let view = |n: usize| {
        format!(
            r#"{{"viewId":"{n}","poseId":"{n}","intrinsicId":"7","path":"/p/{n}.png","width":"100","height":"75"}}"#
        )
    };
    let pose = |n: usize| {
        format!(
            r#"{{"poseId":"{n}","pose":{{"transform":{{"rotation":["1","0","0","0","1","0","0","0","1"],"center":["{n}","0","0"]}},"locked":"0"}}}}"#
        )
    };
    let list = |of: &dyn Fn(usize) -> String| (1..4).map(of).collect::<Vec<_>>().join(",");
    let folder = Folder::new();
    folder.write(
        "cameras.sfm",
        format!(
            r#"{{"version":["1","2","6"],"views":[{}],"poses":[{}],"intrinsics":[{{"intrinsicId":"7","width":"100","height":"75","sensorWidth":"36",
            "sensorHeight":"27","type":"pinhole","focalLength":"30","pixelRatio":"1","principalPoint":["0","0"],"distortionType":"none",
            "distortionParams":""}}]}}"#,
            list(&view),
            list(&pose)
        ),
    );
    advice(&folder, "ConvertSfMFormat");
}

#[test]
fn zero_distortion_needs_no_undistortion() {
    let mut model = ColmapModel::from_scene(&scene());
    let params = [vec![85.0, 85.0, 50.0, 37.5], vec![0.0; 8]].concat();
    model.cameras[0] = Camera::new(1, CameraModel::FullOpenCv, 100, 75, params).unwrap();
    let folder = Folder::new();
    folder
        .colmap_text("sparse/0", &model)
        .pictures(&scene(), |name| format!("images/{name}"));
    assert_eq!(folder.read().cameras[0].model(), CameraModel::Pinhole);
    let (code, _, stderr) = folder.plan(&["--backend", "openmvs,colmap,sgm"]);
    assert_eq!(code, 0, "{stderr}");
    // The matcher reads no distorted camera. Of a record: id, then the number of the model.
    let cameras = fs::read(folder.at("viewrank/sgm/sparse/cameras.bin")).unwrap();
    assert_eq!(cameras[12..16], 1_u32.to_le_bytes());
    let linked = |export: &str| fs::read(folder.at(&format!("viewrank/{export}"))).unwrap();
    let original = fs::read(folder.at("images/view_4.png")).unwrap();
    assert_eq!(linked("colmap/images/view_4.png"), original);
}

#[test]
fn of_several_ply_files_the_cloud_of_most_points_is_taken() {
    let folder = Folder::new();
    let mut few = scene();
    few.points.truncate(3);
    let corners = "0 0 0\n1 0 0\n0 1 0\n".repeat(400);
    let head = "ply\nformat ascii 1.0\nelement vertex 1200\nproperty float x\nproperty float y\nproperty float z\nelement face 1\n\
                property list uchar int vertex_indices\nend_header\n";
    folder
        .colmap("sparse/0", &without_points())
        .cloud("sparse/0/a.ply", &few)
        .write("sparse/0/mesh.ply", format!("{head}{corners}3 0 1 2\n"))
        .cloud("sparse/0/points.ply", &scene())
        .write("sparse/0/z.ply", "none");
    let read = folder.read();
    assert_eq!(read.points.len(), scene().points.len());
    let said: Vec<&str> = read.warnings.iter().map(|said| &*said.text).collect();
    let named = |text: &&str| {
        ["points.ply", "a.ply", "mesh.ply"]
            .iter()
            .all(|name| text.contains(name))
    };
    assert!(said.iter().any(named), "{said:?}");
}

#[test]
fn a_cloud_in_the_project_has_the_points_of_poses_below_it() {
    let folder = Folder::new();
    let pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n";
    folder
        .colmap("sparse/0", &without_points())
        .cloud("points.ply", &scene())
        .write("z.ply", pointer);
    std::fs::remove_file(folder.at("sparse/0/points3D.bin")).unwrap();
    let read = folder.read();
    assert_eq!(read.points.len(), scene().points.len());
    let said: Vec<&str> = read.warnings.iter().map(|said| &*said.text).collect();
    let is_named = |text: &&str| text.contains("z.ply (a Git LFS pointer");
    assert!(said.iter().any(is_named), "{said:?}");
}
