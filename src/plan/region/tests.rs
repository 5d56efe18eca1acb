//! Regions over a town of 80 m, whose shares and places are known.

use std::path::{Path, PathBuf};

use nalgebra::Point3;
use serde_json::{Value, json};

use super::{RegionFileError, read};
use crate::{
    base::{column::Storage, progress::NoWatcher},
    config::RegionChoice,
    io::{ply, region_file::RegionFault},
    method::{
        ranking::{Objective, TriangleWeight},
        region::{Region, RegionError, RegionKind, ShapeError},
        synthetic::{Town, block},
        target::Target,
        visibility::{self, Shown, VisibilitySettings},
    },
    model::{
        georeference::{Geodetic, Georeference, MapFrame},
        scene::Scene,
        surface::Surface,
    },
    plan::PlanError,
};

const PLACE: Geodetic = Geodetic {
    longitude: 13.4,
    latitude: 52.5,
    height: 34.0,
};

fn town() -> Town {
    Town {
        boxes: 0,
        points: 300,
        ..Town::default()
    }
}

/// The town's surface, its scene, and a folder for the files of regions.
struct Site {
    scene: Scene,
    surface: Surface,
    folder: tempfile::TempDir,
}

impl Site {
    fn new() -> Self {
        Self {
            scene: town().scene(),
            surface: town().surface(),
            folder: tempfile::tempdir().unwrap(),
        }
    }

    fn file(&self, contents: &[u8]) -> PathBuf {
        let path = self.folder.path().join("region");
        std::fs::write(&path, contents).unwrap();
        path
    }

    fn on(&self, choice: &RegionChoice, place: &Georeference) -> Result<Region, PlanError> {
        let shape = read(choice, place, &MapFrame::new(&self.scene, None))?;
        Ok(shape.lay_over(
            &self.surface,
            &vec![1.0; self.surface.triangles.len()],
            &NoWatcher,
        )?)
    }

    fn with_file(&self, contents: &[u8], place: &Georeference) -> Result<Region, PlanError> {
        self.on(&RegionChoice::File(self.file(contents)), place)
    }

    fn polygons(&self, geojson: &Value, place: &Georeference) -> Result<Region, PlanError> {
        self.with_file(geojson.to_string().as_bytes(), place)
    }

    /// Horizontal area of what counts.
    fn flat_area(&self, region: &Region) -> f64 {
        let of = |(t, &factor): (usize, &f32)| {
            0.5 * self.surface.area_normal(t as u32).z.abs() * f64::from(factor)
        };
        region.factors.iter().enumerate().map(of).sum()
    }
}

/// A rectangle in metres around the town's middle, as a ring in longitude and latitude.
fn ring([x0, y0, x1, y1]: [f64; 4], place: &Georeference) -> Value {
    let at = |x: f64, y: f64| match place.geodetic(&Point3::new(x, y, 0.0)) {
        Some(at) => json!([at.longitude, at.latitude]),
        None => json!([x, y]),
    };
    json!([at(x0, y0), at(x1, y0), at(x1, y1), at(x0, y1), at(x0, y0)])
}

fn feature(rings: &[Value], properties: Value) -> Value {
    json!({ "type": "Feature", "properties": properties, "geometry": { "type": "Polygon", "coordinates": rings } })
}

fn collection(features: &[Value]) -> Value {
    json!({ "type": "FeatureCollection", "features": features })
}

#[test]
fn the_area_of_a_polygon_with_a_hole_counts_in_each_frame() {
    let site = Site::new();
    let (outer, hole) = ([-31.0, -20.5, 20.3, 30.7], [-5.0, -5.0, 10.5, 8.25]);
    let expected = 51.3 * 51.2 - 15.5 * 13.25;
    let far_north = Geodetic {
        latitude: 70.0,
        ..PLACE
    };
    for place in [
        Georeference::Local,
        Georeference::east_north_up(PLACE),
        Georeference::east_north_up(far_north),
    ] {
        let rings = [outer, hole].map(|corners| ring(corners, &place));
        let region = site
            .polygons(&feature(&rings, Value::Null), &place)
            .unwrap();
        let found = site.flat_area(&region);
        // The samples are half a metre apart.
        assert!(
            (found / expected - 1.0).abs() < 0.01,
            "{place:?}: {found} {expected}"
        );
        assert_eq!((region.kind, region.gsd.len()), (RegionKind::Polygons, 0));
    }
}

