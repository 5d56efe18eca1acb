//! The definition of f against what it stands for: finite differences, Monte Carlo runs, special
//! cases.

use nalgebra::{DMatrix, DVector, Point3, Vector2, Vector3};
use rand_core::{Rng, SeedableRng};
use rand_pcg::Pcg64;

use super::*;
use crate::{
    base::{column::Storage, progress::NoWatcher},
    method::{
        confidence::{Agreement, Confidence, PairAgreement, PairConfidence, Photometric},
        synthetic::{SeenTown, Town},
        target::{TargetMode, TargetSettings},
        visibility::Shown,
    },
    model::{
        camera::{Camera, CameraModel},
        cluster::ViewCluster,
    },
};

/// A town with its table and everything that f needs.
#[derive(Clone)]
struct Setting {
    scene: Scene,
    surface: Surface,
    visibility: Visibility,
    target: Target,
    unary: Unary,
    agreement: Agreement,
}

impl Setting {
    fn new(model: CameraModel, params: &[f64]) -> Self {
        let camera = Camera::new(1, model, 1000, 750, params.to_vec()).unwrap();
        let town = Town {
            edge: 4.0,
            points: 50,
            ..Town::new(camera)
        };
        let SeenTown {
            scene,
            surface,
            visibility,
            target,
        } = town.seen(&TargetSettings::default(), 0.05, Storage::Memory);
        Self {
            scene,
            surface,
            visibility,
            target,
            unary: Unary::certain(),
            agreement: Agreement::default(),
        }
    }

    /// Views 11 and 36 have no picture, and no view was compared with view 13.
    fn with_pictures(self) -> Self {
        let geometry = Geometry {
            scene: &self.scene,
            surface: &self.surface,
            visibility: &self.visibility,
            target: &self.target,
            image_scale: 1.0,
        };
        let views: Vec<ViewIndex> = self.scene.view_indices().collect();
        let compared: Vec<ViewIndex> = views.iter().copied().filter(|view| view.0 != 13).collect();
        let without: Vec<bool> = views
            .iter()
            .map(|view| [11, 36].contains(&view.0))
            .collect();
        let value = |key: ViewIndex, partner: ViewIndex, t: u32| {
            ((7 * key.0 + 31 * partner.0 + 3 * t) % 256) as u8
        };
        let agreement = Agreement::made_up(&geometry, |_| &compared, &without, value);
        Self { agreement, ..self }
    }

    fn pinhole() -> Self {
        Self::new(CameraModel::Pinhole, &[850.0, 820.0, 500.0, 375.0])
    }

    fn distorted() -> Self {
        Self::new(
            CameraModel::OpenCv,
            &[800.0, 820.0, 510.0, 370.0, -0.2, 0.05, 0.001, -0.002],
        )
    }

    fn model(&self, confidence: Confidence) -> Model<'_> {
        let rule = FulfilmentRule {
            alpha: 0.4,
            sigma_px: 0.5,
            min_cameras: 3,
            image_scale: 1.0,
            confidence,
        };
        let Self {
            scene,
            surface,
            visibility,
            target,
            unary,
            agreement,
        } = self;
        Model {
            scene,
            surface,
            visibility,
            target,
            unary,
            agreement,
            rule,
        }
    }
}

