//! PMVS2: its option reader and the reader of vis.dat, by position.

use super::{Fixture, numbers};

/// `name value`, where timages and oimages hold a counted list.
fn options(text: &str) -> (Vec<usize>, Vec<usize>, Vec<String>) {
    let mut words = text.split_whitespace();
    let (mut timages, mut oimages, mut names) = (Vec::new(), Vec::new(), Vec::new());
    while let Some(name) = words.next() {
        names.push(name.to_owned());
        let value = words.next().unwrap();
        let mut list = |to: &mut Vec<usize>| {
            let count: i32 = value.parse().unwrap();
            assert!(count >= 0, "ranges and other forms are not used");
            to.extend((0..count).map(|_| words.next().unwrap().parse::<usize>().unwrap()));
        };
        match name {
            "timages" => list(&mut timages),
            "oimages" => list(&mut oimages),
            _ => {}
        }
    }
    (timages, oimages, names)
}

fn visibility(text: &str) -> Vec<Vec<usize>> {
    let mut words = text.split_whitespace();
    assert_eq!(words.next(), Some("VISDATA"));
    let mut next = || words.next().unwrap().parse::<usize>().unwrap();
    let count = next();
    // The first number of a row is read and thrown away: rows count by position.
    let rows = (0..count).map(|_| {
        next();
        let partners = next();
        (0..partners).map(|_| next()).collect()
    });
    rows.collect()
}

#[test]
fn pmvs_visdata_row_position() {
    let fixture = Fixture::new(4);
    let files = fixture.export("pmvs");
    let rows = visibility(files.text("vis.dat"));
    let first: Vec<usize> = files.lines("vis.dat")[2..]
        .iter()
        .map(|l| numbers(l)[0] as usize)
        .collect();
    assert_eq!(
        first,
        (0..rows.len()).collect::<Vec<_>>(),
        "complete and ascending"
    );
    assert!(rows[..4].iter().all(|row| row.len() >= 4) && rows[4..].iter().all(Vec::is_empty));
}

#[test]
fn pmvs_visdata_ids() {
    let fixture = Fixture::new(4);
    let files = fixture.export("pmvs");
    let rows = visibility(files.text("vis.dat"));
    let cameras = files
        .names()
        .into_iter()
        .filter(|n| n.starts_with("txt/"))
        .count();
    assert!(
        rows.len() == cameras && rows.iter().flatten().all(|&i| i < cameras),
        "indices, never image ids"
    );
    let indexed: Vec<usize> = files.0.record.clusters[1]
        .partners
        .iter()
        .map(|p| p.target.parse().unwrap())
        .collect();
    assert_eq!(rows[1][..indexed.len()], indexed);
}

#[test]
fn pmvs_row_goes_on_with_what_shares_points() {
    let fixture = Fixture::new(4);
    let files = fixture.export("pmvs");
    let rows = visibility(files.text("vis.dat"));
    let clusters = &files.0.record.clusters;
    let mut names = vec![""; rows.len()];
    for exported in clusters
        .iter()
        .flat_map(|c| std::iter::once(&c.key).chain(&c.partners))
    {
        names[exported.target.parse::<usize>().unwrap()] = &exported.name;
    }
    let view = |name: &str| fixture.scene.find(name).unwrap();
    let points = fixture.scene.view_points();
    for (key, row) in rows[..4].iter().enumerate() {
        let shares = |&other: &usize| {
            !points
                .shared(view(names[key]), view(names[other]))
                .is_empty()
        };
        let (mut listed, partners) = (row.clone(), clusters[key].partners.len());
        listed[partners..]
            .iter()
            .for_each(|other| assert!(shares(other), "{} {}", names[key], names[*other]));
        listed.sort_unstable();
        let wanted: Vec<usize> = (0..rows.len())
            .filter(|other| row[..partners].contains(other) || (*other != key && shares(other)))
            .collect();
        assert_eq!(listed, wanted, "each once");
    }
}

#[test]
fn pmvs_image_in_both_lists() {
    let mut fixture = Fixture::new(4);
    let neighbour = fixture.connected(viewrank_core::model::scene::ViewIndex(12))[0].0;
    fixture.choose(&[12, neighbour], 4);
    let (timages, oimages, _) = options(fixture.export("pmvs").text("option-viewrank"));
    assert_eq!(timages, [0, 1]);
    assert!(oimages.iter().all(|i| !timages.contains(i)));
}

#[test]
fn pmvs_timages_minus_one_range() {
    let files = Fixture::new(3).export("pmvs");
    assert!(
        !files.text("option-viewrank").contains("-1"),
        "lists are written out: `-1 a b` excludes b"
    );
}

#[test]
fn pmvs_no_comment_in_lists() {
    assert!(
        !Fixture::new(3)
            .export("pmvs")
            .text("option-viewrank")
            .contains('#')
    );
}

#[test]
fn pmvs_unknown_option_exits() {
    let known = "level csize threshold wsize minImageNum CPU setEdge useBound useVisData sequence timages oimages quad maxAngle";
    let (_, _, names) = options(Fixture::new(3).export("pmvs").text("option-viewrank"));
    assert!(
        names.iter().all(|name| known.split(' ').any(|k| k == name)),
        "{names:?}"
    );
}

#[test]
fn pmvs_prefix_slash() {
    assert_eq!(
        Fixture::new(3).export("pmvs").0.record.commands,
        ["pmvs2 ./ option-viewrank"]
    );
}

#[test]
fn pmvs_half_pixel() {
    let fixture = Fixture::new(3);
    let files = fixture.export("pmvs");
    assert_eq!(
        files.0.record.pixel_shift, 0.0,
        "as COLMAP's own export, and written down"
    );
    let p = numbers(&files.lines("txt/00000000.txt")[1..].join(" "));
    let view = fixture.clusters[0].key;
    let point = fixture.scene.points[fixture.scene.view_points().observed_by(view)[0].index()];
    let row = |i: usize| {
        p[4 * i] * point.x + p[4 * i + 1] * point.y + p[4 * i + 2] * point.z + p[4 * i + 3]
    };
    let pixel = fixture
        .scene
        .camera_of(view)
        .project(
            &fixture
                .scene
                .view(view)
                .cam_from_world
                .camera_from_world(&point),
        )
        .unwrap();
    assert!((row(0) / row(2) - pixel.x).abs() < 1e-9 && (row(1) / row(2) - pixel.y).abs() < 1e-9);
}

#[test]
fn pmvs_order_ignored() {
    assert!(Fixture::new(3).export("pmvs").says("rank order"));
}
