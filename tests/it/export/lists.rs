//! Gaussian splatting, NeRF, plain lists: which images train.

use std::collections::{BTreeMap, BTreeSet};

use viewrank::backends::{ExportOptions, References};
use viewrank_io::formats::colmap_bin;

use super::Fixture;

#[test]
fn nerfstudio_all_splits_needed() {
    let files = Fixture::new(3).export("splat");
    let json = files.json("transforms.json");
    let frames: BTreeSet<&str> = json["frames"]
        .as_array()
        .unwrap()
        .iter()
        .map(|f| f["file_path"].as_str().unwrap())
        .collect();
    for split in ["train_filenames", "val_filenames", "test_filenames"] {
        let names = json[split].as_array().unwrap();
        assert!(
            !names.is_empty() && names.iter().all(|n| frames.contains(n.as_str().unwrap())),
            "{split}"
        );
    }
    assert_eq!(json["train_filenames"].as_array().unwrap().len(), 4);
}

#[test]
fn nerfstudio_val_list_name() {
    let fixture = Fixture::new(3);
    let files = fixture.export("splat");
    let train: Vec<String> = fixture.named().into_iter().map(|(key, _)| key).collect();
    assert_eq!(files.lines("train_list.txt"), train);
    for list in ["val_list.txt", "validation_list.txt", "test_list.txt"] {
        let lines = files.lines(list);
        assert!(
            !lines.is_empty() && lines.iter().all(|name| train.iter().any(|t| t == name)),
            "an empty line is an unknown name"
        );
    }
}

#[test]
fn nerf_cameras_look_backward_along_z() {
    let fixture = Fixture::new(3);
    let json = fixture.export("splat").json("transforms.json");
    let matrix = &json["frames"][0]["transform_matrix"];
    let column = |j: usize| [0, 1, 2].map(|i: usize| matrix[i][j].as_f64().unwrap());
    let pose = &fixture.scene.view(fixture.clusters[0].key).cam_from_world;
    let direction = pose.viewing_direction();
    assert!((0..3).all(|i| (column(2)[i] + direction[i]).abs() < 1e-12));
    assert!((0..3).all(|i| (column(3)[i] - pose.centre()[i]).abs() < 1e-9));
    assert_eq!(json["frames"][0]["cx"], 330.25);
}

#[test]
fn gsplat_holdout_eats_key_views() {
    let files = Fixture::new(3).export("splat");
    let command = files
        .0
        .record
        .commands
        .iter()
        .find(|c| c.contains("gsplat"))
        .unwrap();
    assert!(
        command.ends_with("--test_every 5"),
        "more than there are images: only the first is held out ({command})"
    );
    let first = files
        .lines("train_list.txt")
        .into_iter()
        .min()
        .unwrap()
        .to_owned();
    assert!(files.says(&format!("the first image by name ({first})")));
}

#[test]
fn gsplat_images_n_by_position() {
    let files = Fixture::new(3).export("splat");
    assert!(!files.names().iter().any(|n| n.starts_with("images_")));
    assert!(files.0.record.commands[0].contains("--data_factor 1"));
}

#[test]
fn brush_picks_largest_model() {
    let files = Fixture::new(3).export("splat");
    let models: BTreeSet<&str> = files
        .names()
        .into_iter()
        .filter(|n| n.ends_with("images.bin"))
        .map(|n| n.rsplit_once('/').unwrap().0)
        .collect();
    assert_eq!(
        models,
        BTreeSet::from(["sparse/0"]),
        "the reduced model alone"
    );
}

#[test]
fn trap_3dgs_stale_points3d_ply() {
    let files = Fixture::new(3).export("splat");
    let ply = files.bytes("sparse/0/points3D.ply");
    let head =
        std::str::from_utf8(&ply[..ply.windows(11).position(|w| w == b"end_header\n").unwrap()])
            .unwrap();
    let count: usize = head
        .lines()
        .find_map(|l| l.strip_prefix("element vertex "))
        .unwrap()
        .parse()
        .unwrap();
    assert_eq!(
        count,
        model(&files).points.len(),
        "written anew with each export"
    );
    assert_eq!(ply.len(), head.len() + 11 + count * (6 * 4 + 3));
}

#[test]
fn trap_3dgs_basename_collision() {
    let mut fixture = Fixture::new(3);
    fixture.scene.views[12].name = "flight 0/same.a.jpg".into();
    fixture.scene.views[30].name = "flight 1/same.b.jpg".into();
    assert!(fixture.export("splat").says("for the same image"));
}

fn model(files: &super::Files) -> viewrank_io::formats::colmap::ColmapModel<'static> {
    model_in(files, "sparse/0")
}

fn model_in(
    files: &super::Files,
    folder: &str,
) -> viewrank_io::formats::colmap::ColmapModel<'static> {
    let leak = |name: &str| -> &'static [u8] {
        Vec::leak(files.bytes(&format!("{folder}/{name}")).to_vec())
    };
    let bytes = viewrank_io::formats::Bytes {
        cameras: leak("cameras.bin"),
        images: leak("images.bin"),
        points3d: leak("points3D.bin"),
        rigs: None,
        frames: None,
    };
    colmap_bin::read(&bytes).unwrap()
}