/// The centroid of a large triangle may be behind a camera that sees one of its corners.
#[test]
fn a_view_that_has_a_triangle_behind_it_has_no_say_in_its_target() {
    let mut setting = Setting::pinhole();
    let turned = ViewIndex(0);
    let about = nalgebra::Rotation3::from_axis_angle(&Vector3::y_axis(), std::f64::consts::PI);
    let pose = &mut setting.scene.views[0].cam_from_world;
    (pose.rotation, pose.translation) = (about * pose.rotation, about * pose.translation);
    let Setting {
        scene,
        surface,
        visibility,
        ..
    } = &setting;
    let settings = TargetSettings {
        mode: TargetMode::Best,
        ..TargetSettings::default()
    };
    let of_the_whole = 123.0;
    let target = Target::new(
        &Shown::new(scene, surface, visibility),
        &settings,
        of_the_whole,
        1.0,
    );
    let seen_by = |view: ViewIndex| visibility.triangles_seen_by(view);
    let others: std::collections::BTreeSet<u32> = scene
        .view_indices()
        .filter(|view| *view != turned)
        .flat_map(|view| seen_by(view).iter().copied())
        .collect();
    let (shared, alone): (Vec<u32>, Vec<u32>) =
        seen_by(turned).iter().partition(|t| others.contains(t));
    assert!(
        !shared.is_empty()
            && shared
                .iter()
                .all(|&t| target.gsd[t as usize] < of_the_whole as f32)
    );
    assert!(
        alone
            .iter()
            .all(|&t| target.gsd[t as usize] == of_the_whole as f32)
    );
}

/// A standard normal number.
fn normal(random: &mut Pcg64) -> f64 {
    let mut unit = || ((random.next_u64() >> 11) as f64 + 0.5) / (1u64 << 53) as f64;
    (-2.0 * unit().ln()).sqrt() * (std::f64::consts::TAU * unit()).cos()
}

/// A point triangulated by Gauss-Newton from noisy pixels.
fn triangulate(
    model: &Model,
    views: &[ViewIndex],
    truth: &Point3<f64>,
    random: &mut Pcg64,
) -> Point3<f64> {
    let sees = |x: &Point3<f64>, v: &ViewIndex| {
        let pose = &model.scene.view(*v).cam_from_world;
        let projected = model
            .scene
            .camera_of(*v)
            .project_with_jacobian(&pose.camera_from_world(x))
            .unwrap();
        (projected.0.coords, projected.1 * pose.rotation.matrix())
    };
    let mut noise = || Vector2::new(normal(random), normal(random)) * model.rule.sigma_px;
    let measured: Vec<_> = views.iter().map(|v| sees(truth, v).0 + noise()).collect();
    let mut x = *truth;
    for _ in 0..5 {
        let (mut jacobian, mut rest) = (
            DMatrix::zeros(2 * views.len(), 3),
            DVector::zeros(2 * views.len()),
        );
        for (i, v) in views.iter().enumerate() {
            let (pixel, j) = sees(&x, v);
            jacobian.rows_mut(2 * i, 2).copy_from(&j);
            rest.rows_mut(2 * i, 2).copy_from(&(measured[i] - pixel));
        }
        let step = (jacobian.transpose() * &jacobian)
            .lu()
            .solve(&(jacobian.transpose() * rest))
            .unwrap();
        x += Vector3::new(step[0], step[1], step[2]);
    }
    x
}

#[test]
fn uncertainty_is_that_of_a_monte_carlo_triangulation() {
    for setting in [Setting::pinhole(), Setting::distorted()] {
        // So strict that nothing reaches it, as f_unc ends at 1.
        let target = Target {
            accuracy_over_gsd: 0.1,
            ..setting.target.clone()
        };
        let model = Model {
            target: &target,
            ..setting.model(Confidence::None)
        };
        let mut random = Pcg64::seed_from_u64(7);
        let key = ViewIndex(12);
        let triangle = model.visibility.triangles_seen_by(key)[40];
        let others = model
            .scene
            .view_indices()
            .filter(|&v| v != key && model.visibility.row(v, triangle).is_some());
        let partners: Vec<ViewIndex> = others.step_by(3).take(3).collect();
        let views = [&[key], &partners[..]].concat();
        let centroid = model.surface.centroid(triangle);
        let runs = 4000;
        let mut covariance = Matrix3::zeros();
        for _ in 0..runs {
            let miss = triangulate(&model, &views, &centroid, &mut random) - centroid;
            covariance += miss * miss.transpose() / f64::from(runs);
        }
        let expected =
            model.target.accuracy(triangle) / covariance.symmetric_eigenvalues().max().sqrt();
        let ours = value(&model, key, &partners, triangle).uncertainty;
        assert!(ours < 1.0 && expected < 1.0);
        // The spread of a standard deviation over so many runs is 1.1 %.
        assert!((ours / expected - 1.0).abs() < 0.05, "{ours} {expected}");
    }
}

