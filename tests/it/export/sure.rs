//! SURE: oriented images, lists, one project per cluster.

use viewrank::{MapScale, backends::ExportOptions};
use viewrank_core::base::error::Hint;
use viewrank_io::formats::sure;

use super::Fixture;

#[test]
fn pair_files_are_those_of_the_method() {
    let fixture = Fixture::new(3);
    let files = fixture.export("sgm");
    let clusters: Vec<String> = fixture
        .named()
        .iter()
        .map(|(k, p)| format!("{k}\t{}", p.join("\t")))
        .collect();
    assert_eq!(files.lines("clusters.txt"), clusters);
    let pairs: Vec<String> = fixture
        .named()
        .iter()
        .flat_map(|(k, p)| p.iter().map(move |p| format!("{k}\t{p}")))
        .collect();
    assert_eq!(files.lines("pairs.txt"), pairs);
    let keys: Vec<String> = fixture.named().into_iter().map(|(k, _)| k).collect();
    assert_eq!(files.lines("baseImages.txt"), keys);
}

#[test]
fn names_that_the_pair_files_cannot_hold_are_refused() {
    for name in ["a\tb.jpg", "a\nb.jpg", "#a.jpg"] {
        let mut fixture = Fixture::new(3);
        fixture.scene.views[12].name = name.into();
        for backend in ["sgm", "sure"] {
            let error = fixture
                .try_export(backend, &ExportOptions::default())
                .err()
                .unwrap();
            assert!(error.to_string().contains(name) && error.hint().is_some());
        }
    }
}

#[test]
fn sure_ori_folder_exact_count() {
    let files = Fixture::new(3).export("sure");
    let stems = |folder: &str, extension: &str| {
        let inside = files
            .names()
            .into_iter()
            .filter_map(|n| n.strip_prefix(folder)?.strip_suffix(extension))
            .map(str::to_owned);
        inside.collect::<Vec<_>>()
    };
    assert_eq!(stems("ori/", ".ori"), stems("images/", ".jpg"));
    assert!(
        files
            .names()
            .iter()
            .filter(|n| n.starts_with("ori/"))
            .all(|n| n.ends_with(".ori"))
    );
}

/// The folders of the clusters, in rank order.
fn folders(fixture: &Fixture) -> Vec<String> {
    fixture
        .clusters
        .iter()
        .map(|c| format!("clusters/{:08}", fixture.scene.view(c.key).image_id))
        .collect()
}

#[test]
fn sure_list_order_is_correspondence() {
    let fixture = Fixture::new(3);
    let files = fixture.export("sure");
    for folder in ["", &format!("{}/", folders(&fixture)[1])] {
        let stem = |path: &&str| {
            path.rsplit('/')
                .next()
                .unwrap()
                .rsplit_once('.')
                .unwrap()
                .0
                .to_owned()
        };
        let images: Vec<String> = files
            .lines(&format!("{folder}images.txt"))
            .iter()
            .map(stem)
            .collect();
        let orientations: Vec<String> = files
            .lines(&format!("{folder}ori.txt"))
            .iter()
            .map(stem)
            .collect();
        assert_eq!(images, orientations);
    }
}

#[test]
fn one_project_per_cluster_has_its_images_and_its_base_image_only() {
    let fixture = Fixture::new(3);
    let files = fixture.export("sure");
    for (i, (key, partners)) in fixture.named().iter().enumerate() {
        let flat = |name: &String| name.replace('/', "_");
        let folder = &folders(&fixture)[i];
        let wanted: Vec<String> = std::iter::once(key)
            .chain(partners)
            .map(|n| format!("../../images/{}", flat(n)))
            .collect();
        assert_eq!(files.lines(&format!("{folder}/images.txt")), wanted);
        assert_eq!(
            files.lines(&format!("{folder}/baseImages.txt")),
            [flat(key).replace(".jpg", "")]
        );
        let project = folder.replace("clusters", "projects");
        let prepare = &files.0.record.commands[2 * i];
        assert!(
            prepare.contains(&format!("-basepath {project} "))
                && prepare.contains(&format!("-img {folder}/"))
        );
        assert!(files.0.record.commands[2 * i].contains("-maxmodels 3"));
    }
    let keys: Vec<String> = fixture
        .named()
        .iter()
        .map(|(k, _)| k.replace('/', "_").replace(".jpg", ""))
        .collect();
    assert_eq!(
        files.lines("baseImages.txt"),
        keys,
        "the joint project too, in rank order"
    );
}

#[test]
fn sure_stem_collision() {
    let mut fixture = Fixture::new(3);
    fixture.scene.views[12].name = "flight 0/img 012.jpg".into();
    fixture.scene.views[3].name = "flight 0/img 012.tif".into();
    let error = fixture
        .try_export("sure", &ExportOptions::default())
        .err()
        .unwrap();
    assert!(error.to_string().contains("img 012"), "{error}");
}

#[test]
fn sure_black_pixels_invalid() {
    assert!(
        Fixture::new(3)
            .export("sure")
            .says("black count as invalid")
    );
}

