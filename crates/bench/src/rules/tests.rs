//! The rules against the programs that they are taken from, on `fixtures/valley`
//! (`fixtures/valley_partners.json`, whose README is `fixtures/README.md`), and on constructed
//! cases.

use std::{collections::BTreeMap, path::Path};

use nalgebra::{Matrix3, Point3, Rotation3, Vector3};

use super::*;
use viewrank::Project;
use viewrank_core::model::{
    camera::{Camera, CameraModel},
    scene::{CameraIndex, Pose, View},
};

type Lists = BTreeMap<String, Vec<String>>;

fn fixture() -> (Scene, BTreeMap<String, Lists>) {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fixtures");
    let scene = Project::open(&folder.join("valley"), None)
        .and_then(|p| p.read_scene())
        .unwrap();
    let lists = std::fs::read_to_string(folder.join("valley_partners.json")).unwrap();
    (scene, serde_json::from_str(&lists).unwrap())
}

fn names(scene: &Scene, views: &[ViewIndex]) -> Vec<String> {
    views.iter().map(|&v| scene.name(v).into()).collect()
}

fn rule(name: &str) -> &'static SelectionRule {
    RULES.iter().find(|r| r.name == name).unwrap()
}

#[test]
fn colmap_chooses_as_colmap_does() {
    let (scene, lists) = fixture();
    let points = scene.view_points();
    for (key, expected) in &lists["colmap"] {
        let hood = Neighbourhood::new(&scene, &points, scene.find(key).unwrap());
        assert_eq!(
            names(&scene, &colmap::choose(&hood, 11)),
            *expected,
            "{key}"
        );
    }
}

#[test]
fn mvsnet_chooses_as_its_script_does() {
    let (scene, lists) = fixture();
    let points = scene.view_points();
    for (key, expected) in &lists["mvsnet"] {
        let hood = Neighbourhood::new(&scene, &points, scene.find(key).unwrap());
        assert_eq!(
            names(&scene, &mvsnet::choose(&hood, expected.len())),
            *expected,
            "{key}"
        );
    }
}

#[test]
fn openmvs_orders_neighbours_as_openmvs_does() {
    let (scene, lists) = fixture();
    let points = scene.view_points();
    for (key, expected) in &lists["openmvs"] {
        let hood = Neighbourhood::new(&scene, &points, scene.find(key).unwrap());
        let found: Vec<_> = openmvs::neighbours(&hood)
            .into_iter()
            .map(|n| n.view)
            .collect();
        assert_eq!(names(&scene, &found), *expected, "{key}");
    }
}

/// Views at `x` looking down from 10 m, and which of them observe each point of a row on the
/// ground.
fn row_of_views(x: &[f64], observed: &[&[u32]]) -> Scene {
    let pose = |x: f64| {
        let rotation = Rotation3::from_matrix_unchecked(Matrix3::from_diagonal(&Vector3::new(
            1.0, -1.0, -1.0,
        )));
        Pose {
            rotation,
            translation: -(rotation * Vector3::new(x, 0.0, 10.0)),
        }
    };
    let view = |(i, &x): (usize, &f64)| View {
        name: format!("{i}"),
        image_id: i as u32,
        file_position: i as u32,
        camera: CameraIndex(0),
        cam_from_world: pose(x),
    };
    let camera = Camera::new(
        1,
        CameraModel::Pinhole,
        1000,
        1000,
        vec![500.0, 500.0, 500.0, 500.0],
    )
    .unwrap();
    let mut scene = Scene {
        cameras: vec![camera],
        views: x.iter().enumerate().map(view).collect(),
        track_offsets: vec![0],
        ..Default::default()
    };
    for (p, views) in observed.iter().enumerate() {
        scene.points.push(Point3::new(p as f64 * 0.1, 0.0, 0.0));
        scene
            .track_views
            .extend(views.iter().map(|&v| ViewIndex(v)));
        scene.track_offsets.push(scene.track_views.len());
    }
    scene
}

fn chosen(scene: &Scene, rule_name: &str, k: usize) -> Vec<u32> {
    let clusters = rule(rule_name).clusters(scene, &[ViewIndex(0)], k);
    clusters
        .first()
        .map(|c| c.partners.iter().map(|p| p.0).collect())
        .unwrap_or_default()
}

#[test]
fn greedy_rules_pass_over_a_twin_of_a_partner() {
    // 1 and 2 are at the same position and share three points with the key view; 3 is elsewhere and
    // shares two.
    let scene = row_of_views(
        &[0.0, 3.0, 3.0, -3.0],
        &[&[0, 1, 2], &[0, 1, 2, 3], &[0, 1, 2, 3]],
    );
    assert_eq!(chosen(&scene, "maxcon", 2), [1, 2]);
    assert_eq!(chosen(&scene, "goesele", 2), [1, 3]);
}

#[test]
fn goesele_weighs_angle_and_scale() {
    let scale = super::goesele::scale;
    assert_eq!(
        [scale(0.5), scale(1.0), scale(1.5), scale(2.0), scale(4.0)],
        [0.5, 1.0, 1.0, 1.0, 0.5]
    );
    // Half the full angle counts a quarter: 2 points at more than 10 degrees beat 7 at 4.6.
    let both: &[u32] = &[0, 1, 2];
    let scene = row_of_views(
        &[0.0, 0.8, 3.0],
        &[both, both, &[0, 1], &[0, 1], &[0, 1], &[0, 1], &[0, 1]],
    );
    assert_eq!(chosen(&scene, "goesele", 1), [2]);
    assert_eq!(chosen(&scene, "maxcon", 1), [1]);
}

#[test]
fn shen_takes_the_smallest_angle_times_distance_inside_his_limits() {
    // Angles about 2.9, 11, 17, 22 degrees, and 63: the first and the last are out.
    let all: &[u32] = &[0, 1, 2, 3, 4, 5];
    let scene = row_of_views(&[0.0, 0.5, 4.0, 2.0, 3.0, 20.0], &[all]);
    assert_eq!(chosen(&scene, "shen", 11), [3, 4, 2]);
}

#[test]
fn mindist_looks_at_centres_alone() {
    let scene = row_of_views(&[0.0, 5.0, 1.0, -2.0], &[&[0, 1]]);
    assert_eq!(chosen(&scene, "mindist", 2), [2, 3]);
    assert_eq!(chosen(&scene, "maxcon", 2), [1]);
}

#[test]
fn every_rule_names_distinct_partners_and_never_the_key_view() {
    let (scene, _) = fixture();
    let keys: Vec<ViewIndex> = scene.view_indices().collect();
    for rule in RULES {
        for cluster in rule.clusters(&scene, &keys, 5) {
            let mut partners = cluster.partners.clone();
            partners.push(cluster.key);
            partners.sort_unstable();
            partners.dedup();
            assert_eq!(partners.len(), cluster.partners.len() + 1, "{}", rule.name);
            assert!(cluster.partners.len() <= 5);
        }
        assert_eq!(
            rule.clusters(&scene, &keys, 5),
            rule.clusters(&scene, &keys, 5),
            "{}",
            rule.name
        );
        assert!(rule.clusters(&scene, &keys, 5).len() > 20, "{}", rule.name);
    }
}