#[test]
fn the_last_area_that_holds_a_place_decides() {
    let site = Site::new();
    let place = Georeference::Local;
    let areas = [
        feature(
            &[ring([-30.0, -30.0, 30.0, 30.0], &place)],
            json!({ "weight": 0.5, "gsd": 0.2 }),
        ),
        feature(
            &[ring([-10.0, -10.0, 10.0, 10.0], &place)],
            json!({ "weight": 3, "gsd": 0.01 }),
        ),
        feature(
            &[ring([20.0, 20.0, 30.0, 30.0], &place)],
            json!({ "weight": 0 }),
        ),
    ];
    let region = site.polygons(&collection(&areas), &place).unwrap();
    let (mut seen, gsd) = ([0; 4], |t: usize| region.gsd[t]);
    for t in 0..site.surface.triangles.len() {
        let inside = |half: f64| {
            let corners = site.surface.corners(t as u32);
            corners
                .iter()
                .all(|p| p.x.abs() < half - 0.1 && p.y.abs() < half - 0.1)
        };
        let centre = site.surface.centroid(t as u32);
        let (kind, expected) = match () {
            () if inside(10.0) => (0, (3.0, 0.01)),
            () if centre.x.min(centre.y) > 22.0 && inside(30.0) => (1, (0.0, f32::INFINITY)),
            () if centre.x.abs().max(centre.y.abs()) > 34.0 => (2, (0.0, f32::INFINITY)),
            () if centre.x.abs().max(centre.y.abs()) > 14.0 && centre.x < 18.0 && inside(30.0) => {
                (3, (0.5, 0.2))
            }
            () => continue,
        };
        assert_eq!((region.factors[t], gsd(t)), expected, "{centre}");
        seen[kind] += 1;
    }
    assert!(seen.iter().all(|&count| count > 10), "{seen:?}");
}

#[test]
fn wishes_replace_the_target_inside_only() {
    let site = Site::new();
    let square = feature(
        &[ring([-10.0, -10.0, 10.0, 10.0], &Georeference::Local)],
        json!({ "gsd": 0.01 }),
    );
    let region = site.polygons(&square, &Georeference::Local).unwrap();
    let target = Target {
        mode: Default::default(),
        gsd: vec![0.5; site.surface.triangles.len()],
        accuracy_over_gsd: 2.0,
    };
    let with = target.with_wishes(&region);
    for t in 0..site.surface.triangles.len() as u32 {
        assert_eq!(
            with.gsd[t as usize],
            if region.is_inside(t) { 0.01 } else { 0.5 }
        );
    }
    let inside = (0..).find(|&t| region.is_inside(t)).unwrap();
    assert!((with.accuracy(inside) - 0.02).abs() < 1e-8);
}

#[test]
fn a_region_of_everything_is_no_region() {
    let site = Site::new();
    let settings = VisibilitySettings::default();
    let points = site.scene.view_points();
    let visibility = visibility::estimate(
        &site.scene,
        &points,
        &site.surface,
        &settings,
        2.0,
        Storage::Memory,
        &NoWatcher,
    )
    .unwrap();
    let shown = Shown::new(&site.scene, &site.surface, &visibility);
    let everything = site
        .on(
            &RegionChoice::Box([-1e3, -1e3, -1e3, 1e3, 1e3, 1e3]),
            &Georeference::Local,
        )
        .unwrap();
    let half = site
        .on(
            &RegionChoice::Box([0.0, -1e3, -1e3, 1e3, 1e3, 1e3]),
            &Georeference::Local,
        )
        .unwrap();
    for weight in [
        TriangleWeight::Pixels,
        TriangleWeight::Area,
        TriangleWeight::Count,
    ] {
        let objective = |region| Objective::new(&site.surface, &shown, weight, region, 2);
        assert_eq!(objective(Some(&everything)), objective(None));
        let of_half = objective(Some(&half));
        assert!((of_half.inside - 0.5).abs() < 0.03, "{}", of_half.inside);
        assert!((of_half.weights.iter().sum::<f64>() - 1.0).abs() < 1e-12);
        let counts = |t: usize| of_half.weights[t] > 0.0;
        assert!((0..of_half.weights.len()).all(|t| !counts(t) || half.is_inside(t as u32)));
    }
}

