//! A surface in tiles against the whole one: the same model, and what the tiled order reaches on
//! the whole surface.

use std::{fs, path::Path};

use viewrank::{
    Plan, PlanError, Settings,
    config::{Bytes, ConfidenceSource},
    evaluate::curve::ReachCurve,
    plan,
};
use viewrank_core::{
    base::{column::Storage, progress::NoWatcher},
    method::{fulfilment, synthetic::Town},
    model::camera::{Camera, CameraModel},
};
use viewrank_io::{
    formats::{colmap::ColmapModel, colmap_bin},
    project::Project,
};

fn fixture() -> Project {
    Project::open(
        &Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/valley"),
        None,
    )
    .unwrap()
}

fn planned(project: &Project, change: impl FnOnce(&mut Settings)) -> Plan {
    let mut settings = Settings {
        backends: vec!["sgm".into()],
        ..Settings::default()
    };
    change(&mut settings);
    plan(project, &settings, &NoWatcher).unwrap()
}

/// Plans by triangles alone: an order by the pilot's places is made of pictures, not of the surface
/// that tiles change.
fn by_triangles(settings: &mut Settings) {
    settings.confidence.source = ConfidenceSource::Geometric;
}

/// f_o, on the whole surface, of the first i clusters of the tiled plan.
fn on_the_whole(whole: &Plan, tiled: &Plan) -> Vec<f64> {
    let table =
        fulfilment::table(&whole.stages.model(), &tiled.stages.clusters, &NoWatcher).unwrap();
    ReachCurve::new(
        &table,
        &whole.stages.objective,
        &tiled.stages.clusters,
        &tiled.decision.ranking.order,
    )
    .fulfilment
}

/// Most fulfilment that the tiled order lacks at equal length, over what the whole one reaches with
/// all.
fn loss(whole: &Plan, tiled: &Plan) -> f64 {
    let reached = on_the_whole(whole, tiled);
    let lacks = |(i, f): (usize, &f64)| f - reached[(i + 1).min(reached.len() - 1)];
    whole
        .decision
        .ranking
        .fulfilment
        .iter()
        .enumerate()
        .map(lacks)
        .fold(0.0, f64::max)
        / whole.decision.ranking.fulfilment.last().unwrap()
}

#[test]
fn one_tile_is_the_whole() {
    let project = fixture();
    let whole = planned(&project, |_| ());
    let one = planned(&project, |s| s.surface.tile_points = Some(u32::MAX));
    assert_eq!(whole.stages.surface.vertices, one.stages.surface.vertices);
    assert_eq!(whole.decision.ranking, one.decision.ranking);
    assert_eq!(
        (
            whole.stages.surface_stats.tiles,
            one.stages.surface_stats.tiles
        ),
        (1, 1)
    );
}

#[test]
fn tiles_lose_next_to_nothing() {
    let project = fixture();
    let whole = planned(&project, by_triangles);
    let tiled = planned(&project, |s| {
        by_triangles(s);
        s.surface.tile_points = Some(4000);
    });
    assert_eq!(tiled.stages.surface_stats.tiles, 4);
    assert!(tiled.warnings.iter().any(|w| w.contains("4 tiles")));
    let area = |plan: &Plan| {
        (0..plan.stages.surface.triangles.len() as u32)
            .map(|t| plan.stages.surface.area(t))
            .sum::<f64>()
    };
    assert!(
        (area(&tiled) / area(&whole) - 1.0).abs() < 0.05,
        "{} {}",
        area(&tiled),
        area(&whole)
    );
    let loss = loss(&whole, &tiled);
    eprintln!("fixtures/valley in 4 tiles: loss {:.3} %", 100.0 * loss);
    assert!(loss < 0.02, "{loss}");
}

