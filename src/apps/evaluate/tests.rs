//! Depth maps of a town whose surface is known: exact ones reach all that can be reached, damaged
//! ones what is left of them.

use std::path::Path;

use nalgebra::Point3;

use super::*;
use crate::{
    base::{column::Storage, pixels::PixelBound, progress::NoWatcher},
    config::{TargetMode, TargetSettings},
    io::{
        depthmaps::{self, DepthMapError, DepthMapFormat},
        npy,
    },
    method::{
        confidence::{Confidence, NO_AGREEMENT, Unary},
        fulfilment::{FulfilmentRule, Model},
        ranking::Objective,
        synthetic::{SeenTown, Town},
        target::Target,
        visibility::{self, Visibility},
    },
    model::{
        camera::{Camera, CameraModel},
        cluster::ViewCluster,
        scene::{Scene, ViewIndex},
        surface::Surface,
    },
};

const GSD: f64 = 0.2;
/// Pixels of a depth map: two thirds of the image.
const SIZE: [u32; 2] = [200, 150];

struct Fixture {
    scene: Scene,
    surface: Surface,
    visibility: Visibility,
    target: Target,
    unary: Unary,
}

impl Fixture {
    fn new() -> Self {
        let town = Town::new(
            Camera::new(
                1,
                CameraModel::Pinhole,
                300,
                225,
                vec![280.0, 280.0, 150.0, 112.5],
            )
            .unwrap(),
        );
        let wanted = TargetSettings {
            gsd: Some(GSD),
            accuracy: None,
            mode: TargetMode::Absolute,
        };
        let SeenTown {
            scene,
            surface,
            visibility,
            target,
        } = town.seen(&wanted, GSD, Storage::Memory);
        Self {
            scene,
            surface,
            visibility,
            target,
            unary: Unary::certain(),
        }
    }

    fn model(&self) -> Model<'_> {
        let rule = FulfilmentRule {
            alpha: 0.5,
            sigma_px: 0.5,
            min_cameras: 3,
            image_scale: 1.0,
            confidence: Confidence::None,
        };
        Model {
            scene: &self.scene,
            surface: &self.surface,
            visibility: &self.visibility,
            target: &self.target,
            unary: &self.unary,
            agreement: &NO_AGREEMENT,
            rule,
        }
    }

    /// The first view with the next three as partners, and so on.
    fn clusters(&self, count: u32) -> Vec<ViewCluster> {
        let partners = |key: u32| (1..4).map(|i| ViewIndex(key + i)).collect();
        (0..count)
            .map(|key| ViewCluster {
                key: ViewIndex(key),
                partners: partners(key),
            })
            .collect()
    }

    /// Depth where the ray through a pixel's centre meets the plane of the triangle in front there;
    /// `damage` may change it.
    fn write_maps(&self, folder: &Path, count: u32, damage: impl Fn(u32, u32, f64) -> f64) {
        for view in (0..count).map(ViewIndex) {
            let depth = visibility::front(&self.scene, &self.surface, view, SIZE, 0..SIZE[1]);
            let depth = depth.iter().enumerate().map(|(at, &t)| {
                let (column, row) = (at as u32 % SIZE[0], at as u32 / SIZE[0]);
                let exact = if t == visibility::NOTHING {
                    0.0
                } else {
                    self.depth(view, column, row, t)
                };
                damage(column, row, exact) as f32
            });
            write_map(
                &folder.join(format!("{}.npy", self.scene.name(view))),
                SIZE,
                depth.collect(),
            );
        }
    }

    /// Columns and rows of the pixels that show the surface.
    fn surface_pixels(&self, view: ViewIndex) -> Vec<(u32, u32)> {
        let picture = visibility::front(&self.scene, &self.surface, view, SIZE, 0..SIZE[1]);
        let shown = picture
            .iter()
            .enumerate()
            .filter(|(_, t)| **t != visibility::NOTHING);
        shown
            .map(|(at, _)| (at as u32 % SIZE[0], at as u32 / SIZE[0]))
            .collect()
    }

    fn depth(&self, view: ViewIndex, column: u32, row: u32, triangle: u32) -> f64 {
        let camera = self.scene.camera_of(view);
        let scale = f64::from(camera.width) / f64::from(SIZE[0]);
        let pixel = Point3::new(
            (f64::from(column) + 0.5) * scale,
            (f64::from(row) + 0.5) * scale,
            0.0,
        )
        .xy();
        let ray = camera.ray(&pixel).unwrap();
        let pose = &self.scene.view(view).cam_from_world;
        let [a, b, c] = self
            .surface
            .corners(triangle)
            .map(|p| pose.camera_from_world(&p));
        let normal = (b - a).cross(&(c - a));
        normal.dot(&a.coords) / normal.dot(&ray) * ray.z
    }

    fn run(
        &self,
        clusters: &[ViewCluster],
        maps: &Path,
        reference: Option<&Path>,
    ) -> Result<MeasuredClusters, EvaluateError> {
        let task = EvaluationInput {
            model: self.model(),
            clusters,
            depth_maps: maps,
            known: Box::new(|_| true),
            of_plan: None,
            reference,
            accuracy: GSD,
            places: None,
            half_worth: None,
        };
        MeasuredClusters::new(&task, &NoWatcher)
    }
}