#[test]
fn resolution_is_that_of_many_small_pieces() {
    for setting in [Setting::pinhole(), Setting::distorted()] {
        let model = setting.model(Confidence::None);
        let (key, n) = (ViewIndex(12), 40);
        let (camera, pose) = (
            model.scene.camera_of(key),
            &model.scene.view(key).cam_from_world,
        );
        for &t in model.visibility.triangles_seen_by(key).iter().step_by(17) {
            let [a, b, c] = model.surface.corners(t);
            let at = |i: u32, j: u32| {
                let (u, v) = (f64::from(i) / f64::from(n), f64::from(j) / f64::from(n));
                camera.project(&pose.camera_from_world(&(a + (b - a) * u + (c - a) * v)))
            };
            let piece = |i: u32, j: u32, size: u32| {
                let [p, q, r] = [at(i, j)?, at(i + size, j)?, at(i, j + size)?];
                Some(0.5 * (q - p).perp(&(r - p)).abs())
            };
            // Twice the upward pieces: the downward ones are as large to first order.
            let pieces: Option<f64> = (0..n)
                .flat_map(|i| (0..n - i).map(move |j| piece(i, j, 1)))
                .sum();
            let Some(pieces) = pieces.map(|sum| sum * f64::from(n) / f64::from(n + 1) * 2.0) else {
                continue;
            };
            let density = density(&model, key, t) * model.surface.area(t);
            assert!((density / pieces - 1.0).abs() < 0.02, "{density} {pieces}");
        }
    }
}

#[test]
fn information_is_that_of_finite_differences() {
    for setting in [Setting::pinhole(), Setting::distorted()] {
        let model = setting.model(Confidence::None);
        let view = ViewIndex(37);
        let (camera, pose) = (
            model.scene.camera_of(view),
            &model.scene.view(view).cam_from_world,
        );
        for &t in model.visibility.triangles_seen_by(view).iter().step_by(29) {
            let centroid = model.surface.centroid(t);
            let mut jacobian = nalgebra::Matrix2x3::zeros();
            for axis in 0..3 {
                let step = Vector3::ith(axis, 1e-4);
                let at = |x: Point3<f64>| camera.project(&pose.camera_from_world(&x)).unwrap();
                jacobian.set_column(axis, &((at(centroid + step) - at(centroid - step)) / 2e-4));
            }
            jacobian /= model.rule.sigma_px;
            let expected = jacobian.transpose() * jacobian;
            assert!((information(&model, view, t) - expected).norm() < 1e-6 * expected.norm());
        }
    }
}

#[test]
fn a_cluster_without_enough_cameras_fulfils_nothing() {
    let setting = Setting::pinhole();
    let model = setting.model(Confidence::None);
    let key = ViewIndex(12);
    let triangle = setting.visibility.triangles_seen_by(key)[10];
    assert_eq!(value(&model, key, &[ViewIndex(11)], triangle).value, 0.0);
    let unseen = (0..)
        .find(|&t| setting.visibility.row(key, t).is_none())
        .unwrap();
    assert_eq!(
        value(&model, key, &[ViewIndex(11), ViewIndex(13)], unseen),
        Fulfilment::default()
    );
}