#[test]
fn tables_on_disk_change_nothing() {
    let camera = Camera::new(
        1,
        CameraModel::Pinhole,
        300,
        225,
        vec![280.0, 280.0, 150.0, 112.5],
    )
    .unwrap();
    let town = Town {
        grid: 12,
        tilt: Some(35.0),
        points: 6000,
        ..Town::new(camera)
    };
    let scene = town.scene();
    // More views than are read at a time.
    assert!(scene.views.len() > 256);
    let folder = tempfile::tempdir().unwrap();
    let model = ColmapModel::from_scene(&scene);
    fs::create_dir_all(folder.path().join("sparse/0")).unwrap();
    for (name, bytes) in colmap_bin::write(&model) {
        fs::write(folder.path().join("sparse/0").join(name), bytes).unwrap();
    }
    let project = Project::open(folder.path(), None).unwrap();
    let memory = planned(&project, |_| ());
    // What would do without an eighth of its rows.
    let limit =
        memory.stages.memory.visibility - memory.stages.visibility.triangles.len() as u64 / 4;
    let disk = planned(&project, |s| s.max_memory = Some(Bytes(limit)));
    assert!(
        memory.stages.memory.disk == 0
            && disk.stages.memory.disk >= 13 * memory.stages.visibility.triangles.len() as u64
    );
    assert!(disk.stages.memory.peak() <= limit && disk.stages.surface_stats.tiles == 1);
    assert_eq!(
        [
            disk.stages.visibility.triangles.storage(),
            disk.stages.fulfilment.values.storage()
        ],
        [Storage::Disk; 2]
    );
    // Too large to be kept for the next plan: what was kept before is removed.
    let kept = |plan: &Plan| {
        plan.unwritten()
            .iter()
            .filter(|set| !set.files.is_empty())
            .count()
    };
    assert_eq!(
        (kept(&disk), disk.unwritten().len(), kept(&memory)),
        (4, 7, 7)
    );
    assert_eq!(disk.stages.visibility, memory.stages.visibility);
    assert_eq!(
        (&disk.stages.unary, &disk.stages.fulfilment),
        (&memory.stages.unary, &memory.stages.fulfilment)
    );
    assert_eq!(
        (
            &disk.stages.clusters,
            &disk.decision.ranking,
            disk.decision.cut
        ),
        (
            &memory.stages.clusters,
            &memory.decision.ranking,
            memory.decision.cut
        )
    );
    assert_eq!(
        (&disk.decision.views, &disk.decision.triangle_reasons),
        (&memory.decision.views, &memory.decision.triangle_reasons)
    );
    assert_eq!(
        (disk.decision.forecast, disk.best_substitutes().unwrap()),
        (memory.decision.forecast, memory.best_substitutes().unwrap())
    );
}

/// A synthetic survey of 300 views, the set `survey` of `benches/sets.py`.
#[test]
#[ignore = "needs VIEWRANK_DATA: survey"]
fn a_survey_in_tiles() {
    let default = || concat!(env!("CARGO_MANIFEST_DIR"), "/target/data").into();
    let folder =
        Path::new(&std::env::var_os("VIEWRANK_DATA").unwrap_or_else(default)).join("survey");
    let project = Project::open(Path::new(&folder), None).unwrap();
    let whole = planned(&project, by_triangles);
    let most = project.read_scene().unwrap().points.len() as u32 / 4;
    let tiled = planned(&project, |s| {
        by_triangles(s);
        s.surface.tile_points = Some(most);
    });
    let loss = loss(&whole, &tiled);
    eprintln!(
        "{} views in {} tiles: loss {:.3} %",
        whole.stages.scene.views.len(),
        tiled.stages.surface_stats.tiles,
        100.0 * loss
    );
    assert!(loss < 0.005, "{loss}");
}

#[test]
fn a_limit_that_is_too_small_is_refused_with_one_that_is_not() {
    use viewrank_core::base::error::Hint;
    let settings = Settings {
        max_memory: Some(Bytes(60 << 20)),
        ..Settings::default()
    };
    let error = plan(&fixture(), &settings, &NoWatcher).unwrap_err();
    let PlanError::Memory { with_pictures, .. } = error else {
        panic!("{error}")
    };
    assert!(error.hint().unwrap().to_string().contains("max_memory"));
    // What the hint adds.
    let advised = with_pictures + with_pictures / 20;
    let enough = Settings {
        max_memory: Some(Bytes(advised)),
        ..Settings::default()
    };
    let plan = plan(&fixture(), &enough, &NoWatcher).unwrap();
    assert!(plan.stages.memory.peak() <= advised);
    assert_eq!(plan.stages.settings.max_memory, enough.max_memory);
}
