//! MVE's dmrecon: bundles that steer its choice of views.

use std::collections::BTreeSet;

use viewrank::MapScale;
use viewrank_io::depthmaps;

use super::{Files, Fixture, numbers};

/// Cameras that are there and the references of each feature, as load_photosynther_bundle reads.
fn bundle(text: &str) -> (Vec<bool>, Vec<Vec<usize>>) {
    let (head, rest) = text.split_once('\n').unwrap();
    assert_eq!(head, "drews 1.0");
    let mut words = rest.split_whitespace().map(|w| w.parse::<f64>().unwrap());
    let mut next = || words.next().unwrap();
    let (cameras, features) = (next() as usize, next() as usize);
    let valid = (0..cameras)
        .map(|_| (0..15).map(|_| next()).collect::<Vec<_>>()[0] != 0.0)
        .collect();
    let references = (0..features).map(|_| {
        (0..6).for_each(|_| _ = next());
        let count = next() as usize;
        let views = (0..count).map(|_| {
            let view = next() as usize;
            next();
            next();
            view
        });
        views.collect()
    });
    let references = references.collect();
    assert_eq!(words.next(), None);
    (valid, references)
}

fn members(files: &Files, cluster: usize) -> BTreeSet<usize> {
    let cluster = &files.0.record.clusters[cluster];
    std::iter::once(&cluster.key)
        .chain(&cluster.partners)
        .map(|v| v.target.parse().unwrap())
        .collect()
}

#[test]
fn mve_bundle_mixes_clusters() {
    let mut fixture = Fixture::new(3);
    let neighbour = fixture.connected(viewrank_core::model::scene::ViewIndex(12))[0].0;
    fixture.choose(&[12, neighbour], 3);
    let files = fixture.export("mve");
    for cluster in 0..2 {
        let (valid, references) = bundle(files.text(&format!("bundles/{:04}.out", cluster + 1)));
        let there: BTreeSet<usize> = (0..valid.len()).filter(|&i| valid[i]).collect();
        assert_eq!(there, members(&files, cluster), "one bundle per key view");
        let seen: BTreeSet<usize> = references.into_iter().flatten().collect();
        assert_eq!(seen, there);
    }
}

#[test]
fn mve_partners_by_tracks_only() {
    let fixture = Fixture::new(3);
    let files = fixture.export("mve");
    let key: usize = files.0.record.clusters[2].key.target.parse().unwrap();
    let (_, references) = bundle(files.text("bundles/0003.out"));
    assert!(
        references
            .iter()
            .all(|views| views.contains(&key) && views.len() > 1)
    );
    assert!(files.says("dmrecon chooses among them"));
}

/// The default of 4 is for 20 neighbours: where 4 of few must agree, most of the map stays empty.
#[test]
fn mve_local_neighbors_default_4() {
    for (k, wanted) in [(1, 1), (2, 2), (3, 2), (6, 2)] {
        let files = Fixture::new(k).export("mve");
        let command = files
            .0
            .record
            .commands
            .iter()
            .find(|c| c.starts_with("dmrecon"))
            .unwrap();
        assert!(
            command.contains(&format!("--neighbors={k} --local-neighbors={wanted}")),
            "{command}"
        );
    }
}

#[test]
fn mve_view_id_not_index() {
    let files = Fixture::new(3).export("mve");
    let mut ids = BTreeSet::new();
    for cluster in &files.0.record.clusters {
        for view in std::iter::once(&cluster.key).chain(&cluster.partners) {
            let meta = files.text(&format!("views/view_{:08}.mve/meta.ini", view.image_id));
            assert!(
                meta.contains(&format!("\nid = {}\nname = {}\n", view.target, view.name)),
                "{meta}"
            );
            ids.insert(view.target.parse::<usize>().unwrap());
        }
    }
    assert!(
        ids.iter().copied().eq(0..ids.len()),
        "MVE refuses ids that are large for the number of views"
    );
}

#[test]
fn mve_existing_depth_skipped() {
    let files = Fixture::new(3).export("mve");
    let calls: Vec<_> = files
        .0
        .record
        .commands
        .iter()
        .filter(|c| c.starts_with("dmrecon"))
        .collect();
    assert_eq!(calls.len(), 4);
    assert!(
        calls.iter().all(|c| c.contains(" -m")),
        "-l would pass over views that have a map, -m does not"
    );
}

#[test]
fn mve_scale_in_name() {
    let mut fixture = Fixture::new(3);
    fixture.image_scale = 0.5;
    let commands = fixture.export("mve").0.record.commands;
    assert!(
        commands
            .iter()
            .filter(|c| c.starts_with("dmrecon"))
            .all(|c| c.contains(" -s1 "))
    );
    assert!(commands.last().unwrap().contains("-F1 "));
}