/// The numbers behind a key of an `.ori` file.
fn ori(text: &str, key: &str) -> Vec<f64> {
    let after = text
        .lines()
        .skip_while(|line| !line.starts_with(&format!("${key}_")))
        .skip(1);
    after
        .take_while(|line| !line.starts_with('$'))
        .flat_map(super::numbers)
        .collect()
}

fn first_ori(fixture: &Fixture) -> String {
    let flat = fixture
        .name(fixture.clusters[0].key)
        .replace('/', "_")
        .replace(".jpg", ".ori");
    fixture
        .export("sure")
        .text(&format!("ori/{flat}"))
        .to_owned()
}

#[test]
fn sure_centre_not_translation() {
    let fixture = Fixture::new(3);
    let text = first_ori(&fixture);
    let pose = &fixture.scene.view(fixture.clusters[0].key).cam_from_world;
    let (written, centre) = (ori(&text, "ExtOri_TranslationVector"), pose.centre());
    assert!(
        (0..3).all(|i| (written[i] - centre[i]).abs() < 1e-9),
        "{written:?} {centre}"
    );
    let r = ori(&text, "ExtOri_RotationMatrix");
    assert_eq!(
        r[1],
        pose.rotation.matrix()[(0, 1)],
        "world to image, row by row"
    );
}

#[test]
fn sure_pixel_centre_minus_half() {
    let text = first_ori(&Fixture::new(3));
    assert_eq!(ori(&text, "IntOri_PrincipalPoint"), [329.75, 229.0]);
    assert_eq!(
        ori(&text, "IntOri_CameraMatrix"),
        [510.0, 0.0, 329.75, 0.0, 500.0, 229.0, 0.0, 0.0, 1.0]
    );
}

#[test]
fn sure_precision() {
    let mut fixture = Fixture::new(3);
    let far = nalgebra::Vector3::new(431_234.0, 5_412_345.0, 210.0);
    for view in &mut fixture.scene.views {
        let pose = &mut view.cam_from_world;
        pose.translation -= pose.rotation * far;
    }
    let centre = fixture
        .scene
        .view(fixture.clusters[0].key)
        .cam_from_world
        .centre();
    let written = ori(&first_ori(&fixture), "ExtOri_TranslationVector");
    assert!(
        (0..3).all(|i| written[i] == centre[i]),
        "every digit of map coordinates: {written:?}"
    );
}

#[test]
fn orientations_are_read_back() {
    let fixture = Fixture::new(3);
    let files = fixture.export("sure");
    for view in fixture
        .scene
        .view_indices()
        .filter(|v| fixture.clusters.iter().any(|c| c.key == *v))
    {
        let flat = fixture.name(view).replace('/', "_");
        let read = sure::read(
            files
                .text(&format!("ori/{}", flat.replace(".jpg", ".ori")))
                .as_bytes(),
            1,
        )
        .unwrap();
        assert_eq!(read.image, flat);
        assert_eq!(read.camera.params(), fixture.scene.camera_of(view).params());
        let (a, b) = (
            read.cam_from_world.pose().unwrap().centre(),
            fixture.scene.view(view).cam_from_world.centre(),
        );
        assert!((a - b).norm() < 1e-12);
    }
}

/// `run.sh` is run in tests/python.
#[test]
fn the_batch_file_tries_every_cluster_and_ends_with_what_became_of_them() {
    let fixture = Fixture::new(3);
    let files = fixture.export("sure");
    let lines = files.lines("run.bat");
    assert_eq!(lines[..3], ["@echo off", "cd /d \"%~dp0\"", "set failed=0"]);
    for (i, line) in lines[3..lines.len() - 1].iter().enumerate() {
        let (calls, otherwise) = line.split_once(" || ").unwrap();
        let folder = folders(&fixture)[i].replace("clusters/", "projects\\");
        let calls: Vec<&str> = calls.split(" && ").collect();
        assert_eq!(
            (calls.len(), calls[0]),
            (3, &*format!("(if not exist {folder} mkdir {folder})"))
        );
        assert!(calls[1..].iter().all(
            |c| c.starts_with(&format!("sure.exe -basepath {folder} ")) || c.ends_with(&folder)
        ));
        assert!(otherwise.starts_with("(echo error: ") && otherwise.ends_with(" & set failed=1)"));
    }
    assert_eq!(
        (lines.len(), lines[lines.len() - 1]),
        (3 + 4 + 1, "exit /b %failed%")
    );
}

#[test]
fn sure_a_pyramid_level_for_each_size() {
    let mut fixture = Fixture::new(3);
    fixture.image_scale = 0.5;
    fixture.clusters[1].scale = MapScale::Half;
    let files = fixture.export("sure");
    let levels: Vec<&str> = files
        .0
        .record
        .commands
        .iter()
        .filter_map(|c| c.split(" -pyr ").nth(1)?.split(' ').next())
        .collect();
    assert_eq!(levels, ["1", "2", "1", "1"]);
    assert!(files.says("sizes in a joint project"));
}
