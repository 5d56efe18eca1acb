//! MVSNet's family: small readers after the grammars of PatchmatchNet, cascade, MVSNet.

use viewrank::MapScale;
use viewrank_core::model::scene::{CameraIndex, ViewIndex};

use super::{Files, Fixture, numbers, table};

/// Key view, partners and scores, as PatchmatchNet and cascade read: line by line.
fn pairs_by_line(text: &str) -> Vec<(usize, Vec<(usize, f64)>)> {
    let mut lines = text.lines();
    let count: usize = lines.next().unwrap().parse().unwrap();
    let mut entry = || {
        let key = lines.next().unwrap().trim_end().parse().unwrap();
        let words = numbers(lines.next().unwrap());
        assert_eq!(
            words.len(),
            1 + 2 * words[0] as usize,
            "the count, then an index and a score for each"
        );
        (
            key,
            words[1..]
                .chunks(2)
                .map(|w| (w[0] as usize, w[1]))
                .collect(),
        )
    };
    let entries = (0..count).map(|_| entry()).collect();
    assert_eq!(lines.next(), None);
    entries
}

/// The same by words, as MVSNet and the ACM programs read.
pub fn pairs_by_word(text: &str) -> Vec<(usize, Vec<(usize, f64)>)> {
    let mut words = text.split_whitespace().map(|w| w.parse::<f64>().unwrap());
    let mut next = || words.next().unwrap();
    let count = next() as usize;
    let entries = (0..count).map(|_| {
        let (key, partners) = (next() as usize, next() as usize);
        (
            key,
            (0..partners).map(|_| (next() as usize, next())).collect(),
        )
    });
    entries.collect()
}

pub fn names_of(files: &Files, pairs: &[(usize, Vec<(usize, f64)>)]) -> Vec<(String, Vec<String>)> {
    let names = table(files.text("view_names.txt"));
    let name = |i: &usize| names[i].clone();
    pairs
        .iter()
        .map(|(key, partners)| (name(key), partners.iter().map(|(p, _)| name(p)).collect()))
        .collect()
}

#[test]
fn pairs_have_the_files_of_mvsnet_and_tuples() {
    let fixture = Fixture::new(4);
    let (pairs, mvsnet) = (fixture.export("pairs"), fixture.export("mvsnet"));
    let mut names = pairs.names();
    names.retain(|name| *name != "tuples.txt");
    let mut named = mvsnet.names();
    // It has a program to call.
    named.retain(|name| *name != "run.sh");
    assert_eq!(names, named);
    for name in names.into_iter().filter(|name| name.ends_with(".txt")) {
        assert_eq!(pairs.text(name), mvsnet.text(name), "{name}");
    }
    let views = table(pairs.text("view_names.txt"));
    let tuple = |line: &&str| {
        let mut words = line.split(' ');
        assert_eq!(words.next(), Some("scene:0"));
        let mut named = words.map(|id| views[&id.parse().unwrap()].clone());
        (named.next().unwrap(), named.collect::<Vec<_>>())
    };
    let tuples: Vec<_> = pairs.lines("tuples.txt").iter().map(tuple).collect();
    assert_eq!(tuples, fixture.named());
}

#[test]
fn mvsnet_count_tokens() {
    let fixture = Fixture::new(4);
    for dialect in ["mvsnet", "patchmatchnet"] {
        let files = fixture.export(dialect);
        for list in ["pair.txt", "pair_fuse.txt"] {
            let by_line = pairs_by_line(files.text(list));
            assert_eq!(by_line, pairs_by_word(files.text(list)));
            assert!(
                by_line
                    .iter()
                    .flat_map(|(_, p)| p)
                    .all(|(_, score)| score.is_finite())
            );
        }
        assert_eq!(
            names_of(&files, &pairs_by_line(files.text("pair.txt"))),
            fixture.named()
        );
    }
}

#[test]
fn mvsnet_key_only_fusion_missing_maps() {
    let mut fixture = Fixture::new(4);
    let neighbour = fixture.connected(ViewIndex(12))[0].0;
    fixture.choose(&[12, neighbour, 49], 4);
    let files = fixture.export("patchmatchnet");
    let fuse = pairs_by_line(files.text("pair_fuse.txt"));
    assert_eq!(fuse.len(), 3);
    let keys: Vec<usize> = fuse.iter().map(|(key, _)| *key).collect();
    assert!(
        fuse.iter()
            .flat_map(|(_, p)| p)
            .all(|(partner, _)| keys.contains(partner)),
        "only key views have maps"
    );
    assert_eq!(fuse[0].1.len(), 1);
}