#[test]
fn model_dangling_track() {
    let model = model(&Fixture::new(3).export("splat"));
    let images: BTreeMap<u32, usize> = model
        .images
        .iter()
        .map(|i| (i.id, i.points2d.len()))
        .collect();
    for element in model.points.iter().flat_map(|p| p.track.iter()) {
        assert!((element.index() as usize) < images[&element.image()]);
    }
}

#[test]
fn model_renumbered_points2d() {
    let fixture = Fixture::new(3);
    let model = model(&fixture.export_with(
        "splat",
        &ExportOptions {
            refs: Some(References::KeysAndPartners),
            ..Default::default()
        },
    ));
    let scene = model.scene().unwrap();
    for (p, id) in scene.point_ids.iter().enumerate() {
        let original = fixture
            .scene
            .point_ids
            .iter()
            .position(|o| o == id)
            .unwrap();
        assert_eq!(scene.points[p], fixture.scene.points[original]);
        for i in scene.track_offsets[p]..scene.track_offsets[p + 1] {
            let name = scene.name(scene.track_views[i]);
            let there =
                fixture.scene.track_offsets[original]..fixture.scene.track_offsets[original + 1];
            let same = there
                .into_iter()
                .find(|&o| fixture.scene.name(fixture.scene.track_views[o]) == name)
                .unwrap();
            assert_eq!(scene.track_pixels[i], fixture.scene.track_pixels[same]);
        }
    }
}

#[test]
fn images_are_listed_best_first() {
    let fixture = Fixture::new(2);
    let keys: Vec<String> = fixture.named().into_iter().map(|(key, _)| key).collect();
    assert_eq!(fixture.export("images").lines("images.txt"), keys);
    let refs = |refs| ExportOptions {
        refs: Some(refs),
        ..Default::default()
    };
    let files = fixture.export_with("images", &refs(References::KeysAndPartners));
    let with_partners = files.lines("images.txt");
    let (key, partners) = &fixture.named()[0];
    assert_eq!(with_partners[..3], [key, &partners[0], &partners[1]]);
    let all = fixture.export_with("images", &refs(References::All));
    assert_eq!(all.lines("images.txt").len(), fixture.scene.views.len());
}

/// A fixture of which every seventh view is kept for tests, as no cluster has it.
fn with_tests() -> (Fixture, Vec<String>) {
    let mut fixture = Fixture::new(3);
    let tests = fixture.scene.kept_for_tests(Some(7), &[]);
    let others: Vec<_> = fixture
        .matchable()
        .into_iter()
        .filter(|view| !tests.contains(view))
        .collect();
    for (cluster, key) in fixture.clusters.iter_mut().zip(&others) {
        cluster.key = *key;
        cluster.partners.clear();
    }
    fixture.test_every = Some(7);
    let names = tests.iter().map(|&view| fixture.name(view).to_owned());
    let names = names.collect();
    (fixture, names)
}

fn images_of(files: &super::Files, folder: &str) -> BTreeSet<String> {
    let below = |name: &&str| name.strip_prefix(folder).map(String::from);
    files.names().iter().filter_map(below).collect()
}

#[test]
fn test_images_are_in_the_lists_for_tests_and_never_trained_on() {
    let (fixture, tests) = with_tests();
    let files = fixture.export("splat");
    let train: BTreeSet<String> = fixture.named().into_iter().map(|(key, _)| key).collect();
    let all: BTreeSet<String> = train.iter().chain(&tests).cloned().collect();
    assert_eq!(all.len(), train.len() + tests.len());
    for list in [
        "val_list.txt",
        "validation_list.txt",
        "test_list.txt",
        "sparse/0/test.txt",
    ] {
        assert_eq!(files.lines(list), tests, "{list}");
    }
    let listed: BTreeSet<String> = files
        .lines("train_list.txt")
        .iter()
        .map(|&n| n.into())
        .collect();
    assert_eq!(listed, train);
    let json = files.json("transforms.json");
    let frames = json["frames"].as_array().unwrap().len();
    let splits = ["train_filenames", "val_filenames", "test_filenames"]
        .map(|split| json[split].as_array().unwrap().len());
    assert_eq!(
        (frames, splits),
        (all.len(), [train.len(), tests.len(), tests.len()])
    );
    let in_model = |folder| -> BTreeSet<String> {
        let images = model_in(&files, folder).images;
        images.into_iter().map(|image| image.name.into()).collect()
    };
    assert_eq!(
        (in_model("sparse/0"), images_of(&files, "images/")),
        (all.clone(), all)
    );
    let without = (
        in_model("train/sparse/0"),
        images_of(&files, "train/images/"),
    );
    assert_eq!(without, (train.clone(), train));
    for command in &files.0.record.commands {
        let reads_lists = command.starts_with("ns-train");
        let is_in_train = command.split(' ').any(|word| word == "train");
        assert_ne!(reads_lists, is_in_train, "{command}");
    }
    assert!(files.says("nerfstudio: other trainers hold out every n-th image"));
}

#[test]
fn test_images_are_in_no_plain_list() {
    let (fixture, tests) = with_tests();
    let all = ExportOptions {
        refs: Some(References::All),
        ..Default::default()
    };
    let files = fixture.export_with("images", &all);
    let listed = files.lines("images.txt");
    assert_eq!(listed.len() + tests.len(), fixture.scene.views.len());
    assert!(tests.iter().all(|name| !listed.contains(&name.as_str())));
}