#[test]
fn a_box_its_file_and_its_mesh_are_the_same_region() {
    let site = Site::new();
    let corners = [-20.3, 25.1, -40.0, 13.7, -11.9, 1.1];
    let region = site
        .on(&RegionChoice::Box(corners), &Georeference::Local)
        .unwrap();
    let file = site
        .with_file(b"13.7 -11.9 1.1\n-20.3 25.1 -40\n", &Georeference::Local)
        .unwrap();
    assert_eq!(file, region);
    let [low, high] = [[-20.3, -11.9, -40.0], [13.7, 25.1, 1.1]];
    let mesh = block(low, high);
    let ply = ply::write(&mesh.vertices, &mesh.triangles, &[], &[]);
    let solid = site.with_file(&ply, &Georeference::Local).unwrap();
    assert_eq!(
        (solid.kind, &solid.factors),
        (RegionKind::Mesh, &region.factors)
    );
    assert_eq!(region.bounds, [-20.3, -11.9, -40.0, 13.7, 25.1, 1.1]);
    let partly = region
        .factors
        .iter()
        .filter(|&&factor| factor > 0.0 && factor < 1.0)
        .count();
    assert!(partly > 20, "triangles on the border count partly");
}

#[test]
fn a_polygon_on_the_180th_meridian_is_one_in_two_parts() {
    let site = Site::new();
    let place = Georeference::east_north_up(Geodetic {
        longitude: 180.0,
        latitude: -17.0,
        height: 0.0,
    });
    let [west, east] = [[-30.0, -30.0, -1e-6, 30.0], [1e-6, -30.0, 30.0, 30.0]]
        .map(|corners| ring(corners, &place));
    let parts = json!({ "type": "MultiPolygon", "coordinates": [[west], [east]] });
    let region = site.polygons(&parts, &place).unwrap();
    assert!(
        (site.flat_area(&region) / 3600.0 - 1.0).abs() < 0.01,
        "{}",
        site.flat_area(&region)
    );
}

#[test]
fn polygons_in_model_units_may_bring_their_axes() {
    let site = Site::new();
    let place = Georeference::east_north_up(PLACE);
    // The file's x is the model's y.
    let mut turned = feature(
        &[ring([20.0, -10.0, 30.0, 15.0], &Georeference::Local)],
        Value::Null,
    );
    (turned["crs"], turned["axes"]) = (Value::Null, json!([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]));
    let region = site.polygons(&turned, &place).unwrap();
    let middle = |i: usize| 0.5 * (region.bounds[i] + region.bounds[i + 3]);
    assert!(
        (middle(0) + 2.5).abs() < 1.1 && (middle(1) - 25.0).abs() < 1.1,
        "{:?}",
        region.bounds
    );
    turned["axes"] = json!([[0, 0, 0], [-1, 0, 0], [0, 0, 1]]);
    assert!(matches!(
        site.polygons(&turned, &place),
        Err(PlanError::RegionFile(RegionFileError::Shape {
            fault: ShapeError::Axes,
            ..
        }))
    ));
}