fn write_map(path: &Path, size: [u32; 2], depth: Vec<f32>) {
    let bytes = npy::write(&[size[1] as usize, size[0] as usize], depth);
    std::fs::write(path, bytes).unwrap();
}

fn folders() -> (tempfile::TempDir, tempfile::TempDir) {
    (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap())
}

#[test]
fn masks_limit_what_a_map_shows() {
    let (mut town, (maps, _truth)) = (Fixture::new(), folders());
    town.write_maps(maps.path(), 2, |_, _, exact| exact);
    let key = ViewIndex(1);
    let shares = |town: &Fixture| {
        let path = maps.path().join(format!("{}.npy", town.scene.name(key)));
        let map = depthmaps::read(&path, DepthMapFormat::Npy, PixelBound::LARGEST).unwrap();
        measure(&town.model(), key, map, None, GSD, None).shares
    };
    let without = shares(&town);
    // Of three triangles of the table, one is excluded, one in part, one not at all.
    let allowed = |row: usize| (row % 3) as f32 / 2.0;
    town.unary =
        Unary::certain().within((0..town.visibility.triangles.len()).map(allowed).collect());
    let rows = town.visibility.rows(key);
    let with: Vec<f32> = rows
        .zip(&without)
        .map(|(row, &share)| if row % 3 == 0 { 0.0 } else { share })
        .collect();
    assert_eq!(shares(&town), with);
    assert!(with != without);
}

#[test]
fn exact_maps_reach_all_that_can_be_reached() {
    let town = Fixture::new();
    let (maps, truth) = folders();
    town.write_maps(maps.path(), 4, |_, _, exact| exact);
    town.write_maps(truth.path(), 4, |_, _, exact| exact);
    let clusters = town.clusters(4);
    let run = town
        .run(&clusters, maps.path(), Some(truth.path()))
        .unwrap();
    assert_eq!(run.clusters, clusters);
    assert_eq!(run.real, run.attainable);
    assert!(run.real.triangles.len() > 500);
    let all = run.pooled();
    assert_eq!((all.completeness(), all.outliers()), (1.0, 0.0));
    assert!(all.rmse() < 1e-9);
    // Three views of three partners each: x = 3 holds nearly everywhere.
    assert_eq!(run.predicted, run.attainable);
}