#[test]
fn smaller_images_resolve_less() {
    let setting = Setting::pinhole();
    let full = setting.model(Confidence::None);
    let half = Model {
        rule: FulfilmentRule {
            image_scale: 0.5,
            ..full.rule
        },
        ..full
    };
    let (key, partners) = (ViewIndex(12), [ViewIndex(11), ViewIndex(17)]);
    let triangle = setting.visibility.triangles_seen_by(key)[40];
    let target = Target {
        gsd: vec![0.01; setting.surface.triangles.len()],
        ..setting.target.clone()
    };
    let f = |model: Model| {
        value(
            &Model {
                target: &target,
                ..model
            },
            key,
            &partners,
            triangle,
        )
    };
    assert!((f(half).resolution / f(full).resolution - 0.25).abs() < 1e-9);
    assert!((f(half).uncertainty / f(full).uncertainty - 0.5).abs() < 1e-9);
}

#[test]
fn the_best_target_is_reached_by_the_nearest_view() {
    let setting = Setting::pinhole();
    assert_eq!(setting.target.mode, TargetMode::Best);
    let key = ViewIndex(12);
    // Straight below the camera the nearest view resolves 1.25 times finer than wanted.
    let below = setting.scene.view(key).cam_from_world.centre();
    let nearest = |&t: &u32| (setting.surface.centroid(t).xy() - below.xy()).norm();
    let seen = setting.visibility.triangles_seen_by(key).iter().copied();
    let triangle = seen
        .min_by(|a, b| nearest(a).total_cmp(&nearest(b)))
        .unwrap();
    assert_eq!(
        value(&setting.model(Confidence::None), key, &[], triangle).resolution,
        1.0
    );
    let typed = TargetSettings {
        gsd: Some(0.02),
        accuracy: Some(0.03),
        ..Default::default()
    };
    let shown = Shown::new(&setting.scene, &setting.surface, &setting.visibility);
    let target = Target::new(&shown, &typed, 0.02, 1.0);
    assert_eq!((target.mode, target.gsd[0]), (TargetMode::Absolute, 0.02));
    assert!((target.accuracy(0) - 0.03).abs() < 1e-8);
}

#[test]
fn a_pair_counts_by_its_geometry_and_both_views() {
    let mut setting = Setting::pinhole();
    setting.unary = Unary::certain().within(vec![0.5; setting.visibility.triangles.len()].into());
    let numbers = PairConfidence {
        min_matches: 1,
        p0: 0.8,
        cosine_power: 0.0,
        scale_octaves: None,
        full_angle_deg: None,
    };
    let (key, partners) = (ViewIndex(12), [ViewIndex(11), ViewIndex(17)]);
    let everyone = |t: &&u32| {
        partners
            .iter()
            .all(|&p| setting.visibility.row(p, **t).is_some())
    };
    let triangle = *setting
        .visibility
        .triangles_seen_by(key)
        .iter()
        .find(everyone)
        .unwrap();
    let confidence = |c: Confidence| value(&setting.model(c), key, &partners, triangle).confidence;
    assert!(
        (confidence(Confidence::Pair(numbers)) - (1.0 - 0.8 * 0.8)).abs() < 1e-12,
        "0.8 times both masks"
    );
    assert_eq!(confidence(Confidence::None), 1.0);
}