#[test]
fn mvsnet_key_views_confirm_others_that_are_no_partners() {
    let mut fixture = Fixture::new(4);
    let sharing: Vec<u32> = fixture
        .connected(ViewIndex(12))
        .iter()
        .map(|view| view.0)
        .collect();
    fixture.choose(&[12, sharing[0], sharing[1], sharing[2]], 1);
    let files = fixture.export("patchmatchnet");
    let names = names_of(&files, &pairs_by_line(files.text("pair_fuse.txt")));
    let of = |view: u32| fixture.scene.name(ViewIndex(view)).to_string();
    assert_eq!(
        names[0],
        (of(12), sharing[..3].iter().map(|&view| of(view)).collect()),
        "most shared points first"
    );
}

#[test]
fn mvsnet_self_pair() {
    let files = Fixture::new(4).export("mvsnet");
    assert!(
        pairs_by_word(files.text("pair.txt"))
            .iter()
            .all(|(key, p)| p.iter().all(|(partner, _)| partner != key))
    );
}

#[test]
fn mvsnet_score_token_mandatory() {
    let files = Fixture::new(2).export("mvsnet");
    let lists: Vec<&str> = files
        .lines("pair.txt")
        .into_iter()
        .skip(2)
        .step_by(2)
        .collect();
    assert!(
        lists
            .iter()
            .all(|line| line.split_whitespace().count() == 5)
    );
}

#[test]
fn mvsnet_zero_score_dropped() {
    let files = Fixture::new(4).export("mvsnet");
    let scores = pairs_by_word(files.text("pair.txt"))
        .into_iter()
        .flat_map(|(_, p)| p);
    assert!(
        scores.into_iter().all(|(_, score)| score >= 1.0),
        "also when written as integers"
    );
}

#[test]
fn mvsnet_index_mapping_differs() {
    let fixture = Fixture::new(3);
    let files = fixture.export("mvsnet");
    let names = table(files.text("view_names.txt"));
    assert_eq!(
        names.len(),
        fixture.scene.views.len(),
        "of all views: maps of earlier plans may be there"
    );
    for (i, name) in names
        .iter()
        .filter(|(i, _)| files.names().contains(&&*format!("images/{i:08}.jpg")))
    {
        let view = fixture.scene.find(name).unwrap();
        assert_eq!(
            *i,
            fixture.scene.view(view).image_id as usize,
            "the same in each plan"
        );
        assert_eq!(
            files.link(&format!("images/{i:08}.jpg")),
            fixture.project.images.as_ref().unwrap().join(name)
        );
        let cluster = files
            .0
            .record
            .clusters
            .iter()
            .flat_map(|c| std::iter::once(&c.key).chain(&c.partners));
        assert!(
            cluster
                .into_iter()
                .filter(|v| v.name == *name)
                .all(|v| v.target == i.to_string())
        );
    }
}

#[test]
fn mvsnet_geo_threshold() {
    let files = Fixture::new(3).export("patchmatchnet");
    let threshold = files.0.record.commands[1]
        .split("--geo_mask_thres ")
        .nth(1)
        .unwrap()
        .trim_end_matches(')');
    let support = viewrank::backends::by_name("patchmatchnet")
        .unwrap()
        .planning
        .support;
    assert_eq!(
        threshold.parse::<u32>().unwrap() + 1,
        support,
        "as many maps as the plan asks for, the key view's own among them"
    );
    let script = files.text("run.sh");
    let at = files.0.record.commands.iter().map(|c| script.find(c));
    assert!(at.clone().all(|at| at.is_some()) && at.is_sorted());
}

/// Rows of `run.json`.
fn rows(files: &Files) -> Vec<serde_json::Value> {
    let run: serde_json::Value = serde_json::from_str(files.text("run.json")).unwrap();
    run["maps"].as_array().unwrap().clone()
}

#[test]
fn patchmatchnet_reduces_images_as_planned() {
    let mut fixture = Fixture::new(3);
    let sizes = |fixture: &Fixture| {
        let commands = fixture.export("patchmatchnet").0.record.commands;
        [&commands[0], &commands[1]].map(|c| {
            c.split("--image_max_dim ")
                .nth(1)
                .map(|n| n.trim_matches(|c: char| !c.is_ascii_digit()).to_string())
        })
    };
    assert_eq!(sizes(&fixture), [None, None]);
    fixture.image_scale = 0.5;
    for size in sizes(&fixture) {
        assert!(size.unwrap().starts_with("320"));
    }
    assert!(!fixture.export("patchmatchnet").says("planned size"));
}