#[test]
fn errors_along_the_ray_beyond_three_times_the_accuracy_are_outliers() {
    let town = Fixture::new();
    let (maps, truth) = folders();
    town.write_maps(truth.path(), 1, |_, _, exact| exact);
    // Left half off by 2.9 a_d along the z axis, which along slanted rays is more; right half by
    // 2.5 a_d.
    let error = |column: u32| if column < SIZE[0] / 2 { 2.9 } else { 2.5 };
    town.write_maps(maps.path(), 1, |column, _, exact| {
        if exact > 0.0 {
            exact + GSD * error(column)
        } else {
            0.0
        }
    });
    let run = town
        .run(&town.clusters(1), maps.path(), Some(truth.path()))
        .unwrap();
    let camera = town.scene.camera_of(ViewIndex(0));
    let (fx, c) = (camera.params()[0], [camera.params()[2], camera.params()[3]]);
    let surface = town.surface_pixels(ViewIndex(0));
    let right = surface.iter().filter(|(column, row)| {
        let (x, y) = (
            f64::from(*column) * 1.5 + 0.75 - c[0],
            f64::from(*row) * 1.5 + 0.75 - c[1],
        );
        error(*column) * (1.0 + (x * x + y * y) / (fx * fx)).sqrt() <= 3.0
    });
    let expected = right.count() as u64;
    let quality = run.quality[0];
    assert_eq!(quality.both, surface.len() as u64);
    assert!(
        quality.right.abs_diff(expected) < 5,
        "{} {expected}",
        quality.right
    );
    assert!(quality.rmse() > 2.5 * GSD && quality.rmse() <= 3.0 * GSD);
}

#[test]
fn a_hole_takes_its_share_of_the_triangles_in_it() {
    let town = Fixture::new();
    let (maps, truth) = folders();
    town.write_maps(truth.path(), 2, |_, _, exact| exact);
    town.write_maps(
        maps.path(),
        2,
        |_, row, exact| if row < SIZE[1] / 3 { 0.0 } else { exact },
    );
    let run = town
        .run(&town.clusters(2), maps.path(), Some(truth.path()))
        .unwrap();
    let pixels = |view| town.surface_pixels(ViewIndex(view));
    let kept = |view| {
        pixels(view)
            .iter()
            .filter(|(_, row)| *row >= SIZE[1] / 3)
            .count()
    };
    let all = run.pooled();
    assert_eq!(
        (all.right as usize, all.reference as usize),
        (kept(0) + kept(1), pixels(0).len() + pixels(1).len())
    );
    let sum = |values: &[f32]| values.iter().map(|&f| f64::from(f)).sum::<f64>();
    let share = sum(&run.real.values) / sum(&run.attainable.values);
    assert!((0.4..0.9).contains(&share), "{share}");
    let reached = MeasuredSurface::new(&town.model(), &run);
    assert!(reached.counts(|_| true)[&Missing::MatchingFailed] > 0);
    // Without a reference each depth counts, holes do not.
    let blind = town.run(&town.clusters(2), maps.path(), None).unwrap();
    assert_eq!(blind.real, run.real);
    assert_eq!(blind.pooled().outliers(), 0.0);
}