/// The written table against the definition, with all kinds of confidence, for every triangle of
/// some clusters.
#[test]
fn the_table_holds_what_the_definition_says() {
    let sure = PairConfidence {
        min_matches: 2,
        p0: 0.8,
        cosine_power: 1.0,
        scale_octaves: Some(0.7),
        full_angle_deg: None,
    };
    let patch_match = PairConfidence {
        min_matches: 1,
        p0: 0.6,
        cosine_power: 0.5,
        scale_octaves: None,
        full_angle_deg: Some(40.0),
    };
    let three = PairConfidence {
        min_matches: 3,
        ..sure
    };
    let agreement = Photometric {
        agree: 0.9,
        differ: 0.1,
        full_agreement: 0.7,
    };
    let settings = [Setting::pinhole(), Setting::distorted()]
        .map(Setting::with_pictures)
        .into_iter()
        .flat_map(|setting| {
            let rows = setting.visibility.triangles.len();
            let varied = Unary::of_points((0..rows).map(|r| (r % 7) as u8).collect(), 6)
                .within((0..rows).map(|r| (r % 101) as f32 / 100.0).collect());
            [Unary::certain(), varied].map(|unary| Setting {
                unary,
                ..setting.clone()
            })
        });
    for setting in settings {
        let views = |v: &[u32]| v.iter().map(|&v| ViewIndex(v)).collect::<Vec<_>>();
        let clusters = [
            (12, views(&[11, 13, 7, 17, 37])),
            (40, views(&[12, 7])),
            (3, views(&[])),
            (30, views(&[0, 5, 31, 36])),
        ]
        .map(|(key, partners)| ViewCluster {
            key: ViewIndex(key),
            partners,
        });
        let confidences = [
            Confidence::None,
            Confidence::Pair(sure),
            Confidence::Pair(patch_match),
            Confidence::Pair(three),
            Confidence::Photometric {
                agreement,
                otherwise: sure,
            },
            Confidence::Photometric {
                agreement,
                otherwise: patch_match,
            },
        ];
        for (confidence, accuracy_over_gsd) in
            confidences.into_iter().zip([1.0, 0.3, 0.1, 0.5, 0.3, 1.0])
        {
            let target = Target {
                accuracy_over_gsd,
                ..setting.target.clone()
            };
            let model = Model {
                target: &target,
                ..setting.model(confidence)
            };
            let table = table(&model, &clusters, &NoWatcher).unwrap();
            for (c, cluster) in clusters.iter().enumerate() {
                let (triangles, values) = table.row(c);
                assert!(values.iter().all(|&f| f > 0.0));
                for &t in setting.visibility.triangles_seen_by(cluster.key) {
                    let expected = value(&model, cluster.key, &cluster.partners, t).value;
                    let ours = triangles
                        .binary_search(&t)
                        .map_or(0.0, |i| f64::from(values[i]));
                    assert!(
                        (ours - expected).abs() <= 1e-5 * expected,
                        "{confidence:?} {cluster:?} {t}: {ours} {expected}"
                    );
                }
            }
        }
    }
}

/// Without a picture of both views the geometry of the pair counts; a pair that was not compared
/// has no match.
#[test]
fn a_pair_counts_by_what_its_pictures_show() {
    let setting = Setting::pinhole().with_pictures();
    let agreement = Photometric {
        agree: 0.9,
        differ: 0.1,
        full_agreement: 0.7,
    };
    let otherwise = PairConfidence {
        min_matches: 1,
        p0: 0.8,
        cosine_power: 0.0,
        scale_octaves: None,
        full_angle_deg: None,
    };
    let (key, partners) = (ViewIndex(12), [11, 13, 7, 17].map(ViewIndex));
    let everyone = |t: &u32| {
        partners
            .iter()
            .all(|&p| setting.visibility.row(p, *t).is_some())
    };
    let seen = setting.visibility.triangles_seen_by(key);
    let row = seen.iter().position(everyone).unwrap();
    let model = setting.model(Confidence::Photometric {
        agreement,
        otherwise,
    });
    let shown =
        |partner: u32| agreement.chance(((7 * 12 + 31 * partner + 3 * seen[row]) % 256) as u8);
    for (partner, expected) in partners.into_iter().zip([0.8, 0.0, shown(7), shown(17)]) {
        let found = value(&model, key, &[partner], seen[row]).confidence;
        assert!(
            (found - expected).abs() < 1e-6,
            "{partner:?}: {found} {expected}"
        );
    }
    let of_pair = |partner: ViewIndex| setting.agreement.of_pair(key, partner);
    assert!(matches!(of_pair(partners[0]), PairAgreement::NoPicture));
    assert!(matches!(
        setting.agreement.of_pair(partners[0], key),
        PairAgreement::NoPicture
    ));
    assert!(matches!(of_pair(partners[1]), PairAgreement::NoCandidate));
    assert!(
        matches!(of_pair(partners[3]), PairAgreement::Compared(values) if values.len() == seen.len())
    );
}