/// Maps of each size are joined by themselves, since `scene2pset` takes one level; `fssrecon` takes
/// both clouds.
#[test]
fn mve_levels_of_two_sizes() {
    let mut fixture = Fixture::new(3);
    fixture.image_scale = 0.5;
    fixture.clusters[1].scale = MapScale::Half;
    fixture.clusters[3].scale = MapScale::Half;
    let files = fixture.export("mve");
    let commands = &files.0.record.commands;
    let levels: Vec<&str> = commands
        .iter()
        .filter_map(|c| c.strip_prefix("dmrecon ")?.split_whitespace().next())
        .collect();
    assert_eq!(levels, ["-s1", "-s2", "-s1", "-s2"]);
    assert_eq!(
        commands[8..],
        [
            "scene2pset -F1 -v0,2 . fused.ply",
            "scene2pset -F2 -v1,3 . fused_half.ply"
        ]
    );
    let script = files.text("run.sh");
    assert!(script.contains("\njoin fused.ply -F1 -v0,2\njoin fused_half.ply -F2 -v1,3\n"));
    assert!(
        files
            .0
            .record
            .fusion
            .contains("fssrecon fused.ply fused_half.ply surface.ply")
    );
    // Without ids scene2pset would take all views.
    fixture
        .clusters
        .iter_mut()
        .for_each(|cluster| cluster.scale = MapScale::Half);
    let files = fixture.export("mve");
    assert_eq!(
        files.0.record.commands[8..],
        ["scene2pset -F2 -v0,1,2,3 . fused_half.ply"]
    );
}

#[test]
fn mve_order_parallel() {
    let files = Fixture::new(3).export("mve");
    let masters: Vec<&str> = files
        .0
        .record
        .commands
        .iter()
        .filter_map(|c| c.split(" -m").nth(1)?.split(' ').next())
        .collect();
    assert_eq!(
        masters,
        ["0", "1", "2", "3"],
        "one call per key view keeps the order"
    );
}

/// MVE's maps hold distances from the camera: what is read is the depth along the optical axis.
#[test]
fn mve_ray_length_depth() {
    let fixture = Fixture::new(3);
    let files = fixture.export("mve");
    let folder = tempfile::tempdir().unwrap();
    // 10 units from the camera everywhere.
    let mut map = b"\x89MVE_IMAGE\n".to_vec();
    map.extend([64i32, 48, 1, 9].iter().flat_map(|v| v.to_le_bytes()));
    map.extend(std::iter::repeat_n(10f32.to_le_bytes(), 64 * 48).flatten());
    for meta in files
        .names()
        .into_iter()
        .filter(|name| name.ends_with("meta.ini"))
    {
        let path = folder.path().join(meta);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(&path, files.text(meta)).unwrap();
        std::fs::write(path.with_file_name("depth-L0.mvei"), &map).unwrap();
    }
    let found = depthmaps::find(folder.path(), &fixture.scene).unwrap();
    assert!(found.unassigned.is_empty() && found.maps.len() >= fixture.clusters.len());
    let file = &found.maps[0];
    let (camera, z) = (
        fixture.scene.camera_of(file.view),
        depthmaps::read_of_view(file, &fixture.scene).unwrap(),
    );
    for (column, row) in [(0, 0), (31, 20), (63, 47)] {
        let ray = camera.ray(&z.image_position(camera, column, row)).unwrap();
        assert!((z.depth_at(column, row).unwrap() - 10.0 * ray.z).abs() < 1e-5);
    }
}

/// Focal length in units of the larger side, the principal point in units of each side.
#[test]
fn views_have_the_model_s_cameras() {
    let fixture = Fixture::new(3);
    let files = fixture.export("mve");
    let meta = files.text(&format!(
        "views/view_{:08}.mve/meta.ini",
        files.0.record.clusters[0].key.image_id
    ));
    let value = |key: &str| {
        meta.lines()
            .find_map(|l| l.strip_prefix(&format!("{key} = ")))
            .unwrap()
    };
    assert_eq!(numbers(value("focal_length"))[0] * 640.0, 510.0);
    assert_eq!(
        numbers(value("focal_length"))[0] * 640.0 * numbers(value("pixel_aspect"))[0],
        500.0
    );
    assert_eq!(
        numbers(value("principal_point")),
        [330.25 / 640.0, 229.5 / 480.0]
    );
    let r = numbers(value("rotation"));
    let pose = &fixture.scene.view(fixture.clusters[0].key).cam_from_world;
    assert_eq!(r[1], pose.rotation.matrix()[(0, 1)]);
}