#[test]
fn the_report_takes_away_partners_that_were_not_matched() {
    let town = Fixture::new();
    let (maps, _) = folders();
    town.write_maps(maps.path(), 1, |_, _, exact| exact);
    let clusters = town.clusters(1);
    let name = |v: u32| town.scene.name(ViewIndex(v));
    let partner = |v: u32, matched| format!(r#"{{"name": "{}", "matched": {matched}}}"#, name(v));
    let rows = [partner(1, true), partner(2, false), partner(3, false)].join(",");
    let report = format!(
        r#"{{"clusters": [{{"key": "{}", "partners": [{rows}]}}]}}"#,
        name(0)
    );
    std::fs::write(maps.path().join("report.json"), report).unwrap();
    let run = town.run(&clusters, maps.path(), None).unwrap();
    assert_eq!(run.matched[0].partners, [ViewIndex(1)]);
    // One partner and the key view are fewer than x = 3.
    assert!(run.real.triangles.is_empty() && !run.predicted.triangles.is_empty());
    let reached = MeasuredSurface::new(&town.model(), &run);
    assert!(reached.counts(|_| true)[&Missing::TooFewPartners] > 0);
    assert!(run.other_partners.is_empty());
}

#[test]
fn what_does_not_fit_is_an_error_that_says_so() {
    let town = Fixture::new();
    let (maps, truth) = folders();
    town.write_maps(maps.path(), 2, |_, _, exact| exact);
    town.write_maps(truth.path(), 1, |_, _, exact| exact);
    // A view without reference counts as wrong, not as right.
    let run = town
        .run(&town.clusters(2), maps.path(), Some(truth.path()))
        .unwrap();
    assert!(run.real.row(0).1.len() > 100 && run.real.row(1).1.is_empty());
    let other = ViewCluster {
        key: ViewIndex(9),
        partners: vec![ViewIndex(1)],
    };
    assert!(matches!(
        town.run(&[other], maps.path(), None),
        Err(EvaluateError::NoClusters(_))
    ));
    let path = maps
        .path()
        .join(format!("{}.npy", town.scene.name(ViewIndex(0))));
    write_map(&path, [300, 100], vec![1.0; 30_000]);
    assert!(matches!(
        town.run(&town.clusters(1), maps.path(), None),
        Err(EvaluateError::DepthMap(DepthMapError::Shape { .. }))
    ));
}

#[test]
fn the_page_is_whole_and_the_orders_agree_with_plain_sums() {
    let town = Fixture::new();
    let (maps, truth) = folders();
    town.write_maps(truth.path(), 12, |_, _, exact| exact);
    town.write_maps(maps.path(), 12, |column, row, exact| {
        if (column / 20 + row / 30) % 3 == 0 {
            0.0
        } else {
            exact
        }
    });
    let run = town
        .run(&town.clusters(12), maps.path(), Some(truth.path()))
        .unwrap();
    let objective = Objective::weighing(vec![1.0; town.surface.triangles.len()], 1);
    let model = town.model();
    let reached = MeasuredSurface::new(&model, &run);
    let so_far = MeasuredProgress::default();
    // Three maps agree in two of five cells.
    let table = maps.path().join("cells.tsv");
    let key = |&c: &u32| model.scene.name(run.clusters[c as usize].key);
    let names: Vec<&str> = run.order.iter().map(key).collect();
    std::fs::write(&table, names.join("\t") + "\n5\t2\t7\n").unwrap();
    let cells = (
        cells::Incidence::read(&table, 2, 99).unwrap(),
        cells::CellSource::Maps,
    );
    let how = EvaluationOptions {
        all_maps: 2,
        objective: &objective,
        pilot: None,
        cells,
        baselines: true,
        so_far,
        clouds: None,
        half: None,
    };
    let evaluation = Evaluation::new(&model, &run, &reached, &how, &NoWatcher).unwrap();
    let best: f64 = reached
        .fulfilment
        .iter()
        .map(|&f| f64::from(f))
        .sum::<f64>()
        / objective.weights.len() as f64;
    assert!((evaluation.real - best).abs() < 1e-9);
    for order in &evaluation.orders {
        assert!(
            (order.kept[12] - evaluation.kept.real).abs() < 1e-9,
            "{}",
            order.name
        );
        assert!(
            order
                .needed
                .windows(2)
                .all(|n| n[0].clusters <= n[1].clusters),
            "{}",
            order.name
        );
    }
    let needed = |name: &str| {
        &evaluation
            .orders
            .iter()
            .find(|o| o.name == name)
            .unwrap()
            .needed
    };
    assert!(
        needed("optimum")
            .iter()
            .zip(needed("random"))
            .all(|(a, b)| a.clusters <= b.clusters + 1.0)
    );
    let page = page(&evaluation, "a <town>");
    assert!(page.contains("a &lt;town&gt;") && page.ends_with("</body></html>\n"));
    assert_eq!(evaluation.curve.real[..4], [0.0, 0.0, 1.0, 1.0]);
    assert_eq!(
        page.matches("<polyline").count(),
        1 + evaluation.cells.all.orders.len()
    );
    assert!(
        !page.contains("http://")
            || page.matches("http://").count() == page.matches("http://www.w3.org").count()
    );
    assert!(crate::io::ply::read(&reached.ply(&model)).is_ok());
}