/// The program has one longest side for all images.
#[test]
fn patchmatchnet_reduces_small_images_less() {
    let mut fixture = Fixture::new(3);
    fixture
        .clusters
        .iter_mut()
        .for_each(|c| c.scale = MapScale::Half);
    let mut small = fixture.scene.cameras[0].clone();
    (small.width, small.height) = (401, 300);
    fixture.scene.cameras.push(small);
    let key = fixture.clusters[1].key;
    fixture.scene.views[key.index()].camera = CameraIndex(fixture.scene.cameras.len() as u32 - 1);
    let net = fixture.export("patchmatchnet");
    assert!(
        net.says("planned size of 1 map:"),
        "{:?}",
        net.0.record.not_honoured
    );
    assert_eq!(
        rows(&net)[1]["size"],
        serde_json::json!([320, 239]),
        "320 of 401, rounded down"
    );
}

#[test]
fn cameras_are_those_of_the_pictures_that_are_there() {
    let mut fixture = Fixture::new(3);
    let of = |fixture: &Fixture| {
        let net = fixture.export("patchmatchnet");
        let (_, intrinsic, _) = camera(first_camera(&net));
        (intrinsic, rows(&net)[0]["size"].clone())
    };
    let (whole, _) = of(&fixture);
    let views = fixture.scene.view_indices();
    fixture.image_faults.other_size = views.map(|view| (view, [320, 240])).collect();
    let (reduced, size) = of(&fixture);
    assert_eq!(size, serde_json::json!([320, 240]), "of 640 x 480");
    let halved: Vec<f64> = whole[..6].iter().map(|x| x / 2.0).collect();
    assert_eq!((&reduced[..6], reduced[8]), (&halved[..], 1.0));
}

/// The camera file of the first key view.
pub fn first_camera(files: &Files) -> &str {
    let number: usize = files.0.record.clusters[0].key.target.parse().unwrap();
    files.text(&format!("cams/{number:08}_cam.txt"))
}

/// Line 5 and 10 are empty, `extrinsic` is first, the matrices follow.
fn camera(text: &str) -> (Vec<f64>, Vec<f64>, Vec<f64>) {
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(lines.len(), 12);
    assert_eq!(
        (lines[0], lines[5], lines[6], lines[10]),
        ("extrinsic", "", "intrinsic", "")
    );
    (
        numbers(&lines[1..5].join(" ")),
        numbers(&lines[7..10].join(" ")),
        numbers(lines[11]),
    )
}

#[test]
fn mvsnet_cam_blank_lines() {
    let fixture = Fixture::new(3);
    let files = fixture.export("mvsnet");
    let names = table(files.text("view_names.txt"));
    for (i, name) in names {
        if !files.names().contains(&&*format!("cams/{i:08}_cam.txt")) {
            continue;
        }
        let (extrinsic, intrinsic, _) = camera(files.text(&format!("cams/{i:08}_cam.txt")));
        let view = fixture.scene.view(fixture.scene.find(&name).unwrap());
        let (r, t) = (
            view.cam_from_world.rotation.matrix(),
            view.cam_from_world.translation,
        );
        for row in 0..3 {
            assert_eq!(
                extrinsic[4 * row..4 * row + 4],
                [r[(row, 0)], r[(row, 1)], r[(row, 2)], t[row]]
            );
        }
        assert_eq!(extrinsic[12..], [0.0, 0.0, 0.0, 1.0]);
        assert_eq!(
            intrinsic,
            [510.0, 0.0, 330.25, 0.0, 500.0, 229.5, 0.0, 0.0, 1.0]
        );
    }
}

#[test]
fn mvsnet_scaled_intrinsics() {
    let mut fixture = Fixture::new(3);
    fixture.image_scale = 0.25;
    let files = fixture.export("mvsnet");
    assert_eq!(
        camera(first_camera(&files)).1[0],
        510.0,
        "K belongs to the stored image"
    );
}

#[test]
fn mvsnet_cam_word_count() {
    let fixture = Fixture::new(3);
    let words = |dialect: &str| {
        first_camera(&fixture.export(dialect))
            .split_whitespace()
            .count()
    };
    assert_eq!(
        (words("mvsnet"), words("acmm")),
        (31, 31),
        "MVSNet takes any other count for no depths at all"
    );
}

