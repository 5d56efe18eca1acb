//! ACMH, ACMM, ACMP, ACMMP: every image is a problem, and ids are positions.

use std::collections::BTreeSet;

use super::{Fixture, mvsnet, numbers};

#[test]
fn acm_partner_must_be_problem() {
    let fixture = Fixture::new(4);
    let files = fixture.export("acmm");
    let pairs = mvsnet::pairs_by_word(files.text("pair.txt"));
    let problems: BTreeSet<usize> = pairs.iter().map(|(key, _)| *key).collect();
    assert!(
        pairs
            .iter()
            .flat_map(|(_, p)| p)
            .all(|(partner, _)| problems.contains(partner))
    );
    assert_eq!(
        mvsnet::names_of(&files, &pairs)[..4],
        fixture.named()[..],
        "key views first, in rank order"
    );
}

#[test]
fn acmm_id_is_position() {
    let files = Fixture::new(4).export("acmm");
    let pairs = mvsnet::pairs_by_word(files.text("pair.txt"));
    assert!(pairs.iter().enumerate().all(|(i, (key, _))| i == *key));
    let images = files
        .names()
        .into_iter()
        .filter(|n| n.starts_with("images/"))
        .count();
    assert_eq!(pairs.len(), images);
}

#[test]
fn acm_fusion_maps_unknown_to_zero() {
    let files = Fixture::new(4).export("acmm");
    assert!(
        files.says("every view of a cluster gets one"),
        "so no partner is unknown to its fusion"
    );
}

#[test]
fn acm_score_zero_dropped() {
    let files = Fixture::new(4).export("acmm");
    assert!(
        mvsnet::pairs_by_word(files.text("pair.txt"))
            .iter()
            .flat_map(|(_, p)| p)
            .all(|(_, score)| *score >= 1.0)
    );
}

#[test]
fn acm_max_32_partners() {
    let mut fixture = Fixture::new(4);
    fixture.choose(&[12], 40);
    let most = fixture.clusters[0].partners.len();
    let files = fixture.export("acmm");
    let longest = mvsnet::pairs_by_word(files.text("pair.txt"))
        .iter()
        .map(|(_, p)| p.len())
        .max()
        .unwrap();
    assert!(
        most > 32 && longest == 32 && files.says("beyond the first 32"),
        "{most} {longest}"
    );
}

#[test]
fn acmh_device_1() {
    assert!(
        Fixture::new(3)
            .export("acmm")
            .says("ACMH takes the second GPU")
    );
}

#[test]
fn acm_four_depth_tokens() {
    let files = Fixture::new(3).export("acmm");
    assert_eq!(numbers(files.lines("cams/00000000_cam.txt")[11]).len(), 4);
}

#[test]
fn acm_double_range_relaxation() {
    let fixture = Fixture::new(3);
    let depths = |dialect: &str| {
        numbers(
            super::mvsnet::first_camera(&fixture.export(dialect))
                .lines()
                .nth(11)
                .unwrap(),
        )
    };
    let (plain, acm) = (depths("mvsnet"), depths("acmm"));
    assert!(
        (plain[0] / acm[0] - 0.9).abs() < 1e-9 && (plain[3] / acm[3] - 1.1).abs() < 1e-9,
        "it widens the range itself"
    );
}

#[test]
fn acmm_fuses_key_views_only() {
    let fixture = Fixture::new(3);
    let files = fixture.export("acmm");
    let lists = files.lines("pair_fuse.txt");
    assert_eq!((lists[0], lists.len()), ("4", 9));
}
