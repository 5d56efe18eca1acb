//! Sparse models of all kinds against what other programs say of them.

use std::path::{Path, PathBuf};

use viewrank_core::{
    base::error::Hint,
    model::scene::{Scene, WarningKind},
};
use viewrank_io::{
    formats::{
        Bytes,
        colmap::{ColmapImage, ColmapModel, ImageUse, Point2d},
        colmap_bin, colmap_text,
    },
    project::{ModelFormat, Project, ProjectError, ProjectKind},
};

/// Small models of every kind that COLMAP writes.
fn formats() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/formats")
}

/// The folders of `formats/` with what pycolmap says of them.
fn expected(formats: &Path) -> serde_json::Map<String, serde_json::Value> {
    serde_json::from_str(&std::fs::read_to_string(formats.join("expected.json")).unwrap()).unwrap()
}

fn open(path: &Path) -> Project {
    Project::open(path, None).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

fn read(path: &Path) -> Scene {
    open(path)
        .read_scene()
        .unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// The scene again from files as `write` makes them.
fn reread(files: &[(&str, Vec<u8>)]) -> Scene {
    let bytes = |stem: &str| {
        files
            .iter()
            .find(|f| f.0.starts_with(stem))
            .map(|f| &f.1[..])
    };
    let parts = ["cameras", "images", "points3D"].map(|stem| bytes(stem).unwrap());
    let [cameras, images, points3d] = parts;
    let bytes = Bytes {
        cameras,
        images,
        points3d,
        rigs: bytes("rigs"),
        frames: bytes("frames"),
    };
    let text = files[0].0.ends_with(".txt");
    let model = if text {
        colmap_text::read(&bytes)
    } else {
        colmap_bin::read(&bytes)
    };
    model.and_then(|model| model.scene()).unwrap()
}

fn assert_same(a: &Scene, b: &Scene, what: &str) {
    assert_eq!(a.cameras, b.cameras, "{what}");
    let view = |s: &Scene, v: usize| {
        let view = &s.views[v];
        (
            view.name.clone(),
            view.image_id,
            view.camera,
            view.file_position,
            view.cam_from_world,
        )
    };
    let views = |s: &Scene| (0..s.views.len()).map(|v| view(s, v)).collect::<Vec<_>>();
    assert_eq!(views(a), views(b), "{what}");
    assert_eq!(
        (&a.points, &a.point_ids, &a.colours),
        (&b.points, &b.point_ids, &b.colours),
        "{what}"
    );
    assert_eq!(
        (&a.track_offsets, &a.track_views),
        (&b.track_offsets, &b.track_views),
        "{what}"
    );
    assert_eq!(a.track_pixels, b.track_pixels, "{what}");
}

#[test]
fn all_colmap_models_have_the_expected_counts() {
    let formats = formats();
    let expected = expected(&formats);
    assert!(expected.len() > 50);
    for (folder, expected) in &expected {
        let scene = read(&formats.join(folder));
        let count = |key: &str| expected[key].as_u64().unwrap() as usize;
        assert_eq!(scene.cameras.len(), count("cameras"), "{folder}");
        assert_eq!(scene.views.len(), count("registered"), "{folder}");
        assert_eq!(scene.points.len(), count("points3D"), "{folder}");
        assert_eq!(scene.observations(), count("observations"), "{folder}");
        let kinds: Vec<_> = scene.warnings.iter().map(|warning| warning.kind).collect();
        let lacks_points = scene.points.is_empty() && !scene.views.is_empty();
        let expected_kinds = if lacks_points {
            vec![WarningKind::NoPoints]
        } else {
            vec![]
        };
        assert_eq!(kinds, expected_kinds, "{folder}");
        if let Some(error) = expected["error"].as_f64() {
            let found = scene.mean_reprojection_error().unwrap();
            assert!(
                (found - error).abs() < 1e-5,
                "{folder}: {found} instead of {error}"
            );
        }
    }
}

#[test]
fn text_and_binary_are_the_same_model() {
    let formats = formats();
    let expected = expected(&formats);
    let mut compared = 0;
    for folder in expected.keys().filter(|folder| folder.ends_with("bin")) {
        let text = format!("{}txt", folder.strip_suffix("bin").unwrap());
        if folder.starts_with("names/") || !expected.contains_key(&text) {
            continue;
        }
        let (a, b) = (read(&formats.join(folder)), read(&formats.join(&text)));
        assert_eq!(a.track_views, b.track_views, "{folder}");
        let pixels = a.track_pixels.iter().zip(&b.track_pixels);
        assert!(
            pixels
                .flat_map(|(a, b)| [a[0] - b[0], a[1] - b[1]])
                .all(|d| d.abs() < 1e-9),
            "{folder}"
        );
        compared += 1;
    }
    assert!(compared > 20);
}

#[test]
fn colmap_text_name_cut() {
    let formats = formats();
    let names = |folder: &str| -> Vec<String> {
        read(&formats.join(folder))
            .views
            .iter()
            .map(|v| v.name.clone())
            .collect()
    };
    assert_eq!(names("names/txt"), names("names/bin"));
    for name in [
        "flug 2/straße/Übersicht ö.jpg",
        "日本/写真 2.png",
        "quote'd \"name\".jpg",
        // A separator of Windows.
        "back/slash.jpg",
    ] {
        assert!(names("names/txt").contains(&name.to_string()), "{name}");
    }
}

#[test]
fn quaternions_are_normalised() {
    let formats = formats();
    let (a, b) = (
        read(&formats.join("txt_unnormalised_quaternion")),
        read(&formats.join("ids_unordered/txt")),
    );
    for (a, b) in a.views.iter().zip(&b.views) {
        assert!(
            (a.cam_from_world.rotation.matrix() - b.cam_from_world.rotation.matrix()).norm()
                < 1e-12,
            "{}",
            a.name
        );
    }
}

#[test]
fn what_is_written_is_what_was_read() {
    let formats = formats();
    for folder in expected(&formats).keys() {
        let project = open(&formats.join(folder));
        let files = project.colmap_files().unwrap();
        let model = files.model().unwrap();
        let scene = model.scene().unwrap();
        let binary = colmap_bin::write(&model);
        if project.model.format == ModelFormat::ColmapBinary {
            for (name, bytes) in &binary {
                assert_eq!(
                    &std::fs::read(project.model.path.join(name)).unwrap(),
                    bytes,
                    "{folder}/{name}"
                );
            }
        }
        assert_same(&reread(&binary), &scene, folder);
        if folder.starts_with("names/") {
            assert!(colmap_text::write(&model).is_err());
        } else {
            assert_same(
                &reread(&colmap_text::write(&model).unwrap()),
                &scene,
                folder,
            );
        }
        // By way of the scene alone.
        let again = reread(&colmap_bin::write(&ColmapModel::from_scene(&scene)));
        assert_eq!(
            (&again.track_views, &again.track_pixels),
            (&scene.track_views, &scene.track_pixels),
            "{folder}"
        );
    }
}

#[test]
fn reduced_models_are_consistent() {
    let formats = formats();
    for folder in [
        "base_colmap42_bin",
        "ids_unordered/bin",
        "many_cameras/txt",
        "rig_oblique5/bin",
    ] {
        let files = open(&formats.join(folder)).colmap_files().unwrap();
        let model = files.model().unwrap();
        let whole = model.scene().unwrap();
        let kept: Vec<_> = whole.view_indices().filter(|v| v.0 % 3 != 0).collect();
        let ids: Vec<u32> = kept.iter().map(|&v| whole.view(v).image_id).collect();
        let use_of = |image: &ColmapImage| {
            if ids.contains(&image.id) {
                ImageUse::Counting
            } else {
                ImageUse::Removed
            }
        };
        let reduced = model.reduced(use_of, 2).unwrap();
        assert!(reduced.rigs.is_none() && reduced.frames.is_none());
        let used: Vec<u32> = reduced.images.iter().map(|i| i.camera_id).collect();
        assert!(
            reduced.cameras.iter().all(|c| used.contains(&c.id)),
            "{folder}"
        );
        // 2D points stay in place, linked only to points that are there.
        for image in &reduced.images {
            let before = model.images.iter().find(|i| i.id == image.id).unwrap();
            assert_eq!(before.points2d.len(), image.points2d.len());
            for (before, after) in before.points2d.iter().zip(image.points2d.iter()) {
                assert_eq!(before.pixel(), after.pixel());
                let id = before
                    .point()
                    .filter(|id| reduced.points.iter().any(|p| p.id == *id));
                assert_eq!(after.point(), id);
            }
        }
        // Oracle: the tracks of the whole scene without the dropped views.
        let mut expected = Vec::new();
        for p in 0..whole.points.len() {
            let track = whole.track(viewrank_core::model::scene::PointIndex(p as u32));
            let names = track.filter(|&o| kept.contains(&whole.track_views[o]));
            let names: Vec<_> = names
                .map(|o| (whole.name(whole.track_views[o]), whole.track_pixels[o]))
                .collect();
            let mut distinct: Vec<_> = names.iter().map(|n| n.0).collect();
            distinct.dedup();
            if distinct.len() >= 2 {
                expected.push((whole.point_ids[p], names));
            }
        }
        let scene = reread(&colmap_bin::write(&reduced));
        assert_eq!(scene.points.len(), expected.len(), "{folder}");
        for (p, (id, names)) in expected.iter().enumerate() {
            let track = scene.track(viewrank_core::model::scene::PointIndex(p as u32));
            let found: Vec<_> = track
                .map(|o| (scene.name(scene.track_views[o]), scene.track_pixels[o]))
                .collect();
            assert_eq!((scene.point_ids[p], &found), (*id, names), "{folder}");
        }
    }
}

#[test]
fn a_damaged_count_of_images_does_not_win() {
    let fixture = Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/valley/sparse/0");
    let folder = tempfile::tempdir().unwrap();
    for name in ["0", "1"] {
        let model = folder.path().join("sparse").join(name);
        std::fs::create_dir_all(&model).unwrap();
        for file in ["cameras.bin", "images.bin", "points3D.bin"] {
            std::fs::copy(fixture.join(file), model.join(file)).unwrap();
        }
    }
    let images = folder.path().join("sparse/0/images.bin");
    let mut bytes = std::fs::read(&images).unwrap();
    bytes[..8].copy_from_slice(&(1u64 << 60).to_le_bytes());
    std::fs::write(&images, bytes).unwrap();
    assert_eq!(open(folder.path()).model.name, "1");
}

#[test]
fn pixels_whose_points_do_not_know_them_are_counted() {
    let scene = read(&Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/valley"));
    assert_eq!(scene.warnings, []);
    let mut model = ColmapModel::from_scene(&scene);
    let stray =
        [Some(u64::MAX - 1), Some(scene.point_ids[0])].map(|point| Point2d::new([3.0, 4.0], point));
    model.images[2].points2d.to_mut().extend(stray);
    let read = reread(&colmap_bin::write(&model));
    assert!(
        read.warnings[0].text.starts_with("2 of "),
        "{:?}",
        read.warnings
    );
    assert_eq!(read.observations(), scene.observations());
}

#[test]
fn the_sub_model_with_most_images_is_taken() {
    let formats = formats();
    let path = formats.join("project_two_models");
    let project = open(&path);
    assert_eq!(
        (project.kind, project.model.name.as_str()),
        (ProjectKind::Colmap, "0")
    );
    let scene = project.read_scene().unwrap();
    assert_eq!(scene.views.len(), 7);
    assert_eq!(scene.warnings.len(), 1);
    assert!(
        scene.warnings[0].text.contains("1 (6 images)"),
        "{:?}",
        scene.warnings
    );
    let other = Project::open(&path, Some("1")).unwrap();
    assert_eq!(other.read_scene().unwrap().views.len(), 6);
    let error = Project::open(&path, Some("7")).unwrap_err();
    assert!(error.to_string().contains("0, 1"), "{error}");
    assert!(error.hint().is_some());
}

#[test]
fn unregistered_images_are_those_of_the_folder() {
    let folder = tempfile::tempdir().unwrap();
    let (model, images) = (folder.path().join("sparse/0"), folder.path().join("images"));
    [&model, &images]
        .iter()
        .for_each(|path| std::fs::create_dir_all(path).unwrap());
    for file in ["cameras.bin", "images.bin", "points3D.bin"] {
        std::fs::copy(
            formats().join("unregistered_colmap311/bin").join(file),
            model.join(file),
        )
        .unwrap();
    }
    let all: Vec<String> = read(&formats().join("base_colmap38_bin"))
        .views
        .iter()
        .map(|v| v.name.clone())
        .collect();
    all.iter()
        .for_each(|name| std::fs::write(images.join(name), "").unwrap());
    let scene = read(folder.path());
    assert_eq!(scene.views.len(), 9);
    let missing: Vec<_> = all
        .into_iter()
        .filter(|name| scene.find(name).is_none())
        .collect();
    assert_eq!(
        (scene.unregistered.len(), &scene.unregistered),
        (3, &missing)
    );
}

#[test]
fn a_project_is_recognised_by_what_lies_in_it() {
    let formats = formats();
    let base = formats.join("base_colmap38_bin");
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    let copy = |to: &str| {
        std::fs::create_dir_all(root.join(to)).unwrap();
        for file in ["cameras.bin", "images.bin", "points3D.bin"] {
            std::fs::copy(base.join(file), root.join(to).join(file)).unwrap();
        }
    };
    let error = Project::open(root, None).unwrap_err();
    assert!(matches!(error, ProjectError::NoModel { .. }), "{error}");
    assert!(matches!(
        Project::open(&root.join("nowhere"), None).unwrap_err(),
        ProjectError::NotFound(_)
    ));

    copy("sparse/10");
    copy("sparse/2");
    std::fs::create_dir(root.join("images")).unwrap();
    let project = open(root);
    // As many images in both: the first by name, 2 before 10.
    assert_eq!(
        (project.kind, project.model.name.as_str()),
        (ProjectKind::Colmap, "2")
    );
    assert_eq!(project.images.unwrap().to_path_buf(), root.join("images"));
    assert_eq!(project.dense_workspace, None);

    // A workspace is the model's if it has its images.
    std::fs::create_dir_all(root.join("dense/2/stereo")).unwrap();
    assert_eq!(open(root).dense_workspace, None);
    copy("dense/2/sparse");
    assert_eq!(open(root).dense_workspace, Some(root.join("dense/2")));
    for file in ["cameras.bin", "images.bin", "points3D.bin"] {
        std::fs::copy(
            formats.join("names/bin").join(file),
            root.join("dense/2/sparse").join(file),
        )
        .unwrap();
    }
    let other = open(root);
    assert_eq!(other.dense_workspace, None);
    let warnings = other.read_scene().unwrap().warnings;
    assert!(
        warnings
            .iter()
            .any(|w| w.text.contains("writes nothing into it")),
        "{warnings:?}"
    );
    assert_eq!(open(&root.join("sparse/10")).kind, ProjectKind::BareModel);
    assert_eq!(
        open(&root.join("sparse/10")).images.unwrap().to_path_buf(),
        root.join("images")
    );
    assert_eq!(
        open(&root.join("sparse/10/cameras.bin")).model.path,
        root.join("sparse/10")
    );

    std::fs::remove_dir_all(root.join("sparse")).unwrap();
    copy("sparse");
    std::fs::create_dir(root.join("stereo")).unwrap();
    assert_eq!(open(root).kind, ProjectKind::ColmapDense);
    assert_eq!(open(root).dense_workspace.as_deref(), Some(root));

    std::fs::remove_file(root.join("sparse/points3D.bin")).unwrap();
    let error = Project::open(root, None).unwrap_err();
    assert!(error.to_string().contains("points3D.bin"), "{error}");
    // Text is read where binary is not whole.
    for file in ["cameras.txt", "images.txt", "points3D.txt"] {
        std::fs::copy(
            formats.join("unregistered_colmap311/txt").join(file),
            root.join("sparse").join(file),
        )
        .unwrap();
    }
    assert_eq!(open(root).model.format, ModelFormat::ColmapText);
    assert_eq!(read(root).views.len(), 9);
    // Binary wins over text.
    std::fs::copy(base.join("points3D.bin"), root.join("sparse/points3D.bin")).unwrap();
    assert_eq!(read(root).views.len(), 12);
}

#[test]
fn inspect_prints_the_counts() {
    let formats = formats();
    let inspect = |folder: &str, format: &str| {
        let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_viewrank"));
        let output = command
            .arg("inspect")
            .arg(formats.join(folder))
            .args(["--format", format])
            .output()
            .unwrap();
        assert!(
            output.status.success(),
            "{}",
            String::from_utf8_lossy(&output.stderr)
        );
        String::from_utf8(output.stdout).unwrap()
    };
    for (folder, expected) in &expected(&formats) {
        let found: serde_json::Value = serde_json::from_str(&inspect(folder, "json")).unwrap();
        let format = if expected["format"] == "bin" {
            "colmap_binary"
        } else {
            "colmap_text"
        };
        assert_eq!(found["format"], format, "{folder}");
        for (key, expected_key) in [
            ("registered", "registered"),
            ("cameras", "cameras"),
            ("points", "points3D"),
            ("observations", "observations"),
        ] {
            assert_eq!(found[key], expected[expected_key], "{folder} {key}");
        }
        let (error, expected) = (
            found["mean_reprojection_error_px"].as_f64(),
            expected["error"].as_f64(),
        );
        assert_eq!(error.is_some(), expected.is_some(), "{folder}");
        assert!(
            (error.unwrap_or(0.0) - expected.unwrap_or(0.0)).abs() < 1e-5,
            "{folder}: {error:?}"
        );
    }
    let text = inspect("project_two_models", "text");
    assert!(
        text.contains("7 registered") && text.contains("1 (6 images)"),
        "{text}"
    );
}