#[test]
fn mvsnet_depth_dialect() {
    let fixture = Fixture::new(3);
    let key = &fixture.scene.view(fixture.clusters[0].key).cam_from_world;
    let points = fixture.scene.view_points();
    let depths: Vec<f64> = points
        .observed_by(fixture.clusters[0].key)
        .iter()
        .map(|p| key.camera_from_world(&fixture.scene.points[p.index()]).z)
        .collect();
    let share_inside = |least: f64, greatest: f64| {
        depths
            .iter()
            .filter(|z| (least..=greatest).contains(*z))
            .count() as f64
            / depths.len() as f64
    };
    let line = |dialect: &str| camera(first_camera(&fixture.export(dialect))).2;

    let [least, interval, number, greatest] = line("mvsnet")[..] else {
        panic!("four numbers")
    };
    assert!(share_inside(least, greatest) > 0.97);
    assert!((least + interval * (number - 1.0) - greatest).abs() < 1e-9);
    let [least, greatest] = line("patchmatchnet")[..] else {
        panic!("least and greatest")
    };
    assert!(share_inside(least, greatest) > 0.97 && greatest < 3.0 * least);
}

#[test]
fn mvsnet_jpg_name() {
    let mut fixture = Fixture::new(3);
    fixture
        .scene
        .views
        .iter_mut()
        .for_each(|v| v.name = v.name.replace(".jpg", ".png"));
    let files = fixture.export("mvsnet");
    let images: Vec<&str> = files
        .names()
        .into_iter()
        .filter(|n| n.starts_with("images/"))
        .collect();
    assert!(!images.is_empty() && images.iter().all(|n| n.ends_with(".jpg")));
    assert!(
        images
            .iter()
            .all(|n| files.link(n).to_str().unwrap().ends_with(".png"))
    );
}

/// Each size has a folder of its own; PatchmatchNet's fusion takes all maps in their full size. The
/// others match all at one size.
#[test]
fn mvsnet_a_folder_per_size() {
    let mut fixture = Fixture::new(3);
    fixture.image_scale = 0.5;
    fixture.clusters[1].scale = MapScale::Half;
    fixture.clusters[3].scale = MapScale::Half;
    let named = fixture.named();
    let (full, half) = (
        [named[0].clone(), named[2].clone()],
        [named[1].clone(), named[3].clone()],
    );
    let net = fixture.export("patchmatchnet");
    assert_eq!(names_of(&net, &pairs_by_line(net.text("pair.txt"))), full);
    let pairs = pairs_by_line(net.text("half/pair.txt"));
    assert_eq!(names_of(&net, &pairs), half);
    for view in pairs
        .iter()
        .flat_map(|(key, partners)| partners.iter().map(|(p, _)| p).chain([key]))
    {
        let camera = format!("cams/{view:08}_cam.txt");
        assert_eq!(
            net.text(&format!("half/{camera}")),
            net.text(&camera),
            "the program reduces them"
        );
        assert!(
            net.names()
                .contains(&&*format!("half/images/{view:08}.jpg"))
        );
    }
    let commands = &net.0.record.commands;
    assert!(
        commands[0].contains("--input_folder \"$here\" ")
            && commands[0].contains("--image_max_dim 320 ")
    );
    assert!(
        commands[1].contains("--input_folder \"$here/half\" ")
            && commands[1].contains("--image_max_dim 160 ")
    );
    assert!(
        commands[..2]
            .iter()
            .all(|c| c.contains("--output_folder \"$here/depths\"")),
        "one map of a view"
    );
    assert_eq!(commands.len(), 2, "its fusion takes maps of one size");
    assert_eq!(pairs_by_line(net.text("pair_fuse.txt")).len(), 4);
    let sizes: Vec<_> = rows(&net)
        .iter()
        .map(|row| [row["size"][0].clone(), row["fused_size"][0].clone()])
        .collect();
    assert!(
        sizes.iter().all(|[_, fused]| fused == 320) && sizes.iter().any(|[size, _]| size == 160),
        "{sizes:?}"
    );
    fixture
        .clusters
        .iter_mut()
        .for_each(|c| c.scale = MapScale::Half);
    let net = fixture.export("patchmatchnet");
    assert_eq!(
        rows(&net)[0]["fused_size"][0],
        160,
        "half maps alone are joined in their size"
    );
    assert!(net.0.record.commands[1].contains("--image_max_dim 160"));
    let others = fixture.export("mvsnet");
    assert!(others.says("planned at half the size") && !others.names().contains(&"half/pair.txt"));
}