#[test]
fn regions_that_hold_nothing_say_why() {
    let site = Site::new();
    let here = Georeference::east_north_up(PLACE);
    let local = Georeference::Local;
    let square = |place: &Georeference| ring([-30.0, -30.0, 30.0, 30.0], place);
    let weightless = feature(&[square(&local)], json!({ "weight": 0 }));
    assert!(matches!(
        site.polygons(&weightless, &local),
        Err(PlanError::Region(RegionError::Weightless))
    ));
    let utm = json!([
        [391_000.0, 5_818_000.0],
        [391_100.0, 5_818_000.0],
        [391_000.0, 5_818_100.0]
    ]);
    assert!(matches!(
        site.polygons(&feature(&[utm], Value::Null), &here),
        Err(PlanError::RegionFile(RegionFileError::Shape {
            fault: ShapeError::NotDegrees { x: 391_000.0, .. },
            ..
        }))
    ));
    let degrees = feature(&[square(&here)], Value::Null);
    assert!(matches!(
        site.polygons(&degrees, &local),
        Err(PlanError::Region(RegionError::OutsideMap {
            is_geodetic: false,
            ..
        }))
    ));
    let mut named = degrees.clone();
    named["crs"] =
        json!({ "type": "name", "properties": { "name": "urn:ogc:def:crs:OGC:1.3:CRS84" } });
    assert!(matches!(
        site.polygons(&named, &local),
        Err(PlanError::RegionFile(RegionFileError::Shape {
            fault: ShapeError::NoGeoreference,
            ..
        }))
    ));
    let there = Georeference::east_north_up(Geodetic {
        longitude: 14.0,
        ..PLACE
    });
    match site.polygons(&feature(&[square(&there)], Value::Null), &here) {
        Err(PlanError::Region(RegionError::OutsideMap {
            region,
            model,
            is_geodetic: true,
        })) => {
            assert!((region.low[0] - 14.0).abs() < 0.01 && (model.low[0] - 13.4).abs() < 0.01);
        }
        other => panic!("{other:?}"),
    }
    let far = site.on(
        &RegionChoice::Box([500.0, 0.0, 0.0, 600.0, 1.0, 1.0]),
        &local,
    );
    assert!(matches!(
        far,
        Err(PlanError::Region(RegionError::OutsideBox { .. }))
    ));
    let mut open = block([-9.0; 3], [9.0; 3]);
    open.triangles.pop();
    let open = ply::write(&open.vertices, &open.triangles, &[], &[]);
    assert!(matches!(
        site.with_file(&open, &local),
        Err(PlanError::RegionFile(RegionFileError::Shape {
            fault: ShapeError::Open(_),
            ..
        }))
    ));
    for contents in [&b"what"[..], b"{\"type\": 3}", b"ply\nformat ascii 1.0\n"] {
        assert!(matches!(
            site.with_file(contents, &local),
            Err(PlanError::RegionFile(RegionFileError::Read { .. }))
        ));
    }
    let nowhere = RegionChoice::File(Path::new("/nowhere/at/all").into());
    assert!(matches!(
        site.on(&nowhere, &local),
        Err(PlanError::RegionFile(RegionFileError::Read { .. }))
    ));
}

#[test]
fn a_huge_file_is_not_read() {
    let site = Site::new();
    let path = site.folder.path().join("region");
    std::fs::File::create(&path)
        .unwrap()
        .set_len(1 << 40)
        .unwrap();
    let refused = site.on(&RegionChoice::File(path), &Georeference::Local);
    assert!(matches!(
        refused,
        Err(PlanError::RegionFile(RegionFileError::Read {
            fault: RegionFault::Read(_),
            ..
        }))
    ));
}

/// All of them would have to be looked at for each sample.
#[test]
fn a_comb_or_many_polygons_above_each_other_are_too_intricate() {
    let (site, local) = (Site::new(), Georeference::Local);
    let tooth = |i: u32| {
        [[0.0, -40.0], [0.2, 40.0]].map(|[dx, y]| [f64::from(i) * 4e-4 - 40.0 + dx * 1e-3, y])
    };
    let back = [[41.0, -41.0], [-41.0, -41.0]];
    let comb: Vec<[f64; 2]> = (0..200_000).flat_map(tooth).chain(back).collect();
    let square = [[[-40.0, -40.0], [40.0, -40.0], [40.0, 40.0]]];
    for coordinates in [json!([[comb]]), json!(vec![square; 100_000])] {
        let polygons = json!({ "type": "MultiPolygon", "coordinates": coordinates, "crs": null });
        let refused = site.polygons(&polygons, &local);
        assert!(
            matches!(refused, Err(PlanError::Region(RegionError::TooIntricate))),
            "{refused:?}"
        );
    }
}