#[test]
fn half_size_is_worth_its_own_fulfilment_and_a_part_of_the_difference_to_full_size() {
    let setting = Setting::pinhole();
    let model = setting.model(Confidence::None);
    let quarter = Model {
        rule: FulfilmentRule {
            image_scale: 0.5,
            ..model.rule
        },
        ..model
    };
    assert_eq!(quarter.at(MapScale::Half).rule.image_scale, 0.25);
    let clusters = [ViewCluster {
        key: ViewIndex(12),
        partners: vec![ViewIndex(11), ViewIndex(13)],
    }];
    let full = table(&model, &clusters, &NoWatcher).unwrap();
    let half = table(&model.at(MapScale::Half), &clusters, &NoWatcher).unwrap();
    let blended = half_size(&model, &clusters, &full, 0.25, &NoWatcher).unwrap();
    assert_eq!(blended.triangles, full.triangles);
    assert_eq!(half.triangles, full.triangles);
    let values = || {
        full.values
            .iter()
            .zip(half.values.iter())
            .zip(blended.values.iter())
    };
    assert!(
        values().any(|((fine, coarse), _)| fine - coarse > 0.01),
        "there is a difference"
    );
    for ((fine, coarse), found) in values() {
        assert!(
            (found - (0.75 * coarse + 0.25 * fine)).abs() < 1e-6,
            "{fine} {coarse} {found}"
        );
    }
}

#[test]
fn a_triangle_without_area_resolves_nothing() {
    let mut setting = Setting::pinhole();
    let triangle = setting.visibility.triangles_seen_by(ViewIndex(12))[40];
    let corners = &mut setting.surface.triangles[triangle as usize];
    corners[2] = corners[1];
    assert_eq!(
        density(&setting.model(Confidence::None), ViewIndex(12), triangle),
        0.0
    );
}

#[test]
fn a_cluster_gives_the_smaller_f_of_each_triangle() {
    let table = FulfilmentTable::new([vec![(0, 0.5f32), (1, 0.2)], vec![(1, 0.9)], vec![(0, 0.1)]]);
    let by_triangle = ByTriangle::new(&table, &[2, 0, 1], 2).unwrap();
    let given = |end| by_triangle.given_by_each(&[0, 1], &[0.25, 0.5], end);
    let is = |found: Vec<f64>, expected: &[f64]| {
        found.len() == expected.len()
            && found
                .iter()
                .zip(expected)
                .all(|(a, b)| (a - b).abs() < 1e-6)
    };
    assert!(
        is(given(3), &[0.1, 0.45, 0.5]) && is(given(2), &[0.1, 0.45]),
        "{:?}",
        given(3)
    );
    assert!((by_triangle.most_by_one(&[0, 1], &[0.25, 0.5]) - 0.5).abs() < 1e-6);
}

#[test]
fn the_memory_of_a_block_is_known_before_it_is_made() {
    let setting = Setting::pinhole();
    let rows = setting.visibility.triangles.len();
    let setting = Setting {
        unary: Unary::of_points((0..rows).map(|row| (row % 6) as u8).collect(), 5),
        ..setting
    };
    let model = setting.model(Confidence::None);
    let partners: Vec<ViewIndex> = (20..30).map(ViewIndex).collect();
    let mut slots = block::BlockSlots::new(&model);
    for key in [0, 12, 24].map(ViewIndex) {
        let mut block = Block::new(&model, key, &partners, |t| t.is_multiple_of(3), &mut slots);
        block.values(&(0..partners.len()).collect::<Vec<_>>());
        let known = Block::bytes(
            setting.visibility.triangles_seen_by(key).len() as u64,
            partners.len() as u64,
        );
        let held = block.held() as u64;
        assert!(held <= known && known <= held + held / 4, "{held} {known}");
    }
}
